"""What is left of recordings with contacts, and how they are cut by time."""

from dataclasses import replace

import numpy as np
import pytest
from sliding_mass import recording

from tauext.config import FreeMotionConfig
from tauext.data.free_motion import first_seconds, free_pieces, free_samples, split_by_time, standing_joints, total_s


def touched(*spans: tuple[int, int], samples: int = 6000):
    contact = np.zeros(samples, dtype=np.int8)
    for begin, end in spans:
        contact[begin:end] = 1
    return recording(samples=samples, contact=contact)


def test_margins_are_left_out_on_both_sides_of_every_contact():
    # Stamps are 1 ms apart, so margins of 10 and 30 ms are that many samples.
    made = touched((1000, 1100), (1115, 1116), (3000, 3001))
    free = free_samples(made, FreeMotionConfig(before_s=0.01, after_s=0.03))
    slow = np.ones(6000, dtype=bool)
    for k in np.flatnonzero(made.contact == 1):
        slow[max(k - 10, 0) : k + 31] = False
    np.testing.assert_array_equal(free, slow)


def test_what_is_unknown_is_not_free_and_a_recording_without_labels_is():
    contact = np.zeros(100, dtype=np.int8)
    contact[40:50] = -1
    assert free_samples(recording(samples=100, contact=contact)).sum() == 90
    assert not free_samples(recording(samples=100, contact=np.full(100, -1, dtype=np.int8))).any()
    assert free_samples(recording(samples=100)).all()


def test_pieces_are_the_free_stretches_of_a_second_or_more_and_hold_no_contact():
    made = touched((500, 600), (2900, 3000))
    pieces = free_pieces([made], FreeMotionConfig(before_s=0.1, after_s=0.2))
    assert [(p.t_ns[0] // 1_000_000, p.t_ns[-1] // 1_000_000) for p in pieces] == [(800, 2799), (3200, 5999)]
    assert all((p.contact == 0).all() and p.name == made.name for p in pieces)
    whole = recording()
    assert free_pieces([whole])[0] is whole


def test_a_split_by_time_leaves_a_gap_and_keeps_short_recordings_whole():
    long, short = recording("long", samples=10_000), recording("short", samples=2000)
    first, last = split_by_time([long, short], share=0.2, gap_s=1.5, least_s=1.0)
    assert [r.name for r in first] == ["long", "short"] and [r.name for r in last] == ["long"]
    assert last[0].t_ns[0] - first[0].t_ns[-1] >= 1.5e9
    assert last[0].t_ns[-1] == long.t_ns[-1] and first[1] is short
    assert last[0].duration_s == pytest.approx(0.2 * long.duration_s, abs=1e-3)


def test_a_standing_joint_is_found_by_its_position_not_by_a_noisy_speed():
    rng = np.random.default_rng(1)
    noisy = recording(dq=rng.normal(0, 0.05, (3000, 1)))
    moving = recording(q=np.linspace(0, 0.1, 3000)[:, None])
    assert standing_joints([noisy]).all() and not standing_joints([noisy, moving]).any()


THREE = [recording(name, 900, contact=np.zeros(900, dtype=np.int8)) for name in ("one", "two", "three")]


@pytest.mark.parametrize(
    "seconds, samples", [(0.4, [400]), (0.9, [900]), (1.8, [900, 900]), (2.05, [900, 900, 250]), (9.9, [900] * 3)]
)
def test_whole_recordings_come_first_and_the_last_one_is_cut(seconds, samples):
    taken = first_seconds(THREE, seconds)
    assert [part.samples for part in taken] == samples
    assert total_s(taken) == pytest.approx(min(seconds, 2.7), abs=1e-9)
    for whole, part in zip(THREE, taken, strict=False):
        for signal in ("t_ns", "q", "dq", "tau", "contact"):
            np.testing.assert_array_equal(getattr(part, signal), getattr(whole, signal)[: part.samples])
        assert part.name == whole.name and part.temperature is None


def test_a_gap_counts_as_time():
    with_gap = replace(THREE[0], t_ns=THREE[0].t_ns + np.where(np.arange(900) >= 300, 200_000_000, 0))
    (part,) = first_seconds([with_gap], 0.4)
    assert part.samples == 300  # 0.3 s of samples, then nothing until 0.5 s
