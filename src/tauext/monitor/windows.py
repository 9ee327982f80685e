"""Recordings cut into what is weighed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext.data.recording import Recording
from tauext.errors import ConfigError, RecordingError
from tauext.monitor.frame import NamedFrame
from tauext.monitor.identify import LEAST_ROWS, LoadEstimate, identify
from tauext.monitor.rows import Seen

WINDOW_S = 4.0
"""What a robot does between two grasps; and short enough for a load that changes to be seen."""


def between(seen: Seen, from_s: float | None, to_s: float | None) -> Seen:
    """The rows within these times of the recording.

    Raises:
        RecordingError: there are fewer than a measurement takes.
    """
    low, high = from_s if from_s is not None else -np.inf, to_s if to_s is not None else np.inf
    part = seen.part((seen.time_s >= low) & (seen.time_s <= high))
    if part.rows < LEAST_ROWS:
        raise RecordingError(
            f"{seen.recording.name}: {part.rows} healthy rows from {max(low, 0):g} s on are too few to weigh a load"
        )
    return part


def expect_different(recordings: Sequence[Recording]) -> None:
    """Raise ConfigError where two hold the same motion: given twice it would seem to be known better than it is."""
    for k, one in enumerate(recordings):
        for other in recordings[:k]:
            if np.array_equal(one.q, other.q) and np.array_equal(one.tau, other.tau):
                raise ConfigError(f"recordings {other.name} and {one.name} are the same motion; give each one once")


def each_window(
    bundle: _core.Bundle, frame: NamedFrame, parts: Sequence[Seen], whole: LoadEstimate
) -> list[tuple[str, float, LoadEstimate]]:
    """The load by each whole window alone: its recording, where it begins, what it says."""
    told = []
    for part in parts:
        start = part.time_s[0]
        while start + WINDOW_S <= part.time_s[-1] + 0.05:
            rows = part.part((part.time_s >= start) & (part.time_s < start + WINDOW_S))
            if rows.rows >= LEAST_ROWS:
                own = identify(bundle, frame, [rows], whole.reach_m, whole.phi)
                told.append((part.recording.name, float(start), own))
            start += WINDOW_S
    return told
