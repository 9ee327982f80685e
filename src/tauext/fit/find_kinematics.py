"""Finds the axes and link lengths of an arm that has no model, from what its joints' torques show."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.fit.inertial_regressors import observed
from tauext.fit.kinematic_sample import RIDGE, KinematicSample
from tauext.fit.kinematics import Kinematics
from tauext.fit.possible_links import FIRST_MOMENT, LARGEST, LARGEST_SPREAD, MASS, ROTOR
from tauext.fit.ties import ranked, simplest
from tauext.fit.training_set import Setup
from tauext.robot.inertial import PARAMETERS, with_inertial_parameters

DIRECTIONS = np.vstack([np.eye(3), -np.eye(3)])
"""Axes of nearly all arms stand at right angles at q = 0; the others are found from the nearest of these."""
BEAM = 8
REFINED = 3
STEPS = 12
FIRST_SHIFT_M = 0.1
MOST_TURN_RAD, MOST_SHIFT_M, MOST_RATIO = 0.3, 0.2, 0.5  # of one step
DELTA = 1e-4  # [rad] or [m] of the numerical derivative
GAINS_LITTLE = 1e-3
"""Share of the squared error: a step that gains less is the last one; of arms so nearly alike the first is taken."""
AXES_TIE = 1e-6
"""Of the squared error: mirror images, and axes on which the torques do not depend, differ by rounding alone."""
OBLIQUE_HELPS = 0.3
"""Axes stay at right angles unless the error falls by this share: few arms are built otherwise."""

ABOUT_ITS_ORIGIN = range(1, ROTOR)  # first moments and inertia: all that a link shows whose joints meet in one point


@dataclass(frozen=True)
class Candidate:
    """An arm, and its squared error on left-out motion as a share of r's."""

    kinematics: Kinematics
    error: float
    scales: np.ndarray
    """(n,) of each joint's r against what the arm says; 1 where torques of all joints are in one unit."""


def can_be_found(setup: Setup) -> bool:
    """Whether all joints turn, and something weighs on them."""
    turning = all(link.type == _core.JointType.revolute for link in setup.tree.links)
    return turning and bool(np.any(setup.tree.gravity))


def find_kinematics(
    sample: KinematicSample,
    joints: Sequence[str],
    tell: Callable[[str], None] | None = None,
    one_unit: bool = True,
    start: Kinematics | None = None,
) -> Candidate:
    """The serial arm of revolute joints whose inertia explains r best beside each joint's friction.

    Gravity's torques depend on the directions of the axes and on a first moment a link, whatever the links' lengths,
    so directions come first: joint by joint from the base, among those at right angles, the best few being kept
    (beam search). Lengths and oblique axes follow by Gauss-Newton steps in all unknowns at once; r is linear in
    the inertial parameters. The arm found is one that moves and weighs like the true one: an axis that its torques do
    not depend on, and a shift along an axis, may be any.

    Args:
        tell: takes a line a stage.
        one_unit: torques of all joints are in N m; False: each in a unit of its own, of which only the ratios show.
        start: an arm that was found in torques of other units, from which the search goes on.
    """
    tell = tell or (lambda line: None)
    free = frozenset() if one_unit else frozenset({"scales"})
    if start is not None:
        best = [Candidate(start, np.inf, np.ones(sample.joints))]
    else:
        best = directions(sample, joints)
        tell(f"axes at right angles: error {np.sqrt(best[0].error):.1%} of r")
    tried = [refined(sample, joints, one, free) for one in best[:REFINED]]
    found = simplest(tried, lambda one: one.error, GAINS_LITTLE)
    tell(f"with link lengths: {np.sqrt(found.error):.1%}")
    oblique = refined(sample, joints, found, free | {"axes"})
    tell(f"with oblique axes: {np.sqrt(oblique.error):.1%}")
    return oblique if oblique.error < (1 - OBLIQUE_HELPS) ** 2 * found.error else found


def directions(sample: KinematicSample, joints: Sequence[str]) -> list[Candidate]:
    """Arms whose axes meet in one point, the best first."""
    n = sample.joints
    rotors = sample.regressors(arm(np.zeros((0, 3)), n).tree(joints, sample.gravity), range(n), [ROTOR])
    beam: list[tuple[float, np.ndarray, np.ndarray]] = [(np.inf, np.zeros((0, 3)), rotors)]
    for link in range(n):
        longer = []
        for _, axes, columns in beam:
            for direction in DIRECTIONS:
                tried = np.vstack([axes, direction])
                if not faces_x(tried):
                    continue
                of_link = sample.regressors(arm(tried, n).tree(joints, sample.gravity), [link], ABOUT_ITS_ORIGIN)
                together = np.concatenate([columns, of_link], axis=2)
                longer.append((sample.regression(together).score(RIDGE), tried, together))
        beam = ranked(longer, lambda one: one[0], AXES_TIE, BEAM)
    return [Candidate(arm(axes, n), error, np.ones(n)) for error, axes, _ in beam]


def faces_x(axes: np.ndarray) -> bool:
    """Whether the first axis that is not vertical is x: others are the same arm, turned about the vertical."""
    level = axes[np.abs(axes[:, 2]) < 0.5]
    return len(level) == 0 or bool(level[0, 0] > 0.5)


