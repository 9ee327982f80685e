"""Tables of arms by joints, one for each thing that is measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tauext.fleet.fleet_cells import NONE, Cell, likelier, number, outness

Content = Mapping[str, Any]
CONSTANT_SINCE = "What a unit of recorded torque is worth, by that of the arm's first date, as far as gravity tells."


@dataclass(frozen=True)
class MeasureRow:
    arm: str
    link: str
    cells: tuple[Cell, ...]


@dataclass(frozen=True)
class Measure:
    """One table."""

    name: str
    says: str
    rows: tuple[MeasureRow, ...]
    heads: tuple[str, ...]


def measures(group: Content, arms: Sequence[Content], link: Mapping[str, str]) -> list[Measure]:
    """All that there is something of, the most telling first."""
    unit = units_word(group["units"])
    compared = [
        ("since first date", "own", "friction", "Friction by that of the arm's own first date, ± its standard error."),
        (
            "beside the fleet",
            "fleet",
            "friction",
            "Friction at 0.5 rad/s by the middle of the fleet's, ± standard error.",
        ),
        ("constant since", "own", "constant", CONSTANT_SINCE),
        (
            "constant beside the fleet",
            "fleet",
            "constant",
            "Torque constant, as motion shows it, by the fleet's middle.",
        ),
    ]
    plain = [
        ("friction", "friction_nm", f"Friction at 0.5 rad/s, {unit}."),
        ("ripple", "ripple_nm", f"Ripple of motor and gear, amplitude, {unit}."),
        ("limit", "limit_nm", f"Collision limit while the joint moves in the usual way, {unit}."),
        ("limit at rest", "near_stiction_limit_nm", f"Collision limit near standstill, {unit}."),
        ("error", "error_nm", f"Error (RMSE) on free motion that training did not see, {unit}."),
    ]
    found = [relative(group, arms, link, *one) for one in compared]
    found += [absolute(group, arms, link, *one) for one in plain]
    return [one for one in found if any(cell is not NONE for row in one.rows for cell in row.cells)]


def relative(
    group: Content, arms: Sequence[Content], link: Mapping[str, str], name: str, against: str, what: str, says: str
) -> Measure:
    """Factors with their errors, coloured by how far they are from what the arm does and what all arms do."""
    rows, with_arm = [], what == "friction"
    for arm in arms:
        told = (arm["visits"][-1].get(against) or {}).get(what)
        cells = [
            NONE if told is None or told["value"][j] is None else factor_cell(group, arm, told, j, against, what, link)
            for j in range(len(group["joints"]))
        ]
        to = link.get(arm["serial"], "")
        rows.append(MeasureRow(arm["serial"], to, (*cells, whole_arm(told, to)) if with_arm else tuple(cells)))
    return Measure(name, says, tuple(rows), (*group["joints"], "all joints") if with_arm else tuple(group["joints"]))


def whole_arm(told: Content | None, link: str) -> Cell:
    """What all joints of the arm do together."""
    if told is None or "arm" not in told:
        return NONE
    factor = float(np.exp(told["arm"]))
    return Cell(f"{factor:.2f}", factor, link=link)


def factor_cell(
    group: Content, arm: Content, told: Content, joint: int, against: str, what: str, link: Mapping[str, str]
) -> Cell:
    """One factor: in logarithms beside the centre of the table, by the spread of healthy joints."""
    table = table_of(group, arm, against, what)
    value, error = told["value"][joint], told["error"][joint]
    out = 0.0
    if table is not None:
        apart = value - table["centre"][joint]
        out = (apart - told["arm"]) / float(np.hypot(table["joint_spread"], error))
        value = apart if against == "fleet" else value
    probability, sign = likelier(told, joint)
    if probability is not None and probability >= 0.1 and out * sign < 0.5:
        out = 0.51 * sign
    factor = float(np.exp(min(value, 20)))
    text = f"{factor:.2f} ± {factor * error:.2f}"
    title = f"{arm['serial']} {group['joints'][joint]}: {text}, {out:+.1f} spreads"
    return Cell(text, factor, out, probability, link.get(arm["serial"], ""), title)


def table_of(group: Content, arm: Content, against: str, what: str) -> Content | None:
    """What healthy arms do, of the table that this arm's last date stands in."""
    if against == "fleet":
        return group["tables"].get(f"fleet {what}")
    number = (arm["visits"][-1].get("own") or {}).get("number")
    return group["tables"].get(f"own {what} {number}")


def absolute(
    group: Content, arms: Sequence[Content], link: Mapping[str, str], name: str, key: str, says: str
) -> Measure:
    """Numbers as they are, coloured by how far they are from the column's median."""
    joints = range(len(group["joints"]))
    columns = [[at(arm["visits"][-1].get(key), j) for arm in arms] for j in joints]
    out = [outness(column) for column in columns]
    rows = []
    for a, arm in enumerate(arms):
        to = link.get(arm["serial"], "")
        cells = tuple(
            NONE if columns[j][a] is None else Cell(number(columns[j][a]), columns[j][a], out[j][a], link=to)
            for j in joints
        )
        rows.append(MeasureRow(arm["serial"], to, cells))
    return Measure(name, says, tuple(rows), tuple(group["joints"]))


def at(values: Sequence[float | None] | None, joint: int) -> float | None:
    return values[joint] if values and joint < len(values) else None


def units_word(units: Sequence[str]) -> str:
    """Of all joints; where they differ the bundle's own."""
    return {"N m": "Nm"}.get(units[0], units[0]) if len(set(units)) == 1 else "in the unit of each joint's estimate"
