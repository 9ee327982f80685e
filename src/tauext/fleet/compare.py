"""Arms of one type compared with each other and with their own first date."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tauext import _core
from tauext.fleet.odds import NAMED, Odds, Question, learn_odds
from tauext.fleet.visits import BundleFacts, friction_nm
from tauext.robot.inertial import unit_loads

# --- Change of gravity torques between two states of an arm: a tool at the flange, or the scale of a joint's torque.
#
# .. math:: y_j(q) = X_j(q) (m, m c) - \kappa_j g_j(q) + error
#
# y: by how much the gravity torques of two bundles differ at the same poses. A tool shows at all joints at once, in
# proportion to its weight; a constant that is off by kappa shows at its own joint, in proportion to what weighs there.


POSES = 200
INDEPENDENT = 10.0
"""Number of the poses that count as independent: about this many numbers determine an arm's gravity."""
MASS_KG, MOMENT_KG_M = 1.0, 0.15
"""Standard deviations of a tool's mass and of its first moment before any data: grippers and their parts."""
ROUNDS = 3
LEAST_SHARE, LEAST_NM = 0.5, 0.02
"""Least error of a bundle's gravity: a share of the joint's residual torque in training, and a torque [N m]."""


@dataclass(frozen=True)
class Weighed:
    """One arm compared with another state of it, or with the fleet."""

    kg: float
    kg_error: float
    share: np.ndarray  # (n,) kappa
    share_error: np.ndarray  # (n,); the prior spread where gravity does not load the joint


def poses_seen(bundles: Sequence[_core.Bundle], seed: int = 0) -> np.ndarray:
    """Random poses within the median training range of these bundles, (POSES, n); each joint by itself."""
    rng = np.random.default_rng(seed)
    n = bundles[0].joints
    q = np.empty((POSES, n))
    for j in range(n):
        ranges = [seen_range(bundle, j) for bundle in bundles]
        low, high = (float(np.median([one[k] for one in ranges])) for k in (0, 1))
        q[:, j] = rng.uniform(low, high, POSES)
    return q


def seen_range(bundle: _core.Bundle, joint: int) -> tuple[float, float]:
    """First and last position of the joint in training; one turn about 0 where they are unknown."""
    coverage = bundle.coverage
    if not len(coverage.fastest_rad_s):
        return -np.pi, np.pi
    cells = [c for c in range(64) if int(coverage.seen[joint]) >> c & 1]
    if not cells:
        return -np.pi, np.pi
    if coverage.turns[joint]:
        cells = longest_run(cells)
    first = coverage.centre_rad[joint] - coverage.span_rad[joint] / 2
    cell = coverage.span_rad[joint] / 64
    return first + cells[0] * cell, first + (cells[-1] + 1) * cell


def longest_run(cells: Sequence[int]) -> list[int]:
    """Cells of a circle from behind its widest gap on, counted upwards."""
    gaps = [(cells[(k + 1) % len(cells)] - cell) % 64 or 64 for k, cell in enumerate(cells)]
    start = (int(np.argmax(gaps)) + 1) % len(cells)
    turned = [*cells[start:], *(c + 64 for c in cells[:start])]
    return [c - 64 for c in turned] if turned[0] >= 32 else turned


def arm_tree(bundle: _core.Bundle) -> _core.Tree:
    """The arm model as trained."""
    return _core.Tree(bundle.prior.corrected_links or bundle.links, bundle.gravity)


def gravity_nm(tree: _core.Tree, q: np.ndarray) -> np.ndarray:
    """Torques that hold the arm, (poses, n)."""
    return tree.momentum(q, np.zeros_like(q))[1]


def tool_columns(tree: _core.Tree, q: np.ndarray) -> np.ndarray:
    """What a kilogram, and a first moment of 1 kg m along each axis, adds on the last link, (poses, n, 4)."""
    usual = gravity_nm(tree, q)
    return np.stack([gravity_nm(loaded, q) - usual for loaded in unit_loads(tree)], axis=-1)


