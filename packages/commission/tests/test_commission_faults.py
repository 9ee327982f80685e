"""Every file of a commissioned folder damaged in every way: nothing confirmed is lost silently, a bundle monitors."""

from __future__ import annotations

import errno
import importlib
import json
import os
import re
import shutil
import socket
import sqlite3
import subprocess
import sys
from contextlib import ExitStack, closing, contextmanager
from dataclasses import asdict
from pathlib import Path
from unittest import mock

import pytest
from made_bundles import JOINTS, pushed
from made_commission import cut_journal, forge
from made_faults import ANSWERS, BACKUP, FAULTS, ROBOT, alone, begin, end, faults, files_of, outcome, prepare, wait
from tauext_commission import history, journal
from tauext_commission.connect import restore_arm
from tauext_commission.folder import CommissionFolder, Segment
from tauext_commission.history import arm_row, describe_folder
from tauext_commission.history_file import (
    active_bundle,
    expect_journal,
    left_out,
    read_events,
    read_history,
    read_labels,
    read_question,
)
from tauext_commission.motion_recorder import repaired, trim_damaged
from tauext_commission.run import free_sockets
from tauext_commission.trainer import Trainer

from tauext import _core
from tauext.cli import main
from tauext.data.dataset import load_dataset
from tauext.data.labels import Label
from tauext.data.recording_file import save_recording
from tauext.errors import ConfigError

CONFIRMED = {k: "touched" if k % 2 else "nothing" for k in range(1, ANSWERS + 1)}
EXPECTED = (
    (r"journal\.db", ".*", r"journal\.db was damaged \(.+\): \d+ of \d+ lines are refilled"),
    (r"journal\.backup\.db", "(?!older|deleted)", r"journal\.backup\.db was damaged \(.+\), and is written again"),
    (r"bundles/b0002\.tauext", "(?!older)", r"b0001 is chosen: b0002\.tauext: "),
    (r"commission\.json", "(?!older)", r"commission\.json was missing or damaged, and is written again"),
    (r"arm\.toml|robot\..*", "(?!older)", r"is written again: "),
    (
        r"seg-.*",
        "(?!older|deleted)",
        r"seg-\d+\.parquet is kept as seg-\d+\.parquet\.damaged(-\d+)?: it cannot be read",
    ),
    (r".*", "directory|symlink", r"is kept as .*\.damaged(-\d+)?: "),
)
"""Pattern of a file, of a fault, and of a line in the history: the first that fits counts."""
QUIET = ("bundles/b0001.tauext", "results/", ".journal.lock")
"""Files of which only commands that read them report anything."""


def expected(name: str, fault: str) -> str | None:
    if name.startswith(QUIET):
        return None
    for file, kind, line in EXPECTED:
        if re.fullmatch(file, name) and re.match(kind, fault):
            return line
        if re.fullmatch(file, name) and file != ".*":
            return None
    return None


@pytest.fixture(scope="module")
def prepared(tmp_path_factory) -> Path:
    with alone():
        return prepare(tmp_path_factory.mktemp("faults"))


@pytest.fixture
def copy(prepared, tmp_path) -> Path:
    journal.close_all()
    shutil.copytree(prepared, tmp_path / "cell")
    return tmp_path / "cell"


def start(path: Path) -> CommissionFolder:
    """What the command does with a folder before it monitors."""
    journal.close_all()
    folder = CommissionFolder.open(path, create=True)
    restore_arm(folder)
    repaired(folder)
    folder.sync()
    return folder


NAMES = (
    ".facts.lock", ".journal.lock", ".reserve", "arm.toml", "bundles/b0001.tauext", "bundles/b0002.tauext",
    "carried.bin", "commission.json", "coverage.json", "coverage.npz", "findings.json", "journal.backup.db",
    "journal.db", "learned.json", "lock", "log.txt", "peaks.state", "pending.json", "results/b0001/results.json",
    "results/b0002/results.json", "robot.shapes.json", "robot.urdf", "seg-000001.parquet", "seg-000007.parquet",
    "split.json", "trainer.json",
)  # fmt: skip


def test_the_matrix_has_every_file_of_the_folder(prepared):
    assert files_of(prepared) == sorted(NAMES)


@pytest.mark.parametrize("name", NAMES)
def test_a_damaged_file_loses_nothing_that_was_confirmed(name, prepared, copy):
    whole = {one: (copy / one).read_bytes() for one in ("robot.urdf", "arm.toml", "robot.shapes.json")}
    for fault, damage in faults(copy.parent).items():
        backup = prepared.parent / BACKUP / name
        if not os.path.lexists(copy / name) or (fault == "older copy" and not backup.exists()):
            continue
        lines = len(CommissionFolder(copy).history())
        journal.close_all()
        damage(copy / name, backup)
        folder = start(copy)
        labels = {one.id: one.answer for one in folder.labels()}
        assert labels == CONFIRMED and not folder.lost(), fault
        assert {one["id"]: one["answer"] for one in read_events(copy)} == labels, fault
        assert _core.Bundle.load(str(folder.fall_back())).name == ("b0001" if name.endswith("2.tauext") else "b0002")
        news = [one["words"] for one in folder.history()[lines:]]
        if line := expected(name, fault):
            assert any(re.search(line, one) for one in news), (fault, news)
        else:
            assert len(news) <= 1, (fault, news)
        for one in ("robot.urdf", "arm.toml", "robot.shapes.json"):
            assert (copy / one).read_bytes() == whole[one], fault
        if name.startswith(("bundles/b0002", "results/", "seg-")):  # set aside for good, so that one fault is enough
            if os.path.lexists(copy / name):
                (copy / name).unlink() if not (copy / name).is_dir() else shutil.rmtree(copy / name)
            shutil.copyfile(prepared / name, copy / name)
            if name.endswith("2.tauext"):
                folder.activate("b0002", "a test", 0.0)


