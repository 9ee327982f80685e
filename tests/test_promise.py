"""Budgets of false alarms: what they are, what their hours support, and whether a test kept them."""

import json
import math

import pytest
from scipy.stats import chi2, poisson

from tauext.errors import ConfigError
from tauext.fit.tail import (
    FalseAlarmBudget,
    Promise,
    duration,
    is_kept,
    rate_interval,
    upper_rate,
)

ONE_IN_EIGHT = FalseAlarmBudget(1, 8)


def test_a_budget_is_a_rate_and_says_itself_in_words():
    assert FalseAlarmBudget(2, 8).rate_per_hour == 0.25
    assert str(ONE_IN_EIGHT) == "1 in 8 h"
    assert str(FalseAlarmBudget(1, 0.1)) == "1 in 6 minutes"


@pytest.mark.parametrize("events", [0, 1, 3, 40, 1000])
@pytest.mark.parametrize("confidence", [0.5, 0.95, 0.999])
def test_intervals_and_bounds_are_those_of_chi_squared_quantiles(events, confidence):
    alpha, hours = 1 - confidence, 7.0
    low, high = rate_interval(events, hours, confidence)
    assert low == pytest.approx(chi2.ppf(alpha / 2, 2 * events) / (2 * hours) if events else 0.0, rel=1e-9)
    assert high == pytest.approx(chi2.ppf(1 - alpha / 2, 2 * events + 2) / (2 * hours), rel=1e-9)
    assert upper_rate(events, hours, confidence) == pytest.approx(chi2.ppf(1 - alpha, 2 * events + 2) / (2 * hours))


def test_a_promise_is_kept_by_as_many_alarms_as_its_rate_explains_and_by_fewer():
    rate = ONE_IN_EIGHT.rate_per_hour  # 3 expected in 24 h
    assert [is_kept(k, 24, rate) for k in (0, 3, 6, 7, 20)] == [True, True, True, False, False]
    assert poisson.sf(6, 3.0) < 0.05 < poisson.sf(5, 3.0)  # P(7 or more), P(6 or more)
    assert is_kept(2, 240, rate)  # far fewer than promised


def test_three_times_the_hours_of_one_alarm_are_needed():
    needed_hours = Promise(ONE_IN_EIGHT, 1.0).needed_hours
    assert needed_hours == pytest.approx(24.0, abs=0.05)
    assert upper_rate(0, needed_hours) == pytest.approx(ONE_IN_EIGHT.rate_per_hour, rel=1e-12)
    assert Promise(ONE_IN_EIGHT, 1.0, 0.99).needed_hours == pytest.approx(36.84, abs=0.01)


def test_twenty_minutes_refuse_to_promise_eight_hours_and_say_how_much_more_to_record():
    promise = Promise(ONE_IN_EIGHT, hours=1 / 3)
    assert not promise.is_supported
    assert promise.supported.hours * 60 == pytest.approx(6.68, abs=0.005)
    assert promise.sentence() == (
        "At most 1 false alarm in 8 h cannot be proved: 20 minutes of calibration support 1 in 6.67 minutes at best "
        "(at 95 % confidence); record 23.7 h more of free motion, 24 h in all."
    )


def test_enough_hours_support_the_budget():
    assert Promise(FalseAlarmBudget(2, 8), hours=24.0).sentence() == (
        "At most 2 false alarms in 8 h: supported by 24 h of calibration (at 95 % confidence)."
    )


@pytest.mark.parametrize("hours", [0.01, 1 / 3, 2.9, 8.0, 23.9, 500.0])
def test_what_is_advised_is_enough(hours):
    promise = Promise(ONE_IN_EIGHT, hours)
    assert Promise(ONE_IN_EIGHT, hours + promise.missing_hours).is_supported
    assert Promise(promise.supported, hours).is_supported
    # Also as it is worded: the supported budget is rounded down, what is missing up.
    factor = {"h": 1, "minutes": 60, "s": 3600}
    number, unit = duration(promise.supported.hours, "down").split()
    assert Promise(FalseAlarmBudget(1, float(number) / factor[unit]), hours).is_supported
    if promise.missing_hours:
        number, unit = duration(promise.missing_hours, "up").split()
        assert Promise(ONE_IN_EIGHT, hours + float(number) / factor[unit]).is_supported


def test_the_summary_is_json_and_holds_the_sentence():
    promise = Promise(ONE_IN_EIGHT, hours=1 / 3)
    read = json.loads(json.dumps(promise.summary()))
    assert read["sentence"] == promise.sentence()
    assert read["asked"] == {"alarms": 1, "hours": 8, "rate_per_hour": 0.125, "text": "1 in 8 h"}
    assert read["supported"] is False
    assert read["missing_hours"] == pytest.approx(23.63, abs=0.005)


@pytest.mark.parametrize(
    ("hours", "nearest", "up", "down"),
    [
        (8.0, "8 h", "8 h", "8 h"),
        (23.6325, "23.6 h", "23.7 h", "23.6 h"),
        (112.4, "112 h", "113 h", "112 h"),
        (0.11127, "6.68 minutes", "6.68 minutes", "6.67 minutes"),
        (0.01, "36 s", "36 s", "36 s"),
        (1e-5, "0.036 s", "0.036 s", "0.036 s"),
    ],
)
def test_durations_in_words(hours, nearest, up, down):
    assert (duration(hours), duration(hours, "up"), duration(hours, "down")) == (nearest, up, down)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: FalseAlarmBudget(0, 8), "target false alarm rate: alarms = 0 must be > 0"),
        (lambda: FalseAlarmBudget(1, math.nan), "target false alarm rate: hours = nan must be > 0"),
        (lambda: rate_interval(-1, 8), "events = -1 must be a whole number >= 0"),
        (lambda: is_kept(1.5, 8, 0.1), "events = 1.5 must be a whole number >= 0"),
        (lambda: is_kept(1, 0, 0.1), "hours = 0 must be > 0"),
        (lambda: upper_rate(1, 8, 1.0), "confidence = 1.0 must lie between 0 and 1"),
        (lambda: Promise(ONE_IN_EIGHT, 8, 0), "confidence = 0 must lie between 0 and 1"),
        (lambda: Promise(ONE_IN_EIGHT, -1.0), "hours = -1.0 must be > 0"),
    ],
)
def test_bad_input_is_named(make, message):
    with pytest.raises(ConfigError) as refused:
        make()
    assert str(refused.value) == message
