"""The files of a flight, written by a thread: recording, estimates, explanation."""

from __future__ import annotations

import csv
import os
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from types import TracebackType

import numpy as np

from tauext import _core
from tauext.bundle.estimates import save_estimates
from tauext.data.recording_file import save_recording
from tauext.data.servo import AMPERES
from tauext.errors import ConfigError, RecordingError, TauextError
from tauext.files.atomic_write import atomic_write
from tauext.files.provenance import VERSION
from tauext.monitor.explanation import explain
from tauext.monitor.flight_content import (
    Flight,
    FlightSource,
    as_estimates,
    as_recording,
    carried,
    event_kind,
    event_numbers,
    rows_kept,
)
from tauext.monitor.loads import load_facts

# --- A thread that writes flights to disk while samples continue.


POLL_S = 0.05
MOST_WAITING = 4
"""Most flights in memory before a replay waits for the disk."""


@dataclass(frozen=True)
class FlightNews:
    """A written flight, or the reason why it was not written."""

    what: str
    """collision, contact or fault."""
    t_ns: int
    """Time of the event."""
    path: Path | None
    error: str | None = None
    number: int = 0
    """Number of the alarm; 0: a fault."""


@dataclass
class FlightCount:
    """Number of flights that were written, failed or missed."""

    written: int = 0
    failed: int = 0
    missed: int = 0
    error: str = ""
    """Error of the first failed flight."""
    repeated: int = 0
    """Faults without a flight, since one with their causes was written in the minute before."""

    def add(self, news: FlightNews) -> None:
        """Count one more."""
        self.written += news.error is None
        self.failed += news.error is not None
        self.error = self.error or news.error or ""

    def merge(self, other: FlightCount) -> None:
        """Add another recording's."""
        self.repeated += other.repeated
        self.written, self.failed = self.written + other.written, self.failed + other.failed
        self.missed += other.missed
        self.error = self.error or other.error

    def summary(self) -> dict[str, int]:
        repeated = {"repeated": self.repeated} if self.repeated else {}
        return {"written": self.written, "failed": self.failed, "missed": self.missed} | repeated

    def expect_all_written(self) -> None:
        """Raise ConfigError if a flight could not be written."""
        if self.failed:
            raise ConfigError(f"{self.failed} of {self.failed + self.written} flights are lost: {self.error}")


@dataclass(frozen=True)
class FlightSettings:
    """Folder and length of flights."""

    folder: Path
    before_s: float
    after_s: float
    contacts: bool
    """Whether to write flights of contacts too."""

    def recorder(self, bundle: _core.Bundle) -> _core.FlightRecorder:
        """Make a new recorder and the folder.

        Raises:
            ConfigError: the folder cannot be created.
            CoreError: the recorder refuses the settings.
        """
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigError(f"{self.folder}: no folder for flights ({error.strerror or error})") from error
        period_ns = bundle.observer.sample_period_ns
        return _core.FlightRecorder(bundle.joints, period_ns, self.before_s, self.after_s, self.contacts)


class FlightWriter:
    """Takes flights from a recorder and writes them: `with FlightWriter(recorder, write) as writer: ...`.

    A flight that cannot be written is reported in news(), and the thread continues. Leaving the block takes the event
    that still waits for samples, writes everything and ends the thread; nothing is lost.
    """

    def __init__(
        self,
        recorder: _core.FlightRecorder,
        write: Callable[[Flight], Path],
        poll_s: float = POLL_S,
        fault_every_s: float = 0.0,
    ):
        """
        Args:
            write: writes one flight and returns its path; raises TauextError on failure.
            fault_every_s: least time between two flights of faults with the same causes; others are counted in
                `repeated`.
        """
        self.recorder, self._write, self._poll_s = recorder, write, poll_s
        self.repeated = 0
        self._fault_every_ns = round(fault_every_s * 1e9)
        self._faults: dict[str, int] = {}
        """Stamp of the newest written fault of each cause, [ns]."""
        self._waiting: deque[Flight] = deque()
        self._news: deque[FlightNews] = deque()
        self._taking = threading.Lock()
        self._wake = threading.Event()
        self._ended = threading.Event()
        self._broken: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="flight writer", daemon=True)

    def __enter__(self) -> FlightWriter:
        self._thread.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            self._take()
            self.recorder.finish()
            self._take()
        finally:
            self._ended.set()
            self._wake.set()
            self._thread.join()
        if self._broken is not None and error is None:
            raise self._broken

    def catch_up(self) -> None:
        """Take the finished flight and wait while too many are in memory; for replays, which may wait."""
        self._take()
        while self.waiting > MOST_WAITING and self._thread.is_alive():
            self._wake.set()
            self._thread.join(timeout=0.01)

    @property
    def waiting(self) -> int:
        """Number of flights not yet on disk."""
        return len(self._waiting)

    def news(self) -> list[FlightNews]:
        """Flights written or lost since the last call."""
        news = []
        while self._news:
            news.append(self._news.popleft())
        return news

    def _take(self) -> None:
        with self._taking:
            flight = self.recorder.take()
            if flight is not None:
                self._waiting.append(flight)
                self._wake.set()

    def _work(self) -> None:
        try:
            while True:
                ended = self._ended.is_set()
                self._wake.clear()
                self._take()
                while self._waiting:
                    if self._is_repeated(self._waiting[0]):
                        self.repeated += 1
                    else:
                        self._news.append(self._written(self._waiting[0]))
                    self._waiting.popleft()
                if ended:
                    return
                self._wake.wait(self._poll_s)
        except BaseException as broken:  # a bug: raised by the thread that waits for this one
            self._broken = broken

    def _is_repeated(self, flight: Flight) -> bool:
        """Whether it is a fault whose causes all had a flight just before."""
        if not self._fault_every_ns or event_kind(flight) != "fault":
            return False
        t_ns, causes = int(flight["event"].t_ns), list(flight["event"].causes)
        if causes and all(abs(t_ns - self._faults.get(one, -(1 << 62))) < self._fault_every_ns for one in causes):
            return True
        self._faults |= dict.fromkeys(causes, t_ns)
        return False

    def _written(self, flight: Flight) -> FlightNews:
        what, event = event_kind(flight), flight["event"]
        path, failed = None, None
        try:
            path = self._write(flight)
        except TauextError as error:
            failed = str(error)
        except Exception as error:  # a bug: reported now, and raised at the end; the thread goes on
            self._broken = self._broken or error
            failed = f"{type(error).__name__}: {error}"
        return FlightNews(what, int(event.t_ns), path, failed, 0 if what == "fault" else event.alarm_number)


