"""Files that harm the reader: too deep, too large, stored elsewhere, with names that act on a terminal."""

from __future__ import annotations

import gzip
import re
import struct
import tomllib
import zlib
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from made_recordings import message
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore
from test_import_bags import SAMPLES, write_mcap

from tauext.cli.recordings import write_template
from tauext.data.importers.bag import decompressed
from tauext.data.importers.open_raw import open_raw
from tauext.errors import ConfigError, RecordingError, RobotError
from tauext.files.plain_file import parse_toml
from tauext.robot.read import load_tree

TIME_S = np.arange(100) * 0.01
UNPACKS = "it unpacks to more than .*, from .*; no recording is packed like that"


def test_metadata_of_deep_brackets_is_refused_in_one_sentence(tmp_path):
    (tmp_path / "metadata.yaml").write_text("[" * 100_000)
    with pytest.raises(RecordingError, match="not the metadata of a ROS 2 bag"):
        open_raw(tmp_path)


@pytest.mark.parametrize("name", ["q", "joint_names", "rate_hz"])
@pytest.mark.parametrize("kind", ["external", "virtual"])
def test_datasets_in_other_files_are_not_read(tmp_path, kind, name):
    secret = tmp_path / "secret.bin"
    secret.write_bytes(np.arange(200.0).tobytes())
    path = tmp_path / "log.h5"
    shape, dtype = {"q": ((100, 2), "f8"), "joint_names": ((2,), "S8"), "rate_hz": ((1,), "f8")}[name]
    with h5py.File(path, "w") as file:
        file["time"] = TIME_S
        file["dq"] = np.zeros((100, 2))
        if kind == "external":
            file.create_dataset(name, shape, dtype, external=[(str(secret), 0, int(np.prod(shape)) * 8)])
        else:
            layout = h5py.VirtualLayout(shape, dtype)
            layout[...] = h5py.VirtualSource(str(secret), name, shape)
            file.create_virtual_dataset(name, layout)
    with pytest.raises(RecordingError, match=rf"'/{name}' is stored in other files \('.*secret.bin'\)"):
        open_raw(path)


def test_datasets_that_state_far_more_than_is_stored_are_refused(tmp_path):
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file.create_dataset("q", (10**10, 2), "f8", chunks=(1000, 2), compression="gzip")[:10] = 1.0
    with pytest.raises(RecordingError, match="'/q' states 160 GB, and .* bytes are stored"):
        open_raw(tmp_path / "log.h5")


def test_a_matlab_file_that_unpacks_to_hundreds_of_its_size_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("tauext.files.unpacking.LEAST", 1 << 20)
    count = 1_000_000
    head = struct.pack("<IIII", 6, 8, 9, 0) + struct.pack("<IIii", 5, 8, count, 1) + struct.pack("<II", 1, 1)
    body = head + b"q".ljust(8, b"\0") + struct.pack("<II", 2, count) + bytes(count)
    packed = zlib.compress(struct.pack("<II", 14, len(body)) + body, 9)
    beginning = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    path = tmp_path / "log.mat"
    path.write_bytes(beginning + struct.pack("<II", 15, len(packed)) + packed)
    assert open_raw(path)[0].streams[""] == ("q",)  # 1 MB is no harm
    monkeypatch.setattr("tauext.files.unpacking.LEAST", 1 << 18)
    with pytest.raises(RecordingError, match="unpacks to more than 262 kB, from .* no recording is packed like that"):
        open_raw(path)


def test_names_with_control_characters_are_escaped_in_the_description(tmp_path):
    names = ["a\x01\x7f", "b\U0001f600"]
    columns = [f"{signal}_{name}" for signal in ("q", "dq", "tau") for name in names]
    rows = [",".join(map(str, [t, *np.sin(np.arange(6) + t)])) for t in TIME_S]
    path = tmp_path / "log.csv"
    path.write_text("\n".join([",".join(["time", *columns, "x\x1b[31m"]), *(f"{row},0" for row in rows)]) + "\n")
    write_template(tmp_path / "arm.toml", (path,), None)
    text = (tmp_path / "arm.toml").read_text()
    assert tomllib.loads(text)["robot"]["joints"] == names
    assert not re.search(r"[^\n\t\x20-\x7e\x80-\U0010ffff]", text)
    assert r"not in use: x\x1b" in text


