"""Good data on which the check must find nothing, and ways to break it, each with the finding that it must lead to."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from made_arms import Part, planar_rig, seven_axis, six_axis
from made_recordings import Drive, Made, made_motion

from tauext import _core
from tauext.check.examine import Diagnosis
from tauext.check.finding import Finding
from tauext.check.motion import low_pass
from tauext.check.robot_file import with_load
from tauext.data.recording import FLAGS, SIGNALS, Recording
from tauext.robot.read import load_tree

UP, ACROSS = np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0])


def scara() -> list[Part]:
    """Two upright axes, a horizontal arm, and a wrist that tilts and turns a tool: gravity acts on the tilt alone."""
    return [
        _rod("column", None, 0.0, UP, 12.0, 0.35, 0.5),
        _rod("elbow", "column", 0.35, UP, 6.0, 0.3, 0.3),
        _rod("tilt", "elbow", 0.3, ACROSS, 3.0, 0.2, 0.05),
        _rod("turn", "tilt", 0.2, np.array([1.0, 0.0, 0.0]), 1.0, 0.1, 0.02),
    ]


def parallel() -> list[Part]:
    """Four links in one vertical plane."""
    names, masses = ("lift", "reach", "pitch", "tip"), (9.0, 6.0, 3.0, 1.0)
    before = (None, *names)
    return [
        _rod(name, before[k], 0.35 if k else 0.0, ACROSS, mass, 0.35, 0.3 / (k + 1))
        for k, (name, mass) in enumerate(zip(names, masses, strict=True))
    ]


def _rod(name: str, parent: str | None, along: float, axis: np.ndarray, kg: float, length: float, rotor: float) -> Part:
    inertia = kg * length**2 / 12 * np.diag([0.1, 1.0, 1.0])
    com = np.array([0.45 * length, 0.0, 0.05])
    return Part(name, parent, "revolute", np.array([along, 0, 0]), np.zeros(3), axis, kg, com, np.zeros(3), inertia,
                rotor)  # fmt: skip


def scaled(parts: list[Part], masses: float) -> list[Part]:
    return [replace(part, mass=masses * part.mass, inertia=masses * part.inertia) for part in parts]


@dataclass(frozen=True)
class Setting:
    """One arm as it may stand in a laboratory."""

    name: str
    parts: list[Part]
    rate_hz: float = 100.0
    drive: Drive = Drive()


CURRENT = Drive(nm_per_a=(13.0, 13.0, 9.4, 4.6, 4.6, 4.5), step=0.02, presliding_rad=2e-3, load=0.05, pause_s=2.0)

SETTINGS = [
    Setting("six, half as heavy, little friction", scaled(six_axis(), 0.5), 250.0, Drive(friction=0.2)),
    Setting("six, twice as heavy, much friction", scaled(six_axis(), 2.0), 125.0, Drive(friction=3.0, noise=0.05)),
    Setting("seven, 50 Hz, no velocity filter", seven_axis(), 50.0, Drive(velocity_filter_s=0.0)),
    Setting("seven, 500 Hz, quiet", seven_axis(), 500.0, Drive(noise=0.003, velocity_filter_s=0.005)),
    Setting("seven, 200 Hz, noisy", seven_axis(), 200.0, Drive(noise=0.15, velocity_filter_s=0.01, friction=2.0)),
    Setting("scara, quintic", scara(), 250.0, Drive(friction=0.5)),
    Setting("scara, trapezoids and pauses", scara(), 100.0,
            Drive(profile="trapezoid", pause_s=3.0, presliding_rad=1e-3, noise=0.03)),
    Setting("parallel, 1 kHz", parallel(), 1000.0, Drive(friction=0.3, noise=0.05, velocity_filter_s=0.002)),
    Setting("parallel, presliding and pauses", parallel(), 100.0,
            Drive(presliding_rad=5e-3, pause_s=3.0, load=0.1, profile="trapezoid")),
    Setting("planar rig, trapezoids", planar_rig(), 500.0, Drive(profile="trapezoid", pause_s=2.0, noise=0.03)),
    Setting("six, presliding, load, warming by 8 %", six_axis(), 100.0,
            Drive(presliding_rad=3e-3, load=0.1, warming=0.08, pause_s=2.0, profile="trapezoid", noise=0.02))
]  # fmt: skip
"""Good data: effort is a torque, signs and order are right."""

CURRENTS = [
    Setting("six, currents, 125 Hz, trapezoids", six_axis(), 125.0, replace(CURRENT, profile="trapezoid")),
    Setting("six, currents, 250 Hz, warming", six_axis(), 250.0, replace(CURRENT, warming=0.3, step=0.01)),
    Setting("seven, currents, 100 Hz", seven_axis(), 100.0, replace(CURRENT, step=0.03, noise=0.05)),
    Setting("seven, motor side, 500 Hz", seven_axis(), 500.0,
            replace(CURRENT, nm_per_a=(100.0, 100.0, 80.0, 80.0, 50.0, 50.0, 50.0), step=0.001))
]  # fmt: skip
"""Efforts that are currents or torques before the gear: without a model nothing is wrong with them."""


J = 1
"""The joint that is broken: the second, which carries the arm."""
DEG = 180 / np.pi


class NotApplicable(Exception):
    """This case cannot be broken in this way."""


@dataclass(frozen=True)
class Case:
    """Good data of an arm, which faults then change."""

    made: Made
    urdf: Path
    minutes: float
    rate_hz: float

    @property
    def tree(self) -> _core.Tree:
        return load_tree(self.urdf, self.made.recordings[0].joints)

    def anew(self, tree: _core.Tree, **options: object) -> list[Recording]:
        self.needs_urdf()
        options = {"minutes": self.minutes, "rate_hz": self.rate_hz, "seed": 1} | options
        return made_motion(tree, **options).recordings  # type: ignore[arg-type]

    def needs_urdf(self) -> None:
        if self.urdf.suffix != ".urdf":
            raise NotApplicable


Broken = tuple[list[Recording], str]
"""Recordings, and the text of the robot file."""


@dataclass(frozen=True)
class Fault:
    name: str
    code: str
    joint: int | None
    """Index of the joint that must be named; None: any or none."""
    broken: Callable[[Case], Broken]
    words: str = ""
    """Words of the evidence that name the fault, where several have one code."""
    follows: tuple[str, ...] = ()
    """Codes of findings that the fault rightly brings with it."""
    planar: bool = True
    """Whether two joints in one plane can show it."""


def each(case: Case, change: Callable[[Recording, int], dict]) -> Broken:
    return [replace(r, **change(r, k)) for k, r in enumerate(case.made.recordings)], case.urdf.read_text()


def one(case: Case, change: Callable[[Recording], dict]) -> Broken:
    """The first recording alone."""
    return each(case, lambda r, k: change(r) if k == 0 else {})


def spiked(r: Recording, signal: str, by: float, samples: int = 1) -> dict:
    x = getattr(r, signal).copy()
    x[r.samples // 3 : r.samples // 3 + samples, J] += by
    return {signal: x}


def at(r: Recording, signal: str, j: int, change: Callable[[np.ndarray], np.ndarray]) -> dict:
    x = getattr(r, signal).copy()
    x[:, j] = change(x[:, j])
    return {signal: x}


def swapped(x: np.ndarray, a: int, b: int) -> np.ndarray:
    order = list(range(x.shape[1]))
    order[a], order[b] = b, a
    return np.ascontiguousarray(x[:, order])


def shifted(x: np.ndarray, seconds: float, rate_hz: float) -> np.ndarray:
    t = np.arange(len(x)) / rate_hz
    return np.interp(t - seconds, t, x)


def held(x: np.ndarray, first: int, rows: int) -> np.ndarray:
    x = x.copy()
    for start in range(first, len(x) - rows, 10 * rows):
        x[start : start + rows] = x[start]
    return x


def stuck(case: Case, signal: str, j: int) -> Broken:
    return each(case, lambda r, k: at(r, signal, j, lambda x: held(x, 100, round(1.5 * r.rate_hz))))


def repeated(case: Case) -> Broken:
    rng = np.random.default_rng(0)

    def change(r: Recording, k: int) -> dict:
        rows = np.maximum.accumulate(np.where(rng.random(r.samples) < 0.5, np.arange(r.samples), 0))
        return {name: getattr(r, name)[rows] for name in ("q", "dq", "tau")}

    return each(case, change)


def jittered(r: Recording, k: int) -> dict:
    """Stamped when a message arrives, not when it was measured."""
    period = 1e9 / r.rate_hz
    late = np.random.default_rng(k).uniform(0, 0.8 * period, r.samples)
    return {"t_ns": (r.t_ns + late).astype(np.int64)}


def gapped(case: Case) -> Broken:
    def change(r: Recording, k: int) -> dict:
        keep = np.ones(r.samples, dtype=bool)
        for start in (r.samples // 3, r.samples // 2):
            keep[start : start + 50] = False
        held = [name for name in ("t_ns", *SIGNALS, *FLAGS) if getattr(r, name) is not None]
        return {name: getattr(r, name)[keep] for name in held}

    return each(case, change)


def displaced(r: Recording, by_rad: float) -> dict:
    return at(r, "q", J, lambda x: x + by_rad)


def standing(case: Case, signs: list[float]) -> Broken:
    """Ten seconds in each of four poses, and friction of a tenth of the largest load that holds either way."""
    rng, tree = np.random.default_rng(0), case.tree
    t = np.arange(round(10 * case.rate_hz)) / case.rate_hz
    poses = rng.uniform(-1.5, 1.5, (4, tree.size))
    gravity = tree.momentum(poses, 0 * poses)[1]
    recordings = []
    for k, (pose, load_nm) in enumerate(zip(poses, gravity, strict=True)):
        held_nm = load_nm + 0.1 * np.abs(gravity).max(axis=0) * rng.uniform(-1, 1, tree.size)
        noise = rng.standard_normal((len(t), tree.size))
        shape: dict = {name: None for name in (*SIGNALS, *FLAGS)}
        shape |= {"t_ns": (1e9 * t).astype(np.int64), "q": pose + 0 * noise, "dq": 1e-4 * noise}
        tau = np.array(signs) * (held_nm + 0.01 * np.abs(held_nm).max() * noise)
        recordings.append(replace(case.made.recordings[0], name=f"pose-{k}", **shape | {"tau": tau}))
    return recordings, case.urdf.read_text()


def growing(case: Case) -> Broken:
    """A zero that drifts from the first recording to the last."""
    per_s = 0.2 / 60 * float(case.made.recordings[0].tau[:, J].std())
    return each(case, lambda r, k: at(r, "tau", J, lambda x: x + per_s * (k * r.duration_s + r.time_s)))


def sometimes(r: Recording) -> np.ndarray:
    """1 for two seconds of every six, (samples,)."""
    on: np.ndarray = r.time_s % 6.0 < 2.0
    return on


def uncompensated(case: Case) -> Broken:
    return each(case, lambda r, k: {"tau": r.tau - case.made.gravity[k]})


def external(case: Case) -> Broken:
    """What is left of the torque where a driver subtracts its model: noise, and a little of everything."""
    rng = np.random.default_rng(0)

    def change(r: Recording, k: int) -> dict:
        noise = low_pass(rng.standard_normal(r.tau.shape), 2.0, r.rate_hz)
        return {
            "tau": 0.02 * r.tau
            + 0.05 * r.tau.std(axis=0) * (noise / noise.std() + 0.1 * rng.standard_normal(r.tau.shape))
        }

    return each(case, change)


def drifting(case: Case) -> Broken:
    case.needs_urdf()
    made = made_motion(case.tree, 8.0, 50.0, seed=2)
    whole, done, recordings = sum(r.samples for r in made.recordings), 0, []
    for r, friction in zip(made.recordings, made.friction, strict=True):
        share = (np.arange(r.samples)[:, None] + done) / whole
        done += r.samples
        warm = np.repeat(25 + 20 * share, len(r.joints), axis=1)
        recordings.append(replace(r, tau=r.tau - 0.4 * share * friction, temperature=warm))
    return recordings, case.urdf.read_text()


def touched(r: Recording, k: int) -> dict:
    contact = r.contact.copy()
    contact[500:600] = 1
    return {"contact": contact}


def pushed(r: Recording, k: int, lasts_s: float, share: float) -> dict:
    """Four half sines at the joints up to a random one, of this share of their torques' spread; nobody labels them."""
    rng, tau = np.random.default_rng(k), r.tau.copy()
    for start_s in rng.uniform(2, r.duration_s - 2 - lasts_s, 4):
        last = int(rng.integers(1, len(r.joints)))
        during = (r.time_s > start_s) & (r.time_s < start_s + lasts_s)
        shape = np.sin(np.pi * (r.time_s[during] - start_s) / lasts_s)[:, None]
        way = rng.choice([-1, 1], last + 1) * rng.uniform(0.5, 1, last + 1)
        tau[during, : last + 1] += share * shape * way * r.tau.std(axis=0)[: last + 1]
    return {"tau": tau, "contact": None}


