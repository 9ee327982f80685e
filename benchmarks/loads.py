"""What arms carry, weighed by their own joints: arms of the trial on unseen arms, with loads that they do not know.

    python benchmarks/loads.py MODELS OUT [--arms ur5 panda ...] [--seed 0]

Each arm is trained on nine minutes without a load, with constants of its currents that are true, and again with ones
off by up to 10 %. Then it moves with 25 loads of 0.5 to 3 kg within 10 cm of its last joint's origin, two windows of
4 s each; with a weight of 2.805 kg that is known; and with a constant force on its last link. OUT/README.md and
OUT/loads.json get the tables; those of docs/results/loads are of this command. What is there is used again.
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

import numpy as np
from unseen.arms import Maker, makers, true_arm
from unseen.recordings import description, write_take
from weighing.results import Weighed, markdown, summary
from weighing.takes import FIRST_S, KNOWN_KG, TRAIN, WINDOW_S, WINDOWS, carried, write_carrying

from tauext.data import load_bundle, load_recording
from tauext.errors import TauextError
from tauext.load import identify, load_frame, scaled_bundle, see, weigh_constants

WRONG = 0.1
KINDS = {"true": ["--fit-torque-constants", "False"], "off": []}
"""Constants, and what training is told of them: it corrects those of currents where it is not told otherwise."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", type=Path, help="folder of ur5_robot.urdf, panda.urdf and kinova.urdf")
    parser.add_argument("out", type=Path)
    parser.add_argument("--arms", nargs="+", default=["ur5", "panda", "kinova", "seven_axis"])
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    outcomes: list[Weighed] = []
    factors: dict[str, dict] = {}
    for name in options.arms:
        maker = makers(options.models)[name]
        folder = options.out / name
        simulate_all(maker, folder, options.seed)
        for kind in KINDS:
            dataset(maker, folder, options.seed, kind)
            train(folder, kind, folder / f"{kind}.tauext", KINDS[kind])
        outcomes += weigh(folder, "true", folder / "true.tauext", maker, options.seed)
        outcomes += weigh(folder, "off", folder / "off.tauext", maker, options.seed)
        factors[name] = correct(folder, maker, options.seed)
        for kind in ("common", "joints"):
            if (folder / f"off-{kind}.tauext").exists():
                outcomes += weigh(folder, f"off, {kind}", folder / f"off-{kind}.tauext", maker, options.seed)
    facts = summary(outcomes) | {"factors": factors}
    (options.out / "loads.json").write_text(json.dumps(facts, indent=1) + "\n")
    asked = f"python benchmarks/loads.py MODELS OUT --arms {' '.join(options.arms)}"
    text = markdown(outcomes, factors, asked)
    (options.out / "README.md").write_text(text)
    print(text)


def simulate_all(maker: Maker, folder: Path, seed: int) -> None:
    """Every recording that is not there."""
    raw = folder / "csv"
    raw.mkdir(parents=True, exist_ok=True)
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        jobs = [
            pool.submit(write_take, maker, seed, k, raw, TRAIN)
            for k, take in enumerate(TRAIN)
            if not (raw / f"{take.name}.truth.npz").exists()
        ]
        jobs += [
            pool.submit(write_carrying, maker, seed, name, raw)
            for name in carried(maker, seed)
            if not (raw / f"{name}.truth.json").exists()
        ]
        for job in jobs:
            job.result()


def dataset(maker: Maker, folder: Path, seed: int, kind: str) -> None:
    """Import with constants that are true, or off by up to WRONG."""
    out = folder / f"data-{kind}"
    if out.is_dir():
        return
    arm = true_arm(maker, maker.random(seed, 0))
    wrong = maker.random(seed, 98).uniform(1 - WRONG, 1 + WRONG, len(maker.joints)) if kind == "off" else 1.0
    text = description(maker, seed, model=True, takes=TRAIN)
    text = re.sub(r"torque_constant = .*", f"torque_constant = {(arm.nm_per_ampere * wrong).tolist()}", text)
    names = list(carried(maker, seed))
    text = text.replace("test = []", f"test = {json.dumps([f'{name}.csv' for name in names])}")
    (folder / "csv" / f"arm-{kind}.toml").write_text(text)
    files = [str(folder / "csv" / f"{name}.csv") for name in [*(take.name for take in TRAIN), *names]]
    command("import", "--source", *files, "--arm", folder / "csv" / f"arm-{kind}.toml", "--out", out)


def train(folder: Path, kind: str, out: Path, how: list[str]) -> None:
    if not out.exists():
        command("train", "--data", folder / f"data-{kind}", "--recipe", "prior", "--out", out, *how)


def command(*arguments: str | Path) -> None:
    """Run `tauext ARGUMENTS`; RuntimeError where it failed."""
    words = [sys.executable, "-m", "tauext", *map(str, arguments)]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    if ended.returncode:
        raise RuntimeError(f"{' '.join(words)}:\n{ended.stdout}{ended.stderr}")


def weigh(folder: Path, label: str, path: Path, maker: Maker, seed: int) -> list[Weighed]:
    """Every window of every load and push."""
    bundle = load_bundle(path)
    frame = load_frame(bundle, maker.joints[-1])
    data = folder / f"data-{label.split(',')[0]}"
    outcomes = []
    for name, truth in carried(maker, seed).items():
        if name == "known":
            continue
        seen = see(bundle, load_recording(data / f"{name}.parquet"))
        for k in range(WINDOWS):
            begin = FIRST_S + k * WINDOW_S
            part = seen.part((seen.time_s >= begin) & (seen.time_s < begin + WINDOW_S))
            try:
                found = identify(bundle, frame, [part])
            except TauextError:
                outcomes.append(Weighed.refused(maker.name, label, name, truth))
                continue
            outcomes.append(Weighed.of(maker.name, label, name, truth, found))
    return outcomes


def correct(folder: Path, maker: Maker, seed: int) -> dict:
    """The known weight on the arm whose constants are off: the common factor put into the bundle, and those of every
    joint into a new training."""
    bundle = load_bundle(folder / "off.tauext")
    recording = load_recording(folder / "data-off" / "known.parquet")
    wrong = maker.random(seed, 98).uniform(1 - WRONG, 1 + WRONG, len(maker.joints))
    constants = np.array(bundle.observer.nm_per_unit or np.ones(bundle.joints))
    facts: dict = {"left": (1 / (wrong * constants)).tolist()}
    try:
        known = weigh_constants(bundle, load_frame(bundle, maker.joints[-1]), [see(bundle, recording)], KNOWN_KG)
    except TauextError as error:
        return facts | {"refused": str(error)}
    scaled_bundle(bundle, known.common).save(str(folder / "off-common.tauext"))
    told = (constants * known.factors).tolist()
    train(folder, "off", folder / "off-joints.tauext", ["--torque-constants", *(f"{k:.6g}" for k in told)])
    return facts | {
        "common": known.common,
        "common_error": known.common_error,
        "joints": known.factors.tolist(),
        "errors": known.errors.tolist(),
        "shows": known.shows.tolist(),
    }


if __name__ == "__main__":
    main()
