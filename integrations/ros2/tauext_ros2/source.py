"""Joint states of a ROS 2 topic as samples: selects joints, publisher, rate, time and temperatures."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Sequence
from contextlib import ExitStack, nullcontext, suppress
from pathlib import Path
from typing import Any

import numpy as np
from cyclonedds.core import WaitSet

from tauext.errors import AwayError, ConfigError
from tauext.monitor.source import Sample, SourceCounts, SourceFacts, SourceSettings
from tauext.sources.describing import LEARNT_STEPS, chosen_joints, learnt_period_ns, mean_period_ns
from tauext_ros2.messages import JointState, Temperature
from tauext_ros2.node import Conditions, Inbox, Node, without_lines

# --- The arm's joints in messages with any order of joints and possibly other joints.


FIELDS = ("position", "velocity", "effort")


class ArmJoints:
    """Selects positions, velocities and efforts of the arm, (joints,) each, in the order of `names`."""

    def __init__(self, names: tuple[str, ...]):
        """names: names of the joints in the messages."""
        self.names = names
        self._of: list[str] = []
        self._rows: list[int] = []
        self._missing: list[str] = []

    def is_here(self, message: JointState) -> bool:
        """Whether the message has every joint of the arm; it may have others."""
        if message.name != self._of:
            row = {name: k for k, name in reversed(list(enumerate(message.name)))}
            self._of, self._missing = message.name, [name for name in self.names if name not in row]
            self._rows = [row[name] for name in self.names if name in row]
        return not self._missing

    def missing(self, message: JointState) -> str:
        """Text about the joints that a message lacks."""
        self.is_here(message)
        return f"no {', '.join(self._missing)} among its joints {', '.join(message.name) or '(none)'}"

    def pick(self, message: JointState) -> tuple[np.ndarray, np.ndarray, np.ndarray] | str:
        """q [rad], dq [rad/s], tau [N m] of a message with the arm's joints, or the reason why there are none.

        NaN is passed on: the monitor's health handles it.
        """
        values = [getattr(message, field) for field in FIELDS]
        for field, numbers in zip(FIELDS, values, strict=True):
            if len(numbers) != len(message.name):
                return (
                    f"{field} is empty: position, velocity and effort are needed"
                    if not numbers
                    else f"{field} has {len(numbers)} values for {len(message.name)} names"
                )
        q, dq, tau = (np.array(numbers, dtype=np.float64)[self._rows] for numbers in values)
        return q, dq, tau

    def not_finite(self, arrays: tuple[np.ndarray, ...]) -> str | None:
        """Text about the numbers that are NaN or infinite; None: all are finite."""
        bad = [
            f"{field} of {', '.join(self.names[j] for j in np.flatnonzero(~np.isfinite(values)))}"
            for field, values in zip(FIELDS, arrays, strict=True)
            if not np.isfinite(values).all()
        ]
        return f"{' and '.join(bad)} is not a number" if bad else None


# --- The publisher in use, of several on one topic.


TAKEOVER_NS = 500_000_000
"""Silence after which another publisher is used: longer than any pause of a driver."""


class Followed:
    """The publisher in use: the first one of the arm until it is silent, then the next. Never two at once."""

    def __init__(self) -> None:
        self._handle: int | None = None
        self._last_ns = 0

    def is_another(self, handle: int, now_ns: int) -> bool:
        """Whether this publisher is another than the one in use."""
        return self._handle not in (None, handle) and now_ns - self._last_ns <= TAKEOVER_NS

    def take(self, handle: int, now_ns: int) -> bool:
        """Use a sample of this publisher; returns whether the publisher changed."""
        changed = handle != self._handle
        self._handle, self._last_ns = handle, now_ns
        return changed


# --- From the publisher's rate to the bundle's: every n-th sample, by time stamps.


LEARNT_FROM = LEARNT_STEPS + 1
"""Samples from which the rate is learnt. They are not passed on, since the monitor would detect a wrong rate."""
TOLERANCE = 0.05
"""Relative difference from which the monitor reports another rate."""
CHANGED = 0.2
"""Relative difference from which the rate has changed; less is jitter."""


class SampleRate:
    """Learns a publisher's period from stamps, then selects the samples that match the bundle's rate.

    At n times the bundle's rate every n-th sample is used, in slots of the bundle's period counted from the first; a
    neighbour replaces a lost sample. At any other rate all samples are passed on, and the monitor reports the wrong
    rate.
    """

    def __init__(self, period_ns: int):
        """period_ns: the bundle's period."""
        self._wanted_ns = period_ns
        self.forget()

    def forget(self) -> None:
        """Restart for another publisher."""
        self.period_ns: int | None = None
        """Period of the publisher, [ns]; None until learnt."""
        self.factor = 1
        self.lost = 0
        """Samples lost according to gaps of the stamps, since the period was learnt."""
        self._steps: list[int] = []
        self._last_ns: int | None = None
        self._due_ns: int | None = None

    def wants(self, t_ns: int) -> bool:
        """Whether to pass on the sample at t_ns, which is later than the previous one."""
        last_ns, self._last_ns = self._last_ns, t_ns
        if last_ns is None:
            return False
        step_ns = t_ns - last_ns
        if self.period_ns is not None:
            self.lost += max(0, round(step_ns / self.period_ns) - 1)
        self._learn(step_ns)
        if self.period_ns is None:
            return False
        if self.factor == 1:
            return True
        if self._due_ns is None or t_ns - self._due_ns > self._wanted_ns:
            self._due_ns = t_ns
        if t_ns < self._due_ns - self.period_ns // 2:
            return False
        self._due_ns += self._wanted_ns
        return True

    @property
    def problem(self) -> str | None:
        """Text about a wrong rate of the publisher; None: the rate fits."""
        if self.period_ns is None:
            return None
        is_hz, wanted_hz = 1e9 / self.period_ns, 1e9 / self._wanted_ns
        if self.factor > 1 or abs(is_hz / wanted_hz - 1) <= TOLERANCE:
            return None
        rule = "no multiple of" if is_hz > wanted_hz else "less than"
        return (
            f"{is_hz:.4g} samples a second are {rule} the bundle's {wanted_hz:.4g}: "
            "publish at that rate, or train for this one"
        )

    def _learn(self, step_ns: int) -> None:
        """Learn the period from every LEARNT_FROM samples, since rates change."""
        self._steps.append(step_ns)
        if len(self._steps) < LEARNT_FROM - 1:
            return
        period_ns = mean_period_ns(self._steps)
        self._steps.clear()
        if self.period_ns is not None and abs(period_ns / self.period_ns - 1) <= CHANGED:
            return
        self.period_ns, self._due_ns = period_ns, None
        ratio = self._wanted_ns / period_ns
        self.factor = max(1, round(ratio)) if abs(round(ratio) / ratio - 1) <= TOLERANCE else 1


