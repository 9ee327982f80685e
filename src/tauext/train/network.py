"""The network on the residual of observer and prior, and the observer gain, both from data."""

from __future__ import annotations

import hashlib
import json

import numpy as np

from tauext._core import Bundle, Tree
from tauext.config import PAPER_GAIN_PER_S
from tauext.fit.bundle_writing import make_bundle, set_signal_ranges
from tauext.fit.network_training import Progress, ScaledNetwork, train_network
from tauext.fit.prior_terms import PriorFit
from tauext.fit.stable_choice import simplest
from tauext.fit.training_set import Setup, TooShort, build_windows, find_scaling
from tauext.train.error_scale import collect_rows, largest_standardised
from tauext.train.fitting import observe, put_region, with_fit
from tauext.train.limits import unseen_motion
from tauext.train.preparation import Job

# --- The network on the residual of observer and prior, and its bundle.


CHECKPOINT = ".checkpoint.npz"
"""Ending of a network's checkpoint, beside the bundle until that is written."""


def fit_network(job: Job, setup: Setup) -> ScaledNetwork | None:
    """Train the recipe's network, or return that of the start; None: the recipe has none, or the motion is too short
    and there is a prior.

    Raises:
        TrainingError: too little data, or a loss that diverges.
    """
    if (started := job.start.network()) is not None:
        return started
    if not job.motion.network:
        return None
    with job.times.phase("windows"):
        scaling = find_scaling(setup, job.motion.training)
    with job.report.progress(f"train {job.name}") as show:

        def report(p: Progress) -> None:
            show(p.step, p.steps, f"loss {p.loss:.3g} validation {p.validation_loss:.3g}")

        try:
            with job.times.phase("windows"):
                training = build_windows(setup, scaling, job.motion.training)
                validation = build_windows(setup, scaling, job.motion.validation)
            trained = train_network(
                setup,
                training,
                validation,
                job.config,
                checkpoint_path=job.out.with_suffix(CHECKPOINT),
                settings={key: job.run[key] for key in ("settings", "recordings")} | {"robot": model_digest(job.tree)},
                report=report,
            )
        except TooShort as error:
            if not job.config.row.gated:
                raise
            job.notes.append(f"prior only: {error}")
            return None
    job.times.seconds["train"] = trained.seconds
    return ScaledNetwork(scaling, trained)


def assemble(job: Job, setup: Setup, network: ScaledNetwork | None = None) -> Bundle:
    """Make the bundle of this setup, without limits.

    Raises:
        TrainingError: all recordings are shorter than a window.
    """
    learned = (network.scaling, network.trained) if network else ()
    bundle = make_bundle(job.name, setup, job.config.observer.near_stiction_rad_s, job.reference(setup), *learned)
    bundle.units = job.units
    # Set before gate and limits, which use the same signal watch as the control loop.
    set_signal_ranges(bundle, job.training, job.possible.torque_limit_nm, job.possible.bounds)
    return bundle


def model_digest(tree: Tree) -> str:
    """SHA-256 of the model's numbers, so that checkpoints of another model are not resumed."""
    fields = ("joint_name", "parent", "rotation", "translation", "mass", "com", "inertia", "rotor_inertia")
    numbers = [[getattr(link, field) for field in fields] for link in tree.links]
    return hashlib.sha256(json.dumps([numbers, tree.gravity]).encode()).hexdigest()


# --- Observer gain from data: a fast observer detects a hit sooner, a slow one suppresses more errors.


GAINS_PER_S = (PAPER_GAIN_PER_S, 50.0, 100.0)
MOST_A_STEP = 0.5
"""Largest K0 times sample period."""
HIT = 4.0
"""Hit for comparing gains, in limits of the first gain; equal torque for all gains ..."""
HIT_S = 0.06
"""... as a half sine of this length, between hits of a hard and a padded shell ..."""
LATEST_S = 0.2
"""... with this delay if it stays below the limit."""
WORTH = 0.05
"""Share by which a faster observer must detect the hit sooner: it has more noise and detects slow pushes later."""


def choose_gain(job: Job, setup: Setup, fit: PriorFit) -> tuple[Setup, PriorFit]:
    """Choose the gain that detects a hit soonest; returns setup and prior, unchanged if that is the first gain.

    Gains are compared by the time until the response passes a limit, on the mean over joints and all held-out motion.
    Each gain has its own error scale and the limits that this motion does not exceed. The prior's terms are those
    chosen at the first gain, refitted for each.

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
    limits = {gain: limits_of_gain(job, *one) for gain, one in tried.items()}
    hit_nm = HIT * limits[PAPER_GAIN_PER_S][0]
    delay_s = {gain: mean_delay_s(gain, limit_nm, hit_nm) for gain, (_, limit_nm) in limits.items()}
    chosen = simplest(list(delay_s), delay_s.__getitem__, WORTH)
    delays = ", ".join(f"{1e3 * delay:.0f} ms at {gain:g} 1/s" for gain, delay in delay_s.items())
    job.facts["gain"] = {
        "chosen_per_s": chosen,
        "hit_nm": dict(zip(job.joints, hit_nm.tolist(), strict=True)),
        "mean_delay_s": {f"{gain:g}": delay for gain, delay in delay_s.items()},
        "reason": f"a hit of {HIT:g} times the limit at {PAPER_GAIN_PER_S:g} 1/s is found after {delays}",
    }
    return tried[chosen]


def limits_of_gain(job: Job, setup: Setup, fit: PriorFit) -> tuple[np.ndarray, np.ndarray]:
    """Limits of a bundle with this gain on motion not used in its fit (largest_standardised)."""
    bundle = assemble(job, with_fit(setup, fit))
    put_region(job, bundle, fit)
    unseen, left_out = unseen_motion(job, bundle, setup, fit)
    return largest_standardised(collect_rows(bundle, [*unseen, *left_out], job.threads, job.config.margins))


def mean_delay_s(gain_per_s: float, limit_nm: np.ndarray, hit_nm: np.ndarray) -> float:
    r"""Mean time until a hit of hit_nm, (joints,), exceeds limit_nm, (rows, joints), [s]; LATEST_S if never.

    The observer's response to a half sine S sin(w t), w = pi / HIT_S, is

    .. math:: S \frac{K_0}{K_0^2 + w^2}\left(K_0 \sin w t - w \cos w t + w\,e^{-K_0 t}\right), \quad t \le HIT\_S.
    """
    t, w = np.linspace(0, HIT_S, 601), np.pi / HIT_S
    response = gain_per_s * np.sin(w * t) - w * np.cos(w * t) + w * np.exp(-gain_per_s * t)
    highest = np.maximum.accumulate(gain_per_s / (gain_per_s**2 + w**2) * response)
    passed = np.searchsorted(highest, limit_nm / hit_nm)
    return float(np.append(t, LATEST_S)[passed].mean())
