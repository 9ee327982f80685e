"""Clock and units: gaps, irregular or repeated samples, wrong units of time and angle."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tauext.check.finding import Finding, Severity
from tauext.check.motion import LEAST_CORRELATION, Stretch, repeated_rows
from tauext.data.recording import GAP_STEPS, Recording, fitted_period_ns, runs_of, unwrapped

# --- Time stamps and rows: gaps, irregular steps, rows that repeat the one before.


GAP = 3.0
"""A longer step is a gap, [sample periods]: a controller's cycle may lose one or two samples."""
IRREGULAR_BADLY = GAP_STEPS - 1
"""Above this share, jitter cannot be distinguished from lost samples; below it, training and monitor accept jitter."""


def lost_findings(recordings: Sequence[Recording]) -> list[Finding]:
    """Findings of rows that an import left out or sorted."""
    found = []
    for recording in recordings:
        facts = recording.provenance
        left_out, late = (float(facts.get(key, 0)) for key in ("dropped_share", "sorted_share"))
        if max(left_out, late) <= 0.01:
            continue
        evidence = f"'{recording.name}': {left_out:.1%} of the rows were left out, {late:.1%} sorted by their stamps"
        evidence += "".join(f"; {sentence}" for sentence in facts.get("dropped", []))
        advice = "look at the places named; the motion around them is cut, and limits miss what happened there"
        found.append(Finding("rows-dropped", "warning", None, evidence, advice, recording.name))
    return found


def gap_findings(recordings: Sequence[Recording]) -> list[Finding]:
    """Finding of gaps, all recordings together."""
    longest, count, period_ms = 0.0, 0, 0.0
    for recording in recordings:
        steps = np.diff(recording.t_ns) * 1e-6
        if not len(steps):
            continue
        period_ms = 1e-6 * fitted_period_ns(recording.t_ns)
        gaps = steps[steps > GAP * period_ms]
        count += len(gaps)
        longest = max(longest, float(gaps.max(initial=0)))
    if not count:
        return []
    evidence = f"{count} gaps of more than {GAP:g} sample periods ({period_ms:.3g} ms), the longest {longest:.4g} ms"
    advice = "the observer restarts after each; check for lost packets, or record on the controller"
    return [Finding("clock-gaps", "warning", None, evidence, advice)]


def jitter_findings(recordings: Sequence[Recording]) -> list[Finding]:
    """Finding of the recording whose steps differ most."""
    worst: tuple[float, str] = (0.0, "")
    for recording in recordings:
        if recording.samples < 100:
            continue
        low, high = np.percentile(np.diff(recording.t_ns) * 1e-6, [1, 99])
        period_ms = 1e-6 * fitted_period_ns(recording.t_ns)
        spread = float(high - low) / period_ms
        steps = f"'{recording.name}': steps of {low:.2f} to {high:.2f} ms (1 to 99 %), period {period_ms:.2f} ms"
        worst = max(worst, (spread, steps))
    # a clock on a busy computer stays below a tenth
    if worst[0] <= 0.25:
        return []
    advice = (
        "stamp samples where they are measured, not where they arrive: jitter of the clock disturbs velocities and r"
    )
    severity: Severity = "warning" if worst[0] > IRREGULAR_BADLY else "note"
    return [Finding("clock-irregular", severity, None, worst[1], advice)]


def repeat_findings(recordings: Sequence[Recording]) -> list[Finding]:
    """Finding of repeated rows, all recordings together."""
    repeats = [repeated_rows(r) for r in recordings]
    count, rows = sum(int(x.sum()) for x in repeats), sum(len(x) for x in repeats)
    # measured rows of several joints hardly ever agree in every bit
    if count < 3 or count / rows < 0.005:
        return []
    runs = np.concatenate([np.ptp(runs_of(x), axis=1) for x in repeats])
    fresh = np.concatenate([np.diff(r.t_ns[~x]) * 1e-6 for r, x in zip(recordings, repeats, strict=True)])
    severity: Severity = "warning" if count / rows >= 0.05 else "note"
    evidence = f"{count / rows:.1%} of the rows equal the row before ({len(runs)} runs, up to {runs.max()} repeats)"
    if len(fresh):
        evidence += (
            f"; distinct rows are {np.median(fresh):.3g} ms apart, "
            f"99 % within {np.percentile(fresh, 99):.3g} ms, {1e3 / fresh.mean():.0f} a second on average"
        )
    advice = (
        "the state is refreshed more slowly than it is logged: log it at its own rate; where it is several times "
        'slower, drop repeats at import ([time] repeats = "drop")'
    )
    return [Finding("repeated-rows", severity, None, evidence, advice)]


