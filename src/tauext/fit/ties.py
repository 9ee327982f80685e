"""Options that are about equally good: the simplest is taken, so that rounding on another machine does not choose.

The least of several costs is decided by rounding wherever costs are equal by construction: mirror images, options that
the data do not depend on, flat minima. Within a margin the order of the options decides instead; the margin of each
decision stands beside it with its reason. A cost exactly at the margin can still fall on either side, but nothing makes
costs lie there.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

Option = TypeVar("Option")


def simplest(options: Sequence[Option], cost: Callable[[Option], float], margin: float) -> Option:
    """The first option whose cost exceeds the least by this share of it at most.

    Args:
        options: simplest first, at least one.
        cost: >= 0, called once for each.
    """
    costs = [cost(option) for option in options]
    most = (1 + margin) * min(costs)
    return next(option for option, one in zip(options, costs, strict=True) if one <= most)


def ranked(options: Sequence[Option], cost: Callable[[Option], float], margin: float, most: int) -> list[Option]:
    """As many of the best as asked for, the best first: each is the simplest of those that are left."""
    left = [(cost(option), option) for option in options]
    found: list[Option] = []
    while left and len(found) < most:
        best = simplest(range(len(left)), lambda k: left[k][0], margin)
        found.append(left.pop(best)[1])
    return found
