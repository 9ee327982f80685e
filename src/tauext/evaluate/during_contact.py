"""How far the estimate is from the reference while something touches the arm."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.bundle.estimates import Estimates
from tauext.data.recording import Recording
from tauext.evaluate.collisions import GRACE_S, Collision
from tauext.evaluate.free_motion import numbers


class DuringContact:
    """Sums over the healthy samples from the onset of each collision to the grace after its end, a joint each."""

    def __init__(self, joints: int) -> None:
        self._square = np.zeros(joints)
        self._samples = 0

    def add(
        self, touches: Sequence[Collision], recording: Recording, estimates: Estimates, reference: np.ndarray | None
    ) -> None:
        """Take in the collisions of one recording; without a reference there is nothing to compare with."""
        if reference is None:
            return
        for touch in touches:
            window = slice(touch.begin, touch.end + round(GRACE_S * recording.rate_hz))
            healthy = estimates.healthy[window]
            error = estimates.tau_ext[window][healthy] - reference[window][healthy]
            self._square += (error**2).sum(axis=0)
            self._samples += len(error)

    def rmse_nm(self) -> list[float | None]:
        """The entry `rmse_during_contact_nm` of a bundle in results.json."""
        with np.errstate(invalid="ignore"):
            return numbers(np.sqrt(self._square / self._samples))
