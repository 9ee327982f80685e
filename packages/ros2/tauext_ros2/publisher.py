"""Output of the monitor on ROS 2 (torques, alarms, diagnostics, wrenches) and requests to it."""

from __future__ import annotations

import json
import math
import re
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from cyclonedds.core import DDSException, GuardCondition, WaitSet

from tauext import _core
from tauext._core import Load
from tauext.bundle.estimates import ALARMS, COLLISION, FAULT, HEALTHS, NONE, torque_lists
from tauext.bundle.estimates import OK as HEALTHY
from tauext.bundle.estimates import STALE as HEALTH_STALE
from tauext.errors import ConfigError
from tauext.monitor.changes import HealthChange
from tauext.monitor.control_lines import alarm_of_text
from tauext.monitor.explanation import MEANING, WORTH_TELLING, unseen_words
from tauext.monitor.phases import announced_of_text
from tauext.monitor.sink import Control, LoopReport, ReactionEvent, Verdict
from tauext_ros2.messages import (
    ERROR,
    OK,
    STALE,
    WARN,
    Bool,
    DiagnosticArray,
    DiagnosticStatus,
    Float64MultiArray,
    Header,
    Inertia,
    JointState,
    KeyValue,
    MultiArrayDimension,
    MultiArrayLayout,
    String,
    Time,
    Vector3,
    Wrench,
    WrenchStamped,
)
from tauext_ros2.node import Conditions, Node
from tauext_ros2.source import Ros2Source

# --- The monitor's state as diagnostic_msgs.


def arm_status(verdict: Verdict | None, joints: tuple[str, ...], hardware_id: str) -> DiagnosticStatus:
    """Alarm, health with causes, and per joint the torque, its standard error, its limits and the margin to a
    collision, in [N m] or the bundle's unit.

    Level: ERROR for a collision or a fault; STALE without samples; WARN for a contact, during warm-up, if a joint's
    drift is at its bound, or if the motion is unlike the training data; else OK. A collision has priority.
    """
    status = DiagnosticStatus(STALE, "tauext: arm", "no sample yet", hardware_id)
    if verdict is None:
        return status
    estimates = verdict.estimates
    health, alarm = int(estimates["health"][-1]), int(estimates["alarm"][-1])
    causes = _core.cause_names(int(estimates["causes"][-1]))
    drifted = [name for name, at_bound in zip(joints, estimates["drift_saturated"][-1], strict=True) if at_bound]
    texts = []
    if alarm != NONE:
        joint = int(estimates["alarm_joint"][-1])
        texts.append(ALARMS[alarm] + (f" on {joints[joint]}" if joint >= 0 else ""))
    if health != HEALTHY:
        texts += HealthChange(0, 0, health, health, int(estimates["causes"][-1]), -1).words(joints)
    if drifted:
        texts.append(f"adaptive bias at its bound on {', '.join(drifted)}: record and retrain")
    unfamiliar = float(estimates["unfamiliar"][-1])
    if unfamiliar >= WORTH_TELLING:
        what, joint, other = (int(estimates[key][-1]) for key in ("unseen", "unseen_joint", "unseen_other"))
        texts.append(f"training never saw such motion: {unseen_words((what, joint, other), joints)}")
    status.message = "; ".join(texts) or "ok"
    if alarm == COLLISION:
        status.level = ERROR
    elif verdict.block is None or health == HEALTH_STALE:
        status.level = STALE
    elif health == FAULT:
        status.level = ERROR
    else:
        status.level = WARN if texts else OK
    status.values = [
        KeyValue("alarm", ALARMS[alarm]),
        KeyValue("health", HEALTHS[health]),
        KeyValue("unfamiliar", number(unfamiliar)),
        *(KeyValue(f"cause: {cause}", MEANING[cause]) for cause in causes),
        *(
            KeyValue(f"{key} {joint}", number(value))
            for key, values in torque_lists(lambda name: estimates[name][-1]).items()
            for joint, value in zip(joints, values, strict=True)
        ),
    ]
    return status