def test_lost_lines_stop_all_learning_until_a_person_accepts_it(copy, capsys):
    folder, arm = CommissionFolder.open(copy), CommissionFolder(copy).facts["arm"]
    cut_journal(folder, lambda line: not 5 <= line["number"] < 9 and line["kind"] != "file")
    noted = folder.facts["journal"]
    lost = folder.lost()
    assert lost > 4 and Trainer(folder).step() == "nothing"
    folder.append_label(Label(99, 1, 1, 2, "touched", "page", "", "b0002"))  # answers are stored all the same
    assert folder.lost() == lost and journal.read(copy).last == noted + 1
    with pytest.raises(ConfigError, match=f"{lost} confirmed lines are lost; nothing is trained on it before"):
        expect_journal(copy)
    assert describe_folder(copy)["lost_lines"] == lost
    assert main(["train", "--data", str(copy), "--recipe", "prior", "--out", str(copy.parent / "b.tauext")]) == 2
    assert "confirmed lines are lost" in capsys.readouterr().err and not (copy.parent / "b.tauext").exists()
    with folder.locked():
        assert main(["commission", "--out", str(copy), "--repair"]) == 2
    assert "another `tauext commission` uses this folder" in capsys.readouterr().err
    assert main(["commission", "--out", str(copy), "--repair"]) == 0
    told = capsys.readouterr().out
    assert (
        f"journal: at least {lost} confirmed lines are lost; a person accepts it" in told and "journal is whole" in told
    )
    journal.close_all()
    after = start(copy)
    assert after.lost() == 0 and Trainer(after).facts().kept_s == 0.0  # training begins again
    assert not load_dataset(copy).split.train and after.facts["arm"] == arm
    assert {one.id for one in after.labels()} > {99}
    (copy / "robot.urdf").unlink()
    assert start(copy) and (copy / "robot.urdf").is_file()
    assert main(["commission", "--out", str(copy), "--repair"]) == 0 and "lines are lost" not in capsys.readouterr().out
    assert main(["commission", "--out", str(copy.parent), "--repair"]) == 2


def test_a_journal_that_is_gone_is_noticed_and_a_whole_bundle_monitors(copy):
    for name in (journal.NAME, journal.BACKUP):
        (copy / name).unlink()
    folder = start(copy)
    assert folder.lost() >= ANSWERS and folder.fall_back().stem == "b0002"
    assert Trainer(folder).step() == "nothing" and len(list(folder.bundles.glob("*.tauext"))) == 2


@pytest.mark.parametrize("change", [{"period_ns": 2_000_000}, {"joints": ["shoulder", "wrist"]}])
def test_a_bundle_of_another_arm_is_no_fallback(copy, change):
    (copy / "bundles" / "b0002.tauext").write_bytes(b"")
    folder = CommissionFolder.open(copy)
    folder.save(arm=folder.facts["arm"] | change)
    assert folder.fall_back() is None and folder.active().stem == "b0002"


TEXT = "a text file of an earlier version of tauext.*; begin again with `tauext commission --out"
REFUSED = {
    "nothing": (lambda path: path.rmdir(), "is no folder of `tauext commission`; it has no commission.json", ""),
    "a thesis": (lambda path: (path / "thesis.tex").touch(), "is no folder of", "is not empty and no folder of"),
    "a version without a journal": (lambda path: (path / "commission.json").write_text('{"format": 1}'),
                                    "by a version of tauext without a journal", "without a journal"),
    "a later version": (lambda path: (path / "commission.json").write_text('{"format": 9}'), "format 9", "format 9"),
    "a journal of text": (lambda path: [(path / name).write_text('{"format": 1, "journal": 3}')
                                        for name in ("commission.json", "journal.jsonl")],
                          TEXT, TEXT),
}  # fmt: skip
"""What makes a folder one that is refused, and the message, also where the command would make a new folder."""


@pytest.mark.parametrize("what", REFUSED)
def test_a_folder_of_something_else_is_refused_and_stays_as_it_is(what, tmp_path):
    make, opened, created = REFUSED[what]
    path = tmp_path / "cell"
    path.mkdir()
    make(path)
    before = tree_of(path)
    for create, why in ((True, created), (False, opened)):
        if why:
            with pytest.raises(ConfigError, match=why):
                CommissionFolder.open(path, create)
    assert tree_of(path) == before


def test_a_journal_of_a_later_format_is_refused(copy):
    with closing(sqlite3.connect(copy / journal.NAME)) as database:
        database.execute("PRAGMA user_version = 2")
    for create in (True, False):
        with pytest.raises(ConfigError, match=r"journal\.db: has format 2, which this version of tauext does not read"):
            CommissionFolder.open(copy, create)


