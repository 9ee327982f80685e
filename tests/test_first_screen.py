"""The report's first screen says what results.json says, in plain words, and what is missing is said to be."""

from __future__ import annotations

from dataclasses import replace

import pytest
from made_results import make_results
from tauext_lab.evaluate.results import (
    CurvePoint,
    EvaluatedBundle,
    Limits,
    Results,
    StrengthBin,
    load_results,
)
from tauext_lab.report.page import false_alarms, first_screen, joint_list, plain, shown_bundle, tile, weak_words
from tauext_lab.report.tables import duration_or_dash

from tauext.check.before_training import RejectedTime


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Results:
    folder, _ = make_results(tmp_path_factory.mktemp("made"), bundles=("exact", "none"), seconds=20, test_recordings=1)
    return load_results(folder)


def free(bundle: EvaluatedBundle, **changes) -> EvaluatedBundle:
    return replace(bundle, free_motion=replace(bundle.free_motion, **changes))


def test_its_numbers_are_those_of_the_results(results):
    screen, bundle = first_screen(results), shown_bundle(results)
    latched = bundle.latched
    found, false_alarm, delay, limit = screen.glances
    assert screen.method == bundle.label
    assert found.value == f"{latched.latched} of {latched.collisions}"
    assert f"collisions latched, {latched.strong_latched} of {latched.strong} strong ones" in found.means
    assert false_alarm.value == str(bundle.free_motion.false_collisions)
    assert delay.value == f"{1000 * latched.delay_median_s:.0f} ms"
    for name, value in zip(results.joints, bundle.limits.sliding_nm, strict=True):
        assert f"{name} {value:.1f}" in limit.value.replace("\N{NO-BREAK SPACE}", " ")
    assert f"{len(results.collisions)} collision" in screen.tested and "by force pulses" in screen.tested


def test_a_rate_of_no_alarm_at_all_is_as_low_as_the_test_was_long(results):
    """exp(-3) = 0.05: at 3 / T an hour, T hours without an alarm have a probability of 5 %."""
    none = free(results.bundles[0], hours=0.1, false_collisions=0)
    assert false_alarms(none).value == "0"
    assert false_alarms(none).means.startswith("false collisions in 6 minutes of free motion: fewer than 30 an hour")
    some = free(results.bundles[0], hours=0.5, false_collisions=2, false_collisions_interval_per_hour=(0.48, 14.4))
    assert "4 an hour (the truth lies between 0.48 and 14, 95 %)" in false_alarms(some).means


def test_the_method_shown_misses_least_at_one_false_alarm_an_hour(results):
    """One that finds all by alarming all the time is not shown."""
    exact, none = results.bundles
    loud = replace(exact, missed_curve=(CurvePoint(0.1, 900.0, 0), CurvePoint(1.0, 0.5, 9)))
    calm = replace(none, missed_curve=(CurvePoint(0.1, 800.0, 0), CurvePoint(1.0, 0.9, 3)))
    assert shown_bundle(replace(results, bundles=(loud, calm))) is calm
    assert shown_bundle(replace(results, bundles=(calm, loud))) is calm


def test_what_is_too_weak_is_counted_up_to_the_strength_that_is_seen(results):
    bins = ((0.0, 1.0, 5, 0), (1.0, 2.0, 10, 4), (2.0, 4.0, 20, 19), (4.0, None, 30, 30))
    bundle = replace(results.bundles[0], by_strength=tuple(StrengthBin(*one, None, None) for one in bins))
    assert weak_words(bundle) == " Of 15 collisions below 2 Nm it missed 11."
    seen = replace(bundle, by_strength=bundle.by_strength[2:])
    assert weak_words(seen) == ""


@pytest.mark.parametrize(
    "change, says",
    [
        ({"promised_per_hour": None}, "The thresholds have no target false alarm rate"),
        (
            {"promised_per_hour": 0.125, "promise_kept": False},
            "The thresholds allow at most 0.12 false alarms an hour, and the test had more",
        ),
    ],
)
def test_the_next_step_follows_from_the_promise(results, change, says):
    told = first_screen(replace(results, bundles=(free(results.bundles[0], **change),)))
    assert says in " ".join(step.words for step in told.steps)