@pytest.mark.parametrize("kind", ["slide", "hinge"])
def test_a_body_outside_of_worldbody_is_named(tmp_path: Path, kind):
    inertial = '<inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>'
    body = f'<body name="arm"><joint name="j" type="{kind}"/>{inertial}</body>'
    path = tmp_path / "arm.xml"
    path.write_text(f"<mujoco>\n{body}<worldbody/></mujoco>")
    with pytest.raises(RobotError, match=r"line 2: <body> 'arm' lies outside of <worldbody>; move it into"):
        load_tree(path)
    path.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    assert load_tree(path).size == 1


def test_a_parquet_file_that_states_far_more_than_is_stored_is_refused_and_one_of_a_resting_arm_is_read(
    tmp_path, monkeypatch
):
    path, rows = tmp_path / "log.parquet", 200_000
    constant = {name: np.zeros(rows) for name in ("q_a", "q_b", "dq_a", "dq_b", "tau_a", "tau_b")}
    monkeypatch.setattr("tauext.files.unpacking.LEAST", 1 << 20)
    pq.write_table(pa.table({"time": np.arange(rows) * 1e-3} | constant), path)  # a simulated arm at rest
    assert open_raw(path)[0].streams[""][:2] == ("time", "q_a")
    pq.write_table(pa.table({"time": np.zeros(rows)} | constant), path, row_group_size=rows)
    with pytest.raises(RecordingError, match=UNPACKS):
        open_raw(path)
    wide = pa.array([[0.0] * 4000] * 100)
    pq.write_table(pa.table({"time": TIME_S, "picture": wide}), path)
    monkeypatch.setattr("tauext.files.unpacking.LEAST", 1 << 30)
    monkeypatch.setattr("tauext.data.importers.parquet.MOST_VALUES", 1 << 15)
    assert sum(len(block.columns) for block in open_raw(path)[0].blocks()) == 100  # a few rows at a time


def test_a_gzipped_table_that_unpacks_to_hundreds_of_its_size_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "log.csv.gz"
    path.write_bytes(gzip.compress(b"time,q_a\n" + b"0.001,1\n" * 300_000))
    open_raw(path)  # 2 MB is no harm
    monkeypatch.setattr("tauext.files.unpacking.LEAST", 1 << 20)
    with pytest.raises(RecordingError, match=UNPACKS):
        list(open_raw(path)[0].blocks())


@pytest.mark.parametrize("codec", ["zstd", "lz4", "bz2"])
def test_a_part_of_a_bag_is_bounded(codec, monkeypatch):
    monkeypatch.setattr("tauext.files.unpacking.LEAST", 1 << 20)
    for data in (b"few", bytes(1 << 20)):
        assert decompressed(packed(data, codec), codec) == (data, True)
    part, whole = decompressed(packed(bytes(1 << 24), codec), codec)
    assert len(part) <= 1 << 20 and not whole
    assert decompressed(packed(b"0123456789" * 20, codec)[:-5], codec)[1] is False


def packed(data: bytes, codec: str) -> bytes:
    sink = pa.BufferOutputStream()
    with pa.CompressedOutputStream(sink, codec) as stream:
        stream.write(data)
    return sink.getvalue().to_pybytes()