# --- Time stamps in another unit than declared, found from motion and velocity.


UNITS = (1e3, 1e6, 1e9, 60.0, 3600.0)
"""Ratios of units of time: seconds, their thousandths and so on, minutes, hours."""
SLOWEST_HZ, FASTEST_HZ = 5.0, 20_000.0
"""No training uses fewer samples a second, no arm sends more."""
CREEP_RAD_S, FLIES_RAD_S = 0.02, 50.0
"""Implausible speeds of an arm's fastest joint during smooth motion."""


@dataclass(frozen=True)
class TimeUnit:
    """Factor by which the time stamps are too large."""

    factor: float
    evidence: str
    velocity_derived: bool
    """Whether the velocity was derived with the same time stamps."""


def time_unit(recording: Recording) -> TimeUnit | None:
    """Unit error of a recording's time stamps; None: the stamps fit the motion, or nothing moves."""
    rows = ~repeated_rows(recording)
    q, dq, t = recording.q[rows], recording.dq[rows], recording.t_ns[rows]
    if len(t) < 100:
        return None
    moving = np.ptp(np.percentile(q, [1, 99], axis=0), axis=0) > 0.1
    if not moving.any():
        return None
    step_s = float(np.median(np.diff(t))) * 1e-9
    ratios = _ratios(q[:, moving], dq[:, moving], step_s)
    # the joints' ratios must agree
    if len(ratios) and np.ptp(np.log(ratios)) < 0.1:
        ratio = float(np.exp(np.median(np.log(ratios))))
        # deg/s, 57.3, stays apart from minutes, 60
        factor = next((f for u in UNITS for f in (u, 1 / u) if abs(math.log(ratio / f)) < 0.03), None)
        then_hz = factor / step_s if factor else 0.0
        if factor is not None and SLOWEST_HZ / 5 < then_hz < FASTEST_HZ * 5:
            evidence = (
                f"the velocity is {ratio:.4g} times the derivative of the position on "
                f"{'all' if len(ratios) > 1 else 'the'} {len(ratios)} joint{'s' if len(ratios) > 1 else ''} that move: "
                f"{1 / step_s:.4g} Hz would be {then_hz:.4g} Hz, {recording.duration_s:.4g} s "
                f"{recording.duration_s / factor:.4g} s"
            )
            return TimeUnit(factor, evidence, velocity_derived=False)
    return _impossible(q[:, moving], step_s, recording.duration_s)


def _ratios(q: np.ndarray, dq: np.ndarray, step_s: float) -> np.ndarray:
    """Ratio of recorded velocity to the derivative of position, for joints where the two correlate."""
    found = []
    width = 5
    moved = (q[width:] - q[:-width]) / (width * step_s)
    sums = np.cumsum(np.vstack([np.zeros(q.shape[1]), dq]), axis=0)
    recorded = (sums[width + 1 :] - sums[: -width - 1])[: len(moved)] / (width + 1)
    for a, b in zip(moved.T, recorded.T, strict=True):
        # robust against spikes
        keep = (np.abs(a) <= np.percentile(np.abs(a), 99.5)) & (np.abs(b) <= np.percentile(np.abs(b), 99.5))
        a, b = a[keep], b[keep]
        size = float(np.linalg.norm(a) * np.linalg.norm(b))
        correlation = float(a @ b) / size if size > 0 else 0.0
        if correlation > LEAST_CORRELATION:
            found.append(float(np.linalg.norm(b) / np.linalg.norm(a)))
    return np.array(found)


def _impossible(q: np.ndarray, step_s: float, seconds: float) -> TimeUnit | None:
    """Detect an implausible rate together with an implausible motion; used where the velocity agrees with the
    stamps."""
    rate_hz = 1 / step_s
    speed = np.abs(np.diff(q, axis=0)) / step_s
    fastest = float(np.percentile(speed, 99.5, axis=0).max())
    turns = np.abs(np.diff(q, 2, axis=0)).sum(axis=0) / np.maximum(np.abs(np.diff(q, axis=0)).sum(axis=0), 1e-12)
    # successive steps of a motion that is sampled densely hardly differ
    if float(turns.min()) > 0.2:
        return None
    slow = rate_hz < SLOWEST_HZ and fastest < CREEP_RAD_S
    fast = rate_hz > FASTEST_HZ and fastest > FLIES_RAD_S
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
    """Findings of time units, one for all recordings that agree, and the recordings with corrected clocks."""
    units = [time_unit(r) for r in recordings]
    wrong = [(r, u) for r, u in zip(recordings, units, strict=True) if u is not None]
    if not wrong:
        return [], list(recordings)
    corrected = [_corrected(r, u) if u else r for r, u in zip(recordings, units, strict=True)]
    if len(wrong) == len(recordings) and len({u.factor for _, u in wrong}) == 1:
        first, unit = wrong[0]
        evidence = f"'{first.name}': {unit.evidence}"
        return [Finding("time-unit", "fault", None, evidence, _advice(unit.factor))], corrected
    return [
        Finding("time-unit", "fault", None, f"'{r.name}': {u.evidence}", _advice(u.factor), r.name) for r, u in wrong
    ], corrected


