"""Does the promised rate of false alarms hold, with limits from an hour of calibration, or from minutes of training?

    python packages/lab/benchmarks/promise.py hour MODELS OUT [--arms palletizer offset_wrist ...] [--seed 0]
    python packages/lab/benchmarks/promise.py minutes OUT DATASET [DATASET ...] [--minutes 1 4 8] [--splits 3]

hour: arms of unseen at their work, without touches while they learn: twenty minutes of training (recipe prior), an hour
for the limits, a later hour of the same programs, an hour of others, and half an hour with 150 touches. Hits are added
to that last free hour in every link and direction (`tauext evaluate --inject`). Recordings and bundles in OUT/ARM are
used again, and OUT/promise.json keeps the results of each version of the code, so that two versions are compared on the
same files: run the script in both checkouts.

minutes: DATASET is a folder of `tauext import`, as unseen_arms.py makes them, or anyone's. For each split, pieces of
--piece-s are drawn at random from its recordings without contacts until they have the minutes; a bundle is trained on
them (recipe prior). It is judged on the rest of these recordings, at least 2 s away from any piece, and on its labelled
contacts. OUT keeps every split; OUT/minutes.md gets the table.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import (
    arguments,
    checkpoint,
    commit,
    head,
    in_parallel,
    joined,
    quantiles_ms,
    save_json,
    table_row,
    trained,
    write_tables,
)
from tauext_commission.connect import provenance_of, write_arm
from tauext_lab.evaluate.collisions import find_collisions
from tauext_lab.evaluate.comparison import evaluate
from tauext_lab.evaluate.config import EventsConfig
from tauext_lab.evaluate.events import EventMeasures, Labels
from unseen.arms import makers
from unseen.working import NAMES, Part, Working, current_arm, working

from tauext.bundle.bundle_file import load_bundle
from tauext.config import PAPER_CASES, AlarmConfig, TrainConfig
from tauext.data.dataset import Split, load_dataset, save_split
from tauext.data.free_motion import between
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording, save_recording
from tauext.errors import TrainingError
from tauext.fit.tail import promised_per_hour
from tauext.monitor.estimate import estimate_recording
from tauext.robot.model_case import chosen_case, estimated_model
from tauext.train.limits import LIMITS
from tauext.train.paper_limits import LimitMotion
from tauext.train.preparation import TrainingInput
from tauext.train.stage import train_on_recordings


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    ways = parser.add_subparsers(dest="way", required=True)
    arms = ("palletizer", "offset_wrist", "light_arm", "ur5", "panda")
    ways.add_parser("hour", parents=[arguments("", "models", "out", arms=arms, seed=0)], add_help=False)
    minutes = arguments("", "out", seed=0, workers=os.cpu_count() or 1)
    minutes.add_argument("datasets", type=Path, nargs="+")
    minutes.add_argument("--minutes", type=float, nargs="+", default=[1, 4, 8])
    minutes.add_argument("--splits", type=int, default=3)
    minutes.add_argument("--piece-s", type=float, default=60.0)
    ways.add_parser("minutes", parents=[minutes], add_help=False)
    options = parser.parse_args()
    if options.way == "hour":
        by_the_hour(options)
        return
    jobs = [
        (options.out, data, minutes, options.seed + k, options.piece_s)
        for k in range(options.splits)
        for minutes in options.minutes
        for data in options.datasets
    ]
    write_tables(options.out, minutes_table(in_parallel(options.workers, row_of, jobs)), name="minutes")


# --- Limits from an hour.


SETS = {"train": (2, 0, 0), "calib0": (6, 10, 0), "later": (6, 16, 0), "test": (6, 5000, 0), "hits": (3, 5100, 50)}
"""Stretches of ten minutes, number of the first, touches in each."""


def by_the_hour(options: argparse.Namespace) -> None:
    file, version = options.out / "promise.json", commit()
    done = json.loads(file.read_text()) if file.exists() else {}
    for name in options.arms:
        known = name in NAMES
        arm = working(name, options.seed) if known else current_arm(
            makers(options.models)[name], options.seed, (0.0, 0.0), True
        )  # fmt: skip
        made(arm, options.out / name, options.seed)
        done.setdefault(name, {})[version] = judged(options.out / name)
        save_json(done, file)
    lines = head(
        "arm | commit | false alarms, same programs | other programs | in [h] | promised in them | touches | hits "
        "| limits for sliding [N m]"
    )
    for name, versions in done.items():
        for version, one in versions.items():
            promised = f"{one['promised_per_hour'] * one['hours']:.1f}"
            touches, hits = f"{one['detected']} of {one['touches']}", f"{one['hits']:.1%}"
            false = one["false_later"], one["false"], f"{one['hours']:.2f}"
            lines.append(table_row(name, version, *false, promised, touches, hits, joined(one["limits"], ".2g")))
    write_tables(options.out, lines)


def made(arm: Working, folder: Path, seed: int) -> None:
    """Recordings and bundle of an arm, as far as they do not exist."""
    folder.mkdir(parents=True, exist_ok=True)
    robot = arm.robot
    if arm.robot_text:
        robot = folder / "in.xml"
        robot.write_text(arm.robot_text)
    write_arm(arm.facts, robot, folder)
    for label, (count, first, touches) in SETS.items():
        for k in range(count):
            path = folder / f"{label}-{first + k}.parquet"
            if path.exists():
                continue
            learns = label in ("train", "calib0", "later")
            warm_s = 600.0 * (k + {"calib0": 2, "later": 8}.get(label, 0)) if learns else 7200.0
            stretch = arm.stretch(seed if learns else seed + 1, first + k, Part("bare", 6.0), warm_s, touches)
            save_recording(replace(stretch, name=path.stem, provenance=provenance_of(arm.facts)), path)
    save_split(Split(tuple(one.name for one in sorted(folder.glob("train-*.parquet"))), (), ()), folder)
    trained(folder, folder / "bundle.tauext")


def judged(folder: Path) -> dict:
    """What limits by this version do."""
    path = folder / "bundle.tauext"
    bundle = load_bundle(path)

    def of(label: str) -> list[Callable[[], Recording]]:
        return [lambda path=path: load_recording(path) for path in sorted(folder.glob(f"{label}-*.parquet"))]

    loaders = [lambda load=load: replace(load(), contact=None, tau_ext=None) for load in of("calib0")]
    limits = LIMITS["promised"](bundle, LimitMotion("bundle", AlarmConfig(), 2, calibration=loaders))
    kept = folder / "estimates"
    bundles = {"trained": load_bundle(path), "promised": bundle}  # the first one sets the sizes of the hits
    later = evaluate({"promised": bundle}, of("later"), [], kept, 0, 2, keep_free_estimates=0).bundles[0].free_motion
    one = evaluate(bundles, of("test"), of("hits"), kept, 0, 2, keep_free_estimates=0, inject=True).bundles[1]
    shutil.rmtree(kept, ignore_errors=True)
    assert one.latched is not None and one.forces.added is not None
    curves = one.forces.added.curves
    of_links = [[curve for curve in curves if curve.place == place] for place in {curve.place for curve in curves}]
    return {
        "promised_per_hour": promised_per_hour(limits),
        "false_later": later.false_collisions,
        "false": one.free_motion.false_collisions,
        "hours": one.free_motion.hours,
        "detected": one.latched.latched,
        "touches": one.latched.collisions,
        "hits": float(np.mean([sum(c.latched for c in link) / sum(c.events for c in link) for link in of_links])),
        "limits": list(bundle.sliding_limit_nm),
        "hold_s": bundle.hold_s,
    }


# --- Limits from minutes.


def row_of(out: Path, data: Path, minutes: float, seed: int, piece_s: float) -> dict:
    """The row of one split, kept in OUT."""
    name = f"{data.parent.name}-{data.name}-{minutes:g}-{seed}.json"
    return checkpoint(out / name, lambda: one_split(data, minutes, seed, piece_s))


def one_split(folder: Path, minutes: float, seed: int, piece_s: float) -> dict:
    """Train on so many minutes and judge on the rest."""
    dataset = load_dataset(folder)
    free = [r for part in ("train", "validation", "test") for r in dataset.recordings(part) if not find_collisions(r)]
    name = folder.parent.name if folder.name == "urdf" else folder.name
    key = int(hashlib.sha256(name.encode()).hexdigest()[:8], 16)
    pieces, rest = drawn(free, 60 * minutes, piece_s, np.random.default_rng([seed, round(60 * minutes), key]))
    robot = dataset.robot_file(None)
    model = PAPER_CASES[chosen_case(None, robot)[0]]
    row = {"arm": name, "minutes": minutes, "split": seed}
    with tempfile.TemporaryDirectory() as scratch:
        path = Path(scratch) / "made.tauext"
        tree = estimated_model(robot, pieces[0].joints, model)
        try:
            train_on_recordings(TrainingInput(robot, model, pieces, [], model=tree), TrainConfig(recipe="prior"), path)
        except TrainingError as error:
            return row | {"refused": str(error)}
        bundle = load_bundle(path)
    limits = json.loads(bundle.provenance)["limits"]
    measured = EventMeasures(EventsConfig())
    for recording in [*rest, *dataset.recordings("collisions")]:
        labels = Labels(recording, EventsConfig(), bundle.near_stiction_rad_s)
        measured.add_estimates(labels, estimate_recording(bundle, recording, 1))
    events = measured.summary().all
    rate = limits["promise"]["supported_budget"]["rate_per_hour"] if "promise" in limits else None
    counts = {"false": events.false_alarms, "contacts": events.events, "detected": events.found}
    return row | counts | {
        "promised": None if rate is None else events.free_hours * rate, "delay_s": events.delay_median_s
    }  # fmt: skip


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


def minutes_table(rows: Sequence[dict]) -> list[str]:
    """Splits of one arm and length together, and all of a length."""
    lines = head("arm | minutes | splits | promised | false | ratio (least to most) | detected | delay, ms")
    used = [row for row in rows if row.get("promised")]
    for arm in [*dict.fromkeys(row["arm"] for row in used), "**all**"]:
        for minutes in sorted({row["minutes"] for row in used}):
            of = [row for row in used if row["minutes"] == minutes and arm in (row["arm"], "**all**")]
            if not of:
                continue
            promised, false, contacts, found = (
                sum(row[key] for row in of) for key in ("promised", "false", "contacts", "detected")
            )
            each = [row["false"] / row["promised"] for row in of]
            delay = quantiles_ms([row["delay_s"] for row in of if row["delay_s"] is not None], (0.5,))
            ratio = f"{false / promised:.2f} ({min(each):.2f} to {max(each):.2f})"
            detected = f"{found}/{contacts}" if contacts else ""
            lines.append(table_row(arm, f"{minutes:g}", len(of), f"{promised:.1f}", false, ratio, detected, delay))
    return lines


if __name__ == "__main__":
    main()
