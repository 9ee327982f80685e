"""Touches with physical causes on a simulated arm: what touches and where, takes of one touch each.

A cause has mass, springs and limits, and gives its force from how the two sides move, along one line. `x_m` and `v_m_s`
are the arm's place and speed along it, away from what touches; a force of more than 0 pushes the arm that way. Nothing
pulls.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import mujoco
import numpy as np
from tauext_lab.sim.contacts import log_uniform

from tauext import _core
from tauext.robot.read import load_tree
from unseen.arms import Maker, TrueArm, true_arm
from unseen.picks import Gripper, Pick, Way, raised
from unseen.recordings import write_csv
from unseen.simulation import LINK_RADIUS_M, RATE_HZ, Contact, build, point_jacobian, reach_of, simulate

SUBSTEPS = 4
"""Of a free mass in a step of the arm."""
TREMOR_SHARE, TREMOR_HZ = 0.03, 9.0
"""Of a hand that pushes: physiological tremor."""
STRONGER = 1.5
"""Times what it wants to push with: so much a hand holds out before it gives way."""


class Cause(Protocol):
    """One touch."""

    def force_n(self, t_s: float, x_m: float, v_m_s: float, dt_s: float) -> float:
        """The force over the next step; called once a step, from t_s = 0 with x_m = 0 on."""
        ...


@dataclass
class Mass:
    """A free body that flies or swings into the arm, or stands where the arm runs into it; it bounces off."""

    mass_kg: float
    speed_m_s: float
    """Towards the arm; 0: it stands still."""
    stiffness_n_m: float
    damping_ratio: float
    place_m: float = 0.0
    gone: bool = False

    def force_n(self, t_s: float, x_m: float, v_m_s: float, dt_s: float) -> float:
        total, damping = 0.0, 2 * self.damping_ratio * np.sqrt(self.stiffness_n_m * self.mass_kg)
        for k in range(SUBSTEPS):
            into = self.place_m - (x_m + v_m_s * k * dt_s / SUBSTEPS)
            touches = into > 0 and not self.gone
            force = max(0.0, self.stiffness_n_m * into + damping * (self.speed_m_s - v_m_s)) if touches else 0.0
            self.gone = self.gone or (into < 0 and t_s > 0)
            self.speed_m_s -= force / self.mass_kg * dt_s / SUBSTEPS
            self.place_m += self.speed_m_s * dt_s / SUBSTEPS
            total += force / SUBSTEPS
        return total


@dataclass
class Hand:
    """A springy hand that wants to push with a force: its anchor follows, slowly, wherever that force is.

    F = clip(k (a - x) + c (da/dt - v), 0, 1.5 peak),  da/dt = (wanted - F) / (k yields_s)
    """

    peak_n: float
    rise_s: float
    hold_s: float
    fall_s: float
    stiffness_n_m: float
    yields_s: float
    damping_n_s_m: float = 20.0
    anchor_m: float = 0.0

    def wanted_n(self, t_s: float) -> float:
        """A raised cosine up, and one down again."""
        if t_s < self.rise_s:
            share = t_s / self.rise_s
        else:
            share = min(1.0, max(0.0, (self.rise_s + self.hold_s + self.fall_s - t_s) / self.fall_s))
        tremor = 1 + TREMOR_SHARE * np.sin(2 * np.pi * TREMOR_HZ * t_s)
        return self.peak_n * 0.5 * (1 - np.cos(np.pi * share)) * tremor

    def force_n(self, t_s: float, x_m: float, v_m_s: float, dt_s: float) -> float:
        wanted, follows = self.wanted_n(t_s), self.stiffness_n_m * self.yields_s
        # solved for F: with the anchor's speed of the step before, soft hands would swing from step to step
        force = self.stiffness_n_m * (self.anchor_m - x_m) + self.damping_n_s_m * (wanted / follows - v_m_s)
        force /= 1 + self.damping_n_s_m / follows
        most = STRONGER * self.peak_n
        if force > most:  # it is pushed back
            self.anchor_m -= (force - most) / self.stiffness_n_m
        force = min(max(force, 0.0), most)
        self.anchor_m += (wanted - force) / follows * dt_s
        return force


@dataclass
class Obstacle:
    """A wall, or a body part before one: it stays; or a press that closes at a steady speed up to a force."""

    stiffness_n_m: float
    damping_n_s_m: float
    closes_m_s: float = 0.0
    most_n: float = np.inf
    """Where a press stops."""
    place_m: float = 0.0

    def force_n(self, t_s: float, x_m: float, v_m_s: float, dt_s: float) -> float:
        into = self.place_m - x_m
        if into <= 0 and t_s > 0:
            closing, force = self.closes_m_s, 0.0
        else:
            closing = self.closes_m_s if self.stiffness_n_m * into < self.most_n else 0.0
            force = max(0.0, self.stiffness_n_m * into + self.damping_n_s_m * (closing - v_m_s))
        self.place_m += closing * dt_s
        return force


# --- A touch on the simulated arm: where, along which line, and what it shows in the joints.


WORLD = -1


@dataclass(frozen=True)
class Place:
    """A point on the surface of a link; of the world: nothing."""

    link: int
    share: float = 0.0
    """Of the way from the link's joint to the next."""

    def of(self, tree: _core.Tree) -> np.ndarray:
        """In the link's frame, [m]; the last link is 12 cm long."""
        return reach_of(tree, self.link, self.share) + [LINK_RADIUS_M, 0, 0]