@pytest.mark.parametrize("end", ["index", "cut off"])
@pytest.mark.parametrize("codec", ["bz2", "lz4"])
def test_a_ros_1_bag_whose_parts_unpack_to_hundreds_of_its_size_is_refused(tmp_path, monkeypatch, codec, end):
    """With an index another library unpacks its parts; without one, tauext does."""
    rows = [(1_000_000 * k, 1_000_000 * k, ("a",), [0.0], [0.0], [0.0]) for k in range(60_000)]
    path = tmp_path / "log.bag"
    bag = Writer(path)
    bag.set_compression(Writer.CompressionFormat[codec.upper()])
    with bag:
        store = get_typestore(Stores.ROS1_NOETIC)
        topic = bag.add_connection("/joint_states", "sensor_msgs/msg/JointState", typestore=store)
        for stamp_ns, _, names, *signals in rows:
            raw = store.serialize_ros1(message(store, 0, names, *signals, ros1=True), topic.msgtype)
            bag.write(topic, stamp_ns, raw)
    if end == "cut off":
        path.write_bytes(path.read_bytes()[: int(0.97 * path.stat().st_size)])
    assert sum(len(block.columns) for block in open_raw(path)[0].blocks()) > 50_000
    monkeypatch.setattr("tauext.files.unpacking.LEAST", 1 << 21)
    monkeypatch.setattr("tauext.files.unpacking.RATIO", 0)
    with pytest.raises(RecordingError, match=UNPACKS):
        sum(len(block.columns) for block in open_raw(path)[0].blocks())


def test_an_mcap_file_of_many_small_parts_that_unpack_to_far_more_is_refused(tmp_path, monkeypatch):
    path = write_mcap(tmp_path / "log.mcap")
    assert sum(len(block.columns) for block in open_raw(path)[0].blocks()) == SAMPLES
    monkeypatch.setattr("tauext.files.unpacking.LEAST", 1 << 14)
    monkeypatch.setattr("tauext.files.unpacking.RATIO", 0)
    with pytest.raises(RecordingError, match=UNPACKS):
        sum(len(block.columns) for block in open_raw(path)[0].blocks())


def arrow_file(path: Path, table: pa.Table, codec: str | None) -> None:
    with pa.ipc.new_file(path, table.schema, options=pa.ipc.IpcWriteOptions(compression=codec)) as file:
        file.write_table(table)


def bombs() -> dict[str, pa.Table]:
    zeros = np.zeros(1 << 20)
    lists = pa.FixedSizeListArray.from_arrays(pa.array(zeros), 1 << 19)
    return {
        "zeros": pa.table({"time": zeros, "q_a": zeros}),
        "nulls": pa.table({"time": pa.nulls(1 << 20), "q_a": pa.nulls(1 << 20)}),
        "dictionary": pa.table({"q_a": pa.DictionaryArray.from_arrays(np.zeros(9, np.int32), zeros)}),
        "lists": pa.table({"time": [0.0, 1.0], "q": lists}),
        "text": pa.table({"q_a": ["0" * (1 << 23)]}),
    }


@pytest.mark.parametrize("kind", bombs())
@pytest.mark.parametrize("codec", ["zstd", "lz4"])
def test_an_arrow_file_that_unpacks_to_far_more_is_refused_before_it_is_unpacked(tmp_path, monkeypatch, kind, codec):
    path = tmp_path / "log.arrow"
    arrow_file(path, bombs()[kind], codec)
    monkeypatch.setattr("tauext.files.unpacking.LEAST", 1 << 20)
    monkeypatch.setattr("pyarrow.ipc.open_stream", None)  # no batch is unpacked
    with pytest.raises(RecordingError, match=UNPACKS):
        open_raw(path)


@pytest.mark.parametrize("codec", [None, "zstd", "lz4"])
def test_an_arrow_file_of_motion_is_read(tmp_path, monkeypatch, codec):
    path, rows = tmp_path / "log.arrow", 30_000
    q = np.random.default_rng(0).uniform(-1, 1, (rows, 3))
    time = pa.array(np.arange(rows) * 1e-3, mask=np.arange(rows) == 5)
    arm = pa.array(["left"] * rows).dictionary_encode()
    arrow_file(path, pa.table({"time": time, "q": pa.FixedSizeListArray.from_arrays(q.ravel(), 3), "arm": arm}), codec)
    monkeypatch.setattr("tauext.files.unpacking.LEAST", 1 << 20)
    found = np.concatenate([block.columns for block in open_raw(path)[0].blocks()])
    np.testing.assert_array_equal(found[:, 1:], q)
    assert np.flatnonzero(np.isnan(found[:, 0])).tolist() == [5]


