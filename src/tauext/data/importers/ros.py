"""ROS 1 and ROS 2 bags."""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from tauext.data.importers.raw import BLOCK_ROWS, RawRecording, RawSignals, readable
from tauext.errors import RecordingError

# --- ROS messages to columns: JointState in bulk if all have one layout, other types field by field.


JOINT_STATE = "sensor_msgs/msg/JointState"
ARRAYS = ("position", "velocity", "effort")
Deserialize = Callable[[bytes], Any]


@dataclass(frozen=True)
class Layout:
    """Positions of the numbers in the bytes of a JointState message."""

    names: tuple[str, ...]
    stamp: int
    fixed: tuple[slice, ...]
    """Bytes common to all messages of this layout: names and array lengths."""
    arrays: dict[str, slice]


def layout_of(raw: bytes, cdr: bool) -> Layout | None:
    """Layout of a JointState message, CDR (little-endian) or ROS 1; None: not determinable.

    CDR aligns each number to its size, counted after the four bytes of encapsulation; ROS 1 does not align.
    """
    if cdr and raw[:2] != b"\x00\x01":
        return None
    try:
        at = stamp = 4
        at += 8  # the stamp, after the encapsulation or ROS 1's sequence number
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
    """Convert JointState messages to columns `position[joint]`, `velocity[joint]`, `effort[joint]`, with rows in `raw`.

    Messages of one layout are decoded together from one view of their bytes, others one by one. Messages with different
    joints (an arm and its gripper on one topic) give separate blocks. Times are the headers'.

    Raises:
        RecordingError: an array is neither empty nor as long as the names.
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
    """Convert messages of any type: each number is a column `field.field` or `field.field[index]`; text is left out.

    Times are the headers', 0 without one.

    Raises:
        RecordingError: the messages do not all have the same columns.
    """
    rows: list[list[float]] = []
    names: tuple[str, ...] = ()
    t_ns = []
    for message in map(deserialize, raw):
        numbers = dict(_numbers(message, ""))
        if rows and tuple(numbers) != names:
            raise RecordingError(f"topic {topic}: its messages have arrays of changing length; they must stay the same")
        names = tuple(numbers)
        rows.append(list(numbers.values()))
        t_ns.append(stamp_ns(message))
    return RawSignals(topic, names, np.array(t_ns, np.int64), np.array(rows, np.float64).reshape(len(raw), len(names)))


def stamp_ns(message: Any) -> int:
    """Stamp of the message's header, [ns]; 0 without one."""
    header = getattr(message, "header", None)
    return 0 if header is None else header.stamp.sec * 10**9 + header.stamp.nanosec


class Clock:
    """Clock of a topic: header stamps, or log times if the first messages' stamps are all zero or all equal."""

    def __init__(self, raw: RawRecording):
        self._raw = raw
        self._by_log: bool | None = None
        self._messages = 0

    def stamped(self, block: RawSignals, log_ns: np.ndarray, rows: np.ndarray) -> RawSignals:
        """Return the block with this clock's times; messages without a stamp among stamped ones are left out.

        A stamp of zero that leads the block is kept: recordings of simulated time begin there.

        Args:
            log_ns: log time of each message, [ns].
            rows: place of each message in its group of messages of the topic.
        """
        assert block.t_ns is not None
        rows = rows + self._messages
        if self._by_log is None:
            # A single message may have the valid stamp 0.
            none = not block.t_ns.any() and (len(log_ns) > 1 or log_ns[0] > 0)
            self._by_log = none or (len(log_ns) > 1 and bool((block.t_ns == block.t_ns[0]).all()))
        if self._by_log:
            why = "a stamp of zero" if not block.t_ns.any() else "one and the same stamp"
            self._raw.counts[f"{block.stream}: messages with {why}, timed by the bag's log"] += len(log_ns)
            return replace(block, t_ns=log_ns, rows=rows)
        stamped = block.t_ns != 0
        stamped[0] = True
        if not stamped.all():
            first = self._raw.place(int(rows[np.argmin(stamped)]))
            self._raw.lost.add(
                "without a stamp among stamped ones", int((~stamped).sum()), f"{first} of {block.stream}"
            )
        return RawSignals(
            block.stream, block.names, block.t_ns[stamped], block.columns[stamped], log_ns[stamped], rows[stamped]
        )

    def passed(self, messages: int) -> None:
        """Count the messages of a group once all of its blocks are stamped."""
        self._messages += messages


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


CLOCKS = ("header", "log")
MESSAGE = ("message", 1)

# --- Common to ROS 1 and ROS 2 bags: choice of topics, and messages as blocks of columns.


