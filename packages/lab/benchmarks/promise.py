"""Do limits keep the budget that they are set for, with minutes of motion?

    python packages/lab/benchmarks/promise.py work MODELS OUT [--arms ur5 rig ...] [--minutes 2 5 10 30] [--splits 2]
    python packages/lab/benchmarks/promise.py data OUT DATASET [DATASET ...] [--minutes 1 4 8] [--splits 3]

work: arms of unseen at their work, without touches while they learn. A bundle is trained on minutes of up to eight
hours (recipe prior). It is judged on later motion of the same programs, on other programs, and on touches. Recordings
in OUT/ARM are used again.

data: DATASET is a folder of `tauext import`, as unseen_arms.py and real_arms.py make them, or anyone's. For each split,
pieces of --piece-s are drawn at random from its recordings without contacts until they have the minutes. The bundle
trained on them is judged on the rest of these recordings, at least 2 s away from any piece, and on labelled contacts.

Counted are peaks of the worst ratio of a joint's held error to its limit, at the limits of three budgets, at those that
the minutes prove (kind supported), and at the largest ratio seen. OUT keeps every split; OUT/tables.md gets the tables.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import arguments, checkpoint, head, in_parallel, table_row, write_tables
from scipy.stats import poisson
from tauext_commission.connect import provenance_of, write_arm
from tauext_lab.evaluate.collisions import find_collisions
from unseen.arms import makers
from unseen.working import NAMES, Part, current_arm, working

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.config import PAPER_CASES, FreeMotionConfig, TrainConfig
from tauext.data.dataset import load_dataset
from tauext.data.free_motion import between
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording, save_recording
from tauext.errors import TrainingError
from tauext.robot.model_case import chosen_case, estimated_model
from tauext.train.asked_limits import AskedConfig, put_asked
from tauext.train.error_scale import judge
from tauext.train.held_peaks import PeakConfig, held_minimum, hold_lengths, peak_indices
from tauext.train.limits import LIMITS
from tauext.train.preparation import TrainingInput
from tauext.train.stage import train_on_recordings

LIMITS["asked"] = lambda bundle, motion: put_asked(bundle, motion, AskedConfig(times_as_many=(4.0, 16.0)))
"""Budgets of 1 in 8 h, 2 h and 30 minutes."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ways = parser.add_subparsers(dest="way", required=True)
    workers = os.cpu_count() or 1
    arms = ("ur5", "seven_axis", "so101", "rig", "panda", "kinova", "palletizer", "offset_wrist", "light_arm")
    work = arguments("", "models", "out", arms=arms, seed=0, workers=workers)
    data = arguments("", "out", seed=0, workers=workers)
    data.add_argument("datasets", type=Path, nargs="+")
    data.add_argument("--piece-s", type=float, default=60.0)
    for one, minutes, splits in ((work, [2, 5, 10, 30], 2), (data, [1, 4, 8], 3)):
        one.add_argument("--minutes", type=float, nargs="+", default=minutes)
        one.add_argument("--splits", type=int, default=splits)
    ways.add_parser("work", parents=[work], add_help=False)
    ways.add_parser("data", parents=[data], add_help=False)
    options = parser.parse_args()
    splits = [(minutes, options.seed + k) for minutes in options.minutes for k in range(options.splits)]
    if options.way == "work":
        jobs = [(name, options.models, options.out, pool_of(max(options.minutes))) for name in options.arms]
        in_parallel(options.workers, made, jobs)
        jobs = [(options.out, name, *split) for split in splits for name in options.arms]
        rows = in_parallel(options.workers, row_of_work, jobs)
    else:
        jobs = [(options.out, folder, *split, options.piece_s) for split in splits for folder in options.datasets]
        rows = in_parallel(options.workers, row_of_data, jobs)
    write_tables(options.out, tables(rows))


# --- One bundle, and what its limits do.


def judged(
    row: dict,
    pieces: Sequence[Recording],
    robot: Path | None,
    later: Iterable[Recording],
    other: Iterable[Recording],
    touched: Iterable[Recording],
) -> dict:
    """The row with a bundle's limits, and peaks of the worst ratio: trained on these pieces of free motion."""
    model = PAPER_CASES[chosen_case(None, robot)[0]]
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "made.tauext"
        tree = estimated_model(robot, pieces[0].joints, model)
        try:
            train_on_recordings(TrainingInput(robot, model, pieces, [], model=tree), TrainConfig(recipe="prior"), path)
        except TrainingError as error:
            return row | {"refused": str(error)}
        bundle = load_bundle(path)
    facts = json.loads(bundle.provenance)
    limits = facts["limits"]
    levels = {one["text"]: one["share_of_limits"] for one in limits["budgets"]}
    levels |= {"proved": 1 / limits["extrapolated"]["factor"], "largest error": limits["extrapolated"]["largest_seen"]}
    same, others = (ratios_of(bundle, some) for some in (later, other))
    hits = np.array([hit for recording in touched for hit in hit_ratios(bundle, recording)])
    return row | {
        "levels": levels,
        "set_per_hour": {one["text"]: one["per_hour"] for one in limits["budgets"]},
        "push_n": {one["text"]: list(one["push_n"].values()) for one in limits["budgets"]},
        "between_per_hour": limits["extrapolated"]["between_per_hour"],
        "hours": [hours for _, hours in (same, others)],
        "false": {name: [int((peaks > at).sum()) for peaks, _ in (same, others)] for name, at in levels.items()},
        "hits": {name: int((hits > at).sum()) for name, at in levels.items()},
        "touches": len(hits),
        "faults": sorted({one["code"] for one in facts["limit_findings"] if one["severity"] == "fault"}),
        "largest_ratios": [np.sort(peaks)[::-1][:50].round(4).tolist() for peaks, _ in (same, others)],
        "touch_ratios": np.sort(hits)[::-1].round(4).tolist(),
    }


