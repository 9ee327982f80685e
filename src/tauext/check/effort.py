"""The torque signal: sign, unit, delay, and whether the motion excites it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tauext.check import joint_fit
from tauext.check.examination import SEARCH_S, Examination
from tauext.check.finding import Finding, Severity
from tauext.check.joint_fit import FitRows, JointFit
from tauext.check.motion import MOVING_RAD_S, Stretch, some_known
from tauext.data.description_template import UR_EFFORT, UR_JOINTS
from tauext.data.recording import Recording
from tauext.data.servo import in_amperes

NEGATE = "negate the effort at import (`sign = -1` in [signals.tau])"  # remedy of every `effort-sign`

# --- Sign of a joint's torque, from friction, inertia and gravity.


@dataclass(frozen=True)
class SignVote:
    """Terms of friction, inertia and gravity: value / standard error, times the term's share of the torque."""

    friction: float
    inertia: float
    gravity: float
    power_w: float  # mean of torque times speed
    friction_nm_s: float  # friction power by squared speed

    @property
    def inverted(self) -> bool:
        """Whether the sign is inverted. Friction, inertia and mean power decide where they are conclusive, else
        gravity. A sum of 1.5 is certain; good data reach 3 to 6."""
        motion = self.friction + self.inertia  # which do not depend on the model
        if motion < -1.0 and self.power_w < 0:
            return True
        if motion < -1.5:
            return self.gravity < -1.5
        return abs(motion) <= 0.5 and motion + self.gravity < -1.5


def sign_vote(rows: FitRows, joint: int, fit: JointFit) -> SignVote:
    dq, acceleration = rows.dq[:, joint], rows.acceleration[:, joint]
    inertial = np.column_stack([rows.inertial[:, joint], acceleration])

    def along(columns: np.ndarray, by: np.ndarray) -> np.ndarray:
        """Weights that sum the columns' parts along a signal."""
        return (columns * by[:, None]).mean(axis=0) / max(float((by**2).mean()), 1e-12)

    def term(value: float, spread: float, part_nm: float) -> float:
        """Limited to 6 standard errors: a wrong model can have a small one."""
        if part_nm == 0 or fit.torque_nm == 0:
            return 0.0
        return float(np.clip(value / max(spread, 1e-9 * abs(value) + 1e-12), -6.0, 6.0)) * part_nm / fit.torque_nm

    by_speed, by_acceleration = along(rows.friction[:, joint], dq), along(inertial, acceleration)
    by_speed[0] = 0.0
    resists, pushes = slice(joint_fit.CONSTANT, joint_fit.CONSTANT + joint_fit.FRICTION), slice(1, 3)
    friction = float(fit.weights[resists] @ by_speed)
    return SignVote(
        term(friction, joint_fit.spread_of(fit.left_out[:, resists] @ by_speed), fit.friction_nm),
        term(
            float(fit.weights[pushes] @ by_acceleration),
            joint_fit.spread_of(fit.left_out[:, pushes] @ by_acceleration),
            fit.inertial_nm,
        ),
        term(*fit.gravity_factor, fit.gravity_nm) if rows.has_model else 0.0,
        float((rows.tau[:, joint] * dq).mean()),
        friction,
    )


def sign_findings(x: Examination) -> Iterator[Finding]:
    """Findings of inverted signs; corrects them."""
    power, signs = "W" if x.unit == "Nm" else f"{x.unit} rad/s", np.ones(len(x.joints))
    for j, (joint, fit) in enumerate(zip(x.joints, x.fits, strict=True)):
        vote = sign_vote(x.rows, j, fit)
        if vote.inverted:
            signs[j], (factor, error) = -1.0, fit.gravity_factor
            parts = [f"torque times speed is {vote.power_w:.3g} {power} on average"]
            if fit.friction_nm:
                parts.append(f"friction resists with {vote.friction_nm_s:.3g} {x.unit}s/rad, must be > 0")
            parts += [f"gravity factor {factor:.3g} ± {error:.1g}"] if factor else []
            yield Finding("effort-sign", "fault", joint, "; ".join(parts), NEGATE)
    if (signs < 0).any():
        x.correct(motion=[s.changed(lambda tau: tau * signs, ("tau",)) for s in x.motion])


