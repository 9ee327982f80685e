"""Motions, contacts, and the true arm under its drive at 1 kHz in MuJoCo: friction with memory, load and warmth."""

from __future__ import annotations

import ctypes
import os
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
from common import ROOT
from tauext_lab.sim.servo_arm import specification

from tauext import _core
from unseen.arms import Maker, TrueArm, direction

# --- What an integrator would have the arm do: all joints together from pose to pose, pauses between, some of it slow.


SLOW_SHARE = 0.2
PAUSE_SHARE = 0.7
ACCELERATIONS_RAD_S2 = (1.4, 8.0)
"""Most that a programmed move asks of a joint: from a controller's default to what the makers of such arms allow."""
STOP_S = (0.03, 0.08)
"""From the speed of the move to a stand."""
STOP_SPEEDS = (0.15, 0.6)
"""Shares of the most speed at which drives can stop the arm in so short a time."""
STOP_PLACES = (0.3, 0.6)
"""Shares of the time that the whole move would take; a stop from here ends before the move would have."""


Setpoints = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Position, velocity and acceleration, each (samples, joints)."""


def draw_motion(maker: Maker, samples: int, rate_hz: float, rng: np.random.Generator) -> Setpoints:
    """Setpoints of position, velocity and acceleration, each (samples, joints), [rad, rad/s, rad/s^2]; from rest."""
    low, high = np.array(maker.low_rad), np.array(maker.high_rad)
    here, parts, length = rng.uniform(low, high), [], 0
    while length < samples:
        slow = rng.uniform() < SLOW_SHARE
        stops = maker.stop_share > 0 and not slow and rng.uniform() < maker.stop_share
        there = rng.uniform(low, high)
        if slow:  # a short straight piece, as to a fixture
            there = np.clip(here + rng.uniform(-0.25, 0.25, len(here)), low, high)
        shares = (0.02, 0.08) if slow else STOP_SPEEDS if stops else (0.15, 0.85)
        speed = np.array(maker.speed_rad_s) * rng.uniform(*shares)
        s, ds, dds = drawn_move(here, there, speed, rate_hz, rng)
        way = there - here
        if stops:
            at, seconds = round(len(s) * rng.uniform(*STOP_PLACES)), rng.uniform(*STOP_S)
            s, ds, dds = _stopped(s, ds, dds, at, round(seconds * rate_hz), rate_hz)
            there = here + s[-1] * way
        stand = round(rng.uniform(0.2, 3.0) * rate_hz) if stops or rng.uniform() < PAUSE_SHARE else 0
        s = np.append(s, np.full(stand, s[-1]))
        ds, dds = np.append(ds, np.zeros(stand)), np.append(dds, np.zeros(stand))
        parts.append((here + s[:, None] * way, ds[:, None] * way, dds[:, None] * way))
        length, here = length + len(s), there
    q, dq, ddq = (np.concatenate(column)[:samples] for column in zip(*parts, strict=True))
    return q, dq, ddq


def drawn_move(
    here: np.ndarray, there: np.ndarray, speed: np.ndarray, rate_hz: float, rng: np.random.Generator
) -> Setpoints:
    """A share of the way over time, with its derivatives: at this most speed, of an acceleration and form drawn."""
    fastest_s = float((np.abs(there - here) / speed).max())
    square_s2 = float(np.abs(there - here).max()) / rng.uniform(*ACCELERATIONS_RAD_S2)
    if rng.uniform() < 0.5:
        return quintic(fastest_s, square_s2, rate_hz)
    return trapezoid(fastest_s, square_s2, rng.uniform(0.15, 0.4), rate_hz)


class Way:
    """Setpoints from pose to pose, at RATE_HZ."""

    def __init__(self, maker: Maker, rng: np.random.Generator) -> None:
        self.maker, self.rng = maker, rng
        self.low, self.high = np.array(maker.low_rad), np.array(maker.high_rad)
        self.here = rng.uniform(self.low, self.high)
        self.parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
        self.samples = 0

    @property
    def now_s(self) -> float:
        return self.samples / RATE_HZ

    def go(self, there: np.ndarray, seconds: float | None = None) -> None:
        """A move; None: with a speed and acceleration drawn as of ordinary motion."""
        if seconds is not None:
            s, ds, dds = quintic(seconds * 8 / 15, 0.0, RATE_HZ)
        else:
            speed = np.array(self.maker.speed_rad_s) * self.rng.uniform(0.15, 0.85)
            s, ds, dds = drawn_move(self.here, there, speed, RATE_HZ, self.rng)
        way = there - self.here
        self._add(self.here + s[:, None] * way, ds[:, None] * way, dds[:, None] * way)
        self.here = there

    def stand(self, seconds: float) -> None:
        count = round(seconds * RATE_HZ)
        zero = np.zeros((count, len(self.here)))
        self._add(np.tile(self.here, (count, 1)), zero, zero)

    def _add(self, *part: np.ndarray) -> None:
        self.parts.append(part)
        self.samples += len(part[0])

    def setpoints(self) -> Setpoints:
        return tuple(np.concatenate(column) for column in zip(*self.parts, strict=True))


def quintic(fastest_s: float, square_s2: float, rate_hz: float) -> Setpoints:
    """0 to 1 with speed and acceleration zero at both ends; they peak at 15/8 and 10/sqrt(3) of the means.

    Args:
        fastest_s: the way over the most speed, of the joint where that is longest.
        square_s2: the longest way over the most acceleration.
    """
    seconds = max(0.3, fastest_s * 15 / 8, np.sqrt(square_s2 * 10 / np.sqrt(3)))
    x = np.arange(1, round(seconds * rate_hz) + 1) / round(seconds * rate_hz)
    s = 10 * x**3 - 15 * x**4 + 6 * x**5
    return s, (30 * x**2 - 60 * x**3 + 30 * x**4) / seconds, (60 * x - 180 * x**2 + 120 * x**3) / seconds**2


def trapezoid(fastest_s: float, square_s2: float, share: float, rate_hz: float) -> Setpoints:
    """The same with constant acceleration over a share of the time at either end: its steps are jerks."""
    peak = 1 / (1 - share)
    seconds = max(0.3, fastest_s * peak, np.sqrt(square_s2 * peak / share))
    x = np.arange(1, round(seconds * rate_hz) + 1) / round(seconds * rate_hz)
    speed = peak * np.minimum(1, np.minimum(x, 1 - x) / share)
    push = np.where(x < share, peak / share, np.where(x > 1 - share, -peak / share, 0.0))
    rising, falling = peak * x**2 / (2 * share), 1 - peak * (1 - x) ** 2 / (2 * share)
    s = np.where(x < share, rising, np.where(x > 1 - share, falling, peak * (x - share / 2)))
    return s, speed / seconds, push / seconds**2


def _stopped(s: np.ndarray, ds: np.ndarray, dds: np.ndarray, at: int, steps: int, rate_hz: float) -> Setpoints:
    """The move up to sample `at`, then to a stand on its path at constant deceleration, in so many steps."""
    x, seconds = np.arange(1, steps + 1) / steps, steps / rate_hz
    return (
        np.append(s[: at + 1], s[at] + ds[at] * seconds * (x - x**2 / 2)),
        np.append(ds[: at + 1], ds[at] * (1 - x)),
        np.append(dds[: at + 1], np.full(steps, -ds[at] / seconds)),
    )


# --- What touches the arm: impacts, pushes and holds at places drawn by chance, and labels as a person or a skin sets.


LABEL_ERROR_S = 0.03
SHARES = {"impact": 0.45, "push": 0.35, "hold": 0.2}
RANGES = {"impact": ((20, 150), (0.02, 0.1)), "push": ((10, 60), (0.5, 1.0)), "hold": ((10, 40), (2.0, 4.0))}
"""Peak force [N] and duration [s]."""
RISES_S = {"impact": 0.0, "push": 0.15, "hold": 0.3}
"""Of a ramp at both ends; 0: a half sine."""


@dataclass(frozen=True)
class Contact:
    """One force on one link."""

    kind: str
    start_s: float
    end_s: float
    link: int
    share: float
    """Of the way from the link's joint to the next."""
    direction: tuple[float, float, float]
    """In the world; an impact on a moving link acts against its motion instead."""
    peak_n: float
    label_s: tuple[float, float]
    at_m: tuple[float, float, float] | None = None
    """Where on its link, in the link's axes; None: beside the line to the next joint, by `share`."""
    in_link: bool = False
    """The direction is along the link's axes as the touch begins, and then stays in the world."""


