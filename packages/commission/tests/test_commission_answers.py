"""Alarms of a loop as lines for the page and in the journal; answers that are on the disk when they are confirmed."""

import json
import math
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_bundles import JOINTS, pushed, watching_bundle
from made_commission import words
from made_live import ScriptedSource, samples_of
from tauext_commission.answers import AlarmJournal, CurrentLoop
from tauext_commission.exchange import Exchanged
from tauext_commission.folder import CommissionFolder
from tauext_commission.history_file import read_events, read_labels
from tauext_commission.live import MOST_READERS, PAST_EVERY, Curves, LiveSink
from tauext_commission.motion_recorder import MotionRecorder
from tauext_commission.processes import Child
from tauext_commission.promises import put_suspects
from tauext_commission.run import AGAIN_S, Commission

from tauext.bundle.estimates import CONTACT, OK, STALE, rounded
from tauext.errors import ConfigError
from tauext.monitor.changes import ChangeFinder
from tauext.monitor.control_lines import obey
from tauext.monitor.episode import Episode, EpisodeFinder
from tauext.monitor.flight_files import FlightNews
from tauext.monitor.loop import Loop
from tauext.monitor.record_sink import RecordCount
from tauext.monitor.source import settings_of
from tauext.monitor.touch_place import PlaceChange
from tauext.train.suspects import Suspect

PATIENCE_S = 20.0
PAUSE = 4000
"""Sample before which the source waits: the push is over, its alarm stands."""


def until(true, what):
    end = time.monotonic() + PATIENCE_S
    while not true():
        assert time.monotonic() < end, what
        time.sleep(0.01)


class Arm:
    """A loop on a recording in which the arm is pushed at 2 s; the source then waits until it is told to go on."""

    def __init__(self, path, recording=None, pause=PAUSE):
        self.folder = CommissionFolder.open(path, create=True)
        self.bundle, self.notes = watching_bundle(), []
        self.go_on = threading.Event()
        settings = settings_of(self.bundle)
        samples = samples_of(recording or pushed())
        source = ScriptedSource([*samples[:pause], self.go_on.is_set, *samples[pause:]])
        self.record = MotionRecorder(self.folder, settings, "script", 1e9)
        self.keeper = AlarmJournal(self.folder, lambda: self.record.epoch, self.notes.append)
        self.live = LiveSink(path / "live.sock")
        self.live.alarm = self.keeper.event
        self.live.describe(settings.joints, settings.torque_units)
        self.loop = Loop(self.bundle, source, [self.record, self.keeper, self.live])
        self.loop.monitor.alarms = self.keeper.newest
        for sink in (self.keeper, self.live):
            sink.follow(self.bundle, self.loop.monitor)
        self.current_loop = CurrentLoop(self.keeper, self.loop.stop)
        self.current_loop.loop = self.loop
        self._thread = threading.Thread(target=self.loop.run, daemon=True)
        self._thread.start()
        until(lambda: self.loop.samples == pause and self.keeper.unanswered, "the alarm")
        until(lambda: self.keeper.newest in {one.id for one in read_labels(path)}, "its label")

    def end(self):
        self.go_on.set()
        self._thread.join(PATIENCE_S)
        assert not self._thread.is_alive()
        self.live.end()
        self.keeper.end()


@contextmanager
def arm(path, *settings):
    one = Arm(path, *settings)
    try:
        yield one
    finally:
        one.end()


def lines_of(path, number=1):
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as wire:
        wire.settimeout(PATIENCE_S)
        wire.connect(str(path))
        with wire.makefile("rb") as lines:
            return [json.loads(lines.readline()) for _ in range(number)]


