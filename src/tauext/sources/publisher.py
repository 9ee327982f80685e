"""What the monitor says, on ROS 2 topics; and what others ask of it there."""

from __future__ import annotations

import json
import threading
import time
from typing import Any

from cyclonedds.core import DDSException, GuardCondition, WaitSet

from tauext._core import Load
from tauext.errors import ConfigError
from tauext.monitor.changes import COLLISION, NONE
from tauext.monitor.sink import Control, Event, LoopReport, Verdict
from tauext.monitor.source import Sample
from tauext.sources.conditions import Conditions
from tauext.sources.diagnostics import arm_status, input_status
from tauext.sources.messages import Bool, DiagnosticArray, Header, Inertia, JointState, String, Time
from tauext.sources.node import Node
from tauext.sources.source import Ros2Source
from tauext.sources.wrenches import Wrenches

FOREVER_NS = 2**63 - 1
BETWEEN_NS = 50_000_000
"""Between two diagnostics that a change asks for, so that a state that flickers does not fill the network."""


class Ros2Publisher:
    """A publisher of the loop: torque at every sample, alarms when they change, diagnostics each second and on change.

    `external_torque`: JointState with the stamp of the sample it speaks of, effort = tau_ext [N m], positive where the
    environment pushes the joint in its positive direction, NaN while there is no estimate. `contact`, `collision`:
    Bool, latched: who subscribes later gets the last one. `event`: String, JSON, for reactions with publish = true.
    `wrench/NAME`: WrenchStamped of each frame that was asked for, with its covariance; nothing where it is not known.
    `diagnostics`: DiagnosticArray. Asked: `profile` (String: its name), `acknowledge` and `resume` (Bool: true),
    `load` (Inertia, in the bundle's load frame; m = 0: nothing).

    A subscriber that does not keep up never holds the loop: it misses what is older than a topic's depth. What the
    library refuses to send is counted in `unsent`.
    """

    def __init__(
        self,
        node: Node,
        conditions: Conditions,
        source: Ros2Source | None = None,
        wrenches: Wrenches | None = None,
    ):
        """source: whose stamps the torques bear; None: the time of reception. wrenches: None: none are told."""
        self._wrenches = wrenches or Wrenches((), None)
        self._node, self._conditions, self._source = node, conditions, source
        self.unsent = 0
        self._verdict: Verdict | None = None
        self._report: LoopReport | None = None
        self._before: LoopReport | None = None
        self._said: dict[str, bool] = {}
        self._diagnosed_ns, self._due = 0, False
        self._listening: threading.Thread | None = None
        self._closing: Any = None  # GuardCondition while open

    def open(self, joints: tuple[str, ...], control: Control) -> None:
        node, settings = self._node, self._node.settings
        node.enter()
        self._joints, self._control = joints, control
        self._torque = node.writer(settings.full_name("external_torque"), JointState, "reliable", "volatile", 8)
        self._alarms = {
            name: node.writer(settings.full_name(name), Bool, "reliable", "transient-local")
            for name in ("contact", "collision")
        }
        self._events = node.writer(settings.full_name("event"), String, "reliable", "volatile", 16)
        self._wrenches.open(node)
        self._diagnostics = node.writer(
            settings.full_name(settings.diagnostics), DiagnosticArray, "reliable", "volatile", 8
        )
        self._message = JointState(name=list(settings.names or joints))
        self._asked = {
            name: (node.inbox(settings.full_name(name), of, "reliable", "volatile", 8), do)
            for name, of, do in (
                ("profile", String, self._use_profile),
                ("acknowledge", Bool, self._acknowledge),
                ("resume", Bool, self._resume),
                ("load", Inertia, self._load),
            )
        }
        node.announce()
        self._say_alarm(NONE)
        self._diagnose(time.monotonic_ns())
        self._closing = GuardCondition(node.participant)
        self._listening = threading.Thread(target=self._listen, name="ros2 asked", daemon=True)
        self._listening.start()

    def verdict(self, verdict: Verdict) -> None:
        self._verdict = verdict
        if verdict.sample is not None:
            # The writer serialises at once, so one message serves all.
            stamp_ns = self._stamp_ns(verdict.sample)
            self._message.header.stamp = Time.of_ns(stamp_ns)
            self._message.effort = verdict.said["tau_ext"][0].tolist()
            self._send(self._torque, self._message)
            self._wrenches.tell(verdict, stamp_ns, self._send)
        if verdict.changes:
            self._say_alarm(int(verdict.said["alarm"][0]))
            self._due = True
        if self._due:
            now_ns = time.monotonic_ns()
            if now_ns - self._diagnosed_ns >= BETWEEN_NS:
                self._diagnose(now_ns)

    def every_second(self, report: LoopReport) -> None:
        self._before, self._report = self._report, report
        self._diagnose(time.monotonic_ns())

    def publish_event(self, event: Event) -> None:
        facts = {"kind": event.kind, "joint": event.joint, "t_ns": event.t_ns, "merged": event.merged, **event.facts}
        self._send(self._events, String(json.dumps(facts)))

    def close(self) -> None:
        """What was said last is kept for nobody: latched topics end with their publisher."""
        if self._listening is None:
            return
        self._closing.set(True)
        self._listening.join()
        entities = [self._torque, *self._alarms.values(), self._events, self._diagnostics, *self._wrenches.writers]
        entities += [inbox.reader for inbox, _ in self._asked.values()]
        self._listening = self._closing = self._torque = self._events = self._diagnostics = None
        self._alarms, self._asked = {}, {}
        self._node.leave(entities)

    def _stamp_ns(self, sample: Sample) -> int:
        if self._source is not None:
            return self._source.last_stamp_ns
        return time.time_ns() - (time.monotonic_ns() - sample.received_ns)

    def _say_alarm(self, alarm: int) -> None:
        for name, stands in (("contact", alarm != NONE), ("collision", alarm == COLLISION)):
            if self._said.get(name) != stands and self._send(self._alarms[name], Bool(stands)):
                self._said[name] = stands

    def _diagnose(self, now_ns: int) -> None:
        self._diagnosed_ns, self._due = now_ns, False
        topic = self._node.settings.topic
        statuses = [
            arm_status(self._verdict, self._joints, topic),
            input_status(self._report, self._before, self._conditions.standing(now_ns), topic),
        ]
        self._send(self._diagnostics, DiagnosticArray(Header(Time.of_ns(time.time_ns())), statuses))

    def _send(self, writer: Any, message: Any) -> bool:
        try:
            writer.write(message)
        except DDSException:  # no reason to stop watching the arm
            self.unsent += 1
            return False
        return True

    def _listen(self) -> None:
        """Its own thread: what is asked is rare, and must not wait for a sample."""
        waitset = WaitSet(self._node.participant)
        for condition in (self._closing, *(inbox.new for inbox, _ in self._asked.values())):
            waitset.attach(condition)
        while not self._closing.read():
            waitset.wait(FOREVER_NS)
            for name, (inbox, do) in self._asked.items():
                topic = self._node.settings.full_name(name)
                messages, damaged = inbox.take()
                if damaged:
                    self._conditions.say(name, f"{topic}: {damaged}", time.monotonic_ns())
                for message in messages:
                    do(message if isinstance(message, Inertia) else message.data, f"ros2 {topic}")

    def _use_profile(self, name: str, by: str) -> None:
        try:
            self._control.use_profile(name, by)
        except ConfigError as refused:
            self._conditions.say("profile", f"{by}: {refused}", time.monotonic_ns())

    def _acknowledge(self, asked: bool, by: str) -> None:
        if asked:
            self._control.acknowledge(by)

    def _load(self, body: Inertia, by: str) -> None:
        inertia = [body.ixx, body.iyy, body.izz, body.ixy, body.ixz, body.iyz]
        try:
            self._control.set_load(Load(body.m, [body.com.x, body.com.y, body.com.z], inertia), by)
        except ConfigError as refused:
            self._conditions.say("load", f"{by}: {refused}", time.monotonic_ns())

    def _resume(self, asked: bool, by: str) -> None:
        if asked:
            self._control.resume(by)
