"""LeRobot dataset folders of versions 3.0 and 2.1: one raw recording an episode."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from tauext.data.importers.raw import RawRecording, RawSignals
from tauext.data.lerobot_folder import (
    INFO,
    LerobotFolder,
    columns_of,
    episode_rows,
    frame_stamps,
    open_folder,
    readable,
)

__all__ = ["INFO", "open_lerobot", "raw_episode"]


def open_lerobot(path: Path) -> list[RawRecording]:
    """Every episode of a LeRobot dataset as a raw recording; element `name` of a feature is `feature[name]`.

    Times are those of the feature `t_ns` where there is one (tauext writes it), else frame_index / fps. `goal[name]` is
    the goal that was followed: see columns_of().

    Raises:
        RecordingError: another version, a file missing or damaged.
    """
    folder = open_folder(path)
    return [raw_episode(folder, number) for number in folder.lengths]


def raw_episode(folder: LerobotFolder, number: int) -> RawRecording:
    """One episode; its frames are read when its blocks are asked for."""

    def blocks() -> Iterator[RawSignals]:
        rows = episode_rows(folder, number)
        with readable(folder.path, f"episode {number}"):
            columns = columns_of(folder, rows)
            if "t_ns" in rows.column_names:
                t_ns = rows.column("t_ns").to_numpy().astype(np.int64)
            else:
                t_ns = frame_stamps(columns["frame_index"], folder.fps)
            signals = RawSignals("", tuple(columns), t_ns, np.column_stack(list(columns.values())))
        yield signals

    name = f"{folder.path.name}-episode-{number:03d}"
    return RawRecording(name, folder.path, f"LeRobot {folder.version.split('.')[0]} dataset", blocks)
