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

from tauext.data.importers import csv_table, ros
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
def test_several_joint_state_topics_are_read_until_one_is_named(tmp_path, kind):
    path = write_bag(tmp_path / "run", kind, {"/left": joint_rows(samples=5), "/right": joint_rows(samples=5)})
    assert list(read(path)[1]) == ["/left", "/right"]
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
def test_an_empty_bag_is_refused(tmp_path, kind):
    with pytest.raises(RecordingError, match="empty"):
        read(write_bag(tmp_path / "empty", kind, {}))


def table(samples: int = 50) -> dict[str, np.ndarray]:
    t_ns, q, _, tau = motion(samples, joints=2)
    return {"time": (t_ns - t_ns[0]) * 1e-9, "q0": q[:, 0], "q1": q[:, 1], "tau0": tau[:, 0], "tau1": tau[:, 1]}


HEADER = list(table())
ROWS = [list(map(repr, map(float, row))) for row in zip(*table().values(), strict=True)]


def lines(header: list[str] = HEADER, rows: list[list[str]] = ROWS, separator: str = ",", end: str = "\n") -> str:
    return "".join(separator.join(row) + end for row in [header, *rows])


def commas(rows: list[list[str]] = ROWS) -> list[list[str]]:
    return [[cell.replace(".", ",") for cell in row] for row in rows]


def padded(rows: list[list[str]], width: int = 26) -> list[list[str]]:
    return [[cell.rjust(width) for cell in row] for row in rows]


def quoted(rows: list[list[str]]) -> list[list[str]]:
    return [[f'"{cell}"' for cell in row] for row in rows]


def more(*cells: str, rows: list[list[str]] = ROWS) -> list[list[str]]:
    return [[*row, *cells] for row in rows]


def assert_table(path, samples: int = 50):
    source, streams = read(path)
    t_ns, columns = streams[""]
    assert t_ns is None and not source.lost.count
    for name, values in table(samples).items():
        np.testing.assert_array_equal(columns[name], values)
    return source, columns


SAME_CSV = {
    "commas": lines(),
    "semicolons": lines(separator=";"),
    "tabs": lines(separator="\t"),
    "pipes": lines(separator="|"),
    "blanks": lines(separator=" "),
    "decimal commas and semicolons": lines(rows=commas(), separator=";"),
    "decimal commas and tabs": lines(rows=commas(), separator="\t"),
    "decimal commas and blanks": lines(rows=commas(), separator=" "),
    "decimal commas in quotes": lines(quoted([HEADER])[0], quoted(commas())),
    "columns aligned by blanks": lines(padded([HEADER])[0], padded(ROWS), ""),
    "aligned with commas": lines(padded([HEADER])[0], padded(ROWS)),
    "blanks at both ends of lines": lines(["", *HEADER, ""], [["", *row, ""] for row in ROWS], "   "),
    "text with a comma between semicolons": lines([*HEADER, "mode"], more('"a, b"'), ";"),
    "text with semicolons between commas": lines([*HEADER, "mode"], more("a; b; c")),
    "names in quotes": lines(quoted([HEADER])[0], quoted(ROWS)),
    "another separator in the names": lines(rows=[], separator=",") + lines(separator=";").split("\n", 1)[1],
    "Windows line ends": lines(end="\r\n"),
    "old Mac line ends": lines(end="\r"),
    "no end of the last line": lines().rstrip("\n"),
    "separators at the ends of all lines": lines([*HEADER, ""], more("")),
    "separators at the ends of the rows": lines(HEADER, more("")),
    "a separator at the end of the names": lines([*HEADER, ""]),
    "blank lines": lines(end="\n\n"),
    "a title": "Log of the arm, 2024-05-01 12:00\n\n" + lines(),
    "entries before the names": "robot: ur5\ndate: 2024-05-01\nsession = 12\n\n" + lines(),
    "comments before the names": "# robot, ur5\n# 3 of 5\n// by hand\n" + lines(),
    "names in a comment": "# the arm\n# " + lines(separator=" "),
    "names in a MATLAB comment": "% " + lines(separator=" "),
    "units under the names": lines(rows=[["s", "rad", "rad", "Nm", "Nm"], *ROWS]),
    "units in brackets": lines(rows=[["[s]", "[deg/s]", "(rad)", "[N m]", "-"], *ROWS]),
    "a rule under the names": lines(rows=[["---"] * 5, *ROWS]),
    "Excel's separator": "sep=;\r\n" + lines(separator=";", end="\r\n"),
    "an index without a name": lines(["", *HEADER], [[str(k), *row] for k, row in enumerate(ROWS)]),
    "an index that the names lack": lines(HEADER, [[str(k), *row] for k, row in enumerate(ROWS)], " "),
    "a comment amid the rows": lines(rows=[*ROWS[:20], ["# stop"], *ROWS[20:]]),
    "names again amid the rows": lines(rows=[*ROWS[:20], HEADER, *ROWS[20:]]),
    "exponents of Fortran": lines(rows=[[cell + "D+00" * ("e" not in cell) for cell in row] for row in ROWS]),
    "plus signs": lines(rows=[["+" * (cell[0] != "-") + cell for cell in row] for row in ROWS]),
    "zeros after a crash": lines() + "\0" * 200,
    "several tabs between cells": lines(separator="\t\t"),
    "uneven tabs and blanks": lines(
        rows=[[" " * (k % 3) + row[0], *row[1:]] for k, row in enumerate(ROWS)], separator="\t "
    ),
    "another decimal mark in a column": lines([*HEADER, "temperature"], more("20.5", rows=commas()), ";"),
    "a first row without values": lines(rows=[["nan"] * 5, *ROWS]),
    "a text with a comma in some rows": lines(
        [*HEADER, "event"], [[*row, "stop, go" if k == 7 else "go"] for k, row in enumerate(ROWS)]
    ),
    "an index of dates": lines(HEADER, [[f"2024-05-{k % 28 + 1:02d}", *row] for k, row in enumerate(ROWS)], "  "),
}


