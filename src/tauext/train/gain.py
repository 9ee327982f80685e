"""The observer's gain, from the data: a fast observer shows a hit sooner, and a slow one hides more of the errors."""

from __future__ import annotations

import numpy as np

from tauext.config import PAPER_GAIN_PER_S
from tauext.fit.prior_fit import PriorFit
from tauext.fit.ties import simplest
from tauext.fit.training_set import Setup
from tauext.train.error_scale import LeftOutErrors, left_out_errors
from tauext.train.fitting import observe, put_region, with_fit
from tauext.train.limits import unseen_motion
from tauext.train.network import assemble
from tauext.train.preparation import Job

GAINS_PER_S = (PAPER_GAIN_PER_S, 50.0, 100.0)
MOST_A_STEP = 0.5
"""Largest K0 times sample period: a faster observer follows samples, not the arm."""
HIT = 4.0
"""What gains are compared by is a hit of so many limits of the first gain: the same torque for all of them ..."""
HIT_S = 0.06
"""... a half sine of this length, between those of a hard shell and of a padded one ..."""
LATEST_S = 0.2
"""... that counts as found so late where it stays below the limit."""
WORTH = 0.05
"""A faster observer must find the hit sooner by this share: it shows more of all noise, and finds slow pushes later."""


def choose_gain(job: Job, setup: Setup, fit: PriorFit) -> tuple[Setup, PriorFit]:
    """The setup and the prior with the gain that finds a hit soonest; both as they are where that is the first.

    The time at which its response passes a limit is compared on the mean over joints and all left-out motion, with each
    gain's own error scale and the limits that nothing of that motion passes. The terms of the prior are those chosen at
    the first gain, fitted anew to each.

    Args:
        setup: without the prior, at the first gain.
    """
    assert fit.refit is not None
    period_s = 1e-9 * setup.observer.sample_period_ns
    tried = {PAPER_GAIN_PER_S: (setup, fit)}
    for gain in GAINS_PER_S[1:]:
        if gain * period_s <= MOST_A_STEP:
            other = observe(job, gain)
            tried[gain] = (other, fit.refit(other))
    if len(tried) == 1:
        job.facts["gain"] = {"chosen_per_s": PAPER_GAIN_PER_S, "reason": "samples are too far apart for a faster one"}
        return setup, fit
    errors = {gain: of_gain(job, *one) for gain, one in tried.items()}
    hit_nm = HIT * errors[PAPER_GAIN_PER_S].usual_limit_nm
    delay_s = {gain: mean_delay_s(gain, errors[gain].limit_nm, hit_nm) for gain in tried}
    chosen = simplest(list(delay_s), delay_s.__getitem__, WORTH)
    told = ", ".join(f"{1e3 * delay:.0f} ms at {gain:g} 1/s" for gain, delay in delay_s.items())
    job.facts["gain"] = {
        "chosen_per_s": chosen,
        "hit_nm": dict(zip(job.joints, hit_nm.tolist(), strict=True)),
        "mean_delay_s": {f"{gain:g}": delay for gain, delay in delay_s.items()},
        "reason": f"a hit of {HIT:g} times the limit at {PAPER_GAIN_PER_S:g} 1/s is found after {told}",
    }
    return tried[chosen]


def of_gain(job: Job, setup: Setup, fit: PriorFit) -> LeftOutErrors:
    """What a bundle of this gain would be wrong by on motion that it has not seen."""
    bundle = assemble(job, with_fit(setup, fit))
    put_region(job, bundle, fit)
    unseen, left_out = unseen_motion(job, bundle, setup, fit)
    return left_out_errors(bundle, [*unseen, *left_out], job.threads, job.config.margins)


def mean_delay_s(gain_per_s: float, limit_nm: np.ndarray, hit_nm: np.ndarray) -> float:
    r"""Mean time after which a hit of hit_nm, (joints,), is over limit_nm, (rows, joints), LATEST_S where never, [s].

    A half sine S sin(w t), w = pi / HIT_S, shows behind the observer as

    .. math:: S \frac{K_0}{K_0^2 + w^2}\left(K_0 \sin w t - w \cos w t + w\,e^{-K_0 t}\right), \quad t \le HIT\_S.
    """
    t, w = np.linspace(0, HIT_S, 601), np.pi / HIT_S
    response = gain_per_s * np.sin(w * t) - w * np.cos(w * t) + w * np.exp(-gain_per_s * t)
    highest = np.maximum.accumulate(gain_per_s / (gain_per_s**2 + w**2) * response)
    passed = np.searchsorted(highest, limit_nm / hit_nm)
    return float(np.append(t, LATEST_S)[passed].mean())
