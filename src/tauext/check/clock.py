"""Clock and units: gaps, irregular or repeated samples, wrong units of time, angle and velocity."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tauext.check.examination import Examination
from tauext.check.finding import Finding, Severity
from tauext.check.motion import DEGREES, LEAST_CORRELATION, Stretch, compare, repeated_rows
from tauext.data.recording import GAP_STEPS, Recording, fitted_period_ns, runs_of, unwrapped
from tauext.data.servo import derives_velocity

# --- Time stamps and rows: gaps, irregular steps, rows that repeat the one before.


def lost_findings(x: Examination) -> Iterator[Finding]:
    """Findings of rows that an import left out or sorted."""
    for recording in x.recordings:
        facts = recording.provenance
        left_out, late = (float(facts.get(key, 0)) for key in ("dropped_share", "sorted_share"))
        if max(left_out, late) <= 0.01:
            continue
        evidence = f"'{recording.name}': {left_out:.1%} of the rows were left out, {late:.1%} sorted by their stamps"
        evidence += "".join(f"; {sentence}" for sentence in facts.get("dropped", []))
        advice = "look at the places named; the motion around them is cut, and thresholds miss what happened there"
        yield Finding("rows-dropped", "warning", None, evidence, advice, recording.name)


def gap_findings(x: Examination) -> Iterator[Finding]:
    """Finding of gaps, all recordings together: a controller's cycle may lose one or two samples."""
    longest, count, period_ms = 0.0, 0, 0.0
    for recording in x.recordings:
        steps = np.diff(recording.t_ns) * 1e-6
        if not len(steps):
            continue
        period_ms = 1e-6 * fitted_period_ns(recording.t_ns)
        gaps = steps[steps > 3.0 * period_ms]
        count += len(gaps)
        longest = max(longest, float(gaps.max(initial=0)))
    if count:
        evidence = f"{count} gaps of more than 3 sample periods ({period_ms:.3g} ms), the longest {longest:.4g} ms"
        advice = "the observer restarts after each; check for lost packets, or record on the controller"
        yield Finding("clock-gaps", "warning", None, evidence, advice)


def jitter_findings(x: Examination) -> Iterator[Finding]:
    """Finding of the recording whose steps differ most: a clock on a busy computer stays below a tenth."""
    worst: tuple[float, str] = (0.0, "")
    for recording in x.recordings:
        if recording.samples < 100:
            continue
        low, high = np.percentile(np.diff(recording.t_ns) * 1e-6, [1, 99])
        period_ms = 1e-6 * fitted_period_ns(recording.t_ns)
        steps = f"'{recording.name}': steps of {low:.2f} to {high:.2f} ms (1 to 99 %), period {period_ms:.2f} ms"
        worst = max(worst, (float(high - low) / period_ms, steps))
    if worst[0] > 0.25:
        advice = (
            "stamp samples where they are measured, not where they arrive: jitter of the clock disturbs velocities and "
            "r"
        )
        # less can be distinguished from lost samples, and training and monitor accept it
        severity: Severity = "warning" if worst[0] > GAP_STEPS - 1 else "note"
        yield Finding("clock-irregular", severity, None, worst[1], advice)


def repeat_findings(x: Examination) -> Iterator[Finding]:
    """Finding of repeated rows, all recordings together: measured rows hardly ever agree in every bit."""
    repeats = [repeated_rows(r) for r in x.recordings]
    count, rows = sum(int(one.sum()) for one in repeats), sum(map(len, repeats))
    if count < 3 or count / rows < 0.005:
        return
    runs = np.concatenate([np.ptp(runs_of(one), axis=1) for one in repeats])
    fresh = np.concatenate([np.diff(r.t_ns[~one]) * 1e-6 for r, one in zip(x.recordings, repeats, strict=True)])
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
    yield Finding("repeated-rows", "warning" if count / rows >= 0.05 else "note", None, evidence, advice)


# --- Time stamps in another unit than declared, found from motion and velocity.


UNITS = (1e3, 1e6, 1e9, 60.0, 3600.0)  # ratios of units of time: seconds, their thousandths and so on, minutes, hours
SLOWEST_HZ, FASTEST_HZ = 5.0, 20_000.0  # no training uses fewer samples a second, no arm sends more


@dataclass(frozen=True)
class TimeUnit:
    """Factor by which the time stamps are too large."""

    factor: float
    evidence: str
    velocity_derived: bool  # whether the velocity was derived with the same time stamps

    def corrected(self, recording: Recording) -> Recording:
        t_ns = np.round((recording.t_ns - recording.t_ns[0]) / self.factor).astype(np.int64)
        if (np.diff(t_ns) <= 0).any():
            return recording
        dq = recording.dq * self.factor if self.velocity_derived else recording.dq
        return replace(recording, t_ns=t_ns, dq=dq, rate_hz=recording.rate_hz * self.factor)

    def finding(self, first: str, recording: str | None) -> Finding:
        way = f"{self.factor:.4g} times too long" if self.factor > 1 else f"{1 / self.factor:.4g} times too short"
        advice = f"the stamps are {way}: give their unit at import ([time] unit)"
        return Finding("time-unit", "fault", None, f"'{first}': {self.evidence}", advice, recording)


