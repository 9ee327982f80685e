"""Settings of a leader that feels."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from lerobot.teleoperators import TeleoperatorConfig

from tauext.monitor.leader_feedback import FeedbackSettings


@TeleoperatorConfig.register_subclass("tauext_leader")
@dataclass
class TauextLeaderConfig(TeleoperatorConfig):
    """What is put around which leader; where one number stands, {joint: number} may stand, too."""

    # The leader: its own options, and its type. A dictionary, since LeRobot's parser follows no type into itself.
    leader: dict[str, Any] = field(default_factory=dict)
    # Joints that are felt; empty: all but "gripper", whose motor is the trigger's spring.
    joints: list[str] = field(default_factory=list)
    # Most torque of the leader's motors, [N m]. Begin low: see the README.
    cap_nm: float | dict[str, float] = FeedbackSettings.cap_nm
    # Torque of the leader over what is felt of tau_ext; negative where the leader's joint turns the other way.
    gain: float | dict[str, float] = 0.5
    # Of tau_ext so many standard errors are not felt, where the follower tells them (<joint>.tau_ext_sigma).
    dead_band_sigmas: float | dict[str, float] = FeedbackSettings.dead_band_sigmas
    # And no less than this, [N m]; needed where the follower tells no standard errors.
    dead_band_nm: float | dict[str, float] | None = None
    # Fastest change of the torque, [N m/s].
    slew_nm_s: float = 5.0
    # Resistance to the leader's motion where something is felt, [N m s/rad].
    damping_nm_s_rad: float | dict[str, float] = 0.0
    # Energy that the motors may give at once, [J].
    tank_j: float = 0.02
    # N m an ampere of the leader's servos, where their type is not known.
    nm_per_ampere: float | dict[str, float] | None = None
    # Positions of a leader that is no servo bus of LeRobot's: "deg" or "rad".
    position_unit: str = "deg"
    # After so long without an observation the torque fades, [s].
    silence_s: float = 0.2
