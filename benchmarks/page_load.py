"""The page of `tauext commission` while strangers hold connections: time to first byte, stream, and the loop's p99.

    python benchmarks/page_load.py [--python OTHER/.venv/bin/python] [--arm rig] [--loads 40] [--core 1]
        [--priority 80]

Each version of tauext (that of this environment, and of each --python) commissions a simulated arm in real time until a
bundle monitors it. The page is then loaded by its owner, LOADS times in a row, while nobody else is connected, while
24 connections send a byte every 3 s and 200 streams are opened that nobody reads, and while each of these that the
server closes is opened again within 50 ms. A load that takes longer than 5 s, or is closed, has failed.
"""

from __future__ import annotations

import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
from commission_latency import connected
from common import arguments, free_port, head, loop_arguments, loop_flags, table_row

SLOW, STREAMS = 24, 200
PATIENCE_S, READY_S = 5.0, 600.0
STREAM_S = 3.0
MODES = ("nobody else", "connections that stay", "connections that come again")
COLUMNS = (
    "version | connected besides | pages loaded | time to first byte, median [ms] | largest [ms] | "
    "lines of a new stream in 3 s | loop's p99, median of the seconds [µs] | largest [µs] | page's memory [MB]"
)


class Strangers(threading.Thread):
    """Slow and unread connections to a port, from this process."""

    def __init__(self, port: int, comes_again: bool):
        super().__init__(daemon=True)
        self.port, self.comes_again, self.opened = port, comes_again, 0
        self._ends, self._ready = threading.Event(), threading.Event()
        self._looking = selectors.DefaultSelector()
        self.start()
        self._ready.wait()

    def run(self) -> None:
        request = stream_request(self.port)
        for _ in range(SLOW):
            self._open(b"G", True)
        for _ in range(STREAMS):
            self._open(request, False)
        self._ready.set()
        due_s = time.monotonic()
        while not self._ends.wait(0.05):
            if time.monotonic() > due_s:
                due_s += 3.0
                for key in self._held():
                    if key.data[1]:
                        with suppress(OSError):
                            key.fileobj.send(b"E")
            for key in self._held():
                if is_closed(key.fileobj):
                    self._looking.unregister(key.fileobj)
                    key.fileobj.close()
                    if self.comes_again:
                        self._open(*key.data)
        for key in self._held():
            key.fileobj.close()

    def close(self) -> None:
        self._ends.set()
        self.join()

    def _held(self) -> list[selectors.SelectorKey]:
        return list(self._looking.get_map().values())

    def _open(self, request: bytes, is_slow: bool) -> None:
        with suppress(OSError):
            wire = socket.create_connection(("127.0.0.1", self.port), PATIENCE_S)
            wire.setblocking(False)
            self._looking.register(wire, selectors.EVENT_READ, (request, is_slow))
            self.opened += 1
            wire.send(request)


def is_closed(wire: socket.socket) -> bool:
    """Whether the other end is closed, without reading what it has sent."""
    return wire.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 1)[0] != 1  # TCP_ESTABLISHED


def stream_request(port: int) -> bytes:
    """Opens a WebSocket; a server of event streams ignores the further headers."""
    lines = [
        "GET /live HTTP/1.1",
        f"Host: 127.0.0.1:{port}",
        f"Origin: http://127.0.0.1:{port}",
        "Connection: Upgrade",
        "Upgrade: websocket",
        "Sec-WebSocket-Version: 13",
        f"Sec-WebSocket-Key: {'A' * 22}==",
    ]
    return "\r\n".join([*lines, "", ""]).encode()


def first_byte(port: int) -> float:
    """Time from connecting to the first byte of the page, [s]; inf: it failed."""
    began_s = time.monotonic()
    with suppress(OSError), socket.create_connection(("127.0.0.1", port), PATIENCE_S) as wire:
        wire.sendall(f"GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\n\r\n".encode())
        wire.settimeout(max(0.01, began_s + PATIENCE_S - time.monotonic()))
        if (first := wire.recv(100)).split()[1:2] == [b"200"]:
            took_s = time.monotonic() - began_s
            while first:
                first = wire.recv(1 << 16)
            return took_s
    return float("inf")


