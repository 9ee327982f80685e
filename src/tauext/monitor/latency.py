"""Latency quantiles, and real-time priority if the system grants it."""

from __future__ import annotations

import math
import os

import numpy as np

# --- Quantiles of a stream of times, in constant memory.


BINS_PER_OCTAVE = 64


class Latencies:
    """Histogram with bins 1.1 % wide; quantiles are at most that much too large."""

    def __init__(self) -> None:
        self.count, self.max_ns = 0, 0
        self._bins = [0] * (BINS_PER_OCTAVE * 40)  # up to 2^40 ns or 18 minutes; longer times count in the last bin

    def add(self, ns: int) -> None:
        """Count one time, [ns]; negative ones count as 1 ns."""
        self.count += 1
        self.max_ns = max(self.max_ns, ns)
        index = int(math.log2(max(ns, 1)) * BINS_PER_OCTAVE)
        self._bins[min(index, len(self._bins) - 1)] += 1

    def add_all(self, ns: np.ndarray) -> None:
        """Count some times, at least one, [ns]."""
        if len(ns) == 1:
            return self.add(int(ns[0]))
        self.count += len(ns)
        self.max_ns = max(self.max_ns, int(ns.max()))
        bins = (np.log2(np.maximum(ns, 1)) * BINS_PER_OCTAVE).astype(int)
        for index, count in zip(*np.unique(np.minimum(bins, len(self._bins) - 1), return_counts=True), strict=True):
            self._bins[index] += int(count)

    def quantile_us(self, share: float) -> float:
        """The quantile of this share, [µs]; NaN without any time."""
        if self.count == 0:
            return math.nan
        index = int(np.searchsorted(np.cumsum(self._bins), max(1, math.ceil(share * self.count))))
        return min(2 ** ((index + 1) / BINS_PER_OCTAVE), self.max_ns) * 1e-3

    def summary(self) -> dict[str, float | int | None]:
        """Quantiles as plain JSON; null without times."""
        if self.count == 0:
            return {"count": 0, "p50_us": None, "p99_us": None, "max_us": None}
        p50, p99 = self.quantile_us(0.5), self.quantile_us(0.99)
        return {"count": self.count, "p50_us": p50, "p99_us": p99, "max_us": self.max_ns * 1e-3}

    def text(self) -> str:
        """Return text such as `p50 120 µs, p99 310 µs, max 2 ms`."""
        if self.count == 0:
            return "none"
        names = {"p50": self.quantile_us(0.5), "p99": self.quantile_us(0.99), "max": self.max_ns * 1e-3}
        return ", ".join(f"{name} {_in_words(us)}" for name, us in names.items())


def _in_words(us: float) -> str:
    return f"{us:.0f} µs" if us < 1000 else f"{us * 1e-3:.2f} ms" if us < 1e6 else f"{us * 1e-6:.2f} s"


# --- One core and real-time priority for the calling thread, if the system grants them.


def ask_for_real_time(core: int | None, priority: int | None) -> list[str]:
    """Pin this thread, and all that it starts later, to a core, and set SCHED_FIFO; None: unchanged.

    Returns sentences on what was granted or refused. Refusals are no errors: a loop runs without, less evenly.
    """
    results = []
    if core is not None:
        try:
            os.sched_setaffinity(0, {core})
            results.append(f"pinned to core {core}")
        except AttributeError:
            results.append("not pinned to a core: this system has no such call")
        except OSError as error:
            there = sorted(os.sched_getaffinity(0))
            results.append(f"not pinned to core {core}: {error.strerror}; there are {', '.join(map(str, there))}")
    if priority is not None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
            results.append(f"SCHED_FIFO, priority {priority}")
        except AttributeError:
            results.append("no SCHED_FIFO: this system has no such call")
        except OSError as error:
            results.append(f"no SCHED_FIFO, priority {priority}: {error.strerror}; `ulimit -r` or root allow it")
    return results


def how_to_hold_the_rate(core: int | None, priority: int | None) -> str:
    """What to do on a computer that takes samples too late, with the options of the command that are not used yet."""
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))
    options = [f"--core {cores[-1]}"] if core is None and len(cores) > 1 else []
    options += ["--priority 50"] if priority is None else []
    return "close other programs" + (f", or start with {' '.join(options)}" if options else "")
