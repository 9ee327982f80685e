"""Terms that all arms of a type get: those that enough of them keep."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext.config import PriorConfig
from tauext.fit.prior_terms import ESTIMATED, own_terms
from tauext.fit.training_set import Setup, with_presliding
from tauext.fleet.arms import OwnTerms

ENOUGH = 0.5
"""A width, a ripple or a load term stays that this share of the arms keeps."""


def common_gain(arms: Sequence[OwnTerms]) -> float:
    """The observer gain that most arms choose, the slower one of two, [1/s]."""
    counts = Counter(one.gain_per_s for one in arms)
    return min(counts, key=lambda gain: (-counts[gain], gain))


def common_widths(arms: Sequence[OwnTerms]) -> tuple[float, ...]:
    """Presliding widths that enough arms keep, rising, [rad]."""
    every = sorted({width for one in arms for width in one.widths_rad})
    return tuple(width for width in every if enough([width in one.widths_rad for one in arms]))


def common_terms(setup: Setup, config: PriorConfig, arms: Sequence[OwnTerms]) -> tuple[tuple[_core.Term, ...], ...]:
    """Terms of each joint; Coulomb terms level off at the speeds that half of the arms reach.

    Args:
        setup: of any of the arms.
    """
    bent = with_presliding(setup, common_widths(arms))
    terms = []
    for j in range(setup.tree.size):
        cycles = sorted({number for one in arms for number in one.ripples[j]})
        kept = [number for number in cycles if enough([number in one.ripples[j] for one in arms])]
        load = ESTIMATED if enough([one.loaded[j] for one in arms]) else None
        top = float(np.median([one.tops_rad_s[j] for one in arms]))
        terms.append(tuple(own_terms(bent, config, j, kept, load, top)))
    return tuple(terms)


def enough(kept: Sequence[bool]) -> bool:
    return sum(kept) >= ENOUGH * len(kept)
