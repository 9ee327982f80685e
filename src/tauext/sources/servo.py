"""What sources of serial servos have in common: one transaction a period, silent servos, holding position."""

from __future__ import annotations

import threading
import time
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from tauext.data.servo_types import COUNTS_A_TURN
from tauext.errors import ConfigError
from tauext.monitor.loop import DropOuts
from tauext.monitor.source import Sample, SourceSettings
from tauext.sources.reader import ReaderSource, Ticks, Unreachable
from tauext.sources.servo_bus_file import ServoBusFile, ServoJoint
from tauext.sources.servo_port import PORT_ERRORS, ServoPort

# --- One request to all servos of a serial bus, and their answers, whichever of them come.


class Packets(Protocol):
    """A vendor's packet handler, as both of them are called; the fields say how their packets differ."""

    overhead: int
    """Bytes of an answer beside its data."""
    asked: int
    """Bytes of a request for a block beside the ids."""
    success: int
    """What their functions return where nothing is wrong."""
    silence: int
    """What they return where nothing came."""

    def ask(self, port: ServoPort, address: int, length: int, ids: Sequence[int]) -> int:
        """Send a sync read, the one instruction that all servos answer, one after the other."""
        ...

    def answer(self, port: ServoPort) -> tuple[int, int, int, bytes]:
        """Wait for the next packet: what was wrong with it, id, error bits, data."""
        ...

    def write(self, port: ServoPort, address: int, length: int, data: Sequence[int]) -> int:
        """Send a sync write, which no servo answers; data: id, bytes, id, bytes ..."""
        ...


@dataclass
class Reading:
    """What came of one request."""

    t_ns: int
    """When it was sent, by time.monotonic_ns(): each servo reads its registers on its way to answer."""
    data: dict[int, bytes] = field(default_factory=dict)
    """Registers by id, of the servos whose answer was whole."""
    errors: dict[int, int] = field(default_factory=dict)
    """Error bits by id, as their packets hold them."""
    corrupt: int = 0
    """Packets that could not be used: a wrong checksum, a wrong length, bytes that are no packet, a servo not asked."""


class ServoBus:
    """Transactions on a port. Whoever else of this process uses the port holds `lock` meanwhile."""

    def __init__(self, port: ServoPort, packets: Packets):
        self.port, self.packets = port, packets
        self.lock = threading.Lock()
        """A transaction holds it; a thread that drives the arm through the same port does, too."""

    def transaction_s(self, servos: int, length: int) -> float:
        """Shortest time of a reading, by the bytes on the wire, [s]; return delays of the servos are on top."""
        packets = self.packets
        return self.port.wire_s(packets.asked + servos + servos * (packets.overhead + length))

    def read(self, address: int, length: int, ids: Sequence[int]) -> Reading:
        """Registers address to address + length - 1 of all these servos. Which of them did not answer is for the caller
        to see.

        Raises:
            Unreachable: the port has gone.
        """
        with self.lock:
            return self._read(address, length, ids)

    def write(self, address: int, length: int, values: Mapping[int, bytes]) -> None:
        """Registers of each servo by its id; no servo says whether it took them: read them back.

        Raises:
            Unreachable: the port has gone.
        """
        data = [byte for id_, value in values.items() for byte in (id_, *value)]
        with self.lock:
            self._sent(self.packets.write, address, length, data)

    def _read(self, address: int, length: int, ids: Sequence[int]) -> Reading:
        reading = Reading(time.monotonic_ns())
        self._sent(self.packets.ask, address, length, ids)
        silent = set(ids)
        while silent:
            try:
                result, id_, error, data = self.packets.answer(self.port)
            except PORT_ERRORS as wrong:
                raise Unreachable(f"the port has gone: {wrong}") from wrong
            if result == self.packets.success and len(data) == length and id_ in silent:
                silent.discard(id_)
                reading.data[id_], reading.errors[id_] = data, error
                continue
            reading.corrupt += result != self.packets.silence
            if self.port.isPacketTimeout():
                break
        return reading

    def _sent(self, send: Any, address: int, length: int, data: Sequence[int]) -> None:
        self.port.begin()
        try:
            result = send(self.port, address, length, data)
        except PORT_ERRORS as wrong:
            raise Unreachable(f"the port has gone: {wrong}") from wrong
        if result != self.packets.success:
            raise Unreachable(f"a request could not be sent (the library's code {result})")


# --- What sources of serial servos have in common: all servos in one transaction a period, who is silent, how to hold.


WAIT_S = 0.1
TRIES = 3
"""Of what is asked once: a packet may be lost."""
ON = b"\x01"
COUNT_RAD = 2 * np.pi / COUNTS_A_TURN


@dataclass(frozen=True)
class Identity:
    """What a servo says of itself once."""

    model: str
    """Its name, by its model number."""
    reports: tuple[str, ...]
    """As data.servo_types: torque_from that it can serve, beside goal."""
    homing_offset: int
    """[counts]."""
    holds: bool
    """It follows a goal position: its operating mode is one of those."""


