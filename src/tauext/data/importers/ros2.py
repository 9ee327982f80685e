"""ROS 2 bags: sqlite3 and MCAP files, alone or in the folder of a bag."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

from tauext.data.importers.raw import RawRecording, RawSignals
from tauext.data.importers.ros_messages import JOINT_STATE, Clock
from tauext.data.importers.ros_topics import blocks_of, chosen_topics
from tauext.errors import RecordingError

SQLITE_MAGIC, MCAP_MAGIC = b"SQLite format 3\0", b"\x89MCAP0\r\n"
SUFFIXES = (".db3", ".mcap")
REPAIR = "a file that was not closed can be repaired: `mcap recover`, or for sqlite3 `.recover`"


def open_ros2(path: Path, topics: Sequence[str] = ()) -> list[RawRecording]:
    """A ROS 2 bag (folder or storage file) as one raw recording, a stream a topic.

    A folder whose metadata.yaml is missing or names files that are not there is read by its storage files. Messages
    without a definition in the bag are read by the standard one of their type.

    Raises:
        RecordingError: now or while it is read: damaged, empty, or without the topics asked for.
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
                yield from blocks_of(messages, True, _deserializer, clocks, counts)

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

    try:
        if isinstance(file, _Folder):
            storage: Any = DirectoryReader(file.path)
        else:
            # rosbags goes by the suffix; a file is what it begins with.
            with file.open("rb") as raw:
                begin = raw.read(len(SQLITE_MAGIC))
            storage = McapReader(file) if begin.startswith(MCAP_MAGIC) else Sqlite3Reader(file)
        storage.open()
        try:
            yield storage
        finally:
            storage.close()
    except (RecordingError, GeneratorExit):
        raise
    except Exception as error:  # what rosbags meets in damaged bytes is of many types
        what = " ".join(str(error).split()) or type(error).__name__
        raise RecordingError(f"{file}: cannot be read as a ROS 2 bag ({what}); {REPAIR}") from error


@cache
def _standard_types() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


def _deserializer(connection: Any) -> Callable[[bytes], Any]:
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