def worst_ratio(bundle: _core.Bundle, recording: Recording, touches: bool) -> tuple[Recording, np.ndarray, np.ndarray]:
    """The motion, the worst ratio of a joint's held error to its limit, (samples,), and which samples count."""
    motion, found, error, counted = judge(bundle, recording, 1, FreeMotionConfig())
    if touches:
        counted = np.isfinite(found["tau_ext"]).all(axis=1)
    near = found["near_stiction"].astype(bool)
    ratio = error / np.where(near, bundle.near_stiction_limit_nm, bundle.sliding_limit_nm)
    held = held_minimum(ratio, counted, hold_lengths(motion.t_ns, bundle.hold_s))
    return motion, np.nan_to_num(held, nan=0.0).max(axis=1), counted


def ratios_of(bundle: _core.Bundle, recordings: Iterable[Recording]) -> tuple[np.ndarray, float]:
    """Peaks in free motion, and its hours."""
    peaks, hours = [np.zeros(0)], 0.0
    for recording in recordings:
        motion, ratio, counted = worst_ratio(bundle, recording, touches=False)
        peaks.append(ratio[peak_indices(ratio, motion.t_ns, gap_s=PeakConfig.gap_s)])
        hours += float(np.diff(motion.t_ns)[counted[1:] & counted[:-1]].sum()) / 3.6e12
    return np.concatenate(peaks), hours


def hit_ratios(bundle: _core.Bundle, recording: Recording) -> list[float]:
    """Largest ratio during each labelled contact and 0.2 s after it."""
    _, ratio, _ = worst_ratio(bundle, recording, touches=True)
    after = round(0.2 * recording.rate_hz)
    return [float(ratio[one.begin : one.end + after].max()) for one in find_collisions(recording)]


# --- Arms at their work.


SETS = {"pool": (8, 0, 0), "later": (4, 48, 0), "test": (4, 5000, 0), "hits": (2, 5100, 50)}
"""Stretches of ten minutes, number of the first, touches in each."""
LEARNS = ("pool", "later")
SHIFT = 48
"""Stretches of the pool from which hours of motion are drawn."""


def pool_of(minutes: float) -> int:
    """Stretches from which so much motion is drawn."""
    count = SETS["pool"][0]
    return count if minutes <= 10 * count else SHIFT


def made(name: str, models: Path, out: Path, pool: int) -> None:
    """Recordings of an arm, as far as they do not exist."""
    arm = working(name, 0) if name in NAMES else current_arm(makers(models)[name], 0, (0.0, 0.0), True)
    folder = out / name
    folder.mkdir(parents=True, exist_ok=True)
    robot = arm.robot
    if arm.robot_text:
        robot = folder / "in.xml"
        robot.write_text(arm.robot_text)
    write_arm(arm.facts, robot, folder)
    for label, (count, first, touches) in (SETS | {"pool": (pool, 0, 0)}).items():
        for k in range(first, first + count):
            path = folder / f"{label}-{k:04d}.parquet"
            if path.exists():
                continue
            # A cold start; later motion is of the same programs and other programs are of a warm arm.
            warm_s, seed = (600.0 * k, 0) if label in LEARNS else (7200.0, 1)
            stretch = arm.stretch(seed, k, Part("bare", 6.0), warm_s, touches)
            save_recording(replace(stretch, name=path.stem, provenance=provenance_of(arm.facts)), path)


def row_of_work(out: Path, name: str, minutes: float, split: int) -> dict:
    """The row of one split, kept in OUT."""
    folder, row = out / name, {"arm": name, "minutes": minutes, "split": split}

    def of(label: str) -> list[Path]:
        first, count = SETS[label][1], pool_of(minutes) if label == "pool" else SETS[label][0]
        return [folder / f"{label}-{k:04d}.parquet" for k in range(first, first + count)]

    def make() -> dict:
        robot = next((one for one in folder.glob("robot.*") if one.suffix in (".urdf", ".xml")), None)
        pieces = list(consecutive(of("pool"), 60 * minutes, np.random.default_rng([split, round(60 * minutes)])))
        return judged(row, pieces, robot, *(map(load_recording, of(label)) for label in ("later", "test", "hits")))

    return checkpoint(out / f"{name}-{minutes:g}-{split}.json", make)


