"""What a page needs of the running loop: a line of JSON ten times a second on a socket."""

from __future__ import annotations

import json
import math
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from tauext import _core
from tauext.bundle.estimates import HEALTHS, OK, rounded
from tauext.files.plain_file import FORMAT
from tauext.monitor.control_lines import listen_at
from tauext.monitor.monitored_time import Monitored, blind_words
from tauext.monitor.sink import Control, LoopReport, Verdict
from tauext_commission.folder import wall

PERIOD_S = 0.1
MOST_READERS = 8
"""Readers of the socket; a further one takes the place of one that does not read, else of the oldest."""
UNREAD_S = 5.0
"""Time in which a reader must take a line."""
POINT_NS = 25_000_000
"""Time of a point of the page's torque curves: its sample with the largest share of a limit."""
PAST_S, PAST_EVERY = 20.0, 20
"""Past that a page shows when it is opened, and lines between two copies of it."""
PAST_POINT_NS = 100_000_000
MOST_FRESH = 4000
"""Samples of which the thread has not drawn a point yet."""


def finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


class Curves:
    """Torques of the newest samples as points of the page's curves. The loop's thread only copies a row of numbers."""

    def __init__(self, joints: int):
        self._t_ns, self._valid = np.zeros(MOST_FRESH, dtype=np.int64), np.zeros(MOST_FRESH, dtype=bool)
        self._tau = np.zeros((MOST_FRESH, joints), dtype=np.float32)
        self._written = self._read = 0
        self.trace: list[tuple[int, list[Any]]] = []
        """Points since the last call of draw(): stamp [ns], and torques; none without an estimate."""
        self.past: deque[tuple[int, list[Any]]] = deque(maxlen=round(PAST_S * 1e9) // PAST_POINT_NS)
        """Points of the last PAST_S, with torques, standard errors, collision and contact limits."""
        self._share = 0.0

    def add(self, verdict: Verdict) -> None:
        """Called in the loop's thread."""
        count = len(verdict.t_ns)
        rows = np.arange(self._written, self._written + count) % MOST_FRESH
        self._t_ns[rows] = verdict.t_ns
        self._valid[rows] = verdict.estimates["health"] == OK
        self._tau[rows] = verdict.estimates["tau_ext"]
        self._written += count

    def draw(self, newest: Verdict) -> None:
        """Make points of the samples since the last call, with the limits and errors of the newest one."""
        end, begin = self._written, max(self._read, self._written - MOST_FRESH)
        self._read, self.trace = end, []
        if begin == end:
            return
        rows = np.arange(begin, end) % MOST_FRESH
        t_ns, tau, limit = self._t_ns[rows], self._tau[rows], newest.estimates["limit_nm"][-1]
        share = np.where(self._valid[rows], np.nan_to_num(np.abs(tau) / limit).max(axis=1), -1.0)
        first = np.flatnonzero(np.diff(t_ns // POINT_NS, prepend=t_ns[0] // POINT_NS - 1))
        names = ("contact_sigma_nm", "limit_nm", "contact_limit_nm")
        beside = [rounded(newest.estimates[name][-1]) for name in names]
        for start, stop in zip(first, [*first[1:], len(rows)], strict=True):
            at = start + int(np.argmax(share[start:stop]))
            point = int(t_ns[at]), rounded(tau[at]) if share[at] >= 0 else []
            self.trace.append(point)
            wide = point[0], [point[1], *(beside if point[1] else [[]] * 3)]
            if self.past and self.past[-1][0] // PAST_POINT_NS == point[0] // PAST_POINT_NS:
                if share[at] < self._share:
                    continue
                self.past.pop()
            self.past.append(wide)
            self._share = float(share[at])


def monitored_facts(now: Monitored, remedy: str) -> dict[str, Any]:
    """Shares of the last minute and hour for the page, with the reason and remedy of a loss."""
    words = blind_words(now, remedy) if now.level else ""
    return {
        "minute": finite(now.minute),
        "hour": finite(now.hour),
        "of_s": round(now.of_seconds),
        "level": now.level,
        "words": words,
    }


class LiveSink:
    """Sends lines to the readers of a socket. The loop's thread only keeps the newest verdict, and that of a rise.

    A reader that is slow loses lines. Without a loop, lines still come, so that a page can distinguish waiting from
    silence.
    """

    def __init__(self, path: Path):
        """path: socket that only its owner may read; one that a killed process left is replaced."""
        self.state, self.message, self.lost = "connecting", "", ""
        """Words for the page; any thread may set them."""
        self.remedy = ""
        """What a person can do if samples come late or not at all."""
        self.bundle: str | None = None
        self.alarm: Callable[[int], dict[str, Any] | None] = lambda number: None
        """Returns the facts of an alarm."""
        self._path = path
        self._joints: tuple[str, ...] = ()
        self._units: tuple[str, ...] = ()
        self._newest: Verdict | None = None
        self._q: np.ndarray | None = None
        self._rise: tuple[Verdict, int] | None = None
        """The newest rise of an alarm that the thread has not shown yet: its verdict and row."""
        self._curves: Curves | None = None
        self._lines = 0
        self._report: LoopReport | None = None
        self._readers: dict[socket.socket, tuple[bytes, float]] = {}
        """Each reader's rest of the line that it takes, and since when it is slow, by time.monotonic(); inf: it is
        not."""
        self._wake, self._ended = threading.Event(), False
        path.unlink(missing_ok=True)
        self._socket = listen_at(path)
        self._socket.setblocking(False)
        self._thread = threading.Thread(target=self._work, name="live", daemon=True)
        self._thread.start()

    def describe(self, joints: tuple[str, ...], units: Sequence[str]) -> None:
        """Names and units of the joints, before the first verdict."""
        self._joints, self._units, self._curves = joints, tuple(units), Curves(len(joints))

    @property
    def alarm_number(self) -> int:
        """Number of the alarm that stands; 0: none."""
        return self._newest.alarm_number if self._newest is not None else 0

    # The loop's thread.

    def open(self, joints: tuple[str, ...], control: Control) -> None:
        pass

    def verdict(self, verdict: Verdict) -> None:
        self._newest = verdict
        if self._curves is not None:
            self._curves.add(verdict)
        if verdict.block is not None:
            self._q = verdict.block.q[-1]
        if rows := [one.row - verdict.row for one in verdict.news if one.t_ns == verdict.t_ns[one.row - verdict.row]]:
            self._rise = verdict, rows[-1]
            self._wake.set()

    def every_second(self, report: LoopReport) -> None:
        self._report = report

    def follow(self, bundle: _core.Bundle, monitor: _core.Monitor) -> None:
        self._units = tuple(bundle.estimate_units)
        self.bundle = bundle.name

    def close(self) -> None:
        """The loop has ended; the socket stays open for the next one."""

    # Any thread.

    def end(self) -> None:
        """Close the socket."""
        self._ended = True
        self._wake.set()
        self._thread.join()
        for one in (self._socket, *self._readers):
            one.close()
        self._path.unlink(missing_ok=True)

    # This sink's thread.

    def _work(self) -> None:
        due = time.monotonic()
        while not self._ended:
            self._wake.wait(max(0.0, due - time.monotonic()))
            self._wake.clear()
            shown, self._rise = self._rise, None
            if shown is None and time.monotonic() < due:
                continue
            due = time.monotonic() + PERIOD_S
            if self._curves is not None and self._newest is not None:
                self._curves.draw(self._newest)
            self._accept()
            if self._readers:
                self._send(json.dumps(self._line(shown)).encode() + b"\n")

    def _line(self, shown: tuple[Verdict, int] | None) -> dict[str, Any]:
        """shown: verdict and row of the sample at which an alarm rose; None: the newest."""
        (verdict, row), report = shown or (self._newest, -1), self._report
        line: dict[str, Any] = {
            "format": FORMAT,
            "wall": wall(),
            "state": self.state,
            "message": self.message,
            "lost": self.lost,
            "bundle": self.bundle,
            "joints": list(self._joints),
            "units": list(self._units),
            "alarm": self.alarm(self.alarm_number),
            "rate_hz": finite(report.rate_hz) if report else None,
            "tick_p99_us": finite(report.tick_p99_us) if report else None,
            "monitored": monitored_facts(report.monitored, self.remedy) if report else None,
        }
        if verdict is None:
            return line
        estimates = {name: values[row] for name, values in verdict.estimates.items()}
        q = self._q if verdict.block is None else verdict.block.q[row]
        self._lines += 1
        curves, now_ns = self._curves, int(verdict.t_ns[row])
        past = {}
        if curves is not None and self._lines % PAST_EVERY == 0:
            past = {"past": [[round((now_ns - t_ns) * 1e-6), *values] for t_ns, values in curves.past]}
        return line | {
            "t_ns": now_ns,
            "trace": [[round((now_ns - t_ns) * 1e-6), tau] for t_ns, tau in (curves.trace if curves else ())],
            **past,
            "q": [] if q is None else rounded(q),
            "tau_ext": rounded(estimates["tau_ext"]),
            "sigma": rounded(estimates["contact_sigma_nm"]),
            "limit": rounded(estimates["limit_nm"]),
            "contact_limit": rounded(estimates["contact_limit_nm"]),
            "near_stiction": estimates["near_stiction"].tolist(),
            "health": HEALTHS[int(estimates["health"])],
            "causes": _core.cause_names(int(estimates["causes"])),
        }

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                reader, _ = self._socket.accept()
                reader.setblocking(False)
                if len(self._readers) >= MOST_READERS:
                    slowest = min(self._readers, key=lambda one: self._readers[one][1])
                    del self._readers[slowest]
                    slowest.close()
                self._readers[reader] = b"", math.inf

    def _send(self, line: bytes) -> None:
        """A reader receives whole lines: one that has not taken the last line yet gets the rest of it, not this one."""
        gone = select.select(list(self._readers), [], [], 0)[0]  # readers send nothing
        now_s = time.monotonic()
        for reader, (rest, since_s) in list(self._readers.items()):
            try:
                if reader in gone or now_s > since_s + UNREAD_S:
                    raise BrokenPipeError
                left = rest or line
                rest = left[reader.send(left) :]
                self._readers[reader] = rest, min(since_s, now_s) if rest else math.inf
            except BlockingIOError:
                self._readers[reader] = rest, min(since_s, now_s)
            except OSError:
                del self._readers[reader]
                reader.close()
