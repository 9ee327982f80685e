"""An error scale that is easy to work out by hand."""

from __future__ import annotations

from tauext import _core

SIGMA_NM, SIGMA_PER_SPEED, SIGMA_NEAR_NM, LARGEST = 0.1, 0.2, 0.3, 4.0


def with_error_scale(bundle: _core.Bundle, per_speed: float = 1.0) -> _core.Bundle:
    """This bundle, changed: limits grow by per_speed of themselves a rad/s, sigma with the speed, too."""
    scale, n = _core.ErrorScaleSettings(), bundle.joints
    scale.features = [_core.MotionFeature.constant, _core.MotionFeature.speed]
    scale.limit_weights = [1.0, per_speed] * n
    scale.largest = [LARGEST] * n
    scale.sigma_weights = [SIGMA_NM, SIGMA_PER_SPEED] * n
    scale.sigma_near_weights = [SIGMA_NEAR_NM, 0.0] * n
    scale.largest_sigma = [1e3] * n
    bundle.error_scale = scale
    return bundle
