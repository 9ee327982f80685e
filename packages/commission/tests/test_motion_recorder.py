"""The recorder of a commissioned arm: sets, labels of alarms, clocks, coverage, the bound, kills, full disks."""

from __future__ import annotations

import os
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tauext_commission import folder as folder_module
from tauext_commission import journal, motion_recorder
from tauext_commission.answers import AlarmJournal
from tauext_commission.folder import CommissionFolder, Segment, split_of
from tauext_commission.history_file import watches
from tauext_commission.motion_recorder import (
    Coverage,
    MotionRecorder,
    learned_up_to,
    repaired,
    set_of,
    to_drop,
    trim_flights,
)

from tauext.bundle.estimates import COLLISION
from tauext.data.dataset import load_dataset
from tauext.data.free_motion import free_pieces
from tauext.data.labels import Label
from tauext.errors import ConfigError
from tauext.monitor.changes import ChangeFinder
from tauext.monitor.episode import EpisodeFinder
from tauext.monitor.sink import Verdict
from tauext.monitor.source import Block, Sample, SourceSettings

PERIOD_NS = 20_000_000
ARM = SourceSettings(("shoulder", "elbow"), PERIOD_NS, ("N m", "N m"), "held")
ROWS = round(10e9 / PERIOD_NS)
ESTIMATES = {name: np.zeros(1, int) for name in ("causes", "cause_joint", "touch", "unfamiliar", "declared")}
ESTIMATES |= {"declared_size": np.zeros(1), "declared_contact": np.full(1, -1), "declared_nm": np.zeros((1, 2))}
ESTIMATES["drift_saturated"] = np.zeros((1, 2), bool)
ESTIMATES |= {"health": np.ones(1, int), "alarm_joint": np.zeros(1, int), "near_stiction": np.zeros((1, 2), bool)}
ESTIMATES |= {name: np.ones((1, 2)) for name in ("limit_nm", "contact_limit_nm", "sigma_nm", "margin_nm")}
OVER_NS = 500_000_000


@pytest.fixture(autouse=True)
def no_thread_left(monkeypatch):
    made: list[Script] = []
    monkeypatch.setattr(Script, "made", made, raising=False)
    yield
    for one in made:
        one.sink.worker.end()
        one.keeper.end()


class Script:
    """Sends verdicts of a swinging arm to the sinks."""

    made: list[Script]

    def __init__(self, folder: Path, budget: float = 1e9, start_ns: int = 0):
        self.folder = CommissionFolder.open(folder, create=True)
        self.sink = MotionRecorder(self.folder, ARM, "test", budget, lambda: "b0001")
        self.sink.worker.patient = True
        self.notes: list[str] = []
        self.keeper = AlarmJournal(self.folder, lambda: self.sink.epoch, self.notes.append)
        self.made.append(self)
        self.changes, self.episodes = ChangeFinder(), EpisodeFinder("b0001")
        for sink in (self.sink, self.keeper):
            sink.open(ARM.joints, None)
        self.row, self.t_ns, self.touch_t_ns = 0, start_ns, 0

    def stand(self, number: int) -> Script:
        """This alarm stands from before."""
        self.changes.stand(COLLISION, number)
        self.episodes.stand(number, COLLISION, 0)
        return self

    def go(self, seconds: float, alarm: int = 0, push: float = 0.0, still: bool = False) -> Script:
        for _ in range(round(seconds * 1e9 / PERIOD_NS)):
            time_s = 0.0 if still else 1e-9 * self.t_ns
            q = np.array([np.sin(time_s), 0.1 * np.sin(0.1 * time_s)])
            dq = np.array([np.cos(time_s), 0.01 * np.cos(0.1 * time_s)]) * (not still)
            sample = Sample(self.t_ns, q, dq, dq + q, 0)
            self.touch_t_ns = self.t_ns if push > 1 else self.touch_t_ns
            over = not 0 <= self.t_ns - self.touch_t_ns < OVER_NS
            numbers = {"alarm": COLLISION * bool(alarm), "alarm_number": alarm, "held_alarm": COLLISION * (push > 1)}
            numbers |= {"touch_t_ns": self.touch_t_ns, "touch_over": over}
            estimates = ESTIMATES | {name: np.array([value]) for name, value in numbers.items()}
            estimates |= {"tau_ext": np.full((1, 2), push), "load_nm": np.zeros((1, 2))}
            news = self.changes.find(self.row, np.array([self.t_ns]), estimates)
            block = Block.of([sample])
            told = self.episodes.find(self.row, block.t_ns, estimates, news, block.q)
            verdict = Verdict(self.row, block.t_ns, block, estimates, tuple(news), self.episodes.standing, told)
            for sink in (self.sink, self.keeper):
                sink.verdict(verdict)
            self.row, self.t_ns = self.row + 1, self.t_ns + PERIOD_NS
        return self

    def answer(self, what: str, alarm: int | None = None) -> int:
        return self.keeper.answer(what, "page", alarm)

    def end(self) -> CommissionFolder:
        self.sink.close()
        self.keeper.end()
        return self.folder