class Touch:
    """What `simulate` calls a grip: from start_s on, one cause between a link and the world, or between two links.

    Between two links it lies along the line between their points, wherever that turns.

    Args:
        direction: of the force on the link, in the world, from its velocity when the touch begins.
    """

    def __init__(
        self,
        tree: _core.Tree,
        place: Place,
        other: Place,
        cause: Cause,
        start_s: float,
        samples: int,
        direction: Callable[[np.ndarray], np.ndarray],
    ) -> None:
        self.cause, self.start = cause, round(start_s * RATE_HZ)
        self.sides = [(place.link, place.of(tree)), (other.link, other.of(tree) if other.link >= 0 else np.zeros(3))]
        self.direction = direction
        self.along = np.zeros(3)
        self.first_m = 0.0
        self.force_n = np.zeros(samples)
        self.tau_ext = np.zeros((samples, tree.size))

    def __call__(self, model: mujoco.MjModel, data: mujoco.MjData, k: int) -> np.ndarray:
        if k < self.start:
            return np.zeros(model.nv)
        mujoco.mj_kinematics(model, data)  # of this step, not of the one before
        mujoco.mj_comPos(model, data)
        (point, jacobian), (other, other_jacobian) = (self._side(model, data, *side) for side in self.sides)
        apart, jacobian = point - other, jacobian - other_jacobian
        if self.sides[1][0] != WORLD:
            self.along = apart / np.linalg.norm(apart)
        elif k == self.start:
            self.along = self.direction(jacobian @ data.qvel)
        if k == self.start:
            self.first_m = float(self.along @ apart)
        v = float(self.along @ jacobian @ data.qvel)
        dt = 1 / RATE_HZ
        force = self.cause.force_n((k - self.start) * dt, float(self.along @ apart) - self.first_m, v, dt)
        self.force_n[k], self.tau_ext[k] = force, force * (self.along @ jacobian)
        return self.tau_ext[k]

    @staticmethod
    def _side(model: mujoco.MjModel, data: mujoco.MjData, link: int, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if link == WORLD:
            return np.zeros(3), np.zeros((3, model.nv))
        point = data.xpos[link + 1] + data.xmat[link + 1].reshape(3, 3) @ at
        return point, point_jacobian(model, data, point, link + 1)


# --- Takes of one touch each: what it is and when, how the arm moves, and what the controller logs.


BEFORE_S, AFTER_S = 3.0, 1.3
"""Ordinary motion before, and what is recorded from the touch on; the drive knows nothing of the touch."""
SPEEDS_M_S = (0.05, 0.5)
"""Of the touched point."""
SLOWEST_M_S = 0.03
"""At which two links that catch something must close."""
MOST_SPEED = 0.6
"""Of a joint's most speed, in a move that is touched."""
WARM_S = 400.0
"""How long the arm has run: training covers it."""
STRENGTHS = (0.7, 4.0)
"""Of a push and of a weight, and up to half of this for the weight: its torque of the joint that feels it most, over
that joint's Coulomb friction; limits are about a third to a half of that."""
PUSHES_N, WEIGHTS_KG, PRESS_N = (10.0, 200.0), (0.3, 5.0), 1000.0
"""What a hand can do, a gripper holds, and where a press stops."""
TILT = 0.5
"""Of an obstacle from the way of what runs into it: tangent of 27 degrees at most."""
KINDS = ("impact", "push", "clamp", "load")
WAYS = {
    "impact": ("hit at rest", "hit in motion", "runs into a loose body"),
    "push": ("at rest", "in motion"),
    "clamp": ("wall", "body against a wall", "body between links", "press"),
    "load": ("at rest", "lifting"),
}
"""Of each kind, in turn."""


@dataclass(frozen=True)
class Event:
    """One touch as it was drawn."""

    kind: str
    way: str
    start_s: float
    link: int
    share: float
    facts: dict[str, float]


class Spot(Protocol):
    """A point of a link, in its frame, [m]."""

    @property
    def link(self) -> int: ...

    def of(self, tree: _core.Tree) -> np.ndarray: ...


class Kinematics:
    """Points of a model's links and their velocities."""

    def __init__(self, tree: _core.Tree) -> None:
        self.tree, self.model = tree, build(tree)
        self.data = mujoco.MjData(self.model)

    def jacobian(self, place: Spot, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        self.data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        return Touch._side(self.model, self.data, place.link, place.of(self.tree) if place.link >= 0 else np.zeros(3))


def draw_moving(maker: Maker, arm: Kinematics, way: Way, place: Place, other: Place, rng: np.random.Generator) -> float:
    """Add a move in which the point goes at a speed drawn; returns when the touch begins. RuntimeError: none found."""
    for _ in range(200):
        there = np.clip(way.here + rng.uniform(-0.6, 0.6, len(way.here)), way.low, way.high)
        share = rng.uniform(0.25, 0.55)
        rate = 30 * share**2 * (1 - share) ** 2
        q = way.here + (10 * share**3 - 15 * share**4 + 6 * share**5) * (there - way.here)
        (point, jacobian), (base, base_jacobian) = arm.jacobian(place, q), arm.jacobian(other, q)
        velocity = (jacobian - base_jacobian) @ (there - way.here) * rate
        speed = float(np.linalg.norm(velocity))
        if other.link != WORLD:
            speed = -float(unit(point - base) @ velocity)  # they close
        if speed < 0.02:
            continue
        wanted = log_uniform(rng, SPEEDS_M_S)
        seconds = max(speed / wanted, float((1.9 * np.abs(there - way.here) / maker.speed_rad_s).max()) / MOST_SPEED)
        if seconds > 10 or speed / seconds < SLOWEST_M_S:
            continue
        start = way.now_s + share * seconds
        way.go(there, seconds)
        return start
    raise RuntimeError("no such move")


def draw_place(maker: Maker, rng: np.random.Generator) -> Place:
    """Anywhere but on the first link, as of the other contacts of the trial."""
    return Place(int(rng.integers(1, len(maker.joints))), rng.uniform(0.2, 1.0))


def draw_cause(kind: str, way: str, peak_n: float, rng: np.random.Generator) -> tuple[Any, dict[str, float]]:
    """Args: peak_n: of a hand."""
    if kind == "impact":
        mass, stiffness = log_uniform(rng, (0.5, 5)), log_uniform(rng, (5e3, 1e5))
        speed = rng.uniform(0.5, 2.5)
        if way == "runs into a loose body":
            mass, speed = log_uniform(rng, (2, 10)), 0.0
        facts = {"mass_kg": mass, "speed_m_s": speed, "stiffness_n_m": stiffness}
        return Mass(mass, speed, stiffness, rng.uniform(0.05, 0.4)), facts
    if kind == "push":
        facts = {
            "peak_n": peak_n,
            "rise_s": log_uniform(rng, (0.05, 0.5)),
            "hold_s": rng.uniform(0.3, 1.5),
            "fall_s": rng.uniform(0.1, 0.3),
            "stiffness_n_m": log_uniform(rng, (200, 2000)),
            "yields_s": rng.uniform(0.06, 0.15),
        }
        return Hand(**facts), facts
    stiffness = log_uniform(rng, (1e4, 1e6)) if way == "wall" else log_uniform(rng, (1e4, 7.5e4))
    closes = log_uniform(rng, (0.01, 0.05)) if way == "press" else 0.0
    most = PRESS_N if way == "press" else 1e9
    damping = 2 * rng.uniform(0.05, 0.3) * np.sqrt(stiffness * 3.0)
    facts = {"stiffness_n_m": stiffness, "damping_n_s_m": float(damping), "closes_m_s": closes, "most_n": most}
    return Obstacle(**facts), facts


def peak_of(
    maker: Maker,
    arm: Kinematics,
    path: Way,
    place: Place,
    start_s: float,
    direction: np.ndarray,
    bounds: tuple[float, float],
    strengths: tuple[float, float],
    rng: np.random.Generator,
) -> float:
    """A force along that direction of a strength that is drawn, within bounds, [N]."""
    jacobian = arm.jacobian(place, path.setpoints()[0][round(start_s * RATE_HZ)])[1]
    felt = float((np.abs(direction @ jacobian) / np.array(maker.coulomb_nm)).max())
    return float(np.clip(log_uniform(rng, strengths) / max(felt, 1e-6), *bounds))


def unit(x: np.ndarray) -> np.ndarray:
    return x / max(float(np.linalg.norm(x)), 1e-12)


def draw_direction(way: str, aside: np.ndarray, rng: np.random.Generator) -> Callable[[np.ndarray], np.ndarray]:
    """Any; of what is run into, against the motion, but for a tilt."""
    tilt = rng.uniform(0, TILT)

    def direction(velocity: np.ndarray) -> np.ndarray:
        if way in ("wall", "body against a wall", "runs into a loose body"):
            back = -unit(velocity)
            return unit(back + tilt * unit(aside - (aside @ back) * back))
        return aside

    return direction


def draw_touch(
    maker: Maker, known: _core.Tree, kind: str, way: str, rng: np.random.Generator
) -> tuple[Event, Way, Any]:
    """An event, the setpoints, and what makes the touch: (tree, samples) -> Grip, or an arm's own for a load."""
    arm, path = Kinematics(known), Way(maker, rng)
    path.ordinary(BEFORE_S)
    place, other = draw_place(maker, rng), Place(WORLD)
    if way == "body between links":  # on two links with one, or two, joints between them
        upper = int(rng.integers(1, len(maker.joints) - 1))
        place = Place(min(upper + int(rng.integers(1, 3)), len(maker.joints) - 1), rng.uniform(0.3, 1.0))
        other = Place(upper, rng.uniform(0.0, 0.7))
    if way in ("hit at rest", "at rest", "press"):
        path.go(rng.uniform(path.low, path.high), None)
        path.stand(rng.uniform(0.3, 0.8))
        start = path.now_s
    else:
        start = draw_moving(maker, arm, path, place, other, rng)
    path.stand(max(0.0, start + AFTER_S - path.now_s))
    aside = unit(rng.standard_normal(3))
    cause, facts = draw_cause(kind, way, peak_of(maker, arm, path, place, start, aside, PUSHES_N, STRENGTHS, rng), rng)
    direction = draw_direction(way, aside, rng)

    def make(tree: _core.Tree, samples: int) -> Touch:
        return Touch(tree, place, other, cause, start, samples, direction)

    return Event(kind, way, start, place.link, place.share, facts), path, make


class Weight(Gripper):
    """A load put into the hand, which says what it shows."""

    def __init__(self, arm: TrueArm, pick: Pick, samples: int) -> None:
        super().__init__(arm, pick)
        self.force_n = np.zeros(samples)
        self.tau_ext = np.zeros((samples, arm.tree.size))

    def __call__(self, model: mujoco.MjModel, data: mujoco.MjData, k: int) -> np.ndarray:
        held = super().__call__(model, data, k)
        if self.carries:
            point = data.xpos[-1] + data.xmat[-1].reshape(3, 3) @ np.array(self.pick.com_m)
            jacobian = point_jacobian(model, data, point, model.nbody - 1)
            self.tau_ext[k] = held - 9.81 * self.pick.mass_kg * jacobian[2]
            self.force_n[k] = np.linalg.norm(self.tau_ext[k])
        return held


def draw_load(maker: Maker, known: _core.Tree, way: str, rng: np.random.Generator) -> tuple[Event, Way, Pick]:
    """A weight handed to an arm that stands, or lifted off a table."""
    model, path = build(known), Way(maker, rng)
    path.ordinary(BEFORE_S)
    while True:
        low = rng.uniform(path.low, path.high)
        high = raised(model, low, rng.uniform(0.04, 0.12))
        if high is not None:
            break
    path.go(low)
    path.stand(rng.uniform(0.3, 0.8))
    start, lifts = path.now_s, log_uniform(rng, (0.05, 0.6))
    if way == "lifting":
        path.go(high, rng.uniform(0.5, 1.6))
    path.stand(max(0.0, start + AFTER_S + lifts - path.now_s))
    com = np.array([0, 0, 0.10]) + unit(rng.standard_normal(3)) * rng.uniform(0, 0.06)
    strengths, bounds = (STRENGTHS[0], STRENGTHS[1] / 2), (9.81 * WEIGHTS_KG[0], 9.81 * WEIGHTS_KG[1])
    flange, down = Place(len(maker.joints) - 1, 1.0), np.array([0.0, 0.0, -1.0])
    mass = peak_of(maker, Kinematics(known), path, flange, start, down, bounds, strengths, rng) / 9.81
    pick = Pick(mass, tuple(com.tolist()), rng.uniform(0.02, 0.06), start, start, lifts, 1e9, 1e9, 1e9)
    return Event("load", way, start, len(maker.joints) - 1, 1.0, {"mass_kg": mass, "rise_s": lifts}), path, pick


def name_of(kind: str, number: int) -> str:
    return f"{kind}-{number:03d}"


def write_touch(maker: Maker, seed: int, kind: str, number: int, folder: Path) -> None:
    """Simulate one take and write NAME.csv, NAME.truth.json and NAME.truth.npz; not what is there."""
    name = name_of(kind, number)
    if (folder / f"{name}.truth.npz").exists():
        return
    arm, known = true_arm(maker, maker.random(seed, 0)), load_tree(maker.model, maker.joints)
    way = WAYS[kind][number % len(WAYS[kind])]
    for trial in range(10):  # some poses leave no such move; a heavy load may shake an arm whose drive does not know it
        rng = maker.random(seed, 10 * (20000 + 1000 * KINDS.index(kind) + number) + trial)
        try:
            if kind == "load":
                event, path, pick = draw_load(maker, known, way, rng)
            else:
                event, path, make = draw_touch(maker, known, kind, way, rng)
            samples = round((event.start_s + AFTER_S + event.facts.get("rise_s", 0.0)) * RATE_HZ)
            setpoints = tuple(column[:samples] for column in path.setpoints())
            samples = len(setpoints[0])
            grip = Weight(arm, pick, samples) if kind == "load" else make(arm.tree, samples)
            run = simulate(arm, known, setpoints, maker.torque_nm, [], WARM_S, grip)
            break
        except RuntimeError:
            continue
    else:
        raise RuntimeError(f"{maker.name}: {name} cannot be simulated")
    when = (event.start_s, samples / RATE_HZ)
    contact = Contact(kind, *when, event.link, event.share, (0, 0, 1), 0.0, when)
    write_csv(folder / f"{name}.csv", maker, arm, run, [contact], rng)
    truth = {
        "kind": kind,
        "way": way,
        "start_s": event.start_s,
        "link": event.link,
        **event.facts,
        "peak_n": float(grip.force_n.max()),
        "peak_nm": np.abs(grip.tau_ext).max(axis=0).tolist(),
    }
    (folder / f"{name}.truth.json").write_text(json.dumps(truth) + "\n")
    np.savez_compressed(
        folder / f"{name}.truth.npz",
        force_n=grip.force_n.astype(np.float32),
        tau_ext=grip.tau_ext.astype(np.float32),
        q_des=setpoints[0].astype(np.float32),
    )
