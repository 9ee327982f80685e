"""Joint states of a ROS 2 topic as samples of the arm."""

from __future__ import annotations

import time
from collections import deque
from typing import Any

import numpy as np
from cyclonedds.core import WaitSet

from tauext.errors import ConfigError
from tauext.monitor.source import Sample, SourceCounts, SourceSettings
from tauext.sources.arm_joints import ArmJoints
from tauext.sources.conditions import Conditions
from tauext.sources.followed import Followed
from tauext.sources.messages import JointState
from tauext.sources.node import Inbox, Node
from tauext.sources.sample_rate import SampleRate
from tauext.sources.sample_time import SampleTime
from tauext.sources.temperatures import Temperatures

LOOK_NS = 500_000_000
"""After so long without a message, and as often, the publishers are looked at."""


class Ros2Source:
    """A tauext.monitor Source: reads sensor_msgs/JointState in the thread that asks for samples.

    What cannot be used is counted as refused and stands in `conditions`: messages without the arm's joints, without
    velocity or effort, of a second publisher. Stamps, rates and publishers that change are dealt with as SampleTime,
    SampleRate and Followed say. Samples that a full reader pushed out show as lost, by the gap of their stamps.
    """

    def __init__(self, node: Node, conditions: Conditions):
        self._node, self.conditions = node, conditions
        self.name = f"ros2 {node.settings.topic}"
        self.counts = SourceCounts()
        self.last_stamp_ns = 0
        """Of the last sample given, since 1970: what is said of it bears this stamp."""
        self._inbox: Inbox | None = None
        self._waitset: Any = None
        self._pending: deque[JointState] = deque()

    def open(self, settings: SourceSettings) -> None:
        """Subscribe; a publisher need not be there yet."""
        chosen = self._node.settings
        names = chosen.names or settings.joints
        if len(names) != len(settings.joints):
            raise ConfigError(
                f"ROS 2 names {', '.join(names)}: {len(names)} for the bundle's {len(settings.joints)} joints "
                f"{', '.join(settings.joints)}"
            )
        self._node.enter()
        self._looked_ns = time.monotonic_ns()
        self._joints, self._rate = ArmJoints(tuple(names)), SampleRate(settings.period_ns)
        self._time, self._followed = SampleTime(), Followed()
        self._averaged = settings.torque_timing == "averaged"
        self._torques: list[np.ndarray] = []
        self.counts = SourceCounts()
        self._unreadable = self._node.unreadable.count(chosen.topic)
        self._lost_before = 0
        self._t_ns: int | None = None
        self._inbox = self._node.inbox(chosen.topic, JointState, chosen.reliability, chosen.durability, chosen.depth)
        self._temperatures = Temperatures(self._node, len(settings.joints))
        self._waitset = WaitSet(self._node.participant)
        self._waitset.attach(self._inbox.new)
        self._node.announce()

    def next_sample(self, timeout_s: float) -> Sample | None:
        until_ns = time.monotonic_ns() + round(timeout_s * 1e9)
        while True:
            while self._pending:
                sample = self._use(self._pending.popleft())
                if sample is not None:
                    return sample
            now_ns = time.monotonic_ns()
            self._count_unreadable(now_ns)
            left_ns = until_ns - now_ns
            if self._inbox is None or (left_ns <= 0 and timeout_s > 0):
                return None
            if self._waitset.wait(max(left_ns, 0)) or timeout_s <= 0:
                self._take()
                if not self._pending and timeout_s <= 0:
                    return None
            else:
                self._look_for_publishers(time.monotonic_ns())

    @property
    def ended(self) -> bool:
        """A topic never ends, as its publisher may return."""
        return False

    def notes(self) -> list[str]:
        return self.conditions.untold()

    def close(self) -> None:
        """Unsubscribe; a node that nobody else uses ends."""
        if self._inbox is None:
            return
        inbox, self._inbox, self._waitset = self._inbox, None, None
        self._node.leave([inbox.reader, *self._temperatures.readers])
        self._pending.clear()

    def _take(self) -> None:
        received_ns, wall_ns = time.monotonic_ns(), time.time_ns()
        self._looked_ns = received_ns
        assert self._inbox is not None  # between open() and close()
        messages, damaged = self._inbox.take()
        if damaged:
            self.counts.received += 1
            self._refuse("damaged", damaged, received_ns)
        for message in messages:
            message.received_ns, message.wall_ns = received_ns, wall_ns
            self._pending.append(message)

    def _count_unreadable(self, now_ns: int) -> None:
        """Messages that the library itself dropped since the last look."""
        count = self._node.unreadable.count(self._node.settings.topic)
        if count == self._unreadable:
            return
        self.counts.received += count - self._unreadable
        self.counts.refused += count - self._unreadable
        self._unreadable = count
        self._say("unreadable", "messages come that are no JointState inside: they are counted as refused", now_ns)

    def _use(self, message: JointState) -> Sample | None:
        """The sample of a message, if it has one that the bundle's rate wants."""
        now_ns, publisher = message.received_ns, message.sample_info.publication_handle
        other = self._followed.is_another(publisher, now_ns)
        self.counts.received += 1
        if not self._joints.is_here(message):  # no fault of another's, as a gripper often shares the topic
            self._refuse("joints", None if other else f"a message has {self._joints.missing(message)}", now_ns)
            return None
        picked = self._joints.pick(message)
        if isinstance(picked, str):
            self._refuse("values", picked, now_ns)
            return None
        if other:
            self._refuse("publishers", "two publishers: the first is followed", now_ns)
            return None
        changed = self._followed.take(publisher, now_ns)
        if changed:
            self._begin(now_ns)
        stamp_ns, last_ns = message.header.stamp.ns, self._t_ns
        if stamp_ns == 0:
            stamp_ns = message.sample_info.source_timestamp
            self._say("stamps are zero", "stamps are zero: times of publication are used", now_ns)
        t_ns, wrong = self._time.next(stamp_ns, now_ns, message.wall_ns, not changed)
        self._t_ns = t_ns
        self._say("stamps", wrong, now_ns)
        if last_ns is not None and t_ns <= last_ns:
            self.counts.refused += 1
            return None
        wanted = self._rate.wants(t_ns)
        self.counts.lost = self._lost_before + self._rate.lost
        self._say("rate", self._rate.problem, now_ns)
        self._say("numbers", self._joints.not_finite(picked), now_ns)
        q, dq, tau = picked
        tau = self._torque(tau, wanted)
        if not wanted:
            return None
        self.last_stamp_ns = stamp_ns or t_ns
        return Sample(t_ns, q, dq, tau, now_ns, self._temperatures.latest())

    def _torque(self, tau: np.ndarray, wanted: bool) -> np.ndarray:
        """Of the sample; where its torque means an average, over all samples since the last one given."""
        if not self._averaged or self._rate.factor == 1:
            return tau
        self._torques.append(tau)
        mean = np.mean(self._torques, axis=0)
        if wanted:
            self._torques.clear()
        return mean

    def _begin(self, now_ns: int) -> None:
        """Another publisher: its stamps and its rate are its own."""
        if self._rate.period_ns is not None:
            self._say("publisher", "another publisher is followed now", now_ns)
        self._lost_before += self._rate.lost
        self._rate.forget()
        self._torques.clear()

    def _refuse(self, key: str, text: str | None, now_ns: int) -> None:
        self.counts.refused += 1
        self._say(key, text, now_ns)

    def _say(self, key: str, problem: str | None, now_ns: int) -> None:
        if problem:
            self.conditions.say(key, f"{self._node.settings.topic}: {problem}", now_ns)

    def _look_for_publishers(self, now_ns: int) -> None:
        """Nothing came: is anyone there who could send, and does their quality of service fit?"""
        if now_ns - self._looked_ns < LOOK_NS:
            return
        self._looked_ns = now_ns
        assert self._inbox is not None  # between open() and close()
        reader = self._inbox.reader
        matched = reader.get_matched_publications()
        if not matched and reader.get_requested_incompatible_qos_status().total_count:
            text = "a publisher offers less reliability or durability than is asked of it"
        elif not matched:
            text = f"no publisher of sensor_msgs/JointState in domain {self._node.settings.domain_id}"
        else:
            text = "the publisher is silent"
        self._say("silence", text, now_ns)
