"""A new arm with one minute of its own: with a fleet's prior, without it, and with ten minutes of its own.

    python packages/fleet/benchmarks/fleet_prior.py MODELS OUT [--type ur5] [--arms 10] [--minutes 6] [--new 6]

Simulated arms of one type (unseen.arms): links, gears and drives they share; friction of each joint (0.7 to 1.3 of
the type's), tool, torque constants (8 % about those of the data sheet) and ripple's size and phase are each arm's own.
MODELS: folder of the arms' URDFs, as of unseen_arms.py. OUT gets recordings, bundles and TYPE.md; existing files are
used again.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import collisions_begin, estimates, head, runs, table_row, tauext, trained, type_arguments, write_tables
from unseen.arms import Maker, makers
from unseen.recordings import STRONG, Take, make_dataset, nearest, nm_per_given, truth_of

from tauext import _core
from tauext.data.dataset import load_split
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording

FLEET_TAKES = (Take("work-1", "train", 3), Take("work-2", "train", 3, 0, 600))
NEW_TAKES = (
    Take("own-1", "train", 1, 0, 120),
    Take("own-2", "train", 4.5, 0, 180),
    Take("own-3", "train", 4.5, 0, 600),
    Take("free-1", "test", 4, 0, 60),
    Take("contacts-1", "collisions", 4, 25, 360),
    Take("contacts-2", "collisions", 4, 25, 900),
)
"""The first minute of its own is all that a prior gets; the test begins at another time of the day."""
NEW_SEED = 100
WAYS = {
    "one": ("1 min, alone", ("--minutes", "1")),
    "like": ("1 min, fleet prior", ("--minutes", "1", "--like")),
    "ten": ("10 min, alone", ()),
}
WARM_UP_S, AFTER_S = 3.0, 0.5
BEFORE_S, AFTER_CONTACT_S = 0.2, 3.0


@dataclass
class Outcome:
    """One bundle of one new arm."""

    error_nm: np.ndarray
    """(n,), of true torque, on free motion."""
    limit_nm: np.ndarray
    """(n,), the mean of what was in force there."""
    found: int = 0
    found_strong: int = 0
    false: int = 0
    hours: float = 0.0


def main() -> None:
    parser = type_arguments(__doc__, arms=10)
    parser.add_argument("--minutes", type=float, default=6, help="of each arm of the fleet, default: %(default)s")
    parser.add_argument("--new", type=int, default=6, help="arms that are met, default: %(default)s")
    options = parser.parse_args()
    maker = replace(makers(options.models)[options.type], type_seed=options.type_seed)
    root = options.out / options.type
    takes = [replace(take, minutes=options.minutes / len(FLEET_TAKES)) for take in FLEET_TAKES]
    fleet = [make_dataset(maker, k, root / f"arm-{k:02d}", takes) for k in range(options.arms)]
    prior = root / f"{options.type}-{options.arms}.prior.json"
    if not prior.exists():
        tauext("fleet", "prior", *fleet, "--out", prior)
    rows = []
    for k in range(options.new):
        folder = root / f"new-{k}"
        data = make_dataset(maker, NEW_SEED + k, folder, NEW_TAKES)
        files = {"one": "one", "like": f"like-{prior.name.partition('.')[0]}", "ten": "ten"}
        bundles = {
            way: trained(
                data, folder / f"{files[way]}.tauext", "--threads", 1, *how, *([prior] if way == "like" else [])
            )
            for way, (_, how) in WAYS.items()
        }
        rows.append(judge(maker, NEW_SEED + k, folder, data, bundles))
    write_tables(options.out, table(rows), name=options.type)


def judge(maker: Maker, seed: int, folder: Path, data: Path, paths: dict[str, Path]) -> dict:
    """Errors on free motion, contacts that were found and false collisions, of each bundle on the same recordings."""
    split = load_split(data)
    bundles = {way: _core.Bundle.load(str(path)) for way, path in paths.items()}
    true = nm_per_given(maker, seed)
    scale = {way: true / np.array(bundle.observer.nm_per_unit or 1.0) for way, bundle in bundles.items()}
    tests = [load_recording(data / name) for name in (*split.test, *split.collisions)]
    outcomes = {way: of_free(bundle, tests, scale[way]) for way, bundle in bundles.items()}
    strong = every = 0
    for name in split.collisions:
        recording = load_recording(data / name)
        files = {take.name: folder / "csv" / f"{take.name}.truth.json" for take in NEW_TAKES}
        truths = {take: json.loads(path.read_text()) for take, path in files.items()}
        said = {way: estimates(bundle, recording)["held_alarm"] for way, bundle in bundles.items()}
        start_s, labels = 1e-9 * float(recording.t_ns[0]), contacts(recording)
        for begin, end in labels:
            truth = nearest(truth_of(recording.name, truths), start_s + float(recording.time_s[begin]))
            is_strong = bool(np.max(np.array(truth["peak_nm"]) / outcomes["ten"].error_nm) >= STRONG)
            every, strong = every + 1, strong + is_strong
            last = end + round(AFTER_S * recording.rate_hz)
            for way, held in said.items():
                hit = len(collisions_begin(held[begin:last], recording.t_ns[begin:last])) > 0
                outcomes[way].found += hit
                outcomes[way].found_strong += hit and is_strong
    return {"every": every, "strong": strong, "outcomes": outcomes}


def of_free(bundle: _core.Bundle, recordings: Sequence[Recording], scale: np.ndarray) -> Outcome:
    """Error, limits and false collisions where nothing touches."""
    errors, limits = [], []
    outcome = Outcome(np.zeros(bundle.joints), np.zeros(bundle.joints))
    for recording in recordings:
        said = estimates(bundle, recording)
        free = free_of(recording)
        errors.append(scale * said["tau_ext"][free])
        level = np.where(said["near_stiction"], bundle.near_stiction_limit_nm, bundle.sliding_limit_nm)
        limits.append(scale * (level * said["limit_scale"] + said["doubt"])[free])
        outcome.false += len(collisions_begin(said["held_alarm"][free], recording.t_ns[free]))
        outcome.hours += float(free.sum()) / recording.rate_hz / 3600
    outcome.error_nm = np.sqrt(np.mean(np.concatenate(errors) ** 2, axis=0))
    outcome.limit_nm = np.mean(np.concatenate(limits), axis=0)
    return outcome


def free_of(recording: Recording) -> np.ndarray:
    """Where nothing touches, (samples,) bool: not from BEFORE_S before a label until AFTER_CONTACT_S behind it."""
    free = recording.time_s > WARM_UP_S
    for begin, end in contacts(recording):
        first, last = (round(s * recording.rate_hz) for s in (BEFORE_S, AFTER_CONTACT_S))
        free[max(0, begin - first) : end + last] = False
    return free


def contacts(recording: Recording) -> list[tuple[int, int]]:
    """First and last sample of each label."""
    return [] if recording.contact is None else runs(recording.contact == 1)


def table(rows: Sequence[dict]) -> list[str]:
    """A row a new arm and way, and their medians."""
    lines = head("new arm | trained on | error | limit | detected | of strong | false (minutes)")
    for k, arm in enumerate(rows):
        for way, (words, _) in WAYS.items():
            one = arm["outcomes"][way]
            ratios = [f"{ratio(arm, way, name):.2f}" for name in ("error_nm", "limit_nm")]
            found = f"{one.found}/{arm['every']}", f"{one.found_strong}/{arm['strong']}"
            lines.append(table_row(k + 1, words, *ratios, *found, f"{one.false} ({60 * one.hours:.0f})"))
    for way, (words, _) in WAYS.items():
        error, limit = (np.median([ratio(arm, way, name) for arm in rows]) for name in ("error_nm", "limit_nm"))
        found = np.median([arm["outcomes"][way].found / arm["every"] for arm in rows])
        strong = np.median([arm["outcomes"][way].found_strong / max(arm["strong"], 1) for arm in rows])
        false = sum(arm["outcomes"][way].false for arm in rows)
        minutes = 60 * sum(arm["outcomes"][way].hours for arm in rows)
        cells = f"{error:.2f}", f"{limit:.2f}", f"{found:.0%}", f"{strong:.0%}", f"{false} ({minutes:.0f}), sum"
        lines.append(table_row("**median**", words, *cells))
    return lines


def ratio(arm: dict, way: str, name: str) -> float:
    """By that with ten minutes, the mean over joints."""
    return float(np.mean(getattr(arm["outcomes"][way], name) / getattr(arm["outcomes"]["ten"], name)))


if __name__ == "__main__":
    main()
