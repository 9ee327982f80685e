"""What there is to examine: recordings of a dataset, a folder or by name, and the robot file beside them."""

from __future__ import annotations

from pathlib import Path, PurePath

from tauext.data.dataset import ROBOT_FILES, load_dataset
from tauext.data.recording import Recording
from tauext.data.recording_file import describe, load_recording
from tauext.errors import ConfigError
from tauext.files.copies import local_robot
from tauext.files.places import Place
from tauext.progress import SILENT, Reporter
from tauext.robot.write import is_placeholder

MOST_MINUTES = 30.0
"""Recordings beyond this are left out, evenly: what half an hour does not show is no mistake of units."""


def gather(
    data: tuple[Place, ...], robot: Place | None, report: Reporter = SILENT
) -> tuple[list[Recording], set[str], Path | None]:
    """Recordings, at most MOST_MINUTES of them; names of those that a dataset calls free; and the robot file.

    Raises:
        ConfigError: nothing to check.
    """
    files: list[Place] = []
    free: set[str] = set()
    for path in data:
        if not path.is_dir():
            files.append(path)
            continue
        if (path / "split.json").is_file():
            split = load_dataset(path).split
            names = [*split.train, *split.validation, *split.test]
            free |= {PurePath(name).stem for name in names}
            files += [path / name for name in names]
        else:
            files += sorted(path.glob("*.parquet"))
        robot = robot or next((path / name for name in ROBOT_FILES if (path / name).is_file()), None)
    robot_file = None if robot is None else local_robot(robot)
    if robot_file is not None and is_placeholder(robot_file):
        robot_file = None
    if not files:
        raise ConfigError(f"{', '.join(map(str, data)) or 'data'}: no recording (*.parquet) is there to check")
    return _evenly(files, report), free, robot_file


def _evenly(files: list[Place], report: Reporter) -> list[Recording]:
    """Loaded, every second or third only where there are too many."""
    heads = [describe(file) for file in files]
    minutes = sum(head.samples / head.rate_hz for head in heads) / 60
    stride = max(1, -int(-minutes // MOST_MINUTES))
    chosen, recordings = files[::stride], []
    with report.progress("read") as show:
        for file in chosen:
            recordings.append(load_recording(file))
            show(len(recordings), len(chosen), "recordings")
    return recordings
