"""Joint states over DDS, as samples: each way in which a robot's topic is not what the monitor needs."""

import threading
import time

import numpy as np
import pytest
from made_ros2 import DOMAIN, Robot, own_space, until

pytest.importorskip("cyclonedds")

from cyclonedds._clayer import ddspy_write
from tauext_ros2 import connect
from tauext_ros2 import source as ros2_source
from tauext_ros2.messages import JointState, Temperature
from tauext_ros2.samples import LEARNT_FROM
from tauext_ros2.settings import Ros2Settings

from tauext.errors import ConfigError
from tauext.monitor.source import SourceSettings
from tauext.robot.write import write_placeholder
from tauext.sources.open import open_source

MS = 1_000_000


@pytest.fixture
def topic(request):
    return own_space(request)


@pytest.fixture
def listen(topic):
    """Opens a source on the test's topic."""
    opened = []

    def listen(period_ms=1, timing="", joints=("a", "b"), **settings):
        made, _ = connect(Ros2Settings(topic=topic, domain=DOMAIN, **settings))
        made.open(SourceSettings(joints, round(period_ms * MS), torque_timing=timing))
        opened.append(made)
        return made

    yield listen
    for made in opened:
        made.close()


@pytest.fixture
def robot(topic):
    return lambda **how: Robot(Ros2Settings(topic=topic, domain=DOMAIN, node="robot"), **how)


@pytest.fixture
def met(listen, robot):
    """A source and a robot that has met it."""
    live, arm = listen(), robot()
    arm.meets()
    return live, arm


@pytest.fixture
def learnt(met):
    """The same, once the rate is known: samples come at once."""
    live, arm = met
    arm.send(LEARNT_FROM)
    assert len(received(live)) == 1
    return met


def received(live, timeout_s=0.05):
    """All samples that are there."""
    samples = []
    while (sample := live.next_sample(timeout_s)) is not None:
        samples.append(sample)
    return samples


def test_samples_have_the_arms_order_the_stamps_and_every_number(listen, robot):
    live, arm = listen(), robot(joints=("b", "gripper", "a"))
    arm.meets()
    arm.send(LEARNT_FROM + 30)
    samples = received(live)
    assert len(samples) == 31
    k = np.arange(LEARNT_FROM - 1, LEARNT_FROM + 30)
    assert [sample.t_ns for sample in samples] == (10**18 + (k + 1) * MS).tolist()
    np.testing.assert_array_equal([sample.q for sample in samples], np.stack([k, k], axis=1))
    np.testing.assert_array_equal([sample.dq for sample in samples], np.stack([-k, -k], axis=1))
    np.testing.assert_array_equal([sample.tau for sample in samples], np.stack([10 * k + 2, 10 * k], axis=1))
    assert all(0 <= time.monotonic_ns() - sample.received_ns < 60 * 10**9 for sample in samples)
    assert live.stamp_ns(samples[-1].t_ns) == samples[-1].t_ns
    assert (live.counts.received, live.counts.lost, live.counts.refused) == (LEARNT_FROM + 30, 0, 0)
    assert live.notes() == []


def test_the_latest_temperature_of_each_joint_holds(listen, robot, topic):
    topics = tuple(f"{topic}/{joint}/temperature" for joint in "ab")
    live, arm = listen(temperatures=topics), robot()
    told = [arm.node.writer(name, Temperature, "reliable", "volatile", 10) for name in topics]
    arm.meets()
    for writer in told:
        until(lambda writer=writer: writer.get_matched_subscriptions(), "a subscriber")
    arm.send(LEARNT_FROM)
    assert np.isnan(received(live)[0].temperature).all()
    told[1].write(Temperature(temperature=20.0))
    told[1].write(Temperature(temperature=41.5))
    told[1].write(Temperature(temperature=float("nan")))
    until(lambda: live._temperatures.latest()[1] == 41.5, "the temperature")
    arm.send(3)
    for sample in received(live):
        np.testing.assert_array_equal(sample.temperature, [np.nan, 41.5])
    with pytest.raises(ConfigError, match="1 topics for 2 joints"):
        listen(temperatures=topics[:1])
    with pytest.raises(ConfigError, match="'a b' must begin with /"):
        Ros2Settings(temperatures=("a b",))


