"""The files of a flight: recording, estimates, explanation."""

from __future__ import annotations

import csv
import os
from contextlib import suppress
from dataclasses import dataclass
from itertools import count
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.bundle.estimates import save_estimates
from tauext.data.recording_file import save_recording
from tauext.data.servo import AMPERES
from tauext.errors import ConfigError, RecordingError
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

# --- Flights that were asked for, and what became of them.


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
        """Count one more flight."""
        self.written += news.error is None
        self.failed += news.error is not None
        self.error = self.error or news.error or ""

    def merge(self, other: FlightCount) -> None:
        """Add the counts of another recording."""
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
            raise ConfigError(f"{self.failed} of {self.failed + self.written} event logs are lost: {self.error}")


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
            raise ConfigError(f"{self.folder}: no folder for event logs ({error.strerror or error})") from error
        period_ns = bundle.observer.sample_period_ns
        return _core.FlightRecorder(bundle.joints, period_ns, self.before_s, self.after_s, self.contacts)


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
        raise RecordingError(
            f"{folder / wanted}: the event log cannot be written ({error.strerror or error})"
        ) from error
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
