"""A load from recordings: mass and centre of mass, how sure they are, and whether it is a load at all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext.errors import RecordingError
from tauext.monitor.frame import NamedFrame
from tauext.monitor.rows import ROW_S, Seen, sums_about

ROUNDS = 3
"""In which inertia and the loaded side of each gear follow from the load found so far."""
LEAST_ROWS = 30
"""Three tenths of a second: less is no measurement."""

LoadEstimate = _core.LoadFound
"""What was found; lengths and axes of the load frame."""


def identify(
    bundle: _core.Bundle, frame: NamedFrame, parts: Sequence[Seen], reach_m: float = 0.3, phi: np.ndarray | None = None
) -> LoadEstimate:
    """The load that these rows show, by weighted least squares on tau_ext.

        tau_ext_j = X_j(m, h) + offset_j + Coulomb_j tanh(dq_j / v) + error,   weights worth / (scale_j sigma_j)^2

    X holds gravity, inertia and the friction that the load adds, through the observer's filter. The centre of mass is
    within the reach: h is drawn to 0 with a standard deviation of m reach / 2.

    Args:
        phi: a load to begin with, (10,).

    Raises:
        RecordingError: fewer than LEAST_ROWS rows.
    """
    if sum(part.rows for part in parts) < LEAST_ROWS:
        raise RecordingError(
            f"{parts[0].recording.name if parts else 'nothing'}: too few healthy samples to weigh a load; it takes "
            f"{LEAST_ROWS * ROW_S:g} s behind the observer's warm-up"
        )
    phi = np.zeros(10) if phi is None else phi
    for _ in range(ROUNDS):
        found = _core.weigh_load(bundle, sums_about(bundle, frame.frame, parts, phi), reach_m, phi.tolist(), rounds=1)
        phi = found.phi
    return found
