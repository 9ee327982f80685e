"""Effect of setting the load in the monitor: false collisions, errors and detected pushes.

    python benchmarks/loads.py MODELS OUT --arms ur5 panda ...     # simulates arms and loads, of which this is made
    python benchmarks/carrying.py MODELS OUT [--arms ur5 panda ...]

Each arm is trained by the recipe prior on nine minutes without a load, with the constants of its currents that are
true, and with some that are off by up to 10 % and that training corrects as it can. Then it moves with 25 loads of 0.5
to 3 kg, and is pushed while it carries some of them: the same pushes, on the same motion, as without a load.
OUT/carrying.md and OUT/carrying.json get the tables.
"""

from __future__ import annotations

import json
import os
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from common import COLLISION, arguments, checkpoint, head, in_parallel, joined, quantiles_ms, table_row, write_tables
from loads import KINDS, dataset
from unseen.arms import Maker, makers
from unseen.loads import PAIRS, pair_names, write_pair
from unseen.recordings import STRONG

from tauext import Bundle, Monitor, Recording, load_bundle, load_dataset, load_recording
from tauext.monitor.weighing import identify, load_frame, see

FIRST_S = 1.3
"""Observer and alarms have warmed up."""
RADIUS_M = 0.04
APART_S = 0.5
"""Detections farther apart are two collisions."""
AFTER_S = 0.5
"""After a push a collision still counts as that push's."""
HARD = 1.5
GRADES = ("hard", "strong", "weak")
"""Some joint's true torque is HARD times its usual limit without a load or more; STRONG times its error; less."""
LOADS = {
    "load not set": None,
    "load set": (1.0, 0.03),
    "load set, error share 0": (1.0, 0.0),
    "load set, 5 % too heavy": (1.05, 0.03),
}
"""Factor on the true load, and the error share that raises the limits; None: no load set."""


def main() -> None:
    parser = arguments(__doc__, "models", "out", arms=("ur5", "panda", "kinova", "seven_axis"), seed=0)
    options = parser.parse_args()
    known = makers(options.models)
    carrying: list[dict[str, Any]] = []
    pushed: list[dict[str, Any]] = []
    for arm in options.arms:
        facts = judge(known[arm], options.out / arm, options.seed)
        carrying += facts["carrying"]
        pushed += facts["pushed"]
    write_tables(options.out, tables(carrying, pushed), {"carrying": carrying, "pushed": pushed}, "carrying")


def judge(maker: Maker, folder: Path, seed: int) -> dict[str, list[dict[str, Any]]]:
    """Rows of one arm, from FOLDER/carrying.json where that is not older than the bundles."""
    bundles = {kind: path for kind in KINDS if (path := folder / f"{kind}.tauext").exists()}

    def facts() -> dict[str, list[dict[str, Any]]]:
        in_parallel(os.cpu_count(), write_pair, [(maker, seed, k, folder / "csv") for k in range(PAIRS)])
        return {
            "carrying": [row for kind in bundles for row in carry(folder, kind)],
            "pushed": [row for kind in bundles for row in push(maker, folder, kind, seed)],
        }

    return checkpoint(folder / "carrying.json", facts, *bundles.values())


def carry(folder: Path, kind: str) -> list[dict[str, Any]]:
    """Rows of one arm: without a load, then with each of LOADS."""
    bundle = load_bundle(folder / f"{kind}.tauext")
    recordings = load_dataset(folder / f"data-{kind}")
    seen: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for recording in recordings.recordings("train"):
        seen["no load, training motion"].append(watched(bundle, recording, None))
    for recording in recordings.recordings("test"):
        if not recording.name.startswith("load-"):
            continue
        truth = json.loads((folder / "csv" / f"{recording.name}.truth.json").read_text())
        for words, told in LOADS.items():
            load = None if told is None else load_of(bundle, truth, *told)
            seen[words].append(watched(bundle, recording, load))
    return [
        {"arm": folder.name, "constants": kind, "monitor": words} | together(all_of) for words, all_of in seen.items()
    ]