def lines_of_stream(port: int) -> int:
    """Lines that a new stream brings in STREAM_S."""
    count, end_s = 0, time.monotonic() + STREAM_S
    with suppress(OSError), socket.create_connection(("127.0.0.1", port), PATIENCE_S) as wire:
        wire.sendall(stream_request(port))
        while (left_s := end_s - time.monotonic()) > 0:
            wire.settimeout(left_s)
            if not (content := wire.recv(1 << 16)):
                break
            count += content.count(b'"wall"')
    return count


class Loop(threading.Thread):
    """Reads the loop's socket: the bundle, and the p99 of each second."""

    def __init__(self, wire: socket.socket):
        super().__init__(daemon=True)
        self.wire, self.bundle, self.seconds = wire, None, []
        self.start()

    def run(self) -> None:
        newest_s = 0.0
        with suppress(OSError, ValueError):
            for line in self.wire.makefile():
                one = json.loads(line)
                self.bundle = one.get("bundle") if one.get("health") == "ok" else None
                if (p99 := one.get("tick_p99_us")) is not None and time.monotonic() > newest_s + 1:
                    newest_s = time.monotonic()
                    self.seconds.append(float(p99))


def memory_mb(port: int) -> float:
    """Resident memory of the process that listens on this port, [MB]."""
    rows = [line.split() for line in Path("/proc/net/tcp").read_text().splitlines()[1:]]
    sockets = {f"socket:[{row[9]}]" for row in rows if row[1].endswith(f":{port:04X}") and row[3] == "0A"}
    for process in filter(str.isdigit, os.listdir("/proc")):
        with suppress(OSError):
            if any(os.readlink(file) in sockets for file in Path(f"/proc/{process}/fd").iterdir()):
                return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
    return float("nan")


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--python", action="append", default=[], help="of another version's environment; repeatable")
    parser.add_argument("--arm", default="rig", help="of sim:, default: %(default)s")
    parser.add_argument("--loads", type=int, default=40, help="of the page in each row, default: %(default)s")
    loop_arguments(parser)
    options = parser.parse_args()
    flags = loop_flags(options)
    print("\n".join(head(COLUMNS)), flush=True)
    for python in (*options.python, sys.executable):
        with tempfile.TemporaryDirectory() as temporary:
            folder, port = Path(temporary) / "arm", free_port()
            words = ["commission", "--source", f"sim:{options.arm}", "--out", str(folder), "--port", str(port), *flags]
            # Not in this folder, whose sources another version would import.
            command = subprocess.Popen([python, "-m", "tauext", *words], stdout=subprocess.DEVNULL, cwd=temporary)
            try:
                loop = Loop(connected(command, folder / "live.sock"))
                end_s = time.monotonic() + READY_S
                while loop.bundle is None:
                    if time.monotonic() > end_s:
                        sys.exit("no bundle monitors the arm")
                    time.sleep(1.0)
                for mode in MODES:
                    shown = measured(mode, port, loop, options.loads)
                    name = Path(python).absolute().parents[2].name
                    print(table_row("this" if python == sys.executable else name, mode, *shown), flush=True)
            finally:
                command.send_signal(signal.SIGINT)
                with suppress(subprocess.TimeoutExpired):
                    command.wait(30)
                command.kill()
                command.wait()


def measured(mode: str, port: int, loop: Loop, loads: int) -> list[str]:
    """Columns of a row after version and mode."""
    strangers = None if mode == MODES[0] else Strangers(port, mode == MODES[2])
    loop.seconds.clear()
    lines = lines_of_stream(port)
    took_s = []
    for _ in range(loads):
        took_s.append(first_byte(port))
        time.sleep(0.25)
    memory = memory_mb(port)
    if strangers is not None:
        strangers.close()
        time.sleep(12.0)  # until their connections have ended
    whole = [1e3 * one for one in took_s if np.isfinite(one)]
    times = [f"{np.median(whole):.1f}", f"{max(whole):.1f}"] if whole else ["–", "–"]
    p99 = [f"{np.median(loop.seconds):.0f}", f"{max(loop.seconds):.0f}"] if loop.seconds else ["–", "–"]
    return [f"{len(whole)} of {loads}", *times, str(lines), *p99, f"{memory:.0f}"]


if __name__ == "__main__":
    main()
