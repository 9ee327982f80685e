"""Explains a flight in words: event, joint, limit and the time before."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import groupby
from typing import Any

import numpy as np

from tauext import _core
from tauext._core import LoadFound, PlaceModel
from tauext.bundle.estimates import CONTACT, FAULT, FIRST_KIND, HEALTHS, NONE, OK, unexplained
from tauext.bundle.units import short
from tauext.errors import RecordingError
from tauext.monitor.changes import Change, TouchChange
from tauext.monitor.flight_content import Flight, FlightSource, as_recording, carried, event_kind
from tauext.monitor.loads import load_words
from tauext.monitor.touch_place import PlaceChange, strongest_sample
from tauext.monitor.weighing import WeighedMotion, identify, load_frame, mass_error, mass_words

# --- Meaning and remedy of each cause of bad health.


MEANING = {
    "not finite": "a position, velocity or torque was NaN, infinite or absurdly large; look at the driver and at the "
    "conversion of its values",
    "wrong size": "the sample did not have one value for each joint; look at the code that makes the samples",
    "late sample": "a sample was not newer than the one before it and was left out; look at the clock that makes the "
    "stamps, and at the order of the samples",
    "time backwards": "the time stamps went back by more than one network period; look at the clock that makes them",
    "missing sample": "the loop ran and no new sample had come; look at the connection to the arm",
    "gap": "no sample came for longer than one network period; look at the connection to the arm",
    "wrong rate": "samples came at another rate than the bundle was trained for; run the loop at that rate, or train "
    "for this one",
    "torque saturated": "a drive was at its torque limit and gave another torque than commanded; move slower, carry "
    "less, or expect doubtful estimates there",
    "encoder still": "a position did not change while velocity or torque show that the joint moved; look at the "
    "encoder and its cable",
    "impossible torque": "a torque was larger than the drive can give, whatever touches the arm; look at the driver, "
    "at the unit of its torques and at the conversion of their values",
    "impossible velocity": "a velocity was higher than the joint can get; look at the encoder, at the unit of the "
    "velocity and at how it is differentiated",
    "impossible position": "a position lay farther from the one before than the joint can have gone, or beyond all "
    "that encoders count; look at the encoder, its cable and its zero: after a new zero the monitor continues",
}
"""Meaning and remedy by the core's name of the cause."""


def in_words(names: list[str]) -> str:
    """Join names: `gap and wrong rate`, or `no cause`."""
    return " and ".join(names) if names else "no cause"


# --- Motion that the training data do not contain.


WORTH_TELLING: float = _core.CoverageSettings.WORTH_TELLING
"""Least value of `unfamiliar` for reporting motion as unfamiliar."""
KINDS = tuple(kind.name for kind in sorted(_core.Unseen, key=lambda kind: kind.value))
"""Kinds of unfamiliar motion, by the core's number."""
Unseen = tuple[int, int, int]
"""Number of the kind, joint, and the other joint of a new pair of positions, else -1."""


def unseen_of(estimates: Mapping[str, np.ndarray]) -> Counter[Unseen]:
    """Count unfamiliar samples by kind and joints.

    Args:
        estimates: as returned by Monitor.run.
    """
    rows = estimates["unfamiliar"] >= WORTH_TELLING
    if not rows.any():
        return Counter()
    what = np.stack([estimates[key][rows].astype(int) for key in ("unseen", "unseen_joint", "unseen_other")], axis=1)
    kinds, counts = np.unique(what, axis=0, return_counts=True)
    return Counter({(kind[0], kind[1], kind[2]): n for kind, n in zip(kinds.tolist(), counts.tolist(), strict=True)})


def unseen_words(unseen: Unseen, joints: Sequence[str]) -> str:
    """Describe unfamiliar motion: `speed of joint2`, `position of joint1`, `joint1 and joint3 together`."""
    what, joint, other = unseen
    if other >= 0:
        return f"{joints[joint]} and {joints[other]} together"
    return f"{KINDS[what]} of {joints[joint]}"


# --- Numbers in sentences.


def readable(value: float, spec: str) -> str:
    """Format a value by .3f or +.2f; from 1e6 on, where decimals are meaningless, as four digits and a power of ten."""
    if abs(value) < 1e6 or value != value:
        return format(value, spec)
    return format(value, ("+" if spec.startswith("+") else "") + ".4g")


