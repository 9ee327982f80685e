"""Every file of a bundle, a dataset and a results folder, damaged in every way, and the commands that read it.

No traceback, one line that names the file, nothing half-written.
"""

from __future__ import annotations

import json
import os
import re
import resource
import shutil
import sqlite3
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from dataclasses import replace
from functools import partial
from io import BytesIO
from pathlib import Path

import h5py
import matplotlib
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from made_planar import dataset, moving
from made_results import make_results, run_command
from made_results import undrawn as no_pictures
from matplotlib.figure import Figure
from tauext_lab.report.page import write_report
from tauext_lab.report.style import RC

from tauext.bundle.bundle_file import load_bundle
from tauext.bundle.estimates import load_estimates
from tauext.data.assemble import assemble
from tauext.data.clock import RowRules
from tauext.data.dataset import Split, save_split
from tauext.data.importers.open_raw import open_raw
from tauext.data.recording_file import load_recording, save_recording
from tauext.errors import ConfigError, RecordingError, TauextError
from tauext.files.preflight import within_memory
from tauext.robot.write import write_placeholder

FREE, PUSH = "free.parquet", "push.parquet"


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """A bundle, its dataset and its results."""
    folder = tmp_path_factory.mktemp("whole")
    data = dataset(folder / "data", moving(0, 30.0, (1.0, 1.0), "free"))
    made = moving(1, 20.0, (1.0, 1.0), "push")
    touched = (made.time_s > 10) & (made.time_s < 10.5)
    push = replace(made, tau=made.tau - 60.0 * touched[:, None], contact=touched.astype(np.int8))
    save_recording(push, data / PUSH)
    save_split(Split((FREE,), (), (), (PUSH,)), data)
    with pytest.MonkeyPatch.context() as patch, no_pictures():
        patch.chdir(folder)
        from tauext.cli import main

        assert main(["train", "--data", "data", "--recipe", "observer", "--out", "arm.tauext"]) == 0
        assert main(["evaluate", "--data", "data", "--bundles", "arm.tauext", "--out", "results"]) == 0
    return folder


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def cut(path: Path) -> None:
    raw = path.read_bytes()
    path.write_bytes(raw[: len(raw) // 2])


def garbage(path: Path) -> None:
    path.write_bytes(np.random.default_rng(0).bytes(3000))


def directory(path: Path) -> None:
    path.unlink()
    path.mkdir()


def loop_of_links(path: Path) -> None:
    path.unlink()
    path.symlink_to(path.name)


def link_to_nothing(path: Path) -> None:
    path.unlink()
    path.symlink_to("../gone")


def link_to_another(path: Path) -> None:
    """The whole file lies elsewhere: as good as in place."""
    path.rename(path.with_name("elsewhere"))
    path.symlink_to("elsewhere")


FAULTS: dict[str, Callable[[Path], None]] = {
    "deleted": Path.unlink,
    "empty": emptied,
    "cut": cut,
    "garbage": garbage,
    "directory": directory,
    "no permission": lambda path: path.chmod(0),
    "loop of links": loop_of_links,
    "link to nothing": link_to_nothing,
    "link to another": link_to_another,
}
COMMANDS = {
    "run": ("run", "arm.tauext", f"data/{PUSH}", "--flights", "out"),
    "evaluate": ("evaluate", "--data", "data", "--bundles", "arm.tauext", "--out", "out"),
    "report": ("report", "--results", "results", "--data", "data", "--out", "out", "--page-mb", "0"),
    "show bundle": ("show", "arm.tauext"),
    "show recording": ("show", f"data/{PUSH}"),
    "train": ("train", "--data", "data", "--recipe", "observer", "--out", "out.tauext"),
    "check": ("check", "--data", "data", "--out", "out"),
}
READ_BY = {
    "arm.tauext": ("show bundle", "run", "evaluate"),
    f"data/{PUSH}": ("show recording", "run", "evaluate", "report"),
    f"data/{FREE}": ("train", "check"),
    "data/split.json": ("train", "evaluate", "check"),
    "data/robot.xml": ("train", "check"),
    "results/results.json": ("report",),
    f"results/estimates/arm/{PUSH}": ("report",),
}
"""Files and the commands that read them; the first is tried in the fast tests."""
UNREADABLE, NOT_THERE = ("empty", "cut", "garbage"), ("deleted", "directory", "loop of links", "link to nothing")
FOUND = {("check", "data/robot.xml", fault) for fault in UNREADABLE}
"""A finding of the check names the file."""
WORKS = {
    **{("check", "data/split.json", fault): "all recordings of the folder are checked" for fault in NOT_THERE},
    **{("check", "data/robot.xml", fault): "a line states that there is no robot model" for fault in NOT_THERE},
    **{("report", f"results/estimates/arm/{PUSH}", fault): "the page names what is missing" for fault in NOT_THERE},
}
"""Expected outcomes other than a refusal: the command ends well."""


def cases() -> list[object]:
    found = []
    for name, commands in READ_BY.items():
        for number, command in enumerate(commands):
            for fault in FAULTS:
                marks = [pytest.mark.slow] if number else []
                if fault == "no permission":
                    marks.append(pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything"))
                found.append(pytest.param(name, command, fault, marks=marks, id=f"{name}-{fault}-{command}"))
    return found


@pytest.mark.parametrize(("name", "command", "fault"), cases())
def test_a_damaged_file_is_named_in_one_line(name, command, fault, whole, tmp_path, monkeypatch, capsys, undrawn):
    place = tmp_path / "place"
    shutil.copytree(whole, place)
    monkeypatch.chdir(place)
    FAULTS[fault](place / name)
    before = {path for path in place.rglob("*")}
    code, out, err = run_command(capsys, *COMMANDS[command])
    assert "Traceback" not in err
    left = {path for path in place.rglob("*")} - before
    assert not [path for path in left if path.name.endswith(".part")]
    if fault == "link to another" or (command, name, fault) in WORKS:
        assert code == 0, err
        return
    if (command, name, fault) in FOUND:
        assert code == 1 and Path(name).stem in out, (code, out)
        return
    assert code == 2, (code, err)
    lines = [line for line in err.splitlines() if line.startswith("tauext: error: ")]
    assert len(lines) == 1 and err.splitlines()[-1] == lines[0], err
    assert Path(name).name in lines[0] or Path(name).stem in lines[0], lines
    assert not [path for path in left if path.is_file()], left


# --- Sizes that a file states, and names that lead elsewhere.


def stating(rows: int, path: Path) -> None:
    """A recording of few bytes with so many rows."""
    whole = pq.read_table(path)
    zeros = {
        name: pa.array(np.zeros(rows, whole.schema.field(name).type.to_pandas_dtype())) for name in whole.schema.names
    }
    zeros["t_ns"] = pa.array(np.arange(rows) * 1_000_000)
    pq.write_table(pa.table(zeros).replace_schema_metadata(whole.schema.metadata), path, compression="zstd")


@pytest.mark.parametrize("load", [load_recording, load_estimates])
def test_rows_that_do_not_fit_are_refused_before_they_are_read(load, whole, tmp_path, monkeypatch):
    path = tmp_path / "bomb.parquet"
    shutil.copy(whole / ("data" if load is load_recording else "results/estimates/arm") / PUSH, path)
    stating(1_000_000, path)
    monkeypatch.setattr("tauext.files.preflight.free_memory", lambda: 50_000_000)
    monkeypatch.setattr("pyarrow.parquet.ParquetFile.read", lambda *a, **k: pytest.fail("rows were read"))
    monkeypatch.setattr("pyarrow.parquet.read_table", lambda *a, **k: pytest.fail("rows were read"))
    with pytest.raises(ConfigError, match=r"bomb.parquet: to read 1,000,000 rows of \d+ columns needs .* of memory"):
        load(path)


def refusal(capsys, path: Path, *words: object) -> str:
    """The line with which the import of a file ends."""
    code, _, err = run_command(capsys, "import", "--new", path.with_name("arm.toml"), "--source", path, *words)
    assert code == 2 and err.count("\n") == 1 and not path.with_name("arm.toml").exists(), err
    return err


@contextmanager
def memory(patch: pytest.MonkeyPatch, free: int) -> Iterator[None]:
    """This process may use so many bytes more."""
    patch.setattr("tauext.files.preflight.free_memory", lambda: free)
    before = resource.getrlimit(resource.RLIMIT_DATA)
    yield
    assert resource.getrlimit(resource.RLIMIT_DATA) == before


@pytest.mark.slow
def test_what_unpacks_to_more_than_the_memory_ends_in_a_line(tmp_path):
    """Zeros, of which a megabyte is a kilobyte: an Arrow file, and one of MATLAB, whose parts are unpacked whole."""
    rows = pa.record_batch([pa.array(np.zeros(5_000_000))] * 4, names=["time", "q0", "q1", "tau0"])
    zipped = pa.ipc.IpcWriteOptions(compression="zstd")
    with pa.ipc.new_file(str(tmp_path / "bomb.arrow"), rows.schema, options=zipped) as file:
        file.write_batch(rows)
    size = 160_000_000
    head = struct.pack("<6I2i", 6, 8, 6, 0, 5, 8, size // 16, 2)
    head += struct.pack("<4I", 1 | (1 << 16), ord("q"), 9, size)
    packer = zlib.compressobj(1)
    packed = packer.compress(struct.pack("<II", 14, len(head) + size) + head)
    packed += b"".join(packer.compress(bytes(4_000_000)) for _ in range(size // 4_000_000)) + packer.flush()
    begin = b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"
    (tmp_path / "bomb.mat").write_bytes(begin + struct.pack("<II", 15, len(packed)) + packed)
    assert sum(one.stat().st_size for one in tmp_path.iterdir()) < 1_000_000
    code = "import sys; from tauext.files import preflight; preflight.free_memory = lambda: 120_000_000\n"
    code += "from tauext.cli import main\n"
    code += "for name in sys.argv[1:]: print(main(['import', '--new', 'arm.toml', '--source', name]))"
    command = [sys.executable, "-c", code, "bomb.arrow", "bomb.mat"]  # this process has freed memory that it may use
    ended = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert ended.stdout == "2\n2\n" and ended.stderr.count("\n") == 2, ended.stderr
    for line, name in zip(ended.stderr.splitlines(), ("bomb.arrow", "bomb.mat"), strict=True):
        assert f"{name}: what it states or unpacks to needs more memory than is free" in line


def test_rows_that_a_file_states_but_does_not_hold_are_refused(tmp_path, capsys):
    rows = 10**9
    with h5py.File(tmp_path / "stated.h5", "w") as file:
        file.create_dataset("q", (rows, 7), "f8", chunks=(8192, 7))
    assert "'/q' states 1,000,000,000 rows, and none was written" in refusal(capsys, tmp_path / "stated.h5")
    with h5py.File(tmp_path / "chunk.h5", "w") as file:
        large = file.create_dataset("q", (20_000_000, 7), "f8", chunks=(20_000_000, 7), compression="gzip")
        large.id.write_direct_chunk((0, 0), zlib.compress(bytes(100)))
    assert "'/q' is stored in chunks of 1.12 GB, and 134 MB are the most" in refusal(capsys, tmp_path / "chunk.h5")


def test_lists_that_are_only_stated_are_not_read(tmp_path, monkeypatch):
    with h5py.File(tmp_path / "names.h5", "w") as file:
        file.create_dataset("joint_names", (64,), "S100000000", chunks=(1,))
        file.create_dataset("cells", (10**9,), h5py.ref_dtype, chunks=(8192,))
        file["q"] = np.ones((100, 7))
    with memory(monkeypatch, 10**8), within_memory():
        (raw,) = open_raw(tmp_path / "names.h5")
        assert raw.streams[""][0] == "q[0]"


@pytest.mark.parametrize("rows", [1, 10**9, 10**12])
def test_a_footer_with_wrong_rows_is_refused(rows, whole, tmp_path):
    """The number of rows in the footer of a recording, in each place in which it stands there."""
    path, raw = tmp_path / "odd.parquet", (whole / "data" / FREE).read_bytes()
    length = int.from_bytes(raw[-8:-4], "little")
    footer = raw[-8 - length : -8]
    was, now = (varint(2 * count) for count in (load_recording(whole / "data" / FREE).samples, rows))
    places = [one.start() for one in re.finditer(re.escape(was), footer)]
    rows_of = [places[0], places[-1]]  # of the file, and of its only group
    columns = places[1:-1:2] + places[2:-1:2]
    assert len(places) == 2 + 2 * 7
    for place in (*rows_of, *columns):
        changed = footer[:place] + now + footer[place + len(was) :]
        path.write_bytes(raw[: -8 - length] + changed + len(changed).to_bytes(4, "little") + b"PAR1")
        try:
            assert load_recording(path).samples == 3750, place  # a count of statistics, which nothing needs
            assert place in columns
        except TauextError as error:
            assert "odd.parquet: " in str(error)


def varint(value: int) -> bytes:
    """A number as the footer of a Parquet file has it."""
    parts = []
    while value > 127:
        parts.append(value & 127 | 128)
        value >>= 7
    return bytes([*parts, value])


def mcap(path: Path, chunks: list[tuple[int, bytes]], times: int = 1) -> Path:
    """An MCAP file of zstd chunks, each listed so often, of which it states the unpacked size."""
    text, record = lambda s: struct.pack("<I", len(s)) + s, lambda op, body: struct.pack("<BQ", op, len(body)) + body
    schema = struct.pack("<H", 1) + text(b"sensor_msgs/msg/JointState") + text(b"ros2msg") + text(b"")
    channel = struct.pack("<HH", 1, 1) + text(b"/joint_states") + text(b"cdr") + text(b"")
    out, index = b"\x89MCAP0\r\n" + record(1, text(b"ros2") + text(b"")), b""
    for size, packed in chunks:
        body = struct.pack("<QQQI", 0, 10**18, size, 0) + text(b"zstd") + struct.pack("<Q", len(packed)) + packed
        place = struct.pack("<QQQQIQ", 0, 10**18, len(out), len(body) + 9, 0, 0) + text(b"zstd")
        index += times * record(8, place + struct.pack("<QQ", len(packed), size))
        out += record(6, body)
    counts = struct.pack("<QHIIIIQQI", 5, 1, 1, 0, 0, len(chunks), 0, 10**18, 10) + struct.pack("<HQ", 1, 5)
    start = len(out) + 13
    out += record(15, bytes(4)) + record(3, schema) + record(4, channel) + index + record(11, counts)
    path.write_bytes(out + record(2, struct.pack("<QQI", start, 0, 0)) + out[:8])
    return path


def test_bags_that_unpack_to_anything_are_refused(tmp_path, monkeypatch, capsys):
    """A chunk that states a terabyte, chunks that overlap, one that is listed a thousand times, messages cut short."""
    one = struct.pack("<BQHIQQ", 5, 122, 1, 0, 5, 5) + bytes(100)
    packed = pa.compress(one * 1000, "zstd", asbytes=True)
    for size, note in ((1 << 40, "a part that states 1.1 TB is left out"), (1 << 63, "a part that states")):
        (raw,) = open_raw(mcap(tmp_path / "stated.mcap", [(size, packed)]))
        assert list(raw.blocks()) == [] and any(note in one for one in [*raw.notes, *raw.lost.reasons])
    for cut in (9, 10, 30):
        short = pa.compress(struct.pack("<BQ", 5, cut - 9) + one[9:cut], "zstd", asbytes=True)
        (raw,) = open_raw(mcap(tmp_path / "short.mcap", [(cut, short), (len(one) * 1000, packed)]))
        assert "none of its" in refusal(capsys, tmp_path / "short.mcap")
    mcap(tmp_path / "twice.mcap", [(len(one) * 1000, packed)], times=1000)
    assert "none of its 1000 messages can be read" in refusal(capsys, tmp_path / "twice.mcap")
    monkeypatch.setattr("tauext.data.importers.mcap_file.MOST_WAITING", 1500)
    mcap(tmp_path / "overlap.mcap", [(len(one) * 1000, packed)] * 3)
    line = refusal(capsys, tmp_path / "overlap.mcap")
    assert "more than 1,500 messages lie in parts that begin at the same time" in line
    with pa.CompressedOutputStream(str(tmp_path / "zeros.db3.zstd"), "zstd") as file:
        file.write(bytes(100_000))
    assert "what it unpacks to is no bag" in refusal(capsys, tmp_path / "zeros.db3.zstd")
    with pa.CompressedOutputStream(str(tmp_path / "long.mcap.zstd"), "zstd") as file:
        file.write(b"\x89MCAP0\r\n" + bytes(10_000_000))
    monkeypatch.setattr("tauext.files.unpacking.LEAST", 10_000)
    assert "it unpacks to more than" in refusal(capsys, tmp_path / "long.mcap.zstd")
    monkeypatch.setattr("tauext.data.importers.ros.MOST_OF_DISK", 1e-9)
    assert "of what is free in" in refusal(capsys, tmp_path / "long.mcap.zstd")
    assert not list(tmp_path.glob("*.db3")) and not list(tmp_path.glob("*.mcap.part"))


def test_rows_that_a_bag_computes_are_refused(tmp_path, capsys):
    with closing(sqlite3.connect(tmp_path / "view.db3")) as file:
        file.execute("CREATE TABLE topics(id INTEGER, name TEXT, type TEXT, serialization_format TEXT)")
        file.execute("INSERT INTO topics VALUES(1, '/joint_states', 'sensor_msgs/msg/JointState', 'cdr')")
        endless = "WITH RECURSIVE r(id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM r)"
        file.execute(f"CREATE VIEW messages AS {endless} SELECT id, 1 AS topic_id, id AS timestamp, x'' AS data FROM r")
        file.commit()
    assert "view.db3: its 'messages' is no plain table" in refusal(capsys, tmp_path / "view.db3")


def test_a_clock_that_stands_still_ends_an_import(tmp_path, monkeypatch, capsys):
    """Rows wait for the stamps to go on; a billion of them would fill the memory."""
    monkeypatch.setattr("tauext.data.importing.assemble", partial(assemble, rules=RowRules(most_waiting=9000)))
    (tmp_path / "still.csv").write_text("time,q0,tau0\n" + "0,0.1,0.2\n" * 20_000)
    signals = '[signals]\nq = {columns = ["q0"], unit = "rad"}\ntau = {columns = ["tau0"], unit = "Nm"}\n'
    (tmp_path / "arm.toml").write_text('[robot]\njoints = ["a"]\nmodel = ""\n[time]\ncolumn = "time"\n' + signals)
    words = ("import", "--source", tmp_path / "still.csv", "--arm", tmp_path / "arm.toml", "--out", tmp_path / "out")
    code, _, err = run_command(capsys, *words)
    assert code == 2 and "more than 9,000 rows have stamps within 1 s" in err and not (tmp_path / "out").exists()


def test_names_that_act_on_a_terminal_are_spelled_out(whole, tmp_path, capsys, undrawn):
    code, _, err = run_command(capsys, "show", tmp_path / "a\x1b[31m\u202eb\n.parquet")
    assert code == 2 and "a\\x1b[31m\\u202eb" in err and err.count("\n") == 1 and "\x1b" not in err
    code, _, err = run_command(capsys, "check", "--data", whole / "data", "--out", tmp_path / "a\x1b[31m")
    assert code == 2 and "has characters that cannot be printed" in err
    bundle = load_bundle(whole / "arm.tauext")
    bundle.name = "arm\x1b[31m"
    bundle.save(str(tmp_path / "odd.tauext"))
    code, out, err = run_command(capsys, "show", tmp_path / "odd.tauext")
    assert code == 2 and "odd.tauext: its name 'arm\\x1b[31m' has characters that cannot be printed" in err


def test_a_line_without_an_end_is_refused(tmp_path, capsys):
    import gzip

    path = tmp_path / "log.csv.gz"
    with gzip.open(path, "wb", 1) as file:
        file.write(b"time,q0,tau0\n")
        for _ in range(40):
            file.write(b"0" * (1 << 20))
    code, _, err = run_command(capsys, "import", "--new", tmp_path / "arm.toml", "--source", path)
    assert code == 2 and "log.csv.gz: a line has more than 16 MB" in err and err.count("\n") == 1


@pytest.mark.parametrize("name", ["../../data/secret", "/etc/passwd", "..", "a/b", ""])
def test_names_in_results_lead_nowhere_else(name, tmp_path, undrawn):
    results, data = make_results(tmp_path, seconds=10, bundles=("exact",), test_recordings=1, collision_recordings=1)
    path = results / "results.json"
    content = json.loads(path.read_text())
    content["bundles"][0]["name"] = name
    path.write_text(json.dumps(content))
    with pytest.raises(TauextError, match="must be that of a file, without a folder"):
        write_report(results, data, tmp_path / "out", 0)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", ["../free.parquet", "/free.parquet", "..", "a/b.parquet"])
def test_names_in_a_split_lead_nowhere_else(name, whole, tmp_path, capsys):
    place = shutil.copytree(whole / "data", tmp_path / "data")
    (place / "split.json").write_text(json.dumps({"format": 1, "train": [name]}))
    code, _, err = run_command(capsys, "check", "--data", place)
    assert code == 2 and "must be a file name without a folder" in err


def test_a_label_of_html_is_text_on_every_page(tmp_path, undrawn):
    word = "<img src=x onerror=alert(1)>"
    results, data = make_results(tmp_path, seconds=10, bundles=("exact",), test_recordings=1, collision_recordings=1)
    text = (results / "results.json").read_text()
    content = json.loads(text)
    content["provenance"] |= {"dataset": word, "command": word, "machine": word}
    (results / "results.json").write_text(json.dumps(content))
    page = write_report(results, data, tmp_path / "out", 2.0).read_text()
    assert word not in page and "&lt;img src=x" in page


def test_a_joint_of_html_and_of_mathematics_is_text(whole, tmp_path, capsys, undrawn):
    r"""Dollar signs are no formula of the figures, which `$\frac{$` would end with a traceback."""
    joints = ("</script><img src=x onerror=alert(1)>$\\frac{$", "\"'%s{0}{{x}}")
    data, bundle = tmp_path / "data", tmp_path / "arm.tauext"
    data.mkdir()
    write_placeholder(joints, data)
    for name in (FREE, PUSH):
        save_recording(replace(load_recording(whole / "data" / name), joints=joints), data / name)
    save_split(Split((FREE,), (), (), (PUSH,)), data)
    wide = ("--accept", "limit-wide")
    assert run_command(capsys, "train", "--data", data, "--recipe", "observer", "--out", bundle, *wide)[0] == 0
    assert run_command(capsys, "run", bundle, data / PUSH, "--flights", tmp_path / "flights")[0] == 0
    flight = next(one for one in (tmp_path / "flights").glob("*.parquet") if "estimates" not in one.name)
    assert run_command(capsys, "report", "--flight", flight, "--out", tmp_path / "page")[0] == 0
    (page,) = (tmp_path / "page").glob("*.html")
    assert joints[0] not in page.read_text() and "&lt;img src=x" in page.read_text()
    with matplotlib.rc_context(RC):
        Figure().text(0, 0, joints[0]).figure.savefig(BytesIO(), format="svg")


def test_one_sample_is_a_recording(whole, tmp_path, capsys):
    made = load_recording(whole / "data" / FREE)
    arrays = {name: getattr(made, name)[:1] for name in ("t_ns", "q", "dq", "tau")}
    save_recording(replace(made, name="one", **arrays), tmp_path / "one.parquet")
    for words in (("show", tmp_path / "one.parquet"), ("run", whole / "arm.tauext", tmp_path / "one.parquet")):
        assert run_command(capsys, *words)[0] == 0
    source = f"replay:{tmp_path / 'one.parquet'}"
    assert run_command(capsys, "monitor", whole / "arm.tauext", "--source", source)[0] == 0
    with pytest.raises(RecordingError):
        load_recording(tmp_path / "none.parquet")