def draw_contacts(count: int, length_s: float, links: int, rng: np.random.Generator) -> list[Contact]:
    """So many contacts in order of time, about evenly over the recording, never two at once; the first after 8 s.

    The first link is spared: its joint alone would feel it, and most forces on it turn nothing.
    """
    slot = (length_s - 8.0) / max(1, count)
    contacts = []
    for k in range(count):
        kind = str(rng.choice(list(SHARES), p=list(SHARES.values())))
        (least_n, most_n), (least_s, most_s) = RANGES[kind]
        seconds = rng.uniform(least_s, most_s)
        start = 8.0 + k * slot + rng.uniform(0.05, max(0.1, slot - seconds - 1.5))
        way = direction(rng)
        link, share, peak = int(rng.integers(1, links)), rng.uniform(0.2, 1.0), float(rng.uniform(least_n, most_n))
        begins, ends = (at + rng.uniform(-LABEL_ERROR_S, LABEL_ERROR_S) for at in (start, start + seconds))
        contacts.append(Contact(kind, start, start + seconds, link, share, tuple(way), peak, (begins, ends)))
    return contacts


def label(contacts: Sequence[Contact], time_s: np.ndarray) -> np.ndarray:
    """1 where a label stands, else 0, (samples,); a short impact whose labels cross is labelled for 30 ms."""
    marked = np.zeros(len(time_s), dtype=np.int8)
    for contact in contacts:
        begin, end = contact.label_s
        marked[(time_s >= begin) & (time_s <= max(end, begin + LABEL_ERROR_S))] = 1
    return marked


