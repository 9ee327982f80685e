"""The whole chain on simulated arms that nobody tuned for: motor currents, a wrong URDF or none, labelled contacts.

    python benchmarks/unseen_arms.py make MODELS OUT [--arms ur5 panda ...] [--seed 0]

MODELS: folder of ur5_robot.urdf, panda.urdf and kinova.urdf. `make` simulates and imports: OUT/ARM holds csv/ and the
datasets urdf/ and none/.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from unseen.arms import Maker, makers
from unseen.recordings import TAKES, description, write_take

MODELS = {"urdf": True, "none": False}


def make(maker: Maker, out: Path, seed: int, workers: int) -> None:
    """Simulate every take of an arm and import it twice, with its URDF and without a model."""
    raw = out / maker.name / "csv"
    raw.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(workers) as pool:
        for done in [pool.submit(write_take, maker, seed, number, raw) for number in range(len(TAKES))]:
            done.result()
    files = [str(raw / f"{take.name}.csv") for take in TAKES]
    for name, model in MODELS.items():
        arm = raw / f"arm-{name}.toml"
        arm.write_text(description(maker, seed, model))
        said = command("import", "--source", *files, "--arm", str(arm), "--out", str(out / maker.name / name))
        (out / maker.name / f"import-{name}.txt").write_text(said)


def command(*arguments: str, may_find_faults: bool = False) -> str:
    """What `tauext ARGUMENTS` printed; RuntimeError where it failed."""
    ended = subprocess.run([sys.executable, "-m", "tauext", *arguments], capture_output=True, text=True, check=False)
    if ended.returncode not in ((0, 1) if may_find_faults else (0,)):
        raise RuntimeError(f"tauext {' '.join(arguments)}:\n{ended.stdout}{ended.stderr}")
    return ended.stdout + ended.stderr


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("stage", choices=("make",))
    parser.add_argument("models", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--arms", nargs="+", default=["ur5", "panda", "kinova", "seven_axis"])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    options = parser.parse_args()
    known = makers(options.models)
    for name in options.arms:
        if name not in known:
            parser.error(f"--arms {name}: must be of {', '.join(known)}")
        make(known[name], options.out, options.seed, options.workers)


if __name__ == "__main__":
    main()
