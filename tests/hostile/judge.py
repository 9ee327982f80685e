"""Runs a case in a process of its own, with limits, and says what is wrong with how it ended."""

from __future__ import annotations

import ctypes
import json
import os
import re
import resource
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from hostile.cases import Case, lay_out, make_case
from tauext.cli import main

PATIENCE_S = 10.0
"""A command that was not asked for long work ends within this."""
WORKING_S = 5.0
"""One that was is interrupted after this, and must end within PATIENCE_S from then."""
WAITS = ("commission", "monitor", "run")
"""Commands that may rightly wait: for samples, for people, for the time of the recording."""
MEMORY = 4 << 30
LARGEST_FILE = 1 << 28
MOST_THREADS = 400
NOBODY = 65534
KEEP_CAPABILITIES, AMBIENT, AMBIENT_RAISE = 8, 47, 2  # of Linux: prctl
CAPABILITY_VERSION, READ_ALL = 0x20080522, 1 << 2  # capset; DAC_READ_SEARCH
STATUSES = (0, 1, 2, 130)
KEEP = {"commission", "run", "monitor", "simulate", "evaluate", "reproduce"}
"""Commands that write many files: what was whole before the one that failed stays, and the same command goes on."""


@dataclass(frozen=True)
class Ending:
    """How a case ended."""

    number: int
    kind: str
    arguments: list[str]
    what: str
    status: int
    seconds: float
    faults: list[str]
    last_line: str


@dataclass
class Worker:
    """A process that runs one case after the other, and is followed by another where one of them ends it."""

    folder: Path
    numbers: list[int]
    pid: int
    began: float
    """The case at work, the first of the numbers."""
    interrupted: float | None = None
    starved_s: float = 0.0
    """Time that the process wanted a processor and had none, since it began: others' work, no hang."""
    starved_before_s: float = 0.0
    """The same, until the case at work began or was interrupted."""


@dataclass(frozen=True)
class Plan:
    """What all cases of a run have in common."""

    seed: int
    good: Path
    only: str
    full: Path | None


def start(plan: Plan, numbers: list[int], folder: Path) -> Worker:
    """Begin these cases in a process of its own; each has a folder of its own in the folder."""
    for number in numbers:
        shutil.rmtree(folder / str(number), ignore_errors=True)
        (folder / str(number)).mkdir(parents=True)
        (folder / str(number)).chmod(0o777)
    folder.chmod(0o777)
    pid = os.fork()
    if pid == 0:
        try:
            os.setsid()
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            become_nobody()
            for number in numbers:
                work(plan, number, folder / str(number))
        finally:
            os._exit(0)
    return Worker(folder, numbers, pid, time.monotonic())


def work(plan: Plan, number: int, folder: Path) -> None:
    """In the process of the cases: draw one, limit it, run the command, write how it ended."""
    for name, descriptor in (("stdout", 1), ("stderr", 2)):
        os.dup2(os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o666), descriptor)
    sys.stdout, sys.stderr = (open(k, "w", encoding="utf-8", closefd=False) for k in (1, 2))
    place = folder / "work"
    place.mkdir()
    os.chdir(place)
    lay_out(plan.good, place, plan.full)
    case = make_case(plan.seed, number, place, plan.only)
    write_json(case.__dict__, folder / "case.json")
    os.environ["XDG_CACHE_HOME"] = os.environ["HOME"] = str(place / "out/cache")
    before_s = time.process_time()
    with limited(case):
        status = status_of(case)
    write_json([status, time.process_time() - before_s], folder / "ended.json")


def status_of(case: Case) -> int:
    """The exit status that the interpreter would give; a traceback where it would print one."""
    status = 1
    try:
        signal.signal(signal.SIGINT, signal.default_int_handler)
        status = main(case.arguments)
    except SystemExit as stop:
        status = int(stop.code or 0)
    except BaseException:
        traceback.print_exc()
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            status = 120  # as the interpreter itself ends then
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    return status


def write_json(content: Any, path: Path) -> None:
    path.with_suffix(".new").write_text(json.dumps(content))
    path.with_suffix(".new").rename(path)


@contextmanager
def limited(case: Case) -> Iterator[None]:
    """Limits of a case; all but that on files stay for the next."""
    limit(resource.RLIMIT_AS, MEMORY)
    limit(resource.RLIMIT_CORE, 0)
    if os.getuid() == NOBODY:
        limit(resource.RLIMIT_NPROC, MOST_THREADS)
    limit(resource.RLIMIT_FSIZE, LARGEST_FILE if case.largest_file is None else case.largest_file)
    try:
        yield
    finally:
        limit(resource.RLIMIT_FSIZE, LARGEST_FILE)


def become_nobody() -> None:
    """Root writes nowhere but here; it still reads all, as an interpreter may lie in its own folder."""
    if os.getuid() != 0:
        return
    libc = ctypes.CDLL(None)
    libc.prctl(KEEP_CAPABILITIES, 1, 0, 0, 0)
    os.setgroups([])
    os.setgid(NOBODY)
    os.setuid(NOBODY)
    libc.capset((ctypes.c_uint32 * 2)(CAPABILITY_VERSION, 0), (ctypes.c_uint32 * 6)(*[READ_ALL] * 3, 0, 0, 0))
    libc.prctl(AMBIENT, AMBIENT_RAISE, READ_ALL.bit_length() - 1, 0, 0)  # also for what is started


def limit(what: int, most: int) -> None:
    resource.setrlimit(what, (most, resource.getrlimit(what)[1]))


