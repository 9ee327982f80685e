"""Files that harm the reader: too deep, too large, stored elsewhere, with names that act on a terminal."""

from __future__ import annotations

import re
import struct
import tomllib
import zlib
from pathlib import Path

import h5py
import numpy as np
import pytest

from tauext.cli.recordings import write_template
from tauext.data.importers.open_raw import open_raw
from tauext.errors import RecordingError, RobotError
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
