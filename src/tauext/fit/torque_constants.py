"""Torque constants of arms that report motor currents: one factor a joint."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from tauext import _core
from tauext.config import ObserverConfig, PriorConfig
from tauext.data.recording import Recording
from tauext.errors import ConfigError, TrainingError
from tauext.fit.bundle_writing import build_setup
from tauext.fit.find_kinematics import Fitted, can_be_found, find_kinematics
from tauext.fit.kinematic_sample import LEAST_ROWS, ROW_S, KinematicSample
from tauext.fit.kinematics import Kinematics
from tauext.fit.prior_terms import has_model, own_terms
from tauext.fit.scaled_arm import fit_scaled_arm
from tauext.fit.ties import simplest
from tauext.fit.training_set import Setup, with_presliding
from tauext.robot.perturb import empty

PIECES = 10
WELL_DETERMINED = 0.15
"""A constant counts as known whose standard error is at most this share of it: masses are seldom known better."""
GUESS = 0.5
"""One that is known to this share only is a guess: of no use for reading N m, but nearer to the model's torque, which
it must meet, than amperes are."""
LEAST_SHARE = 0.05
"""Without a model: what gravity and inertia of the arm found must make up of what friction leaves of the current."""
UNKNOWN_TO = 1.0
"""Standard deviation of the logarithm of a constant that nobody knows about what the model as it is says."""
GIVEN_TO = 0.1
"""The same of a given one: makers' numbers, and gear losses beside them, are right to about 10 %."""
KEPT = 0.75
"""A given constant is kept where motion leaves this share of its doubt or more."""
UNIT_TIE = 0.01
"""Of a standard error from PIECES parts: of joints that are known so nearly alike, the first has the unit of all."""
ARM_OFF = 0.05
"""Share by which the torques of an arm found in the motion are off, beside their scatter."""


