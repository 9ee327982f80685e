"""Tables of the trial."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
from unseen.results import STRONG

from picking.takes import GRADUAL_S, SUDDEN_S, WINDOW_S
from picking.watched import AT_MOST_KG, DOWN, Outcome

INTRODUCTION = f"""\
# Picks and places

Written by `{{asked}}`; each take is in [picks.json](picks.json).

Simulated arms of the trial on [unseen arms](../unseen-arms/README.md): a model that is wrong, friction with memory,
load and warmth, motor currents. Seventeen minutes to train on: nine of ordinary motion, eight of picks of nothing. Then
loads of 0.5 to 3 kg come off a table, half of them within {SUDDEN_S:g} s, half over {GRADUAL_S[0]:g} to
{GRADUAL_S[1]:g} s, are moved about and put on a table. The gripper's word is `expect_load({WINDOW_S:g},
{AT_MOST_KG:g})` at the grasp, and `expect_load({WINDOW_S:g}, 0)` just before the load is put down. Told exactly:
`set_load` when the load hangs freely, `clear_load` when the table begins to take it, by somebody who sees it. Limits
are those of seventeen minutes of motion: 1 false alarm in 7 to 8 minutes is all that they promise.

The method was fixed on the ur5. After a first look at the panda a load had to explain half of what shows, and after one
at the kinova what was found is weighed by everything since, once the window is over; nothing else was changed for them.

| arm | picks and places | false collisions in the windows | elsewhere | elsewhere, told exactly | without any word \
| hours |
|---|---|---|---|---|---|---|"""
WEIGHED = """
What was weighed: mass within 5 % or 0.1 kg when the window is over, and before it is put down; how far off when the
window is over.

| arm | right after the window | right before it is put down | off, median | off, 90 % | within two of its errors \
| not taken | not off at the end |
|---|---|---|---|---|---|---|---|"""
COLLISIONS = f"""
Collisions in the same windows: impacts, pushes and holds anywhere on the arm but its first link, without a load and,
where a release is expected, with one in hand. Strong: the torque at some joint is {STRONG:g} times the error in free
motion or more. Those within {np.degrees(np.arccos(DOWN)):.0f} degrees of gravity are listed apart: to the joints they
are a load as long as they last. Found: an alarm at most 0.7 s after the contact's end, of those that the same monitor
finds without the window.

| arm | contacts | found without the window | of these with it | ms without it: median, 90 % | ms with it | most later |
|---|---|---|---|---|---|---|"""


def right(found_kg: float, true_kg: float) -> bool:
    return abs(found_kg - true_kg) <= max(0.05 * true_kg, 0.1)


def summary(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    return [_rounded(asdict(one)) for one in outcomes]


def _rounded(facts: dict[str, Any]) -> dict[str, Any]:
    whole = {key: _rounded(value) if isinstance(value, dict) else value for key, value in facts.items()}
    return {key: round(value, 4) if isinstance(value, float) else value for key, value in whole.items()}


def markdown(outcomes: Sequence[Outcome], asked: str) -> str:
    arms = list(dict.fromkeys(one.arm for one in outcomes))
    groups = [(arm, [one for one in outcomes if one.arm == arm]) for arm in arms] + [("**all**", list(outcomes))]
    picks = [(arm, [one for one in group if one.truth["contact"] is None]) for arm, group in groups]
    lines = [*INTRODUCTION.format(asked=asked).splitlines(), *(_picks(arm, group) for arm, group in picks)]
    lines += [*WEIGHED.splitlines(), *(_masses(arm, group) for arm, group in picks), *COLLISIONS.splitlines()]
    for words, chosen in (
        ("strong", lambda one: one.strength >= STRONG and not one.down),
        ("weak", lambda one: one.strength < STRONG and not one.down),
        ("along gravity", lambda one: one.down),
    ):
        for arm, group in groups:
            hit = [one for one in group if one.truth["contact"] is not None and chosen(one)]
            if hit:
                lines.append(_hits(f"{arm}, {words}", hit))
    return "\n".join(lines) + "\n"


def _picks(arm: str, group: Sequence[Outcome]) -> str:
    cells = [sum(getattr(one, name) for one in group) for name in (
        "in_windows", "elsewhere", "told_elsewhere", "untold")]  # fmt: skip
    hours = sum(one.seconds for one in group) / 3600
    return f"| {arm} | {len(group)} | {' | '.join(map(str, cells))} | {hours:.2f} |"


def _masses(arm: str, group: Sequence[Outcome]) -> str:
    true = np.array([one.truth["mass_kg"] for one in group])
    found, error = np.array([one.mass_kg for one in group]), np.array([one.error_kg for one in group])
    off = np.abs(found - true)[found > 0]
    after = sum(right(one.mass_kg, one.truth["mass_kg"]) for one in group)
    before = sum(right(one.carried_kg, one.truth["mass_kg"]) for one in group)
    within = np.mean((np.abs(found - true) <= 2 * error)[found > 0])
    left = sum(one.left_kg > 0 for one in group)
    sizes = f"{np.median(off):.2f} kg | {np.percentile(off, 90):.2f} kg"
    last = f"{within:.0%} | {np.sum(found == 0)} | {left}"
    return f"| {arm} | {after}/{len(group)} | {before}/{len(group)} | {sizes} | {last} |"


def _hits(label: str, hit: Sequence[Outcome]) -> str:
    plain = [one for one in hit if one.plain_delay_s is not None]
    found = [one for one in plain if one.delay_s is not None]
    if not found:
        return f"| {label} | {len(hit)} | {len(plain)} | 0 | | | |"
    without = 1e3 * np.percentile([one.plain_delay_s for one in found], [50, 90])
    with_it = 1e3 * np.percentile([one.delay_s for one in found], [50, 90])
    more = max(one.delay_s - one.plain_delay_s for one in found)
    return (
        f"| {label} | {len(hit)} | {len(plain)} | {len(found)} | {without[0]:.0f}, {without[1]:.0f} "
        f"| {with_it[0]:.0f}, {with_it[1]:.0f} | {more:.2f} s |"
    )