def _advice(factor: float) -> str:
    way = f"{factor:.4g} times too long" if factor > 1 else f"{1 / factor:.4g} times too short"
    return f"the stamps are {way}: give their unit at import ([time] unit)"


def _corrected(recording: Recording, unit: TimeUnit) -> Recording:
    t_ns = np.round((recording.t_ns - recording.t_ns[0]) / unit.factor).astype(np.int64)
    if (np.diff(t_ns) <= 0).any():
        return recording
    dq = recording.dq * unit.factor if unit.velocity_derived else recording.dq
    return replace(recording, t_ns=t_ns, dq=dq, rate_hz=recording.rate_hz * unit.factor)


# --- Jumps of whole turns, which an import takes out.


def wrap_findings(recordings: Sequence[Recording]) -> tuple[list[Finding], list[Recording]]:
    """Findings of joints whose position jumps by whole turns, in rad or degrees, and the recordings without jumps."""
    jumps: dict[str, list[str]] = {}
    continuous = []
    for recording in recordings:
        q, counts = unwrapped(recording.q)
        if not counts.any():
            turned, counts = unwrapped(np.radians(recording.q))
            q = np.where(counts, np.degrees(turned), recording.q)
        for j in np.flatnonzero(counts):
            jumps.setdefault(recording.joints[j], []).append(f"{counts[j]} times in '{recording.name}'")
        continuous.append(replace(recording, q=q) if counts.any() else recording)
    advice = "import again: `tauext import` takes such jumps out"
    return [
        Finding("position-wraps", "fault", joint, f"the position jumps by whole turns {', '.join(places[:3])}", advice)
        for joint, places in jumps.items()
    ], continuous


# --- Degrees taken for radians, found from positions and their derivative alone, or against the robot file's limits.


WIDEST_RAD = 4.5 * math.pi
"""Cables allow a turn or two. One joint may turn further; two such joints suggest degrees."""


def degree_findings(
    recordings: Sequence[Recording],
    stretches: Sequence[Stretch],
    limits_rad: np.ndarray | None = None,
) -> list[Finding]:
    """Findings of joints whose position is in degrees; a finding without a joint concerns all joints.

    Args:
        limits_rad: (joints, 2) lower and upper limits of the robot file, infinite where it has none.
    """
    joints = recordings[0].joints
    far = np.max([np.abs(r.q).max(axis=0) for r in recordings], axis=0)
    fast = np.zeros(len(joints))
    if stretches:
        fast = np.max([np.percentile(np.abs(s.dq), 99.5, axis=0) for s in stretches], axis=0)
    beyond = np.zeros(len(joints), dtype=bool)
    if limits_rad is not None and np.isfinite(limits_rad).any():
        low, high = limits_rad[:, 0] - 0.1, limits_rad[:, 1] + 0.1
        turned = (np.radians(r.q) for r in recordings)
        within = np.all([((q >= low) & (q <= high)).all(axis=0) for q in turned], axis=0)
        beyond = within & (far > np.maximum(1.5 * np.abs(limits_rad).max(axis=1), 2 * math.pi))
    wide = far > WIDEST_RAD
    # no arm's joint turns faster; the wrists of small, fast arms reach 17 rad/s
    certain = (fast > 20.0) | (far > 2 * WIDEST_RAD)
    if wide.sum() >= 2 or beyond.sum() >= 2:
        certain |= wide | beyond
    if not certain.any():
        return []
    advice = "convert positions and velocities to radians at import"
    if certain.sum() >= min(2, len(joints)):
        j, k = int(np.argmax(far)), int(np.argmax(fast))
        evidence = (
            f"positions up to {far[j]:.4g} ('{joints[j]}'), changing by up to {fast[k]:.4g} a second ('{joints[k]}')"
        )
        if beyond.any():
            evidence += "; the robot file's limits fit degrees"
        return [Finding("degrees", "fault", None, evidence, advice)]
    j = int(np.argmax(certain))
    evidence = (
        f"positions up to {far[j]:.4g}, changing by up to {fast[j]:.4g} a second; the other joints are in radians"
    )
    return [Finding("degrees", "fault", joints[j], evidence, advice)]
