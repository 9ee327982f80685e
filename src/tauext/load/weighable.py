"""Which bundles can weigh."""

from __future__ import annotations

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
