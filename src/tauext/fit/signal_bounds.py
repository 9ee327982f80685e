"""What an arm can do at most, told from its recordings and its robot file: beyond it a sample is no sample."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.data.impossible import MOST_SHARE, SignalBounds
from tauext.data.recording import Recording

LEAST_TORQUE_NM = 1.0
"""A joint that needed no torque in training may yet need some: least torque that counts as the largest."""
BEYOND_DRIVE = 2.0
"""Times what the robot file says that a drive gives: files often say the rated torque, and a peak is twice that."""
BEYOND_TORQUE = 10.0
"""Times what a joint needed where its drive is not known: a wrist that moved gently needs a tenth of what its drive
gives, and a collision makes it give all."""
BEYOND_SPEED = 5.0
"""Times the speed of training ..."""
USUAL_SPEED_RAD_S = 2.0
"""... and of so much at least: 10 rad/s, which hardly a joint of an arm reaches, and which no collision adds."""
MOST_ROWS = 2_000_000


def signal_bounds(
    recordings: Sequence[Recording],
    torque_limit_nm: Sequence[float] | np.ndarray | None = None,
    nm_per_unit: Sequence[float] | np.ndarray = (1.0,),
) -> SignalBounds:
    """Beyond which torque and speed a sample of this arm cannot be true, whatever touches it.

    The largest values of training count but for MOST_SHARE of all samples, which may be glitches. A joint whose drive
    is not known may have the torque at least that the arm's strongest joint needed.

    Args:
        recordings: at least one.
        torque_limit_nm: what each drive gives at most, infinite where unknown; one that training passed counts as
            unknown.
        nm_per_unit: torque constants of the recordings' tau.
    """
    torque = robust_largest([recording.tau for recording in recordings]) * np.abs(nm_per_unit)
    speed = robust_largest([recording.dq for recording in recordings])
    needed = np.maximum(torque, LEAST_TORQUE_NM)
    unknown = np.maximum(BEYOND_TORQUE * needed, torque.max())
    drive = np.full(len(torque), np.inf) if torque_limit_nm is None else np.asarray(torque_limit_nm, dtype=float)
    known = np.isfinite(drive) & (drive >= torque)
    most = np.where(known, np.maximum(BEYOND_DRIVE * np.where(known, drive, 0.0), LEAST_TORQUE_NM), unknown)
    return SignalBounds(most, BEYOND_SPEED * np.maximum(speed, USUAL_SPEED_RAD_S))


def robust_largest(signals: Sequence[np.ndarray]) -> np.ndarray:
    """Largest magnitude of each column but for MOST_SHARE of its values, and for one of a few; (joints,)."""
    rows = sum(len(signal) for signal in signals)
    step = -(-rows // MOST_ROWS)
    magnitude = np.abs(np.concatenate([signal[::step] for signal in signals]))
    return np.quantile(magnitude, 1 - MOST_SHARE, axis=0, method="lower")
