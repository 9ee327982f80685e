"""Files of bags, of ROS 1 and ROS 2 (sqlite3): channels, and messages in order of log time, of damaged files too."""

from __future__ import annotations

import mmap
import os
import shutil
import sqlite3
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol
from urllib.parse import quote

import pyarrow as pa

from tauext.errors import RecordingError
from tauext.files import unpacking
from tauext.files.unpacking import Unpacked

ROS1_MAGIC, SQLITE_MAGIC = b"#ROSBAG V", b"SQLite format 3\0"
ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"


@dataclass(frozen=True, eq=False)
class Channel:
    """Messages of one topic with one type and encoding."""

    topic: str
    msgtype: str
    """Type of the messages: package/msg/Type for ROS, else as in the file."""
    encoding: str
    """Encoding of the messages: cdr, ros1, json."""
    schema: str
    """Kind of the definition: ros2msg, ros2idl, ros1msg, jsonschema; empty: there is none."""
    definition: str
    count: int
    profile: str = ""
    """Profile of an MCAP file."""


CountLost = Callable[[str, int, str], None]
"""Counts messages left out: reason, number, position of the first."""


class BagFile(Protocol):
    """An open file."""

    channels: list[Channel]
    notes: list[str]
    """On damage; more may come while the messages are read."""

    def messages(self, wanted: Sequence[Channel], lost: CountLost) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield channel, log time [ns] and bytes of each message."""

    def close(self) -> None:
        """Close the file."""


def ros_type(name: str) -> str:
    """Name of a ROS type as package/msg/Type, from the forms of ROS 1, IDL and DDS."""
    parts = [part for part in name.replace("::", "/").split("/") if part and part != "dds_"]
    if "::" in name:
        parts[-1] = parts[-1].removesuffix("_")
    return "/".join([parts[0], "msg", parts[1]] if len(parts) == 2 else parts)


def decompressed(data: bytes, codec: str) -> tuple[bytes, bool]:
    """Decompress zstd, lz4 or bz2 as far as it is whole, at most to the size of a part; also whether all of it is."""
    stream, parts, size = pa.CompressedInputStream(pa.BufferReader(data), codec), list[bytes](), 0
    try:
        while (part := stream.read(1 << 16)) and (size := size + len(part)) <= unpacking.LEAST:
            parts.append(part)
    except OSError:
        return b"".join(parts), False
    return b"".join(parts), size <= unpacking.LEAST


# --- ROS 2: sqlite3 files, also those that the recorder did not close.


class SqliteBag:
    """An open sqlite3 file."""

    def __init__(self, path: Path):
        self.notes: list[str] = []
        self._copies: TemporaryDirectory | None = None
        self._database = self._opened(path)
        self._damaged = False
        try:
            definitions = self._definitions()
            topics = self._database.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
        except (RecordingError, sqlite3.DatabaseError) as error:
            self.close()
            damaged = (
                "its table of topics cannot be read: it is damaged, or the recorder kept its last rows in "
                f"{path.name}-wal; copy all files of the bag's folder again"
            )
            raise RecordingError(f"{path}: {error if isinstance(error, RecordingError) else damaged}") from error
        counts = self._counts()
        self._by_id = {
            number: Channel(name, ros_type(kind), encoding, *definitions.get(kind, ("", "")), counts.get(number, 0))
            for number, name, kind, encoding in topics
        }
        self.channels = list(self._by_id.values())

    def close(self) -> None:
        """Close the file."""
        self._database.close()
        if self._copies:
            self._copies.cleanup()

    def _opened(self, path: Path) -> sqlite3.Connection:
        """Open the file without a change to it: rows beside it are taken in, part of a page left out, on a copy."""
        # The recorder's last rows are there until it closes the bag.
        beside = [path.with_name(path.name + end) for end in ("-wal", "-journal")]
        beside = [part for part in beside if part.is_file() and part.stat().st_size]
        part_of_page = 0 if beside else path.stat().st_size % _page_bytes(path)
        if not beside and not part_of_page:
            return sqlite3.connect(f"file:{quote(str(path))}?immutable=1", uri=True)
        self._copies = TemporaryDirectory()
        for part in (path, *beside):
            shutil.copyfile(part, Path(self._copies.name) / part.name)
        copy = Path(self._copies.name) / path.name
        if beside:
            self.notes.append(
                f"not closed by the recorder: the rows in {', '.join(p.name for p in beside)} are read too"
            )
        else:  # sqlite would take the missing end of the last page for zeros
            os.truncate(copy, copy.stat().st_size - part_of_page)
        return sqlite3.connect(copy)

    def _definitions(self) -> dict[str, tuple[str, str]]:
        """Kind and text of the definition of each type; older bags have none."""
        # A file that is shorter than its header states is refused otherwise, with every row that it has.
        self._database.execute("PRAGMA writable_schema=ON")
        self._expect_tables()
        tables = {name for (name,) in self._database.execute("SELECT name FROM sqlite_master")}
        if "message_definitions" not in tables:
            return {}
        query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions ORDER BY id DESC"
        return {kind: (schema, text) for kind, schema, text in self._database.execute(query)}

    def _expect_tables(self) -> None:
        """Raise RecordingError where rows are computed, not stored: a view can have any number of rows."""
        kinds = {name: kind for name, kind in self._database.execute("SELECT name, type FROM sqlite_master")}
        for name in ("topics", "messages", "message_definitions"):
            columns = self._database.execute(f"PRAGMA table_xinfo({name})").fetchall()
            if kinds.get(name, "table") != "table" or any(column[-1] for column in columns):
                raise RecordingError(f"its '{name}' is no plain table: no recorder of ROS 2 writes such a file")

    def _counts(self) -> dict[int, int]:
        try:
            return dict(self._database.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"))
        except sqlite3.DatabaseError:
            self._damaged = True
        counts: dict[int, int] = {}
        for number, _, _ in self._readable():
            counts[number] = counts.get(number, 0) + 1
        self.notes.append(f"the file is damaged or cut off: the {sum(counts.values())} readable messages are read")
        return counts

    def messages(self, wanted: Sequence[Channel], lost: CountLost) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield channel, log time [ns] and bytes of each message, by log time; of a damaged file as they lie."""
        del lost
        channels = {number: channel for number, channel in self._by_id.items() if channel in wanted}
        last_ns = -1
        if not self._damaged:
            marks = ",".join("?" * len(channels))
            query = f"SELECT topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY timestamp"
            try:
                for number, log_ns, raw in self._database.execute(query, tuple(channels)):
                    if isinstance(raw, bytes):
                        yield channels[number], log_ns, raw
                        last_ns = log_ns
                return
            except sqlite3.DatabaseError:  # of the index of times
                self.notes.append("the file is damaged: its readable messages are read")
        for number, log_ns, raw in self._readable():
            if number in channels and isinstance(raw, bytes) and isinstance(log_ns, int) and log_ns > last_ns:
                yield channels[number], log_ns, raw

    def _readable(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield the rows that can be read, in the order of the file."""
        query = "SELECT id, topic_id, timestamp, data FROM messages NOT INDEXED WHERE id > ? ORDER BY id"
        last, step = 0, 1
        while step < 1 << 32:  # rows to step over, in search of the next readable one
            try:
                for row, number, log_ns, raw in self._database.execute(query, (last,)):
                    if row <= last:  # damaged pages may lead in a circle
                        raise sqlite3.DatabaseError
                    last, step = row, 1
                    yield number, log_ns, raw
                return
            except sqlite3.DatabaseError:
                last += step
                step *= 2


def _page_bytes(path: Path) -> int:
    """Size of a database's pages, from its header."""
    with path.open("rb") as file:
        size = int.from_bytes(file.read(18)[16:], "big")
    return 65536 if size == 1 else max(size, 1)


# --- ROS 1: files, also those that were not closed.


class Ros1Bag:
    """An open file; rosbags reads it by its index, a walk over its records where the index is missing or wrong."""

    def __init__(self, path: Path):
        from rosbags.rosbag1.reader import Reader, decompressors

        self.notes: list[str] = []
        self._path = path
        self._file = path.open("rb")
        self._data = mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ)
        self._unpacked = Unpacked(path)
        self._reader: Any = Reader(path)
        try:
            self._reader.open()
            codecs = {function: name for name, function in decompressors.items()}
            for at, chunk in self._reader.chunks.items():
                bounded = partial(self._counted, at, codecs[chunk.decompressor])
                self._reader.chunks[at] = chunk._replace(decompressor=bounded)
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
            except (MemoryError, RecordingError):
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

    def _counted(self, at: int, codec: str, packed: bytes) -> bytes:
        """Unpack a chunk for rosbags, whose functions have no bound."""
        if codec == "none":
            return packed
        chunk, whole = decompressed(packed, codec)
        self._unpacked.add(len(chunk), at)
        if not whole:
            raise OSError("damaged")
        return chunk

    def _walk(self, connections: dict[int, tuple[str, str, str]]) -> Iterator[tuple[int, int, bytes]]:
        """Yield connection, log time [ns] and bytes of each whole message, in the order of the file.

        Args:
            connections: topic, type and definition by number; filled here.
        """
        for fields, begin, end in _ros1_records(self._data, self._data.find(b"\n") + 1):
            if fields.get(b"op", b"")[:1] != b"\x05":
                continue
            packed, compression = self._data[begin:end], fields.get(b"compression", b"none")
            whole = len(packed) == end - begin
            chunk: bytes | None = packed
            if compression in (b"bz2", b"lz4"):
                chunk, sound = decompressed(packed, compression.decode())
                chunk = chunk if sound or not whole else None
            if chunk is None:
                self._note("a damaged part of the file is left out")
                continue
            self._unpacked.add(len(chunk), begin)
            for inner, at, stop in _ros1_records(chunk, 0):
                operation, number = inner.get(b"op", b"\0")[0], inner.get(b"conn", b"")
                if len(number) != 4 or stop > len(chunk):
                    continue
                key = int.from_bytes(number, "little")
                if operation == 7:
                    held = _ros1_fields(chunk, at, stop)
                    texts = (inner.get(b"topic", b""), held.get(b"type", b""), held.get(b"message_definition", b""))
                    topic, kind, definition = (text.decode(errors="replace") for text in texts)
                    connections.setdefault(key, (topic, kind, definition))
                elif operation == 2 and len(inner.get(b"time", b"")) == 8:
                    sec, nanosec = struct.unpack("<II", inner[b"time"])
                    yield key, sec * 10**9 + nanosec, chunk[at:stop]


def _ros1_records(data: bytes | mmap.mmap, at: int) -> Iterator[tuple[dict[bytes, bytes], int, int]]:
    """Yield fields, begin and end of the content of each record; the last one may end beyond the data."""
    while at + 8 <= len(data):
        (length,) = struct.unpack_from("<I", data, at)
        begin = at + 8 + length
        if begin > len(data):
            return
        (size,) = struct.unpack_from("<I", data, at + 4 + length)
        yield _ros1_fields(data, at + 4, at + 4 + length), begin, begin + size
        at = begin + size


def _ros1_fields(data: bytes | mmap.mmap, at: int, end: int) -> dict[bytes, bytes]:
    fields = {}
    while at + 4 <= end:
        (size,) = struct.unpack_from("<I", data, at)
        name, _, value = bytes(data[at + 4 : min(at + 4 + size, end)]).partition(b"=")
        fields[name] = value
        at += 4 + size
    return fields
