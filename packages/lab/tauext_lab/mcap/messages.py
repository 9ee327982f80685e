"""ROS 2 messages by their standard definitions, one at a time or many of one layout; rosbags makes the bytes."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from tauext.data.importers.ros import standard_types

LAST_NS = (1 << 31) * 10**9 - 1
"""Last time of a stamp, which has 32 bits of seconds."""
_BASE, _NAME, _ARRAY = 1, 2, 3
"""Kinds of fields in rosbags' tables; the fourth is a sequence."""


def definition(kind: str) -> str:
    """Definition of a type and of the types that it uses, in the format `ros2msg`."""
    made: str = standard_types().generate_msgdef(kind, ros_version=2)[0]
    return made


def message(kind: str, given: Mapping[str, Any]) -> Any:
    """A message with these fields; the others are zero or empty.

    Args:
        given: values by field; of a field with a type of its own, its fields; lists of them of a sequence.
    """
    store = standard_types()
    _, fields = store.fielddefs[kind]
    values = {}
    for name, (nature, of) in fields:
        value = given.get(name)
        if nature == _NAME:
            values[name] = message(of, value or {})
        elif nature == _BASE:
            values[name] = _zero(of[0]) if value is None else value
        else:
            (inner, what), size = of
            if inner == _NAME:
                values[name] = [message(what, one) for one in value or [{}] * (size if nature == _ARRAY else 0)]
            elif what[0] == "string":
                values[name] = list(value or [])
            else:
                values[name] = np.asarray([0] * (size if nature == _ARRAY else 0) if value is None else value, what[0])
    return store.types[kind](**values)


def _zero(base: str) -> Any:
    return "" if base == "string" else False if base == "bool" else 0.0 if base.startswith("float") else 0


def cdr(kind: str, given: Mapping[str, Any]) -> bytes:
    """Bytes of such a message: CDR, little-endian."""
    return bytes(standard_types().serialize_cdr(message(kind, given), kind))


def stamp(t_ns: int) -> dict[str, int]:
    """A time of ROS; t_ns: 0 to LAST_NS."""
    sec, nanosec = divmod(t_ns, 10**9)
    return {"sec": sec, "nanosec": nanosec}


class Template:
    """The bytes of a message in which only stamps and numbers of 64 bits change.

    The message is made once with numbers that occur nowhere else; their bytes show where each number belongs.
    """

    def __init__(self, kind: str, count: int, make: Callable[[dict[str, int], list[float]], Mapping[str, Any]]):
        """make: fields of the message with this stamp, which may occur several times, and these `count` numbers."""
        drawn = np.random.default_rng(0).uniform(1, 2, count)
        mark_ns = 0x5A5A_5A5A * 10**9 + 0x2B2B_2B2B
        raw = cdr(kind, make(stamp(mark_ns), drawn.tolist()))
        self._raw = np.frombuffer(raw, np.uint8)
        self._stamps = _positions(raw, struct.pack("<iI", *stamp(mark_ns).values()))
        self._runs: list[list[int]] = []
        """Numbers that are neighbours in the bytes, too: where they begin, the first one, the one after the last."""
        for k, one in enumerate(drawn.tolist()):
            (at,) = _positions(raw, struct.pack("<d", one))
            if self._runs and at == self._runs[-1][0] + 8 * (k - self._runs[-1][1]):
                self._runs[-1][2] = k + 1
            else:
                self._runs.append([at, k, k + 1])

    def fill(self, t_ns: np.ndarray, numbers: np.ndarray | None = None) -> np.ndarray:
        """Messages, (rows, bytes) uint8.

        Args:
            t_ns: (rows,), 0 to LAST_NS.
            numbers: (rows, count) float64; None: of a message without.
        """
        rows = np.tile(self._raw, (len(t_ns), 1))
        stamps = np.empty((len(t_ns), 2), "<u4")
        stamps[:, 0], stamps[:, 1] = np.divmod(t_ns, 10**9)
        for at in self._stamps:
            rows[:, at : at + 8] = stamps.view(np.uint8)
        if numbers is not None:
            filled = np.ascontiguousarray(numbers, "<f8").view(np.uint8)
            for at, first, end in self._runs:
                rows[:, at : at + 8 * (end - first)] = filled[:, 8 * first : 8 * end]
        return rows


def _positions(raw: bytes, mark: bytes) -> list[int]:
    """Where the mark begins, each time it occurs."""
    return [found.start() for found in re.finditer(re.escape(mark), raw)]
