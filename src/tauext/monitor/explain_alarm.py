"""Says in words how a contact or collision came about: which limit, by how much, what observer and network said."""

from __future__ import annotations

import numpy as np

from tauext._core import PlaceModel
from tauext.bundle.estimates import HEALTHS
from tauext.monitor.causes import in_words
from tauext.monitor.changes import FIRST_KIND, OK, TOUCHES, with_article
from tauext.monitor.flight_content import Flight, FlightSource
from tauext.monitor.places import PlaceChange, place_words
from tauext.monitor.unfamiliar import WORTH_TELLING, unseen_words

MOST_OTHERS = 3


def over_limit(flight: Flight, source: FlightSource, kind: str) -> str:
    """By how much over which limit, and since when."""
    event, row = flight["event"], flight["event_row"]
    j = event.alarm_joint
    limits = limits_of(flight, kind)[:, j]
    left = np.abs(without_load(flight)[:, j])
    size, limit, speed = left[row], limits[row], flight["dq"][row, j]
    region, edge = ("near stiction", "below") if event.near_stiction[j] else ("sliding", "not below")
    unit = source.unit(j)
    torque = "tau_ext - load" if event.load_nm[j] else "tau_ext"
    text = (
        f"|{torque}| of {source.joints[j]} was {size:.3f} {unit}, {size - limit:.3f} {unit} over its {kind} limit of "
        f"{limit:.3f} {unit} ({region}: its speed was {speed:+.4f} rad/s, {edge} {source.near_stiction_rad_s:g})."
    )
    text += certainty(flight, source)
    since = row
    while since > 0 and left[since - 1] > limits[since - 1]:
        since -= 1
    if since < row:
        ms = (flight["t_ns"][row] - flight["t_ns"][since]) * 1e-6
        text += f" It had been over that limit for {ms:.1f} ms."
    return text


def certainty(flight: Flight, source: FlightSource) -> str:
    """How sure the estimate was, and what the motion did to the limit; empty where no error scale says so."""
    event = flight["event"]
    j = event.alarm_joint
    sigma = event.sigma_nm[j]
    if not source.has_error_scale or not sigma > 0:
        return ""
    motion = (
        f"; the motion multiplied the limit of usual motion by {event.limit_scale[j]:.2f}" if source.follows else ""
    )
    return (
        f" It was {abs(event.tau_ext[j] - event.load_nm[j]) / sigma:.2g} times its standard error in free motion of "
        f"{sigma:.3f} {source.unit(j)} (during the contact: {event.contact_sigma_nm[j]:.3f} {source.unit(j)}){motion}."
    )


def kind_of_touch(flight: Flight) -> str:
    """What kind of touch it was taken for, at the end of the flight; empty where nobody knew."""
    row, touch = flight["event_row"], flight["touch"]
    if not len(touch) or touch[-1] < FIRST_KIND:
        return ""
    since = len(touch) - 1
    while since > row and touch[since - 1] == touch[-1]:
        since -= 1
    ms = (flight["t_ns"][since] - flight["t_ns"][row]) * 1e-6
    return f"{ms:.0f} ms later it was taken for {with_article(TOUCHES[touch[-1]])}."


def place_of_touch(flight: Flight, source: FlightSource) -> str:
    """Which link, and where, by the sample since the event at which tau_ext stood out most; empty where unknown."""
    event, row = flight["event"], flight["event_row"]
    if source.chain is None or not source.has_error_scale:
        return ""
    model, sigma = PlaceModel(source.chain), flight["sigma_nm"][row:]
    tau = without_load(flight)[row:]
    with np.errstate(divide="ignore", invalid="ignore"):
        strength = np.where((sigma > 0).all(axis=1), np.square(tau / sigma).sum(axis=1), np.nan)
    if model.refused or not np.isfinite(strength).any():
        return ""
    at = int(np.nanargmax(strength))
    q, dq, contact_sigma = (flight[name][row + at].tolist() for name in ("q", "dq", "contact_sigma_nm"))
    found = model.find(q, tau[at].tolist(), sigma[at].tolist(), contact_sigma, dq=dq)
    if found.best is None:
        return ""
    links = tuple((link, found.probability[link]) for link in found.ranked)
    since_s = (int(flight["t_ns"][row + at]) - int(flight["t_ns"][row])) * 1e-9
    level = event.alarm.value
    told = (links, tuple(found.places), found.best, found.consistent)
    change = PlaceChange(row, int(event.t_ns), level, event.alarm_joint, since_s, *told)
    words = place_words(change, source.joints)
    return f"{words[0].upper()}{words[1:]}."