@pytest.mark.parametrize("what", ["directory", "file", "dangling"])
def test_things_in_the_place_of_the_sockets_are_set_aside(what, copy):
    for name in ("control.sock", "live.sock"):
        path = copy / name
        {"directory": path.mkdir, "file": path.touch, "dangling": lambda path=path: path.symlink_to("nothing")}[what]()
    free_sockets(copy, CommissionFolder.open(copy))
    assert not list(copy.glob("*.sock")) and len([one for one in os.listdir(copy) if "sock.damaged" in one]) == 2


def test_the_answer_to_a_question_outlives_a_kill(copy):
    folder = CommissionFolder.open(copy)
    folder.note("step", 1.0, "another tool?", segment=3)
    assert "answer" not in read_question(copy)
    folder.append_reply("learn", "page")
    journal.close_all()
    assert read_question(copy)["answer"] == "learn" and read_question(copy)["segment"] == 3
    folder.note("step", 1.0, "it is learned", learned=True)
    assert read_question(copy) == {}


# --- The journal itself.


@pytest.mark.parametrize("is_new", [True, False], ids=["start", "running"])
@pytest.mark.parametrize("fault", [*(one for one in FAULTS if one != "no permission"), "in place", "foreign"])
def test_a_damaged_journal_is_refilled_from_its_backup_and_a_damaged_backup_is_made_again(fault, is_new, tmp_path):
    (tmp_path / "other").touch()
    for k in range(20):
        assert journal.append(tmp_path, "answer", {"id": k, "words": "x" * 300}) == ""
        if k == 9:
            journal.mend(tmp_path)
            journal.close_all()
            shutil.copytree(tmp_path, tmp_path / "backup", ignore=lambda *_: ["backup"])
    journal.mend(tmp_path)
    for name in (journal.NAME, journal.BACKUP):
        journal.close_all()  # the log of SQLite is in the file
        path, lines = tmp_path / name, journal.read(tmp_path).lines
        if is_new:
            journal.close_all()
        if fault == "in place":
            raw = path.read_bytes()
            at = raw.rindex(b"x" * 300)
            path.write_bytes(raw[:at] + b"yy" + raw[at + 2 :])
        elif fault == "foreign":
            path.unlink()
            with closing(sqlite3.connect(path)) as database:
                database.execute("CREATE TABLE line (number INTEGER)")
        else:
            FAULTS[fault](path, tmp_path / "backup" / name)
        assert journal.read(tmp_path).lines == lines and not journal.read(tmp_path).lost(20)
        words = journal.mend(tmp_path)
        expected = rf"{name} was damaged \(.+\): \d+ of 20 lines" if name == journal.NAME else rf"{name} was damaged \("
        quiet = name == journal.BACKUP and fault in ("deleted", "older copy")
        assert quiet or re.match(expected, words), words
        for one in (journal.NAME, journal.BACKUP):  # each alone has everything
            journal.close_all()
            shutil.copytree(tmp_path, tmp_path / "alone", symlinks=True, ignore=lambda *_: ["backup", "alone"])
            (tmp_path / "alone" / one).unlink()
            assert journal.read(tmp_path / "alone").lines == lines, one
            shutil.rmtree(tmp_path / "alone")


def test_a_damaged_line_never_counts_and_gaps_are_counted(tmp_path):
    for k in range(9):
        journal.append(tmp_path, "answer", {"id": k})
    journal.mend(tmp_path)
    journal.close_all()
    for name in (journal.NAME, journal.BACKUP):  # a bit flip in both files
        (tmp_path / name).write_bytes((tmp_path / name).read_bytes().replace(b'"id": 3', b'"id": 4'))
    assert [one["id"] for one in journal.read(tmp_path).lines] == [0, 1, 2, 4, 5, 6, 7, 8]
    assert journal.read(tmp_path).lost() == [(4, 4)] and journal.read(tmp_path).lost(12) == [(4, 4), (10, 12)]
    journal.append(tmp_path, journal.REPAIR, {"lost": [(4, 4), (10, 12)]}, 12)
    assert journal.read(tmp_path).last == 13 and not journal.read(tmp_path).lost()


def test_lines_of_the_backup_return_although_another_process_appends_before_the_repair(tmp_path):
    for k in range(9):
        journal.append(tmp_path, "answer", {"id": k})
    journal.mend(tmp_path)
    with closing(sqlite3.connect(tmp_path / journal.NAME, isolation_level=None)) as other:
        other.execute("DELETE FROM line WHERE number < 4")
        assert journal.read(tmp_path).last == 9
        other.execute("INSERT INTO line VALUES (?, ?, ?, ?)", journal._row({"number": 10, "kind": "answer", "id": 9}))
        assert len(journal.read(tmp_path).lines) == 10
        assert "3 of 10 lines are refilled" in journal.mend(tmp_path)
    journal.close_all()
    assert [one["id"] for one in journal.read(tmp_path).lines] == list(range(10))


