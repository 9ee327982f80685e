"""What `tauext commission` does when something fails: kills, a full disk, a source that is silent, a clock that jumps.

    CHROMIUM=/usr/bin/chromium python benchmarks/commission_failures.py docs/results/commission [--arm rig] [--keep]

Runs the command in real time on a simulated arm and checks that nothing is lost that was confirmed. Writes
OUT/failures.md with eight pictures of the page, and exits with 1 if a check fails. Needs Linux, Chromium and the
websockets (extra `dev`); the full disk also needs the right to mount a file system. Takes ten minutes.

    python benchmarks/commission_failures.py docs/results/commission --damage

Damages every file of a folder in every way instead, and kills the command 200 times at random moments. Writes
OUT/damage.md. Needs Linux. Takes 40 minutes.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from commission_pictures import ask, photograph
from common import head, table_row

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))
import commission_pictures
import made_faults
from made_browser import Browser

from tauext.bundle.bundle_file import load_bundle
from tauext.bundle.estimates import ALARMS, HEALTHS, NONE
from tauext.bundle.history_file import active_bundle, lost_lines, read_events, read_history, read_question, watches
from tauext.commission.answers import ASKING_S
from tauext.commission.folder import CommissionFolder
from tauext.commission.keep import KeepSink
from tauext.data.labels import read_labels
from tauext.data.recording_file import load_recording
from tauext.errors import TauextError
from tauext.files import journal
from tauext.files.synced_file import RESERVE, RESERVED
from tauext.monitor.loop import Loop, LoopSettings
from tauext.sim.source import SimSource
from tauext.sources.describing import LEARNT_STEPS

PORT = 8797
SIZES = {"phone": (390, 844), "desktop": (1280, 820)}
PUSH = "sim push joint=joint2 force=0,0,-60 seconds=0.4"
PATIENCE_S = 240.0
AGAIN_S = 30.0
"""Longest time from the command to health ok, [s]."""
SETTLE_S = 6.0
"""From the opening of a page to its picture, [s]."""
CARRIED_S = 3.0
"""After an alarm, its copy for the next process is on the disk, [s]."""
SPARE_BYTES = 24 << 20
"""Free space of the small disk before it is filled."""
SILENT_S, JUMP_S = 60.0, 3600.0
HOUR_S = 3600.0


# --- Checks, and what is printed meanwhile.


@dataclass
class Part:
    """One kind of failure."""

    title: str
    text: str
    pictures: tuple[str, ...] = ()
    lines: list[str] = field(default_factory=list)
    checks: list[tuple[str, str, bool]] = field(default_factory=list)
    """What was checked, what was measured, and whether it passed."""
    table: list[str] = field(default_factory=list)
    skipped: str = ""


class Report:
    """Transcript and checks of all parts."""

    def __init__(self) -> None:
        self.began, self.parts = time.monotonic(), list[Part]()

    def part(self, title: str, text: str, *pictures: str) -> Part:
        self.parts.append(Part(title, text, pictures))
        print(f"\n{title}", flush=True)
        return self.parts[-1]

    def line(self, text: str) -> None:
        self.parts[-1].lines.append(f"{time.monotonic() - self.began:5.0f} s  {text}")
        print(self.parts[-1].lines[-1], flush=True)

    def check(self, what: str, measured: object, passed: bool) -> None:
        self.parts[-1].checks.append((what, str(measured), passed))
        print(f"{'PASS' if passed else 'FAIL'}  {what}: {measured}", flush=True)

    @property
    def failed(self) -> int:
        return sum(not passed for part in self.parts for *_, passed in part.checks)


def wait_for(true: Callable[[], Any], what: str, patience_s: float = PATIENCE_S) -> tuple[Any, float]:
    """What the function returns once that is true, and the seconds until then."""
    began = time.monotonic()
    while True:
        with suppress(OSError, ValueError, KeyError, TypeError):
            if value := true():
                return value, time.monotonic() - began
        if time.monotonic() > began + patience_s:
            raise TimeoutError(what)
        time.sleep(0.05)


# --- The command as a process of its own, with its page, its training and its simulated arm.


class Command:
    """One run of the command; its lines go to the report."""

    def __init__(self, report: Report, folder: Path, arm: str):
        words = ["commission", "--source", f"sim:{arm}", "--out", str(folder), "--port", str(PORT)]
        report.line(f"$ tauext commission --source sim:{arm} --out {folder.name}")
        self.folder, self.lines, self.began = folder, list[str](), time.monotonic()
        command = [sys.executable, "-m", "tauext", *words]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True)

        def read() -> None:
            for line in self.process.stdout or ():
                self.lines.append(line.rstrip().replace(str(folder), folder.name))
                report.line(self.lines[-1])

        self._reading = threading.Thread(target=read)
        self._reading.start()
        self._report = report

    def members(self) -> list[int]:
        """Processes of this run that have not ended."""
        found = []
        for path in Path("/proc").glob("[0-9]*/stat"):
            with suppress(OSError):
                state, _, _, session, *_ = path.read_text().rpartition(")")[2].split()
                if int(session) == self.process.pid and state != "Z":
                    found.append(int(path.parent.name))
        return found

    @property
    def training(self) -> int:
        """The training process: it alone takes idle time only."""
        return min((one for one in self.members() if os.sched_getscheduler(one) == os.SCHED_IDLE), default=0)

    @property
    def page(self) -> int:
        """The process that listens on the page's port."""
        port = int(self.url.rstrip("/").rpartition(":")[2])
        rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
        sockets = {f"socket:[{row[9]}]" for row in rows if row[1].endswith(f":{port:04X}") and row[3] == "0A"}
        for one in self.members():
            for file in Path(f"/proc/{one}/fd").glob("*"):
                with suppress(OSError):
                    if os.readlink(file) in sockets:
                        return one
        raise ValueError("nothing listens")

    @property
    def url(self) -> str:
        return next(line.split()[0] for line in self.lines if line.startswith("http://"))

    def is_served(self) -> bool:
        with urllib.request.urlopen(self.url.replace("localhost", "127.0.0.1"), timeout=5) as answer:
            return b"NOTHING IS MONITORED" in answer.read()

    def live(self) -> dict[str, Any]:
        """The newest line that the loop sends to its page."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as wire:
            wire.settimeout(5)
            wire.connect(str(self.folder / "live.sock"))
            with wire.makefile() as lines:
                return json.loads(lines.readline())

    def reach(self, true: Callable[[dict[str, Any]], Any], what: str, patience_s: float = PATIENCE_S) -> dict[str, Any]:
        """The first live line of which this is true."""
        return wait_for(lambda: (line := self.live()) and true(line) and line, what, patience_s)[0]

    def state(self, *states: str) -> dict[str, Any]:
        return self.reach(lambda line: line["state"] in states and line.get("t_ns"), f"the state {states[0]}")

    def is_monitored(self) -> tuple[dict[str, Any], float]:
        """The first live line with health ok, and the seconds from the command until then."""
        line = self.reach(lambda line: line["bundle"] and line.get("health") == "ok", "a monitored arm")
        return line, time.monotonic() - self.began

    def alarm(self) -> int:
        """Push the arm; the number of the alarm that this raises, once the push is over."""
        self.tell(PUSH)
        number = int(self.reach(lambda line: line["alarm"], "an alarm", 10.0)["alarm"]["id"])
        time.sleep(1.0)
        return number

    def tell(self, line: str) -> str:
        """Send a control line."""
        answer = ask(self.folder, line)
        self._report.line(f"control line `{line}`: {answer}")
        return answer

    def kill(self) -> tuple[float, int]:
        """kill -9 of the main process; seconds until its other processes have ended, too, and how many have not."""
        os.kill(self.process.pid, signal.SIGKILL)
        began = time.monotonic()
        self.process.wait()
        with suppress(TimeoutError):
            wait_for(lambda: not self.members(), "the end of the other processes", 10.0)
        took_s, left = time.monotonic() - began, len(self.members())
        self._report.line("(kill -9 of the main process)")
        return took_s, left

    def stop(self) -> None:
        self.process.send_signal(signal.SIGINT)
        self.process.wait(60)

    def close(self) -> None:
        for one in self.members():
            with suppress(ProcessLookupError):
                os.kill(one, signal.SIGKILL)
        self.process.wait()
        self._reading.join()


@contextmanager
def running(report: Report, folder: Path, arm: str) -> Iterator[Command]:
    command = Command(report, folder, arm)
    try:
        yield command
    finally:
        command.close()


# --- What must outlast every failure.


class Confirmed:
    """Answers that were confirmed with `ok`, and recordings that were complete."""

    def __init__(self, report: Report, folder: Path):
        self.report, self.folder = report, folder
        self.answers: dict[int, str] = {}
        self.recordings: dict[str, int] = {}

    def answer(self, command: Command, line: str) -> bool:
        """Give an answer and remember it; whether the labels hold it when `ok` comes."""
        before = {one.id: one.wall for one in read_labels(self.folder) if one.answer == line.split()[0]}
        if command.tell(line) != "ok":
            return False
        after = [one for one in read_labels(self.folder) if one.answer == line.split()[0]]
        found = [one for one in after if one.id not in before]
        self.answers |= {one.id: one.answer for one in found}
        return bool(found)

    def see(self) -> None:
        """Remember the recordings that are complete now."""
        self.recordings = {path.name: path.stat().st_size for path in self.folder.glob("seg-*.parquet")}

    def check(self, when: str) -> None:
        labels = {one.id: one.answer for one in read_labels(self.folder)}
        there = sum(labels.get(number) == answer for number, answer in self.answers.items())
        if self.answers:
            measured = f"{there} of {len(self.answers)}"
            self.report.check(f"{when}: confirmed answers in the journal", measured, there == len(self.answers))
        readable = 0
        for name, size in self.recordings.items():
            with suppress(OSError, TauextError):
                path = self.folder / name
                readable += path.stat().st_size == size and load_recording(path).samples > 0
        if self.recordings:
            measured = f"{readable} of {len(self.recordings)}"
            self.report.check(f"{when}: recordings readable", measured, readable == len(self.recordings))

    def clear(self, command: Command) -> dict[str, Any]:
        """Answer false alarms with `nothing` until none is asked about; the limits of the first minutes allow some."""
        while True:
            line = command.state("monitoring", "asking")
            if line["state"] == "monitoring":
                return line
            asked = [event["id"] for event in read_events(self.folder) if not event.get("answer")]
            for number in asked:
                self.answer(command, f"nothing {number}")
            if not asked and read_question(self.folder):
                command.tell("learn no")
            time.sleep(1.2)


def gaps_s(folder: Path, epoch: int) -> float:
    """Time between the recordings of an epoch that no recording holds, [s]."""
    segments = [one for one in CommissionFolder(folder).segments() if one.epoch == epoch]
    period_ns = CommissionFolder(folder).facts["arm"]["period_ns"]
    return 1e-9 * sum(b.from_ns - a.to_ns - period_ns for a, b in pairwise(segments))


def is_of(folder: Path, bundle: str, before: str) -> bool:
    """Whether a bundle is the one before, or has taken over since."""
    taken = [one["bundle"] for one in read_history(folder) if one["kind"] == "exchange"]
    return bundle == before or bundle == taken[-1]


def epoch_of(folder: Path) -> int:
    return int(json.loads((folder / "commission.json").read_text())["epoch"])


def recordings(folder: Path) -> int:
    return len(list(folder.glob("seg-*.parquet")))


# --- Kills.

KILLS = """\
`kill -9` of the main process in each state, of the training process during a training, and of the page's process. The
same command is then started again. Seconds count from that command."""


def kills(report: Report, folder: Path, arm: str, out: Path, browser: Browser) -> None:
    report.part("Kills", KILLS, "learning", "asking")
    kept = Confirmed(report, folder)

    def kill(command: Command, state: str) -> tuple[str, int]:
        """kill -9; the bundle that monitored, and the newest alarm."""
        kept.see()
        bundle = command.live()["bundle"] if state != "connecting" else ""
        took_s, left = command.kill()
        report.check(f"{state}: processes that outlive the main process", f"{left} after {took_s:.1f} s", not left)
        return bundle, max((int(one["id"]) for one in read_events(folder)), default=0)

    def check_again(command: Command, state: str, bundle: str, newest: int) -> dict[str, Any]:
        """Compare the first seconds after the restart with the time before the kill."""
        line, seconds = command.is_monitored()
        report.check(f"{state}: bundle in charge", line["bundle"], line["bundle"] == bundle)
        report.check(f"{state}: health ok", f"{seconds:.1f} s", seconds <= AGAIN_S)
        line = command.reach(lambda line: line["state"] != "connecting", "the state after the restart", 10.0)
        later = [int(one["id"]) for one in read_events(folder) if int(one["id"]) > newest]
        is_same = line["state"] == ("asking" if state == "asking" or later else "monitoring")
        report.check(f"{state}: state after the restart", line["state"] + " about another alarm" * bool(later), is_same)
        kept.check(state)
        return line

    with running(report, folder, arm) as command:
        wait_for(lambda: any("connecting" in line for line in command.lines), "connecting")
        kill(command, "connecting")
    with running(report, folder, arm) as command:
        first = command.reach(lambda line: line["state"], "a line of the loop")["state"]
        report.check("connecting: state after the restart", first, first == "connecting")
        command.state("learning")
        report.check("connecting: first sample", *within(command.began, AGAIN_S))
        wait_for(lambda: recordings(folder) >= 3, "three recordings")
        report.check("learning: `touched` is stored when it is confirmed", *yes(kept.answer(command, "touched")))
        kill(command, "learning")
    with running(report, folder, arm) as command:
        state = command.state("learning", "monitoring", "asking")["state"]
        report.check("learning: first sample", *within(command.began, AGAIN_S))
        report.check("learning: state after the restart", state, state == "learning")
        kept.check("learning")
        wait_for(command.is_served, "the page")
        photograph(browser, command.url, out, "failures-learning", SETTLE_S)
        kill_training(report, command)
        command.is_monitored()
        kept.clear(command)
        before = kill(command, "monitoring")
    with running(report, folder, arm) as command:
        check_again(command, "monitoring", *before)
        kill_page(report, command)
        kept.clear(command)
        alarm = command.alarm()
        time.sleep(CARRIED_S)
        before = kill(command, "asking")
    with running(report, folder, arm) as command:
        line = check_again(command, "asking", *before)
        number, answer = (line["alarm"] or {}).get("id"), (line["alarm"] or {}).get("answer")
        measured = f"alarm {number}, answer {answer or 'none'}"
        report.check(f"asking: alarm {alarm} stands and is asked about", measured, (number, answer) == (alarm, None))
        photograph(browser, command.url, out, "failures-asking", SETTLE_S)
        report.check(
            "asking: the answer is stored when it is confirmed", *yes(kept.answer(command, f"touched {alarm}"))
        )
        before = kill(command, "answered")
    with running(report, folder, arm) as command:
        check_again(command, "answered", *before)
        with suppress(TimeoutError):
            command.reach(lambda line: (line["alarm"] or {}).get("id") != alarm, "the end of the alarm", 5.0)
        standing = (command.live()["alarm"] or {}).get("id")
        report.check(f"answered: alarm {alarm} stands no more", f"alarm {standing or 'none'}", standing != alarm)
        command.stop()


MANY_KILLS = """\
`kill -9` of the main process at random moments, %d times: while it connects, learns, monitors and asks, also while an
answer is being stored. The clock of the samples is set back by an hour now and then. The same command is started again
each time. An answer counts as confirmed when `ok` came."""
LEARNING_SHARE = 0.2
"""Share of the kills before the first bundle."""


def many_kills(report: Report, folder: Path, arm: str, number: int) -> None:
    part = report.part(f"{number} kills", MANY_KILLS % number)
    kept, rng, states = Confirmed(report, folder), np.random.default_rng(0), Counter[str]()
    jumps, refused = 0, 0
    for k in range(number):
        is_early = k < LEARNING_SHARE * number
        with running(report, folder, arm) as command:
            if k == int(LEARNING_SHARE * number):
                wait_for(lambda: active_bundle(folder), "the first bundle", 600.0)
            limit_s = time.monotonic() + rng.uniform(0.0, 8.0)
            with suppress(TimeoutError, OSError, ValueError):
                if rng.random() < 0.8:
                    wanted = ("learning", "monitoring", "asking") if is_early else ("monitoring", "asking")
                    command.state(*wanted)
                    limit_s = time.monotonic() + rng.uniform(0.0, 2.5)
                    if rng.random() < 0.3:
                        jumps += command.tell("sim clock seconds=-3600") == "ok"
                    if not is_early:
                        command.tell(PUSH)
                        time.sleep(rng.uniform(0.0, 1.5))
                    newest = max((int(one["id"]) for one in read_events(folder)), default=0)
                    line = f"{rng.choice(['touched', 'nothing'])} {newest}" if newest and k % 2 else "touched"
                    refused += not kept.answer(command, line)
                    if rng.random() < 0.3:  # this one is killed while it is stored
                        threading.Thread(target=tell_in_vain, args=(command,), daemon=True).start()
            time.sleep(max(0.0, limit_s - time.monotonic()))
            with suppress(OSError, ValueError):
                states[command.live()["state"]] += 1
            command.kill()
    part.lines[:] = part.lines[:20]
    labels = {one.id: one.answer for one in read_labels(folder)}
    there = sum(labels.get(one) == answer for one, answer in kept.answers.items())
    report.check("states at the kill", ", ".join(f"{name} {count}" for name, count in states.items()), True)
    report.check("clock set back", f"{jumps} times", jumps > 0)
    report.check("confirmed answers in the journal", f"{there} of {len(kept.answers)}", there == len(kept.answers) > 0)
    report.check("lines of the journal that are lost", lost_lines(folder), not lost_lines(folder))


DAMAGE = """\
Each file of a folder, of numbered ones the first and the last, is damaged before the start, or while the command runs,
which then is started again. Every run is the whole command but for its child processes: one step of the training is
done in its place. Columns are kinds of damage. `quiet`: nothing is printed, since the file is written again anyway or
nothing uses it. `reported`: a line is printed. `older bundle`: the newest whole bundle monitors, and the reason is
printed. `loss reported`: `journal: at least N confirmed lines are lost` in terminal and page, and nothing is trained. A
file that is newer than the older copies stays as it is."""


def damage(report: Report, work: Path) -> None:
    part = report.part("Damaged files", DAMAGE)
    with made_faults.alone():
        prepared = made_faults.prepare(work)
    kinds, counts = list(made_faults.faults(work)), Counter[str]()
    both = (journal.NAME, journal.COPY)
    names = [*((name,) for name in made_faults.files_of(prepared)), both]
    for when in ("start", "running"):
        part.table += ["", *head(" | ".join([when, *kinds]))]
        for files in names:
            cells = []
            for kind in kinds:
                shutil.rmtree(work / "case", ignore_errors=True)
                (work / "case").mkdir()
                found = made_faults.outcome(prepared, work / "case", files, kind, when)
                counts["combinations"] += 1
                counts["tracebacks"] += bool(found.traceback)
                counts["answers lost silently"] += found.lost_silently
                counts["arms that are not monitored"] += not found.is_monitored
                cells.append(found.words)
            part.table.append(table_row(" and ".join(f"`{name}`" for name in files), *cells))
            print(part.table[-1], flush=True)
    report.check("combinations", counts["combinations"], True)
    for name in ("tracebacks", "answers lost silently", "arms that are not monitored"):
        report.check(name, counts[name], not counts[name])


def tell_in_vain(command: Command) -> None:
    with suppress(OSError, ValueError):
        command.tell("touched")


def within(began: float, limit_s: float) -> tuple[str, bool]:
    seconds = time.monotonic() - began
    return f"{seconds:.1f} s", seconds <= limit_s


def yes(done: bool) -> tuple[str, bool]:
    return ("yes" if done else "no"), done


def kill_training(report: Report, command: Command) -> None:
    """kill -9 of the training process once a training runs."""
    folder = command.folder

    def is_training() -> bool:
        return str(json.loads((folder / "trainer.json").read_text())["doing"]).startswith("training")

    wait_for(is_training, "a training")
    time.sleep(3.0)
    first = command.training
    os.kill(first, signal.SIGKILL)
    report.line("(kill -9 of the training process)")
    _, seconds = wait_for(lambda: (now := command.training) != first and now, "the next training process", 30.0)
    report.check("training: the process runs again", f"{seconds:.1f} s", seconds <= AGAIN_S)
    _, seconds = wait_for(lambda: active_bundle(folder), "the first bundle", 400.0)
    trained = [one for one in read_history(folder) if one["kind"] == "training"]
    measured = f"{seconds:.0f} s, {len(trained)} training"
    report.check("training: the repeated training brings the bundle", measured, len(trained) == 1)
    lost_s = gaps_s(folder, epoch_of(folder))
    report.check("training: motion that no recording holds", f"{lost_s:.3f} s", abs(lost_s) < 1e-6)


def kill_page(report: Report, command: Command) -> None:
    """kill -9 of the process that serves the page."""
    wait_for(command.is_served, "the page")
    before, first = command.live()["t_ns"], command.page
    os.kill(first, signal.SIGKILL)
    report.line("(kill -9 of the page's process)")
    began = time.monotonic()
    wait_for(lambda: command.page != first and command.is_served(), "the page after the kill", 60.0)
    seconds, moved_s = time.monotonic() - began, (command.live()["t_ns"] - before) * 1e-9
    report.check("page: served again", f"{seconds:.1f} s", seconds <= AGAIN_S)
    report.check("page: samples that the loop took meanwhile", f"{moved_s:.1f} s", moved_s > 0.8 * seconds)


# --- A full disk.

DISK = """\
The folder lies on a small disk of its own, which another file fills to the last byte while the arm is monitored. After
half a minute the main process is killed, and the same command is started on the full disk. The file is then removed.
Lost flights of faults come from late samples: other work uses the same two cores."""


def full_disk(report: Report, trained: Path, work: Path, arm: str, out: Path, browser: Browser) -> None:
    part = report.part("A full disk", DISK, "disk")
    disk = work / "disk"
    disk.mkdir()
    size = sum(path.stat().st_size for path in trained.rglob("*") if path.is_file()) + SPARE_BYTES
    mount = ["mount", "-t", "tmpfs", "-o", f"size={size}", "tauext", str(disk)]
    try:
        made = subprocess.run(mount, capture_output=True, text=True)
        refused = made.stderr.strip() if made.returncode else ""
    except OSError as error:
        refused = str(error)
    if refused:
        part.skipped = "Skipped: this user may not mount a file system."
        print(f"{part.skipped} ({refused})", flush=True)
        return
    try:
        folder = disk / trained.name
        shutil.copytree(trained, folder, ignore=shutil.ignore_patterns("*.sock"))
        kept, dummy = Confirmed(report, folder), disk / "dummy"
        with running(report, folder, arm) as command:
            fill(report, command, kept, dummy, out, browser)
            command.kill()
        with running(report, folder, arm) as command:
            empty(report, command, kept, dummy)
            command.stop()
    finally:
        if subprocess.run(["umount", str(disk)]).returncode:
            subprocess.run(["umount", "-l", str(disk)], check=True)


def fill(report: Report, command: Command, kept: Confirmed, dummy: Path, out: Path, browser: Browser) -> None:
    """Fill the disk while the arm is monitored, and give five answers."""
    folder = command.folder
    command.is_monitored()
    before = recordings(folder)
    wait_for(lambda: recordings(folder) > before, "a recording")
    kept.clear(command)
    kept.see()
    with dummy.open("wb", buffering=0) as file:
        for size in (1 << 16, 1 << 12):
            with suppress(OSError):
                while True:
                    file.write(bytes(size))
    began = time.monotonic()
    report.line(f"(a file of {dummy.stat().st_size / 1e6:.0f} MB fills the disk: {free(dummy.parent)} bytes are free)")
    wait_for(lambda: losses(command), "the report of lost samples", 30.0)
    report.check("the loss is reported", *within(began, 15.0))
    line = command.reach(lambda line: line["says"], "the page's report of lost samples", 15.0)
    report.check("the page reports the loss", f"`{line['says']}`", "LOSES SAMPLES" in line["says"])
    photograph(browser, command.url, out, "failures-disk", SETTLE_S)
    done = int(kept.answer(command, f"touched {command.alarm()}"))
    for _ in range(4):
        time.sleep(5.0)
        done += kept.answer(command, "touched")
    report.check("answers confirmed and stored while the disk is full", f"{done} of 5", done == 5)
    stamp, at = command.live()["t_ns"], time.monotonic()
    time.sleep(2.0)
    line = command.live()
    share = (line["t_ns"] - stamp) * 1e-9 / (time.monotonic() - at)
    measured = f"health {line['health']}, {share:.0%} of the samples"
    report.check("monitoring goes on while the disk is full", measured, line["health"] == "ok" and share > 0.8)
    report.line(f"(so far: {losses(command)[-1]})")


def empty(report: Report, command: Command, kept: Confirmed, dummy: Path) -> None:
    """Give an answer after a restart on the full disk, and remove the file that fills it."""
    folder = command.folder
    _, seconds = command.is_monitored()
    report.check("monitored again after a kill on the full disk", f"{seconds:.1f} s", seconds <= AGAIN_S)
    report.check("another answer is confirmed and stored", *yes(kept.answer(command, "touched")))
    kept.check("after the kill")
    dummy.unlink()
    began, before = time.monotonic(), recordings(folder)
    report.line("(the file is removed)")
    wait_for(lambda: recordings(folder) >= before + 2, "recordings after the file is removed", 60.0)
    report.check("two recordings after the file is removed", *within(began, 30.0))
    command.reach(lambda line: not line["says"], "the end of the page's report", 15.0)
    reserved = (folder / RESERVE).stat().st_size
    report.check("space reserved for labels again", f"{reserved / 1e6:.2f} MB", reserved >= RESERVED)
    kept.check("afterwards")


def losses(command: Command) -> list[str]:
    return [line for line in command.lines if "LOSES SAMPLES" in line]


def free(disk: Path) -> int:
    return shutil.disk_usage(disk).free


# --- A source that disappears.

SILENCE = f"""\
The source sends nothing for {SILENT_S:.0f} s in real time, then for an hour in simulated time. The loop, recorder and
monitor of the command run that hour as fast as they can, with an alarm that stands when the silence begins."""


def silence(report: Report, folder: Path, arm: str, out: Path, browser: Browser) -> None:
    report.part("A source that disappears", SILENCE, "silent")
    kept = Confirmed(report, folder)
    with running(report, folder, arm) as command:
        bundle = command.is_monitored()[0]["bundle"]
        before, epoch = recordings(folder), epoch_of(folder)
        wait_for(lambda: recordings(folder) > before, "a recording")
        kept.clear(command)
        kept.see()
        command.tell(f"sim off seconds={SILENT_S:g}")
        began = time.monotonic()
        line = command.reach(lambda line: line["lost"], "a report", 15.0)
        taken, soon = within(began, 5.0)
        report.check("the page reports the silence", f"{taken}: `{line['lost']}`", soon)
        photograph(browser, command.url, out, "failures-silent", SETTLE_S)
        line = command.live()
        report.check("state meanwhile", line["state"], line["state"] == "monitoring")
        measured = f"{line['health']} ({', '.join(line['causes'])})"
        report.check("health meanwhile", measured, line["health"] != "ok")
        command.reach(lambda line: line["health"] == "ok" and not line["lost"], "health ok", SILENT_S + 60)
        seconds = time.monotonic() - began - SILENT_S
        report.line("(samples come again, health ok)")
        report.check("health ok after the silence", f"after {seconds:.1f} s", seconds <= 10.0)
        now = command.live()["bundle"]
        report.check("bundle in charge", now, is_of(folder, now, bundle))
        report.check("epoch is the same", epoch_of(folder), epoch_of(folder) == epoch)
        before = recordings(folder)
        wait_for(lambda: recordings(folder) >= before + 1, "a recording", 30.0)
        command.stop()
    segments = [one for one in CommissionFolder(folder).segments() if one.epoch == epoch]
    confirming_s = 1e-9 * LEARNT_STEPS * CommissionFolder(folder).facts["arm"]["period_ns"]
    lost_s = gaps_s(folder, epoch)
    what = f"motion that {len(segments)} recordings lack beyond the {LEARNT_STEPS} samples that confirm the rate"
    report.check(
        what, f"{max(0.0, lost_s - SILENT_S - confirming_s):.3f} s", abs(lost_s - SILENT_S) < confirming_s + 2e-3
    )
    kept.check("afterwards")


class Watching:
    """Follows health and alarms of an accelerated loop, and stops it at a stamp."""

    def __init__(self, until_s: float):
        self.until_s = until_s
        self.samples, self.last_ns, self.gap_ns = 0, 0, 0
        self.alarm = ""
        """Level of the alarm that stands before the gap."""
        self.after: list[tuple[float, str, str]] = []
        """Of the samples after the gap: seconds since it, health, alarm."""
        self.back_ns = 0

    def open(self, joints: tuple[str, ...], control: Any) -> None:
        self._control = control

    def verdict(self, verdict: Any) -> None:
        if verdict.sample is None:
            return
        self.samples += 1
        if self.samples > 1 and verdict.t_ns - self.last_ns > self.gap_ns:
            self.gap_ns, self.back_ns, self.after = verdict.t_ns - self.last_ns, verdict.t_ns, []
        self.last_ns = verdict.t_ns
        alarm = ALARMS[int(verdict.estimates["alarm"][0])]
        if self.gap_ns < 1e9:
            self.alarm = alarm
        health = HEALTHS[int(verdict.estimates["health"][0])]
        self.after.append(((verdict.t_ns - self.back_ns) * 1e-9, health, alarm))
        if verdict.t_ns >= self.until_s * 1e9:
            self._control.stop("the end")

    def every_second(self, report: Any) -> None:
        pass

    def close(self) -> None:
        pass


def silent_hour(report: Report, trained: Path, work: Path, arm: str) -> None:
    """An hour without a sample, as fast as the loop takes the samples."""
    before_s, after_s = 35.0, 42.0
    path = work / "hour"
    shutil.copytree(trained, path, ignore=shutil.ignore_patterns("*.sock"))
    folder = CommissionFolder.open(path)
    bundle = load_bundle(folder.bundles / f"{folder.facts['running']}.tauext")
    script = [(before_s - 3.0, PUSH.removeprefix("sim ")), (before_s, f"off seconds={HOUR_S:g}")]
    source = SimSource(arm, 0, None, script)
    settings = source.facts.settings
    record, watching = (
        KeepSink(folder, settings, source.name, 5e9, lambda: bundle.name),
        Watching(before_s + HOUR_S + after_s),
    )
    record.patient = True
    chosen = LoopSettings(acknowledge_after_s=ASKING_S)
    loop = Loop(bundle, source, [record, watching], settings=chosen, arm=settings)
    loop.alarms = max((one.id for one in read_labels(path)), default=0)
    received_s, began, kept = folder.seconds(), time.monotonic(), folder.segments()
    loop.run()
    ok_s = next((at for at, health, _ in watching.after if health == "ok"), float("inf"))
    simulated_s = watching.samples * settings.period_ns * 1e-9
    report.line(
        f"(a simulated hour without a sample, with {simulated_s:.0f} s around it, in {time.monotonic() - began:.0f} s)"
    )
    report.check(
        "hour: gap of the stamps", f"{watching.gap_ns * 1e-9:.3f} s", abs(watching.gap_ns * 1e-9 - HOUR_S) < 0.01
    )
    report.check("hour: alarm before the silence", watching.alarm, watching.alarm != ALARMS[NONE])
    report.check("hour: health ok after the silence", f"after {ok_s:.2f} s", ok_s <= 5.0)
    share = sum(health == "ok" for _, health, _ in watching.after) / len(watching.after)
    report.check("hour: samples after the silence with health ok", f"{share:.1%}", share > 0.95)
    report.check("hour: alarm after the silence", watching.after[0][2], watching.after[0][2] == ALARMS[NONE])
    new = [one for one in folder.segments() if one.number > kept[-1].number]
    held = sum(load_recording(path / one.name).samples for one in new)
    report.check("hour: samples in recordings", f"{held} of {watching.samples}", held == watching.samples)
    grown_s = folder.seconds() - received_s
    report.check(
        "hour: received motion grows by the samples alone", f"{grown_s:.3f} s", abs(grown_s - simulated_s) < 0.01
    )


# --- A clock that jumps.

CLOCK = """\
The source's clock is set back by an hour, then forward by an hour. Received hours come from
`tauext show --json`; a promise is compared with monitored hours."""


def jumps(report: Report, folder: Path, arm: str) -> None:
    report.part("A clock that jumps", CLOCK)
    with running(report, folder, arm) as command:
        command.is_monitored()
        jump(report, command, -JUMP_S)
        jump(report, command, JUMP_S)
        command.stop()


def jump(report: Report, command: Command, seconds: float) -> None:
    """Set the source's clock, and compare what is counted before and after."""
    folder, direction = command.folder, "back" if seconds < 0 else "forward"
    kept, number = Confirmed(report, folder), recordings(folder)
    wait_for(lambda: recordings(folder) > number, "a recording")
    bundle = kept.clear(command)["bundle"]
    kept.see()
    epoch, stamp, shown, began = epoch_of(folder), command.live()["t_ns"], hours(folder), time.monotonic()
    asked = time.monotonic()
    command.tell(f"sim clock seconds={seconds:g}")
    command.reach(
        lambda line: abs(line["t_ns"] - stamp) > 0.9 * JUMP_S * 1e9 and line["health"] == "ok", "health ok", 30.0
    )
    report.check(f"{direction}: health ok by the new clock", *within(asked, 5.0))
    expected = epoch + (seconds < 0)
    with suppress(TimeoutError):
        wait_for(lambda: epoch_of(folder) == expected, "the epoch", 5.0)
    name, now = "a new epoch" if seconds < 0 else "the same epoch", epoch_of(folder)
    report.check(f"{direction}: {name}", f"{epoch} → {now}", now == expected)
    number = recordings(folder)
    wait_for(lambda: recordings(folder) >= number + 2, "two recordings", 60.0)
    later, passed_s = hours(folder), time.monotonic() - began
    for key in shown:
        grown_s = 3600 * (later[key] - shown[key])
        measured = f"{grown_s:.0f} s in {passed_s:.0f} s"
        report.check(f"{direction}: growth of {key}", measured, 0 < grown_s <= passed_s + 15)
    kept.check(direction)
    after = command.live()["bundle"]
    report.check(f"{direction}: bundle in charge", after, is_of(folder, after, bundle))


