"""Evenly sampled stretches of motion, velocity against position, and poses at rest."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from tauext import _core
from tauext.check.finding import NEGATE_EFFORT, Finding
from tauext.data.recording import Recording
from tauext.data.servo import torque_unit

# --- Recordings as evenly sampled stretches of smooth free motion, the input of every fit.


LEAST_STRETCH_S = 2.0
"""Least length of a stretch; a shorter one is mostly filter transients."""
POSITION_CUTOFF_HZ = 15.0
"""Cut-off for differentiating positions: above an arm's motion, below the noise of encoder steps."""
FIT_CUTOFF_HZ = 5.0
"""Cut-off of torque and model before comparison: it keeps friction at reversals and inertia, and removes noise."""
FIT_ROWS_HZ = 25.0
MOST_HZ, THINNED_CUTOFF_HZ = 250.0, 60.0
"""Rate to which faster recordings are low-passed and thinned; no fit uses more than 15 Hz."""
MOVING_RAD_S = 0.02
"""Speed below which a joint rests."""
CONTACT_MARGIN_S = 0.5
"""Time left out before and after a labelled contact: labels come late, and an arm springs back."""
SIGNALS = ("q", "dq", "tau", "q_raw", "dq_raw")
GAP_PERIODS = 5.0
"""Step, in periods, that ends a stretch, as longer gaps cannot be interpolated."""


@dataclass(frozen=True)
class Stretch:
    """Free motion without a gap on an even clock of at most MOST_HZ; arrays (samples, joints)."""

    recording: int
    start_s: float  # after the beginning of the first recording; recordings follow one another without a pause
    rate_hz: float
    q: np.ndarray  # [rad], smooth
    dq: np.ndarray  # [rad/s], derivative of q, no delay
    tau: np.ndarray  # [N m], as recorded, thinned
    q_raw: np.ndarray  # [rad], as recorded, thinned
    dq_raw: np.ndarray  # [rad/s], as recorded, thinned

    @property
    def seconds(self) -> float:
        return len(self.q) / self.rate_hz

    def changed(self, change: Callable[[np.ndarray], np.ndarray], names: Sequence[str] = SIGNALS) -> Stretch:
        """The stretch with these signals changed."""
        signals: dict[str, Any] = {name: change(getattr(self, name)) for name in names}
        return replace(self, **signals)


PADDED_ROWS = 9
"""Number of samples that pad the filter at either end."""


def low_pass(x: np.ndarray, cutoff_hz: float, rate_hz: float) -> np.ndarray:
    """Apply a second-order Butterworth forwards and backwards over axis 0; unchanged if too fast or too short."""
    if cutoff_hz >= 0.45 * rate_hz or len(x) <= PADDED_ROWS:
        return x
    from scipy.signal import sosfiltfilt  # takes 0.6 s to import, and most commands do not need it

    # Along contiguous samples, since SciPy copies others several times.
    return sosfiltfilt(_butterworth(cutoff_hz, rate_hz), np.ascontiguousarray(x.T), axis=-1).T


@cache
def _butterworth(cutoff_hz: float, rate_hz: float) -> np.ndarray:
    from scipy.signal import butter

    return butter(2, cutoff_hz, fs=rate_hz, output="sos")


def stretches(recordings: Iterable[Recording], contacts: bool = False) -> list[Stretch]:
    """Evenly sampled stretches of at least LEAST_STRETCH_S, without repeated rows and labelled contacts.

    Args:
        contacts: keep labelled contacts.
    """
    found, start_s = [], 0.0
    for number, recording in enumerate(recordings):
        for rows in _whole(recording, contacts):
            stretch = _even(recording, rows, number, start_s)
            if stretch is not None:
                found.append(stretch)
        start_s += recording.duration_s
    return found


def repeated_rows(recording: Recording) -> np.ndarray:
    """(samples,) bool: every signal of every joint equals the row before."""
    repeated = np.zeros(recording.samples, dtype=bool)
    repeated[1:] = True
    for x in (recording.q, recording.dq, recording.tau):
        for column in x.T:
            at = np.flatnonzero(repeated)  # most rows drop out after the first column
            repeated[at[column[at] != column[at - 1]]] = False
    return repeated


