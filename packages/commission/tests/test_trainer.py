"""The training process of a commissioned arm, on recordings of the rig."""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import re
import shutil
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_commission import active, add_event, cut_journal, filled, question, words
from tauext_commission import arm_change, motion_recorder, promises, schedule, trainer
from tauext_commission.arm_change import named_steps
from tauext_commission.connect import HELD, Remark, as_entries
from tauext_commission.folder import CommissionFolder
from tauext_commission.history import describe_folder, kept_of
from tauext_commission.history_file import active_bundle, read_findings, read_history, read_labels
from tauext_commission.promises import CalibrationPeaks, Promises
from tauext_commission.trainer import Trainer, why_not, why_worse
from tauext_lab.sim.collect import simulate_recording
from tauext_lab.sim.config import RigConfig, changed_friction

from tauext import _core
from tauext._core import CoreError
from tauext.bundle.bundle_file import load_bundle
from tauext.cli import main
from tauext.config import PAPER_CASES, AlarmConfig
from tauext.data.dataset import load_dataset
from tauext.data.free_motion import cut
from tauext.data.labels import Label
from tauext.errors import ConfigError, FaultyDataError
from tauext.train.preparation import TrainingInput


@pytest.fixture(scope="module", autouse=True)
def few_events():
    """Fewer added forces than in use: most of the time would go there."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tauext_lab.evaluate.comparison.EVENTS", 100)
        yield


@pytest.fixture(scope="module")
def motion():
    """Four minutes; in the first, a touch that nobody reports."""
    made = simulate_recording(RigConfig(), "free", 240.0, 3, 0)
    push = np.zeros(made.samples)
    push[24_200:24_700] = 25.0 * np.sin(np.linspace(0, np.pi, 500))
    tau = made.tau - np.column_stack([push, 0.6 * push])
    return replace(made, tau=tau, tau_ext=None, contact=None, contact_link=None, q_des=None, tau_ext_sensor=None)


@pytest.fixture(scope="module")
def learned(motion, tmp_path_factory) -> CommissionFolder:
    """After the first bundle."""
    folder = filled(tmp_path_factory.mktemp("arm") / "cell", [cut(motion, slice(0, 60_000))])
    one = Trainer(folder)
    assert [one.step() for _ in range(2)] == ["train", "nothing"]
    filled(folder.path, [cut(motion, slice(60_000, 121_000))])
    assert Trainer(folder).step() == "judge"
    return folder


@pytest.fixture
def copy(learned, tmp_path) -> CommissionFolder:
    shutil.copytree(learned.path, tmp_path / "cell")
    return CommissionFolder.open(tmp_path / "cell")


def test_the_first_bundle_monitors_after_two_minutes_without_the_touch(learned):
    touches = [one for one in read_labels(learned.path) if one.epoch == 1]
    (touch,) = [one for one in touches if one.from_ns < 24.3e9 and one.to_ns > 24.6e9]
    # A minute's fit also doubts a moment or two of free motion; these are left out, which costs half a second each.
    assert touch.answer == "suspect" and len(touches) <= 3
    assert active(learned) == "b0001" and active_bundle(learned.path).stem == "b0001"
    bundle = load_bundle(learned.active())
    factor = json.loads(bundle.provenance)["limits"]["extrapolated"]["factor"]
    assert factor > 1 and max(bundle.sliding_limit_nm) < 2.0 * factor  # with the touch 3.6 Nm
    training = [one for one in read_history(learned.path) if one["kind"] == "training"][0]
    assert training["passed"] and training["minutes"] == 1 and 0.2 < training["hits"] <= 1
    assert len(training["error"]) == 2 and training["test_minutes"] >= 0.9
    shown = describe_folder(learned.path)
    assert shown["bundle"] == "b0001" and shown["trainings"] == 1 and shown["budget"] == "1 in 8 h"
    assert "Set for one false alarm in 8 h, extrapolated from 4" in shown["limits"]
    assert "The data alone prove 1 in 1" in shown["limits"]  # seconds
    assert training["promised_per_hour"] == 0.125 < training["between_per_hour"][1] < training["proved_per_hour"]
    trained_on = json.loads(bundle.provenance)["recordings"]["train"]
    assert not set(load_dataset(learned.path).split.test) & {f"{name}.parquet" for name in trained_on}


def test_a_killed_training_process_goes_on(copy):
    """Whatever was written last: what nothing names is removed, an activation has its line, progress is none."""
    copy.bundles.joinpath("b0007.tauext").write_bytes(b"half")
    copy.progress_file.write_text('{"doing": "training b0007"}')
    one = Trainer(copy)
    assert not list(copy.bundles.glob("b0007*")) and copy.next_bundle().stem == "b0002"
    assert [line["kind"] for line in copy.history()].count("activation") == 1
    assert json.loads(copy.progress_file.read_text())["doing"] == ""
    assert one.facts().has_bundle and one.facts().trained_min == 1


@pytest.mark.slow
def test_kill_9_during_a_training_costs_that_training_alone(copy):
    spawn = multiprocessing.get_context("spawn")
    mine, its = spawn.Pipe()
    process = spawn.Process(target=trainer.run_trainer, args=(its, copy.path), daemon=True)
    process.start()
    end = time.monotonic() + 120
    while "training b0002" not in copy.progress_file.read_text():
        assert time.monotonic() < end and process.is_alive()
        time.sleep(0.01)
    with pytest.raises(ConfigError, match="another"), copy.locked("trainer.lock"):
        pass
    process.kill()
    process.join()
    mine.close()
    with copy.locked("trainer.lock"):
        one = Trainer(copy)
    assert active(copy) == "b0001" and [path.name for path in copy.bundles.glob("*.tauext")] == ["b0001.tauext"]
    assert one.step() == "train" and one.facts().trained_min == 2


@pytest.mark.slow
def test_motion_without_the_next_minutes_waits_and_faults_are_reported(copy, motion, monkeypatch):
    monkeypatch.setattr(arm_change.DayComparison, "strokes", lambda *_: [])
    assert Trainer(copy).step() == "train"  # two minutes are there
    pending = json.loads(copy.pending_file.read_text())
    assert pending["minutes"] == 2 and len(pending["trained_on"]) == 11
    copy.pending_file.unlink()
    (copy.path / "robot.xml").write_text("<mujoco/>")
    Trainer(copy).step()
    assert "failed" in words(copy)[-1] and Trainer(copy).step() == "nothing"


@pytest.mark.slow
def test_a_bundle_that_rejects_or_alarms_does_not_monitor(copy, monkeypatch):
    cut_journal(copy, lambda line: line["kind"] != "activation")
    monkeypatch.setattr(CommissionFolder, "lost", lambda self: 0)
    content = {"bundle": "b0001", "minutes": 1, "trained_on": []}
    path = copy.pending_file
    for change, why in (
        ({"sliding_limit_nm": [0.01, 0.01], "near_stiction_limit_nm": [0.01, 0.01]}, "it reports collisions during"),
        ({"possible_speed_rad_s": [0.5, 0.5]}, "it rejects"),
        (
            {"sliding_limit_nm": [90.0, 90.0], "near_stiction_limit_nm": [90.0, 90.0]},
            "fault: joint1: the threshold of a",
        ),
        ({"sliding_limit_nm": [0.2, 0.2], "near_stiction_limit_nm": [0.2, 0.2]}, "false alarms in"),
    ):
        path.write_text(json.dumps(content))
        bundle = load_bundle(copy.bundles / "b0001.tauext")
        if why == "false alarms in":
            monkeypatch.setattr(trainer, "MOST_ALARMED", 1.0)
            facts = json.loads(bundle.provenance)
            facts["limits"]["extrapolated"]["between_per_hour"] = [0.01, 0.1]
            bundle.provenance = json.dumps(facts)
        for name, value in change.items():
            setattr(bundle, name, value)
        monkeypatch.setattr(trainer, "load_bundle", lambda path, bundle=bundle: bundle)
        monkeypatch.setattr(trainer, "search", lambda *_: [])
        Trainer(copy).step()
        assert why in words(copy)[-1], words(copy)[-1]
        assert copy.active() is None and not path.exists()


@pytest.fixture
def quick(monkeypatch):
    """Limits from minutes of calibration."""
    monkeypatch.setattr(promises, "SPARE_S", 0.0)
    monkeypatch.setattr(arm_change.DayComparison, "strokes", lambda *_: [])
    monkeypatch.setattr(schedule, "LEARN_S", 30.0)
    monkeypatch.setattr(schedule, "LIMITS_AT_H", (0.01, 0.02))
    monkeypatch.setattr(schedule, "SCHEDULE_MIN", (1,))
    monkeypatch.setattr(motion_recorder, "TRAIN_S", 90.0)


@pytest.mark.slow
def test_limits_follow_from_calibration_and_grow_with_it(copy, motion, quick):
    filled(copy.path, [cut(motion, slice(121_000, 200_000))])
    one = Trainer(copy)
    assert [one.step() for _ in range(3)] == ["learn", "limits", "nothing"]
    hours = one.promises.calibration().hours
    assert active(copy) == "b0002" and 50 / 3600 < hours < 70 / 3600
    promise = copy.history()[-1]
    assert promise["kind"] == "promise" and promise["promised_per_hour"] == 0.125
    assert abs(promise["proved_per_hour"] - 3.0 / hours) < 0.1 / hours
    old, new = (load_bundle(copy.bundles / f"{name}.tauext") for name in ("b0001", "b0002"))
    assert list(old.prior.weights) == list(new.prior.weights)

    # Dropped calibration stays in the peaks, and a killed process loses nothing.
    for segment in copy.segments():
        if segment.set == "calibration":
            (copy.path / segment.name).unlink()
    assert motion_recorder.learned_up_to(copy) == one.promises.calibration().learned > 0
    again = Trainer(copy)
    assert again.promises.calibration().hours == hours and again.promises.calibration().base == "b0001"


def test_limits_from_calibration_contain_no_reserve_of_the_first_minutes(copy, motion, quick):
    """Floors and friction that the first bundle's limits reserve, five times as much here, stay in no later limit."""
    filled(copy.path, [cut(motion, slice(121_000, 200_000))])
    path, limits = copy.bundles / "b0001.tauext", []
    reserved = path.read_bytes()
    for times in (1.0, 5.0):
        bundle = _core.Bundle.from_bytes(reserved)
        assert bundle.near_memory_s > 0
        scale = bundle.error_scale
        scale.limit_weights, scale.largest = (list(times * np.array(x)) for x in (scale.limit_weights, scale.largest))
        bundle.error_scale, bundle.near_memory_s = scale, times * bundle.near_memory_s
        path.write_bytes(bundle.to_bytes())
        calibration = CalibrationPeaks(copy, "b0001")
        calibration.learn([part for part in copy.segments() if part.set == "calibration"], copy.segments())
        renewed = Promises(copy, lambda *_: ({}, ""))
        renewed._calibration = calibration
        renewed.renew()
        new = load_bundle(copy.path / active_bundle(copy.path))
        limits.append([new.sliding_limit_nm, new.near_stiction_limit_nm, new.error_scale.limit_weights])
        assert new.near_memory_s == 0
    for one, other in zip(*limits, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)


