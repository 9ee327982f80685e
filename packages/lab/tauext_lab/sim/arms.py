"""Arms with geared drives: what moves, and how it is driven."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.resources import files

import mujoco
import numpy as np

from tauext import _core
from tauext_lab.sim.config import DriveConfig, FrictionConfig, MotionConfig, RigConfig, SensorConfig, changed_friction
from tauext_lab.sim.rig import LINK_SPACING_M, add_drivetrain, arm_xml, joint_names


@dataclass(frozen=True)
class GearedArm:
    """One arm with drives, friction, instruments (a tauext_lab.sim Drivetrain) and motion."""

    name: str
    xml: str
    """MJCF of the bare arm: what is simulated, and what the monitor's model is read from."""
    joints: tuple[str, ...]
    drives: tuple[DriveConfig, ...]
    friction: tuple[FrictionConfig, ...]
    sensors: SensorConfig
    motion: MotionConfig
    rotor_inertia_kg_m2: tuple[float, ...]
    home: tuple[float, ...]
    """Middle of the motion, [rad]."""
    rate_hz: int = 1000
    hand_m: float | None = None
    """Along the last joint's axis from the last link's origin, where a weight in the hand has its centre, [m]; None:
    the arm has no hand."""

    @cached_property
    def model(self) -> mujoco.MjModel:
        """The arm with drives, friction and sensors, compiled; bodies are in the order of the joints."""
        return self.changed_model(1.0)

    def changed_model(self, friction: float, held: _core.Load | None = None) -> mujoco.MjModel:
        """The arm with its friction times a factor, and with a weight in its hand: one more body behind the links."""
        spec = mujoco.MjSpec.from_string(self.xml)
        if held is not None:
            spec.joint(self.joints[-1]).parent.add_body(
                name="held", mass=held.mass, ipos=held.com, fullinertia=held.inertia, explicitinertial=True
            )
        add_drivetrain(spec, self.joints, replace(self, friction=changed_friction(self.friction, friction)))
        spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
        return spec.compile()


def rig_arm() -> GearedArm:
    """The paper's two-axis rig, with drums at its joints to make them visible."""
    config = RigConfig()
    spec = mujoco.MjSpec.from_string(arm_xml(config, true_com=True))
    for i, link in enumerate(joint_names(config)):
        body = spec.joint(link).parent
        body.geoms[0].contype = 0
        body.add_geom(
            name=f"drum{i + 1}",
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[0.075, 0.5 * LINK_SPACING_M - 0.002, 0.0],
            pos=[0.0, (i - 0.5) * LINK_SPACING_M, 0.0],
            quat=[np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0],
            contype=0,
            conaffinity=0,
            mass=0.0,
        )
    spec.compile()
    return GearedArm(
        name="rig",
        xml=spec.to_xml(),
        joints=tuple(joint_names(config)),
        drives=config.drives,
        friction=config.friction,
        sensors=config.sensors,
        motion=config.motion,
        rotor_inertia_kg_m2=config.rotor_inertia_kg_m2,
        home=(0.0, 0.0),
    )


def seven_axis_arm() -> GearedArm:
    """A seven-axis arm of 18.5 kg with geared drives, of no manufacturer."""
    sizes = np.array([1.0, 1.0, 0.8, 0.8, 0.4, 0.4, 0.3])
    return GearedArm(
        name="seven",
        xml=files("tauext_lab.sim").joinpath("seven.xml").read_text(),
        joints=tuple(f"joint{i + 1}" for i in range(7)),
        drives=tuple(DriveConfig(stiffness_nm_rad=4000.0 * s, damping_nm_s_rad=100.0 * s) for s in sizes),
        friction=tuple(_geared(6.0 * s) for s in sizes),
        sensors=SensorConfig(encoder_counts=2**20, torque_noise_nm=tuple(0.5 * sizes), jts_noise_nm=tuple(0.1 * sizes)),
        motion=MotionConfig(range_deg=50.0, mean_speed_deg_s=(15.0, 35.0), least_travel_deg=25.0),
        rotor_inertia_kg_m2=(0.58, 0.58, 0.47, 0.47, 0.2, 0.2, 0.18),
        home=(0.0, 0.3, 0.0, -1.4, 0.0, 0.9, 0.0),
        hand_m=0.2,
    )


def _geared(coulomb_nm: float) -> FrictionConfig:
    """Friction of a geared joint in proportion to its Coulomb part, as that of the rig is."""
    return FrictionConfig(
        coulomb_nm=coulomb_nm,
        static_nm=1.25 * coulomb_nm,
        load_share=0.0,
        stribeck_rad_s=0.05,
        viscous_nm_s_rad=0.95 * coulomb_nm,
        bristle_nm_rad=1250.0 * coulomb_nm,
        bristle_damping_nm_s_rad=5.0 * coulomb_nm,
        ripple_nm=0.06 * coulomb_nm,
        ripple_cycles=200,
    )


ARMS: dict[str, Callable[[], GearedArm]] = {"rig": rig_arm, "seven": seven_axis_arm}