# --- Stamps that are no clock.


NO_STAMP, REPEATED_STAMPS = "stamps are zero", "messages with new values have the stamp of the one before"
REPEATED_SHARE, OVER_MESSAGES = 0.2, 50
"""Share of such messages, among about the last ones, above which stamps are no clock: some may be sent twice."""


class OwnStamps:
    """Finds stamps of a publisher that are no clock: zero, constant, or coarser than its messages.

    A message that repeats stamp and values is none of these: its driver may be frozen.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Restart for another publisher."""
        self._last_ns = 0
        self._values: tuple[np.ndarray, ...] = ()
        self._share = 0.0
        self._repeat = False

    def problem(self, stamp_ns: int, values: tuple[np.ndarray, ...]) -> str:
        """Why the stamp of the next message is not used; empty: it is."""
        if stamp_ns == 0:
            return NO_STAMP
        is_repeated = stamp_ns == self._last_ns and not all(map(np.array_equal, values, self._values))
        self._last_ns, self._values = stamp_ns, values
        self._share += (is_repeated - self._share) / OVER_MESSAGES
        self._repeat = self._repeat or self._share > REPEATED_SHARE
        return REPEATED_STAMPS if self._repeat else ""


# --- Time of samples: from their stamps if these are usable, else from reception.


JUMP_NS = 1_000_000_000
"""If a stamp departs by more than this from the times of reception, a clock was set."""


class SampleTime:
    """Adds up steps between stamps or, where stamps contradict reception, between receptions.

    While stamps are valid, time equals the stamp, independent of network delays. If a clock is set forward or back, one
    step is taken from reception and time continues from there. Without stamps every step is taken from reception. If
    two samples arrive together, that step equals the previous one.
    A sample with the previous stamp gets the same time; the caller drops it.
    """

    def __init__(self) -> None:
        self._t_ns = self._stamp_ns = self._received_ns = self._step_ns = 0
        self._begun = False

    def next(self, stamp_ns: int, received_ns: int, wall_ns: int, follows: bool = True) -> tuple[int, str | None]:
        """Time of the next sample, [ns], and text about a problem of its stamp.

        Args:
            stamp_ns: stamp of the message; 0: none.
            received_ns: time of reception by a monotonic clock.
            wall_ns: time of reception since 1970, the start of time without stamps.
            follows: False for the first sample of another publisher, which may use another clock.
        """
        wrong, step_ns = None, stamp_ns - self._stamp_ns
        by_reception_ns = received_ns - self._received_ns
        if stamp_ns == 0:
            wrong = "stamps are missing: times of reception are used"
        elif self._begun and follows and self._stamp_ns:
            if step_ns == 0:
                return self._t_ns, "two messages have the same stamp: the second is dropped"
            if step_ns < 0:
                wrong = f"the stamp went back by {-step_ns / 1e9:.3g} s: the time of reception is used"
            elif step_ns - by_reception_ns > JUMP_NS:
                wrong = f"the stamp jumped ahead by {step_ns / 1e9:.3g} s: the time of reception is used"
        if not self._begun:
            self._t_ns = stamp_ns or wall_ns
        elif wrong or not follows or not self._stamp_ns:
            self._step_ns = by_reception_ns or self._step_ns
            self._t_ns += self._step_ns
        else:
            self._step_ns = step_ns
            self._t_ns += step_ns
        self._begun, self._stamp_ns, self._received_ns = True, stamp_ns, received_ns
        return self._t_ns, wrong