def test_an_alarm_is_shown_asked_about_and_answered(tmp_path):
    with arm(tmp_path / "cell") as one:
        (shown,) = lines_of(one.live._path)
        assert shown["alarm"]["id"] == 1 and shown["alarm"]["level"] == "collision" and shown["alarm"]["answer"] is None
        assert shown["alarm"]["sentence"] == f"Touched at {JOINTS[0]} or beyond it"
        assert shown["alarm"]["details"].startswith("COLLISION") and JOINTS[0] in shown["alarm"]["details"]
        until(lambda: len(one.notes) == 2, "the alarm's lines in the terminal")
        contact, collision = one.notes
        assert "(Contact: " in contact and collision.startswith(
            f"alarm 1: Touched at {JOINTS[0]} or beyond it (COLLISION"
        )
        assert collision.endswith("threshold 2 Nm); answer: `touched 1` or `nothing 1`") and JOINTS[0] in collision
        assert shown["bundle"] == one.bundle.name and len(shown["tau_ext"]) == len(shown["q"]) == len(JOINTS)
        assert [label.answer for label in read_labels(one.folder.path)] == ["unanswered"]
        assert obey("nothing 7", one.current_loop, "test") == "error: nothing: there is no alarm 7; the newest is 1"
        assert obey("nothing", one.current_loop, "test") == "ok"  # and now it is on the disk
        (label,) = read_labels(one.folder.path)
        assert (label.answer, label.by, label.id) == ("nothing", "test", 1)
        assert read_events(one.folder.path)[-1]["answer"] == "nothing" and one.keeper.unanswered is None
        assert obey("touched 1", one.current_loop, "page") == "ok"  # a person may change it
        assert [label.answer for label in read_labels(one.folder.path)] == ["touched"]
        assert one.keeper.event(1)["answer"] == "touched"
    (event,) = read_events(one.folder.path)
    assert event["ended"] and event["answer"] == "touched" and event["held_ns"] > event["t_ns"]
    assert len(event["over"]) == len(JOINTS) and 1 < event["over"][0] and abs(event["over"][1]) < event["over"][0]


def test_curves_keep_the_peak_of_one_sample_and_are_empty_without_an_estimate():
    def verdict(t_ms, tau, health=OK):
        columns = {"tau_ext": tau, "contact_sigma_nm": 0.1, "limit_nm": 2.0, "contact_limit_nm": 1.0}
        estimates = {name: np.array([[value, value / 4]]) for name, value in columns.items()}
        return SimpleNamespace(t_ns=np.array([t_ms * 1_000_000]), estimates=estimates | {"health": np.array([health])})

    curves = Curves(2)
    for one in [verdict(k, -7.5 if k == 31 else 0.5) for k in range(50)]:
        curves.add(one)
    for k in (60, 70):
        curves.add(verdict(k, math.nan, STALE))
    curves.draw(verdict(80, 0.5))
    assert curves.trace == [(0, [0.5, 0.125]), (31_000_000, [-7.5, -1.875]), (60_000_000, [])]
    assert list(curves.past) == [(31_000_000, [[-7.5, -1.875], [0.1, 0.025], [2.0, 0.5], [1.0, 0.25]])]
    curves.draw(verdict(90, 0.5))
    assert curves.trace == [] and len(curves.past) == 1


@pytest.mark.slow
def test_a_page_that_is_opened_gets_the_past(tmp_path):
    with arm(tmp_path / "cell") as one:
        lines = lines_of(one.live._path, PAST_EVERY + 1)
        (past,) = [line["past"] for line in lines if "past" in line][:1]
        ages = [age for age, *_ in past]
        assert 30 < len(past) < 80 and ages == sorted(ages, reverse=True) and ages[0] > 3000
        assert max(abs(tau[0]) for _, tau, *_ in past if tau) > 3  # the push, seconds ago


def test_an_alarm_has_the_torque_of_its_peak_with_the_limit_there_less_what_is_explained():
    def facts(t_ns, tau, limit, declared, *changes):
        at = {"held_alarm": 2, "touch_over": 0, "touch_t_ns": t_ns, "alarm": 2, "alarm_joint": 1, "alarm_number": 3}
        torques = {"tau_ext": (0.1, tau), "declared_nm": (0.0, declared), "limit_nm": (1.0, limit)}
        torques |= {"margin_nm": (0.9, limit - abs(tau - declared)), "sigma_nm": (0.1, 0.1), "near_stiction": (0, 0)}
        estimates = {name: np.array([value]) for name, value in (at | torques).items()}
        changes = changes or (ChangeFinder._alarm_change(0, t_ns, 0, 0, estimates),)
        (one,) = finder.find(changes[0].row, np.array([t_ns]), estimates, changes)
        return changes[0], one.facts(("a", "b"), ("N m", "N m"))

    finder = EpisodeFinder()
    rise, risen = facts(10, 12.5, 2.0, 10.0)
    assert (risen["sentence"], risen["tau_ext_nm"], risen["limit_nm"]) == ("Touched at b or beyond it", 2.5, 2.0)
    assert "|tau_ext - explained| 2.50 Nm" in rise.words(("a", "b"), ("N m", "N m"))[0]
    best = SimpleNamespace(link=1, point=(0, 0, 0), force=(0.0, 84.3, 0.0))
    links = ((1, 0.95), (0, 0.05))
    place = PlaceChange(5, 50, 2, 1, 0.1, links, (), best, 0.1, 84.3, (70.0, 101.0), 0.5, None, 3)
    _, placed = facts(50, -21.0, 3.0, 0.0, place)
    assert placed["sentence"] == "Touched at b, 70 to 100 N"
    assert placed["details"] == "COLLISION on the link of b: 21 Nm at b, threshold 3 Nm"
    _, later = facts(60, 2.6, 2.55, 0.0, replace(place, row=6, t_ns=60))  # weaker: the peak stays
    assert later["details"] == placed["details"] and later["newtons_interval"] == [70.0, 101.0]