def test_lines_survive_a_kill_without_a_backup(tmp_path):
    """The log of SQLite holds them, also where the folder takes no files any more."""
    code = "import os, sys; from pathlib import Path; from tauext_commission import journal\n"
    code += "for k in range(30): journal.append(Path(sys.argv[1]), 'a', {'id': k})\nos.kill(os.getpid(), 9)"
    assert subprocess.run([sys.executable, "-c", code, str(tmp_path)]).returncode == -9
    assert (tmp_path / "journal.db-wal").stat().st_size and not (tmp_path / journal.BACKUP).exists()
    with mock.patch("tauext_commission.journal.os.access", lambda at, mode: not mode & os.W_OK):
        assert journal.read(tmp_path).last == 30
    journal.close_all()
    assert journal.read(tmp_path).last == 30 and not journal.mend(tmp_path)


def test_lines_of_several_processes_get_different_numbers_and_none_is_lost(tmp_path):
    code = "import sys; from pathlib import Path; from tauext_commission import journal\n"
    code += "for k in range(60): journal.append(Path(sys.argv[1]), 'a', {'id': k})"
    writers = [subprocess.Popen([sys.executable, "-c", code, str(tmp_path)]) for _ in range(3)]
    reads = own = 0
    while any(one.poll() is None for one in writers):
        journal.read(tmp_path)  # a reader, which also opens the database anew and writes: it sees no damage
        reads += 1
        if reads % 7 == 0:
            journal.close(tmp_path)
        if reads % 50 == 0:
            journal.append(tmp_path, "b", {"id": reads})
            own += 1
    assert [one.returncode for one in writers] == [0, 0, 0]
    assert [one["number"] for one in journal.read(tmp_path).lines] == list(range(1, 181 + own))
    assert not list(tmp_path.glob("*.damaged*"))


ODD = ["x", [], {}, {"joints": 5}, None]


@pytest.mark.parametrize("odd", [5, "../../b0002", *(pytest.param(one, marks=pytest.mark.slow) for one in ODD)])
def test_a_commission_json_of_odd_values_beside_no_journal_still_monitors(odd, prepared, tmp_path):
    """Its values are used where the journal is gone."""
    cell = shutil.copytree(prepared, tmp_path / "made" / "cell", symlinks=True)
    shutil.copyfile(prepared.parent / "log.parquet", tmp_path / "made" / "log.parquet")
    content = json.loads((cell / "commission.json").read_text())
    odds = dict.fromkeys((one for one in content if one not in ("format", "journal")), odd)
    (cell / "commission.json").write_text(json.dumps(content | odds))
    found = outcome(cell, tmp_path, (journal.NAME, journal.BACKUP), "deleted", "start")
    assert (found.traceback, found.refused, found.is_monitored) == ("", "", True)
    assert any("b0002 monitors the arm" in line for line in found.lines), found.lines


ODD = ({"bundle": "../../outside"}, {"bundle": "*"}, {"bundle": 5}, {"minutes": "x"}, {"after": {}})


@pytest.mark.parametrize("content", ODD)
def test_a_name_in_pending_json_leads_nowhere_else(content, copy):
    outside = copy.parent / "outside.tauext"
    shutil.copyfile(copy / "bundles" / "b0001.tauext", outside)
    folder = CommissionFolder.open(copy)
    folder.pending_file.write_text(json.dumps({"bundle": "b0001", "minutes": 1, "trained_on": []} | content))
    trainer = Trainer(folder)
    assert trainer._pending() == {} and trainer.facts().unseen_s is None
    assert outside.is_file() and len(list(folder.bundles.glob("*.tauext"))) == 2


# --- Forged lines: whole by their checksum, and written by another program.


NAMES_OUTSIDE = ("../x", "../../x", "sub/x", "..", ".", "", "x\0y", "ABSOLUTE", "C:x", 5, None)


def tree_of(path: Path) -> dict[str, bytes]:
    return {str(one.relative_to(path)): one.read_bytes() for one in sorted(path.rglob("*")) if one.is_file()}


@pytest.mark.parametrize("name", NAMES_OUTSIDE)
def test_a_forged_file_name_writes_nothing_outside_of_the_folder(name, copy):
    name = str(copy.parent / "forged") if name == "ABSOLUTE" else name
    forge(copy, "file", {"name": name, "text": "forged"})
    around = {one: text for one, text in tree_of(copy.parent).items() if not one.startswith("cell/")}
    folder = start(copy)
    assert {one: text for one, text in tree_of(copy.parent).items() if not one.startswith("cell/")} == around
    assert b"forged" not in b"".join(
        text for one, text in tree_of(copy).items() if not one.startswith(("journal", "log."))
    )
    assert folder.lost() == 1 and "its name" in describe_folder(copy)["unusable_lines"]
    assert folder.fall_back().stem == "b0002"  # it monitors all the same


@pytest.mark.parametrize("name", ["commission.json", "trainer.json", "journal.db", "seg-000001.parquet", "new.txt"])
def test_a_forged_file_line_writes_no_file_but_those_of_the_description(name, copy):
    forge(copy, "file", {"name": name, "text": "forged"})
    (copy / name).unlink(missing_ok=True)
    start(copy)
    assert not (copy / name).is_file() or (copy / name).read_bytes() != b"forged"


