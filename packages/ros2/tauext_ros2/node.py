"""A ROS 2 node without ROS: readers, writers, conditions, unreadable messages."""

from __future__ import annotations

import os
import re
import sys
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from typing import Any
from weakref import WeakSet

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
    raise ConfigError(f"ROS 2 needs CycloneDDS ({missing}): pip install cyclonedds") from missing

from tauext_ros2.messages import GRAPH_TYPES, TYPE_HASHES, ParticipantEntitiesInfo
from tauext_ros2.settings import Durability, Reliability, Ros2Settings

# --- Conditions: current input problems as text, and those not yet reported.


HOLD_NS = 2_000_000_000
"""A condition holds this long after it last occurred: longer than the second between two diagnostics."""


class Conditions:
    """Texts by key; a new text replaces the old one of its key."""

    def __init__(self) -> None:
        self._standing: dict[str, tuple[str, int]] = {}
        self._unreported: list[str] = []

    def report(self, key: str, text: str, now_ns: int) -> None:
        """Note a problem. If its key still holds, the text is replaced and not reported again."""
        before = self._standing.get(key)
        if before is None or now_ns - before[1] > HOLD_NS:
            self._unreported.append(text)
        self._standing[key] = (text, now_ns)

    def standing(self, now_ns: int) -> list[str]:
        """Texts of the last two seconds."""
        return [text for text, seen_ns in list(self._standing.values()) if now_ns - seen_ns <= HOLD_NS]

    def unreported(self) -> list[str]:
        """Texts of problems that began since the last call."""
        texts, self._unreported = self._unreported, []
        return texts


# --- Messages that the DDS library cannot decode, counted by topic.
#
# No status of a reader counts such a message. The library writes a line to its trace, which goes through a pipe and is
# counted here, and always the same line to stderr. `without_lines` removes it there, for command lines.


LINE = re.compile(r"deserialization rt(/.*)/[^/]*::dds_::\w+ failed")
END_S = 1.0
CONFIGURATION = "CYCLONEDDS_URI"
TRACING = (
    "<CycloneDDS><Domain><Tracing><Verbosity>warning</Verbosity><OutputFile>/dev/fd/{}</OutputFile>"
    "</Tracing></Domain></CycloneDDS>"
)


@cache
def unreadable(domain_id: int) -> Counter[str]:
    """Undecodable messages of a domain by topic, whose name begins with /, counted from the first call on.

    Call it before the domain's first participant is created. Nothing is counted where the trace is redirected already:
    the process uses the domain, or CYCLONEDDS_URI has another trace.
    """
    counts: Counter[str] = Counter()
    own = os.environ.get(CONFIGURATION, "")
    if sys.platform != "linux" or "Tracing" in own:
        return counts
    reads, writes = os.pipe()
    try:
        domain = Domain(domain_id, ",".join(filter(None, (own, TRACING.format(writes)))))
    except DDSException:  # the process already uses the domain, or CYCLONEDDS_URI is wrong, which a node reports
        os.close(reads)
        return counts
    finally:
        os.close(writes)  # the library has opened it by its path

    def count(domain: Domain) -> None:  # the domain ends with the last reference to it
        with open(reads, encoding="utf-8", errors="replace") as lines, suppress(OSError, ValueError):
            for line in lines:
                if found := LINE.search(line):
                    counts[found[1]] += 1

    threading.Thread(target=count, args=(domain,), name="dds trace", daemon=True).start()
    return counts


@contextmanager
def without_lines() -> Iterator[None]:
    """Remove the lines about undecodable messages from the process's stderr, which goes through a pipe meanwhile."""
    before, (reads, writes) = os.dup(2), os.pipe()
    os.dup2(writes, 2)
    os.close(writes)
    thread = threading.Thread(target=_pass_on, args=(reads, os.dup(before)), name="dds stderr", daemon=True)
    thread.start()
    try:
        yield
    finally:
        os.dup2(before, 2)  # closes the pipe, unless a child process still holds it
        os.close(before)
        thread.join(END_S)


def _pass_on(reads: int, to: int) -> None:
    with open(reads, "rb") as lines, open(to, "wb", buffering=0) as passed, suppress(OSError, ValueError):
        for line in lines:
            if not LINE.search(line.decode("utf-8", "replace")):
                passed.write(line)


# --- The node: readers and writers with the names, types and user data that ROS 2 nodes expect.


GRAPH_TOPIC = "ros_discovery_info"
DESCRIBING = threading.Lock()
XCDR1 = Policy.DataRepresentation(use_cdrv0_representation=True)
"""The encoding of all ROS 2 nodes."""


