"""Terms that a prior is made of."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import combinations, combinations_with_replacement

from tauext import _core
from tauext.config import PriorConfig
from tauext.fit.training_set import Setup

Kind = _core.TermKind
LEVELS_OFF = 1.5
"""Times its smoothing, a speed gives a Coulomb term 91 % of its value."""
ESTIMATED, CORRECTED = 0, 1
"""Forms of the load terms: whose beta loads the gear."""


def own_terms(
    setup: Setup,
    config: PriorConfig,
    joint: int,
    ripple: Sequence[int] = (),
    load: int | None = None,
    top_speed_rad_s: float = math.inf,
    play: int | None = None,
    local_memory: bool = False,
) -> list[_core.Term]:
    """Friction and ripple of one joint: what it does alone.

    A Coulomb term that training never saw level off is left out: beside the viscous one it may be anything, and their
    difference grows beyond the speeds that were seen.

    Args:
        top_speed_rad_s: of the joint in training.
        load: friction grows with the load by ESTIMATED or CORRECTED model; None: there is none that could tell.
        local_memory: part of its presliding friction may have local memory; the setup's prior has its branch.
        play: index of the width that is half the joint's play, where it carries no load; None: none.
    """
    terms = [_core.Term(Kind.constant, joint), _core.Term(Kind.viscous, joint)]
    narrowest, *wider = config.coulomb_speeds_rad_s
    speeds = [narrowest, *(speed for speed in wider if LEVELS_OFF * speed <= top_speed_rad_s)]
    terms += [_core.Term(Kind.coulomb, joint, speed=speed) for speed in speeds]
    terms += [_core.Term(Kind.presliding, joint, b=width) for width in range(len(setup.widths_rad))]
    if local_memory:
        terms.append(_core.Term(Kind.local_memory, joint))
    if load is not None:
        terms.append(_core.Term(Kind.load, joint, form=load, speed=config.coulomb_speeds_rad_s[0]))
        if setup.widths_rad:
            terms.append(_core.Term(Kind.load_presliding, joint, b=len(setup.widths_rad) // 2, form=load))
        if play is not None:
            terms.append(_core.Term(Kind.backlash, joint, b=play, form=load))
    return terms + [_core.Term(Kind.ripple, joint, b=cycles, form=form) for cycles in ripple for form in (0, 1)]


def shared_terms(setup: Setup) -> list[_core.Term]:
    """Gravity and inertia from sines and cosines of single joints and pairs, for every joint: where no model says."""
    joints = range(setup.tree.size)
    terms = [_core.Term(Kind.gravity, j, j, form=form) for j in joints for form in (0, 1)]
    terms += [_core.Term(Kind.gravity, a, b, form=form) for a, b in combinations(joints, 2) for form in (2, 3, 4, 5)]
    # Three neighbours: gravity of parallel axes is that of the sum of their angles, and of a wrist behind them.
    terms += [_core.Term(Kind.gravity, j - 2, j - 1, j, form=form) for j in joints[2:] for form in range(6, 14)]
    terms += [_core.Term(Kind.momentum, j, j, form=0) for j in joints]
    terms += [_core.Term(Kind.momentum, a, b, form=form) for a in joints for b in near(a, joints) for form in (1, 2)]
    terms += [
        _core.Term(Kind.quadratic, a, b, c, form)
        for a, b in combinations_with_replacement(joints, 2)
        if b - a <= 1
        for c in near(a, joints)
        for form in (0, 1)
    ]
    return terms


def near(joint: int, joints: range) -> list[int]:
    """A joint and its neighbours, whose angles its inertia depends on most; all of them in a short arm."""
    return [other for other in joints if len(joints) <= 3 or abs(other - joint) <= 1]


def has_model(setup: Setup) -> bool:
    return any(link.mass > 0 or link.rotor_inertia > 0 for link in setup.tree.links)
