"""The interface of live sources, and velocity and torque of servo samples."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import groupby
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np

from tauext import _core
from tauext._core import RATE_TOLERANCE_RANGE, ServoSettings
from tauext.data.recording import Recording

# --- The interface of live sources: recordings, robots and networks.


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One measurement of the whole arm; arrays are (joints,) float64 in the order of the bundle's joints."""

    t_ns: int
    """Time of measurement by the source's clock, [ns]; only differences matter."""
    q: np.ndarray
    """Position, [rad]."""
    dq: np.ndarray
    """Velocity, [rad/s]."""
    tau: np.ndarray
    """Motor torque at the joint, [N m], or its substitute in the bundle's recordings (such as amperes), in the units of
    SourceSettings.torque_units. NaN where it was not measured."""
    received_ns: int
    """Time of reception in this process, by time.monotonic_ns()."""
    temperature: np.ndarray | None = None
    """Temperature, [degC], NaN where it was not measured; None: the source measures none."""
    q_des: np.ndarray | None = None
    """Goal of a servo, [rad], NaN where it was not measured; None: not measured by the source, as for the next
    three."""
    current: np.ndarray | None = None
    """Current reported by a servo, of its windings or its supply, [A]."""
    duty: np.ndarray | None = None
    """Share of the supply voltage at its motor, -1 to 1."""
    voltage: np.ndarray | None = None
    """Supply voltage, [V]."""

    @property
    def shapes(self) -> tuple[tuple[int, ...] | None, ...]:
        """Shape of each signal; None: not measured by the source."""
        return tuple(None if (one := getattr(self, name)) is None else np.shape(one) for name in SIGNALS)


SIGNALS = ("q", "dq", "tau", "temperature", "q_des", "current", "duty", "voltage")
"""Signals of a sample; a source measures the first three."""


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """Successive samples with the same signals, at least one; a row each. See Sample for the units."""

    t_ns: np.ndarray
    """(rows,) int64, [ns]."""
    q: np.ndarray
    """(rows, joints), as the other signals."""
    dq: np.ndarray
    tau: np.ndarray
    received_ns: np.ndarray
    """(rows,) int64, [ns]."""
    temperature: np.ndarray | None = None
    q_des: np.ndarray | None = None
    current: np.ndarray | None = None
    duty: np.ndarray | None = None
    voltage: np.ndarray | None = None

    @staticmethod
    def of(samples: Sequence[Sample]) -> Block:
        """Make a block of samples with the same shapes."""

        def rows(name: str, kind: type = np.float64) -> np.ndarray:
            if len(samples) == 1:
                return np.asarray(getattr(samples[0], name), kind)[None]
            return np.array([getattr(one, name) for one in samples], kind)

        measured = [name for name in SIGNALS if getattr(samples[0], name) is not None]
        times = {name: rows(name, np.int64) for name in ("t_ns", "received_ns")}
        return Block(**times, **{name: rows(name) for name in measured})

    def sample(self, row: int) -> Sample:
        of_row: dict[str, Any] = {name: None if (one := getattr(self, name)) is None else one[row] for name in SIGNALS}
        return Sample(int(self.t_ns[row]), received_ns=int(self.received_ns[row]), **of_row)

    def __len__(self) -> int:
        return len(self.t_ns)

    def __getitem__(self, rows: slice) -> Block:
        if rows == slice(0, len(self)):
            return self
        parts: list[Any] = [None if (one := getattr(self, name.name)) is None else one[rows] for name in fields(self)]
        return Block(*parts)


def blocks_of(samples: Sequence[Sample], joints: int) -> Iterator[tuple[Block, bool]]:
    """Blocks of successive samples, and whether every signal has one value for each joint: else all values are NaN."""
    for shapes, group in groupby(samples, key=lambda one: one.shapes):
        if set(shapes) <= {None, (joints,)}:
            yield Block.of(tuple(group)), True
        else:
            unknown = np.full(joints, np.nan)
            yield Block.of([Sample(one.t_ns, unknown, unknown, unknown, one.received_ns) for one in group]), False


class CountedTime:
    """Time that samples have taken, whatever happens to their clock: durations are measured in it.

    Where stamps go back, stand still or jump ahead, a sample counts as one period.
    """

    LONGEST_NS = 1_000_000_000
    """Longest step between two stamps that counts as such, or two periods if these are longer, [ns]."""

    def __init__(self, period_ns: int):
        self.now_ns = 0
        self._period_ns, self._longest_ns = period_ns, max(self.LONGEST_NS, 2 * period_ns)
        self._last_ns: int | None = None

    def step(self, t_ns: int) -> int:
        """Count the sample of this stamp; returns the time since the first one, [ns]."""
        if self._last_ns is not None:
            step_ns = t_ns - self._last_ns
            self.now_ns += step_ns if 0 < step_ns <= self._longest_ns else self._period_ns
        self._last_ns = t_ns
        return self.now_ns

    def steps(self, t_ns: np.ndarray) -> np.ndarray:
        """Count samples, at least one; returns the time of each, (samples,) [ns]."""
        times_ns = np.array([self.step(int(t_ns[0]))])
        if len(t_ns) > 1:
            steps_ns = np.diff(t_ns)
            steps_ns[(steps_ns <= 0) | (steps_ns > self._longest_ns)] = self._period_ns
            times_ns = np.append(times_ns, self.now_ns + np.cumsum(steps_ns))
            self.now_ns, self._last_ns = int(times_ns[-1]), int(t_ns[-1])
        return times_ns


@dataclass
class SourceCounts:
    """Counts of samples before they reach the loop, since open()."""

    received: int = 0
    lost: int = 0  # never received, detected by a gap of stamps or numbers
    overrun: int = 0  # received while the loop was late, and replaced by newer ones
    refused: int = 0  # received but unusable: of another arm, or without velocity or torque


