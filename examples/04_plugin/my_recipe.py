"""A recipe of your own for `tauext train --recipe viscous`: a row, and the function that fits its prior.

    tauext train --recipe viscous --data DATA --out arm.tauext
    tauext evaluate --baselines --methods viscous --data DATA --out results

pyproject.toml names RECIPE as an entry point; --help lists it with its summary.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from tauext.recipes import Recipe

if TYPE_CHECKING:  # the help of `tauext train` imports the row alone
    from tauext.data.recording import Recording
    from tauext.fit.prior_terms import PriorFit
    from tauext.fit.training_set import Setup

RECIPE = Recipe(
    "viscous", "constant and viscous friction of each joint, fitted", fit="my_recipe:fit_viscous", baseline="viscous"
)


def fit_viscous(
    setup: Setup, recordings: Sequence[Recording], *, report: Callable[[str], None], **_: object
) -> PriorFit:
    """Fit r = -(constant + viscous dq) of each joint by ridge regression; see tauext.train.fitting.Fit."""
    from tauext.fit.prior_terms import Kind, Term
    from tauext.fit.ridge import Regressors, fit_ridge

    own = [[Term(Kind.constant, joint), Term(Kind.viscous, joint)] for joint in range(setup.tree.size)]
    fit = fit_ridge(setup, recordings, Regressors(own))
    report(f"error on left-out motion {fit.error_nm.max():.2f} Nm")
    return fit
