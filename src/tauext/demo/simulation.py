"""Arm, mover, push and monitors together: one sample after the other, and what a viewer wants to know of it."""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np

from tauext import _core
from tauext.demo.arms import DemoArm
from tauext.demo.mover import REACTIONS, Mover, Reaction
from tauext.demo.plant import Plant, Sample
from tauext.demo.push import Drag, estimated_force
from tauext.demo.watch import Watch
from tauext.errors import ConfigError

TRACE_EVERY_S = 0.02
TRACE_ROWS = 100
"""Rows that are kept for a viewer that does not ask: older ones are dropped."""
EVENTS = 20
RESUME_RAD, RESUME_S = 0.02, 1.2
"""After resume() a method that is blind to static friction is acknowledged anew at every sample until each joint has
moved so far, or for so long: what a push leaves in the friction of a joint at rest looks like a push to it until the
joint has slid, and would stop the arm again before it does."""


@dataclass(frozen=True)
class Verdict:
    """What one method says now."""

    health: str
    alarm: str
    joint: int
    """That raised the alarm, -1 for none."""


@dataclass(frozen=True)
class Event:
    """A method raised a contact or a collision."""

    time_s: float
    method: str
    alarm: str
    joint: int
    after_push_s: float | None
    """Since a push began; None: nothing pushed, the alarm is false."""


@dataclass(frozen=True)
class Touch:
    """A push, true and estimated."""

    joint: int
    point_m: np.ndarray
    target_m: np.ndarray
    """Where the pointer pulls to."""
    force_n: np.ndarray
    estimate_n: np.ndarray
    directions: int
    """Of the force that the joints' torques show, 0 to 3."""


@dataclass
class Snapshot:
    """What a viewer draws; arrays over the joints where nothing else is said."""

    time_s: float
    poses: np.ndarray
    """Of the links in the base frame: position and quaternion w, x, y, z, (joints, 7)."""
    doing: str
    method: str
    tau_ext: np.ndarray
    """Estimate of the method shown, [N m]; NaN while it warms up."""
    limit_nm: np.ndarray
    verdicts: dict[str, Verdict]
    touch: Touch | None
    trace: np.ndarray
    """Since the last snapshot, (rows, 1 + 4 joints): time, estimate, standard error (0: unknown), limit, truth."""
    events: list[Event] = field(default_factory=list)
    """Since the last snapshot."""
    real_time_factor: float = float("nan")


