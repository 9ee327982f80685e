"""Files of every format, whole and damaged: the numbers come out as they were written, or one clear message does."""

from __future__ import annotations

import gzip
import shutil
import sqlite3

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from made_recordings import JOINTS, joint_rows, motion, write_bag
from scipy.io import savemat

from tauext.data.importers import ros
from tauext.data.importers.open_raw import open_raw
from tauext.errors import RecordingError

KINDS = ("ros1", "sqlite3", "mcap")


def read(path, topics=()):
    """Stream: stamps and columns by name, blocks joined."""
    streams: dict = {}
    (source,) = open_raw(path, topics)
    for block in source.blocks():
        held = streams.setdefault(block.stream, ([], {}))
        held[0].append(block.t_ns)
        for k, name in enumerate(block.names):
            held[1].setdefault(name, []).append(block.columns[:, k])
    return source, {
        stream: (None if t[0] is None else np.concatenate(t), {n: np.concatenate(c) for n, c in columns.items()})
        for stream, (t, columns) in streams.items()
    }


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_gives_header_stamps_and_every_joint_by_name(tmp_path, kind):
    path = write_bag(tmp_path / "run", kind, {"/joint_states": joint_rows()})
    source, streams = read(path)
    t_ns, q, dq, tau = motion()
    times, columns = streams["/joint_states"]
    assert source.name == "run"
    np.testing.assert_array_equal(times, t_ns)
    for array, values in (("position", q), ("velocity", dq), ("effort", tau)):
        for j, joint in enumerate(JOINTS):
            np.testing.assert_array_equal(columns[f"{array}[{joint}]"], values[:, j])


@pytest.mark.parametrize("kind", KINDS)
def test_the_bulk_view_gives_what_rosbags_gives_message_by_message(tmp_path, kind, monkeypatch):
    # Names of odd lengths shift the alignment; a missing velocity shortens the message.
    rows = [(t, s, ("a", "bc", "def", "ghij"), q, [], tau) for t, s, _, q, _, tau in joint_rows(("a",) * 4, 50)]
    path = write_bag(tmp_path / "run", kind, {"/arm": rows})
    _, bulk = read(path)
    monkeypatch.setattr(ros, "layout_of", lambda *_: None)
    _, slow = read(path)
    np.testing.assert_array_equal(bulk["/arm"][0], slow["/arm"][0])
    assert list(bulk["/arm"][1]) == list(slow["/arm"][1]) and len(bulk["/arm"][1]) == 8
    for name, values in bulk["/arm"][1].items():
        np.testing.assert_array_equal(values, slow["/arm"][1][name])


@pytest.mark.parametrize("kind", KINDS)
def test_a_gripper_on_the_same_topic_comes_as_columns_of_its_own(tmp_path, kind):
    arm, gripper = joint_rows(samples=40), joint_rows(("finger",), 40)
    path = write_bag(
        tmp_path / "run", kind, {"/joint_states": [row for pair in zip(arm, gripper, strict=True) for row in pair]}
    )
    columns = read(path)[1]["/joint_states"][1]
    np.testing.assert_array_equal(columns["position[tip]"], motion(40)[1][:, 2])
    np.testing.assert_array_equal(columns["position[finger]"], motion(40, joints=1)[1][:, 0])


@pytest.mark.parametrize("kind", KINDS)
def test_log_times_serve_where_all_stamps_are_zero(tmp_path, kind):
    rows = [(log, 0, *rest) for log, _, *rest in joint_rows()]
    source, streams = read(write_bag(tmp_path / "run", kind, {"/joint_states": rows}))
    np.testing.assert_array_equal(streams["/joint_states"][0], motion()[0] + 2_000_000)
    assert any("stamp of zero" in text for text in source.counts)


def test_a_message_without_a_stamp_among_stamped_ones_is_left_out(tmp_path):
    rows = joint_rows(samples=20)
    rows[7] = (rows[7][0], 0, *rows[7][2:])
    source, streams = read(write_bag(tmp_path / "run", "sqlite3", {"/joint_states": rows}))
    assert len(streams["/joint_states"][0]) == 19
    lost = "1 row left out: without a stamp among stamped ones, first message 8 of /joint_states"
    assert source.lost.sentences() == [lost]


@pytest.mark.parametrize("kind", KINDS)
def test_several_joint_state_topics_must_be_named(tmp_path, kind):
    path = write_bag(tmp_path / "run", kind, {"/left": joint_rows(samples=5), "/right": joint_rows(samples=5)})
    with pytest.raises(RecordingError, match=r"2 topics are of type .*: /left, /right; name the one"):
        open_raw(path)
    assert list(read(path, ["/right"])[1]) == ["/right"]
    with pytest.raises(RecordingError, match=r"no topic '/arm'; it has /left \(sensor_msgs/JointState, messages: 5\)"):
        open_raw(path, ["/arm"])


