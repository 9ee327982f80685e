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
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.optimize import minimize

from tauext import _core
from tauext.bundle.estimates import STALE
from tauext.config import AlarmConfig, DriftConfig, FreeMotionConfig, warm_up_s
from tauext.data.free_motion import cut, free_samples, standing_joints
from tauext.data.recording import Recording
from tauext.errors import TrainingError

# --- Samples of free motion from which limits follow, and the bundle's error there.


AT_A_TIME = 4
"""Most recordings estimated at a time."""
FOR_ERRORS = ("tau_ext", "doubt", "limit_scale")
"""Torque columns of the estimates that the error follows from."""


@dataclass(frozen=True)
class Judged:
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


def with_outputs(bundle: _core.Bundle, recording: Recording, threads: int) -> Judged:
    """The recording with its network outputs, for several evaluations while limits and error scale are set."""
    signals = (recording.t_ns, recording.q, recording.dq, recording.tau)
    outputs = _core.network_outputs(bundle, *signals, threads, recording.temperature)
    return Judged(recording, outputs=outputs)


def whole_recordings(judged: Sequence[Recording | Judged]) -> list[Recording]:
    """Each recording once, for any number of spans."""
    return list({id(r): r for r in (one.recording if isinstance(one, Judged) else one for one in judged)}.values())


