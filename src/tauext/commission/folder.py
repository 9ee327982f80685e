"""The folder of one commissioned arm: names, facts, index of recordings, bundles, history, log."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from tauext.bundle.history_file import (
    ACTIVE,
    BUNDLES,
    EVENTS,
    FACTS,
    HISTORY,
    RESULTS,
    active_bundle,
    read_facts,
    read_history,
)
from tauext.data.dataset import FILE_NAME as SPLIT
from tauext.data.dataset import Split
from tauext.data.labels import FILE_NAME as LABELS
from tauext.data.labels import Label, append_label, read_labels
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.errors import ConfigError, TauextError
from tauext.files.append_file import append_line, lock, read_lines, reserve, write_synced
from tauext.files.copies import version_of
from tauext.files.plain_file import FORMAT, json_of, read_text
from tauext.files.preflight import expect_folder
from tauext.files.provenance import write_json

# --- The index of recordings, from which split.json follows.


INDEX = "segments.jsonl"
JOIN_S = 0.1
"""Longest gap between two recordings that are one motion, [s]."""


@dataclass(frozen=True)
class Segment:
    """One recording of the folder."""

    name: str
    """Of its file."""
    number: int
    set: str
    """train, test or calibration; it never changes."""
    epoch: int
    from_ns: int
    to_ns: int
    seconds: float
    bytes: int

    @property
    def stem(self) -> str:
        return self.name.removesuffix(".parquet")


def up_to(segments: Sequence[Segment], seconds: float) -> list[Segment]:
    """The first of these recordings, until they last so long."""
    lasts = np.cumsum([one.seconds for one in segments])
    return list(segments[: int(np.searchsorted(lasts, seconds)) + 1])


def split_of(segments: Iterable[Segment]) -> Split:
    """The split of these recordings."""
    sets: dict[str, list[str]] = {"train": [], "test": [], "calibration": []}
    for one in segments:
        sets[one.set].append(one.name)
    return Split(tuple(sets["train"]), (), tuple(sets["test"]), calibration=tuple(sets["calibration"]))


# --- The folder.


LEAST_DISK = 1 << 26
"""Free space that a new folder needs, [bytes]."""


class CommissionFolder:
    """Paths and small files of one arm. The recorder alone writes the index, the trainer alone active.json and bundles;
    facts, labels, history and log may be written by both."""

    def __init__(self, path: Path):
        self.path = path
        self.bundles, self.results, self.flights = path / BUNDLES, path / RESULTS, path / "flights"
        self.history_file, self.events_file = path / HISTORY, path / EVENTS
        self.coverage_file, self.findings_file = path / "coverage.json", path / "findings.json"
        self.question_file, self.progress_file = path / "question.json", path / "trainer.json"
        self.pending_file = path / "pending.json"
        """The bundle that waits to be judged, and what it was trained on."""

    @classmethod
    def open(cls, path: Path, create: bool = False) -> CommissionFolder:
        """The folder of an arm.

        Args:
            create: make a new one where the path does not exist or is empty.

        Raises:
            ConfigError: it is no such folder, cannot be written, or holds something else.
        """
        folder = cls(path)
        if not (path / FACTS).is_file():
            if not create:
                raise ConfigError(f"{path}: is no folder of `tauext commission`; it has no {FACTS}")
            if path.exists() and (not path.is_dir() or any(path.iterdir())):
                raise ConfigError(f"{path}: is not empty and no folder of `tauext commission`; choose another --out")
            expect_folder(path, LEAST_DISK)
            try:
                path.mkdir(parents=True, exist_ok=True)
                write_synced(path / FACTS, json.dumps({"format": FORMAT, "created": wall(), "epoch": 0}) + "\n")
            except OSError as error:
                raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error
        read_facts(path)
        if create:
            try:
                for one in (folder.bundles, folder.results, folder.flights):
                    one.mkdir(exist_ok=True)
                (path / LABELS).touch()
            except OSError as error:
                raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error
            reserve(path)
        return folder

    def progress(self, doing: str, share: float = 0.0) -> None:
        """Show what the training process does; empty: nothing."""
        with suppress(OSError):
            write_json({"doing": doing, "share": round(share, 3)}, self.progress_file)

    @contextmanager
    def locked(self, name: str = "lock") -> Iterator[None]:
        """Hold the folder for one process; the system releases it when the process ends.

        Raises:
            ConfigError: another process holds it.
        """
        import fcntl

        with (self.path / name).open("a") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise ConfigError(f"{self.path}: another `tauext commission` uses this folder") from error
            yield

    # Facts.

    @property
    def facts(self) -> dict[str, Any]:
        """Content of commission.json."""
        return read_facts(self.path)

    def save(self, **changes: Any) -> None:
        """Change entries of commission.json; the new content is on the disk on return."""
        with (self.path / ".facts.lock").open("a") as file:
            lock(file.fileno())
            write_synced(self.path / FACTS, json.dumps(self.facts | changes, indent=1, allow_nan=False) + "\n")

    # Recordings.

    def segments(self) -> list[Segment]:
        """Recordings that exist, in order of their numbers."""
        index = self.path / INDEX
        there = {path.name for path in self.path.glob("seg-*.parquet")}
        return [one for one in _indexed(index, version_of(index)) if one.name in there] if index.is_file() else []

    def add_segment(self, segment: Segment) -> None:
        """Add a recording whose file is complete to the index."""
        append_line(self.path / INDEX, asdict(segment))

    def put_index(self, segments: Iterable[Segment]) -> None:
        """Replace the index; numbers are not given twice."""
        lines = [json.dumps({"number": int(self.next_segment().stem[4:]) - 1})]
        write_synced(self.path / INDEX, "\n".join([*lines, *(json.dumps(asdict(one)) for one in segments)]) + "\n")

    def put_split(self, segments: Iterable[Segment]) -> None:
        """Write split.json, so that the folder is a dataset."""
        content = {"format": FORMAT} | asdict(split_of(segments))
        write_synced(self.path / SPLIT, json.dumps(content, indent=1) + "\n")

    def next_segment(self) -> Path:
        """File of the next recording: a number that no earlier one had."""
        numbers = [int(path.stem[4:]) for path in self.path.glob("seg-*.parquet") if path.stem[4:].isdecimal()]
        numbers += [number for line in read_lines(self.path / INDEX) if isinstance(number := line.get("number"), int)]
        return self.path / f"seg-{max(numbers, default=0) + 1:06d}.parquet"

    def load(self, segments: Iterable[Segment]) -> list[Recording]:
        """Recordings with their labels, those that follow each other at once joined; one that was dropped meanwhile is
        left out."""
        runs: list[list[Recording]] = []
        last: Segment | None = None
        for one in segments:
            try:
                recording = load_recording(self.path / one.name)
            except TauextError:
                if (self.path / one.name).exists():
                    raise
                continue
            if last is not None and one.epoch == last.epoch and 0 < one.from_ns - last.to_ns < JOIN_S * 1e9:
                runs[-1].append(recording)
            else:
                runs.append([recording])
            last = one
        return [joined(run) for run in runs]

    # Labels, bundles, history, log.

    def append_label(self, label: Label) -> None:
        """Keep a label; it is on the disk on return."""
        append_label(self.path, label)

    def labels(self) -> tuple[Label, ...]:
        """The newest label of each id."""
        return read_labels(self.path)

    def active(self) -> Path | None:
        """File of the bundle in charge; None: none yet."""
        found = active_bundle(self.path)
        return None if found is None else Path(str(found))

    def activate(self, bundle: str, why: str, seconds: float, **facts: Any) -> None:
        """Put a bundle in charge: the loop takes it over. A later bundle of the same name is another activation."""
        old = self.active()
        replaced = None if old is None else old.stem
        content = {"format": FORMAT, "bundle": bundle, "replaces": replaced, "at": wall(), "why": why}
        write_synced(self.path / ACTIVE, json.dumps(content) + "\n")
        self.note("activation", seconds, f"{bundle} is chosen: {why}", bundle=bundle, replaces=replaced, **facts)

    def next_bundle(self) -> Path:
        """File of the next bundle."""
        numbers = [int(path.stem[1:]) for path in self.bundles.glob("b*.tauext") if path.stem[1:].isdecimal()]
        numbers += [int(str(one["bundle"])[1:]) for one in self.history() if str(one.get("bundle"))[1:].isdecimal()]
        return self.bundles / f"b{max(numbers, default=0) + 1:04d}.tauext"

    def history(self) -> list[dict[str, Any]]:
        """See read_history."""
        return read_history(self.path)

    def note(self, kind: str, seconds: float, words: str, **facts: Any) -> None:
        """Add a line to the history.

        Args:
            seconds: received samples up to then, [s].
            words: one sentence for a person.
        """
        line = {"kind": kind, "wall": wall(), "seconds": round(seconds, 3), "words": words} | facts
        append_line(self.history_file, line)
        self.log(words)

    def log(self, text: str) -> None:
        """Add a line to log.txt; a full disk loses it."""
        with suppress(OSError), (self.path / "log.txt").open("a", encoding="utf-8") as file:
            file.write(f"{wall()} {text}\n")

    def seconds(self) -> float:
        """Samples received so far, [s]: the clock of all decisions."""
        return float(self.coverage().get("seconds") or 0.0)

    def coverage(self) -> dict[str, Any]:
        """Content of coverage.json; empty before the first recording."""
        with suppress(OSError, ValueError):
            if isinstance(content := json_of(read_text(self.coverage_file)), dict):
                return content
        return {}


@lru_cache(maxsize=2)
def _indexed(index: Path, version: str) -> tuple[Segment, ...]:
    """Recordings in the index, in order of their numbers; it is read once a second, and changes seldom."""
    found: dict[str, Segment] = {}
    for line in read_lines(index):
        with suppress(TypeError):
            one = Segment(**line)
            found[one.name] = one
    return tuple(sorted(found.values(), key=lambda one: one.number))


def joined(recordings: list[Recording]) -> Recording:
    """Recordings that follow each other at once as one, under the first one's name."""
    first = recordings[0]
    if len(recordings) == 1:
        return first
    arrays: dict[str, Any] = {}
    for name in ("t_ns", "q", "dq", "tau", "temperature", "q_des", "current", "duty", "voltage", "contact"):
        parts = [getattr(one, name) for one in recordings]
        if all(part is not None for part in parts):
            arrays[name] = np.concatenate(parts)
    facts = {name: getattr(first, name) for name in ("joints", "rate_hz", "torque_timing", "source", "robot_sha256")}
    return Recording(name=first.name, provenance=first.provenance, **facts, **arrays)


def wall() -> str:
    """Date and time as every file of the folder states them, UTC."""
    return time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime())
