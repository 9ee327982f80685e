"""The page of the trial."""

from __future__ import annotations

import numpy as np

from touches.run import CONE_RAD, FORCES_N, RATIOS, REJECTED, SAID_AT_S

STATED = 0.9
AT_FLANGE = 0.5
WITHIN_DEG, FROM_N, LAST_LINKS = 30.0, 20.0, 3


def markdown(rows: list[dict], command: str) -> str:
    arms = list(dict.fromkeys(row["arm"] for row in rows))
    held, rows = [row for row in rows if row["flange"]], [row for row in rows if not row["flange"]]
    text = f"""# Which link, and where

Written by `{command}`; each touch is in [links.json](links.json).

Simulated arms of the trial on [unseen arms](../unseen-arms/README.md), bundles of recipe prior from their twelve
minutes, links shaped as cylinders (`benchmarks/unseen/surfaces.py`). The method's numbers were looked at on arm ur5
alone. Touches on every link as often, anywhere on its surface, within {np.degrees(CONE_RAD):.0f} degrees of the
normal, held for 1.2 s, in motion and at rest; {RATIOS[0]:g} to {RATIOS[1]:g} times the limit of the joint that exceeds
it most, as far as that takes {FORCES_N[0]:g} to {FORCES_N[1]:g} N. What the monitor has said by {SAID_AT_S:g} s after
the alarm counts. `Bayes` knows the cylinders, how touches are drawn, and this arm's errors, fitted to the very touches
that are judged. Stated: with a probability of {STATED:.0%} or more.

| arm | touches | alarms | right | Bayes | among two | Bayes | stated | of those right | Bayes stated | right |
|---|---|---|---|---|---|---|---|---|---|---|
"""
    for arm in [*arms, None]:
        text += links_line(arm or "**all**", [row for row in rows if arm in (None, row["arm"])])
    text += "\nBy the largest torque over its limit, as the joints' truth had it:\n\n"
    text += "| ratio | touches seen | right | Bayes right | stated | of those right |\n|---|---|---|---|---|---|\n"
    for low, high in ((0, 2), (2, 4), (4, 7), (7, 99)):
        some = [row for row in rows if row["seen"] and low <= row["ratio"] < high]
        if some:
            ours, bayes = (Told(padded(some), by) for by in ("probability", "bayes"))
            text += f"| {low} to {high} | {len(some)} | {ours.first:.0%} | {bayes.first:.0%} "
            text += f"| {ours.stated:.0%} | {ours.sure:.0%} |\n"
    text += "\nLinks that were touched (rows) and what they were taken for, the most probable link:\n"
    for arm in arms:
        text += confusion(arm, [row for row in rows if row["arm"] == arm and row["seen"]])
    text += f"""
Pushes on other links taken for a force at the origin of the last link's frame: those of which `Monitor.force` says that
they are none there (consistent below {REJECTED:g}), and those with a probability below {AT_FLANGE:g} of being one there
rather than a touch elsewhere (`PlaceModel.find(frame=...)`). Beside them, of forces at that very point, in any
direction, how many are refused.

| arm | on other links | by consistency | by probability | at the point | by consistency | by probability |
|---|---|---|---|---|---|---|
"""
    for arm in [*arms, None]:
        text += flange_line(
            arm or "**all**", *([row for row in some if arm in (None, row["arm"])] for some in (rows, held))
        )
    text += f"""
The place on the link, which is given, of touches from {FROM_N:g} N within {WITHIN_DEG:g} degrees of the normal on the
last {LAST_LINKS} links: distance from the true point, the spread that is said, the error of the force's size.

| arm | touches | off, cm: median | 90 % | spread, cm | force off, N |
|---|---|---|---|---|---|
"""
    for arm in [*arms, None]:
        text += place_line(arm or "**all**", [row for row in rows if arm in (None, row["arm"]) and row["seen"]])
    return text


class Told:
    """Shares of touches whose link was told right."""

    def __init__(self, rows: list[dict], by: str):
        told, link = np.array([row[by] for row in rows]), np.array([row["link"] for row in rows])
        ranked = np.argsort(-told, axis=1)
        sure = told.max(axis=1) >= STATED
        right = ranked[:, 0] == link
        self.first, self.two = right.mean(), (right | (ranked[:, 1] == link)).mean()
        self.stated, self.sure = sure.mean(), right[sure].mean() if sure.any() else np.nan


def padded(rows: list[dict]) -> list[dict]:
    """Of arms with different numbers of links, so that they fit one table."""
    most = max(len(row["probability"]) for row in rows)
    return [row | {by: [*row[by], *[0.0] * (most - len(row[by]))] for by in ("probability", "bayes")} for row in rows]


def links_line(name: str, rows: list[dict]) -> str:
    seen = padded([row for row in rows if row["seen"]])
    ours, bayes = Told(seen, "probability"), Told(seen, "bayes")
    told = (ours.first, bayes.first, ours.two, bayes.two, ours.stated, ours.sure, bayes.stated, bayes.sure)
    return f"| {name} | {len(rows)} | {len(seen)} | {' | '.join(f'{share:.0%}' for share in told)} |\n"


def confusion(arm: str, rows: list[dict]) -> str:
    links = len(rows[0]["probability"])
    table = np.zeros((links, links), dtype=int)
    for row in rows:
        table[row["link"], int(np.argmax(row["probability"]))] += 1
    text = f"\n| {arm} | " + " | ".join(str(k + 1) for k in range(links)) + " |\n" + "|---" * (links + 1) + "|\n"
    for k, counts in enumerate(table):
        text += f"| {k + 1} | " + " | ".join(str(one) if one else "" for one in counts) + " |\n"
    return text


def flange_line(name: str, rows: list[dict], held: list[dict]) -> str:
    other = [row for row in rows if row["seen"] and row["link"] < len(row["probability"]) - 1]
    text = f"| {name}"
    for some in (other, [row for row in held if row["seen"]]):
        rejected = np.mean([row["flange_rejected"] for row in some])
        improbable = np.mean([row["at_flange"] < AT_FLANGE for row in some])
        text += f" | {len(some)} | {rejected:.0%} | {improbable:.0%}"
    return text + " |\n"


def place_line(name: str, rows: list[dict]) -> str:
    placed = [
        row
        for row in rows
        if row["link"] >= len(row["probability"]) - LAST_LINKS
        and row["force_n"] >= FROM_N
        and row["angle_deg"] <= WITHIN_DEG
    ]
    off = np.array([row["off_m"] for row in placed]) * 100
    spread = np.median([row["spread_m"] for row in placed]) * 100
    force = np.median([abs(row["said_n"] - row["force_n"]) for row in placed])
    median, most = np.quantile(off, (0.5, 0.9))
    return f"| {name} | {len(placed)} | {median:.1f} | {most:.1f} | {spread:.1f} | {force:.1f} |\n"
