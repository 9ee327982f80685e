"""Evidence of each arm's motion for a common prior, its change from day to day, and errors of new arms."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tauext import _core
from tauext.config import AlarmConfig, TrainConfig
from tauext.data.free_motion import total_s
from tauext.data.recording import Recording
from tauext.fit.regression import NormalEquations, Regression
from tauext.fit.ridge import Regressors, gather, solved
from tauext.fit.stable_choice import simplest
from tauext.fit.training_set import Setup, remainder, with_presliding
from tauext.train.error_scale import ErrorRows, HeldOut, collect_rows, scale_of
from tauext.train.fitting import assemble, fit_prior, observe, put_prior, with_fit
from tauext.train.held_peaks import Peaks, collect_peaks
from tauext.train.limits import unseen_motion
from tauext.train.promised_limits import LimitsConfig, PromisedLimits, promised_limits
from tauext.train.supported_limits import SupportedConfig
from tauext_fleet.fleet_prior import FleetDays, FleetErrors, block_columns
from tauext_fleet.hierarchy import MORE_ARMS, Evidence, Hierarchy, learn_hierarchy
from tauext_fleet.like import LEAST_SIZE, Like, scale_settings, sizes
from tauext_fleet.map_regression import MapRegression, WeightPrior
from tauext_fleet.prior_arms import OwnTerms, first_minutes, run_of, settings_of

# --- How friction of an arm differs from one recording to the next, over its joints: what a refit may expect of a joint
# that hardly moved.
#
# .. math:: \log f_{ar} \sim N(m_a, D)
#
# f_ar: factors of friction of arm a's joints in recording r by the arm's own fit, and D their covariance between
# recordings of one arm, pooled over the arms. Joints get warm together, so their factors are correlated. Recordings are
# few: D is drawn towards its own diagonal, as if there were MORE_ARMS more arms whose joints vary independently.


Kind = _core.TermKind
FRICTION = (Kind.coulomb, Kind.presliding, Kind.viscous, Kind.load, Kind.load_presliding)
LEAST_MOVED_S = 10.0
"""A joint that moved for less showed too little of its friction, as for a refit's promise."""
MOVES_RAD_S = 0.02
LEAST_ARMS = 3
"""With two recordings or more each."""


def recording_factors(
    equations: Sequence[NormalEquations],
    recordings: Sequence[Recording],
    weights: np.ndarray,
    terms: Sequence[Sequence[_core.Term]],
) -> np.ndarray:
    """Each recording's friction by that of the arm's own fit, (recordings, n); of those in which every joint moved.

    Args:
        equations: of pieces of recordings.
        recordings: that each piece is of.
        weights: the arm's own, (columns,).
    """
    found = []
    for recording in dict.fromkeys(recordings):
        pieces = [one for one, of in zip(equations, recordings, strict=True) if of is recording]
        if moved_s(recording).min() >= LEAST_MOVED_S:
            found.append(factors(sum(pieces[1:], start=pieces[0]), weights, terms))
    return np.array(found).reshape(-1, len(terms))


def moved_s(recording: Recording) -> np.ndarray:
    """Time for which each joint moved, (n,), [s]."""
    return (np.abs(recording.dq) > MOVES_RAD_S).sum(axis=0) / recording.rate_hz


def factors(equations: NormalEquations, weights: np.ndarray, terms: Sequence[Sequence[_core.Term]]) -> np.ndarray:
    """Factor on the friction of each joint that explains the equations best while all else stays, (n,)."""
    out, first = np.ones(len(terms)), 0
    for j, (at, gram, moment) in enumerate(zip(equations.columns, equations.gram, equations.moment, strict=True)):
        friction = np.zeros(len(weights))
        own = np.arange(first, first + len(terms[j]))
        friction[own] = [weights[c] if t.kind in FRICTION else 0.0 for c, t in zip(own, terms[j], strict=True)]
        first += len(terms[j])
        shown = friction[at] @ gram @ friction[at]
        if shown > 0:
            out[j] += friction[at] @ (moment - gram @ weights[at]) / shown
    return out


def fleet_days(factors_of: Sequence[np.ndarray]) -> FleetDays | None:
    """Covariance of the logarithms of factors between recordings of one arm; None: too few arms have several.

    Args:
        factors_of: of each arm, (recordings, n).
    """
    logs = [np.log(np.clip(one, 0.1, 10.0)) for one in factors_of if len(one) >= 2]
    if len(logs) < LEAST_ARMS:
        return None
    apart = [one - one.mean(axis=0) for one in logs]
    free = sum(len(one) - 1 for one in apart)
    covariance = np.sum([one.T @ one for one in apart], axis=0) / free
    share = len(logs) / (len(logs) + MORE_ARMS)
    covariance = share * covariance + (1 - share) * np.diag(np.diag(covariance))
    return FleetDays(covariance, len(logs), sum(map(len, logs)))