@pytest.mark.parametrize("variation", SAME_CSV)
def test_a_csv_of_each_dialect_gives_the_same_numbers(tmp_path, variation):
    path = tmp_path / "run.csv"
    path.write_bytes(SAME_CSV[variation].encode())
    assert_table(path)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-be", "latin-1"])
def test_a_csv_of_each_encoding_gives_the_same_numbers(tmp_path, encoding, end):
    path = tmp_path / "run.csv"
    text = lines([*HEADER, "Kraft_ä"], more("1.5"), end=end)
    path.write_bytes(b"\xfe\xff" * (encoding == "utf-16-be") + text.encode(encoding))
    assert (assert_table(path)[1]["Kraft_ä"] == 1.5).all()


def test_a_gzipped_csv_is_found_by_its_bytes_and_a_truncated_one_refused(tmp_path):
    path = tmp_path / "run.dat"
    path.write_bytes(gzip.compress(lines().encode()))
    assert_table(path)
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(
        RecordingError, match=r"run.dat: cannot be read as gzipped CSV .* truncated or damaged; copy it"
    ):
        read(path)


def test_names_of_csv_columns(tmp_path):
    path = tmp_path / "run.csv"
    for text, names in (
        ("0.0,1,a\n0.1,2,b\n", ["column1", "column2"]),
        ("0,1,2\n0.0,0.5,1\n0.1,0.5,2\n", ["0", "1", "2"]),
        (",t,q\n0,0.0,1\n1,0.1,2\n", ["column1", "t", "q"]),
        ("t,q,q,tau\n0,1,2,3\n1,2,3,4\n", ["t", "q[0]", "q[1]", "tau"]),
        ('t,q\n0,"[0.1, 0.2]"\n1,"[0.3, 0.4]"\n', ["t", "q[0]", "q[1]"]),
        ("time,1,2\n0.0,0.5,1\n0.1,0.5,2\n", ["time", "1", "2"]),
        ("time [s] q1 [deg]\n0.0 0.5\n0.1 0.6\n", ["time [s]", "q1 [deg]"]),
        ("Time stamp   Joint 1\n0.0   0.5\n0.1   0.6\n", ["Time stamp", "Joint 1"]),
        ("t;q;name\n0;(0.1, 0.2);['b', 'a']\n1;(0.3, 0.4);['b', 'a']\n", ["t", "q[b]", "q[a]"]),
        ("t;q\n0;array('d', [0.1, 0.2])\n1;array('d', [0.3, 0.4])\n", ["t", "q[0]", "q[1]"]),
        ("header.stamp.secs,header.stamp.nsecs,q\n5,6,1\n5,7,1\n", ["header.stamp.secs", "header.stamp.nsecs", "q"]),
        ("t,mode\n0.0,idle\n0.1,move\n", ["t"]),
    ):
        path.write_text(text)
        assert list(read(path)[1][""][1]) == names
    assert read(path)[0].notes == ["columns of text left out: mode"]


STAMPS = {
    "ISO 8601": ("2024-05-01T23:59:{:06.3f}Z", "2024-05-01T23:59"),
    "ISO 8601, basic": ("20240501T2359{:06.3f}", "2024-05-01T23:59"),
    "basic, in UTC": ("20240501T2359{:06.3f}Z", "2024-05-01T23:59"),
    "basic, a zone": ("20240502_0159{:06.3f}+0200", "2024-05-01T23:59"),
    "a zone": ("2024-05-02 01:59:{:06.3f}+02:00", "2024-05-01T23:59"),
    "microseconds": ("2024-05-01 23:59:{:09.6f}", "2024-05-01T23:59"),
    "slashes": ("2024/05/01 23:59:{:06.3f}", "2024-05-01T23:59"),
    "day first": ("01.05.2024 23:59:{:06.3f}", "2024-05-01T23:59"),
    "month first": ("05/01/2024 11:59:{:06.3f} PM", "2024-05-01T23:59"),
    "MATLAB": ("01-May-2024 23:59:{:06.3f}", "2024-05-01T23:59"),
    "time of day": ("23:59:{:06.3f}", "1970-01-01T23:59"),
    "duration": ("1 days 23:59:{:06.3f}", "1970-01-02T23:59"),
}


