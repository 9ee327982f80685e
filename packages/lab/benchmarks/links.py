"""Which link is touched and where: touches on every link of simulated arms, and on a Panda that stands.

    python packages/lab/benchmarks/links.py MODELS UNSEEN OUT [--arms panda kinova seven_axis]
      [--meshes panda=ROBOT ...] [--touches 200] [--seed 0]
    python packages/lab/benchmarks/links.py MODELS UNSEEN OUT --panda DATASET BUNDLES [--meshes panda=ROBOT]
    python packages/lab/benchmarks/links.py MODELS UNSEEN OUT --shapes ROBOT ...
    python packages/lab/benchmarks/links.py MODELS UNSEEN OUT --pressed [--arms ur5 seven_axis] [--meshes ur5=ROBOT ...]

MODELS: folder of the robot files. UNSEEN: what unseen_arms.py wrote; a bundle is trained on each arm's datasets where
OUT has none. ROBOT: the arm's robot file with its meshes in the folders above: touches on the meshes, too. OUT gets the
bundles, links.json and links.md.

--panda: recordings of a Panda at rest and bundles, as real_arms.py makes them (panda/data, a file a touched link with
labels and the robot's own estimate; panda/bundles). Links are found by the bundle of recipe observer, with the standard
error of its own limits; by the robot's own estimate, with that of its samples without a touch.

--shapes: how well the capsules of these robot files' links fit their meshes. OUT gets shapes.json and shapes.md.
--pressed: forces that MuJoCo exerts on points of the surfaces, and how often what is stated of them is right. UNSEEN is
not read. OUT gets pressed.json, pressed.md and reliability.png.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import mujoco
import numpy as np
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import arguments, estimates, head, runs, short, table_row, trained, write_tables
from made_live import replay
from unseen.arms import Maker, arm_of, makers
from unseen.recordings import logged, nm_per_given
from unseen.simulation import RATE_HZ, Contact, draw_motion, simulate
from unseen.surfaces import (
    SURFACES,
    Cylinder,
    Triangles,
    capsules_of,
    draw_touch,
    meshes_of,
    triangles_of,
    within_cone,
)

from tauext import _core
from tauext.config import FreeMotionConfig
from tauext.data.free_motion import free_samples
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.monitor.touch_place import (
    INCONSISTENT,
    STATED,
    PlaceChange,
    PlaceFinder,
    find_places,
    run_of,
    straight_touches,
    strength,
)
from tauext.robot.capsules import Ends, body_capsules, even_directions, link_capsules
from tauext.robot.frames import wrench_frames
from tauext.robot.mesh_files import MeshFinder
from tauext.robot.read import load_tree, placed_bodies, read_robot

GIVEN, GUESSED, MESHES, FITTED = "given", "guessed", "meshes", "fitted"
Shapes = dict[str, list[_core.Capsule]]
"""What a bundle may know of an arm's surface; GUESSED: nothing."""


@dataclass(frozen=True)
class Arm:
    maker: Maker
    bundle: _core.Bundle
    title: str
    surface: Sequence[Cylinder | Triangles]
    shapes: Shapes


def ready(models: Path, unseen: Path, out: Path, name: str) -> Arm:
    """With a bundle of recipe prior, trained where there is none."""
    maker = makers(models)[name]
    bundle = _core.Bundle.load(str(trained(unseen / name / "urdf", out / f"{name}.tauext")))
    shapes = {GIVEN: capsules_of(SURFACES[name]), GUESSED: []}
    return Arm(maker, bundle, name, SURFACES[name], shapes)


def meshed(arm: Arm, model: Path) -> Arm:
    """The arm with the meshes of this robot file for surfaces, and the capsules that an import fits to them."""
    shapes = {MESHES: mesh_capsules(model, list(arm.maker.joints)), GUESSED: []}
    return replace(arm, title=f"{arm.title}, meshes", surface=triangles_of(model, arm.maker.joints), shapes=shapes)


def mesh_capsules(model: Path, joints: list[str]) -> list[_core.Capsule]:
    capsules, lost = link_capsules(model, load_tree(model, joints))
    assert not lost, lost
    return capsules


# --- Touches on every link of a simulated arm, and what the monitor reports of them.