def doubt(flight: Flight) -> str:
    """Health at the event, where it was not ok."""
    event = flight["event"]
    if event.health.value == OK:
        return ""
    health = HEALTHS[event.health.value]
    return f"Health was {health} ({in_words(event.causes)}) at that sample: the estimate may be wrong."


def unfamiliar(flight: Flight, source: FlightSource) -> str:
    """What of the motion training never saw, where that is worth telling."""
    event = flight["event"]
    if event.unfamiliar < WORTH_TELLING:
        return ""
    what = unseen_words((event.unseen.value, event.unseen_joint, event.unseen_other), source.joints)
    return f"Training never saw such motion ({what}): the estimate may be wrong."


def sum_of_terms(flight: Flight, source: FlightSource) -> str:
    """What observer, prior and network said of the joint."""
    event = flight["event"]
    j = event.alarm_joint
    residual, unit = event.residual[j], source.unit(j)
    if source.has_prior:
        said = f"the prior expected {event.prior[j]:+.3f} {unit} of it in free motion"
        said += f" and the network {event.network[j]:+.3f} {unit} more" if source.has_network else ""
        said += f", slow changes since training {event.drift[j]:+.3f} {unit}" if source.has_drift else ""
        left = f"what is left is tau_ext = {event.tau_ext[j]:+.3f} {unit}"
        return f"The observer said {residual:+.3f} {unit}, {said}; {left}."
    if not source.has_network:
        return f"The observer said {residual:+.3f} {unit}; the bundle has no network, so this is tau_ext."
    expected = f"the network expected {event.network[j]:+.3f} {unit} of it in free motion"
    return (
        f"The observer said {residual:+.3f} {unit}, {expected}; "
        f"their difference is tau_ext = {event.tau_ext[j]:+.3f} {unit}."
    )


def others(flight: Flight, source: FlightSource, kind: str) -> str:
    """The other joints that are nearest to their limits."""
    row = flight["event_row"]
    rest = [j for j in range(len(source.joints)) if j != flight["event"].alarm_joint]
    if kind == "fault" or not rest:
        return ""
    share = np.abs(without_load(flight)[row]) / limits_of(flight, kind)[row]
    nearest = sorted(rest, key=lambda j: -share[j])[:MOST_OTHERS]
    return f"Other joints, nearest to their {kind} limits first: {loads(flight, row, source, nearest, kind)}."


def without_load(flight: Flight) -> np.ndarray:
    """tau_ext less what is taken for an expected load, (samples, joints): what the alarm compares with its limits."""
    left: np.ndarray = flight["tau_ext"] - flight["load_nm"]
    return left


def limits_of(flight: Flight, kind: str) -> np.ndarray:
    """What |tau_ext| must exceed for this kind of alarm, (samples, joints); for a fault, a collision's."""
    return flight["contact_limit_nm" if kind == "contact" else "limit_nm"]


def loads(flight: Flight, row: int, source: FlightSource, joints: list[int] | range, kind: str = "collision") -> str:
    """`joint2 1.100 of 2.600 Nm (42%)` for each joint."""
    parts, limits = [], limits_of(flight, kind)
    for j in joints:
        size, limit = abs(without_load(flight)[row, j]), limits[row, j]
        parts.append(f"{source.joints[j]} {size:.3f} of {limit:.3f} {source.unit(j)} ({size / limit:.0%})")
    return ", ".join(parts)