def tilted(case: Case) -> Broken:
    tree = _core.Tree(list(case.tree.links), [0.0, 9.81 * np.sin(0.7), -9.81 * np.cos(0.7)])
    return case.anew(tree), case.urdf.read_text()


def loaded(case: Case) -> Broken:
    kg = max(2.0, 0.15 * sum(link.mass for link in case.tree.links))
    return case.anew(with_load(case.tree, np.array([kg, 0.02 * kg, 0, 0.08 * kg]))), case.urdf.read_text()


def coarse_nm(case: Case) -> float:
    return 0.3 * float(case.made.recordings[0].tau[:, J].std())


def most_nm(case: Case) -> float:
    return float(np.quantile(case.made.recordings[0].tau[:, J], 0.9))


def link_text(case: Case, change: Callable[[str], str], j: int) -> Broken:
    """The robot file with the inertial element of joint j's link changed."""
    case.needs_urdf()
    text, joint = case.urdf.read_text(), case.made.recordings[0].joints[j]
    link = re.search(rf'<joint name="{joint}".*?<child link="(.*?)"', text, re.S).group(1)  # type: ignore[union-attr]
    whole = re.search(rf'<link name="{link}">.*?</link>', text, re.S).group(0)  # type: ignore[union-attr]
    return case.made.recordings, text.replace(whole, change(whole))


