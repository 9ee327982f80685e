"""Parts of a recording by time, as recordings of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tauext.data.recording import FLAGS, SIGNALS, Recording


def between(recording: Recording, first: int, last: int, name: str) -> Recording:
    """Rows first to last, last left out, under another name; its provenance says which part it is, in seconds."""
    arrays = {key: getattr(recording, key) for key in ("t_ns", *SIGNALS, *FLAGS)}
    cut = {key: values[first:last] for key, values in arrays.items() if values is not None}
    part = {"of": recording.name, "from_s": round(float(recording.time_s[first]), 6)}
    part["to_s"] = round(float(recording.time_s[last - 1]), 6)
    return replace(recording, name=name, provenance=recording.provenance | {"part": part}, **cut)


def has_contact(recording: Recording) -> bool:
    """Whether a sample is in contact."""
    return recording.contact is not None and bool((recording.contact == 1).any())


def free_stretches(recording: Recording, before_s: float, after_s: float, least_s: float) -> list[Recording]:
    """Stretches without contact, each a recording NAME-free-00, -01, ...; the recording itself where it has none.

    Samples whose label is neither contact nor free are left out with the contacts.

    Args:
        before_s: left out before a contact, too, [s]: a label may come late.
        after_s: left out after one, [s]: the observer rings down, and the arm may still swing.
        least_s: a shorter stretch is left out, [s].
    """
    if recording.contact is None or (recording.contact == 0).all():
        return [recording]
    edges = np.flatnonzero(np.diff(np.r_[0, (recording.contact != 0).astype(np.int8), 0]))
    t_ns = recording.t_ns
    free = np.ones(recording.samples, bool)
    for begin, end in edges.reshape(-1, 2):
        first, last = t_ns[begin] - int(before_s * 1e9), t_ns[end - 1] + int(after_s * 1e9)
        free[np.searchsorted(t_ns, first) : np.searchsorted(t_ns, last, side="right")] = False
    runs = np.flatnonzero(np.diff(np.r_[0, free.astype(np.int8), 0])).reshape(-1, 2)
    long = [run for run in runs if (t_ns[run[1] - 1] - t_ns[run[0]]) * 1e-9 >= least_s]
    return [between(recording, first, last, f"{recording.name}-free-{k:02d}") for k, (first, last) in enumerate(long)]


def within(recording: Recording, from_s: float, to_s: float, name: str) -> Recording | None:
    """What of it lies in [from_s, to_s), seconds of its source; itself where that is all, None where it is nothing."""
    time_s = recording.time_s + recording.provenance.get("start_s", 0.0)
    rows = np.flatnonzero((time_s >= from_s) & (time_s < to_s))
    if not len(rows):
        return None
    return recording if len(rows) == recording.samples else between(recording, rows[0], rows[-1] + 1, name)