def time_findings(x: Examination) -> Iterator[Finding]:
    """Findings of time units, one for all recordings that agree; corrects the clocks."""
    units = [time_unit(r) for r in x.recordings]
    wrong = [(r.name, unit) for r, unit in zip(x.recordings, units, strict=True) if unit is not None]
    if not wrong:
        return
    if len(wrong) == len(units) and len({unit.factor for _, unit in wrong}) == 1:
        yield wrong[0][1].finding(wrong[0][0], None)
    else:
        yield from (unit.finding(name, name) for name, unit in wrong)
    x.correct(recordings=[unit.corrected(r) if unit else r for r, unit in zip(x.recordings, units, strict=True)])


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
        if size > 0 and float(a @ b) / size > LEAST_CORRELATION:
            found.append(float(np.linalg.norm(b) / np.linalg.norm(a)))
    return np.array(found)


def _impossible(q: np.ndarray, step_s: float, seconds: float) -> TimeUnit | None:
    """An implausible rate together with an implausible motion, where the velocity agrees with the stamps."""
    rate_hz = 1 / step_s
    steps = np.abs(np.diff(q, axis=0))
    fastest = float(np.percentile(steps / step_s, 99.5, axis=0).max())
    turns = np.abs(np.diff(q, 2, axis=0)).sum(axis=0) / np.maximum(steps.sum(axis=0), 1e-12)
    slow = rate_hz < SLOWEST_HZ and fastest < 0.02  # [rad/s], of the fastest joint
    fast = rate_hz > FASTEST_HZ and fastest > 50.0
    # successive steps of a motion that is sampled densely hardly differ
    if float(turns.min()) > 0.2 or not (slow or fast):
        return None
    factor = 1e3 ** round(math.log(200.0 / rate_hz, 1e3))  # towards 200 Hz, the middle of what arms send
    if factor == 1:
        return None
    evidence = (
        f"{rate_hz:.4g} Hz for {seconds:.4g} s, and the fastest joint turns at {fastest:.3g} rad/s: "
        f"{rate_hz * factor:.4g} Hz, {seconds / factor:.4g} s and {fastest * factor:.3g} rad/s would be an arm's"
    )
    return TimeUnit(factor, evidence, velocity_derived=True)


# --- Positions: jumps of whole turns, which an import takes out, and degrees taken for radians.


def wrap_findings(x: Examination) -> Iterator[Finding]:
    """Findings of joints whose position jumps by whole turns, in rad or degrees; takes the jumps out."""
    jumps: dict[str, list[str]] = {}
    continuous = []
    for recording in x.recordings:
        q, counts = unwrapped(recording.q)
        if not counts.any():
            turned, counts = unwrapped(np.radians(recording.q))
            q = np.where(counts, np.degrees(turned), recording.q)
        for j in np.flatnonzero(counts):
            jumps.setdefault(recording.joints[j], []).append(f"{counts[j]} times in '{recording.name}'")
        continuous.append(replace(recording, q=q) if counts.any() else recording)
    for joint, places in jumps.items():
        evidence = f"the position jumps by whole turns {', '.join(places[:3])}"
        advice = "import again: `tauext import` takes such jumps out"
        yield Finding("position-wraps", "fault", joint, evidence, advice)
    if jumps:
        x.correct(recordings=continuous)


