"""What is published, and what others may ask, seen by a peer with readers of its own; the child is another process."""

import dataclasses
import json
import os
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest
from made_ros2 import DOMAIN, next_of, own_space, reading, until

pytest.importorskip("cyclonedds")

from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
)
from cyclonedds.core import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from tauext_ros2 import connect
from tauext_ros2.messages import (
    ERROR,
    GRAPH_TYPES,
    OK,
    STALE,
    TYPE_HASHES,
    WARN,
    Bool,
    DiagnosticArray,
    Inertia,
    JointState,
    String,
    Vector3,
)
from tauext_ros2.node import GRAPH_TOPIC, Node, quality
from tauext_ros2.settings import Ros2Settings

from tauext._core import DeclaredContact, Load
from tauext.errors import ConfigError
from tauext.monitor.changes import HealthChange
from tauext.monitor.phases import Announced
from tauext.monitor.sink import LoopReport, Publisher, ReactionEvent, Verdict
from tauext.monitor.source import Block, Sample, SourceCounts

JOINTS = ("shoulder", "elbow")
WARMING_UP, FINE, HEALTH_STALE, FAULT = range(4)
NONE, CONTACT, COLLISION = range(3)
GAP = 1 << 5
"""The core's bit, of which a test below asks the name."""


class Loop:
    """A Control that writes down what it was asked."""

    def __init__(self):
        self.asked = []

    def use_profile(self, name, by):
        if name != "careful":
            raise ConfigError(f"no profile {name!r}; there is careful")
        self.asked.append((name, by))

    def acknowledge(self, by):
        self.asked.append(("acknowledge", by))

    def resume(self, by):
        self.asked.append(("resume", by))

    def set_load(self, load, by, ago_s=None):
        if load.mass > 5:
            raise ConfigError(f"{load.mass:g} kg are too heavy")
        self.asked.append((load, by))

    def answer(self, what, by, alarm=None):
        if alarm == 9:
            raise ConfigError("there was no alarm 9 yet")
        self.asked.append((what, alarm))

    def declare(self, announced, by):
        if announced.name == "insertion":
            raise ConfigError("phase 'insertion' must be one of sanding")
        self.asked.append((announced, by))

    def stop(self, by):
        self.asked.append(("stop", by))


def verdict(
    tau_ext=(1.0, -2.0),
    health=FINE,
    alarm=NONE,
    causes=0,
    joint=1,
    changed=True,
    sample=True,
    drift=False,
    unfamiliar=0.0,
):
    t_ns = time.time_ns()
    said = {
        "tau_ext": np.array([tau_ext]),
        "limit_nm": np.array([[5.0, 6.0]]),
        "contact_limit_nm": np.array([[2.5, 3.0]]),
        "sigma_nm": np.array([[0.25, np.nan]]),
        "contact_sigma_nm": np.array([[0.5, np.nan]]),
        "margin_nm": np.array([[5.0, 6.0]]) - np.abs([tau_ext]),
        **dict.fromkeys(("residual", "uncertainty", "load_nm", "declared_nm"), np.zeros((1, 2))),
        "health": np.array([health]),
        "alarm": np.array([alarm]),
        "alarm_joint": np.array([joint]),
        "causes": np.array([causes]),
        **dict.fromkeys(("declared", "declared_size"), np.zeros(1, int)),
        "drift_saturated": np.array([[False, drift]]),
        "unfamiliar": np.array([unfamiliar]),
        "unseen": np.array([3]),
        "unseen_joint": np.array([0]),
        "unseen_other": np.array([1]),
    }
    two = np.zeros(2)
    made = Block.of([Sample(t_ns, two, two, two, time.monotonic_ns())]) if sample else None
    changes = (HealthChange(0, t_ns, health, health, causes, -1),) if changed else ()
    return Verdict(0, np.array([t_ns]), made, said, changes)


def report(rate_hz=1000.0, profile="", **counts):
    return LoopReport(time.monotonic_ns(), 10, 3, rate_hz, SourceCounts(**counts), 100.0, 250.0, 900.0, profile)


@pytest.fixture
def space(request):
    return own_space(request)


@pytest.fixture
def settings(space):
    return Ros2Settings(namespace=space, domain=DOMAIN)


@pytest.fixture
def talking(settings):
    """An opened publisher and the loop it asks."""
    _, publisher = connect(settings)
    loop = Loop()
    publisher.open(JOINTS, loop)
    yield publisher, loop
    publisher.close()


@pytest.fixture
def peer(settings):
    return Node(Ros2Settings(domain=DOMAIN, node="peer", namespace=settings.namespace + "_peer"))