def load_of(bundle: Bundle, truth: dict[str, Any], times: float, error_share: float) -> dict[str, Any]:
    """Arguments of set_load(), in the bundle's load frame; the truth is in the frame of the last link."""
    at = bundle.load_settings
    turn = np.array(at.rotation).reshape(3, 3)
    com = turn.T @ (np.array(truth["com_m"]) - at.translation)
    mass = times * truth["mass_kg"]
    ball = 0.4 * mass * truth["radius_m"] ** 2
    inertia = [ball, ball, ball, 0.0, 0.0, 0.0]
    return {"mass": mass, "com": com.tolist(), "inertia": inertia, "error_share": error_share}


def judged(bundle: Bundle, recording: Recording, load: dict[str, Any] | None) -> dict[str, np.ndarray]:
    """Estimates of a monitor in which this load is set before the recording."""
    monitor = Monitor(bundle)
    if load is not None:
        monitor.set_load(**load)
    return monitor.run(recording.t_ns, recording.q, recording.dq, recording.tau)


def watched(bundle: Bundle, recording: Recording, load: dict[str, Any] | None) -> dict[str, Any]:
    """Collisions, seconds, mean squares and median limits of one recording."""
    said = judged(bundle, recording, load)
    counts = recording.time_s >= FIRST_S
    return {
        "collisions": collisions(recording.time_s[counts & said["detection"].astype(bool)]),
        "seconds": float(recording.time_s[-1] - FIRST_S),
        "squares": np.nanmean(said["tau_ext"][counts] ** 2, axis=0),
        "limits": np.nanmedian(said["limit_nm"][counts], axis=0),
    }


def collisions(at_s: np.ndarray) -> int:
    """How many these samples are."""
    return int(len(at_s) > 0) + int(np.sum(np.diff(at_s) > APART_S))


def together(seen: list[dict[str, Any]]) -> dict[str, Any]:
    rms = np.sqrt(np.mean([one["squares"] for one in seen], axis=0))
    return {
        "collisions": sum(one["collisions"] for one in seen),
        "hours": sum(one["seconds"] for one in seen) / 3600,
        "rms_nm": rms.round(3).tolist(),
        "limit_nm": np.mean([one["limits"] for one in seen], axis=0).round(3).tolist(),
    }


def push(maker: Maker, folder: Path, kind: str, seed: int) -> list[dict[str, Any]]:
    """Rows of one arm that is pushed: without a load, then with each of LOADS but the first."""
    data = folder / f"pushed-{kind}"
    names = [name for k in range(PAIRS) for name in pair_names(k)]
    dataset(maker, folder, seed, kind, data, names, "collisions")
    bundle, true = load_bundle(folder / f"{kind}.tauext"), load_bundle(folder / "true.tauext")
    error = json.loads(true.provenance)["prior"]["error_nm"]
    least_nm = {"hard": HARD * np.array(true.sliding_limit_nm), "strong": STRONG * np.array([*error.values()])}
    seen: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for k in range(PAIRS):
        bare, loaded = (load_recording(data / f"{name}.parquet") for name in pair_names(k))
        truth = json.loads((folder / "csv" / f"{bare.name}.truth.json").read_text())
        grades = [grade(np.array(one["peak_nm"]), least_nm) for one in truth]
        carried = json.loads((folder / "csv" / f"load-{k:02d}.truth.json").read_text())
        itself = weighed(bundle, maker.joints[-1], load_recording(folder / f"data-{kind}" / f"load-{k:02d}.parquet"))
        seen["no load"].append(found(judged(bundle, bare, None), bare, truth, grades))
        for words, told in LOADS.items():
            if told is not None:
                said = judged(bundle, loaded, load_of(bundle, carried, *told))
                seen[words].append(found(said, loaded, truth, grades))
        said = judged(bundle, loaded, load_of(bundle, itself, *LOADS["load set"]))
        seen["load as weighed"].append(found(said, loaded, truth, grades))
    return [{"arm": maker.name, "constants": kind, "monitor": words} | sums(all_of) for words, all_of in seen.items()]


