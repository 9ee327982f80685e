"""Which link is touched and where: touches on every link of simulated arms, with bundles as users have them.

    python benchmarks/links.py MODELS UNSEEN OUT [--arms panda kinova seven_axis] [--touches 200] [--seed 0]

MODELS: folder of the robot files. UNSEEN: what `benchmarks/unseen_arms.py` wrote; a bundle is trained on each arm's
datasets where OUT has none. OUT gets the bundles, links.json and README.md.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from touches.bayes import Bayes, errors_of
from touches.pages import markdown
from touches.run import Arm, look_at, ready, touched

FIXED_ON = "ur5"
"""The method's numbers were looked at on this arm alone."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    for name in ("models", "unseen", "out"):
        parser.add_argument(name, type=Path)
    parser.add_argument("--arms", nargs="+", default=["panda", "kinova", "seven_axis"])
    parser.add_argument("--touches", type=int, default=200, help="an arm")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    rows: list[dict] = []
    for name in options.arms:
        rows += judged(ready(options.models, options.unseen, options.out, name), options)
        (options.out / "links.json").write_text(json.dumps(rows, indent=1) + "\n")
    words = " ".join(["python benchmarks/links.py MODELS UNSEEN OUT --arms", *options.arms])
    text = markdown(rows, f"{words} --touches {options.touches} --seed {options.seed}")
    (options.out / "README.md").write_text(text)
    print(text)


def judged(arm: Arm, options: argparse.Namespace) -> list[dict]:
    """One row a touch that raised an alarm, with what is said of it."""
    rng = np.random.default_rng([options.seed, 61, len(arm.names)])
    looks = look_at(arm, *touched(arm, options.touches, rng))
    bayes = Bayes(arm, errors_of(looks), rng)
    for look in looks:
        if look["seen"]:
            look["bayes"] = bayes.probability(look).tolist()
    return [{key: value for key, value in look.items() if not key.startswith("_")} for look in looks]


if __name__ == "__main__":
    main()
