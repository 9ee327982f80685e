"""Verdicts of a live loop in the form that a replay gives, for those who tell and count."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.monitor.changes import Change
from tauext.monitor.replay import Chunk
from tauext.monitor.sink import Verdict


def chunk_of(verdicts: Sequence[Verdict], changes: list[Change]) -> Chunk:
    """Verdicts in a row, at least one, with these changes; the speed of a sample that did not come is NaN."""
    said = {key: np.concatenate([one.said[key] for one in verdicts]) for key in verdicts[0].said}
    unknown = np.full(said["tau_ext"].shape[1], np.nan)
    dq = np.array([unknown if one.sample is None else one.sample.dq for one in verdicts])
    return Chunk(verdicts[0].row, np.array([one.t_ns for one in verdicts]), dq, said, changes, 0.0)
