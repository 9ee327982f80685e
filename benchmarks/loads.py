"""What arms carry, weighed by their own joints: arms of the trial on unseen arms, with loads that they do not know.

    python benchmarks/loads.py MODELS OUT [--arms ur5 panda ... rig] [--seed 0]

Each arm, and the virtual rig, is trained on nine minutes without a load, with constants of its currents that are true,
and again with ones off by up to 10 %. Then it moves with 25 loads of 0.5 to 3 kg within 10 cm of its last joint's
origin (the rig: of its tip), two windows of 4 s each; with a weight of 2.805 kg that is known; and with a constant
force on its last link. OUT/README.md and OUT/loads.json get the tables; those of docs/results/loads are of this
command. What is there is used again.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import arguments, in_parallel, trained, write_page
from unseen.arms import Maker, makers, true_arm
from unseen.recordings import description, import_csv, simulate_takes
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
    parser = arguments(__doc__, "models", "out")
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
            trained(folder / f"data-{kind}", folder / f"{kind}.tauext", *KINDS[kind])
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
    write_page(options.out / "README.md", markdown(outcomes, factors, asked))


def an_arm(maker: Maker, folder: Path, seed: int, kinds: list[str]) -> Subject:
    """One of the trial on unseen arms; its recordings and datasets are made where they are not there."""
    takes = carried(maker, seed)
    simulate_all(maker, folder, seed, list(takes))
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


def simulate_all(maker: Maker, folder: Path, seed: int, names: list[str]) -> None:
    """Every recording that does not exist: those to train on, and these of `carried`."""
    raw = folder / "csv"
    simulate_takes(maker, seed, raw, TRAIN, os.cpu_count())
    missing = [name for name in names if not (raw / f"{name}.truth.json").exists()]
    in_parallel(os.cpu_count(), write_carrying, [(maker, seed, name, raw) for name in missing])


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
    files = [folder / "csv" / f"{name}.csv" for name in [*(take.name for take in TRAIN), *names]]
    import_csv(text, files, folder / "csv" / f"arm-{out.name}.toml", out)


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
    constants_told = ["--torque-constants", *(f"{k:.6g}" for k in told)]
    trained(folder / "data-off", folder / "off-joints.tauext", *constants_told)
    return facts | {
        "common": known.common,
        "common_error": known.common_error,
        "joints": known.factors.tolist(),
        "errors": known.errors.tolist(),
        "shows": known.shows.tolist(),
    }


if __name__ == "__main__":
    main()