@pytest.mark.parametrize("form", STAMPS)
def test_a_column_of_dates_or_times_is_the_clock(tmp_path, form):
    path = tmp_path / "run.csv"
    pattern, begin = STAMPS[form]
    rows = [[pattern.format(k * 0.02), *row[1:]] for k, row in enumerate(ROWS)]
    path.write_text(lines(rows=rows))
    source, streams = read(path)
    t_ns, columns = streams[""]
    np.testing.assert_array_equal(t_ns, np.datetime64(begin, "ns").astype(np.int64) + 20_000_000 * np.arange(50))
    np.testing.assert_array_equal(columns["q0"], table()["q0"])
    assert source.clocks == ("time", "") and "time" not in columns
    assert source.notes == ["stamps from column 'time', which has dates or times"]


def test_a_basic_stamp_with_a_decimal_comma_is_the_clock(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("time;q\n" + "".join(f"20240501T2359{k:02d},250;{k},5\n" for k in range(50)))
    t_ns, columns = read(path)[1][""]
    begin = np.datetime64("2024-05-01T23:59:00.250", "ns").astype(np.int64)
    np.testing.assert_array_equal(t_ns, begin + 10**9 * np.arange(50))
    np.testing.assert_array_equal(columns["q"], np.arange(50) + 0.5)


def test_a_column_of_times_that_is_not_read_is_named(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("when,mode,robot,q\n" + "".join(f"10h00m{k:02d},idle,UR5,{k}\n" for k in range(50)))
    source, _ = read(path)
    assert source.hints() == ["column 'when' is text such as '10h00m00', no form of date or time that is read"]


def test_times_of_day_continue_over_midnight_and_the_finest_clock_is_used(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("date,clock,q\n2024-05-01,23:59:59.98,1\n2024-05-01,23:59:59.99,1\n2024-05-02,00:00:00.00,1\n")
    np.testing.assert_array_equal(np.diff(read(path)[1][""][0]), 10_000_000)
    path.write_text("date,log,q\n" + "".join(f"12:00:00,2024-05-01T12:00:00.{k:03d},1\n" for k in range(5)))
    source, streams = read(path)
    np.testing.assert_array_equal(np.diff(streams[""][0]), 1_000_000)
    assert source.notes[1] == "further columns of dates or times left out: date"


LEFT_OUT = {
    "too few cells": ["0.5", "1.0"],
    "too many cells": ["0.5"] * 6,
    "a quote without its end": ["0.5", '"1.0', "2", "3", "4"],
    "zero bytes": ["\0\0"] * 5,
}


@pytest.mark.parametrize("kind", LEFT_OUT)
def test_a_broken_line_is_left_out_and_counted_with_its_place(tmp_path, kind):
    path = tmp_path / "run.csv"
    path.write_text("# a comment\n\n" + lines(rows=[*ROWS[:20], LEFT_OUT[kind], *ROWS[20:]]))
    source, streams = read(path)
    np.testing.assert_array_equal(streams[""][1]["tau1"], table()["tau1"])
    assert source.lost.sentences() == ["1 row left out: a wrong number of cells, first line 24"]
    (block,) = source.blocks()
    assert source.position(block.rows[19]) == "line 23" and source.position(block.rows[20]) == "line 25"


@pytest.mark.parametrize(
    "word", ["", "None", "#N/A", "-", "--", "inf", "1.#QNAN", "nan(ind)", "true", "ERROR 3", "1.2.3"]
)
def test_a_cell_without_a_number_is_missing_wherever_it_lies(tmp_path, word):
    path = tmp_path / "run.csv"
    for at in (0, 30, 49):
        rows = [list(row) for row in ROWS]
        rows[at][3] = word
        path.write_text(lines(rows=rows))
        source, streams = read(path)
        columns = streams[""][1]
        expected = np.where(np.arange(50) == at, np.nan, table()["tau0"])
        np.testing.assert_array_equal(np.where(np.isfinite(columns["tau0"]), columns["tau0"], np.nan), expected)
        np.testing.assert_array_equal(columns["tau1"], table()["tau1"])
        assert not source.lost.count


def test_a_stamp_of_damaged_bytes_costs_one_row(tmp_path):
    path = tmp_path / "run.csv"
    rows = [f"2024-05-01 12:00:0{k}.5,{k}" for k in range(5)]
    path.write_bytes("\n".join(["stamp,q", *rows]).encode().replace(b":03.5", b":0\xff.5"))
    source, streams = read(path)
    np.testing.assert_array_equal(streams[""][1]["q"], [0, 1, 2, 4])
    assert source.lost.sentences() == ["1 row left out: 'stamp', its time, is missing, first line 5"]


def test_flags_are_numbers_and_a_column_without_values_is_kept(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text(
        lines(
            [*HEADER, "contact", "effort"], more("True", "nan", rows=ROWS[:30]) + more("False", "nan", rows=ROWS[30:])
        )
    )
    columns = read(path)[1][""][1]
    np.testing.assert_array_equal(columns["contact"], np.arange(50) < 30)
    assert np.isnan(columns["effort"]).all()


def test_rates_before_the_names_of_a_csv_are_reported(tmp_path):
    path = tmp_path / "run.csv"
    for line, name, hz in (("# rate_hz: 100", "rate_hz", 100), ("Sample time = 0.002 s", "Sample time", 500)):
        path.write_text(f"{line}\n# mass: 20\n" + lines())
        assert open_raw(path)[0].stated_hz == {name: hz}


REFUSED_CSV = {
    "too few names": ("time;q0\n0.0,1,2\n0.1,1,2\n", r"line 1 has 2 names between ';', line 2 has 3 cells between ','"),
    "a name is missing": (
        "t,q0,q1\n0.00,1.5,2.5,3\n0.01,1.5,2.5,3\n", "line 1 has 3 names between ',', line 2 has 4 cells between ','"
    ),
    "a name is missing between blanks": (
        "t q0 q1\n0.00 1.5 2.5 3\n0.01 1.5 2.5 3\n", "line 1 has 3 names between ' ', line 2 has 4 cells between ' '"
    ),
    "thousands": ('t,q\n"1,000.5",1\n"1,001.5",2\n', "column 't' has separators between thousands, such as '1,000.5'"),
    "thousands alone": ('t,q\n"1,000",1\n"1,001",2\n', "column 't' has separators between thousands"),
    "thousands far on": (
        "t,q\n" + "0.5,1\n" * 300 + '"1,000.5",1\n',
        "column 't' has separators between thousands, in line 302: '1,000.5'",
    ),
    "names alone": ("t,q\n", "it has no rows under its names; its first line is 't,q'"),
    "prose": ("A licence.\nMany words,\nno numbers.\n", "no table of numbers; its first line is 'A licence.'"),
    "blank lines": ("\n\n \n", "it is empty; a CSV file begins with the names of its columns"),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED_CSV)
def test_a_csv_that_is_no_table_is_refused_with_the_cause(tmp_path, kind):
    path = tmp_path / "run.csv"
    text, message = REFUSED_CSV[kind]
    path.write_text(text)
    with pytest.raises(RecordingError, match=f"run.csv: {message}"):
        read(path)


@pytest.mark.parametrize("block_bytes", [97, 1000])
def test_blocks_of_a_csv_join_without_a_seam(tmp_path, monkeypatch, block_bytes):
    monkeypatch.setattr(csv_table, "BLOCK_BYTES", block_bytes)
    path = tmp_path / "run.csv"
    rows = [*ROWS[:20], ["# stop"], ["1.0"], *ROWS[20:]]
    for text in (lines(rows=rows), lines(rows=padded(rows), separator=" ")):
        path.write_text(text)
        source, streams = read(path)
        np.testing.assert_array_equal(streams[""][1]["q1"], table()["q1"])
        assert source.lost.sentences() == ["1 row left out: a wrong number of cells, first line 23"]
        last = list(source.blocks())[-1]
        assert source.position(last.rows[-1]) == "line 53"


def pairs(of: str) -> np.ndarray:
    return np.column_stack([table()[f"{of}0"], table()[f"{of}1"]])


def fixed_lists(values: np.ndarray) -> pa.Array:
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])


T_NS = np.datetime64("2024-05-01T12:00", "ns").astype(np.int64) + 10_000_000 * np.arange(50)
SAME_ARROW = {
    "numbers": {name: pa.array(values) for name, values in table().items()},
    "lists": {"q": pa.array(pairs("q").tolist()), "tau": pa.array(pairs("tau").tolist(), pa.large_list(pa.float64()))},
    "lists of one length": {"q": fixed_lists(pairs("q")), "tau": fixed_lists(pairs("tau"))},
    "lists of one row": {"q": pa.array(pairs("q")[:, None].tolist()), "tau": pa.array(pairs("tau")[:, None].tolist())},
    "lists of one column": {
        "q": pa.array(pairs("q")[:, :, None].tolist()),
        "tau": pa.array(pairs("tau")[:, :, None].tolist()),
    },
    "a struct": {
        "arm": pa.array([{"q": q, "tau": t} for q, t in zip(pairs("q").tolist(), pairs("tau").tolist(), strict=True)])
    },
    "a tensor": {
        name: pa.ExtensionArray.from_storage(pa.fixed_shape_tensor(pa.float64(), [1, 2]), fixed_lists(pairs(name)))
        for name in ("q", "tau")
    },
    "text": {name: pa.array(map(repr, map(float, values)), pa.string()) for name, values in table().items()},
    "a dictionary": {name: pa.array(values).dictionary_encode() for name, values in table().items()},
}


@pytest.mark.parametrize("form", ["parquet", "arrow"])
@pytest.mark.parametrize("variation", SAME_ARROW)
def test_arrow_columns_of_each_type_give_the_same_numbers(tmp_path, form, variation):
    path = tmp_path / f"run.{form}"
    columns = pa.table({"picture": pa.array([b"x"] * 50), "mode": ["idle"] * 50, **SAME_ARROW[variation]})
    if form == "parquet":
        pq.write_table(columns, path, row_group_size=20)
    else:
        with pa.ipc.new_file(path, columns.schema) as file:
            file.write_table(columns, max_chunksize=20)
    source, streams = read(path)
    t_ns, found = streams[""]
    spelled = "arm.{}[{}]" if variation == "a struct" else "{}{}" if "q0" in SAME_ARROW[variation] else "{}[{}]"
    for signal in ("q", "tau"):
        for k in range(2):
            np.testing.assert_array_equal(found[spelled.format(signal, k)], table()[f"{signal}{k}"])
    assert t_ns is None and source.notes == ["columns without numbers left out: mode, picture"]


STAMP_TYPES = {
    "ns": pa.array(T_NS).cast(pa.timestamp("ns")),
    "us with a zone": pa.array(T_NS // 1000).cast(pa.timestamp("us", "Europe/Berlin")),
    "ms": pa.array(T_NS // 10**6).cast(pa.timestamp("ms")),
    "text": pa.array(T_NS // 1000).cast(pa.timestamp("us")).cast(pa.string()),
    "time of day": pa.array(T_NS // 1000 % (86_400 * 10**6)).cast(pa.time64("us")),
    "time of day in ms": pa.array((T_NS // 10**6 % 86_400_000).astype(np.int32)).cast(pa.time32("ms")),
    "duration": pa.array(T_NS - T_NS[0]).cast(pa.duration("ns")),
}


@pytest.mark.parametrize("kind", STAMP_TYPES)
@pytest.mark.parametrize("name", ["timestamp", "__index_level_0__"])
def test_an_arrow_column_of_times_is_the_clock(tmp_path, kind, name):
    if kind == "duration" and name != "timestamp":
        return  # a duration may be anything
    path = tmp_path / "run.parquet"
    pq.write_table(pa.table({name: STAMP_TYPES[kind], **table()}), path)
    source, streams = read(path)
    t_ns, columns = streams[""]
    day = 86_400 * 10**9
    begin = {"time of day": T_NS[0] % day, "time of day in ms": T_NS[0] % day, "duration": 0}.get(kind, T_NS[0])
    np.testing.assert_array_equal(t_ns, begin + T_NS - T_NS[0])
    np.testing.assert_array_equal(columns["tau1"], table()["tau1"])
    assert source.clocks == (name, "") and name not in columns
    assert source.notes == [f"stamps from column '{name}', which has dates or times"]


@pytest.mark.parametrize(
    ("kind", "exact"),
    [
        (pa.float32(), False),
        (pa.float16(), False),
        (pa.int16(), True),
        (pa.uint64(), True),
        (pa.decimal128(6, 2), True),
    ],
)
def test_arrow_numbers_of_each_type_are_read(tmp_path, kind, exact):
    path = tmp_path / "run.parquet"
    numbers = pa.array([None, *range(49)], pa.float64()).cast(kind)
    flags = pa.array([None, *(k % 2 == 0 for k in range(49))])
    pq.write_table(pa.table({"q": numbers, "contact": flags, "effort": pa.nulls(50), "at": table()["time"]}), path)
    columns = read(path)[1][""][1]
    np.testing.assert_array_equal(columns["q"], np.r_[np.nan, np.arange(49.0)])
    np.testing.assert_array_equal(columns["contact"], np.r_[np.nan, np.arange(49) % 2 == 0])
    assert np.isnan(columns["effort"]).all()


def test_rows_of_parquet_without_a_stamp_or_with_another_length_of_a_list(tmp_path):
    path = tmp_path / "run.parquet"
    stamps = pa.array([None if k == 7 else int(t) for k, t in enumerate(T_NS)], pa.timestamp("ns"))
    lists = [[float(k), 0.5][: 1 if k == 9 else 2] if k != 11 else None for k in range(50)]
    ragged = pa.array([[1.0] * (k % 9 + 1) for k in range(50)])
    pq.write_table(pa.table({"stamp": stamps, "q": pa.array(lists), "points": ragged}), path)
    source, streams = read(path)
    t_ns, columns = streams[""]
    np.testing.assert_array_equal(t_ns, np.delete(T_NS, 7))
    assert source.lost.sentences() == ["1 row left out: 'stamp', its time, is missing, first row 8"]
    expected = np.where(np.isin(np.arange(50), (9, 11)), np.nan, np.arange(50.0))
    np.testing.assert_array_equal(columns["q[0]"], np.delete(expected, 7))
    assert source.counts == {"lists of 'q' without 2 elements are missing values": 1}
    assert source.notes[-1] == "columns without numbers left out: points (lists of changing length)"
    (block,) = source.blocks()
    assert source.position(block.rows[7]) == "row 9"


def test_arrays_of_a_joint_state_have_its_names(tmp_path):
    path = tmp_path / "run.parquet"
    names, stamps = pa.array([["elbow", "wrist"]] * 50), pa.array([{"sec": 7, "nanosec": k} for k in range(50)])
    pq.write_table(pa.table({"name": names, "position": pa.array(pairs("q").tolist()), "stamp": stamps}), path)
    t_ns, columns = read(path)[1][""]
    np.testing.assert_array_equal(columns["position[wrist]"], table()["q1"])
    np.testing.assert_array_equal(t_ns, 7 * 10**9 + np.arange(50))


def test_parquet_without_rows_or_numbers_is_refused(tmp_path):
    path = tmp_path / "run.parquet"
    for columns, message in (
        ({"q": pa.array([], pa.float64())}, "it has no rows"),
        (
            {"mode": ["a"], "stamp": pa.array([1], pa.timestamp("ns"))},
            "no column has numbers; its columns are mode, stamp",
        ),
    ):
        pq.write_table(pa.table(columns), path)
        with pytest.raises(RecordingError, match=f"run.parquet: {message}"):
            open_raw(path)


RECORDS = np.zeros(50, [("time", "f8"), ("q", "f8", 2), ("tau", "f8", (1, 2)), ("mode", "S4")])
RECORDS["time"], RECORDS["q"], RECORDS["tau"] = table()["time"], pairs("q"), pairs("tau")[:, None]
SAME_ARRAYS = {
    "rows": {"time": table()["time"], "q": pairs("q"), "tau": pairs("tau")},
    "columns": {"time": table()["time"], "q": pairs("q").T, "tau": pairs("tau").T},
    "an axis of one before": {"time": table()["time"][None], "q": pairs("q")[None], "tau": pairs("tau")[None]},
    "an axis of one between": {
        "time": table()["time"][:, None],
        "q": pairs("q")[:, None],
        "tau": pairs("tau")[:, None],
    },
    "an axis of one behind": {"time": table()["time"], "q": pairs("q")[..., None], "tau": pairs("tau").T[..., None]},
    "Simulink's last axis": {"time": table()["time"], "q": pairs("q").T[:, None], "tau": pairs("tau").T[:, None]},
    "fewer samples than joints": {
        "time": table(2)["time"],
        "q": pairs("q")[:2].repeat(2, 1),
        "tau": pairs("tau")[:2].repeat(2, 1),
    },
}


def as_matlab_73(path, write):
    """A file of MATLAB 7.3: HDF5 behind a block of 512 bytes."""
    with h5py.File(path, "w", userblock_size=512) as file:
        write(file)
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, written by a test".ljust(124) + b"\0\2IM")


@pytest.mark.parametrize("name", ["run.h5", "old.mat", "new.mat"])
@pytest.mark.parametrize("variation", SAME_ARRAYS)
def test_arrays_of_each_orientation_give_the_same_numbers(tmp_path, name, variation):
    path, arrays = tmp_path / name, SAME_ARRAYS[variation]

    def write(file):
        for key, values in arrays.items():
            file[f"rec/{key}"] = values
        file["gains"] = np.ones(7)

    if name == "old.mat":
        savemat(path, {"rec": arrays, "gains": np.ones(7)})
    elif name == "new.mat":
        as_matlab_73(path, write)
    else:
        with h5py.File(path, "w") as file:
            write(file)
    source, streams = read(path)
    mark = "/" if name == "run.h5" else "."
    columns = streams[""][1]
    samples, twice = (2, 2) if "fewer" in variation else (50, 1)
    np.testing.assert_array_equal(columns[f"rec{mark}time"], table()["time"][:samples])
    for signal in ("q", "tau"):
        for k in range(2 * twice):
            expected = table()[f"{signal}{k // twice}"][:samples]
            np.testing.assert_array_equal(columns[f"rec{mark}{signal}[{k}]"], expected)
    assert source.notes == [f"arrays of another length than {samples} left out: gains (7)"]


def test_hdf5_fields_names_and_rates(tmp_path):
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        file["log"] = RECORDS
        file["arm/q"], file["arm/joint_names"], file["arm/fs"] = pairs("q"), ["shoulder", "elbow"], 100.0
        file["arm/contact"], file["arm/half"] = np.arange(50) > 30, pairs("q").astype(np.float16)
        file["arm/q"].attrs["dt"] = 0.01
        file["camera/fps"], file["camera/image"], file["empty"] = 30.0, np.zeros((7, 9, 9)), np.zeros((0, 3))
        file["pose"] = np.zeros((50, 4, 4))
        file["table/block0_values"], file["table/block0_items"] = pairs("tau"), np.array([b"tau_1", b"tau_2"])
        file["table/axis1"] = np.arange(50) * 10**7
        file["table"].attrs["pandas_type"] = "frame"
    source, streams = read(path)
    columns = streams[""][1]
    for names in (("log.q[0]", "log.q[1]"), ("arm/q[shoulder]", "arm/q[elbow]")):
        np.testing.assert_array_equal(np.column_stack([columns[name] for name in names]), pairs("q"))
    for names in (("log.tau[0]", "log.tau[1]"), ("table/tau_1", "table/tau_2")):
        np.testing.assert_array_equal(np.column_stack([columns[name] for name in names]), pairs("tau"))
    np.testing.assert_array_equal(columns["table/index"], np.arange(50) * 10**7)
    np.testing.assert_array_equal(columns["arm/contact"], np.arange(50) > 30)
    np.testing.assert_array_equal(columns["arm/half[elbow]"], pairs("q")[:, 1].astype(np.float16))
    assert "pose[15]" in columns and "log.mode" not in columns
    assert source.stated_hz == {"arm/fs": 100.0, "arm/q/dt": 100.0}
    assert source.notes == ["arrays of another length than 50 left out: camera/image (9), empty (3)"]


@pytest.mark.parametrize(
    ("pattern", "lengths", "runs"),
    [
        ("data/demo_{}", (50, 40, 50), True),
        ("episode_{}", (50, 50, 50), True),
        ("block{}", (50, 40, 30), True),
        ("joint_{}", (50, 50, 50), False),
        ("part_{}", (50, 50, 50), False),
    ],
)
def test_groups_of_runs_are_recordings_of_their_own(tmp_path, pattern, lengths, runs):
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        file["gains"], file.attrs["rate_hz"] = np.ones(3), 100
        for k, samples in enumerate(lengths):
            group = file.create_group(pattern.format(k + 9))
            group["obs/q"], group["t"] = pairs("q")[:samples] + k, table()["time"][:samples]
    sources = open_raw(path)
    assert all(source.stated_hz == {"rate_hz": 100.0} for source in sources)
    if not runs:
        (source,) = sources
        assert f"{pattern.format(10)}/obs/q[1]" in source.streams[""]
        return
    assert [source.name for source in sources] == [f"run-{pattern.format(k + 9).split('/')[-1]}" for k in range(3)]
    for k, source in enumerate(sources):
        (block,) = source.blocks()
        assert block.names == ("obs/q[0]", "obs/q[1]", "t")
        np.testing.assert_array_equal(block.columns[:, :2], pairs("q")[: lengths[k]] + k)
    assert sources[0].notes == ["arrays outside of the runs left out: gains"]


def matlab_runs(kind: str) -> dict:
    """Two runs of 50 and 40 samples in the ways of MATLAB."""
    one, other = ({"t": table()["time"][:n], "q": pairs("q")[:n]} for n in (50, 40))
    if kind == "an array of structs":
        runs = np.zeros((1, 2), [("t", object), ("q", object)])
        for k, run in enumerate((one, other)):
            runs[0, k] = (run["t"], run["q"])
        return {"log": runs}
    cells = {key: np.empty(2, object) for key in ("t", "q")}
    for key, cell in cells.items():
        cell[:] = [one[key], other[key]]
    if kind == "parallel cells":
        return cells
    structs = np.empty(2, object)
    structs[:] = [one, other]
    return {"runs": structs}


@pytest.mark.parametrize("kind", ["an array of structs", "parallel cells", "cells of structs"])
def test_runs_of_matlab_are_recordings_of_their_own(tmp_path, kind):
    savemat(tmp_path / "run.mat", matlab_runs(kind))
    first, second = open_raw(tmp_path / "run.mat")
    assert (first.name, second.name) == ("run-1", "run-2")
    for source, samples in ((first, 50), (second, 40)):
        (block,) = source.blocks()
        columns = dict(zip(block.names, block.columns.T, strict=True))
        np.testing.assert_array_equal(columns["q[1]"], table()["q1"][:samples])
        np.testing.assert_array_equal(columns["t"], table()["time"][:samples])


@pytest.mark.parametrize("cell", [True, False])
def test_references_of_matlab_7_3_are_followed(tmp_path, cell):
    def write(file):
        for k in range(2):
            file[f"#refs#/t{k}"], file[f"#refs#/q{k}"] = table()["time"][None, : 50 - k], pairs("q").T[:, : 50 - k]
        for key in ("t", "q"):
            held = file.create_dataset(key if cell else f"log/{key}", (2, 1), h5py.ref_dtype)
            held[:, 0] = [file[f"#refs#/{key}{k}"].ref for k in range(2)]
            if cell:
                held.attrs["MATLAB_class"] = np.bytes_("cell")
        file["empty"] = np.array([0, 3], np.uint64)
        file["empty"].attrs["MATLAB_empty"] = 1

    as_matlab_73(tmp_path / "run.mat", write)
    sources = open_raw(tmp_path / "run.mat")
    for k, source in enumerate(sources):
        (block,) = source.blocks()
        columns = dict(zip(block.names, block.columns.T, strict=True))
        np.testing.assert_array_equal(columns["q[1]"], table()["q1"][: 50 - k])
    assert [source.name for source in sources] == ["run-1", "run-2"]


def test_simulink_and_cells_of_joints(tmp_path):
    path = tmp_path / "run.mat"
    names, joints = np.empty(2, object), np.empty(2, object)
    names[:], joints[:] = ["shoulder", "elbow"], [table()["tau0"], table()["tau1"]]
    signals = {"values": pairs("q").T[:, None], "dimensions": 2.0, "label": "q"}
    out = {"time": table()["time"], "signals": signals, "Ts": 0.01}
    savemat(path, {"out": out, "tau": joints, "joint_names": names})
    source, streams = read(path)
    columns = streams[""][1]
    np.testing.assert_array_equal(columns["out.signals.values[elbow]"], table()["q1"])
    np.testing.assert_array_equal(columns["tau[shoulder]"], table()["tau0"])
    assert source.stated_hz == {"out.Ts": 100.0}


REFUSED_ARRAYS = {
    "a square": ({"q": np.eye(7)}, r"which axis of 'q' \(7 x 7\) counts samples is not clear; add an array `time`"),
    "a square with a clock": ({"time": np.arange(7.0), "q": np.eye(7)}, r"which axis of 'q' \(7 x 7\) counts"),
    "few samples without a clock": ({"q": np.ones((5, 7)), "tau": np.ones((5, 7))}, r"which axis of 'q' \(5 x 7\)"),
    "images": ({"image": np.zeros((50, 30, 30))}, r"looks like a signal, .*; its arrays: image \(50 x 30 x 30\)"),
    "nothing": ({}, "looks like a signal, .*; its arrays: none"),
}


@pytest.mark.parametrize("kind", REFUSED_ARRAYS)
def test_arrays_that_are_no_signals_are_refused_with_the_cause(tmp_path, kind):
    path = tmp_path / "run.h5"
    arrays, message = REFUSED_ARRAYS[kind]
    with h5py.File(path, "w") as file:
        for name, values in arrays.items():
            file[name] = values
    with pytest.raises(RecordingError, match=f"run.h5: .*{message}"):
        open_raw(path)


def test_matlab_objects_are_named_with_the_way_on(tmp_path):
    def write(file):
        file["log"] = np.arange(6, dtype=np.uint32)[None]
        file["log"].attrs["MATLAB_class"], file["log"].attrs["MATLAB_object_decode"] = np.bytes_("timeseries"), 3

    path = tmp_path / "run.mat"
    as_matlab_73(path, write)
    with pytest.raises(
        RecordingError, match=r"MATLAB objects cannot be read: log \(timeseries\); save .* plain arrays"
    ):
        open_raw(path)
    as_matlab_73(
        path, lambda file: (write(file), file.create_dataset("t", data=table()["time"]))
    )  # as the message says
    source, streams = read(path)
    np.testing.assert_array_equal(streams[""][1]["t"], table()["time"])
    assert source.notes == ["MATLAB objects left out: log (timeseries)"]


def test_hdf5_files_that_are_being_written(tmp_path):
    path, copied = tmp_path / "run.h5", tmp_path / "copied.h5"
    with h5py.File(path, "w", libver="latest") as file:
        file["q"] = table()["q0"]
        file.flush()
        shutil.copy(path, copied)
        with pytest.raises(
            RecordingError, match="copied.h5: the program that writes it has not closed it; close it there"
        ):
            open_raw(copied)
        file.swmr_mode = True
        file.flush()
        shutil.copy(path, copied)
    for one in (path, copied):
        np.testing.assert_array_equal(read(one)[1][""][1]["q"], table()["q0"])


def test_a_missing_filter_of_hdf5_is_named(tmp_path):
    path = tmp_path / "run.h5"
    with h5py.File(path, "w") as file:
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk((50,))
        plist.set_filter(32001, h5py.h5z.FLAG_OPTIONAL)
        space = h5py.h5s.create_simple((50,))
        h5py.h5d.create(file.id, b"q", h5py.h5t.NATIVE_DOUBLE, space, plist).write_direct_chunk((0,), bytes(400))
    with pytest.raises(
        RecordingError, match="'/q' is compressed by the filter .*; write the file with gzip, or without"
    ):
        open_raw(path)
    with h5py.File(path, "w") as file:
        file.create_dataset("q", data=table()["q0"], compression="gzip")
    np.testing.assert_array_equal(read(path)[1][""][1]["q"], table()["q0"])


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


def test_split_files_of_one_bag_come_in_their_order(tmp_path):
    rows = joint_rows(samples=30)
    (tmp_path / "bag").mkdir()
    for k, part in ((2, rows[:10]), (10, rows[10:])):
        written = write_bag(tmp_path / f"part{k}", "sqlite3", {"/joint_states": part})
        shutil.copy(written / f"part{k}.db3", tmp_path / "bag" / f"bag_{k}.db3")
    np.testing.assert_array_equal(read(tmp_path / "bag")[1]["/joint_states"][0], motion(30)[0])
