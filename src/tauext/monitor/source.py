"""The interface of live sources, and velocity and torque of servo samples."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Protocol, runtime_checkable

import numpy as np

from tauext import _core
from tauext._core import RATE_TOLERANCE_RANGE, ServoSettings

# --- Where live samples come from: one small interface for recordings, robots and networks.


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """One measurement of the whole arm; arrays are (joints,) float64 in the order of the bundle's joints."""

    t_ns: int
    """When it was measured, by the source's clock, [ns]; only differences matter."""
    q: np.ndarray
    """[rad]."""
    dq: np.ndarray
    """[rad/s]."""
    tau: np.ndarray
    """Motor torque at the joint, [N m], or what the bundle's recordings hold in its place (such as amperes), in the
    units that the source was opened with: SourceSettings.torque_units. NaN where it was not measured."""
    received_ns: int
    """Reception in this process, by time.monotonic_ns()."""
    temperature: np.ndarray | None = None
    """[degC], NaN where it was not measured; None: the source measures none."""
    q_des: np.ndarray | None = None
    """Goal of a servo, [rad], NaN where it was not measured; None: the source measures none. So of the next three."""
    current: np.ndarray | None = None
    """[A], as the servo reports it: of its windings, or of its supply."""
    duty: np.ndarray | None = None
    """Share of the supply voltage at its motor, -1 to 1."""
    voltage: np.ndarray | None = None
    """Of its supply, [V]."""


@dataclass
class SourceCounts:
    """Counts of samples before they reach the loop, since open()."""

    received: int = 0
    lost: int = 0  # never received: detected by a gap of stamps or numbers
    overrun: int = 0  # received while the loop was late, and replaced by newer ones
    refused: int = 0  # received but unusable: of another arm, or without velocity or torque


@dataclass(frozen=True)
class SourceSettings:
    """What a source needs from the bundle."""

    joints: tuple[str, ...]
    """Names, in the order that samples must have."""
    period_ns: int
    """Of the bundle's samples, [ns]."""
    torque_units: tuple[str, ...] = ()
    """Of the tau that the bundle takes, a joint: "N m", "N", "A" or "recorded unit"; empty: N m, or N."""
    torque_timing: str = ""
    """What a torque sample of the bundle means: held, instant or averaged."""
    servo: ServoSettings | None = None
    """What the loop makes torque from, of a bundle of servos' recordings; None, or off: tau is taken as it is."""
    rate_tolerance: float = RATE_TOLERANCE_RANGE[0]
    """Of the period: a monitor reports a larger difference as a wrong rate."""


class Source(Protocol):
    """Gives one sample after the other, oldest first; used by one thread, and closed by it.

    A source may read ahead in a thread of its own, into a SampleQueue: bounded, where the newest sample wins and what
    it pushes out is counted. A source never waits longer than timeout_s, makes up no sample, and drops none uncounted.
    """

    name: str
    """For people and files: `ur 192.168.0.2`."""
    counts: SourceCounts

    def open(self, settings: SourceSettings) -> None:
        """Connect; refuse with ConfigError what cannot fit: joints that are not there, another rate.

        A robot that is not there yet need not be an error: then next_sample() returns None until it is.
        """
        ...

    def next_sample(self, timeout_s: float) -> Sample | None:
        """The next sample; None where none came for timeout_s, or after the last one."""
        ...

    @property
    def ended(self) -> bool:
        """No sample will come any more: a recording is over, a robot has closed the connection for good."""
        ...

    def notes(self) -> list[str]:
        """New messages for the user: `two publishers on /joint_states, the first is followed`."""
        ...

    def close(self) -> None:
        """Disconnect; more than one call does no harm."""
        ...


@runtime_checkable
class Stoppable(Protocol):
    """A source that can make its robot stop."""

    def stop(self) -> None:
        """Called by the thread of a reaction, beside next_sample() of the loop; may take its time and may raise."""
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


# --- Velocity and torque of a servo arm's live samples, by the bundle's word.


class ServoStage:
    """Fills dq and tau of one sample after the other, as import did for the recordings that the bundle was trained on.

    A signal that is needed and that the source did not measure makes them NaN, which the monitor takes for a fault.
    """

    def __init__(self, settings: _core.ServoSettings):
        self._input = _core.ServoInput(settings)

    def made(self, sample: Sample) -> Sample:
        """The sample with dq [rad/s] and tau in the unit that the bundle takes."""
        kept = (sample.dq, sample.tau, sample.q_des, sample.current, sample.duty, sample.voltage)
        signals = (None if values is None else np.ascontiguousarray(values, dtype=np.float64) for values in kept)
        dq, tau = self._input.step(sample.t_ns, np.ascontiguousarray(sample.q, dtype=np.float64), *signals)
        return replace(sample, dq=dq, tau=tau)
