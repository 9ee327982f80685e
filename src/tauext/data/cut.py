"""Some samples of a recording, as a recording of its own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tauext.data.recording import FLAGS, SIGNALS, Recording


def cut(recording: Recording, span: slice | np.ndarray) -> Recording:
    """Some samples of a recording, at least one, under its name: those of a slice, or where a flag a sample says so."""
    arrays = {name: getattr(recording, name) for name in ("t_ns", *SIGNALS, *FLAGS)}
    return replace(recording, **{name: a[span] for name, a in arrays.items() if a is not None})


def between(recording: Recording, first: int, last: int, name: str) -> Recording:
    """Rows first to last, last left out, under another name; its provenance says which part it is, in seconds."""
    part = {"of": recording.name, "from_s": round(float(recording.time_s[first]), 6)}
    part["to_s"] = round(float(recording.time_s[last - 1]), 6)
    provenance = recording.provenance | {"part": part}
    return replace(cut(recording, slice(first, last)), name=name, provenance=provenance)


def within(recording: Recording, from_s: float, to_s: float, name: str) -> Recording | None:
    """What of it lies in [from_s, to_s), seconds of its source; itself where that is all, None where it is nothing."""
    time_s = recording.time_s + recording.provenance.get("start_s", 0.0)
    rows = np.flatnonzero((time_s >= from_s) & (time_s < to_s))
    if not len(rows):
        return None
    return recording if len(rows) == recording.samples else between(recording, rows[0], rows[-1] + 1, name)
