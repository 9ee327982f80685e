"""A refit on a minute in which only some joints move: with a fleet's prior, and without it.

    python benchmarks/refit_like.py MODELS OUT [--type ur5] [--arms 10] [--new 6] [--type-seed 1]

OUT: as fleet_prior.py left it, whose new arms and prior are used: each arm was trained on ten minutes, partly
warm. It is refitted cold on a minute in which its first joints move and the others stand, on one in
which these stand, and on one in which all move; and evaluated on two minutes of other motion of all joints, later that
morning, without the drift tracker. OUT gets the recordings (used again if they exist) and TYPE-still.md,
the last section of docs/results/refit.
"""

from __future__ import annotations

import argparse
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from common import flags, head, table_row, type_arguments, write_page
from fleet_prior import NEW_SEED
from unseen.arms import Maker, makers
from unseen.recordings import Take, description, import_csv, simulate_takes

from tauext import _core
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.errors import TrainingError
from tauext.fit.fleet_prior import FleetPrior, load_fleet_prior
from tauext.train.refit import refit_recordings

MINUTE = 1.1
TAKES = (
    Take("first", "train", MINUTE, 0, 0),
    Take("last", "train", MINUTE, 0, 0),
    Take("all", "train", MINUTE, 0, 0),
    Take("later", "test", 2.1, 0, 70),
)
STANDS_AT = 0.6
"""Of a joint's range: gravity pulls there."""
WARM_UP_S = 3.0


@dataclass(frozen=True)
class Row:
    """One refit of one arm."""

    take: str
    like: bool
    error: np.ndarray  # (n,), by that of the old bundle
    limit: np.ndarray  # (n,), factor by which limits were raised
    moved: np.ndarray  # (n,) bool


def main() -> None:
    parser = type_arguments(__doc__, arms=10)
    parser.add_argument("--new", type=int, default=6, help="arms that are met, default: %(default)s")
    options = parser.parse_args()
    maker = replace(makers(options.models)[options.type], type_seed=options.type_seed)
    root = options.out / options.type
    like = load_fleet_prior(root / f"{options.type}-{options.arms}.prior.json")
    assert like.days is not None
    rows, refused = [], 0
    for k in range(options.new):
        data = make_cold(maker, NEW_SEED + k, root / f"new-{k}" / "cold")
        recordings = {take.name: load_recording(next(data.glob(f"{take.name}*.parquet"))) for take in TAKES}
        path = root / f"new-{k}" / "ten.tauext"
        for take in ("first", "last", "all"):
            for known in (None, like):
                try:
                    rows.append(judge(path, recordings[take], recordings["later"], known))
                except TrainingError as error:
                    print(f"new-{k} {take}: {error}")
                    refused += 1
    write_page(options.out / f"{options.type}-still.md", markdown(rows, maker, like, options, refused))


def make_cold(maker: Maker, seed: int, folder: Path) -> Path:
    """The dataset of the arm's morning; not what is there."""
    raw, data, n = folder / "csv", folder / "data", len(maker.joints)
    who = {"first": range(n // 2), "last": range(n // 2, n), "all": range(n), "later": range(n)}
    if not data.is_dir():
        files = []
        for take in TAKES:
            files += simulate_takes(with_standing(maker, who[take.name]), seed, raw, TAKES, only=(take,))
        import_csv(description(maker, seed, True, TAKES), files, raw / "arm.toml", data)
    return data


def with_standing(maker: Maker, moving: Collection[int]) -> Maker:
    """The same arm, of which only these joints are moved."""
    low, high = np.array(maker.low_rad), np.array(maker.high_rad)
    stands = np.array([joint not in moving for joint in range(len(low))])
    at = low + STANDS_AT * (high - low)
    return replace(maker, low_rad=tuple(np.where(stands, at, low)), high_rad=tuple(np.where(stands, at, high)))


def judge(path: Path, minute: Recording, later: Recording, like: FleetPrior | None) -> Row:
    """Error by that of the old bundle, and limits."""
    old = _core.Bundle.load(str(path))
    found = refit_recordings(old, [minute], threads=1, like=like)
    error = rms(found.bundle, later) / rms(old, later)
    limit = np.array([joint.limit_factor for joint in found.joints])
    moved = np.array([joint.moved_s >= 10 for joint in found.joints])
    return Row(minute.name.partition(".")[0], like is not None, error, limit, moved)


def rms(bundle: _core.Bundle, recording: Recording) -> np.ndarray:
    """Of tau_ext on motion that nothing touches, (n,)."""
    bundle.drift = _core.DriftSettings()
    said = _core.estimate(bundle, recording.t_ns, recording.q, recording.dq, recording.tau, 1, None)
    return np.sqrt(np.mean(said["tau_ext"][recording.time_s > WARM_UP_S] ** 2, axis=0))


def markdown(rows: list[Row], maker: Maker, like: FleetPrior, options: argparse.Namespace, refused: int) -> list[str]:
    """The table and the definitions of its columns."""
    assert like.days is not None
    given = flags(options, {"type": "ur5", "type_seed": 1, "arms": 10, "new": 6})
    spread = np.sqrt(np.diag(like.days.covariance))
    lines = [
        "## Refit while some joints stand still",
        "",
        f"Written by `python benchmarks/refit_like.py MODELS OUT{given}`.",
        "",
        f"{options.new} arms of the [fleet's type](../fleet-prior/README.md) ({options.type}), each trained on ten",
        "minutes, are refitted cold on a minute in which only some joints move. They are evaluated on two minutes of",
        "other motion of all joints, later that morning, without the drift tracker. *Error*: RMS of tau_ext divided",
        "by that before the refit, mean over joints and arms; 1 is no improvement. *Limits*: the factor by which they",
        f"were raised. In the fleet's recordings ({like.days.recordings} of {like.days.arms} arms), an arm's friction",
        f"differs by {100 * spread.min():.0f} to {100 * spread.max():.0f} % from one recording to the next.",
        "",
        *head(
            "in the minute | refit | error: moving joints | standing joints | limits: moving joints | standing joints"
        ),
    ]
    half = len(maker.joints) // 2
    words = {"first": f"the first {half} move", "last": f"the last {len(maker.joints) - half} move", "all": "all move"}
    for take, told in words.items():
        for known, way in ((False, "by itself"), (True, "`--like`")):
            chosen = [one for one in rows if one.take == take and one.like is known]
            cells = [mean_of(chosen, name, moved) for name in ("error", "limit") for moved in (True, False)]
            lines.append(table_row(told, way, *cells))
    return [*lines, *(["", f"{refused} refits were refused."] if refused else [])]


def mean_of(rows: list[Row], name: str, moved: bool) -> str:
    """Over joints that moved, or stood, of all these rows."""
    values = np.concatenate([getattr(row, name)[row.moved == moved] for row in rows] or [np.zeros(0)])
    return f"{values.mean():.2f}" if len(values) else ""


if __name__ == "__main__":
    main()
