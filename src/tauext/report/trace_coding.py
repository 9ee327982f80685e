"""Buckets as bytes for the page: whole steps, sorted by place, deflated. traces.js reads them."""

from __future__ import annotations

import zlib

import numpy as np

from tauext.report.buckets import Buckets

LARGEST = 2**30
"""In quanta; what is not finite or larger is no number to draw."""


def encode(buckets: Buckets, quantum: np.ndarray) -> tuple[bytes, list[int]]:
    """The bytes of buckets, and which pair of rows every trace has; equal traces share one.

    Rows of uint32: whether a run begins; first time, as a step from the one before (ms, then the rest in ns); last
    less first time (ms, ns); then two of each different trace: minimum in quanta, as a step from the one before with
    the sign in the lowest bit, and 1 + maximum − minimum, 0 for a hole. Bytes are sorted by their place in the number,
    whose upper ones are nearly all zero, and deflated. Rounded to the nearest quantum: half of one is the error.

    Args:
        quantum: (traces,), [unit of the trace].
    """
    step_ns, span_ns = np.diff(buckets.t_ns[:, 0], prepend=buckets.t_ns[:1, 0]), np.diff(buckets.t_ns, axis=1)[:, 0]
    rows = [buckets.begins, *np.divmod(step_ns, 1_000_000), *np.divmod(span_ns, 1_000_000)]
    place: dict[bytes, int] = {}
    where = []
    for trace, unit in enumerate(quantum):
        pair = two_rows(buckets.low[:, trace] / np.float64(unit), buckets.high[:, trace] / np.float64(unit))
        key = pair.tobytes()
        if key not in place:
            place[key] = len(place)
            rows.extend(pair)
        where.append(place[key])
    table = np.array(rows, dtype="<u4")
    planes = table.view(np.uint8).reshape(len(table), len(buckets), 4).transpose(0, 2, 1)
    return zlib.compress(planes.tobytes()), where


def two_rows(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Of one trace in quanta: steps of the minimum and widths, (2, buckets) uint32; a hole keeps the last minimum."""
    with np.errstate(invalid="ignore"):
        there = (np.abs(low) < LARGEST) & (np.abs(high) < LARGEST)
    low, high = (np.rint(np.where(there, values, 0)).astype(np.int64) for values in (low, high))
    last = np.maximum.accumulate(np.where(there, np.arange(len(low)), -1))
    step = np.diff(np.where(last < 0, 0, low[last]), prepend=0)
    return np.stack([(step << 1) ^ (step >> 63), np.where(there, high - low + 1, 0)]).astype("<u4")