SLOT_S, FIRST_S, HELD_S = 3.0, 8.0, 1.2
ACKNOWLEDGED_S = 1.4
"""After the alarm: a touch's own has ended by then, and the next finds none."""
RATIOS = (1.5, 10.0)
"""Of the limit that a touch exceeds most, even in its logarithm."""
FORCES_N = (8.0, 120.0)
"""Less is no touch that matters; more takes a small arm's drives to their limits."""
SEED, WARM_S = 0, 660.0
"""Of the arms that the datasets were made with; how long they have run."""
REPORTED_AT_S = 0.5
"""After the alarm: the last result by then counts."""


@dataclass(frozen=True)
class Touch:
    """In the link's axes."""

    link: int
    point_m: np.ndarray
    direction: np.ndarray
    angle_rad: float
    force_n: float
    start_s: float

    def contact(self) -> Contact:
        when, along, at = (self.start_s, self.start_s + HELD_S), self.direction.tolist(), self.point_m.tolist()
        return Contact("push", *when, self.link, 0.5, tuple(along), self.force_n, when, tuple(at), in_link=True)


def judged(arm: Arm, options: argparse.Namespace) -> list[dict]:
    """One row a touch and kind of shapes, with what is reported of it."""
    rng = np.random.default_rng([options.seed, 61, arm.bundle.joints])
    maker, real = arm.maker, arm_of(arm.maker, SEED)
    setpoints = draw_motion(maker, round((FIRST_S + options.touches * SLOT_S) * RATE_HZ), RATE_HZ, rng)
    touches = [
        drawn(arm, setpoints[0], FIRST_S + k * SLOT_S + rng.uniform(0, 0.8), rng) for k in range(options.touches)
    ]
    contacts = [one.contact() for one in touches]
    run = simulate(real, load_tree(maker.model, maker.joints), setpoints, maker.torque_nm, contacts, WARM_S)
    constants = real.nm_per_ampere / nm_per_given(maker, SEED)
    made = argparse.Namespace(**logged(maker, real, run, constants, rng), temperature=None)
    true_nm, said = run.tau_ext[:: RATE_HZ // maker.rate_hz], estimates(arm.bundle, made)
    rows = []
    for shapes, capsules in arm.shapes.items():
        arm.bundle.capsules = capsules
        finder, changes = PlaceFinder(arm.bundle), []
        assert not finder.refused, finder.refused
        for chunk in replay(_core.Monitor(arm.bundle), made, acknowledge_after_s=ACKNOWLEDGED_S, places=finder):
            changes += [change for change in chunk.changes if isinstance(change, PlaceChange)]
        rows += [{"shapes": shapes} | row_of(arm, touch, made, true_nm, said, changes) for touch in touches]
    return rows


def drawn(arm: Arm, q: np.ndarray, start_s: float, rng: np.random.Generator) -> Touch:
    """A touch on any link, at a point of its surface, that exceeds a limit by a ratio drawn from RATIOS."""
    model, limits = _core.WrenchModel(arm.bundle), np.array(arm.bundle.sliding_limit_nm)
    pose = q[round((start_s + 0.5) * RATE_HZ)]
    while True:
        link = int(rng.integers(arm.bundle.joints))
        for _ in range(20):  # a link that no joint feels there is left for another one
            point, direction, angle = draw_touch(arm.surface, link, np.radians(45), rng)  # friction of 1
            name = arm.bundle.links[link].joint_name
            columns = model.columns(name, pose.tolist(), point.tolist(), _core.WrenchAxes.frame)[:3]
            force = np.exp(rng.uniform(*np.log(RATIOS))) / max(np.abs(direction @ columns / limits).max(), 1e-9)
            if FORCES_N[0] <= force <= FORCES_N[1]:
                return Touch(link, point, direction, angle, float(force), start_s)


def row_of(
    arm: Arm, touch: Touch, made: argparse.Namespace, true_nm: np.ndarray, said: dict, changes: list[PlaceChange]
) -> dict:
    """What is reported of a touch by REPORTED_AT_S after its alarm."""
    start_ns = round(touch.start_s * 1e9) + int(made.t_ns[0])
    own = [
        one
        for one in changes
        if 0 <= one.t_ns - one.since_s * 1e9 - start_ns < HELD_S * 1e9 and one.since_s <= REPORTED_AT_S
    ]
    row = {"arm": arm.title, "link": touch.link, "force_n": touch.force_n, "seen": bool(own)}
    row["angle_deg"] = float(np.degrees(touch.angle_rad))
    if not own:
        return row
    last = own[-1]
    first = int(np.searchsorted(made.t_ns, last.t_ns - round(last.since_s * 1e9)))
    until = slice(first, last.row + 1)
    at = first + int(np.argmax(strength(said["tau_ext"][until], said["sigma_nm"][until])[:, last.joint]))
    sample = (made.q[at].tolist(), *(said[key][at].tolist() for key in ("tau_ext", "sigma_nm", "contact_sigma_nm")))
    place = _core.PlaceModel(arm.bundle).find(*sample, link=touch.link, dq=made.dq[at].tolist()).places[0]
    probability = [0.0] * arm.bundle.joints
    for link, share in last.links:
        probability[link] = share
    return row | {
        "probability": probability,
        "off_m": float(np.linalg.norm(np.subtract(place.on_link, touch.point_m))),
        "spread_m": place.spread_m,
        "off_n": abs(float(np.linalg.norm(place.force)) - touch.force_n),
        "ratio": float(np.abs(true_nm[at] / said["limit_nm"][at]).max()),
    }


# --- Touches on arms in MuJoCo, and what their torques tell of the place.


SIGMA_SHARE = 0.007
"""Standard error of a torque in free motion, as a share of what the drive can give."""
ALARM_SIGMAS = 5.0
CONSTANTS, ABSORBED = 0.05, 0.08
"""Standard error of a torque constant, as a share; largest share of a touch that gear friction takes up."""
PRESSED_N = (15.0, 150.0)
"""By people, tables and clamps; even in its logarithm."""
FRICTION = (0.1, 0.8)
"""Coefficient, drawn evenly for each touch; the force is drawn evenly from its cone."""
HAND_M = 0.06
"""Free way in front of a point that is touched."""
TOUCHES_AN_ARM = 50
"""With the same torque constants."""


@dataclass(frozen=True)
class Pressed:
    link: int
    q: np.ndarray
    point_m: np.ndarray
    """In the base."""
    force_n: np.ndarray
    """On the arm, along the base's axes, (3,)."""
    torque_nm: np.ndarray
    """(joints,)."""


class TouchableArm:
    """The arm in MuJoCo with a surface: its poses, levers and rays are MuJoCo's."""

    def __init__(self, maker: Maker, surface: Sequence[Cylinder | Triangles]):
        spec, _ = read_robot(maker.model)
        for geom in list(spec.geoms):
            spec.delete(geom)
        placed = {}
        for body in placed_bodies(maker.model, load_tree(maker.model, maker.joints))[2]:
            placed.setdefault(body.link, body)
        self._maker, self._placed = maker, placed
        self._parts = [part for part in surface if part.link in placed]
        for part in self._parts:
            body = placed[part.link]
            part.add_to(spec, spec.body(body.name), body.rotation.T, -body.rotation.T @ body.translation)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)
        joints = [self._model.joint(name) for name in maker.joints]
        self._qpos, self._dofs = (
            [int(adr[0]) for adr in column]
            for column in zip(*((one.qposadr, one.dofadr) for one in joints), strict=True)
        )

    def touch(self, rng: np.random.Generator, link: int | None = None) -> Pressed:
        """A touch that nothing is in front of, in any pose.

        Args:
            link: the touched one; None: each point of the arm's surface is as likely.
        """
        model, data = self._model, self._data
        parts = [part for part in self._parts if link in (None, part.link)]
        areas = np.array([part.area_m2 for part in parts])
        while True:
            q = rng.uniform(self._maker.low_rad, self._maker.high_rad)
            data.qpos[self._qpos] = q
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            part = parts[rng.choice(len(parts), p=areas / areas.sum())]
            on_link, inwards = part.draw(rng)
            body = self._placed[part.link]
            number = model.body(body.name).id
            turn = data.xmat[number].reshape(3, 3) @ body.rotation.T
            point = data.xpos[number] + turn @ (on_link - body.translation)
            inwards = turn @ inwards
            hit = np.full(1, -1, dtype=np.int32)
            free_m = mujoco.mj_ray(model, data, point - 1e-3 * inwards, -inwards, None, 1, -1, hit, None)
            if 0 <= free_m < HAND_M:
                continue
            half_angle = np.arctan(rng.uniform(*FRICTION))
            force = np.exp(rng.uniform(*np.log(PRESSED_N))) * within_cone(inwards, half_angle, rng)
            turned = np.zeros(model.nv)
            mujoco.mj_applyFT(model, data, force, np.zeros(3), point, number, turned)
            return Pressed(part.link, q, point, force, turned[self._dofs])


