"""Traces of one recording: all of it in buckets, and every sample around events."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tauext.bundle.estimates import OK, Estimates
from tauext.data.recording import Recording
from tauext.report.buckets import GAP_PERIODS, Buckets, in_buckets, run_begins
from tauext.report.stretches import Stretch, alarms, gaps, stretches

AROUND_S = 0.5
"""Every sample is kept from so long before the beginning of an event ..."""
EVENT_S = 1.0
"""... to so long after its end, or after this much of it."""
METHOD_SIGNALS = ("tau_ext", "limit", "sigma", "learned", "r")
"""Of every method; sigma of those whose bundle has an error scale."""


@dataclass
class Traced:
    """One recording and what methods said of it, reduced."""

    head: dict[str, Any]
    """Names, and times in s from the first sample, as the page reads them."""
    traces: list[tuple[str, str | None, int]]
    """Of every column: signal, method (None: the recording's own), joint."""
    whole: Buckets
    close: list[tuple[int, Buckets]]
    """Windows of every sample in order of time, each with its place in the order of importance."""


def trace(
    recording: Recording, said: dict[str, Estimates], size: int, windows: int, first: Sequence[Stretch] = ()
) -> Traced:
    """Reduce one recording.

    Args:
        said: by method, the most important first; its alarms have windows first.
        size: samples a bucket.
        windows: around so many events, at most, every sample is kept: contacts first, then alarms.
        first: events that come before all others, [s].
    """
    time_s, n = recording.time_s, len(recording.joints)
    named: dict[tuple[str, str | None], np.ndarray] = {("tau", None): recording.tau}
    reference = recording.tau_ext if recording.tau_ext_sensor is None else recording.tau_ext_sensor
    if reference is not None:
        named["reference", None] = reference
    for method, estimates in said.items():
        healthy_only = np.where((estimates.health == OK)[:, None], estimates.tau_ext, np.nan)
        learned = estimates.r - estimates.tau_ext
        values = (healthy_only, estimates.limit, estimates.band_nm, learned, estimates.r)
        named |= {(name, method): one for name, one in zip(METHOD_SIGNALS, values, strict=True) if one is not None}
    contacts = [] if recording.contact is None else stretches(recording.contact == 1, time_s)
    found = {method: alarms(estimates, time_s) for method, estimates in said.items()}
    parts = around([*first, *contacts, *(one[:2] for each in found.values() for one in each)], time_s, windows)
    gap_ns = GAP_PERIODS * 1e9 / recording.rate_hz
    blocks = list(named.values())
    edges = [edge for _, part in parts for edge in (part.start, part.stop) if edge < recording.samples]
    begins = run_begins(recording.t_ns, blocks, gap_ns, edges)
    head = {
        "name": recording.name,
        "duration_s": recording.duration_s,
        "gap_s": gap_ns * 1e-9,
        "reference": "true or best known" if recording.tau_ext_sensor is None else "sensor",
        "gaps": gaps(recording.t_ns, gap_ns),
        "contacts": contacts,
        "alarms": found,
        "unhealthy": {method: stretches(estimates.health != OK, time_s) for method, estimates in said.items()},
    }
    return Traced(
        head=head,
        traces=[(*name, joint) for name in named for joint in range(n)],
        whole=in_buckets(recording.t_ns, blocks, begins, size),
        close=[(k, in_buckets(recording.t_ns[p], [b[p] for b in blocks], begins[p], 1)) for k, p in parts],
    )


def around(events: Sequence[Stretch], time_s: np.ndarray, count: int) -> list[tuple[int, slice]]:
    """Rows around the first `count` events that are not covered yet, in order of time, none touching the next.

    With each the place of the first event that asked for it.
    """
    rank = np.full(len(time_s) + 2, len(events))
    for place, (start, end) in enumerate(events):
        ends = start - AROUND_S, min(end, start + EVENT_S) + AROUND_S
        part = slice(*(int(row) + 1 for row in np.searchsorted(time_s, ends)))
        if count > 0 and (rank[part] == len(events)).any():
            rank[part] = np.minimum(rank[part], place)
            count -= 1
    edges = np.flatnonzero(np.diff(rank < len(events))).reshape(-1, 2)
    return [(int(rank[a + 1 : b + 1].min()), slice(int(a), int(b))) for a, b in edges]
