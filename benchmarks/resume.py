"""False alarms after an arm was pushed at rest and moves on, by `Monitor.acknowledge()` and by `Monitor.resume()`.

Simulated arms move, come to rest and are pushed on a link for a while; the push ends, and they move on. In half of the
cycles nothing more happens: a collision within 4 s is false. In the other half the arm is pushed again up to a second
later: is the push reported, and how long after it began?

    python benchmarks/resume.py OUT    OUT gets the bundles, which are trained briefly
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from common import arguments, head, table_row
from contact_errors import train
from pushed_arms import Hand

from tauext import __version__, _core
from tauext.sim.arms import ARMS, GearedArm
from tauext.sim.plant import Mover, Plant

PULLS_M = 0.12, 0.25
"""About 30 and 60 N."""


class WatchedArm:
    """A simulated arm that stops at a collision."""

    def __init__(self, arm: GearedArm, bundle: Path, seed: int):
        self.arm, self.plant, self.mover = arm, Plant(arm, seed), Mover(arm, seed)
        self.monitor = _core.Monitor(_core.Bundle.load(str(bundle)))
        self.hand: Hand | None = None
        self._alarm, self._moves = _core.Alarm.none, True

    def step(self) -> bool:
        """One sample; whether a collision was raised at it."""
        force, point = (None, None) if self.hand is None else self.hand.force_n(self.plant)
        joint = 0 if self.hand is None else self.hand.joint
        sample = self.plant.step(*self.mover.step(), force, point, joint)
        alarm = self.monitor.step(sample.t_ns, sample.q, sample.dq, sample.tau).alarm
        rises = alarm == _core.Alarm.collision != self._alarm
        self._alarm = alarm
        if rises and self._moves:
            self.rest()
        return rises

    def rest(self) -> None:
        self._moves = False
        self.mover.stop()

    def move_on(self, resume: bool) -> None:
        """End the alarm and move; resume: by Monitor.resume(), else by acknowledge()."""
        (self.monitor.resume if resume else self.monitor.acknowledge)()
        self._alarm, self._moves = _core.Alarm.none, True
        self.mover.resume()


@dataclass
class Count:
    cycles: int = 0
    false: int = 0
    pushes: int = 0
    delays_s: list[float] = field(default_factory=list)
    """Of the pushes that were reported."""


class Trial:
    """One arm, pushed again and again."""

    def __init__(self, watched: WatchedArm, resumes: bool, seed: int):
        self.watched, self.resumes, self.rng = watched, resumes, np.random.default_rng(seed)
        self.count = Count()

    def run(self, cycles: int) -> Count:
        self._go(3.0)
        while self.count.cycles < cycles:
            self._cycle(again=self.count.cycles % 2 == 1)
        return self.count

    def _cycle(self, again: bool) -> None:
        self.watched.rest()
        self._go(1.5)
        self._push(self.rng.choice(PULLS_M), self.rng.uniform(0.3, 1.5))
        self._go(self.rng.uniform(0.3, 1.5))
        self.watched.move_on(self.resumes)
        self.count.cycles += 1
        if self._go(self.rng.uniform(0.05, 1.0) if again else 4.0):
            self.count.false += 1
        elif again:
            self.count.pushes += 1
            self.count.delays_s += self._push(PULLS_M[1], 1.0)[:1]
        self._clear()

    def _clear(self) -> None:
        """Let every joint slide, so that no cycle changes the next one."""
        self.watched.move_on(True)  # after an acknowledgement alone the arm may never move on
        while self._go(3.0):
            self.watched.move_on(True)

    def _push(self, pull_m: float, hold_s: float) -> list[float]:
        """Push a link sideways for so long; delays of the collisions since the push began, [s]."""
        plant = self.watched.plant
        joint = int(self.rng.integers(0, len(self.watched.arm.joints) - 1))  # the last one hardly feels it
        origin, rotation = plant.body_pose(joint)
        point, across = origin + rotation @ [0.0, 0.05, 0.15], rotation[:, 0] * self.rng.choice([-1.0, 1.0])
        hand = self.watched.hand = Hand.grab(plant, joint, point)
        began_s, raised_s = plant.time_s, []
        for share in np.linspace(0.125, 1.0, 8):
            hand.target_m = point + share * pull_m * across
            raised_s += self._go(0.01)
        raised_s += self._go(hold_s)
        self.watched.hand = None
        return [at_s - began_s for at_s in raised_s]

    def _go(self, seconds: float) -> list[float]:
        """Times of the collisions, [s]."""
        steps = range(round(seconds * self.watched.arm.rate_hz))
        return [self.watched.plant.time_s for _ in steps if self.watched.step()]


def main() -> None:
    parser = arguments(__doc__, "out")
    parser.add_argument("--cycles", type=int, default=120, help="of every arm and way")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--bundle", type=Path, help="of the rig, instead of those that are trained briefly")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    print(f"tauext {__version__}: {' '.join(sys.argv)}\n")
    columns = "arm | moves on by | cycles | false collisions | later pushes | reported | median, 90 % of delays, ms"
    print("\n".join(head(columns)))
    for name in ["rig"] if args.bundle else ARMS:
        bundle = args.bundle or train(name, args.out)
        for way in ("acknowledge", "resume"):
            watched = WatchedArm(ARMS[name](), bundle, args.seed)
            count = Trial(watched, way == "resume", args.seed).run(args.cycles)
            delays = "{:.0f}, {:.0f}".format(*np.quantile(count.delays_s, [0.5, 0.9]) * 1e3) if count.delays_s else "–"
            counts = count.cycles, count.false, count.pushes, len(count.delays_s)
            print(table_row(name, way, *counts, delays), flush=True)


if __name__ == "__main__":
    main()