# --- Compiled steps, built with MuJoCo's headers where they are older than their source.


POINTER, WHOLE, NUMBER = ctypes.c_void_p, ctypes.c_int, ctypes.c_double
BUILT = ROOT / "build" / "steps"


@cache
def compiled(name: str, arguments: tuple[type, ...], result: type | None, function: str = "") -> ctypes._CFuncPtr:  # type: ignore[name-defined]
    """This function of NAME.cpp, by default NAME."""
    source, built = Path(__file__).with_name(f"{name}.cpp"), BUILT / f"{name}.so"
    if not built.exists() or built.stat().st_mtime < source.stat().st_mtime:
        BUILT.mkdir(parents=True, exist_ok=True)
        library = Path(mujoco.__file__).parent
        engine = next(library.glob("libmujoco.so*"))
        made = built.with_suffix(f".{os.getpid()}")
        command = [os.environ.get("CXX", "g++"), *"-std=c++20 -O2 -shared -fPIC -Wall".split(), f"-I{library}/include"]
        subprocess.run([*command, str(source), str(engine), f"-Wl,-rpath,{library}", "-o", str(made)], check=True)
        made.replace(built)
    found = ctypes.CDLL(str(built))[function or name]
    found.restype, found.argtypes = result, list(arguments)
    return found


def address(values: np.ndarray) -> ctypes.c_void_p:
    """Of a contiguous array's first value."""
    assert values.flags.c_contiguous
    return ctypes.c_void_p(values.ctypes.data)


