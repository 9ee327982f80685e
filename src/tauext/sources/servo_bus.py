"""One request to all servos of a serial bus, and their answers, whichever of them come."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from tauext.sources.reader_source import Unreachable
from tauext.sources.servo_port import PORT_ERRORS, ServoPort


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
