"""The observer's gain, from the data: a fast observer shows a push sooner, and a slow one more of what errors hide."""

from __future__ import annotations

import numpy as np

from tauext.calibrate import LeftOutErrors, left_out_errors
from tauext.config import PAPER_GAIN_PER_S
from tauext.learn import PriorFit, Setup
from tauext.train.fitting import observe, put_region, with_fit
from tauext.train.limits import unseen_motion
from tauext.train.network import assemble
from tauext.train.preparation import Job

GAINS_PER_S = (PAPER_GAIN_PER_S, 50.0, 100.0)
MOST_A_STEP = 0.5
"""Largest K0 times sample period: a faster observer follows samples, not the arm."""
PUSH = 1.5
"""The push that gains are compared by, in limits of the first gain: the same torque for all of them."""
PUSH_S = 0.2
"""How long it lasts; one that is not found counts as so late."""
WORTH = 0.03
"""A faster observer must find the push sooner by this share: it shows more of every noise."""


def choose_gain(job: Job, setup: Setup, fit: PriorFit) -> tuple[Setup, PriorFit]:
    """The setup and the prior with the gain that finds a push soonest; both as they are where that is the first.

    A step of S_j [N m] shows in r as S_j (1 - exp(-K0 t)), and passes a limit L at t = -ln(1 - L / S_j) / K0. The mean
    of min(t, PUSH_S) over joints and all left-out motion is compared, with each gain's own error scale and the limits
    that would be as rarely passed. The terms of the prior are those chosen at the first gain, fitted anew to each.

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
    push_nm = PUSH * errors[PAPER_GAIN_PER_S].usual_limit_nm
    delay_s = {gain: mean_delay_s(gain, errors[gain].limit_nm, push_nm) for gain in tried}
    soonest = min(delay_s.values())
    chosen = min(gain for gain, delay in delay_s.items() if delay <= (1 + WORTH) * soonest)
    told = ", ".join(f"{1e3 * delay:.0f} ms at {gain:g} 1/s" for gain, delay in delay_s.items())
    job.facts["gain"] = {
        "chosen_per_s": chosen,
        "push_nm": dict(zip(job.joints, push_nm.tolist(), strict=True)),
        "mean_delay_s": {f"{gain:g}": delay for gain, delay in delay_s.items()},
        "reason": f"a push of {PUSH:g} times the limit at {PAPER_GAIN_PER_S:g} 1/s is found after {told}",
    }
    return tried[chosen]


def of_gain(job: Job, setup: Setup, fit: PriorFit) -> LeftOutErrors:
    """What a bundle of this gain would be wrong by on motion that it has not seen."""
    bundle = assemble(job, with_fit(setup, fit))
    put_region(job, bundle, fit)
    unseen, left_out = unseen_motion(job, bundle, setup, fit)
    return left_out_errors(bundle, [*unseen, *left_out], job.threads, job.config.margins)


def mean_delay_s(gain_per_s: float, limit_nm: np.ndarray, push_nm: np.ndarray) -> float:
    """Mean time after which a step of push_nm, (joints,), is over limit_nm, (rows, joints), PUSH_S at most, [s]."""
    share = np.minimum(limit_nm / push_nm, 1 - 1e-12)
    return float(np.minimum(-np.log1p(-share) / gain_per_s, PUSH_S).mean())
