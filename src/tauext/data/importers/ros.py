"""ROS 1 and ROS 2 bags, and MCAP files of other recorders."""

from __future__ import annotations

import json
import re
import shutil
import struct
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from functools import cache
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa

from tauext.data.importers import bag, mcap_file
from tauext.data.importers.bag import ZSTD_MAGIC, BagFile, Channel, decompressed
from tauext.data.importers.raw import BLOCK_ROWS, RawRecording, RawSignals
from tauext.errors import RecordingError
from tauext.files.preflight import in_words
from tauext.files.unpacking import Unpacked


@cache
def standard_types(ros1: bool = False) -> Any:
    """Types of ROS 2 Humble or ROS 1 Noetic, as rosbags has them."""
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)


# --- Messages to columns: JointState in bulk where messages have one layout, all others field by field.


JOINT_STATE = "sensor_msgs/msg/JointState"
ARRAYS = ("position", "velocity", "effort")


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
    sound = at == len(raw) and all(names) and len(set(names)) == len(names)
    return Layout(tuple(names), stamp, tuple(fixed), arrays) if sound else None


class Messages:
    """Converts the messages of one channel to blocks of columns, and counts those that cannot be read.

    A block has the messages of one layout: an arm and its gripper on one topic give separate blocks. Times are the
    headers', 0 without one.
    """

    def __init__(self, channel: Channel, recording: RawRecording):
        self._channel, self._recording = channel, recording
        self._deserialize = deserializer(channel)
        self._bulk = channel.msgtype == JOINT_STATE and channel.encoding in ("cdr", "ros1")
        self.read = 0
        """Messages that became a row, so far."""

    def blocks(self, raw: Sequence[bytes], first: int) -> Iterator[tuple[np.ndarray, RawSignals]]:
        """Yield the blocks of these messages, with their positions in `raw`.

        Args:
            first: number of the first of the messages in its topic, from 0.
        """
        one_by_one = list(range(len(raw)))
        if self._bulk:
            by_length: dict[int, list[int]] = {}
            for k, message in enumerate(raw):
                by_length.setdefault(len(message), []).append(k)
            one_by_one = []
            for group in by_length.values():
                layout = layout_of(raw[group[0]], self._channel.encoding == "cdr")
                if layout is None or (layout.names and not layout.arrays):
                    one_by_one += group
                    continue
                rows = np.frombuffer(b"".join([raw[k] for k in group]), np.uint8).reshape(len(group), -1)
                same = np.ones(len(group), bool)
                for part in layout.fixed:
                    same &= (rows[:, part] == rows[0, part]).all(axis=1)
                positions = np.array(group)
                one_by_one += positions[~same].tolist()
                self.read += int(same.sum())
                yield positions[same], _in_bulk(self._channel.topic, rows if same.all() else rows[same], layout)
        if one_by_one:
            yield from self._one_by_one(raw, sorted(one_by_one), first)

    def _one_by_one(
        self, raw: Sequence[bytes], positions: Sequence[int], first: int
    ) -> Iterator[tuple[np.ndarray, RawSignals]]:
        topic, recording = self._channel.topic, self._recording
        by_names: dict[tuple[str, ...], list[tuple[int, list[float], int]]] = {}
        for k in positions:
            at = f"{recording.position(first + k)} of {topic}"
            try:
                message = self._deserialize(raw[k])
                numbers = self._columns(message, at)
                t_ns = stamp_ns(message)
            except Exception:  # rosbags raises many types on damaged bytes
                recording.lost.add(f"cannot be decoded as {self._channel.msgtype or self._channel.encoding}", 1, at)
                continue
            if numbers or not getattr(message, "name", True):  # an empty JointState is of no joint
                by_names.setdefault(tuple(numbers), []).append((k, list(numbers.values()), t_ns))
            else:
                recording.lost.add("without numbers", 1, at)
        for names, held in by_names.items():
            rows, values, stamps = zip(*held, strict=True)
            self.read += len(rows)
            yield np.array(rows), RawSignals(topic, names, np.array(stamps, np.int64), np.array(values, np.float64))

    def _columns(self, message: Any, at: str) -> dict[str, float]:
        """Numbers of one message by column: `array[joint]` where joints are named, else `field.field[index]`."""
        left_out: list[str] = []
        found: dict[str, float] = {}
        if self._channel.msgtype == JOINT_STATE:
            names = list(getattr(message, "name", ()))
            for array in ARRAYS:
                values = getattr(message, array, ())
                if names and len(values) not in (0, len(names)):
                    left_out.append(f"{array} has {len(values)} values for {len(names)} joints")
                    continue
                found |= _by_joint(array, names or list(map(str, range(len(values)))), values)
            odd = [name for name in dict.fromkeys(names) if not name or names.count(name) > 1]
            for name in odd:
                found = {column: value for column, value in found.items() if not column.endswith(f"[{name}]")}
                left_out.append(f"joint '{name}' is named {names.count(name)} times" if name else "a joint has no name")
        else:
            found = dict(_numbers(message, ""))
        for what in left_out:
            note = f"{self._channel.topic}: {what} in some messages, left out there"
            if not any(one.startswith(note) for one in self._recording.notes):
                self._recording.notes.append(f"{note}, first {at.removesuffix(f' of {self._channel.topic}')}")
        return found


