"""What limits from minutes of data promise, and what they do: short trainings, each judged on all it did not see.

    python benchmarks/minutes_limits.py OUT DATASET [DATASET ...] [--minutes 1 4 8] [--splits 3] [--piece-s 60]

DATASET: folders of `tauext import`, as benchmarks/unseen_arms.py makes them, or anyone's. For each split, pieces of
PIECE_S are drawn at random from its recordings without contacts until they have the minutes; a bundle is trained on
them (recipe prior). It is judged on the rest of these recordings, at least GAP_S away from any piece, and on its
labelled contacts. OUT keeps every split, and one that is there is not run again; OUT/minutes_limits.md gets the table.
"""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from common import arguments, checkpoint, head, in_parallel, quantiles_ms, table_row, write_tables
from tauext_lab.evaluate.collisions import find_collisions
from tauext_lab.evaluate.config import EventsConfig
from tauext_lab.evaluate.events import EventMeasures, Labels

from tauext.bundle.bundle_file import load_bundle
from tauext.config import PAPER_CASES, TrainConfig
from tauext.data.dataset import load_dataset
from tauext.data.free_motion import between
from tauext.data.recording import Recording
from tauext.errors import TrainingError
from tauext.monitor.estimate import estimate_recording
from tauext.robot.model_case import chosen_case, estimated_model
from tauext.train.preparation import TrainingInput
from tauext.train.stage import train_on_recordings

GAP_S = 2.0
LEAST_S = 8.0
"""A shorter rest is not judged: the monitor takes seconds of it to warm up."""


def main() -> None:
    parser = arguments(__doc__, "out", seed=0, workers=os.cpu_count() or 1)
    parser.add_argument("datasets", type=Path, nargs="+")
    parser.add_argument("--minutes", type=float, nargs="+", default=[1, 4, 8])
    parser.add_argument("--splits", type=int, default=3)
    parser.add_argument("--piece-s", type=float, default=60.0)
    options = parser.parse_args()
    jobs = [
        (options.out, data, minutes, options.seed + k, options.piece_s)
        for k in range(options.splits)
        for minutes in options.minutes
        for data in options.datasets
    ]
    write_tables(options.out, table(in_parallel(options.workers, row_of, jobs)), name="minutes_limits")


def row_of(out: Path, data: Path, minutes: float, seed: int, piece_s: float) -> dict:
    """The row of one split, kept in OUT."""
    name = f"{data.parent.name}-{data.name}-{minutes:g}-{seed}.json"
    return checkpoint(out / name, lambda: one_split(data, minutes, seed, piece_s))


def one_split(folder: Path, minutes: float, seed: int, piece_s: float) -> dict:
    """Train on so many minutes and judge on the rest."""
    dataset = load_dataset(folder)
    free = [r for part in ("train", "validation", "test") for r in dataset.recordings(part) if not find_collisions(r)]
    touched = list(dataset.recordings("collisions"))
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
    for recording in [*rest, *touched]:
        labels = Labels(recording, EventsConfig(), bundle.near_stiction_rad_s)
        measured.add_estimates(labels, estimate_recording(bundle, recording, 1))
    events = measured.summary().all
    hours = events.free_hours
    return row | {
        "judged_min": 60 * hours,
        "promised": hours * limits["promise"]["supported_budget"]["rate_per_hour"] if "promise" in limits else None,
        "false": events.false_alarms,
        "contacts": events.events,
        "detected": events.found,
        "delay_s": events.delay_median_s,
        "factor": limits.get("minutes_factor"),
    }


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
        begins, ends = [0.0, *(s + piece_s + GAP_S for s in cuts)], [*(s - GAP_S for s in cuts), recording.duration_s]
        rest += [span(recording, a, b) for a, b in zip(begins, ends, strict=True) if b - a > LEAST_S]
    return pieces, rest


def span(recording: Recording, from_s: float, to_s: float) -> Recording:
    """What lies between two times, under a name that has them."""
    first, last = np.searchsorted(recording.time_s, [from_s, to_s])
    return between(recording, int(first), int(last), f"{recording.name}-{from_s:.0f}")


def table(rows: Sequence[dict]) -> list[str]:
    """Splits of one arm and length together, and all of a length."""
    lines = head(
        "arm | minutes | splits | false alarms promised | observed | ratio (least to most) | detected | delay, ms"
    )
    used = [row for row in rows if row.get("promised")]
    arms = [*dict.fromkeys(row["arm"] for row in used), "**all**"]
    for arm in arms:
        for minutes in sorted({row["minutes"] for row in used}):
            of = [row for row in used if row["minutes"] == minutes and arm in (row["arm"], "**all**")]
            if not of:
                continue
            promised, false = sum(row["promised"] for row in of), sum(row["false"] for row in of)
            each = [row["false"] / row["promised"] for row in of]
            contacts, found = sum(row["contacts"] for row in of), sum(row["detected"] for row in of)
            delays = [row["delay_s"] for row in of if row["delay_s"] is not None]
            delay = quantiles_ms(delays, (0.5,))
            ratio = f"{false / promised:.2f} ({min(each):.2f} to {max(each):.2f})"
            detected = f"{found}/{contacts}" if contacts else ""
            lines.append(table_row(arm, f"{minutes:g}", len(of), f"{promised:.1f}", false, ratio, detected, delay))
    return lines


if __name__ == "__main__":
    main()
