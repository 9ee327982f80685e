"""Flights of a live arm: written by a thread while the loop goes on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

import numpy as np

from tauext import _core
from tauext.data.recording import TorqueTiming
from tauext.monitor.flight_content import Flight
from tauext.monitor.flight_files import FlightSource, write_flight
from tauext.monitor.flight_writer import FlightNews, FlightWriter
from tauext.monitor.record_sink import file_name
from tauext.monitor.sink import Control, LoopReport, Verdict


@dataclass(frozen=True)
class Origin:
    """What a flight's files say of where it comes from, as a recording would."""

    name: str
    joints: tuple[str, ...]
    t_ns: np.ndarray
    rate_hz: float
    torque_timing: TorqueTiming
    robot_sha256: str = ""


class FlightSink:
    """Writes the flights of a recorder that the loop fills."""

    def __init__(self, folder: Path, bundle: _core.Bundle, recorder: _core.FlightRecorder, source: str):
        """folder: exists. source: its name, for the files'."""
        self.recorder = recorder
        self._folder, self._bundle, self._name = folder, bundle, file_name(source)
        self._source: FlightSource | None = None
        self._writer = FlightWriter(recorder, self._write)

    def open(self, joints: tuple[str, ...], control: Control) -> None:
        self._joints = joints
        self._writer.__enter__()

    def verdict(self, verdict: Verdict) -> None:
        if self._source is None:
            timing = cast(TorqueTiming, self._bundle.observer.timing.name)
            rate_hz = 1e9 / self._bundle.observer.sample_period_ns
            first = Origin(self._name, self._joints, np.array([verdict.t_ns]), rate_hz, timing)
            self._source = replace(FlightSource.of(self._bundle, first), command="tauext monitor")

    def every_second(self, report: LoopReport) -> None:
        pass

    def close(self) -> None:
        """Everything is on disk, or told as lost."""
        self._writer.__exit__(None, None, None)

    def news(self) -> list[FlightNews]:
        """What became of flights since the last call."""
        return self._writer.news()

    def _write(self, flight: Flight) -> Path:
        assert self._source is not None  # a flight comes after a verdict
        return write_flight(flight, self._folder, self._source)
