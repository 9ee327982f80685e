"""Traces of recordings within a number of bytes, as the page takes them."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tauext.data.recording import Recording
from tauext.report.buckets import Buckets
from tauext.report.trace_coding import encode
from tauext.report.tracing import AROUND_S, Traced

QUANTA_A_LIMIT, QUANTA_A_RANGE = 1000, 8000
"""External torque, standard error and limits are kept in steps of a joint's smallest limit by the one; other signals,
and where there is no limit, in steps of their range by the other, if that is more."""
RANGE_PERCENT = (0.1, 99.9)
"""Of all buckets: one wild value does not make the others coarse."""
QUANTA_A_ROW = 500
"""A row of the page spans so many at least: on its 200 pixels the rounding is a fifth of one."""
CLOSE_SHARE = 0.65
"""Of the bytes, at most, go to the samples around events."""
BYTES_A_SAMPLE, BYTES_A_BUCKET = 0.5, 1.0
"""Of base64, that one of a trace takes, or a little less: where counting starts from."""
FEWEST_BUCKETS = 100
"""Recordings are not merged further once none has more, whatever room there is."""


@dataclass(frozen=True)
class Plan:
    """How much is kept of recordings that are not read yet, for somewhat more bytes than there are.

    Args:
        samples: of all recordings together.
        traces: of each, about.
        room: bytes.
    """

    samples: int
    traces: int
    room: int

    @property
    def size(self) -> int:
        """Samples a bucket: finer than there is room for, since buckets can be merged later and not split."""
        return max(int(self.samples * self.traces * BYTES_A_BUCKET / self.room) // 2, 1)

    def windows(self, recording: Recording) -> int:
        """Its share of the windows, by its length; one at least."""
        in_all = CLOSE_SHARE * self.room / (BYTES_A_SAMPLE * self.traces * 2 * AROUND_S * recording.rate_hz)
        return max(round(in_all * recording.samples / self.samples), 1)


@dataclass(frozen=True)
class Tier:
    """Buckets as they stand in the page."""

    told: dict[str, Any]
    text: str

    @classmethod
    def of(cls, buckets: Buckets, unit: np.ndarray) -> Tier:
        content, rows = encode(buckets, unit)
        told = {"size": buckets.size, "count": len(buckets), "rows": rows}
        return cls(told, base64.b64encode(content).decode())


def pack(traced: Sequence[Traced], joints: Sequence[str], room: int) -> tuple[dict[str, Any], list[str]]:
    """What the page is told of the recordings, and base64 for each of their tiers: buckets, then windows if it has any.

    All of it takes `room` bytes at most: the least important windows go until the others take their share, then buckets
    are merged.

    Returns:
        An object for JSON, times [s], torques [N m]; texts as trace_coding.py writes them.
    """
    steps = quanta(traced, len(joints))
    room -= len(json.dumps([one.head for one in traced]))
    units = [np.array([steps[signal][joint] for signal, _, joint in one.traces]) for one in traced]
    windows = [one.close if one.whole.size > 1 else [] for one in traced]
    while True:
        close = [
            [Tier.of(Buckets.joined([part for _, part in parts]), unit)] if parts else []
            for parts, unit in zip(windows, units, strict=True)
        ]
        left = room - size_of(close)
        if left >= (1 - CLOSE_SHARE) * room:
            break
        windows = fewer(windows, CLOSE_SHARE * room / size_of(close))
    merge = 1
    while True:
        whole = [[Tier.of(one.whole.merged(merge), unit)] for one, unit in zip(traced, units, strict=True)]
        if size_of(whole) <= left or all(tier.told["count"] <= FEWEST_BUCKETS for (tier,) in whole):
            break
        merge = max(merge + 1, int(merge * size_of(whole) / left))
    tiers = [of_all + near for of_all, near in zip(whole, close, strict=True)]
    recordings = [
        one.head
        | {
            "traces": one.traces,
            "tiers": [tier.told for tier in mine],
            "windows": [((part.t_ns[[0, -1], [0, 1]] - one.whole.t_ns[0, 0]) * 1e-9).tolist() for _, part in parts],
        }
        for one, mine, parts in zip(traced, tiers, windows, strict=True)
    ]
    told = {"joints": list(joints), "quanta": steps, "quanta_a_row": QUANTA_A_ROW}
    return told | {"recordings": recordings}, [tier.text for mine in tiers for tier in mine]


def size_of(tiers: Sequence[Sequence[Tier]]) -> int:
    return sum(len(tier.text) for mine in tiers for tier in mine)


def fewer(windows: list[list[tuple[int, Buckets]]], share: float) -> list[list[tuple[int, Buckets]]]:
    """This share of all windows, at least one less: the first of each recording, then the second of each, ..."""
    order = sorted(
        (place, number, rank)
        for number, parts in enumerate(windows)
        for place, rank in enumerate(sorted(r for r, _ in parts))
    )
    kept = {(number, rank) for _, number, rank in order[: min(int(share * len(order)), len(order) - 1)]}
    return [[part for part in parts if (number, part[0]) in kept] for number, parts in enumerate(windows)]


def quanta(traced: Sequence[Traced], joints: int) -> dict[str, list[float]]:
    """The steps in which values are kept: of every signal one a joint, [N m]."""
    limit = np.full(joints, np.inf)
    extent: dict[str, np.ndarray] = {}
    for one in traced:
        for column, (signal, _, joint) in enumerate(one.traces):
            values = np.append(one.whole.low[:, column], one.whole.high[:, column])
            values = values[np.isfinite(values)]
            if len(values):
                low, high = np.percentile(values, RANGE_PERCENT)
                ranges = extent.setdefault(signal, np.zeros(joints))
                ranges[joint] = max(ranges[joint], high - low)
                if signal == "limit" and values.min() > 0:
                    limit[joint] = min(limit[joint], values.min())
    from_limit = np.where(np.isfinite(limit), limit, 0.0) / QUANTA_A_LIMIT
    steps = {}
    for signal in dict.fromkeys(signal for one in traced for signal, *_ in one.traces):
        from_range = extent.get(signal, np.zeros(joints)) / QUANTA_A_RANGE
        step = np.maximum(from_limit, from_range)
        if signal in ("tau_ext", "limit", "sigma"):
            step = np.where(from_limit > 0, from_limit, from_range)
        steps[signal] = np.where(step > 0, step, 1 / QUANTA_A_RANGE).tolist()
    return steps