# --- An arm at rest: torque against the model's gravity, pose by pose.


def poses_of(recordings: Sequence[Recording]) -> tuple[np.ndarray, np.ndarray]:
    """Medians of position [rad] and torque [N m] of each pose, (poses, joints): seconds in which no joint moves by 0.01
    rad, poses 0.05 rad apart. Labelled contacts are left out, as are rows of unknown contact (see `stretches`)."""
    poses: list[tuple[list[np.ndarray], list[np.ndarray]]] = []
    touched = (1, -1) if some_known(recordings) else (1,)
    for r in recordings:
        free = np.ones(r.samples, dtype=bool) if r.contact is None else ~np.isin(r.contact, touched)
        window = (r.time_s // 1.0).astype(int)
        for k in np.unique(window):
            rows = (window == k) & free
            if rows.sum() < 5 or np.ptp(r.q[rows], axis=0).max() > 0.01:
                continue
            q, tau = np.median(r.q[rows], axis=0), np.median(r.tau[rows], axis=0)
            pose = next((pose for pose in poses if np.abs(pose[0][0] - q).max() < 0.05), None)
            if pose is None:
                poses.append(pose := ([], []))
            pose[0].append(q)
            pose[1].append(tau)
    size = len(recordings[0].joints)
    medians = [[np.median(x, axis=0) for x in signals] for signals in zip(*poses, strict=True)] or [[], []]
    return np.reshape(medians[0], (-1, size)), np.reshape(medians[1], (-1, size))


def pose_findings(x: Examination) -> Iterator[Finding]:
    """Find joints at rest whose torque acts with gravity instead of against it, beyond friction.

    With one or two poses only joints with a fifth of the arm's largest gravity torque count, of which a gear's friction
    holds a tenth, and whose torque has the size of gravity. With more poses joints with less load count too, if gravity
    with one factor explains all but a third of their torques.
    """
    q, tau = poses_of(x.recordings)
    if not len(q):
        return
    anywhere = np.random.default_rng(0).uniform(-np.pi, np.pi, (300, x.model.size))
    most = np.abs(joint_fit.gravity_of(x.model, anywhere)).max()
    gravity = joint_fit.gravity_of(x.model, q)
    power = np.maximum((gravity**2).sum(axis=0), 1e-18)
    factor = (gravity * tau).sum(axis=0) / power
    left = np.sqrt(((tau - factor * gravity) ** 2).mean(axis=0))
    loaded = np.abs(gravity) > 0.2 * most
    is_loaded = loaded.any(axis=0)
    # the ratio of torque to gravity is that of the other loaded joints, 1 for a single one; friction, a tool and torque
    # constants differ by less
    usual = float(np.median(np.abs(factor[is_loaded]))) if is_loaded.sum() > 1 else 1.0
    of_one_size = (np.abs(factor) > usual / 2.5) & (np.abs(factor) < usual * 2.5)
    wrong = is_loaded & ((tau * gravity < 0) | ~loaded).all(axis=0) & of_one_size
    # enough poses to estimate friction from the part that gravity does not explain
    if len(q) >= 3:
        load = np.sqrt(power / len(q))
        wrong |= (load > 0.05 * most) & (factor < 0) & (-factor * load > 3.0 * left)
    for j in np.flatnonzero(wrong).tolist():
        k = int(np.argmax(np.abs(gravity[:, j])))
        apart = f" ({len(q)} poses: {factor[j]:.3g} times gravity, {left[j]:.2g} {x.unit} apart)" if len(q) > 1 else ""
        evidence = f"at rest the effort is {tau[k, j]:.4g} {x.unit} where gravity takes {gravity[k, j]:.4g} Nm{apart}"
        yield Finding("effort-sign", "fault", x.joints[j], evidence, NEGATE)


# --- Kind of the effort: joint torque, scaled, without gravity, or external torque.


def far_findings(x: Examination) -> Iterator[Finding]:
    """Findings of efforts far larger than the model's torque."""
    model_nm, gravity_nm = x.rows.model.std(axis=0), x.rows.gravity.std(axis=0)
    for j, fit in enumerate(x.fits):
        # no friction of a loaded joint is so large
        if gravity_nm[j] > 0.02 * gravity_nm.max() and fit.torque_nm > 50.0 * model_nm[j]:
            evidence = (
                f"the effort varies by {fit.torque_nm:.3g} {x.unit}, gravity and inertia of the model by "
                f"{model_nm[j]:.3g} Nm: {fit.torque_nm / model_nm[j]:.2g} times as much"
            )
            advice = "another unit, mNm or encoder counts for instance: convert it to Nm at import"
            yield Finding("effort-scale", "fault", x.joints[j], evidence, advice)


def unit_findings(x: Examination) -> Iterator[Finding]:
    """Findings of efforts in another unit, without a model: impossible torques, or joints far apart from the others."""
    if in_amperes(x.recordings):
        return
    advice = "another unit, mNm for instance: convert it to Nm at import"
    spread = np.array([fit.torque_nm for fit in x.fits])
    order = [j for j in np.argsort(-spread) if spread[j] > 0]
    # no arm has two successive joints, sorted by the spread of their torque, that are so far apart
    far = next((k for k in range(1, len(order)) if spread[order[k - 1]] > 100.0 * spread[order[k]]), 0)
    for j in [*sorted(order[:far]), *order[far:]]:
        if j in order[:far]:
            more = f"that of '{x.joints[order[far]]}' by {spread[order[far]]:.3g} Nm"
        elif spread[j] > 2e4:  # [N m]; no joint of an arm turns with more, except those of a few giants
            more = "more than any joint gives"
        else:
            continue
        evidence = f"the effort varies by {spread[j]:.3g} Nm, {more}"
        yield Finding("effort-scale", "fault", x.joints[j], evidence, advice)


def kind_findings(x: Examination) -> tuple[list[Finding], list[int]]:
    """Findings of efforts without gravity or before the gear, and the joints without such a finding whose gravity, of
    the model or as fitted, is large enough to judge its factor."""
    found, left, geared = list[Finding](), list[int](), list[int]()
    model_nm = x.rows.gravity.std(axis=0)
    for j, fit in enumerate(x.fits):
        strong = model_nm[j] > 0.3 * fit.torque_nm or fit.gravity_nm > 0.2 * fit.torque_nm
        if not strong or fit.torque_nm == 0 or model_nm[j] <= 0.02 * model_nm.max():
            continue
        (factor, error), absent = fit.gravity_factor, abs(fit.gravity_factor[0]) < 0.15
        if absent and fit.explained < 0.5:
            shown = f"; gravity, inertia and friction explain {max(0.0, fit.explained):.0%} of the effort"
            advice = "this is already an external torque or an error: record the motor's or joint's torque instead"
        elif absent and fit.gravity_nm < 0.2 * fit.torque_nm:  # with more gravity, the unit is too small
            shown = f"; friction and inertia explain {fit.explained:.0%} of the effort"
            advice = "the driver subtracts gravity: record the uncompensated torque, or add g(q) of the model at import"
        else:
            # gear ratios exceed 30; no joint has so few Nm/A
            (geared if 0 < factor < 1 / 20 and error < 0.3 * factor else left).append(j)
            continue
        found.append(Finding("effort-compensated", "fault", x.joints[j], _gravity_words(x, j) + shown, advice))
    if geared and (gears := _gear_findings(x, geared)):
        return found + gears, left
    return found, sorted(left + geared)


def _gravity_words(x: Examination, j: int) -> str:
    factor, error = x.fits[j].gravity_factor
    varies = f"where the model's gravity varies by {float(x.rows.gravity[:, j].std()):.3g} Nm"
    return f"gravity factor {factor:.3g} ± {error:.1g} {varies}"


MOST_GEAR = 400.0
"""Largest ratio of a joint's gear; wave gears have up to 160 a stage, and few joints two stages."""

MOST_APART = 5.0
"""Largest ratio of two gears of one arm; shares of the largest torques are further apart."""


def _gear_findings(x: Examination, geared: Sequence[int]) -> list[Finding]:
    """Findings of efforts before the gear: at these joints, with ratios of gears, while others are in Nm."""
    factors = factors_of(x)
    others = [factor for j, (factor, _) in factors.items() if j not in geared]
    ratios = {j: 1 / factors.get(j, x.fits[j].gravity_factor)[0] for j in geared}
    most, unlike = max(ratios.values()), max(ratios.values()) > MOST_APART * min(ratios.values())
    if most > MOST_GEAR or unlike or not all(LOW < factor < 2 * HIGH for factor in others if factor > 1 / 20):
        return []
    how = "multiply by the gear ratio at import"
    how += f" (about {_each(x, ratios)})" if _differ(ratios) else f" (about {float(np.median([*ratios.values()])):.3g})"
    return [
        Finding(
            "effort-motor-side",
            "fault",
            x.joints[j],
            f"{_gravity_words(x, j)}: 1 / {1 / x.fits[j].gravity_factor[0]:.3g}",
            f"the torque before the gear: {how}",
        )
        for j in geared
    ]


def _each(x: Examination, values: Mapping[int, float]) -> str:
    return ", ".join(f"{x.joints[j]} {value:.3g}" for j, value in values.items())


def _differ(values: Mapping[int, float]) -> bool:
    """Whether they are further apart than errors of a model."""
    return max(values.values()) > 1.15 * min(values.values())


def factors_of(x: Examination) -> dict[int, tuple[float, float]]:
    """Factor of each joint's torque on the model's, and its error, where it is known to a tenth."""
    found = {j: joint_fit.model_factor(x.rows, j) for j in range(len(x.joints))}
    return {j: (factor, error) for j, (factor, error) in found.items() if factor > 0 and error < 0.1 * factor}


LOW, HIGH = 0.7, 1.45  # good torques have factors in this range, given payload, cables and rough models


def scale_findings(x: Examination, judged: Sequence[int]) -> list[Finding]:
    """Findings of factors outside the range of good torques; the advice lists the factors of all joints."""
    off = []
    for j in judged:
        factor, error = x.fits[j].gravity_factor
        if not (LOW <= factor <= HIGH or factor <= 0 or abs(factor - 1) < 4 * error):
            off.append(j)
    if not off:
        return []
    factors = factors_of(x)
    advice = scale_advice(x, {j: 1 / factor for j, (factor, _) in factors.items()}, off)
    # beside a joint that is off, light ones are too, whose gravity alone shows too little
    more = [j for j, (factor, error) in factors.items() if not LOW <= factor <= HIGH and abs(factor - 1) > 4 * error]
    found = []
    for j in sorted({*off, *more}):
        if j in off:
            evidence = "effort = {:.3g} ± {:.1g} times the model's gravity".format(*x.fits[j].gravity_factor)
            inertial, inertial_error = x.fits[j].inertial_factor
            if inertial and inertial_error < 0.3 * abs(inertial):
                evidence += f", {inertial:.3g} ± {inertial_error:.1g} times its inertial torque"
        else:
            evidence = "effort = {:.3g} ± {:.1g} times the model's torque".format(*factors[j])
        found.append(Finding("effort-scale", "fault", x.joints[j], evidence, advice))
    return found


def common_findings(x: Examination, judged: Sequence[int]) -> list[Finding]:
    """Finding of one factor at all joints within the range of good torques: models err by other factors at each."""
    factors = {j: factor for j, (factor, _) in factors_of(x).items() if j in judged}
    if len(factors) < 3 or max(factors.values()) > 1.05 * min(factors.values()):
        return []
    factor = float(np.median(list(factors.values())))
    if not LOW < factor < HIGH or abs(math.log(factor)) < 0.1:
        return []
    evidence = f"effort = {factor:.3g} times the model's torque at all {len(factors)} joints that show it"
    advice = (
        f"another unit (a pound-force foot is 1.356 Nm), or masses in the model that are all too "
        f"{'large' if factor < 1 else 'small'}: multiply the effort by {1 / factor:.3g}, or correct the model"
    )
    return [Finding("effort-scale", "warning", None, evidence, advice)]


def no_current_findings(x: Examination) -> list[Finding]:
    """Finding of currents that are the model's torque at all joints that show it: they are torques."""
    factors = factors_of(x) if in_amperes(x.recordings) else {}
    if len(factors) < 2 or not all(0.8 < factor < 1.25 for factor, _ in factors.values()):
        return []
    evidence = (
        "imported as currents of unknown torque constants, but equal to the model's torque in Nm: "
        f"{_each(x, {j: factor for j, (factor, _) in factors.items()})} times"
    )
    advice = 'they are torques: give unit = "Nm" in [signals.tau], and no torque_constant'
    return [Finding("effort-scale", "warning", None, evidence, advice)]


def scale_advice(x: Examination, by: Mapping[int, float], off: Sequence[int]) -> str:
    """What to multiply by: one number, or one a joint where they differ.

    Args:
        by: what each joint's effort must be multiplied by, where it is known.
        off: joints that are certainly off, at least one.
    """
    known = dict(by) or {j: 1 / x.fits[j].gravity_factor[0] for j in off}
    other = (
        "or a payload that is not in the model, where factors grow towards the tip; or another arm's robot file, where "
        "they differ without order"
    )
    if min(known.values()) > MOST_GEAR:
        what = "no gear and no torque constant is so large: kNm, a position error, or a share of the largest torque"
    elif max(known.values()) < 1e-2:
        what = "another unit, mNm for instance"
    elif all(any(name.endswith(joint) for name in x.joints) for joint in UR_JOINTS):
        what = f"a current or another unit ({UR_EFFORT})"
    else:
        what = "a current or another unit"
    if not _differ(known):
        times = f"{float(np.median(list(known.values()))):.3g}"
        return f"{what}: multiply by {times} (for a current, this is its torque constant in Nm/A); {other}"
    if right := [j for j, factor in known.items() if abs(factor - 1) < 0.1]:
        wrong = {j: factor for j, factor in known.items() if j not in right}
        what = f"a wrong torque constant or gear ratio: multiply by {_each(x, wrong)} at import, and leave the others"
        return f"{what}; {other}"
    lacking = [name for j, name in enumerate(x.joints) if j not in known]
    unknown = f"; unknown for {', '.join(lacking)}" if lacking else ""
    most = max(float(np.abs(r.tau).max()) for r in x.recordings)
    unit, full = next(((u, n) for u, n in (("shares", 1), ("percent", 100), ("per mille", 1000)) if most <= n), ("", 0))
    shares = f", or {unit} of a largest torque of {_each(x, {j: full * k for j, k in known.items()})} Nm" * bool(full)
    return (
        f"{what}, with a factor of its own at each joint: multiply by {_each(x, known)}{unknown}. These are torque "
        f'constants in Nm/A of currents{shares}: give them as torque_constant, with unit = "A", in [signals.tau]; '
        f"{other}"
    )


# --- Delay of the torque against the motion.


def torque_lags(motion: Sequence[Stretch], rows: FitRows) -> list[tuple[float, float, float]]:
    """Per joint: lag of least error [s], that error as a share of the one at lag 0, and the share explained there.
    Without a model gravity is known roughly, and an error that falls up to the largest lag is no delay: share 1."""
    lags = np.linspace(-0.1, 0.1, 21)
    torques, found = [joint_fit.torque_rows(motion, lag) for lag in lags], []
    for j in range(rows.joints):
        columns = rows.columns(j)
        if rows.has_model:  # friction that grows with the load would show as a delay
            sharp_sign = rows.friction[:, j, 2]
            columns = np.column_stack([columns, np.abs(rows.gravity[:, j]) * sharp_sign])
        trust = joint_fit.robust_solve(columns, rows.tau[:, j])[1]
        root = np.sqrt(trust)
        basis = joint_fit.basis_of(root[:, None] * columns / joint_fit.rms(columns))
        weighted = [root * torque[:, j] for torque in torques]
        errors = np.array([np.sqrt(((y - basis @ (basis.T @ y)) ** 2).mean()) for y in weighted])
        best, squared = int(np.argmin(errors)), errors**2
        lag, least = lags[best], squared[best]
        inside = 0 < best < len(lags) - 1
        if inside:
            a, b, c = squared[best - 1 : best + 2]
            if a - 2 * b + c > 0:
                shift = 0.5 * (a - c) / (a - 2 * b + c)
                lag, least = lag + shift * (lags[1] - lags[0]), b - 0.25 * (a - c) * shift
        zero = errors[len(lags) // 2]
        ratio = float(np.sqrt(max(least, 0)) / zero) if zero > 0 and (rows.has_model or inside) else 1.0
        spread = float(np.average((rows.tau[:, j] - rows.tau[:, j].mean()) ** 2, weights=trust)) ** 0.5
        found.append((float(lag), ratio, 1 - max(least, 0) / max(spread**2, 1e-18)))
    return found


def delay_findings(x: Examination) -> Iterator[Finding]:
    """Findings of delays; corrects the lag that most joints have in common. Filter and bus cycle cause 1 to 5 ms,
    presliding and elasticity more; friction at reversals lowers the error, too."""
    x.lags = torque_lags(x.motion, x.rows)
    if x.moving_s < SEARCH_S:
        return
    least_s = max(0.012, 1.25 * (1 / x.motion[0].rate_hz))
    late = []
    for joint, (lag, ratio, explained) in zip(x.joints, x.lags, strict=True):
        if abs(lag) > least_s and ratio < 0.95 and explained > 0.7:
            late.append(lag)
            what = "late" if lag > 0 else "early"
            evidence = f"the torque comes {abs(lag) * 1e3:.0f} ms {what}: there the error falls to {ratio:.0%}"
            advice = (
                "torque and position come from different clocks or filters: shift one at import, or record them "
                "together"
            )
            yield Finding("torque-delay", "warning", joint, evidence, advice)
    if late:
        x.correct(lag_s=float(np.median(late)) if len(late) > len(x.joints) / 2 else 0.0)


# --- Whether the arm moves enough, and long enough, for training.


@dataclass(frozen=True)
class ExcitationRules:
    """Least motion of a joint, and of the whole arm."""

    range_rad: float = 0.2
    speed_rad_s: float = 0.1
    friction_min: float = 1.0  # a friction fit needs five to ten reversals a joint at several speeds
    network_min: float = 10.0  # see docs/method/training.md


def excitation_findings(x: Examination, least: ExcitationRules = ExcitationRules()) -> Iterator[Finding]:
    """Findings of joints, and of an arm, that move too little."""
    ranges = np.max([np.ptp(r.q, axis=0) for r in x.recordings], axis=0)
    minutes, moving_min = sum(r.duration_s for r in x.recordings) / 60, x.moving_s / 60
    if ranges.max() < 0.05:
        evidence = f"the widest range of a joint is {ranges.max():.3g} rad in {minutes:.2g} minutes"
        advice = (
            "an arm at rest gives the plain observer and its thresholds at this pose, no friction fit and no network"
        )
        yield Finding("never-moves", "warning", None, evidence, advice)
        return
    for j, joint in enumerate(x.joints if x.motion else ()):
        dq = np.concatenate([s.dq[:, j] for s in x.motion])
        seconds = np.concatenate([np.full(len(s.dq), 1 / s.rate_hz) for s in x.motion])
        forward, backward = float(seconds[dq > MOVING_RAD_S].sum()), float(seconds[dq < -MOVING_RAD_S].sum())
        speed, share = float(np.percentile(np.abs(dq), 99)), (forward + backward) / float(seconds.sum())
        varied = share >= 0.05 and min(forward, backward) >= 0.05 * max(forward, backward)
        if ranges[j] < least.range_rad or speed < least.speed_rad_s or not varied:
            evidence = (
                f"range {float(ranges[j]):.3g} rad, speed up to {speed:.3g} rad/s, "
                f"{forward:.3g} s forward and {backward:.3g} s back"
            )
            advice = (
                f"move it by at least {least.range_rad:g} rad, both ways, at speeds from {least.speed_rad_s:g} rad/s "
                "to what the work needs: its friction and weight cannot be learned from this"
            )
            yield Finding("excitation-low", "warning", joint, evidence, advice)
    if moving_min < least.network_min:
        evidence = f"{moving_min:.2g} minutes of motion in {minutes:.2g} minutes"
        advice = (
            f"a friction fit needs {least.friction_min:g} minute of varied motion, a network {least.network_min:g}; "
            "thresholds are proved for one false alarm in a third of the time they were found on, here "
            f"{minutes / 3:.2g} minutes, and extrapolated beyond"
        )
        if x.moving_s < SEARCH_S:
            advice += f"; order, axes and delay of the torque were not judged: that needs {SEARCH_S:g} s of motion"
        severity: Severity = "warning" if moving_min < least.friction_min else "note"
        yield Finding("too-short", severity, None, evidence, advice)