def test_motion_becomes_a_dataset_whose_sets_never_change(tmp_path):
    folder = Script(tmp_path / "cell").go(75).end()
    dataset = load_dataset(folder.path)
    assert [len(getattr(dataset.split, name)) for name in ("train", "test", "calibration")] == [7, 1, 0]
    before = dataset.split
    assert all(r.contact is not None and not r.contact.any() for r in dataset.training())
    assert dataset.training()[0].provenance["epoch"] == 1
    (long,) = folder.load([one for one in folder.segments() if one.number < 4])
    assert long.samples == 3 * ROWS and long.name == "seg-000001"
    again = Script(folder.path).go(20).end()
    split = load_dataset(again.path).split
    assert set(before.train) < set(split.train) and set(before.test) <= set(split.test)
    assert [one.epoch for one in again.segments()] == [1] * 8 + [2] * 2


def test_a_clock_that_starts_again_is_another_epoch(tmp_path):
    script = Script(tmp_path / "cell", start_ns=10**15).go(12)
    script.t_ns = 0
    folder = script.go(12).end()
    assert [(one.epoch, one.from_ns) for one in folder.segments()] == [
        (1, 10**15), (1, 10**15 + 10**10), (2, PERIOD_NS), (2, PERIOD_NS + 10**10)
    ]  # fmt: skip
    assert folder.facts["epoch"] == 2 and script.sink.count.unfit == 1


def test_each_footer_is_read_once_and_again_after_a_change(tmp_path, monkeypatch):
    folder, read = Script(tmp_path / "cell").go(30).end(), []
    real = folder_module.segment_of
    monkeypatch.setattr(folder_module, "segment_of", lambda path, size: read.append(path.name) or real(path, size))
    folder = CommissionFolder.open(folder.path)
    for _ in range(3):
        assert [(one.number, one.epoch, one.set) for one in folder.segments()] == [(k, 1, "train") for k in (1, 2, 3)]
    assert sorted(read) == [f"seg-00000{k}.parquet" for k in (1, 2, 3)]
    changed = folder.path / "seg-000002.parquet"
    changed.write_bytes(changed.read_bytes()[:-1])
    assert [one.number for one in folder.segments()] == [1, 3] and len(read) == 4
    assert [one.name for one in folder.load(folder.segments())] == ["seg-000001", "seg-000003"]


@pytest.mark.parametrize(("answer", "free_s"), [("touched", 27.2), ("nothing", 29.9), ("", 27.2)])
def test_motion_of_an_alarm_is_trained_on_only_if_nothing_was_there(tmp_path, answer, free_s):
    script = Script(tmp_path / "cell").go(15).go(0.5, 1, 5.0).go(1.5, 1, 0.0).go(3)
    if answer:
        script.answer(answer, 1)
    folder = script.go(10).end()
    (label,) = folder.labels()
    assert label.answer == (answer or "unanswered") and label.bundle == "b0001" and label.epoch == 1
    assert (label.from_ns, label.to_ns) == (15_000_000_000, 15_480_000_000)
    pieces = free_pieces(load_dataset(folder.path).training())
    assert abs(sum(1e-9 * (one.t_ns[-1] - one.t_ns[0]) for one in pieces) - free_s) < 1.2
    inside = np.concatenate([one.t_ns for one in pieces])
    assert ((inside > 14_800_000_000) & (inside < 16_480_000_000)).any() == (answer == "nothing")


