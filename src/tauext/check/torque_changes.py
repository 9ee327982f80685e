"""Torque that changes with time, not with the motion: friction that warms up, a zero that grows, steps that repeat."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.check.finding import Finding
from tauext.check.joint_fit import CONSTANT, FRICTION, FitRows, JointFit, columns_of, robust_solve, solve
from tauext.check.motion import MOVING_RAD_S
from tauext.data.recording import Recording

# --- Friction that changes with time, for example while a gear warms up.


WINDOW_S = 60.0
LEAST_WINDOWS = 7
"""With five or six windows the standard error is too uncertain."""
CHANGE = 0.1
"""Smallest reported change over all data, as a share of the friction."""
SURE = 5.0
"""Smallest significant slope, [standard errors]."""
SHARE = 0.15
"""Friction below this share of the torque's spread is not followed."""


def friction_by_time(rows: FitRows, joint: int, fit: JointFit) -> tuple[np.ndarray, np.ndarray]:
    """Middle of each window [s], and its friction relative to all data."""
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


def friction_findings(
    rows: FitRows, joints: Sequence[str], fits: Sequence[JointFit], recordings: Sequence[Recording]
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
        found.append(Finding("torque-changes", "warning", joints[j], evidence, advice))
    return found


# --- Torque that the motion does not explain: an offset that grows, and steps that repeat.


BLOCK_S = 5.0
"""Errors within a block depend on each other: a program repeats its motion at such times."""
LEAST_BLOCKS = 12
GROWTH_SURE = 6.0
"""Smallest significant growth, [standard errors]. Without a model, motion that changes with time reaches 4."""
GROWTH = 1.0
"""Smallest reported growth over the longest recording, relative to the usual error."""
GROWTH_SHARE = 0.25
"""Smallest reported growth in the time of all recordings, relative to the spread of the explained torque. A gear that
warms up, with a wrong model, reaches 0.06."""
ERROR_S = 0.5
"""The largest error of each such time counts: its median is the usual error."""
LEAST_ERRORS = 120
STEPS_SHARE = 90
"""Percentile of the errors that counts as a step's: 10 % of the time or more is off."""
STEP_TIMES, STEP_TIMES_NO_MODEL = 6.0, 4.0
"""Least size of a step, in usual errors. Friction at reversals reaches 5.3 with a model. Without one the usual error is
that of gravity, and friction reaches 2.7."""
CLOSEST, ROUNDS = 0.6, 10
"""Share of the rows to which the model is fitted, those with the least errors: steps in a third of the time distort a
fit to all rows."""
STEP_SHARE = 0.5
"""Least size of a step, relative to the spread of the torque that the motion explains."""


def largest_errors(rows: FitRows, error: np.ndarray) -> np.ndarray:
    """Largest |error| of each ERROR_S in which the arm moves, (times,)."""
    starts = np.r_[0, 1 + np.flatnonzero(np.diff((rows.time_s // ERROR_S).astype(int)))]
    moves = np.maximum.reduceat((np.abs(rows.dq) > MOVING_RAD_S).any(axis=1), starts)
    largest: np.ndarray = np.maximum.reduceat(np.abs(error), starts)[moves]
    return largest


def growth_findings(rows: FitRows, joints: Sequence[str], fits: Sequence[JointFit], unit: str) -> list[Finding]:
    """Findings of torques with an offset that grows steadily within the recordings.

    The fit of motion and friction gets a term in time. Each recording has an offset of its own, so that motion which
    differs between recordings is no growth. Blocks of the errors give the standard error.
    """
    recording = np.unique(rows.recording, return_inverse=True)[1]
    rows_of_each = np.bincount(recording)
    lengths_s = [float(np.ptp(rows.time_s[recording == k])) for k in range(len(rows_of_each))]
    longest_s, all_s = max(lengths_s), sum(lengths_s)
    block = np.unique(recording * 10**6 + (rows.time_s // BLOCK_S).astype(int), return_inverse=True)[1]

    def centred(x: np.ndarray) -> np.ndarray:
        return x - (np.bincount(recording, x) / rows_of_each)[recording]

    if block.max() + 1 < LEAST_BLOCKS:
        return []
    time_s, found = centred(rows.time_s), []
    for j, fit in enumerate(fits):
        columns = np.column_stack([centred(column) for column in columns_of(rows, j).T])
        columns[:, CONSTANT] = 1.0
        torque = centred(rows.tau[:, j])
        weights, trust = robust_solve(np.column_stack([columns, time_s]), torque)
        growth, error = float(weights[-1]), torque - columns @ weights[:-1] - weights[-1] * time_s
        root = np.sqrt(trust)
        alone = time_s - columns @ np.linalg.lstsq(root[:, None] * columns, root * time_s, rcond=None)[0]
        power = float(trust @ alone**2)
        sigma = np.sqrt(float((np.bincount(block, trust * alone * error) ** 2).sum())) / max(power, 1e-12)
        usual = float(np.median(largest_errors(rows, error)))
        is_large = abs(growth) * longest_s > GROWTH * usual and abs(growth) * all_s > GROWTH_SHARE * fit.predicted.std()
        if is_large and abs(growth) > GROWTH_SURE * sigma:
            evidence = f"the torque's zero changes by {60 * growth:+.3g} ± {60 * sigma:.2g} {unit} a minute"
            advice = (
                "let electronics and arm warm up, repair or zero the sensor, then record again; a load that is filled "
                "or emptied while recording does the same"
            )
            found.append(Finding("torque-changes", "fault", joints[j], evidence, advice))
    return found


def closest_fit(rows: FitRows, joint: int, predicted: np.ndarray) -> np.ndarray:
    """Torque of a fit to the CLOSEST rows of this one, (rows,)."""
    columns, torque = columns_of(rows, joint), rows.tau[:, joint]
    for _ in range(ROUNDS):
        error = np.abs(torque - predicted)
        trust = np.where(error <= np.quantile(error, CLOSEST), 1.0, 1e-9)
        predicted = columns @ solve(columns, torque, trust)
    return predicted


def step_findings(rows: FitRows, joints: Sequence[str], fits: Sequence[JointFit], unit: str) -> list[Finding]:
    """Findings of torques that are off in some of the time by far more than in the rest of it."""
    found = []
    for j, fit in enumerate(fits):
        predicted = closest_fit(rows, j, fit.predicted) if rows.has_model else fit.predicted
        error = rows.tau[:, j] - predicted
        largest = largest_errors(rows, error - np.median(error))
        if len(largest) < LEAST_ERRORS:
            continue
        usual, step = np.percentile(largest, (50, STEPS_SHARE))
        times = STEP_TIMES if rows.has_model else STEP_TIMES_NO_MODEL
        if step > times * usual and step > STEP_SHARE * float(predicted.std()):
            share = float((largest > 0.5 * step).mean())
            evidence = f"off by {step:.3g} {unit} in {share:.0%} of the motion, by {usual:.2g} {unit} usually"
            advice = (
                "pushes, a second load or a faulty signal that no label names: label or cut these times, or record "
                "motion that nothing touches"
            )
            found.append(Finding("torque-changes", "fault", joints[j], evidence, advice))
    return found