AREA, LINK, STRAIGHT = DRAWS = ("area", "link", "straight")
"""Each point of the arm is as likely; each link is; pushes through a wrist's centre that load the first joint alone."""


def pressed(arm: Arm, options: argparse.Namespace, drawn: str) -> list[dict]:
    """One row a touch that raises an alarm and kind of shapes, with what is found from its torques."""
    rng = np.random.default_rng([options.seed, 67, arm.bundle.joints, DRAWS.index(drawn)])
    bundle = arm.bundle
    sigma = np.array(bundle.error_scale.sigma_weights)
    touchable, models = TouchableArm(arm.maker, arm.surface), {}
    for shapes, capsules in arm.shapes.items():
        bundle.capsules = capsules
        models[shapes] = _core.PlaceModel(bundle)
        assert not models[shapes].refused, models[shapes].refused
    rows = []
    for number in range(options.touches):
        if number % TOUCHES_AN_ARM == 0:
            constants = 1 + CONSTANTS * rng.standard_normal(bundle.joints)
        while True:
            link = int(rng.integers(bundle.joints)) if drawn == LINK else None
            touch = straight_push(arm, rng) if drawn == STRAIGHT else touchable.touch(rng, link)
            share = constants * (1 - rng.uniform(0, ABSORBED, bundle.joints))
            wrong = sigma * rng.standard_t(6, bundle.joints) * np.sqrt(4 / 6)
            tau = share * touch.torque_nm + wrong
            if (np.abs(tau) > ALARM_SIGMAS * sigma).any():
                break
        in_contact = np.sqrt(sigma**2 + (CONSTANTS**2 + ABSORBED**2 / 3) * tau**2)
        for shapes, model in models.items():
            at = [one.tolist() for one in (touch.q, tau, sigma, in_contact)]
            sample = at[0], at[1], at[2], at[3], [0.0] * bundle.joints
            found = find_places(model, sample)
            known = found.best is not None and found.consistent >= INCONSISTENT
            row = {"arm": arm.title, "shapes": shapes, "drawn": drawn, "link": touch.link, "seen": known}
            if known:
                (straight, least_n), (low_n, high_n) = straight_touches(model, sample, found), found.force_interval_n
                row |= {
                    "probability": list(found.probability),
                    "straight": straight,
                    "force_n": float(np.linalg.norm(touch.force_n)),
                    "median_n": found.force_n,
                    "interval_n": [min(low_n, least_n), high_n],
                    "off_m": float(np.linalg.norm(np.subtract(found.best.point, touch.point_m))),
                    "within_m": found.within_m,
                }
            rows.append(row)
    return rows