def _whole(recording: Recording, contacts: bool) -> list[np.ndarray]:
    """Rows of each stretch, without repeats."""
    keep = ~repeated_rows(recording)
    if recording.contact is not None and not contacts:
        touched = recording.time_s[recording.contact == 1]
        if len(touched):
            after = np.searchsorted(touched, recording.time_s)
            to_next = touched[np.minimum(after, len(touched) - 1)] - recording.time_s
            since = recording.time_s - touched[np.maximum(after - 1, 0)]
            keep &= (np.abs(to_next) > CONTACT_MARGIN_S) & (np.abs(since) > CONTACT_MARGIN_S)
    rows = np.flatnonzero(keep)
    if not len(rows):
        return []
    step_ns = np.median(np.diff(recording.t_ns)) if recording.samples > 1 else 1
    period_ns = max(step_ns, 1e9 / recording.rate_hz)
    # rows left out in between are repeats, during which the clock continued
    # longest run of repeated rows within a stretch
    longest_ns = np.where(np.diff(rows) > 1, max(0.25 * 1e9, GAP_PERIODS * period_ns), GAP_PERIODS * period_ns)
    breaks = np.flatnonzero(np.diff(recording.t_ns[rows]) > longest_ns)
    return [part for part in np.split(rows, breaks + 1) if len(part) > 8]


def _even(recording: Recording, rows: np.ndarray, number: int, start_s: float) -> Stretch | None:
    t = (recording.t_ns[rows] - recording.t_ns[0]) * 1e-9
    if t[-1] - t[0] < LEAST_STRETCH_S:
        return None
    rate_hz = min(recording.rate_hz, (len(rows) - 1) / (t[-1] - t[0]) * 1.25)
    even = np.arange(t[0], t[-1], 1 / rate_hz)

    every = max(1, int(rate_hz / MOST_HZ + 0.5)) if rate_hz > MOST_HZ else 1

    def on_clock(x: np.ndarray) -> np.ndarray:
        x = np.stack([np.interp(even, t, x[rows, j]) for j in range(x.shape[1])], axis=1)
        return x if every == 1 else np.ascontiguousarray(low_pass(x, THINNED_CUTOFF_HZ, rate_hz)[::every])

    raw, tau, recorded = on_clock(recording.q), on_clock(recording.tau), on_clock(recording.dq)
    rate_hz /= every
    smooth = low_pass(raw, min(POSITION_CUTOFF_HZ, 0.3 * rate_hz), rate_hz)
    dq = np.gradient(smooth, 1 / rate_hz, axis=0)
    return Stretch(number, start_s + even[0], rate_hz, smooth, dq, tau, raw, recorded)


# --- Velocity against the derivative of position: unit, sign, delay, order.


FACTOR_OFF = 0.1
LEAST_CORRELATION = 0.9
LEAST_SPEED_RAD_S = 0.02
"""Least RMS of the velocity for a comparison, [rad/s]; below is noise."""
DEGREES = 180 / math.pi


@dataclass(frozen=True)
class VelocityFit:
    """Fit of one joint's recorded velocity to the derivative of its position, with factor and lag."""

    factor: float
    lag_s: float
    correlation: float


