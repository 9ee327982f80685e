"""Traces of a recording within a number of bytes: buckets, stretches of interest, encoding."""

from __future__ import annotations

import base64
import json
import zlib
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from tauext.bundle.estimates import COLLISION, CONTACT, OK, Estimates
from tauext.data.recording import Recording

# --- Minima and maxima of buckets of samples, so that a peak of one sample is there at every zoom.


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
    """First row of every bucket of `count` rows, counted from 0 where a run begins: (buckets,) int64."""
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


# --- Intervals of a condition: contacts, alarms, gaps, health other than ok.


Stretch = tuple[float, float]
APART_S = 0.1
"""Alarms closer together are one, as `tauext evaluate` counts them."""


def stretches(holds: np.ndarray, time_s: np.ndarray, apart_s: float = 0.0) -> list[Stretch]:
    """First and last time of every stretch in which it holds, [s]; those closer than apart_s are one."""
    at = np.flatnonzero(holds)
    if len(at) == 0:
        return []
    parts = np.flatnonzero((np.diff(at) > 1) & (time_s[at[1:]] - time_s[at[:-1]] >= apart_s))
    return [
        (float(a), float(b))
        for a, b in zip(time_s[at[np.append(0, parts + 1)]], time_s[at[np.append(parts, len(at) - 1)]], strict=True)
    ]


def alarms(estimates: Estimates, time_s: np.ndarray) -> list[tuple[float, float, int]]:
    """First and last time of every alarm and its level, collisions first.

    A monitor's are latched; without a monitor they last as long as they are held.
    """
    level_at = estimates.held_alarm if estimates.alarm is None else estimates.alarm
    return [(*one, level) for level in (COLLISION, CONTACT) for one in stretches(level_at == level, time_s, APART_S)]


def gaps(t_ns: np.ndarray, gap_ns: float) -> list[Stretch]:
    """The samples before and after every step longer than gap_ns, [s] from the first."""
    at = np.flatnonzero(np.diff(t_ns) > gap_ns)
    return [(float(t_ns[k] - t_ns[0]) * 1e-9, float(t_ns[k + 1] - t_ns[0]) * 1e-9) for k in at]


# --- Traces of one recording: all of it in buckets, and every sample around events.


AROUND_S = 0.5
"""Every sample is kept from this time before the beginning of an event ..."""
EVENT_S = 1.0
"""... to this time after its end, or after this much of it."""
METHOD_SIGNALS = ("tau_ext", "limit", "sigma", "learned", "r")
"""Signals of every method; only bundles with an error scale have sigma."""


@dataclass
class Traced:
    """One recording and the estimates of methods, reduced."""

    head: dict[str, Any]
    """Names, and times in s from the first sample, as the page reads them."""
    traces: list[tuple[str, str | None, int]]
    """Signal, method (None: the recording's own) and joint of every column."""
    whole: Buckets
    close: list[tuple[int, Buckets]]
    """Windows of every sample in order of time, each with its place in the order of importance."""


def trace(
    recording: Recording, by_method: dict[str, Estimates], size: int, windows: int, first: Sequence[Stretch] = ()
) -> Traced:
    """Reduce one recording.

    Args:
        by_method: estimates, the most important first; its alarms have windows first.
        size: samples a bucket.
        windows: around so many events, at most, every sample is kept: contacts first, then alarms.
        first: events that come before all others, [s].
    """
    time_s, n = recording.time_s, len(recording.joints)
    named: dict[tuple[str, str | None], np.ndarray] = {("tau", None): recording.tau}
    reference = recording.tau_ext if recording.tau_ext_sensor is None else recording.tau_ext_sensor
    if reference is not None:
        named["reference", None] = reference
    for method, estimates in by_method.items():
        healthy_only = np.where((estimates.health == OK)[:, None], estimates.tau_ext, np.nan)
        learned = estimates.residual - estimates.tau_ext
        values = (healthy_only, estimates.limit_nm, estimates.band_nm, learned, estimates.residual)
        named |= {(name, method): one for name, one in zip(METHOD_SIGNALS, values, strict=True) if one is not None}
    contacts = [] if recording.contact is None else stretches(recording.contact == 1, time_s)
    found = {method: alarms(estimates, time_s) for method, estimates in by_method.items()}
    parts = around([*first, *contacts, *(one[:2] for each in found.values() for one in each)], time_s, windows)
    gap_ns = GAP_PERIODS * 1e9 / recording.rate_hz
    blocks = list(named.values())
    edges = [edge for _, part in parts for edge in (part.start, part.stop) if edge < recording.samples]
    begins = run_begins(recording.t_ns, blocks, gap_ns, edges)
    head = {
        "name": recording.name,
        "duration_s": recording.duration_s,
        "gap_s": gap_ns * 1e-9,
        "reference": "true or best known" if recording.tau_ext_sensor is None else "sensor",
        "gaps": gaps(recording.t_ns, gap_ns),
        "contacts": contacts,
        "alarms": found,
        "unhealthy": {method: stretches(estimates.health != OK, time_s) for method, estimates in by_method.items()},
    }
    return Traced(
        head=head,
        traces=[(*name, joint) for name in named for joint in range(n)],
        whole=in_buckets(recording.t_ns, blocks, begins, size),
        close=[(k, in_buckets(recording.t_ns[p], [b[p] for b in blocks], begins[p], 1)) for k, p in parts],
    )


