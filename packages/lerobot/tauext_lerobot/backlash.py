r"""Play between a motor with its encoder and its load, from reversals.

After a reversal the motor crosses the play before it moves its load the other way. The position travels by the width
while the drive carries only its own friction. Where gravity holds a gear at one flank, no play is crossed; an encoder
behind the play measures little of it.

At the same place just before and just after a reversal, gravity is equal and inertia nearly so. The drive's torques
then differ by twice the friction, as a function of the travel s since the reversal:

.. math:: d\,(\tau_{out}(s) - \tau_{in}(s)) = F_i + c\,v(s) + J\,a(s) - h\,m(s)

with the direction d, the sum of speeds v and the difference of accelerations a of the two ways. m is the share of the
load not yet carried: 1 over a flat, then falling to 0 over a bend of gear or friction (Dahl). F_i belongs to each
reversal. Flat and bend are found by least squares; the width is the travel after which half is carried. A bend without
a flat is normal for good gears and is no play.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from tauext.check.finding import Check, Facts, Finding, Found, Plot, Plots
from tauext.check.motion import DEGREES
from tauext.check.sensors import position_step
from tauext.data.recording import Recording
from tauext_lerobot.drive_signal import LEAST_VISITS, motion_of, unsigned_visits

WIDEST_RAD = 0.045
"""Largest detectable play, [rad]. Play beyond 2.6 degrees is a defect, and gravity differs across it."""
LEAST_TRAVEL_RAD = 0.03
"""Least travel of the motion before and after a reversal."""
FINEST_RAD = 5e-4
"""Width of the places at which both ways are compared, unless the encoder's step is coarser."""
BENDS_RAD = (0.001, 0.002, 0.004, 0.008, 0.016, 0.032, 0.064)
"""Travel over which the load is carried again."""
LEAST_ROWS = 5
"""Least number of different places before and after a reversal."""
GROUPS = 10
"""Groups of reversals; each is left out once to estimate the error."""
LEAST_TURNS, MOST_TURNS = 8, 300
"""Most reversals used for a width; of more, evenly spaced ones."""
CERTAIN_FLAT, FLAT = 2.5, 0.75
"""Play has a flat. Standard errors by which a flat must fit better than any bend without one, and its least length as a
share of half the bend. A bend smoothed by rounding and sampling has a flat of a half."""


@dataclass(frozen=True)
class Play:
    """One joint's play, or why none is detected."""

    width_rad: float
    """NaN: unknown, from too few turns; 0: not detected."""
    error_rad: float
    """Standard error from left-out reversals and the encoder's step; NaN without a width."""
    lost_rad: float
    """Travel after which half of the load is carried again, from play or from elastic gear and friction; 0: none."""
    share: float
    """Share of the friction that is absent while the play is crossed."""
    turns: int
    travel_rad: np.ndarray
    """Travel since the reversal at the points of the mean curve."""
    curve: np.ndarray
    """Mean over reversals of d (tau_out - tau_in) without speed and inertia, relative to its final value."""


def backlash_widths(recordings: Sequence[Recording]) -> tuple[np.ndarray, np.ndarray]:
    """Width of each joint's play and its standard error, (joints,) each, [rad].

    The width is the whole recorded travel from flank to flank. 0: no play detected; that excludes play only if friction
    and not gravity loads the joint and the encoder sits before the play. NaN: too few reversals. The error is NaN in
    both cases.
    """
    plays = [play_of(recordings, j) for j in range(len(recordings[0].joints))]
    return np.array([p.width_rad for p in plays]), np.array([p.error_rad for p in plays])


