"""Picks and places with expect_load(): false collisions, what was weighed, and collisions within the same windows.

    python benchmarks/picks.py MODELS OUT [--arms ur5 panda ...] [--picks 80 80 ...] [--seed 0]

Each arm is trained on nine minutes of ordinary motion and eight of picks of nothing. Then it picks loads of 0.5 to 3 kg
off tables, suddenly and gradually, moves with them and puts them down; and it is hit within such a window, without a
load and with one in hand. OUT/README.md and OUT/picks.json get the tables; those of docs/results/picks are of this
command. What is there is used again.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from picking.results import markdown, summary
from picking.takes import write_pick
from picking.watched import Outcome, errors, watch
from unseen.arms import Maker, makers, true_arm
from unseen.recordings import description, write_take
from weighing.takes import TRAIN

EMPTY = 24
"""Picks of nothing to train on, twenty seconds each."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", type=Path, help="folder of ur5_robot.urdf, panda.urdf and kinova.urdf")
    parser.add_argument("out", type=Path)
    parser.add_argument("--arms", nargs="+", default=["ur5", "panda"])
    parser.add_argument("--picks", nargs="+", type=int, default=[80, 80], help="of each arm; as many collisions")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    outcomes: list[Outcome] = []
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        for name, picks in zip(options.arms, options.picks, strict=True):
            maker, folder = makers(options.models)[name], options.out / name
            takes = plan(picks)
            simulate_all(pool, maker, folder, options.seed, takes)
            data = dataset(maker, folder, options.seed, takes)
            bundle = train(folder, data)
            free = errors(bundle, data, [f"empty-{k:03d}" for k in range(EMPTY)])
            jobs = [pool.submit(watch, name, bundle, data, folder / "csv", take, free) for take in names(takes)]
            outcomes += [job.result() for job in jobs]
            print(markdown(outcomes, ""), flush=True)
    counts = " ".join(map(str, options.picks))
    asked = f"python benchmarks/picks.py MODELS OUT --arms {' '.join(options.arms)} --picks {counts}"
    (options.out / "picks.json").write_text(json.dumps(summary(outcomes)) + "\n")
    (options.out / "README.md").write_text(markdown(outcomes, asked))


def plan(picks: int) -> dict[str, int]:
    """Takes by their kind."""
    return {"empty": EMPTY, "pick": picks, "any": 3 * picks // 4, "any-hand": picks // 4, "down": picks // 4}


def names(takes: dict[str, int]) -> list[str]:
    """Of the takes that are watched."""
    return [f"{kind}-{k:03d}" for kind, count in takes.items() if kind != "empty" for k in range(count)]


def simulate_all(pool: ProcessPoolExecutor, maker: Maker, folder: Path, seed: int, takes: dict[str, int]) -> None:
    raw = folder / "csv"
    raw.mkdir(parents=True, exist_ok=True)
    jobs = [
        pool.submit(write_take, maker, seed, k, raw, TRAIN)
        for k, take in enumerate(TRAIN)
        if not (raw / f"{take.name}.truth.npz").exists()
    ]
    for kind, count in takes.items():
        what, _, hand = kind.partition("-")
        contact = "none" if what == "pick" else what
        jobs += [
            pool.submit(write_pick, maker, seed, k, raw, k % 2 == 0, contact, hand == "hand") for k in range(count)
        ]
    for job in jobs:
        job.result()


def dataset(maker: Maker, folder: Path, seed: int, takes: dict[str, int]) -> Path:
    """Imported with constants that are true."""
    out = folder / "data"
    if out.is_dir():
        return out
    arm = true_arm(maker, maker.random(seed, 0))
    text = description(maker, seed, model=True, takes=TRAIN)
    text = re.sub(r"torque_constant = .*", f"torque_constant = {arm.nm_per_ampere.tolist()}", text)
    ordinary = [f"{take.name}.csv" for take in TRAIN]
    empty = [f"empty-{k:03d}.csv" for k in range(takes["empty"])]
    watched = [f"{name}.csv" for name in names(takes)]
    text = re.sub(r"\ntrain = .*", f"\ntrain = {json.dumps(ordinary + empty)}", text)
    touched = [name for name in watched if not name.startswith("pick")]
    text = re.sub(r"\ntest = .*", f"\ntest = {json.dumps([name for name in watched if name not in touched])}", text)
    text = re.sub(r"\ncollisions = .*", f"\ncollisions = {json.dumps(touched)}", text)
    (folder / "csv" / "arm.toml").write_text(text)
    files = [str(folder / "csv" / name) for name in ordinary + empty + watched]
    command("import", "--source", *files, "--arm", folder / "csv" / "arm.toml", "--out", out)
    return out


def train(folder: Path, data: Path) -> Path:
    out = folder / "arm.tauext"
    if not out.exists():
        command("train", "--data", data, "--recipe", "prior", "--out", out, "--fit-torque-constants", "False")
    return out


def command(*arguments: str | Path) -> None:
    """Run `tauext ARGUMENTS`; RuntimeError where it failed."""
    words = [sys.executable, "-m", "tauext", *map(str, arguments)]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    if ended.returncode:
        raise RuntimeError(f"{' '.join(words)}:\n{ended.stdout}{ended.stderr}")


if __name__ == "__main__":
    main()