def test_a_long_touch_is_labelled_while_it_lasts_and_answers_find_their_alarm(tmp_path):
    script = Script(tmp_path / "cell").go(5).go(20, 1, 5.0)
    script.keeper.end()
    assert script.folder.labels()[0].to_ns >= 20_000_000_000  # as if it had been killed here
    script = Script(tmp_path / "cell").go(5).go(1, 2, 5.0).go(2)
    assert script.answer("nothing") == 2  # no number: the newest without an answer
    script.go(1)
    assert script.answer("touched") == 0  # none is left
    with pytest.raises(ConfigError, match=r"nothing: the newest alarm \(2\) has an answer; give the number of another"):
        script.answer("nothing")
    labels = {one.id: one for one in script.go(2).end().labels()}
    assert {id: one.answer for id, one in labels.items()} == {1: "unanswered", 2: "nothing", -1: "touched"}
    assert labels[-1].to_ns - labels[-1].from_ns == 3_000_000_000 and labels[2].epoch == 2


def test_an_alarm_that_stands_since_another_clock_keeps_its_label(tmp_path):
    folder = Script(tmp_path / "cell").go(5).go(1, 1, 5.0).end()
    before = folder.labels()
    assert Script(folder.path).stand(1).go(2, 1, 5.0).end().labels() == before


@pytest.mark.parametrize("answer", ["touched", None])
def test_a_touch_that_goes_on_after_a_restart_is_neither_written_each_sample_nor_asked_about_again(answer, tmp_path):
    script = Script(tmp_path / "cell").go(5).go(1, 1, 5.0)
    if answer:
        script.answer(answer, 1)
    path = script.end().path  # as after kill -9: the touch has not ended
    before = len(journal.read(path).lines)
    script = Script(path, start_ns=10**12).stand(1).go(20, 1, 5.0)
    script.end()
    added = [one["kind"] for one in journal.read(path).lines[before:]]
    assert added.count("event") <= 1, added
    asked = [note for note in script.notes if note.startswith("alarm 1:")]
    assert not asked if answer else len(asked) <= 1
    assert script.keeper.event(1)["answer"] == answer


def test_stamps_that_go_back_and_forth_during_a_touch_write_no_line_each_sample(tmp_path):
    script = Script(tmp_path / "cell").go(5).go(1, 1, 5.0)
    before = len(journal.read(script.folder.path).lines)
    for _ in range(100):
        script.t_ns -= 30_000_000_000
        script.go(0.04, 1, 5.0)
        script.t_ns += 30_000_000_000
        script.go(0.04, 1, 5.0)
    events = [one for one in journal.read(script.end().path).lines[before:] if one["kind"] == "event"]
    assert len(events) < 20


def test_long_standstill_is_dropped_and_reported(tmp_path):
    folder = Script(tmp_path / "cell").go(200, still=True).end()
    content = folder.coverage()
    assert content["seconds"] == 200 and content["dropped_s"] == 80 and content["kept_s"] == 120
    assert "elbow" in [one["joint"] for one in content["joints"] if "never moved" in one["missing"][0]]


def test_what_is_missing_is_reported_in_words(tmp_path):
    content = Script(tmp_path / "cell").go(65).end().coverage()
    shoulder, elbow = content["joints"]
    assert elbow["missing"] == ["never moved; let it move through its working range"]
    assert shoulder["reversals"] == [11, 10] and "never moved faster" not in str(shoulder["missing"])
    assert shoulder["positions"] == 1.0
    assert any("hardly moved slowly" in words for words in shoulder["missing"])
    assert content["needs_s"] == 55.0 and content["bytes"] > 0


def week(budget: int, labels: tuple[Label, ...] = ()) -> tuple[list[Segment], int]:
    """What a week of recordings leaves within the budget, and the most that was ever there."""
    kept: list[Segment] = []
    most, train_s = 0, 0.0
    for number in range(1, 7 * 8640 + 1):
        of = set_of(number, True, train_s)
        train_s += 10.0 * (of == "train")
        start = number * 10_000_000_000
        kept.append(Segment(f"seg-{number:06d}.parquet", number, of, 1, start, start + 10**10 - 1, 10.0, 500_000))
        if number % 400 == 0:
            gone = {one.number for one in to_drop(kept, labels, budget, number - 100, 480)}
            kept = [one for one in kept if one.number not in gone]
            most = max(most, sum(one.bytes for one in kept))
    return kept, most