def input_status(
    report: LoopReport | None, before: LoopReport | None, standing: list[str], hardware_id: str
) -> DiagnosticStatus:
    """Rate, lost, late and refused samples, time of a tick, and current input problems as text.

    Level: STALE without samples; WARN if there is an input problem or samples were lost since the previous report; else
    OK.
    """
    status = DiagnosticStatus(STALE, "tauext: input", "; ".join(standing) or "no report yet", hardware_id)
    if report is None:
        return status
    counts = report.counts
    lost = counts.lost + counts.overrun - (before.counts.lost + before.counts.overrun if before else 0)
    texts = ([f"{lost} samples lost in the last second"] if lost else []) + standing
    if report.rate_hz > 0:
        status.level = WARN if texts else OK
    elif not texts:
        texts.append("no sample in the last second")
    status.message = "; ".join(texts) or "ok"
    status.values = [
        KeyValue("rate_hz", number(report.rate_hz)),
        KeyValue("samples", str(report.samples)),
        KeyValue("received", str(counts.received)),
        KeyValue("lost", str(counts.lost + counts.overrun)),
        KeyValue("late", str(report.missing)),
        KeyValue("refused", str(counts.refused)),
        KeyValue("tick_p50_us", number(report.tick_p50_us)),
        KeyValue("tick_p99_us", number(report.tick_p99_us)),
        KeyValue("tick_max_us", number(report.tick_max_us)),
        KeyValue("profile", report.profile),
    ]
    return status


def number(value: float | None) -> str:
    """Four digits, or - for a missing number."""
    return f"{value:.4g}" if value is not None and math.isfinite(value) else "-"


# --- Force and moment at frames of the arm: per frame a WrenchStamped and its covariance.


LABELS = ("force.x", "force.y", "force.z", "torque.x", "torque.y", "torque.z")
"""Labels of the rows and columns of a covariance; that of a force alone has the first three."""


class Wrenches:
    """Topics `wrench/NAME` and `wrench/NAME/covariance` of the frames in the settings.

    A wrench is what the environment exerts on the arm, at the frame's origin and along the frame's axes. The header's
    frame_id is the frame, so tf can transform it. Rows and columns of the covariance are in the order of LABELS.
    """

    def __init__(self, frames: Sequence[str], bundle: _core.Bundle | None):
        """
        Args:
            bundle: basis of the forces; None: nothing is published before follow().

        Raises:
            ConfigError: the bundle estimates no force, or has no such frame.
        """
        self._frames = {topic_name(name): name for name in frames}
        self._model: _core.WrenchModel | None = None
        if len(self._frames) < len(frames):
            raise ConfigError(f"ROS 2 wrench_frames {', '.join(frames)}: two frames have the same topic name")
        if bundle is not None and (reason := self.follow(bundle)):
            raise ConfigError(f"ROS 2 wrench_frames {reason}")

    def follow(self, bundle: _core.Bundle) -> str:
        """Estimate with this bundle; why it cannot, then nothing is published."""
        self._model = None
        frames = list(self._frames.values())
        if not frames:
            return ""
        model = _core.WrenchModel(bundle)
        if model.refused:
            return f"{', '.join(frames)}: no force can be estimated, {model.refused}"
        known = [frame.name for frame in model.frames]
        for name in frames:
            if name not in known:
                return f"{name!r} must be one of {', '.join(known)}"
        self._model = model
        return ""

    def open(self, node: Node) -> None:
        """Create the writers."""
        self._writers = {frame: wrench_writers(node, f"wrench/{topic}") for topic, frame in self._frames.items()}

    def close(self) -> None:
        """Remove the writers."""
        self._writers = {}

    def publish(self, verdict: Verdict, stamps_ns: Sequence[int], send: Callable[[Any, Any], bool]) -> None:
        """Send wrench and covariance of each sample at each frame where the force is known."""
        if verdict.block is None or self._model is None:
            return
        estimates, block = verdict.estimates, verdict.block
        rows = (block.q, estimates["tau_ext"] - estimates["load_nm"], estimates["sigma_nm"])
        for frame, (wrenches, covariances) in self._writers.items():
            own = _core.WrenchAxes.frame
            found = self._model.wrenches(frame, *rows, None, own, estimates["contact_sigma_nm"], block.dq)
            for row in np.flatnonzero(np.isfinite(found["force"]).all(axis=1)).tolist():
                of_frame = (found[key][row].tolist() for key in ("force", "moment"))
                send(wrenches, wrench_message(frame, stamps_ns[row], *of_frame))
                send(covariances, covariance_message(found["covariance"][row]))


def wrench_writers(node: Node, name: str) -> tuple[Any, Any]:
    """Writers of a wrench and of its covariance."""

    def writer(topic: str, of: type) -> Any:
        return node.writer(node.settings.full_name(topic), of, "reliable", "volatile", 8)

    return writer(name, WrenchStamped), writer(f"{name}/covariance", Float64MultiArray)


def topic_name(frame: str) -> str:
    """A frame's name with _ for characters that ROS 2 does not allow in topic names."""
    name = re.sub(r"\W", "_", frame, flags=re.ASCII)
    return f"_{name}" if name[:1].isdigit() else name


