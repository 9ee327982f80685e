"""A ROS 2 topic as a source of samples, with the temperatures of the joints."""

from __future__ import annotations

import math
import time
from collections import deque
from contextlib import ExitStack, nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np
from cyclonedds.core import WaitSet

from tauext.errors import AwayError, ConfigError
from tauext.monitor.source import Sample, SourceCounts, SourceFacts, SourceSettings
from tauext.sources.describing import chosen_joints, learnt_period_ns
from tauext_ros2.messages import JointState, Temperature
from tauext_ros2.node import Conditions, Inbox, Node, without_lines
from tauext_ros2.samples import (
    LEARNT_FROM,
    REPEATED_STAMPS,
    ArmJoints,
    Followed,
    OwnStamps,
    SampleRate,
    SampleTime,
    usable_joints,
    usual_joints,
)

# --- Temperatures of the joints, one topic each. The latest value holds, since temperatures change slowly.


class Temperatures:
    """Reads sensor_msgs/Temperature from the topics of the settings; never waits."""

    def __init__(self, node: Node, joints: int):
        """Subscribe; publishers may start later.

        Raises:
            ConfigError: the number of topics differs from the number of joints.
        """
        topics = node.settings.temperatures
        if topics and len(topics) != joints:
            raise ConfigError(f"ROS 2 temperatures {', '.join(topics)}: {len(topics)} topics for {joints} joints")
        self._inboxes = [node.input(topic, Temperature) for topic in topics]
        self._celsius = np.full(joints, np.nan)

    def latest(self) -> np.ndarray | None:
        """(joints,) [degC], NaN before the first message; None: no topics. Undecodable messages are ignored."""
        if not self._inboxes:
            return None
        for joint, inbox in enumerate(self._inboxes):
            finite = [message.temperature for message in inbox.take()[0] if math.isfinite(message.temperature)]
            if finite:
                self._celsius[joint] = finite[-1]
        return self._celsius.copy()


# --- The source.


LISTEN_S, LISTEN_NS = 1.0, 50_000_000
"""Least time for which describe() listens, since publishers are found one after the other; longest wait of a step."""
DESCRIBED_FROM = 2 * LEARNT_FROM
"""Messages of one publisher after which describe() has enough."""
MOST_STAMPS = 1000
"""Samples whose stamps are kept for what is published about them."""
LOOK_NS = 500_000_000
"""Interval at which publishers are checked while no message arrives."""


