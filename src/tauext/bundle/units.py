"""Units of torques in words: what a bundle answers in need not be newton metres."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tauext._core import Bundle

SEVERAL = "unit of the joint"
"""Where joints answer in different units, a heading over all of them says this."""


def short(unit: str) -> str:
    """As it stands behind a number: `Nm` for `N m`, others as they are."""
    return unit.replace("N m", "Nm")


def of_all(units: Sequence[str]) -> str:
    """The unit that all joints share, [N m] where nobody says one, or that each has its own."""
    different = set(units) or {"N m"}
    return short(different.pop()) if len(different) == 1 else SEVERAL


def left_out(bundle: Bundle) -> dict[str, list[str]]:
    """For facts: names of the joints that do not answer in N m, by which no load or force is told; {} if all do."""
    names = not_in_newtons([link.joint_name for link in bundle.links], bundle.estimate_units)
    return {"left_out": list(names)} if names else {}


def not_in_newtons(joints: Sequence[str], units: Sequence[str]) -> tuple[str, ...]:
    """Of these joints, those whose answers are in none of N m, N and W."""
    return tuple(joint for joint, unit in zip(joints, units, strict=True) if unit not in ("N m", "N", "W"))
