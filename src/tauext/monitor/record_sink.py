"""Recordings and flights of a live arm, written while the loop runs."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np

from tauext import _core
from tauext.bundle.estimates import NONE, OK, lacking
from tauext.data.recording import Recording, TorqueTiming
from tauext.data.recording_file import save_recording
from tauext.data.servo import AMPERES, RAW_SIGNALS, servo_facts
from tauext.errors import ConfigError, TauextError
from tauext.files.preflight import LEAST_ROOM, expect_folder
from tauext.files.provenance import VERSION
from tauext.monitor.background import BackgroundWorker
from tauext.monitor.flight_content import Flight, FlightSource, event_kind
from tauext.monitor.flight_files import FlightNews, write_flight
from tauext.monitor.sink import Control, LoopReport, Verdict
from tauext.monitor.source import SourceSettings

# --- Recordings of a live arm, for retraining.


MOST_WAITING = 4
"""Most segments in memory beside the one being written; further ones are lost and counted."""


@dataclass
class RecordCount:
    """Counts of samples."""

    files: int = 0
    samples: int = 0  # on disk
    unfit: int = 0  # not finite, or not newer than the sample before
    lost: int = 0  # in segments that could not be written
    error: str = ""  # error of the first segment that could not be written


class RecordSink:
    """Writes NAME-0001.parquet, NAME-0002.parquet, ... of segment_s each; never overwrites files.

    `contact` follows the monitor: 1 during an alarm or a declared contact, 0 while healthy without either, else -1
    (unknown). Training uses samples with 0, with margins around 1. Torques are in the unit of the source. The loop
    copies each sample; a thread writes. A new segment begins after a gap, and where the clock of the source starts
    again.
    """

    gap_ns = 1_000_000_000
    """Shortest gap of stamps that begins a new segment, [ns]."""

    def __init__(
        self,
        folder: Path,
        arm: SourceSettings,
        source: str,
        segment_s: float = 25.0,
        bundle_name: Callable[[], str] = lambda: "",
        is_expected: bool = True,
    ):
        """source: name of the source, for file names and provenance. bundle_name: name of the bundle that monitors.
        is_expected: whether a folder without write access or space is refused; else its recordings are lost."""
        if is_expected:
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise ConfigError(f"{folder}: no folder for recordings ({error.strerror or error})") from error
            expect_folder(folder, LEAST_ROOM)
        self.is_losing = False
        """Whether the newest recording could not be written."""
        self._reported = self._lost_at_end = 0
        self._folder, self._arm, self._source, self._bundle_name = folder, arm, source, bundle_name
        self._stem = f"{file_name(source)}-{time.strftime('%Y%m%dT%H%M%S')}"
        self._names: tuple[str, ...] = ()
        self._row: int
        self._warm: np.ndarray | None = None
        self._t_ns: np.ndarray
        self._contact: np.ndarray
        self._signals: list[np.ndarray]
        self._rows = max(2, round(segment_s * 1e9 / arm.period_ns))
        self._number = 0
        self._late_ns: int | None = None
        """Stamp of a sample older than the one before; the clock started again if the next one follows it."""
        self.count = RecordCount()
        self.worker = BackgroundWorker("recording", MOST_WAITING)
        """Writes segments."""

    def open(self, joints: tuple[str, ...], control: Control) -> None:
        self._joints, self._control = joints, control
        self._begin()
        self.worker.start()

    def verdict(self, verdict: Verdict) -> None:
        if (block := verdict.block) is None:
            return
        if not self._names:  # the other signals of the source, taken from its first sample
            measured = [name for name in RAW_SIGNALS if getattr(block, name) is not None]
            if block.temperature is not None:
                self._warm = block.temperature[0]
                measured += ["temperature"] * bool(np.isfinite(self._warm).all())
            self._names = ("q", "dq", "tau", *measured)
            self._begin()
        estimates = verdict.estimates
        touched, is_ok = (estimates["alarm"] != NONE) | (estimates["declared"] != 0), estimates["health"] == OK
        contact = np.where(touched, 1, np.where(is_ok, 0, -1)).tolist()
        for row, t_ns in enumerate(block.t_ns.tolist()):
            signals = [None if (one := getattr(block, name)) is None else one[row] for name in self._names]
            self._add(t_ns, signals, contact[row])

    def _add(self, t_ns: int, signals: list[Any], contact: int) -> None:
        """Keep one sample, if it is usable. signals: None: not measured."""
        k = self._row
        if self._names[-1] == "temperature" and signals[-1] is not None:  # measured seldom: the last value holds
            signals[-1] = self._warm = np.array(np.where(np.isfinite(signals[-1]), signals[-1], self._warm))
        if any(values is None for values in signals) or not all(np.isfinite(values).all() for values in signals):
            self.count.unfit += 1
            return
        if k and t_ns <= self._t_ns[k - 1]:
            if self._late_ns is None or t_ns <= self._late_ns:
                self._late_ns = t_ns
                self.count.unfit += 1
                return
            self._hand_over()
            self._clock_restarted()
            k = 0
        self._late_ns = None
        if k == self._rows or (k and t_ns - self._t_ns[k - 1] > self.gap_ns):
            self._hand_over()
            k = 0
        self._t_ns[k], self._contact[k] = t_ns, contact
        for values, kept in zip(signals, self._signals, strict=True):
            kept[k] = values
        self._row = k + 1

    def every_second(self, report: LoopReport) -> None:
        lost = self.count.lost
        if lost > self._reported:
            self._reported = lost
            remedy = "; recording goes on by itself once the disk has room and can be written" if self.is_losing else ""
            self._control.note(f"RECORDING LOSES SAMPLES: {lost:,} so far ({self.count.error}){remedy}")
        elif self._reported > self._lost_at_end and not self.is_losing:
            self._lost_at_end = self._reported
            self._control.note(f"recording works again; {lost:,} samples were lost so far")

    def loss(self) -> str:
        """See Losing."""
        lost, of = self.count.lost, self.count.lost + self.count.samples
        return f"{lost} of {of} samples of the recording are lost: {self.count.error}" if lost else ""

    def close(self) -> None:
        """Write the remaining samples and wait for the disk."""
        self._hand_over(last=True)
        self.worker.end()

    def _clock_restarted(self) -> None:
        """Called in the loop's thread before the first sample of the new clock."""

    def _begin(self) -> None:
        self._row, shape = 0, (self._rows, len(self._joints))
        self._t_ns, self._contact = np.zeros(self._rows, dtype=np.int64), np.zeros(self._rows, dtype=np.int8)
        self._signals = [np.zeros(shape) for _ in self._names]

    def _hand_over(self, last: bool = False) -> None:
        k = self._row
        signals = {name: kept[:k] for name, kept in zip(self._names, self._signals, strict=True)}
        segment = {"t_ns": self._t_ns[:k], "contact": self._contact[:k]} | signals
        if k < 2:
            self.count.unfit += k
        elif not self.worker.put(partial(self._write, segment), must=last):
            self.count.lost += k
            self.count.error = self.count.error or "the disk was too slow"
        if not last:
            self._begin()

    def _write(self, segment: dict[str, np.ndarray]) -> None:
        while True:
            self._number += 1
            path = self._folder / f"{self._stem}-{self._number:04d}.parquet"
            if not path.exists():
                break
        self._save(segment, path, {"command": "tauext monitor", "contact": "the monitor's own word"})

    def _save(self, segment: dict[str, np.ndarray], path: Path, facts: dict[str, Any]) -> Recording | None:
        """Write a segment; None where that failed, which is counted."""
        arm = self._arm
        provenance = {"version": VERSION, "bundle": self._bundle_name(), "source": self._source} | facts
        if "A" in arm.torque_units:
            provenance["torque"] = AMPERES
        if arm.servo is not None and arm.servo.on:
            provenance["servo"] = servo_facts(arm.servo)
        try:
            recording = Recording(
                name=path.stem,
                joints=self._joints,
                rate_hz=1e9 / arm.period_ns,
                torque_timing=cast(TorqueTiming, arm.torque_timing),
                source=self._source,
                robot_sha256="",
                provenance=provenance,
                **segment,
            )
            save_recording(recording, path)
        except Exception as error:  # continue with the next segment
            self._lose(segment, str(error))
            return None
        self.is_losing = False
        self.count.files += 1
        self.count.samples += recording.samples
        return recording

    def _lose(self, segment: dict[str, np.ndarray], why: str) -> None:
        """Count a segment that cannot be written."""
        self.is_losing = True
        self.count.lost += len(segment["t_ns"])
        self.count.error = self.count.error or why


