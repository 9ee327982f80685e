"""What is lost where one joint's torque constant is not known: masses, told loads and forces, beside the same arm.

    python benchmarks/missing_constant.py DATA OUT [--loads 12] [--pushes 60] [--seed 0]

DATA: folder of `models` and `ur3_aspectum` as benchmarks/real_arms.py takes them. The UR5 of benchmarks/loads.py is
simulated, its motor currents are imported without constants. The UR3 is real: one recorded trajectory to train on, the
other one with added loads, whose torques follow from the model and which its currents would show. Each is trained
twice: training is told the constants of all joints, or of all but the last. OUT/missing_constant.json and the table of
docs/results/loads/missing-constant.md are of this command. What is there is used again.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

import numpy as np
from carrying import FIRST_S, collisions, judged, load_of
from common import arguments, head, table_row, tauext
from loads import dataset, simulate_all
from real_arms import KEPT, NO_TOOL
from unseen.arms import Maker, TrueArm, makers, true_arm
from unseen.loads import TRAIN, WARM_S, WINDOW_S, Carried, carried, with_load
from wrench import STREAM, pushes_of, told_of

from tauext import Bundle
from tauext._core import Tree, estimate
from tauext.bundle.bundle_file import load_bundle
from tauext.cli import main as run_tauext
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording, save_recording
from tauext.fit.torque_constants import TorqueConstants
from tauext.monitor.weighing import identify, load_frame, mass_error, see
from tauext.robot.read import load_tree

UR3_NM_PER_AMPERE = np.array([12.925, 13.088, 9.358, 4.572, 4.572, 4.548])
UR3_CUT_S = 33.5
"""Behind it something touches the arm."""
KINDS = {"all": 0, "last left out": 1}
LOADS_KG = (0.5, 1.0, 1.5, 2.0, 2.5)
"""Added to the UR3, which is built for 3 kg and holds a tool."""


def main() -> None:
    parser = arguments(__doc__, "data", "out")
    parser.add_argument("--loads", type=int, default=12)
    parser.add_argument("--pushes", type=int, default=60)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rows = [*simulated(options), *real(options)]
    (options.out / "missing_constant.json").write_text(json.dumps(rows, indent=1) + "\n")
    print(markdown(rows))


def simulated(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The UR5: a row a bundle."""
    maker, seed = makers(options.data / "models")["ur5"], options.seed
    folder = options.out / maker.name
    raw = folder / "csv"
    names = list(carried(maker, seed))[: options.loads]
    simulate_all(maker, folder, seed, names)
    data, arm = folder / "data", true_arm(maker, maker.random(seed, 0))
    dataset(maker, folder, seed, "unknown", data, names)
    truths = {name: json.loads((raw / f"{name}.truth.json").read_text()) for name in names}
    loaded = [(load_recording(data / f"{name}.parquet"), truth) for name, truth in truths.items()]
    free = [load_recording(data / f"{take.name}.parquet") for take in TRAIN]
    for kind, missing in KINDS.items():
        bundle = trained(data, folder / f"{missing}.tauext", arm.nm_per_ampere, missing)
        row = {"arm": "UR5, simulated", "constants": kind} | weighed(bundle, loaded) | told(bundle, loaded, free[-1:])
        yield row | forces(maker, arm, bundle, options)


def trained(data: Path, path: Path, nm_per_ampere: np.ndarray, missing: int) -> Bundle:
    """A bundle whose training is told these constants, but of the last `missing` joints."""
    if not path.exists():
        known = np.arange(len(nm_per_ampere)) < len(nm_per_ampere) - missing
        constants = TorqueConstants(
            np.where(known, nm_per_ampere, np.nan), np.where(known, 0.02 * nm_per_ampere, np.inf), known
        )
        with patch("tauext.train.preparation.fit_torque_constants", lambda *_: constants):
            if run_tauext(["train", "--data", str(data), "--recipe", "prior", "--out", str(path)]):
                raise RuntimeError(f"no training on {data}")
    return load_bundle(path)


