"""The trial's README.md: contacts found by true strength, false alarms, delays and held-out errors."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import head, joined, table_row

from tauext import _core
from tauext.data.dataset import load_split
from tauext.data.recording_file import load_recording
from unseen.arms import Maker, arm_of
from unseen.recordings import TAKES, told_constants

STRONG = 3.0
"""A contact is strong if its torque at some joint is this many times the held-out error."""
AFTER_CONTACT_S = 3.0
GROUPS = {
    False: (
        "Arms used for development",
        ("These results guided the method; they do not predict the results of another arm.",),
    ),
    True: (
        "Arms run once, afterwards",
        (
            "Other kinematics, sample rates and random draws. Stamps jitter by a tenth of the period. One arm's log",
            "lacks 3 % of its samples. A fifth of the moves end in an abrupt stop within 30 to 80 ms.",
        ),
    ),
}
"""By `Maker.fresh`: the heading and its introduction."""


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
    truths = {
        take.name: json.loads((folder / "csv" / f"{take.name}.truth.json").read_text())
        for take in TAKES
        if take.contacts
    }
    split = load_split(folder / model)
    tests = [load_recording(folder / model / name) for name in split.test]
    touched = [load_recording(folder / model / name) for name in split.collisions]
    begins_s = {recording.name: 1e-9 * float(recording.t_ns[0]) for recording in touched}
    given = told_constants(maker, seed, model == "urdf")
    true = arm_of(maker, seed).nm_per_ampere / (1.0 if given == "unknown" else given)
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


def truth_of(recording: str, truths: Mapping[str, Sequence[dict]]) -> Sequence[dict]:
    """The contacts of the take that a recording is of: the import cuts long ones, TAKE-00, TAKE-01 ..."""
    return truths[recording if recording in truths else recording.rpartition("-")[0]]


def nearest(truth: Sequence[dict], label_s: float) -> dict:
    """The contact that a label at this time of its take stands for."""
    return min(truth, key=lambda one: abs(one["label_s"][0] - label_s))


def markdown(outcomes: Sequence[Outcome], command: str) -> str:
    """The text of README.md: arms that the method was fixed on and fresh ones are never in one table."""
    lines = [
        "# Unseen arms",
        "",
        f"Written by `{command}`.",
        "",
        "Simulated arms with the flaws of real ones: a wrong model (masses off by 20 %, centres of mass by 2 cm,",
        "missing tool and rotor inertias), friction that depends on history, load and temperature, motor currents",
        "with wrong or unknown torque constants, jittering stamps, and labels 30 ms early or late. Each arm has",
        "twelve minutes of training motion, ten minutes of free test motion, and ten with 50 labelled contacts.",
        "",
        "- `urdf`: with the maker's model; `none`: without a model. Limits are those that `train` chooses by default.",
        f"- *Strong*: the contact torque at some joint is {STRONG:g} times the held-out error or more. Torques are the",
        "  true ones, whatever constants the method uses.",
        f"- *After a contact*: false alarms within {AFTER_CONTACT_S:g} s after a label's end, counted apart from the",
        "  others in free motion.",
    ]
    for fresh, (heading, words) in GROUPS.items():
        group = [outcome for outcome in outcomes if outcome.fresh == fresh]
        if group:
            lines += ["", f"## {heading}", "", *words, "", *_alarms(group), "", *_kinds(group), "", *_errors(group)]
    return "\n".join([*lines, ""])


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
    lines = ["Found by kind:", "", *head("arm | model | recipe | impacts | pushes | holds")]
    for c in outcomes:
        by_kind = [f"{c.found[c.kinds == kind].sum()}/{(c.kinds == kind).sum()}" for kind in ("impact", "push", "hold")]
        lines.append(table_row(c.arm, c.model, c.recipe, *by_kind))
    return lines


def _errors(outcomes: Sequence[Outcome]) -> list[str]:
    lines = ["Held-out RMS error, Nm (% of the torque's RMS), joint by joint, and the usual sliding limits, Nm:", ""]
    lines += head("arm | model | recipe | error | limits")
    for c in outcomes:
        errors = " · ".join(f"{e:.2f} ({s:.0%})" for e, s in zip(c.rmse_nm, c.rmse_share, strict=True))
        lines.append(table_row(c.arm, c.model, c.recipe, errors, joined(c.limit_nm, ".1f")))
    return lines


def _ms(outcome: Outcome, key: str) -> str:
    return "–" if outcome.delays[key] is None else f"{1e3 * outcome.delays[key]:.0f}"
