"""The demo without a browser: a weight in the hand that nobody told of, and one that the monitors know."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tauext.bundle.bundle_file import load_bundle
from tauext.page.hand import LEAST_KG, MOST_KG
from tauext.page.simulation import Simulation
from tauext.page.snapshot import Event
from tauext.page.weighing import weigh, weighed_words
from tauext.sim.arms import DemoArm

FREE_S, HELD_S = 3.0, 5.0


@dataclass(frozen=True)
class Carried:
    """One weight, put in while the arm moves, and what was made of it."""

    mass_kg: float
    told: bool
    begin_s: float
    collisions: dict[str, Event]
    """The first while it was held, of each method that raised one."""
    refused: dict[str, str]
    """Why methods refused to be told."""
    weighed: str


def carried_weights(
    arm: DemoArm, bundles: dict[str, Path], seed: int, held_s: float = HELD_S, method: str = "tauext"
) -> list[Carried]:
    """The same weight in the same motion, not told and told; nothing where the arm has no hand."""
    if arm.hand_m is None:
        return []
    mass_kg = round(float(np.random.default_rng(seed).uniform(LEAST_KG, MOST_KG)), 1)
    return [_carry(arm, bundles, seed, mass_kg, told, held_s, method) for told in (False, True)]


def _carry(
    arm: DemoArm, bundles: dict[str, Path], seed: int, mass_kg: float, told: bool, held_s: float, method: str
) -> Carried:
    simulation = Simulation(arm, seed)
    simulation.watch_with({name: str(path) for name, path in bundles.items()}, method)
    simulation.set_reaction("ignore")
    for _ in range(round(FREE_S * arm.rate_hz)):
        simulation.step()
    simulation.resume()
    simulation.take_events()
    begin_s = simulation.plant.time_s
    simulation.hold(mass_kg, told)
    collisions: dict[str, Event] = {}
    for _ in range(round(held_s * arm.rate_hz)):
        if simulation.step():
            for event in simulation.take_events():
                if event.alarm == "collision":
                    collisions.setdefault(event.method, event)
    refused = {name: held.refused for name in bundles if (held := simulation.hand.held(name)) and held.refused}
    weighed = weighed_words(weigh(load_bundle(bundles[method]), arm, simulation.recent()))
    return Carried(mass_kg, told, begin_s, collisions, refused, weighed)


def describe_weights(weights: list[Carried], arm: DemoArm, bundles: dict[str, Path]) -> str:
    """A line a weight, one a method, and what was weighed."""
    lines = []
    for carried in weights:
        lines.append(f"{carried.mass_kg:.1f} kg into the hand, {'told' if carried.told else 'not told'}")
        for name in sorted(bundles):
            event = carried.collisions.get(name)
            said = "nothing"
            if event is not None:
                late_ms = 1e3 * (event.time_s - carried.begin_s)
                said = f"collision at {arm.joints[event.joint]} after {late_ms:.0f} ms"
            if name in carried.refused:
                said += f"; could not be told: {carried.refused[name]}"
            lines.append(f"          {name:9s} {said}")
        lines.append(f"          weighed   {carried.weighed}")
    return "\n".join(lines)
