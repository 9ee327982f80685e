"""Tails: the fit against SciPy's, levels against closed forms, and bounds that hold as often as they say."""

import json
import math

import numpy as np
import pytest
from scipy.stats import binom, genpareto

from tauext.errors import ConfigError, TrainingError
from tauext.fit.limits_together import TailCurve, rates_together
from tauext.fit.tail import (
    GOODNESS_P,
    GOODNESS_SHAPES,
    SHAPES,
    FalseAlarmBudget,
    Tail,
    TailConfig,
    TooFewPeaks,
    fit_excess,
    fit_tail,
    goodness,
    upper_rate,
)


@pytest.mark.parametrize("shape", [-0.4, -0.1, 0.0, 0.3])
@pytest.mark.parametrize("count", [30, 200])
def test_the_fit_is_as_likely_as_scipys_or_more(shape, count):
    excess = genpareto.rvs(shape, scale=3.0, size=count, random_state=np.random.default_rng([count, 7]))
    found, scale = fit_excess(excess)
    theirs = genpareto.fit(excess, floc=0)
    assert genpareto.logpdf(excess, found, scale=scale).sum() >= genpareto.logpdf(excess, *theirs).sum() - 1e-6
    # The likelihood is flat at its top: equal to 1e-8 within 1e-3 of the parameters.
    assert (found, scale) == (pytest.approx(theirs[0], abs=2e-3), pytest.approx(theirs[2], rel=2e-3))


def test_the_fit_scales_with_its_unit_and_stays_within_its_bounds():
    excess = np.random.default_rng(1).exponential(size=80)
    shape, scale = fit_excess(excess)
    assert fit_excess(1000 * excess) == (pytest.approx(shape, abs=1e-5), pytest.approx(1000 * scale, rel=1e-5))
    short = np.random.default_rng(2).random(200) ** 0.3  # its density grows toward its end: a shape of about -3
    assert fit_excess(short)[0] == pytest.approx(SHAPES[0], abs=1e-6)
    heavy = np.random.default_rng(3).random(200) ** -3.0
    assert fit_excess(heavy)[0] == pytest.approx(SHAPES[1], abs=1e-6)


def drawn(tail: Tail, *levels: float) -> np.ndarray:
    return tail.rates(np.array(levels), np.random.default_rng(0))


def test_rates_fall_with_the_level_and_have_the_spread_of_their_peaks():
    tail = fit_tail(np.random.default_rng(5).exponential(size=3000), hours=10.0)
    rates = drawn(tail, *np.linspace(0, 20, 60))
    assert (np.diff(rates, axis=1) <= 0).all()
    # At the threshold only the number of peaks is uncertain: a gamma distribution's.
    at = drawn(tail, tail.threshold_nm)[:, 0]
    assert at.mean() == pytest.approx((tail.exceedances + 0.5) / 10, rel=2e-3)
    assert at.std() == pytest.approx(math.sqrt(tail.exceedances + 0.5) / 10, rel=0.02)
    # Below it, peaks are counted.
    low = float(tail.peaks_nm[2 * tail.exceedances])
    assert drawn(tail, low)[:, 0] == pytest.approx(at * 2)


def test_a_peak_that_the_rate_does_not_allow_is_one_that_garwoods_interval_does_not_allow():
    tail = fit_tail(np.random.default_rng(6).exponential(size=3000), hours=10.0)
    for rate in (tail.rate_per_hour * 1.01, 40.0, 100.0):
        bound = tail.seen(rate, 0.95)
        over = int((tail.peaks_nm > bound).sum())
        assert bound in tail.peaks_nm
        assert upper_rate(over, tail.hours) <= rate < upper_rate(over + 1, tail.hours)
    assert tail.seen(0.01, 0.95) == tail.peaks_nm[0]


