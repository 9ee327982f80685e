"""ROS messages to columns: JointState in bulk where all have one layout, any other type by walking its fields."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tauext.data.importers.raw import RawSignals
from tauext.errors import RecordingError

JOINT_STATE = "sensor_msgs/msg/JointState"
ARRAYS = ("position", "velocity", "effort")
Deserialize = Callable[[bytes], Any]


@dataclass(frozen=True)
class Layout:
    """Where the numbers of a JointState message lie in its bytes."""

    names: tuple[str, ...]
    stamp: int
    fixed: tuple[slice, ...]
    """Bytes that every message of this layout has in common: names, and the lengths of the arrays."""
    arrays: dict[str, slice]


def layout_of(raw: bytes, cdr: bool) -> Layout | None:
    """Layout of a JointState message, CDR (little-endian) or ROS 1; None where it cannot be read off.

    CDR aligns each number to its size, counted from behind the four bytes of encapsulation; ROS 1 aligns nothing.
    """
    if cdr and raw[:2] != b"\x00\x01":
        return None
    try:
        at = stamp = 4
        at += 8  # the stamp, behind the encapsulation or behind ROS 1's sequence number
        _, at = _text(raw, at, cdr)
        count, at = _length(raw, at, cdr)
        names = []
        for _ in range(count):
            name, at = _text(raw, at, cdr)
            names.append(name)
        fixed, arrays, begin = [], {}, stamp + 8
        for array in ARRAYS:
            count, at = _length(raw, at, cdr)
            fixed.append(slice(begin, at))
            if count not in (0, len(names)):
                return None
            if count:
                at = 4 + -(-(at - 4) // 8) * 8 if cdr else at
                arrays[array] = slice(at, at + 8 * count)
            begin = at = at + 8 * count
    except (struct.error, UnicodeDecodeError):
        return None
    return Layout(tuple(names), stamp, tuple(fixed), arrays) if at == len(raw) else None


def joint_states(
    topic: str, raw: Sequence[bytes], cdr: bool, deserialize: Deserialize
) -> Iterator[tuple[np.ndarray, RawSignals]]:
    """JointState messages as columns `position[joint]`, `velocity[joint]`, `effort[joint]`, with their rows in `raw`.

    Messages of one layout are decoded at once from one view of their bytes; others one by one. Where messages name
    different joints (an arm and its gripper on one topic), each set of names comes by itself. Times are the headers'.

    Raises:
        RecordingError: an array that is neither empty nor as long as the names.
    """
    layout = layout_of(raw[0], cdr)
    if layout is not None and all(len(message) == len(raw[0]) for message in raw):
        rows = np.frombuffer(b"".join(raw), np.uint8).reshape(len(raw), -1)
        if all((rows[:, part] == rows[0, part]).all() for part in layout.fixed):
            yield np.arange(len(raw)), _in_bulk(topic, rows, layout)
            return
    by_names: dict[tuple[tuple[str, ...], tuple[str, ...]], list[int]] = {}
    messages = [deserialize(message) for message in raw]
    for row, message in enumerate(messages):
        held = tuple(array for array in ARRAYS if len(getattr(message, array)))
        for array in held:
            if len(getattr(message, array)) != len(message.name):
                raise RecordingError(
                    f"topic {topic}: a message has {len(message.name)} names and {len(getattr(message, array))} values "
                    f"of {array}; they must be as many, or none"
                )
        by_names.setdefault((tuple(message.name), held), []).append(row)
    for (names, held), group in by_names.items():
        values = np.array([np.concatenate([[], *(getattr(messages[k], a) for a in held)]) for k in group])
        t_ns = np.array([stamp_ns(messages[k]) for k in group], np.int64)
        columns = tuple(f"{array}[{name}]" for array in held for name in names)
        yield np.array(group), RawSignals(topic, columns, t_ns, values.reshape(len(group), len(columns)))


def any_messages(topic: str, raw: Sequence[bytes], deserialize: Deserialize) -> RawSignals:
    """Messages of any type: every number in it a column, `field.field` or `field.field[index]`; text is left out.

    Times are the headers', 0 without one.

    Raises:
        RecordingError: messages that do not all hold the same numbers.
    """
    rows: list[list[float]] = []
    names: tuple[str, ...] = ()
    t_ns = []
    for message in map(deserialize, raw):
        numbers = dict(_numbers(message, ""))
        if rows and tuple(numbers) != names:
            raise RecordingError(f"topic {topic}: its messages hold arrays of changing length; they must stay the same")
        names = tuple(numbers)
        rows.append(list(numbers.values()))
        t_ns.append(stamp_ns(message))
    return RawSignals(topic, names, np.array(t_ns, np.int64), np.array(rows, np.float64).reshape(len(raw), len(names)))


def stamp_ns(message: Any) -> int:
    """Stamp of the message's header, [ns]; 0 without one."""
    header = getattr(message, "header", None)
    return 0 if header is None else header.stamp.sec * 10**9 + header.stamp.nanosec


