"""Settings of a leader with force feedback."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, cast

from lerobot.teleoperators import TeleoperatorConfig
from tauext_lerobot.leader_feedback import FeedbackSettings


@TeleoperatorConfig.register_subclass("tauext_leader")
@dataclass
class TauextLeaderConfig(TeleoperatorConfig):
    """The wrapped leader and its feedback. A number for all joints can be replaced by {joint: number}."""

    # The leader: its type and options. A dictionary, since LeRobot's parser cannot parse a leader inside a leader.
    leader: dict[str, Any] = field(default_factory=dict)
    # Joints with feedback; empty: all but "gripper", whose motor acts as the trigger's spring.
    joints: list[str] = field(default_factory=list)
    # Largest torque of the leader's motors, [N m]. Start low: see the README.
    cap_nm: float | dict[str, float] = cast(float, FeedbackSettings.cap_nm)
    # Leader torque per tau_ext beyond the dead band; negative if the leader's joint turns the other way.
    gain: float | dict[str, float] = 0.5
    # Dead band in standard errors of tau_ext, if the observation has them (<joint>.tau_ext_sigma).
    dead_band_sigmas: float | dict[str, float] = cast(float, FeedbackSettings.dead_band_sigmas)
    # Least dead band, [N m]; required if the observation has no standard errors.
    dead_band_nm: float | dict[str, float] | None = None
    # Fastest change of the torque, [N m/s].
    slew_nm_s: float = 5.0
    # Damping of the leader's motion during feedback, [N m s/rad].
    damping_nm_s_rad: float | dict[str, float] = 0.0
    # Energy that the motors may deliver at once, [J].
    tank_j: float = 0.02
    # Torque constant of the leader's servos, [N m/A], if their type is unknown.
    nm_per_ampere: float | dict[str, float] | None = None
    # Unit of positions of a leader without a LeRobot servo bus: "deg" or "rad".
    position_unit: str = "deg"
    # Time without an observation after which the torque fades, [s].
    silence_s: float = 0.2
