r"""Growth of errors with the motion: weights of the core's error scale (cpp/src/alarm/error_scale.hpp).

With F_m >= 0 the features of a joint's motion, filtered as r is, and e = max(\|tau_ext\| - doubt, 0) on free motion not
used in training, the scale sigma = sum_m w_m F_m minimises

.. math:: \overline{\ln\sigma} + \frac1p \ln\overline{(e/\sigma)^p}, \qquad w \ge 0,

which is independent of a factor on sigma. p = 2 is the likelihood of a normal error with standard error sigma. A larger
p weights the largest errors, which set a limit: the average limit becomes lowest.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.optimize import minimize

from tauext import _core
from tauext.bundle.estimates import STALE
from tauext.config import DriftConfig, FreeMotionConfig, warm_up_s
from tauext.data.free_motion import cut, free_samples
from tauext.data.recording import Recording
from tauext.errors import TrainingError

# --- Samples of free motion from which limits follow, and the bundle's error there.


FOR_ERRORS = ("tau_ext", "doubt", "limit_scale")
"""Torque columns of the estimates that the error follows from."""


@dataclass(frozen=True)
class HeldOut:
    """A recording, the span that counts, and the bundle evaluated on it."""

    recording: Recording
    span: slice = field(default_factory=lambda: slice(None))
    bundle: _core.Bundle | None = None
    """A bundle fitted without these samples; None: the bundle itself, whose training did not contain them."""
    outputs: np.ndarray | None = None
    """The network's outputs (with_outputs); None: the network runs each time."""

    @property
    def motion(self) -> Recording:
        """The recording up to the end of the span, whose estimates do not depend on what follows."""
        recording, end = self.recording, self.span.stop
        return recording if end is None or end >= recording.samples else cut(recording, slice(0, end))


def with_outputs(bundle: _core.Bundle, recording: Recording, threads: int) -> HeldOut:
    """The recording with its network outputs, for several evaluations while limits and error scale are set."""
    outputs = _core.network_outputs(bundle, *recording.signals, threads, recording.temperature)
    return HeldOut(recording, outputs=outputs)


def whole_recordings(held_out: Sequence[Recording | HeldOut]) -> list[Recording]:
    """Each recording once, for any number of spans."""
    return list({id(r): r for r in (one.recording if isinstance(one, HeldOut) else one for one in held_out)}.values())


