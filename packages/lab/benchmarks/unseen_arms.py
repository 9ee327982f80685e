"""The whole chain on simulated arms as an integrator meets them: motor currents, a wrong URDF or none, contacts.

    python packages/lab/benchmarks/unseen_arms.py MODELS OUT [--fresh] [--arms ur5 panda ...] [--seed 0]

Without --fresh the arms are those that the method may be fixed on: ur5, panda, kinova and seven_axis. --fresh adds
palletizer, offset_wrist and light_arm. Run them once, after the method is final; their numbers have a section of their
own. --arms selects any of the seven instead.

MODELS: folder of ur5_robot.urdf, panda.urdf and kinova.urdf. OUT/ARM gets csv/ with the recordings and the truth, the
datasets urdf/ and none/, bundles and results; existing recordings, datasets and bundles are used again.
OUT/tables.md gets the tables.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))

from common import arguments, head, joined, table_row, tauext, trained, write_tables
from unseen.arms import Maker, fresh_makers, makers
from unseen.recordings import STRONG, TAKES, make_dataset, nearest, nm_per_given, truth_of

from tauext import _core
from tauext.data.dataset import load_split
from tauext.data.recording_file import load_recording

MODELS = {"urdf": True, "none": False}
AFTER_CONTACT_S = 3.0
GROUPS = {False: "Arms used for development", True: "Arms run once, afterwards"}
"""By `Maker.fresh`: the heading."""


def main() -> None:
    parser = arguments(__doc__, "models", "out", seed=0, workers=os.cpu_count() or 1)
    parser.add_argument("--arms", nargs="+", help="of all seven, instead of those that --fresh decides on")
    parser.add_argument("--fresh", action="store_true", help="also the arms that are run once, when all is fixed")
    parser.add_argument("--recipes", nargs="+", default=["prior", "friction"])
    options = parser.parse_args()
    known = makers(options.models) | fresh_makers()
    arms = options.arms or [name for name, maker in known.items() if options.fresh or not maker.fresh]
    for name in arms:
        if name not in known:
            parser.error(f"--arms {name}: must be of {', '.join(known)}")
        if not known[name].model.is_file():
            parser.error(f"{known[name].model}: there is no such file; MODELS is the folder of the arms' URDFs")
    outcomes = []
    for name in arms:
        folder = options.out / name
        for model in MODELS:
            given = MODELS[model]
            make_dataset(known[name], options.seed, folder, TAKES, options.workers, name=model, model=given)
            judge(folder, model, options.recipes)
            outcomes += read_outcomes(known[name], options.seed, model, folder)
    write_tables(options.out, tables(outcomes))


def judge(folder: Path, model: str, recipes: list[str]) -> None:
    """Check, train and evaluate as a user would, each command's words beside its results."""
    data, how = folder / model, [] if MODELS[model] else ["--case", "none"]
    tauext("check", "--data", data, printed=folder / f"check-{model}.txt", accept=(0, 1))
    bundles = [folder / f"{model}-{recipe}.tauext" for recipe in recipes]
    for recipe, bundle in zip(recipes, bundles, strict=True):
        trained(data, bundle, *how, recipe=recipe)
    results, printed = folder / f"results-{model}", folder / f"evaluate-{model}.txt"
    tauext("evaluate", "--data", data, "--out", results, "--bundles", *bundles, printed=printed)


# --- Contacts found by true strength, false alarms, delays and held-out errors.


@dataclass(frozen=True)
class Outcome:
    """One bundle on one arm's test."""

    arm: str
    fresh: bool
    model: str
    recipe: str
    rmse_nm: np.ndarray
    rmse_share: np.ndarray
    """Of the RMS of the joint's torque."""
    limit_nm: np.ndarray
    found: np.ndarray
    strength: np.ndarray
    """Largest true peak torque over the error, a contact."""
    kinds: np.ndarray
    false_after_contact: int
    """False alarms that begin within AFTER_CONTACT_S of a label's end."""
    false_free: int
    """All others."""
    free_hours: float
    delays: dict[str, float | None]


