"""A LeRobot leader whose motors receive torque from the follower's <joint>.tau_ext."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from typing import Any

import draccus
import numpy as np
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig, make_teleoperator_from_config
from tauext_lerobot.leader_feedback import FeedbackSettings, LeaderFeedback

from lerobot_robot_tauext.config_tauext_leader import TauextLeaderConfig
from lerobot_robot_tauext.programs import FEELING
from lerobot_robot_tauext.torque_ports import torque_port
from tauext.errors import ConfigError

UNITS = {"deg": math.pi / 180, "rad": 1.0}


class TauextLeader(Teleoperator):
    """Passes the leader's actions on, and drives its motors from the follower's external torque.

    send_feedback() takes the follower's observation: `<joint>.tau_ext` [N m] of every joint with feedback, and
    optionally its standard error `<joint>.tau_ext_sigma`. A missing or NaN value fades the torque of its joint to 0.
    `contact` or `collision` of -1 (unknown) fades all joints, as does a pause of silence_s.
    """

    config_class = TauextLeaderConfig
    name = "tauext_leader"

    def __init__(self, config: TauextLeaderConfig):
        """Raises ConfigError: no such leader, its motors accept no torque, or a setting is invalid."""
        super().__init__(config)
        self.config = config
        self.leader = make_teleoperator_from_config(leader_config(config.leader))
        self._port = torque_port(self.leader, config.joints, config.nm_per_ampere)
        self._joints = self._port.joints
        self._feedback = LeaderFeedback(len(self._joints), self._settings())
        self._q = np.full(len(self._joints), np.nan)
        self._stepped_s: float | None = None
        self._observed_s: float | None = None
        self._radians: dict[str, float] = {}

    action_features = property(lambda self: self.leader.action_features)
    feedback_features = property(lambda self: {f"{joint}.tau_ext": float for joint in self._joints})
    is_connected = property(lambda self: self.leader.is_connected)
    is_calibrated = property(lambda self: self.leader.is_calibrated)

    def calibrate(self) -> None:
        self.leader.calibrate()

    def configure(self) -> None:
        self.leader.configure()

    def connect(self, calibrate: bool = True) -> None:
        self.leader.connect(calibrate)
        try:
            self._radians = radians_a_unit(self.leader, self._joints, self.config.position_unit)
            self._feedback = LeaderFeedback(len(self._joints), self._settings())
            self._stepped_s = self._observed_s = None
            self._port.begin()
        except BaseException:
            self.disconnect()
            raise
        FEELING.add(self)

    def get_action(self) -> dict[str, Any]:
        """The leader's action. Without an observation for silence_s, the torque fades."""
        action = self.leader.get_action()
        positions = [action.get(f"{joint}.pos") for joint in self._joints]
        scale = [self._radians[joint] for joint in self._joints]
        self._q = np.array([np.nan if q is None else float(q) for q in positions]) * scale
        if self._observed_s is not None and time.monotonic() - self._observed_s > self.config.silence_s:
            nothing = np.full(len(self._joints), np.nan)
            self._step(nothing, nothing)
        return action

    def send_feedback(self, feedback: dict[str, Any]) -> dict[str, float]:
        """Send torque to the leader's motors from one observation of the follower; returns the torque, [N m].

        Raises:
            ConfigError: the first observation lacks a joint's tau_ext, or its error is neither observed nor configured.
        """
        tau_ext, sigma = (self._of_joints(feedback, suffix) for suffix in ("tau_ext", "tau_ext_sigma"))
        if self._observed_s is None:
            self._expect_tau_ext(feedback)
        if self.config.dead_band_nm is not None:
            sigma = np.where(np.isnan(sigma), 0.0, sigma)  # then the configured dead band applies
        self._observed_s = time.monotonic()
        healthy = feedback.get("contact", 0.0) >= 0 and feedback.get("collision", 0.0) >= 0
        return self._step(tau_ext, sigma, healthy)

    def disconnect(self) -> None:
        """Release the motors first, then disconnect the leader even if that failed."""
        FEELING.discard(self)
        try:
            if self.leader.is_connected:
                self._port.end()
        finally:
            self.leader.disconnect()

    def _step(self, tau_ext: np.ndarray, sigma: np.ndarray, healthy: bool = True) -> dict[str, float]:
        now = time.monotonic()
        # A first tick of 20 ms: its torque is at most one slew step.
        dt_s = 0.02 if self._stepped_s is None else max(now - self._stepped_s, 1e-4)
        self._stepped_s = now
        torque = self._feedback.step(tau_ext, sigma, self._q, dt_s, healthy)
        sent = dict(zip(self._joints, torque.tolist(), strict=True))
        self._port.write(sent)
        return sent

    def _of_joints(self, feedback: Mapping[str, Any], suffix: str) -> np.ndarray:
        return np.array([float(feedback.get(f"{joint}.{suffix}", np.nan)) for joint in self._joints])

    def _expect_tau_ext(self, feedback: Mapping[str, Any]) -> None:
        missing = [joint for joint in self._joints if f"{joint}.tau_ext" not in feedback]
        if missing:
            raise ConfigError(
                f"the follower's observation has no {missing[0]}.tau_ext: use a robot that observes it "
                f"(--robot.type=tauext of lerobot_robot_tauext), or leave {', '.join(missing)} out of joints"
            )
        if self.config.dead_band_nm is None and f"{self._joints[0]}.tau_ext_sigma" not in feedback:
            raise ConfigError(
                f"the follower's observation has no {self._joints[0]}.tau_ext_sigma: set dead_band_nm to the largest "
                "tau_ext of free motion, [N m]"
            )

    def _settings(self) -> FeedbackSettings:
        config = self.config
        return FeedbackSettings(
            gain=self._of_setting("gain"),
            cap_nm=self._of_setting("cap_nm"),
            dead_band_sigmas=self._of_setting("dead_band_sigmas"),
            least_dead_band=self._of_setting("dead_band_nm") if config.dead_band_nm is not None else 0.0,
            slew_nm_s=config.slew_nm_s,
            damping_nm_s_rad=self._of_setting("damping_nm_s_rad"),
            tank_j=config.tank_j,
        )

    def _of_setting(self, name: str) -> float | tuple[float, ...]:
        value = getattr(self.config, name)
        if not isinstance(value, Mapping):
            return value
        if set(value) != set(self._joints):
            raise ConfigError(
                f"{name} names {', '.join(value)}; it must name all of {', '.join(self._joints)}, or be one number"
            )
        return tuple(float(value[joint]) for joint in self._joints)