class Ros2Source:
    """A tauext.monitor Source: reads sensor_msgs/JointState in the thread that takes the samples.

    Unusable messages are counted as refused and noted in `conditions`: without the arm's joints, without velocity or
    effort, or of a second publisher. SampleTime, SampleRate and Followed handle changes of stamps, rates and
    publishers. Samples dropped by a full reader count as lost, by the gap of their stamps.
    """

    def __init__(self, node: Node, conditions: Conditions, quiet: bool = False):
        """quiet: see connect()."""
        self._node, self.conditions = node, conditions
        self._quietly = without_lines if quiet else nullcontext
        self._while_open = ExitStack()
        self.name = f"ros2 {node.settings.topic}"
        self.counts = SourceCounts()
        self._stamps_ns: dict[int, int] = {}
        self._inbox: Inbox | None = None
        self._waitset: Any = None
        self._pending: deque[JointState] = deque()

    def describe(self, wait_s: float, robot: Path | None = None) -> SourceFacts:
        """Listen for at least LISTEN_S, then describe the publisher with most joints of the arm.

        Units and kind of its effort are not known.
        """
        with self._quietly():
            return self._facts(self._publishers(wait_s), robot)

    def _publishers(self, wait_s: float) -> list[list[JointState]]:
        """Usable messages of each publisher that came within wait_s; raises AwayError without any."""
        chosen, began = self._node.settings, time.monotonic()
        inbox = self._node.input(chosen.topic, JointState)
        waitset, came = WaitSet(self._node.participant), dict[int, list[JointState]]()
        waitset.attach(inbox.new)
        unusable = (0, "")  # of the message with most joints: a gripper often shares the topic
        while (now := time.monotonic()) < began + wait_s:
            if now > began + LISTEN_S and len(max(came.values(), key=len, default=[])) > DESCRIBED_FROM:
                break
            waitset.wait(LISTEN_NS)
            for message in inbox.take()[0]:
                if isinstance(usable := usable_joints(message, chosen.names), str):
                    unusable = max(unusable, (len(message.name), usable))
                else:
                    came.setdefault(message.sample_info.publication_handle, []).append(message)
        if not came:
            raise AwayError(f"{self.name}: {unusable[1] or silence(inbox.reader, chosen.domain_id)}")
        return list(came.values())

    def _facts(self, publishers: list[list[JointState]], robot: Path | None) -> SourceFacts:
        """Facts of the publisher with most joints of the arm; of several such, the one that came first."""
        settings, found = self._node.settings, []
        for messages in publishers:
            usable, those = usual_joints(messages, settings.names)
            left_out = tuple[str, ...]()
            with suppress(ConfigError) if len(publishers) > 1 else nullcontext():
                usable, left_out = (settings.names, ()) if settings.names else chosen_joints(usable, robot, self.name)
                found.append((usable, left_out, those))
        if not found:
            raise ConfigError(f"{self.name}: no publisher has the joints of {robot}")
        joints, notes, messages = max(found, key=lambda one: len(one[0]))
        if sum(one[0] == joints for one in found) > 1:
            notes += (f"two publishers on {settings.topic}: the first is used",)
        stamps = [one.header.stamp.ns or one.sample_info.source_timestamp for one in messages]
        if 2 * len(set(stamps)) < len(stamps):
            stamps = [one.sample_info.source_timestamp for one in messages]
            notes += (f"{REPEATED_STAMPS}: times of publication are used",)
        period_ns = learnt_period_ns(stamps, self.name)
        notes += ("the effort is taken as a torque in N m until the arm's motion shows another kind",)
        arm = SourceSettings(joints, period_ns, ("N m",) * len(joints), "instant")
        return SourceFacts(arm, "unknown", bool(settings.temperatures), notes)

    def open(self, settings: SourceSettings) -> None:
        """Subscribe; the publisher may start later."""
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
        self._stamps, self._no_clock = OwnStamps(), ""
        self._averaged = settings.torque_timing == "averaged"
        self._torques: list[np.ndarray] = []
        self.counts = SourceCounts()
        self._unreadable = self._node.unreadable[chosen.topic]
        self._lost_before = 0
        self._t_ns: int | None = None
        self._inbox = self._node.input(chosen.topic, JointState)
        self._temperatures: Temperatures | None = Temperatures(self._node, len(settings.joints))
        self._waitset = WaitSet(self._node.participant)
        self._waitset.attach(self._inbox.new)
        self._node.announce()
        self._while_open.enter_context(self._quietly())

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
        """Never: a publisher may return."""
        return False

    def stamp_ns(self, t_ns: int) -> int:
        """Time of one of the newest samples passed on, since 1970: the stamp of everything published about it.

        Args:
            t_ns: as passed on.
        """
        return self._stamps_ns.get(t_ns, t_ns)

    def notes(self) -> list[str]:
        return self.conditions.unreported()

    def close(self) -> None:
        """Unsubscribe; the node closes if it has no other users."""
        if self._inbox is None:
            return
        self._inbox = self._waitset = self._temperatures = None
        self._node.leave()
        self._pending.clear()
        self._while_open.close()

    def _take(self) -> None:
        self._looked_ns = received_ns = time.monotonic_ns()
        assert self._inbox is not None  # between open() and close()
        messages, damaged = self._inbox.take()
        if damaged:
            self.counts.received += 1
            self._refuse("damaged", damaged, received_ns)
        for message in messages:
            message.received_ns = received_ns
            self._pending.append(message)

    def _count_unreadable(self, now_ns: int) -> None:
        """Count messages that the library dropped since the last call."""
        count = self._node.unreadable[self._node.settings.topic]
        if count == self._unreadable:
            return
        self.counts.received += count - self._unreadable
        self.counts.refused += count - self._unreadable
        self._unreadable = count
        self._report("unreadable", "messages do not decode as JointState: they are counted as refused", now_ns)

    def _use(self, message: JointState) -> Sample | None:
        """The sample of a message, if it is usable and due at the bundle's rate."""
        now_ns, publisher = message.received_ns, message.sample_info.publication_handle
        other = self._followed.is_another(publisher, now_ns)
        self.counts.received += 1
        if not self._joints.is_here(message):  # others are not reported: a gripper often shares the topic
            self._refuse("joints", None if other else f"a message has {self._joints.missing(message)}", now_ns)
            return None
        picked = self._joints.pick(message)
        if isinstance(picked, str):
            self._refuse("values", picked, now_ns)
            return None
        if other:
            self._refuse("publishers", "two publishers: the first is used", now_ns)
            return None
        changed = self._followed.take(publisher, now_ns)
        if changed:
            self._begin(now_ns)
        stamp_ns, last_ns = message.header.stamp.ns, self._t_ns
        was, self._no_clock = self._no_clock, self._stamps.problem(stamp_ns, picked)
        if self._no_clock:
            stamp_ns = message.sample_info.source_timestamp
            self._report("no clock", f"{self._no_clock}: times of publication are used", now_ns)
        follows = not changed and was == self._no_clock
        t_ns, wrong = self._time.next(stamp_ns, now_ns, follows)
        self._t_ns = t_ns
        self._report("stamps", wrong, now_ns)
        if last_ns is not None and t_ns <= last_ns:
            self.counts.refused += 1
            return None
        wanted = self._rate.wants(t_ns)
        self.counts.lost = self._lost_before + self._rate.lost
        self._report("rate", self._rate.problem, now_ns)
        self._report("numbers", self._joints.not_finite(picked), now_ns)
        q, dq, tau = picked
        tau = self._torque(tau, wanted)
        if not wanted:
            return None
        if len(self._stamps_ns) >= MOST_STAMPS:
            self._stamps_ns.pop(next(iter(self._stamps_ns)))
        self._stamps_ns[t_ns] = stamp_ns or t_ns
        assert self._temperatures is not None  # between open() and close()
        return Sample(t_ns, q, dq, tau, now_ns, self._temperatures.latest())

    def _torque(self, tau: np.ndarray, wanted: bool) -> np.ndarray:
        """Torque of the sample; for averaged torque, the mean over all samples since the last one passed on."""
        if not self._averaged or self._rate.factor == 1:
            return tau
        self._torques.append(tau)
        mean = np.mean(self._torques, axis=0)
        if wanted:
            self._torques.clear()
        return mean

    def _begin(self, now_ns: int) -> None:
        """Begin with another publisher, which has its own stamps and rate."""
        if self._rate.period_ns is not None:
            self._report("publisher", "another publisher is used now", now_ns)
        self._lost_before += self._rate.lost
        self._rate.forget()
        self._stamps.forget()
        self._torques.clear()

    def _refuse(self, key: str, text: str | None, now_ns: int) -> None:
        self.counts.refused += 1
        self._report(key, text, now_ns)

    def _report(self, key: str, problem: str | None, now_ns: int) -> None:
        if problem:
            self.conditions.report(key, f"{self._node.settings.topic}: {problem}", now_ns)

    def _look_for_publishers(self, now_ns: int) -> None:
        """Report why no message arrives: no publisher, incompatible quality of service, or a silent publisher."""
        if now_ns - self._looked_ns < LOOK_NS:
            return
        self._looked_ns = now_ns
        assert self._inbox is not None  # between open() and close()
        self._report("silence", silence(self._inbox.reader, self._node.settings.domain_id), now_ns)


def silence(reader: Any, domain_id: int) -> str:
    """Why no message arrives."""
    matched = reader.get_matched_publications()
    if not matched and reader.get_requested_incompatible_qos_status().total_count:
        return "a publisher offers less reliability or durability than requested"
    if not matched:
        return f"no publisher of sensor_msgs/JointState in domain {domain_id}"
    return "the publisher is silent"
