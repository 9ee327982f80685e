"""What a fleet costs beside its tasks: one worker against two, overhead a task, and a run that has nothing to do.

    python packages/fleet/benchmarks/fleet.py MODELS OUT [--arms 40] [--minutes 12] [--ray ADDRESS]

Arms are of one simulated type (unseen.arms), as CSV files of currents: friction, tool and constants are each
arm's own. Of each 20 arms two have a broken source, and must fail alone. Each run starts with empty folders and an
empty cache of findings. MODELS: folder of the arms' URDFs, as of unseen_arms.py.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import in_parallel, type_arguments
from unseen.arms import Maker, makers
from unseen.recordings import Take, description, simulate_takes

FIRST_SEED = 300
BROKEN = {7: "headless", 13: "empty"}
"""Of each 20 arms."""


def simulate(maker: Maker, out: Path, arms: int, minutes: float, workers: int) -> Path:
    """Sources, arm.toml and fleet.toml; what is there stays."""
    takes = (
        Take("work-1", "train", minutes / 4),
        Take("work-2", "train", minutes / 4, 0, 600),
        Take("free-1", "test", minutes / 4, 0, 60),
        Take("contacts-1", "collisions", minutes / 4, round(1.5 * minutes), 360),
    )
    in_parallel(workers, sources, [(maker, k, out / f"arm-{k:02d}", takes) for k in range(arms)])
    names = [f"arm-{k:02d}" for k in range(arms)]
    tables = [f'[[arms]]\nname = "{n}"\narm = "{n}/arm.toml"\nsources = ["{n}/*.csv"]\n' for n in names]
    path = out / "fleet.toml"
    path.write_text("[evaluate]\nkeep_free_estimates = 1\n" + "".join(tables))
    return path


def sources(maker: Maker, number: int, folder: Path, takes: tuple[Take, ...]) -> None:
    """The CSV files of one arm and their description, some broken."""
    simulate_takes(maker, FIRST_SEED + number, folder, takes)
    (folder / "arm.toml").write_text(description(maker, FIRST_SEED + number, takes))
    broken = folder / f"{takes[-1].name}.csv"
    if BROKEN.get(number % 20) == "empty":
        broken.write_bytes(b"")
    if BROKEN.get(number % 20) == "headless" and (content := broken.read_bytes()).startswith(b'"time"'):
        broken.write_bytes(content.partition(b"\n")[2])


def run(fleet: Path, out: Path, *more: str) -> float:
    """Wall time, [s]."""
    started = time.monotonic()
    command = [sys.executable, "-m", "tauext", "fleet", "run", str(fleet), "--out", str(out), *more]
    environment = os.environ | {"XDG_CACHE_HOME": str(out.with_name(out.name + "-cache"))}
    done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)
    if done.returncode not in (0, 1):  # 1: an arm failed, as the broken ones must
        raise SystemExit(f"{' '.join(command)} ended with {done.returncode}")
    return time.monotonic() - started


def written(out: Path) -> dict[str, bytes]:
    """All outputs but wall times; reasons name the folder, which is another one in each run."""
    files = [
        path for path in (out / "arms").rglob("*") if path.is_file() and not path.name.endswith("wall_time_s.json")
    ]
    return {str(p.relative_to(out)): p.read_bytes().replace(str(out).encode(), b"OUT") for p in files}


def main() -> None:
    parser = type_arguments(__doc__, arms=40)
    parser.add_argument("--minutes", type=float, default=12.0, help="of motion an arm, default: %(default)s")
    parser.add_argument("--ray", default=None, help="a cluster of two cores")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    maker = replace(makers(asked.models)[asked.type], type_seed=asked.type_seed)
    fleet = simulate(maker, asked.out, asked.arms, asked.minutes, 2)
    ways = {"local-1": ("--workers", "1"), "local-2": ("--workers", "2")}
    if asked.ray:
        ways["cluster-2"] = ("--ray", asked.ray)
    seconds = {}
    for name, options in ways.items():
        for left in (asked.out / name, asked.out / f"{name}-cache"):
            shutil.rmtree(left, ignore_errors=True)
        seconds[name] = run(fleet, asked.out / name, *options)
        book = json.loads((asked.out / name / "fleet.json").read_text())
        stages = [stage for arm in book["arms"] for stage in arm["stages"].values()]
        of_tasks = [stage["seconds"] for stage in stages if stage["state"] == "done"]
        failed = [arm["name"] for arm in book["arms"] if any(s["state"] == "failed" for s in arm["stages"].values())]
        workers = int(name[-1])
        beside = (workers * seconds[name] - sum(of_tasks)) / len(of_tasks)
        ratio = seconds["local-1"] / seconds[name]
        print(
            f"{name}: {seconds[name]:.1f} s wall, "
            f"{len(of_tasks)} tasks of {sum(of_tasks):.1f} s in all, "
            f"{1e3 * beside:.0f} ms of a worker beside each task, {ratio:.2f} times local-1; "
            f"failed alone: {', '.join(failed) or 'none'}",
            flush=True,
        )
    same = all(written(asked.out / name) == written(asked.out / "local-1") for name in ways)
    print(f"outputs are the same bytes: {same}")
    again = run(fleet, asked.out / "local-1")
    print(f"nothing to do: {again:.1f} s wall for {asked.arms} arms")


if __name__ == "__main__":
    main()
