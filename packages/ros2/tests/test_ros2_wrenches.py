"""Forces at frames on ROS 2 topics, read by a peer, against what the core says of the same sample."""

import time
from pathlib import Path

import numpy as np
import pytest
from made_ros2 import DOMAIN, next_of, own_space, reading

pytest.importorskip("cyclonedds")

from tauext_ros2 import connect
from tauext_ros2.messages import Float64MultiArray, WrenchStamped
from tauext_ros2.node import Node
from tauext_ros2.publisher import Wrenches
from tauext_ros2.settings import Ros2Settings

from tauext import _core
from tauext.errors import ConfigError
from tauext.monitor.sink import Verdict
from tauext.monitor.source import Block, Sample

JOINTS = ("shoulder", "elbow")
Q, DQ, TAU, SIGMA = [0.3, 0.8], [0.2, -0.1], [5.0, -2.0], [0.4, 0.2]
LOAD, CONTACT_SIGMA = [0.5, 0.0], [0.9, 0.2]


@pytest.fixture(scope="module")
def bundle():
    """Its arm has two joints, and a frame at the tip whose name no topic may have."""
    made = _core.Bundle.load(str(Path(__file__).parents[3] / "tests" / "golden" / "format-1-prior.tauext"))
    settings = made.wrench_settings
    settings.frames = [_core.WrenchFrame("tip/1", 1, [0, -1, 0, 1, 0, 0, 0, 0, 1], [0.3, 0.0, 0.1])]
    made.wrench_settings = settings
    return made


def said_of(tau=TAU):
    row = {"tau_ext": tau, "load_nm": LOAD, "sigma_nm": SIGMA, "contact_sigma_nm": CONTACT_SIGMA, "margin_nm": SIGMA}
    arrays = {name: np.array([values]) for name, values in row.items()}
    return arrays | {"health": np.array([1]), "alarm": np.array([0]), "causes": np.array([0])}


def verdict(tau=TAU, sample=True):
    made = Block.of([Sample(0, np.array(Q), np.array(DQ), np.zeros(2), time.monotonic_ns())]) if sample else None
    return Verdict(0, np.zeros(1, np.int64), made, said_of(tau), ())


@pytest.fixture
def talking(request, bundle):
    space = own_space(request)
    settings = Ros2Settings(namespace=space, domain=DOMAIN, wrench_frames=("elbow", "tip/1"))
    source, publisher = connect(settings, bundle)
    publisher.open(JOINTS, None)
    peer = Node(Ros2Settings(domain=DOMAIN, node="peer", namespace=space + "_peer"))

    yield source, publisher, lambda name, of: reading(peer, f"{space}/{name}", of)
    publisher.close()


def numbers(vector):
    return [vector.x, vector.y, vector.z]


