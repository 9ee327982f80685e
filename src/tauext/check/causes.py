"""Causes before symptoms: which findings explain others, and the hypothesis of another arm's robot file."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.check.finding import SEVERITIES, Finding, Severity
from tauext.check.joint_fit import FitRows, JointFit

# --- Findings that another one explains are not printed beside it: one remedy at a time, the first to do.


_TORQUE = ("effort-sign", "effort-scale", "effort-motor-side", "effort-compensated")
_LOAD = ("gravity-direction", "payload")
_PLACES = ("joint-axis", "position-offset", "beyond-limit")
_VELOCITY = ("velocity-sign", "velocity-unit", "velocity-mismatch", "velocity-delay")
EXPLAINED: dict[str, tuple[str, ...]] = {
    "time-unit": (*_VELOCITY, *_TORQUE, "torque-delay", "clock-irregular"),
    "position-wraps": ("spike", "degrees", *_VELOCITY, "effort-sign", "effort-scale", "excitation-low"),
    "degrees": ("velocity-unit", *_TORQUE, *_LOAD, *_PLACES),
    "joint-names": (*_TORQUE, *_LOAD, *_PLACES),
    "joint-order": (*_VELOCITY, *_TORQUE, *_LOAD, *_PLACES, "torque-delay"),
    "velocity-mismatch": ("effort-sign", "torque-delay", "velocity-delay"),
    "velocity-sign": ("effort-sign",),
    "robot-file-other": (*_TORQUE, *_LOAD, *_PLACES, "joint-order", "torque-delay"),
}
"""Codes that each cause explains; the causes in the order in which they are to be mended."""


def causes_only(found: Sequence[Finding]) -> list[Finding]:
    """Findings, worst first and causes before others, without those that a fault among them explains."""
    causes = [code for code in EXPLAINED if any(f.code == code and f.severity == "fault" for f in found)]
    explained: set[str] = set()
    for code in causes:
        if code not in explained:
            explained.update(EXPLAINED[code])
    order = list(EXPLAINED)
    left = [finding for finding in found if finding.code not in explained]
    return sorted(
        left, key=lambda f: (SEVERITIES.index(f.severity), order.index(f.code) if f.code in order else len(order))
    )


# --- Another arm's robot file: torque that depends on the pose, but not as the model says.


BEYOND_RAD, BEYOND_SHARE = 0.3, 0.05
"""Positions this far beyond the limits, in this share of the samples, are widely beyond."""


def other_robot_findings(
    rows: FitRows, joints: Sequence[str], fits: Sequence[JointFit], found: Sequence[Finding], limits_rad: np.ndarray
) -> list[Finding]:
    """Finding of a robot file of another arm.

    Args:
        rows: of the last fit, with a model.
        fits: of these rows.
        found: findings of the torque, of which those that the model's gravity contradicts are doubted.
        limits_rad: (joints, 2) position limits of the robot file, infinite where it has none.
    """
    if len(np.unique(rows.time_s // 1.0)) < 20.0:  # [s]; in less motion, the pose explains anything
        return []
    doubted = ("effort-compensated", "effort-scale", "gravity-direction")
    suspected = any(finding.code in doubted and finding.severity == "fault" for finding in found)
    low, high = limits_rad[:, 0] - BEYOND_RAD, limits_rad[:, 1] + BEYOND_RAD
    outside = ((rows.q < low) | (rows.q > high)).mean(axis=0)
    beyond = [] if (outside > BEYOND_SHARE).sum() < 2 else np.flatnonzero(outside > BEYOND_SHARE).tolist()
    strong = rows.gravity.std(axis=0) > 0.1 * rows.gravity.std(axis=0).max()
    fitted = [j for j in range(len(joints)) if strong[j] and fits[j].explained > 0.8 and fits[j].gravity_factor[0] > 0]
    if not suspected and len(fitted) > strong.sum() / 2:
        return []
    shares = [pose_share(rows, j) for j in range(len(joints))]
    # such a torque has gravity in it that is not the model's
    misfits = [j for j, share in enumerate(shares) if share > 0.3]
    if not misfits and (suspected or not beyond):
        return []
    parts = [
        f"{shares[j]:.0%} of the torque of {joints[j]} depends on the pose, but not as the model's gravity does (on "
        "left-out motion)"
        for j in misfits
    ]
    parts += [f"{outside[j]:.0%} of the positions of {joints[j]} are far beyond the file's limits" for j in beyond]
    advice = "perhaps another robot's file: give the one of this arm"
    # A crude model of the right arm also leaves torque unexplained, and training corrects it.
    severity: Severity = "fault" if suspected or beyond else "warning"
    return [Finding("robot-file-other", severity, None, "; ".join(parts), advice)]


def pose_share(rows: FitRows, joint: int) -> float:
    """Share of a joint's torque that the pose explains on left-out motion beyond friction, inertia and model.

    The pose enters by sines and cosines of the angles, of sums and differences of two, and of sums of three neighbours:
    the gravity torques of any arm whose neighbouring axes are parallel or at right angles.
    """
    model = np.column_stack([rows.gravity[:, joint], rows.inertial[:, joint]])
    plain = np.column_stack([rows.friction[:, joint], rows.acceleration, model])
    with_pose = np.column_stack([plain, _pose_features(rows.q)])
    # motion is left out in blocks of five seconds
    block = (rows.time_s // 5.0).astype(int) % 2
    tau = rows.tau[:, joint]
    errors = np.zeros(2)
    for left_out in (0, 1):
        train, test = block != left_out, block == left_out
        if not train.any() or not test.any():
            return 0.0
        for k, features in enumerate((plain, with_pose)):
            mean, size = features[train].mean(axis=0), features[train].std(axis=0) + 1e-9
            a, b = (features[train] - mean) / size, tau[train] - tau[train].mean()
            weights = np.linalg.solve(a.T @ a + 1e-3 * len(a) * np.eye(a.shape[1]), a.T @ b)
            left = tau[test] - tau[train].mean() - (features[test] - mean) / size @ weights
            errors[k] += float(left @ left)
    spread = float(np.sum((tau - tau.mean()) ** 2))
    return (min(float(errors[0]), spread) - float(errors[1])) / spread if spread > 0 else 0.0


def _pose_features(q: np.ndarray) -> np.ndarray:
    n = q.shape[1]
    angles = [q[:, i] for i in range(n)]
    angles += [q[:, i] + sign * q[:, k] for i in range(n) for k in range(i + 1, n) for sign in (1, -1)]
    angles += [q[:, i] + a * q[:, i + 1] + b * q[:, i + 2] for i in range(n - 2) for a in (1, -1) for b in (1, -1)]
    return np.column_stack([wave(angle) for angle in angles for wave in (np.sin, np.cos)])
