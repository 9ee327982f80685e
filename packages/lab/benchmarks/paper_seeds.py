"""The paper's recipe with several seeds, beside Table I: how much errors depend on first weights and batches.

    python packages/lab/benchmarks/paper_seeds.py OUT [--cases exact none] [--seeds 0 1 2] [--max-steps N]

OUT/data is the dataset of `tauext reproduce --scale full`. Bundles in OUT/bundles are not trained again.
docs/results/full/seeds.json keeps what was measured, so that bundles can be of several machines; docs/fill.py makes the
tables. Errors are those of test motion at 100 Hz, as in the paper, and at 1 kHz, as a monitor answers. A collision
counts by a sample over the limit, since the paper states no hold time.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import ROOT, arguments, in_parallel, save_json, tauext
from tauext_lab.evaluate.collisions import find_collisions, judge
from tauext_lab.evaluate.free_motion import count_episodes

from tauext.bundle.bundle_file import load_bundle
from tauext.config import PAPER_CASES
from tauext.data.dataset import load_split
from tauext.data.recording_file import load_recording
from tauext.monitor.estimate import estimate_recording

KEPT = ROOT / "docs/results/full/seeds.json"
PAPER_STEP = 10
"""Samples from one row of the paper's data to the next."""
STICTION_RAD_S = 0.02
APART = 500
"""Samples between two false alarms; closer ones count as one."""


def measured(bundle_path: Path, data: Path) -> dict[str, np.ndarray]:
    """Errors of a bundle on test motion, its false alarms and detected collisions; arrays a joint."""
    bundle, split = load_bundle(bundle_path), load_split(data)
    errors, near, false, found, of = [], [], 0, 0, 0
    for name in split.test:
        recording = load_recording(data / name)
        estimates = estimate_recording(bundle, recording, 1)
        errors.append(np.where(estimates.healthy[:, None], np.abs(estimates.tau_ext), np.nan))
        near.append(np.abs(recording.dq) < STICTION_RAD_S)
        false += count_episodes(estimates.detection, APART)
    for name in split.collisions:
        recording = load_recording(data / name)
        verdicts = [
            judge(touch, recording, estimates)
            for estimates in [estimate_recording(bundle, recording, 1)]
            for touch in find_collisions(recording)
        ]
        found, of = found + sum(one.found for one in verdicts), of + len(verdicts)
    all_rows, slow = np.concatenate(errors), np.concatenate(near)
    rows = np.concatenate([one[::PAPER_STEP] for one in errors])
    return {
        "l1": np.nanmean(rows, axis=0),
        "l2": np.sqrt(np.nanmean(rows**2, axis=0)),
        "mse": np.nanmean(rows**2, axis=0),
        "l1_1khz": np.nanmean(all_rows, axis=0),
        "near": np.sqrt(np.nanmean(np.where(slow, all_rows, np.nan) ** 2, axis=0)),
        "sliding": np.sqrt(np.nanmean(np.where(slow, np.nan, all_rows) ** 2, axis=0)),
        "limit": np.array(bundle.sliding_limit_nm),
        "counts": np.array([false, found, of]),
    }


Measures = dict[tuple[str, int], dict[str, np.ndarray]]


def keep(new: Measures) -> None:
    """Write the file of all measures, by case and seed: what was measured now, and before."""
    listed = json.loads(KEPT.read_text()) if KEPT.is_file() else []
    found = {(one["case"], one["seed"]): one for one in listed}
    for (case, seed), one in new.items():
        rounded = {name: np.round(value.astype(float), 3).tolist() for name, value in one.items()}
        found[case, seed] = {"case": case, "seed": seed} | rounded
    save_json([found[key] for key in sorted(found, key=lambda key: (list(PAPER_CASES).index(key[0]), key[1]))], KEPT)


def main() -> None:
    parser = arguments(__doc__, "out")
    parser.add_argument("--cases", nargs="+", default=list(PAPER_CASES))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--max-steps", type=int, default=None, help="steps of a training; default: 500 epochs")
    options = parser.parse_args()
    out: Path = options.out
    data, bundles = out / "data", {}
    if not (data / "split.json").exists():
        tauext("simulate", "--minutes", 90, "--collision-recordings", 20, "--seed", 0, "--out", data)
    for case in options.cases:
        for seed in options.seeds:
            bundle = out / "bundles" / f"{case}-{seed}.tauext"
            if not bundle.exists():
                words = ["--recipe", "paper", "--case", case, "--seed", seed]
                words += [] if options.max_steps is None else ["--max-steps", options.max_steps]
                tauext("train", "--data", data, *words, "--out", bundle, printed=out / f"{case}-{seed}.log")
            bundles[case, seed] = bundle
    measures = in_parallel(None, measured, [(bundle, data) for bundle in bundles.values()])
    keep(dict(zip(bundles, measures, strict=True)))


if __name__ == "__main__":
    main()