@pytest.mark.parametrize("name", ["../outside", "../../outside", "*", "b0001/../../outside", 5, None, "b٣"])
def test_a_forged_activation_chooses_no_bundle_outside_of_the_folder(name, copy, capsys):
    shutil.copyfile(copy / "bundles" / "b0001.tauext", copy / "outside.tauext")
    shutil.copyfile(copy / "bundles" / "b0001.tauext", copy.parent / "outside.tauext")
    forge(copy, "activation", {"bundle": name, "words": "x", "seconds": 1.0, "wall": ""})
    assert active_bundle(copy).stem == "b0002" and start(copy).fall_back().stem == "b0002"
    assert main(["show", str(copy)]) == 0
    assert "line" in (printed := capsys.readouterr().out) and "the name of a bundle of this folder" in printed


DEEP: list = []
for _ in range(50):
    DEEP = [DEEP]
ODD_VALUES = (
    None, True, -1, 10**12, 10**30, 1e300, float("nan"), float("-inf"), "x", "../x", "\x1b[2J\x00\n", "\ud800",
    "x" * 5000, [], {}, [[1]], [[2, 1]], [float("nan")], {"b0002": "x"}, {"joints": 5}, DEEP,
)  # fmt: skip
KINDS = (
    *("facts", "file", "activation", "event", "label", "training", "promise", "step", "reply", "repair", "compacted"),
    "budget",
)
ALSO = {
    "training": {"bundle": "b0002", "words": "x", "seconds": 1.0, "minutes": 1.0, "passed": True, "hits": 0.5,
                 "error": [0.1, 0.2], "units": ["N m", "N m"], "per_hour": 0.1, "wall": "2026-01-01T00:00:00Z"},
    "promise": {"bundle": "b0002", "words": "x", "seconds": 1.0, "promised_per_hour": 1.0, "hours": 1.0, "alarms": 0,
                "kept": True, "sentence": "x", "wall": "2026-01-01T00:00:00Z", "between_per_hour": [0.1, 2.0],
                "proved_per_hour": 9.0},
    "budget": {"words": "x", "seconds": 1.0, "false_alarms": 1.0, "in_hours": 2.0, "by": "page", "wall": ""},
    "step": {"words": "another tool?", "seconds": 1.0, "segment": 1, "learned": True, "wall": ""},
    "reply": {"answer": "leave", "by": "page", "wall": ""},
    "repair": {"lost": [[1000, 1001]], "words": "x", "seconds": 1.0},
    "compacted": {"dropped": [[1000, 1001]], "unanswered": {"b0002": 1}, "wall": ""},
    "event": {"id": 3, "epoch": 1, "t_ns": 3, "held_ns": 3, "level": "collision", "wall": "", "bundle": "b0002",
              "over": [1.2, 0.4], "flight": "x.parquet", "sentence": "x", "details": "x", "joint": "shoulder"},
}  # fmt: skip
"""A line of each kind that the prepared folder has not, or not with every key."""


def damaged_lines(path: Path, kind: str) -> list[dict]:
    """The newest line of a kind with each of its values replaced by each odd one, and with each key missing."""
    there = journal.read(path).kinds.get(kind) or [{}]
    good = {key: value for key, value in there[-1].items() if key not in ("number", "kind", "format", "journal")}
    good |= ALSO.get(kind, {})
    made = [good | {key: value} for key in good for value in ODD_VALUES]
    return made + [{key: value for key, value in good.items() if key != gone} for gone in good]


@pytest.mark.parametrize(
    "kind",
    [pytest.param(one, marks=[pytest.mark.slow] * (one not in ("file", "activation", "label"))) for one in KINDS],
)
def test_forged_lines_end_in_sentences(kind, copy, prepared, tmp_path, capsys):
    shutil.copyfile(prepared.parent / "log.parquet", tmp_path / "log.parquet")
    for one in damaged_lines(copy, kind):
        forge(copy, kind, one)
    around = {one for one in tree_of(tmp_path) if not one.startswith("cell/")}
    with alone():
        made = end(begin(copy))
        assert all(isinstance(one, ConfigError) for one in made.errors), made.errors
        assert not [line for line in made.lines if "Error" in line], made.lines
        folder = CommissionFolder.open(copy, create=True)
        assert Trainer(folder).step() in ("nothing", "answer", "check", "judge", "train", "promise", "budget")
    assert {one for one in tree_of(tmp_path) if not one.startswith("cell/")} == around
    for words in (["show", str(copy)], ["show", str(copy), "--json"]):
        assert main(words) == 0
    printed = capsys.readouterr().out
    assert "\x1b" not in printed.partition("{")[0] and "is not used: " in printed
    assert main(["report", str(copy), "--out", str(tmp_path / "page")]) == 0
    assert main(["report", str(copy), str(copy), "--out", str(tmp_path / "arms")]) == 0
    assert "its files are damaged" not in capsys.readouterr().out


ODD_COVERAGE = (
    "", "{", "[]", "deleted", '{"seconds": "x", "kept_s": [], "bytes": NaN, "joints": 5}',
    '{"joints": [5, {"joint": 3}], "monitored": {"b0002": [1e-300, 1e-300]}}',
    '{"seconds": -5, "journal": 1e9, "needs_s": "x", "monitored_hour": {}}',
)  # fmt: skip


