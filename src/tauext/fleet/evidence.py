"""What each arm's motion says of the common terms, and how much a minute of it says beside the other arms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tauext import _core
from tauext.config import TrainConfig
from tauext.data.first_seconds import total_s
from tauext.fit.error_memory import error_memory_s
from tauext.fit.fleet_prior import block_columns
from tauext.fit.hierarchy import Evidence, Hierarchy, learn_hierarchy
from tauext.fit.map_regression import MapRegression, WeightPrior
from tauext.fit.regression import NormalEquations, Regression
from tauext.fit.ridge import gather, solved
from tauext.fit.ties import simplest
from tauext.fit.training_set import with_presliding
from tauext.fleet.arms import OwnTerms, first_minutes, job_of, settings_of
from tauext.fleet.days import recording_factors
from tauext.train.fitting import observe

MINUTES = 1.0
"""Of its own that a new arm is tried with."""
LEAST_REST = 1.0
"""Minutes beyond that, of an arm whose rest judges its first minute."""
GROUPS = 10
"""Of arms, one of which is left out of the fleet at a time; each arm by itself where they are no more."""
TRUSTS = (1.0, 0.3, 0.1, 0.03)
"""By how much a row of a new arm's minute may count for less than the correlation of its errors in time says: the arm
warms up, and a minute is one motion in one state of the gears."""

TRUST_TIE = 0.002
"""Of the error on the rest, whose mean over ten arms is known no better: so close, a minute counts fully."""


@dataclass(frozen=True)
class ArmEvidence:
    """One arm's motion, summed up."""

    name: str
    minutes: float
    whole: NormalEquations
    minute: list[NormalEquations]
    """Pieces of its first minute."""
    error_nm: np.ndarray  # (n,) of its own fit, left out
    memory_s: np.ndarray  # (n,)
    period_s: float
    factors: np.ndarray
    """Friction in each recording by that of the whole, (recordings, n)."""

    @property
    def rest(self) -> NormalEquations:
        """All but the first minute."""
        first = sum(self.minute[1:], start=self.minute[0])
        gram = [a - b for a, b in zip(self.whole.gram, first.gram, strict=True)]
        moment = [a - b for a, b in zip(self.whole.moment, first.moment, strict=True)]
        return NormalEquations(
            self.whole.columns, gram, moment, self.whole.energy - first.energy, self.whole.rows - first.rows
        )

    @property
    def judges(self) -> bool:
        """Whether there is a rest by which a minute is judged."""
        return self.minutes >= MINUTES + LEAST_REST

    def evidence(self) -> Evidence:
        """Each joint's rows counted by the size and the memory of its errors."""
        independent = np.minimum(1.0, self.period_s / self.memory_s)
        width = 1 + max(int(at.max()) for at in self.whole.columns)
        gram, moment = np.zeros((width, width)), np.zeros(width)
        for j, at in enumerate(self.whole.columns):
            count = independent[j] / self.error_nm[j] ** 2
            gram[np.ix_(at, at)] += count * self.whole.gram[j]
            moment[at] += count * self.whole.moment[j]
        return Evidence(gram, moment, float(independent.max()) * self.whole.rows)


def evidence_of(
    own: OwnTerms,
    config: TrainConfig,
    gain_per_s: float,
    widths_rad: Sequence[float],
    terms: Sequence[Sequence[_core.Term]],
) -> ArmEvidence:
    """The arm's motion read again, at the fleet's gain and on the fleet's terms."""
    job = job_of(own.arm, settings_of(own, config, gain_per_s))
    setup, recordings = with_presliding(observe(job), widths_rad), job.motion.uncut
    found = gather(setup, recordings, terms, [], setup.tree)
    equations = [one for one, _ in found]
    regression = Regression(equations)
    fit = solved(setup, regression, found, terms, [], setup.tree)
    weights = regression.solve(regression.whole, fit.ridge)
    minute = gather(setup, first_minutes(recordings, MINUTES), terms, [], setup.tree)
    return ArmEvidence(
        name=own.arm.name,
        minutes=total_s(recordings) / 60,
        whole=sum(equations[1:], start=equations[0]),
        minute=[one for one, _ in minute],
        error_nm=fit.error_nm,
        memory_s=error_memory_s(setup, recordings, fit.settings),
        period_s=1e-9 * setup.observer.sample_period_ns * setup.observer.network_stride,
        factors=recording_factors(equations, [recording for _, (recording, _) in found], weights, terms),
    )


def weight_prior(arms: Sequence[ArmEvidence], found: Hierarchy, trust: float) -> WeightPrior:
    """What a new arm is told: the fleet's mean and covariance, and the usual size and memory of errors."""
    error_nm = np.median([one.error_nm for one in arms], axis=0)
    memory_s = np.median([one.memory_s for one in arms], axis=0)
    return WeightPrior(found.mean, found.covariance, error_nm, memory_s, trust)


def groups(count: int) -> list[list[int]]:
    """Which arms are left out together."""
    number = min(count, GROUPS)
    return [list(range(k, count, number)) for k in range(number)]


def priors_without(
    arms: Sequence[ArmEvidence],
    terms: Sequence[Sequence[_core.Term]],
    show: Callable[[int, int, str], None] = lambda done, total, note: None,
) -> list[WeightPrior]:
    """For each arm what the others alone would tell it."""
    blocks, left = block_columns(terms), groups(len(arms))
    found: dict[int, WeightPrior] = {}
    for done, group in enumerate(left):
        others = [one for k, one in enumerate(arms) if k not in group]
        prior = weight_prior(others, learn_hierarchy([one.evidence() for one in others], blocks), 1.0)
        found |= dict.fromkeys(group, prior)
        show(done + 1, len(left), "arms left out in turn")
    return [found[k] for k in range(len(arms))]


def choose_trust(arms: Sequence[ArmEvidence], priors: Sequence[WeightPrior]) -> tuple[float, list[np.ndarray]]:
    """How much a new arm's minute counts: what leaves the least error on the rest of the arms' motion.

    Returns: that, and each arm's error there with it, (n,), [N m]; empty of an arm that has no rest.
    """
    pairs = list(zip(arms, priors, strict=True))
    tried = {trust: [rest_error_nm(one, prior, trust) for one, prior in pairs] for trust in TRUSTS}

    def size(trust: float) -> float:
        return float(np.exp(np.mean([np.log(error) for error in tried[trust] if len(error)] or [0.0])))

    best = simplest(TRUSTS, size, TRUST_TIE)
    return best, tried[best]


def rest_error_nm(arm: ArmEvidence, prior: WeightPrior, trust: float) -> np.ndarray:
    """RMSE on the rest of an arm's motion by its first minute and the others, (n,); empty where there is no rest."""
    if not arm.judges:
        return np.zeros(0)
    regression = MapRegression(arm.minute, replace(prior, trust=trust), arm.period_s)
    rest = arm.rest
    return np.sqrt(np.maximum(rest.squares(regression.solve(regression.whole)), 1e-300) / rest.rows)
