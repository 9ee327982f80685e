"""What a fleet costs beside its tasks: one worker against two, overhead a task, and a run that has nothing to do.

    python benchmarks/fleet.py --arms 40 --minutes 1 --out FOLDER [--ray local]

Arms are virtual rigs of drawn friction. Each run starts with empty folders and an empty memory of looks.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

RECIPE = "friction"


def simulate(out: Path, arms: int, minutes: float) -> Path:
    """Datasets and fleet.toml; what is there stays."""
    from tauext.rig import simulate_dataset
    from tauext.rig.config import changed_rig

    factors = np.random.default_rng(0).uniform(0.7, 1.3, arms)
    for k, friction in enumerate(factors):
        folder = out / f"data-{k:02d}"
        if not (folder / "split.json").is_file():
            simulate_dataset(folder, changed_rig(20, float(friction)), k, minutes, 1, lambda *told: None)
    tables = [f'[[arms]]\nname = "arm-{k:02d}"\ndataset = "data-{k:02d}"\n' for k in range(arms)]
    path = out / "fleet.toml"
    path.write_text(f'[train]\nrecipe = "{RECIPE}"\n[evaluate]\nkeep_free_estimates = 1\n' + "".join(tables))
    return path


def run(fleet: Path, out: Path, *more: str) -> tuple[float, float]:
    """Wall time, and processor time of driver and local workers, [s]: another's work changes the first the most."""
    started = time.monotonic()
    command = [sys.executable, "-m", "tauext", "fleet", "run", str(fleet), "--out", str(out), *more]
    environment = os.environ | {"XDG_CACHE_HOME": str(out.with_name(out.name + "-cache"))}
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment)
    _, status, usage = os.wait4(process.pid, 0)
    if os.waitstatus_to_exitcode(status) != 0:
        raise SystemExit(f"{' '.join(command)} ended with {os.waitstatus_to_exitcode(status)}")
    return time.monotonic() - started, usage.ru_utime + usage.ru_stime


def written(out: Path) -> dict[str, bytes]:
    """All outputs but wall times."""
    files = [path for path in (out / "arms").rglob("*") if path.is_file()]
    return {str(p.relative_to(out)): p.read_bytes() for p in files if not p.name.endswith("wall_time_s.json")}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--arms", type=int, default=40)
    parser.add_argument("--minutes", type=float, default=1.0)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--ray", default=None)
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    fleet = simulate(asked.out, asked.arms, asked.minutes)
    ways = {"local-1": ("--workers", "1"), "local-2": ("--workers", "2")}
    if asked.ray:
        ways["ray-2"] = ("--ray", asked.ray, *(("--workers", "2") if asked.ray == "local" else ()))
    seconds = {}
    for name, options in ways.items():
        for left in (asked.out / name, asked.out / f"{name}-cache"):
            shutil.rmtree(left, ignore_errors=True)
        seconds[name], busy_s = run(fleet, asked.out / name, *options)
        book = json.loads((asked.out / name / "fleet.json").read_text())
        of_tasks = [stage["seconds"] for arm in book["arms"] for stage in arm["stages"].values()]
        workers = int(name[-1])
        beside = (workers * seconds[name] - sum(of_tasks)) / len(of_tasks)
        ratio = seconds["local-1"] / seconds[name]
        print(
            f"{name}: {seconds[name]:.1f} s wall, {busy_s:.1f} s of processors, "
            f"{len(of_tasks)} tasks of {sum(of_tasks):.1f} s in all, "
            f"{1e3 * beside:.0f} ms of a worker beside each task, {ratio:.2f} times local-1",
            flush=True,
        )
    same = all(written(asked.out / name) == written(asked.out / "local-1") for name in ways)
    print(f"outputs are the same bytes: {same}")
    again = run(fleet, asked.out / "local-1")
    print(f"nothing to do: {again[0]:.1f} s wall, {again[1]:.1f} s of processors, for {asked.arms} arms")


if __name__ == "__main__":
    main()
