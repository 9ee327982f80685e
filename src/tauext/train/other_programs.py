r"""Errors of a prior in programs that its motion does not contain.

Minutes of motion leave some of the prior undetermined: the inertia that a faster program needs, or the friction of a
joint that hardly moved. Its five fits without a fifth of the motion disagree where this matters. With tau_k the prior
without fold k of F, and tau the prior of all motion, the jackknife's standard error of one sample is

.. math:: s = \sqrt{\frac{F - 1}{F} \sum_k (\tau_k - \tau)^2}

It is evaluated in motion of the arm's own joints in other combinations, and faster: each joint repeats a span of its
recorded motion, drawn for it alone, at one of `paces`. There the error scale must reach `times` standard errors. Where
a joint rests there, s is a part of sigma: recordings hold few resting poses, often the same ones.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.data.recording import Recording
from tauext.fit.prior_terms import PriorFit
from tauext.fit.training_set import Setup
from tauext.train.error_scale import FEATURES, ErrorRows, features_of, fit_weights, rest_sigma_nm


@dataclass(frozen=True)
class OtherProgramsConfig:
    """Programs that stand for those to come."""

    times: float = 3.0
    """Standard errors of the prior that the error scale reaches."""
    paces: tuple[float, ...] = (1.0, 1.5, 2.0)
    """Speed of each program, in multiples of the recorded one."""
    pace_s: float = 100.0
    """Length of the programs of each pace, [s]."""
    program_s: float = 15.0
    """Length of one program, [s]."""
    shortest_s: float = 5.0
    """A shorter recording takes no part, [s]."""
    share: float = 0.99
    """Share of the samples in which the scale reaches the standard errors."""
    power: float = 8.0
    """The largest standard errors decide which features the scale grows with, see error_scale."""
    seed: int = 0


def widen_for_other_programs(
    bundle: _core.Bundle,
    setup: Setup,
    fit: PriorFit,
    recordings: Sequence[Recording],
    rows: ErrorRows,
    config: OtherProgramsConfig = OtherProgramsConfig(),
) -> tuple[dict, np.ndarray]:
    """Let the error scale of limits grow with the prior's standard error in other programs.

    The scale remains 1 in the median of the recorded motion, and its largest value is that of this motion. Sigma at
    rest grows too. Returns facts, and what was added to the weights, (joints, features), for a scale of 1 before.

    Args:
        bundle: with the error scale of the recorded motion.
        fit: its prior, with the fits without a fold.
        rows: errors from which the scale follows.
    """
    usable = [recording for recording in recordings if recording.duration_s > config.shortest_s]
    if len(fit.left_out) < 3 or not usable:
        return {}, np.zeros((bundle.joints, rows.features.shape[2]))
    features, spread_nm = spread_rows(bundle, setup, fit, usable, config)
    scale = bundle.error_scale
    weights = np.array(scale.limit_weights).reshape(bundle.joints, -1)
    before, added = rows.scale(weights), np.zeros_like(weights)
    for j in range(bundle.joints):
        level_nm = max(float(np.quantile(rows.error_nm[:, j] / before[:, j], 0.999)), 1e-12)
        own = features[:, j]
        reached = own @ weights[j]
        missing = np.hypot(reached, config.times * spread_nm[:, j] / level_nm) - reached
        if missing.any():
            more = fit_weights(own, missing, config.power)
            added[j] = more * float(np.quantile(missing / (own @ more), config.share))
    weights = weights + added
    # As in the recorded motion: a collision moves the arm faster than any program, and must not raise its limit.
    largest = rows.scale(weights).max(axis=0)
    usual = np.median(rows.scale(weights), axis=0)
    scale.limit_weights, scale.largest = (weights / usual[:, None]).ravel().tolist(), (largest / usual).tolist()
    bundle.error_scale = scale
    names, of_motion_nm = [link.joint_name for link in bundle.links], rest_sigma_nm(bundle)
    add_at_rest(bundle, features, spread_nm, rows.config.rests_rad_s)
    facts = {
        "rest_sigma_nm": dict(zip(names, of_motion_nm.tolist(), strict=True)),
        "standard_error_nm": dict(zip(names, np.sqrt((spread_nm**2).mean(axis=0)).tolist(), strict=True)),
        "scale_grew_by": dict(zip(names, usual.tolist(), strict=True)),
    }
    return facts, added


def add_at_rest(bundle: _core.Bundle, features: np.ndarray, spread_nm: np.ndarray, rests_rad_s: float) -> None:
    """Add the prior's standard error where each joint rests to sigma at rest, in squares.

    Args:
        features, spread_nm: see spread_rows.
        rests_rad_s: speed below which a joint rests.
    """
    scale, speed = bundle.error_scale, FEATURES.index(_core.MotionFeature.speed)
    near = np.array(scale.sigma_near_weights).reshape(bundle.joints, -1)
    before = rest_sigma_nm(bundle)
    rests = features[:, :, speed] < rests_rad_s
    squares = (rests * spread_nm**2).sum(axis=0) / np.maximum(rests.sum(axis=0), 1)
    after = np.hypot(before, np.sqrt(squares))
    near[:, FEATURES.index(_core.MotionFeature.standstill)] += after - before
    scale.sigma_near_weights = near.ravel().tolist()
    scale.largest_sigma = np.maximum(scale.largest_sigma, after).tolist()
    bundle.error_scale = scale


def spread_rows(
    bundle: _core.Bundle,
    setup: Setup,
    fit: PriorFit,
    recordings: Sequence[Recording],
    config: OtherProgramsConfig = OtherProgramsConfig(),
) -> tuple[np.ndarray, np.ndarray]:
    """Features of other programs, (rows, joints, features), and the prior's standard error there, (rows, joints)."""
    rng = np.random.default_rng(config.seed)
    folds = [one.settings for one in fit.left_out]
    features, spread = [], []
    for t_ns, q, dq in (one for pace in config.paces for one in programs(recordings, pace, rng, config)):

        def observe(
            settings: _core.PriorSettings, t_ns: np.ndarray = t_ns, q: np.ndarray = q, dq: np.ndarray = dq
        ) -> _core.Observation:
            return _core.observe(setup.tree, setup.observer, t_ns, q, dq, np.zeros_like(q), settings)

        whole = observe(fit.settings)
        at = np.flatnonzero(whole.warm)[:: setup.observer.network_stride].astype(np.int64)
        squares = sum((observe(one).prior[at] - whole.prior[at]) ** 2 for one in folds)
        features.append(features_of(bundle, t_ns, dq, at))
        spread.append(np.sqrt((len(folds) - 1) / len(folds) * squares))
    return np.concatenate(features), np.concatenate(spread)


def programs(
    recordings: Sequence[Recording], pace: float, rng: np.random.Generator, config: OtherProgramsConfig
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Stamps [ns], positions and velocities of programs at this pace, config.pace_s in all."""
    left_s = config.pace_s
    while left_s > 0:
        recording = recordings[int(rng.integers(len(recordings)))]
        length_s = min(config.program_s, 0.8 * recording.duration_s / pace)
        t = np.arange(int(length_s * recording.rate_hz)) / recording.rate_hz
        q, dq = np.empty((2, len(t), len(recording.joints)))
        for j, start in enumerate(rng.uniform(0, recording.duration_s - pace * length_s, len(recording.joints))):
            at = recording.time_s[0] + start + pace * t
            q[:, j] = np.interp(at, recording.time_s, recording.q[:, j])
            dq[:, j] = pace * np.interp(at, recording.time_s, recording.dq[:, j])
        yield 1_000_000_000 + np.round(1e9 * t).astype(np.int64), q, dq
        left_s -= length_s