# --- Evidence of each arm's motion for the common terms, and the weight of a minute of it beside the other arms.


MINUTES = 1.0
"""Of its own that a new arm is tried with."""
LEAST_REST = 1.0
"""Minutes beyond that, of an arm whose rest judges its first minute."""
GROUPS = 10
"""Of arms, one of which is left out of the fleet at a time; each arm by itself where they are no more."""
TRUSTS = (1.0, 0.3, 0.1, 0.03)
"""Factors tried on the weight of a row of a new arm's minute, beyond the correlation of its errors in time: the arm
warms up, and a minute is one motion in one state of the gears."""

TRUST_TIE = 0.002
"""Share of the error on the rest, whose mean over ten arms is no more accurate: within it, a minute counts fully."""


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


def error_memory_s(
    setup: Setup, recordings: Sequence[Recording], settings: _core.PriorSettings, longest_s: float = 2.0
) -> np.ndarray:
    """Correlation time of each joint's error, (n,), [s]: a period and twice the sum of its correlations.

    Rows within it are not independent. It is summed up to the first lag whose correlation is below 0.05, as in the
    core's refit, and at most up to longest_s.
    """
    most = max(2, round(longest_s / setup.network_period_s))
    n = setup.tree.size
    products = np.zeros((most, n))
    for recording in recordings:
        observation, rows = setup.observe(recording, settings)
        left = remainder(observation)[rows]
        for lag in range(min(most, len(left))):
            products[lag] += (left[lag:] * left[: len(left) - lag]).sum(axis=0)
    correlation = products / np.maximum(products[0], 1e-300)
    gone = np.argmax(np.vstack([correlation < 0.05, np.ones(n, dtype=bool)]), axis=0)
    inside = np.arange(most)[:, None] < gone
    return setup.network_period_s * np.maximum(1.0, 2 * (correlation * inside).sum(axis=0) - 1)


def evidence_of(
    own: OwnTerms,
    config: TrainConfig,
    gain_per_s: float,
    widths_rad: Sequence[float],
    terms: Sequence[Sequence[_core.Term]],
) -> ArmEvidence:
    """The arm's motion read again, at the fleet's gain and on the fleet's terms."""
    run = run_of(own.arm, settings_of(own, config, gain_per_s))
    setup, recordings = with_presliding(observe(run), widths_rad), run.motion.uncut
    regressors = Regressors(terms, corrected=setup.tree)
    found = gather(setup, recordings, regressors)
    equations = [one for one, _ in found]
    regression = Regression(equations)
    fit = solved(setup, regression, found, regressors)
    weights = regression.solve(regression.whole, fit.ridge)
    minute = gather(setup, first_minutes(recordings, MINUTES), regressors)
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
    """The prior of a new arm: the fleet's mean and covariance, and the usual size and memory of errors."""
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
    """Make for each arm the prior of the other arms alone."""
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


# --- Errors of new arms: each arm gets a minute of its own and the prior of the others, and the rest of it judges.


MOST_REST_S = 3600.0
"""Of each arm: more adds little about how arms differ."""
ROUNDS = 2
"""Of the common scale and each arm's size beside it."""


@dataclass(frozen=True)
class NewArm:
    """One arm as if it were new: its bundle after a minute, and the errors of that bundle."""

    own: OwnTerms
    bundle: _core.Bundle
    minute: ErrorRows
    """Its first minute, left out of the fit in turn."""
    rest: ErrorRows


def new_arm(own: OwnTerms, config: TrainConfig, like: Like) -> NewArm:
    """A training of the arm on its first minute, and the errors of that.

    Args:
        config: without torque constants, which the minute has to determine.
        like: prior from the other arms.
    """
    run = run_of(own.arm, config, minutes=MINUTES, start=like)
    setup = observe(run)
    fit = fit_prior(run, setup, run.motion.uncut)
    assert fit is not None
    bundle = assemble(run, with_fit(setup, fit))
    put_prior(run, bundle, fit)
    if bundle.region_width >= 0:
        bundle.near_memory_s = SupportedConfig.near_memory / bundle.observer.gain_per_s
    bundle.after_contact_factor = run.config.alarm.after_contact_factor
    _, left_out = unseen_motion(run, bundle, setup, fit)
    margins = run.config.margins
    minute = collect_rows(bundle, left_out, run.threads, margins)
    rest = collect_rows(bundle, judged_rest(own, config, bundle, like.prior.gain_per_s), run.threads, margins)
    return NewArm(own, bundle, minute, rest)


def judged_rest(own: OwnTerms, config: TrainConfig, bundle: _core.Bundle, gain_per_s: float) -> Iterator[HeldOut]:
    """The arm's motion behind its first minute, judged by this bundle."""
    run = run_of(own.arm, settings_of(own, config, gain_per_s))
    before_s = 0.0
    for recording in run.motion.uncut:
        first_s = max(60 * MINUTES - before_s, 0.0)
        last_s = 60 * MINUTES + MOST_REST_S - before_s
        before_s += recording.duration_s
        span = span_of(recording, first_s, last_s)
        if span.start < span.stop:
            yield HeldOut(recording, span, bundle)