def straight_push(arm: Arm, rng: np.random.Generator) -> Pressed:
    """A push at a wrist's joint, along the direction that loads the first joint alone, to half a standard error."""
    model, sigma, n = _core.WrenchModel(arm.bundle), np.array(arm.bundle.error_scale.sigma_weights), arm.bundle.joints
    while True:
        q, link = rng.uniform(arm.maker.low_rad, arm.maker.high_rad), int(rng.integers(n - 3, n))
        name = arm.bundle.links[link].joint_name
        columns = model.columns(name, q.tolist(), axes=_core.WrenchAxes.base)[:3]
        along = np.linalg.svd((columns[:, 1:] / sigma[1:]).T)[2][-1]
        force = np.exp(rng.uniform(*np.log(PRESSED_N))) * along
        if (np.abs(force @ columns)[1:] < 0.5 * sigma[1:]).all():
            return Pressed(link, q, model.pose(name, q.tolist())[1], force, force @ columns)


def at_rest(maker: Maker, robot: Path | None) -> Arm:
    """The arm with constant standard errors. robot: with the meshes of this file."""
    tree, bundle, scale = load_tree(maker.model, maker.joints), _core.Bundle(), _core.ErrorScaleSettings()
    settings = _core.WrenchSettings()
    settings.frames = wrench_frames(maker.model, tree)
    sigma = (SIGMA_SHARE * np.array(maker.torque_nm)).tolist()
    scale.features = [_core.MotionFeature.constant]
    scale.limit_weights = scale.largest = [1.0] * len(sigma)
    scale.sigma_weights = scale.sigma_near_weights = scale.largest_sigma = sigma
    bundle.links, bundle.gravity, bundle.error_scale, bundle.wrench_settings = tree.links, tree.gravity, scale, settings
    shapes: Shapes = {GIVEN: capsules_of(SURFACES[maker.name]), GUESSED: []}
    if robot is None:
        return Arm(maker, bundle, maker.name, SURFACES[maker.name], shapes)
    shapes[FITTED] = mesh_capsules(robot, list(maker.joints))
    return Arm(maker, bundle, f"{maker.name}, meshes", triangles_of(robot, maker.joints), shapes)


