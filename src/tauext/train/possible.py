"""What the arm can do at most, and the recordings without the samples that say more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext._core import TorqueUnit, Tree
from tauext.config import ModelCase, TrainConfig
from tauext.data.amperes import from_amperes, in_amperes
from tauext.data.free_motion import free_pieces
from tauext.data.impossible import LeftOut, SignalBounds, possible_parts
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.fit.bundle_writing import build_setup
from tauext.fit.signal_bounds import signal_bounds
from tauext.fit.torque_constants import TorqueConstants, fit_torque_constants, with_constants
from tauext.train.recordings import given_unit, wants_constants

AT_LIMIT = 0.999
"""Share of a drive's limit from which on a monitor calls it saturated (SignalWatch::kSaturated)."""
MOST_AT_LIMIT = 2e-3
"""Share of the training samples: of seven joints together, 1.4 % of the samples would be saturated at most."""


@dataclass(frozen=True)
class PossibleMotion:
    """The recordings as a monitor of this bundle would see them."""

    training: list[Recording]
    validation: list[Recording]
    bounds: SignalBounds
    torque_limit_nm: np.ndarray
    """Of each drive, infinite where nobody knows."""
    constants: TorqueConstants | None
    """That tau is to be multiplied by; None: it is in N m, or nothing tells."""
    left_out: LeftOut
    passed: np.ndarray
    """Joints whose drive limit of the robot file does not hold, (n,) bool; see passed_limits."""


def possible_motion(
    tree: Tree,
    case: ModelCase,
    training: Sequence[Recording],
    validation: Sequence[Recording],
    torque_limit_nm: np.ndarray,
    config: TrainConfig,
) -> PossibleMotion:
    """Leave impossible samples out, and find torque constants on what is left.

    Bounds are in the unit of the bundle's answers, which follows from the constants: those are fitted to what is
    possible in the recordings' own unit, which no drive limit speaks of.

    Args:
        training: at least one.
        torque_limit_nm: what the robot file says of each drive, infinite where it does not.

    Raises:
        ConfigError: torque constants are not one a joint.
        TrainingError: too many samples are impossible, or the recordings' joints are not the model's.
    """
    observer = build_setup(tree, training[0], config.observer, config.recipe, config.filters).observer
    constants = None
    if config.torque_constants is not None:
        constants = known_constants(config.torque_constants, training)
        observer = with_constants(observer, constants.used)
    elif wants_constants(config, training, case):
        parts = possible_parts(training, observer, signal_bounds(training), LeftOut("training"))
        free = free_pieces(parts, config.margins)
        constants = fit_torque_constants(tree, free, config.observer, from_amperes(training))
        observer = with_constants(observer, constants.used)
    drives = np.where(in_newton_metres(constants, training, config), torque_limit_nm, np.inf)
    free = free_pieces(training, config.margins)
    passed = passed_limits(free, drives, constants.used if constants else (1.0,))
    drives = np.where(passed, np.inf, drives)
    bounds = signal_bounds(training, drives, constants.used if constants else (1.0,))
    left_out = LeftOut("training and validation" if validation else "training")
    learned_on = possible_parts(training, observer, bounds, left_out)
    validated_on = possible_parts(validation, observer, bounds, left_out)
    return PossibleMotion(learned_on, validated_on, bounds, drives, constants, left_out, passed)


def passed_limits(free: Sequence[Recording], torque_limit_nm: np.ndarray, nm_per_unit: Sequence[float]) -> np.ndarray:
    """Joints, (n,) bool, whose torque is at or beyond the robot file's limit in MOST_AT_LIMIT of free motion or more.

    With such a limit the monitor would report its own training motion as saturated: the file is wrong, or the drive
    usually works at its limit. During a contact a drive may well reach a limit that is right.

    Args:
        free: free motion; none of it passes no limit.
    """
    if not free:
        return np.zeros(len(torque_limit_nm), dtype=bool)
    at_limit = [np.abs(one.tau * nm_per_unit) >= AT_LIMIT * torque_limit_nm for one in free]
    return np.asarray(np.concatenate(at_limit).mean(axis=0) >= MOST_AT_LIMIT)


def known_constants(nm_per_unit: Sequence[float], training: Sequence[Recording]) -> TorqueConstants:
    """Constants on a person's word.

    Raises:
        ConfigError: they are not one a joint.
    """
    joints = training[0].joints
    if len(nm_per_unit) != len(joints):
        raise ConfigError(
            f"torque_constants = {', '.join(f'{k:g}' for k in nm_per_unit)}: must be {len(joints)}, one for each of "
            f"{', '.join(joints)}"
        )
    sure = np.ones(len(joints), dtype=bool)
    return TorqueConstants(np.array(nm_per_unit), np.zeros(len(joints)), sure, given=not in_amperes(training))


def in_newton_metres(
    constants: TorqueConstants | None, training: Sequence[Recording], config: TrainConfig
) -> np.ndarray | bool:
    """Whether a joint's torque is known in N m, so that it can be held against what the robot file says."""
    if constants is None:
        return given_unit(config, training) == TorqueUnit.newton_metre
    return constants.given or (constants.determined & (constants.relative_to is None))
