"""What arms carry, weighed by their own joints: arms of the trial on unseen arms, with loads that they do not know.

    python benchmarks/loads.py MODELS OUT [--arms ur5 panda ... rig] [--seed 0]

Each arm, and the virtual rig, is trained on nine minutes without a load, with constants of its currents that are true,
and again with ones off by up to 10 %. Then it moves with 25 loads of 0.5 to 3 kg within 10 cm of its last joint's
origin (the rig: of its tip), two windows of 4 s each; with a weight of 2.805 kg that is known; and with a constant
force on its last link. OUT/README.md and OUT/loads.json get the tables; those of docs/results/loads are of this
command. What is there is used again.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from unseen.arms import Maker, makers, true_arm
from unseen.recordings import description, write_take
from weighing.results import Weighed, markdown, summary
from weighing.rig import PLANE, make_rig, rig_carried, tip
from weighing.takes import FIRST_S, KNOWN_KG, TRAIN, WINDOW_S, WINDOWS, Carried, carried, write_carrying

from tauext import Bundle
from tauext.bundle.bundle_file import load_bundle
from tauext.data.recording_file import load_recording
from tauext.errors import TauextError
from tauext.monitor.known_load import scaled_bundle, weigh_constants
from tauext.monitor.weighing import NamedFrame, identify, load_frame, see
from tauext.sim.config import RigConfig

RIG = "rig"
WRONG = 0.1
KINDS = {"true": ["--fit-torque-constants", "False"], "off": []}
"""Constants, and what training is told of them: it corrects those of currents where it is not told otherwise."""


@dataclass(frozen=True)
class Subject:
    """An arm, and what is known of it when it is weighed with."""

    name: str
    carried: dict[str, Carried]
    wrong: np.ndarray
    """Where constants are off: those that are believed over the true ones."""
    frame: Callable[[Bundle], NamedFrame]
    axes: tuple[int, ...] = (0, 1, 2)
    """Along which its motion can tell a centre of mass."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("models", type=Path, help="folder of ur5_robot.urdf, panda.urdf and kinova.urdf")
    parser.add_argument("out", type=Path)
    parser.add_argument("--arms", nargs="+", default=["ur5", "panda", "kinova", "seven_axis", RIG])
    parser.add_argument("--true-only", nargs="*", default=[], help="of these, arms whose constants are never off")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    outcomes: list[Weighed] = []
    factors: dict[str, dict] = {}
    for name in options.arms:
        folder = options.out / name
        kinds = ["true"] if name in options.true_only else list(KINDS)
        known = None if name == RIG else makers(options.models)[name]
        subject = an_arm(known, folder, options.seed, kinds) if known else the_rig(folder, options.seed)
        for kind in kinds:
            train(folder, kind, folder / f"{kind}.tauext", KINDS[kind])
            outcomes += weigh(folder, kind, folder / f"{kind}.tauext", subject)
        if name in options.true_only:
            continue
        factors[name] = correct(folder, subject)
        for kind in ("common", "joints"):
            if (folder / f"off-{kind}.tauext").exists():
                outcomes += weigh(folder, f"off, {kind}", folder / f"off-{kind}.tauext", subject)
    facts = summary(outcomes) | {"factors": factors}
    (options.out / "loads.json").write_text(json.dumps(facts, indent=1) + "\n")
    asked = f"python benchmarks/loads.py MODELS OUT --arms {' '.join(options.arms)}"
    asked += f" --true-only {' '.join(options.true_only)}" if options.true_only else ""
    text = markdown(outcomes, factors, asked)
    (options.out / "README.md").write_text(text)
    print(text)


def an_arm(maker: Maker, folder: Path, seed: int, kinds: list[str]) -> Subject:
    """One of the trial on unseen arms; its recordings and datasets are made where they are not there."""
    simulate_all(maker, folder, seed)
    takes = carried(maker, seed)
    for kind in kinds:
        dataset(maker, folder, seed, kind, folder / f"data-{kind}", list(takes))
    return Subject(maker.name, takes, wrong_constants(maker, seed), lambda bundle: load_frame(bundle, maker.joints[-1]))


