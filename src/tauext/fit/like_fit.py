"""A prior from a minute of an arm's own motion and what a fleet of its type knows."""

from __future__ import annotations

from collections.abc import Sequence

from tauext.config import PriorConfig
from tauext.data.recording import Recording
from tauext.fit.fleet_prior import FleetPrior
from tauext.fit.map_regression import MapRegression
from tauext.fit.prior import bound_loads, branches_of
from tauext.fit.prior_fit import PriorFit
from tauext.fit.ridge import gather, solved
from tauext.fit.temperature import with_temperature
from tauext.fit.training_set import Setup, with_presliding


def fit_like(setup: Setup, recordings: Sequence[Recording], config: PriorConfig, like: FleetPrior) -> PriorFit:
    """The prior that is most likely by this motion and the fleet: its terms and widths, no search of its own.

    Every fold that is left out of the fit in turn is judged by the fleet and the other folds.

    Args:
        setup: without a prior, of the fleet's type.

    Raises:
        TrainingError: no recording is longer than the observer's warm-up.
    """
    bent = with_presliding(setup, like.widths_rad)
    found = gather(bent, recordings, like.own, [], bent.tree)
    period_s = 1e-9 * setup.observer.sample_period_ns * setup.observer.network_stride
    regression = MapRegression([problem for problem, _ in found], like.weights, period_s)
    fit = solved(bent, regression, found, like.own, [], bent.tree)
    for settings in (fit.settings, *(one.settings for one in fit.left_out)):
        settings.branches = branches_of(settings)
    bound_loads(bent, recordings, fit)
    return with_temperature(bent, recordings, fit) if config.follow_temperature else fit
