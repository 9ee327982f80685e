"""Evenly sampled stretches of motion, their filters, and the velocity against the derivative of the position."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

from tauext._core import Tree
from tauext.data.recording import Recording

MOVING_RAD_S = 0.02  # speed below which a joint rests
DEGREES = 180 / math.pi

# --- Filters.


PADDED_ROWS = 9  # number of samples that pad the filter at either end


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


def smooth(x: np.ndarray, rate_hz: float) -> np.ndarray:
    """The filter before positions are differentiated: above an arm's motion, below the noise of encoder steps."""
    return low_pass(x, min(15.0, 0.3 * rate_hz), rate_hz)


@dataclass(frozen=True)
class RowFilter:
    """The filter of torque and model before they are compared, and the rows that are compared."""

    cutoff_hz: float = 5.0  # keeps friction at reversals and inertia, and removes noise
    rows_hz: float = 25.0
    end_s: float = 0.2  # left out at both ends of a stretch: there the filter has data on one side only

    def filtered(self, x: np.ndarray, rate_hz: float) -> np.ndarray:
        return low_pass(x, min(self.cutoff_hz, rate_hz / 6), rate_hz)

    def inner(self, x: np.ndarray, rate_hz: float) -> np.ndarray:
        """x without both ends."""
        end = int(self.end_s * rate_hz)
        return x[end : len(x) - end]

    def picked(self, x: np.ndarray, rate_hz: float) -> np.ndarray:
        """A copy of the rows."""
        return self.inner(x, rate_hz)[:: max(1, round(rate_hz / self.rows_hz))].copy(order="K")

    def rows(self, x: np.ndarray, rate_hz: float) -> np.ndarray:
        return self.picked(self.filtered(x, rate_hz), rate_hz)


FIT = RowFilter()


# --- Recordings as evenly sampled stretches of smooth free motion, the input of every fit.


SIGNALS = ("q", "dq", "tau", "q_raw", "dq_raw")


@dataclass(frozen=True)
class Stretch:
    """Free motion without a gap on an even clock of at most 250 Hz; arrays (samples, joints)."""

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

    @property
    def moves(self) -> np.ndarray:
        """(samples,) bool: some joint moves."""
        moves: np.ndarray = (np.abs(self.dq) > MOVING_RAD_S).any(axis=1)
        return moves

    def changed(self, change: Callable[[np.ndarray], np.ndarray], names: Sequence[str] = SIGNALS) -> Stretch:
        """The stretch with these signals changed."""
        signals: dict[str, Any] = {name: change(getattr(self, name)) for name in names}
        return replace(self, **signals)


def stretches(recordings: Iterable[Recording], contacts: bool = False) -> list[Stretch]:
    """Evenly sampled stretches of at least 2 s, without repeated rows and, unless kept, labelled contacts.

    Rows of unknown contact are left out with them, unless no row of any recording is known to be free.
    """
    recordings, found, start_s = list(recordings), [], 0.0
    known = some_known(recordings)
    for number, recording in enumerate(recordings):
        for rows in _whole(recording, contacts, known):
            t = (recording.t_ns[rows] - recording.t_ns[0]) * 1e-9
            if t[-1] - t[0] >= 2.0:  # a shorter one is mostly filter transients
                found.append(_even(recording, rows, t, number, start_s))
        start_s += recording.duration_s
    return found


def some_known(recordings: Iterable[Recording]) -> bool:
    """Whether a row of some recording is known to be free of contact."""
    return any(r.contact is None or bool((r.contact == 0).any()) for r in recordings)


def repeated_rows(recording: Recording) -> np.ndarray:
    """(samples,) bool: every signal of every joint equals the row before."""
    repeated = np.zeros(recording.samples, dtype=bool)
    repeated[1:] = True
    for x in (recording.q, recording.dq, recording.tau):
        for column in x.T:
            at = np.flatnonzero(repeated)  # most rows drop out after the first column
            repeated[at[column[at] != column[at - 1]]] = False
    return repeated


def _whole(recording: Recording, contacts: bool, known: bool) -> list[np.ndarray]:
    """Rows of each stretch, without repeats and, if `known`, without those of unknown contact."""
    keep = ~repeated_rows(recording)
    labels = np.zeros(recording.samples) if contacts or recording.contact is None else recording.contact
    touched = recording.time_s[np.isin(labels, (1, -1) if known else 1)]
    if len(touched):  # labels come late, and an arm springs back for half a second
        after = np.searchsorted(touched, recording.time_s)
        to_next = touched[np.minimum(after, len(touched) - 1)] - recording.time_s
        since = recording.time_s - touched[np.maximum(after - 1, 0)]
        keep &= (np.abs(to_next) > 0.5) & (np.abs(since) > 0.5)
    rows = np.flatnonzero(keep)
    if not len(rows):
        return []
    step_ns = np.median(np.diff(recording.t_ns)) if recording.samples > 1 else 1
    gap_ns = 5.0 * max(step_ns, 1e9 / recording.rate_hz)  # longer ones cannot be interpolated
    # rows left out in between are repeats, during which the clock continued, for 0.25 s at most
    longest_ns = np.where(np.diff(rows) > 1, max(0.25 * 1e9, gap_ns), gap_ns)
    breaks = np.flatnonzero(np.diff(recording.t_ns[rows]) > longest_ns)
    return [part for part in np.split(rows, breaks + 1) if len(part) > 8]