def span_of(recording: Recording, from_s: float, to_s: float) -> slice:
    """Samples in this time after the first."""
    first, last = np.searchsorted(recording.time_s, [from_s, to_s])
    return slice(int(first), int(last))


def errors_of(arms: Sequence[NewArm], config: TrainConfig, threads: int) -> FleetErrors:
    """The scale that fits all arms' errors but for the size of each, and the limits that all of them support together.

    Raises:
        TrainingError: too few peaks to fit.
    """
    n = arms[0].bundle.joints
    own = np.array([np.sqrt(np.mean(one.minute.error_nm**2, axis=0)) for one in arms])
    size = own / np.median(own, axis=0)
    for _ in range(ROUNDS):
        scale = scale_of(pooled([one.rest for one in arms], size))
        size = np.array([np.clip(sizes(one.minute, scale), LEAST_SIZE, None) for one in arms])
    scale = scale_of(pooled([one.rest for one in arms], size))
    weights = {
        name: np.array(getattr(scale, name)).reshape(n, -1)
        for name in ("limit_weights", "sigma_weights", "sigma_near_weights")
    }
    nothing = np.zeros(n)
    errors = FleetErrors(
        MINUTES, sum(one.rest.hours for one in arms), len(arms), tuple(kind.name for kind in scale.features),
        **weights, largest=np.array(scale.largest), largest_sigma=np.array(scale.largest_sigma),
        sliding_limit_nm=nothing, near_stiction_limit_nm=nothing,
        contact_sliding_limit_nm=nothing, contact_near_stiction_limit_nm=nothing,
        hold_s=0.0, contact_hold_s=0.0, facts={},
    )  # fmt: skip
    for one, own_size in zip(arms, size, strict=True):
        one.bundle.error_scale = scale_settings(errors, own_size)

    def rest(some: Sequence[NewArm]) -> Iterator[HeldOut]:
        for one in some:
            yield from judged_rest(one.own, config, one.bundle, one.bundle.observer.gain_per_s)

    margins, alarm = config.margins, AlarmConfig()
    limits = LimitsConfig(confidence=SupportedConfig.confidence, at_most_seen=True)
    found = promised_limits(
        arms[0].bundle, collect_peaks(arms[0].bundle, rest(arms), alarm.holds_s, threads, margins), alarm, limits
    )
    held = [collect_peaks(one.bundle, rest([one]), [found.hold_s], threads, margins)[0] for one in arms]
    return with_limits(errors, found, factor_of(np.array([largest(peaks) for peaks in held])))


def largest(peaks: Peaks) -> np.ndarray:
    """Largest held error of each joint by the common scale, sliding and in either region, (joints, regions), [N m]."""
    return np.maximum.accumulate(peaks.largest_nm, axis=1)


def factor_of(top_nm: np.ndarray) -> float:
    """What limits at the largest errors of the other arms must be multiplied by for none of the arms to be over them.

    Errors differ more between arms than within one: a rate from hours of all arms holds for further hours of the same
    arms. Comparing each of A arms with the limits of the others predicts one more arm: it exceeds the largest of A by
    chance once in A + 1.

    Args:
        top_nm: largest held error of each arm, (arms, joints, regions).
    """
    factors = [np.max(top_nm[a] / np.delete(top_nm, a, axis=0).max(axis=0)) for a in range(len(top_nm))]
    return max(1.0, float(np.max(factors)))


def with_limits(errors: FleetErrors, found: PromisedLimits, factor: float) -> FleetErrors:
    """The errors with the limits that they require, times the factor between arms."""
    facts = {key: value for key, value in found.facts().items() if key != "one_moment"} | {"arms_factor": factor}
    return replace(
        errors,
        sliding_limit_nm=factor * found.collision[0],
        near_stiction_limit_nm=factor * found.collision[1],
        contact_sliding_limit_nm=factor * found.contact[0],
        contact_near_stiction_limit_nm=factor * found.contact[1],
        hold_s=found.hold_s,
        contact_hold_s=found.contact_hold_s,
        facts=facts,
    )


def pooled(rows: Sequence[ErrorRows], size: np.ndarray) -> ErrorRows:
    """ErrorRows of all arms, each arm's errors by its size, (arms, n)."""
    before = np.cumsum([0, *(len(one.recordings) for one in rows[:-1])])
    return ErrorRows(
        np.concatenate([one.error_nm / own for one, own in zip(rows, size, strict=True)]),
        np.concatenate([one.near_stiction for one in rows]),
        np.concatenate([one.features for one in rows]),
        rows[0].period_s,
        np.concatenate([one.t_ns for one in rows]),
        np.concatenate([one.recording + first for one, first in zip(rows, before, strict=True)]),
        tuple(name for one in rows for name in one.recordings),
    )