# --- Temperatures of the joints, one topic each. The latest value holds, since temperatures change slowly.


class Temperatures:
    """Reads sensor_msgs/Temperature from the topics of the settings; never waits."""

    def __init__(self, node: Node, joints: int):
        """Subscribe; publishers may start later.

        Raises:
            ConfigError: the number of topics differs from the number of joints.
        """
        settings = node.settings
        topics = settings.temperatures
        if topics and len(topics) != joints:
            raise ConfigError(f"ROS 2 temperatures {', '.join(topics)}: {len(topics)} topics for {joints} joints")
        self._node = node
        self._inboxes = [
            node.inbox(topic, Temperature, settings.reliability, settings.durability, settings.depth)
            for topic in topics
        ]
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

    @property
    def readers(self) -> list:
        """Readers to return to the node."""
        return [inbox.reader for inbox in self._inboxes]


# --- The source.


LISTEN_S, LISTEN_NS = 1.0, 50_000_000
"""Least time for which describe() listens, since publishers are found one after the other; longest wait of a step."""
DESCRIBED_FROM = 2 * LEARNT_FROM
"""Messages of one publisher after which describe() has enough."""
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
        self.last_stamp_ns = 0
        """Time of the last sample passed on, since 1970: the stamp of everything published about it."""
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
        inbox = self._node.inbox(chosen.topic, JointState, chosen.reliability, chosen.durability, chosen.depth)
        waitset, came = WaitSet(self._node.participant), dict[int, list[JointState]]()
        waitset.attach(inbox.new)
        unusable = (0, "")  # of the message with most joints: a gripper often shares the topic
        try:
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
        finally:
            del waitset
            self._node.remove([inbox.reader])

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
        self._unreadable = self._node.unreadable.count(chosen.topic)
        self._lost_before = 0
        self._t_ns: int | None = None
        self._inbox = self._node.inbox(chosen.topic, JointState, chosen.reliability, chosen.durability, chosen.depth)
        self._temperatures = Temperatures(self._node, len(settings.joints))
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

    def notes(self) -> list[str]:
        return self.conditions.unreported()

    def close(self) -> None:
        """Unsubscribe; the node closes if it has no other users."""
        if self._inbox is None:
            return
        inbox, self._inbox, self._waitset = self._inbox, None, None
        self._node.leave([inbox.reader, *self._temperatures.readers])
        self._pending.clear()
        self._while_open.close()

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
        """Count messages that the library dropped since the last call."""
        count = self._node.unreadable.count(self._node.settings.topic)
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
        t_ns, wrong = self._time.next(stamp_ns, now_ns, message.wall_ns, follows)
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
        self.last_stamp_ns = stamp_ns or t_ns
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


def usable_joints(message: JointState, names: tuple[str, ...]) -> tuple[str, ...] | str:
    """Joints of a message with finite position, velocity and effort, or the reason why it is unusable.

    Args:
        names: joints that must be among them; empty: at least one must.
    """
    counted = [len(getattr(message, field)) for field in FIELDS]
    for field, count in zip(FIELDS, counted, strict=True):
        if not count and message.name:
            return f"{field} is empty: position, velocity and effort are needed"
    rows = zip(message.name, *(getattr(message, field) for field in FIELDS), strict=False)
    finite = tuple(name for name, *values in rows if all(map(math.isfinite, values)))
    what = "no finite position, velocity and effort"
    if missing := [name for name in names if name not in finite]:
        return f"{what} of {', '.join(missing)} among {', '.join(message.name) or '(none)'}"
    return finite or f"{what} of a joint among {', '.join(message.name) or '(none)'}"


def usual_joints(messages: Sequence[JointState], names: tuple[str, ...]) -> tuple[tuple[str, ...], list[JointState]]:
    """Joints of one publisher's usual messages, and these messages: the most joints that a tenth of them have.

    Args:
        messages: usable ones.
        names: as for usable_joints().
    """
    by_joints: dict[tuple[str, ...], list[JointState]] = {}
    for message in messages:
        usable = usable_joints(message, names)
        assert not isinstance(usable, str)
        by_joints.setdefault(usable, []).append(message)
    usual = {joints: those for joints, those in by_joints.items() if 10 * len(those) >= len(messages)}
    return max((usual or by_joints).items(), key=lambda one: (len(one[0]), len(one[1])))
