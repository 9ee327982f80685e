"""Folders of `tauext commission` filled from recordings, without a loop."""

from __future__ import annotations

import json
import sqlite3
from contextlib import closing
from functools import partial
from pathlib import Path
from unittest import mock

from tauext_commission import journal
from tauext_commission.folder import CommissionFolder
from tauext_commission.history_file import read_question
from tauext_commission.motion_recorder import MotionRecorder
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
        sink = MotionRecorder(folder, arm, "sim", budget)
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

    def text(content: dict) -> str:
        return json.dumps(content)  # NaN, too

    journal.read(path)  # with its rules
    with mock.patch.object(journal, "why_unusable", lambda line: ""), mock.patch.object(journal, "_text", text):
        journal.append(path, kind, content)
    journal.close_all()


def words(folder: CommissionFolder) -> list[str]:
    return [one["words"] for one in folder.history()]


def active(folder: CommissionFolder) -> str:
    return [one["bundle"] for one in folder.history() if one["kind"] == "activation"][-1]


def question(folder: CommissionFolder) -> dict:
    return read_question(folder.path)


def cut_journal(folder: CommissionFolder, kept=lambda line: True) -> None:
    """Leave only the lines of journal and backup for which this is true, as if another process had."""
    lines = journal.read(folder.path).lines
    journal.close_all()
    for name in (journal.NAME, journal.BACKUP):
        if (folder.path / name).exists():
            with closing(sqlite3.connect(folder.path / name)) as database, database:
                gone = [(line["number"],) for line in lines if not kept(line)]
                database.executemany("DELETE FROM line WHERE number = ?", gone)