# --- Explains a contact or collision: which limit, by how much, and the terms of the estimate.


def over_limit(flight: Flight, source: FlightSource, kind: str) -> str:
    """Sentence on the exceeded limit, the excess and its duration."""
    event, row = flight["event"], flight["event_row"]
    j = event.alarm_joint
    limits = limits_of(flight, kind)[:, j]
    left = np.abs(unexplained(flight)[:, j])
    size, limit, speed = left[row], limits[row], flight["dq"][row, j]
    region, edge = ("near stiction", "below") if event.near_stiction[j] else ("sliding", "not below")
    slow_rad_s = source.bundle.near_stiction_rad_s
    unit = source.unit(j)
    text = (
        f"|{compared(event, j)}| of {source.joints[j]} was {size:.3f} {unit}, {size - limit:.3f} {unit} over its "
        f"{kind} threshold of {limit:.3f} {unit} ({region}: its speed was {speed:+.4f} rad/s, {edge} {slow_rad_s:g})."
    )
    text += certainty(flight, source)
    since = row
    while since > 0 and left[since - 1] > limits[since - 1]:
        since -= 1
    if since < row:
        ms = (flight["t_ns"][row] - flight["t_ns"][since]) * 1e-6
        text += f" It had been over that threshold for {ms:.1f} ms."
    return text


def compared(event: Any, joint: int) -> str:
    """What is compared with the joint's limit: `tau_ext - declared`."""
    parts = (("load", event.load_nm[joint]), ("declared", event.declared_nm[joint]))
    return " - ".join(["tau_ext", *(word for word, nm in parts if nm)])


def certainty(flight: Flight, source: FlightSource) -> str:
    """The standard error of the estimate, and the factor of the motion on the limit; empty without an error scale."""
    event = flight["event"]
    j = event.alarm_joint
    sigma = event.sigma_nm[j]
    if not source.has_error_scale or not sigma > 0:
        return ""
    motion = (
        f"; the motion multiplied the threshold of usual motion by {event.limit_scale[j]:.2f}"
        if source.bundle.error_scale.follows
        else ""
    )
    left = abs(unexplained(flight)[flight["event_row"], j])
    return (
        f" It was {left / sigma:.2g} times its standard error in free motion of {sigma:.3f} {source.unit(j)} (during "
        f"the contact: {event.contact_sigma_nm[j]:.3f} {source.unit(j)}){motion}."
    )


def kind_of_touch(flight: Flight) -> str:
    """The kind of touch at the end of the flight; empty where unknown."""
    row, touch = flight["event_row"], flight["touch"]
    if not len(touch) or touch[-1] < FIRST_KIND:
        return ""
    since = len(touch) - 1
    while since > row and touch[since - 1] == touch[-1]:
        since -= 1
    since_s = (flight["t_ns"][since] - flight["t_ns"][row]) * 1e-9
    alarm = max(int(flight["event"].alarm.value), CONTACT)
    return sentence(TouchChange(since, int(flight["t_ns"][since]), int(touch[-1]), 0, alarm, -1, since_s), ())


def place_of_touch(flight: Flight, source: FlightSource) -> str:
    """The touched link and place, from the strongest sample since the event; empty where unknown."""
    event, row = flight["event"], flight["event_row"]
    if not source.has_error_scale:
        return ""
    signals = (flight[name][row:] for name in ("sigma_nm", "contact_sigma_nm"))
    q, dq, tau_ext = flight["q"][row:], flight["dq"][row:], unexplained(flight)[row:]
    model = PlaceModel(source.bundle)
    if model.refused:
        return ""
    sample = strongest_sample(event.alarm_joint, q, dq, tau_ext, *signals)
    change = PlaceChange.of(model, sample, row, int(event.t_ns), event.alarm.value, event.alarm_joint, 0.0)
    return "" if change is None else sentence(change, source.joints)


def sentence(change: Change, joints: tuple[str, ...]) -> str:
    (words,) = change.words(joints)
    return f"{words[0].upper()}{words[1:]}."


