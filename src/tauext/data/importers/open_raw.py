"""Importers of all formats; a file's format is found by its first bytes, regardless of its name."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from tauext import plugins
from tauext.data.importers import csv_table, hdf5, parquet, ros
from tauext.data.importers.bag import ZSTD_MAGIC
from tauext.data.importers.raw import BEGIN, Export, Importer, RawRecording
from tauext.errors import ConfigError, RecordingError
from tauext.files.plain_file import expect_file


def fits_ros(path: Path, begin: bytes) -> bool:
    return path.is_dir() or begin.startswith((*ros.KINDS, ZSTD_MAGIC))


def fits_csv(path: Path, begin: bytes) -> bool:
    text = begin.rstrip(b"\0")  # a file system leaves zeros at the end of a file after a crash
    return begin.startswith((csv_table.GZIP_MAGIC, *csv_table.UTF16_MAGIC)) or (bool(text) and b"\0" not in text)


def begins(*magics: bytes) -> Callable[[Path, bytes], bool]:
    return lambda path, begin: begin.startswith(magics)


IMPORTERS: dict[str, Importer] = {
    "ros": Importer("ROS 1 bag, ROS 2 bag (sqlite3, MCAP, or their folder)", fits_ros, ros.open_bag),
    "parquet": Importer(
        "Parquet, Arrow", begins(parquet.MAGIC, parquet.ARROW_MAGIC), lambda path, _: parquet.open_parquet(path)
    ),
    "matlab": Importer("MATLAB", begins(*hdf5.MATLAB_MAGICS), lambda path, _: hdf5.open_matlab(path)),
    "hdf5": Importer("HDF5", begins(hdf5.MAGIC), lambda path, _: hdf5.open_hdf5(path)),
    "csv": Importer("CSV (also gzipped)", fits_csv, lambda path, _: csv_table.open_csv(path)),
}
"""The importers of this package by name. The first that fits is used: any text fits CSV, any folder a bag."""


def importers() -> dict[str, Importer]:
    """Importers of packages, which may know a narrower format than Parquet or CSV, then those of this package."""
    return plugins.every(plugins.IMPORTERS, Importer, IMPORTERS) | IMPORTERS


def open_raw(path: Path | str, topics: Sequence[str] = ()) -> list[RawRecording]:
    """Open the recordings in a file or folder of any supported format: one, or one an episode.

    Args:
        topics: topics of a bag to read; empty: its only topic of JointState.

    Raises:
        RecordingError: no such file, an unsupported format, or a damaged or empty file.
        ConfigError: the package that reads this format is not installed, or one cannot be loaded.
    """
    path = Path(path)
    begin = b"" if path.is_dir() else beginning(path)
    known = importers()
    for mark, name in plugins.IMPORTED.items():
        if (path / mark).is_file() and (how := plugins.how_to_add(name)):
            raise ConfigError(f"{path}: {how}")
    for importer in known.values():
        if importer.fits(path, begin):
            return importer.open(path, topics)
    formats = ", ".join(importer.format for importer in (IMPORTERS | known).values())
    raise RecordingError(f"{path}: its first bytes are of no format that is read; these are: {formats}")


def beginning(path: Path) -> bytes:
    """The first bytes of a file. Raises RecordingError: it is missing, empty, no file, or cannot be read."""
    try:
        expect_file(path)
        with path.open("rb") as file:
            begin = file.read(BEGIN)
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: there is no such file") from error
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
    if not begin:
        raise RecordingError(f"{path}: the file is empty; copy or record it again")
    return begin


def exporting(name: str) -> Export:
    """The function that writes datasets of the format of this importer."""
    importer = plugins.named(name, IMPORTERS, plugins.IMPORTERS, Importer)
    if importer is None and (how := plugins.how_to_add(name)):
        raise ConfigError(f"format = {name}: {how}")
    if importer is None or importer.export is None:
        written = ", ".join(["tauext", *(other for other, one in importers().items() if one.export)])
        raise ConfigError(f"format = {name} must be one of {written}")
    return importer.export