def stamp_ns(message: Any) -> int:
    """Stamp of the message's header, [ns]; 0 without one. JSON messages may have it as `timestamp` or `stamp`."""
    header = getattr(message, "header", None)
    stamp = getattr(header, "stamp", None)
    if stamp is None and isinstance(message, SimpleNamespace):
        stamp = getattr(message, "timestamp", getattr(message, "stamp", None))
    for sec, nanosec in (("sec", "nanosec"), ("sec", "nsec"), ("secs", "nsecs")):
        if hasattr(stamp, nanosec):
            return int(getattr(stamp, sec)) * 10**9 + int(getattr(stamp, nanosec))
    return 0


class Clock:
    """Clock of a topic: header stamps, or log times if the first messages' stamps are all zero or all equal."""

    def __init__(self, raw: RawRecording):
        self._raw, self._by_log, self._decided = raw, "", False
        self.messages = 0
        """Number of messages so far."""

    def stamped(self, blocks: Sequence[tuple[np.ndarray, RawSignals]], log_ns: np.ndarray) -> Iterator[RawSignals]:
        """Yield the blocks with this clock's times; messages without a stamp among stamped ones are left out.

        A first stamp of zero is kept where the next ones are near: simulated time begins there.

        Args:
            blocks: blocks of messages that follow those before, with the position of each message in them.
            log_ns: log time of each message, [ns].
        """
        held = [block.t_ns for _, block in blocks if block.t_ns is not None]
        stamps = np.concatenate(held) if held else np.zeros(0, np.int64)
        if not self._decided and len(stamps):
            self._decided = True
            # A single message may have the valid stamp 0.
            if len(stamps) > 1 and (stamps == stamps[0]).all():
                self._by_log = "one and the same stamp"
            if not stamps.any() and (len(stamps) > 1 or log_ns[0] > 0):
                self._by_log = "a stamp of zero"
        near_ns = 10**10  # before that, a clock began at zero
        begins_at_zero = self.messages == 0 and (not stamps.any() or stamps[stamps != 0].min(initial=near_ns) < near_ns)
        for positions, block in blocks:
            assert block.t_ns is not None
            rows = positions + self.messages
            if self._by_log:
                self._raw.counts[f"{block.stream}: messages with {self._by_log}, timed by the bag's log"] += len(rows)
                yield replace(block, t_ns=log_ns[positions], rows=rows)
                continue
            stamped = (block.t_ns != 0) | ((rows == 0) & begins_at_zero)
            if not stamped.all():
                first = f"{self._raw.position(int(rows[np.argmin(stamped)]))} of {block.stream}"
                self._raw.lost.add("without a stamp among stamped ones", int((~stamped).sum()), first)
                positions, rows = positions[stamped], rows[stamped]
                block = replace(block, t_ns=block.t_ns[stamped], columns=block.columns[stamped])
            if len(rows):
                yield replace(block, other_ns=log_ns[positions], rows=rows)
        self.messages += len(log_ns)


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


