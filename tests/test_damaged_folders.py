"""Every file of a bundle, a dataset and a results folder, damaged in every way, and the commands that read it.

No traceback, one line that names the file, nothing half-written.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from made_fleets import dataset, moving
from made_results import make_results, run_command
from made_results import undrawn as no_pictures

from tauext.bundle.estimates import load_estimates
from tauext.data.dataset import Split, save_split
from tauext.data.recording_file import load_recording, save_recording
from tauext.errors import ConfigError, RecordingError, TauextError
from tauext.report.page import write_report

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