def test_suspects_are_labels_and_a_line_of_the_history(tmp_path):
    folder = CommissionFolder.open(tmp_path / "cell", create=True)
    one = Suspect("seg-000001", 0, 0, 500_000_000, 0, ("a", "b"), 1.6, "a", epoch=1)
    put_suspects(folder, [one, replace(one, joints=("a",), times=3.0, from_ns=2_000_000_000)], "b0001")
    assert words(folder)[-1].startswith("2 unlabelled contacts, ")
    assert [one.answer for one in read_labels(folder.path)] == ["suspect"] * 2  # all are left out of training


def test_an_answer_counts_for_a_touch_until_its_end(tmp_path):
    """Label, event and page agree: one alarm, answered, which ends with the touch."""
    with arm(tmp_path / "cell", pushed(pushes=((2.0, 0, 6.0),), length_s=2.0), 2500) as one:
        assert obey("touched", one.current_loop, "page") == "ok"
        assert one.keeper.unanswered is None  # nobody is asked any more
        (shown,) = lines_of(one.live._path)
        assert shown["alarm"]["id"] == 1 and shown["alarm"]["answer"] == "touched"
        before = read_labels(one.folder.path)[0].to_ns
    (label,) = read_labels(one.folder.path)
    (event,) = read_events(one.folder.path)
    assert (label.id, label.answer, label.by) == (1, "touched", "page") and one.loop.alarms == 1
    assert before < label.to_ns - 1_000_000_000 and 4_000_000_000 < label.to_ns - 7_000_000_000 < 4_300_000_000
    assert event["answer"] == "touched" and event["ended"] and abs(event["held_ns"] - label.to_ns) < 100_000_000


def test_a_touch_without_an_alarm_is_a_label_of_its_own(tmp_path):
    with arm(tmp_path / "cell") as one:
        assert obey("touched 1", one.current_loop, "a") == obey("touched", one.current_loop, "b") == "ok"
        labels = {label.id: label for label in read_labels(one.folder.path)}
        assert labels[1].by == "a" and min(labels) < 0 and labels[min(labels)].by == "b"
        assert labels[min(labels)].to_ns - labels[min(labels)].from_ns == 3_000_000_000
        assert obey("nothing", one.current_loop, "b") == "error: nothing: the newest alarm (1) has an answer"

        def refuse(yes, by):
            raise ConfigError(f"no change waits for {yes}")

        one.keeper.learn = refuse
        for line, yes in (("learn yes", True), ("learn no", False)):
            assert obey(line, one.current_loop, "b") == f"error: no change waits for {yes}"


def test_lost_recordings_are_shown_on_the_page(tmp_path):
    one = Commission.__new__(Commission)
    one._folder = CommissionFolder.open(tmp_path / "cell", create=True)
    one._live = SimpleNamespace(state="monitoring", message="", lost="", bundle="b0001")
    one._has_ended, one._lost = False, ""
    one._loop, one._source, one._alarm_journal = SimpleNamespace(samples=1), None, SimpleNamespace(unanswered=None)
    one._record = SimpleNamespace(
        is_losing=True, count=RecordCount(error=f"{one._folder.path}/seg-000001.parquet: full")
    )
    one._show_state()
    assert one._live.message == "RECORDING LOSES SAMPLES: seg-000001.parquet: full"
    one._record.is_losing = False
    one._show_state()
    assert one._live.message == "" and one._live.state == "monitoring"


def test_a_source_that_comes_and_goes_prints_one_line_a_minute(tmp_path, monkeypatch):
    one = Commission.__new__(Commission)
    one._folder = CommissionFolder.open(tmp_path / "cell", create=True)
    one._live = SimpleNamespace(state="monitoring", message="", lost="", bundle="b0001")
    one._has_ended, one._record, one._lost = False, None, ""
    one._loop, one._alarm_journal = SimpleNamespace(samples=1), SimpleNamespace(unanswered=None)
    now_s, lines = 0.0, []
    one._note, one._echo = lines.append, lines.append
    monkeypatch.setattr("tauext_commission.run.time", SimpleNamespace(monotonic=lambda: now_s))
    for second in range(600):
        now_s, one._source = float(second), SimpleNamespace(away="no sample for 2 s" if second % 4 < 2 else "")
        one._show_state()
        assert one._live.lost == one._source.away  # the page shows each
    assert lines[:2] == ["NOTHING IS MONITORED: no sample for 2 s", "samples come again"]
    assert 16 <= len(lines) <= 20


