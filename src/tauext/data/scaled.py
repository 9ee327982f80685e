"""Recordings whose tau is a motor current: torque constants turn it into the torque that a bundle takes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tauext.data.recording import Recording

AMPERES = "amperes: the torque constant is unknown"
FROM_AMPERES = "N m: amperes times given torque constants"


def scaled_torque(recording: Recording, nm_per_unit: Sequence[float] | None) -> Recording:
    """The recording with each joint's tau times its constant, [N m] a unit of the recording; itself with None.

    Its provenance says so, under `torque_constants`.
    """
    if nm_per_unit is None:
        return recording
    factors = np.asarray(nm_per_unit, dtype=float)
    provenance = recording.provenance | {"torque_constants": factors.tolist()}
    return replace(recording, tau=recording.tau * factors, provenance=provenance)


def in_amperes(recordings: Sequence[Recording]) -> bool:
    """Whether some were imported as currents whose constants nobody knew, and are not scaled yet."""
    return _unscaled(recordings, AMPERES)


def from_amperes(recordings: Sequence[Recording]) -> bool:
    """Whether some were imported as currents and multiplied by given constants, which may be corrected yet."""
    return _unscaled(recordings, FROM_AMPERES)


def _unscaled(recordings: Sequence[Recording], torque: str) -> bool:
    return any(r.provenance.get("torque") == torque and "torque_constants" not in r.provenance for r in recordings)


def torque_constants_of(provenance: str) -> list[float] | None:
    """What recordings must be scaled by for a bundle of this provenance, by joint; None: they are in N m."""
    constants = json.loads(provenance or "{}").get("torque_constants")
    return None if constants is None else constants["used"]
