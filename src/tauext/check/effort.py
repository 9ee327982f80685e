"""The torque signal: sign, unit, delay, drift, steps, and whether the motion excites it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext.check.finding import NEGATE_EFFORT, Finding
from tauext.check.joint_fit import (
    CONSTANT,
    FRICTION,
    SIGN,
    FitRows,
    JointFit,
    basis_of,
    columns_of,
    robust_solve,
    spread_of,
    torque_rows,
)
from tauext.check.motion import MOVING_RAD_S, Stretch
from tauext.data.recording import Recording

# --- Sign of a joint's torque, from friction, inertia and gravity.


MOST = 6.0
"""Limit of each term, [standard errors]: a wrong model can have a small standard error."""


@dataclass(frozen=True)
class SignVote:
    """Terms of friction, inertia and gravity: value / standard error, times the term's share of the torque."""

    friction: float
    inertia: float
    gravity: float
    power_w: float  # mean of torque times speed
    friction_nm_s: float  # friction power by squared speed
    inertia_kg_m2: float

    @property
    def motion(self) -> float:
        """Sum of friction and inertia, which do not depend on the model."""
        return self.friction + self.inertia

    @property
    def total(self) -> float:
        return self.motion + self.gravity


def sign_vote(rows: FitRows, joint: int, fit: JointFit) -> SignVote:
    dq, acceleration = rows.dq[:, joint], rows.acceleration[:, joint]
    columns = np.column_stack([rows.inertial[:, joint], acceleration])
    by_speed = (rows.friction[:, joint] * dq[:, None]).mean(axis=0) / max(float((dq**2).mean()), 1e-12)
    by_speed[0] = 0.0
    by_acceleration = (columns * acceleration[:, None]).mean(axis=0) / max(float((acceleration**2).mean()), 1e-12)
    friction = fit.left_out[:, CONSTANT : CONSTANT + FRICTION] @ by_speed
    inertia = fit.left_out[:, 1:3] @ by_acceleration

    def witness(value: float, spread: float, part_nm: float) -> float:
        if part_nm == 0 or fit.torque_nm == 0:
            return 0.0
        return float(np.clip(value / max(spread, 1e-9 * abs(value) + 1e-12), -MOST, MOST)) * part_nm / fit.torque_nm

    friction_now = float(fit.weights[CONSTANT : CONSTANT + FRICTION] @ by_speed)
    inertia_now = float(fit.weights[1:3] @ by_acceleration)
    return SignVote(
        witness(friction_now, spread_of(friction), fit.friction_nm),
        witness(inertia_now, spread_of(inertia), fit.inertial_nm),
        witness(*fit.gravity_factor, fit.gravity_nm) if rows.has_model else 0.0,
        float((rows.tau[:, joint] * dq).mean()),
        friction_now,
        inertia_now,
    )


# --- Kind of the effort: joint torque, scaled, inverted, without gravity, or external torque.


CERTAIN = 1.5
"""Sum of terms (standard errors times share of torque) that makes a sign certain; good data reach 3 to 6."""
LOW, HIGH = 0.7, 1.45
"""Good torques have factors in this range, given payload, cables and rough models."""
MOTOR_SIDE = 1 / 20
"""Factors below it mean torque before the gear: gear ratios exceed 30, and no joint's torque constant is so small in
Nm/A."""


def inverted(vote: SignVote) -> bool:
    """Whether the sign is inverted. Friction, inertia and mean power decide where they are conclusive, else gravity."""
    if vote.motion < -1.0 and vote.power_w < 0:
        return True
    if vote.motion < -CERTAIN:
        return vote.gravity < -CERTAIN
    return abs(vote.motion) <= 0.5 and vote.total < -CERTAIN


def sign_findings(
    joints: Sequence[str], votes: Sequence[SignVote], fits: Sequence[JointFit], unit: str
) -> list[Finding]:
    """Findings of inverted signs; `unit` is the effort's."""
    power = "W" if unit == "Nm" else f"{unit} rad/s"
    found = []
    for joint, vote, fit in zip(joints, votes, fits, strict=True):
        if inverted(vote):
            factor, error = fit.gravity_factor
            parts = [f"torque times speed is {vote.power_w:.3g} {power} on average"]
            parts += (
                [f"friction resists with {vote.friction_nm_s:.3g} {unit}s/rad, must be > 0"] if fit.friction_nm else []
            )
            parts += [f"gravity factor {factor:.3g} ± {error:.1g}"] if factor else []
            found.append(Finding("effort-sign", "fault", joint, "; ".join(parts), NEGATE_EFFORT))
    return found


