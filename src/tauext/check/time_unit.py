"""Time stamps in another unit than said: the motion and the velocity tell what a step takes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tauext.check.finding import Finding
from tauext.check.motion import repeated_rows
from tauext.data.recording import Recording

UNITS = (1e3, 1e6, 1e9, 60.0, 3600.0)
"""Ratios of units of time: seconds, their thousandths and so on, minutes, hours."""
OFF = 0.03
"""Deg/s, 57.3, stays apart from minutes, 60."""
AGREE = 0.05
"""Joints' ratios lie within this."""
LEAST_CORRELATION = 0.9
LEAST_RAD = 0.1
"""A joint that moves by less tells nothing."""
SLOWEST_HZ, FASTEST_HZ = 5.0, 20_000.0
"""Nobody trains on fewer samples a second, no arm sends more."""
CREEP_RAD_S, FASTEST_RAD_S = 0.02, 50.0
"""An arm whose fastest joint creeps like this, or flies like this, while its samples follow a smooth motion."""
SMOOTH = 0.2
"""A step of the motion is that share of the step before, or less, off it: the samples are close together."""


@dataclass(frozen=True)
class TimeUnit:
    """The stamps are so many times too large."""

    factor: float
    evidence: str
    velocity_derived: bool
    """The velocity was made with the same stamps."""


def time_unit(recording: Recording) -> TimeUnit | None:
    """None where the stamps fit the motion, or nothing moves."""
    rows = ~repeated_rows(recording)
    q, dq, t = recording.q[rows], recording.dq[rows], recording.t_ns[rows]
    if len(t) < 100:
        return None
    moving = np.ptp(np.percentile(q, [1, 99], axis=0), axis=0) > LEAST_RAD
    if not moving.any():
        return None
    step_s = float(np.median(np.diff(t))) * 1e-9
    ratios = _ratios(q[:, moving], dq[:, moving], step_s)
    if len(ratios) and np.ptp(np.log(ratios)) < 2 * AGREE:
        said = float(np.exp(np.median(np.log(ratios))))
        factor = next((f for u in UNITS for f in (u, 1 / u) if abs(math.log(said / f)) < OFF), None)
        then_hz = factor / step_s if factor else 0.0
        if factor is not None and SLOWEST_HZ / 5 < then_hz < FASTEST_HZ * 5:
            evidence = (
                f"the velocity is {said:.4g} times the derivative of the position on "
                f"{'all' if len(ratios) > 1 else 'the'} {len(ratios)} joint{'s' if len(ratios) > 1 else ''} that move: "
                f"{1 / step_s:.4g} Hz would be {then_hz:.4g} Hz, {recording.duration_s:.4g} s "
                f"{recording.duration_s / factor:.4g} s"
            )
            return TimeUnit(factor, evidence, velocity_derived=False)
    return _impossible(q[:, moving], step_s, recording.duration_s)


def _ratios(q: np.ndarray, dq: np.ndarray, step_s: float) -> np.ndarray:
    """Recorded velocity by the derivative of the position, of the joints where they go together."""
    found = []
    width = 5
    moved = (q[width:] - q[:-width]) / (width * step_s)
    sums = np.cumsum(np.vstack([np.zeros(q.shape[1]), dq]), axis=0)
    said = (sums[width + 1 :] - sums[: -width - 1])[: len(moved)] / (width + 1)
    for a, b in zip(moved.T, said.T, strict=True):
        # a spike must not decide
        keep = (np.abs(a) <= np.percentile(np.abs(a), 99.5)) & (np.abs(b) <= np.percentile(np.abs(b), 99.5))
        a, b = a[keep], b[keep]
        size = float(np.linalg.norm(a) * np.linalg.norm(b))
        correlation = float(a @ b) / size if size > 0 else 0.0
        if correlation > LEAST_CORRELATION:
            found.append(float(np.linalg.norm(b) / np.linalg.norm(a)))
    return np.array(found)


def _impossible(q: np.ndarray, step_s: float, seconds: float) -> TimeUnit | None:
    """Of a velocity that says the same: a rate that none has, and motion that no arm makes."""
    rate_hz = 1 / step_s
    speed = np.abs(np.diff(q, axis=0)) / step_s
    fastest = float(np.percentile(speed, 99.5, axis=0).max())
    turns = np.abs(np.diff(q, 2, axis=0)).sum(axis=0) / np.maximum(np.abs(np.diff(q, axis=0)).sum(axis=0), 1e-12)
    if float(turns.min()) > SMOOTH:
        return None
    slow = rate_hz < SLOWEST_HZ and fastest < CREEP_RAD_S
    fast = rate_hz > FASTEST_HZ and fastest > FASTEST_RAD_S
    if not slow and not fast:
        return None
    aimed = 200.0  # samples a second, the middle of what arms send
    factor = 1e3 ** round(math.log(aimed / rate_hz, 1e3)) if slow or fast else 1.0
    if factor == 1:
        return None
    evidence = (
        f"{rate_hz:.4g} Hz for {seconds:.4g} s, and the fastest joint turns at {fastest:.3g} rad/s: "
        f"{rate_hz * factor:.4g} Hz, {seconds / factor:.4g} s and {fastest * factor:.3g} rad/s would be an arm's"
    )
    return TimeUnit(factor, evidence, velocity_derived=True)


def time_findings(recordings: Sequence[Recording]) -> tuple[list[Finding], list[Recording]]:
    """Findings, one for all recordings where they agree; and the recordings on the clock that their motion tells."""
    units = [time_unit(r) for r in recordings]
    wrong = [(r, u) for r, u in zip(recordings, units, strict=True) if u is not None]
    if not wrong:
        return [], list(recordings)
    mended = [_mended(r, u) if u else r for r, u in zip(recordings, units, strict=True)]
    if len(wrong) == len(recordings) and len({u.factor for _, u in wrong}) == 1:
        first, unit = wrong[0]
        evidence = f"'{first.name}': {unit.evidence}"
        return [Finding("time-unit", "fault", None, evidence, _advice(unit.factor))], mended
    return [
        Finding("time-unit", "fault", None, f"'{r.name}': {u.evidence}", _advice(u.factor), r.name) for r, u in wrong
    ], mended


def _advice(factor: float) -> str:
    way = f"{factor:.4g} times too long" if factor > 1 else f"{1 / factor:.4g} times too short"
    return f"the stamps are {way}: give their unit at import ([time] unit)"


def _mended(recording: Recording, unit: TimeUnit) -> Recording:
    t_ns = np.round((recording.t_ns - recording.t_ns[0]) / unit.factor).astype(np.int64)
    if (np.diff(t_ns) <= 0).any():
        return recording
    dq = recording.dq * unit.factor if unit.velocity_derived else recording.dq
    return replace(recording, t_ns=t_ns, dq=dq, rate_hz=recording.rate_hz * unit.factor)
