"""What a mutation does to a recording: each changes what it names and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from tauext.data.recording import Recording

SIGNALS = ("q", "dq", "tau")
STUCK_TRIES = 20


@dataclass(frozen=True)
class Facts:
    """What a mutation's size is measured by, joint by joint, of a dataset's training recordings."""

    largest: dict[str, np.ndarray]
    """|dq| [rad/s] and |tau| [N m], (n,)."""
    nm_per_ampere: np.ndarray
    """Of the drives: what a torque is divided by that is logged as a current, (n,)."""


@dataclass(frozen=True)
class Change:
    """One mutation of a recording."""

    what: str
    """A key of CHANGES."""
    signals: tuple[str, ...] = SIGNALS
    joints: tuple[int, ...] = ()
    """None: all."""
    size: float = 0.0
    length: float = 0.0
    """Samples of a spike; seconds of a signal that is stuck, infinite: all of them."""


def facts_of(recordings: Sequence[Recording], nm_per_ampere: Sequence[float]) -> Facts:
    largest = {s: np.max([np.abs(getattr(r, s)).max(axis=0) for r in recordings], axis=0) for s in ("dq", "tau")}
    return Facts(largest, np.array(nm_per_ampere))


def changed(recording: Recording, change: Change, facts: Facts, rng: np.random.Generator) -> Recording:
    """The recording after the mutation; its name, and what it does not name, stay.

    Raises:
        RecordingError: no recording may be so.
    """
    joints = list(change.joints) or list(range(len(recording.joints)))
    return CHANGES[change.what](recording, change, joints, facts, rng)


def _each(recording: Recording, change: Change, new: Callable[[str, np.ndarray], None]) -> Recording:
    """With a copy of each signal that `new` has written into."""
    signals = {name: getattr(recording, name).copy() for name in change.signals}
    for name, values in signals.items():
        new(name, values)
    return replace(recording, **signals)


def factor(
    recording: Recording, change: Change, joints: list[int], facts: Facts, rng: np.random.Generator
) -> Recording:
    """Times the size: another unit, or the opposite sign."""

    def scale(_: str, values: np.ndarray) -> None:
        values[:, joints] *= change.size

    return _each(recording, change, scale)


def amperes(
    recording: Recording, change: Change, joints: list[int], facts: Facts, rng: np.random.Generator
) -> Recording:
    """Currents that stand as torques."""

    def divide(_: str, values: np.ndarray) -> None:
        values[:, joints] /= facts.nm_per_ampere[joints]

    return _each(recording, change, divide)


def exchange(
    recording: Recording, change: Change, joints: list[int], facts: Facts, rng: np.random.Generator
) -> Recording:
    """Two joints' columns, one for the other."""
    first, second = joints

    def swap(_: str, values: np.ndarray) -> None:
        values[:, [first, second]] = values[:, [second, first]]

    return _each(recording, change, swap)


def spike(recording: Recording, change: Change, joints: list[int], facts: Facts, rng: np.random.Generator) -> Recording:
    """A few samples in a row: a velocity or torque is set to so many times the largest, a position is off by rad."""
    count = int(change.length)
    begin = int(rng.integers(recording.samples // 10, max(recording.samples // 10 + 1, recording.samples - count)))
    rows, sign = slice(begin, begin + count), float(rng.choice([-1, 1]))

    def put(name: str, values: np.ndarray) -> None:
        if name == "q":
            values[rows, joints] += sign * change.size
        else:
            values[rows, joints] = sign * change.size * facts.largest[name][joints]

    return _each(recording, change, put)


def stuck(recording: Recording, change: Change, joints: list[int], facts: Facts, rng: np.random.Generator) -> Recording:
    """A signal keeps a value for some seconds while its joint moves; infinite: for the whole recording."""
    count = recording.samples
    begin = 0
    if np.isfinite(change.length):
        count = min(round(change.length * recording.rate_hz), recording.samples)
        tries = rng.integers(0, max(1, recording.samples - count), STUCK_TRIES)
        moved = [np.ptp(recording.q[at : at + count, joints], axis=0).max() for at in tries]
        begin = int(tries[int(np.argmax(moved))])

    def hold(_: str, values: np.ndarray) -> None:
        values[begin : begin + count, joints] = values[begin, joints]

    return _each(recording, change, hold)


def delay(recording: Recording, change: Change, joints: list[int], facts: Facts, rng: np.random.Generator) -> Recording:
    """Later by so many seconds than the other signals."""
    time_s = recording.time_s

    def late(_: str, values: np.ndarray) -> None:
        for j in joints:
            values[:, j] = np.interp(time_s - change.size, time_s, values[:, j])

    return _each(recording, change, late)


def time_unit(
    recording: Recording, change: Change, joints: list[int], facts: Facts, rng: np.random.Generator
) -> Recording:
    """Stamps counted from the first, times the size; the nominal rate follows, as an import takes it from them."""
    steps = np.round((recording.t_ns - recording.t_ns[0]) * change.size).astype(np.int64)
    return replace(recording, t_ns=recording.t_ns[0] + steps, rate_hz=recording.rate_hz / change.size)


def zero(recording: Recording, change: Change, joints: list[int], facts: Facts, rng: np.random.Generator) -> Recording:
    """Positions count from elsewhere, by so many rad."""

    def shift(_: str, values: np.ndarray) -> None:
        values[:, joints] += change.size

    return _each(recording, change, shift)


def thinned(
    recording: Recording, change: Change, joints: list[int], facts: Facts, rng: np.random.Generator
) -> Recording:
    """Every so manieth row alone."""
    step = int(change.size)
    signals = {
        name: values[::step]
        for name in (*SIGNALS, "t_ns", "tau_jts", "tau_ext", "tau_ext_sensor", "q_des", "temperature", "contact",
                     "contact_link")
        if (values := getattr(recording, name)) is not None
    }  # fmt: skip
    return replace(recording, rate_hz=recording.rate_hz / step, **signals)


CHANGES = {
    "factor": factor,
    "amperes": amperes,
    "exchange": exchange,
    "spike": spike,
    "stuck": stuck,
    "delay": delay,
    "time-unit": time_unit,
    "zero": zero,
    "thinned": thinned,
}
