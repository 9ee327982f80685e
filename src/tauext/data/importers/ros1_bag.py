"""Files of ROS 1 bags, also those that were not closed or are damaged."""

from __future__ import annotations

import bz2
import mmap
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from tauext.data.importers.bag import MOST_BYTES, Channel, CountLost, decompressed, ros_type

MAGIC = b"#ROSBAG V"
_MESSAGE, _CHUNK, _CONNECTION = 2, 5, 7
"""Operations of records."""


class Ros1Bag:
    """An open file; rosbags reads it by its index, a walk over its records where the index is missing or wrong."""

    def __init__(self, path: Path):
        from rosbags.rosbag1 import Reader

        self.notes: list[str] = []
        self._path = path
        self._file = path.open("rb")
        self._data = mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ)
        self._reader: Any = Reader(path)
        try:
            self._reader.open()
        except Exception:  # rosbags raises many types on damaged bytes: struct, assertion, its own
            self._reader = None
            self.notes.append("the file has no index: it was not closed, or is cut off; read up to its last message")
        if self._reader is not None:
            self._connections = {
                c.id: Channel(c.topic, c.msgtype, "ros1", "ros1msg", c.msgdef.data, c.msgcount)
                for c in self._reader.connections
            }
        else:
            found: dict[int, tuple[str, str, str]] = {}
            counts: dict[int, int] = {}
            for number, _, _ in self._walk(found):
                counts[number] = counts.get(number, 0) + 1
            self._connections = {
                number: Channel(topic, ros_type(kind), "ros1", "ros1msg", definition, counts.get(number, 0))
                for number, (topic, kind, definition) in found.items()
            }
        self.channels = list(self._connections.values())

    def close(self) -> None:
        """Close the file."""
        if self._reader is not None:
            self._reader.close()
        self._data.close()
        self._file.close()

    def messages(self, wanted: Sequence[Channel], lost: CountLost) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield channel, log time [ns] and bytes of each message, in order of log time; without index, of the file."""
        channels = {number: channel for number, channel in self._connections.items() if channel in wanted}
        missing = sum(channel.count for channel in channels.values())
        last_ns = -1
        if self._reader is not None:
            try:
                for connection, log_ns, raw in self._reader.messages(
                    [c for c in self._reader.connections if c.id in channels]
                ):
                    yield channels[connection.id], log_ns, raw
                    last_ns, missing = log_ns, missing - 1
                return
            except MemoryError:
                raise
            except Exception:  # as above
                self._note("a damaged part of the file is left out")
        for number, log_ns, raw in self._walk({}):
            if number in channels and log_ns > last_ns:
                yield channels[number], log_ns, raw
                missing -= 1
        if missing > 0:
            lost("in a damaged part of the file", missing, "unknown")

    def _note(self, note: str) -> None:
        if note not in self.notes:
            self.notes.append(note)

    def _walk(self, connections: dict[int, tuple[str, str, str]]) -> Iterator[tuple[int, int, bytes]]:
        """Yield connection, log time [ns] and bytes of each whole message, in the order of the file.

        Args:
            connections: topic, type and definition by number; filled here.
        """
        for fields, begin, end in _records(self._data, self._data.find(b"\n") + 1):
            if fields.get(b"op", b"")[:1] != bytes([_CHUNK]):
                continue
            packed, compression = self._data[begin:end], fields.get(b"compression", b"none")
            whole = len(packed) == end - begin
            chunk: bytes | None = packed
            if compression == b"bz2":
                chunk = _bz2(packed)
            elif compression == b"lz4":
                chunk, sound = decompressed(packed, "lz4")
                chunk = chunk if sound or not whole else None
            if chunk is None:
                self._note("a damaged part of the file is left out")
                continue
            for inner, at, stop in _records(chunk, 0):
                operation, number = inner.get(b"op", b"\0")[0], inner.get(b"conn", b"")
                if len(number) != 4 or stop > len(chunk):
                    continue
                key = int.from_bytes(number, "little")
                if operation == _CONNECTION:
                    held = _fields(chunk, at, stop)
                    texts = (inner.get(b"topic", b""), held.get(b"type", b""), held.get(b"message_definition", b""))
                    topic, kind, definition = (text.decode(errors="replace") for text in texts)
                    connections.setdefault(key, (topic, kind, definition))
                elif operation == _MESSAGE and len(inner.get(b"time", b"")) == 8:
                    sec, nanosec = struct.unpack("<II", inner[b"time"])
                    yield key, sec * 10**9 + nanosec, chunk[at:stop]


def _records(data: bytes | mmap.mmap, at: int) -> Iterator[tuple[dict[bytes, bytes], int, int]]:
    """Yield fields, begin and end of the content of each record; the last one may end beyond the data."""
    while at + 8 <= len(data):
        (length,) = struct.unpack_from("<I", data, at)
        begin = at + 8 + length
        if begin > len(data):
            return
        (size,) = struct.unpack_from("<I", data, at + 4 + length)
        yield _fields(data, at + 4, at + 4 + length), begin, begin + size
        at = begin + size


def _fields(data: bytes | mmap.mmap, at: int, end: int) -> dict[bytes, bytes]:
    fields = {}
    while at + 4 <= end:
        (size,) = struct.unpack_from("<I", data, at)
        name, _, value = bytes(data[at + 4 : min(at + 4 + size, end)]).partition(b"=")
        fields[name] = value
        at += 4 + size
    return fields


def _bz2(packed: bytes) -> bytes | None:
    """Decompress as far as the data is whole; None: it is damaged."""
    try:
        return bz2.BZ2Decompressor().decompress(packed, MOST_BYTES)
    except OSError:
        return None
