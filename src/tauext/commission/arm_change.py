"""Names what has changed on the arm: the load in its hand, or single joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.data.free_motion import free_samples
from tauext.data.recording import Recording
from tauext.errors import TauextError
from tauext.monitor.weighing import ROW_S, expect_weighable, identify, load_frame, see

MOST_LEFT = 0.3
"""Largest share of the squared errors that a named load leaves. On two simulated arms, loads of 0.3 kg and more left
at most 0.18 of them; the best load left at least 0.97 of those of another friction."""
ERRORS, SHARE = 2.0, 0.05
"""A mass is named with so many standard errors, at least this share of it; and if it exceeds twice as many."""
USUAL, ODD = 2.0, 5.0
"""Error of a joint, divided by that of training: up to the first the joint is as before; from the second it is not."""
ONE_SIGMA = 0.683
LEAST_FREE_S = 10.0


@dataclass(frozen=True)
class LoadChange:
    """A load that explains the torques."""

    mass_kg: float
    """Beside what the arm carried in training; negative: it carries less."""
    within_kg: float
    lever_m: float | None
    """Distance of its centre of mass from the load frame; None: the motion does not determine it."""
    frame: str


def find_change(
    bundle: _core.Bundle, recordings: Sequence[Recording], threads: int
) -> tuple[LoadChange | None, dict[str, float]]:
    """Weigh what the arm carries beside the load of training, in motion without labelled touches.

    An alarm that stands all the time leaves none; all motion is then weighed.

    Returns:
        The load; None if no load explains the torques. The error of each joint, divided by that of training; empty if
        a force explains it, or if the bundle has no robot model that accepts loads.
    """
    settings = bundle.load_settings
    if not settings.settable or not any(link.mass > 0 for link in bundle.links):
        return None, {}
    try:
        expect_weighable(bundle)
        parts, where = [see(bundle, one, threads) for one in recordings], load_frame(bundle)
        free = [one.part(free_samples(one.recording)[one.samples]) for one in parts]
        if sum(one.rows for one in free) * ROW_S >= LEAST_FREE_S:
            parts = free
        # As if the largest load were set: the arm may carry less than in training, too.
        found = identify(bundle, where, parts, settings.largest_reach_m, beside=_core.Load(settings.largest_mass_kg))
    except TauextError:  # torques in amperes, or too little motion
        return None, {}
    if found.verdict == "contact":
        return None, {}
    explains = found.fits["load"].cost < MOST_LEFT * found.fits["nothing"].cost
    if explains and found.mass_seen and abs(found.mass_kg) > 2 * ERRORS * found.mass_error_kg:
        lever = None if found.unseen else float(np.linalg.norm(found.com_m))
        within_kg = max(ERRORS * found.mass_error_kg, SHARE * abs(found.mass_kg))
        return LoadChange(found.mass_kg, within_kg, lever, where.name), {}
    errors = np.quantile(np.concatenate([np.abs(one.tau_ext) / one.sigma for one in parts]), ONE_SIGMA, axis=0)
    return None, dict(zip([link.joint_name for link in bundle.links], errors.tolist(), strict=True))


def change_words(load: LoadChange | None, errors: Mapping[str, float], why: str) -> str:
    """A question about a change of the arm.

    Args:
        errors: error of each joint, divided by that of training; empty: unknown.
        why: why no friction explains the torques.
    """
    if load is not None:
        more = f"{abs(load.mass_kg):.2f} kg {'more' if load.mass_kg > 0 else 'less'}"
        at = "" if load.lever_m is None else f", {1e3 * load.lever_m:.0f} mm from the origin of {load.frame}"
        within = f"within {max(load.within_kg, 0.01):.2f} kg{at}"
        return f"the hand carries {more} than in training ({within}): another tool or load?"
    odd = {joint: error for joint, error in errors.items() if error > USUAL}
    if odd and len(odd) <= max(1, len(errors) // 3) and min(odd.values()) >= ODD:
        named = " and ".join(f"{joint} (error {error:.3g} times that of training)" for joint, error in odd.items())
        return f"only {named} {'is' if len(odd) == 1 else 'are'} not as before: gear, damage, or a weight on that link?"
    return f"the arm is not as before, and no friction explains it (tool, load or damage?): {why}"