def errors(
    bundle: _core.Bundle, judged: Recording | Judged, threads: int, margins: FreeMotionConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times, |tau_ext|, region and which samples count: (samples,), 2 x (samples, joints) and (samples,) bool.

    |tau_ext| is divided by the bundle's error scale, if any, which gives its size in usual motion.

    Samples of free motion within the span count where tau_ext is compared with limits; that includes saturated drives,
    although they are unhealthy. The recording runs through the chain from its start, so that filters are warm at the
    span's start, to the end of the span.
    """
    motion, estimates, error, counted = judge(bundle, judged, threads, margins)
    return motion.t_ns, error, estimates["near_stiction"].astype(bool), counted


def judge(
    bundle: _core.Bundle,
    judged: Recording | Judged,
    threads: int,
    margins: FreeMotionConfig,
    torques: Sequence[str] = FOR_ERRORS,
) -> tuple[Recording, dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """The motion up to the end of the span, its estimates, and |tau_ext| and counted samples as in errors().

    Args:
        torques: torque columns of the estimates, FOR_ERRORS at least.
    """
    judged = judged if isinstance(judged, Judged) else Judged(judged)
    motion = judged.motion
    signals = (motion.t_ns, motion.q, motion.dq, motion.tau)
    estimates = _core.estimate(
        judged.bundle or bundle, *signals, threads, motion.temperature, judged.outputs, list(torques)
    )
    counted = np.zeros(motion.samples, dtype=bool)
    counted[judged.span] = True
    counted &= (
        (estimates["health"] != STALE)
        & np.isfinite(estimates["tau_ext"]).all(axis=1)
        & free_samples(judged.recording, margins)[: motion.samples]
    )
    # Limits are raised by the prior's doubt, so it is not part of the error.
    error = np.maximum(np.abs(estimates["tau_ext"]) - estimates["doubt"], 0) / estimates["limit_scale"]
    return motion, estimates, error, counted


def judge_all(
    bundle: _core.Bundle,
    judged: Iterable[Recording | Judged],
    threads: int,
    margins: FreeMotionConfig,
    torques: Sequence[str] = FOR_ERRORS,
) -> Iterator[tuple[Recording, dict[str, np.ndarray], np.ndarray, np.ndarray]]:
    """Yield judge() of each, in order. Up to AT_A_TIME are estimated at a time, since only the network's part of an
    estimate runs in several threads.

    Args:
        threads: 0: one a core.
    """
    threads = threads or os.cpu_count() or 1
    workers = min(threads, AT_A_TIME)
    with ThreadPoolExecutor(workers) as pool:
        coming: deque[Future] = deque()
        for one in judged:
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
        f"limits need free motion: no recording has any beyond the warm-up of {warm_s:g} s{window}, with "
        f"{margins.before_s:g} s before and {margins.after_s:g} s after every contact left out"
    )


# --- The paper's limits: the largest values in free motion not used in training.


LIMIT_KINDS = ("sliding", "near_stiction", "contact_sliding", "contact_near_stiction")


@dataclass(frozen=True)
class LevelLimits:
    """Limits of |tau_ext| of one level of the alarm, [N m]."""

    sliding_nm: np.ndarray  # (n,)
    near_stiction_nm: np.ndarray  # (n,), for |dq| below the bundle's near_stiction_rad_s

    def of_arm(self, watched: np.ndarray, joints: int) -> LevelLimits:
        """These limits of the watched joints, (watched,) indices, among all joints; infinite for the others."""
        level = np.full((2, joints), np.inf)
        level[:, watched] = self.sliding_nm, self.near_stiction_nm
        return LevelLimits(level[0], level[1])

    def put(self, bundle: _core.Bundle, level: Literal["", "contact_"]) -> None:
        """Set a bundle's limits of a collision, or of a contact; those of joints that are not monitored stay
        infinite."""
        for region, limits in (("sliding", self.sliding_nm), ("near_stiction", self.near_stiction_nm)):
            setattr(bundle, f"{level}{region}_limit_nm", np.where(bundle.monitored, limits, np.inf).tolist())


def paper_limits(
    bundle: _core.Bundle,
    recordings: Sequence[Recording | Judged],
    threads: int,
    margins: FreeMotionConfig = FreeMotionConfig(),  # noqa: B008
) -> LevelLimits:
    """Largest |tau_ext| of each joint on validation free motion [Lim2021], in each region as the paper suggests.

    A joint that was never near stiction, or has smaller errors there, gets the sliding limit in both regions: friction
    at rest is no more certain than in motion. A joint that never slid gets its limit at rest in both regions; its
    errors in motion are unknown, and `warning` states it. Contacts, with margins, are left out.

    Raises:
        TrainingError: no healthy sample of free motion, or |tau_ext| of a joint is zero throughout.
    """
    n = bundle.joints
    sliding, near, samples = np.zeros(n), np.zeros(n), 0
    for recording in recordings:
        _, error, stuck, counted = errors(bundle, recording, threads, margins)
        error, stuck = error[counted], stuck[counted]
        sliding = np.maximum(sliding, np.where(stuck, 0, error).max(axis=0, initial=0))
        near = np.maximum(near, np.where(stuck, error, 0).max(axis=0, initial=0))
        samples += len(error)
    if samples == 0:
        raise no_free_motion(bundle, margins)
    sliding[~np.array(bundle.monitored)] = np.inf
    if (np.maximum(sliding, near) == 0).any():
        name = bundle.links[int(np.argmin(np.maximum(sliding, near)))].joint_name
        raise TrainingError(
            f"joint '{name}': |tau_ext| is zero throughout the validation recordings, so its limit cannot be found; "
            "is its torque recorded?"
        )
    stand = standing_joints([r.recording if isinstance(r, Judged) else r for r in recordings])
    both = np.maximum(sliding, near)
    sliding = np.where(stand | (sliding == 0), both, sliding)
    return LevelLimits(sliding, both)


def ignore_standing(bundle: _core.Bundle, recordings: Sequence[Recording]) -> str:
    """Give joints that stand still in all recordings, while others move, infinite limits; returns a sentence.

    Their friction in motion is unknown, and limits of a locked joint would be those of rounding. If no joint moves, all
    keep limits that hold at this pose. Call it first: whatever sets limits later leaves infinite ones.
    """
    stand = standing_joints(recordings)
    if stand.all():
        return "limits at rest only: no joint moves in the recordings; in motion expect false alarms"
    if not stand.any():
        return ""
    for kind in LIMIT_KINDS:
        name = f"{kind}_limit_nm"
        setattr(bundle, name, np.where(stand, np.inf, getattr(bundle, name)).tolist())
    names = [link.joint_name for link, stands in zip(bundle.links, stand, strict=True) if stands]
    verb = "never moves" if len(names) == 1 else "never move"
    return f"{', '.join(names)} {verb} in the recordings: not monitored; move every joint that is to be monitored"


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


def set_limits(bundle: _core.Bundle, limits: LevelLimits, alarm: AlarmConfig) -> None:
    """Set limits and hold times of a bundle. The paper has one limit: contact and collision differ in hold time
    only."""
    limits.put(bundle, "")
    limits.put(bundle, "contact_")
    bundle.hold_s = alarm.collision_hold_s
    bundle.contact_hold_s = alarm.contact_hold_s
    bundle.contact_release_s = alarm.contact_release_s


def raise_limits(bundle: _core.Bundle, factor: float, by_nm: np.ndarray | float = 0.0) -> None:
    """Multiply all limits of a bundle by `factor` and add `by_nm`, one a joint or for all, [N m]."""
    for kind in LIMIT_KINDS:
        name = f"{kind}_limit_nm"
        setattr(bundle, name, (factor * np.array(getattr(bundle, name)) + by_nm).tolist())


def usual_speed_rad_s(recordings: Sequence[Recording | Judged]) -> np.ndarray:
    """Largest 95 % quantile of each joint's speed over the recordings, (n,), [rad/s]."""
    speeds = [np.quantile(np.abs(recording.dq), 0.95, axis=0) for recording in whole_recordings(recordings)]
    return np.max(speeds, axis=0)


# --- The error scale.


FEATURES = tuple(_core.MotionFeature)
SHARP_HOURS = 1.0
"""Hours of held-out motion from which the limits' scale is fitted to the largest errors, with power SHARP ..."""
SHARP, BLUNT = 8.0, 4.0
"""... and below which to all errors, with power BLUNT."""
STOOD_S = 60.0
"""Least time at rest for a limit at rest. A joint that rested less gets at least the limit of usual motion, since
friction at rest may hide more."""
LEAST_CONSTANT = 0.05
"""Least constant as a share of usual motion's scale, which keeps limits above zero."""
STANDS_RAD_S = 0.002
"""Speed below which a joint rests."""
MOST_ROWS = 1_000_000
"""Largest number of rows: over an hour and a half at the network's rate."""
LEAST_ROWS = 300
"""A region with fewer rows uses the standard error of both."""
RESERVE_SPEED_RAD_S = 3.0
"""Speed up to which the friction reserve grows."""
ONE_SIGMA = 0.6827
"""Share of normal errors within one standard error; sigma is scaled to it."""


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

    @property
    def hours(self) -> float:
        """Hours of motion."""
        return len(self.error_nm) * self.period_s / 3600

    @property
    def power(self) -> float:
        """p of the limits' scale."""
        return SHARP if self.hours >= SHARP_HOURS else BLUNT

    def of_joints(self, chosen: np.ndarray) -> ErrorRows:
        """The rows of these joints alone, (chosen,) indices."""
        error, near, features = (one[:, chosen] for one in (self.error_nm, self.near_stiction, self.features))
        return replace(self, error_nm=error, near_stiction=near, features=features)

    def only(self, inside: np.ndarray) -> ErrorRows:
        """Select rows, by (rows,) bool or indices."""
        return replace(
            self,
            error_nm=self.error_nm[inside],
            near_stiction=self.near_stiction[inside],
            features=self.features[inside],
            t_ns=self.t_ns[inside],
            recording=self.recording[inside],
        )


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
    blind_sigma(bundle)
    if bundle.drift.time_constant_s > 0:
        seen = freeze_floor_nm(rows.error_nm, drift, rows.period_s)
        drifted = drift.freeze_floor_share * np.array(bundle.drift.size_nm)
        bundle.drift.freeze_floor_nm = np.maximum(drifted, seen).tolist()
    return {"hours": rows.hours, "power": rows.power}


def put_constant_error(bundle: _core.Bundle, rows: ErrorRows) -> None:
    """Set the standard errors of a bundle with constant limits from these rows, sliding and near stiction."""
    scale = _core.ErrorScaleSettings()
    scale.features = [_core.MotionFeature.constant]
    scale.limit_weights = scale.largest = [1.0] * bundle.joints
    regions = []
    for inside in (~rows.near_stiction, rows.near_stiction):
        enough = inside.sum(axis=0) >= LEAST_ROWS
        errors = [rows.error_nm[inside[:, j] if enough[j] else slice(None), j] for j in range(bundle.joints)]
        regions.append([float(sigma_weights(np.ones((len(one), 1)), one)[0]) for one in errors])
    scale.sigma_weights, scale.sigma_near_weights = regions
    scale.largest_sigma = np.max(regions, axis=0).tolist()
    bundle.error_scale = scale
    blind_sigma(bundle)


def scale_of(rows: ErrorRows) -> _core.ErrorScaleSettings:
    """Fit an error scale to these rows."""
    joints = rows.error_nm.shape[1]
    weights = np.array([limit_weights(rows, j) for j in range(joints)])
    scale = _core.ErrorScaleSettings()
    scale.features = list(FEATURES)
    scale.limit_weights = weights.ravel().tolist()
    scale.largest = np.einsum("rjf,jf->rj", rows.features, weights).max(axis=0).tolist()
    sliding: list[np.ndarray] = []
    near: list[np.ndarray] = []
    for j in range(joints):
        error, features, stuck = rows.error_nm[:, j], rows.features[:, j], rows.near_stiction[:, j]
        both = sigma_weights(features, error)
        for inside, into in ((~stuck, sliding), (stuck, near)):
            into.append(sigma_weights(features[inside], error[inside]) if inside.sum() >= LEAST_ROWS else both)
    scale.sigma_weights = np.concatenate(sliding).tolist()
    scale.sigma_near_weights = np.concatenate(near).tolist()
    of_sliding, of_near = (np.einsum("rjf,jf->rj", rows.features, np.array(weights)) for weights in (sliding, near))
    scale.largest_sigma = np.where(rows.near_stiction, of_near, of_sliding).max(axis=0).tolist()
    return scale


def add_friction(bundle: _core.Bundle, share: float, at_rest_nm: np.ndarray, per_speed: np.ndarray) -> None:
    """Add a share of the friction, at_rest_nm + per_speed |dq|, to limits that follow the error.

    The weights of the constant and the speed contain it, in units of the sliding collision limit; other limits grow in
    proportion.
    """
    scale, level = bundle.error_scale, np.array(bundle.sliding_limit_nm)
    weights = np.array(scale.limit_weights).reshape(bundle.joints, -1)
    weights[:, FEATURES.index(_core.MotionFeature.constant)] += share * at_rest_nm / level
    weights[:, FEATURES.index(_core.MotionFeature.speed)] += share * per_speed / level
    # The bound was the largest scale in training motion; add at most the friction at a very high speed.
    scale.largest = (np.array(scale.largest) + share * (at_rest_nm + per_speed * RESERVE_SPEED_RAD_S) / level).tolist()
    scale.limit_weights = weights.ravel().tolist()
    bundle.error_scale = scale


@dataclass(frozen=True)
class LeftOutErrors:
    """Limits that follow the error, on motion not used in training."""

    usual_limit_nm: np.ndarray  # (joints,): sliding, in usual motion
    limit_nm: np.ndarray  # (rows, joints)


def left_out_errors(
    bundle: _core.Bundle, judged: Iterable[Recording | Judged], threads: int, margins: FreeMotionConfig
) -> LeftOutErrors:
    """Find limits from the largest standardised errors, which this motion does not exceed.

    Raises:
        TrainingError: no free motion.
    """
    rows = collect_rows(bundle, judged, threads, margins)
    weights = np.array([limit_weights(rows, j) for j in range(bundle.joints)])
    scale = np.einsum("rjf,jf->rj", rows.features, weights)
    sliding, near = (
        np.where(inside, rows.error_nm / scale, 0).max(axis=0) for inside in (~rows.near_stiction, rows.near_stiction)
    )
    near = np.maximum(sliding, near)
    sliding = np.where(sliding > 0, sliding, near)  # a joint that never slid
    return LeftOutErrors(sliding, np.where(rows.near_stiction, near, sliding) * scale)


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
    judged: Iterable[Recording | Judged],
    threads: int,
    margins: FreeMotionConfig = FreeMotionConfig(),  # noqa: B008
) -> ErrorRows:
    """Collect errors and features of free motion, one row a network period, thinned to at most MOST_ROWS.

    Raises:
        TrainingError: no free motion.
    """
    plain = _core.Bundle.from_bytes(bundle.to_bytes())
    plain.error_scale = unit_scale(bundle.joints)
    found: list[tuple[np.ndarray, ...]] = []
    stride, count = bundle.observer.network_stride, 0
    numbers: dict[str, int] = {}
    for r, estimates, error, counted in judge_all(bundle, judged, threads, margins):
        at = np.flatnonzero(counted)[::stride].astype(np.int64)
        if len(at) == 0:
            continue
        near = estimates["near_stiction"]
        motion = _core.motion_errors(plain, r.t_ns, r.dq, near, estimates["entered"], estimates["restarted"], at)
        number = np.full(len(at), numbers.setdefault(r.name, len(numbers)))
        found.append((error[at], near[at].astype(bool), motion["features"], r.t_ns[at], number))
        count += len(at)
        if count > MOST_ROWS:  # thin out evenly
            found = [tuple(column[::2] for column in rows) for rows in found]
            count, stride = sum(len(rows[0]) for rows in found), 2 * stride
    if not found:
        raise no_free_motion(bundle, margins)
    error, near, features, t_ns, number = (np.concatenate(column) for column in zip(*found, strict=True))
    period_s = 1e-9 * bundle.observer.sample_period_ns * stride
    return ErrorRows(error, near, features, period_s, t_ns, number, tuple(numbers))


def limit_weights(rows: ErrorRows, joint: int) -> np.ndarray:
    """Weights of a joint's limits, (features,): the scale's median is 1, and it is never below LEAST_CONSTANT."""
    features = rows.features[:, joint]
    weights = fit_weights(features, rows.error_nm[:, joint], rows.power)
    weights = weights / float(np.median(features @ weights))
    weights[0] = max(weights[0], LEAST_CONSTANT)
    speed, standstill = (FEATURES.index(kind) for kind in (_core.MotionFeature.speed, _core.MotionFeature.standstill))
    stood_s = 3600 * rows.hours * float(np.mean(features[:, speed] < STANDS_RAD_S))
    if stood_s < STOOD_S:
        weights[standstill] = max(weights[standstill], 1.0 - weights[0])
    return weights


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
    scaled = weights * float(np.quantile(error / sigma, ONE_SIGMA))
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
    bounds = [(LEAST_CONSTANT / 10, None)] + [(0, None)] * (F.shape[1] - 1)
    found = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 200})
    weights = np.zeros(len(size))
    weights[used] = np.maximum(found.x, [low for low, _ in bounds]) / size[used]  # SciPy may end at -1e-19
    return weights