def compare(stretches: Sequence[Stretch], joint: int, of: int | None = None) -> VelocityFit | None:
    """Compare the recorded velocity of `joint` with the derivative of position of joint `of`, itself if None.

    None: the joint does not move. If it moves slowly, a fit needs a much faster recorded velocity that correlates.
    """
    of = joint if of is None else of
    rate = float(np.median([s.rate_hz for s in stretches]))
    reach = max(2, math.ceil(0.2 * rate))
    pairs = []
    for s in stretches:
        cutoff = min(FIT_CUTOFF_HZ, s.rate_hz / 6)
        true, recorded = low_pass(s.dq[:, of], cutoff, s.rate_hz), low_pass(s.dq_raw[:, joint], cutoff, s.rate_hz)
        if len(true) > 4 * reach:
            pairs.append((true, recorded))

    def later(k: int) -> np.ndarray:
        return np.concatenate([recorded[reach + k : len(recorded) - reach + k] for _, recorded in pairs])

    inner = np.concatenate([true[reach:-reach] for true, _ in pairs]) if pairs else np.zeros(1)
    power = float(inner @ inner)
    slow = power / len(inner) < LEAST_SPEED_RAD_S**2
    # a recorded velocity this much faster is no noise, also where the position hardly moves
    if slow and (not power or float(np.mean(later(0) ** 2)) < (3 * LEAST_SPEED_RAD_S) ** 2):
        return None

    stride = max(1, reach // 20)
    coarse = range(-reach, reach + 1, stride)
    products = [abs(inner @ later(k)) / max(float(np.linalg.norm(later(k))), 1e-12) for k in coarse]
    shift = coarse[int(np.argmax(products))]
    recorded = later(shift)
    factor = float(inner @ recorded / power)
    correlation = float(abs(inner @ recorded) / max(math.sqrt(power) * float(np.linalg.norm(recorded)), 1e-12))
    if slow and correlation < LEAST_CORRELATION:
        return None
    # remaining lag, to first order: recorded = factor (true - lag d(true)/dt)
    slope = np.concatenate([np.gradient(true)[reach:-reach] for true, _ in pairs])
    left = float((inner - recorded / factor) @ slope / (slope @ slope)) if factor else 0.0
    return VelocityFit(factor, float(shift + np.clip(left, -stride, stride)) / rate, correlation)


def velocity_findings(
    stretches: Sequence[Stretch], joints: Sequence[str]
) -> tuple[list[Finding], list[VelocityFit | None], np.ndarray]:
    """Return findings, the fit of each joint, and the factors (joints,) by which positions are too large."""
    found, positions = [], np.ones(len(joints))
    fits = [compare(stretches, j) for j in range(len(joints))]
    for j, (joint, fit) in enumerate(zip(joints, fits, strict=True)):
        if fit is None:
            continue
        relation = f"velocity = {fit.factor:.4g} times the derivative of position, correlation {fit.correlation:.3f}"
        size = abs(fit.factor)
        if fit.correlation < LEAST_CORRELATION:
            found.append(_unlike(stretches, joints, j, relation))
        elif abs(size * DEGREES - 1) < FACTOR_OFF:
            positions[j] = DEGREES
            evidence = f"{relation}: 1 / 57.3, so that positions are in degrees and velocities in rad/s"
            advice = "convert positions to radians at import; or the velocity is in rad/s and was imported as deg/s"
            found.append(Finding("degrees", "fault", joint, evidence, advice))
        elif fit.factor < 0:
            found.append(Finding("velocity-sign", "fault", joint, relation, "negate the velocity at import"))
        elif abs(size - 1) > FACTOR_OFF:
            found.append(
                Finding("velocity-unit", "fault", joint, f"{relation}{_guess(size)}", "convert it to rad/s at import")
            )
        rate = stretches[0].rate_hz
        # a drive's filter lags by 1 to 5 ms; from 10 ms, or a period and a quarter, prior and network suffer
        late = fit.correlation >= LEAST_CORRELATION and abs(fit.lag_s) > max(0.010, 1.25 / rate)
        if late:
            way = "after" if fit.lag_s > 0 else "before"
            evidence = f"velocity comes {abs(fit.lag_s) * 1e3:.0f} ms {way} the derivative of position"
            advice = (
                "use a velocity of less filtering, or derive it from position (causally) at import and in the monitor"
            )
            found.append(Finding("velocity-delay", "warning", joint, evidence, advice))
    return found, fits, positions


def _unlike(stretches: Sequence[Stretch], joints: Sequence[str], j: int, relation: str) -> Finding:
    others = [(compare(stretches, j, k), name) for k, name in enumerate(joints) if k != j]
    likely = [(fit.correlation, name) for fit, name in others if fit is not None]
    if likely and max(likely)[0] > LEAST_CORRELATION:
        correlation, name = max(likely)
        evidence = f"{relation}, but {correlation:.3f} with that of '{name}'"
        return Finding("joint-order", "fault", joints[j], evidence, "map positions and velocities by name at import")
    advice = "it may be a commanded, a Cartesian or a stale velocity: derive it from position at import"
    return Finding("velocity-mismatch", "fault", joints[j], relation, advice)


def _guess(size: float) -> str:
    known = (
        (DEGREES, "it is in deg/s, or the position is in rad and was imported as degrees"),
        (60 / (2 * math.pi), "it is in turns a minute"),
        (1 / (2 * math.pi), "it is in turns a second"),
    )
    for factor, what in known:
        if abs(size / factor - 1) < 0.05:
            return f": {what}"
    return ": motor side, perhaps" if size > 20 else ""


# --- An arm at rest: torque against the model's gravity, pose by pose.


LOADED, LOADED_OF_SEVERAL = 0.2, 0.05
"""Least gravity torque as a share of the arm's largest; a gear's friction holds a tenth of that."""
ALIKE = 2.5
"""Largest ratio of torque over gravity between joints, from friction, a tool or torque constants."""


def poses_of(recordings: Sequence[Recording]) -> tuple[np.ndarray, np.ndarray]:
    """Medians of position [rad] and torque [N m] of each pose, (poses, joints): seconds in which no joint moves by 0.01
    rad, poses 0.05 rad apart. Labelled contacts are left out."""
    poses: list[tuple[list[np.ndarray], list[np.ndarray]]] = []
    for r in recordings:
        free = np.ones(r.samples, dtype=bool) if r.contact is None else r.contact != 1
        window = (r.time_s // 1.0).astype(int)
        for k in np.unique(window):
            rows = (window == k) & free
            if rows.sum() < 5 or np.ptp(r.q[rows], axis=0).max() > 0.01:
                continue
            q, tau = np.median(r.q[rows], axis=0), np.median(r.tau[rows], axis=0)
            for at, held in poses:
                if np.abs(at[0] - q).max() < 0.05:
                    at.append(q)
                    held.append(tau)
                    break
            else:
                poses.append(([q], [tau]))
    size = len(recordings[0].joints)
    medians = [[np.median(x, axis=0) for x in signals] for signals in zip(*poses, strict=True)] or [[], []]
    return np.reshape(medians[0], (-1, size)), np.reshape(medians[1], (-1, size))


def pose_findings(recordings: Sequence[Recording], tree: _core.Tree, joints: Sequence[str]) -> list[Finding]:
    """Find joints at rest whose torque acts with gravity instead of against it, beyond friction.

    With one or two poses only joints with much load count, whose torque has the size of gravity. With more poses joints
    with less load count too, if gravity with one factor explains all but a third of their torques.
    """
    q, tau = poses_of(recordings)
    unit = torque_unit(recordings)
    if not len(q):
        return []
    anywhere = np.random.default_rng(0).uniform(-np.pi, np.pi, (300, tree.size))
    most = np.abs(tree.momentum(anywhere, 0 * anywhere)[1]).max()
    gravity = tree.momentum(q, np.zeros_like(q))[1]
    power = np.maximum((gravity**2).sum(axis=0), 1e-18)
    factor = (gravity * tau).sum(axis=0) / power
    left = np.sqrt(((tau - factor * gravity) ** 2).mean(axis=0))
    loaded = np.abs(gravity) > LOADED * most
    wrong = loaded.any(axis=0) & ((tau * gravity < 0) | ~loaded).all(axis=0) & _of_one_size(factor, loaded.any(axis=0))
    # enough poses to estimate friction from the part that gravity does not explain
    if len(q) >= 3:
        load = np.sqrt(power / len(q))
        wrong |= (load > LOADED_OF_SEVERAL * most) & (factor < 0) & (-factor * load > 3.0 * left)
    found = []
    for j in np.flatnonzero(wrong).tolist():
        k = int(np.argmax(np.abs(gravity[:, j])))
        several = f" ({len(q)} poses: {factor[j]:.3g} times gravity, {left[j]:.2g} {unit} apart)" if len(q) > 1 else ""
        evidence = f"at rest the effort is {tau[k, j]:.4g} {unit} where gravity takes {gravity[k, j]:.4g} Nm{several}"
        advice = NEGATE_EFFORT
        if (wrong | ~loaded.any(axis=0)).all():
            advice += "; or the arm hangs: then give its gravity direction"
        found.append(Finding("effort-sign", "fault", joints[j], evidence, advice))
    return found


def _of_one_size(factor: np.ndarray, loaded: np.ndarray) -> np.ndarray:
    """Joints whose ratio of torque to gravity is that of the other loaded joints; for a single one, 1."""
    usual = float(np.median(np.abs(factor[loaded]))) if loaded.sum() > 1 else 1.0
    return (np.abs(factor) > usual / ALIKE) & (np.abs(factor) < usual * ALIKE)