@pytest.mark.slow
def test_after_a_learned_change_known_motion_is_new_again(tmp_path):
    folder = Script(tmp_path / "cell").go(1500).end()
    known = folder.segments()
    assert known[0].set == "train" and {one.set for one in known[-5:]} == {"calibration", "test"}
    folder.save(learn_from=known[-1].number)
    for _ in range(2):  # the second run continues from the disk
        later = Script(tmp_path / "cell").go(45).end().segments()[len(known) :]
        assert {one.set for one in later} <= {"train", "test"} and later[0].set == "train"


def test_a_week_stays_within_its_bound():
    touch = Label(1, 1, 10_000 * 10**10, 10_000 * 10**10 + 10**9, "touched", "page", "")
    kept, most = week(1_000_000_000, (touch,))
    assert most <= 1_000_000_000 and len(kept) > 1800
    sets = {name: [one for one in kept if one.set == name] for name in ("train", "test", "calibration")}
    assert sum(one.seconds for one in sets["train"]) == 3840  # all of it
    assert {one.number for one in kept} >= set(range(9998, 10004)) | set(range(60420, 60480))
    assert sum(one.bytes for one in sets["test"]) <= 0.21e9 and len(sets["test"]) > 300
    assert len({name for names in vars(split_of(kept)).values() for name in names}) == len(kept)


@pytest.mark.slow
def test_labels_beyond_the_bound_do_not_break_it():
    labels = tuple(Label(k, 1, k * 10**11, k * 10**11, "touched", "page", "") for k in range(6048))
    assert week(500_000_000, labels)[1] <= 500_000_000


def test_dropping_is_safe_at_every_point(tmp_path, monkeypatch):
    """Killed between any two writings: the folder is a dataset, and no set has changed."""
    script = Script(tmp_path / "cell", budget=2e5)
    monkeypatch.setattr(motion_recorder, "FRESH_S", 20.0)
    real = {"unlink": Path.unlink, "write": motion_recorder.write_synced}

    class Killed(BaseException):
        pass

    for left in range(1, 40):
        steps = iter(range(left))

        def counted(name, steps=steps):
            def call(*args, **options):
                if next(steps, None) is None:
                    raise Killed
                return real[name](*args, **options)

            return call

        sink = script.sink
        sink.worker.end()
        before = {one.name: one.set for one in script.folder.segments()}
        monkeypatch.setattr(Path, "unlink", counted("unlink"))
        monkeypatch.setattr(folder_module, "write_synced", counted("write"))
        try:
            sink._begin()
            t_ns = np.arange(ROWS, dtype=np.int64) * PERIOD_NS
            signal = np.random.default_rng(left).normal(size=(ROWS, 2))
            sink._write({"t_ns": t_ns, "contact": t_ns.astype(np.int8), "q": signal, "dq": signal, "tau": signal})
        except Killed:
            pass
        finally:
            monkeypatch.setattr(Path, "unlink", real["unlink"])
            monkeypatch.setattr(folder_module, "write_synced", real["write"])
        script = Script(tmp_path / "cell", budget=2e5)
        after = {one.name: one.set for one in script.folder.segments()}
        assert all(before[name] == of for name, of in after.items() if name in before)
        split = load_dataset(script.folder.path).split
        names = {path.name for path in script.folder.path.glob("seg-*.parquet")}
        assert names == {*split.train, *split.test, *split.calibration} == set(after)
    script.end()
    assert 0 < sum(one.bytes for one in script.folder.segments()) <= 1.6e5


