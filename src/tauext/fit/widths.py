"""Which presliding widths the data have a use for."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext.config import PriorConfig
from tauext.data.recording import Recording
from tauext.fit.prior_fit import PriorFit
from tauext.fit.training_set import Setup

BENT = (_core.TermKind.presliding, _core.TermKind.load_presliding)
LEAST_COUNTS = 2.0  # an encoder's counts in a presliding width
IDLE_SHARE = 0.002
ROUNDING_RAD = 1e-9
"""A smaller change of position is rounding, as of a conversion from degrees: a count of 32 bits is 1.5e-9 rad."""


def idle_widths(setup: Setup, recordings: Sequence[Recording], config: PriorConfig, fit: PriorFit) -> dict[float, str]:
    """Presliding widths that the data have no use for, with the reason, from the narrowest up.

    A width below LEAST_COUNTS counts of the encoder follows the last count's flicker and not the joint. Any other goes
    if without it, and without those that went before, the error on left-out recordings grows by less than IDLE_SHARE in
    every joint. The width that tells the limit's region stays.
    """
    regression, dropped = fit.regression, {}
    count_rad = encoder_count(recordings)
    _, all_nm = regression.choose_ridge()
    region = region_width(setup.widths_rad, config)
    for k, width in enumerate(setup.widths_rad):
        if k == region:
            continue
        columns = [m for m, term in enumerate(fit.settings.terms) if term.kind in BENT and term.b == k]
        was = regression.used[columns].copy()
        regression.used[columns] = False
        if width < LEAST_COUNTS * count_rad:
            dropped[width] = f"narrower than {LEAST_COUNTS:g} encoder counts of {count_rad:.2g} rad"
            continue
        _, without_nm = regression.choose_ridge()
        growth = float((without_nm / np.maximum(all_nm, 1e-300) - 1).max())
        if growth < IDLE_SHARE:
            dropped[width] = f"without it the error grows by {max(growth, 0.0):.2%}, less than {IDLE_SHARE:.1%}"
        else:
            regression.used[columns] = was
    return dropped


def encoder_count(recordings: Sequence[Recording]) -> float:
    """Smallest change of position that any joint's encoder shows, the coarsest of the joints, [rad]."""
    moved = [np.abs(np.diff(recording.q, axis=0)) for recording in recordings]
    least = np.min([np.where(m > ROUNDING_RAD, m, np.inf).min(axis=0, initial=np.inf) for m in moved], axis=0)
    return float(np.where(np.isfinite(least), least, 0.0).max())


def region_width(widths_rad: Sequence[float], config: PriorConfig) -> int:
    """Index of the width whose state tells sliding from near stiction; -1: there are no presliding states."""
    wide = [k for k, width in enumerate(widths_rad) if width >= config.region_width_rad]
    return wide[0] if wide else len(widths_rad) - 1