def pressed_tables(rows: list[dict]) -> list[str]:
    """By how touches are drawn, arm and shapes."""
    lines = head(
        "drawn by | arm | shapes | touches | explained | runs: links | stated | right | 85 to 95 %: stated | right "
        "| straight: named | link named | force in interval | within factor 2 | high by low | place within "
        "| distance, cm: stated | true"
    )
    for drawn in DRAWS:
        arms = [*dict.fromkeys(row["arm"] for row in rows), "**all**"]
        for arm in arms:
            for shapes in dict.fromkeys(row["shapes"] for row in rows):
                of = [row for row in rows if row["drawn"] == drawn and row["shapes"] == shapes]
                of = [row for row in of if arm in (row["arm"], "**all**")]
                if of:
                    lines.append(table_row(drawn, arm, shapes, *pressed_cells(of)))
    return lines


def pressed_cells(rows: list[dict]) -> list[object]:
    seen = [row for row in rows if row["seen"]]
    stated = np.array([statement(row["probability"], row["link"]) for row in seen])
    unsure = stated[(stated[:, 1] >= 0.85) & (stated[:, 1] <= 0.95)]
    force, median, (low, high) = (
        np.array([row[key] for row in seen]).T for key in ("force_n", "median_n", "interval_n")
    )
    off, within = (np.array([row[key] for row in seen]) for key in ("off_m", "within_m"))
    ratio = np.maximum(median / force, force / median)
    also = np.array([row["link"] in row["straight"] for row in seen])
    shares = (
        *stated.mean(axis=0)[1:],
        *(unsure.mean(axis=0)[1:] if len(unsure) else (np.nan, np.nan)),
        np.mean([bool(row["straight"]) for row in seen]),
        np.mean(also | (stated[:, 2] > 0)),
        np.mean((low <= force) & (force <= high)),
        np.mean(ratio < 2),
    )
    cells = [f"{share:.0%}" for share in shares]
    links = f"{stated[:, 0].mean():.1f}"
    places = (f"{np.median(high / low):.1f}", f"{np.mean(off <= within):.0%}")
    return [len(rows), f"{len(seen) / len(rows):.0%}", links, *cells, *places,
            *(f"{100 * np.median(one):.0f}" for one in (within, off))]  # fmt: skip


def statement(probability: list[float], link: int) -> tuple[int, float, bool]:
    """Length of the stated run of links, its probability, and whether the link is one of them."""
    first, last, share = run_of([(k, probability[k]) for k in np.argsort(-np.array(probability)).tolist()])
    return last - first + 1, share, first <= link <= last


