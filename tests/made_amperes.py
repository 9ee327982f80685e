"""Bundles that take motor currents."""

from __future__ import annotations

import numpy as np

from tauext import _core
from tauext.fit.torque_constants import with_constants


def taking_amperes(bundle: _core.Bundle, nm_per_ampere: np.ndarray) -> _core.Bundle:
    """The same bundle for currents: it says of tau / nm_per_ampere what it said of tau."""
    bundle.observer = with_constants(bundle.observer, nm_per_ampere)
    bundle.units = _core.TorqueUnits(_core.TorqueUnit.ampere)
    bundle.scale_reference((1 / nm_per_ampere).tolist())
    return bundle
