"""A pick and a place: ordinary motion, a load off a table, ordinary motion with it, and back onto a table."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import mujoco
import numpy as np

from tauext.robot.read import load_tree
from unseen.arms import Maker, TrueArm, direction, link_with_ball, true_arm
from unseen.recordings import peak_nm, write_csv
from unseen.simulation import (
    ACCELERATIONS_RAD_S2,
    RANGES,
    RATE_HZ,
    SHARES,
    Contact,
    build,
    point_jacobian,
    quintic,
    simulate,
    trapezoid,
)

WINDOW_S = 3.0
"""From the gripper's command: so long a load is expected."""
BEFORE_S, BETWEEN_S, AFTER_S = 3.0, 5.0, 2.0
"""Ordinary motion before the pick, with the load, and after the place; at least so long."""
SUDDEN_S = 0.05
GRADUAL_S = (0.1, 1.5)
"""How long a table lets go of a load, or takes it."""
LIFT_M, LIFT_S = (0.04, 0.12), (0.5, 1.6)
TIP_M = (0.0, 0.0, 0.10)
"""Of the gripper, in the last link's frame; the load's centre is within AROUND_M of it."""
AROUND_M = 0.06
WARM_S = 400.0
"""How long the arm has run: training covers it."""


@dataclass(frozen=True)
class Pick:
    """What happens, and when; the load in the last link's frame."""

    mass_kg: float
    com_m: tuple[float, float, float]
    radius_m: float
    grasp_s: float
    lift_s: float
    """When the table begins to let go."""
    lifts_s: float
    """How long that takes."""
    put_s: float
    """When a table begins to take it."""
    puts_s: float
    release_s: float
    """The gripper opens; the load is gone."""
    contact: Contact | None = None
    in_hand: bool = False
    """It has been there from the start, and no table takes part."""


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
        away = float(np.abs(there - self.here).max())
        if seconds is not None:
            s, ds, dds = quintic(seconds * 8 / 15, 0.0, RATE_HZ)
        else:
            speed = np.array(self.maker.speed_rad_s) * self.rng.uniform(0.15, 0.85)
            fastest_s = float((np.abs(there - self.here) / speed).max())
            square_s2 = away / self.rng.uniform(*ACCELERATIONS_RAD_S2)
            if self.rng.uniform() < 0.5:
                s, ds, dds = quintic(fastest_s, square_s2, RATE_HZ)
            else:
                s, ds, dds = trapezoid(fastest_s, square_s2, self.rng.uniform(0.15, 0.4), RATE_HZ)
        way = there - self.here
        self._add(self.here + s[:, None] * way, ds[:, None] * way, dds[:, None] * way)
        self.here = there

    def stand(self, seconds: float) -> None:
        count = round(seconds * RATE_HZ)
        zero = np.zeros((count, len(self.here)))
        self._add(np.tile(self.here, (count, 1)), zero, zero)

    def ordinary(self, seconds: float) -> None:
        end = self.now_s + seconds
        while self.now_s < end:
            self.go(self.rng.uniform(self.low, self.high))
            if self.rng.uniform() < 0.5:
                self.stand(self.rng.uniform(0.2, 1.0))

    def _add(self, q: np.ndarray, dq: np.ndarray, ddq: np.ndarray) -> None:
        self.parts.append((q, dq, ddq))
        self.samples += len(q)

    def setpoints(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        q, dq, ddq = (np.concatenate(column) for column in zip(*self.parts, strict=True))
        return q, dq, ddq


def tip(model: mujoco.MjModel, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height of the gripper's tip [m], and how it changes with each joint."""
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    point = data.xpos[-1] + data.xmat[-1].reshape(3, 3) @ TIP_M
    return point, point_jacobian(model, data, point, model.nbody - 1)


def raised(model: mujoco.MjModel, q: np.ndarray, by_m: float) -> np.ndarray | None:
    """The pose with the tip that much higher; None where the arm hardly can."""
    goal = tip(model, q)[0] + [0, 0, by_m]
    pose = q.copy()
    for _ in range(20):
        at, jacobian = tip(model, pose)
        pose = pose + jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + 1e-3 * np.eye(3), goal - at)
    return pose if np.abs(tip(model, pose)[0] - goal).max() < 0.01 and np.abs(pose - q).max() < 0.6 else None


def draw_pick(maker: Maker, rng: np.random.Generator, sudden: bool, contact: str, in_hand: bool) -> tuple[Pick, Way]:
    """One take. contact: `none`, `empty` (nor a load), `any`, or `down`; while a pick or, with the load in hand, a
    release is expected."""
    touches = contact in ("any", "down")
    model = build(load_tree(maker.model, maker.joints))
    way = Way(maker, rng)

    def low_and_high() -> tuple[np.ndarray, np.ndarray]:
        while True:
            low, by = rng.uniform(way.low, way.high), rng.uniform(*LIFT_M)
            high = raised(model, low, by)
            if high is not None:
                return low, high

    way.ordinary(BEFORE_S)
    low, high = low_and_high()
    way.go(low)
    way.stand(rng.uniform(0.2, 0.5))
    grasp = way.now_s
    way.stand(rng.uniform(0.15, 0.4))
    lift, seconds = way.now_s, rng.uniform(*LIFT_S)
    lifts = SUDDEN_S if sudden else rng.uniform(*GRADUAL_S)
    way.go(high, seconds)
    way.ordinary(BETWEEN_S)
    put = release = puts = 1e9
    if not touches:
        low, high = low_and_high()
        way.go(high)
        seconds = rng.uniform(*LIFT_S)
        way.go(low, seconds)
        puts = SUDDEN_S if sudden else rng.uniform(*GRADUAL_S)
        way.stand(rng.uniform(0.1, 0.3))
        put = way.now_s - rng.uniform(0, min(0.3, seconds))
        release = max(way.now_s + rng.uniform(0, 0.3), put + puts)
        way.stand(release - way.now_s + rng.uniform(0.2, 0.4))
        way.go(high, seconds)
        way.ordinary(AFTER_S)
    mass = float(rng.uniform(0.5, 3.0))
    touch = draw_contact(grasp, len(maker.joints), contact == "down", rng) if touches else None
    if contact != "none" and not in_hand:
        mass = 0.0
    com = tuple((np.array(TIP_M) + direction(rng) * rng.uniform(0, AROUND_M)).tolist())
    radius = float(rng.uniform(0.02, 0.06))
    return Pick(mass, com, radius, grasp, lift, lifts, put, puts, release, touch, in_hand), way


def draw_contact(grasp_s: float, links: int, down: bool, rng: np.random.Generator) -> Contact:
    """While a load is expected; `down`: on the last link, along gravity."""
    kind = str(rng.choice(list(SHARES), p=list(SHARES.values())))
    if down and kind == "impact":
        kind = "push"
    (least_n, most_n), (least_s, most_s) = RANGES[kind]
    start, seconds = grasp_s + rng.uniform(0.1, WINDOW_S - 0.4), rng.uniform(least_s, most_s)
    way = (0.0, 0.0, -1.0) if down else tuple(direction(rng).tolist())
    link = links - 1 if down else int(rng.integers(1, links))
    share, peak = rng.uniform(0.2, 1.0), float(rng.uniform(least_n, most_n))
    return Contact(kind, start, start + seconds, link, share, way, peak, (start, start + seconds))


class Gripper:
    """The load at the flange as time goes on: its mass on the last link, less what a table holds of it."""

    def __init__(self, arm: TrueArm, pick: Pick) -> None:
        self.pick, self.carries = pick, False
        self.own = arm.tree.links[-1]

    def __call__(self, model: mujoco.MjModel, data: mujoco.MjData, k: int) -> np.ndarray:
        t, pick = k / RATE_HZ, self.pick
        carries = pick.mass_kg > 0 and (pick.in_hand or pick.grasp_s <= t < pick.release_s)
        if carries != self.carries:
            self.carries = carries
            self._set(model, carries)
        if not carries or pick.in_hand:
            return np.zeros(model.nv)
        held = max(1 - max(t - pick.lift_s, 0) / pick.lifts_s, 0.0) + min(max(t - pick.put_s, 0) / pick.puts_s, 1.0)
        if held == 0:
            return np.zeros(model.nv)
        point = data.xpos[-1] + data.xmat[-1].reshape(3, 3) @ np.array(pick.com_m)
        jacobian = point_jacobian(model, data, point, model.nbody - 1)
        return jacobian.T @ [0, 0, held * 9.81 * pick.mass_kg]

    def _set(self, model: mujoco.MjModel, carries: bool) -> None:
        mass_kg = self.pick.mass_kg if carries else 0.0
        mass, com, inertia = link_with_ball(self.own, mass_kg, np.array(self.pick.com_m), self.pick.radius_m)
        sizes, axes = np.linalg.eigh(inertia)
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        turn = np.zeros(4)
        mujoco.mju_mat2Quat(turn, axes.flatten())
        model.body_mass[-1], model.body_ipos[-1] = mass, com
        model.body_inertia[-1], model.body_iquat[-1] = sizes, turn


def write_pick(maker: Maker, seed: int, number: int, folder: Path, sudden: bool, contact: str, in_hand: bool) -> None:
    """Simulate one take and write NAME.csv and NAME.truth.json."""
    name = f"{contact if contact != 'none' else 'pick'}{'-hand' if in_hand else ''}-{number:03d}"
    if (folder / f"{name}.truth.json").exists():
        return
    arm, known = true_arm(maker, maker.random(seed, 0)), load_tree(maker.model, maker.joints)
    stream = 3000 + {"none": 0, "any": 2000, "down": 4000, "empty": 6000}[contact] + 1000 * in_hand
    for trial in range(8):  # a heavy load far out may shake an arm whose drive knows nothing of it
        rng = maker.random(seed, 10 * (stream + number) + trial)
        pick, way = draw_pick(maker, rng, sudden, contact, in_hand)
        contacts = [pick.contact] if pick.contact else []
        try:
            grip = Gripper(arm, pick)
            run = simulate(arm, known, way.setpoints(), maker.torque_nm, contacts, WARM_S, grip)
            break
        except RuntimeError:
            continue
    write_csv(folder / f"{name}.csv", maker, arm, run, contacts, rng)
    truth = asdict(pick)
    if pick.contact:
        truth["peak_nm"] = peak_nm(run.tau_ext, pick.contact).tolist()
    (folder / f"{name}.truth.json").write_text(json.dumps(truth) + "\n")