def wrench_message(frame: str, stamp_ns: int, force: Sequence[float], moment: Sequence[float]) -> WrenchStamped:
    """Force [N] and moment [N m] along the frame's axes."""
    return WrenchStamped(Header(Time.of_ns(stamp_ns), frame), Wrench(Vector3(*force), Vector3(*moment)))


def covariance_message(covariance: np.ndarray) -> Float64MultiArray:
    """(6, 6), or (3, 3) of a force alone, row by row."""
    side = len(covariance)
    label = " ".join(LABELS[:side])
    layout = MultiArrayLayout([MultiArrayDimension(label, side, side * side), MultiArrayDimension(label, side, side)])
    return Float64MultiArray(layout, covariance.ravel().tolist())


class ToolForce:
    """Topics `tool_force` and `tool_force/covariance`: Monitor.tool_force() along its frame's axes, while it is known.

    The frame is that of the declared contact in effect, else the load frame; frame_id names it. A topic without
    subscribers costs nothing.
    """

    def __init__(self) -> None:
        self._monitor: _core.Monitor | None = None
        self._writers: tuple[Any, Any] | None = None

    def follow(self, monitor: _core.Monitor) -> None:
        """The forces are this monitor's."""
        self._monitor = monitor

    def open(self, node: Node) -> None:
        """Create the writers."""
        self._writers = wrench_writers(node, "tool_force")

    def close(self) -> None:
        """Remove the writers."""
        self._writers = None

    def publish(self, stamp_ns: int, send: Callable[[Any, Any], bool]) -> None:
        """Send the force at the monitor's last sample."""
        if self._monitor is None or self._writers is None:
            return
        forces, covariances = self._writers
        wanted = [writer for writer in self._writers if writer.get_matched_subscriptions()]
        if not wanted:
            return
        at = self._monitor.tool_force(_core.WrenchAxes.frame).wrench
        if not at.known:
            return
        if forces in wanted:
            send(forces, wrench_message(at.frame, stamp_ns, at.force, at.moment))
        if covariances in wanted:
            send(covariances, covariance_message(at.covariance))


# --- Requests of other nodes: what a message asks the loop to do.


def acknowledge(control: Control, message: Bool, by: str) -> None:
    """End a latched alarm."""
    if message.data:
        control.acknowledge(by)


def resume(control: Control, message: Bool, by: str) -> None:
    """End a latched alarm and accept the torque that the push left."""
    if message.data:
        control.resume(by)


def set_load(control: Control, body: Inertia, by: str) -> None:
    """Set the load; m = 0: none."""
    inertia = [body.ixx, body.iyy, body.izz, body.ixy, body.ixz, body.iyz]
    control.set_load(Load(body.m, [body.com.x, body.com.y, body.com.z], inertia), by)


def declare_contact(control: Control, message: String, by: str) -> None:
    """Declare a contact that the task means, or end some: the text of the control line `contact`."""
    control.declare(announced_of_text(message.data), by)


def answer(control: Control, message: String, by: str) -> None:
    """Keep what an alarm was: `touched` or `nothing`, with the number of the alarm or without."""
    what, _, alarm = message.data.strip().partition(" ")
    if what not in ("touched", "nothing"):
        raise ConfigError(f"{message.data.strip()[:60]!r} must be `touched` or `nothing`")
    control.answer("touched" if what == "touched" else "nothing", by, alarm_of_text(alarm))


REQUESTS: dict[str, tuple[type, Callable[[Control, Any, str], None]]] = {
    "profile": (String, lambda control, message, by: control.use_profile(message.data, by)),
    "acknowledge": (Bool, acknowledge),
    "resume": (Bool, resume),
    "load": (Inertia, set_load),
    "declare_contact": (String, declare_contact),
    "answer": (String, answer),
}
"""Type and action by topic; an action raises ConfigError where the loop refuses the request."""


# --- The publisher.


FOREVER_NS = 2**63 - 1
BETWEEN_NS = 50_000_000
"""Shortest time between two diagnostics, so that a flickering state does not flood the network."""


