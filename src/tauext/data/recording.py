"""One recording of a robot arm: samples in order of time, validated when made."""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np

from tauext.errors import RecordingError

# --- Samples in order of time: late packets, repeated stamps, repeated measurements, gaps.


GAP_STEPS = 1.75
"""Shortest step with lost samples, in periods; a shorter one is jitter (SignalWatch::kGap)."""
BRIDGE_STEPS = 2.5
"""Longest step for interpolation and differentiation, in sample periods."""
SORTED = "samples out of order, sorted by their stamps"
REPEATED = "samples dropped: stamp repeats the sample before, values differ"
"""Changes by ordered(), as they are counted."""


def ordered(t_ns: np.ndarray, values: np.ndarray, counts: Counter[str]) -> tuple[np.ndarray, np.ndarray]:
    """Sort rows by time and keep the first of each stamp; changes are counted.

    Args:
        t_ns: (samples,) int64, [ns], in any order.
        values: (samples, columns).
    """
    late = t_ns < np.maximum.accumulate(t_ns)
    if late.any():
        counts[SORTED] += int(late.sum())
        order = np.argsort(t_ns, kind="stable")
        t_ns, values = t_ns[order], values[order]
    again = np.r_[False, t_ns[1:] == t_ns[:-1]]
    if again.any():
        rows = np.flatnonzero(again)
        same = _same_as_before(values)[rows]
        counts["samples dropped: stamp and values repeat the sample before"] += int(same.sum())
        counts[REPEATED] += int((~same).sum())
        t_ns, values = t_ns[~again], values[~again]
    return t_ns, values


def fresh(t_ns: np.ndarray, measured: np.ndarray, drop: bool, counts: Counter[str]) -> np.ndarray:
    """Mark new measurements, (samples,) bool: the first of each run of equal rows up to 0.1 s long.

    A longer run is kept whole: an arm at rest without noise, or a stuck sensor. `drop` false keeps and counts all.

    Args:
        t_ns: (samples,), increasing, [ns].
        measured: (samples, columns), raw sensor values.
    """
    again = _same_as_before(measured)
    begins = np.flatnonzero(~again)
    lengths = np.diff(np.r_[begins, len(t_ns)])
    standing = (t_ns[begins + lengths - 1] - t_ns[begins]) * 1e-9 > 0.1
    long_run = np.repeat(standing, lengths)
    counts["samples that stay the same for more than 0.1 s kept: at rest, or stuck"] += int((again & long_run).sum())
    repeats = again & ~long_run
    done = "dropped" if drop else "kept"
    counts[f"repeated samples {done}: all values equal the sample before"] += int(repeats.sum())
    return ~repeats if drop else np.ones(len(t_ns), bool)


def fitted_period_ns(t_ns: np.ndarray, longest: int = 10) -> float:
    """Sample period, [ns], fitted together with the number of periods in each step.

    The period is the total time of the steps divided by their periods. Unlike in the mean, lost samples do not lengthen
    it; unlike in the median, frequent slightly longer steps do.

    Args:
        t_ns: increasing, (samples,), at least two, [ns].
        longest: longest step that counts, in periods; a longer one is a pause and weak evidence.
    """
    steps = np.diff(t_ns)
    period = float(np.median(steps))
    for _ in range(20):  # most take two
        ticks = periods_of(steps, period)
        fitted = steps <= longest * period
        if not fitted.any():
            return period
        before, period = period, float(steps[fitted].sum() / ticks[fitted].sum())
        if abs(period - before) < 1e-9 * before:
            break
    return period


def periods_of(steps_ns: np.ndarray, period_ns: float, soon: int = 10) -> np.ndarray:
    """Sample periods in each step, a whole number >= 1: more than one where samples were lost.

    A late sample is not lost: short steps soon after make up for the long one.

    Args:
        soon: steps after a long one that may make up for it.
    """
    ratio = steps_ns / period_ns
    whole = np.round(ratio)
    made_up = np.r_[0.0, np.cumsum(np.where(ratio < 0.5, 1 - ratio, 0.0))]
    after = np.minimum(np.arange(len(ratio)) + 1 + soon, len(ratio))
    late = made_up[after] - made_up[:-1] > 0.5 * (whole - 1)
    return np.where((ratio >= GAP_STEPS) & ~late, whole, 1.0)


