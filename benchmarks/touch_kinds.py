"""What kind of touch: impacts, pushes, clamps and loads with physical causes on arms that nothing was fixed on.

    python benchmarks/touch_kinds.py MODELS OUT [--arms panda kinova ...] [--touches 25] [--seed 12]

Each arm is trained on nine minutes of free motion and then touched, --touches times by each kind. MODELS: folder of
ur5_robot.urdf, panda.urdf and kinova.urdf. OUT/README.md and OUT/kinds.json get the tables; those of docs/results/kinds
are of this command. What is there is used again.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from kinds.results import markdown, summary
from kinds.takes import KINDS, name_of, write_touch
from kinds.watched import Watched, watch
from picks import command
from unseen.arms import Maker, makers
from unseen.fresh import fresh_makers
from unseen.recordings import description, write_take
from weighing.takes import TRAIN

ARMS = ("panda", "kinova", "seven_axis", "light_arm", "offset_wrist", "palletizer")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--arms", nargs="+", default=list(ARMS))
    parser.add_argument("--touches", type=int, default=25, help="of each kind on each arm")
    parser.add_argument(
        "--seed", type=int, default=12, help="of arms and touches; the rules were fixed with 0 to 3 and 11"
    )
    options = parser.parse_args()
    known = makers(options.models) | fresh_makers()
    asked = f"python benchmarks/touch_kinds.py MODELS OUT --touches {options.touches} --seed {options.seed}"
    asked += f" --arms {' '.join(options.arms)}" if tuple(options.arms) != ARMS else ""
    outcomes: list[Watched] = []
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for arm in options.arms:
            folder = options.out / arm
            simulate_all(pool, known[arm], folder, options.seed, options.touches)
            data = dataset(known[arm], folder, options.seed, options.touches)
            bundle = train(folder, data)
            jobs = [pool.submit(watch, arm, bundle, data, folder / "csv", name) for name in names(options.touches)]
            outcomes += [job.result() for job in jobs]
            print(markdown(outcomes, asked), flush=True)
    (options.out / "kinds.json").write_text(json.dumps(summary(outcomes)) + "\n")
    (options.out / "README.md").write_text(markdown(outcomes, asked))


def names(touches: int) -> list[str]:
    return [name_of(kind, number) for kind in KINDS for number in range(touches)]


def simulate_all(pool: ProcessPoolExecutor, maker: Maker, folder: Path, seed: int, touches: int) -> None:
    """Takes to train on and touches; not what is there."""
    raw = folder / "csv"
    raw.mkdir(parents=True, exist_ok=True)
    jobs = [
        pool.submit(write_take, maker, seed, k, raw, TRAIN)
        for k, take in enumerate(TRAIN)
        if not (raw / f"{take.name}.truth.npz").exists()
    ]
    jobs += [pool.submit(write_touch, maker, seed, kind, number, raw) for kind in KINDS for number in range(touches)]
    for job in jobs:
        job.result()


def dataset(maker: Maker, folder: Path, seed: int, touches: int) -> Path:
    """Imported as an integrator would, with constants that are off by up to 10 % or unknown."""
    out = folder / "data"
    if out.is_dir():
        return out
    text = description(maker, seed, model=True, takes=TRAIN)
    files = [f"{name}.csv" for name in names(touches)]
    text = re.sub(r"\ncollisions = .*", f"\ncollisions = {json.dumps(files)}", text)
    (folder / "csv" / "arm.toml").write_text(text)
    sources = [str(folder / "csv" / name) for name in [f"{take.name}.csv" for take in TRAIN] + files]
    command("import", "--source", *sources, "--arm", folder / "csv" / "arm.toml", "--out", out)
    return out


def train(folder: Path, data: Path) -> Path:
    out = folder / "arm.tauext"
    if not out.exists():
        command("train", "--data", data, "--recipe", "prior", "--out", out)
    return out


if __name__ == "__main__":
    sys.exit(main())
