"""A ROS 2 node without ROS: settings, readers, writers, conditions, unreadable messages."""

from __future__ import annotations

import os
import re
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, Literal

from tauext.errors import ConfigError

try:
    from cyclonedds.core import (
        DDSException,
        Entity,
        InstanceState,
        Policy,
        Qos,
        ReadCondition,
        SampleState,
        ViewState,
    )
    from cyclonedds.domain import Domain, DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
except ImportError as missing:
    raise ConfigError(f"ROS 2 needs CycloneDDS ({missing}): pip install 'tauext[ros2]'") from missing

from tauext.sources.ros2_messages import GRAPH_TYPES, TYPE_HASHES, ParticipantEntitiesInfo
from tauext.sources.ros2_settings import Ros2Settings

# --- Present faults in words, and those that have not been reported yet.


HOLD_NS = 2_000_000_000
"""A condition stands for so long after it was last seen: longer than the second between two diagnostics."""


class Conditions:
    """Sentences by key: one that comes again renews the old one."""

    def __init__(self) -> None:
        self._standing: dict[str, tuple[str, int]] = {}
        self._unreported: list[str] = []

    def report(self, key: str, text: str, now_ns: int) -> None:
        """Note a fault. A new text of a key that still stands replaces the old one and is not reported again."""
        before = self._standing.get(key)
        if before is None or now_ns - before[1] > HOLD_NS:
            self._unreported.append(text)
        self._standing[key] = (text, now_ns)

    def standing(self, now_ns: int) -> list[str]:
        """Texts that came within the last two seconds."""
        return [text for text, seen_ns in list(self._standing.values()) if now_ns - seen_ns <= HOLD_NS]

    def unreported(self) -> list[str]:
        """Texts of faults that began since the last call."""
        texts, self._unreported = self._unreported, []
        return texts


# --- Messages that the DDS library cannot read: counted by topic, where it would print a line for each of them.
#
# No status of a reader counts such a message; the library writes a line of it to its trace, which goes through a pipe
# and is counted here, and the same line to stderr, always. A command line leaves it out there: `without_lines`.


LINE = re.compile(r"deserialization rt(/.*)/[^/]*::dds_::\w+ failed")
END_S = 1.0
CONFIGURATION = "CYCLONEDDS_URI"
TRACING = (
    "<CycloneDDS><Domain><Tracing><Verbosity>warning</Verbosity><OutputFile>/dev/fd/{}</OutputFile>"
    "</Tracing></Domain></CycloneDDS>"
)


class Unreadable:
    """Counts for one domain, from its beginning in this process on."""

    _of_domain: dict[int, Unreadable] = {}
    _beginning = threading.Lock()

    def __init__(self, domain_id: int):
        self._counts: Counter[str] = Counter()
        self._domain: Domain | None = None
        if sys.platform == "linux":
            self._listen(domain_id)

    @classmethod
    def of(cls, domain_id: int) -> Unreadable:
        """The counts of a domain; call it before the domain's first participant is made."""
        with cls._beginning:
            if domain_id not in cls._of_domain:
                cls._of_domain[domain_id] = cls(domain_id)
            return cls._of_domain[domain_id]

    def count(self, topic: str) -> int:
        """Messages of the topic, which begins with /, that could not be read so far."""
        return self._counts[topic]

    def _listen(self, domain_id: int) -> None:
        own = os.environ.get(CONFIGURATION, "")
        if "Tracing" in own:
            return  # the user sends the library's trace elsewhere
        reads, writes = os.pipe()
        try:
            self._domain = Domain(domain_id, ",".join(filter(None, (own, TRACING.format(writes)))))
        except (
            DDSException
        ):  # another part of this process began the domain, or CYCLONEDDS_URI is wrong, which a node reports
            os.close(reads)
            return
        finally:
            os.close(writes)  # the library has opened it by its name
        threading.Thread(target=self._read, args=(reads,), name="dds words", daemon=True).start()

    def _read(self, reads: int) -> None:
        with open(reads, encoding="utf-8", errors="replace") as lines, suppress(OSError, ValueError):
            for line in lines:
                if found := LINE.search(line):
                    self._counts[found[1]] += 1


@contextmanager
def without_lines() -> Iterator[None]:
    """Leave the lines about such messages out of stderr, which passes through a pipe meanwhile; for a whole process.

    What Python itself prints goes straight to where stderr went before.
    """
    sys.stderr.flush()
    before, (reads, writes) = os.dup(2), os.pipe()
    os.dup2(writes, 2)
    os.close(writes)
    own, sys.stderr = sys.stderr, open(before, "w", buffering=1, encoding="utf-8", errors="replace", closefd=False)
    thread = threading.Thread(target=_pass_on, args=(reads, before), name="dds stderr", daemon=True)
    thread.start()
    try:
        yield
    finally:
        sys.stderr.flush()
        sys.stderr = own
        os.dup2(before, 2)  # the last end of the pipe, unless a process that was started still has it
        thread.join(END_S)


def _pass_on(reads: int, to: int) -> None:
    with open(reads, "rb") as lines, suppress(OSError, ValueError):
        for line in lines:
            if not LINE.search(line.decode("utf-8", "replace")):
                os.write(to, line)