def hours(folder: Path) -> dict[str, float]:
    """Received hours, and those of all bundles that a promise is compared with, [h]."""
    words = [sys.executable, "-m", "tauext", "show", str(folder), "--json"]
    shown = json.loads(subprocess.run(words, capture_output=True, text=True, check=True).stdout)
    monitored_s = sum(
        one.to_s - one.from_s for one in watches(read_history(folder), CommissionFolder(folder).seconds())
    )
    return {"received hours": shown["received_hours"], "monitored hours": monitored_s / 3600}


# --- The page of results.


def page_of(report: Report, arm: str, title: str = "Failures of `tauext commission`", option: str = "") -> str:
    """Text of failures.md, or of damage.md."""
    text = [f"# {title}", ""]
    made = f"Made by `benchmarks/commission_failures.py OUT --arm {arm}{option}` on a simulated arm, in real time."
    text += [f"{made} Times in the"]
    passed = sum(passed for part in report.parts for *_, passed in part.checks)
    total = sum(len(part.checks) for part in report.parts)
    text += [f"transcripts count from the start of the script. {passed} of {total} checks passed."]
    for part in report.parts:
        text += ["", f"## {part.title}", "", part.text, ""]
        if part.skipped:
            text += [part.skipped]
            continue
        text += [*head("check | measured | result")]
        text += [table_row(what, measured, "pass" if good else "**FAIL**") for what, measured, good in part.checks]
        text += part.table
        if part.pictures:
            text += ["", *head("page | phone, light | desktop, dark")]
        for name in part.pictures:
            stem = f"failures-{name}"
            text += [table_row(CAPTIONS[name], f"![]({stem}-phone.png)", f"![]({stem}-desktop.png)")]
        text += ["", *(f"    {line}" for line in part.lines)]
    return "\n".join(text) + "\n"


