"""What makes samples of joint states: the arm's joints, the publisher in use, its rate, and the time of each."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

import numpy as np

from tauext.sources.describing import LEARNT_STEPS, mean_period_ns
from tauext_ros2.messages import JointState

# --- The arm's joints in messages with any order of joints and possibly other joints.


FIELDS = ("position", "velocity", "effort")
EMPTY = "{} is empty: position, velocity and effort are needed"


class ArmJoints:
    """Selects positions, velocities and efforts of the arm, (joints,) each, in the order of `names`."""

    def __init__(self, names: tuple[str, ...]):
        """names: names of the joints in the messages."""
        self.names = names
        self._of: list[str] = []
        self._rows: list[int] = []
        self._missing: list[str] = []

    def is_here(self, message: JointState) -> bool:
        """Whether the message has every joint of the arm; it may have others."""
        if message.name != self._of:
            row = {name: k for k, name in reversed(list(enumerate(message.name)))}
            self._of, self._missing = message.name, [name for name in self.names if name not in row]
            self._rows = [row[name] for name in self.names if name in row]
        return not self._missing

    def missing(self, message: JointState) -> str:
        """Text about the joints that a message lacks."""
        self.is_here(message)
        return f"no {', '.join(self._missing)} among its joints {', '.join(message.name) or '(none)'}"

    def pick(self, message: JointState) -> tuple[np.ndarray, np.ndarray, np.ndarray] | str:
        """q [rad], dq [rad/s], tau [N m] of a message with the arm's joints, or the reason why there are none.

        NaN is passed on: the monitor's health handles it.
        """
        values = [getattr(message, field) for field in FIELDS]
        for field, numbers in zip(FIELDS, values, strict=True):
            if len(numbers) != len(message.name):
                counted = f"{field} has {len(numbers)} values for {len(message.name)} names"
                return counted if numbers else EMPTY.format(field)
        q, dq, tau = (np.array(numbers, dtype=np.float64)[self._rows] for numbers in values)
        return q, dq, tau

    def not_finite(self, arrays: tuple[np.ndarray, ...]) -> str | None:
        """Text about the numbers that are NaN or infinite; None: all are finite."""
        bad = [
            f"{field} of {', '.join(self.names[j] for j in np.flatnonzero(~np.isfinite(values)))}"
            for field, values in zip(FIELDS, arrays, strict=True)
            if not np.isfinite(values).all()
        ]
        return f"{' and '.join(bad)} is not a number" if bad else None


def usable_joints(message: JointState, names: tuple[str, ...]) -> tuple[str, ...] | str:
    """Joints of a message with finite position, velocity and effort, or the reason why it is unusable.

    Args:
        names: joints that must be among them; empty: at least one must.
    """
    for field in FIELDS:
        if message.name and not getattr(message, field):
            return EMPTY.format(field)
    rows = zip(message.name, *(getattr(message, field) for field in FIELDS), strict=False)
    finite = tuple(name for name, *values in rows if all(map(math.isfinite, values)))
    what = "no finite position, velocity and effort"
    if missing := [name for name in names if name not in finite]:
        return f"{what} of {', '.join(missing)} among {', '.join(message.name) or '(none)'}"
    return finite or f"{what} of a joint among {', '.join(message.name) or '(none)'}"


def usual_joints(messages: Sequence[JointState], names: tuple[str, ...]) -> tuple[tuple[str, ...], list[JointState]]:
    """Joints of one publisher's usual messages, and these messages: the most joints that a tenth of them have.

    Args:
        messages: usable ones.
        names: as for usable_joints().
    """
    by_joints: dict[tuple[str, ...], list[JointState]] = {}
    for message in messages:
        usable = usable_joints(message, names)
        assert not isinstance(usable, str)
        by_joints.setdefault(usable, []).append(message)
    usual = {joints: those for joints, those in by_joints.items() if 10 * len(those) >= len(messages)}
    return max((usual or by_joints).items(), key=lambda one: (len(one[0]), len(one[1])))


# --- The publisher in use, of several on one topic.


TAKEOVER_NS = 500_000_000
"""Silence after which another publisher is used: longer than any pause of a driver."""


class Followed:
    """The publisher in use: the first one of the arm until it is silent, then the next. Never two at once."""

    def __init__(self) -> None:
        self._handle: int | None = None
        self._last_ns = 0

    def is_another(self, handle: int, now_ns: int) -> bool:
        """Whether this publisher is another than the one in use."""
        return self._handle not in (None, handle) and now_ns - self._last_ns <= TAKEOVER_NS

    def take(self, handle: int, now_ns: int) -> bool:
        """Use a sample of this publisher; returns whether the publisher changed."""
        changed = handle != self._handle
        self._handle, self._last_ns = handle, now_ns
        return changed


# --- From the publisher's rate to the bundle's: every n-th sample, by time stamps.


LEARNT_FROM = LEARNT_STEPS + 1
"""Samples from which the rate is learnt. They are not passed on, since the monitor would detect a wrong rate."""
TOLERANCE = 0.05
"""Relative difference from which the monitor reports another rate."""
CHANGED = 0.2
"""Relative difference from which the rate has changed; less is jitter."""


class SampleRate:
    """Learns a publisher's period from stamps, then selects the samples that match the bundle's rate.

    At n times the bundle's rate every n-th sample is used, in slots of the bundle's period counted from the first; a
    neighbour replaces a lost sample. At any other rate all samples are passed on, and the monitor reports the wrong
    rate.
    """

    def __init__(self, period_ns: int):
        """period_ns: the bundle's period."""
        self._wanted_ns = period_ns
        self.forget()

    def forget(self) -> None:
        """Restart for another publisher."""
        self.period_ns: int | None = None
        """Period of the publisher, [ns]; None until learnt."""
        self.factor = 1
        self.lost = 0
        """Samples lost according to gaps of the stamps, since the period was learnt."""
        self._steps: list[int] = []
        self._last_ns: int | None = None
        self._due_ns: int | None = None

    def wants(self, t_ns: int) -> bool:
        """Whether to pass on the sample at t_ns, which is later than the previous one."""
        last_ns, self._last_ns = self._last_ns, t_ns
        if last_ns is None:
            return False
        step_ns = t_ns - last_ns
        if self.period_ns is not None:
            self.lost += max(0, round(step_ns / self.period_ns) - 1)
        self._learn(step_ns)
        if self.period_ns is None:
            return False
        if self.factor == 1:
            return True
        if self._due_ns is None or t_ns - self._due_ns > self._wanted_ns:
            self._due_ns = t_ns
        if t_ns < self._due_ns - self.period_ns // 2:
            return False
        self._due_ns += self._wanted_ns
        return True

    @property
    def problem(self) -> str | None:
        """Text about a wrong rate of the publisher; None: the rate fits."""
        if self.period_ns is None:
            return None
        is_hz, wanted_hz = 1e9 / self.period_ns, 1e9 / self._wanted_ns
        if self.factor > 1 or abs(is_hz / wanted_hz - 1) <= TOLERANCE:
            return None
        rule = "no multiple of" if is_hz > wanted_hz else "less than"
        return (
            f"{is_hz:.4g} samples a second are {rule} the bundle's {wanted_hz:.4g}: "
            "publish at that rate, or train for this one"
        )

    def _learn(self, step_ns: int) -> None:
        """Learn the period from every LEARNT_FROM samples, since rates change."""
        self._steps.append(step_ns)
        if len(self._steps) < LEARNT_FROM - 1:
            return
        period_ns = mean_period_ns(self._steps)
        self._steps.clear()
        if self.period_ns is not None and abs(period_ns / self.period_ns - 1) <= CHANGED:
            return
        self.period_ns, self._due_ns = period_ns, None
        ratio = self._wanted_ns / period_ns
        self.factor = max(1, round(ratio)) if abs(round(ratio) / ratio - 1) <= TOLERANCE else 1


