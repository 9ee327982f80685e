"""Which bundles can weigh, and with which joints."""

from __future__ import annotations

import numpy as np

from tauext import _core
from tauext.errors import ConfigError


def expect_weighable(bundle: _core.Bundle) -> None:
    """Raise ConfigError where tau_ext is no torque of the joint that a weight could be read from."""
    if bundle.observer.method.name != "momentum":
        raise ConfigError(
            f"bundle '{bundle.name}' follows the {bundle.observer.method.name} residual; a load is weighed by the "
            "momentum observer's (recipes tauext, prior, friction, observer)"
        )
    if not any(link.mass > 0 for link in [*bundle.links, *bundle.prior.corrected_links]):
        raise ConfigError(
            f"bundle '{bundle.name}' knows no arm, neither from a model nor found in its motion: no levers"
        )
    if not weighing_joints(bundle).any():
        raise ConfigError(
            f"bundle '{bundle.name}' has no torque constant of any joint; a load is weighed by joints whose torque is "
            "in N m: give the constants (--torque-constants of train)"
        )


def weighing_joints(bundle: _core.Bundle) -> np.ndarray:
    """Joints whose torques can be added up, (n,) bool: those in N m or N; without any, those in one common unit.

    A torque in amperes stands for another number of N m on every joint.
    """
    newtons = np.array(bundle.in_newtons)
    if newtons.any():
        return newtons
    own = np.array(bundle.units.unknown or [0] * bundle.joints, dtype=bool)
    return ~own & np.array([unit != "A" for unit in bundle.estimate_units])
