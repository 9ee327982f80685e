"""Detect a file's format by its first bytes, regardless of its name."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tauext.data import lerobot_folder
from tauext.data.importers import csv_table, hdf5, parquet, ros
from tauext.data.importers.raw import RawRecording
from tauext.errors import RecordingError
from tauext.files.plain_file import expect_file

FORMATS = (
    "ROS 1 bag, ROS 2 bag (sqlite3, MCAP, or their folder), CSV (also gzipped), Parquet, Arrow, HDF5, MATLAB, "
    "LeRobot folder"
)


def open_raw(path: Path | str, topics: Sequence[str] = ()) -> list[RawRecording]:
    """Open the recordings in a file or folder of any supported format: one, or one an episode.

    Args:
        topics: topics of a bag to read; empty: its only topic of JointState.

    Raises:
        RecordingError: no such file, an unsupported format, or a damaged or empty file.
    """
    path = Path(path)
    if path.is_dir():
        if (path / lerobot_folder.INFO).is_file():
            return lerobot_folder.open_lerobot(path)
        return ros.open_bag(path, topics)
    try:
        expect_file(path)
        with path.open("rb") as file:
            begin = file.read(1024)
    except FileNotFoundError as error:
        raise RecordingError(f"{path}: there is no such file") from error
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error.strerror})") from error
    if not begin:
        raise RecordingError(f"{path}: the file is empty; copy or record it again")
    if begin.startswith(ros.MAGICS):
        return ros.open_bag(path, topics)
    if begin.startswith((parquet.MAGIC, parquet.ARROW_MAGIC)):
        return parquet.open_parquet(path)
    if begin.startswith((hdf5.MAGIC_5, hdf5.MAGIC_73)):
        return hdf5.open_matlab(path)
    if begin.startswith(hdf5.MAGIC):
        return hdf5.open_hdf5(path)
    text = begin.rstrip(b"\0")  # a file system leaves zeros at the end of a file after a crash
    if begin.startswith((csv_table.GZIP_MAGIC, *csv_table.UTF16_MAGIC)) or (text and b"\0" not in text):
        return csv_table.open_csv(path)
    raise RecordingError(f"{path}: its first bytes are of no format that is read; these are: {FORMATS}")
