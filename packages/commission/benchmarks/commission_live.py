"""`tauext commission` in real time on a simulated arm: a first use with pictures, kills, a full disk, a silent source.

    CHROMIUM=/usr/bin/chromium python packages/commission/benchmarks/commission_live.py OUT [--arm rig] [--kills 200]
        [--keep]

Checks that nothing is lost that was confirmed; tests/test_commission_faults.py beside it damages every file. Writes
OUT/live.md and pictures of the page, and exits with 1 if a check fails. Needs Linux, Chromium and websockets (extra
`dev`); the full disk also needs the right to mount a file system. Takes 40 minutes.
"""

from __future__ import annotations

import io
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
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))
sys.path.insert(0, str(Path(__file__).parents[3] / "tests"))

from common import arguments, head, table_row, write_tables
from made_browser import Browser, Page
from tauext_commission.history_file import active_bundle, lost_lines, read_events, read_labels, read_question

from tauext.data.recording_file import load_recording
from tauext.errors import TauextError

PORT = 8797
LOOKS = {"phone": ((390, 1500), "light"), "desktop": ((1280, 1000), "dark")}
"""Size and scheme of the pictures."""
PUSH = "sim push joint=joint2 force=0,0,-60 seconds=0.4"
PATIENCE_S = 240.0
AGAIN_S = 30.0
"""Longest time from the command to health ok, [s]."""
SETTLE_S = 6.0
"""From the opening of a page to its picture, [s]."""
SPARE_BYTES = 24 << 20
"""Free space of the small disk before it is filled."""
SILENT_S = 60.0
LEARNING_SHARE = 0.2
"""Share of the kills before the first bundle."""


# --- Checks, and what is printed meanwhile.


class Report:
    """Transcript, which is printed, and checks."""

    def __init__(self) -> None:
        self.began, self.rows, self.failed = time.monotonic(), head("part | check | measured | result"), 0
        self.title = ""

    def part(self, title: str) -> None:
        self.title = title
        print(f"\n{title}", flush=True)

    def line(self, text: str) -> None:
        print(f"{time.monotonic() - self.began:5.0f} s  {text}", flush=True)

    def check(self, what: str, measured: object, passed: bool) -> None:
        self.rows.append(table_row(self.title, what, measured, "pass" if passed else "**FAIL**"))
        self.failed += not passed
        print(f"{'PASS' if passed else 'FAIL'}  {what}: {measured}", flush=True)


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


def within(began: float, limit_s: float) -> tuple[str, bool]:
    seconds = time.monotonic() - began
    return f"{seconds:.1f} s", seconds <= limit_s


def yes(done: bool) -> tuple[str, bool]:
    return ("yes" if done else "no"), done


def recordings(folder: Path) -> int:
    return len(list(folder.glob("seg-*.parquet")))


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
        for name in filter(str.isdigit, os.listdir("/proc")):
            with suppress(OSError):
                state, _, _, session, *_ = Path("/proc", name, "stat").read_text().rpartition(")")[2].split()
                if int(session) == self.process.pid and state != "Z":
                    found.append(int(name))
        return found

    @property
    def url(self) -> str:
        return next(line.split()[0] for line in self.lines if line.startswith("http://"))

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