@pytest.mark.parametrize("content", ODD_COVERAGE)
def test_without_a_coverage_file_an_arm_is_shown_and_reported(content, copy, tmp_path, capsys):
    (copy / "coverage.json").unlink()
    if content != "deleted":
        (copy / "coverage.json").write_text(content)
    assert main(["show", str(copy)]) == 0 and "b0002" in capsys.readouterr().out
    assert main(["report", str(copy), "--out", str(tmp_path / "one")]) == 0


def test_the_fault_of_one_arm_stays_in_its_row(copy, prepared, tmp_path, capsys, monkeypatch):
    (copy / "coverage.json").unlink()
    shutil.copytree(prepared, tmp_path / "whole")
    whole = arm_row(tmp_path / "whole")
    real = history.describe_folder

    def raises(folder):
        if folder.name == "cell":
            raise ZeroDivisionError("a fault that nobody has foreseen")
        return real(folder)

    monkeypatch.setattr(history, "describe_folder", raises)
    assert main(["report", str(copy), str(tmp_path / "whole"), "--out", str(tmp_path / "arms")]) == 0
    assert "cell: its files are damaged (ZeroDivisionError: a fault that nobody" in capsys.readouterr().out
    assert arm_row(tmp_path / "whole") == whole


# --- A folder that cannot be written.


@contextmanager
def unwritable(path: Path, number: int):
    """Every change of a file below this folder raises this error, as on a file system that is read-only or full; root
    ignores permissions."""
    whole = str(path.resolve())

    def refused(real, *flags):
        def call(at, *others, **options):
            names = [str(one) for one in (at, *others[:1]) if isinstance(one, str | os.PathLike)]
            inside = any(os.path.abspath(one).startswith(whole) for one in names)
            mode = str(options.get("mode", others[0] if others else "r"))
            writes = (
                others[0] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC) if "flags" in flags
                else set(mode) & set("wax+") if "mode" in flags
                else os.path.lexists(at) or "make" in flags
            )  # fmt: skip
            if inside and writes:
                raise OSError(number, os.strerror(number), str(at))
            return real(at, *others, **options)

        return call

    def bind(self, address, real=socket.socket.bind):
        if str(address).startswith(whole):
            raise OSError(number, os.strerror(number))
        return real(self, address)

    with ExitStack() as stack:
        for target, *flags in (
            ("io.open", "mode"), ("builtins.open", "mode"), ("os.open", "flags"), ("os.mkdir", "make"), ("os.unlink",),
            ("os.rename",), ("os.replace",), ("os.truncate",), ("os.rmdir",),
        ):  # fmt: skip
            module, name = target.split(".")
            real = getattr(importlib.import_module(module), name)
            stack.enter_context(mock.patch(target, refused(real, *flags)))
        stack.enter_context(mock.patch.object(socket.socket, "bind", bind))
        stack.enter_context(mock.patch("tauext_commission.journal.os.access", lambda at, mode: not mode & os.W_OK))
        yield


@pytest.mark.parametrize(
    "number", [errno.EROFS, *(pytest.param(one, marks=pytest.mark.slow) for one in (errno.EACCES, errno.ENOSPC))]
)
@pytest.mark.parametrize("damage", ["", "bundles/b0002.tauext", "commission.json", "coverage.json", "robot.urdf"])
def test_an_arm_whose_folder_cannot_be_written_is_monitored(number, damage, copy, prepared, tmp_path):
    shutil.copyfile(prepared.parent / "log.parquet", tmp_path / "log.parquet")
    if damage:
        (copy / damage).write_bytes(b"")
    (copy / ".reserve").unlink()  # a full disk has used it up
    before = tree_of(copy)
    with alone():
        with unwritable(copy, number):
            made = begin(copy)
            assert not made.errors, made.errors
            wait(lambda: any("monitors the arm" in line for line in made.lines), str(made.lines))
            with pytest.raises(ConfigError, match=f"not stored: {os.strerror(number)}"):
                made.control[0]._alarm_journal.answer("touched", "test")
        assert tree_of(copy) == before
        printed = "\n".join(made.lines)
        assert os.strerror(number) in printed and "nothing is recorded, trained or stored" in printed, printed
        assert "tried again each second: " not in printed and " is chosen: " not in printed, printed  # no old news
        assert ("b0001" if damage.startswith("bundles") else "b0002") + " monitors the arm" in printed
        wait(lambda: any("can be written again" in line for line in made.lines), str(made.lines))
        made.control[0]._alarm_journal.answer("touched", "test")  # stored again, without a restart
        end(made)
    assert any(one.id < 0 and one.answer == "touched" for one in CommissionFolder(copy).labels())


def test_a_new_folder_that_cannot_be_written_is_refused_in_one_sentence(tmp_path, prepared):
    shutil.copyfile(prepared.parent / "log.parquet", tmp_path / "log.parquet")
    with alone(), unwritable(tmp_path / "cell", errno.EROFS):
        made = begin(tmp_path / "cell")
    (error,) = made.errors
    assert isinstance(error, ConfigError) and "cannot be written" in str(error)


