"""MCAP files of any profile, also those that were not closed or are damaged.

The format is at https://mcap.dev/spec. The packages that read it either refuse a file without its end, or take several
times as long for small messages; a walk over the records needs no more code than their use.
"""

from __future__ import annotations

import mmap
import struct
from bisect import bisect_right
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from zlib import crc32

import pyarrow as pa

from tauext.data.importers.bag import Channel, CountLost, decompressed, ros_type
from tauext.errors import RecordingError
from tauext.files import unpacking
from tauext.files.preflight import in_words
from tauext.files.unpacking import Unpacked

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, CHUNK_INDEX, STATISTICS, DATA_END = 2, 3, 4, 5, 6, 8, 11, 15
RECORD = struct.Struct("<BQ")
"""Operation and length of a record."""
MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence number, log time, publish time."""
MOST_WAITING = 4_000_000
"""Messages of chunks that overlap in time: an hour of a thousand a second."""


class McapFile:
    """An open MCAP file."""

    def __init__(self, path: Path):
        self.notes: list[str] = []
        self._path, self._file = path, path.open("rb")
        self._data = mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ)
        self._unpacked = Unpacked(path)
        self._begin()
        if not self._read_summary():
            self._begin()
            self._scan()
        self.channels = [self._channel(number) for number in self._channels]

    def close(self) -> None:
        """Close the file."""
        self._data.close()
        self._file.close()

    def _begin(self) -> None:
        self._profile = ""
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self._channels: dict[int, tuple[int, str, str]] = {}
        self._counts: Counter[int] = Counter()
        self._chunks: list[tuple[int, int, frozenset[int]]] = []
        """First log time, position of the record's content, and channels; empty: unknown."""
        with suppress(struct.error, UnicodeDecodeError):
            self._profile = _text(self._data, len(MAGIC) + RECORD.size)[0]

    def _channel(self, number: int) -> Channel:
        schema, topic, encoding = self._channels[number]
        name, kind, definition = self._schemas.get(schema, ("", "", ""))
        return Channel(topic, ros_type(name), encoding, kind, definition, self._counts[number], self._profile)

    # --- What the file holds: by its summary, else by reading all of it.

    def _read_summary(self) -> bool:
        """Whether the summary at the end is there and complete."""
        data, end = self._data, len(self._data) - len(MAGIC)
        footer = end - RECORD.size - 20
        if footer < 0 or data[end:] != MAGIC:
            return False
        operation, length = RECORD.unpack_from(data, footer)
        (start,) = struct.unpack_from("<Q", data, footer + RECORD.size)
        if (operation, length) != (FOOTER, 20) or not start:
            return False
        messages, there = None, set[int]()
        try:
            for operation, begin, _ in _records(data, start, end):
                if operation in (SCHEMA, CHANNEL):
                    self._define(data, operation, begin)
                elif operation == CHUNK_INDEX:
                    first_ns, _, at, _, size = struct.unpack_from("<QQQQI", data, begin)
                    if at >= start or data[at] != CHUNK:
                        return False
                    held = struct.iter_unpack("<HQ", data[begin + 36 : begin + 36 + size])
                    if at in there:
                        return False  # the same messages twice
                    there.add(at)
                    self._chunks.append((first_ns, at + RECORD.size, frozenset(number for number, _ in held)))
                elif operation == STATISTICS:
                    (messages,) = struct.unpack_from("<Q", data, begin)
                    (size,) = struct.unpack_from("<I", data, begin + 42)
                    self._counts.update(dict(struct.iter_unpack("<HQ", data[begin + 46 : begin + 46 + size])))
        except (struct.error, UnicodeDecodeError):
            return False
        known = all(schema in self._schemas or not schema for schema, _, _ in self._channels.values())
        return messages == sum(self._counts.values()) and known and set(self._counts) <= set(self._channels)

    def _scan(self) -> None:
        """Read all records for the channels and the number of their messages."""
        closed = False
        for operation, begin, end in _records(self._data, len(MAGIC), len(self._data)):
            if operation == DATA_END:
                closed = True  # definitions may follow once more, which helps where the first ones are damaged
            elif operation == FOOTER:
                closed = True
                break
            elif operation == CHUNK:
                found = Counter[int]()
                chunk = self._chunk(begin)
                for inner, at, stop in _records(chunk, 0, len(chunk)):
                    if stop <= len(chunk):
                        self._count(chunk, inner, at, found)
                try:
                    (first_ns,) = struct.unpack_from("<Q", self._data, begin)
                except struct.error:
                    continue
                self._chunks.append((first_ns, begin, frozenset(found)))
                self._counts.update(found)
            elif end <= len(self._data):
                self._count(self._data, operation, begin, self._counts)
        if not closed:
            self._note("the file was not closed, or is cut off: read up to its last whole message")
        self._counts = Counter({number: count for number, count in self._counts.items() if number in self._channels})

    def _count(self, data: bytes | mmap.mmap, operation: int, begin: int, found: Counter[int]) -> None:
        if operation == MESSAGE and begin + MESSAGE_HEAD.size <= len(data):
            found[struct.unpack_from("<H", data, begin)[0]] += 1
        elif operation in (SCHEMA, CHANNEL):
            try:
                self._define(data, operation, begin)
            except (struct.error, UnicodeDecodeError):
                self._note(f"a definition that is damaged is left out, near byte {begin}")

    def _define(self, data: bytes | mmap.mmap, operation: int, begin: int) -> None:
        (number,) = struct.unpack_from("<H", data, begin)
        if operation == SCHEMA:
            name, at = _text(data, begin + 2)
            kind, at = _text(data, at)
            (size,) = struct.unpack_from("<I", data, at)
            # A binary definition, as protobuf's, is not used.
            self._schemas[number] = (name, kind, bytes(data[at + 4 : at + 4 + size]).decode(errors="replace"))
        else:
            (schema,) = struct.unpack_from("<H", data, begin + 2)
            topic, at = _text(data, begin + 4)
            self._channels[number] = (schema, topic, _text(data, at)[0])

    def _note(self, note: str) -> None:
        if note not in self.notes:
            self.notes.append(note)

    # --- Messages.

    def messages(self, wanted: Sequence[Channel], lost: CountLost) -> Iterator[tuple[Channel, int, bytes]]:
        """Yield channel, log time [ns] and bytes of each message, in order of log time; without chunks, of the file."""
        channels = {number: one for number, one in zip(self._channels, self.channels, strict=True) if one in wanted}
        missing = sum(self._counts[number] for number in channels)
        if self._chunks:
            waiting: list[tuple[int, Channel, bytes]] = []
            for first_ns, begin, held in sorted(self._chunks, key=lambda chunk: chunk[:2]):
                if held and not held & channels.keys():
                    continue
                ready = bisect_right(waiting, first_ns, key=lambda message: message[0])
                yield from ((channel, at, raw) for at, channel, raw in waiting[:ready])
                missing -= ready
                waiting = waiting[ready:] + _taken(self._chunk(begin), channels)
                waiting.sort(key=lambda message: message[0])
                if len(waiting) > MOST_WAITING:
                    raise RecordingError(
                        f"{self._path}: more than {MOST_WAITING:,} messages lie in parts that begin at the same time; "
                        "write it again in the order of time"
                    )
            yield from ((channel, at, raw) for at, channel, raw in waiting)
            missing -= len(waiting)
        else:
            for operation, begin, end in _records(self._data, len(MAGIC), len(self._data)):
                if operation == MESSAGE and begin + MESSAGE_HEAD.size <= end <= len(self._data):
                    number, _, log_ns, _ = MESSAGE_HEAD.unpack_from(self._data, begin)
                    if number in channels:
                        missing -= 1
                        yield channels[number], log_ns, self._data[begin + MESSAGE_HEAD.size : end]
        if missing > 0:
            lost("counted by the file, but not in it or in a damaged part", missing, "unknown")

    def _chunk(self, begin: int) -> bytes:
        """Records of a chunk; of one that is cut off, those before the cut; none of one that is damaged."""
        try:
            _, _, size, crc = struct.unpack_from("<QQQI", self._data, begin)
            compression, at = _text(self._data, begin + 28)
            (length,) = struct.unpack_from("<Q", self._data, at)
        except (struct.error, UnicodeDecodeError):
            return b""
        at += 8
        if size > unpacking.LEAST:
            self._note(f"a part that states {in_words(size)} is left out: {in_words(unpacking.LEAST)} are the most")
            return b""
        self._unpacked.add(size, begin)
        packed = self._data[at : at + length]
        whole = len(packed) == length
        if compression and compression not in ("zstd", "lz4"):
            self._note(f"a part compressed by '{compression}' is left out: only zstd and lz4 are read")
            return b""
        records = packed
        if compression and not whole:
            records = decompressed(packed, compression)[0]
        elif compression:
            try:
                records = pa.decompress(packed, size, compression, asbytes=True)
            except (OSError, ValueError, MemoryError, OverflowError):
                records = b""
        if whole and (len(records) != size or (crc and crc32(records) != crc)):
            self._note(f"a damaged part of the file is left out, near byte {begin}")
            return b""
        return records


def _records(data: bytes | mmap.mmap, at: int, end: int) -> Iterator[tuple[int, int, int]]:
    """Yield operation, begin and end of each record's content; the last one may end beyond the data."""
    while at + RECORD.size <= end:
        operation, length = RECORD.unpack_from(data, at)
        at += RECORD.size
        yield operation, at, at + length
        at += length


def _taken(chunk: bytes, channels: dict[int, Channel]) -> list[tuple[int, Channel, bytes]]:
    """Log time, channel and bytes of a chunk's messages on these channels."""
    taken = []
    for operation, begin, end in _records(chunk, 0, len(chunk)):
        if operation == MESSAGE and begin + MESSAGE_HEAD.size <= end <= len(chunk):
            number, _, log_ns, _ = MESSAGE_HEAD.unpack_from(chunk, begin)
            if number in channels:
                taken.append((log_ns, channels[number], chunk[begin + MESSAGE_HEAD.size : end]))
    return taken


def _text(data: bytes | mmap.mmap, at: int) -> tuple[str, int]:
    (size,) = struct.unpack_from("<I", data, at)
    if at + 4 + size > len(data):
        raise struct.error("text beyond the end")
    return bytes(data[at + 4 : at + 4 + size]).decode(), at + 4 + size
