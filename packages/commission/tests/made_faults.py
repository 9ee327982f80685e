"""Faults of the files of a commissioned folder, and what `tauext commission` makes of them, in one process."""

from __future__ import annotations

import json
import os
import shutil
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from unittest import mock

import numpy as np
from made_bundles import JOINTS, pushed, watching_bundle
from tauext_commission import journal
from tauext_commission.folder import CommissionFolder
from tauext_commission.history_file import lost_words
from tauext_commission.motion_recorder import MotionRecorder
from tauext_commission.promises import CalibrationPeaks
from tauext_commission.run import Commission, Options, run
from tauext_commission.trainer import Trainer

from tauext.data.labels import Label
from tauext.data.recording_file import save_recording
from tauext.errors import TauextError
from tauext.monitor.control_lines import obey
from tauext.monitor.source import SourceSettings

PATIENCE_S = 20.0
BACKUP = "backup"
"""Folder beside the prepared one: an older copy of its files."""
ANSWERS = 8
LINK = """<link name="{0}"><inertial><origin xyz="0 0 0.2"/><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><geometry><cylinder radius="0.05" length="0.3"/></geometry></collision></link>"""
JOINT = """<joint name="{0}" type="revolute"><parent link="{1}"/><child link="{2}"/><axis xyz="0 1 0"/>
<limit lower="-3" upper="3" effort="9" velocity="9"/></joint>"""
ROBOT = "".join([
    '<robot name="arm"><link name="base"/>', LINK.format("upper"), LINK.format("fore"),
    JOINT.format(JOINTS[0], "base", "upper"), JOINT.format(JOINTS[1], "upper", "fore"), "</robot>",
])  # fmt: skip


