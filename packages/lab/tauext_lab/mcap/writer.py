"""Write MCAP files, many messages of one length at a time.

The format is at https://mcap.dev/spec. Chunks are closed often, so readers recover a file whose writer was killed.
"""

from __future__ import annotations

import os
import struct
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from zlib import crc32

import numpy as np
import pyarrow as pa

from tauext.data.importers import mcap_file as op
from tauext.data.importers.mcap_file import MAGIC, MESSAGE_HEAD, RECORD

HEADER, MESSAGE_INDEX = 1, 7
HEAD = RECORD.size + MESSAGE_HEAD.size
"""Bytes of a message's record before its content."""


class McapWriter:
    """A new MCAP file. Messages are in memory until flush(), which writes one chunk with one call of the system.

    A call that fails raises OSError, and the file is cut back to its last whole chunk.
    """

    def __init__(self, path: Path, profile: str, library: str):
        """Raises FileExistsError where something has this name."""
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0), 0o666)
        self._end = 0
        self._schemas: dict[tuple[str, str], int] = {}
        self._definitions: list[bytes] = []
        self._sequence: dict[int, int] = {}
        """Number of the next message of each channel."""
        self._counts: Counter[int] = Counter()
        self._chunks: list[bytes] = []
        self._span: tuple[int, int] | None = None
        self._begin_chunk()
        self._write(MAGIC + record(HEADER, text(profile) + text(library)))

    def add_channel(self, topic: str, kind: str, definition: str, metadata: Mapping[str, str]) -> int:
        """Add a topic of ROS 2 messages in CDR; returns its number.

        Args:
            kind: type of the messages: `std_msgs/msg/String`.
            definition: in the format `ros2msg`, with the types that it uses.
            metadata: what readers show beside the topic.
        """
        new = b""
        schema = self._schemas.get((kind, definition), 0)
        if not schema:
            schema = self._schemas[kind, definition] = len(self._schemas) + 1
            body = struct.pack("<H", schema) + text(kind) + text("ros2msg") + text(definition)
            new = record(op.SCHEMA, body)
        number = len(self._sequence)
        held = b"".join(text(key) + text(value) for key, value in metadata.items())
        body = struct.pack("<HH", number, schema) + text(topic) + text("cdr") + struct.pack("<I", len(held)) + held
        new += record(op.CHANNEL, body)
        self._write(new)
        self._definitions.append(new)
        self._sequence[number] = 0
        return number

    def add(self, channel: int, t_ns: np.ndarray, messages: np.ndarray) -> None:
        """Add messages to the open chunk.

        Args:
            t_ns: (rows,), log time, [ns], at least 0.
            messages: (rows, bytes) uint8.
        """
        rows, size = messages.shape
        if not rows:
            return
        whole = np.empty((rows, HEAD + size), np.uint8)
        whole[:, : RECORD.size] = np.frombuffer(RECORD.pack(op.MESSAGE, MESSAGE_HEAD.size + size), np.uint8)
        heads = np.zeros(rows, [("channel", "<u2"), ("sequence", "<u4"), ("log", "<u8"), ("publish", "<u8")])
        heads["channel"], heads["log"], heads["publish"] = channel, t_ns, t_ns
        heads["sequence"] = (self._sequence[channel] + np.arange(rows)) & 0xFFFFFFFF
        whole[:, RECORD.size : HEAD] = heads.view(np.uint8).reshape(rows, -1)
        whole[:, HEAD:] = messages
        index = np.empty((rows, 2), "<u8")
        index[:, 0], index[:, 1] = t_ns, self._size + whole.shape[1] * np.arange(rows)
        self._index.setdefault(channel, []).append(index)
        self._parts.append(whole.tobytes())
        self._size += whole.size
        self._sequence[channel] += rows
        if self._size >= 1 << 20:  # before compression
            self.flush()

    def flush(self) -> None:
        """Compress and write the open chunk with its index, if it has messages."""
        if not self._parts:
            return
        records, indices = b"".join(self._parts), {key: np.concatenate(held) for key, held in self._index.items()}
        self._begin_chunk()
        packed = pa.compress(records, "zstd", asbytes=True)
        first = min(int(held[:, 0].min()) for held in indices.values())
        last = max(int(held[:, 0].max()) for held in indices.values())
        body = struct.pack("<QQQI", first, last, len(records), crc32(records)) + text("zstd")
        chunk = record(op.CHUNK, body + struct.pack("<Q", len(packed)) + packed)
        start, offsets, after = self._end, b"", b""
        for channel, held in indices.items():
            offsets += struct.pack("<HQ", channel, start + len(chunk) + len(after))
            after += record(MESSAGE_INDEX, struct.pack("<HI", channel, held.nbytes) + held.tobytes())
        self._write(chunk + after)
        self._counts.update({channel: len(held) for channel, held in indices.items()})
        body = struct.pack("<QQQQI", first, last, start, len(chunk), len(offsets)) + offsets
        sizes = struct.pack("<QQ", len(packed), len(records))
        self._chunks.append(record(op.CHUNK_INDEX, body + struct.pack("<Q", len(after)) + text("zstd") + sizes))
        was = self._span or (first, last)
        self._span = min(was[0], first), max(was[1], last)

    def close(self) -> None:
        """Write what is left, and the summary by which readers find a time without reading the file."""
        if self._file < 0:
            return
        try:
            self.flush()
            data_end = record(op.DATA_END, struct.pack("<I", 0))
            counts = b"".join(struct.pack("<HQ", *one) for one in self._counts.items())
            numbers = (sum(self._counts.values()), len(self._schemas), len(self._sequence), 0, 0, len(self._chunks))
            body = struct.pack("<QHIIIIQQ", *numbers, *(self._span or (0, 0))) + struct.pack("<I", len(counts)) + counts
            summary = b"".join(self._definitions) + record(op.STATISTICS, body) + b"".join(self._chunks)
            footer = record(op.FOOTER, struct.pack("<QQI", self._end + len(data_end), 0, 0))
            self._write(data_end + summary + footer + MAGIC)
        finally:
            os.close(self._file)
            self._file = -1

    def _begin_chunk(self) -> None:
        self._parts: list[bytes] = []
        self._index: dict[int, list[np.ndarray]] = {}
        self._size = 0

    def _write(self, content: bytes) -> None:
        left = memoryview(content)
        try:
            while left:
                left = left[os.write(self._file, left) :]
        except OSError:
            os.ftruncate(self._file, self._end)
            os.lseek(self._file, self._end, os.SEEK_SET)
            raise
        self._end += len(content)


def record(operation: int, body: bytes) -> bytes:
    return RECORD.pack(operation, len(body)) + body


def text(value: str) -> bytes:
    """A string, or bytes of a schema, with its length before it."""
    raw = value.encode()
    return struct.pack("<I", len(raw)) + raw
