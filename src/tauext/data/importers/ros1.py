"""ROS 1 bags."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from tauext.data.importers.raw import RawRecording, RawSignals
from tauext.data.importers.ros_messages import Clock
from tauext.data.importers.ros_topics import blocks_of, chosen_topics
from tauext.errors import RecordingError

MAGIC = b"#ROSBAG V"


def open_ros1(path: Path, topics: Sequence[str] = ()) -> list[RawRecording]:
    """A ROS 1 bag as one raw recording, a stream a topic.

    Raises:
        RecordingError: now or while it is read: damaged, empty, or without the topics asked for.
    """
    from rosbags.rosbag1 import Reader

    with _readable(path), Reader(path) as reader:
        wanted = chosen_topics(path, reader.connections, topics)
    counts: Counter[str] = Counter()

    def blocks() -> Iterator[RawSignals]:
        with _readable(path), Reader(path) as reader:
            connections = [c for c in reader.connections if c.topic in wanted]
            clocks: dict[str, Clock] = {}
            yield from blocks_of(reader.messages(connections), False, _deserializer, clocks, counts)

    return [RawRecording(path.stem, path, "ROS 1 bag", blocks, counts=counts)]


def _deserializer(connection: Any) -> Callable[[bytes], Any]:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
    return lambda raw: store.deserialize_ros1(raw, connection.msgtype)


class _readable:
    """The reader's own errors come out as RecordingError."""

    def __init__(self, path: Path):
        self._path = path

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type | None, error: BaseException | None, trace: object) -> None:
        # What rosbags meets in damaged bytes is of many types: struct, assertion, decompressor, its own.
        if isinstance(error, Exception) and not isinstance(error, RecordingError):
            cause = " ".join(str(error).split()) or type(error).__name__
            raise RecordingError(
                f"{self._path}: cannot be read as a ROS 1 bag ({cause}); "
                "a bag that was not closed can be repaired: rosbag reindex"
            ) from error