def test_the_posterior_is_that_of_a_plain_sum_over_shape_and_scale():
    """Against a slow twin: two nested sums, with SciPy's density and no change of variables."""
    excess = genpareto.rvs(0.1, scale=2.0, size=60, random_state=3)
    shape, scale = fit_excess(excess)
    tail = Tail(5.0, shape, scale, 60, 6.0, 0.5, np.sort(np.r_[5.0 + excess, 5.0])[::-1])
    shapes, scales = np.linspace(-0.9, 1.0, 400)[1:-1] + 1e-3, np.linspace(0.5, 6, 200)  # none next to a shape of 0
    with np.errstate(divide="ignore"):
        logs = np.array([[genpareto_sum(excess, x, s) - math.log(s) for s in scales] for x in shapes])
    logs -= (np.maximum(shapes - TailConfig.usual_shape, 0) / TailConfig.shape_spread)[:, None] ** 2 / 2
    weight = np.exp(logs - logs.max())
    # Far out, a rate is that of few shapes, which even draws meet coarsely.
    for reach, within in ((3.0, 0.02), (8.0, 0.05), (20.0, 0.2)):
        over = genpareto.sf(reach, shapes[:, None], scale=scales)
        mean = (weight * over).sum() / weight.sum() * 60.5 / 6.0
        assert drawn(tail, 5.0 + reach).mean() == pytest.approx(mean, rel=within)


def genpareto_sum(excess, shape, scale):
    inner = 1 + shape * excess / scale
    return -np.inf if inner.min() <= 0 else -len(excess) * math.log(scale) - (1 + 1 / shape) * np.log(inner).sum()


@pytest.mark.parametrize("row", [1, *(pytest.param(row, marks=pytest.mark.slow) for row in (3, 5, 7))])
def test_the_table_of_goodness_says_how_often_good_fits_look_so_bad(row):
    rng, runs, shape = np.random.default_rng(row), 1000, GOODNESS_SHAPES[row]
    p = []
    for _ in range(runs):
        excess = genpareto.ppf(rng.random(100), shape)
        p.append(goodness(excess, *fit_excess(excess)))
    for limit in GOODNESS_P[1:5]:
        # Exact at the table's shapes; the fitted one scatters around, which next to the lower bound shifts p a little.
        share = np.mean(np.array(p) <= limit * (1 + 1e-9))
        assert abs(share - limit) < 4 * math.sqrt(limit * (1 - limit) / runs) + 0.2 * limit


def test_the_lowest_threshold_that_serves_is_taken():

    def exceedances(peaks):  # that are an exponential tail from the first on, to the letter
        return fit_tail(-np.log(np.arange(1, peaks + 1) / (peaks + 1)), 1.0).exceedances

    assert exceedances(5000) == 200
    assert exceedances(2000) == 100  # a twentieth of the peaks
    assert exceedances(300) == 50
    assert exceedances(45) == 44
    rng = np.random.default_rng(9)
    # 75 peaks of another kind on top of 5000 small ones: no tail begins among the small.
    mixed = np.r_[rng.exponential(size=5000), 12 + 5 * rng.exponential(size=75)]
    tail = fit_tail(mixed, 1.0)
    assert tail.exceedances <= 70 and tail.threshold_nm > 12
    assert tail.fits


def test_peaks_that_are_no_tail_are_called_a_misfit():
    rng = np.random.default_rng(10)
    lumps = np.r_[rng.normal(3, 0.01, 25), rng.normal(9, 0.01, 25), rng.uniform(0, 1, 900)]
    tail = fit_tail(lumps, 1.0)
    assert not tail.fits and tail.goodness_p < 0.01
    assert TailCurve(tail, 0).level(0.01) > 9


def test_the_same_peaks_in_any_order_give_the_same_bytes_and_a_summary_in_json():
    peaks = np.random.default_rng(12).exponential(size=800)
    first, second = fit_tail(peaks, 3.0), fit_tail(peaks[::-1].copy(), 3.0)
    summary = first.summary()
    assert summary == second.summary() == json.loads(json.dumps(summary))
    assert (drawn(first, 4.0) == drawn(second, 4.0)).all()
    assert summary["rate_per_hour"] == summary["exceedances"] / 3.0 and summary["fits"] is True


@pytest.mark.parametrize("count", [0, 1, 30])
def test_too_few_peaks_are_refused_with_their_number(count):
    with pytest.raises(TooFewPeaks, match=f"{count} peaks are too few to fit a tail: at least 31"):
        fit_tail(np.random.default_rng(0).random(count), 1.0)


def test_equal_peaks_do_not_count_as_many():
    with pytest.raises(TrainingError, match="0 peaks are too few"):
        fit_tail(np.full(100, 4.0), 1.0)
    fit_tail(np.round(np.random.default_rng(13).exponential(size=1000), 1), 1.0)  # a coarse unit is no fault


