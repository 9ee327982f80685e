"""Convert a flight of the core to a recording and estimates; samples that do not fit a recording are left out."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tauext import _core
from tauext.bundle.estimates import ALARMS, COLLISION, FAULT, Estimates, estimate_facts, lacking, number
from tauext.bundle.units import short
from tauext.data.recording import RATE_TOLERANCE, Recording, TorqueTiming, fitted_period_ns

Flight = dict[str, Any]
"""Result of FlightRecorder.take."""


@dataclass(frozen=True)
class FlightSource:
    """Origin of flights, stated in their files beside the samples."""

    bundle: _core.Bundle = field(repr=False, compare=False)
    recording: str
    """Name of the recording or of the live source."""
    joints: tuple[str, ...]
    start_ns: int
    """Stamp of the very first sample, [ns]; event times count from it."""
    rate_hz: float
    torque_timing: TorqueTiming
    lacking: frozenset[str]
    """Columns of the estimates that the bundle does not have."""
    robot_sha256: str = ""
    command: str = "tauext run"
    """Command that runs the monitor, for provenance."""

    @classmethod
    def of(cls, bundle: _core.Bundle, recording: Recording) -> FlightSource:
        """Make the origin for a replay of this recording."""
        r = recording
        start_ns, without = int(r.t_ns[0]), lacking(bundle)
        return cls(bundle, r.name, r.joints, start_ns, r.rate_hz, r.torque_timing, without, r.robot_sha256)

    @property
    def has_error_scale(self) -> bool:
        return "sigma_nm" not in self.lacking

    def unit(self, joint: int) -> str:
        """Unit of the joint's estimate, in its short form."""
        return short(self.bundle.estimate_units[joint])

    def time_s(self, t_ns: int) -> float:
        """Time from the start, [s]."""
        return (t_ns - self.start_ns) * 1e-9


def event_kind(flight: Flight) -> str:
    """Kind of event that triggered the flight: `collision`, `contact` or `fault`.

    If an alarm and a fault share one sample, a collision precedes the fault, and the fault a contact.
    """
    event, row = flight["event"], flight["event_row"]
    alarm, health = int(flight["alarm"][row]), flight["health"]
    raised = alarm > 0 and event.alarm_t_ns == event.t_ns  # also one that was acknowledged and raised again at once
    broke = health[row] == FAULT and (row == 0 or health[row - 1] != FAULT)
    return ALARMS[alarm] if raised and (alarm == COLLISION or not broke) else "fault"


def rows_kept(flight: Flight) -> np.ndarray:
    """Samples that fit a recording, (samples,) bool: all values finite, and later than every one kept before."""
    kept = np.all([np.isfinite(flight[signal]).all(axis=1) for signal in ("q", "dq", "tau")], axis=0)
    t_ns = flight["t_ns"][kept]
    if len(t_ns):
        kept[np.flatnonzero(kept)[1:]] = t_ns[1:] > np.maximum.accumulate(t_ns)[:-1]
    return kept


def flight_rate_hz(t_ns: np.ndarray, nominal_hz: float) -> float:
    """Nominal rate, or that of the fitted period if the stamps disagree."""
    if len(t_ns) < 2:
        return nominal_hz
    measured_hz = 1e9 / fitted_period_ns(t_ns)
    return nominal_hz if abs(nominal_hz / measured_hz - 1) <= RATE_TOLERANCE else measured_hz


def as_recording(
    flight: Flight, kept: np.ndarray, name: str, source: FlightSource, provenance: dict[str, Any]
) -> Recording:
    """Make a recording of the kept samples, at least one."""
    t_ns = flight["t_ns"][kept]
    return Recording(
        name=name,
        joints=source.joints,
        t_ns=t_ns,
        q=flight["q"][kept],
        dq=flight["dq"][kept],
        tau=flight["tau"][kept],
        rate_hz=flight_rate_hz(t_ns, source.rate_hz),
        torque_timing=source.torque_timing,
        source="flight recorder",
        robot_sha256=source.robot_sha256,
        provenance=provenance,
    )


def as_estimates(flight: Flight, kept: np.ndarray, source: FlightSource) -> Estimates:
    """Estimates at the kept samples."""
    return Estimates.of(source.joints, flight["t_ns"][kept], flight, source.lacking, kept)


def carried(flight: Flight) -> list[tuple[int, _core.Load]]:
    """Load at the flight's first sample and at each later change."""
    rows = flight["load"]
    changed = np.flatnonzero(np.any(rows[1:] != rows[:-1], axis=1)) + 1
    return [
        (row, _core.Load(rows[row, 0], rows[row, 1:4].tolist(), rows[row, 4:].tolist()))
        for row in (0, *changed.tolist())
    ]


def event_numbers(flight: Flight, source: FlightSource) -> dict[str, Any]:
    """The estimate at the event, as plain JSON: a list has a value a joint, null where none exists."""
    event, row = flight["event"], flight["event_row"]

    def name(joint: int) -> str | None:
        return source.joints[joint] if joint >= 0 else None

    what = event_kind(flight)
    return {
        "what": what,
        "t_ns": int(event.t_ns),
        "time_s": source.time_s(event.t_ns),
        "joint": name(event.cause_joint if what == "fault" else event.alarm_joint),
        **estimate_facts(lambda of: getattr(getattr(event, of), "value", getattr(event, of)), event.causes),
        "number": event.alarm_number,
        "alarm_joint": name(event.alarm_joint),
        "dq_rad_s": [number(value) for value in flight["dq"][row]],
        "tau": [number(value) for value in flight["tau"][row]],
        "torque_units": list(source.bundle.torque_units),
        "estimate_units": list(source.bundle.estimate_units),
    }