def real(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """The UR3: a row a bundle."""
    folder = options.out / "ur3"
    data = folder / "data"
    if not data.is_dir():
        folder.mkdir(parents=True, exist_ok=True)
        text = re.sub(*NO_TOOL, (KEPT / "ur3" / "arm.toml").read_text())
        (folder / "arm.toml").write_text(text)
        shutil.copy(options.data / "models" / "ur3_robot.urdf", folder)
        bags = [options.data / "ur3_aspectum" / f"{name}.bag" for name in ("id1", "id2")]
        tauext("import", "--source", *bags, "--arm", folder / "arm.toml", "--out", data)
        for file in data.glob("*.parquet"):
            recording = load_recording(file)
            file.unlink()
            told_as = recording.provenance | {"torque": "amperes: the torque constant is unknown"}
            save_recording(replace(recording, tau=recording.tau / UR3_NM_PER_AMPERE, provenance=told_as), file)
    bare = load_recording(next(data.glob("id2*.parquet")))
    keep = bare.time_s < UR3_CUT_S
    bare = replace(bare, t_ns=bare.t_ns[keep], q=bare.q[keep], dq=bare.dq[keep], tau=bare.tau[keep], contact=None)
    tree = load_tree(folder / "ur3_robot.urdf", bare.joints)
    rng = np.random.default_rng(options.seed)
    loaded = []
    for mass in LOADS_KG:
        com = rng.standard_normal(3)
        truth = Carried(mass, tuple((com / np.linalg.norm(com) * rng.uniform(0, 0.1)).tolist()))
        loaded.append((with_torques(bare, tree, truth), truth.__dict__))
    for kind, missing in KINDS.items():
        bundle = trained(data, folder / f"{missing}.tauext", UR3_NM_PER_AMPERE, missing)
        yield {"arm": "UR3, real", "constants": kind} | weighed(bundle, loaded) | told(bundle, loaded, [bare])


def with_torques(bare: Recording, tree: Tree, what: Carried) -> Recording:
    """The recording with the currents that hold and move this load beside all else."""
    heavier = with_load(SimpleNamespace(tree=tree), what)
    p, beta = (b - a for a, b in zip(tree.momentum(bare.q, bare.dq), heavier.momentum(bare.q, bare.dq), strict=True))
    torque = beta.copy()
    torque[1:] += np.diff(p, axis=0) / np.diff(bare.time_s)[:, None]  # held over the step before a sample
    return replace(bare, tau=bare.tau + torque / UR3_NM_PER_AMPERE)


def weighed(bundle: Bundle, loaded: list[tuple[Recording, dict]]) -> dict[str, Any]:
    """Errors of mass and centre over windows of WINDOW_S."""
    frame, off, apart, held = load_frame(bundle, bundle.links[-1].joint_name), [], [], []
    for recording, truth in loaded:
        seen = see(bundle, recording)
        for begin in np.arange(FIRST_S, recording.time_s[-1] - WINDOW_S + 0.05, WINDOW_S):
            part = seen.part((seen.time_s >= begin) & (seen.time_s < begin + WINDOW_S))
            found = identify(bundle, frame, [part])
            off.append(found.mass_kg - truth["mass_kg"])
            apart.append(float(np.linalg.norm(found.com_m - np.array(truth["com_m"]))))
            held.append(abs(off[-1]) <= 2 * mass_error(found))
    return {
        "windows": len(off),
        "mass_off_kg": float(np.median(np.abs(off))),
        "mass_off_most_kg": float(np.max(np.abs(off))),
        "mass_within_two": float(np.mean(held)),
        "centre_off_m": float(np.median(apart)),
    }


def told(bundle: Bundle, loaded: list[tuple[Recording, dict]], free: list[Recording]) -> dict[str, Any]:
    """RMS of tau_ext of the joints in N m, collisions, and how much higher the last joint's limit is."""
    named = np.array(bundle.in_newtons)
    named[-1] = False  # the same joints in both bundles
    rms: dict[str, list] = {"not told": [], "told": []}
    limits, false, last = [], 0, 0
    for recording, truth in loaded:
        counts = recording.time_s >= FIRST_S
        for words, load in (("not told", None), ("told", load_of(bundle, truth, 1.0, 0.03))):
            said = judged(bundle, recording, load)
            rms[words].append(np.nanmean(said["tau_ext"][counts][:, named] ** 2))
        over = np.abs(said["tau_ext"][counts]) > said["limit_nm"][counts]
        false += collisions(recording.time_s[counts][said["detection"][counts].astype(bool)])
        last += int(over[:, -1].any())
        usual = judged(bundle, recording, None)
        limits.append(np.nanmedian(said["limit_nm"][counts][:, -1]) / np.nanmedian(usual["limit_nm"][counts][:, -1]))
    nothing = [np.nanmean(judged(bundle, one, None)["tau_ext"][one.time_s >= FIRST_S][:, named] ** 2) for one in free]
    return {
        "rms_free_nm": float(np.sqrt(np.mean(nothing))),
        "rms_not_told_nm": float(np.sqrt(np.mean(rms["not told"]))),
        "rms_told_nm": float(np.sqrt(np.mean(rms["told"]))),
        "false_collisions": false,
        "of_last_joint": last,
        "minutes": sum(one.time_s[-1] - FIRST_S for one, _ in loaded) / 60,
        "last_limit_times": [float(np.min(limits)), float(np.median(limits)), float(np.max(limits))],
    }


def forces(maker: Maker, arm: TrueArm, bundle: Bundle, options: argparse.Namespace) -> dict[str, Any]:
    """Of pushes on the last link, as benchmarks/wrench.py has them."""
    rng = maker.random(options.seed, STREAM + 1)
    contacts, signals = pushes_of(maker, arm, options.pushes, np.ones(len(maker.joints)), rng, WARM_S)
    said = estimate(bundle, *signals, 1)
    rows = told_of(bundle, arm, contacts, signals, said, said["residual"])
    found: dict[str, Any] = {"pushes": len(rows)}
    for kind in ("force", "wrench"):
        off = [row[kind]["off_n"] for row in rows]
        found |= {
            f"{kind}_off_n": float(np.median(off)),
            f"{kind}_off_nine_of_ten_n": float(np.quantile(off, 0.9)),
            f"{kind}_held": float(np.mean([row[kind]["held"] for row in rows])),
            f"{kind}_blind": float(np.mean([row[kind]["blind"] > 0 for row in rows])),
        }
    return found


def markdown(rows: list[dict[str, Any]]) -> str:
    """The table of docs/results/loads/missing-constant.md."""
    lines = head(" | ".join(["-", *(f"{one['arm']}: {one['constants']}" for one in rows)]))
    lines[0] = lines[0].replace("| - |", "| |", 1)

    def line(name: str, text: Any) -> None:
        lines.append(table_row(name, *map(text, rows)))

    line("mass of 4 s off by, median / most, kg", lambda r: f"{r['mass_off_kg']:.3f} / {r['mass_off_most_kg']:.2f}")
    line("within two of its errors", lambda r: f"{r['mass_within_two']:.0%} of {r['windows']}")
    line("centre of mass off by, median, mm", lambda r: f"{1e3 * r['centre_off_m']:.0f}")
    line("tau_ext without a load, RMS, Nm", lambda r: f"{r['rms_free_nm']:.2f}")
    line("with a load, not set / set", lambda r: f"{r['rms_not_told_nm']:.2f} / {r['rms_told_nm']:.2f}")
    line("false collisions with it set", lambda r: f"{r['false_collisions']} in {r['minutes']:.1f} min")
    line(
        "limit of the last joint, times",
        lambda r: f"{r['last_limit_times'][1]:.2f} ({r['last_limit_times'][0]:.2f} to {r['last_limit_times'][2]:.2f})",
    )
    for kind, what in (("force", "force alone"), ("wrench", "of a whole wrench")):
        line(
            f"{what} off by, median / nine of ten, N",
            lambda r, k=kind: f"{r[f'{k}_off_n']:.1f} / {r[f'{k}_off_nine_of_ten_n']:.1f}" if "pushes" in r else "",
        )
        line(
            f"{what}: within its ellipsoid of 95 % / with a blind direction",
            lambda r, k=kind: f"{r[f'{k}_held']:.0%} / {r[f'{k}_blind']:.0%}" if "pushes" in r else "",
        )
    return "\n".join(lines)


if __name__ == "__main__":
    main()
