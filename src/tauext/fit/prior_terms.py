"""Terms of a prior, the widths of its presliding states, and a fitted prior with its errors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import combinations, combinations_with_replacement
from typing import Protocol

import numpy as np

from tauext import _core
from tauext.config import PriorConfig
from tauext.data.recording import Recording
from tauext.fit.find_kinematics import Kinematics
from tauext.fit.regression import Regression
from tauext.fit.training_set import Setup

# --- A fitted prior, and how well the data determine it.


@dataclass(frozen=True)
class LeftOut:
    """A prior fitted without a fifth of the recordings, and where that fifth lies: (recording, samples) each."""

    settings: _core.PriorSettings
    spans: list[tuple[Recording, slice]]


class Refit(Protocol):
    """Fits the chosen terms once more."""

    def __call__(self, setup: Setup) -> PriorFit:
        """Fit to another observer's residual, on the same recordings; the setup's presliding widths are ignored."""


@dataclass(frozen=True)
class PriorFit:
    """A fitted prior and how well the data determine it."""

    settings: _core.PriorSettings
    ridge: float
    error_nm: np.ndarray  # (n,) RMSE on recordings left out of the fit
    weights: np.ndarray  # (n, terms)
    standard_errors: np.ndarray  # (n, terms), over recordings
    determined: np.ndarray  # (n, terms): 1: by the data alone, 0: by the ridge alone
    corrections: np.ndarray  # (n, 11) of PARAMETERS; empty without a model
    correction_errors: np.ndarray
    corrections_determined: np.ndarray
    corrections_held: np.ndarray
    """(n, 11) bool: at a bound of what a link can be, or as the robot file has it, whatever the motion shows."""
    regression: Regression
    left_out: list[LeftOut]  # one for each fold that leaves a possible model
    kinematics: Kinematics | None = None  # found from the motion if there is no model and the arm explains it
    dropped_widths: dict[float, str] = field(default_factory=dict)  # [rad]: and why
    refit: Refit | None = None  # of the terms that were chosen, on other residuals


# --- Presliding widths that the data support.


def idle_widths(
    setup: Setup,
    recordings: Sequence[Recording],
    config: PriorConfig,
    fit: PriorFit,
    least_counts: float = 2.0,
    idle_share: float = 0.002,
) -> dict[float, str]:
    """Presliding widths that the data do not support, with the reason, from the narrowest up.

    A width below `least_counts` counts of the encoder follows the last count's flicker and not the joint. Any other is
    dropped if without it, and without those dropped before, the error on left-out recordings grows by less than
    `idle_share` in every joint. The width that decides the region of limits is kept.
    """
    regression, dropped = fit.regression, {}
    count_rad = encoder_count(recordings)
    _, all_nm = regression.choose_ridge()
    region = region_width(setup.widths_rad, config)
    for k, width in enumerate(setup.widths_rad):
        if k == region:
            continue
        columns = [
            m
            for m, term in enumerate(fit.settings.terms)
            if term.kind in (Kind.presliding, Kind.load_presliding) and term.b == k
        ]
        was = regression.used[columns].copy()
        regression.used[columns] = False
        if width < least_counts * count_rad:
            dropped[width] = f"narrower than {least_counts:g} encoder counts of {count_rad:.2g} rad"
            continue
        _, without_nm = regression.choose_ridge()
        growth = float((without_nm / np.maximum(all_nm, 1e-300) - 1).max())
        if growth < idle_share:
            dropped[width] = f"without it the error grows by {max(growth, 0.0):.2%}, less than {idle_share:.1%}"
        else:
            regression.used[columns] = was
    return dropped


def encoder_count(recordings: Sequence[Recording]) -> float:
    """Smallest change of position that any joint's encoder shows, the coarsest of the joints, [rad].

    A smaller change than 1e-9 rad is rounding, as of a conversion from degrees: a count of 32 bits is 1.5e-9 rad.
    """
    moved = [np.abs(np.diff(recording.q, axis=0)) for recording in recordings]
    least = np.min([np.where(m > 1e-9, m, np.inf).min(axis=0, initial=np.inf) for m in moved], axis=0)
    return float(np.where(np.isfinite(least), least, 0.0).max())


def region_width(widths_rad: Sequence[float], config: PriorConfig) -> int:
    """Index of the width whose state separates sliding from near stiction; -1: there are no presliding states."""
    wide = [k for k, width in enumerate(widths_rad) if width >= config.region_width_rad]
    return wide[0] if wide else len(widths_rad) - 1


# --- Terms that a prior is made of.


Term, Kind = _core.Term, _core.TermKind
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
    """Friction and ripple of one joint, independent of other joints.

    A Coulomb term that training never saw level off, at 1.5 times its smoothing, is left out: it cannot be separated
    from the viscous one, and their difference grows beyond the speeds of training.

    Args:
        top_speed_rad_s: of the joint in training.
        load: friction grows with the load by ESTIMATED or CORRECTED model; None: no model can show it.
        local_memory: part of its presliding friction may have local memory; the setup's prior has its branch.
        play: index of the width that is half the joint's play, where it carries no load; None: none.
    """
    terms = [_core.Term(Kind.constant, joint), _core.Term(Kind.viscous, joint)]
    narrowest, *wider = config.coulomb_speeds_rad_s
    speeds = [narrowest, *(speed for speed in wider if 1.5 * speed <= top_speed_rad_s)]
    terms += [_core.Term(Kind.coulomb, joint, speed=speed) for speed in speeds]
    terms += [_core.Term(Kind.presliding, joint, b=width) for width in range(len(setup.widths_rad))]
    if setup.observer.unknown_constant and setup.observer.unknown_constant[joint]:
        terms.append(_core.Term(Kind.momentum, joint, joint, form=0))  # its inertia, as there is no model in its unit
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
    """Gravity and inertia from sines and cosines of single joints and pairs, for every joint: where there is no
    model."""
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
