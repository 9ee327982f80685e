"""`tauext run`: a replay finds what a slow loop over single samples finds, flights hold it, faults lose nothing."""

from __future__ import annotations

import csv
import json
import os
import re
import subprocess
import sys
import time
from functools import cache
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from made_bundles import JOINTS, LIMIT_NM, PUSHES, cut_flight, damaged, pushed, watching_bundle, with_error_scale
from made_live import replay
from made_results import run_command
from rich.console import Console

from tauext import _core
from tauext.bundle.estimates import ALARMS, HEALTHS, OK, TOUCHES, WARMING_UP, load_estimates
from tauext.cli.live_view import LiveView, bar
from tauext.cli.text_lines import TextLines
from tauext.data.recording_file import load_recording, save_recording
from tauext.errors import RecordingError
from tauext.monitor import record_sink
from tauext.monitor.changes import AlarmChange, ChangeFinder, HiddenCollision, TouchChange
from tauext.monitor.event_stream import Tally
from tauext.monitor.explanation import MEANING, explain
from tauext.monitor.flight_content import event_kind, flight_rate_hz, rows_kept
from tauext.monitor.flight_files import FlightCount, FlightSource
from tauext.monitor.record_sink import FlightSink
from tauext.sources.replay import Pace, ReplaySource

CAUSES = 12


@pytest.fixture(scope="module")
def bundle():
    return watching_bundle()


@pytest.fixture
def place(tmp_path, bundle):
    """A folder with a bundle and a recording of two pushes."""
    bundle.save(str(tmp_path / "watching.tauext"))
    save_recording(pushed(), tmp_path / "pushed.parquet")
    return tmp_path