def leader_config(options: Mapping[str, Any]) -> TeleoperatorConfig:
    """The leader's configuration from its options.

    Raises:
        ConfigError: LeRobot has no such leader or option.
    """
    if "type" not in options:
        raise ConfigError("leader needs a type: --teleop.leader='{type: koch_leader, port: /dev/ttyACM0, id: mine}'")
    if options["type"] == TauextLeader.name:
        raise ConfigError("leader: a tauext_leader cannot wrap itself")
    try:
        return draccus.decode(TeleoperatorConfig, dict(options))
    except draccus.utils.DecodingError as error:
        raise ConfigError(f"leader: {error}") from error


def radians_a_unit(leader: Any, joints: tuple[str, ...], unit: str) -> dict[str, float]:
    """Radians per unit of `<joint>.pos`.

    LeRobot's buses report degrees, or shares of a calibrated range from -100 or 0 to 100.

    Args:
        unit: unit of a leader without such a bus, "deg" or "rad".

    Raises:
        ConfigError: a range is not calibrated, or the unit is invalid.
    """
    bus = getattr(leader, "bus", None)
    motors = getattr(bus, "motors", {})
    if unit not in UNITS:
        raise ConfigError(f"position_unit = {unit!r} must be one of {', '.join(UNITS)}")
    return {joint: _of_motor(bus, joint) if joint in motors else UNITS[unit] for joint in joints}


def _of_motor(bus: Any, joint: str) -> float:
    mode = getattr(bus.motors[joint].norm_mode, "value", bus.motors[joint].norm_mode)
    if mode == "degrees":
        return math.pi / 180
    if joint not in bus.calibration:
        raise ConfigError(f"joint '{joint}' reports its position as a share of a range that is not calibrated")
    spans = {"range_m100_100": 200, "range_0_100": 100}
    if mode not in spans:
        raise ConfigError(f"joint '{joint}' reports its position as {mode}, not one of degrees, {', '.join(spans)}")
    calibration, resolution = bus.calibration[joint], bus.model_resolution_table[bus.motors[joint].model]
    return (calibration.range_max - calibration.range_min) / spans[mode] * 2 * math.pi / resolution
