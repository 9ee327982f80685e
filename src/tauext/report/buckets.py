"""Minima and maxima of buckets of samples, so that a peak of one sample is there at every zoom."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

GAP_PERIODS = 2.5
"""Samples farther apart than so many periods have a gap between them, over which no line goes."""


@dataclass(frozen=True)
class Buckets:
    """Traces over one time axis, `size` samples a bucket, fewer where a run ends.

    Within a run there is no gap, and no trace changes between numbers and NaN. No bucket straddles runs: a gap stays
    a gap and a NaN a hole, to the sample, and minimum and maximum of a bucket are those of all its samples.
    """

    size: int
    t_ns: np.ndarray  # (buckets, 2) int64: first and last sample
    begins: np.ndarray  # (buckets,) bool: a run begins here
    low: np.ndarray  # (buckets, traces) float32
    high: np.ndarray

    def __len__(self) -> int:
        return len(self.begins)

    def merged(self, count: int) -> Buckets:
        """Buckets of `count` of these each, those that end a run of fewer: as if made from the samples at once."""
        if count == 1:
            return self
        first = bucket_starts(self.begins, count)
        last = np.append(first[1:], len(self)) - 1
        return Buckets(
            self.size * count,
            np.stack([self.t_ns[first, 0], self.t_ns[last, 1]], axis=1),
            self.begins[first],
            np.minimum.reduceat(self.low, first, axis=0),
            np.maximum.reduceat(self.high, first, axis=0),
        )

    @staticmethod
    def joined(parts: Sequence[Buckets]) -> Buckets:
        """One behind the other; parts have one size and the same traces, and a run begins at each."""
        fields = ("t_ns", "begins", "low", "high")
        return Buckets(parts[0].size, *(np.concatenate([getattr(part, name) for part in parts]) for name in fields))


def run_begins(t_ns: np.ndarray, blocks: Sequence[np.ndarray], gap_ns: float, cuts: Sequence[int] = ()) -> np.ndarray:
    """Where runs begin: (samples,) bool.

    Args:
        t_ns: (samples,), increasing.
        blocks: (samples, n) each; their columns are the traces.
        gap_ns: a longer step is a gap.
        cuts: samples at which a run is to begin, too.
    """
    begins = np.append(True, np.diff(t_ns) > gap_ns)
    begins[list(cuts)] = True
    for block in blocks:
        absent = ~np.isfinite(block)
        if absent.any():
            begins[1:] |= (absent[1:] != absent[:-1]).any(axis=1)
    return begins


def bucket_starts(begins: np.ndarray, count: int) -> np.ndarray:
    """First row of every bucket of `count` rows, counted anew where a run begins: (buckets,) int64."""
    here = np.arange(len(begins))
    run = np.maximum.accumulate(np.where(begins, here, 0))
    return np.flatnonzero((here - run) % count == 0)


def in_buckets(t_ns: np.ndarray, blocks: Sequence[np.ndarray], begins: np.ndarray, size: int) -> Buckets:
    """Samples in buckets, block by block, so that hours need no second copy of themselves.

    Args:
        t_ns, blocks: as run_begins takes them.
        begins: what it returned.
    """
    first = bucket_starts(begins, size)
    last = np.append(first[1:], len(t_ns)) - 1
    low, high = (
        np.concatenate([ufunc.reduceat(block, first, axis=0).astype(np.float32) for block in blocks], axis=1)
        for ufunc in (np.minimum, np.maximum)
    )
    return Buckets(size, np.stack([t_ns[first], t_ns[last]], axis=1), begins[first], low, high)
