"""Axes and link lengths of an arm without a model, found from the torques of its joints."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tauext import _core
from tauext.data.free_motion import between
from tauext.data.recording import FLAGS, OPTIONAL_SIGNALS, Recording
from tauext.fit.links import FIRST_MOMENT, LARGEST, LARGEST_SPREAD, MASS, ROTOR, observed
from tauext.fit.regression import FOLDS, NormalEquations, Regression
from tauext.fit.stable_choice import ranked, simplest
from tauext.fit.training_set import Setup
from tauext.robot.inertial import PARAMETERS, with_inertial_parameters


@dataclass(frozen=True)
class ArmSearch:
    """How an arm is found in its motion; more motion and more candidates find it in harder cases, and take longer."""

    sample_s: float = 120.0
    """Motion on which candidates are compared, [s] ..."""
    piece_s: float = 10.0
    """... in pieces of this length, [s], spread evenly over the recordings."""
    row_s: float = 0.04
    """Time between rows, [s]: r changes little within it, as 1/K0 is 0.05 s."""
    ridge: float = 1e-4
    """Ridge of all fits of candidates."""
    least_moving: float = 0.1
    """Share of a piece in which a joint moves: of an arm that rests for most of the time, these pieces are taken."""
    least_rows: int = 250
    """Fewest rows, 10 s of motion: an arm has some seventy unknowns."""
    moves_rad_s: float = 0.02
    """Rows count where a joint moves faster than this, if these are enough: of an arm at rest, friction holds any part
    of gravity ..."""
    rests: bool = False
    """... but rests count, too: a servo with play shows there what its gear carries."""
    beam: int = 8
    """Candidates that are kept from joint to joint ..."""
    refined: int = 3
    """... and those of them whose lengths are fitted ..."""
    steps: int = 12
    """... in at most so many Gauss-Newton steps."""
    first_shift_m: float = 0.1
    """Standard deviation of the first lengths, [m]: at 0, some have no slope."""
    most_turn_rad: float = 0.3
    """Bounds of one step: of a turn, [rad], a shift, [m], and the logarithm of a scale."""
    most_shift_m: float = 0.2
    most_ratio: float = 0.5
    gains_little: float = 1e-3
    """Share of the squared error: a smaller gain ends the steps; among arms this similar, the first is taken."""
    axes_tie: float = 1e-6
    """Share of the squared error: mirror images, and axes on which the torques do not depend, differ by rounding
    alone."""
    oblique_helps: float = 0.3
    """Axes stay at right angles unless the error falls by this share: few arms are built otherwise."""


# --- A thin sample of free motion on which candidate arms are compared.


class KinematicSample:
    """Up to two minutes at the network's rate, and the equations for comparing candidates.

    Args:
        tree: the estimated model: empty, with the gravity of its base.
        observer: of the setup; its method must be the momentum observer's.
        recordings: free motion.
        own: terms of each joint alone, added to every candidate's inertia.
        widths_rad: of their presliding states.
    """

    def __init__(
        self,
        tree: _core.Tree,
        observer: _core.ObserverSettings,
        recordings: Sequence[Recording],
        own: Sequence[Sequence[_core.Term]],
        widths_rad: Sequence[float],
        config: ArmSearch = ArmSearch(),
    ) -> None:
        self.config = config
        self.joints, self.gravity = tree.size, tuple(tree.gravity)
        self.names = tuple(link.joint_name for link in tree.links)
        self.observer = _core.ObserverSettings(
            gain_per_s=observer.gain_per_s,
            timing=_core.TorqueTiming.averaged if observer.network_stride > 1 else observer.timing,
            sample_period_ns=observer.sample_period_ns * observer.network_stride,
            network_stride=1,
            nm_per_unit=observer.nm_per_unit,
            unknown_constant=observer.unknown_constant,
        )
        self.pieces: list[tuple[Recording, np.ndarray]] = []
        targets, values, speeds = [], [], [np.empty((0, self.joints))]
        settings = _core.PriorSettings()
        settings.widths_rad = list(widths_rad)
        settings.terms = [term for group in own for term in group]
        settings.weights = [0.0] * (self.joints * len(settings.terms))
        step = max(1, round(config.row_s / (self.observer.sample_period_ns * 1e-9)))
        observed = []
        for piece in pieces(recordings, config.sample_s, config.piece_s, config.rests):
            thin = thinned(piece, observer.network_stride)
            observation = _core.observe(tree, self.observer, *thin.signals)
            rows = np.flatnonzero(observation.warm.astype(bool))[::step].astype(np.int64)
            observed.append((thin, observation.residual, rows))
        moving = [rows[(np.abs(thin.dq[rows]) > config.moves_rad_s).any(axis=1)] for thin, _, rows in observed]
        enough = not config.rests and sum(map(len, moving)) >= config.least_rows
        for (thin, residual, all_rows), moving_rows in zip(observed, moving, strict=True):
            rows = moving_rows if enough else all_rows
            if len(rows) < FOLDS:
                continue
            self.pieces.append((thin, rows))
            targets.append(residual[rows])
            speeds.append(np.abs(thin.dq[rows]))
            values.append(_core.prior_regressors(tree, self.observer, settings, *thin.signals, rows))
        self.speed_rad_s = np.concatenate(speeds)  # (rows, n)
        if not targets:
            self.rows = 0
            return
        self.target, value = np.concatenate(targets), np.concatenate(values)
        self.rows = len(self.target)
        ends = np.cumsum([len(group) for group in own])
        self.own = [value[:, end - len(group) : end] for group, end in zip(own, ends, strict=True)]
        self._folds = np.array_split(np.arange(self.rows), FOLDS)

    def arm(self, kinematics: Kinematics) -> _core.Tree:
        """The links of an arm on the same base, without mass."""
        return kinematics.tree(self.names, self.gravity)

    def regressors(self, tree: _core.Tree, of: Sequence[int], parameters: Sequence[int]) -> np.ndarray:
        """Derivative of r by these parameters of these links, over the whole sample: (rows, n, links * parameters).

        Args:
            tree: only its kinematics matter, since r is linear in the parameters.
            parameters: indices in PARAMETERS.
        """
        each = [
            _core.LinkRegressors(tree, self.observer, list(of), list(parameters)).rows(one.t_ns, one.q, one.dq, rows)
            for one, rows in self.pieces
        ]
        return np.concatenate(each)

    def regression(self, shared: np.ndarray, scales: np.ndarray | None = None) -> Regression:
        """Regression of r on every joint's own terms and on these columns, common to all joints: (rows, n, columns).

        Args:
            scales: (n,) ratio of each joint's r to the columns; None: 1.
        """
        scales = np.ones(self.joints) if scales is None else scales
        widths = [values.shape[1] for values in self.own]
        ends, common = np.cumsum(widths), np.arange(shared.shape[2])
        columns = tuple(np.r_[end - width : end, ends[-1] + common] for width, end in zip(widths, ends, strict=True))
        equations = []
        for fold in self._folds:
            gram, moment = [], []
            for joint, (values, scale) in enumerate(zip(self.own, scales, strict=True)):
                X = np.hstack([values[fold], scale * shared[fold, joint]])
                gram.append(X.T @ X)
                moment.append(X.T @ self.target[fold, joint])
            energy = (self.target[fold] ** 2).sum(axis=0)
            equations.append(NormalEquations(columns, gram, moment, energy, len(fold)))
        return Regression(equations)


def pieces(recordings: Sequence[Recording], most_s: float, piece_s: float, rests: bool = False) -> list[Recording]:
    """All recordings, or as many pieces of this length, spread evenly over those that move, as make up most_s.

    Args:
        rests: pieces that do not move count, too.
    """
    whole_s = sum(recording.duration_s for recording in recordings)
    if whole_s <= most_s:
        return list(recordings)
    whole = all_pieces(recordings, piece_s)
    moves = [(np.abs(piece.dq) > ArmSearch.moves_rad_s).any(axis=1).mean() >= ArmSearch.least_moving for piece in whole]
    cut = [piece for piece, moving in zip(whole, moves, strict=True) if moving or rests] or whole
    wanted = max(1, int(most_s // piece_s))
    return [cut[k] for k in np.unique(np.linspace(0, len(cut) - 1, wanted).astype(int))]


def all_pieces(recordings: Sequence[Recording], piece_s: float) -> list[Recording]:
    """All of them cut into pieces of at least this length."""
    cut = []
    for recording in recordings:
        count = max(1, int(recording.duration_s // piece_s))
        edges = np.linspace(0, recording.samples, count + 1).astype(int)
        cut += [
            between(recording, a, b, recording.name) for a, b in zip(edges[:-1], edges[1:], strict=True) if b - a > 1
        ]
    return cut


def thinned(recording: Recording, stride: int) -> Recording:
    """Every stride-th sample, with the mean torque of the samples since the one before."""
    if stride == 1:
        return recording
    whole = recording.samples // stride * stride
    tau = recording.tau[:whole].reshape(-1, stride, recording.tau.shape[1]).mean(axis=1)
    kept = {name: getattr(recording, name)[stride - 1 : whole : stride] for name in ("t_ns", "q", "dq")}
    without: dict[str, Any] = dict.fromkeys((*OPTIONAL_SIGNALS, *FLAGS))
    rate_hz = recording.rate_hz / stride
    return replace(recording, tau=tau, rate_hz=rate_hz, torque_timing="averaged", **kept, **without)


# --- An arm without a description: axes and places of its joints, and links.


@dataclass(frozen=True)
class Kinematics:
    """A serial arm of revolute joints at q = 0, in a frame with z up; only what moves the torques is determined.

    Turned about the vertical, or with an origin moved along its axis, the arm is the same.
    """

    axes: np.ndarray
    """(n, 3) unit vectors, by the right-hand rule."""
    origins: np.ndarray
    """(n, 3) a point on each axis, [m]; the first is 0."""

    def tree(self, joints: Sequence[str], gravity: Sequence[float]) -> _core.Tree:
        """Its links, without mass; each one's z axis is its joint's.

        Args:
            gravity: in the frame of the base, [m/s^2], not 0; up is against it.
        """
        upright = frame_of(-np.asarray(gravity) / np.linalg.norm(gravity))
        links, base_from_parent, parent_origin = [], np.eye(3), np.zeros(3)
        for k, (axis, origin) in enumerate(zip(self.axes @ upright.T, self.origins @ upright.T, strict=True)):
            base_from_link = frame_of(axis)
            link = _core.Link()
            link.joint_name, link.parent, link.type = joints[k], k - 1, _core.JointType.revolute
            link.rotation = (base_from_parent.T @ base_from_link).ravel().tolist()
            link.translation = (base_from_parent.T @ (origin - parent_origin)).tolist()
            links.append(link)
            base_from_parent, parent_origin = base_from_link, origin
        return _core.Tree(links, list(gravity))

    def moved(self, turns: np.ndarray, shifts: np.ndarray) -> Kinematics:
        """Axes turned by two small angles each, (n, 2), [rad], and each joint shifted across its axis against the one
        before it, (n, 2), [m]; those after it come along."""
        axes, steps = np.empty_like(self.axes), np.diff(self.origins, axis=0, prepend=np.zeros((1, 3)))
        for k, axis in enumerate(self.axes):
            frame = frame_of(axis)
            axes[k] = frame @ np.array([*turns[k], 1.0])
            steps[k] += frame[:, :2] @ shifts[k]
        return Kinematics(axes / np.linalg.norm(axes, axis=1, keepdims=True), np.cumsum(steps, axis=0))


def frame_of(axis: np.ndarray) -> np.ndarray:
    """A rotation whose third column is this unit vector, (3, 3)."""
    off = np.abs(axis)
    aside = np.eye(3)[np.flatnonzero(off <= off.min() + 0.1)[0]]  # of x and y, as far from z, rounding must not choose
    x = np.cross(aside, axis)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(axis, x), axis])


# --- Finds the axes and link lengths of an arm that has no model, from what its joints' torques show.


@dataclass(frozen=True)
class Candidate:
    """An arm, and its squared error on left-out motion as a share of r's."""

    kinematics: Kinematics
    error: float
    scales: np.ndarray
    """(n,) of each joint's r against the arm's model; 1 where torques of all joints are in one unit."""


