"""Units of torques in words: what a bundle answers in need not be newton metres."""

from __future__ import annotations

from collections.abc import Sequence

SEVERAL = "unit of the joint"
"""Where joints answer in different units, a heading over all of them says this."""


def short(unit: str) -> str:
    """As it stands behind a number: `Nm` for `N m`, others as they are."""
    return unit.replace("N m", "Nm")


def of_all(units: Sequence[str]) -> str:
    """The unit that all joints share, [N m] where nobody says one, or that each has its own."""
    different = set(units) or {"N m"}
    return short(different.pop()) if len(different) == 1 else SEVERAL