def file_text(case: Case, pattern: str, by: str) -> Broken:
    case.needs_urdf()
    return case.made.recordings, re.sub(pattern, by, case.urdf.read_text())


def not_ready(r: Recording, begin_s: float, end_s: float, value: float = 0.0) -> dict:
    """Every signal has one value in this time."""
    at = (r.time_s >= begin_s) & (r.time_s < end_s)
    return {name: np.where(at[:, None], value, getattr(r, name)) for name in ("q", "dq", "tau")}


def refreshed(r: Recording, signal: str, every: int) -> dict:
    """A signal that is new in every so many rows."""
    return {signal: getattr(r, signal)[np.arange(r.samples) // every * every]}


def pressed(r: Recording, k: int) -> dict:
    """Pushes of one to three seconds with breaks of the same length, on all joints, each of a share of its torque."""
    rng, on, end_s = np.random.default_rng(k), np.zeros(r.samples, dtype=bool), 0.0
    while end_s < r.duration_s:
        begin_s, lasts_s = end_s + rng.uniform(1, 3), rng.uniform(1, 3)
        on |= (r.time_s >= begin_s) & (r.time_s < begin_s + lasts_s)
        end_s = begin_s + lasts_s
    return {"tau": r.tau + on[:, None] * 0.4 * r.tau.std(axis=0) * rng.choice([-1.0, 1.0], len(r.joints))}


def percent(case: Case) -> np.ndarray:
    """Torque of a percent of each joint's largest torque, [Nm]; joints near the tip have small drives."""
    return np.geomspace(4.0, 0.3, case.tree.size)


def in_grams(case: Case) -> Broken:
    case.needs_urdf()
    change = lambda found: f'<mass value="{1000 * float(found[1])!r}"'  # noqa: E731
    return case.made.recordings, re.sub(r'<mass value="([^"]*)"', change, case.urdf.read_text())


FAULTS = [
    Fault("effort of one joint negated", "effort-sign", J,
          lambda c: each(c, lambda r, k: at(r, "tau", J, np.negative))),
    Fault("effort of all joints negated", "effort-sign", J, lambda c: each(c, lambda r, k: {"tau": -r.tau})),
    Fault("effort times 1.6", "effort-scale", J, lambda c: each(c, lambda r, k: at(r, "tau", J, lambda x: 1.6 * x)),
          follows=("beyond-limit",)),
    Fault("effort is current, 8 to 14 Nm/A", "effort-scale", J,
          lambda c: each(c, lambda r, k: {"tau": r.tau / np.linspace(14, 8, len(r.joints))})),
    Fault("effort in percent of each joint's largest torque", "effort-scale", J,
          lambda c: each(c, lambda r, k: {"tau": r.tau / percent(c)})),
    Fault("masses of the robot file in g", "inertia-impossible", None, in_grams, "weighs", ("beyond-limit",), False),
    Fault("effort before a gear of 100", "effort-motor-side", J, lambda c: each(c, lambda r, k: {"tau": r.tau / 100})),
    Fault("effort without gravity", "effort-compensated", J, uncompensated, "friction and inertia explain"),
    Fault("effort is external torque", "effort-compensated", J, external, "gravity, inertia and friction explain"),
    Fault("torque 40 ms late", "torque-delay", J,
          lambda c: each(c, lambda r, k: {"tau": np.stack([shifted(x, 0.04, r.rate_hz) for x in r.tau.T], axis=1)})),
    Fault("torque of one joint 40 ms early", "torque-delay", J,
          lambda c: each(c, lambda r, k: at(r, "tau", J, lambda x: shifted(x, -0.04, r.rate_hz)))),
    Fault("q and dq in degrees", "degrees", None, lambda c: each(c, lambda r, k: {"q": DEG * r.q, "dq": DEG * r.dq})),
    Fault("q in degrees", "degrees", None, lambda c: each(c, lambda r, k: {"q": DEG * r.q})),
    Fault("q and dq of one joint in degrees", "degrees", J,
          lambda c: each(c, lambda r, k: at(r, "q", J, lambda x: DEG * x) | at(r, "dq", J, lambda x: DEG * x))),
    Fault("dq in degrees per second", "velocity-unit", J, lambda c: each(c, lambda r, k: {"dq": DEG * r.dq})),
    Fault("dq in turns per minute", "velocity-unit", J,
          lambda c: each(c, lambda r, k: at(r, "dq", J, lambda x: x * 60 / (2 * np.pi)))),
    Fault("dq negated", "velocity-sign", J, lambda c: each(c, lambda r, k: at(r, "dq", J, np.negative))),
    Fault("dq 40 ms late", "velocity-delay", J,
          lambda c: each(c, lambda r, k: at(r, "dq", J, lambda x: shifted(x, 0.04, r.rate_hz)))),
    Fault("dq is another signal", "velocity-mismatch", J,
          lambda c: each(c, lambda r, k: at(r, "dq", J, lambda x: np.sin(np.arange(len(x)) / 97))),
          follows=("stuck",)),
    Fault("dq of two joints exchanged", "joint-order", J, lambda c: each(c, lambda r, k: {"dq": swapped(r.dq, 0, 1)}),
          follows=("stuck",)),
    Fault("efforts of two joints exchanged", "joint-order", J,
          lambda c: each(c, lambda r, k: {"tau": swapped(r.tau, 0, 1)})),
    Fault("all signals of two joints exchanged", "joint-order", J,
          lambda c: each(c, lambda r, k: {n: swapped(getattr(r, n), 1, 3 if len(r.joints) > 3 else 0)
                                          for n in ("q", "dq", "tau")})),
    Fault("an axis reversed", "joint-axis", J,
          lambda c: each(c, lambda r, k: at(r, "q", J, np.negative) | at(r, "dq", J, np.negative)
                         | at(r, "tau", J, np.negative)), planar=False),
    Fault("a zero position off by 0.1 rad", "position-offset", J, lambda c: each(c, lambda r, k: displaced(r, 0.1))),
    Fault("a zero position off by -0.5 rad", "position-offset", J, lambda c: each(c, lambda r, k: displaced(r, -0.5))),
    Fault("a zero position off by 90 degrees", "position-offset", J,
          lambda c: each(c, lambda r, k: displaced(r, np.pi / 2)), follows=("beyond-limit",)),
    Fault("the arm stands, effort of one joint negated", "effort-sign", J,
          lambda c: standing(c, [-1.0 if j == J else 1.0 for j in range(c.tree.size)]),
          follows=("never-moves", "clock-gaps", "resolution")),
    Fault("torque saturated", "saturated", J,
          lambda c: each(c, lambda r, k: at(r, "tau", J, lambda x: np.minimum(x, most_nm(c))))),
    Fault("dq saturated", "saturated", J,
          lambda c: each(c, lambda r, k: at(r, "dq", J, lambda x: np.clip(x, -0.4, 0.4))),
          follows=("velocity-mismatch", "velocity-unit")),
    Fault("q stuck", "stuck", J, lambda c: stuck(c, "q", J), follows=("velocity-mismatch",)),
    Fault("dq stuck", "stuck", J, lambda c: stuck(c, "dq", J),
          follows=("velocity-delay", "velocity-mismatch", "velocity-unit")),
    Fault("torque stuck", "stuck", J, lambda c: stuck(c, "tau", J)),
    Fault("zeros until the driver is ready", "stuck", None, lambda c: each(c, lambda r, k: not_ready(r, 0.0, 2.0)),
          "beside a jump", ("repeated-rows",)),
    Fault("a constant at the end", "stuck", None, lambda c: each(c, lambda r, k: not_ready(r, 15.0, 99.0, 0.7)),
          "beside a jump", ("repeated-rows",)),
    Fault("zeros in between", "stuck", None, lambda c: each(c, lambda r, k: not_ready(r, 7.0, 7.6)),
          "beside a jump", ("repeated-rows",)),
    Fault("no effort", "stuck", J, lambda c: each(c, lambda r, k: {"tau": 0.0 * r.tau}), "in all samples"),
    Fault("a dead band of the torque", "dead-band", J,
          lambda c: each(c, lambda r, k: at(r, "tau", J, lambda x: np.where(np.abs(x) < x.std(), 0.0, x)))),
    Fault("torques refreshed five times more slowly", "refresh-slow", None,
          lambda c: each(c, lambda r, k: refreshed(r, "tau", 5)), "torques are new in every 5 rows"),
    Fault("positions refreshed four times more slowly", "refresh-slow", None,
          lambda c: each(c, lambda r, k: refreshed(r, "q", 4)), "positions are new in every 4 rows"),
    Fault("half of the rows repeated", "repeated-rows", None, repeated),
    Fault("clock jitters", "clock-irregular", None, lambda c: each(c, jittered)),
    Fault("gaps", "clock-gaps", None, gapped),
    Fault("torque smoothed", "resolution", None,
          lambda c: each(c, lambda r, k: {"tau": low_pass(low_pass(r.tau, 3.0, r.rate_hz), 3.0, r.rate_hz)}),
          "noise of the torque"),
    Fault("torque in coarse steps", "resolution", J,
          lambda c: each(c, lambda r, k: at(r, "tau", J, lambda x: np.round(x / coarse_nm(c)) * coarse_nm(c))),
          "whole multiples"),
    Fault("a joint hardly moves", "excitation-low", J, lambda c: (c.anew(c.tree, still=J), c.urdf.read_text())),
    Fault("the arm stands", "never-moves", None,
          lambda c: (c.anew(c.tree, ranges=0.01, minutes=0.5), c.urdf.read_text()), follows=("clock-gaps",)),
    Fault("thirty seconds", "too-short", None, lambda c: (c.anew(c.tree, minutes=0.5), c.urdf.read_text())),
    Fault("friction falls by 40 % as it warms up", "torque-changes", J, drifting, "friction changes"),
    Fault("torque that grows by a fifth of its spread a minute", "torque-changes", J, growing, "zero changes"),
    Fault("unlabelled pushes in a third of the time", "torque-changes", J,
          lambda c: each(c, lambda r, k: at(r, "tau", J, lambda x: x + 1.5 * x.std() * sometimes(r))),
          "off by", follows=("odd-recording",)),
    Fault("contacts in free motion", "contact-in-free-motion", None, lambda c: each(c, touched)),
    Fault("unlabelled impacts of 50 ms", "contact-in-free-motion", None,
          lambda c: each(c, lambda r, k: pushed(r, k, 0.05, 0.6))),
    Fault("unlabelled impacts of 200 ms", "contact-in-free-motion", None,
          lambda c: each(c, lambda r, k: pushed(r, k, 0.2, 0.3))),
    Fault("unlabelled pushes of 2 s", "contact-in-free-motion", None,
          lambda c: each(c, lambda r, k: pushed(r, k, 2.0, 0.3))),
    Fault("base tilted by 40 degrees", "gravity-direction", None, tilted, follows=("odd-recording",), planar=False),
    Fault("a tool that is not in the model", "payload", None, loaded, "a payload that the model lacks"),
    Fault("a limit of position too narrow", "beyond-limit", J,
          lambda c: file_text(c, r'lower="[^"]*" upper="[^"]*"', 'lower="-0.3" upper="0.3"'), "positions from"),
    Fault("a limit of effort too low", "beyond-limit", J, lambda c: file_text(c, r'effort="[^"]*"', 'effort="1"'),
          "torques up to"),
    Fault("an inertia that is not positive", "inertia-impossible", J,
          lambda c: link_text(c, lambda x: re.sub(r'ixx="[^"]*"', 'ixx="-0.01"', x), J)),
    Fault("an inertia that is not a number", "inertia-impossible", J,
          lambda c: link_text(c, lambda x: re.sub(r'iyy="[^"]*"', 'iyy="nan"', x), J)),
    Fault("an inertia that violates the triangle inequality", "inertia-impossible", J,
          lambda c: link_text(c, lambda x: re.sub(r'izz="[^"]*"', 'izz="9"', x), J)),
    Fault("a moving link without mass", "inertia-impossible", J,
          lambda c: link_text(c, lambda x: re.sub(r'<mass value="[^"]*"', '<mass value="0"', x), J), "mass"),
    Fault("one torque sample of 1e6 in one recording", "spike", J, lambda c: one(c, lambda r: spiked(r, "tau", 1e6))),
    Fault("one torque sample of 3 times the range", "spike", J,
          lambda c: one(c, lambda r: spiked(r, "tau", 3 * float(np.ptp(r.tau[:, J]))))),
    Fault("one position off by a radian", "spike", J, lambda c: one(c, lambda r: spiked(r, "q", 1.0))),
    Fault("stamps in ms read as s", "time-unit", None,
          lambda c: each(c, lambda r, k: {"t_ns": 1000 * r.t_ns, "rate_hz": r.rate_hz / 1000})),
    Fault("stamps of one recording in ms", "time-unit", None,
          lambda c: one(c, lambda r: {"t_ns": 1000 * r.t_ns, "rate_hz": r.rate_hz / 1000})),
    Fault("torques of one recording negated", "odd-recording", None, lambda c: one(c, lambda r: {"tau": -r.tau})),
    Fault("one recording in degrees", "odd-recording", None,
          lambda c: one(c, lambda r: {"q": DEG * r.q, "dq": DEG * r.dq})),
    Fault("robot file edited after recording", "robot-file-changed", None,
          lambda c: each(c, lambda r, k: {"robot_sha256": 64 * "0"})),
    Fault("joints with other names", "joint-names", None,
          lambda c: ([replace(r, joints=tuple(f"axis_{j}" for j in range(len(r.joints)))) for r in c.made.recordings],
                     c.urdf.read_text()))
]  # fmt: skip


def is_named(fault: Fault, recordings: list[Recording], diagnosis: Diagnosis) -> bool:
    """Whether a finding of the right code and words names the right joint, or all of them."""
    joint = None if fault.joint is None else recordings[0].joints[fault.joint]
    return any(
        f.code == fault.code and fault.words in f.evidence and (joint is None or f.joint in (joint, None))
        for f in diagnosis.findings
    )


def beside(fault: Fault, diagnosis: Diagnosis) -> list[Finding]:
    """Findings that have nothing to do with the fault; that a test's recordings are short is none."""
    return [f for f in diagnosis.findings if f.code not in (fault.code, *fault.follows, "too-short")]
