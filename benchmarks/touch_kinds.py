"""What kind of touch: impacts, pushes, clamps and loads with physical causes on arms that nothing was fixed on.

    python benchmarks/touch_kinds.py MODELS OUT [--arms panda kinova ...] [--touches 25] [--seed 12]

Each arm is trained on nine minutes of free motion and then touched, --touches times by each kind. MODELS: folder of
ur5_robot.urdf, panda.urdf and kinova.urdf. OUT/kinds.md and OUT/kinds.json get the tables. What is there is used again.
The rules were fixed with seeds 0 to 3 and 11.
"""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import arguments, head, in_parallel, table_row, trained, write_tables
from unseen.arms import Maker, fresh_makers, makers
from unseen.loads import TRAIN
from unseen.recordings import description, import_csv, simulate_takes
from unseen.touches import KINDS, name_of, write_touch

from tauext import Monitor, Touch, load_bundle
from tauext.data.recording_file import load_recording

ARMS = ("panda", "kinova", "seven_axis", "light_arm", "offset_wrist", "palletizer")


def main() -> None:
    parser = arguments(__doc__, "models", "out", arms=ARMS, seed=12)
    parser.add_argument("--touches", type=int, default=25, help="of each kind on each arm")
    options = parser.parse_args()
    known = makers(options.models) | fresh_makers()
    outcomes: list[Watched] = []
    for arm in options.arms:
        folder = options.out / arm
        simulate_all(known[arm], folder, options.seed, options.touches)
        data = dataset(known[arm], folder, options.seed, options.touches)
        bundle = trained(data, folder / "arm.tauext")
        jobs = [(arm, bundle, data, folder / "csv", name) for name in names(options.touches)]
        outcomes += in_parallel(os.cpu_count(), watch, jobs)
    facts = summary(outcomes)
    write_tables(options.out, tables(facts), facts, "kinds")


def names(touches: int) -> list[str]:
    return [name_of(kind, number) for kind in KINDS for number in range(touches)]


def simulate_all(maker: Maker, folder: Path, seed: int, touches: int) -> None:
    """Takes to train on and touches; not those that exist."""
    simulate_takes(maker, seed, folder / "csv", TRAIN, os.cpu_count())
    jobs = [(maker, seed, kind, number, folder / "csv") for kind in KINDS for number in range(touches)]
    in_parallel(os.cpu_count(), write_touch, jobs)


def dataset(maker: Maker, folder: Path, seed: int, touches: int) -> Path:
    """Imported as an integrator would, with constants that are off by up to 10 % or unknown."""
    out = folder / "data"
    if out.is_dir():
        return out
    text = description(maker, seed, model=True, takes=TRAIN)
    files = [f"{name}.csv" for name in names(touches)]
    text = re.sub(r"\ncollisions = .*", f"\ncollisions = {json.dumps(files)}", text)
    sources = [folder / "csv" / name for name in [f"{take.name}.csv" for take in TRAIN] + files]
    import_csv(text, sources, folder / "csv" / "arm.toml", out)
    return out


# --- What the monitor reports of a touch, and tables.


DEADLINE_S = 0.2
"""Since the alarm."""
EARLY_S = 0.005
"""Stamps jitter: an alarm so long before the touch is one of it."""


@dataclass(frozen=True)
class Watched:
    """One touch; the kinds are none where it raised no alarm."""

    arm: str
    name: str
    kind: str
    """That it is."""
    way: str
    rise_s: float
    """Of a push."""
    delay_s: float
    """From the touch to its alarm; NaN: there was none."""
    told: str = "none"
    """DEADLINE_S after the alarm."""
    told_s: float = np.nan
    """Since when it has been that."""
    last: str = "none"
    """At the end of the recording, a second after the touch."""
    ever: tuple[str, ...] = ()


