"""A recording whose clock, zeros or load are a little off the others': what no error of its own would tell.

Each is one number (a load: its mass), estimated for every recording alone from what the common fit leaves of its
torque; a recording is odd where its number is far from those of the others and the error falls by it.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.check.finding import Finding
from tauext.check.motion import FIT_ROWS_HZ, Stretch
from tauext.check.odd_mends import load_columns, spread_about_zero
from tauext.check.regressors import Rows

LATE_S, TURNED_RAD, LOADED_KG = 0.01, 0.03, 0.15
"""Off the others by less than this is what wear, warmth and rough models look like ..."""
FURTHEST_S, FURTHEST_RAD, FURTHEST_KG = 0.2, 0.4, 50.0
"""... and by more no small error: then a linear estimate is none."""
SPREADS = 6.0
"""Times the spread of the others' numbers (median of the magnitudes)."""
GAIN = 0.4
"""Sum over joints of the logarithm of how much the error falls, by a load where it is above the others'."""
LEAST_RECORDINGS = 4
LEAST_S = 11.0
"""Of motion: shorter recordings say too little of one number."""
STEP_RAD = 0.05
ROUNDS, HUBER = 4, 2.0


@dataclass(frozen=True)
class Number:
    """One a recording."""

    name: str
    unit: str
    scale: float  # of the unit as it is told
    joint: int | None
    least: float
    furthest: float
    columns: dict[int, np.ndarray]
    """Of each recording: torque a unit of the number, (rows, joints, 1 or more), NaN where it is not known."""


@dataclass(frozen=True)
class Estimate:
    """Of one number in one recording."""

    value: float
    gain: float


@dataclass(frozen=True)
class Odd:
    """A recording whose number is far from those of the others."""

    number: Number
    recording: int
    off: float
    spread: float  # of the others
    gain: float

    def told(self) -> str:
        scale, unit = self.number.scale, self.number.unit
        return (
            f"{self.number.name} by {self.off * scale:+.3g} {unit} against the other recordings, which differ by "
            f"{self.spread * scale:.2g} {unit}; with that the error falls to {np.exp(-self.gain):.0%}"
        )


def odd_shifts(
    parts: dict[int, Rows],
    errors_nm: dict[int, np.ndarray],
    usual_nm: np.ndarray,
    motion: Sequence[Stretch],
    tree: _core.Tree,
    joints: Sequence[str],
    names: Sequence[str],
) -> list[Finding]:
    """At most one warning a recording.

    Args:
        parts: rows of each recording that agrees with the others, by its number.
        errors_nm: what the common fit leaves of their torques, (rows, joints), [N m].
        usual_nm: (joints,) median of the recordings' errors.
        names: of all recordings.
    """
    parts = {k: part for k, part in parts.items() if len(part.time_s) >= LEAST_S * FIT_ROWS_HZ}
    if len(parts) < LEAST_RECORDINGS:
        return []
    numbers = [
        (number, {k: _estimate(number.columns[k], errors_nm[k], usual_nm) for k in parts})
        for number in _numbers(parts, errors_nm, motion, tree, joints)
    ]
    found: list[Finding] = []
    left = set(parts)
    while len(left) >= LEAST_RECORDINGS:  # the oddest first: among the others' numbers it would widen their spread
        odd = [odd for number, values in numbers for k in left if (odd := _odd(number, values, k, left)) is not None]
        if not odd:
            break
        worst = max(odd, key=lambda one: one.gain)
        joint = None if worst.number.joint is None else joints[worst.number.joint]
        advice = "recorded in another way, or with another tool? mend it at import, or leave it out"
        name = names[worst.recording]
        found.append(Finding("odd-recording", "warning", joint, f"'{name}': {worst.told()}", advice, name))
        left.remove(worst.recording)
    return found


def _odd(number: Number, values: dict[int, Estimate], k: int, left: Collection[int]) -> Odd | None:
    """Whether the number of recording k is far from those of the others that are left."""
    others = np.array([values[i].value for i in left if i != k])
    spread = 1.4826 * float(np.median(np.abs(others - np.median(others))))
    off = values[k].value - float(np.median(others))
    far = max(number.least, SPREADS * spread) < abs(off) < number.furthest
    return Odd(number, k, off, spread, values[k].gain) if far and values[k].gain > GAIN else None


def _numbers(
    parts: dict[int, Rows],
    errors_nm: dict[int, np.ndarray],
    motion: Sequence[Stretch],
    tree: _core.Tree,
    joints: Sequence[str],
) -> Iterator[Number]:
    late = {k: _late(part, part.tau - errors_nm[k]) for k, part in parts.items()}
    yield Number("its torque comes late", "ms", 1e3, None, LATE_S, FURTHEST_S, late)
    largest = np.max([part.gravity.std(axis=0).max() for part in parts.values()])
    for j in range(len(joints)):
        turned = {k: _turned(part, tree, j)[:, :, None] for k, part in parts.items()}
        if max(float(np.abs(x).max()) for x in turned.values()) > 1e-3 * largest:
            yield Number(f"the zero of '{joints[j]}' is off", "rad", 1, j, TURNED_RAD, FURTHEST_RAD, turned)
    loaded = {k: load_columns([s for s in motion if s.recording == k], tree, part) for k, part in parts.items()}
    yield Number(f"its load at '{joints[-1]}' differs", "kg", 1, None, LOADED_KG, FURTHEST_KG, loaded)


def _late(part: Rows, predicted: np.ndarray) -> np.ndarray:
    """Torque a second of delay; NaN where rows do not follow one another."""
    steps = np.gradient(part.time_s)
    slope = -np.gradient(predicted, axis=0) / steps[:, None]
    slope[steps > 1.5 / FIT_ROWS_HZ] = np.nan
    return slope[:, :, None]


def _turned(part: Rows, tree: _core.Tree, j: int) -> np.ndarray:
    """Torque a radian that the joint's position is read too small, by gravity alone."""
    q = part.q.copy()
    still = np.zeros_like(q)
    q[:, j] += STEP_RAD
    return np.asarray((tree.momentum(q, still)[1] - tree.momentum(part.q, still)[1]) / STEP_RAD)


def _estimate(columns: np.ndarray, error_nm: np.ndarray, usual_nm: np.ndarray) -> Estimate:
    """The first number of a robust fit of the columns to the error, an offset of each joint left out."""
    known = np.isfinite(columns).all(axis=(1, 2))
    if known.sum() < LEAST_S * FIT_ROWS_HZ / 2:
        return Estimate(0.0, 0.0)
    columns, error = columns[known], error_nm[known] - np.median(error_nm[known], axis=0)
    weight = np.ones_like(error) / usual_nm
    value = np.zeros(columns.shape[2])
    for _ in range(ROUNDS):
        x = (columns * weight[:, :, None]).reshape(-1, columns.shape[2])
        value = np.linalg.lstsq(x, (error * weight).ravel(), rcond=1e-6)[0]
        off = np.abs(error - columns @ value) / usual_nm
        weight = np.sqrt(np.minimum(1.0, HUBER / np.maximum(off, 1e-9))) / usual_nm
    least_nm = usual_nm if len(value) > 1 else 0.0 * usual_nm  # several numbers always fit something
    before, after = (np.maximum(spread_about_zero(x), least_nm) for x in (error, error - columns @ value))
    return Estimate(float(value[0]), float(np.log(before / after).sum()))