def test_damage_by_a_power_failure_is_set_aside(tmp_path):
    folder = Script(tmp_path / "cell").go(45).end()
    (folder.path / "seg-000005.parquet").write_bytes(b"")
    (folder.path / "seg-000004.parquet").write_bytes((folder.path / "seg-000004.parquet").read_bytes()[:-3])
    (folder.path / "split.json").write_text("")
    (folder.path / "coverage.npz").write_bytes(b"PK")
    assert [one.number for one in repaired(folder)] == [1, 2, 3]
    assert len(load_dataset(folder.path).split.train) == 3
    assert [one.number for one in Script(folder.path).go(10).end().segments()] == [1, 2, 3, 6]
    assert (folder.path / "seg-000005.parquet.damaged").exists()
    assert "seg-000004.parquet is kept as seg-000004.parquet.damaged" in folder.history()[0]["words"]


def test_a_touch_without_a_number_belongs_to_the_newest_alarm_or_to_the_last_seconds(tmp_path):
    script = Script(tmp_path / "cell").go(5).go(1, alarm=1, push=2.0).go(5).go(1, alarm=2, push=2.0).go(5)
    script.answer("touched", 2)
    script.go(20).answer("touched")  # not about alarm 1, however long ago it rose
    labels = {one.id: one for one in script.end().labels()}
    assert [labels[k].answer for k in (1, 2)] == ["unanswered", "touched"] and len(labels) == 3
    assert labels[min(labels)].answer == "touched" and labels[min(labels)].to_ns > labels[2].to_ns


def test_a_clock_that_is_set_back_costs_no_part_of_a_label(tmp_path):
    script = Script(tmp_path / "cell").go(5).go(3, alarm=1, push=2.0)
    before_ns, script.t_ns = script.t_ns, 0
    (label,) = script.go(2, alarm=1, push=2.0).end().labels()
    assert label.epoch == 1 and label.to_ns == before_ns - PERIOD_NS


def test_a_full_disk_while_recordings_are_dropped_leaves_none_uncounted(tmp_path, monkeypatch):
    monkeypatch.setattr(motion_recorder, "FRESH_S", 0.0)
    script = Script(tmp_path / "cell", budget=1e9).go(65)

    def full(*_):
        raise OSError(28, "No space left on device")

    script.sink.close()
    for _ in range(2):
        script.sink._budget = 1e5
        with monkeypatch.context() as patched:
            patched.setattr(CommissionFolder, "put_split", full)
            with pytest.raises(OSError, match="No space"):
                script.sink._tidy()
        counted = {one.name for one in script.sink._segments}
        assert counted == {path.name for path in script.folder.path.glob("seg-*.parquet")}
    script.sink._tidy()
    split = load_dataset(script.folder.path).split
    assert {*split.train, *split.test} == {path.name for path in script.folder.path.glob("seg-*.parquet")} < counted


