"""Limits of a budget that the motion does not prove, and the scale in other programs: errors whose tail is known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from test_few_data import RATE_HZ, motion, planar_arm
from test_promised_limits import alarms_of, noisy, observer

from tauext import _core
from tauext.config import AlarmConfig, ObserverConfig, PriorConfig
from tauext.errors import TrainingError
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.fit.prior import Inertia, fit_terms
from tauext.train.asked_limits import AskedConfig, WorstErrors, budgets_sentence, posterior, put_asked, put_floors
from tauext.train.declared_spread import noticed_standing
from tauext.train.error_scale import (
    FEATURES,
    HeldOut,
    collect_rows,
    fit_error_scale,
    put_constant_error,
    rest_sigma_nm,
    with_unit_scale,
)
from tauext.train.held_peaks import Peaks
from tauext.train.hits import noticed_pushes_n
from tauext.train.other_programs import (
    OtherProgramsConfig,
    add_at_rest,
    programs,
    spread_rows,
    widen_for_other_programs,
)
from tauext.train.paper_limits import LimitMotion
from tauext.train.promised_limits import put_promised

STEADY = AskedConfig(growth=0.0, growth_spread=0.0)


def exponential(rng, hours: float, per_hour: float = 3600.0, scale: float = 0.1) -> np.ndarray:
    """Peaks beyond 1, descending, of a Poisson process: the level x is exceeded per_hour exp(-(x - 1)/scale) times."""
    return np.sort(1 + rng.exponential(scale, rng.poisson(per_hour * hours)))[::-1]


@pytest.mark.parametrize("hours", [0.05, 0.2, 1.0])
def test_the_rate_over_the_level_is_the_one_asked_for_in_the_median(hours):
    rng, true, covered = np.random.default_rng(7), [], 0
    for _ in range(60):
        worst = WorstErrors.of(exponential(rng, hours), hours, STEADY)
        level = worst.level(0.125)
        true.append(3600 * np.exp(-(level - 1) / 0.1))
        low, high = worst.between(level, 0.9)
        covered += low <= true[-1] <= high
    # The prior of the shape reaches to heavier tails than this one, and a level below a peak that was seen is raised.
    assert 0.125 / 30 < np.median(true) < 0.125 * 2
    assert covered >= 48  # of 60: 54 expected; fewer than 48 once in a hundred times


@pytest.mark.parametrize(("hours", "shown"), [(1 / 60, 1 - np.exp(-1 / 4)), (0.5, 1.0), (24.0, 1.0)])
def test_growth_replaces_the_reserve_of_the_first_minutes_and_fades_with_the_hours(hours, shown):
    peaks = exponential(np.random.default_rng(3), hours)
    grown = AskedConfig(growth=0.3, growth_spread=0.0, growth_hours=0.5)
    ratio = WorstErrors.of(peaks, hours, grown).level(0.5) / WorstErrors.of(peaks, hours, STEADY).level(0.5)
    assert ratio == pytest.approx(np.exp(0.3 * shown / np.sqrt(1 + hours / 0.5)), rel=1e-2)


def test_a_peak_that_the_budget_does_not_allow_is_never_exceeded_by_the_limits():
    peaks = np.r_[3.0, exponential(np.random.default_rng(1), 0.5)]
    assert WorstErrors.of(peaks, 0.5, STEADY).level(1.0) >= 3.0  # 1 in 1 h allows none in half an hour
    assert WorstErrors.of(peaks, 0.5, STEADY).level(100.0) < 1.5


def test_of_a_few_peaks_the_prior_decides_and_none_are_refused():
    worst = WorstErrors.of(np.array([2.0, 1.9, 1.8]), 0.01, STEADY)
    # A tail of scale u/10 and shape 0.05 over the least of them: 3 peaks in 0.01 h, of 0.125 in an hour.
    xi, u = 0.05, 1.8
    assert worst.level(0.125) == pytest.approx(u * (1 + 0.1 / xi * ((300 / 0.125) ** xi - 1)), rel=0.2)
    with pytest.raises(TrainingError, match="tau_ext is zero throughout"):
        WorstErrors.of(np.zeros(3), 0.01, STEADY)


def test_the_posterior_of_shape_and_scale_is_that_of_the_likelihood_for_many_peaks():
    rng, xi, sigma = np.random.default_rng(2), 0.2, 0.3
    excess = sigma / xi * (rng.uniform(size=1000) ** -xi - 1)
    shape, scale = posterior(excess, 1.0, AskedConfig(shape=(0.1, 0.2), scale=(0.2, 1.0)))
    # Standard errors of the maximum likelihood: (1 + xi)/sqrt(n) and sigma sqrt(2 (1 + xi)/n).
    assert shape.mean() == pytest.approx(xi, abs=3 * (1 + xi) / np.sqrt(1000))
    assert scale.mean() == pytest.approx(sigma, abs=3 * sigma * np.sqrt(2 * (1 + xi) / 1000))


def test_worst_peaks_are_those_of_the_largest_ratio_a_second_apart():
    rng, t_ns = np.random.default_rng(5), np.arange(20_000, dtype=np.int64) * 1_000_000
    error, near = np.abs(lfilter([0.05], [1, -0.95], rng.normal(size=(20_000, 2)), axis=0)), rng.random((20_000, 2)) < 0
    peaks = Peaks(("a", "b"), 0.0)
    for name in ("one", "two"):
        peaks.add(name, t_ns, error, near, np.ones(len(t_ns), dtype=bool))
    limits = np.array([[0.2, 0.3], [0.5, np.inf]])
    listed = [
        (int(number), int(at), float(nm / limit))
        for j, of_limit in enumerate(limits.T)
        for region, limit in enumerate(of_limit)
        for nm, (number, at) in zip(peaks.nm[j][region], peaks.at[j][region], strict=True)
    ]
    expected = [  # by hand: every peak of a joint without a larger one less than a second away
        ratio
        for number, at, ratio in listed
        if all(other <= ratio for k, t, other in listed if k == number and abs(t - at) < 1_000_000_000)
    ]
    assert len(expected) > 20 and peaks.worst(limits) == pytest.approx(sorted(expected, reverse=True))


def asked(bundle: _core.Bundle, alarm: AlarmConfig, config: AskedConfig = STEADY, **motion) -> tuple[dict, list[str]]:
    """Limits from a minute of the noisy mass, facts and notes."""
    notes: list[str] = []
    given = {"unseen": [HeldOut(noisy(0))]} | motion
    return put_asked(bundle, LimitMotion("made", alarm, 1, note=notes.append, **given), config), notes


def test_a_minute_gives_limits_of_one_alarm_in_six_minutes():
    bundle = observer()
    alarm = AlarmConfig(false_alarms=1, in_hours=0.1, contacts_an_hour=600)
    facts, notes = asked(bundle, alarm)
    assert alarms_of(bundle, 2) <= 4  # in six minutes: one is expected, more than four once in 270 times
    assert alarms_of(bundle, 1) >= 10  # 60 are expected; contacts may be ten times as frequent as those of the peaks
    assert (np.array(bundle.contact_sliding_limit_nm) < bundle.sliding_limit_nm).all()
    assert facts["set_for"] == "1 in 6 minutes" and facts["promise"]["supported"] is False
    low, high = facts["extrapolated"]["between_per_hour"]
    # The limits are higher than those that the data prove, and so state no more false alarms.
    assert (
        low < 10 < high <= facts["promise"]["supported_budget"]["rate_per_hour"]
        and facts["extrapolated"]["largest_seen"] <= 1
    )
    shares = [one["share_of_limits"] for one in facts["budgets"]]
    assert shares[0] == 1 and shares == sorted(shares, reverse=True)
    assert "Thresholds are set for 1 in 6 minutes, extrapolated" in notes[0] and "The data alone prove 1 in" in notes[0]
    assert notes[1] == budgets_sentence(facts["budgets"]) and "1 in 6 minutes:" in notes[1]


def test_calibration_that_proves_the_budget_sets_the_limits_alone():
    alarm = AlarmConfig(false_alarms=1, in_hours=0.02, contacts_an_hour=600)
    recordings = [noisy(k) for k in range(5)]
    loaders = [lambda one=one: one for one in recordings]
    bundle, proved = observer(), observer()
    facts, notes = asked(bundle, alarm, unseen=[], calibration=loaders)
    put_promised(proved, LimitMotion("made", alarm, 1, calibration=loaders))
    assert bundle.sliding_limit_nm == proved.sliding_limit_nm
    assert "extrapolated" not in facts and "supported by" in notes[0] and len(facts["budgets"]) == 3


def test_limits_have_floors_at_rest_and_in_slow_motion_and_others_stay():
    _, _, recordings, before, _ = fitted(20.0)
    friction_nm = np.array([before.prior.friction_at_rest_nm(j) for j in range(2)])
    before.sliding_limit_nm = before.near_stiction_limit_nm = (friction_nm * [0.05, 3.0]).tolist()
    after = _core.Bundle.from_bytes(before.to_bytes())
    config = AskedConfig(rest_share=0.75, rest_errors=1e3, rest_hours=2.0, slow_share=0.4, slow_hours=0.75)
    floors_nm = put_floors(after, 6.0, config, rest_sigma_nm(after))
    assert floors_nm == pytest.approx(np.array([0.4 / 3 * np.array(after.sliding_limit_nm), 0.75 / 2 * friction_nm]))
    still = np.zeros((500, 2))
    sigma_nm = _core.estimate(before, recordings[0].t_ns[:500], still, still, still, 1)["sigma_nm"][-1]
    few = put_floors(
        _core.Bundle.from_bytes(before.to_bytes()), 6.0, replace(config, rest_errors=0.1), rest_sigma_nm(before)
    )
    assert few[1] == pytest.approx(0.1 / 2 * sigma_nm, rel=0.05)
    limit_nm = {}
    for dq_rad_s in (0.0, 1e-9, 1.0):  # at rest, slower than it starts, and at 1 rad/s all the time
        t_ns = recordings[0].t_ns
        q, dq = (np.full((len(t_ns), 2), value) for value in (0.3, dq_rad_s))
        for one in (before, after):
            scale = _core.estimate(one, t_ns, q, dq, 0 * q, 1)["limit_scale"][-1]
            limit_nm[dq_rad_s, one is after] = scale * one.near_stiction_limit_nm
    assert (limit_nm[0.0, True] >= floors_nm[1] * (1 - 1e-12)).all()
    assert limit_nm[0.0, True][0] == pytest.approx(floors_nm[1, 0], rel=0.1)  # a twentieth of the friction before
    assert limit_nm[0.0, True][1] == pytest.approx(limit_nm[0.0, False][1], rel=1e-9)
    assert (limit_nm[1.0, True] >= limit_nm[1.0, False]).all()
    assert limit_nm[1.0, True] == pytest.approx(limit_nm[1.0, False], rel=0.2)


def test_constant_limits_get_no_floors():
    _, _, _, bundle, rows = fitted(8.0)
    put_constant_error(bundle, rows)
    before = bundle.to_bytes()
    assert put_floors(bundle, 0.1, AskedConfig(), rest_sigma_nm(bundle)) is None and bundle.to_bytes() == before


def test_the_median_push_is_that_of_a_lever_over_all_directions():
    """At the elbow, 0.3 m from the shoulder, a newton in any direction exerts 0.3 u, u even in 0 to 1."""
    _, _, _, bundle, _ = fitted(8.0)
    bundle.sliding_limit_nm = [3.0, 1.0]
    found = noticed_pushes_n(bundle, [[0.0, 0.0], [0.4, 1.0]])
    assert set(found) == {"end of the arm", "link of shoulder, at elbow"}
    assert list(found.values()) == pytest.approx(2 * [3.0 / 0.3 / 0.5], rel=0.02)  # of 100 directions
    bundle.sliding_limit_nm = bundle.near_stiction_limit_nm = [np.inf, 1.0]
    assert noticed_pushes_n(bundle, [[0.0, 0.0]]) == noticed_standing(bundle, [[0.0, 0.0]]) == {}


# --- The error scale in other programs.


def fitted(seconds: float):
    """Setup, fit, recordings and bundle of a planar arm."""
    recordings = [motion(seconds=seconds, seed=k, name=f"made-{k}") for k in range(5)]
    setup = build_setup(planar_arm(), recordings[0], ObserverConfig(), "prior")
    fit = fit_terms(setup, recordings, PriorConfig(), [[], []], Inertia())
    bundle = make_bundle("made", replace(setup, prior=fit.settings), 0.02, recordings[0])
    rows = collect_rows(bundle, [HeldOut(one) for one in recordings], 1)
    fit_error_scale(bundle, rows)
    return setup, fit, recordings, bundle, rows


def test_programs_repeat_spans_of_each_joint_at_their_pace():
    recording = motion(seconds=60.0)
    for pace in (1.0, 2.0):
        made = list(programs([recording], pace, np.random.default_rng(0), OtherProgramsConfig(pace_s=30.0)))
        assert sum(len(t_ns) for t_ns, *_ in made) == pytest.approx(30 * RATE_HZ, rel=0.1)
        for t_ns, q, dq in made:
            slope = np.gradient(q, 1e-9 * (t_ns - t_ns[0]), axis=0)
            assert np.sqrt(np.mean((slope - dq)[5:-5] ** 2)) < 0.05 * np.sqrt(np.mean(dq**2))
            assert (q >= recording.q.min(axis=0)).all() and (q <= recording.q.max(axis=0)).all()


def test_the_spread_of_a_weight_is_its_jackknife_error_behind_the_filter():
    setup, fit, recordings, bundle, _ = fitted(20.0)
    config = OtherProgramsConfig(pace_s=15.0, paces=(1.5,))
    by = 0.7
    for k, one in enumerate(fit.left_out):  # all folds alike, but for one viscous weight of one
        weights = np.array(fit.settings.weights).reshape(2, -1)
        term = next(m for m, t in enumerate(fit.settings.terms) if t.kind == _core.TermKind.viscous and t.a == 1)
        weights[1, term] += by * (k == 2)
        one.settings.weights = weights.ravel().tolist()
        one.settings.corrected_links = fit.settings.corrected_links
    features, spread = spread_rows(bundle, setup, fit, recordings, config)
    expected = []
    for _, _, dq in programs(recordings, 1.5, np.random.default_rng(0), config):
        v = dq[:, 1]
        mean = np.r_[v[0], (v[1:] + v[:-1]) / 2]
        kept = np.exp(-setup.observer.gain_per_s / RATE_HZ)
        expected.append(lfilter([1 - kept], [1, -kept], mean))
    warm = int(round(8 / setup.observer.gain_per_s * RATE_HZ))
    reached = np.sqrt(4 / 5) * by * np.abs(np.concatenate([one[warm:] for one in expected]))
    assert spread[:, 0] == pytest.approx(0, abs=1e-12)
    assert np.quantile(spread[:, 1], [0.5, 0.9]) == pytest.approx(np.quantile(reached, [0.5, 0.9]), rel=0.03)
    assert len(features) == len(spread)


def test_sigma_at_rest_contains_the_spread_of_the_rows_at_rest():
    _, _, recordings, before, _ = fitted(20.0)
    after = _core.Bundle.from_bytes(before.to_bytes())
    features = np.zeros((4, 2, len(FEATURES)))
    features[2:, :, FEATURES.index(_core.MotionFeature.speed)] = 1.0
    add_at_rest(after, features, np.array([[0.3, 0.0], [0.4, 0.0], [9.0, 9.0], [9.0, 9.0]]), 0.002)
    still = np.zeros((500, 2))
    variance = [
        _core.estimate(one, recordings[0].t_ns[:500], still, still, still, 1)["sigma_nm"][-1] ** 2
        for one in (before, after)
    ]
    assert variance[1] - variance[0] == pytest.approx([(0.3**2 + 0.4**2) / 2, 0], rel=0.02, abs=1e-9)
    assert after.error_scale.limit_weights == before.error_scale.limit_weights
    assert after.error_scale.sigma_weights == before.error_scale.sigma_weights


def test_the_scale_reaches_the_spread_in_faster_programs_and_stays_where_data_determine_the_prior():
    grew = {}
    for seconds in (8.0, 200.0):
        setup, fit, recordings, bundle, rows = fitted(seconds)
        config = OtherProgramsConfig(pace_s=40.0)
        facts, _ = widen_for_other_programs(bundle, setup, fit, recordings, rows, config)
        weights = np.array(bundle.error_scale.limit_weights).reshape(2, -1)
        assert np.median(rows.scale(weights), axis=0) == pytest.approx(1)
        features, spread = spread_rows(with_unit_scale(bundle), setup, fit, recordings, config)
        scale = np.einsum("rjf,jf->rj", features, weights)
        assert bundle.error_scale.largest == pytest.approx(rows.scale(weights).max(axis=0))
        level = np.quantile(rows.error_nm / rows.scale(weights), 0.999, axis=0)
        assert (np.mean(config.times * spread <= 1.5 * level * scale, axis=0) > 0.97).all()
        grew[seconds] = max(facts["scale_grew_by"].values())
    assert grew[200.0] < 1.2 and grew[8.0] > grew[200.0]