def around(events: Sequence[Stretch], time_s: np.ndarray, count: int) -> list[tuple[int, slice]]:
    """Rows around the first `count` events that are not covered yet, in order of time, none touching the next.

    With each the place of the first event that it belongs to.
    """
    rank = np.full(len(time_s) + 2, len(events))
    for place, (start, end) in enumerate(events):
        ends = start - AROUND_S, min(end, start + EVENT_S) + AROUND_S
        part = slice(*(int(row) + 1 for row in np.searchsorted(time_s, ends)))
        if count > 0 and (rank[part] == len(events)).any():
            rank[part] = np.minimum(rank[part], place)
            count -= 1
    edges = np.flatnonzero(np.diff(rank < len(events))).reshape(-1, 2)
    return [(int(rank[a + 1 : b + 1].min()), slice(int(a), int(b))) for a, b in edges]


# --- Buckets as bytes for the page: whole steps, sorted by place, deflated. traces.js reads them.


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
    """A trace in quanta: steps of the minimum and widths, (2, buckets) uint32; a hole keeps the last minimum."""
    with np.errstate(invalid="ignore"):
        there = (np.abs(low) < LARGEST) & (np.abs(high) < LARGEST)
    low, high = (np.rint(np.where(there, values, 0)).astype(np.int64) for values in (low, high))
    last = np.maximum.accumulate(np.where(there, np.arange(len(low)), -1))
    step = np.diff(np.where(last < 0, 0, low[last]), prepend=0)
    return np.stack([(step << 1) ^ (step >> 63), np.where(there, high - low + 1, 0)]).astype("<u4")


# --- Traces of recordings within a number of bytes, as the page takes them.


QUANTA_A_LIMIT, QUANTA_A_RANGE = 1000, 8000
"""External torque, standard error and limits are kept in steps of a joint's smallest limit by the one; other signals,
and where there is no limit, in steps of their range by the other, if that is more."""
RANGE_PERCENT = (0.1, 99.9)
"""Percentiles of all buckets that bound the range: one wild value does not make the others coarse."""
QUANTA_A_ROW = 500
"""A row of the page spans so many at least: on its 200 pixels the rounding is a fifth of one."""
CLOSE_SHARE = 0.65
"""Largest share of the bytes that the samples around events get."""
BYTES_A_SAMPLE, BYTES_A_BUCKET = 0.5, 1.0
"""Bytes of base64 that a sample and a bucket of a trace take, or a little less: where counting starts."""
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
    """Buckets as encoded in the page."""

    header: dict[str, Any]
    text: str

    @classmethod
    def of(cls, buckets: Buckets, unit: np.ndarray) -> Tier:
        content, rows = encode(buckets, unit)
        header = {"size": buckets.size, "count": len(buckets), "rows": rows}
        return cls(header, base64.b64encode(content).decode())


def pack(traced: Sequence[Traced], joints: Sequence[str], room: int) -> tuple[dict[str, Any], list[str]]:
    """The page's data of the recordings, and base64 for each of their tiers: buckets, then windows if it has any.

    All of it takes `room` bytes at most: the least important windows go until the others take their share, then buckets
    are merged.

    Returns:
        An object for JSON, times [s], torques [N m]; texts as trace_coding.py writes them.
    """
    steps = quanta(traced, len(joints))
    room -= len(json.dumps([one.head for one in traced]))
    units = [np.array([steps[signal][joint] for signal, _, joint in one.traces]) for one in traced]
    windows = [one.close if one.whole.size > 1 else [] for one in traced]

    def encoded(buckets: Iterable[Buckets | None]) -> list[list[Tier]]:
        with ThreadPoolExecutor() as pool:  # most of the time is zlib's, which runs in several threads
            return list(pool.map(lambda one, unit: [] if one is None else [Tier.of(one, unit)], buckets, units))

    while True:
        close = encoded(Buckets.joined([part for _, part in parts]) if parts else None for parts in windows)
        left = room - size_of(close)
        if left >= (1 - CLOSE_SHARE) * room:
            break
        windows = fewer(windows, CLOSE_SHARE * room / size_of(close))
    merge = 1
    while True:
        whole = encoded(one.whole.merged(merge) for one in traced)
        if size_of(whole) <= left or all(tier.header["count"] <= FEWEST_BUCKETS for (tier,) in whole):
            break
        merge = max(merge + 1, int(merge * size_of(whole) / left))
    tiers = [of_all + near for of_all, near in zip(whole, close, strict=True)]
    recordings = [
        one.head
        | {
            "traces": one.traces,
            "tiers": [tier.header for tier in mine],
            "windows": [((part.t_ns[[0, -1], [0, 1]] - one.whole.t_ns[0, 0]) * 1e-9).tolist() for _, part in parts],
        }
        for one, mine, parts in zip(traced, tiers, windows, strict=True)
    ]
    content = {"joints": list(joints), "quanta": steps, "quanta_a_row": QUANTA_A_ROW}
    return content | {"recordings": recordings}, [tier.text for mine in tiers for tier in mine]


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