def test_damaged_coverage_costs_the_cells_but_no_time(tmp_path):
    folder = Script(tmp_path / "cell").go(45).end()
    path, arm = folder.path / "coverage.npz", ARM
    whole, kept = path.read_bytes(), Coverage.load(path, arm)
    assert kept.seconds == pytest.approx(45) and kept.cells.any()
    for damaged in (whole[:100], whole[: len(whole) // 2], whole[:-10], b"", whole[:300] + bytes(200) + whole[500:]):
        path.write_bytes(damaged)
        found = Coverage.load(path, arm)
        assert (found.seconds, found.kept_s, found.dropped_s) == (kept.seconds, kept.kept_s, kept.dropped_s)


def test_a_disk_that_is_full_loses_recordings_but_no_answer(tmp_path, monkeypatch):
    script = Script(tmp_path / "cell")

    def full(*_) -> None:
        raise OSError(28, "full")

    with monkeypatch.context() as patched:
        patched.setattr("tauext.monitor.record_sink.save_recording", full)
        patched.setattr(CommissionFolder, "_append", full)
        script.go(11).go(1, 1, 5.0).go(1)
        with pytest.raises(ConfigError, match="touched: not stored: full; please answer again"):
            script.answer("touched", 1)
        script.go(10)
        script.sink.worker.end()
        assert script.sink.count.lost >= ROWS and script.sink.is_losing and not script.folder.labels()
        assert [note for note in script.notes if "not stored" in note] == ["an event is not stored: full"]
    while not script.folder.labels():  # the alarm's line is tried again by itself
        time.sleep(0.01)
    script.answer("touched", 1)
    script.keeper.end()
    (label,) = script.folder.labels()
    assert label.answer == "touched" and label.to_ns - label.from_ns == 980_000_000


def test_a_disk_that_is_full_at_the_start_loses_recordings_until_it_has_space_again(tmp_path, monkeypatch):
    Script(tmp_path / "cell").go(20).end()

    def full(*_) -> None:
        raise OSError(28, "full")

    with monkeypatch.context() as patched:
        patched.setattr("tauext.files.preflight.shutil.disk_usage", lambda path: SimpleNamespace(free=0))
        patched.setattr("tauext.monitor.record_sink.save_recording", full)
        patched.setattr(Coverage, "save", full)
        script = Script(tmp_path / "cell").go(15)
        while not script.sink.count.lost:
            time.sleep(0.001)
        assert script.sink.is_losing
    folder = script.go(15).end()
    assert not script.sink.is_losing and [(one.number, one.epoch) for one in folder.segments()] == [
        (1, 1), (2, 1), (3, 2), (4, 2)
    ]  # fmt: skip


def test_flights_are_bounded_the_oldest_go_first(tmp_path):
    for k in range(5):
        for end in (".parquet", ".txt"):
            path = tmp_path / f"arm-1.{k}s-collision{end}"
            path.write_bytes(bytes(500))
            os.utime(path, (1000 + k, 1000 + k))
    trim_flights(tmp_path, 2500)
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        f"arm-1.{k}s-collision{end}" for k in (3, 4) for end in (".parquet", ".txt")
    ]


def flight(folder: Path, name: str, age: int, files: tuple[str, ...] = (".parquet", ".txt")) -> None:
    for end in files:
        path = folder / f"{name}{end}"
        path.write_bytes(bytes(1000 // len(files)))
        os.utime(path, (2000 - age, 2000 - age))


def test_flights_of_faults_do_not_crowd_out_collisions(tmp_path):
    kinds = ("collision", "contact", "contact-2", "fault", "collision", "fault-2", "fault-13", "contact")
    for k, kind in enumerate(kinds):
        flight(tmp_path, f"arm-{k}.0s-{kind}", 100 - k)
    flight(tmp_path, "arm-8.0s-fault", 0)  # the newest of all stays, whatever its kind

    def kept(most: int) -> str:
        trim_flights(tmp_path, most)
        return "".join(sorted({path.name[4] for path in tmp_path.iterdir()}))

    assert [kept(most) for most in (9000, 8000, 6000, 4500, 3000, 2000, 1)] == [
        "012345678", "01245678", "012478", "0478", "048", "48", "8"
    ]  # fmt: skip


def test_what_was_learned_is_dropped_first():
    made = [Segment(f"s{k}", k, "calibration", 1, k, k, 100.0, 10) for k in range(10)]
    made[2] = replace(made[2], set="train")
    assert [one.number for one in to_drop(made, (), 60, 1, 0)][:2] == [0, 1]
    assert [one.number for one in to_drop(made, (), 60, 0, 0)] == [0, 1, 3, 2]
    assert learned_up_to(CommissionFolder(Path("/nowhere"))) == 0


def test_a_lost_coverage_is_made_again_from_the_recordings(tmp_path):
    folder = Script(tmp_path / "cell").go(45).end()
    before = Coverage.load(folder.path / "coverage.npz", ARM)
    for name in ("coverage.npz", "coverage.json"):
        (folder.path / name).unlink()
    Script(folder.path, start_ns=45_000_000_000).end()
    after = Coverage.load(folder.path / "coverage.npz", ARM)
    assert after.seconds == pytest.approx(45)
    np.testing.assert_array_equal(after.cells, before.cells)
    np.testing.assert_allclose(after.rest_s, before.rest_s)


def test_a_bundle_is_in_charge_from_its_exchange_on():
    lines = [{"kind": "activation", "bundle": name, "seconds": at} for name, at in (("b1", 100), ("b2", 200))]
    assert [(one.bundle, one.to_s - one.from_s) for one in watches(lines, 300.0)] == [("b1", 100), ("b2", 100)]
    lines.append({"kind": "exchange", "bundle": "b1", "seconds": 110})  # the other one was refused
    assert [(one.bundle, one.to_s - one.from_s) for one in watches(lines, 300.0)] == [("b1", 190)]
