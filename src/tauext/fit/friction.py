"""Textbook friction: what the prior is compared with."""

from __future__ import annotations

from collections.abc import Sequence

from tauext import _core
from tauext.data.recording import Recording
from tauext.fit.prior_fit import PriorFit
from tauext.fit.prior_terms import Kind
from tauext.fit.ridge import fit_ridge
from tauext.fit.training_set import Setup

SMOOTHING_RAD_S = 0.03
"""Of the sign of the speed: wide enough for the noise of a differentiated encoder, narrow beside any motion."""


def fit_friction(setup: Setup, recordings: Sequence[Recording], **settings: object) -> PriorFit:
    r"""Constant, viscous and Coulomb friction of every joint, fitted to r as the prior is.

    .. math:: \tau_f = c + v \dot q + k \tanh(\dot q / 0.03\,\mathrm{rad/s})

    each through the observer's filter. The model is taken as it is: what it has wrong stays in r. Without a model that
    is all of gravity and inertia, for which three numbers a joint cannot stand: such a fit is hopeless.

    Args:
        settings: of the prior, which has no say here.

    Raises:
        TrainingError: no recording is longer than the observer's warm-up.
    """
    own = [
        [
            _core.Term(Kind.constant, joint),
            _core.Term(Kind.viscous, joint),
            _core.Term(Kind.coulomb, joint, speed=SMOOTHING_RAD_S),
        ]
        for joint in range(setup.tree.size)
    ]
    return fit_ridge(setup, recordings, own, shared=[])
