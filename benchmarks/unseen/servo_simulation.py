"""The servo arm in MuJoCo: gear and link of each joint joined through a gap, stepped by servo_steps.cpp."""

from __future__ import annotations

import ctypes
import itertools
import os
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from tauext import _core
from unseen.servos import COUNT_RAD, OUTPUT_SHARE
from unseen.simulation import specification
from unseen.so101 import ServoArm

PHYSICS_HZ = 2000
TICKS_HZ = 1000
"""Of the servos' own loop."""
COMMAND_TICKS = 5
"""From the writing of a goal until a servo follows it (BAM: 5.0 ms)."""
DRY_SOLVER = ((0.002, 1.0), (0.9999, 0.9999, 0.001, 0.5, 2.0))
"""How hard MuJoCo holds dry friction: what stands creeps by less than 1e-4 rad/s."""
STOP_SOLVER = ((0.002, 1.0), (0.95, 0.99, 0.001, 0.5, 2.0))
"""How hard the ends of the backlash are."""
SAMPLE = ("q", "dq", "goal", "duty", "supply_a", "speed", "motor_nm", "load_nm", "tau_ext")
SHAPES = ("impact", "push", "wall")
"""Half sine; ramps up and down; a spring that stands where the link is as the touch begins."""


@dataclass(frozen=True)
class Touch:
    """What touches the arm once; `Contact` of these arms, whose strength is a torque."""

    shape: str
    from_s: float
    to_s: float
    link: int
    at_m: tuple[float, float, float]
    """In the link's axes."""
    direction: tuple[float, float, float]
    """In the world; impacts and walls act against the motion instead, where there is any."""
    peak: float
    """Most torque that it exerts on a joint as it begins, [N m]; of a wall, its stiffness, [N/m]."""
    rise_s: float = 0.1

    def row(self) -> list[float]:
        shape = float(SHAPES.index(self.shape))
        return [self.from_s, self.to_s, self.link, *self.at_m, *self.direction, self.peak, self.rise_s, shape]


@dataclass(frozen=True)
class ServoRun:
    """True signals at the bus's samples, (samples, joints): see SAMPLE; and the voltage, (samples,)."""

    ticks: np.ndarray
    signals: dict[str, np.ndarray]
    volts: np.ndarray


def backlash_model(arm: ServoArm) -> mujoco.MjModel:
    """Two joints about one axis a link: the gear, with the rotor's inertia and friction, and the gap beside it.

    The bearing of the output shaft rubs on the sum of the two, which is the link's angle: a tendon.
    """
    number = itertools.count()

    def join(body: mujoco.MjsBody, link: _core.Link) -> None:
        turn, j = {"type": mujoco.mjtJoint.mjJNT_HINGE, "axis": [0, 0, 1]}, next(number)
        body.add_joint(name=f"gear{j}", **turn, armature=link.rotor_inertia)
        body.add_joint(name=f"gap{j}", **turn, range=[-1, 1], limited=mujoco.mjtLimited.mjLIMITED_TRUE)

    spec = specification(arm.tree, PHYSICS_HZ, join)
    for j, coulomb in enumerate(arm.servos.coulomb_nm):
        shaft = spec.add_tendon(frictionloss=OUTPUT_SHARE * coulomb)
        shaft.wrap_joint(f"gear{j}", 1.0)
        shaft.wrap_joint(f"gap{j}", 1.0)
    model = spec.compile()
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    gear, gap = np.arange(0, model.nv, 2), np.arange(1, model.nv, 2)
    model.jnt_range[gap] = np.outer(arm.servos.backlash_rad / 2, [-1, 1])  # a specification counts in degrees
    model.dof_damping[gear], model.dof_damping[gap] = arm.servos.viscous_nm_s_rad, 1e-4
    model.dof_frictionloss[gear] = arm.servos.coulomb_nm  # > 0 from the start, or the solver makes no room for it
    model.dof_solref[gear], model.dof_solimp[gear] = DRY_SOLVER
    model.tendon_solref_fri[:], model.tendon_solimp_fri[:] = DRY_SOLVER
    model.jnt_solref[gap], model.jnt_solimp[gap] = STOP_SOLVER
    return model


def simulate_servos(
    arm: ServoArm, goals: np.ndarray, rate_hz: float, touches: Sequence[Touch], build_in: Path
) -> ServoRun:
    """The arm follows goals, (samples, joints), [rad], each written as the servos are read, at `rate_hz`.

    A goal is that of the register: whole counts. Samples are taken at the servos' ticks of 1 ms.

    Args:
        build_in: folder where the compiled steps are kept.
    """
    model = backlash_model(arm)
    data = mujoco.MjData(model)
    gears = replace(arm.servos, coulomb_nm=(1 - OUTPUT_SHARE) * arm.servos.coulomb_nm)
    table, goals = gears.table(), np.ascontiguousarray(np.round(goals / COUNT_RAD) * COUNT_RAD)
    data.qpos[::2] = goals[0]
    samples, n = goals.shape
    ticks = np.round(np.arange(samples) * TICKS_HZ / rate_hz).astype(np.int32)
    acts = (ticks + COMMAND_TICKS).astype(np.int32)
    out, volts = np.zeros((samples, n, len(SAMPLE))), np.zeros(samples)
    rows = np.array([touch.row() for touch in touches], dtype=np.float64)
    taken = _steps(build_in)(
        model._address, data._address, _address(table), n, arm.volts, arm.supply_ohm, COUNT_RAD,
        _address(goals), _address(acts), samples, _address(rows), len(touches),
        _address(ticks), samples, _address(out), _address(volts),
    )  # fmt: skip
    if taken != samples or not np.isfinite(out).all() or data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number:
        raise RuntimeError("the simulation diverged")
    return ServoRun(ticks, {name: out[:, :, k].copy() for k, name in enumerate(SAMPLE)}, volts)


def _address(values: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(values.ctypes.data)


def _steps(folder: Path) -> ctypes._CFuncPtr:  # type: ignore[name-defined]
    """servo_steps(), compiled where it is not there or older than its source."""
    source, compiled = Path(__file__).with_name("servo_steps.cpp"), folder / "servo_steps.so"
    if not compiled.exists() or compiled.stat().st_mtime < source.stat().st_mtime:
        folder.mkdir(parents=True, exist_ok=True)
        library = Path(mujoco.__file__).parent
        engine = next(library.glob("libmujoco.so*"))
        made = compiled.with_suffix(f".{os.getpid()}")
        command = [
            os.environ.get("CXX", "g++"),
            "-std=c++20",
            "-O2",
            "-shared",
            "-fPIC",
            "-Wall",
            f"-I{library}/include",
        ]
        subprocess.run([*command, str(source), str(engine), f"-Wl,-rpath,{library}", "-o", str(made)], check=True)
        made.replace(compiled)
    pointer, whole, number = ctypes.c_void_p, ctypes.c_int, ctypes.c_double
    steps = ctypes.CDLL(str(compiled)).servo_steps
    steps.restype = whole
    steps.argtypes = [
        pointer, pointer, pointer, whole, number, number, number, pointer, pointer, whole, pointer, whole,
        pointer, whole, pointer, pointer,
    ]  # fmt: skip
    return steps