def test_a_flight_belongs_to_its_alarm_by_number(tmp_path):
    folder = CommissionFolder.open(tmp_path / "cell", create=True)
    for number in (1, 2):
        folder.append_event({"id": number, "epoch": 1, "t_ns": 5, "held_ns": 9, "level": "collision"})
    keeper = AlarmJournal(folder, lambda: 1, print)
    for number, name in ((1, "one"), (3, "no such alarm"), (0, "fault")):
        keeper.flown(FlightNews("collision", 7, tmp_path / f"{name}.parquet", None, number))
    keeper.flown(FlightNews("collision", 7, None, "a full disk", 2))
    keeper.end()
    assert [(one["id"], one.get("flight")) for one in read_events(folder.path)] == [(1, "one.parquet"), (2, None)]
    assert [(one.id, one.from_ns, one.to_ns, one.answer) for one in read_labels(folder.path)] == [
        (1, 5, 9, "unanswered"), (2, 5, 9, "unanswered")
    ]  # fmt: skip


def test_an_event_that_cannot_be_written_ends_no_thread(tmp_path):
    folder, notes = CommissionFolder.open(tmp_path / "cell", create=True), []
    keeper = AlarmJournal(folder, lambda: 1, notes.append)
    keeper.open(("a",), None)
    for number, bundle in ((1, float("nan")), (2, "b0001")):
        keeper.learned(Episode(number, CONTACT, 0, bundle, 7, 8, 2.0, 1.0))
    keeper.end()
    assert [one["id"] for one in read_events(folder.path)] == [2]
    assert [note for note in notes if note.startswith("an event is not stored: ")]


def test_a_bundle_that_could_not_take_over_is_tried_again(tmp_path, monkeypatch):
    one, asked, lines = Commission.__new__(Commission), [], []
    one._folder = CommissionFolder.open(tmp_path / "cell", create=True)
    one._live, one._by, one._arm = SimpleNamespace(bundle="b0001"), "", {"period_ns": 10**6}
    one._active, one._again_s, one._why_refused, one._exchanged = 0, math.inf, ("", ""), None
    one._echo = lines.append
    loop = SimpleNamespace(bring=lambda path, done: asked.append((path.stem, done)))
    for name in ("b0001", "b0002"):
        (one._folder.bundles / f"{name}.tauext").touch()
    one._folder.activate("b0002", "a test", 0.0)
    now_s = time.monotonic()
    one._bring_bundle(loop, now_s)
    for tries in (1, 2, 3):
        assert [name for name, _ in asked] == ["b0002"] * tries
        asked[-1][1]("b0002 stays out: a contact lasts")
        one._bring_bundle(loop, now_s + 0.5 * AGAIN_S)
        assert len(asked) == tries
        one._bring_bundle(loop, now_s + 1.1 * AGAIN_S)
    assert lines == ["b0002 does not take over: b0002 stays out: a contact lasts"]
    asked[-1][1]("")
    one._live.bundle = "b0002"
    one._exchanged = Exchanged("b0002", "b0001", 1, 1, 1000, b"", b"", 0, 5.0)
    with monkeypatch.context() as full:
        full.setattr(CommissionFolder, "save", lambda *_, **__: (_ for _ in ()).throw(OSError(28, "full")))
        with pytest.raises(OSError, match="full"):
            one._bring_bundle(loop, now_s)
    one._bring_bundle(loop, now_s + 5 * AGAIN_S)
    assert len(asked) == 4 and [line["kind"] for line in one._folder.history()] == ["activation", "exchange"]


def test_the_next_process_counts_on_and_knows_the_answers(tmp_path):
    with arm(tmp_path / "cell") as one:
        assert obey("touched 1", one.current_loop, "test") == "ok"
    before = one.keeper.newest
    with arm(tmp_path / "cell") as one:
        assert one.loop.alarms == one.keeper.newest == before + 1
        assert one.keeper.event(1)["answer"] == "touched"
        assert obey("nothing 1", one.current_loop, "page") == "ok"  # of an earlier run
        assert obey("nothing", one.current_loop, "page") == "ok"  # of the alarm that stands
    labels = {label.id: label for label in read_labels(one.folder.path)}
    assert labels[1].answer == labels[before + 1].answer == "nothing"
    assert (labels[1].epoch, labels[before + 1].epoch) == (1, 2)


