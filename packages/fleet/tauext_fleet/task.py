"""One stage of one arm: done once, in a folder that appears when it is complete."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import socket
import time
import traceback
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any
from uuid import uuid4

import tauext_lab

import tauext
import tauext_fleet
from tauext import _core
from tauext.errors import ConfigError, FaultyDataError, TauextError
from tauext.files.plain_file import FORMAT, expect_file, json_of
from tauext.files.provenance import VERSION, json_text, provenance, write_json
from tauext_fleet.locations import Location, local_work, located, read_text, scratch, with_urls, write_text
from tauext_fleet.store import Stored, StoreError

# --- One driver a folder: a second one would delete unfinished output of the first one's workers.
#
# A store has no locks: there it is one driver of this machine.


LOCK = "fleet.lock"


@contextmanager
def locked(out: Location) -> Iterator[None]:
    """Lock the folder for this driver; the lock ends with the process, even a killed one.

    Raises:
        ConfigError: another driver is at work here.
    """
    try:
        import fcntl
    except ImportError:  # no such locks on this system
        yield
        return
    home = scratch(out) if isinstance(out, Stored) else out
    home.mkdir(parents=True, exist_ok=True)
    with (home / LOCK).open("a+") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            file.seek(0)
            raise ConfigError(f"{out}: another `tauext fleet run` is at work here ({file.read().strip()})") from error
        except OSError:
            pass  # a file system without locks
        file.truncate(0)
        file.write(f"process {os.getpid()} of {socket.gethostname()}")
        file.flush()
        yield


# --- Digests of files by their content, each file read once: what did not change since is known by size and time.


AT_A_TIME = 4
"""Files that are read at a time: disks and networks have little more to give."""


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, hexadecimal."""
    expect_file(path)
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


class Contents:
    """SHA-256 of files, remembered between runs by path, size and time of the last change."""

    def __init__(self, memory: Location):
        """memory: file of known digests; a damaged one is ignored."""
        self._memory = memory
        self._known: dict[str, list] = {}
        try:
            known = json_of(read_text(memory))
            self._known = {path: entry for path, entry in known.items() if len(entry) == 3}
        except (OSError, ValueError, TypeError, AttributeError):
            pass

    def read(self, files: Iterable[Location], show: Callable[[int, int], object]) -> None:
        """Read the files that are not hashed yet, some at a time; calls show with the number read and the total."""
        each = dict.fromkeys(files)
        pool = ThreadPoolExecutor(AT_A_TIME)
        try:
            for done, _ in enumerate(pool.map(self.digest, each), 1):
                show(done, len(each))
        finally:
            pool.shutdown(cancel_futures=True)  # a Ctrl-C waits for the files that are being read, and for no other

    def digest(self, path: Location) -> str:
        """SHA-256 of one file; of a stored one, the mark of its content by the store.

        Raises:
            ConfigError: it cannot be read.
        """
        try:
            if isinstance(path, Stored):
                return path.version()
            status = path.stat()
            size, time_ns, digest = self._known.get(str(path), (None, None, ""))
            if (size, time_ns) != (status.st_size, status.st_mtime_ns):
                digest = sha256_of(path)
                self._known[str(path)] = [status.st_size, status.st_mtime_ns, digest]
        except OSError as error:
            raise ConfigError(f"{path}: cannot be read ({error.strerror or error})") from error
        return str(digest)

    def keep(self) -> None:
        """Save the digests for the next run."""
        write_text(self._memory, json_text(dict(sorted(self._known.items()))))


def digest_of(content: object) -> str:
    """SHA-256 of something as JSON; the order of keys does not matter."""
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


# --- The build of tauext: the release, and a digest of all code that decides an output's bytes.


COUNTED = {
    "tauext": ("files", "robot", "data", "bundle", "check", "fit", "train", "monitor"),
    "tauext_lab": ("evaluate", "torch_backend.py", "own_network.py", "other_methods.py"),
    "tauext_fleet": (
        *("config.py", "locations.py", "stages.py", "store.py", "task.py"),
        *("expected_friction.py", "fleet_prior.py", "hierarchy.py", "like.py", "map_regression.py"),
    ),
}
"""Folders and files whose code decides a task's output, by package. Root modules of tauext count, too."""
ROOTS = tuple(Path(str(package.__file__)).parent for package in (tauext, tauext_lab, tauext_fleet))


def is_counted(package: str, name: Path) -> bool:
    """Whether the code of a file decides a task's output.

    Args:
        name: relative to the package.
    """
    return name.parts[0] in COUNTED[package] or (package == "tauext" and len(name.parts) == 1)