# --- Files of a flight: recording, estimates and explanation; written atomically, never over existing files.


ENDINGS = (".txt", ".dropped.csv", ".estimates.parquet", ".parquet")
"""Endings in the order of writing: once FLIGHT.parquet exists, so do the others."""
PART = ".txt.part"


def write_flight(flight: Flight, folder: Path, source: FlightSource) -> Path:
    """Write FLIGHT.parquet, FLIGHT.estimates.parquet and FLIGHT.txt; returns the path of the first.

    FLIGHT is <recording>-<time of the event>s-<kind>, with a number appended if the name is taken. Samples that do not
    fit a recording are written to FLIGHT.dropped.csv. If none fits, there is no recording and no estimates, and the
    path is that of FLIGHT.txt.

    Args:
        folder: exists.

    Raises:
        RecordingError: a file cannot be written; the flight's other files are removed.
    """
    kept = rows_kept(flight)
    text = explain(flight, kept, source)
    event = event_numbers(flight, source)
    provenance = {
        "command": source.command,
        "version": VERSION,
        "recording": source.recording,
        "bundle": source.bundle.name,
        "event": event,
        "dropped_samples": int((~kept).sum()),
        "loads": [{"t_ns": int(flight["t_ns"][row])} | load_facts(load) for row, load in carried(flight)],
        "explanation": text,
    }
    if "A" in source.bundle.torque_units:
        provenance["torque"] = AMPERES
    wanted = f"{source.recording}-{event['time_s']:.3f}s-{event_kind(flight)}"
    try:
        base = reserve(folder, wanted)
        try:
            if not kept.all():
                write_dropped(flight, kept, source, with_ending(base, ".dropped.csv"))
            if kept.any():
                save_estimates(as_estimates(flight, kept, source), with_ending(base, ".estimates.parquet"))
                recording = as_recording(flight, kept, base.name, source, provenance)
            with_ending(base, PART).write_text(text + "\n", encoding="utf-8")
            os.replace(with_ending(base, PART), with_ending(base, ".txt"))
            if kept.any():
                save_recording(recording, with_ending(base, ".parquet"))
        except BaseException:
            for ending in (*ENDINGS, PART):
                with suppress(OSError):
                    with_ending(base, ending).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise RecordingError(f"{folder / wanted}: the flight cannot be written ({error.strerror or error})") from error
    return with_ending(base, ".parquet" if kept.any() else ".txt")


def with_ending(base: Path, ending: str) -> Path:
    """Path of a flight's file with this ending."""
    return base.with_name(base.name + ending)


def reserve(folder: Path, wanted: str) -> Path:
    """Reserve the wanted name, with a number appended if it exists or is being written.

    A file NAME.txt.part reserves the name.
    """
    for number in count(1):
        base = folder / (wanted if number == 1 else f"{wanted}-{number}")
        try:
            with_ending(base, PART).open("x").close()
        except FileExistsError:
            continue
        if not any(with_ending(base, ending).exists() for ending in ENDINGS):
            break
        with_ending(base, PART).unlink()
    return base


def write_dropped(flight: Flight, kept: np.ndarray, source: FlightSource, path: Path) -> None:
    """Write all samples that do not fit the recording, with the monitor's health."""
    with atomic_write(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        signals = [f"{signal}_{joint}" for signal in ("q", "dq", "tau") for joint in source.joints]
        table.writerow(["row", "t_ns", *signals, "health", "causes"])
        for row in np.flatnonzero(~kept).tolist():
            values = [float(value) for signal in ("q", "dq", "tau") for value in flight[signal][row]]
            flags = [int(flight["health"][row]), int(flight["causes"][row])]
            table.writerow([row, int(flight["t_ns"][row]), *values, *flags])
