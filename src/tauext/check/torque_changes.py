"""Torque that changes with time, not with the motion: friction that warms up, a zero that grows, steps that repeat."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.check.finding import Finding
from tauext.check.joint_fit import CONSTANT, FRICTION, FitRows, JointFit, columns_of, robust_solve, solve
from tauext.check.motion import MOVING_RAD_S
from tauext.data.recording import Recording


def friction_findings(
    rows: FitRows, joints: Sequence[str], fits: Sequence[JointFit], recordings: Sequence[Recording]
) -> list[Finding]:
    """Findings of friction that changes with time, for example while a gear warms up."""
    found = []
    for j, fit in enumerate(fits):
        times_s, shares = friction_by_time(rows, j, fit)
        # the standard error of five or six windows is too uncertain, and so is friction that is little of the torque
        if len(times_s) < 7 or fit.friction_nm < 0.15 * fit.torque_nm:
            continue
        from scipy.stats import linregress  # takes 0.3 s to import

        line, minutes = linregress(times_s, shares), np.ptp(times_s) / 60
        change = float(line.slope) * 60 * minutes
        if abs(change) < 0.1 or abs(line.slope) < 5.0 * line.stderr:
            continue
        evidence = f"friction changes by {change:+.0%} in {minutes:.3g} minutes"
        warm = [r.temperature[:, j] for r in recordings if r.temperature is not None]
        if warm:
            evidence += f", while the motor goes from {warm[0][0]:.1f} to {warm[-1][-1]:.1f} degrees Celsius"
        advice = (
            "train on warm and on cold motion, or warm the arm up first; the monitor's drift tracker follows the rest"
        )
        found.append(Finding("torque-changes", "warning", joints[j], evidence, advice))
    return found


def friction_by_time(rows: FitRows, joint: int, fit: JointFit) -> tuple[np.ndarray, np.ndarray]:
    """Middle of each minute [s], and its friction relative to all data."""
    columns = slice(CONSTANT + 1, CONSTANT + FRICTION)
    friction = columns_of(rows, joint)[:, columns] @ fit.weights[columns]
    error = rows.tau[:, joint] - fit.predicted
    minute = ((rows.time_s - rows.time_s[0]) // 60.0).astype(int)
    times, shares = [], []
    for k in np.unique(minute):
        at = minute == k
        power = float((friction[at] ** 2).sum())
        if at.sum() > 200 and power > 0.1 * at.sum() * float((friction**2).mean()):
            times.append(float(rows.time_s[at].mean()))
            shares.append(1 + float(friction[at] @ error[at]) / power)
    return np.array(times), np.array(shares)


def largest_errors(rows: FitRows, error: np.ndarray) -> np.ndarray:
    """Largest |error| of each half second in which the arm moves, (times,); their median is the usual error."""
    starts = np.r_[0, 1 + np.flatnonzero(np.diff((rows.time_s // 0.5).astype(int)))]
    moves = np.maximum.reduceat((np.abs(rows.dq) > MOVING_RAD_S).any(axis=1), starts)
    largest: np.ndarray = np.maximum.reduceat(np.abs(error), starts)[moves]
    return largest


def growth_findings(rows: FitRows, joints: Sequence[str], fits: Sequence[JointFit], unit: str) -> list[Finding]:
    """Findings of torques with an offset that grows steadily within the recordings.

    The fit of motion and friction gets a term in time. Each recording has an offset of its own, so that motion which
    differs between recordings is no growth. Blocks of five seconds of the errors give the standard error: a program
    repeats its motion at such times.
    """
    recording = np.unique(rows.recording, return_inverse=True)[1]
    rows_of_each = np.bincount(recording)
    lengths_s = [float(np.ptp(rows.time_s[recording == k])) for k in range(len(rows_of_each))]
    block = np.unique(recording * 10**6 + (rows.time_s // 5.0).astype(int), return_inverse=True)[1]

    def centred(x: np.ndarray) -> np.ndarray:
        return x - (np.bincount(recording, x) / rows_of_each)[recording]

    if block.max() + 1 < 12:
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
        # in the longest recording it must exceed the usual error, and in all a quarter of the explained torque's
        # spread: a gear that warms up, with a wrong model, reaches 0.06
        is_large = abs(growth) * max(lengths_s) > float(np.median(largest_errors(rows, error)))
        is_large &= abs(growth) * sum(lengths_s) > 0.25 * fit.predicted.std()
        if is_large and abs(growth) > 6.0 * sigma:  # without a model, motion that changes with time reaches 4
            evidence = f"the torque's zero changes by {60 * growth:+.3g} ± {60 * sigma:.2g} {unit} a minute"
            advice = (
                "let electronics and arm warm up, repair or zero the sensor, then record again; a load that is filled "
                "or emptied while recording does the same"
            )
            found.append(Finding("torque-changes", "fault", joints[j], evidence, advice))
    return found


def step_findings(rows: FitRows, joints: Sequence[str], fits: Sequence[JointFit], unit: str) -> list[Finding]:
    """Findings of torques that are off in a tenth of the time or more by far more than in the rest of it."""
    # friction at reversals reaches 5.3 usual errors with a model; without one the usual error is that of gravity, and
    # friction reaches 2.7
    times, found = 6.0 if rows.has_model else 4.0, []
    for j, fit in enumerate(fits):
        predicted = closest_fit(rows, j, fit.predicted) if rows.has_model else fit.predicted
        error = rows.tau[:, j] - predicted
        largest = largest_errors(rows, error - np.median(error))
        if len(largest) < 120:
            continue
        usual, step = np.percentile(largest, (50, 90))
        if step > times * usual and step > 0.5 * float(predicted.std()):
            share = float((largest > 0.5 * step).mean())
            evidence = f"off by {step:.3g} {unit} in {share:.0%} of the motion, by {usual:.2g} {unit} usually"
            advice = (
                "pushes, a second load or a faulty signal that no label names: label or cut these times, or record "
                "motion that nothing touches"
            )
            found.append(Finding("torque-changes", "fault", joints[j], evidence, advice))
    return found


def closest_fit(rows: FitRows, joint: int, predicted: np.ndarray) -> np.ndarray:
    """Torque of a fit to 60 % of the rows, those closest to this one, (rows,): steps in a third of the time distort a
    fit to all rows."""
    columns, torque = columns_of(rows, joint), rows.tau[:, joint]
    for _ in range(10):
        error = np.abs(torque - predicted)
        trust = np.where(error <= np.quantile(error, 0.6), 1.0, 1e-9)
        predicted = columns @ solve(columns, torque, trust)
    return predicted
