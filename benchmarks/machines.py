"""Which decisions of a training depend on rounding: the same trainings with other kernels, and with noise.

    python benchmarks/machines.py OUT [--data DIR] [--sets rig-exact ur10 ...] [--draws 50] [--few 3] [--workers 1]

A machine shows in three places: the kernels of the linear algebra (OPENBLAS_CORETYPE), those of the core's network
(TAUEXT_SIMD), and those of NumPy and of the C library (NPY_DISABLE_CPU_FEATURES, GLIBC_TUNABLES). Each setting that
this processor can run gets a process. The noise stands for the others: every sample of q, dq and tau times
1 + 1e-13 normal, --draws times for short recordings and --few times for others. All are judged on the same recordings.

DIR holds real recordings, as of real_arms.py. OUT gets datasets, a JSON file a training (used again where it is
there) and machines.md.
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import shutil
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from common import COLLISION, EPISODE_S, ROOT, arguments, head, table_row, write_tables
from real_arms import prepare
from tauext_fleet.prior import make_fleet_prior
from tauext_fleet.prior_arms import fleet_arms
from tauext_fleet.prior_content import ODD
from tauext_lab.evaluate.free_motion import count_episodes
from unseen.arms import makers
from unseen.recordings import Take, description, import_csv, simulate_takes

from tauext import _core
from tauext.config import PAPER_CASES, PriorConfig, TrainConfig
from tauext.data.dataset import load_dataset
from tauext.data.recording_file import load_recording, save_recording
from tauext.fit.bundle_writing import build_setup
from tauext.fit.find_kinematics import ArmSearch, KinematicSample, directions
from tauext.fit.prior_terms import own_terms
from tauext.fit.training_set import with_presliding
from tauext.monitor.estimate import estimate_recording
from tauext.robot.model_case import estimated_model
from tauext.train.stage import train_bundle

NOISE = 1e-13
REFERENCE = "reference"
SETTINGS: dict[str, dict[str, str]] = {
    REFERENCE: {},
    "Haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "Zen": {"OPENBLAS_CORETYPE": "Zen"},
    "SkylakeX": {"OPENBLAS_CORETYPE": "SkylakeX"},
    "Prescott": {"OPENBLAS_CORETYPE": "Prescott"},
    "sse2": {"TAUEXT_SIMD": "sse2"},
    "avx2": {"TAUEXT_SIMD": "avx2"},
    "avx512": {"TAUEXT_SIMD": "avx512"},
    "all plain": {
        "OPENBLAS_CORETYPE": "Prescott",
        "TAUEXT_SIMD": "sse2",
        "NPY_DISABLE_CPU_FEATURES": "X86_V3",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX",
    },
}
"""Each is what some processor would use by itself; the last has none of the wide instructions."""
AT_A_TIME = 10
"""Draws of a process."""
TAKES = (
    Take("train-1", "train", 1.2),
    Take("train-2", "train", 1.2, 3, 180),
    Take("touched", "collisions", 1.5, 10, 60),
)
FLEET = ((1, 1.0), (2, 0.85), (3, 1.15), (4, 0.95), (5, 1.8))
"""Seed and friction of each rig of a fleet; the last is worn."""


@dataclass(frozen=True)
class Case:
    """One training."""

    data: str
    """Its dataset's folder in OUT; of a fleet, the beginning of each."""
    case: str | None = None
    config: TrainConfig = TrainConfig(recipe="prior", threads=1)
    short: bool = False
    """Seconds of motion, which are trained on in seconds: --draws."""
    network: bool = False
    """Without one, no training calls the kernels that TAUEXT_SIMD chooses."""
    axes: bool = False
    """Only the search for the axes of an arm without a model, whose order decides where its lengths are looked for."""


DENSE = TrainConfig(recipe="dense", threads=1, max_steps=1000)
SEARCHED = {"rig": "rig", "panda": "panda_unisa/data", "kuka": "kuka/data"}
NETWORK = TrainConfig(recipe="tauext", threads=1, max_steps=500, prior=PriorConfig(most_ripples=0))
CASES = {
    **{f"rig-{case}": Case("rig", case) for case in ("exact", "mass", "com", "mass+com", "none")},
    "rig-network": Case("rig", "exact", NETWORK, network=True),
    "rig-dense": Case("rig", "exact", DENSE, network=True),
    "unseen-ur5": Case("unseen/urdf"),
    "unseen-ur5-none": Case("unseen/none", "none"),
    "ur3": Case("ur3/tool"),
    "ur10": Case("ur10/data", short=True),
    "panda": Case("panda_unisa/data", short=True),
    "panda-none": Case("panda_unisa/data", "none"),
    "kuka": Case("kuka/data"),
    **{f"{name}-axes": Case(data, "none", short=True, axes=True) for name, data in SEARCHED.items()},
    "fleet": Case("fleet", config=TrainConfig(recipe="prior", threads=1, prior=PriorConfig(most_ripples=0))),
}


