"""A recording as a live source, for trying out a live loop without an arm."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.data.servo import RAW_SIGNALS, from_amperes, in_amperes, servo_of
from tauext.errors import ConfigError
from tauext.monitor.source import Block, Sample, Signal, SourceCounts, SourceFacts, SourceSettings


class Pace:
    """Delays samples to their times: the recording runs `speed` times as fast as it was recorded.

    A late replay does not wait until it has caught up. Times that go backwards cause no wait.
    """

    def __init__(
        self,
        speed: float | None,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ):
        """speed: None for no delay. clock and sleep count in seconds."""
        self.speed = speed
        self._clock, self._sleep = clock, sleep
        self._began: tuple[float, int] | None = None

    def wait_until(self, t_ns: int) -> None:
        """Wait until the time of this stamp; the first call starts the clock and does not wait."""
        left_s = self.left_s(t_ns)
        if left_s > 0:
            self._sleep(left_s)

    def left_s(self, t_ns: int) -> float:
        """Wall time until this stamp, [s]; 0 or negative if it has passed. The first call starts the clock."""
        if self.speed is None:
            return 0.0
        if self._began is None:
            self._began = (self._clock(), t_ns)
        clock_s, first_ns = self._began
        return clock_s + (t_ns - first_ns) * 1e-9 / self.speed - self._clock()

    def late_s(self, t_ns: np.ndarray) -> np.ndarray:
        """Wall time since each of the first of these stamps whose time has come, at least one, [s]."""
        if self.speed is None or self._began is None:
            return np.zeros(len(t_ns))
        clock_s, first_ns = self._began
        late_s = self._clock() - clock_s - (t_ns - first_ns) * 1e-9 / self.speed
        rows = max(1, min([len(t_ns), *np.flatnonzero(late_s < 0)[:1].tolist()]))
        return np.maximum(late_s[:rows], 0.0)


class ReplaySource:
    """Delivers a recording's samples at their times. A late loop finds them waiting; none is lost."""

    def __init__(self, recording: Recording | Path | str, speed: float | None = 1.0, is_made: bool = False):
        """
        Args:
            speed: factor on the recorded speed; None: as fast as the loop takes the samples.
            is_made: see Recorded.

        Raises:
            RecordingError: the file is missing or damaged.
        """
        self.recording = recording if isinstance(recording, Recording) else load_recording(recording)
        self.name = f"replay {self.recording.name}"
        self.counts, self.is_made = SourceCounts(), is_made
        self._next, self._stopped, self._pace = 0, False, Pace(speed)

    def describe(self, wait_s: float, robot: Path | None = None) -> SourceFacts:
        recording = self.recording
        units = ("A" if in_amperes([recording]) else "N m",) * len(recording.joints)
        made = recording.provenance.get("servo")
        servo = servo_of(made) if made else None
        signal: Signal = "torque" if units[0] == "N m" and not from_amperes([recording]) else "current"
        if servo is not None and servo.torque_from.name in ("duty", "goal"):
            signal = "duty" if servo.torque_from.name == "duty" else "goal"
        settings = SourceSettings(
            recording.joints, round(1e9 / recording.rate_hz), units, recording.torque_timing, servo
        )
        return SourceFacts(settings, signal, recording.temperature is not None)

    def open(self, settings: SourceSettings) -> None:
        """Refuse a recording of another arm or another rate."""
        recording = self.recording
        if recording.joints != settings.joints:
            raise ConfigError(
                f"{self.name} has joints {', '.join(recording.joints)}, the bundle {', '.join(settings.joints)}"
            )
        if abs(recording.rate_hz * settings.period_ns * 1e-9 - 1) > settings.rate_tolerance:
            raise ConfigError(f"{self.name} has {recording.rate_hz:g} Hz, the bundle {1e9 / settings.period_ns:g} Hz")

    def next_sample(self, timeout_s: float) -> Sample | None:
        block = self.next_block(timeout_s, 1)
        return None if block is None else block.sample(0)

    def next_block(self, timeout_s: float, most_rows: int) -> Block | None:
        if self.ended:
            return None
        t_ns = self.recording.t_ns[self._next : self._next + most_rows]
        left_s = self._pace.left_s(int(t_ns[0]))
        if left_s > timeout_s:
            time.sleep(timeout_s)
            return None
        self._pace.wait_until(int(t_ns[0]))
        late_s = self._pace.late_s(t_ns)
        rows = slice(self._next, self._next + len(late_s))
        self._next = rows.stop
        self.counts.received += len(late_s)
        received_ns = time.monotonic_ns() - np.round(late_s * 1e9).astype(np.int64)  # they have waited here since then
        return self._rows(rows, received_ns)

    def _rows(self, rows: slice, received_ns: np.ndarray) -> Block:
        recording = self.recording
        optional = {
            name: values[rows]
            for name in ("temperature", *(() if self.is_made else RAW_SIGNALS))
            if (values := getattr(recording, name, None)) is not None
        }
        signals = (recording.t_ns[rows], recording.q[rows], recording.dq[rows], recording.tau[rows])
        return Block(*signals, received_ns, **optional)

    @property
    def ended(self) -> bool:
        return self._stopped or self._next == len(self.recording.t_ns)

    def notes(self) -> list[str]:
        return []

    def stop(self) -> None:
        """Stop the replayed arm: no further samples."""
        self._stopped = True

    def close(self) -> None:
        self._stopped = True