def test_joints_under_other_names(listen, robot):
    live, arm = listen(names=("joint_2", "joint_1")), robot(joints=("joint_1", "joint_2"))
    arm.meets()
    arm.send(LEARNT_FROM)
    assert received(live)[0].tau.tolist() == [10 * 20 + 1, 10 * 20]


def test_missing_joints_and_empty_fields_are_refused_and_named(met, topic):
    live, arm = met
    arm.send(3, name=["a", "x"])
    arm.send(2, velocity=[])
    arm.send(2, effort=[1.0])
    assert received(live) == []
    assert live.counts.refused == live.counts.received == 7
    assert live.notes() == [
        f"{topic}: a message has no b among its joints a, x",
        f"{topic}: velocity is empty: position, velocity and effort are needed",
    ]
    standing = live.conditions.standing(time.monotonic_ns())
    assert f"{topic}: effort has 1 values for 2 names" in standing


def test_nan_goes_to_the_monitor_and_is_named(learnt, topic):
    live, arm = learnt
    arm.send(effort=[float("nan"), 2.0])
    assert np.isnan(received(live)[-1].tau).tolist() == [True, False]
    assert live.notes() == [f"{topic}: effort of a is not a number"]


def test_zero_stamps_are_replaced_by_times_of_publication(met, topic):
    live, arm = met
    before = time.time_ns()
    for _ in range(LEARNT_FROM + 5):
        arm.send(stamp_ns=0)
        time.sleep(0.001)
    samples = received(live)
    assert live.notes()[0] == f"{topic}: stamps are zero: times of publication are used"
    times = [sample.t_ns for sample in samples]
    assert times == sorted(times) and before < times[0] < times[-1] < time.time_ns()