def chosen_topics(path: Path, connections: Iterable[Any], topics: Sequence[str]) -> tuple[str, ...]:
    """Return the topics named, or the only one of type JointState with messages.

    Raises:
        RecordingError: a topic is missing, or none or several have that type; the message lists the topics.
    """
    there: dict[str, tuple[str, int]] = {}
    for connection in connections:
        count = there.get(connection.topic, ("", 0))[1]
        there[connection.topic] = (connection.msgtype, count + connection.msgcount)
    if not there or not any(count for _, count in there.values()):
        raise RecordingError(f"{path}: the bag is empty: it has no messages")
    listed = ", ".join(f"{t} ({kind.replace('/msg/', '/')}, messages: {n})" for t, (kind, n) in sorted(there.items()))
    for topic in topics:
        if topic not in there:
            raise RecordingError(f"{path}: no topic '{topic}'; it has {listed}")
        if not there[topic][1]:
            raise RecordingError(f"{path}: topic '{topic}' has no messages; the bag has {listed}")
    if topics:
        return tuple(topics)
    found = [topic for topic, (kind, count) in there.items() if kind == JOINT_STATE and count]
    if not found:
        raise RecordingError(
            f"{path}: no topic of type sensor_msgs/JointState with messages; it has {listed}. A trajectory is "
            "planned motion, not measured; another topic with measured signals can be named in arm.toml (topic = ...)"
        )
    if len(found) > 1:
        raise RecordingError(
            f"{path}: {len(found)} topics are of type sensor_msgs/JointState: {', '.join(sorted(found))}; "
            "name the one of each signal in arm.toml (topic = ...)"
        )
    return tuple(found)


def blocks_of(
    messages: Iterator[tuple[Any, int, bytes]],
    cdr: bool,
    deserializer: Callable[[Any], Callable[[bytes], Any]],
    recording: RawRecording,
) -> Iterator[RawSignals]:
    """Yield blocks of each topic's messages, in the order of the bag.

    Args:
        messages: connection, log time [ns] and bytes of each message.
        deserializer: returns a connection's function from bytes to a message.
        recording: keeps the counts.
    """
    clocks: dict[str, Clock] = {}
    while taken := list(islice(messages, BLOCK_ROWS)):
        by_connection: dict[int, list[int]] = {}
        connections = {}
        for k, (connection, _, _) in enumerate(taken):
            by_connection.setdefault(id(connection), []).append(k)
            connections[id(connection)] = connection
        for key, rows in by_connection.items():
            connection = connections[key]
            raw = [bytes(taken[k][2]) for k in rows]
            log_ns = np.array([taken[k][1] for k in rows], np.int64)
            clock = clocks.setdefault(connection.topic, Clock(recording))
            deserialize = deserializer(connection)
            if connection.msgtype == JOINT_STATE:
                for group, block in joint_states(connection.topic, raw, cdr, deserialize):
                    yield clock.stamped(block, log_ns[group], group)
            else:
                block = any_messages(connection.topic, raw, deserialize)
                yield clock.stamped(block, log_ns, np.arange(len(rows)))
            clock.passed(len(rows))


# --- ROS 1 bags.


MAGIC = b"#ROSBAG V"
BAG = ("a ROS 1 bag", (Exception,), "a bag that was not closed can be repaired: rosbag reindex")
"""rosbags raises many types on damaged bytes: struct, assertion, decompressor, its own."""


def open_ros1(path: Path, topics: Sequence[str] = ()) -> list[RawRecording]:
    """Open a ROS 1 bag as one raw recording, one stream a topic.

    Raises:
        RecordingError: now or while it is read: damaged, empty, or without the requested topics.
    """
    from rosbags.rosbag1 import Reader

    with readable(path, *BAG), Reader(path) as reader:
        wanted = chosen_topics(path, reader.connections, topics)

    def blocks() -> Iterator[RawSignals]:
        with readable(path, *BAG), Reader(path) as reader:
            connections = [c for c in reader.connections if c.topic in wanted]
            yield from blocks_of(reader.messages(connections), False, _ros1_deserializer, recording)

    recording = RawRecording(path.stem, path, "ROS 1 bag", blocks, clocks=CLOCKS, row_word=MESSAGE)
    return [recording]


def _ros1_deserializer(connection: Any) -> Callable[[bytes], Any]:
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
    return lambda raw: store.deserialize_ros1(raw, connection.msgtype)


# --- ROS 2 bags: sqlite3 and MCAP files, alone or in the folder of a bag.


SQLITE_MAGIC, MCAP_MAGIC = b"SQLite format 3\0", b"\x89MCAP0\r\n"
SUFFIXES = (".db3", ".mcap")
REPAIR = "a file that was not closed can be repaired: `mcap recover`, or for sqlite3 `.recover`"


