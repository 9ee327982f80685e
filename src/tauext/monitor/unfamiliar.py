"""Motion that training never saw: which samples are told to be that, and what of them, in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from tauext import _core

WORTH_TELLING: float = _core.CoverageSettings.WORTH_TELLING
"""From this value of `unfamiliar` on."""
KINDS = tuple(kind.name for kind in sorted(_core.Unseen, key=lambda kind: kind.value))
"""By the core's number."""
Unseen = tuple[int, int, int]
"""Number of the kind, joint, and the other one where positions were never seen together, else -1."""


def unseen_of(said: Mapping[str, np.ndarray]) -> Counter[Unseen]:
    """How many samples were unfamiliar, by what of them was.

    Args:
        said: as Monitor.run gives it.
    """
    told = said["unfamiliar"] >= WORTH_TELLING
    if not told.any():
        return Counter()
    what = np.stack([said[key][told].astype(int) for key in ("unseen", "unseen_joint", "unseen_other")], axis=1)
    kinds, counts = np.unique(what, axis=0, return_counts=True)
    return Counter({(kind[0], kind[1], kind[2]): n for kind, n in zip(kinds.tolist(), counts.tolist(), strict=True)})


def unseen_words(unseen: Unseen, joints: Sequence[str]) -> str:
    """`speed of joint2`, `position of joint1`, `joint1 and joint3 together`."""
    what, joint, other = unseen
    if other >= 0:
        return f"{joints[joint]} and {joints[other]} together"
    return f"{KINDS[what]} of {joints[joint]}"
