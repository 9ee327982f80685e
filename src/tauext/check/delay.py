"""Torque that comes late or early against the motion it makes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.check.finding import Finding
from tauext.check.fit import columns_of, robust_solve
from tauext.check.motion import Stretch
from tauext.check.regressors import Rows, torque_rows

LONGEST_S = 0.1
STEPS = 10  # to either side
LATE_S = 0.012
"""A drive's current filter and a bus cycle make 1 to 5 ms; presliding friction and elasticity look like some more."""
FALL = 0.95
"""The error at the best lag as a share of that without: less is what friction at reversals makes of a good clock."""
EXPLAINED = 0.7


def torque_lags(stretches: Sequence[Stretch], rows: Rows) -> list[tuple[float, float, float]]:
    """Per joint: lag of least error [s], that error as a share of the one at lag 0, and the share explained there."""
    lags = np.linspace(-LONGEST_S, LONGEST_S, 2 * STEPS + 1)
    weights, torques = [], [torque_rows(stretches, lag) for lag in lags]
    errors = np.empty((len(lags), rows.joints))
    for j in range(rows.joints):
        columns = columns_of(rows, j)
        trust = robust_solve(columns, rows.tau[:, j])[1]
        root = np.sqrt(trust)
        size = np.maximum(np.sqrt((columns**2).mean(axis=0)), 1e-9)
        basis, values, _ = np.linalg.svd(root[:, None] * columns / size, full_matrices=False)
        basis = basis[:, values > 1e-6 * values[0]]
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
        zero = errors[STEPS, j]
        ratio = float(np.sqrt(max(least, 0)) / zero) if zero > 0 else 1.0
        found.append((float(lag), ratio, 1 - max(least, 0) / max(weights[j] ** 2, 1e-18)))
    return found


def delay_findings(
    lags: Sequence[tuple[float, float, float]], joints: Sequence[str], period_s: float
) -> tuple[list[Finding], float]:
    """Findings, and one lag for all joints [s], 0 where there is none."""
    late = [
        (lag, j)
        for j, (lag, ratio, explained) in enumerate(lags)
        if abs(lag) > max(LATE_S, 1.25 * period_s) and ratio < FALL and explained > EXPLAINED
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