def reliability(rows: list[dict]) -> Figure:
    """Share of runs of neighbouring links, of any length, that are right, over their stated probability; by shapes."""
    figure, axes = plt.subplots(1, 2, figsize=(9, 4.4), sharex=True, sharey=True, layout="constrained")
    edges = np.array([0, 0.05, 0.15, 0.25, 0.35, 0.45, 0.55, 0.65, 0.75, 0.85, 0.95, 1.0])
    for axis, drawn in zip(axes, (AREA, LINK), strict=True):
        axis.plot([0, 1], [0, 1], color="0.7", linewidth=1, label="calibrated")
        for shapes, mark in ((GIVEN, "o"), (FITTED, "s"), (GUESSED, "^")):
            of = [row for row in rows if row["seen"] and row["drawn"] == drawn and row["shapes"] == shapes]
            if not of:
                continue
            stated, right = np.concatenate([runs_of(row["probability"], row["link"]) for row in of], axis=1)
            at = np.digitize(stated, edges[1:-1])
            kept = [k for k in range(len(edges) - 1) if np.count_nonzero(at == k) >= 30]
            points = np.array([(stated[at == k].mean(), right[at == k].mean()) for k in kept])
            axis.plot(*points.T, mark, linestyle="-", markersize=5, label=f"{shapes}: {len(of)} touches")
        axis.set(
            title=f"each {'point' if drawn == AREA else 'link'} as often", xlabel="stated probability", aspect="equal"
        )
        axis.legend(loc="upper left", fontsize=8)
    axes[0].set_ylabel("share that is right")
    return figure


def runs_of(probability: list[float], link: int) -> np.ndarray:
    """Probability of each run of neighbouring links, and whether the link is in it, (2, runs)."""
    n = len(probability)
    runs = [(first, last) for first in range(n) for last in range(first, n) if last - first + 1 < n]
    return np.array([(sum(probability[a : b + 1]), a <= link <= b) for a, b in runs]).T


# --- Touches of people on a Panda that stands, at the sample of each that shows most.


TOUCHED = {"a4": 7, "a6": 7, "b8": 6, "b9": 6, "c3": 5, "d3": 4, "f2": 2, "f4": 2}
"""Link that people touched in each recording, from 1."""


def panda_rows(data: Path, bundles: Path, robot: Path | None) -> list[dict]:
    """One row a touch, estimate and kind of shapes."""
    arm = _core.Bundle.load(str(bundles / "observer.tauext"))
    shapes = {GIVEN: capsules_of(SURFACES["panda"]), GUESSED: []}
    if robot is not None:
        shapes[MESHES] = mesh_capsules(robot, [link.joint_name for link in arm.links])
    recordings = {name: load_recording(data / f"{name}.parquet") for name in TOUCHED}
    ours = {name: estimates(arm, one)["tau_ext"] for name, one in recordings.items()}
    own = {name: one.tau_ext for name, one in recordings.items() if one.tau_ext is not None}
    free = np.concatenate([own[name][free_rows(recordings[name])] for name in own])
    near = np.array(arm.error_scale.sigma_near_weights)
    ways = {"observer": (ours, near), "the robot's own estimate": (own, np.sqrt(np.nanmean(free**2, axis=0)))}
    rows = []
    for kind, capsules in shapes.items():
        arm.capsules = capsules
        model = _core.PlaceModel(arm)
        assert not model.refused, model.refused
        for way, (tau_ext, sigma) in ways.items():
            for name, one in recordings.items():
                found = [located(model, one, rows, tau_ext[name], sigma) for rows in touches_of(one)]
                rows += [
                    {"arm": way, "shapes": kind, "link": TOUCHED[name] - 1, "seen": True, "probability": probability}
                    for probability in found
                    if probability is not None
                ]
    return rows


def located(
    model: _core.PlaceModel, one: Recording, rows: slice, tau_ext: np.ndarray, sigma: np.ndarray
) -> list[float] | None:
    """Probability of each link; None: no estimate."""
    by_row = strength(tau_ext[rows], sigma)[:, 0]
    if not by_row.any():
        return None
    at = rows.start + int(np.argmax(by_row))
    return list(model.find(one.q[at].tolist(), tau_ext[at].tolist(), sigma.tolist(), places=False).probability)


