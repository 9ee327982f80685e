"""Torque constants of arms that report motor currents, from the model: one factor a joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.config import ObserverConfig
from tauext.data import Recording
from tauext.errors import ConfigError, TrainingError
from tauext.learn.bundle_writing import build_chain
from tauext.learn.find_kinematics import Fitted, can_be_found, find_kinematics
from tauext.learn.friction import SMOOTHING_RAD_S
from tauext.learn.kinematic_sample import LEAST_ROWS, ROW_S, KinematicSample
from tauext.learn.prior_terms import Kind, has_model
from tauext.learn.training_set import Chain
from tauext.robot import empty

PIECES = 10
WELL_DETERMINED = 0.1
"""A constant counts as known whose standard error is at most this share of it, if LEAST_SHARE holds."""
GUESS = 0.5
"""One that is known to this share only is a guess: of no use for reading N m, but nearer to the model's torque, which
it must meet, than amperes are."""
LEAST_SHARE = 0.05
"""Gravity and inertia, as the model has them, must make up this share of what friction leaves of the current."""


@dataclass(frozen=True)
class TorqueConstants:
    """One constant a joint, in N m a unit of the recordings' tau; a negative one says that the sign is inverted."""

    nm_per_unit: np.ndarray  # (n,)
    standard_errors: np.ndarray  # (n,)
    determined: np.ndarray  # (n,) bool
    relative_to: int | None = None
    """Joint in whose recorded unit all torques are then, where no model says what a N m is; None: they are in N m."""

    @property
    def guessed(self) -> np.ndarray:
        """(n,) bool: not determined, but used."""
        with np.errstate(invalid="ignore"):
            return ~self.determined & (self.nm_per_unit > 0) & (self.standard_errors <= GUESS * self.nm_per_unit)

    @property
    def used(self) -> list[float]:
        """What recordings are scaled by: 1 for a joint of which nothing is known, whose torque stays as it was."""
        return np.where(self.determined | self.guessed, self.nm_per_unit, 1.0).tolist()

    def facts(self, joints: Sequence[str]) -> dict:
        """For provenance: what is used, in the order of the joints, and what was found of each."""
        relative = {} if self.relative_to is None else {"relative_to": joints[self.relative_to]}
        return relative | {
            "used": self.used,
            "found": {
                name: {
                    "nm_per_unit": float(self.nm_per_unit[j]) if np.isfinite(self.nm_per_unit[j]) else None,
                    "standard_error": float(self.standard_errors[j]) if np.isfinite(self.standard_errors[j]) else None,
                    "determined": bool(self.determined[j]),
                }
                for j, name in enumerate(joints)
            },
        }

    def sentences(self, joints: Sequence[str]) -> list[str]:
        """What was found, in words."""
        words = [
            f"{name} {k:.3g} ± {error:.1g}"
            for name, k, error in zip(joints, self.nm_per_unit, self.standard_errors, strict=True)
        ]

        def listed(which: np.ndarray, texts: Sequence[str]) -> str:
            return ", ".join(text for text, here in zip(texts, which, strict=True) if here)

        unit, said, unknown = "Nm", [], ~(self.determined | self.guessed)
        if self.relative_to is not None:
            unit = f"units of {joints[self.relative_to]}"
            said.append(f"without a model nothing says what a Nm is: torques, estimates and limits are in {unit}")
        if self.determined.any():
            said.append(f"torque constants, {unit} a unit of tau: {listed(self.determined, words)}")
        if self.guessed.any():
            said.append(
                f"torque constants of {listed(self.guessed, words)} are guesses, gravity and inertia there are too "
                f"small beside friction: their torques, estimates and limits are no {unit} to rely on"
            )
        if unknown.any():
            said.append(
                f"torque constants of {listed(unknown, joints)} are undetermined, gravity and inertia there are too "
                "small beside friction: their torques, estimates and limits stay in the recordings' own unit"
            )
        return said