def can_be_found(setup: Setup) -> bool:
    """Whether all joints are revolute and gravity acts on them."""
    turning = all(link.type == _core.JointType.revolute for link in setup.tree.links)
    return turning and bool(np.any(setup.tree.gravity))


def find_kinematics(
    sample: KinematicSample,
    report: Callable[[str], None] | None = None,
    one_unit: bool = True,
    start: Kinematics | None = None,
) -> Candidate:
    """The serial arm of revolute joints whose inertia explains r best beside each joint's friction.

    Gravity's torques depend on the directions of the axes and on a first moment a link, whatever the links' lengths,
    so directions come first: joint by joint from the base, among those at right angles, as in nearly all arms at q = 0,
    the best few being kept (beam search). Lengths and oblique axes follow by Gauss-Newton steps in all unknowns at
    once; r is linear in the inertial parameters. The arm found is one that moves and weighs like the true one: an axis
    that its torques do not depend on, and a shift along an axis, may be any.

    Args:
        report: receives one line per stage.
        one_unit: torques of all joints are in N m; False: each in a unit of its own, of which only the ratios show.
        start: an arm that was found in torques of other units, from which the search goes on.
    """
    report = report or (lambda line: None)
    free = frozenset() if one_unit else frozenset({"scales"})
    if start is not None:
        best = [Candidate(start, np.inf, np.ones(sample.joints))]
    else:
        best = directions(sample)
        report(f"axes at right angles: error {np.sqrt(best[0].error):.1%} of r")
    tried = [refined(sample, one, free) for one in best[: sample.config.refined]]
    found = simplest(tried, lambda one: one.error, sample.config.gains_little)
    report(f"with link lengths: {np.sqrt(found.error):.1%}")
    oblique = refined(sample, found, free | {"axes"})
    report(f"with oblique axes: {np.sqrt(oblique.error):.1%}")
    return oblique if oblique.error < (1 - sample.config.oblique_helps) ** 2 * found.error else found


