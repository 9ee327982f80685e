"""The virtual rig: its arm, scene, motions and sensors, and an open-loop rollout."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, fields
from typing import Literal

import mujoco
import numpy as np
from mujoco import rollout

from tauext.errors import ConfigError
from tauext_lab.sim.config import Drivetrain, FrictionConfig, MotionConfig, RigConfig

# --- Quintic moves between random joint targets: the setpoints of free motion.


def quintic(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Share of a move that is done at share `s` of its time, and its derivative by s.

    10 s^3 - 15 s^4 + 6 s^5: velocity and acceleration vanish at both ends, the peak speed is 15/8 of the mean.
    Before 0 the move has not begun, after 1 it is done.
    """
    s = np.clip(s, 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2), 30.0 * (s * (1.0 - s)) ** 2


def draw_move(config: MotionConfig, pose: np.ndarray, rng: np.random.Generator) -> tuple[float, np.ndarray, float]:
    """Pause before the next move from a pose (joints,), [s]; its travel (joints,), [rad]; its duration, [s]."""
    reach = np.deg2rad(config.range_deg)
    pause_s = rng.uniform(*config.pause_s)
    travel = rng.uniform(-reach, reach, len(pose)) - pose
    while np.abs(travel).max() < np.deg2rad(config.least_travel_deg):
        travel = rng.uniform(-reach, reach, len(pose)) - pose
    return pause_s, travel, np.abs(travel).max() / np.deg2rad(rng.uniform(*config.mean_speed_deg_s))