def _even(recording: Recording, rows: np.ndarray, t: np.ndarray, number: int, start_s: float) -> Stretch:
    rate_hz = min(recording.rate_hz, (len(rows) - 1) / (t[-1] - t[0]) * 1.25)
    even = np.arange(t[0], t[-1], 1 / rate_hz)
    every = max(1, int(rate_hz / 250.0 + 0.5)) if rate_hz > 250.0 else 1  # no fit uses more than 15 Hz

    def on_clock(x: np.ndarray) -> np.ndarray:
        x = np.stack([np.interp(even, t, x[rows, j]) for j in range(x.shape[1])], axis=1)
        return x if every == 1 else np.ascontiguousarray(low_pass(x, 60.0, rate_hz)[::every])

    raw, tau, recorded = on_clock(recording.q), on_clock(recording.tau), on_clock(recording.dq)
    thinned_hz = rate_hz / every
    q = smooth(raw, thinned_hz)
    dq = np.gradient(q, 1 / thinned_hz, axis=0)
    return Stretch(number, start_s + even[0], thinned_hz, q, dq, tau, raw, recorded)


# --- Velocity against the derivative of position.


LEAST_CORRELATION = 0.9
LEAST_SPEED_RAD_S = 0.02  # least RMS of the velocity for a comparison, [rad/s]; below is noise


@dataclass(frozen=True)
class VelocityFit:
    """Fit of one joint's recorded velocity to the derivative of its position, with factor and lag."""

    factor: float
    lag_s: float
    correlation: float


def compare(stretches: Sequence[Stretch], joint: int, of: int | None = None) -> VelocityFit | None:
    """Compare the recorded velocity of `joint` with the derivative of position of joint `of`, itself if None. None: the
    joint does not move. If it moves slowly, a fit needs a much faster recorded velocity that correlates."""
    of = joint if of is None else of
    rate = float(np.median([s.rate_hz for s in stretches]))
    reach = max(2, math.ceil(0.2 * rate))
    pairs = []
    for s in stretches:
        true, recorded = FIT.filtered(s.dq[:, of], s.rate_hz), FIT.filtered(s.dq_raw[:, joint], s.rate_hz)
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


# --- What each joint of a recording did, at a glance: a swap of joints or columns shows in two correlations.


def joint_table(recordings: Sequence[Recording], tree: Tree | None, torque_unit: str) -> list[list[str]]:
    """Motion and torque of every joint over the first ten minutes, as cells; the heading comes first."""
    before_s = np.cumsum([0.0, *(r.duration_s for r in recordings[:-1])])
    shown = [r for r, passed_s in zip(recordings, before_s, strict=True) if passed_s <= 600.0]
    rows = [_differences(one, 20_000 // len(shown)) for one in shown]
    q, dq, tau, slopes = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    gravity = np.zeros_like(q) if tree is None else tree.momentum(q, np.zeros_like(q))[1]
    low, high = np.min([r.q.min(axis=0) for r in shown], axis=0), np.max([r.q.max(axis=0) for r in shown], axis=0)
    speed, torque = np.max([[np.abs(r.dq).max(axis=0), np.abs(r.tau).max(axis=0)] for r in shown], axis=0)
    table = [["joint", "range rad", "speed rad/s", f"torque {torque_unit}", "dq ~ dq/dt", "tau ~ gravity"]]
    for j, joint in enumerate(shown[0].joints):
        shares = (_correlation(dq[:, j], slopes[:, j]), _correlation(tau[:, j], gravity[:, j]))
        moved = [f"{low[j]:.2f} to {high[j]:.2f}", f"{speed[j]:.2f}", f"{torque[j]:.3g}"]
        table.append([joint, *moved, *("-" if np.isnan(share) else f"{share:.2f}" for share in shares)])
    return table


def _differences(recording: Recording, most: int) -> tuple[np.ndarray, ...]:
    """q, dq, tau and the derivative of q in at most so many rows, (rows, joints) each; none of fewer than three."""
    at = np.arange(1, recording.samples - 1, max(1, recording.samples // max(1, most)))
    steps_s = (recording.t_ns[at + 1] - recording.t_ns[at - 1])[:, None] * 1e-9
    slopes = (recording.q[at + 1] - recording.q[at - 1]) / steps_s
    return recording.q[at], recording.dq[at], recording.tau[at], slopes


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    if not len(a):
        return float("nan")
    a, b = a - a.mean(), b - b.mean()
    size = float(np.linalg.norm(a) * np.linalg.norm(b))
    # a torque of gravity that varies by less is constant
    return float(a @ b) / size if b.std() > 1e-6 and size > 0 else float("nan")