def test_lines_come_before_there_is_an_arm_and_slow_readers_hold_up_nobody(tmp_path):
    live = LiveSink(tmp_path / "live.sock")
    live.message = "no robot there"
    slow = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    slow.connect(str(tmp_path / "live.sock"))  # reads nothing
    try:
        lines = lines_of(tmp_path / "live.sock", 3)
        assert [(one["state"], one["message"], one["joints"]) for one in lines] == [
            ("connecting", "no robot there", [])
        ] * 3
        assert "tau_ext" not in lines[0]
    finally:
        slow.close()
        live.end()
    assert not (tmp_path / "live.sock").exists()


def test_readers_that_only_hold_the_line_take_no_place_of_the_page(tmp_path):
    live = LiveSink(tmp_path / "live.sock")
    with ExitStack() as stack:
        stack.callback(live.end)
        for _ in range(5 * MOST_READERS):
            silent = stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
            silent.connect(str(tmp_path / "live.sock"))
        assert len(lines_of(tmp_path / "live.sock", 2)) == 2


def test_a_reader_that_takes_no_line_is_closed(tmp_path, monkeypatch):
    monkeypatch.setattr("tauext_commission.live.UNREAD_S", 0.3)
    live = LiveSink(tmp_path / "live.sock")
    live.message = "x" * 100_000  # a line fills the buffer
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as silent:
        silent.connect(str(tmp_path / "live.sock"))
        poll = select.poll()
        poll.register(silent, 0)
        try:
            until(lambda: poll.poll(0), "its end")  # the other end is closed
        finally:
            live.end()


def test_control_is_refused_while_no_arm_is_connected(tmp_path):
    stopped: list[str] = []
    keeper = AlarmJournal(CommissionFolder(tmp_path), lambda: 0, print)
    current_loop = CurrentLoop(keeper, stopped.append)
    for line in ("touched", "nothing 1", "learn yes", "acknowledge", "sim push"):
        assert obey(line, current_loop, "test").startswith("error: "), line
    with pytest.raises(ConfigError, match="no arm is connected"):
        current_loop.acknowledge("test")
    assert obey("stop", current_loop, "test") == "ok" and stopped == ["test"]  # the command, which is still connecting
    keeper.end()


def test_numbers_that_json_has_not_are_none():
    assert rounded([[1.0, float("nan"), float("inf"), 0.123456789]]) == [1.0, None, None, 0.12346]


def sleep_for_ever(pipe):
    time.sleep(1000)


def die_at_once(pipe):
    raise SystemExit(3)


def test_a_child_is_started_again_when_it_ends_and_not_at_once(monkeypatch):
    now = [0.0]
    monkeypatch.setattr("tauext_commission.processes.time.monotonic", lambda: now[0])
    child = Child("page", die_at_once, ())
    assert child.tend() == ""
    child._process.join(PATIENCE_S)
    assert child.tend() == "the page ended (status 3); it starts again in 2 s" and child.pid is None
    assert child.tend() == "" and child.pid is None  # not before its time
    now[0] = 2.0
    child.tend()
    child._process.join(PATIENCE_S)
    assert "starts again in 4 s" in child.tend()
    child.end()


def interrupt_itself(pipe):
    os.kill(os.getpid(), signal.SIGINT)
    pipe.send(signal.SIGINT in signal.sigpending())


def test_a_child_does_not_receive_ctrl_c_from_its_first_instruction_on():
    """Not even while it imports: the first process that is spawned brings a tracker, which unblocks signals."""
    code = """if __name__ == "__main__":
        import test_commission_answers as tests
        from tauext_commission.processes import start_worker
        process, pipe = start_worker(tests.interrupt_itself)
        print(pipe.recv(), flush=True)"""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environment, timeout=60)
    assert done.stdout == "True\n", done.stderr


@pytest.mark.slow
def test_children_end_with_a_killed_parent():
    """Whatever they are doing: `kill -9` of the loop leaves no training behind."""
    code = """if __name__ == "__main__":
        import time, test_commission_answers as tests
        child = tests.Child("x", tests.sleep_for_ever, ())
        child.tend()
        print(child.pid, flush=True)
        time.sleep(1000)"""
    paths = {"PYTHONPATH": os.pathsep.join(sys.path)}
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=os.environ | paths)
    child = int(parent.stdout.readline())
    time.sleep(3.0)
    os.kill(parent.pid, signal.SIGKILL)
    parent.wait()

    def is_gone():
        try:
            return open(f"/proc/{child}/stat").read().split()[2] == "Z"
        except OSError:
            return True

    until(is_gone, "the child to end")