# --- The simulation.


RATE_HZ = 1000
BRISTLE_DAMPING = 0.1
"""Of what would damp a stuck joint critically."""
LINK_RADIUS_M = 0.05
PRESLIDING = ("lugre", "elasto-plastic", "maxwell-slip")
"""Models of the friction of joints at rest, as arm_steps.cpp numbers them; see simulate()."""

STEPS = (
    POINTER, POINTER, POINTER, NUMBER, NUMBER, POINTER, POINTER, POINTER, WHOLE, POINTER, WHOLE, POINTER, POINTER,
    POINTER, POINTER,
)  # fmt: skip
"""Arguments of arm_steps()."""


@dataclass(frozen=True)
class Pressing:
    """A surface that presses on the last link as the arm works: it moves and turns with the link."""

    axis: np.ndarray
    """Direction of the force on the arm, in the link's axes, (3,)."""
    rows: np.ndarray
    """Force along the axis [N], friction against sliding as a share of it, and the point in the link's axes [m],
    (samples, 5)."""


@dataclass(frozen=True)
class Run:
    """True signals at 1 kHz, (samples, joints)."""

    q: np.ndarray
    motor_nm: np.ndarray
    friction_nm: np.ndarray
    tau_ext: np.ndarray
    tool_n: np.ndarray
    """Force of what presses on the last link, in the base axes, (samples, 3), [N]."""


def hinge(body: mujoco.MjsBody, link: _core.Link) -> None:
    """A joint about z that carries its rotor."""
    body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1], armature=link.rotor_inertia)


def build(tree: _core.Tree) -> mujoco.MjModel:
    """The tree as a MuJoCo model: one body and one hinge about z a link."""
    return specification(tree, RATE_HZ, hinge).compile()


def simulate(
    arm: TrueArm,
    known: _core.Tree,
    setpoints: Setpoints,
    torque_nm: Sequence[float],
    contacts: Sequence[Contact],
    warm_from_s: float,
    pressing: Pressing | None = None,
) -> Run:
    """Follow the setpoints at 1 kHz; the drive feeds forward what the known model says.

    Friction is tau_f = sigma0 z + sigma1 dz/dt + viscous, g(v) of which bristles hold in steady sliding. How they bend
    before, `arm.presliding`, over a step of constant v:

    - lugre: dz/dt = v - sigma0 |v| z / g(v) [CanudasDeWit1995], exactly. Bristles slip at any speed, so
      that a vibrating load moves the joint and straightens them.
    - elasto-plastic: dz/dt = v (1 - a sigma0 |z| / g(v)), where a rises from 0 at 0.7 of the steady bend to 1 at all of
      it, and is 0 after a reversal [Dupont2002]. Bristles that are bent less do not slip.
    - maxwell-slip: springs in parallel, each of which slips at a force of its own ([AlBender2005], whose
      elements approach g(v) at once here). Reversals are remembered, and no vibration straightens them.

    Args:
        known: the maker's model; the drive adds the rotor inertias, which it does know.
        torque_nm: most of each drive.
        warm_from_s: how long the arm has run when the recording begins.
        pressing: what presses on the last link beside the contacts; None: nothing.

    Raises:
        RuntimeError: the simulation diverged.
    """
    model = build(arm.tree)
    data = mujoco.MjData(model)
    q_des, dq_des, ddq_des = (np.ascontiguousarray(one) for one in setpoints)
    p, beta = known.momentum(q_des, dq_des)
    rotor = np.array([link.rotor_inertia for link in arm.tree.links])
    forward = np.ascontiguousarray(np.gradient(p, 1 / RATE_HZ, axis=0) + beta + rotor * ddq_des)
    joints = joint_table(arm, rotor, rotor + _mean_inertia(known, q_des), torque_nm)
    rows = contact_rows(arm.tree, contacts)
    axis = None if pressing is None else np.ascontiguousarray(pressing.axis, dtype=float)
    press = None if pressing is None else np.ascontiguousarray(pressing.rows)
    out, tool_n = np.zeros((4, *q_des.shape)), np.zeros((len(q_des), 3))
    data.qpos[:] = q_des[0]
    compiled("arm_steps", STEPS, None)(
        model._address, data._address, address(joints), warm_from_s, arm.warm_s, address(q_des), address(dq_des),
        address(forward), len(q_des), address(rows), len(rows), None if press is None else address(press),
        None if axis is None else address(axis), address(out), address(tool_n),
    )  # fmt: skip
    if data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number or not np.isfinite(data.qpos).all():
        raise RuntimeError("the simulation diverged")
    return Run(*out, tool_n)


