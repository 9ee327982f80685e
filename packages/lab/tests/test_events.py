"""Labelled events: found, false, delays, against what was worked out by hand on made-up alarms."""

from dataclasses import replace

import numpy as np
import pytest
from sliding_mass import observer_bundle, pushed, recording
from tauext_lab.evaluate.collisions import Onsets
from tauext_lab.evaluate.comparison import evaluate
from tauext_lab.evaluate.config import EventsConfig
from tauext_lab.evaluate.events import EventMeasures, Labels, event_time, is_moving, labelled_events, own_limits
from tauext_lab.evaluate.results import Events

from tauext.data.recording import Recording
from tauext.errors import ConfigError


def labelled(*spans: tuple[int, int], samples: int = 6000, **changes) -> Recording:
    contact = np.zeros(samples, dtype=np.int8)
    for begin, end in spans:
        contact[begin:end] = 1
    return recording(samples=samples, contact=contact, **changes)


def alarms(*spans: tuple[int, int], samples: int = 6000) -> np.ndarray:
    flags = np.zeros(samples, dtype=bool)
    for begin, end in spans:
        flags[begin:end] = True
    return flags


def judged(made: Recording, alarm: np.ndarray, healthy: np.ndarray | None = None, **config) -> Events:
    settings = EventsConfig(**config)
    measures = EventMeasures(settings)
    zeros = np.zeros_like(made.q)
    measures.add(
        Labels(made, settings, 0.02),
        alarm,
        np.ones(made.samples, dtype=bool) if healthy is None else healthy,
        zeros,
        zeros,
    )
    return measures.summary()


def test_an_alarm_within_the_tolerance_finds_the_event_and_is_not_false():
    made = labelled((2000, 2300), (4000, 4300))
    early = judged(made, alarms((1950, 1960), (4350, 4360)), tolerance_s=0.1)
    assert early.all.found == 2 and early.all.false_alarms == 0
    assert [v.delay_s for v in early.verdicts] == pytest.approx([-0.05, 0.35])
    strict = judged(made, alarms((1950, 1960), (4350, 4360)), tolerance_s=0.02)
    assert strict.all.found == 0 and strict.all.false_alarms == 2
    # Free time: 6 s less two events of 0.3 s (300 samples) with 20 ms on both sides of their first and last samples.
    assert strict.all.free_hours * 3600 == pytest.approx(6 - 2 * 0.340, abs=0.003)


def test_unknown_contact_is_neither_free_nor_a_contact(tmp_path):
    """Pushes of which nothing is known make no false alarm, no collision and no free time, in any of the numbers."""
    known, hit = labelled(samples=10_000, name="known"), pushed("hit", 10.0)
    unknown = replace(hit, contact=-hit.contact)
    none = replace(hit, name="none", contact=np.full(hit.samples, -1, dtype=np.int8))
    loaders = [lambda: known, lambda: unknown, lambda: none]
    found = evaluate({"o": observer_bundle()}, loaders, [], tmp_path, seed=0, threads=1, sanity=True)
    (bundle,) = found.bundles
    assert found.collisions == () and bundle.free_motion.false_collisions == bundle.events.all.false_alarms == 0
    unknown_s = (1.0 * (hit.contact == 1).sum() + hit.samples) / hit.rate_hz
    assert found.unknown_contact_hours * 3600 == pytest.approx(unknown_s)
    free_s = known.samples / known.rate_hz + hit.samples / hit.rate_hz - (hit.contact == 1).sum() / hit.rate_hz
    warm_up_s = 2 * 0.5
    assert bundle.events.all.free_hours * 3600 == pytest.approx(free_s - warm_up_s, abs=0.01)
    margins_s = 0.2 + 1.0  # before and after unknown time, too, which an alarm may outlast
    assert bundle.free_motion.hours * 3600 == pytest.approx(free_s - warm_up_s - margins_s, abs=0.01)
    always = found.sanity[0]
    assert always.false_per_hour == pytest.approx(3600 / free_s) and always.collisions == 0
    said = evaluate({"o": observer_bundle()}, [lambda: replace(unknown, contact=None)], [], tmp_path, seed=0, threads=1)
    assert said.bundles[0].free_motion.false_collisions == 1  # the same push in motion that is called free


def test_alarms_less_than_half_a_second_apart_are_one_and_one_that_outlasts_its_event_is_none():
    made = labelled((2000, 2300))
    summary = judged(made, alarms((2100, 2600), (2900, 2950), (4000, 4010), (4300, 4310)), tolerance_s=0.1)
    assert summary.all.found == 1 and summary.all.false_alarms == 1