def file_name(text: str) -> str:
    """The text as part of a file's name: letters, digits, dots and dashes."""
    return "".join(c if c.isalnum() or c in ".-" else "-" for c in text).strip("-.") or "live"


# --- Flights, written by a thread while the loop runs.


class FlightSink:
    """Writes the flights of a recorder that the loop fills.

    A flight that cannot be written is reported in news(), and the thread continues. close() takes the event that still
    waits for samples: nothing is lost.
    """

    def __init__(
        self,
        folder: Path,
        bundle: _core.Bundle | None,
        recorder: _core.FlightRecorder,
        source: str | FlightSource,
        poll_s: float = 0.05,
        fault_every_s: float = 60.0,
        most_waiting: int = 4,
    ):
        """
        Args:
            folder: exists.
            bundle: None: none monitors yet, and flights are lost.
            source: name of a live source, for file names; or a recording, whose replay waits for the disk.
            poll_s: time between two looks for a finished flight of a live source, [s].
            fault_every_s: least time between two flights of a live source's faults with the same causes, [s]: a busy
                computer makes hundreds of gaps an hour. Others are counted in `repeated`.
            most_waiting: most flights of a recording in memory.
        """
        self._of_recording = isinstance(source, FlightSource)
        self.recorder, self.repeated = recorder, 0
        self._folder, self._bundle = folder, bundle
        self._name = file_name(source) if isinstance(source, str) else ""
        self._source = source if isinstance(source, FlightSource) else None
        self._poll_s, self._due_s = poll_s, 0.0
        self._fault_every_ns = 0 if self._of_recording else round(fault_every_s * 1e9)
        self._faults: dict[str, int] = {}
        """Stamp of the newest written fault of each cause, [ns]."""
        self._news: deque[FlightNews] = deque()
        self._broken: Exception | None = None
        self.worker = BackgroundWorker("flight writer", most_waiting)
        self.worker.patient = self._of_recording

    def open(self, joints: tuple[str, ...], control: Control) -> None:
        self._joints = joints
        self.worker.start()

    def follow(self, bundle: _core.Bundle, monitor: _core.Monitor) -> None:
        """The next flights are this bundle's."""
        if not self._of_recording:
            self._bundle, self._source = bundle, None

    def verdict(self, verdict: Verdict) -> None:
        if self._of_recording:  # before the next event of a fast replay
            if (flight := self.recorder.take()) is not None:
                self.worker.put(partial(self._write, flight))
            return
        if self._source is None and self._bundle is not None:
            self._source = self._live_source(self._bundle, int(verdict.t_ns[0]))
        now_s = time.monotonic()
        if now_s >= self._due_s and self.worker.put(self._take):
            self._due_s = now_s + self._poll_s

    def every_second(self, report: LoopReport) -> None:
        pass

    def close(self) -> None:
        """Finish: everything is on disk or reported as lost."""
        for act in (self._take, self.recorder.finish, self._take):
            self.worker.put(act, must=True)
        self.worker.end()
        if self._broken is not None:
            raise self._broken

    def news(self) -> list[FlightNews]:
        """Flights written or lost since the last call."""
        return [self._news.popleft() for _ in range(len(self._news))]

    def _live_source(self, bundle: _core.Bundle, start_ns: int) -> FlightSource:
        made = bundle.observer
        of_arm = (self._joints, start_ns, 1e9 / made.sample_period_ns, cast(TorqueTiming, made.timing.name))
        return FlightSource(bundle, self._name, *of_arm, lacking(bundle), command="tauext monitor")

    def _take(self) -> None:
        if (flight := self.recorder.take()) is not None:
            self._write(flight)

    def _write(self, flight: Flight) -> None:
        if self._is_repeated(flight):
            self.repeated += 1
            return
        what, event = event_kind(flight), flight["event"]
        path, failed = None, None
        try:
            if self._source is None:
                raise ConfigError("no bundle monitored yet, so this event log has no estimates")
            path = write_flight(flight, self._folder, self._source)
        except TauextError as error:
            failed = str(error)
        except Exception as error:  # a bug: reported now, and raised at the end; the thread goes on
            self._broken = self._broken or error
            failed = f"{type(error).__name__}: {error}"
        number = 0 if what == "fault" else event.alarm_number
        self._news.append(FlightNews(what, int(event.t_ns), path, failed, number))

    def _is_repeated(self, flight: Flight) -> bool:
        """Whether it is a fault whose causes all had a flight just before."""
        if not self._fault_every_ns or event_kind(flight) != "fault":
            return False
        t_ns, causes = int(flight["event"].t_ns), list(flight["event"].causes)
        if causes and all(abs(t_ns - self._faults.get(one, -(1 << 62))) < self._fault_every_ns for one in causes):
            return True
        self._faults |= dict.fromkeys(causes, t_ns)
        return False