def the_rig(folder: Path, seed: int) -> Subject:
    """The virtual rig, whose recordings hold torques; believed constants scale them."""
    wrong = np.random.default_rng([seed, 98]).uniform(1 - WRONG, 1 + WRONG, len(RigConfig().links))
    make_rig(folder, seed, {"true": np.ones_like(wrong), "off": wrong})
    return Subject(RIG, rig_carried(seed), wrong, lambda _: tip(), PLANE)


def wrong_constants(maker: Maker, seed: int) -> np.ndarray:
    return maker.random(seed, 98).uniform(1 - WRONG, 1 + WRONG, len(maker.joints))


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


def dataset(maker: Maker, folder: Path, seed: int, kind: str, out: Path, names: list[str], part: str = "test") -> None:
    """Import training and, into a part of the split, the recordings of these names, with constants that are true, off
    by up to WRONG, or unknown."""
    if out.is_dir():
        return
    arm = true_arm(maker, maker.random(seed, 0))
    wrong = wrong_constants(maker, seed) if kind == "off" else 1.0
    text = description(maker, seed, model=True, takes=TRAIN)
    constants = json.dumps("unknown" if kind == "unknown" else (arm.nm_per_ampere * wrong).tolist())
    text = re.sub(r"torque_constant = .*", f"torque_constant = {constants}", text)
    text = text.replace(f"{part} = []", f"{part} = {json.dumps([f'{name}.csv' for name in names])}")
    (folder / "csv" / f"arm-{out.name}.toml").write_text(text)
    files = [str(folder / "csv" / f"{name}.csv") for name in [*(take.name for take in TRAIN), *names]]
    command("import", "--source", *files, "--arm", folder / "csv" / f"arm-{out.name}.toml", "--out", out)


def train(folder: Path, kind: str, out: Path, how: list[str]) -> None:
    if not out.exists():
        command("train", "--data", folder / f"data-{kind}", "--recipe", "prior", "--out", out, *how)


def command(*arguments: str | Path) -> None:
    """Run `tauext ARGUMENTS`; RuntimeError where it failed."""
    words = [sys.executable, "-m", "tauext", *map(str, arguments)]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    if ended.returncode:
        raise RuntimeError(f"{' '.join(words)}:\n{ended.stdout}{ended.stderr}")


def weigh(folder: Path, label: str, path: Path, subject: Subject) -> list[Weighed]:
    """Every window of every load and push."""
    bundle = load_bundle(path)
    frame = subject.frame(bundle)
    data = folder / f"data-{label.split(',')[0]}"
    outcomes = []
    for name, truth in subject.carried.items():
        if name == "known":
            continue
        seen = see(bundle, load_recording(data / f"{name}.parquet"))
        for k in range(WINDOWS):
            begin = FIRST_S + k * WINDOW_S
            part = seen.part((seen.time_s >= begin) & (seen.time_s < begin + WINDOW_S))
            try:
                found = identify(bundle, frame, [part])
            except TauextError:
                outcomes.append(Weighed.refused(subject.name, label, name, truth))
                continue
            outcomes.append(Weighed.of(subject.name, label, name, truth, found, subject.axes))
    return outcomes


def correct(folder: Path, subject: Subject) -> dict:
    """The known weight on the arm whose constants are off: the common factor put into the bundle, and those of every
    joint into a new training."""
    bundle = load_bundle(folder / "off.tauext")
    recording = load_recording(folder / "data-off" / "known.parquet")
    constants = np.array(bundle.observer.nm_per_unit or np.ones(bundle.joints))
    facts: dict = {"left": (1 / (subject.wrong * constants)).tolist()}
    try:
        known = weigh_constants(bundle, subject.frame(bundle), [see(bundle, recording)], KNOWN_KG)
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