def look(worker: Worker) -> Ending | None:
    """The ending of the worker's case, if it has ended; the worker is then at its next one, or has no number left."""
    number, now = worker.numbers[0], time.monotonic()
    worker.starved_s = starved_s(worker)
    folder = worker.folder / str(number)
    ended = folder / "ended.json"
    if ended.is_file():
        status, cpu_s = json.loads(ended.read_text())
        return judged(worker, status, cpu_s, now)
    pid, code = os.waitpid(worker.pid, os.WNOHANG)
    if pid and not ended.is_file():
        worker.pid = 0
        return judged(worker, os.waitstatus_to_exitcode(code), 0.0, now)
    return None if pid else hurry(worker, now)


def starved_s(worker: Worker) -> float:
    """Of the thread that waited longest, by the second number of its schedstat, [ns]."""
    waited = [worker.starved_s]
    for task in Path(f"/proc/{worker.pid}/task").glob("*/schedstat"):
        with suppress(OSError, IndexError, ValueError):
            waited.append(int(task.read_text().split()[1]) * 1e-9)
    return max(waited)


def judged(worker: Worker, status: int, cpu_s: float, now: float) -> Ending:
    """The ending of the case at work, and the worker goes on to the next."""
    number, folder = worker.numbers[0], worker.folder / str(worker.numbers[0])
    case = read_case(folder)
    error, out = ((folder / name).read_text(errors="replace") for name in ("stderr", "stdout"))
    faults = faults_of(case, status, error, out, folder / "work")
    if worker.interrupted is not None and status in (0, 130):
        if case.kind != "options":  # not asked for long work
            faults.append(f"took longer than {PATIENCE_S:g} s ({cpu_s:.1f} s of them computing)")
        elif cpu_s < 0.2 and case.command not in WAITS:
            faults.append("waited for ever for what does not come")
    last = error.strip().splitlines()[-1][:300] if error.strip() else ""
    seconds = now - worker.began
    worker.numbers.pop(0)
    worker.began, worker.interrupted, worker.starved_before_s = now, None, worker.starved_s
    return Ending(number, case.kind, case.arguments, case.what, status, seconds, faults, last)


def hurry(worker: Worker, now: float) -> Ending | None:
    """Ctrl-C when it is time; an end of all where that does not help."""
    folder = worker.folder / str(worker.numbers[0])
    case = read_case(folder)
    starved_s = worker.starved_s - worker.starved_before_s
    if worker.interrupted is None:
        allowed_s = WORKING_S if case.kind == "options" else PATIENCE_S
        if now - worker.began - starved_s > allowed_s:
            os.kill(worker.pid, signal.SIGINT)
            worker.interrupted, worker.starved_before_s = now, worker.starved_s
        return None
    if now - worker.interrupted - starved_s < PATIENCE_S:
        return None
    end_group(worker.pid)
    os.waitpid(worker.pid, 0)
    worker.pid = 0
    ending = judged(worker, -9, 0.0, now)
    fault = f"hangs: Ctrl-C did not end it within {PATIENCE_S:g} s"
    return Ending(**(ending.__dict__ | {"faults": [fault]}))


def read_case(folder: Path) -> Case:
    file = folder / "case.json"
    if not file.is_file():
        return Case("options", ["(not made)"], "the case itself failed")
    return Case(**json.loads(file.read_text()))


def end(worker: Worker) -> None:
    """The process of the cases and whatever it started; its folders go."""
    if worker.pid:
        end_group(worker.pid)
        os.waitpid(worker.pid, 0)
        worker.pid = 0


def end_group(pid: int) -> None:
    """All processes of the group."""
    try:
        os.killpg(pid, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):
        pass


def faults_of(case: Case, status: int, error: str, out: str, place: Path) -> list[str]:
    """What is wrong with this ending; nothing in most cases."""
    faults = []
    if status < 0:
        faults.append(f"crashed with signal {-status} ({signal.Signals(-status).name})")
    elif status not in STATUSES:
        faults.append(f"exit status {status}")
    if status == 1 and case.command != "check":
        faults.append("exit status 1 belongs to check alone")
    if "Traceback (most recent" in error + out:
        faults.append("traceback")
    if native := re.search(r"\w+Warning: |Exception ignored|HDF5-DIAG|terminate called|RuntimeError|WARNING", error):
        faults.append(f"prints {native[0]!r} beside its own words")
    told = error.rstrip().splitlines()
    begins = [k for k, line in enumerate(told) if line.startswith("tauext: error:")]
    # faults of data are told in a block, indented below their line
    if status == 2 and (len(begins) != 1 or not all(line.startswith("  ") for line in told[begins[0] + 1 :])):
        faults.append(f"{len(begins)} lines of error instead of one at the end")
    if begins and len(told[begins[0]]) > 4000:
        faults.append(f"an error of {len(told[begins[0]])} characters")
    return faults + half_written(case, status, place)


def half_written(case: Case, status: int, place: Path) -> list[str]:
    """Files that are not whole, and any at all where a command was refused."""
    made = [path for path in place.rglob("*") if not path.is_symlink() and path.is_file() and "cache" not in path.parts]
    made = [path for path in made if path.relative_to(place).parts[0] in ("out", "empty", "missing")]
    faults = [f"left {path.relative_to(place)}" for path in place.rglob("*.part*")]
    for path in made:
        try:
            if path.suffix == ".parquet":
                pq.ParquetFile(path).close()
            elif path.suffix == ".json":
                json.loads(path.read_text())
        except Exception as error:
            faults.append(f"half-written {path.relative_to(place)} ({type(error).__name__})")
    simulated = case.command == "simulate" and case.largest_file is None and "full" not in case.what
    if status == 2 and made and (case.command not in KEEP or simulated):
        faults.append(f"refused, and left {', '.join(str(path.relative_to(place)) for path in made[:4])}")
    return faults
