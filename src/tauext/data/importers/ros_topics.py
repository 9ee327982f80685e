"""What ROS 1 and ROS 2 bags have in common: which topics to read, and their messages as blocks of columns."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from tauext.data.importers.raw import BLOCK_ROWS, RawSignals
from tauext.data.importers.ros_messages import JOINT_STATE, Clock, any_messages, joint_states
from tauext.errors import RecordingError


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
