"""Says in words what a flight shows: what happened, when, on which joint, by how much over which limit, and before."""

from __future__ import annotations

from itertools import groupby

import numpy as np

from tauext import _core
from tauext.bundle.estimates import HEALTHS
from tauext.monitor.causes import in_words
from tauext.monitor.changes import CONTACT, FAULT, NONE
from tauext.monitor.explain_alarm import (
    doubt,
    kind_of_touch,
    limits_of,
    others,
    over_limit,
    place_of_touch,
    sum_of_terms,
    unfamiliar,
)
from tauext.monitor.explain_fault import fault_causes, fault_sample, last_estimate
from tauext.monitor.fits_load import fits_load
from tauext.monitor.flight_content import Flight, FlightSource, carried, event_kind
from tauext.monitor.loads import load_words

MOST_HEALTHS = 5
MOST_SAMPLES_TOLD = 10


def explain(flight: Flight, kept: np.ndarray, source: FlightSource) -> str:
    """A paragraph a line, from the headline to what the files leave out.

    Args:
        kept: samples that the flight's recording holds, (samples,) bool.
    """
    kind = event_kind(flight)
    lines = [headline(flight, source, kind)]
    if kind == "fault":
        lines += [*fault_causes(flight), fault_sample(flight, source), last_estimate(flight, source)]
    else:
        lines += [
            over_limit(flight, source, kind),
            kind_of_touch(flight),
            place_of_touch(flight, source),
            sum_of_terms(flight, source),
            unfamiliar(flight, source),
            doubt(flight),
        ]
    lines += [
        load_told(flight, source),
        fits_load(flight, kept, source),
        others(flight, source, kind),
        before(flight),
        standing_alarm(flight, source),
        after(flight, source, kind),
    ]
    lines += left_out(flight, kept, source)
    return "\n".join(line for line in lines if line)


def headline(flight: Flight, source: FlightSource, kind: str) -> str:
    """What, where and when."""
    event = flight["event"]
    when = f"{source.time_s(event.t_ns):.3f} s after the start of {source.recording} (t_ns = {event.t_ns})"
    if kind != "fault":
        return f"{kind.capitalize()} on joint {source.joints[event.alarm_joint]}, {when}."
    where = f", first on joint {source.joints[event.cause_joint]}" if event.cause_joint >= 0 else ""
    return f"Fault ({in_words(event.causes)}){where}, {when}."


def load_told(flight: Flight, source: FlightSource) -> str:
    """What the arm was taken to carry, and when that changed; nothing where it never carried anything."""
    told = carried(flight)
    if all(load.mass == 0 for _, load in told):
        return ""
    text = f"The arm was taken to carry {load_words(told[0][1], source.load_frame)}"
    for row, load in told[1:]:
        since_s = (flight["t_ns"][row] - flight["t_ns"][flight["event_row"]]) * 1e-9
        when = f"{abs(since_s):.3f} s {'before' if since_s < 0 else 'after'} it"
        text += f", from {when} on {load_words(load, source.load_frame)}"
    return f"{text}."


def before(flight: Flight) -> str:
    """Health over the samples before the event, oldest first."""
    row = flight["event_row"]
    if row == 0:
        return "Nothing was kept from before it."
    runs, begin, t_ns = [], 0, flight["t_ns"]
    pairs = np.stack([flight["health"][:row], flight["causes"][:row]], axis=1).tolist()
    for (health, causes), group in groupby(pairs):
        end = begin + len(list(group))
        seconds = (max(t_ns[end], t_ns[end - 1]) - t_ns[begin]) * 1e-9  # at the event the clock may have been set back
        why = f" ({in_words(_core.cause_names(causes))})" if causes else ""
        runs.append(f"{HEALTHS[health]}{why} for {seconds:.3f} s")
        begin = end
    told = ["..."] * (len(runs) > MOST_HEALTHS) + runs[-MOST_HEALTHS:]
    return f"Health before: {', then '.join(told)}."


def standing_alarm(flight: Flight, source: FlightSource) -> str:
    """An alarm that was raised before the event and stood at it."""
    event, row = flight["event"], flight["event_row"]
    alarm = int(flight["alarm"][row - 1]) if row else NONE
    if alarm == NONE or event.alarm.value == NONE:
        return ""
    level = "contact" if alarm == CONTACT else "collision"
    if event.alarm_t_ns == event.t_ns:  # a contact that became a collision
        return f"A {level} alarm already stood before it."
    return (
        f"A {level} alarm of joint {source.joints[event.alarm_joint]} stood already, "
        f"raised at {source.time_s(event.alarm_t_ns):.3f} s."
    )


def after(flight: Flight, source: FlightSource, kind: str) -> str:
    """What became of it in what is kept from after the event."""
    row = flight["event_row"]
    health = flight["health"][row:]
    if len(health) == 1:
        return "Nothing was kept from after it."
    kept_s = (flight["t_ns"][-1] - flight["t_ns"][row]) * 1e-9
    text = f"In the {kept_s:.3f} s after it: "
    if kind == "fault":
        good = np.flatnonzero(health != FAULT)
        if len(good) == 0:
            return text + "the fault lasted."
        gone_s = (flight["t_ns"][row + good[0]] - flight["t_ns"][row]) * 1e-9
        return text + f"the fault was gone after {gone_s:.3f} s; at the end health was {HEALTHS[int(health[-1])]}."
    j = flight["event"].alarm_joint
    size = np.abs(flight["tau_ext"][row:, j])
    if np.isfinite(size).any():
        peak = int(np.nanargmax(size))
        peak_s = (flight["t_ns"][row + peak] - flight["t_ns"][row]) * 1e-9
        text += f"|tau_ext| of {source.joints[j]} peaked at {size[peak]:.3f} {source.unit(j)}, "
        text += f"{peak_s:.3f} s after it; " if peak else "at the event; "
        over = size > limits_of(flight, kind)[row:, j]
        text += f"it was {'' if over[-1] else 'not '}over its {kind} limit at the end; "
    return text + f"health at the end was {HEALTHS[int(health[-1])]}."


def left_out(flight: Flight, kept: np.ndarray, source: FlightSource) -> list[str]:
    """Samples that the files do not hold, with their values."""
    gone = np.flatnonzero(~kept)
    if len(gone) == 0:
        return []
    plural = "samples that a recording cannot hold are" if len(gone) > 1 else "sample that a recording cannot hold is"
    lines = [f"{len(gone)} of {len(kept)} {plural} left out (values that are not finite, or a time not later):"]
    for row in gone[:MOST_SAMPLES_TOLD].tolist():
        t_ns = int(flight["t_ns"][row])
        values = [
            f"{name} = [{', '.join(f'{value:.6g}' for value in flight[name][row])}]" for name in ("q", "dq", "tau")
        ]
        lines.append(f"  t_ns = {t_ns} ({source.time_s(t_ns):.3f} s): {', '.join(values)}")
    if len(gone) > MOST_SAMPLES_TOLD:
        lines.append(f"  and {len(gone) - MOST_SAMPLES_TOLD} more.")
    return lines
