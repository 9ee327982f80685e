"""Play between gear and load: which joints have it, and which presliding width tells where in it they are."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np

from tauext.fit.prior_fit import PriorFit
from tauext.fit.ties import simplest

HELPS = 0.01
"""A joint has play where that lowers its error on left-out motion by this share: as of ripples."""

WIDTH_TIE = 0.002
"""Of the error: of widths that explain the motion so nearly alike the narrowest is taken, hence the least play."""

Play = tuple[int | None, ...]
"""Of each joint, the index of the width; None: it has none that shows."""


def find_play(fit: PriorFit, fitted: Callable[[Play], PriorFit]) -> tuple[Play, PriorFit]:
    """The play of each joint and the fit with it: every width is tried at all joints at once, the best of each stays
    where the others' does not do as well.

    A gear carries nothing while it crosses its play: beta (1 - |state|) of the weight shows in r. The state is a stop
    operator's, of half the play [Nordin2002].

    Args:
        fit: without play.
        fitted: the same with this one.
    """
    joints, widths = len(fit.error_nm), range(len(fit.settings.widths_rad))
    none: Play = (None,) * joints
    fitted = cache(fitted)  # each takes seconds
    if not widths:
        return none, fit
    errors = np.array([fitted((width,) * joints).error_nm for width in widths])
    best = [simplest(widths, of_joint.__getitem__, WIDTH_TIE) for of_joint in errors.T.tolist()]
    helps = errors.min(axis=0) < (1 - HELPS) * fit.error_nm
    play: Play = tuple(int(width) if better else None for width, better in zip(best, helps, strict=True))
    for joint in [j for j, width in enumerate(play) if width is not None]:
        # Another joint's play may have been what made the ridge too strong for this one.
        without: Play = tuple(None if j == joint else width for j, width in enumerate(play))
        if fitted(without).error_nm[joint] * (1 - HELPS) <= fitted(play).error_nm[joint]:
            play = without
    return play, fit if play == none else fitted(play)


def told(play: Play, widths_rad: Sequence[float], joints: Sequence[str]) -> str:
    """In words; empty where no joint has any."""
    found = [f"{name} {2e3 * widths_rad[k]:g} mrad" for name, k in zip(joints, play, strict=True) if k is not None]
    return f"play that carries no weight: {', '.join(found)}" if found else ""