def read_outcomes(maker: Maker, seed: int, model: str, folder: Path) -> list[Outcome]:
    """The bundles of FOLDER/results-MODEL, judged by the truth beside the CSV files."""
    results = json.loads((folder / f"results-{model}" / "results.json").read_text())
    files = {take.name: folder / "csv" / f"{take.name}.truth.json" for take in TAKES if take.contacts}
    truths = {name: json.loads(path.read_text()) for name, path in files.items()}
    split = load_split(folder / model)
    tests = [load_recording(folder / model / name) for name in split.test]
    touched = [load_recording(folder / model / name) for name in split.collisions]
    begins_s = {recording.name: 1e-9 * float(recording.t_ns[0]) for recording in touched}
    true = nm_per_given(maker, seed, model == "urdf")
    torque = true * np.sqrt(np.mean(np.concatenate([test.tau for test in tests]) ** 2, axis=0))
    outcomes = []
    for entry in results["bundles"]:
        bundle = _core.Bundle.load(str(folder / entry["bundle"]))
        nm = true / np.array(bundle.observer.nm_per_unit or 1.0)
        rmse, events = nm * entry["free_motion"]["l2_nm"], entry["events"]
        since_s = [alarm["since_contact_s"] for alarm in events["false_alarms_at"]]
        after = sum(seconds is not None and seconds <= AFTER_CONTACT_S for seconds in since_s)
        truth = [
            nearest(truth_of(verdict["recording"], truths), verdict["start_s"] + begins_s[verdict["recording"]])
            for verdict in events["verdicts"]
        ]
        outcomes.append(
            Outcome(
                arm=maker.name,
                fresh=maker.fresh,
                model=model,
                recipe=entry["recipe"],
                rmse_nm=rmse,
                rmse_share=rmse / torque,
                limit_nm=nm * entry["limits"]["sliding_nm"],
                found=np.array([verdict["found"] for verdict in events["verdicts"]], dtype=bool),
                strength=np.array([np.max(np.array(one["peak_nm"]) / rmse) for one in truth]),
                kinds=np.array([one["kind"] for one in truth]),
                false_after_contact=after,
                false_free=events["all"]["false_alarms"] - after,
                free_hours=events["all"]["free_hours"],
                delays={key: events["all"][key] for key in events["all"] if key.startswith("delay")},
            )
        )
    return outcomes


def tables(outcomes: Sequence[Outcome]) -> list[str]:
    """Arms that the method was fixed on and fresh ones are never in one table."""
    lines: list[str] = []
    for fresh, heading in GROUPS.items():
        if group := [outcome for outcome in outcomes if outcome.fresh == fresh]:
            lines += [f"## {heading}", "", *_alarms(group), "", *_kinds(group), "", *_errors(group), ""]
    return lines


def _alarms(outcomes: Sequence[Outcome]) -> list[str]:
    lines = head(
        "arm | model | recipe | found | of strong | false alarms an hour | in free motion | after a contact "
        "| delay from label, ms: median, 95 % | from onset, ms | limit over error, median"
    )
    for c in outcomes:
        delays = [
            f"{_ms(c, f'{since}_median_s')}, {_ms(c, f'{since}_p95_s')}" for since in ("delay", "delay_from_onset")
        ]
        over = f"{np.median(c.limit_nm / c.rmse_nm):.0f}"
        lines.append(table_row(c.arm, c.model, c.recipe, _alarm_cells([c]), *delays, over))
    for model, recipe in dict.fromkeys((c.model, c.recipe) for c in outcomes):
        chosen = [c for c in outcomes if (c.model, c.recipe) == (model, recipe)]
        lines.append(f"| **all** | {model} | {recipe} | {_alarm_cells(chosen)} | | | |")
    return lines


def _alarm_cells(outcomes: Sequence[Outcome]) -> str:
    """Sums over the outcomes: found, of strong, false alarms an hour, in free motion and after a contact."""
    found = np.concatenate([c.found for c in outcomes])
    strong = np.concatenate([c.strength > STRONG for c in outcomes])
    free, after = sum(c.false_free for c in outcomes), sum(c.false_after_contact for c in outcomes)
    rate = (free + after) / sum(c.free_hours for c in outcomes)
    return f"{found.sum()}/{len(found)} | {found[strong].sum()}/{strong.sum()} | {rate:.1f} | {free} | {after}"


def _kinds(outcomes: Sequence[Outcome]) -> list[str]:
    lines = head("arm | model | recipe | impacts | pushes | holds")
    for c in outcomes:
        by_kind = [f"{c.found[c.kinds == kind].sum()}/{(c.kinds == kind).sum()}" for kind in ("impact", "push", "hold")]
        lines.append(table_row(c.arm, c.model, c.recipe, *by_kind))
    return lines


def _errors(outcomes: Sequence[Outcome]) -> list[str]:
    lines = head("arm | model | recipe | held-out RMS error, Nm (% of the torque's RMS) | usual sliding limits, Nm")
    for c in outcomes:
        errors = " · ".join(f"{e:.2f} ({s:.0%})" for e, s in zip(c.rmse_nm, c.rmse_share, strict=True))
        lines.append(table_row(c.arm, c.model, c.recipe, errors, joined(c.limit_nm, ".1f")))
    return lines


def _ms(outcome: Outcome, key: str) -> str:
    return "–" if outcome.delays[key] is None else f"{1e3 * outcome.delays[key]:.0f}"


if __name__ == "__main__":
    main()
