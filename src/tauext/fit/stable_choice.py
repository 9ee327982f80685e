"""Among options of about equal cost the simplest is taken, so that rounding on another machine does not decide.

Rounding decides the lowest of several costs that are equal by construction: mirror images, options that the
data do not depend on, flat minima. Within a margin the order of the options decides instead; each decision defines its
margin and the reason for it. A cost exactly at the margin can still fall on either side, but nothing makes costs lie
there.
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
    """The requested number of best options, best first; each is the simplest of the remaining ones."""
    left = [(cost(option), option) for option in options]
    found: list[Option] = []
    while left and len(found) < most:
        best = simplest(range(len(left)), lambda k: left[k][0], margin)
        found.append(left.pop(best)[1])
    return found
