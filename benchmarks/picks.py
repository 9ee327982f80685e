"""Picks and places with expect_load(): false collisions, what was weighed, and collisions within the same windows.

    python benchmarks/picks.py MODELS OUT [--arms ur5 panda ...] [--picks 80 80 ...] [--seed 0]

Each arm is trained on nine minutes of ordinary motion and eight of picks of nothing. Then it picks loads of 0.5 to 3 kg
off tables, suddenly and gradually, moves with them and puts them down; and it is hit within such a window, without a
load and with one in hand. OUT/README.md and OUT/picks.json get the tables; those of docs/results/picks are of this
command. What is there is used again.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

from common import arguments, in_parallel, trained, write_page
from picking.results import Outcome, errors, markdown, summary, watch
from picking.takes import write_pick
from unseen.arms import Maker, makers, true_arm
from unseen.recordings import description, import_csv, simulate_takes
from weighing.takes import TRAIN

EMPTY = 24
"""Picks of nothing to train on, twenty seconds each."""


def main() -> None:
    parser = arguments(__doc__, "models", "out")
    parser.add_argument("--arms", nargs="+", default=["ur5", "panda"])
    parser.add_argument("--picks", nargs="+", type=int, default=[80, 80], help="of each arm; as many collisions")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    outcomes: list[Outcome] = []
    for name, picks in zip(options.arms, options.picks, strict=True):
        maker, folder = makers(options.models)[name], options.out / name
        takes = plan(picks)
        simulate_all(maker, folder, options.seed, takes)
        data = dataset(maker, folder, options.seed, takes)
        bundle = trained(data, folder / "arm.tauext", "--fit-torque-constants", "False")
        free = errors(bundle, data, [f"empty-{k:03d}" for k in range(EMPTY)])
        jobs = [(name, bundle, data, folder / "csv", take, free) for take in names(takes)]
        outcomes += in_parallel(os.cpu_count(), watch, jobs)
    counts = " ".join(map(str, options.picks))
    asked = f"python benchmarks/picks.py MODELS OUT --arms {' '.join(options.arms)} --picks {counts}"
    (options.out / "picks.json").write_text(json.dumps(summary(outcomes)) + "\n")
    write_page(options.out / "README.md", markdown(outcomes, asked))


def plan(picks: int) -> dict[str, int]:
    """Takes by their kind."""
    return {"empty": EMPTY, "pick": picks, "any": 3 * picks // 4, "any-hand": picks // 4, "down": picks // 4}


def names(takes: dict[str, int]) -> list[str]:
    """Of the takes that are watched."""
    return [f"{kind}-{k:03d}" for kind, count in takes.items() if kind != "empty" for k in range(count)]


def simulate_all(maker: Maker, folder: Path, seed: int, takes: dict[str, int]) -> None:
    """Recordings to train on, and takes of every kind; not those that exist."""
    raw = folder / "csv"
    simulate_takes(maker, seed, raw, TRAIN, os.cpu_count())
    jobs = []
    for kind, count in takes.items():
        what, _, hand = kind.partition("-")
        contact = "none" if what == "pick" else what
        jobs += [(maker, seed, k, raw, k % 2 == 0, contact, hand == "hand") for k in range(count)]
    in_parallel(os.cpu_count(), write_pick, jobs)


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
    files = [folder / "csv" / name for name in ordinary + empty + watched]
    import_csv(text, files, folder / "csv" / "arm.toml", out)
    return out


if __name__ == "__main__":
    main()