def touches_of(recording: Recording) -> list[slice]:
    """Rows of each labelled touch; labels begin up to 0.1 s before a touch shows."""
    late = round(0.1 * recording.rate_hz)
    return [slice(begin, end + late) for begin, end in runs(np.asarray(recording.contact) > 0)]


def free_rows(recording: Recording) -> np.ndarray:
    """Samples that no touch is within 0.15 s of."""
    free = free_samples(recording, FreeMotionConfig(before_s=0.15, after_s=0.15))
    free[: round(0.3 * recording.rate_hz)] = False  # the observer begins
    return free


COLUMNS = "touches | alarms | right | among two | stated | of these right | runs: links | right"


def cells(rows: list[dict]) -> list[object]:
    """Shares of touches whose link was found, of those with an alarm."""
    seen = [row for row in rows if row["seen"]]
    ranked = [np.argsort(-np.array(row["probability"])).tolist() for row in seen]
    right = np.array([order[0] == row["link"] for order, row in zip(ranked, seen, strict=True)])
    two = np.mean([row["link"] in order[:2] for order, row in zip(ranked, seen, strict=True)])
    sure = np.array([max(row["probability"]) >= STATED for row in seen])
    stated = np.array([statement(row["probability"], row["link"]) for row in seen])
    of_sure = np.mean(right[sure]) if sure.any() else np.nan
    shares = (right.mean(), two, sure.mean(), of_sure)
    cells = (f"{share:.0%}" for share in shares)
    return [len(rows), len(seen), *cells, f"{stated[:, 0].mean():.1f}", f"{stated[:, 2].mean():.0%}"]


def tables(rows: list[dict]) -> list[str]:
    """By arm and shapes; of simulated touches also places, and links by strength."""
    lines = head(f"arm | shapes | {COLUMNS}")
    arms = [*dict.fromkeys(row["arm"] for row in rows), "**all**"]
    groups = [(arm, shapes, [row for row in rows if row["shapes"] == shapes and arm in (row["arm"], "**all**")])
              for arm in arms for shapes in dict.fromkeys(row["shapes"] for row in rows)]  # fmt: skip
    groups = [(*names, of) for *names, of in groups if of]
    lines += [table_row(arm, shapes, *cells(of)) for arm, shapes, of in groups]
    if "ratio" not in next(row for row in rows if row["seen"]):
        return lines
    lines += ["", *head("arm | shapes | places | distance, cm: median | 90 % | spread, cm | force error, N")]
    for arm, shapes, of in groups:
        placed = [row for row in of if row["seen"] and row["force_n"] >= 20 and row["angle_deg"] <= 30]
        off = 100 * np.quantile([row["off_m"] for row in placed], (0.5, 0.9))
        spread, force = (np.median([row[key] for row in placed]) for key in ("spread_m", "off_n"))
        numbers = (f"{one:.1f}" for one in (*off, 100 * spread, force))
        lines.append(table_row(arm, shapes, len(placed), *numbers))
    lines += ["", *head(f"ratio of the true torque to a limit | {COLUMNS}")]
    for low, high in ((0, 2), (2, 4), (4, 7), (7, 99)):
        of = [row for row in rows if row["shapes"] == GIVEN and row["seen"] and low <= row["ratio"] < high]
        lines += [table_row(f"{low} to {high}", *cells(of))] if of else []
    return lines


# --- How well capsules fit the meshes of robot files.


def shape_rows(robot: Path) -> list[dict]:
    """One row a link that is made of meshes: extents, and largest distances outside each other, [m]."""
    fitted = body_capsules(robot)
    try:
        meshes = meshes_of(robot, MeshFinder(robot))
    except (OSError, ValueError) as error:
        return [{"robot": robot.stem, "link": link, "guessed": str(error)} for link in fitted.lost]
    rows: list[dict] = []
    for link, corners in meshes.items():
        ends = fitted.bodies.get(link, [])
        guessed = link in fitted.lost or not ends
        fit = {"guessed": fitted.notes[0] if fitted.notes else "no shape"} if guessed else misfit(corners, ends)
        rows.append({"robot": robot.stem, "link": link} | fit)
    return rows


