"""Does tau_ext's standard error hold in recordings that training did not contain?

    python packages/lab/benchmarks/standard_errors.py OUT DATASET [DATASET ...] [--most 12]

DATASET is a folder of `tauext import`, as real_arms.py makes them, or anyone's. Each of its recordings is left out in
turn (at most --most of a dataset, evenly), and the others train a bundle (recipe prior). Fewer than three are cut into
four each. Where nothing touches the arm, tau_ext is the error: counted are samples in which it lies within two standard
errors, a joint and class of motion, and how small a standard error becomes.

OUT keeps each bundle and its counts (without these, the bundle is judged again); OUT/tables.md gets the tables.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import arguments, checkpoint, head, in_parallel, table_row, write_tables
from promise import span

from tauext.bundle.bundle_file import load_bundle
from tauext.config import PAPER_CASES, FreeMotionConfig, TrainConfig
from tauext.data.dataset import load_dataset
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.errors import TrainingError
from tauext.robot.model_case import chosen_case, estimated_model
from tauext.train.error_scale import FOR_ERRORS, judge
from tauext.train.preparation import TrainingInput
from tauext.train.stage import train_on_recordings

CLASSES = ("at rest", "rests alone", "slow", "fast", "turns", "all")
RESTS_RAD_S, TURNS_S = 0.002, 0.3
PIECES = 4


def main() -> None:
    parser = arguments(__doc__, "out", workers=os.cpu_count() or 1)
    parser.add_argument("datasets", type=Path, nargs="+")
    parser.add_argument("--most", type=int, default=12, help="recordings left out of a dataset, default: %(default)s")
    options = parser.parse_args()
    jobs = []
    for folder in options.datasets:
        count = len(recordings_of(folder)[1])
        chosen = np.unique(np.linspace(0, count - 1, min(count, options.most)).round().astype(int))
        jobs += [(options.out, folder, int(k)) for k in chosen]
    write_tables(options.out, tables(in_parallel(options.workers, row_of, jobs)))


def recordings_of(folder: Path) -> tuple[Path | None, list[Recording]]:
    """Robot file, and all recordings of the folder, cut where there are few."""
    found = [load_recording(path) for path in sorted(folder.glob("*.parquet"))]
    if len(found) < 3:
        edges = [np.linspace(0, one.duration_s, PIECES + 1) for one in found]
        found = [span(r, *pair) for r, at in zip(found, edges, strict=True) for pair in zip(at, at[1:], strict=False)]
    return load_dataset(folder).robot_file(None), found


def row_of(out: Path, folder: Path, k: int) -> dict:
    """Counts of the k-th recording, left out."""
    name = f"{folder.parent.name}-{folder.name}"
    bundle = out / f"{name}-{k}.tauext"
    return checkpoint(out / f"{name}-{k}.json", lambda: {"data": name} | counted(folder, k, bundle))


def counted(folder: Path, k: int, path: Path) -> dict:
    """Samples of each joint and class, and those within two standard errors."""
    robot, recordings = recordings_of(folder)
    held_out = recordings[k]
    if not path.exists():
        model = PAPER_CASES[chosen_case(None, robot)[0]]
        others = [one for one in recordings if not same(one, held_out)]
        tree = estimated_model(robot, held_out.joints, model)
        try:
            train_on_recordings(TrainingInput(robot, model, others, [], model=tree), TrainConfig(recipe="prior"), path)
        except TrainingError as error:
            return {"refused": str(error)}
    bundle = load_bundle(path)
    motion, found, _, counts = judge(bundle, held_out, 1, FreeMotionConfig(), (*FOR_ERRORS, "sigma_nm"))
    limits = np.where(found["near_stiction"], bundle.near_stiction_limit_nm, bundle.sliding_limit_nm)
    joints = {}
    for j in np.flatnonzero(bundle.monitored):
        sigma, error = found["sigma_nm"][:, j], np.abs(found["tau_ext"][:, j])
        at = counts & np.isfinite(sigma)
        if not at.any():
            continue
        joints[motion.joints[j]] = {
            name: [int((chosen & at).sum()), int((chosen & at & (error <= 2 * sigma)).sum())]
            for name, chosen in classes_of(motion, int(j)).items()
        } | {"sigma_over_limit": float((sigma[at] / (limits * found["limit_scale"])[at, j]).min())}
    return {"recording": motion.name, "joints": joints}


def same(one: Recording, other: Recording) -> bool:
    """Whether one is the other, or a part of it."""
    return one.name == other.name or f"{one.name}-test" == other.name or f"{other.name}-test" == one.name


def classes_of(motion: Recording, joint: int) -> dict[str, np.ndarray]:
    """Samples of each class, (samples,), bool; slow: below a fifth of the joint's fastest.

    Rests alone: stopped more than TURNS_S ago, while another joint moves.
    """
    speed = np.abs(motion.dq[:, joint])
    rests = speed < RESTS_RAD_S
    slow = ~rests & (speed < 0.2 * np.quantile(speed, 0.99))
    sign = np.where(rests, 0, np.sign(motion.dq[:, joint]))
    turned = np.concatenate([[False], sign[1:] != sign[:-1]])
    recent = np.convolve(turned, np.ones(max(1, round(TURNS_S * motion.rate_hz))))[: len(turned)] > 0
    others = (np.abs(np.delete(motion.dq, joint, axis=1)) >= RESTS_RAD_S).any(axis=1)
    return {
        "at rest": rests,
        "rests alone": rests & others & ~recent,
        "slow": slow,
        "fast": ~rests & ~slow,
        "turns": recent,
        "all": np.ones(len(speed), bool),
    }


def tables(rows: Sequence[dict]) -> list[str]:
    """Shares within two standard errors, by data: pooled, and the worst joint of a recording."""
    lines = head(f"data | recordings | {' | '.join(CLASSES)} | worst joint of a recording | smallest sigma / limit")
    for data in dict.fromkeys(row["data"] for row in rows):
        some = [row for row in rows if row["data"] == data and "joints" in row]
        each = [joint for row in some for joint in row["joints"].values()]
        cells = []
        for name in CLASSES:
            shares = [joint[name][1] / joint[name][0] for joint in each if joint[name][0] >= 50]
            total = sum(joint[name][0] for joint in each)
            inside = sum(joint[name][1] for joint in each)
            cells.append(f"{inside / total:.0%} ({min(shares):.0%})" if total and shares else "–")
        worst, where = min(
            (joint["all"][1] / joint["all"][0], f"{row['recording']}, {name}")
            for row in some
            for name, joint in row["joints"].items()
            if joint["all"][0] >= 50
        )
        smallest = min(joint["sigma_over_limit"] for joint in each)
        lines.append(table_row(data, len(some), *cells, f"{worst:.0%}: {where}", f"{smallest:.4f}"))
    return lines


if __name__ == "__main__":
    main()
