"""Poses of free motion with the limits that held there, and what force those limits notice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext.bundle.estimates import Estimates
from tauext.data.recording import Recording
from tauext.evaluate.noticed_force import LEAST_LIMIT_NM, noticed

ROW_S = 1.0
"""Between the poses that are kept of a recording: a day of them is 3 MB an arm."""
MOST_POSES = 256
"""That forces are found at, even in time."""


class LimitsHeld:
    """Poses of the healthy samples of free motion, both limits there, and the standard error."""

    def __init__(self) -> None:
        self._rows: list[np.ndarray] = []

    def add(self, recording: Recording, estimates: Estimates) -> None:
        """Take in a recording; what is not healthy is left out."""
        if estimates.contact_limit is None or estimates.sigma_nm is None:
            return
        told = (estimates.limit, estimates.contact_limit, estimates.sigma_nm)
        counted = estimates.healthy & np.all([np.isfinite(one).all(axis=1) for one in told], axis=0)
        at = np.flatnonzero(counted)[:: max(1, round(ROW_S * recording.rate_hz))]
        self._rows.append(np.stack([recording.q[at], *(one[at] for one in told)], axis=1).astype(np.float32))

    def summary(self, bundle: _core.Bundle, frames: Sequence[str] = ()) -> dict | None:
        """As noticed() says; {"refused": why} of a bundle that tells no forces, null without any pose."""
        if refused := _core.WrenchModel(bundle).refused:
            return {"refused": refused}
        rows = np.concatenate(self._rows) if self._rows else np.empty((0, 4, bundle.joints))
        if len(rows) == 0:
            return None
        at = np.unique(np.linspace(0, len(rows) - 1, min(MOST_POSES, len(rows))).round().astype(int))
        q, limit, contact, sigma = np.moveaxis(rows[at].astype(float), 1, 0)
        error_share = float(np.median(sigma / np.maximum(limit, LEAST_LIMIT_NM)))
        return noticed(bundle, q, {"collision": limit, "contact": contact}, error_share, frames)