def strong_joints(rows: FitRows, fits: Sequence[JointFit]) -> list[int]:
    """Joints whose gravity, of the model or as fitted, is large enough to judge its factor."""
    return [
        j
        for j, fit in enumerate(fits)
        if fit.torque_nm > 0
        and rows.gravity[:, j].std() > 0.02 * rows.gravity.std(axis=0).max()
        and (rows.gravity[:, j].std() > 0.3 * fit.torque_nm or fit.gravity_nm > 0.2 * fit.torque_nm)
    ]


def far_findings(rows: FitRows, joints: Sequence[str], fits: Sequence[JointFit], unit: str) -> list[Finding]:
    """Findings of efforts far larger than the model's torque."""
    model_nm, gravity_nm = rows.model.std(axis=0), rows.gravity.std(axis=0)
    found = []
    for j, fit in enumerate(fits):
        # no friction of a loaded joint is so large
        if gravity_nm[j] > 0.02 * gravity_nm.max() and fit.torque_nm > 50.0 * model_nm[j]:
            evidence = (
                f"the effort varies by {fit.torque_nm:.3g} {unit}, gravity and inertia of the model by "
                f"{model_nm[j]:.3g} Nm: {fit.torque_nm / model_nm[j]:.2g} times as much"
            )
            advice = "another unit, mNm or encoder counts for instance: convert it to Nm at import"
            found.append(Finding("effort-scale", "fault", joints[j], evidence, advice))
    return found


def unit_findings(joints: Sequence[str], fits: Sequence[JointFit]) -> list[Finding]:
    """Findings of efforts in another unit, without a model: impossible torques, or joints far apart from the others."""
    found = []
    advice = "another unit, mNm for instance: convert it to Nm at import"
    spread = np.array([fit.torque_nm for fit in fits])
    order = [j for j in np.argsort(-spread) if spread[j] > 0]
    # no arm has two successive joints, sorted by the spread of their torque, that are so far apart
    far = next((k for k in range(1, len(order)) if spread[order[k - 1]] > 100.0 * spread[order[k]]), 0)
    for j in sorted(order[:far]):
        next_nm, other = spread[order[far]], joints[order[far]]
        evidence = f"the effort varies by {spread[j]:.3g} Nm, that of '{other}' by {next_nm:.3g} Nm"
        found.append(Finding("effort-scale", "fault", joints[j], evidence, advice))
    for j in order[far:]:
        # no joint of an arm turns with more, [N m], except those of a few giants
        if spread[j] > 2e4:
            evidence = f"the effort varies by {spread[j]:.3g} Nm, more than any joint gives"
            found.append(Finding("effort-scale", "fault", joints[j], evidence, advice))
    return found


def kind_findings(
    rows: FitRows, joints: Sequence[str], fits: Sequence[JointFit], strong: Sequence[int]
) -> tuple[list[Finding], list[int]]:
    """Findings of efforts without gravity or before the gear, and the strong joints without such a finding."""
    found, left = [], []
    for j in strong:
        fit, (factor, error) = fits[j], fits[j].gravity_factor
        code, absent = "effort-compensated", abs(factor) < 0.15
        if absent and fit.explained < 0.5:
            shown = f"; gravity, inertia and friction explain {max(0.0, fit.explained):.0%} of the effort"
            advice = "this is already an external torque or an error: record the motor's or joint's torque instead"
        elif absent and fit.gravity_nm < 0.2 * fit.torque_nm:  # with more gravity, the unit is too small
            shown = f"; friction and inertia explain {fit.explained:.0%} of the effort"
            advice = "the driver subtracts gravity: record the uncompensated torque, or add g(q) of the model at import"
        elif 0 < factor < MOTOR_SIDE and error < 0.3 * factor:
            code, shown = "effort-motor-side", f": 1 / {1 / factor:.3g}"
            advice = f"the torque before the gear: multiply by the gear ratio (about {1 / factor:.3g}) at import"
        else:
            left.append(j)
            continue
        model_nm = float(rows.gravity[:, j].std())
        evidence = f"gravity factor {factor:.3g} ± {error:.1g} where the model's gravity varies by {model_nm:.3g} Nm"
        found.append(Finding(code, "fault", joints[j], evidence + shown, advice))
    return found, left


