"""A stand-in of a UR controller's RTDE server, packet by packet, for the real library ur_rtde."""

from __future__ import annotations

import itertools
import multiprocessing
import socket
import struct
import threading
import time
from contextlib import suppress
from multiprocessing.connection import Connection

PORT = 30004
"""The library knows no other; every server has an address of its own in 127.0.0.0/8."""
ADDRESSES = itertools.count(10)
BEGUN_S = 100.0
"""Stamp before the first packet."""
PROTOCOL_2, PAUSED, STARTED = 2, b"\x01", b"\x01"


def value(name: str, number: int) -> list[float]:
    """Six values of a variable in the packet of this number."""
    return [len(name) + 0.1 * joint + 1e-3 * number for joint in range(6)]


class Controller:
    """An RtdeServer in a process of its own: the library holds Python's lock while it connects."""

    def __init__(self, cb3: bool = False):
        self.host = f"127.0.0.{next(ADDRESSES)}"
        self.begun_s, self.fastest_hz = BEGUN_S, 125.0 if cb3 else 500.0
        context = multiprocessing.get_context("spawn")
        self._pipe, there = context.Pipe()
        self._process = context.Process(target=serve, args=(there, self.host, cb3), daemon=True)
        self._process.start()
        self._pipe.recv()

    def do(self, what: str) -> list[tuple[float, list[str]]]:
        """restart, silence or nothing; returns what clients have asked for so far."""
        self._pipe.send(what)
        return self._pipe.recv()

    def close(self) -> None:
        self._process.kill()
        self._process.join()


def serve(pipe: Connection, host: str, cb3: bool) -> None:
    server = RtdeServer(host, cb3)
    pipe.send(None)
    with suppress(EOFError):
        while True:
            what = pipe.recv()
            if what == "restart":
                server.restart()
            server.silent = what == "silence"
            pipe.send(server.asked)


class RtdeServer:
    """Sends joint states as an e-Series controller (500 Hz) or a CB3 (125 Hz) does, at the rate asked for."""

    def __init__(self, host: str, cb3: bool):
        self.host = host
        self.version = (3, 15, 8, 106339) if cb3 else (5, 12, 0, 1101319)
        self.fastest_hz = 125.0 if cb3 else 500.0
        self.sent, self.begun_s = 0, BEGUN_S
        self.asked: list[tuple[float, list[str]]] = []
        self.silent = False
        self._open: list[socket.socket] = []
        self._listen()

    def restart(self) -> None:
        """As a controller that was switched off and on: its clock begins again."""
        self.close()
        self.sent, self.begun_s = 0, 1.0
        self._listen()

    def close(self) -> None:
        self._ended.set()
        with suppress(OSError):
            self._server.shutdown(socket.SHUT_RDWR)
        self._server.close()
        for one in self._open:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()
        self._open.clear()

    def _listen(self) -> None:
        self._ended = threading.Event()
        self._server = socket.create_server((self.host, PORT))
        threading.Thread(target=self._accept, args=(self._server, self._ended), daemon=True).start()

    def _accept(self, server: socket.socket, ended: threading.Event) -> None:
        while not ended.is_set():
            try:
                one, _ = server.accept()
            except OSError:
                return
            one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._open.append(one)
            threading.Thread(target=self._serve, args=(one, ended), daemon=True).start()

    def _serve(self, one: socket.socket, ended: threading.Event) -> None:
        running = threading.Event()
        names: list[str] = []
        rate_hz = self.fastest_hz

        def send() -> None:
            due = time.monotonic()
            with suppress(OSError):
                while running.is_set() and not ended.is_set():
                    due += 1 / rate_hz
                    time.sleep(max(0.0, due - time.monotonic()))
                    self.sent += 1
                    if not self.silent:
                        one.sendall(packet("U", b"\x01" + self._state(names, rate_hz)))

        with suppress(OSError, ValueError, struct.error), one.makefile("rb") as stream:
            while len(head := stream.read(3)) == 3:
                size, kind = struct.unpack(">Hc", head)
                data = stream.read(size - 3)
                if kind == b"V":
                    one.sendall(packet("V", bytes([struct.unpack(">H", data)[0] == PROTOCOL_2])))
                elif kind == b"v":
                    one.sendall(packet("v", struct.pack(">4I", *self.version)))
                elif kind == b"O":
                    (rate_hz,), names = struct.unpack(">d", data[:8]), data[8:].decode().strip(",").split(",")
                    self.asked.append((rate_hz, names))
                    types = ",".join("DOUBLE" if name == "timestamp" else "VECTOR6D" for name in names)
                    one.sendall(packet("O", b"\x01" + types.encode()))
                elif kind == b"S":
                    one.sendall(packet("S", STARTED))
                    running.set()
                    threading.Thread(target=send, daemon=True).start()
                elif kind == b"P":
                    running.clear()
                    one.sendall(packet("P", PAUSED))
        running.clear()

    def _state(self, names: list[str], rate_hz: float) -> bytes:
        number = self.sent
        stamp = struct.pack(">d", self.begun_s + number / rate_hz)
        return b"".join(stamp if name == "timestamp" else struct.pack(">6d", *value(name, number)) for name in names)


def packet(kind: str, data: bytes) -> bytes:
    """Size, kind, data."""
    return struct.pack(">Hc", 3 + len(data), kind.encode()) + data