@pytest.mark.parametrize(
    ("call", "kind", "message"),
    [
        (lambda: fit_tail(np.ones(99), 0.0), ConfigError, "hours = 0.0 must be > 0"),
        (lambda: fit_tail(np.r_[np.ones(99), np.nan], 1.0), TrainingError, "= nan Nm must be finite and >= 0"),
        (lambda: fit_tail(np.r_[np.ones(99), np.inf], 1.0), TrainingError, "= inf Nm must be finite and >= 0"),
        (lambda: fit_tail(np.r_[np.ones(99), -2.0], 1.0), TrainingError, "= -2.0 Nm must be finite and >= 0"),
    ],
)
def test_bad_input_is_named(call, kind, message):
    with pytest.raises(kind, match=message):
        call()


def arm_of(rng: np.random.Generator, hours: float, shapes: np.ndarray, rate: float) -> list[list[Tail]]:
    """Tails of an arm whose joints' errors exceed 2 Nm at this rate, (joints, 2), and follow these shapes beyond."""
    return [
        [
            fit_tail(2 + genpareto.rvs(shape, size=max(rng.poisson(rate * hours), 31), random_state=rng), hours)
            for shape in of_joint
        ]
        for of_joint in shapes
    ]


def levels_of(tails: list[list[Tail]], rates: np.ndarray) -> np.ndarray:
    return np.array([
        [TailCurve(tail, 2 * j + g).level(rates[j, g]) for g, tail in enumerate(of_joint)]
        for j, of_joint in enumerate(tails)
    ])  # fmt: skip


@pytest.mark.parametrize(
    "heavy, runs",
    [(0, 20), (1, 20), pytest.param(0, 100, marks=pytest.mark.slow), pytest.param(3, 100, marks=pytest.mark.slow)],
)
def test_limits_chosen_together_keep_the_budget_of_the_arm_as_often_as_they_say(heavy, runs):
    """Made hours of six joints with known tails, some of them heavy: the true rate over all limits is known."""
    hours, rate, kept, used = 6.0, 100.0, 0, []
    budget = FalseAlarmBudget(1, 2.0)
    for run in range(runs):
        rng = np.random.default_rng([heavy, run])
        shapes = rng.uniform(-0.2, 0.1, (6, 2))
        shapes[rng.permutation(6)[:heavy]] = rng.uniform(0.3, 0.5)
        hits = np.concatenate([np.where(np.arange(6) <= k, rng.normal(size=(20, 6)), 0) for k in range(6)])
        tails = arm_of(rng, hours, shapes, rate)
        levels = levels_of(tails, rates_together(tails, budget, 0.95, hits, np.full((6, 2), hours / 2)))
        true = rate * genpareto.sf(levels - 2, shapes).sum()
        kept += true <= budget.rate_per_hour
        used.append(true / budget.rate_per_hour)
    assert kept >= binom.ppf(1e-4, runs, 0.95)
    assert np.median(used) > 0.03  # limits that are always large enough would keep every budget


def test_the_budget_goes_to_the_joint_that_decides_and_is_kept_whole():
    rng = np.random.default_rng(1)
    tails, hours = arm_of(rng, 6.0, np.full((3, 2), 0.2), 100.0), np.full((3, 2), 3.0)
    budget = FalseAlarmBudget(1, 2.0)
    alike = rates_together(tails, budget, 0.5, np.eye(3), hours)
    second = rates_together(tails, budget, 0.5, np.array([[0.01, 1.0, 0.01]]), hours)
    assert second[1].sum() > 2 * alike[1].sum() and second[0].sum() < 0.5 * alike[0].sum()
    assert (levels_of(tails, second)[1] < levels_of(tails, alike)[1]).all()
    # At even odds the mean of the sum is about the budget.
    assert second.sum() == pytest.approx(budget.rate_per_hour, rel=0.5)
    unfelt = rates_together(tails, budget, 0.5, np.vstack([np.eye(3), np.zeros((2, 3))]), hours)
    np.testing.assert_array_equal(unfelt, alike)  # hits before the first monitored joint
    assert np.isfinite(rates_together(tails, budget, 0.5, np.zeros((2, 3)), hours)).all()
    sure = rates_together(tails, budget, 0.95, np.eye(3), hours)
    assert sure.sum() < alike.sum() < 12 * sure.sum()
    # A joint that never moves near stiction needs no budget there.
    sliding = rates_together(tails, budget, 0.5, np.eye(3), np.column_stack([np.full(3, 6.0), np.zeros(3)]))
    assert (sliding[:, 1] < 0.3 * sliding[:, 0]).all()
