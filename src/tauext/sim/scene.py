"""The simulated scene: the plain arm plus drives, friction, and what may touch it."""

from collections.abc import Sequence
from typing import Literal

import mujoco

from tauext.sim.arm import arm_xml, joint_names
from tauext.sim.config import Drivetrain, RigConfig

Kind = Literal["free", "pulses", "pads"]
"""What may touch the arm in a recording: nothing, force pulses, or padded bodies."""
PULSE_GEARS = ((1, 0, 0, 0, 0, 0), (0, 0, 1, 0, 0, 0), (0, 0, 0, 0, 1, 0))
"""What pulls on a link: force along its x and z, torque about the plane's normal, at and in the link's frame."""


PADDING_IMPEDANCE = (0.2, 0.95, 0.01, 0.5, 2.0)
"""MuJoCo's solimp of a pad: hardens from 0.2 to 0.95 over its first centimetre, so that a touch begins softly."""


def build_scene(config: RigConfig, kind: Kind) -> mujoco.MjModel:
    """Compile the arm with its drives and friction, and with the means to touch it.

    Controls run: per joint (q_des, dq_des); then per link the three of PULSE_GEARS, or per pad and axis (x, y, z) the
    pair (position, velocity). Sensors run: per joint (drive, bristles and ripple, all actuators); then per link, with
    pads, (found, force xyz, torque xyz, position xyz) of what touches it. Joints of the arm come before those of pads.

    Friction stands in a second, passive dcmotor, since a dcmotor reports its force net of its own friction: so the
    drive's sensor reads the commanded torque alone.
    """
    spec = mujoco.MjSpec.from_string(arm_xml(config))
    names = joint_names(config)
    add_drivetrain(spec, names, config)
    for i in range(len(names)):
        if kind == "pulses":
            _add_pulse_inputs(spec, i)
        elif kind == "pads":
            _add_pad(spec, i, config)
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    return spec.compile()


def add_drivetrain(spec: mujoco.MjSpec, names: Sequence[str], config: Drivetrain) -> None:
    """Put drive, friction and the three sensors that build_scene tells of on each of these joints, in this order."""
    for name, drive in zip(names, config.drives, strict=True):
        _add_drive(spec, name, drive.stiffness_nm_rad, drive.damping_nm_s_rad)
    for name, friction in zip(names, config.friction, strict=True):
        passive = spec.add_actuator(name=f"{name}_friction", target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        passive.set_to_dcmotor(
            motorconst=[0.0, 0.0],
            resistance=1.0,
            cogging=[friction.ripple_nm, friction.ripple_cycles, 0.0],
            lugre=[
                friction.bristle_nm_rad,
                friction.bristle_damping_nm_s_rad,
                friction.coulomb_nm,
                friction.static_nm,
                friction.stribeck_rad_s,
            ],
            ctrlspec=mujoco.mjtCtrlInput.mjINPUT_NONE,
        )
        passive.damping = [friction.viscous_nm_s_rad, 0.0, 0.0]
    for name in names:
        for actuator in (f"{name}_drive", f"{name}_friction"):
            spec.add_sensor(
                name=actuator,
                type=mujoco.mjtSensor.mjSENS_ACTUATORFRC,
                objtype=mujoco.mjtObj.mjOBJ_ACTUATOR,
                objname=actuator,
            )
        spec.add_sensor(
            name=name,
            type=mujoco.mjtSensor.mjSENS_JOINTACTFRC,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            objname=name,
        )


def _add_drive(spec: mujoco.MjSpec, joint: str, stiffness: float, damping: float) -> None:
    """PD drive on a joint with inputs (position, velocity); its gains are in torque (or force) space."""
    drive = spec.add_actuator(name=f"{joint}_drive", target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    drive.set_to_dcmotor(
        motorconst=[1.0, 1.0],
        resistance=1.0,
        controller=[stiffness, 0.0, damping, 0.0, 0.0, 0.0],
        ctrlspec=mujoco.mjtCtrlInput.mjINPUT_POS | mujoco.mjtCtrlInput.mjINPUT_VEL,
    )


def _add_pulse_inputs(spec: mujoco.MjSpec, link: int) -> None:
    """Three actuators that push on a link in its own frame, so that the force follows the link."""
    site = f"link{link + 1}"
    spec.body(site).add_site(name=site)
    for k, gear in enumerate(PULSE_GEARS):
        push = spec.add_actuator(name=f"{site}_pulse{k}", target=site, trntype=mujoco.mjtTrn.mjTRN_SITE, gear=gear)
        push.set_to_motor()


def _add_pad(spec: mujoco.MjSpec, link: int, config: RigConfig) -> None:
    """A padded ball on three driven slides that meets this link alone: the links lie in planes of their own."""
    name, pads = f"pad{link + 1}", config.pads
    body = spec.worldbody.add_body(name=name, gravcomp=1.0)
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_SPHERE,
        size=[pads.radius_m, 0.0, 0.0],
        mass=pads.mass_kg,
        contype=0,
        conaffinity=1,
        solref=[pads.padding_s, 1.0],
        solimp=PADDING_IMPEDANCE,
        priority=1,
    )
    for k, axis in enumerate("xyz"):
        joint = f"{name}_{axis}"
        body.add_joint(name=joint, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[float(k == j) for j in range(3)])
        _add_drive(spec, joint, pads.stiffness_n_m, pads.damping_n_s_m)
    spec.add_sensor(
        name=name,
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=mujoco.mjtObj.mjOBJ_GEOM,
        objname=name,
        reftype=mujoco.mjtObj.mjOBJ_GEOM,
        refname=f"link{link + 1}",
        intprm=[_CONTACT_DATA, _NET_FORCE, 1],
    )


_CONTACT_DATA = sum(
    1 << int(field)
    for field in (
        mujoco.mjtConDataField.mjCONDATA_FOUND,
        mujoco.mjtConDataField.mjCONDATA_FORCE,
        mujoco.mjtConDataField.mjCONDATA_TORQUE,
        mujoco.mjtConDataField.mjCONDATA_POS,
    )
)
_NET_FORCE = 3
