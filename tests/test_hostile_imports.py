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

from tauext.cli.recordings import write_template
from tauext.data.importers.bag import decompressed
from tauext.data.importers.open_raw import open_raw
from tauext.errors import ConfigError, RecordingError, RobotError
from tauext.files.plain_file import parse_toml
from tauext.robot.read import load_tree

TIME_S = np.arange(100) * 0.01


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
    monkeypatch.setattr("tauext.data.importers.hdf5.MOST_UNPACKED", 1 << 20)
    count = 1_000_000
    head = struct.pack("<IIII", 6, 8, 9, 0) + struct.pack("<IIii", 5, 8, count, 1) + struct.pack("<II", 1, 1)
    body = head + b"q".ljust(8, b"\0") + struct.pack("<II", 2, count) + bytes(count)
    packed = zlib.compress(struct.pack("<II", 14, len(body)) + body, 9)
    beginning = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    path = tmp_path / "log.mat"
    path.write_bytes(beginning + struct.pack("<II", 15, len(packed)) + packed)
    assert open_raw(path)[0].streams[""] == ("q",)  # 1 MB is no harm
    monkeypatch.setattr("tauext.data.importers.hdf5.MOST_UNPACKED", 1 << 18)
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
    monkeypatch.setattr("tauext.data.importers.parquet.MOST_UNPACKED", 1 << 20)
    pq.write_table(pa.table({"time": np.arange(rows) * 1e-3} | constant), path)  # a simulated arm at rest
    assert open_raw(path)[0].streams[""][:2] == ("time", "q_a")
    pq.write_table(pa.table({"time": np.zeros(rows)} | constant), path, row_group_size=rows)
    with pytest.raises(
        RecordingError, match="states 1,400,000 values, which unpack to more than .* is packed like that"
    ):
        open_raw(path)
    wide = pa.array([[0.0] * 4000] * 100)
    pq.write_table(pa.table({"time": TIME_S, "picture": wide}), path)
    monkeypatch.setattr("tauext.data.importers.parquet.MOST_UNPACKED", 1 << 30)
    monkeypatch.setattr("tauext.data.importers.parquet.MOST_VALUES", 1 << 15)
    assert sum(len(block.columns) for block in open_raw(path)[0].blocks()) == 100  # a few rows at a time


def test_a_gzipped_table_that_unpacks_to_hundreds_of_its_size_is_refused(tmp_path, monkeypatch):
    path = tmp_path / "log.csv.gz"
    path.write_bytes(gzip.compress(b"time,q_a\n" + b"0.001,1\n" * 300_000))
    open_raw(path)  # 2 MB is no harm
    monkeypatch.setattr("tauext.data.importers.csv_table.MOST_UNPACKED", 1 << 20)
    with pytest.raises(RecordingError, match="unpacks to more than .*, from .*; no recording is packed like that"):
        list(open_raw(path)[0].blocks())


@pytest.mark.parametrize("codec", ["zstd", "lz4"])
def test_a_part_of_a_bag_unpacks_to_a_thousand_times_its_size_at_most(codec):
    packed = pa.compress(bytes(1 << 27), codec, asbytes=True) if codec == "zstd" else lz4_frame(bytes(1 << 27))
    assert len(packed) < 1 << 20
    part, whole = decompressed(packed, codec)
    assert len(part) <= max(1 << 26, 1000 * len(packed)) and (whole or codec == "zstd")
    assert decompressed(pa.compress(b"few", "zstd", asbytes=True), "zstd") == (b"few", True)


def lz4_frame(data: bytes) -> bytes:
    sink = pa.BufferOutputStream()
    with pa.CompressedOutputStream(sink, "lz4") as stream:
        stream.write(data)
    return sink.getvalue().to_pybytes()


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
