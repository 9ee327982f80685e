"""What a path holds, for messages: a dataset, a recording, a bundle, or a file that has to be imported first."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from tauext.files.plain_file import BUNDLE_MAGIC, json_of, read_text

LOGS = {
    ".csv": "a CSV file",
    ".gz": "a CSV file",
    ".txt": "a text file",
    ".bag": "a ROS 1 bag",
    ".mcap": "a ROS 2 bag",
    ".db3": "a ROS 2 bag",
    ".h5": "an HDF5 file",
    ".hdf5": "an HDF5 file",
    ".mat": "a MATLAB file",
}
"""Files that `tauext import` reads, by the end of their names."""
SPLIT = "split.json"


def why_no_dataset(path: Path) -> str:
    """What the path holds instead of a dataset, and the next command; empty where a folder holds nothing known."""
    if not path.exists():
        return (
            "there is no such dataset folder; `tauext import` makes one of recordings of an arm, "
            f"`tauext simulate --out {path}` one of a simulated arm"
        )
    if path.is_file():
        if is_recording(path):
            folder = path.parent
            if (folder / SPLIT).is_file():
                return f"is one recording of a dataset; give the folder of the dataset: {folder}"
            return f"is a recording, not a dataset folder; {make_dataset(path)}"
        if is_bundle(path):
            return "is a bundle, not a dataset folder"
        return f"is {log_kind(path)}, not a dataset folder; {make_dataset(path)}"
    if log := first_log(path):
        return f"is no dataset but holds {log_kind(log)}; {make_dataset(log)}"
    if is_simulated(path):
        return f"holds an interrupted simulation; the same `tauext simulate --out {path}`, run again, completes it"
    if recording := first(path, ".parquet"):
        return f"holds recordings but no {SPLIT}, so it is no dataset; {make_dataset(recording)}"
    return ""


def why_no_recording(path: Path) -> str:
    """What the path holds instead of a recording, and the next command; empty where a file holds nothing known."""
    if path.is_dir():
        if first(path, ".parquet"):
            folder = "dataset folder" if (path / SPLIT).is_file() else "folder"
            return f"is a {folder}, not a recording; give its recordings: {path}/*.parquet"
        if log := first_log(path):
            return f"is a folder, not a recording; {import_first(log)}"
        return "is a folder, not a recording (*.parquet)"
    if is_bundle(path):
        return "is a bundle, not a recording (*.parquet); the bundle comes first, then the recordings"
    if kind := LOGS.get(path.suffix):
        return f"is {kind}, not a recording (*.parquet); {import_first(path)}"
    return ""


def why_no_bundle(path: Path) -> str:
    """What the path holds instead of a bundle, and the next command; empty where a file holds nothing known."""
    if not path.exists():
        return "there is no such bundle; `tauext train` makes one"
    if path.is_dir():
        if (path / SPLIT).is_file():
            return f"is a dataset folder, not a bundle; `tauext train --data {path} --out NAME.tauext` makes a bundle"
        return "is a folder, not a bundle (*.tauext); `tauext train` makes a bundle"
    if is_recording(path) or path.suffix in LOGS:
        kind = LOGS.get(path.suffix, "a recording")
        return f"is {kind}, not a tauext bundle; the bundle (*.tauext) comes first, then the recordings"
    return ""


def make_dataset(log: Path) -> str:
    return (
        f"`tauext import --new arm.toml --source {log}` describes it, then "
        f"`tauext import --source {log} --arm arm.toml --out DIR` makes the dataset DIR"
    )


def import_first(log: Path) -> str:
    return f"import it first: `tauext import --new arm.toml --source {log}` begins"


def log_kind(path: Path) -> str:
    """A file or folder that `tauext import` may read, in words."""
    if path.is_dir():
        return "a LeRobot dataset" if (path / "meta").is_dir() else "a ROS 2 bag"
    return LOGS.get(path.suffix, "a Parquet file" if path.suffix == ".parquet" else "a file")


def first_log(folder: Path) -> Path | None:
    """The first of the logs in a folder, or the folder itself where it is one log."""
    if (folder / "metadata.yaml").is_file() or (folder / "meta" / "info.json").is_file():
        return folder
    return first(folder, *LOGS)


def first(folder: Path, *ends: str) -> Path | None:
    """The first file, by name, that ends so."""
    return min((one for one in folder.iterdir() if one.suffix in ends and one.is_file()), key=str, default=None)


def is_simulated(folder: Path) -> bool:
    """Whether `tauext simulate` made the folder or began to; its run.json states it."""
    with suppress(OSError, ValueError):
        run = json_of(read_text(folder / "run.json"))
        return isinstance(run, dict) and run.get("command") == "simulate"
    return False


def is_bundle(path: Path) -> bool:
    return begins(path, BUNDLE_MAGIC)


def is_recording(path: Path) -> bool:
    """Whether the file is a recording of tauext, and not another Parquet file."""
    if path.suffix != ".parquet" or not begins(path, b"PAR1"):
        return False
    with suppress(OSError), path.open("rb") as raw:
        raw.seek(max(0, raw.seek(0, 2) - (1 << 20)))  # the metadata are at the end
        return b"tauext_format" in raw.read()
    return False


def begins(path: Path, magic: bytes) -> bool:
    with suppress(OSError):
        if path.is_file():
            with path.open("rb") as raw:
                return raw.read(len(magic)) == magic
    return False
