"""Sends torque to a leader's motors, for each kind of LeRobot bus."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any, Protocol

from tauext_lerobot.servo_series import DYNAMIXEL

from tauext.data.servo_types import SERVO_TYPES
from tauext.errors import ConfigError

AMPERE_A_COUNT = {name: ampere for name, ampere in DYNAMIXEL.models.values() if ampere is not None}
"""Unit of Goal Current, [A]: that of the current. Servos that measure none have no current mode."""
NM_PER_AMPERE = {"xl330-m077": 0.215 / 1.47, "xm540-w270": 10.6 / 4.4}
"""Stall torque over stall current of the e-Manual, at 5 and 12 V. SERVO_TYPES has priority."""

PerJoint = float | Mapping[str, float] | None


class TorquePort(Protocol):
    """Sends torque to the leader's joints."""

    joints: tuple[str, ...]
    """Joints that it drives."""

    def begin(self) -> None:
        """Prepare the motors of a connected leader for torque, with zero torque."""
        ...

    def write(self, torque_nm: dict[str, float]) -> None:
        """Set the torque of some or all joints, [N m]."""
        ...

    def end(self) -> None:
        """Remove the torque; the motors turn freely."""
        ...


class FeedbackPort:
    """A leader that accepts torque through LeRobot's own send_feedback."""

    def __init__(self, leader: Any, joints: tuple[str, ...]):
        self._leader, self.joints = leader, joints

    def begin(self) -> None:
        self.write(dict.fromkeys(self.joints, 0.0))

    def write(self, torque_nm: dict[str, float]) -> None:
        self._leader.send_feedback({f"{joint}.torque": value for joint, value in torque_nm.items()})

    def end(self) -> None:
        self.begin()


class DynamixelPort:
    """Dynamixel servos in current mode: Goal Current, and their watchdog in case the program dies."""

    def __init__(
        self, bus: Any, joints: tuple[str, ...], nm_per_ampere: PerJoint, now: Callable[[], float] = time.monotonic
    ):
        self._bus, self.joints, self._now = bus, joints, now
        self._counts_a_nm = {}
        for joint in joints:
            model = bus.motors[joint].model
            known = SERVO_TYPES[model].nm_per_ampere if model in SERVO_TYPES else NM_PER_AMPERE.get(model)
            given = nm_per_ampere.get(joint) if isinstance(nm_per_ampere, Mapping) else nm_per_ampere
            constant = given or known
            if not constant or not constant > 0:
                raise ConfigError(f"joint '{joint}': torque constant of {model} is unknown; set nm_per_ampere")
            self._counts_a_nm[joint] = 1 / (constant * AMPERE_A_COUNT[model])
        self._written_s: float | None = None

    def begin(self) -> None:
        self._bus.disable_torque(list(self.joints))
        for joint in self.joints:
            self._bus.write("Operating_Mode", joint, 0)  # current control
        self._bus.enable_torque(list(self.joints))
        self._written_s = None
        self.write(dict.fromkeys(self.joints, 0.0))

    def write(self, torque_nm: dict[str, float]) -> None:
        now = self._now()
        if self._written_s is None or now - self._written_s > 0.1:  # half the watchdog's time
            for joint in self.joints:  # a triggered watchdog refuses goals until it is set to 0
                self._bus.write("Bus_Watchdog", joint, 0)
                self._bus.write("Bus_Watchdog", joint, 10)  # units of 20 ms: without packets for so long it stops
        counts = {joint: round(value * self._counts_a_nm[joint]) for joint, value in torque_nm.items()}
        self._bus.sync_write("Goal_Current", counts, normalize=False)
        self._written_s = now

    def end(self) -> None:
        self.write(dict.fromkeys(self.joints, 0.0))
        for joint in self.joints:
            self._bus.write("Bus_Watchdog", joint, 0)
        self._bus.disable_torque(list(self.joints))


class DamiaoPort:
    """Damiao motors in MIT mode without stiffness: torque only."""

    def __init__(self, bus: Any, joints: tuple[str, ...]):
        self._bus, self.joints = bus, joints

    def begin(self) -> None:
        self._bus.enable_torque(list(self.joints))
        self.write(dict.fromkeys(self.joints, 0.0))

    def write(self, torque_nm: dict[str, float]) -> None:
        self._bus._mit_control_batch({joint: (0.0, 0.0, 0.0, 0.0, value) for joint, value in torque_nm.items()})

    def end(self) -> None:
        self.write(dict.fromkeys(self.joints, 0.0))
        self._bus.disable_torque(list(self.joints))


def torque_port(leader: Any, joints: list[str], nm_per_ampere: PerJoint) -> TorquePort:
    """The torque port of a leader.

    Args:
        joints: joints with feedback; empty: all that accept torque but "gripper".

    Raises:
        ConfigError: the motors accept no torque, or the leader has no such joint.
    """
    features = leader.feedback_features
    bus: Any = getattr(leader, "bus", None)
    kind = type(bus).__name__
    if by_feedback := [key.removesuffix(".torque") for key in features if key.endswith(".torque")]:
        return FeedbackPort(leader, _chosen(leader, joints, by_feedback))
    if kind == "DynamixelMotorsBus":
        chosen = _chosen(leader, joints, list(bus.motors))
        others = {joint: bus.motors[joint].model for joint in chosen if bus.motors[joint].model not in AMPERE_A_COUNT}
        if others:
            raise ConfigError(
                f"leader {leader.name}: {others} cannot take torque: they have no current mode, or its unit "
                f"is unknown; leave them out of joints, or use one of {', '.join(AMPERE_A_COUNT)}"
            )
        return DynamixelPort(bus, chosen, nm_per_ampere)
    if kind == "DamiaoMotorsBus" and hasattr(bus, "_mit_control_batch"):
        return DamiaoPort(bus, _chosen(leader, joints, list(bus.motors)))
    why = "its servos accept positions, not torque" if kind == "FeetechMotorsBus" else "it has no motors that accept it"
    raise ConfigError(
        f"leader {leader.name} cannot take torque: {why}; leaders that can: koch_leader and omx_leader (Dynamixel, by "
        "current), openarm_leader (Damiao), and any with <joint>.torque among its feedback_features"
    )


def _chosen(leader: Any, joints: list[str], there: list[str]) -> tuple[str, ...]:
    for joint in joints:
        if joint not in there:
            raise ConfigError(
                f"joints: leader {leader.name} has no motor '{joint}' that accepts torque; it has {', '.join(there)}"
            )
    return tuple(joints) or tuple(joint for joint in there if joint != "gripper")