@dataclass(frozen=True)
class SourceSettings:
    """Settings of a source: of the bundle or, before one exists, its own description."""

    joints: tuple[str, ...]
    """Names of the joints, in the order of the samples."""
    period_ns: int
    """Sample period of the bundle, [ns]."""
    torque_units: tuple[str, ...] = ()
    """Units of the bundle's input tau, one a joint: "N m", "N", "A" or "recorded unit"; empty: N m, or N."""
    torque_timing: str = ""
    """Timing of the bundle's torque samples: held, instant or averaged."""
    servo: ServoSettings | None = None
    """Settings for computing torque from servo signals; None or off: tau is used unchanged."""
    rate_tolerance: float = RATE_TOLERANCE_RANGE[0]
    """Largest relative difference of the period; a monitor reports more as a wrong rate."""


def settings_of(bundle: _core.Bundle) -> SourceSettings:
    """What a source must deliver for this bundle."""
    observer = bundle.observer
    joints, units = tuple(link.joint_name for link in bundle.links), tuple(bundle.torque_units)
    return SourceSettings(
        joints, observer.sample_period_ns, units, observer.timing.name, bundle.servo, bundle.rate_tolerance
    )


Signal = Literal["torque", "current", "duty", "goal", "unknown"]


@dataclass(frozen=True)
class SourceFacts:
    """What a source delivers, as far as it is known before a bundle exists."""

    settings: SourceSettings
    signal: Signal
    """Kind of the signal that stands for the torque."""
    temperature: bool
    """Whether samples contain temperatures."""
    notes: tuple[str, ...] = ()
    """What was assumed, a sentence each."""


@runtime_checkable
class Describes(Protocol):
    """A source that can find out what it delivers, so that no bundle has to prescribe it."""

    def describe(self, wait_s: float, robot: Path | None = None) -> SourceFacts:
        """May connect, read and disconnect; called before open().

        Args:
            wait_s: longest wait for the arm, [s].
            robot: robot file, for the names and the order of joints.

        Raises:
            AwayError: nothing usable was received in this time; the caller may try again.
            ConfigError: the arm, a file and an option do not fit each other.
            RobotError: the robot file is missing or cannot be read.
        """
        ...


@runtime_checkable
class Commanded(Protocol):
    """A source that takes commands, such as pushes at a simulated arm."""

    def command(self, text: str) -> None:
        """Called by any thread, concurrently with next_sample(); must return at once.

        Raises:
            ConfigError: an unknown command, or a bad value.
        """
        ...


@runtime_checkable
class Recorded(Protocol):
    """A source whose samples are those of a recording, with their stamps. The loop takes them as blocks."""

    recording: Recording
    is_made: bool
    """Whether velocity and torque of a servo arm are those of the recording, not computed again from its signals."""

    def next_block(self, timeout_s: float, most_rows: int) -> Block | None:
        """Return the next samples whose time has come; None if there are none within timeout_s, or after the last."""
        ...


class Source(Protocol):
    """Returns samples in order, oldest first; used and closed by one thread.

    A source may read ahead in its own thread into a SampleQueue: bounded, keeps the newest samples and counts dropped
    ones. A source never waits longer than timeout_s, invents no samples, and counts every dropped one.
    """

    name: str
    """Name for messages and files: `ur 192.168.0.2`."""
    counts: SourceCounts

    def open(self, settings: SourceSettings) -> None:
        """Connect; raise ConfigError for a mismatch such as missing joints or another rate, AwayError without a robot.

        A missing robot need not be an error: next_sample() then returns None until it appears.
        """
        ...

    def next_sample(self, timeout_s: float) -> Sample | None:
        """Return the next sample; None if none came within timeout_s, or after the last one."""
        ...

    @property
    def ended(self) -> bool:
        """Whether no more samples will come: the recording is over or the connection closed for good."""
        ...

    def notes(self) -> list[str]:
        """New messages for the user: `two publishers on /joint_states, the first is followed`."""
        ...

    def close(self) -> None:
        """Disconnect; repeated calls are allowed."""
        ...


@runtime_checkable
class Stoppable(Protocol):
    """A source that can make its robot stop."""

    def stop(self) -> None:
        """Called by a reaction's thread, concurrently with next_sample() of the loop; may be slow and may raise."""
        ...


@runtime_checkable
class StopChecked(Protocol):
    """A Stoppable source that can check at the start whether stop() would work."""

    def check_stop(self) -> None:
        """Called before the first sample if a reaction stops the robot.

        Raises:
            ConfigError: stop() would fail.
        """
        ...


# --- Velocity and torque of a servo arm's live samples, by the bundle's settings.


def servo_stage(arm: SourceSettings, recorded: Recorded | None) -> ServoStage | None:
    """What makes velocity and torque of this arm's samples; None: they come as they are used."""
    has_made = recorded is not None and recorded.is_made
    return None if arm.servo is None or not arm.servo.on or has_made else ServoStage(arm.servo)


class ServoStage:
    """Computes dq and tau of samples, as import did for the bundle's training recordings.

    A missing signal makes them NaN, which the monitor reports as a fault.
    """

    def __init__(self, settings: _core.ServoSettings):
        self._input = _core.ServoInput(settings)

    def made(self, block: Block) -> Block:
        """Return the samples with dq [rad/s] and tau in the bundle's input unit."""
        signals = [block.q, block.dq, block.tau, block.q_des, block.current, block.duty, block.voltage]
        rows = zip(block.t_ns.tolist(), *([None] * len(block) if one is None else one for one in signals), strict=True)
        made = [self._input.step(*row) for row in rows]
        dq, tau = (np.array(values) for values in zip(*made, strict=True))
        return replace(block, dq=dq, tau=tau)
