"""Tables of the paper's page, made from the results of two scales and of several seeds."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from tauext_lab.report import paper

DOCS = Path(__file__).parent
ORDER = list(paper.L1_NM)
ERRORS = {"L1, N m": paper.L1_NM, "L2, N m": paper.L2_NM, "MSE, (N m)²": paper.MSE_NM2}
KEYS = ("l1", "l2", "mse")


def load(name: str) -> Any:
    """Content of results/NAME.json."""
    return json.loads((DOCS / "results" / f"{name}.json").read_text())


def table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> list[str]:
    """The lines of a Markdown table."""
    lines = ["| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
    return lines + ["| " + " | ".join(map(str, row)) + " |" for row in rows]


def joined(values: Iterable[float]) -> str:
    return "/".join(format(value, ".3f") for value in values)


def of_recipe(results: dict[str, Any], recipe: str) -> list[dict[str, Any]]:
    """Bundles of a recipe, in the paper's order of cases."""
    return sorted((b for b in results["bundles"] if b["recipe"] == recipe), key=lambda b: ORDER.index(b["case"]))


def table_1(epochs_100: list[dict[str, Any]], epochs_500: list[dict[str, Any]], dense: dict[str, Any]) -> list[str]:
    """L1, L2 and MSE of every case beside the paper's: mean of the seeds, and the range of L1.

    Args:
        epochs_100, epochs_500: errors of recipe `paper` by case and seed, at 100 Hz.
        dense: results.json with a bundle of recipe `dense` for each case.
    """
    columns = ["model", "training", *(f"{error}: {whose}" for error in ERRORS for whose in ("tauext", "paper"))]
    rows = []
    for training, measured in (("100 epochs", epochs_100), ("500 epochs", epochs_500)):
        for case in ORDER:
            if mine := [one for one in measured if one["case"] == case]:
                seeds = f"{len(mine)} seed" + "s" * (len(mine) > 1)
                rows.append(row(case, f"{training}, {seeds}", [[one[key] for one in mine] for key in KEYS]))
    for bundle in of_recipe(dense, "dense"):
        free = bundle["free_motion"]
        rows.append(row(bundle["case"], "`dense`", [[free[key]] for key in ("l1_nm", "l2_nm", "mse_nm2")]))
    return table(columns, rows)


def row(case: str, training: str, errors: list[list[list[float]]]) -> list[str]:
    """errors: L1, L2 and MSE, each (seeds, joints)."""
    cells = [case, training]
    for mine, theirs in zip(errors, ERRORS.values(), strict=True):
        cells += [joined(np.mean(mine, axis=0)), joined(theirs[case])]
    if len(errors[0]) > 1:
        cells[2] += f" ({joined(np.min(errors[0], axis=0))} to {joined(np.max(errors[0], axis=0))})"
    return cells


def delays(trainings: dict[str, dict[str, Any]]) -> list[str]:
    """Delays of joint 1 against its sensor, at the same threshold, of the ten collisions and of all over it in both.

    Args:
        trainings: results.json by what its bundles were trained with.
    """
    columns = ["model", "training", "each of the ten, ms", "median of the ten, ms"]
    columns += ["all: both over the threshold", "median, ms", "5 % to 95 %, ms", "largest, ms"]
    rows = []
    shown = [(name, of, bundle) for name, of in trainings.items() for bundle in of_recipe(of, "paper")]
    for training, results, bundle in shown:
        of_joint_1 = {one["id"]: one["joint_delays_against_sensor_s"][0] for one in bundle["collisions"]}
        delay_ms = {name: 1e3 * delay_s for name, delay_s in of_joint_1.items() if delay_s is not None}
        ten = [delay_ms[name] for name in results["ten_collisions"] if name in delay_ms]
        low, middle, high = np.percentile(list(delay_ms.values()), [5, 50, 95])
        cells = [bundle["case"], training, ", ".join(f"{round(delay):d}" for delay in ten).replace(" ", "\u00a0")]
        cells += [f"{np.median(ten):.1f}", f"{len(delay_ms)} of {len(of_joint_1)}", f"{middle:.1f}"]
        cells += [f"{low:.0f}\u00a0to\u00a0{high:.0f}", f"{max(delay_ms.values()):.0f}"]
        rows.append([cell.replace("-", "−") for cell in cells])
    return table(columns, rows)


@cache
def tables() -> dict[str, list[str]]:
    """The lines of each table by its name."""
    return {
        "table-1": table_1(load("full/seeds"), load("full/seeds-500"), load("quick/results")),
        "delays": delays({"500 epochs": load("full/results-500"), "100 epochs": load("full/results")}),
    }