# --- Stamps that are no clock.


NO_STAMP, REPEATED_STAMPS = "stamps are zero", "messages with new values have the stamp of the one before"
REPEATED_SHARE, OVER_MESSAGES = 0.2, 50
"""Share of such messages, among about the last ones, above which stamps are no clock: some may be sent twice."""


class OwnStamps:
    """Finds stamps of a publisher that are no clock: zero, constant, or coarser than its messages.

    A message that repeats stamp and values is none of these: its driver may be frozen.
    """

    def __init__(self) -> None:
        self.forget()

    def forget(self) -> None:
        """Restart for another publisher."""
        self._last_ns = 0
        self._values: tuple[np.ndarray, ...] = ()
        self._share = 0.0
        self._repeat = False

    def problem(self, stamp_ns: int, values: tuple[np.ndarray, ...]) -> str:
        """Why the stamp of the next message is not used; empty: it is."""
        if stamp_ns == 0:
            return NO_STAMP
        is_repeated = stamp_ns == self._last_ns and not all(map(np.array_equal, values, self._values))
        self._last_ns, self._values = stamp_ns, values
        self._share += (is_repeated - self._share) / OVER_MESSAGES
        self._repeat = self._repeat or self._share > REPEATED_SHARE
        return REPEATED_STAMPS if self._repeat else ""


# --- Time of samples: from their stamps if these are usable, else from reception.


JUMP_NS = 1_000_000_000
"""If a stamp departs by more than this from the times of reception, a clock was set."""


class SampleTime:
    """Adds up steps between stamps or, where stamps contradict reception, between receptions.

    While stamps are valid, time equals the stamp, independent of network delays. If a clock is set forward or back, one
    step is taken from reception and time continues from there. Without stamps every step is taken from reception. If
    two samples arrive together, that step equals the previous one.
    A sample with the previous stamp gets the same time; the caller drops it.
    """

    def __init__(self) -> None:
        self._t_ns = self._stamp_ns = self._received_ns = self._step_ns = 0
        self._begun = False

    def next(self, stamp_ns: int, received_ns: int, follows: bool = True) -> tuple[int, str | None]:
        """Time of the next sample, [ns], and text about a problem of its stamp.

        Args:
            stamp_ns: stamp of the message; 0: none.
            received_ns: time of reception by a monotonic clock.
            follows: False for the first sample of another publisher, which may use another clock.
        """
        wrong, step_ns = None, stamp_ns - self._stamp_ns
        by_reception_ns = received_ns - self._received_ns
        if stamp_ns == 0:
            wrong = "stamps are missing: times of reception are used"
        elif self._begun and follows and self._stamp_ns:
            if step_ns == 0:
                return self._t_ns, "two messages have the same stamp: the second is dropped"
            if step_ns < 0:
                wrong = f"the stamp went back by {-step_ns / 1e9:.3g} s: the time of reception is used"
            elif step_ns - by_reception_ns > JUMP_NS:
                wrong = f"the stamp jumped ahead by {step_ns / 1e9:.3g} s: the time of reception is used"
        if not self._begun:
            self._t_ns = stamp_ns or time.time_ns()
        elif wrong or not follows or not self._stamp_ns:
            self._step_ns = by_reception_ns or self._step_ns
            self._t_ns += self._step_ns
        else:
            self._step_ns = step_ns
            self._t_ns += step_ns
        self._begun, self._stamp_ns, self._received_ns = True, stamp_ns, received_ns
        return self._t_ns, wrong
