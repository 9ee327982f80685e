"""What kind of touch: impacts, pushes, clamps and loads with physical causes on arms that nothing was fixed on.

    python benchmarks/touch_kinds.py MODELS OUT [--arms panda kinova ...] [--touches 25] [--seed 12]

Each arm is trained on nine minutes of free motion and then touched, --touches times by each kind. MODELS: folder of
ur5_robot.urdf, panda.urdf and kinova.urdf. OUT/README.md and OUT/kinds.json get the tables; those of docs/results/kinds
are of this command. What is there is used again.
"""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

from common import arguments, in_parallel, trained, write_page
from kinds.results import Watched, markdown, summary, watch
from kinds.takes import KINDS, name_of, write_touch
from unseen.arms import Maker, fresh_makers, makers
from unseen.recordings import description, import_csv, simulate_takes
from weighing.takes import TRAIN

ARMS = ("panda", "kinova", "seven_axis", "light_arm", "offset_wrist", "palletizer")


def main() -> None:
    parser = arguments(__doc__, "models", "out")
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
    for arm in options.arms:
        folder = options.out / arm
        simulate_all(known[arm], folder, options.seed, options.touches)
        data = dataset(known[arm], folder, options.seed, options.touches)
        bundle = trained(data, folder / "arm.tauext")
        jobs = [(arm, bundle, data, folder / "csv", name) for name in names(options.touches)]
        outcomes += in_parallel(os.cpu_count(), watch, jobs)
    (options.out / "kinds.json").write_text(json.dumps(summary(outcomes)) + "\n")
    write_page(options.out / "README.md", markdown(outcomes, asked))


def names(touches: int) -> list[str]:
    return [name_of(kind, number) for kind in KINDS for number in range(touches)]


def simulate_all(maker: Maker, folder: Path, seed: int, touches: int) -> None:
    """Takes to train on and touches; not those that exist."""
    simulate_takes(maker, seed, folder / "csv", TRAIN, os.cpu_count())
    jobs = [(maker, seed, kind, number, folder / "csv") for kind in KINDS for number in range(touches)]
    in_parallel(os.cpu_count(), write_touch, jobs)


def dataset(maker: Maker, folder: Path, seed: int, touches: int) -> Path:
    """Imported as an integrator would, with constants that are off by up to 10 % or unknown."""
    out = folder / "data"
    if out.is_dir():
        return out
    text = description(maker, seed, model=True, takes=TRAIN)
    files = [f"{name}.csv" for name in names(touches)]
    text = re.sub(r"\ncollisions = .*", f"\ncollisions = {json.dumps(files)}", text)
    sources = [folder / "csv" / name for name in [f"{take.name}.csv" for take in TRAIN] + files]
    import_csv(text, sources, folder / "csv" / "arm.toml", out)
    return out


if __name__ == "__main__":
    main()