def odd_log(kind: str, folder: Path) -> Path:
    """A recording that cannot be replayed."""
    path = folder / f"{kind}.parquet"
    whole = folder / "whole.parquet"
    save_recording(pushed(seconds=0.5, pushes=()), whole)
    raw = whole.read_bytes()
    made = {"cut": raw[: len(raw) // 2], "empty": b"", "garbage": bytes(range(256)) * 9}
    made["flipped"] = raw[: len(raw) // 3] + bytes([raw[len(raw) // 3] ^ 255]) + raw[len(raw) // 3 + 1 :]
    if kind in made:
        path.write_bytes(made[kind])
    elif kind != "gone":
        {"directory": path.mkdir, "dangling": lambda: path.symlink_to("x"), "loop": lambda: path.symlink_to(path.name),
         "pipe": lambda: os.mkfifo(path)}[kind]()  # fmt: skip
    return path


LOGS = ("cut", "empty", "garbage", "flipped", "directory", "dangling", "loop", "pipe", "gone")


@pytest.mark.parametrize("kind", LOGS)
def test_a_log_that_cannot_be_replayed_is_refused_and_leaves_no_folder(kind, tmp_path, capsys):
    path, out = odd_log(kind, tmp_path), tmp_path / "cell"
    assert main(["commission", "--source", f"replay:{path}", "--out", str(out), "--no-page"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and f"{kind}.parquet: " in err and not out.exists()


@pytest.mark.parametrize(("robot", "why"), [("other", "no joint"), ("cut", "as XML"), ("gone", "no such file")])
def test_a_wrong_robot_file_is_refused_and_nothing_is_described(robot, why, tmp_path, capsys):
    path, out = odd_log("gone", tmp_path).with_name("whole.parquet"), tmp_path / "cell"
    text = {"other": ROBOT.replace(f'"{JOINTS[0]}"', '"other"'), "cut": ROBOT[:200]}.get(robot)
    if text is not None:
        (tmp_path / "arm.urdf").write_text(text)
    words = ["--robot", str(tmp_path / "arm.urdf"), "--no-page"]
    assert main(["commission", "--source", f"replay:{path}", "--out", str(out), *words]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and why in err and not (out / "arm.toml").exists()


def test_a_repair_that_goes_on_states_its_end(copy, capsys):
    """The line between the two; the source is refused, so that nothing runs."""
    assert (
        main(["commission", "--out", str(copy), "--repair", "--source", f"replay:{copy.parent / 'gone.parquet'}"]) == 2
    )
    assert "the repair is complete; monitoring begins with replay:" in capsys.readouterr().out


def long_journal(path: Path, alarms: int) -> CommissionFolder:
    """A journal of alarms with four lines each; every tenth is answered, and the answer of every 20th was changed."""
    folder = CommissionFolder.open(path, create=True)
    rows, number = [], journal.read(path).last
    for k in range(1, alarms + 1):
        event = {"kind": "event", "id": k, "level": "collision", "bundle": "b0001", "epoch": 1, "wall": "x"}
        label = {"kind": "label"} | asdict(Label(k, 1, k * 10**9, k * 10**9, "unanswered", "nobody", "x", "b0001"))
        lines = [event, label, event | {"flight": f"{k}"}, label]
        lines += [label | {"answer": "touched", "by": "page"}] * (k % 10 == 0)
        lines += [label | {"answer": "nothing", "by": "page"}, label | {"answer": "withdrawn"}] * (k % 20 == 0)
        for line in lines:
            number += 1
            rows.append(journal._row({"number": number} | line))
    journal._insert(journal._open[path], rows)
    journal.close_all()
    return folder


def facts_of(path: Path) -> tuple:
    """What others read of a journal of long_journal()."""
    answers = {one.id: one.answer for one in read_labels(path) if one.answer in ("touched", "nothing")}
    events = [one for one in read_events(path) if one["answer"] or one["id"] > 1000]
    return answers, [(one["id"], one["answer"], one["flight"]) for one in events], read_history(path)


def test_a_journal_is_compacted_and_loses_no_answer(tmp_path, monkeypatch):
    """Lines that newer ones replace go, and old alarms without an answer; a kill in between loses nothing either."""
    monkeypatch.setattr("tauext_commission.folder.MOST_ALARMS", 900)
    folder = long_journal(tmp_path, 2000)
    folder.save(state="x")
    size, before, count = journal.read(tmp_path).last, facts_of(tmp_path), len(read_events(tmp_path))
    journal.mend(tmp_path)  # the backup has all lines
    whole = journal.read(tmp_path).lines
    folder.compact()
    compacted = journal.read(tmp_path).lines
    assert 2 * len(compacted) < len(whole)
    for _ in range(2):  # with an older backup, and with a new one
        journal.close_all()
        again = CommissionFolder.open(tmp_path, create=True)
        assert facts_of(tmp_path) == before and not again.lost() and len(before[0]) == 200
        assert journal.read(tmp_path).lines == compacted and not list(tmp_path.glob("*.damaged*"))
    there = len(read_events(tmp_path))
    assert there < count and left_out(tmp_path) == {"b0001": count - there}  # the summary
    again.append_label(Label(3000, 1, 1, 2, "touched", "page", "", "b0001"))
    cut_journal(again, lambda line: line["number"] not in (size, size + 1, 40))
    assert again.lost() > 0  # a line that is lost is no line that was left out
    again.compact()
    assert again.lost() > 0


def test_alarms_whose_recordings_are_there_keep_their_labels(tmp_path, monkeypatch):
    monkeypatch.setattr("tauext_commission.folder.MOST_ALARMS", 10)
    folder = long_journal(tmp_path, 2000)
    folder.segments = lambda: [Segment("seg-000001.parquet", 1, "train", 1, 500 * 10**9, 510 * 10**9, 10.0, 1)]
    folder.compact()
    kept = {one.id for one in folder.labels() if one.answer == "unanswered"}
    assert set(range(481, 540)) - set(range(0, 2000, 10)) <= kept < set(range(400, 2001)) and 1999 in kept


def test_a_page_or_a_training_sees_a_compacted_journal(tmp_path):
    """Another process has removed lines since this one has read the journal."""
    long_journal(tmp_path, 2000)
    other = sqlite3.connect(tmp_path / journal.NAME, isolation_level=None)
    before = journal.read(tmp_path).lines
    other.execute("DELETE FROM line WHERE number BETWEEN 5 AND 900")
    assert len(journal.read(tmp_path).lines) == len(before) - 896
    other.close()


def test_files_that_were_set_aside_have_a_bound(tmp_path):
    (tmp_path / "bundles").mkdir()
    names = (
        "journal.db.damaged",
        "bundles/b0001.tauext.damaged",
        "seg-000001.parquet.damaged",
        "split.json.damaged-3",
    )
    for k, name in enumerate((*names, "seg-000002.parquet.damaged-12")):
        (tmp_path / name).write_bytes(bytes(100))
        os.utime(tmp_path / name, (k, k))
    (tmp_path / "log.txt.damaged").mkdir()  # none of this program's files
    assert trim_damaged(tmp_path, 500) == ""
    assert trim_damaged(tmp_path, 310) == "seg-000001.parquet.damaged, b0001.tauext.damaged"
    assert trim_damaged(tmp_path, 0) == "split.json.damaged-3, journal.db.damaged"
    assert sorted(os.listdir(tmp_path)) == ["bundles", "log.txt.damaged", "seg-000002.parquet.damaged-12"]


# --- The whole command, without its children.


@pytest.mark.slow
@pytest.mark.parametrize("when", ["start", "running"])
@pytest.mark.parametrize("name", NAMES)
def test_the_command_survives_every_fault(name, when, prepared, tmp_path):
    for fault in faults(tmp_path) if when == "start" else ("deleted", "garbage"):
        (tmp_path / fault).mkdir()
        found = outcome(prepared, tmp_path / fault, (name,), fault, when)
        assert (found.traceback, found.lost_silently, found.is_monitored, found.refused) == ("", 0, True, ""), fault


@pytest.mark.parametrize("fault", ["garbage", pytest.param("deleted", marks=pytest.mark.slow)])
def test_the_command_reports_a_journal_that_both_files_have_lost(fault, prepared, tmp_path):
    found = outcome(prepared, tmp_path, (journal.NAME, journal.BACKUP), fault, "start")
    assert found.is_monitored and not found.traceback
    assert any(re.search(r"journal: at least \d+ confirmed lines are lost", line) for line in found.lines)
    assert json.loads((tmp_path / "cell" / "commission.json").read_text())["journal"] > 20


ALL = (journal.NAME, journal.BACKUP, "commission.json")
LEFT = {"whole": (), "arm": ("arm.toml",), "robot": ("robot.urdf",), "newest": ("bundles/b0002.tauext",)}
"""What else is damaged beside journal and commission.json."""


@pytest.mark.parametrize("others", LEFT)
@pytest.mark.parametrize(
    "fault", ["deleted", *(pytest.param(one, marks=pytest.mark.slow) for one in FAULTS if one != "deleted")]
)
def test_a_whole_bundle_monitors_an_arm_that_has_lost_everything_else(fault, others, prepared, tmp_path):
    """Journal and commission.json are gone together: nothing is trained before a person has accepted that."""
    if fault not in faults(tmp_path):
        pytest.skip("root may read everything")
    found = outcome(prepared, tmp_path, (*ALL, *LEFT[others]), fault, "start")
    is_older = others == "newest" and fault != "older copy"
    bundle = "b0001" if is_older else "b0002"
    assert (found.traceback, found.refused, found.is_monitored) == ("", "", True)
    if fault == "older copy":
        return
    expected = [r"journal: at least \d+ confirmed lines are lost", f"{bundle} monitors the arm"]
    for line in (*expected, f"{bundle} is chosen: "):
        assert any(re.search(line, one) for one in found.lines), (line, found.lines)
    folder = CommissionFolder.open(tmp_path / "cell")
    assert folder.lost() and Trainer(folder).step() == "nothing" and len(list(folder.bundles.glob("*.tauext"))) >= 1
    assert folder.facts["epoch"] > max(one.epoch for one in CommissionFolder(prepared).segments())
    assert main(["commission", "--out", str(folder.path), "--repair"]) == 0
    journal.close_all()
    assert not start(folder.path).lost() and start(folder.path).fall_back().stem == bundle
    assert Trainer(CommissionFolder.open(folder.path)).facts().kept_s == 0.0
