"""Whether what raised an alarm is a load: the flight's own samples behind the event, weighed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tauext.errors import RecordingError
from tauext.monitor.changes import OK
from tauext.monitor.flight_content import Flight, FlightSource, as_recording, carried, event_kind

if TYPE_CHECKING:
    from tauext.monitor.rows import Seen

SETTLED = 5.0
"""Over K0: so long after the event r shows all of what came on at once, but for a hundredth."""
ONE_ROW = 1.5
"""Periods of the chain's rows: a longer step between two samples is a gap, behind which r begins anew."""


def fits_load(flight: Flight, kept: np.ndarray, source: FlightSource) -> str:
    """A sentence where the torques behind an alarm are those of a load; empty where they are not, or do not tell.

    Weighed as `tauext load` weighs: a constant force that explains them better is no load. What the tracker had learned
    until the event counts as known, what it learned since as part of the load.

    Args:
        kept: samples that the flight's recording holds, (samples,) bool.
    """
    if source.chain is None or event_kind(flight) == "fault":
        return ""
    if set(source.estimate_units or ("N m",)) != {"N m"}:  # a weight says nothing in another unit
        return ""
    from tauext.monitor.frame import load_frame
    from tauext.monitor.identify import identify

    frame = load_frame(source.chain)
    seen = behind_the_event(flight, kept, source)
    try:
        found = identify(source.chain, frame, [seen])
    except RecordingError:
        return ""  # too few samples
    if found.verdict != "load" or not found.mass_seen or found.at_bound:
        return ""
    event_s = source.time_s(flight["event"].t_ns)
    start_s = source.time_s(int(seen.recording.t_ns[0]))
    first_s, last_s = (start_s + float(seen.time_s[row]) - event_s for row in (0, -1))
    before = next(load for row, load in reversed(carried(flight)) if row <= flight["event_row"])
    beside = f", beside the {before.mass:.3g} kg that it was told of" if before.mass > 0 else ""
    return (
        f"From {first_s:.2f} to {last_s:.2f} s after it the torques fit a load of {found.mass_kg:.2f} ± "
        f"{found.mass_error_kg:.2f} kg at {frame.name}{beside}: if the arm picked something up, tell the monitor."
    )


def behind_the_event(flight: Flight, kept: np.ndarray, source: FlightSource) -> Seen:
    """The healthy rows from the event on, once r has settled, without a change of what it was told to carry."""
    from tauext.monitor.rows import SIGMA_SHARE, Seen, stand_worth

    assert source.chain is not None
    chain, row = source.chain, flight["event_row"]
    observer = chain.observer
    recording = as_recording(flight, kept, "flight", source, {})
    place = np.flatnonzero(kept)
    t_ns = flight["t_ns"][kept]
    slowest_per_s = min(observer.gain_per_s, observer.low_pass_per_s or observer.gain_per_s)
    settled_ns = flight["event"].t_ns + SETTLED / slowest_per_s * 1e9
    ends = [changed for changed, _ in carried(flight)[1:] if changed > row]
    usable = (t_ns >= settled_ns) & (flight["health"][kept] == OK) & (place < min(ends, default=len(kept)))
    gaps = np.flatnonzero(np.diff(t_ns) > ONE_ROW * observer.sample_period_ns * observer.network_stride)
    if len(gaps):
        usable[: gaps[-1] + 1] = False
    samples = np.flatnonzero(usable)[:: observer.network_stride]
    sigma = flight["sigma_nm"] if source.has_error_scale else SIGMA_SHARE * flight["limit_nm"]
    learned = flight["drift"] - flight["drift"][row]
    near = flight["near_stiction"][kept].astype(bool)
    worth = stand_worth(near, np.diff(recording.time_s, prepend=0.0))
    return Seen(
        recording,
        samples,
        recording.time_s[samples],
        (flight["tau_ext"] + learned)[kept][samples],
        np.maximum(sigma[kept][samples], 1e-9),
        worth[samples],
        np.abs(recording.dq[samples]),
    )
