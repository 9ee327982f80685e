"""Folders of `tauext commission` filled from recordings, without a loop."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tauext.commission.folder import CommissionFolder
from tauext.commission.keep import KeepSink
from tauext.data.recording import Recording
from tauext.files.append_file import append_line
from tauext.monitor.source import SourceSettings
from tauext.sim.arms import rig_arm


def filled(path: Path, recordings: list[Recording], budget: float = 1e9) -> CommissionFolder:
    """The folder with these recordings added, each an epoch, in segments of 10 s."""
    first = recordings[0]
    arm = SourceSettings(first.joints, round(1e9 / first.rate_hz), ("N m",) * len(first.joints), first.torque_timing)
    folder = CommissionFolder.open(path, create=True)
    if not (path / "robot.xml").exists():
        (path / "robot.xml").write_text(rig_arm().xml)
    for recording in recordings:
        sink = KeepSink(folder, arm, "sim", budget)
        sink.open(first.joints, None)
        for begin in range(0, recording.samples, sink._rows):
            part = slice(begin, begin + sink._rows)
            signals = {name: getattr(recording, name)[part] for name in ("t_ns", "q", "dq", "tau")}
            sink._waiting.put(signals | {"contact": np.zeros(len(signals["t_ns"]), dtype=np.int8)})
        sink.close()
        assert not sink.count.error, sink.count.error
    return folder


def add_event(folder: CommissionFolder, **content) -> None:
    append_line(folder.events_file, content)


def words(folder: CommissionFolder) -> list[str]:
    return [one["words"] for one in folder.history()]


def active(folder: CommissionFolder) -> str:
    return json.loads((folder.path / "active.json").read_text())["bundle"]