@pytest.mark.parametrize("line", ["", " \t", "# no", ",", "x"])
def test_a_table_of_lines_that_are_no_rows_is_refused_soon(tmp_path, monkeypatch, line):
    head, path = "time,q_a\n" + "".join(f"{k},{k}\n" for k in range(5)), tmp_path / "log.csv.gz"
    path.write_bytes(gzip.compress((head + f"{line}\n" * 200_000).encode()))
    monkeypatch.setattr("tauext.data.importers.csv_table.MOST_OTHER", (100_000, 20))
    blocks = open_raw(path)[0].blocks()
    if line == ",":  # rows without a number
        assert sum(len(block.columns) for block in blocks) == 200_005
        return
    with pytest.raises(RecordingError, match="of its first 200,00. lines are blank, comments or broken"):
        list(blocks)


@pytest.mark.parametrize(
    "text", ["a" + ".a" * 200_000 + " = 1", "[" + "a." * 50_000 + "a]", "a={" + "b." * 90_000 + "c=1}"]
)
def test_keys_of_many_parts_are_refused_at_once(tmp_path, text):
    with pytest.raises(ConfigError, match="nested too deeply"):
        parse_toml(text, tmp_path / "arm.toml")
    assert parse_toml('a.b-c."d" = [1.5, 2.5]', tmp_path / "arm.toml") == {"a": {"b-c": {"d": [1.5, 2.5]}}}


@pytest.mark.parametrize("name", ["j&#10;x", "j&#155;31m"])
def test_a_joint_name_that_acts_on_a_terminal_is_refused(tmp_path, name):
    path = tmp_path / "arm.urdf"
    path.write_text(f'<robot name="r"><link name="a"/><link name="b"/>\n<joint name="{name}" type="fixed"/></robot>')
    with pytest.raises(RobotError, match=r"line 2: the name 'j\\.*' has characters that cannot be printed"):
        load_tree(path)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('<replicate count="100000000">{}</replicate>', "<replicate> makes 1e[+]08 copies"),
        (
            '<replicate count="1000"><replicate count="1000">{}</replicate></replicate>',
            "<replicate> makes 1e[+]06 copies",
        ),
        ('{}<geom type="hfield" hfield="h"/>', "<hfield> makes 1e[+]10 cells"),
    ],
)
def test_a_robot_file_that_makes_millions_of_parts_is_refused(tmp_path, text, said):
    body = '<body><joint name="j"/><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/></body>'
    size = 100_000 if "hfield" in text else 10
    field = f'<asset><hfield name="h" nrow="{size}" ncol="{size}" size="1 1 1 1"/></asset>'
    path = tmp_path / "arm.xml"
    path.write_text(f"<mujoco>{field}<worldbody>\n{text.format(body)}</worldbody></mujoco>")
    with pytest.raises(RobotError, match=f"line .: {said}; at most"):
        load_tree(path)
    path.write_text(f"<mujoco>{field.replace('100000', '10')}<worldbody>\n{body}</worldbody></mujoco>")
    assert load_tree(path).size == 1


def test_groups_in_groups_without_end_are_refused(tmp_path):
    with h5py.File(tmp_path / "log.h5", "w") as file:
        file["/".join("g" * 40) + "/q"] = np.ones(100)
    with pytest.raises(RecordingError, match="groups lie more than 32 deep in each other"):
        open_raw(tmp_path / "log.h5")


def test_a_table_of_far_too_many_columns_is_refused_before_their_names_are_compared(tmp_path):
    path, count = tmp_path / "log.csv", 21_000
    rows = [",".join(f"c{k}" for k in range(count)), *[",".join("1" * count)] * 3]
    path.write_text("\n".join(rows) + "\n")
    with pytest.raises(RecordingError, match="more than 20,000 columns; an arm has hundreds"):
        write_template(tmp_path / "arm.toml", (path,), None)
