"""What it is worth to tell the monitor what the arm carries: false collisions and errors, told and untold.

    python benchmarks/loads.py MODELS OUT                # simulates arms and loads, of which this is made
    python benchmarks/carrying.py OUT [--arms ur5 panda ...]

Each arm is trained by the recipe prior on nine minutes without a load, with the constants of its currents that are
true, and with some that are off by up to 10 % and that training corrects as it can. Then it moves with 25 loads of 0.5
to 3 kg. OUT/carrying.md and OUT/carrying.json get the table.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from tauext import Bundle, Monitor, Recording, load_bundle, load_dataset

KINDS = {"true": ["--fit-torque-constants", "False"], "off": []}
FIRST_S = 1.3
"""Observer and alarms have warmed up."""
APART_S = 0.5
"""Detections farther apart are two collisions."""
TOLD = {"not told": None, "told": (1.0, 0.03), "told, believed exactly": (1.0, 0.0), "told 5 % too much": (1.05, 0.03)}
"""Times what it weighs, and the share by which limits rise."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder that benchmarks/loads.py wrote")
    parser.add_argument("--arms", nargs="+", default=["ur5", "panda", "kinova"])
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for arm in options.arms:
        for kind in KINDS:
            rows += carry(options.out / arm, kind)
            print(markdown(rows[-len(TOLD) - 1 :]), flush=True)
    (options.out / "carrying.json").write_text(json.dumps(rows, indent=1) + "\n")
    (options.out / "carrying.md").write_text(markdown(rows) + "\n")


def carry(folder: Path, kind: str) -> list[dict[str, Any]]:
    """Rows of one arm: without a load, then with each one of TOLD."""
    path = folder / f"carrying-{kind}.tauext"
    if not path.exists():
        words = ["train", "--data", str(folder / f"data-{kind}"), "--out", str(path), "--recipe", "prior", *KINDS[kind]]
        subprocess.run([sys.executable, "-m", "tauext", *words], check=True, stdout=subprocess.DEVNULL)
    bundle = load_bundle(path)
    dataset = load_dataset(folder / f"data-{kind}")
    seen: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for recording in dataset.recordings("train"):
        seen["nothing carried, in training"].append(watched(bundle, recording, None))
    for recording in dataset.recordings("test"):
        if not recording.name.startswith("load-"):
            continue
        truth = json.loads((folder / "csv" / f"{recording.name}.truth.json").read_text())
        for words, told in TOLD.items():
            load = None if told is None else load_of(bundle, truth, *told)
            seen[words].append(watched(bundle, recording, load))
    return [
        {"arm": folder.name, "constants": kind, "monitor": words} | together(all_of) for words, all_of in seen.items()
    ]


def load_of(bundle: Bundle, truth: dict[str, Any], times: float, error_share: float) -> dict[str, Any]:
    """What set_load() is told, in the bundle's load frame; the truth is in that of the last link."""
    at = bundle.load_settings
    turn = np.array(at.rotation).reshape(3, 3)
    com = turn.T @ (np.array(truth["com_m"]) - at.translation)
    mass = times * truth["mass_kg"]
    ball = 0.4 * mass * truth["radius_m"] ** 2
    inertia = [ball, ball, ball, 0.0, 0.0, 0.0]
    return {"mass": mass, "com": com.tolist(), "inertia": inertia, "error_share": error_share}


def watched(bundle: Bundle, recording: Recording, load: dict[str, Any] | None) -> dict[str, Any]:
    """Collisions, seconds, mean squares and median limits of one recording."""
    monitor = Monitor(bundle)
    if load is not None:
        monitor.set_load(**load)
    said = monitor.run(recording.t_ns, recording.q, recording.dq, recording.tau)
    counts = recording.time_s >= FIRST_S
    at_s = recording.time_s[counts & said["detection"].astype(bool)]
    return {
        "collisions": int(len(at_s) > 0) + int(np.sum(np.diff(at_s) > APART_S)),
        "seconds": float(recording.time_s[-1] - FIRST_S),
        "squares": np.nanmean(said["tau_ext"][counts] ** 2, axis=0),
        "limits": np.nanmedian(said["limit_nm"][counts], axis=0),
    }


def together(seen: list[dict[str, Any]]) -> dict[str, Any]:
    rms = np.sqrt(np.mean([one["squares"] for one in seen], axis=0))
    return {
        "collisions": sum(one["collisions"] for one in seen),
        "hours": sum(one["seconds"] for one in seen) / 3600,
        "rms_nm": rms.round(3).tolist(),
        "limit_nm": np.mean([one["limits"] for one in seen], axis=0).round(3).tolist(),
    }


def markdown(rows: list[dict[str, Any]]) -> str:
    lines = [
        "| arm | constants | the monitor is | collisions | tau_ext, RMS, Nm | usual limits, Nm |",
        "|---|---|---|---|---|---|",
    ]
    for row in rows:
        rms, limits = (" ".join(f"{x:.2f}" for x in row[name]) for name in ("rms_nm", "limit_nm"))
        told = f"{row['collisions']} in {row['hours']:.3f} h"
        lines.append(f"| {row['arm']} | {row['constants']} | {row['monitor']} | {told} | {rms} | {limits} |")
    return "\n".join(lines)


if __name__ == "__main__":
    main()
