"""The paper's recipe with several seeds, beside Table I: how much errors depend on first weights and batches.

    python packages/lab/benchmarks/paper_seeds.py OUT [--cases exact none] [--seeds 0 1 2] [--max-steps N]

OUT/data is the dataset of `tauext reproduce --scale full`. A bundle that OUT/bundles holds is not trained again. What
was measured is kept in docs/results/full/seeds.json, so that pages can be made from bundles of several machines. Errors
are those of test motion at 100 Hz, as in the paper, and at 1 kHz, as a monitor answers. A collision counts by a sample
over the limit, since the paper states no hold time.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import ROOT, arguments, head, in_parallel, joined, table_row, tauext, write_page
from tauext_lab.evaluate.collisions import find_collisions, judge
from tauext_lab.evaluate.free_motion import count_episodes
from tauext_lab.report.paper import L1_NM, L2_NM, MSE_NM2

from tauext.bundle.bundle_file import load_bundle
from tauext.config import PAPER_CASES
from tauext.data.dataset import load_split
from tauext.data.recording_file import load_recording
from tauext.monitor.estimate import estimate_recording

PAGE = ROOT / "docs/results/full/seeds.inc"
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


def kept(new: Measures) -> Measures:
    """What was measured now or before, by case and seed; it is written to the file of all measures."""
    file = PAGE.with_suffix(".json")
    listed = json.loads(file.read_text()) if file.is_file() else []
    found = {(one.pop("case"), one.pop("seed")): {key: np.array(value) for key, value in one.items()} for one in listed}
    found |= {key: {name: np.round(value.astype(float), 3) for name, value in one.items()} for key, one in new.items()}
    found = {key: found[key] for key in sorted(found, key=lambda key: (list(PAPER_CASES).index(key[0]), key[1]))}
    entries = [
        {"case": case, "seed": seed} | {name: value.tolist() for name, value in one.items()}
        for (case, seed), one in found.items()
    ]
    write_page(file, ["[", *(f"{json.dumps(one)}{',' * (one is not entries[-1])}" for one in entries), "]"])
    return found


def mean_and_range(values: np.ndarray, form: str = ".3f") -> str:
    """Seeds' mean of each joint, and the range where there are several."""
    mean = joined(values.mean(axis=0), form, "/")
    if len(values) == 1:
        return mean
    return f"{mean} ({joined(values.min(axis=0), form, '/')} to {joined(values.max(axis=0), form, '/')})"


def page(found: Measures) -> list[str]:
    cases = [case for case in PAPER_CASES if any(case == key[0] for key in found)]
    columns = "model | seeds | L1, N m | paper | L2, N m | paper | MSE, (N m)² | paper | L1 at 1 kHz, N m"
    lines = head(columns)
    for case in cases:
        seeds = [one for (name, _), one in found.items() if name == case]
        stacked = {key: np.array([one[key] for one in seeds]) for key in seeds[0]}
        cells = [case, len(seeds)]
        for key, paper in (("l1", L1_NM), ("l2", L2_NM), ("mse", MSE_NM2)):
            cells += [mean_and_range(stacked[key]), joined(paper[case], ".3f", "/")]
        lines.append(table_row(*cells, mean_and_range(stacked["l1_1khz"])))
    columns = "model | seed | RMSE near stiction, N m | sliding, N m | threshold sliding, N m"
    columns += " | false alarms | detected by one sample"
    lines += ["", *head(columns)]
    for (case, seed), one in found.items():
        false, detected, of = one["counts"]
        cells = [joined(one[key], ".2f", "/") for key in ("near", "sliding", "limit")]
        lines.append(table_row(case, seed, *cells, int(false), f"{int(detected)} of {int(of)}"))
    return lines


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
    write_page(PAGE, page(kept(dict(zip(bundles, measures, strict=True)))))


if __name__ == "__main__":
    main()