def directions(sample: KinematicSample) -> list[Candidate]:
    """Arms whose axes meet in one point, the best first."""
    n = sample.joints
    rotors = sample.regressors(sample.arm(arm(np.zeros((0, 3)), n)), range(n), [ROTOR])
    beam: list[tuple[float, np.ndarray, np.ndarray]] = [(np.inf, np.zeros((0, 3)), rotors)]
    for link in range(n):
        longer = []
        for _, axes, columns in beam:
            for direction in np.vstack([np.eye(3), -np.eye(3)]):
                tried = np.vstack([axes, direction])
                if not faces_x(tried):
                    continue
                of_link = sample.regressors(sample.arm(arm(tried, n)), [link], range(1, ROTOR))
                together = np.concatenate([columns, of_link], axis=2)
                longer.append((sample.regression(together).score(sample.config.ridge), tried, together))
        beam = ranked(longer, lambda one: one[0], sample.config.axes_tie, sample.config.beam)
    return [Candidate(arm(axes, n), error, np.ones(n)) for error, axes, _ in beam]


def faces_x(axes: np.ndarray) -> bool:
    """Whether the first axis that is not vertical is x: others are the same arm, turned about the vertical."""
    level = axes[np.abs(axes[:, 2]) < 0.5]
    return len(level) == 0 or bool(level[0, 0] > 0.5)