@dataclass(frozen=True)
class Registers:
    """What one reading of a servo says, in its own direction; NaN: not measured."""

    count: int
    """Position."""
    goal: float
    """Where the servo goes, [counts]; NaN where it follows no goal, say with its torque off."""
    counts_a_s: float
    """Speed."""
    current: float
    """[A]."""
    duty: float
    """-1 to 1."""
    volts: float
    celsius: float


class ServoSource(ReaderSource):
    """Angles, speeds, goals, currents, duties, voltages and temperatures of the bundle's joints, a reading a period.

    A reading in which a servo is missing, or its packet corrupt, is left out and counted as refused. Reading never
    writes a register; stop() alone writes, the goals of servos whose torque is on.
    """

    bus: ServoBus
    """For a program that drives the arm through the same port, in this process: see ServoBus.lock."""

    # What a maker's servos have of their own.

    packets: type[Packets]
    block: tuple[int, int]
    """First register of a reading, and how many bytes."""
    identity: tuple[int, int]
    """The same of what is asked once."""
    goal: tuple[int, int]
    """The same of the goal position."""
    position: tuple[int, int]
    """The same of the present position."""
    torque_enable: tuple[int, int]
    """The same of the switch of the torque: 1 is on."""
    current_turns: bool
    """The sign of the current goes with the direction of the joint."""

    def __init__(self, port: str, file: ServoBusFile):
        super().__init__(f"{self.kind} {port}")
        self._file = file
        self.bus = ServoBus(ServoPort(port, file.baud), self.packets())
        self._servos: list[ServoJoint] = []
        self._identities: dict[int, Identity] = {}

    @property
    @abstractmethod
    def kind(self) -> str:
        """As the command line names it."""

    @abstractmethod
    def identified(self, servo: ServoJoint, data: bytes) -> Identity:
        """From the bytes of `identity`. Raises Unreachable: an unknown servo."""

    @abstractmethod
    def registers(self, identity: Identity, data: bytes) -> Registers:
        """From the bytes of `block`."""

    @abstractmethod
    def complaint(self, error: int) -> str:
        """In words what the error bits of an answer say; empty: nothing."""

    # Of a source.

    def open(self, settings: SourceSettings) -> None:
        self.robot_joints = len(settings.joints)
        self._servos = self._file.of(settings.joints)
        self._ids = [servo.id for servo in self._servos]
        self._drop_outs = DropOuts({servo.id: str(servo) for servo in self._servos}, self._note)
        self._said: dict[int, int] = {}
        least_s = self.bus.transaction_s(len(self._ids), self.block[1])
        if least_s * 1e9 > settings.period_ns:
            raise ConfigError(
                f"{self.name}: a reading of {len(self._ids)} servos takes {least_s * 1e3:.2g} ms at {self._file.baud} "
                f"baud, the bundle takes one every {settings.period_ns * 1e-6:g} ms"
            )
        self._tell_of_delay(settings)
        super().open(settings)

    def connect(self) -> None:
        port = self.bus.port
        port.close()
        port.open()
        try:
            said = self._all_of(*self.identity)
            self._identities = {one.id: self.identified(one, said[one.id]) for one in self._servos}
            for servo in self._servos:
                self._expect(servo, self._identities[servo.id])
        except Unreachable:
            port.close()
            raise
        self._ticks = Ticks(self.settings.period_ns * 1e-9)

    def read(self) -> Sample | None:
        if (skipped := self._ticks.wait(WAIT_S)) is None:
            return None
        self.counts.lost += skipped
        reading = self.bus.read(*self.block, self._ids)
        if not self._drop_outs.whole(reading.data.keys(), reading.corrupt):
            self.counts.refused += 1
            return None
        for id_, error in reading.errors.items():
            self._complain(id_, error)
        return self._sample(reading.t_ns, [reading.data[id_] for id_ in self._ids])

    def disconnect(self) -> None:
        self.bus.port.close()

    def close(self) -> None:
        super().close()
        if self._servos and (summary := self._drop_outs.summary()):
            self._note(f"{self.name}: {summary}")
            self._drop_outs.forget()

    def stop(self) -> None:
        """Holds: writes the goal position of every servo whose torque is on, its present position, and reads it back.

        Nothing else is written: a servo whose torque is off stays so.

        Raises:
            RuntimeError: a servo follows no goals, does not answer, or does not take the goal.
        """
        silent, unlike = set(self._ids), set[int]()
        for _ in range(TRIES):
            on = self.bus.read(*self.torque_enable, sorted(silent | unlike)).data
            present = self.bus.read(*self.position, list(on)).data
            silent -= present.keys()
            goals = {id_: data for id_, data in present.items() if on[id_] == ON and self._identities[id_].holds}
            taken = {}
            if goals:
                self.bus.write(*self.goal, goals)
                taken = self.bus.read(*self.goal, list(goals)).data
            unlike = {id_ for id_, data in goals.items() if taken.get(id_) != data} | (unlike - present.keys())
            if not silent | unlike:
                break
        by_why = (
            (silent, "does not answer"),
            (unlike, "does not take the goal"),
            ({id_ for id_ in self._ids if not self._identities[id_].holds}, "is in an operating mode without goal"),
        )
        told = [f"{one} {why}" for ids, why in by_why for one in self._servos if one.id in ids]
        if told:
            raise RuntimeError(f"{self.name} does not hold: {', '.join(told)}")

    # Inside.

    def _count_lost(self, t_ns: int) -> None:
        """Nothing: stamps are those of requests, and a request that was skipped is counted where it is."""

    def _all_of(self, address: int, length: int) -> dict[int, bytes]:
        """Registers of all servos. Raises Unreachable: one does not answer."""
        came: dict[int, bytes] = {}
        for _ in range(TRIES):
            came |= self.bus.read(address, length, [id_ for id_ in self._ids if id_ not in came]).data
            if len(came) == len(self._ids):
                return came
        silent = ", ".join(str(one) for one in self._servos if one.id not in came)
        there = ", ".join(str(one.id) for one in self._servos if one.id in came)
        found = f"{there} do" if there else "nor does any other: is the arm's power on, and are they at "
        found += "" if there else f"{self._file.baud} baud?"
        raise Unreachable(f"{silent} does not answer; {found}")

    def _expect(self, servo: ServoJoint, identity: Identity) -> None:
        """Raises Unreachable where the servo is not the one that the file and the bundle mean."""
        if servo.type and not (servo.type.startswith(identity.model) or identity.model.startswith(servo.type)):
            raise Unreachable(f"{servo} is a {identity.model}, {self._file.path} says {servo.type}")
        if servo.homing_offset is not None and servo.homing_offset != identity.homing_offset:
            raise Unreachable(
                f"{servo} has homing offset {identity.homing_offset}, {self._file.path} {servo.homing_offset}: is it "
                "another arm's calibration, or an old one?"
            )
        told = self.settings.servo
        if told is None or not told.on:
            raise Unreachable(
                "servos report current, duty and goal, of which the bundle makes no torque: import its recordings with "
                "a [servo] table in arm.toml"
            )
        needed = told.torque_from.name.replace("_", "-")
        if needed not in (*identity.reports, "goal"):
            raise Unreachable(
                f"{servo}, a {identity.model}, reports {', '.join((*identity.reports, 'goal'))}, "
                f"the bundle takes its torque from {needed}"
            )

    def _tell_of_delay(self, settings: SourceSettings) -> None:
        """A goal in a register acts; one of a loop that reads, thinks and writes acts later."""
        servo = settings.servo
        if servo is not None and servo.on and servo.torque_from.name == "goal" and servo.goal_delay_ns > 0:
            self._note(
                f"the bundle takes goals to act {servo.goal_delay_ns * 1e-6:g} ms after their stamp, a register holds "
                "the goal that acts: train on what --record wrote, with goal_delay_s = 0"
            )

    def _complain(self, id_: int, error: int) -> None:
        if error != self._said.get(id_, 0):
            self._said[id_] = error
            servo = next(one for one in self._servos if one.id == id_)
            text = self.complaint(error)
            self._note(f"{servo} says: {text}" if text else f"{servo} has no more to say")

    def _sample(self, t_ns: int, data: Sequence[bytes]) -> Sample:
        read = [self.registers(self._identities[id_], one) for id_, one in zip(self._ids, data, strict=True)]
        sign = np.array([servo.sign for servo in self._servos], dtype=float)
        from_zero = np.array([angle_counts(servo, one.count) for servo, one in zip(self._servos, read, strict=True)])
        to_goal = np.array([one.goal - one.count for one in read])
        current = np.array([one.current for one in read])
        return Sample(
            t_ns=t_ns,
            q=sign * from_zero * COUNT_RAD,
            dq=sign * np.array([one.counts_a_s for one in read]) * COUNT_RAD,
            tau=np.full(len(read), np.nan),
            received_ns=time.monotonic_ns(),
            temperature=np.array([one.celsius for one in read]),
            q_des=sign * (from_zero + to_goal) * COUNT_RAD,
            current=sign * current if self.current_turns else current,
            duty=sign * np.array([one.duty for one in read]),
            voltage=np.array([one.volts for one in read]),
        )


def angle_counts(servo: ServoJoint, count: int) -> float:
    """Counts from the zero; within half a turn of it unless the servo counts turns: of one that wraps from 4095 to 0
    the angle goes on."""
    away = count - servo.zero
    return away if servo.multi_turn else (away + COUNTS_A_TURN / 2) % COUNTS_A_TURN - COUNTS_A_TURN / 2


def sign_magnitude(word: int, bit: int) -> int:
    """The number whose sign is that bit and whose amount is the bits below it."""
    amount = word & ((1 << bit) - 1)
    return -amount if word >> bit & 1 else amount