def play_of(recordings: Sequence[Recording], j: int) -> Play:
    """Estimate one joint's play from its reversals."""
    step_rad = position_step(np.concatenate([r.q[:, j] for r in recordings])) or 0.0
    place_rad = max(step_rad, FINEST_RAD)
    turns = [turn for r in recordings for turn in _turns(r, j, place_rad, step_rad)]
    turns = turns[:: max(1, -(-len(turns) // MOST_TURNS))]
    if len(turns) < LEAST_TURNS:
        return Play(np.nan, np.nan, np.nan, np.nan, len(turns), np.zeros(0), np.zeros(0))
    shapes, whole = _shapes(place_rad), _Turns(turns, place_rad)
    products = whole.products(shapes)
    best = int(np.argmin(_squares(products.sum(axis=1))))
    whole = _Turns(whole.trimmed(_weights(products.sum(axis=1)[best]), shapes, best), place_rad)
    products = whole.products(shapes)
    total, groups = products.sum(axis=1), products.shape[1]
    squares, halves = _squares(total), shapes.flat + shapes.half
    best = int(np.argmin(squares))
    others = [int(np.argmin(_squares(total - products[:, g]))) for g in range(groups)]
    weights = _weights(total[best])
    travel_rad, curve = whole.curve(weights, place_rad)
    borne = shapes.missing(travel_rad, best)[:, 0] < 0.1
    full = float(np.mean(curve[borne])) if borne.any() else float(curve[-1])
    share = float(-weights[2] / full) if full > 0 else 0.0
    width_rad, bend_rad = float(halves[best]), float(shapes.half[best])
    error_rad = float(np.sqrt((groups - 1) * np.var(halves[others]) + place_rad**2))
    bent = int(np.argmin(np.where(shapes.flat == 0, squares, np.inf)))
    kept = _weights(total[bent])
    saved = np.array([_left(products[bent, g], kept) - _left(products[best, g], weights) for g in range(groups)])
    # Less than two encoder steps is rounding, less than a tenth of the friction a ripple.
    significant = width_rad > max(2 * step_rad, 3 * error_rad) and share > 0.1
    flat = shapes.flat[best] > FLAT * bend_rad and saved.mean() * np.sqrt(groups) > CERTAIN_FLAT * saved.std(ddof=1)
    return Play(
        width_rad if significant and flat else 0.0,
        error_rad if significant and flat else np.nan,
        width_rad if significant else 0.0,
        share,
        len(turns),
        travel_rad,
        curve / abs(full) if full else np.zeros_like(curve),
    )


@dataclass(frozen=True)
class _Turn:
    since: np.ndarray  # travel since the turn, increasing, [rad]
    differences: np.ndarray  # d (out - in) of torque, speed, acceleration (3, rows)


def _drive(recording: Recording, j: int) -> np.ndarray | None:
    """Signal that follows the drive's torque with its sign: tau, else goal minus position; None: neither."""
    tau = recording.tau[:, j]
    if tau.min() < 0 < tau.max():
        return tau
    moving, _ = motion_of(recording, j)
    if tau.any() and unsigned_visits(tau, moving) < LEAST_VISITS:
        return tau
    return None if recording.q_des is None else recording.q_des[:, j] - recording.q[:, j]


def _turns(recording: Recording, j: int, place_rad: float, step_rad: float) -> list[_Turn]:
    thin = max(1, round(recording.rate_hz / 250))
    drive = _drive(recording, j)
    if drive is None or recording.samples < 20 * thin:
        return []
    t, q, drive = recording.time_s[::thin], recording.q[::thin, j], drive[::thin]
    least_rad = max(2.5 * step_rad, 0.5 * LEAST_TRAVEL_RAD)
    ends = _extremes(q, least_rad)
    speed = np.gradient(q, t)
    acceleration = np.gradient(speed, t)
    found = []
    for before, here, after in zip(ends, ends[1:], ends[2:], strict=False):
        way = np.sign(q[after] - q[here])
        travel = min(2 * WIDEST_RAD, abs(q[here] - q[before]), abs(q[after] - q[here]))
        if travel < LEAST_TRAVEL_RAD:
            continue
        columns = []
        for rows in (np.arange(here, before - 1, -1), np.arange(here, after + 1)):
            since = np.maximum.accumulate(way * (q[rows] - q[here]))
            moves = (np.gradient(since) > 0) & (since > 0.5 * step_rad) & (since <= travel)
            columns.append(
                _averaged(since[moves], np.stack([x[rows[moves]] for x in (drive, speed, acceleration)]), place_rad)
            )
        (since_in, values_in), (since, values) = columns
        if min(len(since_in), len(since)) < LEAST_ROWS:
            continue
        inward = np.stack([np.interp(since, since_in, x) for x in values_in])
        found.append(_Turn(since, way * (values - inward)))
    return found


def _extremes(q: np.ndarray, least_rad: float) -> list[int]:
    """Rows of the turning points that lie at least so far apart, each the last row at its place."""
    ends, low, high, way = [0], 0, 0, 0
    for k in range(len(q)):
        low = k if q[k] <= q[low] else low
        high = k if q[k] >= q[high] else high
        if way >= 0 and q[high] - q[k] > least_rad:
            ends, way, low = [*ends, high], -1, k
        elif way <= 0 and q[k] - q[low] > least_rad:
            ends, way, high = [*ends, low], 1, k
    return ends[1:]


def _averaged(since: np.ndarray, values: np.ndarray, place_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Average the rows of each place, so that a slow joint counts no more than a fast one."""
    _, first = np.unique(np.floor(since / place_rad + 0.25).astype(int), return_index=True)
    count = np.diff(np.r_[first, len(since)])
    if not len(since):
        return since, values
    return np.add.reduceat(since, first) / count, np.add.reduceat(values, first, axis=1) / count


@dataclass(frozen=True)
class _Shapes:
    """Share of the load not yet carried: 1 over a flat, then falling linearly or exponentially. Arrays (shapes,)."""

    flat: np.ndarray  # [rad]
    bend: np.ndarray
    slower: np.ndarray  # bool

    @property
    def half(self) -> np.ndarray:
        """Travel within the bend after which half is carried, [rad]."""
        return self.bend * np.where(self.slower, math.log(2), 0.5)

    def missing(self, since: np.ndarray, k: int | slice) -> np.ndarray:
        """Share not yet carried, (rows, shapes)."""
        slower = np.atleast_1d(self.slower[k])
        beyond = np.maximum(since[:, None] - np.atleast_1d(self.flat[k]), 0) / np.atleast_1d(self.bend[k])
        missing = np.maximum(1 - beyond, 0)
        missing[:, slower] = np.exp(-beyond[:, slower])
        return missing


def _shapes(place_rad: float) -> _Shapes:
    every = [
        (flat, bend, slower)
        for flat in np.arange(0, WIDEST_RAD, 0.5 * place_rad)
        for bend in BENDS_RAD
        for slower in (True, False)
    ]
    return _Shapes(*(np.array(x) for x in zip(*every, strict=True)))


class _Turns:
    """All reversals, prepared for least squares with any shape."""

    def __init__(self, turns: Sequence[_Turn], place_rad: float) -> None:
        groups = np.arange(len(turns)) % min(GROUPS, len(turns))
        turns = [turns[k] for k in np.argsort(groups, kind="stable")]
        self.since = np.concatenate([turn.since for turn in turns])
        self.recorded = np.concatenate([turn.differences for turn in turns], axis=1)
        sizes = np.array([len(turn.since) for turn in turns])
        self._turn = np.repeat(np.arange(len(turns)), sizes)
        self._first = np.r_[0, np.cumsum(sizes)[:-1]]
        self._size = sizes
        self._group_first = self._first[np.flatnonzero(np.diff(np.sort(groups), prepend=-1))]
        self._fine_rad = place_rad / 4  # a shape is constant within each quarter of a place
        self.columns = self._levelled(self.recorded.T)

    def _levelled(self, x: np.ndarray) -> np.ndarray:
        """Subtract each reversal's own mean from (rows, columns)."""
        return x - (np.add.reduceat(x, self._first, axis=0) / self._size[:, None])[self._turn]

    def products(self, shapes: _Shapes) -> np.ndarray:
        """Products of torque, speed, acceleration and a shape: (shapes, groups, 4, 4)."""
        # Shapes are nearly constant over a quarter of a place.
        places, place = np.unique(np.round(self.since / self._fine_rad).astype(int), return_inverse=True)
        missing = shapes.missing(places * self._fine_rad, slice(None))
        rows = np.zeros((len(self._size), len(places)))  # count by reversal and place
        np.add.at(rows, (self._turn, place), 1)
        first = np.searchsorted(self._first, self._group_first)  # turn of each group
        group = np.searchsorted(first, self._turn, side="right") - 1
        sums = np.zeros((len(first), 3, len(places)))
        for k in range(3):
            np.add.at(sums[:, k], (group, place), self.columns[:, k])
        # Columns have zero mean over a reversal, so a shape's mean drops out of their products.
        across = np.moveaxis(sums @ missing, 2, 0)
        means = (rows @ missing) ** 2 / self._size[:, None]
        squares = np.add.reduceat(rows, first) @ missing**2 - np.add.reduceat(means, first)
        own = np.add.reduceat(self.columns[:, :, None] * self.columns[:, None, :], self._group_first, axis=0)
        products = np.empty((len(shapes.flat), len(own), 4, 4))
        products[:, :, :3, :3] = own
        products[:, :, :3, 3] = products[:, :, 3, :3] = across
        products[:, :, 3, 3] = squares.T
        return products

    def trimmed(self, weights: np.ndarray, shapes: _Shapes, k: int) -> list[_Turn]:
        """Return the reversals without rows beyond four robust standard deviations: joints stick and slip."""
        missing = self._levelled(shapes.missing(self.since, k))
        rest = np.abs(self.columns[:, 0] - np.hstack([self.columns[:, 1:], missing]) @ weights)
        near = rest < 4 * 1.4826 * np.median(rest) + 1e-300
        parts = zip(np.split(self.since, self._first[1:]), np.split(self.recorded, self._first[1:], axis=1),
                    np.split(near, self._first[1:]), strict=True)  # fmt: skip
        return [_Turn(since[keep], values[:, keep]) for since, values, keep in parts if keep.sum() >= LEAST_ROWS]

    def curve(self, weights: np.ndarray, place_rad: float) -> tuple[np.ndarray, np.ndarray]:
        """Mean torque at each place without the parts of speed and acceleration, and the places, [rad]."""
        rest = self.recorded[0] - weights[0] * self.recorded[1] - weights[1] * self.recorded[2]
        place = np.floor(self.since / place_rad).astype(int)
        count = np.bincount(place)
        there = np.flatnonzero(count)
        return (there + 0.5) * place_rad, np.bincount(place, rest)[there] / count[there]


def _weights(products: np.ndarray) -> np.ndarray:
    """Least-squares weights of the first column by the others, (..., 3)."""
    ridge = 1e-12 * np.eye(3) * (np.trace(products[..., 1:, 1:], axis1=-2, axis2=-1)[..., None, None] + 1e-30)
    return np.linalg.solve(products[..., 1:, 1:] + ridge, products[..., 1:, :1])[..., 0]


def _left(products: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Residual sum of squares with these weights."""
    whole = np.concatenate([np.ones((*weights.shape[:-1], 1)), -weights], axis=-1)
    return np.einsum("...a,...ab,...b->...", whole, products, whole)


def _squares(products: np.ndarray) -> np.ndarray:
    return _left(products, _weights(products))


# --- Play of joints, as a check.


def play_findings(joints: Sequence[str], plays: Sequence[Play]) -> list[Finding]:
    """Findings of joints whose play is detected."""
    return [
        Finding(
            "backlash",
            "note",
            joint,
            f"{play.width_rad:.2g} ± {play.error_rad:.1g} rad ({play.width_rad * DEGREES:.2g} ± "
            f"{play.error_rad * DEGREES:.1g} degrees): after {play.turns} reversals the position travels so far, on "
            f"average, before the drive carries the {play.share:.0%} of its friction that lie behind the play",
            "the gear carries no load while it crosses its play, so touches are not detected; if the encoder sits "
            "behind the play, the true play is larger",
        )
        for joint, play in zip(joints, plays, strict=True)
        if play.width_rad > 0
    ]


def _facts(play: Play) -> Facts:
    fact: Facts = {"turns": play.turns}
    if play.width_rad > 0:
        fact |= {"backlash_rad": play.width_rad, "backlash_error_rad": play.error_rad}
    if play.lost_rad > 0:
        fact["lost_motion_rad"] = play.lost_rad
    return fact


def _plot(play: Play) -> Plot:
    mark = float(np.degrees(play.width_rad)) if play.width_rad > 0 else None
    travel = np.degrees(play.travel_rad), play.curve
    return Plot(travel, (0, 1.5), shaded=float(np.degrees(play.lost_rad)), mark=mark)


def find_play(recordings: Sequence[Recording]) -> Found:
    """Play of each joint: findings, facts, and the load after a reversal for a picture."""
    joints = recordings[0].joints
    plays = [play_of(recordings, j) for j in range(len(joints))]
    facts = [_facts(play) for play in plays]
    return Found(play_findings(joints, plays), facts=facts, plots=partial(_plots, plays))


def _plots(plays: Sequence[Play]) -> Plots:
    return Plots(
        "friction borne after a turn; shaded: half of it is not",
        "travel since the turn, degrees (line: play)",
        [_plot(play) for play in plays],
        any(play.width_rad > 0 for play in plays),
    )


CHECK = Check({"backlash": "a joint has play between its motor and its load"}, find_play)
