"""Limits from an hour of calibration at the promise that it supports: false alarms in another hour, touches and hits.

    python benchmarks/arm_promise.py MODELS OUT [--arms palletizer offset_wrist ...] [--seed 0]

Arms of benchmarks/unseen at their work, without touches while they learn: twenty minutes of training (recipe prior), an
hour for the limits, a later hour of the same programs, an hour of others, and half an hour with 150 touches. Hits are
added to that last free hour in every link and direction (`tauext evaluate --inject`). Existing recordings and bundles
in OUT/ARM are used again, and OUT/promise.json keeps the results of each version of the code, so that two versions are
compared on the same files: run the script in both checkouts.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from common import arguments, commit, head, joined, save_json, table_row, trained, write_tables
from tauext_commission.connect import provenance_of, write_arm
from tauext_lab.evaluate.comparison import evaluate
from tauext_lab.evaluate.results import EvaluatedBundle
from unseen.arms import makers
from unseen.working import NAMES, Part, Working, current_arm, working

from tauext.bundle.bundle_file import load_bundle
from tauext.config import AlarmConfig
from tauext.data.dataset import Split, save_split
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording, save_recording
from tauext.fit.tail import is_kept, promised_per_hour
from tauext.train.limits import LIMITS
from tauext.train.paper_limits import LimitMotion

SETS = {"train": (2, 0, 0), "calib0": (6, 10, 0), "later": (6, 16, 0), "test": (6, 5000, 0), "hits": (3, 5100, 50)}
"""Stretches of ten minutes, number of the first, touches in each."""
WARM_S = 7200.0
"""Of stretches that do not follow a cold start."""


def main() -> None:
    parser = arguments(
        __doc__, "models", "out", arms=("palletizer", "offset_wrist", "light_arm", "ur5", "panda"), seed=0
    )
    options = parser.parse_args()
    file, version = options.out / "promise.json", commit()
    done = json.loads(file.read_text()) if file.exists() else {}
    for name in options.arms:
        folder = options.out / name
        arm = (
            working(name, options.seed)
            if name in NAMES
            else current_arm(makers(options.models)[name], options.seed, (0.0, 0.0), True)
        )
        made(arm, folder, options.seed)
        done.setdefault(name, {})[version] = judged(folder)
        save_json(done, file)
        print(name, done[name][version], flush=True)
    write_tables(options.out, tables(done))


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
            warm_s = 600.0 * (k + {"calib0": 2, "later": 8}.get(label, 0)) if learns else WARM_S
            stretch = arm.stretch(seed if learns else seed + 1, first + k, Part("bare", 6.0), warm_s, touches)
            save_recording(replace(stretch, name=path.stem, provenance=provenance_of(arm.facts)), path)
    save_split(Split(tuple(one.name for one in sorted(folder.glob("train-*.parquet"))), (), ()), folder)
    trained(folder, folder / "bundle.tauext")


def judged(folder: Path) -> dict:
    """What limits by this version do."""
    path = folder / "bundle.tauext"
    bundle, alarm = load_bundle(path), AlarmConfig()

    def of(label: str) -> list[Callable[[], Recording]]:
        return [lambda path=path: load_recording(path) for path in sorted(folder.glob(f"{label}-*.parquet"))]

    loaders = [lambda load=load: replace(load(), contact=None, tau_ext=None) for load in of("calib0")]
    limits = LIMITS["promised"](bundle, LimitMotion("bundle", alarm, 2, calibration=loaders))
    kept = folder / "estimates"
    bundles = {"trained": load_bundle(path), "promised": bundle}  # the first one sets the sizes of the hits
    later = evaluate({"promised": bundle}, of("later"), [], kept, 0, 2, keep_free_estimates=0).bundles[0].free_motion
    results = evaluate(bundles, of("test"), of("hits"), kept, 0, 2, keep_free_estimates=0, inject=True)
    shutil.rmtree(kept, ignore_errors=True)
    one = results.bundles[1]
    assert one.latched is not None
    return {
        "promised_per_hour": promised_per_hour(limits),
        "false_later": later.false_collisions,
        "hours_later": later.hours,
        "false": one.free_motion.false_collisions,
        "hours": one.free_motion.hours,
        "detected": one.latched.latched,
        "touches": one.latched.collisions,
        "hits": share_of_hits(one),
        "largest_seen": [tail["largest_nm"] for tail in limits["tails"].values()][::2],
        "limits": list(bundle.sliding_limit_nm),
        "hold_s": bundle.hold_s,
        "suspects": limits.get("suspects", 0),
    }


def share_of_hits(one: EvaluatedBundle) -> float:
    """Share of the added hits that raise an alarm, with equal weight for each link."""
    assert one.forces.added is not None
    places = sorted({curve.place for curve in one.forces.added.curves})
    shares = []
    for place in places:
        curves = [curve for curve in one.forces.added.curves if curve.place == place]
        shares.append(sum(curve.latched for curve in curves) / sum(curve.events for curve in curves))
    return float(np.mean(shares))


def tables(done: dict) -> list[str]:
    """Sums of each version over the arms, then a row an arm and version."""
    ways: tuple[list[dict], list[dict]] = ([], [])
    for versions in done.values():
        for way, one in zip(ways, versions.values(), strict=False):
            way.append(one)
    lines = head("version | arms | false alarms, same programs | others | promised in each | kept on arms | touches")
    for what, way in zip(("first", "second"), ways, strict=True):
        sums = [sum(one[key] for one in way) for key in ("false_later", "false", "detected", "touches")]
        kept = [
            sum(is_kept(one[false], one[hours], one["promised_per_hour"]) for one in way)
            for false, hours in (("false_later", "hours_later"), ("false", "hours"))
        ]
        promised = sum(one["promised_per_hour"] * one["hours"] for one in way)
        cells = (f"{promised:.0f}", "{}, {}".format(*kept), "{2} of {3}".format(*sums))
        lines.append(table_row(what, len(way), *sums[:2], *cells))
    lines += ["", *head(
        "arm | commit | suspects | false alarms, same programs | other programs | touches | hits "
        "| limits for sliding [N m] | largest error behind the hold time"
    )]  # fmt: skip
    for name, versions in done.items():
        for version, one in versions.items():
            lines.append(table_row(
                name, version, one["suspects"], one["false_later"], one["false"],
                f"{one['detected']} of {one['touches']}", f"{one['hits']:.1%}", joined(one["limits"], ".2g"),
                joined(one["largest_seen"], ".2g"),
            ))  # fmt: skip
    return lines


if __name__ == "__main__":
    main()