def open_ros2(path: Path, topics: Sequence[str] = ()) -> list[RawRecording]:
    """Open a ROS 2 bag (folder or storage file) as one raw recording, one stream a topic.

    Storage files are read directly if metadata.yaml is missing or names missing files. Messages without a definition in
    the bag use the standard one of their type.

    Raises:
        RecordingError: now or while it is read: damaged, empty, or without the requested topics.
    """
    files, notes = _storage_files(path)
    connections = []
    for file in files:
        with _opened(file) as storage:
            connections += storage.connections
    wanted = chosen_topics(path, connections, topics)
    if any(c.topic in wanted and not c.msgdef.data for c in connections):
        notes.append("no message definitions in the bag: read by the standard ones")

    def messages() -> Iterator[tuple[Any, int, bytes]]:
        for file in files:
            with _opened(file) as storage:
                yield from storage.messages([c for c in storage.connections if c.topic in wanted])

    def blocks() -> Iterator[RawSignals]:
        yield from blocks_of(messages(), True, _ros2_deserializer, recording)

    name = path.stem if path.is_file() else path.name
    recording = RawRecording(name, path, "ROS 2 bag", blocks, notes, clocks=CLOCKS, row_word=MESSAGE)
    return [recording]


def _storage_files(path: Path) -> tuple[Sequence[Path | _Folder], list[str]]:
    if path.is_file():
        return [path], []
    found = sorted((p for p in path.iterdir() if p.suffix in SUFFIXES), key=_by_number)
    metadata = path / "metadata.yaml"
    if not metadata.is_file():
        if not found:
            raise RecordingError(f"{path}: it has no metadata.yaml and no .db3 or .mcap file; it is no ROS 2 bag")
        return found, [f"no metadata.yaml: read {', '.join(p.name for p in found)}"]
    try:
        named = _named_files(metadata)
    except RecordingError:
        if not found:
            raise
        return found, [f"metadata.yaml cannot be read: read {', '.join(p.name for p in found)}"]
    missing = [name for name in named if not (path / name).is_file()]
    if not missing:
        return [_Folder(path)], []
    if not found:
        raise RecordingError(
            f"{path}: its metadata.yaml names {', '.join(missing)}, and no .db3 or .mcap file is there"
        )
    return found, [f"metadata.yaml names {', '.join(missing)}, not there: read {', '.join(p.name for p in found)}"]


class _Folder:
    """A bag's folder with valid metadata.yaml; rosbags reads it whole, including compressed files."""

    def __init__(self, path: Path):
        self.path = path

    def __str__(self) -> str:
        return str(self.path)


def _by_number(path: Path) -> tuple:
    """Sort key that puts bag_2 before bag_10."""
    return tuple(int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name))


def _named_files(metadata: Path) -> list[str]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        content = YAML(typ="safe").load(metadata.read_text())
        return [Path(name).name for name in content["rosbag2_bagfile_information"]["relative_file_paths"]]
    except (YAMLError, OSError, KeyError, TypeError, UnicodeDecodeError) as error:
        raise RecordingError(f"{metadata}: not the metadata of a ROS 2 bag ({type(error).__name__})") from error


@contextmanager
def _opened(file: Path | _Folder) -> Iterator[Any]:
    """Open the storage; the reader's errors become RecordingError."""
    from rosbags.rosbag2.reader import DirectoryReader
    from rosbags.rosbag2.storage_mcap import McapReader
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    with readable(file, "a ROS 2 bag", (Exception,), REPAIR):
        if isinstance(file, _Folder):
            storage: Any = DirectoryReader(file.path)
        else:
            # rosbags decides by the suffix; use the first bytes instead.
            with file.open("rb") as raw:
                begin = raw.read(len(SQLITE_MAGIC))
            storage = McapReader(file) if begin.startswith(MCAP_MAGIC) else Sqlite3Reader(file)
        storage.open()
        with closing(storage):
            yield storage


@cache
def _standard_types() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def _ros2_deserializer(connection: Any) -> Callable[[bytes], Any]:
    """Deserializer from the bag's definition; the standard one for JointState and types without a definition."""
    from rosbags.interfaces import MessageDefinitionFormat
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    kind, definition = connection.msgtype, connection.msgdef
    store = _standard_types()
    if kind != JOINT_STATE and definition.data:
        store = get_typestore(Stores.EMPTY)
        by_idl = definition.format == MessageDefinitionFormat.IDL
        store.register(get_types_from_idl(definition.data) if by_idl else get_types_from_msg(definition.data, kind))
    if kind not in store.fielddefs:
        raise RecordingError(
            f"topic {connection.topic}: its type {kind} has no definition, in the bag or in ROS itself"
        )
    return lambda raw: store.deserialize_cdr(raw, kind)