@pytest.mark.parametrize("kind", KINDS)
def test_a_topic_of_another_type_is_read_where_it_is_named(tmp_path, kind):
    def make(store):
        layout = store.types["std_msgs/msg/MultiArrayLayout"](dim=[], data_offset=0)
        return store.types["std_msgs/msg/Float64MultiArray"](layout=layout, data=np.array([1.0, 2.5]))

    others = {"/torque": ("std_msgs/msg/Float64MultiArray", [(10**18 + k * 10**7, make) for k in range(5)])}
    path = write_bag(tmp_path / "run", kind, {}, others)
    with pytest.raises(
        RecordingError, match="no topic of type sensor_msgs/JointState .*Float64MultiArray, messages: 5"
    ):
        open_raw(path)
    times, columns = read(path, ["/torque"])[1]["/torque"]
    np.testing.assert_array_equal(times, 10**18 + 10**7 * np.arange(5))
    assert (columns["data[1]"] == 2.5).all()


def test_a_bag_without_metadata_or_with_a_wrong_name_in_it_is_read_by_its_files(tmp_path):
    path = write_bag(tmp_path / "run", "sqlite3", {"/joint_states": joint_rows(samples=30)})
    metadata = path / "metadata.yaml"
    metadata.write_text(metadata.read_text().replace("run.db3", "ros2.db3"))
    source, streams = read(path)
    assert len(streams["/joint_states"][0]) == 30 and source.notes == [
        "metadata.yaml names ros2.db3, not there: read run.db3"
    ]
    metadata.unlink()
    assert read(path)[0].notes == ["no metadata.yaml: read run.db3"]
    (path / "run.db3").rename(path / "run.dat")
    assert len(read(path / "run.dat")[1]["/joint_states"][0]) == 30  # by content, not by name
    with pytest.raises(RecordingError, match="no .db3 or .mcap file; it is no ROS 2 bag"):
        open_raw(path)


def test_a_bag_without_message_definitions_is_read_by_the_standard_ones(tmp_path):
    path = write_bag(tmp_path / "run", "sqlite3", {"/joint_states": joint_rows(samples=30)}) / "run.db3"
    with sqlite3.connect(path) as database:
        database.execute("DELETE FROM message_definitions")
    source, streams = read(path)
    assert len(streams["/joint_states"][0]) == 30 and "no message definitions" in source.notes[0]


@pytest.mark.parametrize("kind", KINDS)
def test_empty_and_truncated_bags_are_refused_by_name(tmp_path, kind):
    whole = write_bag(tmp_path / "run", kind, {"/joint_states": joint_rows()})
    file = whole if kind == "ros1" else next(p for p in whole.iterdir() if p.suffix in (".db3", ".mcap"))
    cut = tmp_path / f"cut{file.suffix}"
    cut.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(RecordingError, match=f"{cut.name}: cannot be read as a ROS {1 if kind == 'ros1' else 2} bag"):
        read(cut)
    empty = write_bag(tmp_path / "empty", kind, {})
    with pytest.raises(RecordingError, match="empty"):
        read(empty)


def table(samples: int = 50) -> dict[str, np.ndarray]:
    t_ns, q, _, tau = motion(samples, joints=2)
    return {"time": (t_ns - t_ns[0]) * 1e-9, "q0": q[:, 0], "q1": q[:, 1], "tau0": tau[:, 0], "tau1": tau[:, 1]}


def csv_text(separator: str = ",", decimal: str = ".") -> str:
    columns = table()
    rows = [
        separator.join(columns),
        *(separator.join(map(repr, map(float, row))) for row in zip(*columns.values(), strict=True)),
    ]
    return "\n".join([rows[0], *(row.replace(".", decimal) for row in rows[1:])]) + "\n"


def assert_table(path):
    _, columns = read(path)[1][""]
    for name, values in table().items():
        np.testing.assert_array_equal(columns[name], values)


@pytest.mark.parametrize(("separator", "decimal"), [(",", "."), (";", "."), ("\t", "."), (" ", "."), (";", ",")])
def test_a_csv_is_read_with_any_separator_and_decimal_mark(tmp_path, separator, decimal):
    path = tmp_path / "run.csv"
    path.write_text(csv_text(separator, decimal))
    assert_table(path)


def test_a_gzipped_csv_is_told_by_its_bytes_and_a_truncated_one_refused(tmp_path):
    path = tmp_path / "run.dat"
    path.write_bytes(gzip.compress(csv_text().encode()))
    assert_table(path)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(RecordingError, match="run.dat: cannot be read as CSV to its end .*truncated"):
        read(path)


