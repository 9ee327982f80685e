"""What the effort is: of the right sign, the joint's torque, a multiple of it, without gravity, or external torque."""

from __future__ import annotations

from collections.abc import Sequence

from tauext.check.finding import Finding
from tauext.check.fit import JointFit
from tauext.check.regressors import Rows
from tauext.check.sign import SignVote

CERTAIN = 1.5
"""Votes (standard errors times share of the torque) from which on a sign is certain; good data reach 3 to 6."""
LIKELY = 1.0
"""The same where the torque also takes energy out on average."""
STRONG = 0.3
"""Spread of the model's gravity as a share of the torque's from which on its factor is judged ..."""
SHOWN = 0.2
"""... or of the fitted gravity, where the torque is small in all its parts."""
LOW, HIGH = 0.7, 1.45
"""Factors between these are what payload, cables and rough models make of good torques."""
MOTOR_SIDE = 1 / 20
"""No arm has gears below 30 and no torque constant a joint is that small in Nm/A."""
ABSENT = 0.15
"""Gravity factor below which there is no gravity in the torque ..."""
ABSENT_SHARE = 0.2
"""... unless what there is makes up this share of the torque (then the unit is small, not gravity)."""
FAR = 50.0
"""Times what gravity and inertia make: no friction is as much at a joint that gravity loads; a unit is."""
LITTLE = 0.5
"""Share of variance explained, below which there is neither gravity, nor friction, nor inertia in an effort."""


def inverted(vote: SignVote) -> bool:
    """Friction and inertia decide where they can, for which torque that takes energy out on average speaks, too;
    gravity where they cannot."""
    if vote.motion < -LIKELY and vote.power_w < 0:
        return True
    if vote.motion < -CERTAIN:
        return vote.gravity < -CERTAIN
    return abs(vote.motion) <= 0.5 and vote.total < -CERTAIN


def sign_findings(joints: Sequence[str], votes: Sequence[SignVote], fits: Sequence[JointFit]) -> list[Finding]:
    found = []
    for joint, vote, fit in zip(joints, votes, fits, strict=True):
        if inverted(vote):
            factor, error = fit.gravity_factor
            parts = [f"torque times speed is {vote.power_w:.3g} W on average"]
            parts += [f"friction resists with {vote.friction_nm_s:.3g} Nms/rad, must be > 0"] if fit.friction_nm else []
            parts += [f"gravity factor {factor:.3g} ± {error:.1g}"] if factor else []
            found.append(Finding("effort-sign", "fault", joint, "; ".join(parts), "negate the effort at import"))
    return found


def strong_joints(rows: Rows, fits: Sequence[JointFit]) -> list[int]:
    """Joints whose gravity is large enough, in the model or as fitted, for its factor to be judged."""
    return [
        j
        for j, fit in enumerate(fits)
        if fit.torque_nm > 0
        and rows.gravity[:, j].std() > 0.02 * rows.gravity.std(axis=0).max()
        and (rows.gravity[:, j].std() > STRONG * fit.torque_nm or fit.gravity_nm > SHOWN * fit.torque_nm)
    ]


def far_findings(rows: Rows, joints: Sequence[str], fits: Sequence[JointFit]) -> list[Finding]:
    """Findings of efforts so large that a fit sees nothing of the model in them."""
    model_nm, gravity_nm = rows.model.std(axis=0), rows.gravity.std(axis=0)
    found = []
    for j, fit in enumerate(fits):
        if gravity_nm[j] > 0.02 * gravity_nm.max() and fit.torque_nm > FAR * model_nm[j]:
            evidence = (
                f"the effort varies by {fit.torque_nm:.3g}, gravity and inertia of the model by {model_nm[j]:.3g} Nm: "
                f"{fit.torque_nm / model_nm[j]:.2g} times as much"
            )
            advice = "another unit, mNm or encoder counts for instance: convert it to Nm at import"
            found.append(Finding("effort-scale", "fault", joints[j], evidence, advice))
    return found


def kind_findings(
    rows: Rows, joints: Sequence[str], fits: Sequence[JointFit], strong: Sequence[int]
) -> tuple[list[Finding], list[int]]:
    """Findings of efforts without gravity or before the gear; and the strong joints that have none of these."""
    found, left = [], []
    for j in strong:
        fit = fits[j]
        factor, error = fit.gravity_factor
        model_nm = float(rows.gravity[:, j].std())
        gravity_told = (
            f"gravity factor {factor:.3g} ± {error:.1g} where the model's gravity varies by {model_nm:.3g} Nm"
        )
        if abs(factor) < ABSENT and fit.explained < LITTLE:
            evidence = (
                f"{gravity_told}; gravity, inertia and friction explain {max(0.0, fit.explained):.0%} of the effort"
            )
            advice = "this is an external torque or an error already: record the motor's or joint's torque instead"
            found.append(Finding("effort-external", "fault", joints[j], evidence, advice))
        elif abs(factor) < ABSENT and fit.gravity_nm < ABSENT_SHARE * fit.torque_nm:
            evidence = f"{gravity_told}; friction and inertia explain {fit.explained:.0%} of the effort"
            advice = "the driver subtracts gravity: record the uncompensated torque, or add g(q) of the model at import"
            found.append(Finding("effort-gravity-compensated", "fault", joints[j], evidence, advice))
        elif 0 < factor < MOTOR_SIDE and error < 0.3 * factor:
            evidence = f"{gravity_told}: 1 / {1 / factor:.3g}"
            advice = f"the torque before the gear: multiply by the gear ratio (about {1 / factor:.3g}) at import"
            found.append(Finding("effort-motor-side", "fault", joints[j], evidence, advice))
        else:
            left.append(j)
    return found, left


def scale_findings(joints: Sequence[str], fits: Sequence[JointFit], judged: Sequence[int]) -> list[Finding]:
    """Findings of factors that are neither near 1 nor explained by a payload."""
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
            f"a current or another unit: multiply by {1 / factor:.3g} (the torque constant, if it is a current); or a "
            "payload that is not in the model, where factors grow towards the tip"
        )
        found.append(Finding("effort-scale", "fault", joints[j], evidence, advice))
    return found
