"""What is left of recordings with contacts, and how they are cut by time."""

import numpy as np
import pytest
from sliding_mass import recording

from tauext.config import FreeMotionConfig
from tauext.data.free_motion import free_pieces, free_samples, split_by_time, standing_joints


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


def test_what_is_unknown_is_not_free_unless_nothing_is_labelled():
    contact = np.zeros(100, dtype=np.int8)
    contact[40:50] = -1
    assert free_samples(recording(samples=100, contact=contact)).sum() == 90
    assert free_samples(recording(samples=100, contact=np.full(100, -1, dtype=np.int8))).all()
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


def test_a_standing_joint_is_told_by_its_position_not_by_a_noisy_speed():
    rng = np.random.default_rng(1)
    noisy = recording(dq=rng.normal(0, 0.05, (3000, 1)))
    moving = recording(q=np.linspace(0, 0.1, 3000)[:, None])
    assert standing_joints([noisy]).all() and not standing_joints([noisy, moving]).any()