def misfit(corners: np.ndarray, capsules: Sequence[Ends], drawn: int = 3000) -> dict:
    """Compares the mesh (n, 3, 3), its convex hull and the capsules, [m]."""
    surface, rng = Triangles(0, corners), np.random.default_rng(0)
    points = np.array([surface.draw(rng)[0] for _ in range(drawn)])
    directions, whole = even_directions(3000), corners.reshape(-1, 3)
    hull = (whole @ directions.T).max(axis=0)
    reach = np.array([np.max(np.array(one[:2]) @ directions.T, axis=0) for one in capsules])
    radius = np.array([one[2] for one in capsules])[:, None]
    off = np.min([distance_m(points, *one) for one in capsules], axis=0)
    return {
        "capsules": len(capsules),
        "ends_outside_m": float(max((reach - hull).max(), 0)),
        "surface_outside_m": float(max((reach + radius - hull).max(), 0)),
        "mesh_outside_m": float(max(off.max(), 0)),
        "rms_m": float(np.sqrt(np.mean(off**2))),
    }


def distance_m(points: np.ndarray, start: list[float], end: list[float], radius: float) -> np.ndarray:
    """Of points (n, 3) from a capsule's surface, negative inside, (n,)."""
    way = np.subtract(end, start)
    along = np.clip((points - start) @ way / max(way @ way, 1e-12), 0, 1)
    return np.linalg.norm(points - start - along[:, None] * way, axis=1) - radius


def shape_tables(rows: list[dict]) -> list[str]:
    """By robot."""
    lines = head(
        "robot | links | guessed | capsules | ends outside, cm | surface outside, cm | mesh outside, cm | RMS, cm"
    )
    keys = ("ends_outside_m", "surface_outside_m", "mesh_outside_m", "rms_m")
    for robot in [*dict.fromkeys(row["robot"] for row in rows), "**all**"]:
        of = [row for row in rows if robot in (row["robot"], "**all**")]
        seen = [row for row in of if "guessed" not in row]
        largest = [f"{100 * max((row[key] for row in seen), default=np.nan):.1f}" for key in keys]
        lines.append(table_row(robot, len(of), len(of) - len(seen), sum(row["capsules"] for row in seen), *largest))
    return lines


def main() -> None:
    parser = arguments(__doc__, "models", "unseen", "out", arms=("panda", "kinova", "seven_axis"), seed=0)
    parser.add_argument("--meshes", nargs="+", default=[], help="robot files with meshes, each as ARM=FILE")
    parser.add_argument("--touches", type=int, default=200, help="an arm")
    parser.add_argument("--pressed", action="store_true", help="touches in MuJoCo alone")
    parser.add_argument("--drawn", nargs="+", choices=DRAWS, default=list(DRAWS), help="how these are drawn")
    parser.add_argument("--panda", type=Path, nargs=2, metavar=("DATASET", "BUNDLES"), help="the Panda at rest alone")
    parser.add_argument("--shapes", type=Path, nargs="+", metavar="ROBOT", help="robot files with meshes, alone")
    options = parser.parse_args()
    if options.shapes:
        rows = [row for robot in options.shapes for row in shape_rows(robot)]
        write_tables(options.out, shape_tables(rows), short(rows), "shapes")
        return
    robots = {name: Path(model) for name, _, model in (one.partition("=") for one in options.meshes)}
    if options.pressed:
        known = makers(options.models)
        of = [at_rest(known[name], None) for name in options.arms]
        of += [at_rest(known[name], robot) for name, robot in robots.items()]
        rows = [row for arm in of for drawn in options.drawn for row in pressed(arm, options, drawn)]
        write_tables(options.out, pressed_tables(rows), short(rows), "pressed")
        reliability(rows).savefig(options.out / "reliability.png", dpi=110)
        return
    if options.panda:
        rows = panda_rows(*options.panda, robots.get("panda"))
    else:
        arms = {name: ready(options.models, options.unseen, options.out, name) for name in {*options.arms, *robots}}
        rows = [row for name in options.arms for row in judged(arms[name], options)]
        rows += [row for name, model in robots.items() for row in judged(meshed(arms[name], model), options)]
    write_tables(options.out, tables(rows), short(rows), "panda_touches" if options.panda else "links")


if __name__ == "__main__":
    main()
