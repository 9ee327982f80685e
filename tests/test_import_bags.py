"""Bags and MCAP files as recorders, SDKs and power cuts leave them: whole messages are read, what is lost is named."""

from __future__ import annotations

import json
import re
import shutil
import sqlite3
import struct
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from made_recordings import JOINTS, joint_rows, message, motion, write_bag
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from test_importers import read

from tauext.data.assemble import assemble
from tauext.data.description import parse_arm
from tauext.data.description_template import guess
from tauext.data.importers.open_raw import open_raw
from tauext.errors import RecordingError, TauextError

JOINT_STATE = "sensor_msgs/msg/JointState"
TOPIC = "/joint_states"
SAMPLES = 400
T_NS, Q, DQ, TAU = motion(SAMPLES)
ARM = 'signals = {q.columns = "position", dq.columns = "velocity", tau.columns = "effort"}\n'
ARM += f"[robot]\njoints = {json.dumps([name.replace(' ', '_') for name in JOINTS])}\nnames = {json.dumps(JOINTS)}\n"


@cache
def store(ros1: bool = False):
    return get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)


@cache
def definition(kind: str = "ros2msg") -> str:
    if kind == "ros2idl":
        return IDL
    return store(kind == "ros1msg").generate_msgdef(JOINT_STATE, ros_version=1 if kind == "ros1msg" else 2)[0]


IDL = "\n".join(
    [
        "module builtin_interfaces { module msg { struct Time { int32 sec; uint32 nanosec; }; }; };",
        "module std_msgs { module msg { struct Header { builtin_interfaces::msg::Time stamp; string frame_id; }; }; };",
        "module sensor_msgs { module msg { struct JointState { std_msgs::msg::Header header; sequence<string> name;",
        "sequence<double> position; sequence<double> velocity; sequence<double> effort; }; }; };",
    ]
)
IDL = f"{'=' * 80}\nIDL: sensor_msgs/msg/JointState\n{IDL}"


