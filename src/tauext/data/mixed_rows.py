"""Rows of several origins in one file: writers that alternate on one topic, and stretches that were joined."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tauext.data.recording import TURN


@dataclass(frozen=True)
class MixedRules:
    """When rows are not of one arm's continuous motion."""

    jump_rad: float = 0.05
    """Least step between two rows, [rad], that no arm makes: 2.5 rad/s at 50 Hz, in several joints at once."""
    joints: int = 2
    """Joints that jump together; a single one may be a sensor's fault. Of an arm with one joint: that one."""
    least_share: float = 0.1
    """Share of rows with a jump from which writers may alternate."""
    judged: int = 2000
    """Rows on which alternation is judged."""
    stretches: int = 3
    """Least number of jumps at equal distances that are ends of joined stretches."""
    beyond: float = 5.0
    """Least jump at another distance, as a multiple of the largest step between other rows."""
    least_rows: int = 10
    """Shortest stretch."""


def steps_of(q: np.ndarray) -> np.ndarray:
    """Steps between rows, (samples - 1, joints), [rad], without whole turns."""
    steps = np.diff(q, axis=0)
    return np.abs(steps - TURN * np.round(steps / TURN))


def alternating(q: np.ndarray, rules: MixedRules = MixedRules()) -> str:
    """What alternates where the rows are of two writers, a clause; empty: they are of one.

    Each row is given to the writer whose last position is the nearer one.

    Args:
        q: positions (samples, joints), [rad], in the order of the file.
    """
    joints = min(rules.joints, q.shape[1])
    jumps = (steps_of(q) > rules.jump_rad).sum(axis=1) >= joints
    if jumps.sum() < 2 * rules.least_rows or jumps.mean() < rules.least_share:
        return ""
    begin = max(int(np.argmax(jumps)) - 1, 0)
    rows = q[begin : begin + rules.judged]
    writers: list[list[int]] = [[0]]
    far = 0
    for k in range(1, len(rows)):
        steps = [steps_of(rows[[of[-1], k]])[0] for of in writers]
        sizes = [float(step.max()) for step in steps]
        nearest = int(np.argmin(sizes))
        if len(writers) < 2 and (steps[nearest] > rules.jump_rad).sum() >= joints:
            writers.append([k])
            continue
        # A writer moves on while the other one writes.
        far += len(writers) > 1 and sizes[nearest] > max(rules.jump_rad, 0.5 * max(sizes))
        writers[nearest].append(k)
    if far > 0.05 * len(rows) or len(writers) < 2 or min(map(len, writers)) < max(0.05 * len(rows), rules.least_rows):
        return ""
    of_row = np.zeros(len(rows), int)
    of_row[writers[1]] = 1
    if np.count_nonzero(np.diff(of_row)) < rules.least_share * len(rows):
        return ""
    held = [_words(rows[of]) for of in writers]
    return (
        f"{len(writers[0])} and {len(writers[1])} of {len(rows)} rows alternate between two writers: one has "
        f"{held[0]}, the other {held[1]}"
    )


def _words(q: np.ndarray) -> str:
    """Positions of one writer in words; where both meet, a few rows may be the other's."""
    rows, counts = np.unique(q, axis=0, return_counts=True)
    if counts.max() > 0.9 * len(q):
        usual = rows[counts.argmax()]
        return f"the constant position {', '.join(f'{x:.3g}' for x in usual)} rad" if usual.any() else "zeros"
    first = ", ".join(f"{low:.3g} to {high:.3g}" for low, high in zip(q.min(axis=0), q.max(axis=0), strict=True))
    return f"positions of {first} rad"


@dataclass(frozen=True)
class Joined:
    """Stretches that were joined."""

    begins: np.ndarray
    """Indices at which the stretches after the first begin."""
    jumps: int
    """Ends at which positions jump."""
    largest_rad: float
    rows: int = 0
    """Rows of each stretch; 0: their lengths differ."""


def joined(q: np.ndarray, row: np.ndarray, rules: MixedRules = MixedRules()) -> Joined | None:
    """Find stretches that were joined: positions jump to another pose and go on from there.

    Jumps at equal distances are ends of stretches of equal length, at some of which positions may not jump. A jump at
    another distance must exceed all other steps by far. Beside rows that repeat it is none: the log stood still
    meanwhile, or the driver measured nothing.

    Args:
        q: positions (samples, joints), [rad].
        row: number of each sample in the file.
    """
    if len(q) < 3 * rules.least_rows:
        return None
    steps = steps_of(q)
    at = np.flatnonzero((steps > rules.jump_rad).sum(axis=1) >= min(rules.joints, q.shape[1]))
    if not 0 < len(at) <= len(q) // rules.least_rows:
        return None
    # Beyond what the joint moves between other rows; what jumps back in the next row is a spike.
    usual = np.quantile(steps, 1 - 2 * len(at) / len(steps), axis=0)
    at = at[(steps[at] > np.maximum(rules.jump_rad, 5 * usual)).any(axis=1)]
    at = at[~np.isin(at + 1, at) & ~np.isin(at - 1, at)]
    begins = row[at + 1]
    length = int(np.gcd.reduce(np.diff(begins))) if len(at) >= rules.stretches else 0
    if length >= rules.least_rows:
        every = np.flatnonzero((row[1:] - begins[0]) // length != (row[:-1] - begins[0]) // length) + 1
        return Joined(every, len(at), float(steps[at].max()), length)
    still = (steps == 0).all(axis=1)
    moves = ~(np.r_[True, still[:-1]][at] | np.r_[still[1:], True][at])
    at = at[moves & (row[at + 1] - row[at] == 1)]
    others = np.delete(steps, at, axis=0)
    far = steps[at] > np.maximum(rules.jump_rad, rules.beyond * others.max(axis=0, initial=0.0))
    if not len(at) or not (far.sum(axis=1) >= min(rules.joints, q.shape[1])).all():
        return None
    if np.diff(np.r_[0, at + 1, len(q)]).min() < rules.least_rows:
        return None
    return Joined(at + 1, len(at), float(steps[at].max()))