# --- A ROS 2 node without ROS: readers and writers under the names, types and user data that ROS 2 nodes expect.


Kind = Literal["best-effort", "reliable"]
Lasting = Literal["volatile", "transient-local"]
GRAPH_TOPIC = "ros_discovery_info"
DESCRIBING = threading.Lock()
XCDR1 = Policy.DataRepresentation(use_cdrv0_representation=True)
"""The only encoding that ROS 2 nodes use."""


class Node:
    """One participant with one node; readers and writers are seen by others once announce() was called."""

    def __init__(self, settings: Ros2Settings):
        """Raises ConfigError where the domain cannot be joined: no network, or CYCLONEDDS_URI is wrong."""
        self.settings = settings
        self.unreadable = Unreadable.of(settings.domain_id)
        try:
            # Nodes ignore participants that do not publish their enclave, the name of their security settings.
            self.participant = DomainParticipant(settings.domain_id, Qos(Policy.Userdata(b"enclave=/;")))
        except DDSException as refused:
            raise ConfigError(
                f"ROS 2 domain {settings.domain_id} cannot be joined: check network and CYCLONEDDS_URI ({refused})"
            ) from refused
        self._users = 0
        self._readers: list[DataReader] = []
        self._writers: list[DataWriter] = []
        gid, entities, info = GRAPH_TYPES[settings.gid_bytes]
        self._gid_type, self._entities_type, self._info_type = gid, entities, info
        qos = Qos(*quality("reliable", "transient-local", 1), XCDR1, type_hash(ParticipantEntitiesInfo))
        self._graph = DataWriter(self.participant, topic_of(self.participant, GRAPH_TOPIC, info), qos)

    def inbox(self, name: str, of: type, kind: Kind, lasting: Lasting, depth: int) -> Inbox:
        """Reader of the topic `name`, which begins with /."""
        qos = Qos(*quality(kind, lasting, depth), XCDR1, type_hash(of))
        self._readers.append(DataReader(self.participant, self._topic(name, of), qos))
        return Inbox(self._readers[-1], depth)

    def writer(self, name: str, of: type, kind: Kind, lasting: Lasting, depth: int = 1) -> DataWriter:
        """Writer to the topic `name`, which begins with /. write() never waits: the oldest of its depth gives way."""
        qos = Qos(*quality(kind, lasting, depth), XCDR1, type_hash(of))
        self._writers.append(DataWriter(self.participant, self._topic(name, of), qos))
        return self._writers[-1]

    def announce(self) -> None:
        """Publish node, readers and writers to the graph; to be called again after each new one."""
        space, slash, node = self.settings.full_name(self.settings.node).rpartition("/")
        info = self._entities_type(space or slash, node, self._gids(self._readers), self._gids(self._writers))
        self._graph.write(self._info_type(self._gid(self.participant), [info]))

    def enter(self) -> None:
        """One more who uses the node."""
        self._users += 1

    def leave(self, entities: list[Entity]) -> None:
        """One less, whose readers and writers these were; the last one closes the node."""
        self._users -= 1
        self._readers = [reader for reader in self._readers if reader not in entities]
        self._writers = [writer for writer in self._writers if writer not in entities]
        if self._users > 0:
            self.announce()
        else:
            self._graph = self.participant = None

    def _topic(self, name: str, of: type) -> Topic:
        return topic_of(self.participant, f"rt{name}", of)

    def _gids(self, entities: list[Entity]) -> list:
        return [self._gid(entity) for entity in entities]

    def _gid(self, entity: Entity) -> Any:
        return self._gid_type(entity.guid.bytes.ljust(self.settings.gid_bytes, b"\0"))


class Inbox:
    """A reader, and the condition that waits for what is new in it."""

    def __init__(self, reader: DataReader, depth: int):
        self.reader, self._depth = reader, depth
        self.new = ReadCondition(reader, ViewState.Any | SampleState.NotRead | InstanceState.Any)

    def take(self) -> tuple[list, str | None]:
        """All that is new, and why there is nothing where a message cannot be read.

        The library drops what breaks a type's structure, but hands on strings that are no UTF-8; with such a message
        those are lost that came at once with it.
        """
        try:
            taken = self.reader.take(self._depth, self.new)
        except Exception as damaged:  # whatever others send must not end the loop
            return [], f"a message cannot be read ({type(damaged).__name__}: {damaged})"
        return [message for message in taken if message.sample_info.valid_data], None


def topic_of(participant: DomainParticipant, name: str, of: type) -> Topic:
    """The library describes a type at its first use, which two threads must not have at once."""
    with DESCRIBING:
        return Topic(participant, name, of)


def quality(kind: Kind, lasting: Lasting, depth: int) -> tuple:
    """Policies of a reader or writer."""
    return (
        Policy.Reliability.BestEffort if kind == "best-effort" else Policy.Reliability.Reliable(max_blocking_time=0),
        Policy.Durability.Volatile if lasting == "volatile" else Policy.Durability.TransientLocal,
        Policy.History.KeepLast(depth),
    )


def type_hash(of: type) -> Policy.Userdata:
    """Type hash in the user data of endpoints, as nodes from Iron on send it."""
    return Policy.Userdata(f"typehash=RIHS01_{TYPE_HASHES[of]};".encode())
