"""`tauext check`: the signal doctor, before anyone trains."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tauext.errors import ConfigError

if TYPE_CHECKING:
    from tauext.data import Recording

MOST_MINUTES = 30.0
"""Recordings beyond this are left out, evenly: what half an hour does not show is no mistake of units."""


def check(
    data: tuple[Path, ...],
    robot: Path | None = None,
    out: Path | None = None,
    gravity: tuple[float, float, float] | None = None,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Look for mistakes of units, signs, order and timing in recordings, and in the robot file.

    Prints each finding with its evidence and what to do. Exit status: 0 no fault (there may be warnings), 1 a fault,
    2 bad input.

    Args:
        data: a dataset folder, a folder of recordings, or recordings (*.parquet), of free motion.
        robot: URDF or MJCF; default: the dataset's own. Without any, what needs a model is not looked for.
        out: folder to write: check.txt, check.json, and measured against predicted torque as pictures.
        gravity: acceleration of free fall in the base frame, m/s^2; default: the robot file's.
        as_json: print JSON for scripts.
    """
    import json

    from tauext.doctor import examine
    from tauext.doctor.summary import as_data, as_text

    recordings, free, robot = gather(data, robot)
    diagnosis = examine(recordings, robot, gravity, free)
    text, content = as_text(diagnosis), as_data(diagnosis)
    if robot is None:
        text = f"no robot model: order, scale, gravity and payload cannot be checked\n{text}"
    content["recordings"] = [recording.name for recording in recordings]
    if out is not None:
        from tauext.doctor.picture import draw

        out.mkdir(parents=True, exist_ok=True)
        (out / "check.txt").write_text(text + "\n")
        (out / "check.json").write_text(json.dumps(content, indent=1) + "\n")
        draw(diagnosis, out)
    print(json.dumps(content, indent=1) if as_json else text)
    return 1 if diagnosis.faulty else 0


def gather(data: tuple[Path, ...], robot: Path | None) -> tuple[list[Recording], set[str], Path | None]:
    """Recordings, at most MOST_MINUTES of them; names of those that a dataset calls free; and the robot file.

    Raises:
        ConfigError: nothing to check.
    """
    from tauext.data.dataset import ROBOT_FILES, Dataset
    from tauext.robot import is_placeholder

    files: list[Path] = []
    free: set[str] = set()
    for path in data:
        if not path.is_dir():
            files.append(path)
            continue
        if (path / "split.json").is_file():
            split = Dataset.open(path).split
            names = [*split.train, *split.validation, *split.test]
            free |= {Path(name).stem for name in names}
            files += [path / name for name in names]
        else:
            files += sorted(path.glob("*.parquet"))
        robot = robot or next((path / name for name in ROBOT_FILES if (path / name).is_file()), None)
    if robot is not None and is_placeholder(robot):
        robot = None
    if not files:
        raise ConfigError(f"{', '.join(map(str, data)) or 'data'}: no recording (*.parquet) is there to check")
    return _evenly(files), free, robot


def _evenly(files: list[Path]) -> list[Recording]:
    """Loaded, every second or third only where there are too many."""
    from tauext.data import describe, load

    heads = [describe(file) for file in files]
    minutes = sum(head.samples / head.rate_hz for head in heads) / 60
    stride = max(1, -int(-minutes // MOST_MINUTES))
    return [load(file) for file in files[::stride]]