def lost_samples(t_ns: np.ndarray) -> np.ndarray:
    """Samples lost in each step, (samples - 1,); stamps increasing, (samples,), [ns]."""
    if len(t_ns) < 2:
        return np.zeros(0)
    return periods_of(np.diff(t_ns), fitted_period_ns(t_ns)) - 1


TURN = 2 * math.pi
NEAR_TURN = (0.02, math.pi / 2)
"""Least and largest difference of a jump from whole turns, [rad]: three times what the joint usually moves a sample."""


def unwrapped(q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions without jumps of whole turns, and how many each joint had, (joints,) int.

    A step between two samples is such a jump if it differs from whole turns by no more than the joint moves in a few
    samples. In a joint that has one, any step of more than half a turn is one, such as that over a gap.

    Args:
        q: (samples, joints), [rad]; returned unchanged where nothing jumps.
    """
    steps = np.diff(q, axis=0)
    turns = np.round(steps / TURN)
    counts = np.zeros(q.shape[1], int)
    if not turns.any():
        return q, counts
    q = q.copy()
    for j in np.flatnonzero(turns.any(axis=0)):
        whole, size = turns[:, j], np.abs(steps[:, j])
        usual = float(np.quantile(size[whole == 0], 0.99)) if (whole == 0).any() else 0.0
        near = min(max(3 * usual, NEAR_TURN[0]), NEAR_TURN[1])
        if (np.abs(size - TURN * np.abs(whole))[whole != 0] <= near).any():
            counts[j] = np.count_nonzero(whole)
            q[1:, j] -= TURN * np.cumsum(whole)
    return q, counts


def runs_of(flags: np.ndarray) -> np.ndarray:
    """First sample of each run of true flags, and the sample after its last, (runs, 2)."""
    return np.flatnonzero(np.diff(np.r_[False, flags, False])).reshape(-1, 2)


def _same_as_before(values: np.ndarray) -> np.ndarray:
    return np.r_[False, (values[1:] == values[:-1]).all(axis=1)] if values.shape[1] else np.zeros(len(values), bool)


# --- One recording of a robot arm, with validated content.


TorqueTiming = Literal["held", "instant", "averaged"]
REQUIRED_SIGNALS = ("q", "dq", "tau")
OPTIONAL_SIGNALS = ("tau_jts", "tau_ext", "tau_ext_sensor", "q_des", "temperature", "current", "duty", "voltage")
SIGNALS = REQUIRED_SIGNALS + OPTIONAL_SIGNALS
"""Signals of a joint, in the order of a recording's file."""
FLAGS = ("contact", "contact_link")
RATE_TOLERANCE = 0.2


@dataclass(frozen=True, eq=False)
class Recording:
    """Signals of one stretch of motion, validated when made.

    Arrays are contiguous and read-only; writable inputs are copied. Stamps may be uneven and may have gaps. Signals are
    (samples, joints) float64, joints in the order of `joints`.

    Raises:
        RecordingError: names the column, the row, the value and the broken rule."""

    name: str
    """Stem of the file's name."""
    joints: tuple[str, ...]
    """Names of the joints, in the order of the columns."""
    t_ns: np.ndarray
    """(samples,) int64, sample times, [ns], strictly increasing."""
    q: np.ndarray
    """Measured position, [rad]."""
    dq: np.ndarray
    """Measured velocity, [rad/s]."""
    tau: np.ndarray
    """Motor torque at the joint, after the gear, friction not subtracted, [N m]."""
    rate_hz: float
    """Nominal sample rate: the median step of t_ns agrees with it within 20 %."""
    torque_timing: TorqueTiming
    """held: acts from its stamp to the next; instant: measured at its stamp; averaged: over the step before it."""
    source: str
    """Origin of the recording, free text."""
    robot_sha256: str
    """SHA-256 of the robot file."""
    tau_jts: np.ndarray | None = None
    """Torque that the drive exerts on the link through a joint torque sensor, [N m]."""
    tau_ext: np.ndarray | None = None
    """True external torque (simulation) or the best estimate, [N m]."""
    tau_ext_sensor: np.ndarray | None = None
    """External torque from the joint torque sensor, low-passed: the reference of estimates, [N m]."""
    q_des: np.ndarray | None = None
    """Commanded position, [rad]."""
    temperature: np.ndarray | None = None
    """Motor temperature, [°C]."""
    current: np.ndarray | None = None
    """Current reported by a servo, of its windings or its supply, [A]."""
    duty: np.ndarray | None = None
    """Share of the supply voltage at a servo's motor, -1 to 1."""
    voltage: np.ndarray | None = None
    """Supply voltage of a servo, [V]."""
    contact: np.ndarray | None = None
    """(samples,) int8: 1 in contact, 0 free, -1 unknown."""
    contact_link: np.ndarray | None = None
    """(samples,) int8: index of the joint that carries the touched link, -1 where nothing touches."""
    provenance: dict[str, Any] = field(default_factory=dict)
    """How the recording was made; any JSON-compatible content."""

    def __post_init__(self) -> None:
        self._set("joints", check_joints(self.joints, self._here))
        self._set("t_ns", self._checked_times())
        for signal in SIGNALS:
            if getattr(self, signal) is not None or signal in REQUIRED_SIGNALS:
                self._set(signal, self._checked_signal(signal))
        if self.contact is not None:
            self._set("contact", self._checked_flags("contact", -1, 1, "0 (free), 1 (contact) or -1 (unknown)"))
        if self.contact_link is not None:
            last = len(self.joints) - 1
            rule = f"the index of a joint, 0 to {last}, or -1 where nothing touches"
            self._set("contact_link", self._checked_flags("contact_link", -1, last, rule))
        if self.torque_timing not in (timings := get_args(TorqueTiming)):
            self._refuse(f"torque_timing = {self.torque_timing!r} must be one of {', '.join(timings)}")
        self._set("rate_hz", self._checked_rate())
        for name in ("name", "source", "robot_sha256"):
            if not isinstance(getattr(self, name), str):
                self._refuse(f"{name} = {getattr(self, name)!r} must be text")
        self._set("provenance", self._checked_provenance())

    @property
    def samples(self) -> int:
        """Number of samples, at least 1."""
        return len(self.t_ns)

    @property
    def duration_s(self) -> float:
        """Time from the first sample to the last, [s]; 0 for a single sample."""
        return float(self.t_ns[-1] - self.t_ns[0]) * 1e-9

    @property
    def signals(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """t_ns, q, dq and tau, in the order of the core's functions."""
        return self.t_ns, self.q, self.dq, self.tau

    @property
    def time_s(self) -> np.ndarray:
        """Sample times counted from the first sample, (samples,) float64, [s]."""
        return (self.t_ns - self.t_ns[0]) * 1e-9

    @property
    def _here(self) -> str:
        return f"recording '{self.name}'"

    def _refuse(self, message: str) -> None:
        raise RecordingError(f"{self._here}: {message}")

    def _set(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)

    def _checked_times(self) -> np.ndarray:
        t_ns = np.asarray(self.t_ns)
        if t_ns.ndim != 1:
            self._refuse(f"t_ns has shape {t_ns.shape}, must be (samples,)")
        if t_ns.size == 0:
            self._refuse("it has no samples; at least one is needed")
        if not np.issubdtype(t_ns.dtype, np.integer):
            self._refuse(f"t_ns is {t_ns.dtype}, must be int64 nanoseconds")
        t_ns = read_only(t_ns, np.int64)
        late = np.flatnonzero(t_ns[1:] <= t_ns[:-1])
        if late.size:
            row, rule = int(late[0]) + 1, "times must strictly increase"
            self._refuse(f"t_ns at row {row} is {t_ns[row]}, after {t_ns[row - 1]} at row {row - 1}; {rule}")
        return t_ns

    def _checked_signal(self, signal: str) -> np.ndarray:
        shape, given = (len(self.t_ns), len(self.joints)), np.asarray(getattr(self, signal))
        if given.dtype.kind not in "fiu":
            self._refuse(f"{signal} is {given.dtype}, must be float64")
        if given.shape != shape:
            self._refuse(f"{signal} has shape {given.shape}, must be {shape}: (samples, joints)")
        values = read_only(given, np.float64)
        finite = np.isfinite(values)
        if not finite.all():
            row, joint = np.argwhere(~finite)[0]
            what = f"{signal}_{self.joints[joint]} at row {row} is {values[row, joint]}"
            self._refuse(f"{what}; every value must be finite")
        return values

    def _checked_flags(self, name: str, low: int, high: int, rule: str) -> np.ndarray:
        given = np.asarray(getattr(self, name))
        if given.dtype.kind not in "iub":
            self._refuse(f"{name} is {given.dtype}, must be int8")
        if given.shape != self.t_ns.shape:
            self._refuse(f"{name} has shape {given.shape}, must be {self.t_ns.shape}: (samples,)")
        outside = np.flatnonzero((given < low) | (given > high))
        if outside.size:
            self._refuse(f"{name} at row {outside[0]} is {given[outside[0]]}, must be {rule}")
        return read_only(given, np.int8)

    def _checked_rate(self) -> float:
        rate_hz = float(self.rate_hz)
        if not (math.isfinite(rate_hz) and rate_hz > 0):
            self._refuse(f"rate_hz = {rate_hz:g} must be > 0")
        if self.samples > 1:
            step_ns = float(np.median(np.diff(self.t_ns)))  # fast; an uneven clock may match the fitted period instead
            if abs(step_ns * 1e-9 * rate_hz - 1) > RATE_TOLERANCE:
                step_ns = fitted_period_ns(self.t_ns)
            if abs(step_ns * 1e-9 * rate_hz - 1) > RATE_TOLERANCE:
                self._refuse(
                    f"rate_hz = {rate_hz:g} disagrees with the sample period of t_ns, {step_ns * 1e-6:g} ms "
                    f"({1e9 / step_ns:g} Hz); they must agree within {RATE_TOLERANCE:.0%}; are the times in ns?"
                )
        return rate_hz

    def _checked_provenance(self) -> dict[str, Any]:
        try:
            text = json.dumps(self.provenance, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise RecordingError(f"{self._here}: provenance must be plain JSON ({error})") from error
        if not isinstance(plain := json.loads(text), dict):
            self._refuse(f"provenance is {type(self.provenance).__name__}, must be a dict")
        return plain


def check_joints(joints: Any, here: str) -> tuple[str, ...]:
    """Return joint names as a tuple: at least one, no repeats, and no two that would share a column of the file."""
    names = tuple(joints) if isinstance(joints, tuple | list) else (joints,)
    if not names:
        raise RecordingError(f"{here}: it has no joints; at least one is needed")
    for name in names:
        if not isinstance(name, str) or not name:
            raise RecordingError(f"{here}: joint name {name!r} must be text, not empty")
        if not name.isprintable():
            raise RecordingError(f"{here}: joint name {name!r} has characters that cannot be printed")
    columns: dict[str, str] = {}
    for name in names:
        if names.count(name) > 1:
            raise RecordingError(f"{here}: joint '{name}' is named {names.count(name)} times; names must differ")
        for signal in SIGNALS:
            other = columns.setdefault(f"{signal}_{name}", name)
            if other != name:
                raise RecordingError(
                    f"{here}: joints '{other}' and '{name}' would share the column {signal}_{name}; rename one"
                )
    return names


def read_only(values: np.ndarray, dtype: type) -> np.ndarray:
    """Return the array as contiguous, read-only and of this type; a copy only if needed."""
    if values.dtype == dtype and values.flags.c_contiguous and not values.flags.writeable:
        return values
    values = np.array(values, dtype=dtype, order="C")
    values.flags.writeable = False
    return values