@cache
def build() -> str:
    """Name the build, such as "0.1.0+3f9c0a1be2d4".

    One release may be built from several states of the code, or for several processors.

    Of libraries only the core's own counts: another NumPy repeats no task, and is listed in each output's provenance.
    """
    digest = hashlib.sha256(Path(_core.__file__).read_bytes())
    for root in ROOTS:
        for file in sorted(root.rglob("*.py")):
            if is_counted(root.name, name := file.relative_to(root)):
                digest.update(f"{root.name}/{name.as_posix()}\0".encode())
                digest.update(file.read_bytes())
    return f"{VERSION}+{digest.hexdigest()[:12]}"


# --- One stage of one arm: done once, in a folder that appears complete, with a marker of its inputs.


MARKER, WALL_TIME = "task.json", "task.wall_time_s.json"
TIMED = "wall_time_s.json"
"""End of the names of files that differ from run to run: task.wall_time_s.json, and those of the commands."""
LONGEST_REASON = 400
"""Most characters of a reason on one line."""

Stage = Callable[[Mapping[str, Any], Path], str | None]
"""Runs `work` in a new folder; returns why the arm's later stages must not follow, None where they may."""


@dataclass(frozen=True)
class Task:
    """One unit of work, as plain JSON, so that any process on any machine can run it."""

    arm: str
    stage: str
    folder: str
    """Folder of its complete output; absolute."""
    inputs: dict[str, str]
    """All that the output depends on, by readable names: digests of contents, settings, hashes of earlier tasks."""
    work: dict[str, Any] = field(default_factory=dict)
    """Arguments of the stage: locations and settings. The content of a location is an input, its name is not."""
    build: str = field(default_factory=build)
    """Build of the tauext that planned it."""

    @property
    def hash(self) -> str:
        """SHA-256 over stage, build and inputs: tasks of one hash give the same bytes."""
        return digest_of([self.build, self.stage, self.inputs])

    def to_json(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class Outcome:
    """How a task ended."""

    state: str
    """done, refused (done, but nothing may be made from its output), or failed."""
    reason: str = ""
    seconds: float = 0.0
    """Wall time of the run."""


@dataclass(frozen=True)
class Marker:
    """Content of the marker in a finished task's folder."""

    hash: str
    build: str
    inputs: dict[str, str]
    outputs: dict[str, dict[str, Any]]
    refused: str | None
    seconds: float

    def lacks(self, folder: Location) -> str | None:
        """The first output that is missing or has another size; None: all exist."""
        there = sizes(folder, self.outputs)
        return next((name for name, entry in self.outputs.items() if there.get(name) != entry["bytes"]), None)


def marker_of(folder: Location) -> Marker | None:
    """The marker in the folder; None: missing or incomplete."""
    try:
        content = json_of(read_text(folder / MARKER))
        if content["format"] != FORMAT:
            return None
        seconds = float(json_of(read_text(folder / WALL_TIME))["task_s"])
        return Marker(
            content["hash"], content["build"], content["inputs"], content["outputs"], content["refused"], seconds
        )
    except (OSError, ValueError, TypeError, KeyError):
        return None


def finished(task: Task) -> Outcome | None:
    """How it ended, where it was done already; None: it is to be done."""
    folder = located(task.folder)
    marker = marker_of(folder)
    if marker is None or marker.hash != task.hash or marker.lacks(folder) is not None:
        return None
    return ended(marker)


def ended(marker: Marker) -> Outcome:
    if marker.refused is not None:
        return Outcome("refused", marker.refused, marker.seconds)
    return Outcome("done", "", marker.seconds)


def run_task(task: Task, stages: Mapping[str, Stage]) -> Outcome:
    """Run the task unless it is done; any error is a failed outcome with its reason on one line.

    The output is written to a folder of its own beside the final one and renamed: a killed process leaves no partial
    output. What the stage reads from a store is downloaded first; output for a store is written on this machine and
    uploaded, its marker last. If it fails, STAGE.failed.txt beside it
    holds the full reason.
    """
    if task.build != build():
        return Outcome("failed", f"this worker has tauext {build()}, and the fleet is run by {task.build}")
    if (outcome := finished(task)) is not None:
        return outcome
    folder = located(task.folder)
    failure_file = folder.with_name(f"{task.stage}.failed.txt")
    name = f".{task.stage}.part-{socket.gethostname()}-{os.getpid()}-{uuid4().hex[:8]}"
    here = scratch(folder.parent)
    part, inputs = (folder.parent if isinstance(folder, Path) else here) / name, here / f"{name}-inputs"
    started = time.monotonic()
    try:
        part.mkdir(parents=True)
        with warnings.catch_warnings():
            # Overflows are found where the number is checked; the interpreter's warnings are not shown.
            warnings.simplefilter("ignore", RuntimeWarning)
            refused = stages[task.stage](local_work(task.work, inputs), part)
        marker = mark(task, part, refused, time.monotonic() - started)
        publish(part, task)
        if failure_file.is_file():
            failure_file.unlink(missing_ok=True)
        return ended(marker)
    except Exception as error:
        reason, block = (with_urls(one.replace(str(part), str(folder)), inputs) for one in reason_and_report(error))
        with suppress(OSError, StoreError):  # the reason itself is reported
            write_text(failure_file, block + "\n")
        return Outcome("failed", reason, time.monotonic() - started)
    finally:
        shutil.rmtree(part, ignore_errors=True)
        shutil.rmtree(inputs, ignore_errors=True)


def mark(task: Task, part: Path, refused: str | None, seconds: float) -> Marker:
    """Write the marker into the folder that is complete but for it."""
    files = sorted(path for path in part.rglob("*") if path.is_file() and not path.name.endswith(TIMED))
    outputs = {
        path.relative_to(part).as_posix(): {"bytes": path.stat().st_size, "sha256": sha256_of(path)} for path in files
    }
    content = {"format": FORMAT, "arm": task.arm, "stage": task.stage, "hash": task.hash}
    content |= {"build": task.build, "inputs": task.inputs}
    content |= {"refused": refused, "outputs": outputs}
    made_by = {key: value for key, value in provenance("tauext fleet run", {}, None).items() if key != "settings"}
    write_json({"task_s": round(seconds, 3)}, part / WALL_TIME)
    write_json(content | made_by, part / MARKER)
    return Marker(task.hash, task.build, task.inputs, outputs, refused, round(seconds, 3))


def publish(part: Path, task: Task) -> None:
    """Rename the folder to its final name, replacing output of other inputs; output of the same inputs is kept.

    Raises:
        OSError: it cannot be renamed.
    """
    folder = located(task.folder)
    if isinstance(folder, Stored):
        if finished(task) is None:
            upload_over(part, folder)
        return
    old = part.with_name(part.name.replace(".part-", ".old-"))
    try:
        if folder.exists() and finished(task) is None:
            os.rename(folder, old)
        os.rename(part, folder)
    except OSError:
        if finished(task) is None:
            raise
    finally:
        shutil.rmtree(old, ignore_errors=True)


def upload_over(part: Path, folder: Stored) -> None:
    """Replace a stored folder: the old marker is deleted first, and the new one is uploaded last."""
    files = {path.relative_to(part).as_posix(): path for path in part.rglob("*") if path.is_file()}
    (folder / MARKER).unlink(missing_ok=True)
    for name in folder.files():
        if name not in files:
            (folder / name).unlink(missing_ok=True)
    for name in sorted(files, key=lambda name: (name == MARKER, name)):
        (folder / name).upload(files[name])


def sizes(folder: Location, names: Iterable[str]) -> dict[str, int]:
    """Sizes of those of these files that exist, [bytes]; of a store by one listing."""
    if isinstance(folder, Stored):
        return {name: size for name, (size, _) in folder.files().items()}
    found = {}
    for name in names:
        with suppress(OSError):
            found[name] = (folder / name).stat().st_size
    return found


def reason_and_report(error: Exception) -> tuple[str, str]:
    """The reason in one line, and the full report."""
    if isinstance(error, FaultyDataError):
        codes = dict.fromkeys(getattr(finding, "code", "") for finding in error.findings)
        line = str(error).splitlines()[0].partition(",")[0]
        return one_line(f"{line}: {', '.join(codes)}" if codes else line), str(error)
    if isinstance(error, TauextError):
        return one_line(str(error)), str(error)
    if isinstance(error, OSError):
        line = f"{error.filename or 'output'}: cannot be read or written ({error.strerror or error})"
        return one_line(line), line
    if isinstance(error, MemoryError):
        line = f"this needs more memory than there is ({str(error) or 'none is left'})"
        return one_line(line), line
    last = traceback.extract_tb(error.__traceback__)[-1]
    line = f"an error of tauext itself: {type(error).__name__}: {error} ({Path(last.filename).name}:{last.lineno})"
    return one_line(line), "".join(traceback.format_exception(error))


def one_line(text: str) -> str:
    line = " ".join(text.split())
    return line if len(line) <= LONGEST_REASON else f"{line[:LONGEST_REASON]} ..."


def clean(arm_folder: Location) -> None:
    """Remove leftovers of killed workers of an arm; no other worker may be active there."""
    shutil.rmtree(scratch(arm_folder), ignore_errors=True)
    if isinstance(arm_folder, Path):
        for left in (*arm_folder.glob(".*.part-*"), *arm_folder.glob(".*.old-*")):
            shutil.rmtree(left, ignore_errors=True)


def expect_json(content: Any) -> Task:
    """The task that to_json wrote.

    Raises:
        ConfigError: it is none.
    """
    try:
        return Task(**content)
    except TypeError as error:
        raise ConfigError(f"this is no task of a fleet: {error}") from error
