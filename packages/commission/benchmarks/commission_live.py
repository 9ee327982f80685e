"""`tauext commission` in real time on a simulated arm: a first use with pictures of its page, and kills at random.

    CHROMIUM=/usr/bin/chromium python packages/commission/benchmarks/commission_live.py OUT [--arm rig] [--kills 200]
        [--keep]

Checks that nothing is lost that was confirmed; tests/test_commission_faults.py beside it damages every file. Writes
OUT/live.md and pictures of the page, and exits with 1 if a check fails. Needs Linux, Chromium and websockets (extra
`dev`). Takes half an hour.
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

from common import arguments, head, table_row, write_tables
from made_browser import Browser, Page
from tauext_commission.history_file import active_bundle, lost_lines, read_events, read_labels

PORT = 8797
LOOKS = {"phone": ((390, 1500), "light"), "desktop": ((1280, 1000), "dark")}
"""Size and scheme of the pictures."""
PUSH = "sim push joint=joint2 force=0,0,-60 seconds=0.4"
PATIENCE_S = 240.0
SETTLE_S = 6.0
"""From the opening of a page to its picture, [s]."""
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

    def kill(self) -> None:
        """kill -9 of the main process; its other processes end, too."""
        os.kill(self.process.pid, signal.SIGKILL)
        self.process.wait()
        wait_for(lambda: not self.members(), "the end of the other processes", 10.0)
        self._report.line("(kill -9 of the main process)")

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


# --- A first use, and kills.


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
        said = command.tell(f"touched {alarm}")
        report.check("an answer is confirmed", said, said == "ok")
        command.stop()


def answered(command: Command, line: str) -> dict[int, str]:
    """Labels that are new once the answer is confirmed."""
    before = {one.id for one in read_labels(command.folder)}
    confirmed = command.tell(line) == "ok"
    return {one.id: one.answer for one in read_labels(command.folder) if confirmed and one.id not in before}


def many_kills(report: Report, folder: Path, arm: str, number: int) -> None:
    report.part(f"{number} kills")
    kept, rng, states, jumps = dict[int, str](), np.random.default_rng(0), Counter[str](), 0
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
                    kept |= answered(command, line)
                    if rng.random() < 0.3:  # this one is killed while it is stored
                        threading.Thread(target=tell_in_vain, args=(command,), daemon=True).start()
            time.sleep(max(0.0, limit_s - time.monotonic()))
            with suppress(OSError, ValueError):
                states[command.live()["state"]] += 1
            command.kill()
    labels = {one.id: one.answer for one in read_labels(folder)}
    there = sum(labels.get(one) == answer for one, answer in kept.items())
    report.check("states at the kill", ", ".join(f"{name} {count}" for name, count in states.items()), True)
    report.check("clock set back", f"{jumps} times", jumps > 0)
    report.check("confirmed answers in the journal", f"{there} of {len(kept)}", there == len(kept) > 0)
    report.check("lines of the journal that are lost", lost_lines(folder), not lost_lines(folder))


def tell_in_vain(command: Command) -> None:
    with suppress(OSError, ValueError):
        command.tell("touched")


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
