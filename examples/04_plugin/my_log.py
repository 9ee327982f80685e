"""A plug-in: logs of your own arm for `tauext import`, and a check of what its controller may get wrong.

    tauext import --source run.mylog --arm arm.toml --out data     # converts, and checks
    tauext check --data data

pyproject.toml names IMPORTER and CHECK as entry points; tauext needs nothing else.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from tauext.check.finding import Check, Finding, Found
from tauext.data.importers.raw import Importer, RawRecording, RawSignals
from tauext.data.recording import Recording
from tauext.errors import RecordingError

MAGIC = b"MYLOG1\n"
ROW = np.dtype([("t_us", "<i8"), ("q", "<f4", 2), ("dq", "<f4", 2), ("tau", "<f4", 2)])
"""YOUR ARM: what its controller writes every period."""


def open_log(path: Path, topics: Sequence[str]) -> list[RawRecording]:
    """One recording a file; arm.toml states units and signs of its columns, q[0] to tau[1]."""
    if (path.stat().st_size - len(MAGIC)) % ROW.itemsize:
        raise RecordingError(f"{path}: its last row is cut off; copy it again")

    def blocks() -> Iterator[RawSignals]:
        rows = np.fromfile(path, ROW, offset=len(MAGIC))
        names = tuple(f"{signal}[{k}]" for signal in ("q", "dq", "tau") for k in range(2))
        values = np.hstack([rows[signal] for signal in ("q", "dq", "tau")]).astype(np.float64)
        yield RawSignals("", names, rows["t_us"] * 1000, values)

    return [RawRecording(path.stem, path, "log of my arm", blocks)]


IMPORTER = Importer("log of my arm", lambda path, begin: begin.startswith(MAGIC), open_log)


def find_clipped(recordings: Sequence[Recording]) -> Found:
    """This controller clips the velocities that it reports at 1 rad/s."""
    most = np.max([np.abs(one.dq).max(axis=0) for one in recordings], axis=0)
    advice = 'derive the velocity from the position: columns = "" in [signals.dq] of arm.toml'
    return Found(
        [
            Finding("my-arm-clipped", "warning", joint, f"its largest velocity is {speed:g} rad/s", advice)
            for joint, speed in zip(recordings[0].joints, most, strict=True)
            if speed == 1.0
        ]
    )


CHECK = Check({"my-arm-clipped": "the velocity is clipped"}, find_clipped)