class Simulation:
    """One demo; step() is one sample of the control loop, everything else may be called between two samples."""

    def __init__(self, arm: DemoArm, seed: int = 0):
        self.arm = arm
        self.plant = Plant(arm, seed)
        self.mover = Mover(arm, seed)
        self.watch: Watch | None = None
        self.method = ""
        self.reaction: Reaction = "stop"
        self.sensitivity = 1.0
        self.drag: Drag | None = None
        self._holder: object = None
        self._push_began_s = self._push_ended_s = -np.inf
        self._resumed_s = -np.inf
        self._stuck = np.zeros(len(arm.joints), bool)
        self._resumed_at = np.array(arm.home)
        self._said: dict[str, _core.Estimate] = {}
        self._alarms: dict[str, _core.Alarm] = {}
        self._sample: Sample | None = None
        self._trace: deque[np.ndarray] = deque(maxlen=TRACE_ROWS)
        self._events: deque[Event] = deque(maxlen=EVENTS)
        self._ticks = 0

    # What a viewer may ask for, see serve().

    def watch_with(self, bundles: Mapping[str, str], method: str) -> None:
        """Watch with these bundle files, by method, from now on; `method` is shown and reacted to."""
        self.watch = Watch({name: _core.Bundle.load(path) for name, path in bundles.items()}, self.sensitivity)
        self._said, self._alarms = {}, {}
        self.set_method(method)

    def watch_nothing(self) -> None:
        """Until other bundles are there."""
        self.watch, self._said, self._alarms = None, {}, {}

    def set_method(self, method: str) -> None:
        if self.watch is not None and method not in self.watch.methods:
            raise ConfigError(f"method = {method} must be one of {', '.join(self.watch.methods)}")
        self.method = method

    def set_reaction(self, reaction: Reaction) -> None:
        if reaction not in REACTIONS:
            raise ConfigError(f"reaction = {reaction} must be one of {', '.join(REACTIONS)}")
        self.reaction = reaction

    def set_sensitivity(self, sensitivity: float) -> None:
        self.sensitivity = sensitivity
        if self.watch is not None:
            self.watch.set_sensitivity(sensitivity)

    def set_friction(self, factor: float) -> None:
        self.plant.set_friction(factor)

    def grab(self, holder: object, joint: int, point_m: np.ndarray) -> None:
        """Take hold of the link of a joint at a point in the base frame; whoever held it before lets go."""
        self.drag, self._holder = Drag.grab(self.plant, joint, point_m), holder
        if self.plant.time_s - self._push_ended_s > 0.0:
            self._push_began_s = self.plant.time_s

    def pull(self, holder: object, target_m: np.ndarray) -> None:
        """The pointer is here now, in the base frame."""
        if self.drag is not None and holder == self._holder:
            self.drag.target_m = np.asarray(target_m, float)

    def release(self, holder: object) -> None:
        if self.drag is not None and holder == self._holder:
            self.drag, self._push_ended_s = None, self.plant.time_s

    def resume(self) -> None:
        """End the collision and go on moving: nothing pushes any more."""
        self._resumed_s = self.plant.time_s
        self._resumed_at, self._stuck[:] = self.plant.data.qpos.copy(), True
        if self.watch is not None:
            self.watch.resume()
        self._alarms = dict.fromkeys(self._alarms, _core.Alarm.none)
        self.mover.resume()

    def rest(self) -> None:
        self.mover.rest()

    # The loop.

    def step(self) -> bool:
        """One sample; True where an alarm was raised at it."""
        plant = self.plant
        force, point = self.drag.force_n(plant) if self.drag else (None, None)
        measured = self._sample
        q, dq = (plant.data.qpos, plant.data.qvel) if measured is None else (measured.q, measured.dq)
        setpoints = self.mover.step(q, dq, plant.gravity_nm)
        sample = plant.step(*setpoints, force, point, self.drag.joint if self.drag else 0)
        self._sample = sample
        raised = False
        if self.watch is not None:
            excused = self.watch.blind_to_stiction if self._resuming() else ()
            for method in excused:
                self.watch.acknowledge(method)
            self._said = self.watch.step(sample)
            for method, said in self._said.items():
                alarm = _core.Alarm.none if method in excused else said.alarm
                raised |= self._judge(method, alarm, said.alarm_joint)
        if self._ticks % round(TRACE_EVERY_S * self.arm.rate_hz) == 0:
            estimate, sigma, limit = self._shown()
            self._trace.append(np.concatenate([[plant.time_s], estimate, sigma, limit, sample.tau_ext]))
        self._ticks += 1
        return raised

    def _resuming(self) -> bool:
        """Whether some joint stands where resume() found it, with what the push left in its friction."""
        if self._stuck.any() and self._sample is not None:
            self._stuck &= np.abs(self._sample.q - self._resumed_at) < RESUME_RAD
            self._stuck &= self.plant.time_s < self._resumed_s + RESUME_S
        return bool(self._stuck.any())

    @property
    def tau_ext_nm(self) -> np.ndarray:
        """True external torque of the last sample, (joints,)."""
        return np.zeros(len(self.arm.joints)) if self._sample is None else self._sample.tau_ext

    def take_events(self) -> list[Event]:
        """Alarms since they were last taken."""
        events = list(self._events)
        self._events.clear()
        return events

    def snapshot(self) -> Snapshot:
        """What happened since the last one, and how things stand."""
        data = self.plant.data
        mujoco.mj_kinematics(self.plant.model, data)
        mujoco.mj_comPos(self.plant.model, data)
        estimate, _, limit = self._shown()
        trace = np.array(self._trace)
        self._trace.clear()
        return Snapshot(
            time_s=self.plant.time_s,
            poses=np.hstack([data.xpos[1:], data.xquat[1:]]),
            doing=self.mover.doing,
            method=self.method,
            tau_ext=estimate,
            limit_nm=limit,
            verdicts={
                name: Verdict(said.health.name, self._alarms[name].name, said.alarm_joint)
                for name, said in self._said.items()
            },
            touch=self._touch(estimate),
            trace=trace.reshape(len(trace), 1 + 4 * len(self.arm.joints)),
            events=self.take_events(),
        )

    def _judge(self, method: str, alarm: _core.Alarm, joint: int) -> bool:
        """Note an alarm that rose, and react to a collision of the method shown."""
        was = self._alarms.get(method, _core.Alarm.none)
        self._alarms[method] = alarm
        if alarm.value <= was.value or alarm == _core.Alarm.none:
            return False
        now_s = self.plant.time_s
        pushed = self.drag is not None or now_s - self._push_ended_s < 0.5
        after_s = now_s - self._push_began_s if pushed else None
        self._events.append(Event(now_s, method, alarm.name, joint, after_s))
        if alarm == _core.Alarm.collision and method == self.method and self.mover.doing == "moving":
            self.mover.react(self.reaction)
        return True

    def _shown(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Estimate, its standard error, 0 where nobody knows it, and limit of the method shown."""
        said = self._said.get(self.method)
        if said is None:
            unknown = np.full(len(self.arm.joints), np.nan)
            return unknown, np.zeros(len(unknown)), unknown
        return np.array(said.tau_ext), np.nan_to_num(np.array(said.sigma_nm)), np.array(said.limit_nm)

    def _touch(self, tau_ext: np.ndarray) -> Touch | None:
        if self.drag is None:
            return None
        force, point = self.drag.force_n(self.plant)
        estimate, directions = np.zeros(3), 0
        if np.isfinite(tau_ext).all():
            estimate, directions = estimated_force(tau_ext, self.plant.jacobian(point, self.drag.joint))
        return Touch(self.drag.joint, point, self.drag.target_m, force, estimate, directions)