def test_the_broken_last_line_of_a_csv_is_left_out_and_counted(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text(csv_text() + "0.5,1.0,2.")
    source, streams = read(path)
    assert len(streams[""][1]["time"]) == 50
    assert source.counts == {"lines with a wrong number of cells left out": 1}
    path.write_text(csv_text() + "1,2\n" * 9)
    with pytest.raises(RecordingError, match="9 of 59 lines lack the 5 cells"):
        read(path)


def test_a_column_of_text_and_a_missing_header_are_no_obstacle(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("t,mode\n0.0,idle\n0.1,move\n")
    source, streams = read(path)
    assert list(streams[""][1]) == ["t"] and source.notes == ["columns of text left out: mode"]
    path.write_text("0.0,1\n0.1,2\n")
    assert read(path)[1][""][1]["column2"].tolist() == [1, 2]


def test_parquet_columns_and_lists_come_by_name(tmp_path):
    path = tmp_path / "run.parquet"
    lists = pa.FixedSizeListArray.from_arrays(pa.array(np.arange(100.0)), 2)
    pq.write_table(pa.table({**table(), "pair": lists, "note": ["x"] * 50}), path)
    assert_table(path)
    source, streams = read(path)
    np.testing.assert_array_equal(streams[""][1]["pair[1]"], np.arange(1.0, 100, 2))
    assert source.notes == ["columns without numbers left out: note"]


@pytest.mark.parametrize("across", [False, True])
def test_hdf5_arrays_may_lie_either_way(tmp_path, across):
    path = tmp_path / "run.h5"
    both = np.column_stack([table()["q0"], table()["q1"]])
    with h5py.File(path, "w") as file:
        file["arm/time"], file["arm/q"], file["gains"] = table()["time"], both.T if across else both, np.ones(7)
    source, streams = read(path)
    np.testing.assert_array_equal(streams[""][1]["arm/q[1]"], table()["q1"])
    assert source.notes == ["arrays of another length than 50 left out: gains (7)"]


def test_matlab_structs_of_version_5_and_7_3_come_alike(tmp_path):
    both = np.column_stack([table()["q0"], table()["q1"]])
    savemat(tmp_path / "old.mat", {"rec": {"q": both.T, "t": table()["time"]}, "gain": 3.0})
    new = tmp_path / "new.mat"
    with h5py.File(new, "w", userblock_size=512) as file:
        file["rec/q"], file["rec/t"] = both, table()["time"][None]
    with new.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, written by a test".ljust(124) + b"\0\2IM")
    for name in ("old.mat", "new.mat"):
        _, columns = read(tmp_path / name)[1][""]
        np.testing.assert_array_equal(columns["rec.q[1]"], table()["q1"])
        np.testing.assert_array_equal(columns["rec.t"], table()["time"])


@pytest.mark.parametrize("name", ["run.parquet", "run.h5", "run.mat"])
def test_truncated_tables_are_refused_by_name(tmp_path, name):
    path = tmp_path / name
    if name == "run.parquet":
        pq.write_table(pa.table(table()), path)
    elif name == "run.h5":
        with h5py.File(path, "w") as file:
            file["q"] = np.arange(4000.0)
    else:
        savemat(path, {"q": np.arange(4000.0)})
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(RecordingError, match=f"{name}: cannot be read as .*copy it again"):
        read(path)


def test_files_of_no_known_format_are_refused(tmp_path):
    path = tmp_path / "run.bag"
    with pytest.raises(RecordingError, match="there is no such file"):
        open_raw(path)
    path.write_bytes(b"")
    with pytest.raises(RecordingError, match="the file is empty"):
        open_raw(path)
    path.write_bytes(b"\1\2\0\3")
    with pytest.raises(RecordingError, match="of no format that is read; these are: ROS 1 bag"):
        open_raw(path)
    path.write_text("A licence.\nMany words,\nno numbers.\n")
    with pytest.raises(RecordingError, match="no table of numbers; its first line is 'A licence.'"):
        open_raw(path)


def test_split_files_of_one_bag_come_in_their_order(tmp_path):
    rows = joint_rows(samples=30)
    (tmp_path / "bag").mkdir()
    for k, part in ((2, rows[:10]), (10, rows[10:])):
        written = write_bag(tmp_path / f"part{k}", "sqlite3", {"/joint_states": part})
        shutil.copy(written / f"part{k}.db3", tmp_path / "bag" / f"bag_{k}.db3")
    np.testing.assert_array_equal(read(tmp_path / "bag")[1]["/joint_states"][0], motion(30)[0])
