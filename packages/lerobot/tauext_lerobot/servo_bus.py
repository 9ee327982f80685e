"""A bus of serial servos: a port used by one process, and one request to all servos on it."""

from __future__ import annotations

import errno
import importlib
import os
import select
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tauext.plugins import optional_library
from tauext.sources.reader import Unreachable
from tauext_lerobot.servo_series import Series

PORT_ERRORS: tuple[type[BaseException], ...] = (OSError,)
with suppress(ImportError):  # on Windows, use the vendors' ports
    import fcntl
    import termios

    PORT_ERRORS = (OSError, termios.error)
OPEN_ERRORS: tuple[type[BaseException], ...] = (*PORT_ERRORS, ValueError)


class ServoPort:
    """A serial port that waits for bytes without using the processor, and discards late answers before a request. The
    vendors' own ports do neither.

    The methods in camel case are called by the vendors' packet handlers.
    """

    def __init__(self, path: str, baud: int, answer_s: float = 0.02):
        """answer_s: longest delay of answers beyond their time on the wire: an adapter holds bytes for up to 16 ms."""
        self.path, self.baud, self.answer_s = path, baud, answer_s
        self.is_using = False
        """Flag that the vendors' packet handlers set."""
        self._serial: Any = None
        self._until = 0.0

    def open(self) -> None:
        """Open the port. Raises Unreachable: no such port, no permission, or in use by another process."""
        serial = optional_library("serial", "a bus of serial servos", "pyserial")
        if users := users_of(self.path):
            raise Unreachable(f"the port is in use by another process: {users}; a bus serves one process at a time")
        try:
            self._serial = serial.Serial(self.path, self.baud, timeout=0, write_timeout=1.0, exclusive=True)
            self._claim()
        except OPEN_ERRORS as error:
            self.close()
            raise Unreachable(why_not_open(self.path, error)) from error

    def close(self) -> None:
        """Close the port; repeated calls are allowed."""
        if self._serial is not None:
            with suppress(*PORT_ERRORS):
                fcntl.ioctl(self._serial.fileno(), termios.TIOCNXCL)
            with suppress(*PORT_ERRORS):
                self._serial.close()
            self._serial = None

    def begin(self) -> None:
        """Mark the port as free before a request, however the previous request ended."""
        if self._serial is None:
            raise Unreachable("the port is closed")
        self.is_using = False

    def wire_s(self, count: int) -> float:
        """Time of `count` bytes on the wire, [s]."""
        return count * 10 / self.baud  # with start and stop bit

    def _claim(self) -> None:
        """Lock the port against other processes (except root), and request low latency where the driver supports it."""
        with suppress(OSError):
            fcntl.ioctl(self._serial.fileno(), termios.TIOCEXCL)
        with suppress(*PORT_ERRORS, ValueError, NotImplementedError):  # FTDI adapters; a pty has no such setting
            self._serial.set_low_latency_mode(True)

    # The interface of the vendors' PortHandler.

    def clearPort(self) -> None:
        self._serial.reset_input_buffer()

    def writePort(self, packet: list[int]) -> int:
        return self._serial.write(bytes(packet))

    def readPort(self, length: int) -> bytes:
        """Read `length` bytes, or fewer at the time-out."""
        came = bytearray()
        while len(came) < length:
            came += self._serial.read(length - len(came))
            left_s = self._until - time.monotonic()
            if len(came) < length and (left_s <= 0 or not select.select([self._serial], [], [], left_s)[0]):
                break
        return bytes(came)

    def setPacketTimeout(self, packet_length: int) -> None:
        self.setPacketTimeoutMillis((self.wire_s(packet_length) + self.answer_s) * 1e3)

    def setPacketTimeoutMillis(self, milliseconds: float) -> None:
        self._until = time.monotonic() + milliseconds * 1e-3

    def isPacketTimeout(self) -> bool:
        return time.monotonic() >= self._until

    def getBaudRate(self) -> int:
        return self.baud


def users_of(path: str) -> str:
    """Other processes that have the file open, as far as permissions show: `python3 (1234)`; empty: none."""
    with suppress(OSError):
        wanted = os.stat(path)
        if os.major(wanted.st_rdev) == 1:  # /dev/null and similar devices, which many processes have open
            return ""
        found = []
        for process in Path("/proc").glob("[0-9]*"):
            if int(process.name) == os.getpid():
                continue
            with suppress(OSError):
                for descriptor in (process / "fd").iterdir():
                    with suppress(OSError):
                        if os.path.samestat(descriptor.stat(), wanted):
                            found.append(f"{(process / 'comm').read_text().strip()} ({process.name})")
                            break
        return ", ".join(found)
    return ""