def scale_findings(joints: Sequence[str], fits: Sequence[JointFit], judged: Sequence[int]) -> list[Finding]:
    """Findings of factors outside the range of good torques."""
    found = []
    for j in judged:
        factor, error = fits[j].gravity_factor
        if LOW <= factor <= HIGH or factor <= 0 or abs(factor - 1) < 4 * error:
            continue
        inertial, inertial_error = fits[j].inertial_factor
        evidence = f"effort = {factor:.3g} ± {error:.1g} times the model's gravity"
        if inertial and inertial_error < 0.3 * abs(inertial):
            evidence += f", {inertial:.3g} ± {inertial_error:.1g} times its inertial torque"
        advice = (
            f"a current or another unit: multiply by {1 / factor:.3g} (for a current, this is its torque constant in "
            "Nm/A); or a payload that is not in the model, where factors grow towards the tip; or another arm's robot "
            "file, where they differ without order"
        )
        found.append(Finding("effort-scale", "fault", joints[j], evidence, advice))
    return found


# --- Delay of the torque against the motion.


def torque_lags(stretches: Sequence[Stretch], rows: FitRows) -> list[tuple[float, float, float]]:
    """Per joint: lag of least error [s], that error as a share of the one at lag 0, and the share explained there.

    Without a model gravity is known roughly, and an error that falls up to the largest lag is no delay: share 1.
    """
    lags = np.linspace(-0.1, 0.1, 21)
    weights, torques = [], [torque_rows(stretches, lag) for lag in lags]
    errors = np.empty((len(lags), rows.joints))
    for j in range(rows.joints):
        columns = columns_of(rows, j)
        if rows.has_model:  # friction that grows with the load would show as a delay
            columns = np.column_stack([columns, np.abs(rows.gravity[:, j]) * rows.friction[:, j, SIGN]])
        trust = robust_solve(columns, rows.tau[:, j])[1]
        root = np.sqrt(trust)
        size = np.maximum(np.sqrt((columns**2).mean(axis=0)), 1e-9)
        basis = basis_of(root[:, None] * columns / size)
        for k, torque in enumerate(torques):
            y = root * torque[:, j]
            errors[k, j] = np.sqrt(((y - basis @ (basis.T @ y)) ** 2).mean())
        weights.append(float(np.average((rows.tau[:, j] - rows.tau[:, j].mean()) ** 2, weights=trust)) ** 0.5)
    found = []
    for j in range(rows.joints):
        best, squared = int(np.argmin(errors[:, j])), errors[:, j] ** 2
        lag, least = lags[best], squared[best]
        if 0 < best < len(lags) - 1:
            a, b, c = squared[best - 1 : best + 2]
            if a - 2 * b + c > 0:
                shift = 0.5 * (a - c) / (a - 2 * b + c)
                lag, least = lag + shift * (lags[1] - lags[0]), b - 0.25 * (a - c) * shift
        zero = errors[len(lags) // 2, j]
        inside = rows.has_model or 0 < best < len(lags) - 1
        ratio = float(np.sqrt(max(least, 0)) / zero) if zero > 0 and inside else 1.0
        found.append((float(lag), ratio, 1 - max(least, 0) / max(weights[j] ** 2, 1e-18)))
    return found


def delay_findings(
    lags: Sequence[tuple[float, float, float]], joints: Sequence[str], period_s: float
) -> tuple[list[Finding], float]:
    """Findings of delays, and one lag for all joints [s]; 0: none."""
    # filter and bus cycle cause 1 to 5 ms, presliding and elasticity more; friction at reversals lowers the error, too
    late = [
        (lag, j)
        for j, (lag, ratio, explained) in enumerate(lags)
        if abs(lag) > max(0.012, 1.25 * period_s) and ratio < 0.95 and explained > 0.7
    ]
    found = []
    for lag, j in late:
        what = "late" if lag > 0 else "early"
        evidence = f"the torque comes {abs(lag) * 1e3:.0f} ms {what}: there the error falls to {lags[j][1]:.0%}"
        advice = (
            "torque and position come from different clocks or filters: shift one at import, or record them together"
        )
        found.append(Finding("torque-delay", "warning", joints[j], evidence, advice))
    common = float(np.median([lag for lag, _ in late])) if len(late) > len(joints) / 2 else 0.0
    return found, common


# --- Whether the arm moves enough, and long enough, for training.


LEAST_RANGE_RAD = 0.2
LEAST_SPEED_RAD_S = 0.1
SEARCH_S = 30.0
"""Motion needed to judge order, axes and delay of torque, [s]: with less, some arrangement fits by chance."""
FRICTION_MIN, NETWORK_MIN = 1.0, 10.0
"""Minutes of motion. A friction fit needs five to ten reversals a joint at several speeds. For a network, see
docs/method/training.md."""


def excitation_findings(recordings: Sequence[Recording], stretches: Sequence[Stretch]) -> list[Finding]:
    joints = recordings[0].joints
    ranges = np.max([np.ptp(r.q, axis=0) for r in recordings], axis=0)
    minutes = sum(r.duration_s for r in recordings) / 60
    if ranges.max() < 0.05:
        evidence = f"the widest range of a joint is {ranges.max():.3g} rad in {minutes:.2g} minutes"
        advice = "an arm at rest gives the plain observer and its limits at this pose, no friction fit and no network"
        return [Finding("never-moves", "warning", None, evidence, advice)]
    found = []
    if stretches:
        dq = np.concatenate([s.dq for s in stretches])
        seconds = np.concatenate([np.full(len(s.dq), 1 / s.rate_hz) for s in stretches])
        for j, joint in enumerate(joints):
            found += _joint(joint, float(ranges[j]), dq[:, j], seconds)
    return found + _length(moving_s(stretches) / 60, minutes)


def moving_s(stretches: Sequence[Stretch]) -> float:
    """Time in which some joint moves, [s]."""
    return sum(float((np.abs(s.dq) > MOVING_RAD_S).any(axis=1).sum()) / s.rate_hz for s in stretches)


def _joint(joint: str, travelled_rad: float, dq: np.ndarray, seconds: np.ndarray) -> list[Finding]:
    forward, backward = float(seconds[dq > MOVING_RAD_S].sum()), float(seconds[dq < -MOVING_RAD_S].sum())
    speed, share = float(np.percentile(np.abs(dq), 99)), (forward + backward) / float(seconds.sum())
    one_way = min(forward, backward) < 0.05 * max(forward, backward)
    if travelled_rad >= LEAST_RANGE_RAD and speed >= LEAST_SPEED_RAD_S and share >= 0.05 and not one_way:
        return []
    evidence = (
        f"range {travelled_rad:.3g} rad, speed up to {speed:.3g} rad/s, "
        f"{forward:.3g} s forward and {backward:.3g} s back"
    )
    advice = (
        f"move it by at least {LEAST_RANGE_RAD:g} rad, both ways, at speeds from {LEAST_SPEED_RAD_S:g} rad/s to what "
        "the work needs: its friction and weight cannot be learned from this"
    )
    return [Finding("excitation-low", "warning", joint, evidence, advice)]


def _length(moving_min: float, minutes: float) -> list[Finding]:
    if moving_min >= NETWORK_MIN:
        return []
    evidence = f"{moving_min:.2g} minutes of motion in {minutes:.2g} minutes"
    advice = (
        f"a friction fit needs {FRICTION_MIN:g} minute of varied motion, a network {NETWORK_MIN:g}; limits promise at "
        f"most one false alarm in a third of the time they were found on, here {minutes / 3:.2g} minutes"
    )
    if moving_min * 60 < SEARCH_S:
        advice += f"; order, axes and delay of the torque were not judged: that needs {SEARCH_S:g} s of motion"
    return [Finding("too-short", "warning" if moving_min < FRICTION_MIN else "note", None, evidence, advice)]
