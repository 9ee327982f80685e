"""ROS 1 and ROS 2 bags."""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from tauext.data.importers.raw import BLOCK_ROWS, RawRecording, RawSignals, readable
from tauext.errors import RecordingError

# --- ROS messages to columns: JointState in bulk where all have one layout, any other type by walking its fields.


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


# --- What ROS 1 and ROS 2 bags have in common: which topics to read, and their messages as blocks of columns.


def chosen_topics(path: Path, connections: Iterable[Any], topics: Sequence[str]) -> tuple[str, ...]:
    """The topics named, or the only one of type JointState that has messages.

    Raises:
        RecordingError: a topic that is not there; none or several of that type; the message lists what there is.
    """
    there: dict[str, tuple[str, int]] = {}
    for connection in connections:
        count = there.get(connection.topic, ("", 0))[1]
        there[connection.topic] = (connection.msgtype, count + connection.msgcount)
    if not there or not any(count for _, count in there.values()):
        raise RecordingError(f"{path}: the bag is empty: it holds no messages")
    listed = ", ".join(f"{t} ({kind.replace('/msg/', '/')}, messages: {n})" for t, (kind, n) in sorted(there.items()))
    for topic in topics:
        if topic not in there:
            raise RecordingError(f"{path}: no topic '{topic}'; it holds {listed}")
        if not there[topic][1]:
            raise RecordingError(f"{path}: topic '{topic}' has no messages; the bag holds {listed}")
    if topics:
        return tuple(topics)
    found = [topic for topic, (kind, count) in there.items() if kind == JOINT_STATE and count]
    if not found:
        raise RecordingError(
            f"{path}: no topic of type sensor_msgs/JointState with messages; it holds {listed}. A trajectory is "
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
    clocks: dict[str, Clock],
    counts: Counter[str],
) -> Iterator[RawSignals]:
    """Blocks of the messages of each topic, in the order of the bag.

    Args:
        messages: connection, log time [ns], bytes.
        deserializer: a connection's function from bytes to a message.
        clocks: of the topics seen; filled.
    """
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
            clock = clocks.setdefault(connection.topic, Clock(counts))
            deserialize = deserializer(connection)
            if connection.msgtype == JOINT_STATE:
                for group, block in joint_states(connection.topic, raw, cdr, deserialize):
                    yield clock.stamped(block, log_ns[group])
            else:
                yield clock.stamped(any_messages(connection.topic, raw, deserialize), log_ns)


# --- ROS 1 bags.


MAGIC = b"#ROSBAG V"
BAG = ("a ROS 1 bag", (Exception,), "a bag that was not closed can be repaired: rosbag reindex")
"""What rosbags meets in damaged bytes is of many types: struct, assertion, decompressor, its own."""


def open_ros1(path: Path, topics: Sequence[str] = ()) -> list[RawRecording]:
    """A ROS 1 bag as one raw recording, a stream a topic.

    Raises:
        RecordingError: now or while it is read: damaged, empty, or without the requested topics.
    """
    from rosbags.rosbag1 import Reader

    with readable(path, *BAG), Reader(path) as reader:
        wanted = chosen_topics(path, reader.connections, topics)
    counts: Counter[str] = Counter()

    def blocks() -> Iterator[RawSignals]:
        with readable(path, *BAG), Reader(path) as reader:
            connections = [c for c in reader.connections if c.topic in wanted]
            clocks: dict[str, Clock] = {}
            yield from blocks_of(reader.messages(connections), False, _ros1_deserializer, clocks, counts)

    return [RawRecording(path.stem, path, "ROS 1 bag", blocks, counts=counts)]


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
    """A ROS 2 bag (folder or storage file) as one raw recording, a stream a topic.

    A folder whose metadata.yaml is missing or names files that are not there is read by its storage files. Messages
    without a definition in the bag are read by the standard one of their type.

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
    counts: Counter[str] = Counter()

    def blocks() -> Iterator[RawSignals]:
        clocks: dict[str, Clock] = {}
        for file in files:
            with _opened(file) as storage:
                messages = storage.messages([c for c in storage.connections if c.topic in wanted])
                yield from blocks_of(messages, True, _ros2_deserializer, clocks, counts)

    return [RawRecording(path.stem if path.is_file() else path.name, path, "ROS 2 bag", blocks, notes, counts)]


def _storage_files(path: Path) -> tuple[Sequence[Path | _Folder], list[str]]:
    if path.is_file():
        return [path], []
    found = sorted((p for p in path.iterdir() if p.suffix in SUFFIXES), key=_by_number)
    metadata = path / "metadata.yaml"
    if not metadata.is_file():
        if not found:
            raise RecordingError(f"{path}: it holds no metadata.yaml and no .db3 or .mcap file; it is no ROS 2 bag")
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
    """A bag's folder whose metadata.yaml is in order: rosbags reads it whole, compressed files included."""

    def __init__(self, path: Path):
        self.path = path

    def __str__(self) -> str:
        return str(self.path)


def _by_number(path: Path) -> tuple:
    """bag_2 before bag_10."""
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
    """The storage, open; the reader's own errors come out as RecordingError."""
    from rosbags.rosbag2.reader import DirectoryReader
    from rosbags.rosbag2.storage_mcap import McapReader
    from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader

    with readable(file, "a ROS 2 bag", (Exception,), REPAIR):
        if isinstance(file, _Folder):
            storage: Any = DirectoryReader(file.path)
        else:
            # rosbags goes by the suffix; a file is what it begins with.
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
    """From the bag's own definition; JointState, which never changed, and what has no definition by the standard."""
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
