"""The dashboard server of a Universal Robots controller: lines of text over TCP. Used here to stop the program."""

from __future__ import annotations

import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

PORT = 29999
GREETING = "Connected: Universal Robots Dashboard Server"
TIMEOUT_S = 2.0
"""For the connection and for each answer."""
LONGEST_ANSWER = 4096
"""[bytes]; a server that sends more without a line break is no dashboard server."""


class DashboardError(Exception):
    """The server cannot be reached, is another program, or refuses; the message is one line."""


class Dashboard:
    """One connection, opened on first use and kept. Any thread may use it."""

    def __init__(self, host: str, port: int = PORT):
        self._host, self._port = host, port
        self._socket: socket.socket | None = None
        self._received = b""
        self._lock = threading.Lock()

    def check(self) -> None:
        """Connect and check that the controller would obey a stop.

        Raises:
            DashboardError: the server cannot be reached, or the arm is in local control.
        """
        with self._lock, self._named():
            mode = self._ask("is in remote control")
            if mode == "false":
                raise DashboardError("the arm is in local control: switch it to remote control on the teach pendant")
            if mode != "true":  # CB3 controllers have no remote control and do not know the question
                version = self._ask("PolyscopeVersion")
                major = re.search(r"(\d+)\.\d+", version)
                if major is None or not 1 <= int(major[1]) <= 3:
                    raise DashboardError(
                        f"the answer to 'is in remote control' is {mode!r}, the version {version!r}; "
                        "a stop needs PolyScope 3, or PolyScope 5.6 and later"
                    )

    def stop(self) -> None:
        """Stop the program that the controller runs.

        An old connection may be dead, or refused if remote control was switched on later; a new one is tried then.

        Raises:
            DashboardError: the controller did not confirm the stop.
        """
        with self._lock, self._named():
            if self._socket is not None:
                try:
                    if self._ask("stop") == "Stopped":
                        return
                except (OSError, DashboardError):
                    pass
                self._close()
            if (answer := self._ask("stop")) != "Stopped":
                raise DashboardError(f"the answer to 'stop' is {answer!r}")

    def close(self) -> None:
        """Disconnect; stop() would connect again."""
        with self._lock:
            self._close()

    @contextmanager
    def _named(self) -> Iterator[None]:
        """Name the server in every error, and drop a connection that had one."""
        try:
            yield
        except (OSError, DashboardError) as error:
            self._close()
            reason = (error.strerror if isinstance(error, OSError) else None) or str(error)
            raise DashboardError(f"dashboard server {self._host}:{self._port}: {reason}") from error

    def _close(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket, self._received = None, b""

    def _ask(self, command: str) -> str:
        """The answer to one command, on the open connection or a new one."""
        if self._socket is None:
            self._socket = socket.create_connection((self._host, self._port), TIMEOUT_S)
            self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if (greeting := self._line()) != GREETING:
                raise DashboardError(f"no dashboard server: it begins with {greeting!r}")
        self._socket.sendall(command.encode() + b"\n")
        return self._line()

    def _line(self) -> str:
        """The next line of the server, without its end."""
        assert self._socket is not None  # _ask() has connected
        until = time.monotonic() + TIMEOUT_S
        while b"\n" not in self._received:
            if len(self._received) > LONGEST_ANSWER:
                raise DashboardError(f"no line ends within {LONGEST_ANSWER} bytes")
            self._socket.settimeout(max(1e-3, until - time.monotonic()))
            more = self._socket.recv(1024)
            if not more:
                raise DashboardError("the connection was closed")
            self._received += more
        line, _, self._received = self._received.partition(b"\n")
        return line.decode(errors="replace").strip()
