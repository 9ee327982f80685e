"""Arms of one type beside each other and each beside its own first date: numbers, standard errors, probabilities."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tauext.fleet.bundle_facts import BundleFacts, friction_nm
from tauext.fleet.gravity import Weighed, arm_tree, gravity_nm, poses_seen, tool_columns, weigh_all
from tauext.fleet.odds import NAMED, Odds, Question, learn_odds
from tauext.fleet.questions import (
    FLEET_CONSTANT,
    FLEET_FRICTION,
    FLEET_SHARE,
    FLEET_TOOL,
    OWN_CONSTANT,
    OWN_FRICTION,
    OWN_SHARE,
    OWN_TOOL,
)

LEAST_ARMS = 3
"""Of fewer nothing is said: which of two is the odd one nobody knows."""


@dataclass(frozen=True)
class Compared:
    """One table of arms and joints with what it says."""

    rows: tuple[int, ...]
    """Which visit of the group each row is."""
    values: np.ndarray  # (rows, joints): logarithms; [kg] of a tool
    errors: np.ndarray
    odds: Odds | None
    """None: fewer than LEAST_ARMS rows."""

    def at(self, visit: int) -> dict[str, Any] | None:
        """Of one visit: value, error, more, less, each over the joints; None where it has no row."""
        if visit not in self.rows:
            return None
        k = self.rows.index(visit)
        said: dict[str, Any] = {"value": listed(self.values[k]), "error": listed(self.errors[k])}
        if self.odds is not None:
            said |= {"more": listed(self.odds.more[k]), "less": listed(self.odds.less[k])}
            said["arm"] = round(float(self.odds.shift[k]), 4)
        return said

    def facts(self) -> dict[str, Any] | None:
        """What healthy arms do."""
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
    """All that is compared in one group of arms."""

    friction_nm: np.ndarray  # (visits, joints)
    tables: Mapping[str, Compared]
    """By "fleet friction", "own constant" ...; those of own dates by "own friction 1", the number of the date."""


def compare(facts: Sequence[BundleFacts], serials: Sequence[str], order: Sequence[int]) -> GroupNumbers:
    """Everything of one group.

    Args:
        facts: of every visit that has a bundle, an arm's visits in the order of their dates.
        serials: which arm each is.
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
    """Every arm at its last date beside the others."""
    middle = np.median(gravity[list(rows)], axis=0)
    weighed = weigh_all([gravity[k] - middle for k in rows], middle, tool, FLEET_SHARE, left_nm(facts, rows))
    errors = np.array([facts[k].friction_error(friction[k]) for k in rows])
    constants = np.array([facts[k].constants for k in rows])
    return {
        "fleet friction": asked(rows, logs(friction[list(rows)]), errors, FLEET_FRICTION),
        "fleet constant": asked(
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
    """Every arm beside its own first date, by the torque that was recorded: how a training reads it does not matter."""
    by_first = [facts[a].nm_per_unit / facts[b].nm_per_unit for a, b in zip(first, rows, strict=True)]
    middle = np.median(gravity[list(first)], axis=0)
    differ = [gravity[b] * scale - gravity[a] for a, b, scale in zip(first, rows, by_first, strict=True)]
    weighed = weigh_all(differ, middle, tool, OWN_SHARE, left_nm(facts, rows))
    share = np.array([np.log1p(np.clip(one.share, -0.9, 9.0)) for one in weighed])
    share_error = np.array([one.share_error for one in weighed])
    told = share_error < 0.5 * OWN_SHARE
    constant = asked(rows, np.where(told, share, np.nan), share_error, OWN_CONSTANT)
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
        "friction": asked(rows, x, errors, OWN_FRICTION),
        "constant": constant,
        "tool": tools(rows, weighed, OWN_TOOL),
    }


def left_nm(facts: Sequence[BundleFacts], rows: Sequence[int]) -> np.ndarray:
    """What training leaves of each joint's torque, usually, (n,)."""
    return np.median([facts[k].error_nm for k in rows], axis=0)


def tools(rows: Sequence[int], weighed: Sequence[Weighed], question: Question) -> Compared:
    kg, error = np.array([[one.kg] for one in weighed]), np.array([[one.kg_error] for one in weighed])
    return asked(rows, kg, error, question)


def asked(rows: Sequence[int], values: np.ndarray, errors: np.ndarray, question: Question) -> Compared:
    """A table with what it says, where enough arms have numbers."""
    enough = np.isfinite(values).any(axis=1).sum() >= LEAST_ARMS
    errors = np.where(np.isfinite(errors), errors, 0.0)
    return Compared(tuple(rows), values, errors, learn_odds(values, errors, question) if enough else None)


def logs(values: np.ndarray) -> np.ndarray:
    """NaN where there is none."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(np.asarray(values) > 0, np.log(np.abs(values)), np.nan)


def listed(values: np.ndarray) -> list[float | None]:
    """For JSON, which has no NaN."""
    return [round(float(value), 4) if np.isfinite(value) else None for value in np.atleast_1d(values)]
