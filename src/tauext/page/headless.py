"""The simulation without a browser: scripted pushes, and a weight in the hand that the monitors find."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tauext.bundle.bundle_file import load_bundle
from tauext.page.simulation import Simulation, weigh, weighed_words
from tauext.page.snapshot import LEAST_KG, MOST_KG, Event
from tauext.sim.arms import DemoArm

# --- The demo without a browser: scripted pushes, as fast as the machine can, and the result of every method.


FIRST_PUSH_S = 3.0
PUSH_EVERY_S = 4.0
PUSH_S = 1.0
PULL_M = 0.25
"""How far from the link the scripted pointer pulls: a push of about 60 N."""
LEAST_LEVER_M = 0.02


@dataclass(frozen=True)
class Pushed:
    """One scripted push and the alarms that it raised, first of each method and level."""

    begin_s: float
    joint: int
    torque_nm: np.ndarray
    """Largest |tau_ext| of every joint while it lasted."""
    events: list[Event]


def scripted_pushes(
    arm: DemoArm, bundles: dict[str, Path], seconds: float, seed: int, method: str = "tauext"
) -> tuple[list[Pushed], list[Event]]:
    """Push the links from the last to the first, one every few seconds; resume after each.

    Returns: the pushes, and the alarms that came without one.
    """
    simulation = Simulation(arm, seed)
    simulation.watch_with({name: str(path) for name, path in bundles.items()}, method)
    pushes: list[Pushed] = []
    false: list[Event] = []
    rng = np.random.default_rng(seed)
    begin_s, resumed_s, next_joint = FIRST_PUSH_S, 0.0, len(arm.joints) - 1
    for _ in range(round(seconds * arm.rate_hz)):
        now_s = simulation.plant.time_s
        if now_s >= begin_s and simulation.drag is None and now_s < begin_s + PUSH_S:
            joint = _pull(simulation, next_joint, rng)
            next_joint = (joint - 1) % len(arm.joints)
            pushes.append(Pushed(now_s, joint, np.zeros(len(arm.joints)), []))
        if simulation.drag is not None and now_s >= begin_s + PUSH_S:
            simulation.release("script")
            begin_s, resumed_s = begin_s + PUSH_EVERY_S, now_s + 1.0
        if resumed_s and now_s >= resumed_s:
            simulation.resume()
            resumed_s = 0.0
        raised = simulation.step()
        if simulation.drag is not None:
            np.maximum(pushes[-1].torque_nm, np.abs(simulation.tau_ext_nm), out=pushes[-1].torque_nm)
        if raised:
            for event in simulation.take_events():
                (false if event.after_push_s is None else pushes[-1].events).append(event)
    return pushes, false


def _pull(simulation: Simulation, joint: int, rng: np.random.Generator) -> int:
    """Grab the middle of a link's shape and pull across it.

    Returns: the joint whose link it is: this one or, where a push there turns nothing, the next one down that moves.
    """
    plant = simulation.plant
    model, data = plant.model, plant.data
    while True:
        point = data.geom_xpos[model.body_geomadr[joint + 1]].copy()
        directions, levers_m, _ = np.linalg.svd(plant.jacobian(point, joint))
        if levers_m[0] > LEAST_LEVER_M:
            break
        joint = (joint - 1) % len(simulation.arm.joints)
    direction = directions[:, 0] * rng.choice([-1.0, 1.0])
    simulation.grab("script", joint, point)
    simulation.pull("script", point + PULL_M * direction)
    return joint


def describe(pushes: list[Pushed], false: list[Event], arm: DemoArm) -> str:
    """A line a push, and one of false alarms."""
    lines = []
    for push in pushes:
        felt = int(np.argmax(push.torque_nm))
        lines.append(
            f"{push.begin_s:6.2f} s  push on the link of {arm.joints[push.joint]}: "
            f"{push.torque_nm[felt]:.1f} Nm at {arm.joints[felt]}"
        )
        for event in push.events:
            if event.alarm == "collision":
                over_s = event.after_limit_s
                after = "below its limit" if over_s is None else f"after {1e3 * over_s:.0f} ms over the limit"
                lines.append(f"          {event.method:9s} collision at {arm.joints[event.joint]} {after}")
        silent = {"tauext", "paper", "observer"} - {e.method for e in push.events if e.alarm == "collision"}
        lines += [f"          {method:9s} nothing" for method in sorted(silent)]
    lines.append(f"alarms without a push: {len(false)}")
    lines += [f"{e.time_s:6.2f} s  {e.method}: {e.alarm} at {arm.joints[e.joint]}" for e in false]
    return "\n".join(lines)


# --- The demo without a browser: a weight in the hand, once not set in the monitors and once set.


FREE_S, HELD_S = 3.0, 5.0


@dataclass(frozen=True)
class Carried:
    """One weight, put in while the arm moves, and the result of every method."""

    mass_kg: float
    load_set: bool
    begin_s: float
    collisions: dict[str, Event]  # of each method that raised one: the first while the weight was held
    refused: dict[str, str]  # reason, by method that refused the load
    weighed: str


def carried_weights(
    arm: DemoArm, bundles: dict[str, Path], seed: int, held_s: float = HELD_S, method: str = "tauext"
) -> list[Carried]:
    """The same weight in the same motion, not set in the monitors and set; nothing where the arm has no hand."""
    if arm.hand_m is None:
        return []
    mass_kg = round(float(np.random.default_rng(seed).uniform(LEAST_KG, MOST_KG)), 1)
    return [_carry(arm, bundles, seed, mass_kg, load_set, held_s, method) for load_set in (False, True)]


def _carry(
    arm: DemoArm, bundles: dict[str, Path], seed: int, mass_kg: float, load_set: bool, held_s: float, method: str
) -> Carried:
    simulation = Simulation(arm, seed)
    simulation.watch_with({name: str(path) for name, path in bundles.items()}, method)
    simulation.set_reaction("ignore")
    for _ in range(round(FREE_S * arm.rate_hz)):
        simulation.step()
    simulation.resume()
    simulation.take_events()
    begin_s = simulation.plant.time_s
    simulation.hold(mass_kg, load_set)
    collisions: dict[str, Event] = {}
    for _ in range(round(held_s * arm.rate_hz)):
        if simulation.step():
            for event in simulation.take_events():
                if event.alarm == "collision":
                    collisions.setdefault(event.method, event)
    refused = {name: held.refused for name in bundles if (held := simulation.hand.held(name)) and held.refused}
    weighed = weighed_words(weigh(load_bundle(bundles[method]), arm, simulation.recent()))
    return Carried(mass_kg, load_set, begin_s, collisions, refused, weighed)


def describe_weights(weights: list[Carried], arm: DemoArm, bundles: dict[str, Path]) -> str:
    """A line a weight, one a method, and what was weighed."""
    lines = []
    for carried in weights:
        state = "set" if carried.load_set else "not set"
        lines.append(f"{carried.mass_kg:.1f} kg into the hand, {state} in the monitors")
        for name in sorted(bundles):
            event = carried.collisions.get(name)
            found = "nothing"
            if event is not None:
                late_ms = 1e3 * (event.time_s - carried.begin_s)
                found = f"collision at {arm.joints[event.joint]} after {late_ms:.0f} ms"
            if name in carried.refused:
                found += f"; load refused: {carried.refused[name]}"
            lines.append(f"          {name:9s} {found}")
        lines.append(f"          weighed   {carried.weighed}")
    return "\n".join(lines)