def arm(axes: np.ndarray, joints: int) -> Kinematics:
    """With these axes, and vertical ones behind them, all through one point."""
    axes = np.vstack([axes, np.tile([0.0, 0.0, 1.0], (joints - len(axes), 1))])
    return Kinematics(axes, np.zeros_like(axes))


def refined(sample: KinematicSample, joints: Sequence[str], start: Candidate, free: frozenset[str]) -> Candidate:
    """The same after Gauss-Newton steps in lengths; it is at least as good on left-out motion.

    Args:
        free: what may change beside them, of "axes" and "scales".
    """
    n = sample.joints
    now = start.kinematics
    if not now.origins.any():  # there some lengths have no slope
        shifts = np.random.default_rng(0).normal(size=(n, 2)) * FIRST_SHIFT_M
        now = now.moved(np.zeros((n, 2)), shifts)
    state = Fitted.of(sample, joints, now, start.scales)
    for _ in range(STEPS):
        step = state.step(sample, joints, free)
        for share in (1.0, 0.5, 0.2, 0.05):
            turns, shifts, ratios = (share * part for part in step)
            tried = Fitted.of(sample, joints, state.kinematics.moved(turns, shifts), state.scales * np.exp(ratios))
            if tried.error < state.error:
                break
        else:
            break
        gained, state = 1 - tried.error / state.error, tried
        if gained < GAINS_LITTLE:
            break
    return Candidate(state.kinematics, state.error, state.scales) if state.error < start.error else start


@dataclass(frozen=True)
class Fitted:
    """An arm with the inertia that fits it best."""

    kinematics: Kinematics
    scales: np.ndarray
    columns: np.ndarray
    error: float
    parameters: np.ndarray  # (n, 11)

    @classmethod
    def of(cls, sample: KinematicSample, joints: Sequence[str], kinematics: Kinematics, scales: np.ndarray) -> Fitted:
        n = sample.joints
        columns = sample.regressors(kinematics.tree(joints, sample.gravity), range(n), range(len(PARAMETERS)))
        regression = sample.regression(columns, scales)
        of_links = np.arange(-n * len(PARAMETERS), 0)
        regression.bound(of_links, np.full(len(of_links), -LARGEST), np.full(len(of_links), LARGEST))
        solution = regression.solve(regression.whole, RIDGE)
        parameters = solution[-n * len(PARAMETERS) :].reshape(n, -1)
        return cls(kinematics, scales, columns, regression.score(RIDGE), parameters)

    def step(
        self, sample: KinematicSample, joints: Sequence[str], free: frozenset[str]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Turns and shifts, (n, 2), and logarithms of scales, (n,), that explain most of r, all else fitted anew."""
        n, base = sample.joints, self._said(sample, joints, self.kinematics)
        unknowns = np.eye(4 * n)[0 if "axes" in free else 2 * n :]
        slopes = []
        for unknown in unknowns:
            turns, shifts = (DELTA * unknown).reshape(2, n, 2)
            slopes.append((self._said(sample, joints, self.kinematics.moved(turns, shifts)) - base) / DELTA)
        of_scales = np.eye(n)[:, :, None] * base.T[None] if "scales" in free else np.zeros((0, n, len(base)))
        both = [self.columns, np.stack(slopes, axis=2), of_scales.transpose(2, 1, 0)]
        regression = sample.regression(np.concatenate(both, axis=2), self.scales)
        found = len(unknowns) + len(of_scales)
        solution = regression.solve(regression.whole, RIDGE)[-found:]
        turns, shifts = (solution[: len(unknowns)] @ unknowns).reshape(2, n, 2)
        ratios = np.zeros(n)
        if len(of_scales):
            ratios = solution[len(unknowns) :]
        return (
            np.clip(turns, -MOST_TURN_RAD, MOST_TURN_RAD),
            np.clip(shifts, -MOST_SHIFT_M, MOST_SHIFT_M),
            np.clip(ratios, -MOST_RATIO, MOST_RATIO),
        )

    def _said(self, sample: KinematicSample, joints: Sequence[str], kinematics: Kinematics) -> np.ndarray:
        """What its inertia adds to r with these kinematics, (rows, n)."""
        links = kinematics.tree(joints, sample.gravity).links
        extra = np.zeros_like(self.parameters)  # without it, a fitted mass or rotor may be one that no link can have
        moments = np.linalg.norm(self.parameters[:, FIRST_MOMENT], axis=1)
        extra[:, MASS] = np.maximum(0.0, np.maximum(1.0, moments**2 / LARGEST_SPREAD) - self.parameters[:, MASS])
        extra[:, ROTOR] = np.maximum(0.0, -self.parameters[:, ROTOR])
        light = [with_inertial_parameters(link, p) for link, p in zip(links, extra, strict=True)]
        whole = [with_inertial_parameters(link, p) for link, p in zip(links, extra + self.parameters, strict=True)]
        said = [
            observed(light, sample.gravity, sample.observer, *piece)
            - observed(whole, sample.gravity, sample.observer, *piece)
            for piece in sample.pieces
        ]
        return np.concatenate(said)