def weigh_all(
    y: Sequence[np.ndarray], gravity: np.ndarray, columns: np.ndarray, share_spread: float, left_nm: np.ndarray
) -> list[Weighed]:
    """Tool and shares of each arm; the accuracy of gravity is estimated from their residuals.

    Args:
        y: of each arm, (poses, n) [N m].
        gravity: (poses, n) that shares are of.
        share_spread: prior standard deviation of kappa.
        left_nm: (n,) residual torque of each joint in training; NaN: unknown.
    """
    n = gravity.shape[1]
    least_nm = np.maximum(LEAST_SHARE * np.nan_to_num(left_nm), LEAST_NM)
    noise_nm = np.full(n, 0.1 * float(np.sqrt(np.mean(gravity**2)))) + least_nm
    found: list[Weighed] = []
    for _ in range(ROUNDS):
        found, left = [], []
        for one in y:
            weighed, rest = weigh(one, gravity, columns, share_spread, noise_nm)
            found.append(weighed)
            left.append(np.mean(rest**2, axis=0))
        noise_nm = np.maximum(np.sqrt(np.median(left, axis=0)), least_nm)
    return found


def weigh(
    y: np.ndarray, gravity: np.ndarray, columns: np.ndarray, share_spread: float, noise_nm: np.ndarray
) -> tuple[Weighed, np.ndarray]:
    """Least squares on all joints; also returns the residuals, (poses, n)."""
    poses, n = y.shape
    design = np.zeros((poses, n, 4 + n))
    design[:, :, :4] = columns
    design[:, range(n), range(4, 4 + n)] = -gravity
    worth = INDEPENDENT / poses / noise_nm**2
    information = np.diag(1 / np.r_[MASS_KG, [MOMENT_KG_M] * 3, [share_spread] * n] ** 2)
    information += np.einsum("pji,j,pjk->ik", design, worth, design)
    covariance = np.linalg.inv(information)
    theta = covariance @ np.einsum("pji,j,pj->i", design, worth, y)
    error = np.sqrt(np.diag(covariance))
    return Weighed(float(theta[0]), float(error[0]), theta[4:], error[4:]), y - design @ theta


# --- The prior of each table; in logarithms, that is shares, unless another unit is given.


OWN_FRICTION = Question(arm_spread=0.08, joint_spread=0.05, jump=0.35, common=0.3, apart=0.1)
"""From one date to another. Friction of gears falls by 1 to 2 % a kelvin, so halls and warm-up move all joints of an
arm by some 8 %, a cold morning by 30 %; a joint by itself does half of that. Wear is felt from a tenth on, and is
repaired before friction doubles."""
FLEET_FRICTION = Question(arm_spread=0.1, joint_spread=0.2, jump=0.35, common=3.0, apart=3.0)
"""Of one arm beside others of its type: healthy gears differ by 0.7 to 1.3. The mean of the type is unconstrained."""
OWN_CONSTANT = Question(arm_spread=0.005, joint_spread=0.01, jump=0.1, common=0.02, apart=0.02, odd_arm=0.05)
"""A motor's magnets lose 0.1 to 0.2 % a kelvin; another drive, or another number in its software, is a tenth off."""
FLEET_CONSTANT = Question(arm_spread=0.01, joint_spread=0.05, jump=0.15, common=3.0, apart=3.0, odd_arm=0.1)
"""Makers keep torque constants, gear losses included, to some 5 %."""
OWN_TOOL = Question(arm_spread=0.0, joint_spread=0.05, jump=0.7, common=0.02, apart=0.02)
"""Kilograms. The same tool weighs the same, within the error of gravity; another one differs by some hundred grams."""
FLEET_TOOL = Question(arm_spread=0.0, joint_spread=0.2, jump=0.7, common=3.0, apart=3.0)
"""Kilograms. Arms of one type may carry tools that differ by some hundred grams."""
OWN_SHARE, FLEET_SHARE = 0.1, 0.05
"""Standard deviation of what a torque's scale may be off by when tools are weighed: by the date, and by training."""