def degree_findings(x: Examination) -> Iterator[Finding]:
    """Finding of positions in degrees, of one joint or all, by their size, their derivative or the robot file's limits;
    converts positions and velocities."""
    joints, limits_rad = x.joints, x.position_limits_rad
    far = np.max([np.abs(r.q).max(axis=0) for r in x.recordings], axis=0)
    fast = np.max([np.zeros(len(joints)), *(np.percentile(np.abs(s.dq), 99.5, axis=0) for s in x.motion)], axis=0)
    beyond = np.zeros(len(joints), dtype=bool)
    if limits_rad is not None and np.isfinite(limits_rad).any():
        low, high = limits_rad[:, 0] - 0.1, limits_rad[:, 1] + 0.1
        turned = (np.radians(r.q) for r in x.recordings)
        within = np.all([((q >= low) & (q <= high)).all(axis=0) for q in turned], axis=0)
        beyond = within & (far > np.maximum(1.5 * np.abs(limits_rad).max(axis=1), 2 * math.pi))
    # cables allow a turn or two; one joint may turn further, two such joints suggest degrees
    widest_rad = 4.5 * math.pi
    wide = far > widest_rad
    # no arm's joint turns faster, [rad/s]; the wrists of small, fast arms reach 17
    certain = (fast > 20.0) | (far > 2 * widest_rad)
    if wide.sum() >= 2 or beyond.sum() >= 2:
        certain |= wide | beyond
    if not certain.any():
        return
    every = certain.sum() >= min(2, len(joints))
    j, k = (int(np.argmax(far)), int(np.argmax(fast))) if every else (int(np.argmax(certain)),) * 2
    if every:
        evidence = (
            f"positions up to {far[j]:.4g} ('{joints[j]}'), changing by up to {fast[k]:.4g} a second ('{joints[k]}')"
        )
        evidence += "; the robot file's limits fit degrees" if beyond.any() else ""
    else:
        evidence = (
            f"positions up to {far[j]:.4g}, changing by up to {fast[j]:.4g} a second; the other joints are in radians"
        )
    advice = "convert positions and velocities to radians at import"
    yield Finding("degrees", "fault", None if every else joints[j], evidence, advice)
    by = np.where(every | (np.arange(len(joints)) == j), DEGREES, 1.0)
    x.correct(recordings=[replace(r, q=r.q / by, dq=r.dq / by) for r in x.recordings])


# --- Velocity against the derivative of position: unit, sign, delay, order.


def velocity_findings(x: Examination) -> Iterator[Finding]:
    """Findings of each joint's velocity; converts positions that the velocity shows to be in degrees."""
    x.velocities = [compare(x.motion, j) for j in range(len(x.joints))]
    positions = np.ones(len(x.joints))
    derived = any(map(derives_velocity, x.recordings))
    least_s = max(0.010, 1.25 / x.motion[0].rate_hz)  # a drive's filter lags by 1 to 5 ms; prior and network suffer
    for j, (joint, fit) in enumerate(zip(x.joints, x.velocities, strict=True)):
        if fit is None:
            continue
        relation = f"velocity = {fit.factor:.4g} times the derivative of position, correlation {fit.correlation:.3f}"
        size = abs(fit.factor)
        if fit.correlation < LEAST_CORRELATION:
            yield _unlike(x.motion, x.joints, j, relation)
        elif abs(size * DEGREES - 1) < 0.1:
            positions[j] = DEGREES
            evidence = f"{relation}: 1 / 57.3, so that positions are in degrees and velocities in rad/s"
            advice = "convert positions to radians at import; or the velocity is in rad/s and was imported as deg/s"
            yield Finding("degrees", "fault", joint, evidence, advice)
        elif fit.factor < 0:
            yield Finding("velocity-sign", "fault", joint, relation, "negate the velocity at import")
        elif abs(size - 1) > 0.1:
            evidence = f"{relation}{_guess(size)}"
            yield Finding("velocity-unit", "fault", joint, evidence, "convert it to rad/s at import")
        # the delay of a derived velocity's window is intended
        if not derived and fit.correlation >= LEAST_CORRELATION and abs(fit.lag_s) > least_s:
            way = "after" if fit.lag_s > 0 else "before"
            evidence = f"velocity comes {abs(fit.lag_s) * 1e3:.0f} ms {way} the derivative of position"
            advice = (
                "use a velocity of less filtering, or derive it from position (causally) at import and in the monitor"
            )
            yield Finding("velocity-delay", "warning", joint, evidence, advice)
    if (positions != 1).any():
        x.correct(recordings=[replace(r, q=r.q / positions) for r in x.recordings])


def _unlike(motion: Sequence[Stretch], joints: Sequence[str], j: int, relation: str) -> Finding:
    others = [(compare(motion, j, k), name) for k, name in enumerate(joints) if k != j]
    correlation, name = max(((fit.correlation, name) for fit, name in others if fit is not None), default=(0.0, ""))
    if correlation > LEAST_CORRELATION:
        evidence = f"{relation}, but {correlation:.3f} with that of '{name}'"
        return Finding("joint-order", "fault", joints[j], evidence, "map positions and velocities by name at import")
    advice = "it may be a commanded, a Cartesian or a stale velocity: derive it from position at import"
    return Finding("velocity-mismatch", "fault", joints[j], relation, advice)


def _guess(size: float) -> str:
    known = {
        DEGREES: ": it is in deg/s, or the position is in rad and was imported as degrees",
        60 / (2 * math.pi): ": it is in turns a minute",
        1 / (2 * math.pi): ": it is in turns a second",
    }
    other = ": motor side, perhaps" if size > 20 else ""
    return next((what for factor, what in known.items() if abs(size / factor - 1) < 0.05), other)
