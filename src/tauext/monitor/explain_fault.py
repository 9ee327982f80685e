"""Says in words what a fault is, what the signals were there, and what was known until then."""

from __future__ import annotations

import numpy as np

from tauext.bundle.units import short
from tauext.monitor.causes import MEANING
from tauext.monitor.explain_alarm import loads
from tauext.monitor.flight_content import Flight, FlightSource
from tauext.monitor.readable import readable


def fault_causes(flight: Flight) -> list[str]:
    """What each cause means."""
    return [f"{name.capitalize()}: {MEANING.get(name, 'unknown')}." for name in flight["event"].causes]


def fault_sample(flight: Flight, source: FlightSource) -> str:
    """The joint's signals at the fault and at the sample before it."""
    event, row = flight["event"], flight["event_row"]
    if event.cause_joint < 0:
        steps_ms = (flight["t_ns"][row] - flight["t_ns"][row - 1]) * 1e-6 if row else None
        return f"The sample came {steps_ms:+.3f} ms after the one before it." if row else ""
    text = f"{source.joints[event.cause_joint]} there: {signals(flight, row, event.cause_joint, source)}"
    return text + (f"; one sample before: {signals(flight, row - 1, event.cause_joint, source)}." if row else ".")


def signals(flight: Flight, row: int, joint: int, source: FlightSource) -> str:
    """Position, velocity and torque of one joint."""
    q, dq, tau = (flight[name][row, joint] for name in ("q", "dq", "tau"))
    unit = short(source.torque_units[joint]) if source.torque_units else "Nm"
    told = f"q = {readable(q, '.5f')} rad, dq = {readable(dq, '+.4f')} rad/s, tau = {readable(tau, '+.3f')}"
    return f"{told} {unit}"


def last_estimate(flight: Flight, source: FlightSource) -> str:
    """The newest tau_ext up to the fault."""
    known = np.flatnonzero(np.isfinite(flight["tau_ext"][: flight["event_row"] + 1]).all(axis=1))
    if len(known) == 0:
        return "There is no estimate of tau_ext up to the fault in this flight."
    row = int(known[-1])
    ms = (flight["t_ns"][flight["event_row"]] - flight["t_ns"][row]) * 1e-6
    when = "At the fault" if row == flight["event_row"] else f"Last estimate, {ms:.1f} ms before"
    return f"{when}: {loads(flight, row, source, range(len(source.joints)))}."
