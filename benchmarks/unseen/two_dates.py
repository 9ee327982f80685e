"""A fleet of one type at two dates: between them some joints wear, one arm gets another tool, one another drive."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from unseen.arms import Maker, TrueArm
from unseen.cold import command
from unseen.of_type import arm_of
from unseen.recordings import Take, description, write_take

WORN = 1.3
"""Times all friction of the joint."""
DAY_ARM, DAY_JOINT = 0.08, 0.04
"""Standard deviations of the logarithm of friction at a date: of all joints of an arm together (a hall: some 1.5 % a
kelvin), and of each by itself (grease). Warming up comes on top of it, with the arm's own drop."""
LONGEST_WORK_S = 1800.0
"""The arm has been at work for up to so long when a date's recordings begin."""
TOOL_KG = (0.5, 1.0)
CONSTANT = 1.1
DATES = ("2026-05-04", "2026-06-01")


@dataclass(frozen=True)
class Truth:
    """What was done to the arms between the dates, by their numbers."""

    worn: dict[int, int] = field(default_factory=dict)
    """Arm: joint."""
    tool: int = -1
    constant: tuple[int, int] = (-1, -1)
    """Arm and joint."""
    day_arm: float = DAY_ARM
    day_joint: float = DAY_JOINT
    """What the days do to friction beside warming up."""


def draw_truth(maker: Maker, arms: int, worn: int, day_arm: float = DAY_ARM, day_joint: float = DAY_JOINT) -> Truth:
    """Which arms and joints, under such days."""
    rng = np.random.default_rng([maker.type_seed or 0, arms, 11])
    chosen = rng.permutation(arms)[: worn + 2]
    joints = rng.integers(0, len(maker.joints), worn + 1)
    return Truth(
        {int(a): int(j) for a, j in zip(chosen[:worn], joints, strict=False)},
        int(chosen[worn]),
        (int(chosen[worn + 1]), int(joints[worn])),
        day_arm,
        day_joint,
    )


def takes_of(maker: Maker, seed: int) -> list[tuple[Take, ...]]:
    """The takes of each date: three minutes to train on, and half a one to test on, behind some minutes of work."""
    rng = maker.random(seed, 300)
    found = []
    for date in range(len(DATES)):
        at_s = float(rng.uniform(0, LONGEST_WORK_S))
        spans = (("work-1", "train", 1.5), ("work-2", "train", 1.5), ("free", "test", 0.5))
        takes = []
        for name, part, minutes in spans:
            takes.append(Take(f"{name}-{date}", part, minutes, 0, at_s))
            at_s += 60 * minutes
        found.append(tuple(takes))
    return found


def day_factors(maker: Maker, seed: int, date: int, truth: Truth) -> np.ndarray:
    """By which the day moves friction of each joint, beside warming up."""
    rng = maker.random(seed, 400 + date)
    return np.exp(rng.normal(0, truth.day_arm) + rng.normal(0, truth.day_joint, len(maker.joints)))


def arm_at(maker: Maker, seed: int, date: int, truth: Truth) -> TrueArm:
    """The arm as it is at that date."""
    arm = arm_of(maker, seed)
    factor = day_factors(maker, seed, date, truth)
    if date > 0 and seed in truth.worn:
        factor[truth.worn[seed]] *= WORN
    arm = replace(
        arm,
        coulomb_nm=arm.coulomb_nm * factor,
        viscous_nm_s_rad=arm.viscous_nm_s_rad * factor,
        load_share=arm.load_share * factor,
    )
    if date > 0 and seed == truth.tool:
        more = maker.random(seed, 500)
        arm = replace(arm, tree=heavier(arm, more.uniform(*TOOL_KG), more))
    if date > 0 and seed == truth.constant[0]:
        constants = arm.nm_per_ampere.copy()
        constants[truth.constant[1]] *= CONSTANT
        arm = replace(arm, nm_per_ampere=constants)
    return arm


def heavier(arm: TrueArm, kg: float, rng: np.random.Generator):
    """The tree with so much more at the flange, 5 to 10 cm from it."""
    from tauext import _core

    links = arm.tree.links
    last, at = links[-1], np.array([*rng.uniform(-0.03, 0.03, 2), rng.uniform(0.05, 0.10)])
    com = np.array(last.com)
    both = (last.mass * com + kg * at) / (last.mass + kg)
    xx, yy, zz, xy, xz, yz = last.inertia
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) + 0.4 * kg * 0.06**2 * np.eye(3)
    for one, place in ((last.mass, com), (kg, at)):
        apart = place - both
        inertia += one * (apart @ apart * np.eye(3) - np.outer(apart, apart))
    last.mass, last.com = last.mass + kg, both.tolist()
    last.inertia = [float(inertia[k]) for k in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    return _core.Tree(links, arm.tree.gravity)


def make_date(maker: Maker, seed: int, date: int, truth: Truth, folder: Path) -> Path:
    """The dataset of an arm at a date, simulated and imported; not what is there."""
    raw, data = folder / "csv", folder / "data"
    if data.is_dir():
        return data
    raw.mkdir(parents=True, exist_ok=True)
    by_date = takes_of(maker, seed)
    every: Sequence[Take] = [take for takes in by_date for take in takes]
    arm = arm_at(maker, seed, date, truth)
    for number, take in enumerate(every):
        if take in by_date[date] and not (raw / f"{take.name}.truth.npz").exists():
            write_take(maker, seed, number, raw, every, arm)
    (raw / "arm.toml").write_text(description(maker, seed, True, by_date[date]))
    files = [str(raw / f"{take.name}.csv") for take in by_date[date]]
    command("import", "--source", *files, "--arm", raw / "arm.toml", "--out", data)
    for one in raw.glob("*.csv"):
        one.unlink()  # the dataset holds it
    return data


def fleet_toml(maker: Maker, arms: Sequence[Path], date: int) -> str:
    """FLEET.toml of a date."""
    lines = [f"date = {DATES[date]}", 'stages = ["train", "evaluate"]', "[train]", 'recipe = "prior"', ""]
    for k, data in enumerate(arms):
        lines += [
            "[[arms]]",
            f'name = "arm-{k:02d}"',
            f'type = "{maker.name}"',
            f"dataset = {json.dumps(str(data))}",
            "",
        ]
    return "\n".join(lines)
