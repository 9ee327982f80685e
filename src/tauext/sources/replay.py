"""A recording as a live source, for trying out a live loop without an arm."""

from __future__ import annotations

import time
from pathlib import Path

from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.data.servo import RAW_SIGNALS, from_amperes, in_amperes, servo_of
from tauext.errors import ConfigError
from tauext.monitor.replay import Pace
from tauext.monitor.source import Sample, Signal, SourceCounts, SourceFacts, SourceSettings


class ReplaySource:
    """Delivers a recording's samples at their times. A late loop finds them waiting; none is lost."""

    def __init__(self, recording: Recording | Path | str, speed: float | None = 1.0):
        """speed: factor on the recorded speed; None: as fast as the loop takes the samples.

        Raises:
            RecordingError: the file is missing or damaged.
        """
        self.recording = recording if isinstance(recording, Recording) else load_recording(recording)
        self.name = f"replay {self.recording.name}"
        self.counts = SourceCounts()
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
        if self.ended:
            return None
        k, recording = self._next, self.recording
        t_ns = int(recording.t_ns[k])
        if self._pace.left_s(t_ns) > timeout_s:
            time.sleep(timeout_s)
            return None
        self._pace.wait_until(t_ns)
        self._next += 1
        self.counts.received += 1
        optional = {
            name: values[k]
            for name in ("temperature", *RAW_SIGNALS)
            if (values := getattr(recording, name)) is not None
        }
        received_ns = time.monotonic_ns()
        return Sample(t_ns, recording.q[k], recording.dq[k], recording.tau[k], received_ns, **optional)

    @property
    def ended(self) -> bool:
        return self._stopped or self._next == self.recording.samples

    def notes(self) -> list[str]:
        return []

    def stop(self) -> None:
        """Stop the replayed arm: no further samples."""
        self._stopped = True

    def close(self) -> None:
        self._stopped = True