def _numbers(value: Any, name: str, joints: Sequence[str] = ()) -> Iterator[tuple[str, float]]:
    """Numbers of a field and of those within it, each with its column; texts are left out.

    Args:
        joints: names of joints beside the field; arrays of as many elements are theirs.
    """
    if value is None:
        yield name, np.nan  # JSON has no other missing number
    elif isinstance(value, bool | int | float | np.number):
        yield name, float(value)
    elif isinstance(value, np.ndarray | list):
        elements = value.ravel().tolist() if isinstance(value, np.ndarray) else value
        labels = joints if joints and len(elements) == len(joints) else range(len(elements))
        for element, label in zip(elements, labels, strict=True):
            if isinstance(element, bool | int | float):
                yield f"{name}[{label}]", float(element)
                continue
            held = _held(element)
            joint = label if joints and isinstance(label, str) else held.get("name")
            if held and isinstance(joint, str) and joint:  # values of one joint: each is an array's element
                kinds, values = held.get("interface_names", ()), held.get("values", ())
                pairs = zip(kinds, values, strict=True) if kinds and len(kinds) == len(values) else held.items()
                for kind, number in pairs:
                    yield from ((f"{part}[{joint}]", one) for part, one in _numbers(number, str(kind)))
            else:
                yield from _numbers(element, f"{name}[{label}]", joints)
    else:
        held = _held(value)
        for names in (held[key] for key in ("name", "names", "joint_names", "joint_name") if key in held):
            if isinstance(names, list) and names and all(isinstance(one, str) and one for one in names):
                joints = names if len(set(names)) == len(names) else ()
        for field, inner in held.items():
            yield from _numbers(inner, f"{name}.{field}" if name else field, joints)


def _held(value: Any) -> dict[str, Any]:
    """Fields of a message within a message; empty: it is none."""
    is_json = isinstance(value, SimpleNamespace)
    fields: Iterable[str] = vars(value) if is_json else getattr(value, "__dataclass_fields__", ())
    left_out = ("header", "timestamp", "stamp") if is_json else ("header", "__msgtype__")
    return {field: getattr(value, field) for field in fields if field not in left_out}


def _by_joint(array: str, joints: Sequence[str], values: Any) -> dict[str, float]:
    return dict(zip((f"{array}[{joint}]" for joint in joints), np.array(values, np.float64).tolist(), strict=False))


# --- Choice of topics, and messages as blocks of columns.


JOINTS = ("JointState", "DynamicJointState", "JointStates", "FrankaRobotState", "FrankaState")
"""Types with the measured state of an arm's joints, without the package; the first one in the file is read."""


def chosen_topics(path: Path, channels: Iterable[Channel], topics: Sequence[str]) -> tuple[str, ...]:
    """Return the topics named, else those of type JointState with messages, or of another type in JOINTS.

    Of several, the description names the arm's.
    """
    there: dict[str, tuple[str, int]] = {}
    for channel in channels:
        count = there.get(channel.topic, ("", 0))[1]
        there[channel.topic] = (channel.msgtype or channel.encoding, count + channel.count)
    if not any(count for _, count in there.values()):
        raise RecordingError(f"{path}: the bag is empty: it has no messages")
    listed = ", ".join(f"{t} ({kind.replace('/msg/', '/')}, messages: {n})" for t, (kind, n) in sorted(there.items()))
    for topic in topics:
        if topic not in there:
            raise RecordingError(f"{path}: no topic '{topic}'; it has {listed}")
        if not there[topic][1]:
            raise RecordingError(f"{path}: topic '{topic}' has no messages; the bag has {listed}")
    if topics:
        return tuple(topics)
    by_type: dict[str, list[str]] = {}
    for topic, (kind, count) in there.items():
        if count:
            by_type.setdefault(re.split(r"[/.:]+", kind)[-1], []).append(topic)
    kind = next((kind for kind in JOINTS if kind in by_type), "")
    plain = [topic for topic, (_, count) in there.items() if count]
    if not kind and len(plain) == 1 and all(channel.encoding == "json" for channel in channels):
        return tuple(plain)  # JSON's types have any name
    if not kind:
        raise RecordingError(
            f"{path}: no topic of type sensor_msgs/JointState with messages; it has {listed}. A trajectory is "
            "planned motion, not measured; another topic with measured signals can be named in arm.toml (topic = ...)"
        )
    return tuple(sorted(by_type[kind]))


def expect_encodings(path: Path, channels: Iterable[Channel]) -> None:
    """Refuse topics whose messages cannot be read."""
    for one in channels:
        if one.encoding not in ("cdr", "ros1", "json"):
            raise RecordingError(
                f"{path}: topic {one.topic} has messages of encoding '{one.encoding}' (schema '{one.schema}', type "
                f"'{one.msgtype}', profile '{one.profile}'); cdr, ros1, json are read: record the topic in one of "
                "these, or write its numbers to a CSV or Parquet file"
            )