def draw_motion(
    config: MotionConfig, joints: int, samples: int, rate_hz: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Setpoints q_des, dq_des of one recording, each (samples, joints), [rad], [rad/s].

    A recording begins at rest in a random pose, with a pause; it ends wherever the clock cuts the last move.
    """
    reach = np.deg2rad(config.range_deg)
    q_des, dq_des = np.empty((samples, joints)), np.zeros((samples, joints))
    pose, start = rng.uniform(-reach, reach, joints), 0
    while start < samples:
        pause_s, travel, duration_s = draw_move(config, pose, rng)
        pause = round(pause_s * rate_hz)
        end = min(start + pause + round(duration_s * rate_hz), samples)
        done, rate = quintic((np.arange(start, end) - start - pause)[:, None] / (duration_s * rate_hz))
        q_des[start:end] = pose + travel * done
        dq_des[start:end] = travel * rate / duration_s
        pose, start = pose + travel, end
    return q_des, dq_des


# --- The plain arm as MJCF: an integrator's model of it, and the base of every scene.


LINK_RADIUS_M = 0.05
LINK_SPACING_M = 0.12
"""Links lie side by side, one plane each, so that the arm can fold; the motion itself is planar."""


def joint_names(config: RigConfig) -> list[str]:
    """Names of the joints, from the base outward."""
    return [f"joint{i + 1}" for i in range(len(config.links))]


def arm_xml(config: RigConfig, true_com: bool = False) -> str:
    """MJCF of a planar arm in the vertical x-z plane, joints about +y, upright where every joint is zero.

    Holds links, masses and rotor inertia, neither friction nor actuators.

    Args:
        true_com: the arm that is simulated; False: the robot file, whose centres of mass may differ from it.
    """
    lines = [
        f'<mujoco model="{config.name}">',
        '  <compiler angle="radian"/>',
        f'  <option timestep="{1.0 / config.rate_hz!r}" integrator="Euler">',
        '    <flag eulerdamp="disable"/>',
        "  </option>",
        "  <worldbody>",
    ]
    offset_m = 0.0
    for i, link in enumerate(config.links):
        pad, com_m = "  " * (i + 2), link.true_com_m if true_com else link.com_m
        lines += [
            f'{pad}<body name="link{i + 1}" pos="0 0 {offset_m!r}">',
            f'{pad}  <joint name="joint{i + 1}" type="hinge" axis="0 1 0" armature="{link.rotor_inertia_kg_m2!r}"/>',
            f'{pad}  <inertial pos="0 0 {com_m!r}" mass="{link.mass_kg!r}" '
            f'diaginertia="{link.inertia_kg_m2!r} {link.inertia_kg_m2!r} {_axial_inertia(link.mass_kg)!r}"/>',
            f'{pad}  <geom name="link{i + 1}" type="capsule" size="{LINK_RADIUS_M!r}" contype="1" conaffinity="0" '
            f'fromto="0 {i * LINK_SPACING_M!r} 0 0 {i * LINK_SPACING_M!r} {link.length_m!r}"/>',
        ]
        offset_m = link.length_m
    lines += ["  " * (i + 2) + "</body>" for i in reversed(range(len(config.links)))]
    lines += ["  </worldbody>", "</mujoco>"]
    return "\n".join(lines) + "\n"


def _axial_inertia(mass_kg: float) -> float:
    """Inertia of a solid cylinder about its own axis: never felt in planar motion, but a body needs one."""
    return 0.5 * mass_kg * LINK_RADIUS_M**2


# --- The simulated scene: the plain arm plus drives, friction, and what may touch it.


Kind = Literal["free", "pulses", "pads"]
"""Contacts that are possible in a recording: nothing, force pulses, or padded bodies."""
PULSE_GEARS = ((1, 0, 0, 0, 0, 0), (0, 0, 1, 0, 0, 0), (0, 0, 0, 0, 1, 0))
"""Actuators that pull on a link: force along its x and z, torque about the plane's normal, at and in the link's
frame."""


PADDING_IMPEDANCE = (0.2, 0.95, 0.01, 0.5, 2.0)
"""MuJoCo's solimp of a pad: hardens from 0.2 to 0.95 over its first centimetre, so that a touch begins softly."""


def build_scene(config: RigConfig, kind: Kind) -> mujoco.MjModel:
    """Compile the arm with its drives and friction, and with the means to touch it.

    Controls run: per joint (q_des, dq_des); then per link the three of PULSE_GEARS, or per pad and axis (x, y, z) the
    pair (position, velocity). Sensors run: per joint (drive, bristles and ripple, all actuators); then per link, with
    pads, (found, force xyz, torque xyz, position xyz) of what touches it. Joints of the arm come before those of pads.

    Friction is in a second, passive dcmotor, since a dcmotor reports its force net of its own friction: so the
    drive's sensor reads the commanded torque alone.
    """
    spec = mujoco.MjSpec.from_string(arm_xml(config, true_com=True))
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
    """Put drive, friction and the three sensors that build_scene describes on each of these joints, in this order."""
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
            name=name, type=mujoco.mjtSensor.mjSENS_JOINTACTFRC, objtype=mujoco.mjtObj.mjOBJ_JOINT, objname=name
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


# --- Setpoints in, true signals out: one open-loop rollout of a scene.


LOAD_HELD_S = 0.01
"""Load-dependent friction follows the gear's mean load over so long; at 1.6 rad/s gravity changes by 2 % meanwhile."""
COULOMB_STATIC = slice(3, 5)
"""Where a dcmotor's biasprm holds the two."""
DIVERGED = (mujoco.mjtWarning.mjWARN_BADQPOS, mujoco.mjtWarning.mjWARN_BADQVEL, mujoco.mjtWarning.mjWARN_BADQACC)


@dataclass(frozen=True)
class Truth:
    """True signals of one recording, each (samples, joints); sample k holds from t_k to t_{k+1}."""

    q: np.ndarray
    dq: np.ndarray
    ddq: np.ndarray
    """(dq_{k+1} - dq_k) / dt, the acceleration of the step that starts at sample k."""
    drive: np.ndarray
    """Torque of the drive, friction not subtracted."""
    friction: np.ndarray
    """Torque that friction and ripple take: positive against motion in the positive direction."""
    others: np.ndarray
    """Joint torque of every other actuator (pulses)."""
    touch: np.ndarray
    """Contact sensors, (samples, links, 10): found, force xyz, torque xyz, position xyz; no links without pads."""

    def after(self, samples: int) -> Truth:
        """The signals without their first samples."""
        return Truth(**{f.name: getattr(self, f.name)[samples:] for f in fields(self)})


def set_load(model: mujoco.MjModel, friction: Sequence[FrictionConfig], load_nm: np.ndarray) -> None:
    """Set the Coulomb and static friction of each joint under this load (joints,), [N m]; see FrictionConfig."""
    n = len(friction)
    for joint, one, load in zip(range(n), friction, np.abs(load_nm), strict=True):
        both = np.array([one.coulomb_nm, one.static_nm]) + one.load_share * load
        model.actuator_biasprm[n + joint, COULOMB_STATIC] = both


def roll_out(config: Drivetrain, model: mujoco.MjModel, q_start: np.ndarray, controls: np.ndarray) -> Truth:
    """Simulate a scene from rest at `q_start` (every position, pads included) under `controls` (samples, nu).

    Raises:
        ConfigError: the simulation diverged.
    """
    n = len(config.drives)
    data = mujoco.MjData(model)
    data.qpos[:] = q_start
    state = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, state, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    states, sensors = _roll(config, model, data, state, controls)
    if any(data.warning[kind].number for kind in DIVERGED):
        raise ConfigError(
            f"the simulation of {config.name} diverged; damping / rate_hz of drives and friction must stay well below "
            "the inertia that they move, and stiffness / rate_hz^2 too"
        )
    states = np.vstack([state, states])
    q, dq = states[:, 1 : 1 + n], states[:, 1 + model.nq : 1 + model.nq + n]
    drive, bristles, actuators = (sensors[:, k : 3 * n : 3] for k in range(3))
    viscous = dq[:-1] * [friction.viscous_nm_s_rad for friction in config.friction]
    return Truth(
        q=q[:-1].copy(),
        dq=dq[:-1].copy(),
        ddq=np.diff(dq, axis=0) * config.rate_hz,
        drive=drive.copy(),
        friction=viscous - bristles,
        others=actuators - drive - bristles,
        touch=sensors[:, 3 * n :].reshape(len(controls), (sensors.shape[1] - 3 * n) // 10, 10).copy(),
    )


def _roll(
    config: Drivetrain, model: mujoco.MjModel, data: mujoco.MjData, state: np.ndarray, controls: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """States after each step (samples, nstate) and its sensors (samples, nsensordata), from `state` on."""
    loaded = any(joint.load_share for joint in config.friction)
    held = round(LOAD_HELD_S * config.rate_hz) if loaded else len(controls)
    if loaded:
        model = copy(model)
    n, parts = len(config.drives), []
    velocity = slice(1 + model.nq, 1 + model.nq + n)
    viscous = np.array([joint.viscous_nm_s_rad for joint in config.friction])
    rotor = np.array(config.rotor_inertia_kg_m2) * config.rate_hz
    with rollout.Rollout(nthread=0) as roller:
        for begin in range(0, len(controls), held):
            states, sensors = (
                one[0] for one in roller.rollout(model, data, state[None], controls[None, begin : begin + held])
            )
            parts.append((states, sensors))
            if loaded:
                drive, bristles = (sensors[:, k : 3 * n : 3].mean(axis=0) for k in range(2))
                change = (states[-1, velocity] - state[velocity]) / len(states)
                mean_speed = states[:, velocity].mean(axis=0)
                set_load(model, config.friction, drive + bristles - viscous * mean_speed - rotor * change)
            state = states[-1]
    states, sensors = (np.concatenate(column) for column in zip(*parts, strict=True))
    return states, sensors


# --- What the rig's instruments make of the true signals: quantised position, filtered difference, noise, low-pass.


def low_pass(x: np.ndarray, cutoff_rad_s: float, dt_s: float) -> np.ndarray:
    """First-order low-pass over axis 0: y_k = a y_{k-1} + (1 - a) x_k, a = exp(-cutoff dt), y_{-1} = x_0.

    Starts settled on the first sample. The sum over the past is built by doubling: after m rounds y holds the last 2^m
    samples, and the weight of what is older soon is nothing.
    """
    a = np.exp(-cutoff_rad_s * dt_s)
    y = (1.0 - a) * x
    y[0] = x[0]
    shift, weight = 1, a
    while shift < len(y) and weight > 1e-18:
        y[shift:] = y[shift:] + weight * y[:-shift]
        shift, weight = 2 * shift, weight * weight
    return y


def encoder(q: np.ndarray, counts: int) -> np.ndarray:
    """Position as an encoder with `counts` in one turn reads it, [rad]."""
    step = 2.0 * np.pi / counts
    return np.round(q / step) * step


def velocity(q_measured: np.ndarray, cutoff_rad_s: float, dt_s: float) -> np.ndarray:
    """Velocity as a drive computes it: low-passed difference of the measured positions, [rad/s]."""
    dq = np.diff(q_measured, axis=0, prepend=2.0 * q_measured[:1] - q_measured[1:2]) / dt_s
    return low_pass(dq, cutoff_rad_s, dt_s)


def measure(config: Drivetrain, truth: Truth, tau_ext: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Measured signals of one recording, each (samples, joints), named as a Recording names them.

    The joint torque sensor reads tau_jts = drive - friction - rotor inertia * ddq plus noise: what the drive exerts on
    the link. Its external torque is LP(M ddq + C dq + g - tau_jts) with the true model without rotor inertia and the
    simulator's ddq. The simulator obeys M ddq + C dq + g = drive - friction - rotor inertia * ddq + tau_ext to
    rounding, so the bracket is tau_ext less the sensor's noise, and is taken as that.

    Args:
        tau_ext: true external torque (samples, joints), [N m].
    """
    sensors, dt_s = config.sensors, 1.0 / config.rate_hz
    q = encoder(truth.q, sensors.encoder_counts)
    tau_noise = rng.standard_normal(q.shape) * sensors.torque_noise_nm
    jts_noise = rng.standard_normal(q.shape) * sensors.jts_noise_nm
    rotor = truth.ddq * config.rotor_inertia_kg_m2
    return {
        "q": q,
        "dq": velocity(q, sensors.velocity_cutoff_rad_s, dt_s),
        "tau": truth.drive + tau_noise,
        "tau_jts": truth.drive - truth.friction - rotor + jts_noise,
        "tau_ext_sensor": low_pass(tau_ext - jts_noise, sensors.reference_cutoff_rad_s, dt_s),
    }