@pytest.mark.parametrize("same", [10**6, 10], ids=["constant", "coarse"])
def test_stamps_that_are_no_clock_are_replaced_by_times_of_publication(met, topic, same):
    """All stamps are one, or ten messages have one stamp each."""
    live, arm = met
    for k in range(LEARNT_FROM + 60):
        arm.send(stamp_ns=10**18 + k // same * 10 * MS)
        time.sleep(0.001)
    samples = received(live)
    repeated = "messages with new values have the stamp of the one before: times of publication are used"
    assert f"{topic}: {repeated}" in live.notes()
    assert [sample.q[0] for sample in samples] == list(range(LEARNT_FROM + 60))[-len(samples) :] and len(samples) > 30
    assert (np.diff([sample.t_ns for sample in samples]) > 0).all()


def test_a_driver_that_repeats_its_last_message_is_not_alive(learnt, topic):
    live, arm = learnt
    frozen = {"stamp_ns": arm.stamp_ns, "position": [1.0, 2.0], "velocity": [0.0, 0.0], "effort": [0.0, 0.0]}
    arm.send(200, **frozen)
    assert received(live) == [] and live.counts.refused == 200
    assert live.notes() == [f"{topic}: two messages have the same stamp: the second is dropped"]


def test_single_messages_without_a_field_or_of_other_joints_do_not_describe_the_arm(topic, robot):
    """The first lack the effort, others are of a gripper, and in the last the torque of one joint is not a number."""
    made, _ = connect(Ros2Settings(topic=topic, domain=DOMAIN))
    arm, found = robot(joints=("a", "b")), []
    describing = threading.Thread(target=lambda: found.append(made.describe(5.0)))
    describing.start()
    arm.meets()
    nan = float("nan")
    arm.send(5, effort=[])
    for _ in range(30):
        arm.send(3)
        arm.send(name=["gripper"], position=[0.0], velocity=[0.0], effort=[0.0])
    arm.send(effort=[nan, 1.0])
    describing.join(10)
    (facts,) = found
    assert facts.settings.joints == ("a", "b")


def test_a_clock_that_is_set_back_costs_no_sample(learnt, topic):
    live, arm = learnt
    arm.stamp_ns -= 3600 * 10**9
    arm.send(10)
    times = np.array([sample.t_ns for sample in received(live)])
    assert len(times) == 10 and times[0] > 10**18 + LEARNT_FROM * MS and (np.diff(times) == MS).all()
    assert live.stamp_ns(int(times[-1])) == arm.stamp_ns
    assert live.notes() == [f"{topic}: the stamp went back by 3.6e+03 s: the time of reception is used"]


def test_torques_that_mean_averages_are_averaged_over_what_is_left_out(listen, robot):
    live, arm = listen(period_ms=10, timing="averaged"), robot()
    arm.meets()
    arm.send(60)
    first, second = received(live)[-2:]
    # Effort of the first joint is 10 k: ten samples up to the given one have a mean 45 below its own.
    assert second.tau[0] == 10 * second.q[0] - 45
    assert second.q[0] == first.q[0] + 10


def test_samples_that_a_late_reader_lost_are_counted(listen, robot):
    live, arm = listen(depth=16), robot()
    arm.meets()
    for _ in range(4):  # learnt without a loss
        arm.send(10)
        received(live, 0.01)
    arm.send(100)
    assert len(received(live)) == 16
    assert live.counts.lost == 84


def test_the_first_of_two_publishers_is_followed_and_the_second_takes_over(learnt, robot, topic):
    live, first = learnt
    second = robot()
    second.meets()
    second.stamp_ns = 5 * 10**17
    second.send(5)
    first.send(5)
    assert [sample.q[0] for sample in received(live)] == [21, 22, 23, 24, 25]
    assert live.notes() == [f"{topic}: two publishers: the first is used"]
    assert live.counts.refused == 5
    last_ns = 10**18 + first.sent * MS
    first.dies()
    time.sleep(0.55)
    second.send(LEARNT_FROM + 5)
    samples = received(live)
    assert [sample.q[0] for sample in samples] == [25, 26, 27, 28, 29, 30]
    # Half a second of reception, whatever the second's clock says.
    assert 0.5e9 < samples[0].t_ns - last_ns < 30e9
    assert f"{topic}: another publisher is used now" in live.notes()


def test_a_publisher_that_returns_is_followed_again(listen, robot, topic, monkeypatch):
    monkeypatch.setattr(ros2_source, "LOOK_NS", 10 * MS)
    live = listen()
    assert live.next_sample(0.03) is None
    assert live.notes() == [f"{topic}: no publisher of sensor_msgs/JointState in domain {DOMAIN}"]
    arm = robot()
    arm.meets()
    arm.send(LEARNT_FROM)
    assert len(received(live)) == 1
    arm.dies()
    again = robot()
    again.meets()
    time.sleep(0.55)
    again.send(LEARNT_FROM)
    assert len(received(live)) == 1 and not live.ended


def test_a_gripper_on_the_same_topic_is_no_fault(learnt, robot):
    (live, arm), gripper = learnt, robot(joints=("finger",))
    gripper.meets()
    gripper.send(10)
    arm.send()
    assert len(received(live)) == 1
    assert live.notes() == [] and live.counts.refused == 10


def test_a_message_that_cannot_be_read_is_refused_and_the_next_is_read(met, topic):
    live, arm = met
    whole = JointState(name=["elbow"]).serialize()
    assert ddspy_write(arm.writer._ref, whole.replace(b"elbow", b"elb\xfew")) == 0
    assert live.next_sample(0.05) is None
    assert live.counts.refused == 1
    assert live.notes()[0].startswith(f"{topic}: a message cannot be read (UnicodeDecodeError: ")
    arm.send(LEARNT_FROM)
    assert len(received(live)) == 1


def test_a_publisher_that_offers_too_little_is_named(listen, robot, topic, monkeypatch):
    monkeypatch.setattr(ros2_source, "LOOK_NS", 10 * MS)
    live = listen(reliability="reliable")
    robot(reliability="best-effort")
    told = until(lambda: live.next_sample(0.02) or [n for n in live.notes() if "offers" in n], "the note")
    assert told == [f"{topic}: a publisher offers less reliability or durability than requested"]


@pytest.mark.slow
def test_an_arm_describes_itself_before_a_bundle_exists(topic, robot, tmp_path):
    def described(wait_s: float, file=None, **changed):
        source, _ = open_source("ros2", {"ros2": Ros2Settings(topic=topic, domain=DOMAIN, **changed)})
        return source.describe(wait_s, file)

    with pytest.raises(ConfigError, match="no publisher of sensor_msgs/JointState in domain"):
        described(0.3)
    arm, gripper = robot(joints=("b", "a"), step_ns=4 * MS), robot(joints=("finger_joint",))
    ended, fields = threading.Event(), {}

    def drive() -> None:
        while not ended.wait(0.004):
            arm.send(**fields)
            gripper.send(4)

    thread = threading.Thread(target=drive, daemon=True)
    thread.start()
    try:
        facts = described(20.0)
        assert facts.settings == SourceSettings(("b", "a"), 4 * MS, ("N m", "N m"), "instant")
        assert facts.signal == "unknown" and "until the arm's motion shows another kind" in facts.notes[-1]
        ordered = described(20.0, write_placeholder(["a", "b", "c"], tmp_path))
        assert ordered.settings.joints == ("a", "b")
        fields["effort"] = []
        time.sleep(0.05)
        with pytest.raises(ConfigError, match="effort is empty"):
            described(0.5, names=("a", "b"))
        fields["effort"] = [float("nan"), 1.0]
        with pytest.raises(ConfigError, match="no finite position, velocity and effort of b"):
            described(0.5, names=("a", "b"))
    finally:
        ended.set()
        thread.join()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"topic": "joint_states"}, "ROS 2 topic 'joint_states' must begin with / and consist of letters"),
        ({"topic": "/a b"}, "ROS 2 topic '/a b' must begin with /"),
        ({"namespace": "/1"}, "ROS 2 namespace '/1' must begin with /"),
        ({"node": "a/b"}, "ROS 2 node 'a/b' must consist of letters"),
        ({"diagnostics": ""}, "ROS 2 diagnostics '' must consist of"),
        ({"depth": 0}, "ROS 2 depth = 0 must be >= 1"),
        ({"domain": 233}, "ROS 2 domain = 233 must lie between 0 and 232"),
        ({"names": ("a", "a")}, "ROS 2 names a, a: names must be unique"),
    ],
)
def test_bad_settings_are_named(settings, message):
    with pytest.raises(ConfigError) as refused:
        Ros2Settings(**settings)
    assert str(refused.value).startswith(message)


def test_the_environment_chooses_domain_and_format(monkeypatch):
    monkeypatch.setenv("ROS_DOMAIN_ID", "42")
    monkeypatch.setenv("ROS_DISTRO", "humble")
    assert (Ros2Settings().domain_id, Ros2Settings().gid_bytes, Ros2Settings(domain=3).domain_id) == (42, 24, 3)
    assert Ros2Settings(distro="jazzy").gid_bytes == 16
    for bad in ("x", "-1", "233"):
        monkeypatch.setenv("ROS_DOMAIN_ID", bad)
        with pytest.raises(ConfigError, match=f"ROS_DOMAIN_ID = '{bad}' must be a whole number between 0 and 232"):
            connect(Ros2Settings())
