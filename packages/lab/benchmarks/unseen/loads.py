"""Recordings of an unseen arm that carries something: what it is, how the arm moves, what the controller logs."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.robot.read import load_tree
from unseen.arms import Maker, add_ball, direction, true_arm
from unseen.recordings import Take, motor_temperature, write_csv
from unseen.simulation import RATE_HZ, Contact, draw_motion, simulate

FIRST_S = 1.2
"""Before the first window: observer and limits' memory have warmed up."""
WINDOW_S = 4.0
WINDOWS = 2
"""Of each load."""
KNOWN_KG = {"known": 2.805, "known-2": 1.6}
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


def carried(maker: Maker, seed: int, loads: int = 25, pushes: int = 8) -> dict[str, Carried]:
    """By the recording's name: loads of 0.5 to 3 kg within 10 cm, two that are known, and forces of 10 to 40 N."""
    rng = maker.random(seed, 500)
    takes = {}
    for k in range(loads):
        com = direction(rng) * rng.uniform(0, 0.1)
        takes[f"load-{k:02d}"] = Carried(
            float(rng.uniform(0.5, 3)), tuple(com.tolist()), float(rng.uniform(0.02, 0.06))
        )
    takes["known"] = Carried(KNOWN_KG["known"], tuple((direction(rng) * 0.06).tolist()))
    for k in range(pushes):
        across = direction(rng) * [1, 1, 0.3]  # not along gravity: that is a load
        across /= np.linalg.norm(across)
        takes[f"push-{k}"] = Carried(0.0, (0.0, 0.0, 0.0), 0.0, float(rng.uniform(10, 40)), tuple(across.tolist()))
    takes["known-2"] = Carried(KNOWN_KG["known-2"], tuple((direction(rng) * 0.08).tolist()))
    return takes


def write_carrying(maker: Maker, seed: int, name: str, folder: Path) -> None:
    """Simulate one of `carried` and write NAME.csv and NAME.truth.json; not where they exist."""
    if (folder / f"{name}.truth.json").exists():
        return
    takes, arm, known = (
        carried(maker, seed),
        true_arm(maker, maker.random(seed, 0)),
        load_tree(maker.model, maker.joints),
    )
    what, number, links = takes[name], list(takes).index(name), arm.tree.links
    add_ball(links[-1], what.mass_kg, np.array(what.com_m), what.radius_m)
    loaded = replace(arm, tree=_core.Tree(links, arm.tree.gravity))
    seconds = 40.0 if name in KNOWN_KG else FIRST_S + WINDOWS * WINDOW_S + 0.1
    span = (0.5, seconds)  # on from before the first window
    pushes = [Contact("hold", *span, len(maker.joints) - 1, 0.5, what.direction, what.push_n, span)] * (what.push_n > 0)
    for trial in range(5):  # a heavy load far out may shake an arm whose drive knows nothing of it
        rng = maker.random(seed, 1000 + 10 * number + trial)
        setpoints = draw_motion(maker, round(seconds * RATE_HZ), RATE_HZ, rng)
        try:
            run = simulate(loaded, known, setpoints, maker.torque_nm, pushes, WARM_S)
            break
        except RuntimeError:
            continue
    celsius = motor_temperature(arm, WARM_S, len(run.q), maker.random(seed, 3000 + number))
    write_csv(folder / f"{name}.csv", maker, loaded, run, [], rng, celsius)
    (folder / f"{name}.truth.json").write_text(json.dumps(asdict(what)) + "\n")
