"""Collisions as a monitor would have latched them: hold time and all, against a sensor with the same limit and hold."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.bundle.estimates import COLLISION, Estimates
from tauext.data.recording import Recording
from tauext.evaluate.collisions import GRACE_S, Collision, first_rise

STRONG = 1.5
"""A collision is strong whose sensor reference exceeds so many times the limit ..."""
STRONG_FOR_S = 0.02
"""... for so long beside the hold time: then it must be found."""


def judge_latched(
    collision: Collision, recording: Recording, estimates: Estimates, hold_s: float, reference: np.ndarray | None
) -> dict:
    """Was it latched, how long after its onset, how long after the sensor would have been, and was it strong?

    The reference is low-passed as the observer is (`sensor_reference`), so that the observer's own lag is not held
    against the method; it gets the same limit at every sample, and the same hold time. What was over its limit before
    the touch began does not find it.
    """
    hold = round(hold_s * recording.rate_hz)
    long = hold + round(STRONG_FOR_S * recording.rate_hz)
    # The sample before the onset, and as many before that as the longest hold time asks for.
    first = max(collision.begin - 1 - long, 0)
    last = min(collision.end + round(GRACE_S * recording.rate_hz), recording.samples)
    part, window = slice(first, last), slice(collision.begin - first, last - first)
    assert estimates.held_alarm is not None
    latched = _first_rise_in(estimates.held_alarm[part] == COLLISION, window)
    sensor, strong = None, False
    if reference is not None:
        size, limit = np.abs(reference[part]), estimates.limit[part]
        sensor = _first_rise_in(np.asarray(held(size > limit, hold).any(axis=1)), window)
        strong = bool(held(size > STRONG * limit, long)[window].any())
    seconds = (recording.t_ns[collision.begin : last] - recording.t_ns[collision.begin]) * 1e-9
    both = latched is not None and sensor is not None
    return {
        "id": collision.id,
        "latched": latched is not None,
        "strong": strong,
        "unhealthy": bool(np.mean(estimates.healthy[collision.begin : collision.end]) < 0.5),
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
    """The entry `latched` of a bundle in results.json."""
    delays: dict[str, float | None] = {}
    for key in ("delay", "delay_against_sensor"):
        known = [v[f"{key}_s"] for v in verdicts if v[f"{key}_s"] is not None]
        for name, quantile in (("median", 0.5), ("p95", 0.95)):
            delays[f"{key}_{name}_s"] = float(np.quantile(known, quantile)) if known else None
    return {
        "collisions": len(verdicts),
        "latched": sum(v["latched"] for v in verdicts),
        "strong": sum(v["strong"] for v in verdicts),
        "unhealthy": sum(v["unhealthy"] for v in verdicts),
        "strong_latched": sum(v["strong"] and v["latched"] for v in verdicts),
        **delays,
    }


def _first_rise_in(flags: np.ndarray, window: slice) -> int | None:
    """Index within the window of the first flag that is true after a false one."""
    return first_rise(flags[window], bool(flags[window.start - 1]) if window.start else False)