def arm(axes: np.ndarray, joints: int) -> Kinematics:
    """An arm with these axes and vertical ones after them, all through one point."""
    axes = np.vstack([axes, np.tile([0.0, 0.0, 1.0], (joints - len(axes), 1))])
    return Kinematics(axes, np.zeros_like(axes))


def refined(sample: KinematicSample, start: Candidate, free: frozenset[str]) -> Candidate:
    """Refine a candidate by Gauss-Newton steps in lengths; the result is at least as good on left-out motion.

    Args:
        free: what may change beside them, of "axes" and "scales".
    """
    n = sample.joints
    now = start.kinematics
    if not now.origins.any():  # there some lengths have no slope
        shifts = np.random.default_rng(0).normal(size=(n, 2)) * sample.config.first_shift_m
        now = now.moved(np.zeros((n, 2)), shifts)
    state = Fitted.of(sample, now, start.scales)
    for _ in range(sample.config.steps):
        step = state.step(sample, free)
        for share in (1.0, 0.5, 0.2, 0.05):
            turns, shifts, ratios = (share * part for part in step)
            tried = Fitted.of(sample, state.kinematics.moved(turns, shifts), state.scales * np.exp(ratios))
            if tried.error < state.error:
                break
        else:
            break
        gained, state = 1 - tried.error / state.error, tried
        if gained < sample.config.gains_little:
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
    def of(cls, sample: KinematicSample, kinematics: Kinematics, scales: np.ndarray) -> Fitted:
        n = sample.joints
        columns = sample.regressors(sample.arm(kinematics), range(n), range(len(PARAMETERS)))
        regression = sample.regression(columns, scales)
        of_links = np.arange(-n * len(PARAMETERS), 0)
        regression.bound(of_links, np.full(len(of_links), -LARGEST), np.full(len(of_links), LARGEST))
        solution = regression.solve(regression.whole, sample.config.ridge)
        parameters = solution[-n * len(PARAMETERS) :].reshape(n, -1)
        return cls(kinematics, scales, columns, regression.score(sample.config.ridge), parameters)

    def step(self, sample: KinematicSample, free: frozenset[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Turns and shifts, (n, 2), and logarithms of scales, (n,), that explain most of r, all else refitted."""
        n, base = sample.joints, self._predicted(sample, self.kinematics)
        unknowns = np.eye(4 * n)[0 if "axes" in free else 2 * n :]
        slopes = []
        for unknown in unknowns:
            turns, shifts = (1e-4 * unknown).reshape(2, n, 2)
            slopes.append((self._predicted(sample, self.kinematics.moved(turns, shifts)) - base) / 1e-4)
        of_scales = np.eye(n)[:, :, None] * base.T[None] if "scales" in free else np.zeros((0, n, len(base)))
        both = [self.columns, np.stack(slopes, axis=2), of_scales.transpose(2, 1, 0)]
        regression = sample.regression(np.concatenate(both, axis=2), self.scales)
        found = len(unknowns) + len(of_scales)
        solution = regression.solve(regression.whole, sample.config.ridge)[-found:]
        turns, shifts = (solution[: len(unknowns)] @ unknowns).reshape(2, n, 2)
        ratios = np.zeros(n)
        if len(of_scales):
            ratios = solution[len(unknowns) :]
        most = sample.config
        return (
            np.clip(turns, -most.most_turn_rad, most.most_turn_rad),
            np.clip(shifts, -most.most_shift_m, most.most_shift_m),
            np.clip(ratios, -most.most_ratio, most.most_ratio),
        )

    def _predicted(self, sample: KinematicSample, kinematics: Kinematics) -> np.ndarray:
        """Contribution of its inertia to r with these kinematics, (rows, n)."""
        links = sample.arm(kinematics).links
        extra = np.zeros_like(self.parameters)  # without it, a fitted mass or rotor may be one that no link can have
        moments = np.linalg.norm(self.parameters[:, FIRST_MOMENT], axis=1)
        extra[:, MASS] = np.maximum(0.0, np.maximum(1.0, moments**2 / LARGEST_SPREAD) - self.parameters[:, MASS])
        extra[:, ROTOR] = np.maximum(0.0, -self.parameters[:, ROTOR])
        light = [with_inertial_parameters(link, p) for link, p in zip(links, extra, strict=True)]
        whole = [with_inertial_parameters(link, p) for link, p in zip(links, extra + self.parameters, strict=True)]
        modelled = [
            observed(light, sample.gravity, sample.observer, *piece)
            - observed(whole, sample.gravity, sample.observer, *piece)
            for piece in sample.pieces
        ]
        return np.concatenate(modelled)