def test_false_alarms_say_where_they_began_and_how_long_after_a_contact():
    made = labelled((2000, 2300))
    summary = judged(made, alarms((1000, 1010), (2100, 2110), (3300, 3310), (5000, 5010)), tolerance_s=0.1)
    found = summary.false_alarms_at
    assert [alarm.start_s for alarm in found] == pytest.approx([1.0, 3.3, 5.0])
    assert found[0].since_contact_s is None
    assert [alarm.since_contact_s for alarm in found[1:]] == pytest.approx([1.001, 2.701])  # its last sample: 2.299
    assert all(alarm.recording == made.name and not alarm.moving for alarm in found)
    assert summary.all.false_alarms == 3
    unlabelled = judged(recording(samples=6000), alarms((1000, 1010)))
    assert [alarm.since_contact_s for alarm in unlabelled.false_alarms_at] == [None]


def test_short_events_and_those_before_the_warm_up_are_neither_missed_nor_free_time():
    made = labelled((100, 400), (2000, 2010), (4000, 4300))
    healthy = np.arange(6000) >= 500
    summary = judged(made, alarms((2005, 2006)), healthy, shortest_event_s=0.05, tolerance_s=0.0)
    assert summary.left_out == 2 and summary.all.events == 1 and summary.all.false_alarms == 0
    assert summary.all.free_hours * 3600 == pytest.approx(5.5 - 0.31, abs=0.003)


def test_moving_and_resting_events_and_time_are_distinguished_by_position():
    q = np.where(np.arange(6000) < 3000, 0.0, 0.1 * (np.arange(6000) - 3000) * 1e-3)[:, None]
    rng = np.random.default_rng(0)
    made = labelled((1000, 1200), (4000, 4200), q=q, dq=rng.normal(0, 0.05, (6000, 1)))
    moving = is_moving(made, 0.02)
    assert not moving[:2700].any() and moving[3100:5800].all()
    summary = judged(made, alarms((1010, 1020), (2000, 2010)))
    assert (summary.resting.found, summary.moving.found) == (1, 0)
    assert (summary.resting.false_alarms, summary.moving.false_alarms) == (1, 0)
    events, _ = labelled_events(made, EventsConfig(), 0.02)
    assert [event.moving for event in events] == [False, True]


def test_an_onset_is_the_first_sample_outside_the_noise_band():
    rng = np.random.default_rng(2)
    torque = rng.normal(0, 0.1, (6000, 1))
    torque[2040:2300] += 5.0
    made = labelled((2000, 2300), tau_ext=torque)
    free = ~event_time(made, 0.1)
    assert Onsets(made, [(1.9, 2.299)]).find(np.zeros((6000, 1)), free) == [pytest.approx(2.04)]
    # Without tau_ext by the slope of the residual, here a ramp of 50 Nm/s: 1 Nm in 20 ms beside noise of 0.01 Nm.
    ramp = rng.normal(0, 0.01, (6000, 1)) + np.clip(np.arange(6000) - 2040, 0, 200)[:, None] * 0.05
    (onset,) = Onsets(labelled((2000, 2300)), [(1.9, 2.299)]).find(ramp, free)
    assert 2.04 <= onset <= 2.044
    assert Onsets(made, [(3.0, 3.5)]).find(np.zeros((6000, 1)), free) == [None]


def test_a_test_recording_with_contacts_counts_as_events_and_by_its_free_motion(tmp_path):
    hit = pushed("hit", 10.0)
    results = evaluate({"observer": observer_bundle(2.0)}, [lambda: hit], [], tmp_path, seed=0, threads=1)
    bundle = results.bundles[0]
    assert bundle.events.all.events == bundle.events.all.found == 1
    assert bundle.free_motion.false_alarms == 0 and len(bundle.collisions) == 1
    # 3 s at 1 kHz: less the warm-up of 0.5 s, the push of 0.4 s, 0.2 s before and 1 s after it.
    assert bundle.free_motion.samples == pytest.approx(900, abs=3)
    assert results.own_torque is None


def test_the_robots_own_torque_is_judged_by_its_largest_free_value():
    noise = np.random.default_rng(3).normal(0, 0.1, (6000, 1))
    quiet = recording(samples=6000, tau_ext=noise)
    assert own_limits([quiet]) == pytest.approx([np.abs(noise).max()])
    assert own_limits([recording()]) is None and own_limits([recording(tau_ext=np.zeros((3000, 1)))]) is None


@pytest.mark.parametrize("name", ["shortest_event_s", "tolerance_s"])
def test_event_settings_out_of_range_are_refused(name):
    with pytest.raises(ConfigError, match=f"{name} = -1 must be a number from 0 to 60"):
        EventsConfig(**{name: -1})