def doubt(flight: Flight) -> str:
    """Health at the event, where it was not ok."""
    event = flight["event"]
    if event.health.value == OK:
        return ""
    health = HEALTHS[event.health.value]
    return f"Health was {health} ({in_words(event.causes)}) at that sample: the estimate may be wrong."


def unfamiliar(flight: Flight, source: FlightSource) -> str:
    """The part of the motion that the training data do not contain; empty if insignificant."""
    event = flight["event"]
    if event.unfamiliar < WORTH_TELLING:
        return ""
    what = unseen_words((event.unseen.value, event.unseen_joint, event.unseen_other), source.joints)
    return f"The training data do not contain such motion ({what}): the estimate may be wrong."


def sum_of_terms(flight: Flight, source: FlightSource) -> str:
    """The terms of the joint's estimate: observer, prior, network and drift."""
    event = flight["event"]
    j = event.alarm_joint
    residual, unit = event.residual[j], source.unit(j)
    if "prior" not in source.lacking:
        terms = f"the prior expected {event.prior[j]:+.3f} {unit} of it in free motion"
        terms += f" and the network {event.network[j]:+.3f} {unit} more" if source.bundle.has_network else ""
        terms += (
            f", slow changes since training (adaptive bias) {event.drift[j]:+.3f} {unit}"
            if "drift" not in source.lacking
            else ""
        )
        left = f"the remainder is tau_ext = {event.tau_ext[j]:+.3f} {unit}"
        return f"The observer's residual was {residual:+.3f} {unit}, {terms}; {left}."
    if not source.bundle.has_network:
        return f"The observer's residual was {residual:+.3f} {unit}; the bundle has no network, so this is tau_ext."
    expected = f"the network expected {event.network[j]:+.3f} {unit} of it in free motion"
    return (
        f"The observer's residual was {residual:+.3f} {unit}, {expected}; "
        f"their difference is tau_ext = {event.tau_ext[j]:+.3f} {unit}."
    )


def others(flight: Flight, source: FlightSource, kind: str) -> str:
    """The other joints that are nearest to their limits."""
    row = flight["event_row"]
    rest = [j for j in range(len(source.joints)) if j != flight["event"].alarm_joint]
    if kind == "fault" or not rest:
        return ""
    share = np.abs(unexplained(flight)[row]) / limits_of(flight, kind)[row]
    nearest = sorted(rest, key=lambda j: -share[j])[:3]
    return f"Other joints, nearest to their {kind} thresholds first: {loads(flight, row, source, nearest, kind)}."


def limits_of(flight: Flight, kind: str) -> np.ndarray:
    """Limits of this kind of alarm, (samples, joints); for a fault, those of a collision."""
    return flight["contact_limit_nm" if kind == "contact" else "limit_nm"]


def loads(flight: Flight, row: int, source: FlightSource, joints: list[int] | range, kind: str = "collision") -> str:
    """List torques and limits: `joint2 1.100 of 2.600 Nm (42%)` for each joint."""
    parts, limits = [], limits_of(flight, kind)
    for j in joints:
        size, limit = abs(unexplained(flight)[row, j]), limits[row, j]
        parts.append(f"{source.joints[j]} {size:.3f} of {limit:.3f} {source.unit(j)} ({size / limit:.0%})")
    return ", ".join(parts)


# --- Explains a fault: its cause, the signals there, and the last estimate before.


def fault_causes(flight: Flight) -> list[str]:
    """Sentences on the meaning of each cause."""
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
    unit = short(source.bundle.torque_units[joint])
    text = f"q = {readable(q, '.5f')} rad, dq = {readable(dq, '+.4f')} rad/s, tau = {readable(tau, '+.3f')}"
    return f"{text} {unit}"


def last_estimate(flight: Flight, source: FlightSource) -> str:
    """The newest tau_ext up to the fault."""
    known = np.flatnonzero(np.isfinite(flight["tau_ext"][: flight["event_row"] + 1]).all(axis=1))
    if len(known) == 0:
        return "There is no estimate of tau_ext up to the fault in this event log."
    row = int(known[-1])
    ms = (flight["t_ns"][flight["event_row"]] - flight["t_ns"][row]) * 1e-6
    when = "At the fault" if row == flight["event_row"] else f"Last estimate, {ms:.1f} ms before"
    return f"{when}: {loads(flight, row, source, range(len(source.joints)))}."