def judge(
    bundle: _core.Bundle,
    held_out: Recording | HeldOut,
    threads: int,
    margins: FreeMotionConfig,
    torques: Sequence[str] = FOR_ERRORS,
) -> tuple[Recording, dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """The motion up to the end of the span, its estimates, |tau_ext|, (samples, joints), and which samples count.

    |tau_ext| is divided by the bundle's error scale, if any, which gives its size in usual motion. Samples of free
    motion within the span count where tau_ext is compared with limits; that includes saturated drives, although they
    are unhealthy. The recording runs through the chain from its start, so that filters are warm at the span's start.

    Args:
        torques: torque columns of the estimates, FOR_ERRORS at least.
    """
    held_out = held_out if isinstance(held_out, HeldOut) else HeldOut(held_out)
    motion = held_out.motion
    estimates = _core.estimate(
        held_out.bundle or bundle, *motion.signals, threads, motion.temperature, held_out.outputs, list(torques)
    )
    counted = np.zeros(motion.samples, dtype=bool)
    counted[held_out.span] = True
    counted &= (
        (estimates["health"] != STALE)
        & np.isfinite(estimates["tau_ext"]).all(axis=1)
        & free_samples(held_out.recording, margins)[: motion.samples]
    )
    # Limits are raised by the prior's doubt, so it is not part of the error.
    error = np.maximum(np.abs(estimates["tau_ext"]) - estimates["doubt"], 0) / estimates["limit_scale"]
    return motion, estimates, error, counted


def judge_all(
    bundle: _core.Bundle,
    held_out: Iterable[Recording | HeldOut],
    threads: int,
    margins: FreeMotionConfig,
    torques: Sequence[str] = FOR_ERRORS,
) -> Iterator[tuple[Recording, dict[str, np.ndarray], np.ndarray, np.ndarray]]:
    """Yield judge() of each, in order. Up to four are estimated at a time, since only the network's part of an estimate
    runs in several threads.

    Args:
        threads: 0: one a core.
    """
    threads = threads or os.cpu_count() or 1
    workers = min(threads, 4)
    with ThreadPoolExecutor(workers) as pool:
        coming: deque[Future] = deque()
        for one in held_out:
            coming.append(pool.submit(judge, bundle, one, threads // workers, margins, torques))
            if len(coming) > workers:
                yield coming.popleft().result()
        while coming:
            yield coming.popleft().result()


def no_free_motion(bundle: _core.Bundle, margins: FreeMotionConfig) -> TrainingError:
    """Error for recordings without a sample that counts."""
    warm_s = warm_up_s(bundle.observer.gain_per_s, bundle.observer.low_pass_per_s)
    window = " and the network's window" if bundle.has_network else ""
    return TrainingError(
        f"thresholds need free motion: no recording has any beyond the warm-up of {warm_s:g} s{window}, with "
        f"{margins.before_s:g} s before and {margins.after_s:g} s after every contact, and samples of unknown contact "
        "(-1), left out"
    )


# --- The error scale.


FEATURES = tuple(_core.MotionFeature)


@dataclass(frozen=True)
class ErrorScaleConfig:
    """How the error scale is fitted."""

    sharp_hours: float = 1.0
    """Hours of held-out motion from which the limits' scale is fitted to the largest errors, with power `sharp` ..."""
    sharp: float = 8.0
    blunt: float = 4.0
    """... and below which to all errors, with this power: few hours have few large errors."""
    stood_s: float = 60.0
    """Least time at rest for a limit at rest, [s]. A joint that rested less gets at least the limit of usual motion,
    since friction at rest may hide more."""
    rests_rad_s: float = 0.002
    """Speed below which a joint rests, [rad/s]."""
    least_constant: float = 0.05
    """Least constant as a share of usual motion's scale, which keeps limits above zero."""
    most_rows: int = 1_000_000
    """Largest number of rows: over an hour and a half at the network's rate."""
    least_rows: int = 300
    """A region with fewer rows uses the standard error of both."""
    rest_share: float = 0.3
    """Standard error of a joint at rest before any rest was seen, as a share of its friction ..."""
    rest_worth: float = 10.0
    """... which counts as so many rests."""
    least_sigma: float = 0.2
    """Least constant of the standard error, as a share of the root mean square error."""


@dataclass(frozen=True)
class ErrorRows:
    """Free motion at the network's rate, or thinned out."""

    error_nm: np.ndarray  # (rows, joints)
    near_stiction: np.ndarray  # (rows, joints), bool
    features: np.ndarray  # (rows, joints, features)
    period_s: float
    """Period between two rows of a recording."""
    t_ns: np.ndarray  # (rows,)
    recording: np.ndarray  # (rows,): its number in `recordings`
    recordings: tuple[str, ...]
    config: ErrorScaleConfig = ErrorScaleConfig()

    @property
    def hours(self) -> float:
        """Hours of motion."""
        return len(self.error_nm) * self.period_s / 3600

    @property
    def power(self) -> float:
        """p of the limits' scale."""
        return self.config.sharp if self.hours >= self.config.sharp_hours else self.config.blunt

    def scale(self, weights: np.ndarray) -> np.ndarray:
        """The scale with these weights, (joints, features), in each row, (rows, joints)."""
        return np.einsum("rjf,jf->rj", self.features, weights)

    def of_joints(self, chosen: np.ndarray) -> ErrorRows:
        """The rows of these joints alone, (chosen,) indices."""
        names = ("error_nm", "near_stiction", "features")
        return replace(self, **{name: getattr(self, name)[:, chosen] for name in names})

    def only(self, inside: np.ndarray) -> ErrorRows:
        """Select rows, by (rows,) bool or indices."""
        names = ("error_nm", "near_stiction", "features", "t_ns", "recording")
        return replace(self, **{name: getattr(self, name)[inside] for name in names})


def fit_error_scale(
    bundle: _core.Bundle,
    rows: ErrorRows,
    drift: DriftConfig = DriftConfig(),  # noqa: B008
) -> dict:
    """Set a bundle's error scale and the floor of its drift tracker's freeze; returns facts for provenance.

    Args:
        rows: the bundle's errors (collect_rows).
    """
    bundle.error_scale = scale_of(rows)
    add_unseen(bundle, rows)
    blind_sigma(bundle)
    if bundle.drift.time_constant_s > 0:
        seen = freeze_floor_nm(rows.error_nm, drift, rows.period_s)
        drifted = drift.freeze_floor_share * np.array(bundle.drift.size_nm)
        bundle.drift.freeze_floor_nm = np.maximum(drifted, seen).tolist()
    return {"hours": rows.hours, "power": rows.power}


def limit_scale(bundle: _core.Bundle) -> dict:
    """The scale of the limits as facts: what is found on short motion raises it later (`asked_limits.put_floors`)."""
    scale = bundle.error_scale
    return {"limit_weights": list(scale.limit_weights), "largest": list(scale.largest)}


def put_limit_scale(bundle: _core.Bundle, facts: Mapping) -> None:
    """Set the scale of the limits from `limit_scale`; a bundle without these facts keeps its own."""
    if facts:
        scale = bundle.error_scale
        scale.limit_weights, scale.largest = facts["limit_weights"], facts["largest"]
        bundle.error_scale = scale


def put_constant_error(bundle: _core.Bundle, rows: ErrorRows) -> None:
    """Set the standard errors of a bundle with constant limits from these rows, sliding and near stiction."""
    scale = _core.ErrorScaleSettings()
    scale.features = [_core.MotionFeature.constant]
    scale.limit_weights = scale.largest = [1.0] * bundle.joints
    by_region = region_weights(rows, np.ones((*rows.error_nm.shape, 1)))[:, :, 0]
    scale.sigma_weights, scale.sigma_near_weights = by_region.tolist()
    scale.largest_sigma = by_region.max(axis=0).tolist()
    bundle.error_scale = scale
    blind_sigma(bundle)


def blind_sigma(bundle: _core.Bundle) -> None:
    """Give joints that are not monitored the arm's largest torque as standard error: forces do not follow them."""
    blind = ~np.array(bundle.monitored)
    scale, most_nm = bundle.error_scale, float(np.max(bundle.largest_torque_nm))
    for name in ("sigma_weights", "sigma_near_weights"):
        weights = np.array(getattr(scale, name)).reshape(bundle.joints, -1)
        weights[blind] = [most_nm, *[0.0] * (weights.shape[1] - 1)]
        setattr(scale, name, weights.ravel().tolist())
    scale.largest_sigma = np.where(blind, most_nm, scale.largest_sigma).tolist()
    bundle.error_scale = scale


def scale_of(rows: ErrorRows) -> _core.ErrorScaleSettings:
    """Fit an error scale to these rows."""
    weights = np.array([limit_weights(rows, j) for j in range(rows.error_nm.shape[1])])
    sliding, near = region_weights(rows, rows.features)
    scale = _core.ErrorScaleSettings()
    scale.features = list(FEATURES)
    scale.limit_weights = weights.ravel().tolist()
    scale.largest = rows.scale(weights).max(axis=0).tolist()
    scale.sigma_weights, scale.sigma_near_weights = sliding.ravel().tolist(), near.ravel().tolist()
    sigma = np.where(rows.near_stiction, rows.scale(near), rows.scale(sliding))
    scale.largest_sigma = sigma.max(axis=0).tolist()
    return scale


def add_unseen(bundle: _core.Bundle, rows: ErrorRows) -> None:
    r"""Add to the standard error what few rests do not show, and a floor that no motion undercuts.

    A joint at rest hides a part of its friction f, and all samples of a rest have the same error. With the mean squares
    e_i^2 of k rests and the configuration's worth and share, the standard error at rest is at least

    .. math:: s = \sqrt{(\text{worth} (\text{share} f)^2 + \sum_i e_i^2) / (\text{worth} + k)}

    Friction of other days is not added here: the monitor knows how uncertain it is (FrictionFactors::spread).
    """
    config, scale = rows.config, bundle.error_scale
    sliding, near = (
        np.array(weights).reshape(bundle.joints, -1) for weights in (scale.sigma_weights, scale.sigma_near_weights)
    )
    constant, standstill = (
        FEATURES.index(kind) for kind in (_core.MotionFeature.constant, _core.MotionFeature.standstill)
    )
    floor = config.least_sigma * np.sqrt(np.mean(rows.error_nm**2, axis=0))
    for weights in (sliding, near):
        weights[:, constant] = np.maximum(weights[:, constant], floor)
    for j, squares in enumerate(rest_squares(rows, k) for k in range(bundle.joints)):
        expected = config.rest_worth * (config.rest_share * bundle.prior.friction_at_rest_nm(j)) ** 2
        at_rest = np.sqrt((expected + squares.sum()) / (config.rest_worth + len(squares)))
        near[j, standstill] = max(near[j, standstill], at_rest - near[j, constant])
    scale.sigma_weights, scale.sigma_near_weights = sliding.ravel().tolist(), near.ravel().tolist()
    sigma = np.where(rows.near_stiction, rows.scale(near), rows.scale(sliding))
    scale.largest_sigma = np.maximum(sigma.max(axis=0), near[:, constant] + near[:, standstill]).tolist()
    bundle.error_scale = scale


def rest_sigma_nm(bundle: _core.Bundle) -> np.ndarray:
    """Standard error of each joint at rest, (joints,), [N m]."""
    scale, at_rest = bundle.error_scale, (_core.MotionFeature.constant, _core.MotionFeature.standstill)
    at = [k for k, kind in enumerate(scale.features) if kind in at_rest]
    return np.asarray(np.array(scale.sigma_near_weights).reshape(bundle.joints, -1)[:, at].sum(axis=1))


def rest_squares(rows: ErrorRows, joint: int) -> np.ndarray:
    """Mean square error of each rest of a joint, (rests,)."""
    speed = FEATURES.index(_core.MotionFeature.speed)
    rests = rows.near_stiction[:, joint] & (rows.features[:, joint, speed] < rows.config.rests_rad_s)
    at = np.flatnonzero(rests)
    if not len(at):
        return np.zeros(0)
    begins = np.flatnonzero(np.r_[True, (np.diff(at) > 1) | (np.diff(rows.recording[at]) != 0)])
    return np.add.reduceat(rows.error_nm[at, joint] ** 2, begins) / np.diff(np.r_[begins, len(at)])


def region_weights(rows: ErrorRows, features: np.ndarray) -> np.ndarray:
    """Weights of the standard error sliding and near stiction, (2, joints, features); a region with too few rows has
    those of both.

    Args:
        features: (rows, joints, features).
    """
    found = []
    for inside in (~rows.near_stiction, rows.near_stiction):
        enough = inside.sum(axis=0) >= rows.config.least_rows
        chosen = [inside[:, j] if enough[j] else slice(None) for j in range(len(enough))]
        found.append([sigma_weights(features[at, j], rows.error_nm[at, j]) for j, at in enumerate(chosen)])
    return np.array(found)


def add_friction(bundle: _core.Bundle, share: float, at_rest_nm: np.ndarray, per_speed: np.ndarray) -> None:
    """Add a share of the friction, at_rest_nm + per_speed |dq|, to limits that follow the error.

    The weights of the constant and the speed contain it, in units of the sliding collision limit; other limits grow in
    proportion.
    """
    scale, level = bundle.error_scale, np.array(bundle.sliding_limit_nm)
    weights = np.array(scale.limit_weights).reshape(bundle.joints, -1)
    weights[:, FEATURES.index(_core.MotionFeature.constant)] += share * at_rest_nm / level
    weights[:, FEATURES.index(_core.MotionFeature.speed)] += share * per_speed / level
    # The bound was the largest scale in training motion; add at most the friction at a very high speed, 3 rad/s.
    scale.largest = (np.array(scale.largest) + share * (at_rest_nm + per_speed * 3.0) / level).tolist()
    scale.limit_weights = weights.ravel().tolist()
    bundle.error_scale = scale


def largest_standardised(rows: ErrorRows) -> tuple[np.ndarray, np.ndarray]:
    """Limits that follow the error and that these rows do not exceed: sliding in usual motion, (joints,), and in each
    row, (rows, joints), [N m]."""
    scale = rows.scale(np.array([limit_weights(rows, j) for j in range(rows.error_nm.shape[1])]))
    sliding, near = (
        np.where(inside, rows.error_nm / scale, 0).max(axis=0) for inside in (~rows.near_stiction, rows.near_stiction)
    )
    near = np.maximum(sliding, near)
    sliding = np.where(sliding > 0, sliding, near)  # a joint that never slid
    return sliding, np.where(rows.near_stiction, near, sliding) * scale


def freeze_floor_nm(error_nm: np.ndarray, config: DriftConfig, period_s: float) -> np.ndarray:
    """Least |tau_ext| that freezes the drift tracker, (joints,), [N m].

    It is a common multiple of the joints' RMS errors. The multiple freezes the tracker in config.most_frozen of these
    rows, including freeze_s after each row above it.

    Args:
        error_nm: (rows, joints), period_s apart.
    """
    rms = np.sqrt(np.mean(error_nm**2, axis=0))
    over = (error_nm / np.maximum(rms, 1e-300)).max(axis=1)
    back = max(1, round(config.freeze_s / period_s) + 1)
    recent = maximum_filter1d(over, back, origin=(back - 1) // 2)  # includes this row and those before it
    return float(np.quantile(recent, 1 - config.most_frozen)) * rms


def collect_rows(
    bundle: _core.Bundle,
    held_out: Iterable[Recording | HeldOut],
    threads: int,
    margins: FreeMotionConfig = FreeMotionConfig(),  # noqa: B008
    config: ErrorScaleConfig = ErrorScaleConfig(),
) -> ErrorRows:
    """Collect errors and features of free motion, one row a network period, thinned to at most config.most_rows.

    Raises:
        TrainingError: no free motion.
    """
    plain = with_unit_scale(bundle)
    found: list[tuple[np.ndarray, ...]] = []
    stride, count = bundle.observer.network_stride, 0
    numbers: dict[str, int] = {}
    for r, estimates, error, counted in judge_all(bundle, held_out, threads, margins):
        at = np.flatnonzero(counted)[::stride].astype(np.int64)
        if len(at) == 0:
            continue
        near = estimates["near_stiction"]
        motion = _core.motion_errors(plain, r.t_ns, r.dq, near, estimates["entered"], estimates["restarted"], at)
        number = np.full(len(at), numbers.setdefault(r.name, len(numbers)))
        found.append((error[at], near[at].astype(bool), motion["features"], r.t_ns[at], number))
        count += len(at)
        if count > config.most_rows:  # thin out evenly
            found = [tuple(column[::2] for column in rows) for rows in found]
            count, stride = sum(len(rows[0]) for rows in found), 2 * stride
    if not found:
        raise no_free_motion(bundle, margins)
    error, near, features, t_ns, number = (np.concatenate(column) for column in zip(*found, strict=True))
    period_s = 1e-9 * bundle.observer.sample_period_ns * stride
    return ErrorRows(error, near, features, period_s, t_ns, number, tuple(numbers), config)


def limit_weights(rows: ErrorRows, joint: int) -> np.ndarray:
    """Weights of a joint's limits, (features,): the scale's median is 1, and it is never below its least constant."""
    features, config = rows.features[:, joint], rows.config
    weights = fit_weights(features, rows.error_nm[:, joint], rows.power)
    weights = weights / float(np.median(features @ weights))
    weights[0] = max(weights[0], config.least_constant)
    speed, standstill = (FEATURES.index(kind) for kind in (_core.MotionFeature.speed, _core.MotionFeature.standstill))
    stood_s = 3600 * rows.hours * float(np.mean(features[:, speed] < config.rests_rad_s))
    if stood_s < config.stood_s:
        weights[standstill] = max(weights[standstill], 1.0 - weights[0])
    return weights


def with_unit_scale(bundle: _core.Bundle) -> _core.Bundle:
    """A copy of the bundle whose error scale is 1 and has all features."""
    plain = _core.Bundle.from_bytes(bundle.to_bytes())
    plain.error_scale = unit_scale(bundle.joints)
    return plain


def features_of(bundle: _core.Bundle, t_ns: np.ndarray, dq: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Features of a motion without gaps at these samples, (rows, joints, features)."""
    sliding, every, none = np.zeros(dq.shape, np.uint8), np.ones(len(dq), np.uint8), np.zeros(len(dq), np.uint8)
    motion = _core.motion_errors(with_unit_scale(bundle), t_ns, dq, sliding, every, none, at)
    features: np.ndarray = motion["features"]
    return features


def unit_scale(joints: int) -> _core.ErrorScaleSettings:
    """Scale with all features that is 1 for any motion."""
    scale = _core.ErrorScaleSettings()
    scale.features = list(FEATURES)
    constant = [1.0] + [0.0] * (len(FEATURES) - 1)
    scale.limit_weights = scale.sigma_weights = scale.sigma_near_weights = constant * joints
    scale.largest = scale.largest_sigma = [1.0] * joints
    return scale


def sigma_weights(features: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Weights of the standard error, scaled so that as many errors lie within it as of normal ones.

    If most errors are 0 (a servo exactly at its goal), the scale is their root mean square.
    """
    weights = fit_weights(features, error, 2.0)
    sigma = features @ weights
    scaled = weights * float(np.quantile(error / sigma, 0.6827))  # normal errors within one standard error
    rms = float(np.sqrt(np.mean(error**2)))
    return scaled if scaled.any() else np.r_[max(rms, 1e-6), np.zeros(len(weights) - 1)]


def fit_weights(features: np.ndarray, error: np.ndarray, power: float) -> np.ndarray:
    """Fit the weights w >= 0 of the module's equation, (features,), up to a factor; the constant's is above 0."""
    if not error.any():  # no error in any motion: only the constant
        return np.r_[1.0, np.zeros(features.shape[1] - 1)]
    size = features.mean(axis=0)
    used = size > 0
    F = features[:, used] / size[used]
    e = error / max(float(np.sqrt(np.mean(error**2))), 1e-300)

    def loss(w: np.ndarray) -> tuple[float, np.ndarray]:
        sigma = F @ w
        ratio = e / sigma
        top = max(float(ratio.max()), 1e-300)
        high = (ratio / top) ** power
        total = float(high.sum())
        value = float(np.log(sigma).mean()) + np.log(top) + np.log(total / len(e)) / power
        return value, (F / sigma[:, None]).mean(axis=0) - (F / sigma[:, None]).T @ high / total

    start = np.full(F.shape[1], 1.0 / F.shape[1])
    bounds = [(0.005, None)] + [(0, None)] * (F.shape[1] - 1)
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 200})
    weights = np.zeros(len(size))
    weights[used] = np.maximum(found.x, [low for low, _ in bounds]) / size[used]  # SciPy may end at -1e-19
    return weights