def consecutive(files: Sequence[Path], seconds: float, rng: np.random.Generator) -> Iterable[Recording]:
    """So much motion from a random stretch on, in recordings of a minute."""
    first = int(rng.integers(len(files)))
    for k in range(len(files)):
        recording = replace(load_recording(files[(first + k) % len(files)]), contact=None, tau_ext=None)
        length_s = min(seconds, recording.duration_s)
        start = float(rng.uniform(0, max(recording.duration_s - length_s, 0.0)))
        edges = np.linspace(start, start + length_s, max(1, round(length_s / 60)) + 1)
        yield from (span(recording, *edge) for edge in zip(edges[:-1], edges[1:], strict=True))
        seconds -= length_s
        if seconds < 1:
            return


# --- Recordings of an arm.


def row_of_data(out: Path, data: Path, minutes: float, seed: int, piece_s: float) -> dict:
    """The row of one split, kept in OUT."""
    name = data.parent.name if data.name in ("urdf", "data") else data.name

    def make() -> dict:
        dataset = load_dataset(data)
        sets = ("train", "validation", "test")
        free = [r for part in sets for r in dataset.recordings(part) if not find_collisions(r)]
        key = int(hashlib.sha256(name.encode()).hexdigest()[:8], 16)
        pieces, rest = drawn(free, 60 * minutes, piece_s, np.random.default_rng([seed, round(60 * minutes), key]))
        row = {"arm": name, "minutes": minutes, "split": seed}
        return judged(row, pieces, dataset.robot_file(None), rest, [], dataset.recordings("collisions"))

    return checkpoint(out / f"{data.parent.name}-{data.name}-{minutes:g}-{seed}.json", make)


def drawn(
    free: Sequence[Recording], seconds: float, piece_s: float, rng: np.random.Generator
) -> tuple[list[Recording], list[Recording]]:
    """Random pieces of the recordings, so many seconds in all or the most there is up to half, and the rest."""
    starts = [(r, s) for r in free for s in np.arange(0, max(r.duration_s - piece_s / 2, 1e-9), piece_s)]
    most = max(1, min(round(seconds / piece_s), len(starts) // 2))
    chosen = sorted(rng.choice(len(starts), most, replace=False).tolist())
    pieces, rest = [], []
    for recording in free:
        cuts = [starts[k][1] for k in chosen if starts[k][0] is recording]
        pieces += [span(recording, s, s + piece_s) for s in cuts]
        begins, ends = [0.0, *(s + piece_s + 2.0 for s in cuts)], [*(s - 2.0 for s in cuts), recording.duration_s]
        spans = [one for one in zip(begins, ends, strict=True) if one[1] - one[0] > 8.0]  # seconds to warm up
        rest += [span(recording, *one) for one in spans]
    return pieces, rest


def span(recording: Recording, from_s: float, to_s: float) -> Recording:
    """What lies between two times, under a name that has them."""
    first, last = np.searchsorted(recording.time_s, [from_s, to_s])
    return between(recording, int(first), int(last), f"{recording.name}-{from_s:.0f}")


# --- Tables.


def tables(rows: Sequence[dict]) -> list[str]:
    """What the limits of each number of minutes do, of all arms together and of each."""
    lines = head(
        "minutes | arm | limits | false, same programs (set) | other programs (set) | touches detected "
        "| push noticed [N]: arm's end, forearm"
    )
    used = [row for row in rows if "levels" in row]
    for minutes in sorted({row["minutes"] for row in used}):
        of_minutes = [row for row in used if row["minutes"] == minutes]
        arms = dict.fromkeys(row["arm"] for row in of_minutes)
        for arm in ("**all**", *arms):
            some = [row for row in of_minutes if arm in ("**all**", row["arm"])]
            for name in some[0]["levels"]:
                cells = [counts(some, name, which) for which in (0, 1)]
                touches = sum(row["touches"] for row in some)
                hits = sum(row["hits"][name] for row in some)
                pushes = np.array([row["push_n"].get(name) or [np.nan, np.nan] for row in some], dtype=float)
                push = (
                    ""
                    if arm == "**all**" or np.isnan(pushes).all()
                    else ", ".join(f"{x:.3g}" for x in pushes.mean(axis=0))
                )
                lines.append(table_row(f"{minutes:g}", arm, name, *cells, f"{hits} of {touches}", push))
    return lines


def counts(rows: Sequence[dict], name: str, which: int) -> str:
    """False alarms in the same programs or in others, and how many the budget sets; implausible counts are marked."""
    false, hours = sum(row["false"][name][which] for row in rows), sum(row["hours"][which] for row in rows)
    if not hours:
        return ""
    rate = rows[0]["set_per_hour"].get(name)
    if rate is None:
        return f"{false} in {hours:.1f} h"
    mark = " !" if poisson.sf(false - 1, rate * hours) < 0.01 else ""
    return f"{false} ({rate * hours:.1f}){mark}"


if __name__ == "__main__":
    main()