def why_not_open(path: str, error: BaseException) -> str:
    """Advice for a port that cannot be opened."""
    number = getattr(error, "errno", None) or next(iter(getattr(error.__context__, "args", ())), None)
    if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        ports = importlib.import_module("serial.tools.list_ports").comports()
        there = ", ".join(port.device for port in ports)
        found = f"the ports are {there}" if there else "there is none: is the adapter plugged in?"
        return f"there is no such port; {found}"
    if number in (errno.EACCES, errno.EPERM):
        return "this user may not open the port: `sudo usermod -aG dialout $USER`, then log in again"
    if number in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK):
        return "the port is in use by another process; a bus serves one process at a time"
    if number == errno.ENOTTY:
        return "this is not a serial port"
    return f"the port cannot be opened: {error}"


# --- One request to all servos of a bus, and their answers. All servos answer a sync read, one after the other; none
# answers a sync write.


SUCCESS = 0
"""Return value of the libraries' functions on success."""


@dataclass
class Reading:
    """Answers to one request."""

    t_ns: int
    """Time of sending, by time.monotonic_ns(). Each servo reads its registers when it answers."""
    data: dict[int, bytes] = field(default_factory=dict)
    """Registers by id, of servos with a complete answer."""
    errors: dict[int, int] = field(default_factory=dict)
    """Error bits of the packets by id."""
    corrupt: int = 0
    """Unusable packets: wrong checksum, wrong length, bytes that are no packet, or an id not in the request."""


class ServoBus:
    """Transactions on a port. Other users of the port in this process must hold `lock`."""

    def __init__(self, port: ServoPort, series: Series):
        self.port, self.series = port, series
        library = optional_library(series.library, f"source {series.kind}", series.package)
        self._handler = library.PacketHandler(series.protocol)
        self.lock = threading.Lock()
        """Held during a transaction. A thread that drives the arm through the same port must hold it too."""

    def transaction_s(self, servos: int, length: int) -> float:
        """Shortest time of a reading by its bytes on the wire, [s]; the servos' return delays are not included."""
        return self.port.wire_s(self.series.request_bytes + servos * (1 + self.series.overhead + length))

    def read(self, address: int, length: int, ids: Sequence[int]) -> Reading:
        """Read registers address to address + length - 1 of the servos. The caller checks which of them answered.

        Raises:
            Unreachable: the port is lost.
        """
        with self.lock:
            return self._read(address, length, ids)

    def write(self, address: int, length: int, values: Mapping[int, bytes]) -> None:
        """Write registers of each servo by its id. No servo acknowledges a write: read the registers back.

        Raises:
            Unreachable: the port is lost.
        """
        data = [byte for id_, value in values.items() for byte in (id_, *value)]
        with self.lock:
            self._sent(self._handler.syncWriteTxOnly, address, length, data, len(data))

    def _read(self, address: int, length: int, ids: Sequence[int]) -> Reading:
        reading = Reading(time.monotonic_ns())
        self._sent(self._handler.syncReadTx, address, length, list(ids), len(ids), *self.series.flags)
        silent = set(ids)
        while silent:
            try:
                result, id_, error, data = self._answer()
            except PORT_ERRORS as wrong:
                raise Unreachable(f"the port is lost: {wrong}") from wrong
            if result == SUCCESS and len(data) == length and id_ in silent:
                silent.discard(id_)
                reading.data[id_], reading.errors[id_] = data, error
                continue
            reading.corrupt += result != self.series.silence
            if self.port.isPacketTimeout():
                break
        return reading

    def _answer(self) -> tuple[int, int, int, bytes]:
        """Wait for the next packet; returns the library's result, id, error bits and data."""
        packet, result = self._handler.rxPacket(self.port, *self.series.flags)
        if result != SUCCESS:
            return result, -1, 0, b""
        whole, places = bytes(packet), self.series.packet
        id_, length, error = (int(places[name].of(whole)) for name in ("id", "length", "error"))
        return result, id_, error, whole[places["error"].address + 1 : places["length"].address + length]

    def _sent(self, send: Any, *arguments: Any) -> None:
        self.port.begin()
        try:
            result = send(self.port, *arguments)
        except PORT_ERRORS as wrong:
            raise Unreachable(f"the port is lost: {wrong}") from wrong
        if result != SUCCESS:
            raise Unreachable(f"a request could not be sent (the library's code {result})")