def run(capsys, *arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr of `tauext run`."""
    return run_command(capsys, "run", *arguments)


def faulty():
    """Everything that can go wrong in one replay: NaN, a gap, late samples, a clock set back, a push among them."""
    whole = pushed(seconds=8.0, pushes=(*PUSHES, (5.0, 0, 9.0), (7.0, 1, 8.0)))
    t_ns, tau, q = whole.t_ns.copy(), whole.tau.copy(), whole.q.copy()
    tau[2900:2903, 1] = np.nan
    q[2950] = np.inf
    t_ns[4500:] += 300_000_000
    t_ns[4200] = t_ns[4198]
    t_ns[6200:] -= 2_000_000_000
    return damaged(whole, t_ns=t_ns, tau=tau, q=q)


def slow_changes(bundle, samples, acknowledge_after_s=None) -> list[tuple]:
    """The rule, sample by sample and in plain words: what differs from one sample before."""
    monitor = _core.Monitor(bundle)
    health, causes, alarm, touch, raised_ns, changes = "warming_up", [], "none", "none", None, []
    for row in range(len(samples.t_ns)):
        t_ns = int(samples.t_ns[row])
        due = raised_ns is not None and acknowledge_after_s is not None
        if due and t_ns >= raised_ns + round(acknowledge_after_s * 1e9):
            monitor.acknowledge()
            changes.append((row, t_ns, "acknowledged"))
            alarm, raised_ns = "none", None
        said = monitor.step(t_ns, samples.q[row], samples.dq[row], samples.tau[row])
        if (said.health.name, said.causes) != (health, causes):
            changes.append((row, t_ns, said.health.name, health, said.causes, said.cause_joint))
        if said.alarm.name != alarm:
            raised = ALARMS.index(said.alarm.name) > ALARMS.index(alarm)
            limits = said.contact_limit_nm if said.alarm.name == "contact" else said.limit_nm
            values = (said.tau_ext[said.alarm_joint], limits[said.alarm_joint]) if raised else ()
            changes.append((row, t_ns, said.alarm.name, alarm, said.alarm_joint if raised else -1, *values))
        if said.touch.name not in (touch, "none", "unknown"):
            changes.append((row, t_ns, "touch", said.touch.name, touch, said.alarm.name, said.alarm_joint))
        health, causes, alarm, touch = said.health.name, said.causes, said.alarm.name, said.touch.name
        raised_ns = said.alarm_t_ns if alarm == "collision" else None
    return changes


def plain(changes) -> list[tuple]:
    """What replay found, as the slow loop writes it."""
    told = []
    for c in changes:
        if isinstance(c, HiddenCollision):
            continue
        if isinstance(c, TouchChange):
            told.append((c.row, c.t_ns, "touch", TOUCHES[c.touch], TOUCHES[c.was], ALARMS[c.alarm], c.joint))
        elif not isinstance(c, AlarmChange):
            names = [HEALTHS[h].replace(" ", "_") for h in (c.health, c.was)]
            told.append((c.row, c.t_ns, *names, _core.cause_names(c.causes), c.joint))
        elif c.acknowledged:
            told.append((c.row, c.t_ns, "acknowledged"))
        else:
            values = (c.tau_ext_nm, c.limit_nm) if c.joint >= 0 else ()
            told.append((c.row, c.t_ns, ALARMS[c.alarm], ALARMS[c.was], c.joint, *values))
    return told


def replayed(bundle, samples, **options) -> list:
    return [change for chunk in replay(_core.Monitor(bundle), samples, **options) for change in chunk.changes]


# Replay


def test_words_and_numbers_are_those_of_the_core():
    assert [h.replace(" ", "_") for h in HEALTHS] == [_core.Health(k).name for k in range(len(HEALTHS))]
    assert list(ALARMS) == [_core.Alarm(k).name for k in range(len(ALARMS))]
    assert list(MEANING) == [_core.cause_names(1 << k)[0] for k in range(CAUSES)]
    assert _core.cause_names(1 << CAUSES) == []


@cache
def slow_changes_of(bundle, make, acknowledge_after_s) -> list:
    return slow_changes(bundle, make(), acknowledge_after_s)


@pytest.mark.parametrize("chunk_s", [0.0, 0.37, *(pytest.param(s, marks=pytest.mark.slow) for s in (0.02, 100.0))])
@pytest.mark.parametrize("acknowledge_after_s", [None, 0.1])
@pytest.mark.parametrize("make", [pushed, faulty])
def test_changes_equal_those_of_a_slow_loop_whatever_the_chunks(bundle, make, acknowledge_after_s, chunk_s):
    expected = slow_changes_of(bundle, make, acknowledge_after_s)
    found = plain(replayed(bundle, make(), acknowledge_after_s=acknowledge_after_s, chunk_s=chunk_s))
    assert found == expected
    assert sum(change[2] == "collision" for change in found) >= (1 if acknowledge_after_s is None else 2)


def test_an_acknowledged_alarm_whose_cause_lasts_is_raised_again_at_the_same_sample():
    bundle = watching_bundle(hold_s=0.0)
    long = pushed(pushes=((2.0, 0, 12.0),), length_s=1.0)
    found = plain(replayed(bundle, long, acknowledge_after_s=0.25))
    assert found == slow_changes(bundle, long, 0.25)
    raised = [c[0] for c in found if c[2] == "collision"]
    again = [c[0] for c in found if c[2] == "acknowledged"]
    assert len(raised) >= 4 and raised[1:4] == again[:3]
    assert np.diff(raised[:4]).tolist() == [250, 250, 250]


def test_samples_come_when_their_time_has_come_by_the_clock():
    now, slept = [50.0], []

    def sleep(seconds):
        slept.append(seconds)
        now[0] += seconds

    recording, rows = pushed(seconds=2.0), []
    source = ReplaySource(recording, 4.0)
    source._pace = Pace(4.0, clock=lambda: now[0], sleep=sleep)
    while not source.ended:
        if (block := source.next_block(10.0, 100)) is None:
            continue
        due = 50.0 + (block.t_ns - recording.t_ns[0]) * 1e-9 / 4
        assert (due <= now[0] + 1e-9).all()
        rows.append(len(block))
        if sum(rows) == 500:
            now[0] += 0.06  # a slow reader finds the samples waiting, and is told since when
            block = source.next_block(10.0, 1000)
            rows.append(len(block))
            assert len(block) == 240 and np.ptp(block.received_ns) == pytest.approx(239 / 4 * 1e6, rel=1e-3)
    assert sum(rows) == 2000 and now[0] == pytest.approx(50.0 + 1.999 / 4)


def test_a_replay_as_fast_as_it_can_never_sleeps():
    def sleep(seconds):
        raise AssertionError

    source = ReplaySource(pushed(), None)
    source._pace = Pace(None, sleep=sleep)
    assert [len(source.next_block(0.0, 1000)) for _ in range(6)] == [1000] * 6 and source.ended


def test_the_tally_counts_what_arrays_of_all_samples_hold(bundle):
    monitor, samples = _core.Monitor(bundle), faulty()
    tally, total = Tally(JOINTS, monitor.sample_period_ns), Tally(JOINTS, monitor.sample_period_ns)
    said = []
    for chunk in replay(monitor, samples, acknowledge_after_s=0.1, chunk_s=0.2):
        tally.add(chunk, monitor)
        said.append(chunk.estimates)
    whole = {key: np.concatenate([part[key] for part in said]) for key in said[0]}
    told = tally.summary()
    assert told["samples"] == 8000 and told["hours"] == pytest.approx(8 / 3600)
    assert told["health_share"] == {name: (whole["health"] == k).mean() for k, name in enumerate(HEALTHS)}
    assert list(told["worst_margin_nm"].values()) == np.nanmin(whole["margin_nm"], axis=0).tolist()
    assert sum(told["alarms"]["collision"].values()) == tally.acknowledged + (whole["alarm"][-1] == 2)
    assert (told["bridged_ticks"], told["restarts"]) == (monitor.bridged_ticks, monitor.restarts)
    total.merge(tally)
    total.merge(tally)
    doubled = total.summary()
    assert (doubled["samples"], doubled["restarts"]) == (16000, 2 * monitor.restarts)
    assert doubled["health_share"] == told["health_share"] and doubled["worst_margin_nm"] == told["worst_margin_nm"]
    json.dumps(Tally(JOINTS, 1_000_000).summary(), allow_nan=False)


# Flights


def flight_sink(bundle, samples, folder: Path, before_s=1.0, after_s=0.5, contacts=False, **options) -> FlightSink:
    folder.mkdir(exist_ok=True)
    recorder = _core.FlightRecorder(2, bundle.observer.sample_period_ns, before_s, after_s, contacts)
    sink = FlightSink(folder, bundle, recorder, FlightSource.of(bundle, samples), **options)
    sink.open(JOINTS, None)
    return sink


def flown(bundle, samples, folder: Path, before_s=1.0, after_s=0.5, contacts=False, **options) -> list:
    """News of the flights of one replay."""
    sink = flight_sink(bundle, samples, folder, before_s, after_s, contacts)
    replay(_core.Monitor(bundle), samples, sink.recorder, chunk_s=after_s or 0.02, each=sink.verdict, **options)
    sink.close()
    assert sink.recorder.missed == 0
    return sink.news()


def test_a_flight_holds_the_rows_of_the_recording_around_the_event_and_what_was_reported_of_them(bundle, tmp_path):
    recording = pushed()
    news = flown(bundle, recording, tmp_path, acknowledge_after_s=0.8)
    said = _core.Monitor(bundle).run(recording.t_ns, recording.q, recording.dq, recording.tau)
    raised = [c for c in slow_changes(bundle, recording, 0.8) if c[2] == "collision"]
    assert [one.what for one in news] == ["collision"] * len(raised) and len(raised) == 2
    for one, (row, t_ns, *_) in zip(news, raised, strict=True):
        assert one.t_ns == t_ns
        flight, estimates = (
            load_recording(one.path),
            load_estimates(one.path.with_name(f"{one.path.stem}.estimates.parquet")),
        )
        rows = slice(row - 1000, row + 501)
        for signal in ("t_ns", "q", "dq", "tau"):
            np.testing.assert_array_equal(getattr(flight, signal), getattr(recording, signal)[rows], err_msg=signal)
        for key in ("residual", "network", "tau_ext", "limit_nm"):
            np.testing.assert_array_equal(getattr(estimates, key), said[key][rows].astype(np.float32), err_msg=key)
        for key in ("near_stiction", "health", "detection", "causes"):
            np.testing.assert_array_equal(getattr(estimates, key), said[key][rows], err_msg=key)
        assert estimates.alarm[999] < 2 and estimates.alarm[1000] == 2
        assert (flight.source, flight.robot_sha256) == ("flight recorder", recording.robot_sha256)
        assert flight.provenance["event"]["t_ns"] == t_ns and flight.provenance["bundle"] == "watching"
        text = one.path.with_suffix(".txt").read_text()
        assert flight.provenance["explanation"] + "\n" == text
        assert one.path.stem == f"pushed-{(t_ns - recording.t_ns[0]) * 1e-9:.3f}s-collision"
    assert len(list(tmp_path.iterdir())) == 3 * len(news)


def test_an_explanation_says_the_numbers_of_the_arrays(bundle, tmp_path):
    recording = pushed()
    one = flown(bundle, recording, tmp_path)[0]
    said = _core.Monitor(bundle).run(recording.t_ns, recording.q, recording.dq, recording.tau)
    k = int(np.flatnonzero(said["alarm"] == 2)[0])
    tau_ext, limit = said["tau_ext"][k], said["limit_nm"][k]
    text = one.path.with_suffix(".txt").read_text()
    assert (
        f"Collision on joint shoulder, {k * 1e-3:.3f} s after the start of pushed (t_ns = {recording.t_ns[k]})" in text
    )
    assert f"|tau_ext| of shoulder was {abs(tau_ext[0]):.3f} Nm, {abs(tau_ext[0]) - limit[0]:.3f} Nm over" in text
    assert (
        f"its collision threshold of {limit[0]:.3f} Nm (sliding: its speed was {recording.dq[k, 0]:+.4f} rad/s" in text
    )
    first = k - int(np.argmax(np.abs(said["tau_ext"][k::-1, 0]) <= said["limit_nm"][k::-1, 0])) + 1
    assert k - first == 5  # the hold time
    assert f"over that threshold for {k - first:.1f} ms" in text
    assert f"The observer's residual was {said['residual'][k, 0]:+.3f} Nm, the network expected " in text
    assert f"{said['uncertainty'][k, 0]:+.3f} Nm" in text and f"tau_ext = {tau_ext[0]:+.3f} Nm" in text
    assert f"elbow {abs(tau_ext[1]):.3f} of {limit[1]:.3f} Nm ({abs(tau_ext[1]) / limit[1]:.0%})" in text
    assert "Health before: ok for 1.000 s." in text
    peak = np.abs(said["tau_ext"][k : k + 501, 0])
    assert f"peaked at {peak.max():.3f} Nm, {peak.argmax() * 1e-3:.3f} s after it" in text
    assert "left out" not in text
    event = load_recording(one.path).provenance["event"]
    assert (event["joint"], event["tau_ext_nm"], event["limit_nm"]) == ("shoulder", tau_ext.tolist(), limit.tolist())


def test_a_contact_is_explained_with_its_own_limit_and_only_where_asked_for(bundle, tmp_path):
    soft = pushed(pushes=((2.0, 1, 1.3 * LIMIT_NM / 2),), length_s=1.0)
    said = _core.Monitor(bundle).run(soft.t_ns, soft.q, soft.dq, soft.tau)
    assert said["alarm"].max() == 1  # else this tests nothing
    assert flown(bundle, soft, tmp_path / "none") == []
    news = flown(bundle, soft, tmp_path / "contacts", contacts=True)
    assert {one.what for one in news} == {"contact"}
    text = news[0].path.with_suffix(".txt").read_text()
    k = int(np.flatnonzero(said["alarm"] == 1)[0])
    joint = int(said["alarm_joint"][k])
    limit = LIMIT_NM / 2 * (1.5 if said["near_stiction"][k, joint] else 1.0)
    assert f"{abs(said['tau_ext'][k, joint]) - limit:.3f} Nm over its contact threshold of {limit:.3f} Nm" in text


def test_a_contact_is_reported_with_its_own_limit_in_lines_and_json(bundle, tmp_path, capsys):
    soft = pushed(pushes=((2.0, 1, 1.3 * LIMIT_NM / 2),), length_s=1.0)
    bundle.save(str(tmp_path / "watching.tauext"))
    save_recording(soft, tmp_path / "soft.parquet")
    said = _core.Monitor(bundle).run(soft.t_ns, soft.q, soft.dq, soft.tau)
    k = int(np.flatnonzero(said["alarm"] == 1)[0])
    joint = int(said["alarm_joint"][k])
    limit = LIMIT_NM / 2 * (1.5 if said["near_stiction"][k, joint] else 1.0)
    assert said["contact_limit_nm"][k, joint] == limit
    _, out, _ = run(capsys, tmp_path / "watching.tauext", tmp_path / "soft.parquet")
    (told,) = [line for line in out.splitlines() if "CONTACT" in line]
    assert "contact threshold" in told and told.endswith(f" {limit:.2f} Nm")
    _, out, _ = run(capsys, tmp_path / "watching.tauext", tmp_path / "soft.parquet", "--json")
    events = [json.loads(line) for line in out.splitlines()]
    (alarm,) = [one for one in events if one["event"] == "alarm" and one["alarm"] == "contact"]
    assert alarm["limit_nm"] == limit < abs(alarm["tau_ext_nm"])
    assert events[0]["estimate_units"] == ["N m", "N m"]


def test_answers_are_reported_in_the_bundle_s_own_units(tmp_path, capsys):
    """An arm recorded in amperes, whose torque constants nobody knows."""
    other = watching_bundle()
    other.units = _core.TorqueUnits(given=_core.TorqueUnit.ampere)
    assert other.estimate_units == ["A", "A"]
    other.save(str(tmp_path / "other.tauext"))
    save_recording(pushed(), tmp_path / "pushed.parquet")
    _, out, _ = run(capsys, tmp_path / "other.tauext", tmp_path / "pushed.parquet", "--flights", tmp_path / "flights")
    assert " Nm" not in out and " A, collision threshold" in out
    (text,) = (path.read_text() for path in (tmp_path / "flights").glob("*.txt"))
    assert " Nm" not in text and " A over its collision threshold" in text


def test_a_limit_that_moves_is_reported_with_the_standard_error(bundle, tmp_path, capsys):
    moving, recording = with_error_scale(watching_bundle()), pushed()
    moving.save(str(tmp_path / "moving.tauext"))
    save_recording(recording, tmp_path / "pushed.parquet")
    (one,) = flown(moving, recording, tmp_path)
    said = _core.Monitor(moving).run(recording.t_ns, recording.q, recording.dq, recording.tau)
    k = int(np.flatnonzero(said["alarm"] == 2)[0])
    j = int(said["alarm_joint"][k])
    size, sigma, limit, scale = (abs(said[key][k, j]) for key in ("tau_ext", "sigma_nm", "limit_nm", "limit_scale"))
    assert limit == pytest.approx(scale * LIMIT_NM) and scale > 1.2
    text = one.path.with_suffix(".txt").read_text()
    assert f"over its collision threshold of {limit:.3f} Nm" in text
    assert f"It was {size / sigma:.2g} times its standard error in free motion of {sigma:.3f} Nm" in text
    assert f"multiplied the threshold of usual motion by {scale:.2f}." in text
    estimates = load_estimates(one.path.with_name(f"{one.path.stem}.estimates.parquet"))
    np.testing.assert_array_equal(estimates.sigma_nm, said["sigma_nm"][k - 1000 : k + 501].astype(np.float32))
    _, out, _ = run(capsys, tmp_path / "moving.tauext", tmp_path / "pushed.parquet")
    assert f"|tau_ext| {size:.2f} Nm (standard error {sigma:.2f} Nm), collision threshold {limit:.2f} Nm" in out
    _, out, _ = run(capsys, tmp_path / "moving.tauext", tmp_path / "pushed.parquet", "--json", "--status-hz", 1)
    events = [json.loads(line) for line in out.splitlines()]
    (raised,) = (e for e in events if e["event"] == "alarm" and e["alarm"] == "collision")
    assert (raised["sigma_nm"], raised["limit_nm"]) == (sigma, limit)
    status = [e["sigma_nm"] for e in events if e["event"] == "status"]
    assert status[0] == [None, None] and status[-1] == said["sigma_nm"][5000].tolist()


def test_a_near_stiction_limit_is_called_so(tmp_path):
    pushes = ((2.0, 0, 40.0),)
    dq = pushed(pushes=pushes).dq.copy()
    dq[:, 0] = 0.0
    bundle = watching_bundle(network=False)
    news = flown(bundle, pushed(pushes=pushes, dq=dq), tmp_path)
    text = news[0].path.with_suffix(".txt").read_text()
    assert (
        f"collision threshold of {1.5 * LIMIT_NM:.3f} Nm (near stiction: its speed was +0.0000 rad/s, below 0.02)"
        in text
    )
    assert "the bundle has no network, so this is tau_ext" in text


def test_a_fault_says_its_cause_and_the_samples_that_the_files_leave_out(bundle, tmp_path):
    whole = pushed(pushes=())
    tau = whole.tau.copy()
    tau[3000:3012, 1] = np.nan
    (one,) = flown(bundle, damaged(whole, tau=tau), tmp_path)
    assert (one.what, one.t_ns) == ("fault", whole.t_ns[3000])
    flight, text = load_recording(one.path), one.path.with_suffix(".txt").read_text()
    kept = np.r_[2000:3000, 3012:3501]
    np.testing.assert_array_equal(flight.t_ns, whole.t_ns[kept])
    np.testing.assert_array_equal(flight.q, whole.q[kept])
    estimates = load_estimates(tmp_path / f"{one.path.stem}.estimates.parquet")
    np.testing.assert_array_equal(estimates.t_ns, flight.t_ns)
    assert estimates.health[999] == OK and estimates.health[1000] == WARMING_UP
    assert "Fault (not finite), first on joint elbow, 3.000 s after" in text
    assert "Not finite: a position, velocity or torque was NaN" in text
    assert f"elbow there: q = {whole.q[3000, 1]:.5f} rad" in text and "tau = +nan Nm; one sample before:" in text
    assert "Last estimate, 1.0 ms before: shoulder " in text
    assert "the fault was gone after 0.012 s" in text
    assert "12 of 1501 samples that do not fit a recording are left out" in text
    assert f"t_ns = {whole.t_ns[3000]} (3.000 s): q = [{whole.q[3000, 0]:.6g}, " in text and "and 2 more." in text
    assert flight.provenance["dropped_samples"] == 12
    with (tmp_path / f"{one.path.stem}.dropped.csv").open() as file:
        dropped = list(csv.DictReader(file))
    assert [int(line["t_ns"]) for line in dropped] == whole.t_ns[3000:3012].tolist()
    assert [float(line["q_shoulder"]) for line in dropped] == whole.q[3000:3012, 0].tolist()
    assert all(line["tau_elbow"] == "nan" and line["health"] == "3" and line["causes"] == "1" for line in dropped)


def test_a_flight_of_which_nothing_can_be_kept_still_has_its_explanation(bundle, tmp_path):
    whole = pushed(seconds=0.4)
    (one,) = flown(bundle, damaged(whole, tau=np.full_like(whole.tau, np.nan)), tmp_path)
    assert one.path.name == "pushed-0.000s-fault.txt" and one.error is None
    assert "400 of 400 samples" in one.path.read_text()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["pushed-0.000s-fault.dropped.csv", "pushed-0.000s-fault.txt"]


def test_a_collision_while_a_drive_is_saturated_is_a_collision_and_its_estimate_called_doubtful():
    bundle = watching_bundle()
    bundle.torque_limit_nm = [12.0, 12.0]
    samples = pushed()
    said = _core.Monitor(bundle).run(samples.t_ns, samples.q, samples.dq, samples.tau)
    broke, raised = (int(np.flatnonzero(said[key] == level)[0]) for key, level in (("health", 3), ("alarm", 2)))
    assert broke < raised
    texts = []
    for row, kind in ((broke, "fault"), (raised, "collision")):
        flight = cut_flight(bundle, samples, row)
        assert event_kind(flight) == kind
        texts.append(explain(flight, rows_kept(flight), FlightSource.of(bundle, samples)))
    assert "Fault (torque saturated), first on joint shoulder" in texts[0] and "At the fault: shoulder " in texts[0]
    assert "Health was fault (torque saturated) at that sample: the estimate may be wrong." in texts[1]
    ms = raised - broke
    assert (
        f"Health before: ok for {(1000 - ms) * 1e-3:.3f} s, then fault (torque saturated) for {ms * 1e-3:.3f} s."
        in texts[1]
    )


def test_times_reported_are_sound_where_the_clock_was_set_back(bundle):
    samples = faulty()
    flight = cut_flight(bundle, samples, 6200, before=100)
    text = explain(flight, rows_kept(flight), FlightSource.of(bundle, samples))
    assert "The sample came -1999.000 ms after the one before it." in text
    assert re.search(r"for 0\.099 s\.$", text, flags=re.MULTILINE) and "In the 0.500 s after it" in text


def test_samples_with_a_time_that_is_not_later_are_left_out(bundle, tmp_path):
    samples = faulty()
    news = flown(bundle, samples, tmp_path)
    assert [one.error for one in news] == [None] * len(news)
    back = next(one for one in news if one.t_ns == samples.t_ns[6200])
    assert "Fault (time backwards)" in back.path.with_suffix(".txt").read_text()
    assert load_recording(back.path).t_ns[-1] == samples.t_ns[6199]
    flight = {"t_ns": np.array([5, 9, 7, 9, 12, 11]), **{s: np.zeros((6, 1)) for s in ("q", "dq", "tau")}}
    flight["q"][4] = np.nan
    assert rows_kept(flight).tolist() == [True, True, False, False, False, True]


def test_a_flight_at_another_rate_than_the_recordings_says_its_own():
    ms = 1_000_000
    assert flight_rate_hz(np.arange(9) * ms, 1000.0) == 1000.0
    assert flight_rate_hz(np.arange(9) * 2 * ms, 1000.0) == 500.0
    assert flight_rate_hz(np.arange(1), 1000.0) == 1000.0


def test_flights_are_never_written_over_others(bundle, tmp_path):
    recording = pushed()
    names = [flown(bundle, recording, tmp_path)[0].path.name for _ in range(3)]
    stem = names[0].removesuffix(".parquet")
    assert names == [f"{stem}.parquet", f"{stem}-2.parquet", f"{stem}-3.parquet"]
    (tmp_path / f"{stem}-4.txt.part").touch()  # another run is writing this one
    assert flown(bundle, recording, tmp_path)[0].path.name == f"{stem}-5.parquet"
    assert {load_recording(tmp_path / name).samples for name in names} == {1501}


def test_no_flight_is_missed_however_fast_the_replay(bundle, tmp_path):
    starts = np.arange(1.0, 30.0, 0.8)
    many = pushed(seconds=31.0, pushes=tuple((float(s), k % 2, 9.0) for k, s in enumerate(starts)), length_s=0.1)
    news = flown(bundle, many, tmp_path, before_s=0.2, after_s=0.1, acknowledge_after_s=0.3)
    raised = [c for c in slow_changes(bundle, many, 0.3) if c[2] == "collision"]
    assert [one.t_ns for one in news] == [c[1] for c in raised] and len(news) == len(starts)


def test_a_disk_that_is_full_for_a_while_loses_its_flights_and_no_others(bundle, tmp_path, monkeypatch):
    calls, real = [], record_sink.write_flight

    def write(*arguments):
        calls.append(1)
        if len(calls) == 1:
            raise RecordingError("the disk is full")
        return real(*arguments)

    monkeypatch.setattr(record_sink, "write_flight", write)
    first, second = flown(bundle, pushed(), tmp_path, acknowledge_after_s=0.8)
    assert (first.path, first.error) == (None, "the disk is full")
    assert second.path.exists() and second.error is None


def test_a_replay_waits_for_a_slow_disk_before_memory_fills(bundle, tmp_path, monkeypatch):
    starts = np.arange(1.0, 6.0, 0.8)
    many = pushed(seconds=7.0, pushes=tuple((float(s), 0, 9.0) for s in starts), length_s=0.1)
    monkeypatch.setattr(record_sink, "write_flight", lambda *_: time.sleep(0.02) or tmp_path)
    sink, waiting = flight_sink(bundle, many, tmp_path, 0.2, 0.1, most_waiting=1), []

    def each(chunk):
        sink.verdict(chunk)
        waiting.append(sink.worker._waiting.qsize())

    replay(_core.Monitor(bundle), many, sink.recorder, 0.3, 0.1, each=each)
    sink.close()
    assert max(waiting) <= 1 and len(sink.news()) == len(starts)


def test_a_mistake_in_the_writing_is_not_swallowed(bundle, tmp_path, monkeypatch):
    monkeypatch.setattr(record_sink, "write_flight", lambda *_: 1 / 0)
    sink = flight_sink(bundle, pushed(), tmp_path)
    replay(_core.Monitor(bundle), pushed(), sink.recorder, 0.8, 0.5, each=sink.verdict)
    with pytest.raises(ZeroDivisionError):
        sink.close()
    errors = [one.error for one in sink.news()]
    assert len(errors) > 1 and set(errors) == {"ZeroDivisionError: division by zero"}  # reported at once, each flight


@pytest.mark.parametrize(
    "broken", ["tauext.monitor.flight_files.save_recording", "tauext.monitor.flight_files.save_estimates"]
)
def test_a_flight_that_fails_half_way_leaves_no_file(bundle, tmp_path, monkeypatch, broken):
    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(broken, full)
    (one,) = flown(bundle, pushed(pushes=PUSHES[:1]), tmp_path)
    assert one.path is None and re.fullmatch(r".*pushed-2\.\d+s-collision: .*\(No space left on device\)", one.error)
    assert list(tmp_path.iterdir()) == []


# The command


def test_the_command_tells_events_and_a_summary_in_lines(place, capsys):
    code, out, err = run(capsys, place / "watching.tauext", place / "pushed.parquet", "--acknowledge-after-s", 0.5)
    assert (code, err) == (0, "")
    lines = out.splitlines()
    assert lines[0] == "pushed: 6.0 s, 6,000 samples at 1000 Hz, bundle watching"
    raised = [c for c in slow_changes(watching_bundle(), pushed(), 0.5) if c[2] == "collision"]
    told = [line for line in lines if "COLLISION" in line]
    assert len(told) == len(raised) == 2
    for line, (row, _, _, _, joint, tau_ext, limit) in zip(told, raised, strict=True):
        words = f"COLLISION {JOINTS[joint]}: |tau_ext| {abs(tau_ext):.2f} Nm, collision threshold {limit:.2f} Nm"
        assert line == f"{row * 1e-3:11.3f} s  {words}"
    assert "samples       6,000" in out and "collision shoulder 1, elbow 1" in out and "worst margin  shoulder -" in out
    assert "flights" not in out and "stood from" not in out


def test_json_lines_are_what_the_slow_loop_found(place, capsys, bundle):
    options = ("--acknowledge-after-s", 0.5, "--json", "--status-hz", 40, "--flights", place / "flights")
    code, out, err = run(capsys, place / "watching.tauext", place / "pushed.parquet", *options)
    assert (code, err) == (0, "")
    events = [json.loads(line) for line in out.splitlines()]
    assert events[0] | {"joints": list(JOINTS), "samples": 6000, "bundle": "watching"} == events[0]
    assert [e["event"] for e in events if e["event"] not in ("status", "health", "alarm", "touch", "flight")] == [
        "start",
        "end",
        "summary",
    ]
    expected = slow_changes(bundle, pushed(), 0.5)
    changes = [e for e in events if e["event"] in ("health", "alarm", "touch")]
    assert [(e["row"], e["t_ns"]) for e in changes] == [c[:2] for c in expected]
    raised = [e for e in changes if e["event"] == "alarm" and e["alarm"] == "collision"]
    known = [e for e in changes if e["event"] == "touch"]
    assert [(e["touch"], e["was"], e["alarm"]) for e in known] == [c[3:6] for c in expected if c[2] == "touch"]
    assert [(e["joint"], e["tau_ext_nm"], e["limit_nm"]) for e in raised] == [
        (JOINTS[c[4]], c[5], c[6]) for c in expected if c[2] == "collision"
    ]
    status = [e for e in events if e["event"] == "status"]
    assert [e["row"] for e in status] == list(range(0, 6000, 25))
    said = _core.Monitor(bundle).run(*(getattr(pushed(), name) for name in ("t_ns", "q", "dq", "tau")))
    assert status[0]["tau_ext_nm"] == [None, None] and status[0]["health"] == "warming up"
    assert [e["tau_ext_nm"] for e in status[30:]] == said["tau_ext"][750::25].tolist()
    files = [Path(e["file"]) for e in events if e["event"] == "flight"]
    assert len(files) == 2 and all(file.is_file() for file in files)
    assert events[-1]["flights"] == {"written": 2, "failed": 0, "missed": 0} and not events[-1]["interrupted"]
    assert events[-1]["alarms"]["collision"] == {"shoulder": 1, "elbow": 1}


def test_several_recordings_each_begin_anew_and_are_summed_up(place, capsys):
    save_recording(pushed("second", pushes=PUSHES[1:]), place / "second.parquet")
    paths = (place / "pushed.parquet", place / "second.parquet")
    code, out, _ = run(capsys, place / "watching.tauext", *paths, "--json", "--flights", place / "flights")
    events = [json.loads(line) for line in out.splitlines()]
    alone = [json.loads(line) for line in run(capsys, place / "watching.tauext", paths[1], "--json")[1].splitlines()]
    ours = [e for e in events if e.get("recording") == "second" and e["event"] in ("health", "alarm")]
    assert code == 0 and ours == [e for e in alone if e["event"] in ("health", "alarm")]
    assert (events[-1]["recordings"], events[-1]["samples"]) == (2, 12000)
    assert events[-1]["alarms"]["collision"] == {"shoulder": 1, "elbow": 1}
    assert events[-1]["flights"]["written"] == 2
    code, out, _ = run(capsys, place / "watching.tauext", *paths)
    assert "second (2 of 2)" in out and "2 recordings to the end" in out and out.count("worst margin") == 3


def test_the_networks_own_rate_is_the_cores(place, capsys, bundle):
    arrays = [getattr(pushed(), name) for name in ("t_ns", "q", "dq", "tau")]
    expected = _core.Monitor(bundle, True).run(*arrays)["tau_ext"][1000::8]
    assert (expected != _core.Monitor(bundle).run(*arrays)["tau_ext"][1000::8]).any()
    options = ("--own-rate", "--json", "--status-hz", 125)
    out = run(capsys, place / "watching.tauext", place / "pushed.parquet", *options)[1]
    status = [e for e in map(json.loads, out.splitlines()) if e["event"] == "status"]
    assert [e["tau_ext_nm"] for e in status[125:]] == expected.tolist()


def test_a_disk_error_is_reported_once_the_replay_goes_on_and_the_exit_code_is_2(place, capsys, monkeypatch):
    folder = place / "flights"

    def full(*arguments):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("tauext.monitor.flight_files.save_recording", full)
    options = ("--flights", folder, "--acknowledge-after-s", 0.8)
    code, out, err = run(capsys, place / "watching.tauext", place / "pushed.parquet", *options)
    assert code == 2
    (line,) = err.splitlines()
    assert line.startswith("tauext: error: 2 of 2 event logs are lost: ") and "No space left on device" in line
    assert "6,000" in out and "0 written" in out and "2 could not be written" in out
    assert list(folder.iterdir()) == []


def test_ctrl_c_keeps_the_flights_and_sums_up_what_was_done(place, capsys, monkeypatch):
    calls = []
    find = ChangeFinder.find

    def interrupted(self, *arguments):
        calls.append(1)
        if len(calls) == 9:
            raise KeyboardInterrupt
        return find(self, *arguments)

    monkeypatch.setattr(ChangeFinder, "find", interrupted)
    options = ("--flights", place / "flights", "--after-s", 0.5, "--json")
    code, out, err = run(capsys, place / "watching.tauext", place / "pushed.parquet", *options)
    events = [json.loads(line) for line in out.splitlines()]
    assert code == 130 and err.startswith("tauext: interrupted; the summary covers the motion replayed")
    assert events[-1]["interrupted"] and events[-1]["samples"] == 4000 and events[-1]["recordings"] == 0
    assert events[-2]["event"] == "end" and not events[-2]["complete"]
    assert len(list((place / "flights").glob("*.txt"))) == 1 == events[-1]["flights"]["written"]


def test_a_damaged_recording_stops_the_run_after_the_summary_of_those_before(place, capsys):
    raw = (place / "pushed.parquet").read_bytes()
    middle = len(raw) // 2
    (place / "bad.parquet").write_bytes(raw[:middle] + bytes(200) + raw[middle + 200 :])
    code, out, err = run(capsys, place / "watching.tauext", place / "pushed.parquet", place / "bad.parquet")
    assert code == 2 and len(err.splitlines()) == 1 and "bad.parquet" in err
    assert "1 recording to the end, interrupted" in out and "6,000" in out


def other_recordings(place: Path) -> None:
    save_recording(pushed(joints=("a", "b")), place / "joints.parquet")
    save_recording(pushed(t_ns=np.arange(6000) * 2_000_000, rate_hz=500.0), place / "rate.parquet")
    save_recording(pushed(torque_timing="instant"), place / "timing.parquet")
    (place / "file").touch()


WRONG = [
    (("gone.tauext", "pushed.parquet"), ["gone.tauext", "tauext train"]),
    (("pushed.parquet", "watching.tauext"), ["pushed.parquet", "not a tauext bundle"]),
    (("watching.tauext", "gone.parquet"), ["gone.parquet", "no such recording"]),
    (
        ("watching.tauext", "pushed.parquet", "joints.parquet"),
        ["is for joints shoulder, elbow; recording joints has a, b"],
    ),
    (("watching.tauext", "rate.parquet"), ["runs at 1000 Hz", "500 Hz"]),
    (("watching.tauext", "timing.parquet"), ["torques that are held", "instant"]),
    (("watching.tauext",), ["give one or more recordings"]),
    (("watching.tauext", "pushed.parquet", "--speed", "0"), ["speed = 0.0 must be > 0"]),
    (("watching.tauext", "pushed.parquet", "--speed", "2", "--real-time"), ["speed = 2.0", "--real-time"]),
    (("watching.tauext", "pushed.parquet", "--acknowledge-after-s", "0"), ["--acknowledge-after-s = 0.0 must be > 0"]),
    (("watching.tauext", "pushed.parquet", "--status-hz", "5"), ["--status-hz = 5.0", "--json"]),
    (("watching.tauext", "pushed.parquet", "--flights", "file"), ["file: no folder for event logs"]),
    (("watching.tauext", "pushed.parquet", "--flights", "f", "--before-s", "-1"), ["0 to 600 s"]),
]


@pytest.mark.parametrize("arguments, says", WRONG, ids=lambda value: "-".join(map(str, value))[:60])
def test_wrong_input_gets_one_line_before_anything_is_replayed(place, capsys, monkeypatch, arguments, says):
    monkeypatch.chdir(place)
    other_recordings(place)
    code, out, err = run(capsys, *arguments)
    assert (code, out) == (2, "") and len(err.splitlines()) == 1 and err.startswith("tauext: error: ")
    for part in says:
        assert part in err


def test_a_reader_that_stops_reading_ends_the_run_without_a_traceback(place):
    command = [
        sys.executable,
        "-m",
        "tauext",
        "run",
        "watching.tauext",
        "pushed.parquet",
        "--json",
        "--status-hz",
        "1000",
    ]
    with subprocess.Popen(command, cwd=place, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert json.loads(process.stdout.readline())["event"] == "start"
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 141


def test_health_that_changes_at_every_sample_does_not_flood_the_lines(capsys, bundle):
    whole = pushed(seconds=3.0, pushes=())
    tau = whole.tau.copy()
    tau[1000:1060:2] = np.nan
    lines = TextLines()
    monitor = _core.Monitor(bundle)
    tally = Tally(JOINTS, monitor.sample_period_ns)
    lines.start(bundle, whole, 1, 1)
    for chunk in replay(monitor, damaged(whole, tau=tau), chunk_s=0.3):
        lines.chunk(chunk, tally)
    lines.end(tally, FlightCount(), True)
    out = capsys.readouterr().out
    assert len(out.splitlines()) < 10
    assert out.count("fault: not finite") == 2  # as it happens, and at the end how often
    assert "  fault: not finite, shoulder: 30 times, the last at 1.058 s" in out


# The live view


def test_the_live_view_shows_every_joint_and_leaves_events_and_summary_behind(bundle, monkeypatch):
    monkeypatch.setattr("tauext.cli.live_view.REFRESH_S", 0.0)
    terminal = StringIO()
    console = Console(file=terminal, force_terminal=True, width=110, color_system=None, legacy_windows=False)
    monitor, recording = _core.Monitor(bundle), pushed()
    tally = Tally(JOINTS, monitor.sample_period_ns)
    with LiveView(console=console) as view:
        view.start(bundle, recording, 1, 1)
        for chunk in replay(monitor, recording, chunk_s=0.05):
            tally.add(chunk, monitor)
            view.chunk(chunk, tally)
    shown = terminal.getvalue()
    assert "COLLISION shoulder" in shown and "alarm collision shoulder" in shown
    assert "health warming up" in shown and "5.95 of 6.00 s" in shown
    plain_console = Console(file=StringIO(), width=110, color_system=None)
    plain_console.print(view.panel(chunk, 2.0))
    rows = plain_console.file.getvalue().splitlines()
    assert rows[0].startswith("pushed  6.00 of 6.00 s, 3.0 times as fast as recorded")
    for j, (joint, row) in enumerate(zip(JOINTS, rows[3:], strict=True)):
        said = chunk.estimates
        assert row.split()[0] == joint
        assert f"{said['tau_ext'][-1, j]:+.2f}" in row and f"{said['margin_nm'][-1, j]:+.2f}" in row


@pytest.mark.parametrize(
    "share, cells, side", [(0.0, 0, 1), (0.5, 10, 1), (-0.5, 10, -1), (7.0, 20, 1), (-7.0, 20, -1), (np.nan, 0, 1)]
)
def test_a_bar_grows_from_the_middle_and_stops_at_the_edge(share, cells, side):
    left, right = bar(share).plain[1:-1].split("│")
    assert (len(left), len(right)) == (20, 20)
    assert (left.count("█"), right.count("█")) == ((0, cells) if side > 0 else (cells, 0))
    assert left.endswith("█" * left.count("█")) and right.startswith("█" * right.count("█"))


def on_a_terminal(words: list[str], folder: Path) -> tuple[int, str]:
    """Exit code and output of a command on a pseudo terminal of its own: without a shell, whatever paths hold, and of
    a kind and size of its own, whatever terminal runs the tests."""
    pty, termios = pytest.importorskip("pty"), pytest.importorskip("termios")
    ours, its = pty.openpty()
    termios.tcsetwinsize(its, (40, 100))
    environment = {name: value for name, value in os.environ.items() if name not in ("COLUMNS", "LINES", "NO_COLOR")}
    environment |= {"TERM": "xterm-256color"}
    process = subprocess.Popen(words, cwd=folder, stdin=its, stdout=its, stderr=its, env=environment)
    os.close(its)
    out = bytearray()
    try:
        while part := os.read(ours, 65536):
            out += part
    except OSError:  # as Linux says that nobody writes any longer
        pass
    finally:
        os.close(ours)
    return process.wait(60), out.decode(errors="replace")


def test_on_a_terminal_the_live_view_runs_and_ends_with_the_summary(place):
    words = [sys.executable, "-m", "tauext", "run", "watching.tauext", "pushed.parquet"]
    code, out = on_a_terminal(words, place)
    assert code == 0 and "COLLISION shoulder" in out and "tau_ext from" in out
    assert "worst margin" in out and out.rindex("worst margin") > out.rindex("tau_ext from")