class Clock:
    """Header stamps, or log times where the first messages' stamps are all zero; one a topic."""

    def __init__(self, counts: Counter[str]):
        self._counts = counts
        self._by_log: bool | None = None

    def stamped(self, block: RawSignals, log_ns: np.ndarray) -> RawSignals:
        """The block on this clock. A message without a stamp among stamped ones belongs on no clock: left out.

        A stamp of zero that leads the block is kept: recordings of simulated time begin there.
        """
        assert block.t_ns is not None
        if self._by_log is None:
            # One message alone may rightly be stamped 0.
            self._by_log = not block.t_ns.any() and (len(log_ns) > 1 or log_ns[0] > 0)
        if self._by_log:
            self._counts[f"{block.stream}: messages with a stamp of zero, timed by the bag's log"] += len(log_ns)
            return RawSignals(block.stream, block.names, log_ns, block.columns)
        stamped = block.t_ns != 0
        stamped[0] = True
        if stamped.all():
            return block
        self._counts[f"{block.stream}: messages without a stamp among stamped ones left out"] += int((~stamped).sum())
        return RawSignals(block.stream, block.names, block.t_ns[stamped], block.columns[stamped])


def _in_bulk(topic: str, rows: np.ndarray, layout: Layout) -> RawSignals:
    stamps = np.ascontiguousarray(rows[:, layout.stamp : layout.stamp + 8]).view("<u4").astype(np.int64)
    values = np.empty((len(rows), len(layout.names) * len(layout.arrays)))
    for k, part in enumerate(layout.arrays.values()):
        columns = slice(k * len(layout.names), (k + 1) * len(layout.names))
        values[:, columns] = np.ascontiguousarray(rows[:, part]).view("<f8")
    names = tuple(f"{array}[{name}]" for array in layout.arrays for name in layout.names)
    return RawSignals(topic, names, stamps[:, 0] * 10**9 + stamps[:, 1], values)


def _length(raw: bytes, at: int, cdr: bool) -> tuple[int, int]:
    at = 4 + -(-(at - 4) // 4) * 4 if cdr else at
    return struct.unpack_from("<I", raw, at)[0], at + 4


def _text(raw: bytes, at: int, cdr: bool) -> tuple[str, int]:
    length, at = _length(raw, at, cdr)
    if at + length > len(raw):
        raise struct.error("text beyond the end")
    return raw[at : at + length].rstrip(b"\0" if cdr else b"").decode(), at + length


def _numbers(value: Any, name: str) -> Iterator[tuple[str, float]]:
    if isinstance(value, bool | int | float | np.number):
        yield name, float(value)
    elif isinstance(value, np.ndarray):
        yield from ((f"{name}[{k}]", float(number)) for k, number in enumerate(value.ravel()))
    elif isinstance(value, list):
        for k, element in enumerate(value):
            yield from _numbers(element, f"{name}[{k}]")
    elif hasattr(value, "__dataclass_fields__"):
        for field in value.__dataclass_fields__:
            if field not in ("__msgtype__", "header"):
                yield from _numbers(getattr(value, field), f"{name}.{field}" if name else field)
