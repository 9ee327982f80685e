"""A bag's file of any kind: its channels, and its messages in order of log time."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import pyarrow as pa

ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
MOST_BYTES = 1 << 28
"""Largest size of a chunk or a message, unpacked, [bytes]; recorders write chunks of a hundredth of it."""


@dataclass(frozen=True, eq=False)
class Channel:
    """Messages of one topic with one type and encoding."""

    topic: str
    msgtype: str
    """As package/msg/Type for ROS, else as in the file."""
    encoding: str
    """Of the messages: cdr, ros1, json."""
    schema: str
    """Kind of the definition: ros2msg, ros2idl, ros1msg, jsonschema; empty: there is none."""
    definition: str
    count: int
    profile: str = ""
    """Of an MCAP file."""


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
    """Decompress zstd or lz4 as far as the data is whole, and to MOST_BYTES; also returns whether all of it is."""
    stream, parts, size = pa.CompressedInputStream(pa.BufferReader(data), codec), list[bytes](), 0
    try:
        while (part := stream.read(1 << 16)) and (size := size + len(part)) <= MOST_BYTES:
            parts.append(part)
    except OSError:
        return b"".join(parts), False
    return b"".join(parts), size <= MOST_BYTES