# --- Whether a load raised the alarm: the flight's samples after the event are weighed.


def fits_load(flight: Flight, kept: np.ndarray, source: FlightSource) -> str:
    """Sentence on a load that explains the torques behind an alarm; empty if none does or the motion is too poor.

    The load is estimated as in `tauext load`: a constant force that explains the torques better is no load. Drift
    learned before the event is kept; drift learned since counts as part of the load.

    Args:
        kept: samples in the flight's recording, (samples,) bool.
    """
    if event_kind(flight) == "fault":
        return ""
    if set(source.bundle.estimate_units) != {"N m"}:  # a weight has no meaning in another unit
        return ""
    frame = load_frame(source.bundle)
    motion = behind_the_event(flight, kept, source)
    try:
        found = identify(source.bundle, frame, [motion])
    except RecordingError:
        return ""  # too few samples
    if found.verdict != "load" or not found.mass_seen or found.at_bound:
        return ""
    event_s = source.time_s(flight["event"].t_ns)
    start_s = source.time_s(int(motion.recording.t_ns[0]))
    first_s, last_s = (start_s + float(motion.time_s[row]) - event_s for row in (0, -1))
    before = next(load for row, load in reversed(carried(flight)) if row <= flight["event_row"])
    beside = f", beside the {before.mass:.3g} kg that was set" if before.mass > 0 else ""
    return (
        f"From {first_s:.2f} to {last_s:.2f} s after it the torques fit a payload of "
        f"{mass_words(found.mass_kg, mass_error(found))} at {frame.name}{beside}: if the arm picked something up, set "
        "its load."
    )


def behind_the_event(flight: Flight, kept: np.ndarray, source: FlightSource) -> WeighedMotion:
    """The healthy rows from the event on, once r has settled, without a change of the set load."""
    chain, row = source.bundle, flight["event_row"]
    observer = chain.observer
    recording = as_recording(flight, kept, "flight", source, {})
    rows = np.flatnonzero(kept)
    t_ns = flight["t_ns"][kept]
    slowest_per_s = min(observer.gain_per_s, observer.low_pass_per_s or observer.gain_per_s)
    settled_ns = flight["event"].t_ns + 5 / slowest_per_s * 1e9  # r has then settled to 99 % of a step
    ends = [changed for changed, _ in carried(flight)[1:] if changed > row]
    usable = (t_ns >= settled_ns) & (flight["health"][kept] == OK) & (rows < min(ends, default=len(kept)))
    # After a gap of more than a period of the chain r restarts.
    gaps = np.flatnonzero(np.diff(t_ns) > 1.5 * observer.sample_period_ns * observer.network_stride)
    if len(gaps):
        usable[: gaps[-1] + 1] = False
    samples = np.flatnonzero(usable)[:: observer.network_stride]
    sigma = flight["sigma_nm"] if source.has_error_scale else LoadFound.SIGMA_OF_LIMIT * flight["limit_nm"]
    learned = flight["drift"] - flight["drift"][row]
    near = flight["near_stiction"][kept].astype(np.uint8)
    return WeighedMotion.of(recording, samples, (flight["tau_ext"] + learned)[kept], sigma[kept], near)


# --- Text of a flight: event, time, joint, excess over the limit, and the time before.