def blocks_of(messages: Iterator[tuple[Channel, int, bytes]], recording: RawRecording) -> Iterator[RawSignals]:
    """Yield blocks of each topic's messages, in the order of the bag.

    Args:
        messages: channel, log time [ns] and bytes of each message.
        recording: keeps the counts.

    Raises:
        RecordingError: no message of a topic can be read.
    """
    clocks: dict[str, Clock] = {}
    readers: dict[Channel, Messages] = {}
    while taken := list(islice(messages, BLOCK_ROWS)):
        by_channel: dict[Channel, list[int]] = {}
        for k, (channel, _, _) in enumerate(taken):
            by_channel.setdefault(channel, []).append(k)
        for channel, rows in by_channel.items():
            if channel not in readers:
                readers[channel] = Messages(channel, recording)
            clock = clocks.setdefault(channel.topic, Clock(recording))
            log_ns = np.array([taken[k][1] for k in rows], np.int64)
            found = list(readers[channel].blocks([taken[k][2] for k in rows], clock.messages))
            yield from clock.stamped(found, log_ns)
    for topic in dict.fromkeys(channel.topic for channel in readers):
        if not sum(reader.read for channel, reader in readers.items() if channel.topic == topic):
            raise RecordingError(
                f"topic {topic}: none of its {clocks[topic].messages} messages can be read; "
                f"{'; '.join(recording.lost.sentences())}. Record it again, or name another topic in arm.toml"
            )


def deserializer(channel: Channel) -> Callable[[bytes], Any]:
    """Function from a message's bytes to its fields, by the definition in the file; by the standard one for JointState
    of ROS 2 and for types without a definition.
    """
    if channel.encoding == "json":
        return lambda raw: json.loads(raw, object_hook=lambda held: SimpleNamespace(**held))
    from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore

    kind, definition, ros1 = channel.msgtype, channel.definition, channel.encoding == "ros1"
    store = standard_types(ros1)
    if definition and (ros1 or kind != JOINT_STATE):
        own = get_typestore(Stores.EMPTY)
        by_idl = "idl" in channel.schema
        try:
            own.register(get_types_from_idl(definition) if by_idl else get_types_from_msg(definition, kind))
            store = own
        except Exception as error:  # rosbags' parser raises many types
            if kind not in store.fielddefs:
                raise RecordingError(
                    f"topic {channel.topic}: the definition of its type {kind} ({channel.schema}) cannot be read"
                ) from error
    if kind not in store.fielddefs:
        raise RecordingError(f"topic {channel.topic}: its type {kind} has no definition, in the bag or in ROS itself")
    return (lambda raw: store.deserialize_ros1(raw, kind)) if ros1 else (lambda raw: store.deserialize_cdr(raw, kind))


# --- Files: one, or those in the folder of a ROS 2 bag.


MOST_METADATA = 1 << 24
"""Characters of metadata.yaml that are read; a bag of ten thousand files has a tenth of it."""
MOST_OF_DISK = 0.5
"""Share of the free disk space that an unpacked bag may take."""
KINDS: dict[bytes, Callable[[Path], BagFile]] = {
    bag.ROS1_MAGIC: bag.Ros1Bag,
    mcap_file.MAGIC: mcap_file.McapFile,
    bag.SQLITE_MAGIC: bag.SqliteBag,
}
"""Files of bags by their first bytes."""


def open_bag(path: Path, topics: Sequence[str] = ()) -> list[RawRecording]:
    """Open a bag (file, or folder of ROS 2) as one raw recording, one stream a topic.

    Storage files are read directly if metadata.yaml is missing or names missing files. Messages without a definition in
    the bag use the standard one of their type. What is damaged is left out, with a note.
    """
    files, notes = _storage_files(path)
    damage_from = len(notes)
    channels: list[Channel] = []
    formats = set()
    for file in files:
        with _opened(file, notes) as storage:
            channels += storage.channels
            formats.add("ROS 1 bag" if isinstance(storage, bag.Ros1Bag) else "ROS 2 bag")
    damage = notes[damage_from:]
    if damage and not any(channel.count for channel in channels):
        raise RecordingError(
            f"{path}: no message of it can be read: {'; '.join(damage[:3])}; copy it again from where it was recorded"
        )
    wanted = chosen_topics(path, channels, topics)
    expect_encodings(path, [one for one in channels if one.topic in wanted])
    if any(one.topic in wanted and not one.definition and one.encoding != "json" for one in channels):
        notes.append("no message definitions in the bag: read by the standard ones")

    def messages() -> Iterator[tuple[Channel, int, bytes]]:
        for file in files:
            with _opened(file, notes) as storage:
                mine = [channel for channel in storage.channels if channel.topic in wanted]
                for channel, log_ns, raw in storage.messages(mine, recording.lost.add):
                    if not 0 <= log_ns < 1 << 63:
                        recording.lost.add("with a log time that is none", 1, f"on {channel.topic}")
                        continue
                    yield channel, log_ns, decompressed(raw, "zstd")[0] if raw[:4] == ZSTD_MAGIC else raw
                notes.extend(note for note in storage.notes if note not in notes)

    def blocks() -> Iterator[RawSignals]:
        try:
            yield from blocks_of(messages(), recording)
        except RecordingError as error:
            raise RecordingError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from error

    name = path.stem if path.is_file() else path.name
    recording = RawRecording(
        name, path, formats.pop(), blocks, notes, clocks=("header", "log"), row_word=("message", 1)
    )
    return [recording]