def statuses(reader):
    """By name, of the newest diagnostics."""
    newest = until(lambda: reader.take(64), "diagnostics")[-1]
    return {status.name: status for status in newest.status}


def test_it_is_a_publisher(talking):
    assert isinstance(talking[0], Publisher)


def test_torques_bear_stamp_and_names_and_nothing_but_effort(talking, peer, space):
    publisher, _ = talking
    reader = reading(peer, f"{space}/external_torque", JointState)
    first = verdict((1.5, float("nan")))
    publisher._source._stamps_ns[int(first.t_ns[0])] = 5 * 10**18 // 3
    publisher.verdict(first)
    publisher.verdict(verdict(sample=False))
    publisher.verdict(verdict((2.5, 0.0)))
    first, second = next_of(reader), next_of(reader)
    assert first.name == list(JOINTS) and first.position == [] and first.velocity == []
    assert first.effort[0] == 1.5 and np.isnan(first.effort[1]) and second.effort == [2.5, 0.0]
    assert first.header.stamp.ns == 5 * 10**18 // 3


def test_alarms_are_latched_and_reported_once(talking, peer, space):
    publisher, _ = talking
    early = {name: reading(peer, f"{space}/{name}", Bool, "transient-local") for name in ("contact", "collision")}
    assert [next_of(early[name]).data for name in early] == [False, False]
    for alarm in (CONTACT, CONTACT, COLLISION, COLLISION, NONE):
        publisher.verdict(verdict(alarm=alarm))
    assert [next_of(early["contact"]).data for _ in range(2)] == [True, False]
    assert [next_of(early["collision"]).data for _ in range(2)] == [True, False]
    publisher.verdict(verdict(alarm=COLLISION))
    late = reading(peer, f"{space}/collision", Bool, "transient-local")
    assert next_of(late).data is True
    assert [m.data for m in early["collision"].take(8)] == [True] and late.take(8) == []


@pytest.mark.parametrize(
    ("said", "level", "message"),
    [
        (verdict(), OK, "ok"),
        (verdict(health=WARMING_UP), WARN, "warming up"),
        (verdict(health=WARMING_UP, causes=GAP), WARN, "warming up: gap"),
        (verdict(alarm=CONTACT), WARN, "contact on elbow"),
        (verdict(alarm=COLLISION, joint=0), ERROR, "collision on shoulder"),
        (verdict(health=FAULT, causes=GAP), ERROR, "fault: gap"),
        (verdict(health=HEALTH_STALE, sample=False), STALE, "stale"),
        (verdict(health=FAULT, causes=GAP, sample=False), STALE, "fault: gap"),
        (verdict(alarm=COLLISION, health=FAULT, causes=GAP, sample=False), ERROR, "collision on elbow; fault: gap"),
        (verdict(drift=True), WARN, "adaptive bias at its bound on elbow: record and retrain"),
        (verdict(unfamiliar=0.4), OK, "ok"),
        (verdict(unfamiliar=0.5), WARN, "training never saw such motion: shoulder and elbow together"),
    ],
)
def test_diagnostics_of_the_arm(talking, peer, space, said, level, message):
    publisher, _ = talking
    reader = reading(peer, f"{space}/diagnostics", DiagnosticArray)
    publisher._diagnosed_ns = 0
    publisher.verdict(said)
    arm = statuses(reader)["tauext: arm"]
    assert (arm.level, arm.message, arm.hardware_id) == (level, message, "/joint_states")
    values = {pair.key: pair.value for pair in arm.values}
    assert (
        values["margin_nm elbow"] == "4" and values["limit_nm shoulder"] == "5" and values["tau_ext_nm elbow"] == "-2"
    )
    assert (values["contact_limit_nm shoulder"], values["contact_limit_nm elbow"]) == ("2.5", "3")
    assert (values["sigma_nm shoulder"], values["sigma_nm elbow"]) == ("0.25", "-")
    assert (values["contact_sigma_nm shoulder"], values["contact_sigma_nm elbow"]) == ("0.5", "-")
    assert ("cause: gap" in values) == ("gap" in message)


