"""Recordings whose tau is, or was, a motor current: what their import says of it."""

from __future__ import annotations

from collections.abc import Sequence

from tauext.data.recording import Recording

AMPERES = "amperes: the torque constant is unknown"
FROM_AMPERES = "N m: amperes times given torque constants"


def in_amperes(recordings: Sequence[Recording]) -> bool:
    """Whether some were imported as currents whose constants nobody knew."""
    return _unscaled(recordings, AMPERES)


def from_amperes(recordings: Sequence[Recording]) -> bool:
    """Whether some were imported as currents and multiplied by given constants, which may be corrected yet."""
    return _unscaled(recordings, FROM_AMPERES)


# Flights of tauext 0.1 hold torques that were multiplied already, and say so.
def _unscaled(recordings: Sequence[Recording], torque: str) -> bool:
    return any(r.provenance.get("torque") == torque and "torque_constants" not in r.provenance for r in recordings)
