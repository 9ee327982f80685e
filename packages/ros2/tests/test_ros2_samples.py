"""Times, rates, joints and publishers of samples: what is done with each that is not as it should be."""

import numpy as np
import pytest

pytest.importorskip("cyclonedds")

from tauext_ros2.messages import JointState
from tauext_ros2.node import HOLD_NS, Conditions
from tauext_ros2.samples import LEARNT_FROM, TAKEOVER_NS, ArmJoints, Followed, SampleRate, SampleTime

MS = 1_000_000


def times_of(stamps_ms, received_ms, follows=None):
    """In ms after the first, and what was said of each."""
    time, first = SampleTime(), None
    steps, said = [], []
    for k, (stamp, received) in enumerate(zip(stamps_ms, received_ms, strict=True)):
        t_ns, wrong = time.next(stamp * MS, received * MS, follows is None or follows[k])
        first = t_ns if first is None else first
        steps.append((t_ns - first) // MS)
        said.append(wrong)
    return steps, said


@pytest.mark.parametrize(
    ("stamps", "received", "steps", "said"),
    [
        ([5, 6, 7], [100, 900, 901], [0, 1, 2], None),
        ([5000, 9000], [10, 4010], [0, 4000], None),  # a pause is no jump
        ([0, 0, 0], [10, 11, 13], [0, 1, 3], "stamps are missing"),
        ([5000, 5001, 3000, 3001], [10, 11, 12, 40], [0, 1, 2, 3], "went back by 2 s"),
        ([5000, 5001, 95000, 95001], [10, 11, 12, 40], [0, 1, 2, 3], "jumped ahead by 90 s"),
        ([5000, 5002, 3000, 3001], [10, 12, 12, 12], [0, 2, 4, 5], "went back"),
        ([5000, 5000, 5001], [10, 12, 13], [0, 0, 1], "same stamp"),
        ([5000, 0, 5002], [10, 12, 15], [0, 2, 5], "stamps are missing"),
    ],
)
def test_a_clock_that_is_set_or_missing_costs_steps_by_reception_only(stamps, received, steps, said):
    times, wrong = times_of(stamps, received)
    assert times == steps
    assert any(said in text for text in wrong if text) if said else not any(wrong)


def test_the_clock_of_another_publisher_does_not_enter():
    steps, said = times_of([5000, 5001, 70, 71], [10, 11, 600, 601], [False, True, False, True])
    assert steps == [0, 1, 590, 591]
    assert said == [None] * 4


def given(rate, t_ms):
    return [t for t in t_ms if rate.wants(round(t * MS))]


def learnt(bundle_ms, publisher_ms, samples=LEARNT_FROM):
    rate = SampleRate(round(bundle_ms * MS))
    assert given(rate, [k * publisher_ms for k in range(samples - 1)]) == []
    return rate


@pytest.mark.parametrize("publisher_ms", [1, 0.98, 1.04])
def test_the_bundles_rate_is_given_on_whole(publisher_ms):
    rate = learnt(1, publisher_ms)
    times = [k * publisher_ms for k in range(20, 60)]
    assert given(rate, times) == times
    assert rate.problem is None and rate.lost == 0


@pytest.mark.parametrize("n", [2, 5, 10])
def test_of_n_times_the_rate_every_nth_is_taken(n):
    rate = learnt(10, 10 / n)
    taken = given(rate, [k * 10 / n for k in range(20, 20 + 30 * n)])
    assert np.diff(taken).tolist() == pytest.approx([10] * 29)
    assert rate.factor == n and rate.problem is None


def test_slots_do_not_drift_with_jitter_and_losses_move_one_sample_alone():
    rng = np.random.default_rng(1)
    rate = learnt(10, 1)
    lost = {115, 340}
    taken = given(rate, [k + rng.uniform(-0.2, 0.2) for k in range(20, 600) if k not in lost])
    slots = taken[0] + 10 * np.arange(len(taken))
    # Half a publisher's period and its jitter, one more period where the sample itself was lost.
    assert np.abs(taken - slots).max() < 2.1
    assert rate.lost == 2


@pytest.mark.parametrize(("publisher_ms", "rule"), [(2, "less than"), (0.4, "no multiple of")])
def test_another_rate_is_given_on_whole_and_reported(publisher_ms, rule):
    rate = learnt(1, publisher_ms)
    times = [k * publisher_ms for k in range(21, 41)]
    assert given(rate, times) == times
    assert f"{1000 / publisher_ms:.4g} samples a second are {rule} the bundle's 1000" in rate.problem


def test_a_rate_that_changes_is_learnt_again():
    rate = learnt(10, 1)
    start = given(rate, [20 + k for k in range(100)])[-1] + 100
    assert rate.factor == 10
    given(rate, [start + 2 * k for k in range(60)])
    assert rate.factor == 5


def state(names, **other):
    numbers = [float(k) for k in range(len(names))]
    return JointState(name=list(names), **{"position": numbers, "velocity": numbers, "effort": numbers, **other})


def test_joints_come_in_the_arms_order_whatever_the_message_has():
    arm = ArmJoints(("a", "b", "c"))
    for names in ("abc", "cab", "xcybaz", "bbac"):
        q, dq, tau = arm.pick(state(names)) if arm.is_here(state(names)) else pytest.fail(names)
        assert [names[int(k)] for k in q] == ["a", "b", "c"]
        assert (q == dq).all() and (q == tau).all()


def test_missing_joints_and_empty_or_short_fields_are_named():
    arm = ArmJoints(("a", "b", "c"))
    assert arm.missing(state("xb")) == "no a, c among its joints x, b" and not arm.is_here(state("xb"))
    assert arm.missing(state("")) == "no a, b, c among its joints (none)"
    for field in ("position", "velocity", "effort"):
        assert arm.pick(state("abc", **{field: []})).startswith(f"{field} is empty")
        assert arm.pick(state("abc", **{field: [1.0]})) == f"{field} has 1 values for 3 names"


def test_the_first_publisher_is_followed_until_it_is_silent():
    followed = Followed()
    assert not followed.is_another(7, 0) and followed.take(7, 0)
    assert followed.is_another(8, 1) and not followed.is_another(7, 2)
    assert not followed.take(7, 2)
    assert followed.is_another(8, 2 + TAKEOVER_NS)
    assert not followed.is_another(8, 3 + TAKEOVER_NS) and followed.take(8, 3 + TAKEOVER_NS)
    assert followed.is_another(7, 4 + TAKEOVER_NS)


def test_a_condition_is_reported_when_it_begins_and_stands_while_it_is_seen():
    conditions = Conditions()
    conditions.report("rate", "slow", 0)
    conditions.report("rate", "slower", HOLD_NS)
    assert conditions.unreported() == ["slow"] and conditions.unreported() == []
    assert conditions.standing(2 * HOLD_NS) == ["slower"]
    assert conditions.standing(2 * HOLD_NS + 1) == []
    conditions.report("rate", "slow", 2 * HOLD_NS + 1)
    assert conditions.unreported() == ["slow"]