def test_a_wrench_is_that_of_the_core_along_the_frame_s_own_axes_with_its_covariance(talking, bundle):
    source, publisher, reading = talking
    wrenches, covariances = (
        reading("wrench/tip_1", WrenchStamped),
        reading("wrench/tip_1/covariance", Float64MultiArray),
    )
    source._stamps_ns[0] = 5 * 10**18 // 3
    publisher.verdict(verdict())
    told, with_doubt = next_of(wrenches), next_of(covariances)
    left = [torque - load for torque, load in zip(TAU, LOAD, strict=True)]
    rows = [np.array([values]) for values in (Q, left, SIGMA)]
    contact = np.array([CONTACT_SIGMA])
    own = _core.WrenchAxes.frame
    wanted = _core.WrenchModel(bundle).wrenches("tip/1", *rows, None, own, contact, np.array([DQ]))
    assert numbers(told.wrench.force) == wanted["force"][0].tolist()
    assert numbers(told.wrench.torque) == wanted["moment"][0].tolist()
    assert (told.header.frame_id, told.header.stamp.ns) == ("tip/1", 5 * 10**18 // 3)
    assert with_doubt.data == wanted["covariance"][0].ravel().tolist()
    sizes = [(dim.size, dim.stride) for dim in with_doubt.layout.dim]
    assert sizes == [(6, 36), (6, 6)] and with_doubt.layout.dim[0].label.split()[3] == "torque.x"


def test_nothing_is_reported_of_a_sample_that_is_missing_or_not_known(talking):
    _, publisher, reading = talking
    reader = reading("wrench/elbow", WrenchStamped)
    publisher.verdict(verdict([np.nan, np.nan]))
    publisher.verdict(verdict(sample=False))
    publisher.verdict(verdict([1.0, 2.0]))
    only = next_of(reader)
    assert np.isfinite(numbers(only.wrench.force)).all() and only.header.frame_id == "elbow"
    assert not reader.take(8)


def test_forces_begin_with_the_first_bundle(bundle, talking):
    wrenches = Wrenches(("elbow",), None)
    sent = []
    wrenches._writers = {"elbow": (None, None)}
    wrenches.publish(verdict([1.0, 2.0]), [0], lambda *one: sent.append(one))
    assert not sent and wrenches.follow(bundle) == ""
    wrenches.publish(verdict([1.0, 2.0]), [0], lambda *one: sent.append(one))
    assert len(sent) == 2
    assert "must be one of" in Wrenches(("tool9",), None).follow(bundle)


def test_what_cannot_be_reported_is_refused_at_the_start_in_one_line(bundle):
    def start(*frames, of=bundle):
        connect(Ros2Settings(domain=DOMAIN, wrench_frames=frames), of)

    with pytest.raises(ConfigError, match=r"wrench_frames 'tool0' must be one of shoulder, elbow.*tip/1$"):
        start("elbow", "tool0")
    with pytest.raises(ConfigError, match="two frames have the same topic name"):
        start("tip/1", "tip_1")
    empty = _core.Bundle.from_bytes(bundle.to_bytes())
    links = empty.links
    for link in links:
        link.mass = 0.0
    empty.links = links
    with pytest.raises(ConfigError, match="no force can be estimated, the bundle has no model"):
        start("elbow", of=empty)


class Loaded:
    """A bundle whose tool is at the load frame, and its monitor with a sample."""

    def __init__(self, bundle):
        self.bundle = _core.Bundle.from_bytes(bundle.to_bytes())
        load = self.bundle.load_settings
        load.frame, load.link, load.translation = "tool0", 1, [0.2, 0.0, 0.0]
        self.bundle.load_settings = load
        self.monitor = _core.Monitor(self.bundle)
        self.t_ns = 0

    def runs(self, samples=1500, tau=(0.0, 0.0)):
        """At rest, but for the last count of the encoders."""
        for k in range(samples):
            self.t_ns += self.bundle.observer.sample_period_ns
            q = np.array(Q) + 1e-6 * (k % 2)
            self.monitor.step(self.t_ns, q, np.zeros(2), np.array(tau))


def test_the_tool_force_is_that_of_the_monitor_at_the_load_frame_then_at_the_declared_contact(talking, bundle):
    source, publisher, reading = talking
    arm = Loaded(bundle)
    publisher.follow(arm.bundle, arm.monitor)
    forces, covariances = reading("tool_force", WrenchStamped), reading("tool_force/covariance", Float64MultiArray)
    source._stamps_ns[0] = 10**18
    publisher.verdict(verdict())  # while it warms up
    arm.runs()
    for frame, declared in (("tool0", None), ("elbow", _core.DeclaredContact(frame="elbow", at_most_n=20.0))):
        if declared is not None:
            arm.monitor.expect_contact(declared)
            arm.runs(10)
        publisher.verdict(verdict())
        told, errors = next_of(forces), next_of(covariances)
        wanted = arm.monitor.tool_force(_core.WrenchAxes.frame).wrench
        assert wanted.known and np.abs(wanted.force).max() > 1
        assert (told.header.frame_id, told.header.stamp.ns) == (frame, 10**18)
        assert (numbers(told.wrench.force), numbers(told.wrench.torque)) == (wanted.force, wanted.moment)
        assert errors.data == wanted.covariance.ravel().tolist() and errors.layout.dim[1].size == len(wanted.covariance)