def test_diagnostics_of_the_input(talking, peer, space):
    publisher, _ = talking
    reader = reading(peer, f"{space}/diagnostics", DiagnosticArray)

    def told(*reports):
        for one in reports:
            publisher.every_second(one)
        status = statuses(reader)["tauext: input"]
        return status.level, status.message, {pair.key: pair.value for pair in status.values}

    level, message, values = told(report(profile="careful", received=10, refused=2))
    assert (level, message) == (OK, "ok")
    assert values == {
        "rate_hz": "1000",
        "samples": "10",
        "received": "10",
        "lost": "0",
        "late": "3",
        "refused": "2",
        "tick_p50_us": "100",
        "tick_p99_us": "250",
        "tick_max_us": "900",
        "profile": "careful",
    }
    assert told(report(lost=3, overrun=1))[:2] == (WARN, "4 samples lost in the last second")
    assert told(report(lost=3, overrun=1))[:2] == (OK, "ok")
    assert told(report(rate_hz=0.0, lost=3, overrun=1))[:2] == (STALE, "no sample in the last second")
    publisher._conditions.report("rate", "/joint_states: 500 is less than 1000", time.monotonic_ns())
    assert told(report(lost=3, overrun=1))[:2] == (WARN, "/joint_states: 500 is less than 1000")


def test_changes_that_come_fast_share_one_message(talking, peer, space):
    publisher, _ = talking
    reader = reading(peer, f"{space}/diagnostics", DiagnosticArray)
    publisher._diagnosed_ns = time.monotonic_ns() + 10**12
    for k in range(100):
        publisher.verdict(verdict(health=(FINE, HEALTH_STALE)[k % 2]))
    assert reader.take(64) == []
    publisher._diagnosed_ns = 0
    publisher.verdict(verdict(alarm=CONTACT, changed=False))
    assert statuses(reader)["tauext: arm"].message == "contact on elbow"


def test_diagnostics_go_where_aggregators_listen(settings, peer):
    _, publisher = connect(dataclasses.replace(settings, diagnostics="/diagnostics"))
    publisher.open(JOINTS, Loop())
    reader = reading(peer, "/diagnostics", DiagnosticArray)
    publisher.every_second(report())
    assert set(statuses(reader)) == {"tauext: arm", "tauext: input"}
    publisher.close()


def test_others_ask_for_profiles_acknowledge_and_resume(talking, peer, space):
    publisher, loop = talking
    profile = peer.writer(f"{space}/profile", String, "reliable", "volatile", 8)
    acknowledge, resume = (
        peer.writer(f"{space}/{n}", Bool, "reliable", "volatile", 8) for n in ("acknowledge", "resume")
    )
    until(lambda: all(w.get_matched_subscriptions() for w in (profile, acknowledge, resume)), "the readers")
    for name in ("wild", "careful"):
        profile.write(String(name))
    until(lambda: loop.asked, "the profile")
    acknowledge.write(Bool(False))
    acknowledge.write(Bool(True))
    until(lambda: len(loop.asked) == 2, "the acknowledgement")
    resume.write(Bool(False))
    resume.write(Bool(True))
    until(lambda: len(loop.asked) == 3, "the resumption")
    asked = [("careful", "profile"), ("acknowledge", "acknowledge"), ("resume", "resume")]
    assert loop.asked == [(what, f"ros2 {space}/{topic}") for what, topic in asked]
    assert publisher._conditions.unreported() == [f"ros2 {space}/profile: no profile 'wild'; there is careful"]


def test_others_answer_what_an_alarm_was(talking, peer, space):
    publisher, loop = talking
    answer = peer.writer(f"{space}/answer", String, "reliable", "volatile", 8)
    until(answer.get_matched_subscriptions, "the reader")
    for text in ("touched", "nothing 17", "stop", "touched x", "nothing 9", " touched 3 "):
        answer.write(String(text))
    until(lambda: len(loop.asked) == 3, "the answers")
    assert loop.asked == [("touched", None), ("nothing", 17), ("touched", 3)]
    refused = publisher._conditions.unreported()
    assert any("must be `touched` or `nothing`" in one for one in refused)


