"""False alarms after an arm was pushed at rest and moves on, by `Monitor.acknowledge()` and by `Monitor.resume()`.

The demo's arms move, come to rest and are pushed on a link for a while; the push ends, and they move on. In half of the
cycles nothing more happens: a collision within 4 s is false. In the other half the arm is pushed again up to a second
later: was it told, and how long after the push began?

    python benchmarks/resume.py
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from common import head, table_row

from tauext import __version__
from tauext.page.bundles import LESSONS, cache_folder, find_or_train_bundles
from tauext.page.simulation import Simulation
from tauext.page.snapshot import Event
from tauext.sim.arms import ARMS

PULLS_M = 0.12, 0.25
"""About 30 and 60 N."""


class Acknowledging(Simulation):
    """Ends the alarm when it moves on, and nothing else."""

    def resume(self) -> None:
        for monitor in self.monitors.values():
            monitor.acknowledge()
        self._alarms.clear()
        self.mover.resume()


@dataclass
class Count:
    cycles: int = 0
    false: int = 0
    pushes: int = 0
    delays_s: list[float] = field(default_factory=list)
    """Of the pushes that were told."""


class Trial:
    """One arm, pushed again and again."""

    def __init__(self, simulation: Simulation, seed: int):
        self.simulation, self.rng = simulation, np.random.default_rng(seed)
        self.count = Count()

    def run(self, cycles: int) -> Count:
        self._go(3.0)
        while self.count.cycles < cycles:
            self._cycle(again=self.count.cycles % 2 == 1)
        return self.count

    def _cycle(self, again: bool) -> None:
        self.simulation.rest()
        self._go(1.5)
        self._push(self.rng.choice(PULLS_M), self.rng.uniform(0.3, 1.5))
        self._go(self.rng.uniform(0.3, 1.5))
        self.simulation.resume()
        self.count.cycles += 1
        if self._go(self.rng.uniform(0.05, 1.0) if again else 4.0):
            self.count.false += 1
        elif again:
            told = self._push(PULLS_M[1], 1.0)
            self.count.pushes += 1
            self.count.delays_s += [event.after_push_s for event in told[:1]]
        self._clear()

    def _clear(self) -> None:
        """What went before shall not spoil the next cycle: every joint slides."""
        Simulation.resume(self.simulation)  # an acknowledgement alone may never let the arm move on
        while self._go(3.0):
            Simulation.resume(self.simulation)

    def _push(self, pull_m: float, hold_s: float) -> list[Event]:
        """Push a link sideways for so long; the collisions that were told."""
        joint = int(self.rng.integers(0, len(self.simulation.arm.joints) - 1))  # the last one hardly feels it
        origin, rotation = self.simulation.plant.body_pose(joint)
        point, across = origin + rotation @ [0.0, 0.05, 0.15], rotation[:, 0] * self.rng.choice([-1.0, 1.0])
        self.simulation.grab("script", joint, point)
        told = []
        for share in np.linspace(0.125, 1.0, 8):
            self.simulation.pull("script", point + share * pull_m * across)
            told += self._go(0.01)
        told += self._go(hold_s)
        self.simulation.release("script")
        return told

    def _go(self, seconds: float) -> list[Event]:
        told = []
        for _ in range(round(seconds * self.simulation.arm.rate_hz)):
            if self.simulation.step():
                told += [event for event in self.simulation.take_events() if event.alarm == "collision"]
        return told


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cycles", type=int, default=120, help="of every arm and way")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bundle", type=Path, help="of the rig, instead of the demo's, which are trained briefly")
    args = parser.parse_args()
    print(f"tauext {__version__}: {' '.join(sys.argv)}\n")
    columns = "arm | moves on by | cycles | false collisions | pushes soon after | told | median, 90 % of delays, ms"
    print("\n".join(head(columns)))
    for name in ["rig"] if args.bundle else ARMS:
        arm = ARMS[name]()
        bundle = args.bundle or find_or_train_bundles(arm, "exact", LESSONS[name], args.seed, cache_folder())["tauext"]
        for way, kind in (("acknowledge", Acknowledging), ("resume", Simulation)):
            simulation = kind(arm, args.seed)
            simulation.watch_with({"tauext": str(bundle)}, "tauext")
            count = Trial(simulation, args.seed).run(args.cycles)
            delays = "{:.0f}, {:.0f}".format(*np.quantile(count.delays_s, [0.5, 0.9]) * 1e3) if count.delays_s else "–"
            counts = count.cycles, count.false, count.pushes, len(count.delays_s)
            print(table_row(name, way, *counts, delays), flush=True)


if __name__ == "__main__":
    main()