def prepare(work: Path) -> Path:
    """A folder with every kind of file, and an older copy of them beside it."""
    path = work / "cell"
    save_recording(pushed(seconds=0.5, pushes=()), work / "log.parquet")
    (work / "robot.urdf").write_text(ROBOT)
    end(begin(path, Options(robot=work / "robot.urdf")))
    folder = CommissionFolder.open(path)
    folder.save(arm=folder.facts["arm"])
    for k in (1, 2):
        bundle = watching_bundle(network=False)
        bundle.name = f"b000{k}"
        bundle.save(str(folder.bundles / f"b000{k}.tauext"))
        (folder.results / f"b000{k}").mkdir()
        (folder.results / f"b000{k}" / "results.json").write_text("{}")
        folder.activate(f"b000{k}", "it passes", 10.0 * k)
        if k == 1:
            add_answers(folder, range(1, ANSWERS // 2 + 1))
            record(folder)
            CalibrationPeaks.load(folder, "b0001").put()
            folder.progress("")
            folder.pending_file.write_text(json.dumps({"bundle": "b0009", "minutes": 1}))
            (folder.path / "carried.bin").write_bytes(b"")
            end(begin(path))
            journal.close_all()
            shutil.copytree(path, work / BACKUP)
    add_answers(folder, range(ANSWERS // 2 + 1, ANSWERS + 1))
    record(folder)
    CalibrationPeaks.load(folder, "b0001").put()
    end(begin(path))
    journal.close_all()
    return path


def add_answers(folder: CommissionFolder, numbers: range) -> None:
    for k in numbers:
        folder.append_event({"id": k, "epoch": 1, "t_ns": k, "held_ns": k, "level": "collision", "wall": ""})
        folder.append_label(Label(k, 1, k, k, "touched" if k % 2 else "nothing", "page", "", "b0001"))


def record(folder: CommissionFolder) -> None:
    """Two recordings of 10 s."""
    arm = SourceSettings(JOINTS, 1_000_000, ("N m",) * 2, "held")
    sink = MotionRecorder(folder, arm, "script", 1e9)
    sink.open(JOINTS, None)
    motion = pushed(seconds=20.0, pushes=())
    for rows in (slice(0, 10_000), slice(10_000, 20_000)):
        signals = {name: getattr(motion, name)[rows] for name in ("t_ns", "q", "dq", "tau")}
        sink.worker.put(partial(sink._write, signals), must=True)
    sink.close()
    assert not sink.count.error, sink.count.error


# --- One run of the command, without its children.


@dataclass
class Running:
    folder: Path
    lines: list[str] = field(default_factory=list)
    control: list = field(default_factory=list)
    errors: list[BaseException] = field(default_factory=list)
    bundle: str | None = None
    """What monitors."""
    thread: threading.Thread | None = None
    made: Commission | None = None


def begin(path: Path, options: Options | None = None) -> Running:
    """Start the command and wait until its source has ended, or the command has."""
    one = Running(path)

    def work() -> None:
        try:
            source = f"replay:{path.parent / 'log.parquet'}"
            run(path, source, options or Options(), one.lines.append, one.control.append)
        except BaseException as error:
            one.errors.append(error)

    one.thread = threading.Thread(target=work, daemon=True)
    one.thread.start()
    wait(lambda: not one.thread.is_alive() or any("the source has ended" in line for line in one.lines), "its end")
    if one.control:
        one.bundle = one.control[0].loop and one.control[0].loop.bundle
    return one


def wait(true: Callable[[], object], what: str) -> None:
    limit_s = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < limit_s, what
        time.sleep(0.005)


def end(one: Running) -> Running:
    if one.control and one.thread.is_alive():
        obey("stop", one.control[0], "test")
    one.thread.join(PATIENCE_S)
    assert not one.thread.is_alive()
    return one


@contextmanager
def alone() -> Iterator[None]:
    """No child processes, and a fast look at the folder."""
    with (
        mock.patch("tauext_commission.run.Child.tend", lambda self: ""),
        mock.patch("tauext_commission.run.TEND_S", 0.02),
    ):
        yield


# --- Faults.


def cut(path: Path, backup: Path) -> None:
    os.truncate(path, path.stat().st_size // 2)


def garbage(path: Path, backup: Path) -> None:
    path.write_bytes(np.random.default_rng(0).bytes(max(50, min(path.stat().st_size, 5000))))


def folder(path: Path, backup: Path) -> None:
    path.unlink()
    path.mkdir()


def link(path: Path, backup: Path) -> None:
    path.unlink()
    path.symlink_to("nothing")


def older(path: Path, backup: Path) -> None:
    if backup.exists():
        shutil.copyfile(backup, path)


FAULTS: dict[str, Callable[[Path, Path], None]] = {
    "deleted": lambda path, backup: path.unlink(),
    "empty": lambda path, backup: os.truncate(path, 0),
    "cut": cut,
    "garbage": garbage,
    "directory": folder,
    "no permission": lambda path, backup: path.chmod(0),
    "symlink": link,
    "older copy": older,
}


def faults(work: Path) -> dict[str, Callable[[Path, Path], None]]:
    """All faults; without removed permissions where they refuse nothing, as for root."""
    (trial := work / "trial").touch(mode=0)
    refuses = not os.access(trial, os.R_OK)
    trial.unlink()
    return {name: fault for name, fault in FAULTS.items() if refuses or name != "no permission"}


def files_of(path: Path) -> list[str]:
    """Files of a folder, of each kind of numbered ones the first and the last."""
    names = sorted(str(one.relative_to(path)) for one in path.rglob("*") if one.is_file() and not one.is_symlink())
    segments = [name for name in names if name.startswith("seg-")]
    return [name for name in names if name not in segments[1:-1] and not name.endswith(".sock")]


@dataclass
class Outcome:
    refused: str = ""
    """The sentence with which the command ended."""
    traceback: str = ""
    lost_silently: int = 0
    """Confirmed answers that are gone without a line."""
    is_monitored: bool = False
    lines: tuple[str, ...] = ()
    """What was printed, but for the lines of every run."""

    @property
    def words(self) -> str:
        """In a word or two, worst first."""
        if self.traceback or self.lost_silently:
            return "traceback" if self.traceback else f"{self.lost_silently} answers lost"
        if not self.is_monitored:
            return "refused" if self.refused else "not monitored"
        if any("confirmed line" in line for line in self.lines):
            return "loss reported"
        if any(" is chosen: " in line for line in self.lines):
            return "older bundle"
        return "reported" if any("monitors the arm" not in line for line in self.lines) else "quiet"


def outcome(prepared: Path, work: Path, names: tuple[str, ...], fault: str, when: str) -> Outcome:
    """Damage files of a copy before the start, or while the command runs; start it, and start it again."""
    path, found = work / "cell", Outcome()
    shutil.copytree(prepared, path, symlinks=True)
    shutil.copyfile(prepared.parent / "log.parquet", work / "log.parquet")
    (path / "trainer.json").touch()

    def damage() -> None:
        for name in names:
            if os.path.lexists(path / name):
                FAULTS[fault](path / name, prepared.parent / BACKUP / name)

    printed: list[str] = []
    confirmed = {k: "touched" if k % 2 else "nothing" for k in range(1, ANSWERS + 1)}
    journal.close_all()
    with alone():
        if when == "start":
            damage()
            runs = 1
        else:
            runs = 2
        for k in range(runs):
            one = begin(path)
            monitored = bool(one.made or (one.control and one.control[0].loop is not None))
            if when == "running" and k == 0 and one.thread.is_alive():
                damage()
                number = ANSWERS + 1
                there = CommissionFolder(path)
                with watched(found):
                    there.append_label(Label(number, 1, number, number, "touched", "page", "", "b0002"))
                    confirmed[number] = "touched"
            if one.thread.is_alive():
                with watched(found):
                    Trainer(CommissionFolder.open(path)).step()
                time.sleep(0.1)
            lines = list(one.lines)
            monitored = any("monitors the arm" in line for line in lines) or monitored
            end(one)
            printed += one.lines
            for error in one.errors:
                if isinstance(error, TauextError):
                    found.refused = str(error)
                else:
                    found.traceback = "".join(traceback.format_exception(error))
            failed = [line for line in one.lines if "a task beside the monitor failed" in line]
            found.traceback = found.traceback or "".join(line for line in failed if "Error" in line)
            journal.close_all()
    found.is_monitored = monitored and not found.refused
    found.lines = tuple(line for line in dict.fromkeys(printed) if is_news(line))
    labels: dict[int, str] = {}
    with suppress(TauextError, OSError):
        labels = {one.id: one.answer for one in CommissionFolder(path).labels()}
    missing = sum(labels.get(number) != answer for number, answer in confirmed.items())
    is_told = bool(found.refused) or any(lost_words(2)[-13:] in line or "are lost" in line for line in printed)
    found.lost_silently = 0 if is_told else missing
    return found


@contextmanager
def watched(found: Outcome) -> Iterator[None]:
    try:
        yield
    except TauextError:
        pass
    except BaseException as error:
        found.traceback = "".join(traceback.format_exception(error))


def is_news(line: str) -> bool:
    usual = ("connecting", "NOTHING IS MONITORED: the source", "has ended; training", "keys:", "--robot is not used")
    return not any(one in line for one in usual)