class Node:
    """One participant with one node. Others see its readers and writers after announce().

    The node holds none of them: each ends with the last reference to it.
    """

    def __init__(self, settings: Ros2Settings):
        """Raises ConfigError if the domain cannot be joined: no network, or a wrong CYCLONEDDS_URI."""
        self.settings = settings
        self.unreadable = unreadable(settings.domain_id)
        try:
            # ROS nodes ignore participants that do not publish an enclave, the name of their security settings.
            self.participant = DomainParticipant(settings.domain_id, Qos(Policy.Userdata(b"enclave=/;")))
        except DDSException as refused:
            raise ConfigError(
                f"ROS 2 domain {settings.domain_id} cannot be joined: check network and CYCLONEDDS_URI ({refused})"
            ) from refused
        self._users = 0
        self._readers: WeakSet[DataReader] = WeakSet()
        self._writers: WeakSet[DataWriter] = WeakSet()
        self._gid_type, self._entities_type, self._info_type = GRAPH_TYPES[settings.gid_bytes]
        qos = Qos(*quality("reliable", "transient-local", 1), XCDR1, type_hash(ParticipantEntitiesInfo))
        self._graph = DataWriter(self.participant, topic_of(self.participant, GRAPH_TOPIC, self._info_type), qos)

    def inbox(self, name: str, of: type, reliability: Reliability, durability: Durability, depth: int) -> Inbox:
        """Create a reader of the topic `name`, which begins with /."""
        qos = Qos(*quality(reliability, durability, depth), XCDR1, type_hash(of))
        reader = DataReader(self.participant, topic_of(self.participant, f"rt{name}", of), qos)
        self._readers.add(reader)
        return Inbox(reader, depth)

    def input(self, name: str, of: type) -> Inbox:
        """Create a reader with the quality of service in the settings."""
        return self.inbox(name, of, self.settings.reliability, self.settings.durability, self.settings.depth)

    def writer(
        self, name: str, of: type, reliability: Reliability, durability: Durability, depth: int = 1
    ) -> DataWriter:
        """Create a writer to the topic `name`, which begins with /. write() never waits: it drops old messages."""
        qos = Qos(*quality(reliability, durability, depth), XCDR1, type_hash(of))
        writer = DataWriter(self.participant, topic_of(self.participant, f"rt{name}", of), qos)
        self._writers.add(writer)
        return writer

    def announce(self) -> None:
        """Publish node, readers and writers to the graph. Call it after each change."""
        space, slash, node = self.settings.full_name(self.settings.node).rpartition("/")
        info = self._entities_type(space or slash, node, self._gids(self._readers), self._gids(self._writers))
        self._graph.write(self._info_type(self._gid(self.participant), [info]))

    def enter(self) -> None:
        """Register one more user of the node."""
        self._users += 1

    def leave(self) -> None:
        """Remove a user, which holds its readers and writers no longer; the last user closes the node."""
        self._users -= 1
        if self._users > 0:
            self.announce()
        else:
            self._graph = self.participant = None

    def _gids(self, entities: WeakSet) -> list:
        return [self._gid(entity) for entity in entities]

    def _gid(self, entity: Entity) -> Any:
        return self._gid_type(entity.guid.bytes.ljust(self.settings.gid_bytes, b"\0"))


class Inbox:
    """A reader, and a condition that waits for new messages."""

    def __init__(self, reader: DataReader, depth: int):
        self.reader, self._depth = reader, depth
        self.new = ReadCondition(reader, ViewState.Any | SampleState.NotRead | InstanceState.Any)

    def take(self) -> tuple[list, str | None]:
        """Take all new messages; the second value is the error if a message cannot be decoded.

        The library drops messages that do not match the type, but passes on strings that are not UTF-8. Messages that
        arrived together with such a message are lost.
        """
        try:
            taken = self.reader.take(self._depth, self.new)
        except Exception as damaged:  # no message may end the loop
            return [], f"a message cannot be read ({type(damaged).__name__}: {damaged})"
        return [message for message in taken if message.sample_info.valid_data], None


def topic_of(participant: DomainParticipant, name: str, of: type) -> Topic:
    """Create a topic. The library describes a type at its first use, which is not thread-safe."""
    with DESCRIBING:
        return Topic(participant, name, of)


def quality(reliability: Reliability, durability: Durability, depth: int) -> tuple:
    """QoS policies of a reader or writer."""
    best_effort, volatile = reliability == "best-effort", durability == "volatile"
    return (
        Policy.Reliability.BestEffort if best_effort else Policy.Reliability.Reliable(max_blocking_time=0),
        Policy.Durability.Volatile if volatile else Policy.Durability.TransientLocal,
        Policy.History.KeepLast(depth),
    )


def type_hash(of: type) -> Policy.Userdata:
    """Type hash in an endpoint's user data, as nodes from Iron on send it."""
    return Policy.Userdata(f"typehash=RIHS01_{TYPE_HASHES[of]};".encode())
