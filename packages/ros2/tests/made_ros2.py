"""ROS 2 on the loopback interface, in a domain of its own; and a peer that knows nothing of tauext's node."""

import os
import random
import threading
import time
from collections.abc import Callable
from contextlib import contextmanager

URI = (
    "<CycloneDDS><Domain><General><Interfaces><NetworkInterface name='lo'/></Interfaces>"
    "<AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto</ParticipantIndex>"
    "<MaxAutoParticipantIndex>60</MaxAutoParticipantIndex><SPDPInterval>200ms</SPDPInterval>"
    "<Peers><Peer address='127.0.0.1'/></Peers></Discovery></Domain></CycloneDDS>"
)
DOMAIN = random.SystemRandom().randint(1, 200)
os.environ["CYCLONEDDS_URI"] = URI
for name in ("ROS_DOMAIN_ID", "ROS_DISTRO"):
    os.environ.pop(name, None)
PATIENCE_S = 10.0
"""For what must happen; none of the tests waits so long for what must not."""


def until(condition: Callable[[], object], what: str):
    """The first true value of condition(); fails after a while, naming what was waited for."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        if value := condition():
            return value
        time.sleep(0.002)
    raise AssertionError(f"waited {PATIENCE_S} s for {what}")


@contextmanager
def running(loop):
    """The loop of a monitor, in a thread of its own."""
    thread = threading.Thread(target=loop.run)
    thread.start()
    try:
        yield
    finally:
        loop.stop("test")
        thread.join()


def own_space(request) -> str:
    """One for each test, so that no test meets the publishers of another."""
    return "/" + "".join(c if c.isalnum() else "_" for c in request.node.name)


def reading(peer, topic, of, lasting="volatile"):
    """A reader that has met its writer."""
    reader = peer.inbox(topic, of, "reliable", lasting, 64).reader
    until(reader.get_matched_publications, f"a writer of {topic}")
    return reader


def next_of(reader):
    (message,) = until(lambda: [m for m in reader.take(1) if m.sample_info.valid_data], "a message")
    return message


class Robot:
    """Publishes joint states as a driver does; each of its messages is one step later than the last."""

    def __init__(self, settings, joints=("a", "b"), step_ns=1_000_000, reliability="reliable"):
        from tauext_ros2.messages import JointState
        from tauext_ros2.node import Node

        self.node = Node(settings)
        self.writer = self.node.writer(settings.topic, JointState, reliability, "volatile", 1000)
        self.joints, self.step_ns, self.stamp_ns, self.sent = list(joints), step_ns, 10**18, 0

    def send(self, samples=1, **other):
        """Values count up from the first message on: position k, velocity -k, effort 10 k plus the joint's index.

        other: fields of the message in place of these; stamp_ns: in place of the next one.
        """
        from tauext_ros2.messages import Header, JointState, Time

        for _ in range(samples):
            self.stamp_ns = other.get("stamp_ns", self.stamp_ns + self.step_ns)
            numbers = range(len(other.get("name", self.joints)))
            message = JointState(
                Header(Time.of_ns(self.stamp_ns)),
                list(self.joints),
                [float(self.sent)] * len(numbers),
                [-float(self.sent)] * len(numbers),
                [10.0 * self.sent + j for j in numbers],
            )
            for field in ("name", "position", "velocity", "effort"):
                setattr(message, field, other.get(field, getattr(message, field)))
            self.writer.write(message)
            self.sent += 1

    def meets(self, count=1):
        """Wait until so many subscribers are there."""
        until(lambda: len(self.writer.get_matched_subscriptions()) == count, f"{count} subscribers")

    def dies(self):
        self.writer = None
        self.node.leave()