# --- Arms of one type beside each other and each beside its own first date: numbers, standard errors, probabilities.


LEAST_ARMS = 3
"""Least number of arms that are compared: of two, either could be the odd one."""


@dataclass(frozen=True)
class Compared:
    """One table of arms and joints with its probabilities."""

    rows: tuple[int, ...]
    """Index of each row's visit in the group."""
    values: np.ndarray  # (rows, joints): logarithms; [kg] of a tool
    errors: np.ndarray
    odds: Odds | None
    """None: fewer than LEAST_ARMS rows."""

    def at(self, visit: int) -> dict[str, Any] | None:
        """Of one visit: value, error, more, less, each over the joints; None where it has no row."""
        if visit not in self.rows:
            return None
        k = self.rows.index(visit)
        content: dict[str, Any] = {"value": listed(self.values[k]), "error": listed(self.errors[k])}
        if self.odds is not None:
            content |= {"more": listed(self.odds.more[k]), "less": listed(self.odds.less[k])}
            content["arm"] = round(float(self.odds.shift[k]), 4)
        return content

    def facts(self) -> dict[str, Any] | None:
        """Variation of healthy arms."""
        if self.odds is None:
            return None
        odds = self.odds
        from_x = round(odds.named_from, 4) if np.isfinite(odds.named_from) else None
        spread = {"arms": len(self.rows), "arm_spread": round(odds.arm_spread, 4)}
        return spread | {
            "joint_spread": round(odds.joint_spread, 4),
            "centre": listed(odds.centre),
            "named_from": from_x,
        }


@dataclass(frozen=True)
class GroupNumbers:
    """All comparisons within one group of arms."""

    friction_nm: np.ndarray  # (visits, joints)
    tables: Mapping[str, Compared]
    """Keys: "fleet friction", "own constant" ...; those of own dates by "own friction 1", the number of the date."""


def compare(facts: Sequence[BundleFacts], serials: Sequence[str], order: Sequence[int]) -> GroupNumbers:
    """All comparisons of one group.

    Args:
        facts: of every visit that has a bundle, an arm's visits in the order of their dates.
        serials: identity of each arm.
        order: which of the arm's dates each is: 0 the first; dates of one number are compared with each other.
    """
    poses = poses_seen([one.bundle for one in facts])
    gravity = np.array([gravity_nm(arm_tree(one.bundle), poses) for one in facts])
    friction = frictions(facts, gravity)
    tool = tool_columns(arm_tree(facts[0].bundle), poses)
    latest = [k for k, serial in enumerate(serials) if serial not in serials[k + 1 :]]
    tables = fleet_tables(facts, friction, gravity, tool, latest)
    for number in sorted(set(order) - {0}):
        rows = [k for k in range(len(facts)) if order[k] == number]
        first = [serials.index(serials[k]) for k in rows]
        for name, table in own_tables(facts, friction, gravity, tool, rows, first).items():
            tables[f"own {name} {number}"] = table
    return GroupNumbers(friction, tables)


def frictions(facts: Sequence[BundleFacts], gravity: np.ndarray) -> np.ndarray:
    """(visits, joints) [N m]; what follows the load at the same load for all arms."""
    weight_nm = np.median(np.mean(np.abs(gravity), axis=1), axis=0)
    return np.array([friction_nm(one, weight_nm) for one in facts])


