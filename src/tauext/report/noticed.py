"""What force on a link a bundle notices, as results.json has it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TypeVar

Limit = TypeVar("Limit")

ONE_SIDED_95 = 1.645
"""Standard errors that 95 % of errors are below."""
WAYS = {"x": "x", "y": "y", "z": "z", "worst_way": "worst way"}
"""Directions by their keys, in words."""


@dataclass(frozen=True)
class OverPoses:
    """Force in one direction, [N]; None: blind."""

    median_n: float | None
    worst_n: float | None
    blind_share: float


@dataclass(frozen=True)
class NoticedAt:
    """Forces at one point of the arm."""

    place: str
    every_median_n: float | None
    """Over poses and directions, as the next."""
    nine_of_ten_n: float | None
    ways: Mapping[str, OverPoses]
    """By the names of WAYS."""


@dataclass(frozen=True)
class Noticed:
    """Of one bundle; `refused` says why there is nothing."""

    poses: int = 0
    limits: Mapping[str, tuple[NoticedAt, ...]] | None = None
    gain_per_s: float | None = None
    error_share: float | None = None
    """Standard error of the estimate as a share of the limit, in the median."""
    left_out: tuple[str, ...] = ()
    """Joints that do not answer in N m: what they notice is not in the numbers."""
    refused: str | None = None


def joined(limits: Mapping[str, Limit]) -> dict[str, Limit]:
    """The same, with limits that notice the same under one name: `collision and contact while sliding`."""
    found: dict[str, Limit] = {}
    for name, entries in limits.items():
        same = next((other for other, those in found.items() if those == entries), None)
        if same is None:
            found[name] = entries
            continue
        (level, _, motion), after = same.partition(" "), name.partition(" ")[2]
        both = f"{level if motion == after else same} and {name}"
        found = {both if other == same else other: those for other, those in found.items()}
    return found


def left_out_words(joints: Sequence[str]) -> str:
    """A sentence about joints that do not answer in N m; empty without any."""
    if not joints:
        return ""
    return f"Without {', '.join(joints)}: their torque constants are not known, so what they notice is not counted."


def surely(error_share: float) -> float:
    """Times the force that goes over a limit: from there on 19 of 20 do, whatever way the estimate errs."""
    return 1 + ONE_SIDED_95 * error_share
