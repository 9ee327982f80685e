"""A fitted prior, and how well the data determine it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from tauext import _core
from tauext.data.recording import Recording
from tauext.fit.kinematics import Kinematics
from tauext.fit.regression import Regression
from tauext.fit.training_set import Setup


@dataclass(frozen=True)
class LeftOut:
    """The same prior fitted without a fifth of the recordings, and where that lies: (recording, samples) each."""

    settings: _core.PriorSettings
    spans: list[tuple[Recording, slice]]


class Refit(Protocol):
    """The same terms fitted once more."""

    def __call__(self, setup: Setup) -> PriorFit:
        """To the residual of another observer, on the same recordings; the setup's presliding widths do not count."""


@dataclass(frozen=True)
class PriorFit:
    """A fitted prior and how well the data determine it."""

    settings: _core.PriorSettings
    ridge: float
    error_nm: np.ndarray  # (n,) RMSE on recordings left out of the fit
    weights: np.ndarray  # (n, terms)
    standard_errors: np.ndarray  # (n, terms), over recordings
    determined: np.ndarray  # (n, terms): 1: by the data alone, 0: by the ridge alone
    corrections: np.ndarray  # (n, 11) of PARAMETERS; empty without a model
    correction_errors: np.ndarray
    corrections_determined: np.ndarray
    corrections_held: np.ndarray
    """(n, 11) bool: at a bound of what a link can be, or as the robot file has it, whatever the motion says."""
    regression: Regression
    left_out: list[LeftOut]  # one for each fold that leaves a possible model
    kinematics: Kinematics | None = None  # found from the motion, where there is no model and this explains it
    dropped_widths: dict[float, str] = field(default_factory=dict)  # [rad]: and why
    refit: Refit | None = None  # of the terms that were chosen, on other residuals