def fleet_tables(
    facts: Sequence[BundleFacts], friction: np.ndarray, gravity: np.ndarray, tool: np.ndarray, rows: Sequence[int]
) -> dict[str, Compared]:
    """Compare every arm at its last date with the others."""
    middle = np.median(gravity[list(rows)], axis=0)
    weighed = weigh_all([gravity[k] - middle for k in rows], middle, tool, FLEET_SHARE, left_nm(facts, rows))
    errors = np.array([facts[k].friction_error(friction[k]) for k in rows])
    constants = np.array([facts[k].constants for k in rows])
    return {
        "fleet friction": compared(rows, logs(friction[list(rows)]), errors, FLEET_FRICTION),
        "fleet constant": compared(
            rows,
            logs(constants),
            np.array([facts[k].constants_error for k in rows]) / np.abs(constants),
            FLEET_CONSTANT,
        ),
        "fleet tool": tools(rows, weighed, FLEET_TOOL),
    }


def own_tables(
    facts: Sequence[BundleFacts],
    friction: np.ndarray,
    gravity: np.ndarray,
    tool: np.ndarray,
    rows: Sequence[int],
    first: Sequence[int],
) -> dict[str, Compared]:
    """Compare every arm with its own first date, by the recorded torque, so that the scale used in training does not
    matter."""
    by_first = [facts[a].nm_per_unit / facts[b].nm_per_unit for a, b in zip(first, rows, strict=True)]
    middle = np.median(gravity[list(first)], axis=0)
    differ = [gravity[b] * scale - gravity[a] for a, b, scale in zip(first, rows, by_first, strict=True)]
    weighed = weigh_all(differ, middle, tool, OWN_SHARE, left_nm(facts, rows))
    share = np.array([np.log1p(np.clip(one.share, -0.9, 9.0)) for one in weighed])
    share_error = np.array([one.share_error for one in weighed])
    determined = share_error < 0.5 * OWN_SHARE
    constant = compared(rows, np.where(determined, share, np.nan), share_error, OWN_CONSTANT)
    x = np.array([logs(friction[b] * s) - logs(friction[a]) for a, b, s in zip(first, rows, by_first, strict=True)])
    errors = np.array(
        [
            np.hypot(facts[a].friction_error(friction[a]), facts[b].friction_error(friction[b]))
            for a, b in zip(first, rows, strict=True)
        ]
    )
    if constant.odds is not None:
        # A drive of another scale shows all torques of its joint by that: it is no wear.
        rescaled = np.nan_to_num(np.maximum(constant.odds.more, constant.odds.less)) >= NAMED
        x, errors = np.where(rescaled, x + share, x), np.where(rescaled, np.hypot(errors, share_error), errors)
    return {
        "friction": compared(rows, x, errors, OWN_FRICTION),
        "constant": constant,
        "tool": tools(rows, weighed, OWN_TOOL),
    }


def left_nm(facts: Sequence[BundleFacts], rows: Sequence[int]) -> np.ndarray:
    """Median residual torque of each joint in training, (n,)."""
    return np.median([facts[k].error_nm for k in rows], axis=0)


def tools(rows: Sequence[int], weighed: Sequence[Weighed], question: Question) -> Compared:
    kg, error = np.array([[one.kg] for one in weighed]), np.array([[one.kg_error] for one in weighed])
    return compared(rows, kg, error, question)


def compared(rows: Sequence[int], values: np.ndarray, errors: np.ndarray, question: Question) -> Compared:
    """A table with its probabilities if enough arms have numbers."""
    enough = np.isfinite(values).any(axis=1).sum() >= LEAST_ARMS
    errors = np.where(np.isfinite(errors), errors, 0.0)
    return Compared(tuple(rows), values, errors, learn_odds(values, errors, question) if enough else None)


def logs(values: np.ndarray) -> np.ndarray:
    """NaN where the value is missing."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(np.asarray(values) > 0, np.log(np.abs(values)), np.nan)


def listed(values: np.ndarray) -> list[float | None]:
    """For JSON, which has no NaN."""
    return [round(float(value), 4) if np.isfinite(value) else None for value in np.atleast_1d(values)]