def fit_torque_constants(tree: _core.Tree, recordings: Sequence[Recording], config: ObserverConfig) -> TorqueConstants:
    r"""Constants k from free motion, where the torque of the model and friction are what the current i exerts.

    .. math:: \mathrm{LP}(i) = \mathrm{LP}(\tau_{model}) / k + J\,\mathrm{LP}(\ddot q)
              + c + v\,\dot q + f \tanh(\dot q / 0.03\,\mathrm{rad/s})

    by least squares a joint, each term behind the observer's low-pass, which takes the derivative of the momentum. The
    current is the target and not a regressor, since it has the noise. J is of rotors, which few URDFs know and which
    outweigh the links at the wrists; else the model is taken as it is: an unknown payload goes into the constants.
    Standard errors come from leaving out one tenth of the motion after the other.

    Without a model they are compared with the arm that is found in the motion; then only their ratios show.

    Raises:
        ConfigError: no model, and no arm can be found: a joint slides, or too little motion.
        TrainingError: no recording is longer than the observer's warm-up.
    """
    chain, n = build_chain(tree, recordings[0], config), tree.size
    own = [
        [
            _core.Term(Kind.constant, j),
            _core.Term(Kind.viscous, j),
            _core.Term(Kind.coulomb, j, speed=SMOOTHING_RAD_S),
        ]
        for j in range(n)
    ]
    if not has_model(chain):
        return _relative_constants(chain, recordings, own)
    settings = _core.PriorSettings()
    settings.terms = [term for terms in own for term in terms]
    settings.weights = [0.0] * (n * len(settings.terms))
    rotors = _unit_rotors(tree)
    stacked = []
    for recording in recordings:
        motion = (recording.t_ns, recording.q, recording.dq)
        with_none = _core.observe(tree, chain.observer, *motion, np.zeros_like(recording.tau))
        rows = np.flatnonzero(with_none.warm.astype(bool))[:: chain.observer.network_stride].astype(np.int64)
        if len(rows) == 0:
            continue
        signals = (*motion, recording.tau)
        current = with_none.residual - _core.observe(tree, chain.observer, *signals).residual
        friction = _core.prior_regressors(tree, chain.observer, settings, *signals, rows)
        push = _core.observe(rotors, chain.observer, *motion, np.zeros_like(recording.tau)).residual
        stacked.append((with_none.residual[rows], current[rows], friction, push[rows]))
    if not stacked:
        raise TrainingError(f"no training recording is longer than the observer's warm-up of {chain.warm_up_s:g} s")
    model, current, friction, push = (np.concatenate([one[k] for one in stacked]) for k in range(4))
    beside = [np.column_stack([friction[:, 3 * j : 3 * j + 3], push[:, j]]) for j in range(n)]
    found = [_fit(model[:, j], current[:, j], beside[j]) for j in range(n)]
    return TorqueConstants(*(np.array([one[k] for one in found]) for k in range(3)))


def _relative_constants(
    chain: Chain, recordings: Sequence[Recording], own: Sequence[Sequence[_core.Term]]
) -> TorqueConstants:
    """Constants as multiples of that of the joint in which the arm found in the motion shows best."""
    joints = tuple(link.joint_name for link in chain.tree.links)
    sample = (
        KinematicSample(chain.tree, chain.observer, recordings, own, chain.widths_rad) if can_be_found(chain) else None
    )
    if sample is None or sample.rows < LEAST_ROWS:
        raise ConfigError(
            "torque constants are found by comparing with a model, and there is none (case 'none'); nor can an arm be "
            f"found in the motion, which takes turning joints, gravity and {LEAST_ROWS * ROW_S:g} s of it"
        )
    candidate = find_kinematics(sample, joints, one_unit=False)
    fitted = Fitted.of(sample, joints, candidate.kinematics, candidate.scales)
    said = fitted.columns @ fitted.parameters.ravel()
    found = [_fit(said[:, j], sample.target[:, j], sample.own[j]) for j in range(len(joints))]
    constants, errors, determined = (np.array([one[k] for one in found]) for k in range(3))
    best = int(np.nanargmin(np.where(constants > 0, errors / np.abs(constants), np.inf)))
    return TorqueConstants(constants / constants[best], errors / constants[best], determined, best)


def _unit_rotors(tree: _core.Tree) -> _core.Tree:
    """The same joints with nothing but a rotor inertia of 1 each, so that p = dq and beta = 0."""
    links = empty(tree).links
    for link in links:
        link.rotor_inertia = 1.0
    return _core.Tree(links, tree.gravity)


def _fit(model: np.ndarray, current: np.ndarray, beside: np.ndarray) -> tuple[float, float, bool]:
    """Constant, standard error, and whether that is known, of one joint; `beside` is friction and rotor."""
    columns = np.column_stack([model, beside])
    pieces = [
        (columns[at].T @ columns[at], columns[at].T @ current[at]) for at in np.array_split(range(len(model)), PIECES)
    ]
    gram, moment = (sum(piece[k] for piece in pieces) for k in range(2))
    share = np.linalg.lstsq(gram, moment, rcond=None)[0]
    leave_one = np.array([np.linalg.lstsq(gram - g, moment - m, rcond=None)[0][0] for g, m in pieces])
    error = np.sqrt((PIECES - 1) / PIECES * ((leave_one - leave_one.mean()) ** 2).sum())
    left = current - beside @ np.linalg.lstsq(beside, current, rcond=None)[0]
    explained = 1 - np.sum((current - columns @ share) ** 2) / max(float(left @ left), 1e-300)
    if not abs(share[0]) > 0:
        return np.nan, np.nan, False
    determined = error <= WELL_DETERMINED * abs(share[0]) and explained >= LEAST_SHARE
    return 1 / share[0], error / share[0] ** 2, bool(determined)
