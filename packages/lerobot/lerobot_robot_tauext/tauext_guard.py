"""A LeRobot robot that wraps another one and guards it against stalls."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping
from typing import Any

from tauext_lerobot.frames import ServoFrames, bare_name
from tauext_lerobot.guard import Guard, GuardEvent, load_guard
from tauext_lerobot.guard_limits import Limits

from lerobot_robot_tauext.config_tauext_guard import TauextGuardConfig
from lerobot_robot_tauext.wrapping import Wrapping
from tauext.errors import TauextError

logger = logging.getLogger(__name__)


class TauextGuard(Wrapping):
    """Observation and actions of the wrapped robot, unchanged unless a reaction to a stall changes goals.

    The loop's rate must be the bundle's, or two to four times that.
    """

    config_class = TauextGuardConfig
    name = "tauext_guard"

    def __init__(self, config: TauextGuardConfig):
        super().__init__(config)
        self.config = config
        bundle, arm, settings = load_guard(config.guard)
        self.read_also(arm)
        self._goals = self.goal_names
        joints = [name.removesuffix(".pos") for name in self._goals]
        self._added = {f"{joint}.{signal}" for signal in self.signals for joint in joints}
        names = self.names_of((*self.floats, *sorted(self._added)))
        self._frames = ServoFrames(bundle, arm, names, "the robot")
        self._guard = Guard(bundle, settings)
        self._period_ns = bundle.observer.sample_period_ns
        self._rate_rule = f"the loop must run at {1e9 / self._period_ns:g} Hz, or at two to four times that"
        keys = {joint: f"{bare_name(name)}.pos" for joint, name in zip(arm.robot.joints, arm.names, strict=True)}
        self._gripper = keys[settings.grip.joint] if settings.grip is not None else ""
        self._refuse(config, list(keys.values()))
        self._limits = Limits(keys, self._gripper, config.open_at)
        self._forget()

    def _refuse(self, config: TauextGuardConfig, keys: list[str]) -> None:
        """Raises ValueError where a reaction cannot be carried out."""
        reactions = {"on_stall": config.on_stall, "on_grip": config.on_grip}
        for name, reaction in reactions.items():
            if missing := [key for key in keys if key not in self._goals] if reaction != "report" else []:
                raise ValueError(f"{name} = {reaction}: {self.robot.name} accepts no goal {', '.join(missing)}")
            if not self._gripper and (reaction == "open" or (name == "on_grip" and reaction != "report")):
                raise ValueError(
                    f"{name} = {reaction} needs a gripper, and {config.guard}/guard.toml declares none ([grip])"
                )

    def connect(self, calibrate: bool = True) -> None:
        """Connect the wrapped robot and restart the guard."""
        self.robot.connect(calibrate)
        self._guard.reset()
        self._forget()
        logger.info("tauext guard: %g Hz%s", 1e9 / self._period_ns, self.requests)

    def _forget(self) -> None:
        self._frames.restart()
        self._limits.end()
        self._sent: dict[str, float] = {}
        self._positions: dict[str, float] = {}
        self._last_ns: int | None = None
        self._refused = ""

    def get_observation(self) -> dict[str, Any]:
        """Observe, and react to a stall in the same call."""
        t_ns = time.monotonic_ns()
        observation = self.observed()
        self._positions |= {key: float(observation[key]) for key in self._goals if math.isfinite(observation[key])}
        # A loop may be up to four times as fast as the bundle: observations between its periods are not used.
        if self._last_ns is None or t_ns - self._last_ns >= 0.8 * self._period_ns:
            self._last_ns = t_ns
            self._react(self._events(t_ns, observation))
        return {key: value for key, value in observation.items() if key not in self._added}

    def _events(self, t_ns: int, observation: Mapping[str, Any]) -> list[GuardEvent]:
        """Events of this observation; none where it cannot be used, which the log states once."""
        values = self.numbers(observation, {key: self._sent.get(key, observation[key]) for key in self._goals})
        try:
            return self._guard.step(t_ns, *self._frames.sample(t_ns, values))
        except TauextError as error:  # the guard must not end the program that it guards
            if str(error) != self._refused:
                self._refused = str(error)
                logger.error("tauext guard: nothing is guarded: %s", error)
            return []

    def _react(self, events: list[GuardEvent]) -> None:
        """Log the events, and send what their reactions change of the last goals."""
        goals: dict[str, float] = {}
        for event in events:
            reaction = {"stall": self.config.on_stall, "grip": self.config.on_grip}.get(event.kind, "")
            added = reaction or (self._rate_rule if "wrong rate" in event.causes else "")
            logger.warning("tauext guard: %s%s", event, f"; {added}" if added else "")
            if reaction not in ("limit", "open"):
                continue
            share = self._guard.usual(event.joint) / event.torque if event.torque > 0 else 0.0
            self._limits.begin(event.joint, share, self._sent, self._positions, reaction == "open")
            if reaction == "open" and self._gripper in self._positions:
                goals[self._gripper] = self._positions[self._gripper]
            goals |= self._sent
        if not goals:
            return
        try:  # now, since a policy may take long to give the next action
            self._send(self._limits.passed(goals, self._positions))
        except Exception as error:
            logger.error("tauext guard: the limited goal was not sent (%s); it is sent with the next action", error)

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Send the goals, limited where a joint stalls; returns what was sent."""
        return self._send(self._limits.passed(action, self._positions))

    def _send(self, action: dict[str, Any]) -> dict[str, Any]:
        sent = self.robot.send_action(action)
        self._sent |= {key: float(sent[key]) for key in self._goals if key in sent}
        return sent
