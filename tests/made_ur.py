"""A stand-in of a UR controller's dashboard server: a TCP server on this machine.

Run as a program, it prints its port, then the time (time.monotonic_ns) of every `stop` that it receives.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress

GREETING = "Connected: Universal Robots Dashboard Server"
NOT_ALLOWED = "".join(
    [
        "Command is not allowed due to safety reasons, ",
        "please switch robot to Remote Control mode and reconnect to port 29999",
    ]
)


class Controller:
    """Answers as an e-Series controller (PolyScope 5) does, or a CB3 one (PolyScope 3).

    A connection that was opened in local control stays refused, also after a switch to remote control.
    """

    def __init__(self, remote: bool = True, cb3: bool = False, stopped: Callable[[], object] = lambda: None):
        """stopped: called when a program is stopped."""
        self.remote, self.cb3, self.greeting, self.stopped = remote, cb3, GREETING, stopped
        self.answers: dict[str, str | None] = {}
        """Other answers than a controller's, by command; None: the connection is closed without an answer."""
        self.commands: list[str] = []
        self.connections = 0
        self._server = socket.create_server(("127.0.0.1", 0))
        self._open: list[socket.socket] = []
        self.port = self._server.getsockname()[1]
        threading.Thread(target=self._accept, daemon=True).start()

    def drop(self) -> None:
        """Close every connection, as a controller that restarts."""
        for one in self._open:
            with suppress(OSError):  # the other side has gone
                one.shutdown(socket.SHUT_RDWR)
            one.close()
        self._open.clear()

    def close(self) -> None:
        self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        self.drop()

    def _accept(self) -> None:
        while True:
            try:
                one, _ = self._server.accept()
            except OSError:
                return
            self.connections += 1
            self._open.append(one)
            threading.Thread(target=self._serve, args=(one, self.remote), daemon=True).start()

    def _serve(self, one: socket.socket, remote: bool) -> None:
        try:
            one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            one.sendall(f"{self.greeting}\n".encode())
            for line in one.makefile("r"):
                command = line.strip()
                self.commands.append(command)
                if (answer := self.answers.get(command, self._answer(command, remote))) is None:
                    one.shutdown(socket.SHUT_RDWR)
                    return
                one.sendall(f"{answer}\n".encode())
        except (OSError, ValueError):  # the other side has gone
            pass

    def _answer(self, command: str, remote: bool) -> str:
        if command == "PolyscopeVersion":
            return "URSoftware 3.15.8.106339 (Nov 04 2021)" if self.cb3 else "URSoftware 5.12.0.1101319 (Mar 22 2022)"
        if command == "is in remote control" and not self.cb3:
            return str(self.remote).lower()
        if command == "stop":
            if not (remote or self.cb3):
                return NOT_ALLOWED
            self.stopped()
            return "Stopped"
        return f"could not understand: '{command}'"


def main() -> None:
    print(Controller(stopped=lambda: print(time.monotonic_ns(), flush=True)).port, flush=True)
    threading.Event().wait()


if __name__ == "__main__":
    main()
