"""Collisions as a monitor would have latched them: hold time and all, against a sensor with the same limit and hold."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.data import Recording
from tauext.data.estimates import COLLISION, Estimates
from tauext.evaluate.collisions import GRACE_S, Collision

STRONG = 1.5
"""A collision is strong whose sensor reference exceeds so many times the limit ..."""
STRONG_FOR_S = 0.02
"""... for so long beside the hold time: then it must be found."""


def judge_latched(collision: Collision, recording: Recording, estimates: Estimates, hold_s: float) -> dict:
    """Was it latched, how long after its onset, how long after the sensor would have been, and was it strong?

    The sensor reference is low-passed as the observer is, so that the observer's own lag is not held against the
    method; it gets the same limit at every sample, and the same hold time. What was over its limit before the touch
    began does not find it.
    """
    window = slice(collision.begin, min(collision.end + round(GRACE_S * recording.rate_hz), recording.samples))
    hold = round(hold_s * recording.rate_hz)
    latched = _first_rise(estimates.alarm == COLLISION, window)
    sensor, strong = None, False
    if recording.tau_ext_sensor is not None:
        size = np.abs(recording.tau_ext_sensor)
        sensor = _first_rise(held(size > estimates.limit, hold).any(axis=1), window)
        long = hold + round(STRONG_FOR_S * recording.rate_hz)
        strong = bool(held(size > STRONG * estimates.limit, long)[window].any())
    seconds = (recording.t_ns[window] - recording.t_ns[collision.begin]) * 1e-9
    both = latched is not None and sensor is not None
    return {
        "id": collision.id,
        "latched": latched is not None,
        "strong": strong,
        "delay_s": None if latched is None else float(seconds[latched]),
        "delay_against_sensor_s": float(seconds[latched] - seconds[sensor]) if both else None,
    }


def held(over: np.ndarray, hold_samples: int) -> np.ndarray:
    """Whether each flag and the hold_samples before it are all true: (samples, n), along the samples."""
    runs = np.cumsum(over, axis=0)
    before = np.zeros_like(runs)
    before[hold_samples + 1 :] = runs[: -hold_samples - 1]
    return runs - before == hold_samples + 1


def latched_summary(verdicts: Sequence[dict]) -> dict:
    """The entry `latched` of a case in results.json."""
    delays = [v["delay_against_sensor_s"] for v in verdicts if v["delay_against_sensor_s"] is not None]
    median, late = (float(np.quantile(delays, q)) if delays else None for q in (0.5, 0.95))
    return {
        "collisions": len(verdicts),
        "latched": sum(v["latched"] for v in verdicts),
        "strong": sum(v["strong"] for v in verdicts),
        "strong_latched": sum(v["strong"] and v["latched"] for v in verdicts),
        "delay_against_sensor_median_s": median,
        "delay_against_sensor_p95_s": late,
    }


def _first_rise(flags: np.ndarray, window: slice) -> int | None:
    """Index within the window of the first flag that is true after a false one."""
    before = bool(flags[window.start - 1]) if window.start else False
    rises = np.flatnonzero(flags[window] & ~np.append(before, flags[window][:-1]))
    return int(rises[0]) if len(rises) else None