def test_others_say_what_the_arm_carries(talking, peer, space):
    publisher, loop = talking
    load = peer.writer(f"{space}/load", Inertia, "reliable", "volatile", 8)
    until(load.get_matched_subscriptions, "the reader")
    load.write(Inertia(m=6.0))
    load.write(Inertia(2.0, Vector3(0.1, 0.2, 0.3), ixx=1.0, ixy=4.0, ixz=5.0, iyy=2.0, iyz=6.0, izz=3.0))
    load.write(Inertia())
    until(lambda: len(loop.asked) == 2, "the loads")
    by = f"ros2 {space}/load"
    assert loop.asked == [(Load(2.0, [0.1, 0.2, 0.3], [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), by), (Load(), by)]
    assert publisher._conditions.unreported() == [f"{by}: 6 kg are too heavy"]


def test_others_declare_contacts_by_the_text_of_the_control_line(talking, peer, space):
    publisher, loop = talking
    contact = peer.writer(f"{space}/declare_contact", String, "reliable", "volatile", 8)
    until(contact.get_matched_subscriptions, "the reader")
    text = "frame=elbow axis=0,0,-1 half_angle_deg=30 at_most_n=40 seconds=10"
    for one in (text, "sanding seconds=5", "insertion seconds=5", "frame=elbow at_most=40 seconds=1", "", "none"):
        contact.write(String(one))
    until(lambda: len(loop.asked) == 3, "the contacts")
    declared = DeclaredContact(frame="elbow", axis=[0.0, 0.0, -1.0], half_angle_deg=30, at_most_n=40)
    wanted = [Announced("", declared, 10.0), Announced("sanding", None, 5.0), Announced("", ends=True)]
    assert loop.asked == [(one, f"ros2 {space}/declare_contact") for one in wanted]
    until(lambda: publisher._conditions.standing(time.monotonic_ns()), "the refusals")
    (refused,) = publisher._conditions.standing(time.monotonic_ns())  # the last one of the topic
    assert "contact '' cannot be read; it is" in refused


def test_events_are_json(talking, peer, space):
    publisher, _ = talking
    reader = reading(peer, f"{space}/event", String)
    publisher.publish_event(ReactionEvent("collision", "elbow", 7, 8, {"alarm": "collision"}, 2))
    assert json.loads(next_of(reader).data) == {
        "event": "collision",
        "joint": "elbow",
        "t_ns": 7,
        "merged": 2,
        "alarm": "collision",
    }


@pytest.mark.parametrize(("distro", "size"), [("jazzy", 16), ("humble", 24)])
def test_the_graph_shows_one_node_with_its_readers_and_writers(settings, peer, distro, size):
    """As `ros2 node list` finds it: user data of the participant, and the message of its nodes and their endpoints."""
    source, publisher = connect(dataclasses.replace(settings, distro=distro))
    publisher.open(JOINTS, Loop())
    info = GRAPH_TYPES[size][2]
    reader = DataReader(
        peer.participant, Topic(peer.participant, GRAPH_TOPIC, info), Qos(*quality("reliable", "transient-local", 9))
    )
    gid = source._node.participant.guid.bytes

    def announced():
        return [m for m in reader.take(64) if m.sample_info.valid_data and bytes(m.gid.data)[:16] == gid]

    (node,) = until(announced, "the node")[-1].node_entities_info_seq
    assert (node.node_namespace, node.node_name) == (settings.namespace, "tauext")
    assert len(node.reader_gid_seq) == 6 and len(node.writer_gid_seq) == 7
    assert publisher._torque.guid.bytes.ljust(size, b"\0") in [bytes(one.data) for one in node.writer_gid_seq]
    there = BuiltinDataReader(peer.participant, BuiltinTopicDcpsParticipant).take(64)
    assert b"enclave=/;" in [one.qos[Policy.Userdata].data for one in there if one.key.bytes == gid]
    ends = BuiltinDataReader(peer.participant, BuiltinTopicDcpsPublication).take(500)
    (hashed,) = [end.qos[Policy.Userdata].data for end in ends if end.key.bytes == publisher._torque.guid.bytes]
    assert hashed == f"typehash=RIHS01_{TYPE_HASHES[JointState]};".encode()
    publisher.close()


CHILD = """
    import made_ros2, sys, time
    from tauext_ros2.settings import Ros2Settings
    from tauext_ros2.messages import Bool, JointState
    from tauext_ros2.node import Node
    space = sys.argv[1]
    node = Node(Ros2Settings(domain=int(sys.argv[2]), node="child", namespace=space))
    torques = node.inbox(space + "/external_torque", JointState, "reliable", "volatile", 64).reader
    collision = node.inbox(space + "/collision", Bool, "reliable", "transient-local", 1).reader
    made_ros2.until(torques.get_matched_publications, "a writer")
    print("met", flush=True)
    for reader in (collision, torques):
        (message,) = made_ros2.until(lambda: reader.take(1), "a message")
        print(repr(message), message.serialize().hex(), flush=True)
"""


def test_another_process_gets_the_same_bytes(talking, space):
    publisher, _ = talking
    publisher.verdict(verdict(alarm=COLLISION))
    child = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(CHILD), space, str(DOMAIN)],
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([os.path.dirname(__file__), *sys.path])},
    )
    try:
        assert child.stdout.readline() == "met\n"
        until(publisher._torque.get_matched_subscriptions, "the child")
        publisher.verdict(verdict((0.25, -7.0), alarm=COLLISION, changed=False))
        assert child.stdout.readline() == f"{Bool(True)!r} {Bool(True).serialize().hex()}\n"
        assert child.stdout.readline().split()[-1] == publisher._message.serialize().hex()
        assert child.wait(10) == 0
    finally:
        child.kill()
