"""Tables of the paper's page, made from results.json of two scales and from seeds.json."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from tauext_lab.report import paper

DOCS = Path(__file__).parent
RECIPES = ("paper", "dense")
ORDER = list(paper.L1_NM)


def load(name: str) -> Any:
    """Content of results/NAME.json."""
    return json.loads((DOCS / "results" / f"{name}.json").read_text())


def table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """The lines of a Markdown table."""
    lines = ["| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
    return lines + ["| " + " | ".join(map(str, row)) + " |" for row in rows]


def joined(values: Iterable[float], form: str = ".3f") -> str:
    return "/".join(format(value, form) for value in values)


def by_recipe(results: dict[str, Any]) -> list[dict[str, Any]]:
    """Bundles of the paper's five cases: first those of recipe paper, each in the paper's order; others last."""
    recipes = [*RECIPES, "prior"]
    return sorted(results["bundles"], key=lambda b: (recipes.index(b["recipe"]), ORDER.index(b["case"])))


def table_1(results: dict[str, Any]) -> list[str]:
    """L1, L2 and MSE of every case beside the paper's."""
    columns = ["model", "recipe"]
    columns += [f"{what}: {whose}" for what in ("L1, N m", "L2, N m", "MSE, (N m)²") for whose in ("tauext", "paper")]
    rows = []
    for bundle in by_recipe(results):
        free, case = bundle["free_motion"], bundle["case"]
        rows.append(
            (
                case,
                bundle["recipe"],
                joined(free["l1_nm"]),
                joined(paper.L1_NM[case]),
                joined(free["l2_nm"]),
                joined(paper.L2_NM[case]),
                joined(free["mse_nm2"]),
                joined(paper.MSE_NM2[case]),
            )
        )
    return table(columns, rows)


def delays(results: dict[str, Any], joint: int | None = None) -> list[str]:
    """Delays against the sensor at the same threshold: of the ten collisions, and of all that exceed it in both.

    joint: this joint's own; without it, those of the first joint that exceeds its threshold.
    """
    columns = ["model, recipe paper", "each of the ten, ms", "median of the ten, ms"]
    columns += ["all: both over the threshold", "median, ms", "5 % to 95 %, ms", "largest, ms"]
    rows = []
    for bundle in by_recipe({"bundles": [one for one in results["bundles"] if one["recipe"] == "paper"]}):
        delay_ms = {verdict["id"]: delay_of(verdict, joint) for verdict in bundle["collisions"]}
        known = [delay for delay in delay_ms.values() if delay is not None]
        ten = [delay_ms[name] for name in results["ten_collisions"] if delay_ms[name] is not None]
        row = [bundle["case"], ", ".join(whole(d) for d in ten).replace(" ", "\u00a0")]
        row += [f"{np.median(ten):.1f}" if ten else ""]
        if known:
            low, middle, high = np.percentile(known, [5, 50, 95])
            row += [f"{len(known)} of {len(bundle['collisions'])}", f"{middle:.1f}"]
            row += [f"{low:.0f}\u00a0to\u00a0{high:.0f}", f"{max(known):.0f}"]
        rows.append([cell.replace("-", "−") for cell in row + [""] * (len(columns) - len(row))])
    return table(columns, rows)


def delay_of(verdict: dict[str, Any], joint: int | None) -> float | None:
    """Delay in ms; None where estimate or sensor does not exceed the threshold."""
    delay_s = verdict["delay_against_sensor_s"]
    if joint is not None:
        delay_s = verdict["joint_delays_against_sensor_s"][joint]
    return None if delay_s is None else 1e3 * delay_s


def whole(value: float) -> str:
    """A rounded number that is never −0."""
    return f"{round(value):d}"


def everything(results: dict[str, Any]) -> list[str]:
    """One row a bundle: training, errors, limits, alarms and collisions."""
    hours = results["bundles"][0]["free_motion"]["hours"]
    columns = ["model", "recipe", "steps", "minutes of training", "L1, N m", "L2, N m", "RMSE near stiction, N m"]
    columns += [
        "RMSE sliding, N m",
        "threshold sliding, N m",
        "threshold near stiction, N m",
        f"false alarms (collisions) in {hours:.3f} h",
    ]
    columns += ["of the ten", "strong collisions latched", "latched of 200"]
    rows = []
    for bundle in by_recipe(results):
        free, limits, latched = bundle["free_motion"], bundle["limits"], bundle["latched"]
        rows.append(
            (
                bundle["case"],
                bundle["recipe"],
                f"{bundle['steps']:,}",
                f"{bundle['training_minutes']:.0f}",
                joined(free["l1_nm"]),
                joined(free["l2_nm"]),
                joined(free["rmse_near_stiction_nm"], ".2f"),
                joined(free["rmse_sliding_nm"], ".2f"),
                joined(limits["sliding_nm"], ".2f"),
                joined(limits["near_stiction_nm"], ".2f"),
                f"{free['false_alarms']} ({free['false_collisions']})",
                bundle["ten_found"],
                f"{latched['strong_latched']} of {latched['strong']}",
                latched["latched"],
            )
        )
    return table(columns, rows)


def seeds(measured: list[dict[str, Any]]) -> list[str]:
    """Errors of every case at 100 Hz beside the paper's, and at 1 kHz: mean of the seeds and their range."""
    columns = ["model", "seeds", "L1, N m", "paper", "L2, N m", "paper", "MSE, (N m)²", "paper", "L1 at 1 kHz, N m"]
    rows = []
    for case in ORDER:
        mine = [one for one in measured if one["case"] == case]
        row = [case, len(mine)]
        for key, theirs in (("l1", paper.L1_NM), ("l2", paper.L2_NM), ("mse", paper.MSE_NM2)):
            row += [mean_and_range([one[key] for one in mine]), joined(theirs[case])]
        rows.append([*row, mean_and_range([one["l1_1khz"] for one in mine])])
    return table(columns, rows)


def mean_and_range(values: list[list[float]]) -> str:
    """Of (seeds, joints)."""
    mean, low, high = np.mean(values, axis=0), np.min(values, axis=0), np.max(values, axis=0)
    return f"{joined(mean)} ({joined(low)} to {joined(high)})"


def each_seed(measured: list[dict[str, Any]]) -> list[str]:
    """Errors, thresholds, false alarms and detected collisions of every case and seed."""
    columns = ["model", "seed", "RMSE near stiction, N m", "sliding, N m", "threshold sliding, N m"]
    columns += ["false alarms", "detected by one sample"]
    rows = []
    for one in measured:
        false, detected, of = one["counts"]
        errors = [joined(one[key], ".2f") for key in ("near", "sliding", "limit")]
        rows.append([one["case"], one["seed"], *errors, f"{false:.0f}", f"{detected:.0f} of {of:.0f}"])
    return table(columns, rows)


@cache
def tables() -> dict[str, list[str]]:
    """The lines of each table by its name."""
    full, quick, measured = load("full/results"), load("quick/results"), load("full/seeds")
    dense = {"bundles": [bundle for bundle in quick["bundles"] if bundle["recipe"] == "dense"]}
    return {
        "table-1": [*table_1(full), *table_1(dense)[2:]],
        "seeds": seeds(measured),
        "each-seed": each_seed(measured),
        "full": everything(full),
        "quick": everything(quick),
        "delays-joint-1": delays(full, joint=0),
        "delays": delays(full),
    }
