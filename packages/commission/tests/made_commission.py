"""Folders of `tauext commission` filled from recordings, without a loop."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from unittest import mock
from zlib import crc32

from tauext_commission import journal
from tauext_commission.folder import CommissionFolder
from tauext_commission.history_file import read_question
from tauext_commission.motion_recorder import KeepSink
from tauext_lab.sim.arms import rig_arm

from tauext.data.recording import Recording
from tauext.monitor.source import SourceSettings


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
            sink.worker.put(partial(sink._write, signals), must=True)
        sink.close()
        assert not sink.count.error, sink.count.error
    return folder


def add_event(folder: CommissionFolder, **content) -> None:
    folder.append_event(content)


def forge(path: Path, kind: str, content: dict) -> None:
    """Append a line that the journal itself refuses, as another program could."""

    def line(content: dict) -> bytes:
        body = json.dumps(content).encode()  # NaN, too
        return journal.CHECK % crc32(body) + body[1:] + b"\n"

    journal.read(path)  # with its rules
    with (
        mock.patch("tauext_commission.journal.why_unusable", lambda line: ""),
        mock.patch("tauext_commission.journal._line", line),
    ):
        journal.append(path, kind, content)
    journal._seen.clear()


def words(folder: CommissionFolder) -> list[str]:
    return [one["words"] for one in folder.history()]


def active(folder: CommissionFolder) -> str:
    return [one["bundle"] for one in folder.history() if one["kind"] == "activation"][-1]


def question(folder: CommissionFolder) -> dict:
    return read_question(folder.path)


def cut_journal(folder: CommissionFolder, kept=lambda line: True) -> None:
    """Leave only the lines of both files for which this is true, as if another process had."""
    for name in (journal.NAME, journal.COPY):
        lines = (folder.path / name).read_bytes().splitlines(keepends=True)
        (folder.path / name).write_bytes(b"".join(line for line in lines if kept(json.loads(line))))
    journal._seen.clear()