def watch(arm: str, bundle: Path, data: Path, raw: Path, name: str) -> Watched:
    truth = json.loads((raw / f"{name}.truth.json").read_text())
    recording = load_recording(data / f"{name}.parquet")
    said = Monitor(load_bundle(bundle)).run(recording.t_ns, recording.q, recording.dq, recording.tau)
    facts = (arm, name, truth["kind"], truth["way"], truth.get("rise_s", 0.0))
    time_s = recording.time_s
    over = np.flatnonzero((said["held_alarm"] > 0) & (time_s >= truth["start_s"] - EARLY_S))
    if not len(over):
        return Watched(*facts, np.nan)
    since_s = time_s[over[0] :] - time_s[over[0]]
    kinds = np.array(said["touch"][over[0] :])
    known = kinds[since_s <= DEADLINE_S]
    other = np.flatnonzero(known != known[-1])
    return Watched(
        *facts,
        float(time_s[over[0]] - truth["start_s"]),
        Touch(int(known[-1])).name,
        float(since_s[other[-1] + 1]) if len(other) else 0.0,
        Touch(int(kinds[-1])).name,
        tuple(Touch(int(kind)).name for kind in np.unique(kinds)),
    )


# --- Tables of the trial.


SLOW_S = 0.3
"""A push that rises for longer still rises at the deadline."""


def row(of: Sequence[Watched]) -> dict:
    """Figures of the touches among these that raised an alarm."""
    raised = [w for w in of if np.isfinite(w.delay_s)]
    right = [w for w in raised if w.told == w.kind]
    return {
        "touches": len(of),
        "alarms": len(raised),
        "told": dict(Counter(w.told for w in raised)),
        "last": dict(Counter(w.last for w in raised)),
        "recall": len(right) / len(raised) if raised else None,
        "ever_push": sum("push" in w.ever for w in raised),
        "told_s": np.quantile([w.told_s for w in right], [0.5, 0.95]).tolist() if right else None,
    }


def summary(outcomes: Sequence[Watched]) -> dict:
    """By kind, way and arm."""
    of = {kind: [w for w in outcomes if w.kind == kind] for kind in KINDS}
    return {
        "kinds": {kind: row(touches) for kind, touches in of.items()},
        "ways": {
            f"{kind}: {way}": row([w for w in touches if w.way == way])
            for kind, touches in of.items()
            for way in dict.fromkeys(w.way for w in touches)
        },
        "arms": {
            arm: {kind: row([w for w in touches if w.arm == arm]) for kind, touches in of.items()}
            for arm in dict.fromkeys(w.arm for w in outcomes)
        },
        "pushes": {
            f"rise up to {SLOW_S:g} s": row([w for w in of["push"] if w.rise_s <= SLOW_S]),
            f"rise over {SLOW_S:g} s": row([w for w in of["push"] if w.rise_s > SLOW_S]),
        },
        "unknown": float(np.mean([w.told == "unknown" for w in outcomes if np.isfinite(w.delay_s)])),
    }


COLUMNS = (*KINDS, "unknown")


def confusion(name: str, facts: dict[str, dict]) -> list[str]:
    columns = " | ".join(COLUMNS)
    lines = head(f"{name} | touches | alarms | {columns} | recall | reported after, ms: median, 95 % | at the end")
    for what, f in facts.items():
        counts = [f["told"].get(kind, 0) for kind in COLUMNS]
        when = "–" if f["told_s"] is None else ", ".join(f"{1e3 * s:.0f}" for s in f["told_s"])
        recall = "–" if f["recall"] is None else f"{f['recall']:.0%}"
        last = ", ".join(f"{n} {kind}" for kind, n in sorted(f["last"].items(), key=lambda item: -item[1]))
        lines.append(table_row(what, f["touches"], f["alarms"], *counts, recall, when, last))
    return [*lines, ""]


def tables(facts: dict) -> list[str]:
    """By kind, cause, rise of a push, and arm."""
    clamps = facts["kinds"]["clamp"]
    lines = [
        *confusion("true kind", facts["kinds"]),
        f"Unknown: {facts['unknown']:.1%} of the touches with an alarm. Clamps that were reported as a push at any "
        f"time: {clamps['ever_push']} of {clamps['alarms']}.",
        "",
        *confusion("cause", facts["ways"]),
        *confusion("pushes", facts["pushes"]),
        *head(" | ".join(["arm", *KINDS])),
    ]
    for arm, kinds in facts["arms"].items():
        lines.append(table_row(arm, *(f"{f['told'].get(kind, 0)}/{f['alarms']}" for kind, f in kinds.items())))
    return lines


if __name__ == "__main__":
    main()