def as_json(k: int) -> bytes:
    stamp = {"sec": int(T_NS[k] // 10**9), "nsec": int(T_NS[k] % 10**9)}
    arrays = {"position": list(Q[k]), "velocity": list(DQ[k]), "effort": list(TAU[k])}
    return json.dumps({"timestamp": stamp, "name": list(JOINTS)} | arrays).encode()


def as_listed_json(k: int) -> bytes:
    stamp = {"sec": int(T_NS[k] // 10**9), "nsec": int(T_NS[k] % 10**9)}
    joints = [
        {"name": name, "position": Q[k, j], "velocity": DQ[k, j], "effort": TAU[k, j]} for j, name in enumerate(JOINTS)
    ]
    return json.dumps({"timestamp": stamp, "joints": joints}).encode()


def serialized(k: int, ros1: bool = False) -> bytes:
    content = message(store(ros1), int(T_NS[k]), JOINTS, Q[k], DQ[k], TAU[k], ros1=ros1)
    return bytes((store(ros1).serialize_ros1 if ros1 else store().serialize_cdr)(content, JOINT_STATE))


MESSAGES = {
    # encoding of the messages, of the schema, its name, its text, one message
    "cdr": ("cdr", "ros2msg", JOINT_STATE, definition, serialized),
    "cdr, short name": ("cdr", "ros2msg", "sensor_msgs/JointState", definition, serialized),
    "cdr, IDL": ("cdr", "ros2idl", JOINT_STATE, lambda: IDL, serialized),
    "cdr, DDS": ("cdr", "omgidl", "sensor_msgs::msg::dds_::JointState_", lambda: IDL, serialized),
    "ROS 1": (
        "ros1",
        "ros1msg",
        "sensor_msgs/JointState",
        lambda: definition("ros1msg"),
        lambda k: serialized(k, True),
    ),
    "json": ("json", "jsonschema", "arm.State", lambda: "{}", as_json),
    "json of joints": ("json", "jsonschema", "foxglove.JointStates", lambda: "{}", as_listed_json),
}
LAYOUTS = {
    "zstd": {"compression": CompressionType.ZSTD},
    "lz4": {"compression": CompressionType.LZ4},
    "plain": {"compression": CompressionType.NONE},
    "no chunks": {"use_chunking": False},
    "no summary": {"use_statistics": False, "repeat_schemas": False, "repeat_channels": False},
}


def write_mcap(path: Path, kind: str = "cdr", layout: str = "zstd", rows=range(SAMPLES), profile: str = "") -> Path:
    """Write the rows with the format's own package."""
    encoding, schema, name, text, content = MESSAGES[kind]
    with path.open("wb") as file:
        writer = McapWriter(file, chunk_size=10_000, **LAYOUTS[layout])
        writer.start(profile=profile)
        number = writer.register_schema(name, schema, text().encode())
        channel = writer.register_channel(TOPIC, encoding, number)
        for k in rows:
            writer.add_message(channel, int(T_NS[k]) + 10**6, content(k), int(T_NS[k]))
        writer.finish()
    return path


def expect_rows(path: Path, rows) -> tuple[list[str], list[str]]:
    """Compare what is read with these rows of the motion; returns notes, and sentences on what was lost."""
    source, streams = read(path)
    times, columns = streams[TOPIC]
    np.testing.assert_array_equal(times, T_NS[rows])
    for array, values in (("position", Q), ("velocity", DQ), ("effort", TAU)):
        for j, joint in enumerate(JOINTS):
            np.testing.assert_array_equal(columns[f"{array}[{joint}]"], values[rows, j])
    return source.notes, source.lost.sentences()


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("kind", MESSAGES)
def test_an_mcap_file_of_any_recorder_is_read(tmp_path, kind, layout):
    assert expect_rows(write_mcap(tmp_path / "log.mcap", kind, layout), slice(None)) == ([], [])


def test_definitions_at_the_end_serve_where_the_first_ones_are_damaged(tmp_path):
    path = write_mcap(tmp_path / "log.mcap", layout="zstd")
    content = bytearray(path.read_bytes())
    content[200:240] = bytes(40)  # in the first chunk, which has the definitions
    content[-28:-20] = bytes(8)  # the place of the summary
    path.write_bytes(content)
    times = read(path)[1][TOPIC][0]
    np.testing.assert_array_equal(times, T_NS[SAMPLES - len(times) :])
    assert SAMPLES - 60 < len(times) < SAMPLES


def test_messages_of_overlapping_chunks_come_in_order_of_log_time(tmp_path):
    rows = [k + near for k in range(0, SAMPLES, 40) for near in [*range(20, 40), *range(20)]]
    expect_rows(write_mcap(tmp_path / "log.mcap", rows=rows), slice(None))


@pytest.mark.parametrize("encoding", ["protobuf", "flatbuffer"])
def test_an_encoding_that_is_not_read_is_named_with_its_topic(tmp_path, encoding):
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start(profile="x")
        schema = writer.register_schema("foxglove.JointStates", encoding, b"\xff\x00")
        writer.add_message(writer.register_channel("/arm", encoding, schema), 1, b"\x00", 1)
        writer.finish()
    with pytest.raises(
        RecordingError,
        match=f"/arm has messages of encoding '{encoding}' .*'foxglove.JointStates', profile 'x'.*cdr, ros1, json",
    ):
        open_raw(path, ["/arm"])


# --- Files that were not closed, are cut off or damaged.


def mcap_file(folder: Path, layout: str) -> Path:
    return write_mcap(folder / "log.mcap", layout=layout)


def ros1_file(folder: Path, compression: str) -> Path:
    path = folder / "log.bag"
    writer = Ros1Writer(path)
    if compression:
        writer.set_compression(getattr(Ros1Writer.CompressionFormat, compression))
    writer.chunk_threshold = 10_000
    with writer:
        connection = writer.add_connection(TOPIC, JOINT_STATE, typestore=store(True))
        for k in range(SAMPLES):
            writer.write(connection, int(T_NS[k]), serialized(k, True))
    return path


def sqlite_file(folder: Path, _: str) -> Path:
    return write_bag(folder / "run", "sqlite3", {TOPIC: joint_rows()}) / "run.db3"


FILES = {f"mcap, {layout}": (mcap_file, layout) for layout in LAYOUTS}
FILES |= {f"ROS 1, {name or 'plain'}": (ros1_file, name) for name in ("", "BZ2", "LZ4")}
FILES |= {"sqlite3": (sqlite_file, "")}


@pytest.mark.parametrize("share", [0.4, 0.71, 0.999])
@pytest.mark.parametrize("kind", FILES)
def test_a_file_that_is_cut_off_gives_its_whole_messages(tmp_path, kind, share):
    make, option = FILES[kind]
    path = make(tmp_path, option)
    content = path.read_bytes()[: int(share * path.stat().st_size)]
    cut = tmp_path / f"cut{path.suffix}"
    cut.write_bytes(content)
    rows = np.searchsorted(T_NS, read(cut)[1][TOPIC][0])
    notes, lost = expect_rows(cut, rows)
    assert not lost
    if kind == "sqlite3":  # a page with an early row may lie late in the file
        assert len(rows) > 0.5 * share * SAMPLES - 50
    else:
        np.testing.assert_array_equal(rows, np.arange(len(rows)))
        assert len(rows) > 0.5 * share * SAMPLES - 10  # of small chunks and a large index
    if "plain" in kind or "no chunks" in kind:  # the messages lie in the file as they are
        assert len(rows) == sum(serialized(k, "ROS 1" in kind) in content for k in range(SAMPLES))
    if share == 0.999 and "mcap" in kind:  # of the summary only
        assert len(rows) == SAMPLES and not notes
    else:
        assert len(notes) == 1 and "cut off" in notes[0]


@pytest.mark.parametrize("kind", [kind for kind in FILES if kind not in ("mcap, no chunks", "ROS 1, plain")])
def test_a_damaged_part_costs_its_messages_only(tmp_path, kind):
    make, option = FILES[kind]
    path = make(tmp_path, option)
    content = bytearray(path.read_bytes())
    middle = len(content) // 2 // 4096 * 4096
    content[middle : middle + 40] = bytes(40)
    path.write_bytes(content)
    source, streams = read(path)
    times = streams[TOPIC][0]
    assert SAMPLES - 110 < len(times) < SAMPLES and set(times) < set(T_NS)
    assert any("damaged" in note for note in source.notes)
    if kind in ("mcap, zstd", "mcap, lz4", "mcap, plain") or "ROS 1" in kind:
        assert source.lost.count == SAMPLES - len(times)


@pytest.mark.parametrize("kind", FILES)
def test_a_file_without_one_whole_message_is_refused_in_our_words(tmp_path, kind):
    make, option = FILES[kind]
    cut = tmp_path / "cut.log"
    cut.write_bytes(make(tmp_path, option).read_bytes()[:60])
    with pytest.raises(
        RecordingError, match=r"cut.log: (no message of it can be read|its table of topics).*copy"
    ) as caught:
        read(cut)
    assert not any(word in str(caught.value).lower() for word in ("rosbag", "image", "recover", "struct", "malformed"))


def recorded_with_wal(folder: Path) -> Path:
    """A bag as it lies on disk while the recorder writes: some rows are in the write-ahead log."""
    whole = sqlite_file(folder, "")
    path = folder / "live.db3"
    with sqlite3.connect(whole) as database:
        tables = [sql for (sql,) in database.execute("SELECT sql FROM sqlite_master WHERE sql IS NOT NULL")]
        rows = {
            name: database.execute(f"SELECT * FROM {name}").fetchall()
            for name in ("topics", "message_definitions", "schema", "messages")
        }
    writer = sqlite3.connect(path)
    writer.execute("PRAGMA journal_mode=WAL")
    for sql in tables:
        writer.execute(sql)
    for name, content in rows.items():
        if name == "messages":
            content = content[: SAMPLES // 2]
        writer.executemany(f"INSERT INTO {name} VALUES ({','.join('?' * len(content[0]))})", content)
        writer.commit()
    for end in ("", "-wal"):  # before the writer closes and takes the log in
        shutil.copy(f"{path}{end}", f"{folder / 'copy.db3'}{end}")
    writer.close()
    return folder / "copy.db3"


def test_rows_that_a_recorder_still_held_in_its_log_are_read(tmp_path):
    path = recorded_with_wal(tmp_path)
    before = {file.name: file.read_bytes() for file in tmp_path.glob("copy.db3*")}
    notes, lost = expect_rows(path, slice(SAMPLES // 2))
    assert notes == ["not closed by the recorder: the rows in copy.db3-wal are read too"] and not lost
    assert {file.name: file.read_bytes() for file in tmp_path.glob("copy.db3*")} == before
    Path(f"{path}-wal").unlink()
    with pytest.raises(RecordingError, match=r"kept its last rows in copy.db3-wal.*copy all files"):
        open_raw(path)


@pytest.mark.parametrize("metadata", [True, False])
@pytest.mark.parametrize("mode", ["FILE", "MESSAGE"])
@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
def test_a_compressed_bag_is_read_with_and_without_its_metadata(tmp_path, plugin, mode, metadata):
    path = tmp_path / "run"
    writer = Ros2Writer(path, version=9, storage_plugin=StoragePlugin[plugin])
    writer.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with writer:
        connection = writer.add_connection(TOPIC, JOINT_STATE, typestore=store())
        for k in range(SAMPLES):
            writer.write(connection, int(T_NS[k]), serialized(k))
    if not metadata:
        (path / "metadata.yaml").unlink()
    expect_rows(path, slice(None))
    (file,) = (one for one in path.iterdir() if one.name != "metadata.yaml")
    expect_rows(file, slice(None))


# --- Messages that are wrong, each on its own.


def changed(**arrays):
    """Message 7 with other arrays."""

    def make(ros1: bool) -> bytes:
        held = {"names": JOINTS, "q": Q[7], "dq": DQ[7], "tau": TAU[7]} | arrays
        content = message(store(ros1), int(T_NS[7]), held["names"], held["q"], held["dq"], held["tau"], ros1=ros1)
        return bytes((store(ros1).serialize_ros1 if ros1 else store().serialize_cdr)(content, JOINT_STATE))

    return make


WRONG = {
    "cut short": (lambda ros1: serialized(7, ros1)[:-9], "cannot be decoded as sensor_msgs/msg/JointState"),
    "no bytes": (lambda _: b"", "cannot be decoded as sensor_msgs/msg/JointState"),
    "wrong bytes": (lambda _: b"\x00\x01\x00\x00" + b"\xff" * 60, "cannot be decoded as sensor_msgs/msg/JointState"),
    "positions only": (changed(dq=[], tau=[]), r"without velocity\[base\], velocity\[Wrist 1\]"),
    "no arrays": (changed(q=[], dq=[], tau=[]), "without numbers"),
    "one velocity too few": (changed(dq=DQ[7, :2]), r"without velocity\[base\]"),
    "one effort too many": (changed(tau=[1, 2, 3, 4]), r"without effort\[base\]"),
    "a name twice": (changed(names=("base", "base", "tip")), r"without position\[base\], position\[Wrist 1\]"),
    "a joint without a name": (changed(names=("base", "", "tip")), r"without position\[Wrist 1\]"),
    "NaN": (changed(tau=[0, np.nan, 0]), r"'effort\[Wrist 1\]' is missing or no finite number"),
}


def write_rows(path: Path, kind: str, rows: list[tuple[int, bytes]]) -> Path:
    if kind == "ros1":
        path = path.with_suffix(".bag")
        writer: Ros1Writer | Ros2Writer = Ros1Writer(path)
    else:
        writer = Ros2Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        connection = writer.add_connection(TOPIC, JOINT_STATE, typestore=store(kind == "ros1"))
        for at, content in rows:
            writer.write(connection, int(at), content)
    return path


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
@pytest.mark.parametrize("wrong", WRONG)
def test_one_wrong_message_is_left_out_and_counted(tmp_path, wrong, kind):
    make, reason = WRONG[wrong]
    ros1 = kind == "ros1"
    rows = [(T_NS[k], make(ros1) if k == 7 else serialized(k, ros1)) for k in range(100)]
    (raw,) = open_raw(write_rows(tmp_path / "run", kind, rows))
    (recording,) = assemble(raw, parse_arm(ARM, tmp_path))
    keep = np.r_[:7, 8:100]
    np.testing.assert_array_equal(recording.t_ns, T_NS[keep])
    for values, clean in ((recording.q, Q), (recording.dq, DQ), (recording.tau, TAU)):
        np.testing.assert_array_equal(values, clean[keep])
    (sentence,) = [one for one in recording.provenance["done"] if "left out:" in one]
    assert sentence.startswith("1 row left out: ") and "first message 8 of /joint_states" in sentence
    assert re.search(reason, sentence), sentence


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("cut short", "none of its 40 messages can be read; 40 rows left out: cannot be decoded as"),
        ("no arrays", "none of its 40 messages can be read; 40 rows left out: without numbers, first message 1"),
        (
            "one velocity too few",
            r"\[signals.dq\] 'velocity'.*velocity has 2 values for 3 joints in some messages.*derives",
        ),
        ("a name twice", r"\[signals.q\].*its elements are tip"),
    ],
)
def test_a_topic_of_wrong_messages_only_is_refused_with_the_cause(tmp_path, wrong, said):
    path = write_rows(tmp_path / "run", "mcap", [(T_NS[k], WRONG[wrong][0](False)) for k in range(40)])
    with pytest.raises(TauextError, match=said):
        list(assemble(open_raw(path)[0], parse_arm(ARM, tmp_path)))


def test_the_velocity_can_be_derived_where_its_array_is_wrong(tmp_path):
    rows = [(T_NS[k], changed(q=Q[k], dq=DQ[k, :2], tau=TAU[k])(False)) for k in range(40)]
    for (_, content), k in zip(rows, range(40), strict=True):
        assert content != serialized(k)
    path = write_bag(
        tmp_path / "run", "mcap", {TOPIC: [(T_NS[k], T_NS[k], JOINTS, Q[k], DQ[k, :2], TAU[k]) for k in range(40)]}
    )
    arm = ARM.replace('dq.columns = "velocity"', 'dq.columns = ""')
    (recording,) = assemble(open_raw(path)[0], parse_arm(arm, tmp_path))
    np.testing.assert_array_equal(recording.q, Q[:40])


def test_joints_without_names_are_numbered(tmp_path):
    path = write_bag(
        tmp_path / "run", "mcap", {TOPIC: [(T_NS[k], T_NS[k], (), Q[k], DQ[k], TAU[k]) for k in range(40)]}
    )
    np.testing.assert_array_equal(read(path)[1][TOPIC][1]["effort[2]"], TAU[:40, 2])


# --- Clocks.


@pytest.mark.parametrize(
    ("stamps", "rows", "by_log"),
    [
        (lambda t: np.where(np.arange(len(t)) < 3, 0, t), slice(3, 100), False),  # the driver was not ready
        (lambda t: t - t[0], slice(0, 100), False),  # simulated time begins at zero
        (lambda t: 0 * t, slice(0, 100), True),
        (lambda t: 0 * t + t[0], slice(0, 100), True),
    ],
    ids=["first ones zero", "simulated time", "all zero", "all equal"],
)
def test_stamps_that_are_missing_or_constant_do_not_become_times(tmp_path, stamps, rows, by_log):
    t_ns = T_NS[:100]
    written = [(t_ns[k] + 5, stamps(t_ns)[k], JOINTS, Q[k], DQ[k], TAU[k]) for k in range(100)]
    source, streams = read(write_bag(tmp_path / "run", "mcap", {TOPIC: written}))
    np.testing.assert_array_equal(streams[TOPIC][0], (t_ns + 5 if by_log else stamps(t_ns))[rows])
    assert bool(source.counts) == by_log and source.lost.count == 100 - len(streams[TOPIC][0])


# --- Other types of joints' states.


DYNAMIC = """std_msgs/Header header
string[] joint_names
control_msgs/InterfaceValue[] interface_values
================================================================================
MSG: control_msgs/InterfaceValue
string[] interface_names
float64[] values
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
FRANKA = """std_msgs/Header header
float64[7] q
float64[7] dq
float64[7] tau_J
float64 time
================================================================================
MSG: std_msgs/Header
uint32 seq
time stamp
string frame_id
"""


def test_dynamic_joint_states_give_the_columns_of_joint_states(tmp_path):
    kind = "control_msgs/msg/DynamicJointState"
    types = get_typestore(Stores.ROS2_HUMBLE)
    types.register(get_types_from_msg(DYNAMIC, kind))
    value = types.types["control_msgs/msg/InterfaceValue"]
    with Ros2Writer(tmp_path / "run", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        connection = writer.add_connection(TOPIC, kind, typestore=types)
        for k in range(SAMPLES):
            held = message(types, int(T_NS[k]), JOINTS, Q[k], DQ[k], TAU[k])
            values = [
                value(
                    interface_names=["effort", "position", "velocity"], values=np.array([TAU[k, j], Q[k, j], DQ[k, j]])
                )
                for j in range(len(JOINTS))
            ]
            content = types.types[kind](header=held.header, joint_names=list(JOINTS), interface_values=values)
            writer.write(connection, int(T_NS[k]), types.serialize_cdr(content, kind))
    expect_rows(tmp_path / "run", slice(None))
    found = guess(open_raw(tmp_path / "run")[0].streams)
    assert (found.columns["q"], found.columns["dq"], found.columns["tau"]) == ("position", "velocity", "effort")
    assert found.joint_names == JOINTS


def test_the_state_of_a_franka_arm_is_read_and_guessed(tmp_path):
    kind = "franka_msgs/msg/FrankaState"
    types = get_typestore(Stores.ROS1_NOETIC)
    types.register(get_types_from_msg(FRANKA, kind))
    t_ns, q, dq, tau = motion(50, joints=7)
    with Ros1Writer(tmp_path / "run.bag") as writer:
        connection = writer.add_connection("/state", kind, typestore=types)
        for k in range(50):
            header = message(types, int(t_ns[k]), (), (), (), (), ros1=True).header
            content = types.types[kind](header=header, q=q[k], dq=dq[k], tau_J=tau[k], time=0.1)
            writer.write(connection, int(t_ns[k]), types.serialize_ros1(content, kind))
    times, columns = read(tmp_path / "run.bag")[1]["/state"]
    np.testing.assert_array_equal(times, t_ns)
    np.testing.assert_array_equal(columns["tau_J[6]"], tau[:, 6])
    found = guess(open_raw(tmp_path / "run.bag")[0].streams)
    assert (found.columns["q"], found.columns["dq"], found.columns["tau"]) == ("q", "dq", "tau_J")


def test_messages_whose_arrays_change_their_length_are_separate_blocks(tmp_path):
    def make(size):
        def content(types):
            layout = types.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
            return types.types["std_msgs/msg/Float64MultiArray"](layout=layout, data=np.arange(float(size)))

        return content

    others = {"/torque": ("std_msgs/msg/Float64MultiArray", [(T_NS[k], make(2 if k == 3 else 3)) for k in range(9)])}
    (raw,) = open_raw(write_bag(tmp_path / "run", "mcap", {}, others), ["/torque"])
    blocks = list(raw.blocks())
    assert sorted(tuple(block.rows) for block in blocks) == [(0, 1, 2, 4, 5, 6, 7, 8), (3,)]


def test_a_broken_definition_is_named(tmp_path):
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        writer = McapWriter(file)
        writer.start()
        schema = writer.register_schema("my_msgs/msg/State", "ros2msg", b"float64[ q q")
        writer.add_message(writer.register_channel("/arm", "cdr", schema), 1, struct.pack("<I", 256), 1)
        writer.finish()
    with pytest.raises(RecordingError, match=r"log.mcap: topic /arm: the definition of its type my_msgs/msg/State"):
        read(path, ["/arm"])