@dataclass(frozen=True)
class TorqueConstants:
    """One constant a joint, in N m a unit of the recordings' tau; a negative one says that the sign is inverted."""

    nm_per_unit: np.ndarray  # (n,)
    standard_errors: np.ndarray  # (n,)
    determined: np.ndarray  # (n,) bool
    relative_to: int | None = None
    """Joint in whose recorded unit all torques are then, where no model says what a N m is; None: they are in N m."""
    given: bool = False
    """They correct constants that the recordings were multiplied by; one that is not determined is kept."""
    kinematics: Kinematics | None = None
    """Of the arm found in the motion, where there is no model."""

    @property
    def guessed(self) -> np.ndarray:
        """(n,) bool: not determined, but used."""
        with np.errstate(invalid="ignore"):
            near = (self.nm_per_unit > 0) & (self.standard_errors <= GUESS * self.nm_per_unit)
        return near & ~self.determined & (not self.given)

    @property
    def used(self) -> list[float]:
        """What recordings are scaled by: 1 for a joint of which nothing is known, whose torque stays as it was."""
        return np.where(self.determined | self.guessed, self.nm_per_unit, 1.0).tolist()

    def units(self, given: _core.TorqueUnit) -> _core.TorqueUnits:
        """What a bundle with these constants takes and answers in; given: the unit of the recordings' tau."""
        unknown = ~(self.determined | self.guessed) & (not self.given)
        relative_to = -1 if self.relative_to is None else self.relative_to
        return _core.TorqueUnits(given, relative_to, unknown.astype(int).tolist() if unknown.any() else [])

    def facts(self, joints: Sequence[str]) -> dict:
        """For provenance: what is used, in the order of the joints, and what was found of each."""
        facts: dict = {} if self.relative_to is None else {"relative_to": joints[self.relative_to]}
        facts |= {"given": True} if self.given else {}
        return facts | {
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

        if self.given:
            kept = f"; kept for {listed(~self.determined, joints)}, whose motion says no more"
            if not self.determined.any():
                return ["torque constants of the import are kept: the motion says no more"]
            return [
                f"torque constants of the import, corrected by a factor: {listed(self.determined, words)}"
                f"{kept if not self.determined.all() else ''}. The bundle applies them, a loop gives what it recorded"
            ]
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


def fit_torque_constants(
    tree: _core.Tree, recordings: Sequence[Recording], config: ObserverConfig, given: bool = False
) -> TorqueConstants:
    """Constants from free motion, where friction and the torque of the model are what the current exerts.

    The model's masses, centres of mass and inertia are corrected along with them, see fit_scaled_arm: a tool that it
    lacks does not go into the constants. Friction is the prior's, and a joint's rotor is its own.

    Without a model they are compared with the arm that is found in the motion; then only their ratios show.

    Args:
        given: the recordings' currents were multiplied by constants known to GIVEN_TO; what is found corrects them.

    Raises:
        ConfigError: no model, and no arm can be found: a joint slides, or too little motion.
        TrainingError: no recording is longer than the observer's warm-up.
    """
    friction = PriorConfig()
    setup = with_presliding(build_setup(tree, recordings[0], config), friction.widths_rad)
    tops = np.max([np.abs(recording.dq).max(axis=0) for recording in recordings], axis=0)
    own = [own_terms(setup, friction, j, top_speed_rad_s=top) for j, top in enumerate(tops.tolist())]
    if not has_model(setup):
        return _relative_constants(setup, recordings, own, given)
    sample = KinematicSample(empty(tree), setup.observer, recordings, own, setup.widths_rad)
    if not sample.rows:
        raise TrainingError(f"no training recording is longer than the observer's warm-up of {setup.warm_up_s:g} s")
    if given:
        arm = fit_scaled_arm(sample, tree, GIVEN_TO, np.ones(tree.size))
        return given_constants(arm.nm_per_unit, arm.log_errors)
    arm = fit_scaled_arm(sample, tree, UNKNOWN_TO)
    return TorqueConstants(arm.nm_per_unit, arm.log_errors * np.abs(arm.nm_per_unit), arm.log_errors <= WELL_DETERMINED)


def with_constants(observer: _core.ObserverSettings, nm_per_unit: Sequence[float]) -> _core.ObserverSettings:
    """The same settings for recordings whose tau is to be multiplied by these, a joint."""
    kept = ("gain_per_s", "timing", "sample_period_ns", "network_stride", "method", "high_pass_per_s", "low_pass_per_s")
    settings = {name: getattr(observer, name) for name in kept}
    return _core.ObserverSettings(**settings, nm_per_unit=[float(constant) for constant in nm_per_unit])


def given_constants(factors: np.ndarray, log_errors: np.ndarray) -> TorqueConstants:
    """Corrections of given constants; 1 where the data say little more than what was given."""
    determined = (log_errors <= KEPT * GIVEN_TO) & (factors > 0)
    factors, errors = np.where(determined, factors, 1.0), np.where(determined, log_errors, GIVEN_TO)
    return TorqueConstants(factors, errors * factors, determined, given=True)


def _relative_constants(
    setup: Setup, recordings: Sequence[Recording], own: Sequence[Sequence[_core.Term]], given: bool
) -> TorqueConstants:
    """Constants as multiples of that of the joint in which the arm found in the motion shows best.

    Given ones keep their mean and are drawn towards 1 as far as the motion leaves it open.
    """
    joints = tuple(link.joint_name for link in setup.tree.links)
    sample = (
        KinematicSample(setup.tree, setup.observer, recordings, own, setup.widths_rad) if can_be_found(setup) else None
    )
    if sample is None or sample.rows < LEAST_ROWS:
        if given:
            return given_constants(np.ones(len(joints)), np.full(len(joints), np.inf))
        raise ConfigError(
            "torque constants are found by comparing with a model, and there is none (case 'none'); nor can an arm be "
            f"found in the motion, which takes turning joints, gravity and {LEAST_ROWS * ROW_S:g} s of it "
            "(--fit-torque-constants False trains in the recordings' own unit)"
        )
    candidate = find_kinematics(sample, joints, one_unit=False)
    fitted = Fitted.of(sample, joints, candidate.kinematics, candidate.scales)
    said = fitted.columns @ fitted.parameters.ravel()
    found = [_fit(said[:, j], sample.target[:, j], sample.own[j]) for j in range(len(joints))]
    constants, errors, determined = (np.array([one[k] for one in found]) for k in range(3))
    if given:
        return replace(drawn_to_given(constants, errors), kinematics=candidate.kinematics)
    known_to = np.where((constants > 0) & np.isfinite(errors), errors / np.abs(constants), np.inf)
    best = simplest(range(len(joints)), known_to.__getitem__, UNIT_TIE)
    ratios = constants / constants[best], errors / constants[best], determined
    return TorqueConstants(*ratios, relative_to=best, kinematics=candidate.kinematics)


def drawn_to_given(constants: np.ndarray, errors: np.ndarray) -> TorqueConstants:
    """Corrections whose ratios the motion shows: their mean stays as given, each is drawn to 1 as far as it is open."""
    known = (constants > 0) & np.isfinite(errors)
    logs, shares = np.zeros(len(constants)), np.full(len(constants), np.inf)
    logs[known], shares[known] = np.log(constants[known]), np.hypot(errors[known] / constants[known], ARM_OFF)
    trust = 1 / (shares**2 + GIVEN_TO**2)
    logs -= trust @ logs / max(trust.sum(), 1e-300)
    drawn = GIVEN_TO**2 * trust
    return given_constants(np.exp(drawn * logs), GIVEN_TO * np.sqrt(1 - drawn))


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