def weighed(bundle: Bundle, joint: str, recording: Recording) -> dict[str, Any]:
    """What the arm finds that it carries, from seconds of another motion with the same load; a ball of usual size."""
    seen = see(bundle, recording)
    one = identify(bundle, load_frame(bundle, joint), [seen.part(seen.time_s >= FIRST_S)])
    return {"mass_kg": one.mass_kg, "com_m": one.com_m.tolist(), "radius_m": RADIUS_M}


def grade(peak_nm: np.ndarray, least_nm: dict[str, np.ndarray]) -> str:
    """How strong a push is, by the true torque at the joint where that is most."""
    return next((name for name, least in least_nm.items() if (peak_nm >= least).any()), "weak")


def found(said: dict[str, np.ndarray], recording: Recording, truth: Sequence[dict], grades: Sequence[str]) -> dict:
    """Pushes of each grade that raised a collision, how soon, and collisions that no push raised."""
    time_s, held = recording.time_s, said["held_alarm"] == COLLISION
    free = time_s >= FIRST_S
    delays_s = []
    for one in truth:
        within = (time_s >= one["start_s"]) & (time_s <= one["end_s"] + AFTER_S)
        at_s = time_s[within & held]
        delays_s.append(float(at_s[0] - one["start_s"]) if len(at_s) else np.nan)
        free &= ~within
    hit = ~np.isnan(delays_s)
    of = {name: np.array([one == name for one in grades]) for name in GRADES}
    return {name: [int((hit & chosen).sum()), int(chosen.sum())] for name, chosen in of.items()} | {
        "delays_s": np.array(delays_s)[hit & of["hard"]].tolist(),
        "collisions": collisions(time_s[free & held]),
        "hours": float(free.sum()) / recording.rate_hz / 3600,
    }


def sums(seen: list[dict]) -> dict[str, Any]:
    """Of one row's recordings."""
    return {name: np.sum([one[name] for one in seen], axis=0).tolist() for name in GRADES} | {
        "delays_s": [round(x, 4) for one in seen for x in one["delays_s"]],
        "collisions": sum(one["collisions"] for one in seen),
        "hours": sum(one["hours"] for one in seen),
    }


def tables(carrying: Sequence[dict], pushed: Sequence[dict]) -> list[str]:
    """Detected pushes, then false collisions and errors."""
    lines = head(
        "arm | constants | monitor | hard detected | strong | weak | delay, ms: median, 90 % | false collisions"
    )
    for one in [*pushed, *over_arms(pushed)]:
        counts = ["/".join(map(str, one[name])) for name in GRADES]
        false = f"{one['collisions']} in {one['hours']:.3f} h"
        delays = quantiles_ms(one["delays_s"], (0.5, 0.9))
        lines.append(table_row(one["arm"], one["constants"], one["monitor"], *counts, delays, false))
    lines += ["", *head("arm | constants | monitor | collisions | tau_ext, RMS, Nm | usual limits, Nm")]
    for one in carrying:
        rms_nm, limits = (joined(one[name], by=" ") for name in ("rms_nm", "limit_nm"))
        false = f"{one['collisions']} in {one['hours']:.3f} h"
        lines.append(table_row(one["arm"], one["constants"], one["monitor"], false, rms_nm, limits))
    return lines


def over_arms(pushed: Sequence[dict]) -> list[dict]:
    """The sums over all arms."""
    rows = []
    for constants, words in dict.fromkeys((row["constants"], row["monitor"]) for row in pushed):
        chosen = [row for row in pushed if (row["constants"], row["monitor"]) == (constants, words)]
        rows.append({"arm": "**all**", "constants": constants, "monitor": words} | sums(chosen))
    return rows


if __name__ == "__main__":
    main()