def explain(flight: Flight, kept: np.ndarray, source: FlightSource) -> str:
    """Explain a flight, one paragraph a line, from the headline to samples left out.

    Args:
        kept: samples in the flight's recording, (samples,) bool.
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
        load_set(flight, source),
        fits_load(flight, kept, source),
        others(flight, source, kind),
        before(flight),
        standing_alarm(flight, source),
        after(flight, source, kind),
    ]
    lines += left_out(flight, kept, source)
    return "\n".join(line for line in lines if line)


def headline(flight: Flight, source: FlightSource, kind: str) -> str:
    """Headline with event, joint and time."""
    event = flight["event"]
    when = f"{source.time_s(event.t_ns):.3f} s after the start of {source.recording} (t_ns = {event.t_ns})"
    if kind != "fault":
        return f"{kind.capitalize()} on joint {source.joints[event.alarm_joint]}, {when}."
    where = f", first on joint {source.joints[event.cause_joint]}" if event.cause_joint >= 0 else ""
    return f"Fault ({in_words(event.causes)}){where}, {when}."


def load_set(flight: Flight, source: FlightSource) -> str:
    """Sentence on the load and its changes; empty if there was none."""
    changes = carried(flight)
    if all(load.mass == 0 for _, load in changes):
        return ""
    text = f"The payload of the arm was set to {load_words(changes[0][1], source.bundle.load_settings.frame)}"
    for row, load in changes[1:]:
        since_s = (flight["t_ns"][row] - flight["t_ns"][flight["event_row"]]) * 1e-9
        when = f"{abs(since_s):.3f} s {'before' if since_s < 0 else 'after'} it"
        text += f", from {when} on {load_words(load, source.bundle.load_settings.frame)}"
    return f"{text}."


def before(flight: Flight, most_shown: int = 5) -> str:
    """Health over the samples before the event, oldest first."""
    row = flight["event_row"]
    if row == 0:
        return "Nothing was kept from before it."
    runs, begin, t_ns = [], 0, flight["t_ns"]
    pairs = np.stack([flight["health"][:row], flight["causes"][:row]], axis=1).tolist()
    for (health, causes), group in groupby(pairs):
        end = begin + len(list(group))
        seconds = (max(t_ns[end], t_ns[end - 1]) - t_ns[begin]) * 1e-9  # the clock may have been set back at the event
        why = f" ({in_words(_core.cause_names(causes))})" if causes else ""
        runs.append(f"{HEALTHS[health]}{why} for {seconds:.3f} s")
        begin = end
    shown = ["..."] * (len(runs) > most_shown) + runs[-most_shown:]
    return f"Health before: {', then '.join(shown)}."


def standing_alarm(flight: Flight, source: FlightSource) -> str:
    """Sentence on an alarm raised before the event and still active."""
    event, row = flight["event"], flight["event_row"]
    alarm = int(flight["alarm"][row - 1]) if row else NONE
    if alarm == NONE or event.alarm.value == NONE:
        return ""
    level = "contact" if alarm == CONTACT else "collision"
    if event.alarm_t_ns == event.t_ns:  # a contact that became a collision
        return f"A {level} alarm was already active before it."
    return (
        f"A {level} alarm of joint {source.joints[event.alarm_joint]} was already active, "
        f"raised at {source.time_s(event.alarm_t_ns):.3f} s."
    )


def after(flight: Flight, source: FlightSource, kind: str) -> str:
    """Sentence on the end of the event, from the samples after it."""
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
    size = np.abs(unexplained(flight)[row:, j])
    if np.isfinite(size).any():
        peak = int(np.nanargmax(size))
        peak_s = (flight["t_ns"][row + peak] - flight["t_ns"][row]) * 1e-9
        text += f"|{compared(flight['event'], j)}| of {source.joints[j]} peaked at {size[peak]:.3f} {source.unit(j)}, "
        text += f"{peak_s:.3f} s after it; " if peak else "at the event; "
        over = size > limits_of(flight, kind)[row:, j]
        text += f"it was {'' if over[-1] else 'not '}over its {kind} threshold at the end; "
    return text + f"health at the end was {HEALTHS[int(health[-1])]}."


def left_out(flight: Flight, kept: np.ndarray, source: FlightSource, most_shown: int = 10) -> list[str]:
    """Lines on the samples left out of the files, with their values."""
    gone = np.flatnonzero(~kept)
    if len(gone) == 0:
        return []
    plural = "samples that do not fit a recording are" if len(gone) > 1 else "sample that does not fit a recording is"
    lines = [f"{len(gone)} of {len(kept)} {plural} left out (values that are not finite, or a time not later):"]
    for row in gone[:most_shown].tolist():
        t_ns = int(flight["t_ns"][row])
        values = [
            f"{name} = [{', '.join(f'{value:.6g}' for value in flight[name][row])}]" for name in ("q", "dq", "tau")
        ]
        lines.append(f"  t_ns = {t_ns} ({source.time_s(t_ns):.3f} s): {', '.join(values)}")
    if len(gone) > most_shown:
        lines.append(f"  and {len(gone) - most_shown} more.")
    return lines