class Ros2Publisher:
    """Publishes torque at every sample, alarms at changes, and diagnostics each second and at changes.

    `external_torque`: JointState with the stamp of its sample, effort = tau_ext [N m], positive where the
    environment pushes the joint in its positive direction, NaN while there is no estimate. `contact`, `collision`:
    Bool, transient local: late subscribers receive the last one. `event`: String, JSON, for reactions with
    publish = true. `wrench/NAME`: WrenchStamped of each frame of the settings, with its covariance, while it is known.
    `tool_force`: the same of the declared contact in effect, else of the load frame, at the newest sample.
    `diagnostics`: DiagnosticArray. Subscribed: REQUESTS.

    A slow subscriber never blocks the loop; it misses messages older than the topic's depth. `unsent` counts messages
    that the library refuses to send.
    """

    def __init__(self, node: Node, conditions: Conditions, source: Ros2Source, wrenches: Wrenches):
        """source: provides the stamps of the torques."""
        self._node, self._conditions, self._source, self._wrenches = node, conditions, source, wrenches
        self._tool = ToolForce()
        self.unsent = 0
        self._verdict: Verdict | None = None
        self._report: LoopReport | None = None
        self._before: LoopReport | None = None
        self._sent: dict[str, bool] = {}
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
        self._tool.open(node)
        self._diagnostics = node.writer(
            settings.full_name(settings.diagnostics), DiagnosticArray, "reliable", "volatile", 8
        )
        self._message = JointState(name=list(settings.names or joints))
        self._requests = {
            name: (node.inbox(settings.full_name(name), of, "reliable", "volatile", 8), do)
            for name, (of, do) in REQUESTS.items()
        }
        node.announce()
        self._send_alarm(NONE)
        self._diagnose(time.monotonic_ns())
        self._closing = GuardCondition(node.participant)
        self._listening = threading.Thread(target=self._listen, name="ros2 requests", daemon=True)
        self._listening.start()

    def follow(self, bundle: _core.Bundle, monitor: _core.Monitor) -> None:
        """The forces are those of this bundle and monitor from now on."""
        self._tool.follow(monitor)
        if reason := self._wrenches.follow(bundle):
            self._conditions.report("wrench", f"wrench_frames {reason}", time.monotonic_ns())

    def verdict(self, verdict: Verdict) -> None:
        self._verdict = verdict
        if verdict.block is not None:
            stamps_ns = [self._source.stamp_ns(t_ns) for t_ns in verdict.t_ns.tolist()]
            # The writer serialises immediately, so one message is reused.
            for stamp_ns, tau_ext in zip(stamps_ns, verdict.estimates["tau_ext"].tolist(), strict=True):
                self._message.header.stamp, self._message.effort = Time.of_ns(stamp_ns), tau_ext
                self._send(self._torque, self._message)
            self._wrenches.publish(verdict, stamps_ns, self._send)
            self._tool.publish(stamps_ns[-1], self._send)
        for change in verdict.changes:
            self._send_alarm(int(verdict.estimates["alarm"][change.row - verdict.row]))
        if verdict.changes:
            self._due = True
        if self._due:
            now_ns = time.monotonic_ns()
            if now_ns - self._diagnosed_ns >= BETWEEN_NS:
                self._diagnose(now_ns)

    def every_second(self, report: LoopReport) -> None:
        self._before, self._report = self._report, report
        self._diagnose(time.monotonic_ns())

    def publish_event(self, event: ReactionEvent) -> None:
        self._send(self._events, String(json.dumps(event.content)))

    def close(self) -> None:
        """Remove the topics. Transient-local topics end too: later subscribers receive nothing."""
        if self._listening is None:
            return
        self._closing.set(True)
        self._listening.join()
        self._listening = self._closing = self._torque = self._events = self._diagnostics = None
        self._alarms, self._requests = {}, {}
        self._wrenches.close()
        self._tool.close()
        self._node.leave()

    def _send_alarm(self, alarm: int) -> None:
        for name, stands in (("contact", alarm != NONE), ("collision", alarm == COLLISION)):
            if self._sent.get(name) != stands and self._send(self._alarms[name], Bool(stands)):
                self._sent[name] = stands

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
        except DDSException:  # the monitor continues
            self.unsent += 1
            return False
        return True

    def _listen(self) -> None:
        """Serve requests in a separate thread: they must not wait for a sample."""
        waitset = WaitSet(self._node.participant)
        for condition in (self._closing, *(inbox.new for inbox, _ in self._requests.values())):
            waitset.attach(condition)
        while not self._closing.read():
            waitset.wait(FOREVER_NS)
            for name, (inbox, do) in self._requests.items():
                topic = self._node.settings.full_name(name)
                messages, damaged = inbox.take()
                if damaged:
                    self._conditions.report(name, f"{topic}: {damaged}", time.monotonic_ns())
                for message in messages:
                    by = f"ros2 {topic}"
                    try:
                        do(self._control, message, by)
                    except ConfigError as refused:
                        self._conditions.report(name, f"{by}: {refused}", time.monotonic_ns())