def main() -> None:
    parser = arguments(__doc__, "out", workers=1)
    parser.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data", help="folder of real recordings")
    parser.add_argument("--sets", nargs="+", choices=tuple(CASES), default=list(CASES))
    parser.add_argument("--settings", nargs="+", choices=tuple(SETTINGS), default=list(SETTINGS))
    parser.add_argument("--draws", type=int, default=50)
    parser.add_argument("--few", type=int, default=3)
    parser.add_argument("--work", nargs=3, metavar=("HOW", "FIRST", "LAST"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.work:
        how, first, last = options.work
        for draw in range(int(first), int(last)):
            work(options.out, options.sets, how, draw)
        return
    for name in options.sets:
        make_data(options.out, name, options.data)
    kernels = {name: kernels_of(options.out, name) for name in options.settings}
    networks = [name for name in options.sets if CASES[name].network]
    jobs = []
    for name in distinct(kernels):
        sets = networks if "TAUEXT_SIMD" in SETTINGS[name] and len(SETTINGS[name]) == 1 else options.sets
        jobs += [(name, -1, 0, sets)] if sets else []
    short = [name for name in options.sets if CASES[name].short]
    for first in range(0, options.draws, AT_A_TIME):
        last = min(first + AT_A_TIME, options.draws)
        jobs += [("noise", first, last, short)] if short else []
    long = [name for name in options.sets if not CASES[name].short]
    jobs += [("noise", 0, options.few, long)] if options.few and long else []
    with ThreadPoolExecutor(options.workers) as pool:
        for _ in pool.map(lambda job: start(options.out, *job), jobs):
            pass
    write_tables(options.out, tables(options.out, options.sets, kernels), name="machines")


def start(out: Path, how: str, first: int, last: int, sets: Sequence[str]) -> None:
    """A process that trains these sets, with noise of these draws; without any for -1."""
    words = [sys.executable, __file__, str(out), "--work", how, str(first), str(last), "--sets", *sets]
    print(how, *([] if first < 0 else [first, "to", last - 1]), flush=True)
    subprocess.run(words, env=os.environ | SETTINGS.get(how, {}), check=True)


def kernels_of(out: Path, setting: str) -> str | None:
    """Which kernels a setting gives; None: this processor cannot run them."""
    words = [sys.executable, __file__, str(out), "--work", "kernels", "-1", "0"]
    ended = subprocess.run(words, env=os.environ | SETTINGS[setting], capture_output=True, text=True, check=False)
    return ended.stdout.strip() if ended.returncode == 0 else None


def own_kernels() -> str:
    """Of this process: OpenBLAS of NumPy and of SciPy, of the core and of NumPy itself."""
    import scipy.linalg

    cores = []
    for package, symbol in ((np, "scipy_openblas_get_corename64_"), (scipy, "scipy_openblas_get_corename")):
        folder = Path(package.__file__).parent.parent / f"{package.__name__}.libs"
        library = ctypes.CDLL(str(next(folder.glob("*openblas*"))))
        name = getattr(library, symbol)
        name.restype = ctypes.c_char_p
        cores.append(name().decode())
    square = np.arange(64.0).reshape(8, 8)
    scipy.linalg.solve(np.linalg.solve(square @ square.T + np.eye(8), square) + np.eye(8), square)  # can it be run?
    wide = "X86_V3" not in os.environ.get("NPY_DISABLE_CPU_FEATURES", "")
    libraries = "own" if wide else "plain"
    return f"OpenBLAS {' and '.join(dict.fromkeys(cores))}, core {_core.simd_in_use()}, NumPy and libm {libraries}"


def distinct(kernels: dict[str, str | None]) -> list[str]:
    """Settings whose kernels no earlier one has."""
    found = list(kernels.values())
    return [name for k, (name, one) in enumerate(kernels.items()) if one is not None and one not in found[:k]]


def make_data(out: Path, name: str, data: Path) -> None:
    """The dataset of a set, where it is not there."""
    folder = CASES[name].data
    if folder == "fleet":
        for seed, friction in FLEET:
            rig = ("--minutes", "3.2", "--collision-recordings", "1", "--seed", seed, "--friction", friction)
            make(out / f"fleet-{seed}", "simulate", "--out", out / f"fleet-{seed}", *rig)
    elif folder == "rig":
        make(out / "rig", "simulate", "--out", out / "rig", "--minutes", "2.4", "--collision-recordings", "3")
    elif folder.startswith("unseen"):
        maker, model = makers(data / "models")["ur5"], folder.endswith("urdf")
        files = simulate_takes(maker, 0, out / "unseen" / "csv", TAKES)
        if not (out / folder).is_dir():
            arm = out / "unseen" / "csv" / f"arm-{'urdf' if model else 'none'}.toml"
            import_csv(description(maker, 0, model, TAKES), files, arm, out / folder)
    else:
        arm_name, part = folder.split("/")
        prepare(arm_name, data, out / arm_name)
        sources = {"ur3": ("id1.bag", "id2.bag"), "ur10": ("ur10_exciting",), "panda_unisa": ("panda_exciting",)}
        inside = out / arm_name
        files = [inside / one for one in sources.get(arm_name, ("A.mat", "B.mat", "C.mat"))]
        make(inside / part, "import", "--source", *files, "--arm", inside / "arm.toml", "--out", inside / part)


def make(folder: Path, *arguments: object) -> None:
    """`tauext ARGUMENTS`, which writes this folder."""
    if not folder.is_dir():
        subprocess.run([sys.executable, "-m", "tauext", *map(str, arguments)], check=True)


def work(out: Path, sets: Sequence[str], how: str, draw: int) -> None:
    """Train and judge sets in this process's environment."""
    if how == "kernels":
        print(own_kernels())
        return
    for name in sets:
        file = out / "runs" / name / f"{how}{'' if draw < 0 else f'-{draw}'}.json"
        if not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            trained = out / "runs" / name / file.stem
            folders = [out / f"fleet-{seed}" for seed, _ in FLEET] if name == "fleet" else [out / CASES[name].data]
            given = [noisy(one, trained / one.name, draw) for one in folders] if draw >= 0 else folders
            if name == "fleet":
                found = of_fleet(given, trained)
            elif CASES[name].axes:
                found = of_axes(given[0])
            else:
                found = of_arm(CASES[name], given[0], folders[0], trained)
            file.write_text(json.dumps(found, indent=1) + "\n")
            shutil.rmtree(trained, ignore_errors=True)


def noisy(folder: Path, copy: Path, draw: int) -> Path:
    """A copy of the dataset whose samples are off by NOISE of themselves."""
    shutil.copytree(folder, copy, dirs_exist_ok=True)
    rng = np.random.default_rng([draw, 13])
    for file in sorted(copy.glob("*.parquet")):
        one = load_recording(file)
        signals = {name: getattr(one, name) for name in ("q", "dq", "tau")}
        off = {name: values * (1 + NOISE * rng.standard_normal(values.shape)) for name, values in signals.items()}
        save_recording(replace(one, **off), file)
    return copy


def of_arm(case: Case, data: Path, judged: Path, out: Path) -> dict:
    """A training, and what its bundle says of recordings that have no noise."""
    out.mkdir(parents=True, exist_ok=True)
    file = out / "bundle.tauext"
    bundle = train_bundle(load_dataset(data), file, case=case.case, config=case.config, check=False)
    facts = json.loads(file.with_suffix(".run.json").read_text())
    free, limits, collisions = [], [], 0
    dataset = load_dataset(judged)
    for set_name in ("test", "collisions"):
        for recording in dataset.recordings(set_name):
            said = estimate_recording(bundle, recording, 1)
            alarms = (said.held_alarm == COLLISION) & said.healthy
            collisions += count_episodes(alarms, round(EPISODE_S * recording.rate_hz))
            at = said.healthy & (recording.contact == 0) if recording.contact is not None else said.healthy
            free.append(np.abs(said.tau_ext[at]))
            limits.append(said.limit_nm[at])
    whole = [np.concatenate(one).astype(float).mean(axis=0).tolist() for one in (limits, free)]
    return {"decisions": decisions(bundle, facts), "limits": whole[0], "l1": whole[1], "collisions": collisions}


def of_axes(data: Path) -> dict:
    """The arms from which the search for link lengths begins, and their errors."""
    dataset = load_dataset(data)
    training = dataset.training()
    tree = estimated_model(dataset.robot_file(None), training[0].joints, PAPER_CASES["none"])
    config = PriorConfig()
    setup = with_presliding(build_setup(tree, training[0], TrainConfig().observer), config.widths_rad)
    own = [own_terms(setup, config, joint) for joint in range(tree.size)]
    sample = KinematicSample(setup.tree, setup.observer, training, own, setup.widths_rad)
    found = directions(sample)[: ArmSearch.refined]
    axes = {f"axes {k + 1}": json.dumps(one.kinematics.axes.astype(int).tolist()) for k, one in enumerate(found)}
    return {"decisions": axes, "limits": [], "l1": [one.error for one in found], "collisions": None}


def decisions(bundle: _core.Bundle, facts: dict) -> dict:
    """What the training chose, as text."""
    terms, kinds = bundle.prior.terms, _core.TermKind
    prior, limits = facts.get("prior", {}), facts.get("limits", {})
    links = bundle.prior.corrected_links
    found: dict[str, object] = {
        "gain": bundle.observer.gain_per_s,
        "presliding widths": bundle.prior.widths_rad,
        "ripples": sorted({(t.a, t.b) for t in terms if t.kind == kinds.ripple}),
        "load terms": sorted({t.a for t in terms if t.kind == kinds.load}),
        "Coulomb terms": sorted((t.a, t.speed) for t in terms if t.kind == kinds.coulomb),
        "terms": len(terms),
        "arm found": bool(links) and "arm" in prior,
        "axes of the arm": [[round(x) for x in one["axis"]] for one in prior.get("arm", {}).values()],
        "ridge": prior.get("ridge"),
        "rotors at 0": [k for k, link in enumerate(links) if link.rotor_inertia == 0],
        "gate": [scale > 0 for scale in bundle.output_scale_nm] if bundle.has_network else [],
        "torque constants": [one["determined"] for one in facts.get("torque_constants", {}).get("found", {}).values()],
        "hold": (bundle.hold_s, bundle.contact_hold_s),
        "tails": {name: tail["exceedances"] for name, tail in limits.get("tails", {}).items()},
        "coverage": (list(bundle.coverage.reach), bundle.coverage.reach_together),
        "one moment": [one["joint"] for one in limits.get("one_moment", [])],
    }
    return {name: json.dumps(value) for name, value in found.items()}


def of_fleet(arms: Sequence[Path], out: Path) -> dict:
    """A fleet prior of these arms."""
    out.mkdir(parents=True, exist_ok=True)
    config = CASES["fleet"].config
    prior = make_fleet_prior(fleet_arms([str(arm) for arm in arms]), out / "fleet.prior.json", config)
    facts, errors = prior.facts, prior.errors
    assert errors is not None
    odd = {one["name"].split("-")[-1]: [u < ODD for u in one["trust"].values()] for one in facts["arms"]}
    chosen: dict[str, object] = {
        "arms used": [one["name"].split("-")[-1] for one in facts["arms"]],
        "odd": odd,
        "gain": prior.gain_per_s,
        "presliding widths": prior.widths_rad,
        "terms": [len(own) for own in prior.own],
        "trust": prior.weights.trust,
        "arms judged": errors.arms,
        "hold": (errors.hold_s, errors.contact_hold_s),
    }
    rest = list(facts["after_a_minute"].values())
    limits = [*errors.sliding_limit_nm.tolist(), *errors.near_stiction_limit_nm.tolist()]
    text = {name: json.dumps(value) for name, value in chosen.items()}
    return {"decisions": text, "limits": limits, "l1": rest, "collisions": None}


def tables(out: Path, sets: Sequence[str], kernels: dict[str, str | None]) -> list[str]:
    """Kernels of the settings; a row a set."""
    lines = head("setting | kernels")
    lines += [table_row(name, one or "this processor cannot run it") for name, one in kernels.items()]
    lines += ["", *head("set | trainings | decisions that differ | limits | L1 error | collisions")]
    for name in sets:
        runs = {file.stem: json.loads(file.read_text()) for file in sorted((out / "runs" / name).glob("*.json"))}
        lines += [row(name, runs)] if runs else []
    return lines


def row(name: str, runs: dict[str, dict]) -> str:
    """A line of the table."""
    noise = sum(run.startswith("noise") for run in runs)
    words = []
    for decision in next(iter(runs.values()))["decisions"]:
        counts = Counter(run["decisions"][decision] for run in runs.values())
        if len(counts) > 1:
            words.append(f"{decision}: {', '.join(f'{text} {count}x' for text, count in counts.most_common())}")
    spreads = []
    for figure in ("limits", "l1"):
        values = np.array([run[figure] for run in runs.values()])
        if not values.size:
            spreads.append("-")
            continue
        spread = values.max(axis=0) / np.where(values.min(axis=0) > 0, values.min(axis=0), np.nan) - 1
        most = np.nanmax(spread, initial=0.0)
        spreads.append(f"{most:.2g}" if most < 1e-4 else f"{most:.2%}")
    collisions = Counter(run["collisions"] for run in runs.values())
    found = ", ".join(f"{n}" if len(collisions) == 1 else f"{n} ({times}x)" for n, times in collisions.items())
    return table_row(name, f"{len(runs) - noise} + {noise}", "; ".join(words) or "none", *spreads, found)


if __name__ == "__main__":
    main()