def test_calibration_motion_is_judged_with_the_drift_that_the_loop_has_by_then(copy, quick):
    """Peaks are errors of a monitor that ran through all motion before; friction is off by a third."""
    day = another_day(1.35)
    filled(copy.path, [day])
    one = Trainer(copy)
    while one.step() != "learn":
        pass
    peaks = one.promises.calibration().peaks[0]
    bundle = one.promises.calibration().model()
    bundle.drift.freeze_share = 0.0
    run = _core.Monitor(bundle).run(day.t_ns, day.q, day.dq, day.tau)
    error = np.maximum(np.abs(run["tau_ext"]) - run["doubt"], 0) / run["limit_scale"]
    late = [part for part in copy.segments() if part.set == "calibration" and part.epoch == copy.facts["epoch"]]
    assert len(late) > 2
    at = np.any([(day.t_ns >= part.from_ns) & (day.t_ns <= part.to_ns) for part in late], axis=0)
    largest = np.nanmax(error[at], axis=0)
    np.testing.assert_allclose([max(float(of[0]) for of in joint) for joint in peaks.nm], largest, rtol=1e-9)
    first = slice(late[4].from_ns // 1_000_000, late[5].from_ns // 1_000_000)  # alone, its friction is an error again
    alone = _core.Monitor(bundle).run(*(values[first] for values in (day.t_ns, day.q, day.dq, day.tau)))
    rms = [np.sqrt(np.nanmean(one**2)) for one in (alone["tau_ext"], run["tau_ext"][first])]
    assert rms[0] > 1.5 * rms[1]


def test_answers_change_the_peaks(copy, motion, quick):
    pushed = motion.tau.copy()
    pushed[140_000:140_300] += 12.0
    filled(copy.path, [replace(cut(motion, slice(121_000, 200_000)), tau=pushed[121_000:200_000])])
    epoch = copy.facts["epoch"]
    alarm = Label(1, epoch, 140_000_000_000, 140_300_000_000, "unanswered", "nobody", "", "b0001")
    copy.append_label(alarm)
    one = Trainer(copy)
    one.step()

    def largest() -> float:
        return max(float(of[0]) for joint in one.promises.calibration().peaks[0].nm for of in joint if len(of))

    free = largest()
    copy.append_label(replace(alarm, answer="nothing", by="page"))
    assert one.promises.calibration().news(copy.labels())
    one.promises.calibration().learn([], copy.segments())
    assert largest() > 3 * free
    assert one.promises.calibration().news(copy.labels())  # in the peaks, but in no limit yet
    one.promises.calibration().renewed()
    assert not one.promises.calibration().news(copy.labels())
    copy.append_label(replace(alarm, answer="touched", by="page"))
    one.promises.calibration().learn([], copy.segments())
    assert largest() == free
    assert CalibrationPeaks.load(copy, "b0001").peaks[0].hours == one.promises.calibration().hours


def test_motion_before_calibration_motion_that_was_dropped_meanwhile_is_not_learned(copy, motion, quick):
    filled(copy.path, [cut(motion, slice(121_000, 200_000))])
    segments, one = copy.segments(), Trainer(copy)
    fresh = [part for part in segments if part.set == "calibration" and part.epoch == copy.facts["epoch"]]
    for part in fresh:
        (copy.path / part.name).unlink()
    one.promises.calibration().learn(fresh, segments)
    assert one.promises.calibration().hours == 0.0


@pytest.mark.slow
def test_a_broken_promise_is_reported_and_repaired(copy, motion, quick, monkeypatch):
    filled(copy.path, [cut(motion, slice(121_000, 200_000))])
    one = Trainer(copy)
    [one.step() for _ in range(3)]
    epoch = copy.facts["epoch"]
    for k in range(1, 22):
        over = [0.5, 1.0 + 0.1 * k] if k % 2 else [1.3, 0.0]
        add_event(copy, id=k, level="collision", bundle="b0002", over=over)
        answer = "nothing" if k < 21 else "unanswered"
        copy.append_label(Label(k, epoch, k * 10**9, k * 10**9, answer, "page", "", "b0002"))
    monkeypatch.setattr(CommissionFolder, "seconds", lambda self: 230.0)
    found = kept_of(copy.path, "b0002", 230.0)
    assert (found.false, found.unanswered, found.kept) == (20, 1, False) and "BROKEN" in found.words()
    assert not one.facts().is_broken  # a single alarm right after an exchange breaks nothing
    monkeypatch.setattr(promises, "WATCHED_S", 0.0)
    assert one.facts().is_broken
    one.promises.learn()  # a pass over new motion in between
    assert one.facts().is_broken
    with monkeypatch.context() as killed:
        killed.setattr(one.promises, "_judged", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            one.step()
    one = Trainer(copy)
    assert one.facts().is_broken and one.step() == "limits" and active(copy) == "b0003"
    assert not one.facts().is_broken
    one.promises.compare()
    assert copy.history()[-1]["kind"] == "promise" and "b0003: Set for one false alarm in 8 h" in words(copy)[-1]

    # The alarms do not appear in a replay of their motion. All but those that the rate allows would have been silent.
    old, new = (load_bundle(copy.bundles / f"{name}.tauext") for name in ("b0002", "b0003"))
    allowed = int(found.promise.per_hour * found.hours)
    assert 0 <= allowed < 5
    largest_left = 1.0 + 0.1 * (19 - 2 * allowed)
    for name in ("sliding_limit_nm", "near_stiction_limit_nm"):
        raised = np.divide(getattr(new, name), getattr(old, name))
        np.testing.assert_allclose(raised, [1.3, largest_left], rtol=1e-3)
    facts = json.loads(new.provenance)["limits"]
    assert len(facts["raised"]) == 2
    assert "Thresholds are raised for false alarms" in facts["sentence"]

    # Later limits keep it, whether or not the promise was broken meanwhile.
    one.promises.renew()
    later = load_bundle(copy.bundles / "b0004.tauext")
    np.testing.assert_allclose(later.sliding_limit_nm, new.sliding_limit_nm, rtol=1e-3)

    # Calibration that contains the errors by now needs no factor on top of its own limits.
    higher = [1.2 * limit for limit in new.sliding_limit_nm]
    later.sliding_limit_nm, later.near_stiction_limit_nm = higher, [1.2 * limit for limit in new.near_stiction_limit_nm]
    assert promises.raise_limits(later, new, replace(found, false_alarms=[]), found.promise.per_hour) == {}
    np.testing.assert_allclose(later.sliding_limit_nm, higher)


def test_a_chosen_budget_changes_the_limits_of_the_bundle_in_charge_at_once(copy, monkeypatch):
    monkeypatch.setattr(arm_change.DayComparison, "strokes", lambda *_: [])
    old = load_bundle(copy.active())
    share = json.loads(old.provenance)["limits"]["budgets"][1]["share_of_limits"]
    assert 0.3 < share < 1
    copy.choose(AlarmConfig(in_hours=1.0), "page")
    one = Trainer(copy)
    assert one.step() == "budget" and active(copy) == "b0002" and not one.facts().is_chosen
    new = load_bundle(copy.active())
    for name in ("sliding_limit_nm", "near_stiction_limit_nm"):
        np.testing.assert_allclose(getattr(new, name), share * np.array(getattr(old, name)))
    assert all(np.array(new.contact_sliding_limit_nm) <= new.sliding_limit_nm)
    assert list(new.prior.weights) == list(old.prior.weights) and promises.base_of(copy, "b0002") == "b0001"
    assert words(copy)[-2].startswith(f"b0002 is chosen: thresholds for 1 in 1 h, {share:.0%} of those for 1 in 8 h")
    assert words(copy)[-1].startswith("Set for one false alarm in 1 h, extrapolated from 4")
    assert describe_folder(copy.path)["budget"] == "1 in 1 h"
    copy.choose(AlarmConfig(in_hours=8.0), "page")
    assert one.step() == "budget" and active(copy) == "b0003"
    np.testing.assert_allclose(load_bundle(copy.active()).sliding_limit_nm, old.sliding_limit_nm)
    copy.choose(AlarmConfig(in_hours=100.0), "command")  # beyond the table: for later trainings
    assert not one.facts().is_chosen and one._config(1).alarm.in_hours == 100.0


@pytest.mark.slow
def test_later_trainings_have_the_chosen_budget(copy, motion, monkeypatch):
    monkeypatch.setattr(arm_change.DayComparison, "strokes", lambda *_: [])
    copy.choose(AlarmConfig(in_hours=1.0), "page")
    one = Trainer(copy)
    assert [one.step() for _ in range(2)] == ["budget", "train"]
    filled(copy.path, [cut(motion, slice(121_000, 200_000))])
    assert one.step() == "judge"
    training = [line for line in copy.history() if line["kind"] == "training"][-1]
    assert training["promised_per_hour"] == 1.0 and "in 1 h, extrapolated from 1" in training["words"]
    limits = json.loads(load_bundle(copy.bundles / f"{training['bundle']}.tauext").provenance)["limits"]
    assert [round(one["per_hour"], 3) for one in limits["budgets"]] == [0.125, 1.0, 6.0]


def another_day(factor: float = 1.0, ball_kg: float = 0.0):
    """Another friction, and a ball at the end of the second link."""
    friction, (first, last) = changed_friction(RigConfig().friction, factor), RigConfig().links
    mass = last.mass_kg + ball_kg
    com = (last.mass_kg * last.com_m + ball_kg * last.length_m) / mass
    apart = last.mass_kg * (com - last.com_m) ** 2 + ball_kg * (last.length_m - com) ** 2
    heavy = replace(last, mass_kg=mass, com_m=com, inertia_kg_m2=last.inertia_kg_m2 + apart)
    made = simulate_recording(replace(RigConfig(), friction=friction, links=(first, heavy)), "free", 130.0, 4, 1)
    return replace(made, tau_ext=None, contact=None, contact_link=None, q_des=None, tau_ext_sensor=None)


@pytest.mark.slow
def test_a_cold_morning_is_refitted_without_a_question(copy, motion, monkeypatch):
    monkeypatch.setattr(schedule, "SCHEDULE_MIN", (1,))
    Trainer(copy).step()  # the second epoch of the fixture
    day, earlier = another_day(1.35), copy.segments()[-1].number
    filled(copy.path, [cut(day, slice(0, 62_000))])
    one = Trainer(copy)
    assert one.step() == "morning" and promises.base_of(copy, "b0002") == "b0001"
    assert one.step() == "nothing"  # it is judged on the motion after the first strokes
    strokes = json.loads(copy.pending_file.read_text())["after"]
    assert strokes > earlier and one.facts().unseen_s < 20
    filled(copy.path, [cut(day, slice(62_000, 130_000))])
    seen = []
    judge = one._judged
    one._judged = lambda name, unseen: seen.extend(unseen) or judge(name, unseen)
    assert one.step() == "judge" and min(part.number for part in seen) > strokes
    (morning,) = [line for line in copy.history() if line["kind"] == "morning" and line["segment"] > earlier]
    assert all(1.15 < factor < 1.5 for factor in morning["friction"].values())
    assert not question(copy) and "refit" in [line["kind"] for line in copy.history()]

    # The next morning is compared with training, however often the friction was refitted.
    first = [one.days._factor("b0002", joint) for joint in ("joint1", "joint2")]
    assert first == pytest.approx(list(morning["friction"].values()), rel=1e-3)
    copy.activate("b0002", "the test's", copy.seconds())
    filled(copy.path, [another_day(0.9)])
    assert one.step() == "morning"
    again = copy.history()[-1]["friction"]
    assert all(0.75 < factor < 1.05 for factor in again.values()), again
    third = [one.days._factor("b0003", joint) for joint in ("joint1", "joint2")]
    assert third == pytest.approx(list(again.values()), rel=1e-3)


@pytest.mark.parametrize("facts", [{}, {"per_hour": None, "before": 2.0}, {"per_hour": 0.0, "before": None}])
def test_a_refit_without_numbers_is_not_used_and_stops_nothing(copy, facts):
    copy.pending_file.write_text('{"bundle": "b0002", "minutes": 0, "refit": true}')
    Trainer(copy).days.judge_refit("b0002", facts, "" if facts.get("before") is None else "it accepts no motion")
    assert "b0002, refitted to the first strokes of the day, is not used" in words(copy)[-1]
    assert active(copy) == "b0001" and not copy.pending_file.exists()


def test_a_bundle_that_was_judged_before_a_kill_is_not_judged_again(copy):
    copy.pending_file.write_text('{"bundle": "b0001", "minutes": 1, "trained_on": []}')
    assert Trainer(copy).facts().unseen_s is None and not copy.pending_file.exists()


@pytest.mark.slow
def test_first_strokes_with_a_long_touch_ask_nothing(copy, monkeypatch):
    monkeypatch.setattr(schedule, "SCHEDULE_MIN", (1,))
    Trainer(copy).step()
    filled(copy.path, [cut(another_day(), slice(0, 62_000))])
    copy.append_label(Label(1, copy.facts["epoch"], 0, 58_000_000_000, "touched", "page", "", "b0001"))
    assert Trainer(copy).step() == "morning" and not question(copy)
    assert words(copy)[-1].startswith("the first strokes are not compared with earlier days: a refit needs 10 s")


@pytest.mark.slow
@pytest.mark.parametrize("answer", ["learn", "leave"])
def test_a_step_between_days_is_named_and_waits_for_an_answer(copy, motion, monkeypatch, answer):
    monkeypatch.setattr(schedule, "SCHEDULE_MIN", (1,))
    Trainer(copy).step()
    filled(copy.path, [another_day(ball_kg=1.5)])
    epoch = copy.facts["epoch"]  # the alarm stands for the whole time, and its motion is left out of a refit
    copy.append_label(Label(1, epoch, 0, 130_000_000_000, "unanswered", "nobody", "", "b0001"))
    copy.append_label(Label(2, epoch, 70_000_000_000, 72_000_000_000, "touched", "page", "", "b0001"))
    one = Trainer(copy)
    assert [one.step() for _ in range(2)] == ["morning", "nothing"] and one.facts().is_asking
    asked = question(copy)
    named = re.match(r"the hand carries ([0-9.]+) kg more than in training", asked["words"])
    assert named and abs(float(named[1]) - 1.5) < 0.2 * 1.5 and asked["words"].endswith("another tool or payload?")
    copy.append_reply(answer, "page")
    assert one.step() == "answer" and not question(copy)
    assert one.facts().trained_min == (0 if answer == "learn" else 1) and active(copy) == "b0001"
    if answer == "learn":
        assert one.step() == "train" and json.loads(copy.pending_file.read_text())["bundle"] == "b0002"
        names = json.loads(copy.pending_file.read_text())["trained_on"]
        assert min(names) >= f"seg-{asked['segment']:06d}.parquet"
        assert [label.answer for label in copy.labels() if label.id > 0] == ["touched"]  # the arm raised it itself
        filled(copy.path, [another_day(ball_kg=1.5)])
        assert one.step() == "judge" and active(copy) == "b0002"  # it is not compared with one of another arm
    else:
        assert [label.answer for label in copy.labels() if label.id > 0] == ["unanswered", "touched"]


@pytest.mark.slow
def test_an_arm_that_changes_at_work_is_compared_once_alarms_do_not_end(copy, motion, monkeypatch):
    """No pause precedes the other tool. Early bundles, touches, and a change that is not learned ask nothing."""
    monkeypatch.setattr(schedule, "SCHEDULE_MIN", (1,))
    monkeypatch.setattr(schedule, "CHECKS_S", ())
    bare, heavy = cut(motion, slice(130_000, 200_000)), another_day(ball_kg=1.5)
    heavy = replace(heavy, t_ns=heavy.t_ns + bare.t_ns[-1] + 1_000_000)
    joined = {
        name: np.concatenate([getattr(one, name) for one in (bare, heavy)]) for name in ("t_ns", "q", "dq", "tau")
    }
    filled(copy.path, [replace(bare, tau_jts=None, **joined)])
    monkeypatch.setattr(arm_change, "CHANGED_FOR_S", 100.0)
    epoch, begin, end = copy.facts["epoch"], int(heavy.t_ns[0]), int(heavy.t_ns[-1])
    one = Trainer(copy)
    assert one.step() == "morning"  # after the start
    while one.step() != "nothing":
        pass
    alarm = Label(1, epoch, begin, end, "unanswered", "nobody", "", "b0001")
    copy.append_label(alarm)
    assert one.step() == "nothing"  # the arm is new
    monkeypatch.setattr(arm_change, "CHANGED_AFTER_S", 100.0)
    copy.append_label(replace(alarm, answer="touched"))
    assert one.step() == "nothing"
    copy.append_label(replace(alarm, to_ns=begin + 60_000_000_000))
    assert one.step() == "nothing"
    copy.append_label(alarm)
    assert [one.step() for _ in range(2)] == ["morning", "nothing"] and one.facts().is_asking
    asked = question(copy)
    assert re.match(r"the hand carries 1\.[2-8]\d* kg more than in training", asked["words"])
    copy.append_reply("leave", "page")
    assert [one.step() for _ in range(2)] == ["answer", "nothing"]


def test_a_training_that_finds_no_space_is_tried_again(copy, monkeypatch):
    (copy.bundles / "b0001.tauext").unlink()
    cut_journal(copy, lambda line: line["kind"] == "facts")
    one, failures = Trainer(copy), [os.strerror(errno.ENOSPC), "the motion teaches nothing"]

    def failing(*_: object) -> None:
        raise CoreError(f"cannot write b0001.tauext: {failures[0]}")

    monkeypatch.setattr(trainer, "train_on_recordings", failing)
    for _ in range(2):
        with pytest.raises(CoreError):
            one._train(1)
    assert not words(copy)
    failures.pop(0)
    one._train(1)
    assert "the motion teaches nothing" in words(copy)[-1]


@pytest.mark.slow
def test_a_load_that_friction_could_explain_is_named_all_the_same(copy, monkeypatch):
    monkeypatch.setattr(schedule, "SCHEDULE_MIN", (1,))
    Trainer(copy).step()
    filled(copy.path, [another_day(ball_kg=0.3)])
    assert Trainer(copy).step() == "morning"
    named = re.match(r"the hand carries ([0-9.]+) kg more", question(copy)["words"])
    assert named and abs(float(named[1]) - 0.3) < 0.1


@pytest.mark.slow
def test_another_friction_alone_names_no_load(copy, motion, monkeypatch):
    monkeypatch.setattr(schedule, "SCHEDULE_MIN", (1,))
    Trainer(copy).step()
    filled(copy.path, [another_day(2.2)])
    assert Trainer(copy).step() == "morning"
    asked = question(copy)["words"]
    assert asked.startswith("friction of joint1 is 2.") and asked.endswith("a replaced gear, wear or damage?")


def judged(false: int, seen: int, promised: float = 3.0, kept: bool = True, rejected: float = 0.0):
    """Results of an hour with so many false alarms, and so many of 100 hits detected."""
    rates = {"promised_per_hour": promised, "at_most_per_hour": 1.5 * promised}
    return SimpleNamespace(
        name="old",
        free_motion=SimpleNamespace(hours=1.0, false_collisions=false, promise_kept=kept, **rates),
        rejected=SimpleNamespace(share=rejected, causes={"clock": rejected}),
        forces=SimpleNamespace(added=SimpleNamespace(curves=[SimpleNamespace(events=100, latched=seen)])),
    )


@pytest.mark.slow
def test_a_recording_with_a_fault_of_its_own_is_left_out_of_training(tmp_path, motion):
    bad = cut(motion, slice(80_000, 90_000))
    tau = bad.tau.copy()
    tau[[2000, 5000, 8000], 1] += 500.0  # mixed-up messages
    folder = filled(tmp_path / "cell", [replace(bad, tau=tau), cut(motion, slice(0, 80_000))])
    one = Trainer(folder)
    while one.step() not in ("train", "nothing"):
        pass
    assert (folder.bundles / "b0001.tauext").is_file(), words(folder)
    assert any(line.startswith("left out of training for faults: seg-000001 (spike)") for line in words(folder))
    filled(folder.path, [replace(cut(motion, slice(0, 60_000)), tau=-cut(motion, slice(0, 60_000)).tau)])
    given = TrainingInput(folder.path / "robot.xml", PAPER_CASES["exact"], folder.load(folder.segments()[-6:]))
    with pytest.raises(FaultyDataError):  # of all its motion
        one._checked(given, one._config(1))


def test_a_training_refused_for_the_whole_stream_names_a_remedy_that_the_command_has(tmp_path, motion):
    wrong = cut(motion, slice(0, 90_000))
    folder = filled(tmp_path / "cell", [replace(wrong, tau=-wrong.tau)])
    one = Trainer(folder)
    while one.step() not in ("train", "nothing"):
        pass
    refused = next(line for line in words(folder) if line.startswith("training on"))
    assert "joint1: the torque is positive where it pushes in the negative direction" in refused, refused
    assert "reverse this joint's effort in the driver" in refused and refused.endswith("then begin with a new --out")
    assert "--accept" not in refused and folder.active() is None


@pytest.mark.parametrize(
    ("new", "why"),
    [
        (judged(1, 80), ""),
        (judged(1, 76), ""),
        (judged(1, 70), "it detects 70% of the hits, old 80%"),
        (judged(1, 70, promised=4.0), "it detects 70% of the hits, old 80%"),
        (judged(1, 50, promised=2.0), ""),  # limits for rarer false alarms are higher
        (judged(1, 40, promised=2.0), "it detects 40% of the hits, old 80%"),
        (judged(0, 70), ""),
        (judged(3, 90), "3 false alarms, 1 with old"),
        (judged(5, 80, kept=False), "5 false alarms in 60.0 min, where its thresholds allow at most 4.5 an hour"),
        (judged(1, 80, rejected=0.03), "it rejects 3.0% of the motion (clock 3.0%)"),
    ],
)
def test_a_bundle_is_replaced_by_none_that_is_worse(new, why):
    assert why_not(new, judged(1, 80)) == why
    assert why_not(judged(1, 50), judged(1, 80), is_broken=True) == ""  # higher limits repair a broken promise
    assert why_not(judged(1, 40), judged(1, 80), is_broken=True) == "it detects 40% of the hits, old 80%"


@pytest.mark.parametrize(
    ("new", "broken", "ratio", "why"),
    [
        (judged(1, 80), False, 1.0, ""),
        (judged(0, 85), False, 0.9, ""),
        (judged(1, 76), False, 1.0, "it detects 76.0% of the hits, old 80.0%: up to 5% of the hits less are accepted"),
        (
            judged(1, 50, promised=2.0),
            False,
            1.0,
            "it detects 50.0% of the hits, old 80.0%: its thresholds are set for",
        ),
        (judged(1, 50), True, 1.0, "it detects 50.0% of the hits, old 80.0%: old exceeds its target"),
        (judged(0, 70), False, 1.0, "it detects 70.0% of the hits, old 80.0%: it has fewer false alarms"),
        (judged(2, 80), False, 1.0, "it has 2 false alarms, old 1: one more may be chance"),
        (judged(1, 80), False, 1.2, "its error is 1.20 times that of old"),
    ],
)
def test_in_what_a_bundle_that_replaces_another_is_worse_is_stated(new, broken, ratio, why):
    assert why_not(new, judged(1, 80), broken) == ""
    words = why_worse(new, judged(1, 80), broken, ratio)
    assert words.startswith(why) and bool(words) == bool(why)


def test_the_line_of_an_activation_states_in_what_its_bundle_is_worse(copy, monkeypatch):
    worse = "it detects 76.0% of the hits, b0001 80.0%"
    monkeypatch.setattr(Trainer, "_judged", lambda *_: ({"test_minutes": 1.0, "worse": worse}, ""))
    monkeypatch.setattr("tauext_commission.trainer.search", lambda *_: [])
    (copy.bundles / "b0002.tauext").write_bytes((copy.bundles / "b0001.tauext").read_bytes())
    copy.pending_file.write_text(json.dumps({"bundle": "b0002", "minutes": 2, "trained_on": []}))
    Trainer(copy)._judge_bundle()
    assert copy.history()[-1]["words"] == f"b0002 is chosen: it passed on 60 s outside its training; {worse}"


def test_a_finding_that_later_motion_does_not_show_is_withdrawn(copy):
    other = Remark(
        "robot-file-other", "fault", None, "the robot file seems to be of another arm", "give that of this arm"
    )
    held = Remark(HELD, "warning", None, "this computer took the samples late", "")  # not judged again
    copy.findings_file.write_text(json.dumps({"findings": as_entries([other, held])}))
    one, before = Trainer(copy), words(copy)
    one._report([other], read_findings(copy.path))
    assert words(copy) == before
    one._report([], read_findings(copy.path))
    gone = "no longer found in the newest motion: fault: the robot file seems to be of another arm"
    assert words(copy) == [*before, gone]


def test_steps_are_named_beyond_what_earlier_days_differ():
    day = {"a": 1.0, "b": 1.0}
    errors = {"a": 0.02, "b": 0.02}
    assert not named_steps({"a": 1.4, "b": 0.8}, errors, [])
    assert named_steps({"a": 1.4, "b": 0.5}, errors, [day]) == ["friction of b is 0.50 times that of earlier days"]
    assert not named_steps({"a": 1.9, "b": 1.0}, errors, [day, {"a": 1.6, "b": 1.0}, {"a": 0.8, "b": 1.0}])


def run(capsys, *words: str) -> str:
    assert main(list(words)) == 0, capsys.readouterr().err
    return capsys.readouterr().out


def test_the_folder_is_a_dataset_for_other_commands(copy, tmp_path, capsys):
    cell, bundle = str(copy.path), str(copy.active())
    before = {path.name: path.read_bytes() for path in copy.path.glob("seg-*.parquet")}
    assert "b0001" in run(capsys, "show", cell) and json.loads(run(capsys, "show", cell, "--json"))["bundle"] == "b0001"
    assert run(capsys, "report", cell, "--out", str(tmp_path / "page")).strip().endswith("history.html")
    assert "b0001 is chosen" in (tmp_path / "page" / "history.html").read_text()
    run(capsys, "check", "--data", cell)
    run(capsys, "refit", bundle, "--data", cell, "--out", str(tmp_path / "morning.tauext"))
    run(capsys, "evaluate", "--data", cell, "--bundles", bundle, "--out", str(tmp_path / "results"))
    run(capsys, "run", bundle, f"{cell}/seg-000001.parquet")
    assert before == {path.name: path.read_bytes() for path in copy.path.glob("seg-*.parquet")}


@pytest.mark.slow
def test_training_and_calibration_commands_take_the_folder(copy, motion, quick, tmp_path, capsys):
    filled(copy.path, [cut(motion, slice(121_000, 200_000))])
    out = ["--out", str(tmp_path / "b.tauext"), "--accept", "torque-changes"]
    run(capsys, "train", "--data", str(copy.path), "--recipe", "prior", *out)
    bundle, limits = str(copy.active()), str(tmp_path / "c.tauext")
    run(capsys, "calibrate", "--bundle", bundle, "--data", str(copy.path), "--out", limits)


def test_a_report_of_several_arms_is_one_table(learned, tmp_path, capsys):
    arms = [str(tmp_path / f"cell{k}") for k in (1, 2, 3)]
    for arm in arms[:2]:
        shutil.copytree(learned.path, arm)
    bare = CommissionFolder.open(tmp_path / "cell3", create=True)
    assert describe_folder(bare.path)["bundle"] is None
    cell = CommissionFolder(tmp_path / "cell1")
    for number, answer in enumerate(("nothing", "touched", None), 1):
        add_event(cell, id=number, level="collision", bundle="b0001")
        if answer:
            cell.append_label(Label(number, 1, 0, 0, answer, "page", "", "b0001"))
    cell.coverage_file.write_text(json.dumps(cell.coverage() | {"monitored": {"b0001": [360.0, 360.0]}}))
    cell.findings_file.write_text('{"findings": [{"severity": "warning", "words": "gaps <of> the clock"}]}')
    (tmp_path / "cell2" / "commission.json").write_text("{")
    printed = run(capsys, "report", *arms, "--out", str(tmp_path / "page")).splitlines()
    today = cell.history()[0]["wall"][:10]
    assert printed[0].split()[:6] == ["arm", "since", "monitored", "set", "for", "proved"]
    set_for = r"1 in 8 h \(1 in .*\): kept +1 in 1\S* s"
    assert re.fullmatch(rf"cell1  {today} .* {set_for} +3 +1  {today} passed", printed[1]), printed[1]
    assert printed[2].split() == ["cell2"] and printed[3].split() == ["cell3", "no", "bundle", "yet", "0", "0"]
    assert printed[4] == "cell1: gaps <of> the clock" and printed[5].startswith("cell2: ")
    page = (tmp_path / "page" / "arms.html").read_text()
    assert "gaps &lt;of&gt; the clock" in page and page.count("<tr>") == 4
    assert main(["report", *arms[:1], str(tmp_path), "--out", str(tmp_path / "page")]) == 2
    assert "is no folder of `tauext commission`" in capsys.readouterr().err