def ask(folder: Path, line: str) -> str:
    """The answer to a control line."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as wire:
        wire.connect(str(folder / "control.sock"))
        wire.sendall(line.encode() + b"\n")
        with wire.makefile() as answers:
            return answers.readline().strip()


def photograph(browser: Browser, url: str, out: Path, name: str) -> None:
    """The page on a phone and on a desktop."""
    for look, (size, scheme) in LOOKS.items():
        with browser.page(url, *size, scheme) as page:
            time.sleep(SETTLE_S)
            save(page, out / f"{name}-{look}.png")


def save(page: Page, path: Path) -> None:
    """A picture with few colours, so that it is small."""
    picture = Image.open(io.BytesIO(page.picture())).convert("RGB")
    picture.quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)


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


# --- A first use, kills, a full disk, a silent source.


def first_use(report: Report, folder: Path, arm: str, out: Path, browser: Browser) -> None:
    """From nothing to an answered alarm, with the page in each state."""
    report.part("a first use")
    with running(report, folder, arm) as command:
        for state in ("learning", "monitoring"):
            command.state(state)
            time.sleep(20.0)
            photograph(browser, command.url, out, state)
        report.check("monitored", *within(command.began, PATIENCE_S))
        alarm = command.alarm()
        photograph(browser, command.url, out, "asking")
        with browser.page(command.url, *LOOKS["desktop"][0], "light") as page:
            time.sleep(SETTLE_S)
            save(page, out / "asking-desktop-light.png")  # for the first page of the documentation
        report.check("an answer is confirmed", *yes(command.tell(f"touched {alarm}") == "ok"))
        command.stop()


def many_kills(report: Report, folder: Path, arm: str, number: int) -> None:
    report.part(f"{number} kills")
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
    labels = {one.id: one.answer for one in read_labels(folder)}
    there = sum(labels.get(one) == answer for one, answer in kept.answers.items())
    report.check("states at the kill", ", ".join(f"{name} {count}" for name, count in states.items()), True)
    report.check("clock set back", f"{jumps} times", jumps > 0)
    report.check("confirmed answers in the journal", f"{there} of {len(kept.answers)}", there == len(kept.answers) > 0)
    report.check("lines of the journal that are lost", lost_lines(folder), not lost_lines(folder))


def tell_in_vain(command: Command) -> None:
    with suppress(OSError, ValueError):
        command.tell("touched")


def full_disk(report: Report, trained: Path, work: Path, arm: str, out: Path, browser: Browser) -> None:
    report.part("a full disk")
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
        print(f"skipped: this user may not mount a file system ({refused})", flush=True)
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
    report.line(f"(a file of {dummy.stat().st_size / 1e6:.0f} MB fills the disk)")
    wait_for(lambda: losses(command), "the report of lost samples", 30.0)
    report.check("the loss is reported", *within(began, 15.0))
    line = command.reach(lambda line: line["message"], "the page's report of lost samples", 15.0)
    report.check("the page reports the loss", f"`{line['says']}`", "LOSES SAMPLES" in line["message"])
    photograph(browser, command.url, out, "failures-disk")
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
    command.reach(lambda line: not line["message"], "the end of the page's report", 15.0)
    kept.check("afterwards")


def losses(command: Command) -> list[str]:
    return [line for line in command.lines if "LOSES SAMPLES" in line]


def silence(report: Report, folder: Path, arm: str, out: Path, browser: Browser) -> None:
    report.part("a silent source")
    kept = Confirmed(report, folder)
    with running(report, folder, arm) as command:
        bundle = command.is_monitored()[0]["bundle"]
        before = recordings(folder)
        wait_for(lambda: recordings(folder) > before, "a recording")
        kept.clear(command)
        kept.see()
        command.tell(f"sim off seconds={SILENT_S:g}")
        began = time.monotonic()
        line = command.reach(lambda line: line["lost"], "a report", 15.0)
        taken, soon = within(began, 5.0)
        report.check("the page reports the silence", f"{taken}: `{line['lost']}`", soon)
        photograph(browser, command.url, out, "failures-silent")
        line = command.live()
        report.check("state meanwhile", line["state"], line["state"] == "monitoring")
        measured = f"{line['health']} ({', '.join(line['causes'])})"
        report.check("health meanwhile", measured, line["health"] != "ok")
        command.reach(lambda line: line["health"] == "ok" and not line["lost"], "health ok", SILENT_S + 60)
        seconds = time.monotonic() - began - SILENT_S
        report.line("(samples come again, health ok)")
        report.check("health ok after the silence", f"after {seconds:.1f} s", seconds <= 10.0)
        now = command.live()["bundle"]
        report.check("bundle in charge", now, now >= bundle)
        before = recordings(folder)
        wait_for(lambda: recordings(folder) >= before + 1, "a recording", 30.0)
        command.stop()
    kept.check("afterwards")


def main() -> None:
    parser = arguments(__doc__, "out")
    parser.add_argument("--arm", default="rig", help="of sim:, default: %(default)s")
    parser.add_argument("--kills", type=int, default=200, help="at random moments, default: %(default)s")
    parser.add_argument("--keep", action="store_true", help="keep the folders of the arm, and print where")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    report, work = Report(), Path(tempfile.mkdtemp())
    folder, arm, out = work / "try", options.arm, options.out
    (work / "browser").mkdir()
    browser = Browser(work / "browser")
    parts: list[Callable[[], None]] = [
        lambda: first_use(report, folder, arm, out, browser),
        lambda: full_disk(report, folder, work, arm, out, browser),
        lambda: silence(report, folder, arm, out, browser),
        lambda: many_kills(report, work / "killed", arm, options.kills),
    ]
    try:
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
    write_tables(out, report.rows, name="live")
    sys.exit(1 if report.failed else 0)


if __name__ == "__main__":
    main()
