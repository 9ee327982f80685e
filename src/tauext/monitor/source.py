"""The interface of live sources, and velocity and torque of servo samples."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, Protocol, runtime_checkable

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

    def fits(self, joints: int) -> bool:
        """Whether every signal has one value for each joint."""
        rest = (self.temperature, self.q_des, self.current, self.duty, self.voltage)
        signals = (self.q, self.dq, self.tau, *(one for one in rest if one is not None))
        return all(np.shape(one) == (joints,) for one in signals)

    def without_values(self, joints: int) -> Sample:
        """NaN for each joint, with the same times."""
        unknown = np.full(joints, np.nan)
        return Sample(self.t_ns, unknown, unknown, unknown, self.received_ns)


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
    """A source whose samples are those of a recording, with their stamps."""

    recording: Recording


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


class ServoStage:
    """Computes dq and tau of each sample, as import did for the bundle's training recordings.

    A missing signal makes them NaN, which the monitor reports as a fault.
    """

    def __init__(self, settings: _core.ServoSettings):
        self._input = _core.ServoInput(settings)

    def made(self, sample: Sample) -> Sample:
        """Return the sample with dq [rad/s] and tau in the bundle's input unit."""
        kept = (sample.dq, sample.tau, sample.q_des, sample.current, sample.duty, sample.voltage)
        signals = (None if values is None else np.ascontiguousarray(values, dtype=np.float64) for values in kept)
        dq, tau = self._input.step(sample.t_ns, np.ascontiguousarray(sample.q, dtype=np.float64), *signals)
        return replace(sample, dq=dq, tau=tau)