def _storage_files(path: Path) -> tuple[list[Path], list[str]]:
    if path.is_file():
        return [path], []
    suffixes = (".db3", ".mcap", ".db3.zstd", ".mcap.zstd")
    found = sorted((p for p in path.iterdir() if p.name.endswith(suffixes)), key=_by_number)
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
    missing = ", ".join(name for name in named if not (path / name).is_file())
    if not missing:
        return [path / name for name in named], []
    if not found:
        raise RecordingError(f"{path}: its metadata.yaml names {missing}, and no .db3 or .mcap file is there")
    return found, [f"metadata.yaml names {missing}, not there: read {', '.join(p.name for p in found)}"]


def _by_number(path: Path) -> tuple:
    """Sort key that puts bag_2 before bag_10."""
    return tuple(int(part) if part.isdigit() else part for part in re.split(r"(\d+)", path.name))


def _named_files(metadata: Path) -> list[str]:
    from ruamel.yaml import YAML
    from ruamel.yaml.error import YAMLError

    try:
        with metadata.open(encoding="utf-8") as file:
            content = YAML(typ="safe").load(file.read(MOST_METADATA))
        return [Path(name).name for name in content["rosbag2_bagfile_information"]["relative_file_paths"]]
    except (YAMLError, OSError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise RecordingError(f"{metadata}: not the metadata of a ROS 2 bag ({type(error).__name__})") from error


@contextmanager
def _opened(file: Path, notes: list[str]) -> Iterator[BagFile]:
    """Open a file by its first bytes; its notes are added."""
    with ExitStack() as stack:
        if (begin := _begin(file)).startswith(ZSTD_MAGIC):
            file, whole = _unpacked(file, Path(stack.enter_context(TemporaryDirectory())))
            if not whole:
                notes.append(f"{file.name}.zstd is cut off or damaged: read up to there")
            begin = _begin(file)
        kind = next((kind for magic, kind in KINDS.items() if begin.startswith(magic)), None)
        if kind is None:
            raise RecordingError(f"{file}: its first bytes are of no bag; copy it again from where it was recorded")
        storage = stack.enter_context(closing(kind(file)))
        notes.extend(note for note in storage.notes if note not in notes)
        yield storage


def _begin(file: Path) -> bytes:
    with file.open("rb") as raw:
        return raw.read(16)


def _unpacked(file: Path, folder: Path) -> tuple[Path, bool]:
    """Decompress a file into the folder; also returns whether all of it is whole."""
    path = folder / file.name.removesuffix(".zstd")
    with file.open("rb") as packed, path.open("wb") as out, pa.CompressedInputStream(packed, "zstd") as stream:
        free, size = int(MOST_OF_DISK * shutil.disk_usage(folder).free), 0
        unpacked = Unpacked(file)
        while True:
            try:
                part = stream.read(1 << 20)
            except OSError:
                return path, False
            if not part:
                return path, True
            if not size and not part.startswith(tuple(KINDS)):
                raise RecordingError(f"{file}: what it unpacks to is no bag: it begins otherwise")
            if (size := size + len(part)) > free:
                raise RecordingError(
                    f"{file}: it unpacks to more than {in_words(free)}, {MOST_OF_DISK:.0%} of what is free in "
                    f"{folder.parent}; free some, or set TMPDIR to another disk"
                )
            unpacked.add(len(part))
            out.write(part)