def joint_table(arm: TrueArm, rotor: np.ndarray, inertia: np.ndarray, torque_nm: Sequence[float]) -> np.ndarray:
    """Constants of the joints as arm_steps.cpp reads them, (16, joints)."""
    stiffness = arm.static_share * arm.coulomb_nm / arm.presliding_rad
    damping = 2 * BRISTLE_DAMPING * np.sqrt(stiffness * rotor)
    rows = (
        inertia, np.array(torque_nm, dtype=float), arm.coulomb_nm, arm.asymmetry, arm.static_share, arm.stribeck_rad_s,
        stiffness, damping, arm.viscous_nm_s_rad, arm.load_share, arm.warm_drop, arm.ripple_nm, arm.ripple_cycles,
        arm.ripple_phase_rad, np.full(len(rotor), arm.integral_per_s),
        np.full(len(rotor), PRESLIDING.index(arm.presliding)),
    )  # fmt: skip
    return np.array(rows, dtype=np.float64)


def contact_rows(tree: _core.Tree, contacts: Sequence[Contact]) -> np.ndarray:
    """Contacts as arm_steps.cpp reads them, (contacts, 13)."""
    rows = [
        [one.start_s, one.end_s, round(one.start_s * RATE_HZ), one.link + 1, *touched_point(tree, one), *one.direction,
         one.peak_n, RISES_S[one.kind], float(one.in_link)]
        for one in contacts
    ]  # fmt: skip
    return np.array(rows, dtype=np.float64).reshape(len(contacts), 13)


def _mean_inertia(tree: _core.Tree, q: np.ndarray) -> np.ndarray:
    """Mean of each joint's own inertia over the poses: p_i for dq = e_i."""
    poses = q[:: max(1, len(q) // 50)]
    return np.array(
        [tree.momentum(poses, np.tile(row, (len(poses), 1)))[0][:, i].mean() for i, row in enumerate(np.eye(tree.size))]
    )


def reach_of(tree: _core.Tree, number: int, share: float) -> np.ndarray:
    """A share of the way to the next joint, in the link's frame, [m]; the last link is 12 cm long."""
    further = [link.translation for link in tree.links if link.parent == number]
    return share * np.array(further[0] if further else (0.0, 0.0, 0.12))


def touched_point(tree: _core.Tree, contact: Contact) -> np.ndarray:
    """In the link's axes, [m]."""
    if contact.at_m is not None:
        return np.array(contact.at_m)
    return reach_of(tree, contact.link, contact.share) + [LINK_RADIUS_M, 0, 0]


class Kinematics:
    """Velocities of points of a model's links."""

    def __init__(self, tree: _core.Tree) -> None:
        self.model = build(tree)
        self.data = mujoco.MjData(self.model)

    def jacobian(self, link: int, at_m: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Of a point in the link's axes, (3, joints)."""
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        point = self.data.xpos[link + 1] + self.data.xmat[link + 1].reshape(3, 3) @ at_m
        jacobian = np.zeros((3, self.model.nv))
        mujoco.mj_jac(self.model, self.data, jacobian, None, point, link + 1)
        return jacobian