CAPTIONS = {
    "learning": "after a kill in learning",
    "asking": "after a kill in asking",
    "disk": "full disk",
    "silent": "silent source",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path, help="folder of failures.md and its pictures")
    parser.add_argument("--arm", default="rig")
    parser.add_argument("--damage", action="store_true", help="damage files and kill at random moments instead")
    parser.add_argument("--kills", type=int, default=200, help="number of kills at random moments")
    parser.add_argument("--keep", action="store_true", help="keep the folders of the arm, and print where")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    commission_pictures.SIZES.update(SIZES)
    report, work = Report(), Path(tempfile.mkdtemp())
    folder, arm, out = work / "try", options.arm, options.out
    if options.damage:
        damage(report, work)
        many_kills(report, work / "killed", arm, options.kills)
        shutil.rmtree(work, ignore_errors=True)
        (options.out / "damage.md").write_text(
            page_of(report, arm, "Damage to a folder of `tauext commission`", " --damage")
        )
        sys.exit(1 if report.failed else 0)
    (work / "browser").mkdir()
    browser = Browser(work / "browser")
    try:
        parts: list[Callable[[], None]] = [
            lambda: kills(report, folder, arm, out, browser),
            lambda: full_disk(report, folder, work, arm, out, browser),
            lambda: silence(report, folder, arm, out, browser),
            lambda: silent_hour(report, folder, work, arm),
            lambda: jumps(report, folder, arm),
        ]
        for part in parts:
            try:
                part()
            except TimeoutError as error:
                report.check(f"{error}", "did not come", False)
                if active_bundle(folder) is None:
                    break
    finally:
        browser.close()
        if options.keep:
            print(f"kept: {work}")
        else:
            shutil.rmtree(work, ignore_errors=True)
    (out / "failures.md").write_text(page_of(report, arm))
    print(f"\n{report.failed} checks failed; took {time.monotonic() - report.began:.0f} s")
    sys.exit(1 if report.failed else 0)


if __name__ == "__main__":
    main()
