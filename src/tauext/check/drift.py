"""Friction that changes with time, as a gear does that warms up."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.check.finding import Finding
from tauext.check.fit import CONSTANT, JointFit, columns_of
from tauext.check.regressors import FRICTION, Rows
from tauext.data.recording import Recording

WINDOW_S = 60.0
LEAST_WINDOWS = 7
"""Of five or six the standard error is itself too uncertain to count by."""
CHANGE = 0.1
"""Of the friction, over all of the data."""
SURE = 5.0
"""Standard errors of the slope."""
SHARE = 0.15
"""Friction below this share of the torque's spread is not followed."""


def friction_by_time(rows: Rows, joint: int, fit: JointFit) -> tuple[np.ndarray, np.ndarray]:
    """Middle of each window [s], and the friction in it as a share of the whole data's."""
    columns = slice(CONSTANT + 1, CONSTANT + FRICTION)
    friction = columns_of(rows, joint)[:, columns] @ fit.weights[columns]
    error = rows.tau[:, joint] - fit.predicted
    window = ((rows.time_s - rows.time_s[0]) // WINDOW_S).astype(int)
    times, shares = [], []
    for k in np.unique(window):
        at = window == k
        power = float((friction[at] ** 2).sum())
        if at.sum() > 200 and power > 0.1 * at.sum() * float((friction**2).mean()):
            times.append(float(rows.time_s[at].mean()))
            shares.append(1 + float(friction[at] @ error[at]) / power)
    return np.array(times), np.array(shares)


def drift_findings(
    rows: Rows, joints: Sequence[str], fits: Sequence[JointFit], recordings: Sequence[Recording]
) -> list[Finding]:
    found = []
    for j, fit in enumerate(fits):
        times, shares = friction_by_time(rows, j, fit)
        if len(times) < LEAST_WINDOWS or fit.friction_nm < SHARE * fit.torque_nm:
            continue
        centred = times - times.mean()
        slope = float(centred @ shares / (centred @ centred))
        left = shares - shares.mean() - slope * centred
        error = np.sqrt(float(left @ left) / max(1, len(times) - 2) / float(centred @ centred))
        change = slope * float(np.ptp(times))
        if abs(change) < CHANGE or abs(slope) < SURE * error:
            continue
        evidence = f"friction changes by {change:+.0%} in {np.ptp(times) / 60:.3g} minutes"
        warm = [r.temperature[:, j] for r in recordings if r.temperature is not None]
        if warm:
            evidence += f", while the motor goes from {warm[0][0]:.1f} to {warm[-1][-1]:.1f} degrees Celsius"
        advice = (
            "train on warm and on cold motion, or warm the arm up first; the monitor's drift tracker follows the rest"
        )
        found.append(Finding("temperature-drift", "warning", joints[j], evidence, advice))
    return found