def test_what_is_missing_is_reported(results):
    bundle = free(replace(results.bundles[0], latched=None), hours=None)
    screen = first_screen(replace(results, bundles=(bundle,), collisions=()))
    assert screen.glances[0].value == "–" and "no collisions tested" in screen.glances[0].means
    assert screen.glances[1].value == "not measured" and "no free motion tested" in screen.glances[1].means
    assert screen.glances[2].value == "–" and "no free motion" in screen.tested and not screen.why
    assert "Record touches and label their times" in " ".join(step.words for step in screen.steps)
    nothing = replace(bundle, limits=Limits((None, None), (None, None), False))
    assert joint_list(results, nothing.limits.sliding_nm) == ""


@pytest.mark.parametrize("hours, strong", [(15 / 3600, 0), (0.1, 7), (10.2, 8)])
def test_cards_show_the_counts_and_the_time_of_the_headline(results, hours, strong):
    bundle = free(results.bundles[0], hours=hours, false_collisions=1)
    bundle = replace(
        bundle, latched=replace(bundle.latched, collisions=20, latched=12, strong=8, strong_latched=strong)
    )
    if not strong:
        bundle = replace(bundle, latched=replace(bundle.latched, strong=0))
    found, false_alarm, *_ = first_screen(replace(results, bundles=(bundle,))).glances
    card = tile(bundle, results, "#000000")
    words = f"collisions latched, {f'{strong} of 8 strong ones' if strong else 'none of them strong'}"
    assert card.latched == found.value == "12 of 20" and card.of_what == words and found.means.startswith(words)
    time = {15 / 3600: "15 s", 0.1: "6 minutes", 10.2: "10.2 h"}[hours]
    assert card.false_collisions == f"1 false collision in {time} of free motion"
    assert f"{false_alarm.value} {false_alarm.means}".startswith(f"{card.false_collisions}: ")


def test_cards_and_headline_agree_where_nothing_was_tested(results):
    bundle = replace(free(results.bundles[0], hours=0.0), latched=None, ten_found=0)
    screen = first_screen(replace(results, bundles=(bundle,)))
    card = tile(bundle, results, "#000000")
    assert card.latched == screen.glances[0].value == "–" and screen.glances[0].means.startswith(card.of_what)
    assert card.false_collisions == screen.glances[1].means == "false collisions: not measured, no free motion tested"


def test_times_choose_their_unit_and_numbers_have_no_exponent():
    times = {15 / 3600: "15 s", 33.5 / 60: "33.5 minutes", 1.0: "1 h", 10.2: "10.2 h", 0.0: "–", None: "–"}
    assert [duration_or_dash(hours) for hours in times] == list(times.values())
    assert [plain(value) for value in (30.3, 4.04, 0.125)] == ["30", "4", "0.12"]


def test_collisions_in_unhealthy_time_are_no_misses_of_the_limits(results):
    """`0 of 20` stands beside its reason."""
    bundle = results.bundles[0]
    latched = replace(bundle.latched, collisions=20, latched=0, strong=3, strong_latched=0, unhealthy=18)
    blind = replace(bundle, latched=latched, rejected=RejectedTime(0.86, {"wrong rate": 0.86}, None))
    screen = first_screen(replace(results, bundles=(blind,)))
    assert (
        screen.glances[0].value == "0 of 20" and "18 came while the monitor was not healthy" in screen.glances[0].means
    )
    assert "not healthy for 86% of the time (wrong rate)" in screen.tested
    assert screen.steps[0].command == "tauext check"
    calm = replace(bundle, latched=replace(latched, unhealthy=0))
    assert "none pushed a joint over its threshold" in first_screen(replace(results, bundles=(calm,))).glances[0].means
