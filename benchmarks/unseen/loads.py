"""Recordings of an unseen arm that carries something: what it is, how the arm moves, what the controller logs."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.robot.read import load_tree
from unseen.arms import Maker, TrueArm, add_ball, direction, true_arm
from unseen.recordings import Take, motor_temperature, peak_nm, write_csv
from unseen.simulation import RATE_HZ, Contact, draw_contacts, draw_motion, simulate

FIRST_S = 1.2
"""Before the first window: observer and limits' memory have warmed up."""
WINDOW_S = 4.0
WINDOWS = 2
"""Of each load."""
LOADS = 25
PUSHES = 8
KNOWN_KG, KNOWN_S = 2.805, 40.0
FARTHEST_M = 0.10
WARM_S = 400.0
"""How long the arm has run: training covers it."""

TRAIN = tuple(Take(f"train-{k + 1}", "train", 3, 0, 180.0 * k) for k in range(3))
"""Nine minutes of free motion."""


@dataclass(frozen=True)
class Carried:
    """What is fixed to the last link, in its frame."""

    mass_kg: float
    com_m: tuple[float, float, float]
    radius_m: float = 0.04
    push_n: float = 0.0
    """A force on the last link instead: along a direction of the base that never changes, for the whole recording."""
    direction: tuple[float, float, float] = (1.0, 0.0, 0.0)


def carried(maker: Maker, seed: int) -> dict[str, Carried]:
    """By the recording's name: LOADS loads of 0.5 to 3 kg, one that is known, and PUSHES forces of 10 to 40 N."""
    rng = maker.random(seed, 500)
    takes = {}
    for k in range(LOADS):
        com = direction(rng) * rng.uniform(0, FARTHEST_M)
        takes[f"load-{k:02d}"] = Carried(
            float(rng.uniform(0.5, 3.0)), tuple(com.tolist()), float(rng.uniform(0.02, 0.06))
        )
    takes["known"] = Carried(KNOWN_KG, tuple((direction(rng) * 0.06).tolist()))
    for k in range(PUSHES):
        across = direction(rng) * [1, 1, 0.3]  # not along gravity: that is a load
        across /= np.linalg.norm(across)
        takes[f"push-{k}"] = Carried(0.0, (0.0, 0.0, 0.0), 0.0, float(rng.uniform(10, 40)), tuple(across.tolist()))
    return takes


def write_carrying(maker: Maker, seed: int, name: str, folder: Path) -> None:
    """Simulate one of `carried` and write NAME.csv and NAME.truth.json."""
    what = carried(maker, seed)[name]
    number = list(carried(maker, seed)).index(name)
    arm = true_arm(maker, maker.random(seed, 0))
    loaded = replace(arm, tree=with_load(arm, what))
    seconds = KNOWN_S if name == "known" else FIRST_S + WINDOWS * WINDOW_S + 0.1
    known = load_tree(maker.model, maker.joints)
    for trial in range(5):  # a heavy load far out may shake an arm whose drive knows nothing of it
        rng = maker.random(seed, 1000 + 10 * number + trial)
        setpoints = draw_motion(maker, round(seconds * RATE_HZ), RATE_HZ, rng)
        try:
            run = simulate(loaded, known, setpoints, maker.torque_nm, pushes(what, maker, seconds), WARM_S)
            break
        except RuntimeError:
            continue
    celsius = motor_temperature(arm, WARM_S, len(run.q), maker.random(seed, 3000 + number))
    write_csv(folder / f"{name}.csv", maker, loaded, run, [], rng, celsius)
    (folder / f"{name}.truth.json").write_text(json.dumps(asdict(what)) + "\n")


def with_load(arm: TrueArm, what: Carried) -> _core.Tree:
    """The arm's tree, its last link with the load."""
    links = arm.tree.links
    add_ball(links[-1], what.mass_kg, np.array(what.com_m), what.radius_m)
    return _core.Tree(links, arm.tree.gravity)


def pushes(what: Carried, maker: Maker, seconds: float) -> list[Contact]:
    """The force on the last link, on from before the first window."""
    if not what.push_n:
        return []
    return [Contact("hold", 0.5, seconds, len(maker.joints) - 1, 0.5, what.direction, what.push_n, (0.5, seconds))]


# --- Pushes on an arm that carries something, and the same pushes on the same motion of the bare arm.


PAIRS = 8
"""Of the loads of the weighing trial, the first ones."""
LENGTH_S, CONTACTS = 60.0, 8
BARE, LOADED = "bare", "loaded"
RAN_AWAY = 2.0
"""Times a joint's most speed: so fast is no arm that its drive still holds, and real drives stop before."""


def pair_names(number: int) -> tuple[str, str]:
    """Of the recording without a load, and with one."""
    return f"pushed-{number}-{BARE}", f"pushed-{number}-{LOADED}"


def write_pair(maker: Maker, seed: int, number: int, folder: Path) -> None:
    """Simulate both and write NAME.csv and NAME.truth.json, contacts with their peak torques; not what is there."""
    if all((folder / f"{name}.truth.json").exists() for name in pair_names(number)):
        return
    bare = true_arm(maker, maker.random(seed, 0))
    loaded = replace(bare, tree=with_load(bare, carried(maker, seed)[f"load-{number:02d}"]))
    for trial in range(5):  # a heavy load far out may shake an arm whose drive knows nothing of it
        try:
            for name, arm in zip(pair_names(number), (bare, loaded), strict=True):
                write_pushed(maker, seed, arm, 5000 + 10 * number + trial, folder / name)
            return
        except RuntimeError:
            continue
    raise RuntimeError(f"{maker.name}: no motion of load {number} can be simulated")


def write_pushed(maker: Maker, seed: int, arm: TrueArm, stream: int, path: Path) -> None:
    """One recording; what is drawn depends on the stream alone."""
    rng = maker.random(seed, stream)
    contacts = draw_contacts(CONTACTS, LENGTH_S, len(maker.joints), rng)
    setpoints = draw_motion(maker, round(LENGTH_S * RATE_HZ), RATE_HZ, rng)
    known = load_tree(maker.model, maker.joints)
    run = simulate(arm, known, setpoints, maker.torque_nm, contacts, WARM_S)
    if (np.abs(np.diff(run.q, axis=0)) * RATE_HZ > RAN_AWAY * np.array(maker.speed_rad_s)).any():
        raise RuntimeError("the drive lost the arm")
    celsius = motor_temperature(arm, WARM_S, len(run.q), maker.random(seed, stream + 5))
    write_csv(path.with_suffix(".csv"), maker, arm, run, contacts, rng, celsius)
    truth = [asdict(one) | {"peak_nm": peak_nm(run.tau_ext, one).tolist()} for one in contacts]
    path.with_suffix(".truth.json").write_text(json.dumps(truth, indent=1) + "\n")
