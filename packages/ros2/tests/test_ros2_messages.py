"""Bytes, names and hashes of the ROS 2 messages, against rosbags, which knows them from their definitions."""

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

pytest.importorskip("cyclonedds")

from tauext_ros2 import messages as msg

STORES = {16: get_typestore(Stores.ROS2_JAZZY), 24: get_typestore(Stores.ROS2_HUMBLE)}


def graph_message(size):
    gid, entities, info = msg.GRAPH_TYPES[size]

    def made(first):
        return gid(bytes((first + k) % 256 for k in range(size)))

    return info(made(0), [entities("/tauext", "tauext", [made(9)], [made(200), made(7)]), entities("/", "x", [], [])])


MADE = {
    "time": msg.Time(-3, 999_999_999),
    "header": msg.Header(msg.Time(1_700_000_000, 5), "base_link"),
    "joint state": msg.JointState(
        msg.Header(msg.Time(1, 2), "b"),
        ["shoulder", "ell", "ü", ""],
        [0.1, -2.5, 1e300, 0.0],
        [float("inf")],
        [5e-324] * 3,
    ),
    "no joint": msg.JointState(),
    "true": msg.Bool(True),
    "false": msg.Bool(False),
    "string": msg.String("slow and careful"),
    "no string": msg.String(),
    "inertia": msg.Inertia(2.5, msg.Vector3(0.1, -0.2, 0.3), 0.01, 0.001, -0.002, 0.02, 0.003, 0.03),
    "wrench": msg.WrenchStamped(
        msg.Header(msg.Time(1, 2), "tool0"), msg.Wrench(msg.Vector3(1.0, -2.0, 3.5), msg.Vector3(0.1, 0.2, -0.3))
    ),
    "covariance": msg.Float64MultiArray(
        msg.MultiArrayLayout([msg.MultiArrayDimension("x y", 2, 4), msg.MultiArrayDimension("x y", 2, 2)]),
        [4.0, 0.5, 0.5, 9.0],
    ),
    "key and value": msg.KeyValue("limit_nm a", "3.5"),
    "diagnostics": msg.DiagnosticArray(
        msg.Header(msg.Time(7, 8)),
        [
            msg.DiagnosticStatus(
                msg.STALE, "tauext: arm", "fault: gap", "/x", [msg.KeyValue("a", "b"), msg.KeyValue("", "c")]
            ),
            msg.DiagnosticStatus(msg.OK, "n"),
        ],
    ),
    "nodes": graph_message(16),
    "nodes until Humble": graph_message(24),
}


def name_of(kind):
    return kind.__idl_typename__.replace("::msg::dds_::", "/msg/").removesuffix("_")


def as_rosbags(value, store):
    """The same message as rosbags has it."""
    if hasattr(type(value), "__idl_typename__"):
        fields = {name: as_rosbags(part, store) for name, part in vars(value).items()}
        return store.types[name_of(type(value))](**fields)
    if isinstance(value, list) and value and isinstance(value[0], float):
        return np.array(value)
    if isinstance(value, bytes):
        return np.frombuffer(value, dtype=np.uint8)
    return [as_rosbags(part, store) for part in value] if isinstance(value, list) else value


def as_rosbags_message(message):
    store = STORES[24 if isinstance(message, msg.GRAPH_TYPES[24]) else 16]
    made = as_rosbags(message, store)
    if isinstance(message, msg.JointState):  # an empty list of numbers does not tell its type
        for field in ("position", "velocity", "effort"):
            setattr(made, field, np.array(getattr(message, field), dtype=np.float64))
    return store, made


@pytest.mark.parametrize("message", MADE.values(), ids=MADE.keys())
def test_bytes_equal_those_of_rosbags_and_are_read(message):
    store, made = as_rosbags_message(message)
    written = bytes(store.serialize_cdr(made, name_of(type(message))))
    assert written == message.serialize(use_version_2=False) and type(message).deserialize(written) == message


@pytest.mark.parametrize("kind", msg.TYPE_HASHES, ids=lambda kind: kind.__name__)
def test_hashes_are_those_that_follow_from_the_definitions(kind):
    assert STORES[16].hash_rihs01(name_of(kind)) == f"RIHS01_{msg.TYPE_HASHES[kind]}"


@pytest.mark.parametrize("t_ns", [0, 1, -1, 1_700_000_000_123_456_789, -5_000_000_001])
def test_times_hold_every_nanosecond_before_and_after_1970(t_ns):
    time = msg.Time.of_ns(t_ns)
    assert time.ns == t_ns and 0 <= time.nanosec < 10**9


def test_times_outside_of_the_message_are_cut():
    assert msg.Time.of_ns(2**40 * 10**9).sec == 2**31 - 1
    assert msg.Time.of_ns(-(2**40) * 10**9).sec == -(2**31)
