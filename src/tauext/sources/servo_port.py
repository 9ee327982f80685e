"""A serial port as the packet handlers of Feetech's and ROBOTIS' libraries take one, for one process alone."""

from __future__ import annotations

import errno
import importlib
import os
import select
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from tauext.errors import ConfigError
from tauext.sources.reader import Unreachable

BITS_A_BYTE = 10
MEMORY = 1
"""Major number of /dev/null and its like, which everybody has open."""
ANSWER_S = 0.02
"""For which answers may be late, beside their time on the wire: an adapter keeps bytes for up to 16 ms."""
PORT_ERRORS: tuple[type[BaseException], ...] = (OSError,)
with suppress(ImportError):  # Windows, where the vendors' ports are to be used
    import fcntl
    import termios

    PORT_ERRORS = (OSError, termios.error)
OPEN_ERRORS: tuple[type[BaseException], ...] = (*PORT_ERRORS, ValueError)


class ServoPort:
    """Waits for bytes without using the processor, and throws away what came before a request, an answer to an earlier
    one: the vendors' own ports do neither.

    The methods in their spelling are those that their packet handlers call.
    """

    def __init__(self, path: str, baud: int, answer_s: float = ANSWER_S):
        self.path, self.baud, self.answer_s = path, baud, answer_s
        self.is_using = False
        """Of the vendors' packet handlers."""
        self._serial: Any = None
        self._until = 0.0

    def open(self) -> None:
        """Raises Unreachable: no such port, no right to it, or another process has it."""
        serial = pyserial()
        if users := users_of(self.path):
            raise Unreachable(f"another process has the port: {users}; a bus takes one at a time")
        try:
            self._serial = serial.Serial(self.path, self.baud, timeout=0, write_timeout=1.0, exclusive=True)
            self._claim()
        except OPEN_ERRORS as error:
            self.close()
            raise Unreachable(why_not_open(self.path, error)) from error

    def close(self) -> None:
        """More than one call does no harm."""
        if self._serial is not None:
            with suppress(*PORT_ERRORS):
                fcntl.ioctl(self._serial.fileno(), termios.TIOCNXCL)
            with suppress(*PORT_ERRORS):
                self._serial.close()
            self._serial = None

    def begin(self) -> None:
        """Before a request: nobody uses the port, whatever an earlier one came to."""
        if self._serial is None:
            raise Unreachable("the port is closed")
        self.is_using = False

    def wire_s(self, count: int) -> float:
        """Time of so many bytes on the wire, [s]."""
        return count * BITS_A_BYTE / self.baud

    def _claim(self) -> None:
        """No other process may open it from here on (root still may), and bytes come at once where the driver can."""
        with suppress(OSError):
            fcntl.ioctl(self._serial.fileno(), termios.TIOCEXCL)
        with suppress(*PORT_ERRORS, ValueError, NotImplementedError):  # FTDI adapters; a pty has no such setting
            self._serial.set_low_latency_mode(True)

    # As the vendors' PortHandler.

    def clearPort(self) -> None:
        self._serial.reset_input_buffer()

    def writePort(self, packet: list[int]) -> int:
        return self._serial.write(bytes(packet))

    def readPort(self, length: int) -> bytes:
        """So many bytes, or fewer at the time-out."""
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
    """Other processes that have the file open, as far as this one may see: `python3 (1234)`; empty: none."""
    with suppress(OSError):
        wanted = os.stat(path)
        if os.major(wanted.st_rdev) == MEMORY:
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
    """What to do about a port that cannot be opened."""
    number = getattr(error, "errno", None) or next(iter(getattr(error.__context__, "args", ())), None)
    if number in (errno.ENOENT, errno.ENXIO, errno.ENODEV):
        ports = importlib.import_module("serial.tools.list_ports").comports()
        there = ", ".join(port.device for port in ports)
        return f"there is no such port; there {'are ' + there if there else 'is none: is the adapter plugged in?'}"
    if number in (errno.EACCES, errno.EPERM):
        return "this user may not open the port: `sudo usermod -aG dialout $USER`, then log in again"
    if number in (errno.EBUSY, errno.EAGAIN, errno.EWOULDBLOCK):
        return "another process has the port; a bus takes one at a time"
    if number == errno.ENOTTY:
        return "this is no serial port"
    return f"the port cannot be opened: {error}"


def pyserial() -> Any:
    """The optional library.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        return importlib.import_module("serial")
    except ImportError as error:
        raise ConfigError("serial servos need pyserial: pip install 'tauext[feetech]'") from error
