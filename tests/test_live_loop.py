"""The live loop: what it says is what a replay says; faults of sources and sinks, profiles, control, recordings."""

from __future__ import annotations

import json
import threading
import tomllib
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest
from made_bundles import JOINTS, pushed, taking_amperes, watching_bundle
from made_live import AllAtOnce, Clock, Keeper, Replayed, ScriptedSource, samples_of
from made_results import run_command

from tauext import _core
from tauext.bundle.estimates import COLLISION, FAULT, OK, STALE
from tauext.bundle.match import expect_fit
from tauext.cli.text_lines import TextLines
from tauext.data.description import load_arm
from tauext.data.recording_file import load_recording, save_recording
from tauext.data.servo import in_amperes, servo_facts
from tauext.errors import ConfigError, TauextError
from tauext.files.plain_file import number_of
from tauext.monitor.cell_file import load_cell
from tauext.monitor.changes import AlarmChange, HealthChange
from tauext.monitor.control_lines import ControlSocket, listen_at, obey
from tauext.monitor.latency import Latencies
from tauext.monitor.loop import Loop, LoopSettings
from tauext.monitor.record_sink import FlightSink, RecordSink, file_name
from tauext.monitor.sink import EventFinder
from tauext.monitor.source import Sample, SourceCounts, Stoppable, blocks_of, settings_of
from tauext.sources.reader import SampleQueue
from tauext.sources.replay import ReplaySource


@pytest.fixture(scope="module")
def bundle():
    return watching_bundle()


@pytest.fixture
def clock(monkeypatch) -> Clock:
    """What the loop goes by."""
    one = Clock()
    monkeypatch.setattr("tauext.monitor.loop.time", one)
    return one


def looped(bundle, source, *sinks, profiles=None, recorder=None, **settings) -> tuple[Loop, Keeper]:
    keeper = Keeper()
    loop = Loop(bundle, source, [keeper, *sinks], None, profiles, recorder, LoopSettings(**settings))
    loop.told = []
    loop.note = loop.told.append
    loop.switches = []
    loop.switched = loop.switches.append
    loop.run()
    return loop, keeper


def joined(verdicts) -> dict[str, np.ndarray]:
    return {key: np.concatenate([one.estimates[key] for one in verdicts]) for key in verdicts[0].estimates}


# What it says.


class InBlocks(AllAtOnce):
    """A script whose samples wait until a late loop takes all of them at once."""

    def next_sample(self, timeout_s: float) -> Sample | None:
        sample = super().next_sample(timeout_s)
        return None if sample is None else replace(sample, received_ns=sample.received_ns - 10_000_000)


@pytest.mark.parametrize("acknowledge_after_s", [None, 0.3])
def test_what_is_found_does_not_depend_on_the_blocks(bundle, acknowledge_after_s):
    """Contacts, collisions, a touch of 6 s, faults, wrong sizes, a gap, and a clock that is set back."""
    recording = pushed(seconds=12.0, pushes=((1.0, 0, 1.5), (1.6, 1, 6.0), (4.0, 0, 6.0), (11.0, 1, 2.0)), length_s=0.4)
    lasts = pushed(seconds=12.0, pushes=((4.0, 0, 6.0),), length_s=6.2)
    samples = [*samples_of(recording, slice(0, 4000)), *samples_of(lasts, slice(4000, 12000))]
    samples = [replace(one, t_ns=one.t_ns - 1_000_000_000 * (k >= 6000)) for k, one in enumerate(samples)]
    samples[3000] = replace(samples[3000], tau=samples[3000].tau * np.nan)
    samples = with_wrong_sizes(samples)
    del samples[3500:3600]
    rng = np.random.default_rng(0)
    cuts = sorted(rng.integers(0, len(samples), 300).tolist(), reverse=True)

    def found(most_rows: int, script: list) -> tuple:
        keeper = Keeper()
        settings = LoopSettings(acknowledge_after_s=acknowledge_after_s, missing_after_s=600.0)
        loop = Loop(bundle, InBlocks(script), [keeper], settings=settings)
        loop._most_rows = most_rows
        loop.run()
        finder = EventFinder(loop.joints, {})
        events = [replace(event, received_ns=0) for verdict in keeper.whole for event in finder.find(verdict)]
        news = [one for verdict in keeper.whole for one in verdict.news]
        assert most_rows == 1 or len(keeper.whole) < len(samples) / 5
        return joined(keeper.verdicts), repr(keeper.changes), repr(news), repr(events)

    broken = list(samples)
    for at in cuts:
        waits = iter([False, True])
        broken.insert(at, lambda waits=waits: next(waits))
    one, some, many = found(1, samples), found(1000, broken), found(100, samples)
    for other in (some, many):
        for key, values in one[0].items():
            np.testing.assert_array_equal(other[0][key], values, err_msg=key)
        assert other[1:] == one[1:]
    assert "cleared" in one[3] and "ended=True" in one[2] and "TouchChange" in one[1]


@pytest.mark.parametrize("hours_back", [0, 1])
def test_an_alarm_is_acknowledged_in_time_although_the_clock_was_set_back(bundle, hours_back):
    samples, back_ns = samples_of(pushed()), hours_back * 3_600_000_000_000
    script = [*samples[:4000], *(replace(one, t_ns=one.t_ns - back_ns) for one in samples[4000:])]
    _, keeper = looped(bundle, ScriptedSource(script), acknowledge_after_s=3.0)
    alarms = joined(keeper.verdicts)["alarm"]
    risen, last = int((alarms == COLLISION).argmax()), int(np.flatnonzero(alarms == COLLISION)[-1])
    assert risen < 4000 < last and abs(last - risen - 3000) <= 1


def test_torques_are_multiplied_by_the_constants_of_the_bundle(bundle):
    recording, constants = pushed(seconds=2.5), np.array([0.5, -4.0])
    scaled = taking_amperes(watching_bundle(), constants)
    currents = samples_of(pushed(seconds=2.5, tau=recording.tau / constants))
    (_, one), (_, other) = looped(bundle, ReplaySource(recording, None)), looped(scaled, ScriptedSource(currents))
    np.testing.assert_array_equal(joined(one.verdicts)["tau_ext"], joined(other.verdicts)["tau_ext"])
    assert other.verdicts[2100].sample.tau.tolist() == (recording.tau / constants)[2100].tolist()  # as it came


def test_missing_samples_are_reported_to_the_monitor_and_the_next_one_goes_on(bundle, clock):
    everything = samples_of(pushed(pushes=()))
    waits = []

    def until(count):
        waits.append(count)
        return lambda: loop.missing >= count

    def still_stale():
        return bool(keeper.verdicts and keeper.verdicts[-1].estimates["health"][0] != OK)

    keeper = Keeper()
    script = [*everything[:1000], still_stale, *everything[1001:2000], until(20), *everything[2500:3500]]
    source = ScriptedSource(script, clock)
    loop = Loop(bundle, source, [keeper])
    loop.run()
    changes = [c for c in keeper.changes if isinstance(c, HealthChange)]
    names = [(c.health, _core.cause_names(c.causes)) for c in changes]
    assert names[1] == (STALE, ["missing sample"])
    assert (FAULT, ["gap"]) in names and names[-1] == (OK, [])
    missed = [v for v in keeper.verdicts if v.sample is None]
    assert len(missed) == loop.missing >= 20 and loop.samples == 1000 + 999 + 1000
    assert all(v.estimates["margin_nm"].shape == (1, 2) for v in missed)
    # A gap of one sample is bridged, the long one begins anew.
    assert (loop.monitor.bridged_ticks >= 1, loop.monitor.restarts) == (True, 1)


def test_samples_that_come_late_after_a_silence_lose_nothing(bundle, clock):
    """A computer without time for the sender: no sample for 60 ms, then all that were measured meanwhile."""
    recording = pushed(pushes=())
    everything = samples_of(recording)
    keeper = Keeper()

    script = [*everything[:2000], lambda: loop.missing > 20, *everything[2000:3000]]
    loop = Loop(bundle, ScriptedSource(script, clock), [keeper])
    loop.run()
    missed = [v for v in keeper.verdicts if v.sample is None]
    assert {_core.cause_names(int(v.estimates["causes"][0]))[0] for v in missed} == {"missing sample", "gap"}
    undisturbed = _core.Monitor(bundle).run(*(getattr(recording, name)[:3000] for name in ("t_ns", "q", "dq", "tau")))
    said = joined([v for v in keeper.verdicts if v.sample is not None])
    for name in ("tau_ext", "health", "limit_nm", "margin_nm"):
        np.testing.assert_array_equal(said[name], undisturbed[name], err_msg=name)
    assert loop.monitor.restarts == 0


def test_a_loop_ends_after_its_time_and_reports_every_second(bundle, clock):
    source = ScriptedSource([lambda: False], clock)
    loop, keeper = looped(bundle, source, duration_s=2.05)
    report, _ = keeper.reports
    assert (report.samples, report.missing, report.profile, source.closed) == (0, 0, "", 1)
    assert clock.monotonic() == pytest.approx(2.05, abs=0.1)  # it looks ten times a second
    assert np.isnan(report.tick_p50_us) and loop.samples == 0


# Faults around it.


def test_a_sink_that_raises_is_left_out_and_the_loop_goes_on(bundle):
    def broken(verdict):
        if verdict.row == 3:
            raise OSError("no space left")

    other = Keeper(broken)
    loop, keeper = looped(bundle, Replayed(pushed(seconds=1.0), None), other)
    assert len(keeper.verdicts) == 1000 and len(other.verdicts) == 4 and other.closed == 1
    assert loop.told == ["Keeper is left out from here on: OSError: no space left"]


def test_a_source_that_cannot_be_opened_leaves_nothing_open(bundle):
    keeper = Keeper()
    with pytest.raises(ConfigError, match="has joints shoulder, elbow, the bundle"):
        Loop(watching_of_other_joints(), ReplaySource(pushed()), [keeper]).run()
    assert keeper.closed == 1
    with pytest.raises(ConfigError, match="has 500 Hz, the bundle 1000 Hz"):
        slow = pushed(seconds=1.0)
        half = {s: getattr(slow, s)[::2] for s in ("t_ns", "q", "dq", "tau")}
        Loop(bundle, ReplaySource(pushed(seconds=1.0, rate_hz=500.0, **half))).run()


def watching_of_other_joints():
    bundle = watching_bundle()
    links = bundle.links
    links[0].joint_name = "base"
    bundle.links = links
    return bundle


def test_a_replay_can_be_stopped_and_is_no_more_after_that(bundle):
    source = Replayed(pushed(), None)
    assert isinstance(source, Stoppable)
    keeper = Keeper(lambda verdict: verdict.row == 99 and source.stop())
    Loop(bundle, source, [keeper]).run()
    assert len(keeper.verdicts) == 100 and source.ended and source.next_sample(0.0) is None


def test_a_full_queue_loses_its_oldest_and_counts_it():
    counts = SourceCounts()
    waiting = SampleQueue(counts, capacity=3)
    samples = samples_of(pushed(seconds=0.005))
    for sample in samples:
        waiting.put(sample)
    assert (counts.received, counts.overrun) == (5, 2) and not waiting.ended
    waiting.close()
    assert [waiting.take(0.0).t_ns for _ in range(3)] == [sample.t_ns for sample in samples[2:]]
    assert waiting.take(10.0) is None and waiting.ended  # closed: it does not wait


def test_who_waits_at_a_queue_is_woken_by_a_sample():
    waiting = SampleQueue(SourceCounts())
    (sample,) = samples_of(pushed(seconds=0.001))
    threading.Timer(0.01, waiting.put, [sample]).start()
    assert waiting.take(30.0) is sample


def test_quantiles_are_those_of_all_times_within_a_bin():
    ns = np.random.default_rng(1).lognormal(11, 1.5, 5000).astype(int)
    whole = Latencies()
    for one in ns.tolist():
        whole.add(one)
    for share in (0.5, 0.99, 1.0):
        exact = np.quantile(ns, share, method="inverted_cdf") * 1e-3
        assert exact <= whole.quantile_us(share) * (1 + 1e-9) <= exact * 2 ** (1 / 64) * (1 + 1e-9)
    assert whole.summary()["max_us"] == ns.max() * 1e-3
    assert Latencies().summary()["p99_us"] is None and Latencies().text() == "none"


# Control and profiles.


def profiles_of(tmp_path, text: str, joints=JOINTS):
    path = tmp_path / "cell.toml"
    path.write_text(text)
    return load_cell(path, joints).profiles


TWO = """
[profiles]
lowest = 0.5
highest = 3
start = "usual"
[profiles.usual]
[profiles.pressing]
contact = 3
collision = { elbow = 2.0, others = 0.5 }
"""


def test_a_profile_scales_the_limits_from_the_next_sample_on_and_is_logged(bundle, tmp_path):
    profiles = profiles_of(tmp_path, TWO)
    recording = pushed(pushes=())

    def ask(verdict):
        if verdict.row == 999:
            keeper.control.use_profile("pressing", "test")
            with pytest.raises(ConfigError, match="'none' must be one of usual, pressing"):
                keeper.control.use_profile("none", "test")

    keeper = Keeper(ask)
    loop = Loop(bundle, Replayed(recording, None), [keeper], profiles=profiles)
    switches = []
    loop.switched = switches.append
    loop.run()
    plain = _core.Monitor(bundle).run(recording.t_ns, recording.q, recording.dq, recording.tau)
    said = joined(keeper.verdicts)
    np.testing.assert_array_equal(said["limit_nm"][:1000], plain["limit_nm"][:1000])
    np.testing.assert_array_equal(said["limit_nm"][1000:], plain["limit_nm"][1000:] * [0.5, 2.0])
    np.testing.assert_array_equal(said["tau_ext"], plain["tau_ext"])
    told = [(s.t_ns, s.by, s.old, s.new) for s in switches]
    assert told == [(None, "start", "", "usual"), (int(recording.t_ns[999]), "test", "usual", "pressing")]


def test_without_profiles_there_is_none_to_change_to(bundle):
    with pytest.raises(ConfigError, match="--cell FILE"):
        Loop(bundle, ScriptedSource([])).use_profile("usual", "test")


class Spy:
    """Another object, and which of its attributes were used."""

    def __init__(self, other):
        self.used, self._other = [], other

    def __getattr__(self, name):
        self.used.append(name)
        return getattr(self._other, name)


@pytest.mark.parametrize(("what", "told_so"), [("acknowledge", "acknowledged"), ("resume", "resumed")])
def test_an_alarm_is_ended_and_the_loop_stopped_when_asked(bundle, what, told_so):
    def ask(verdict):
        if verdict.estimates["alarm"][0] == COLLISION and verdict.row == 2100:
            assert obey(f"{what}\n", keeper.control, "a line") == "ok"
        if verdict.row == 2500:
            assert obey("stop", keeper.control, "a line") == "ok"

    keeper = Keeper(ask)
    loop = Loop(bundle, Replayed(pushed(), None), [keeper])
    loop.monitor = Spy(loop.monitor)
    told = []
    loop.note = told.append
    loop.run()
    assert [name for name in loop.monitor.used if name in ("acknowledge", "resume")] == [what]
    found = [c for c in keeper.changes if isinstance(c, AlarmChange) and c.acknowledged]
    assert [c.row for c in found] == [2101] and len(keeper.verdicts) == 2501
    assert told == [f"{told_so} by a line", "stopped by a line"]


# Answers while a touch lasts.


def answered(bundle, pushes, row=1500, acknowledge_at=None, **settings) -> tuple[Loop, Keeper, list[int]]:
    """The loop of an arm that is touched for 2 s a push, and answered at this row; rows of acknowledgements."""

    def each(verdict):
        if verdict.row == row:
            keeper.control.settle(1, "touched, by page")
        if verdict.row == acknowledge_at:
            keeper.control.acknowledge("page")

    keeper = Keeper(each)
    recording = pushed(seconds=7.5, pushes=pushes, length_s=2.0)
    loop = Loop(bundle, Replayed(recording, None), [keeper], settings=LoopSettings(**settings))
    loop.told = []
    loop.note = loop.told.append
    loop.run()
    return loop, keeper, [c.row for c in keeper.changes if isinstance(c, AlarmChange) and c.acknowledged]


@pytest.mark.parametrize("push_nm", [1.5, 6.0], ids=["contact", "collision"])
def test_a_touch_that_lasts_when_it_is_answered_raises_no_second_alarm(bundle, push_nm):
    loop, keeper, ended = answered(bundle, ((1.0, 0, push_nm), (4.5, 0, push_nm)))
    assert loop.told == ["touched, by page: acknowledged once the touch is over"]
    assert loop.alarms == 2  # the second touch is another
    ids = np.array([verdict.alarm_number for verdict in keeper.verdicts])
    first = np.flatnonzero(ids == 1)
    assert 1000 < first[0] < 1100 and len(first) == first[-1] + 1 - first[0] and 3000 < first[-1] < 3600
    finder = EventFinder(loop.joints, {})
    events = [event.kind for verdict in keeper.whole[:4400] for event in finder.find(verdict) if event.news]
    assert events.count("cleared") == 1 and events[-1] == "cleared"  # not while it is touched
    if push_nm > 5:  # latched, so that nothing but the answer ends it
        over = np.array([np.abs(verdict.estimates["tau_ext"][0]).max() > 1.0 for verdict in keeper.verdicts])
        assert ended == [np.flatnonzero(over[:4000])[-1] + 51] == [first[-1] + 1]  # 50 ms: its contact_release_s


def test_a_touch_that_is_over_is_acknowledged_at_once(bundle):
    loop, _, ended = answered(bundle, ((1.0, 0, 6.0),), row=4000)
    assert ended == [4001] and loop.told == ["touched, by page: acknowledged"] and loop.alarms == 1


@pytest.mark.parametrize(("push_nm", "due"), [(1.5, 2500), (6.0, 2000)], ids=["contact", "collision"])
def test_an_answered_touch_that_does_not_end_becomes_another_alarm_when_it_is_due(bundle, push_nm, due):
    """A contact counts from its answer, a collision from its alarm."""
    loop, keeper, ended = answered(bundle, ((1.0, 0, push_nm),), acknowledge_after_s=1.0)
    assert due <= ended[0] < due + 100
    again = next(v.row for v in keeper.verdicts if v.alarm_number == 2)
    assert again - ended[0] < 400 and loop.alarms >= 2


def test_acknowledge_waits_for_no_touch(bundle):
    loop, _, ended = answered(bundle, ((1.0, 0, 6.0),), acknowledge_at=1600)
    assert ended == [1601] and loop.alarms == 2  # the touch lasts, and nobody has answered the second alarm


def test_lines_that_ask_for_nothing_known_are_answered():
    usage = "`profile NAME`, `acknowledge`, `resume`, `load mass=KG com=X,Y,Z`, `load none`, "
    usage += "`expect seconds=S at_most=KG`, `contact PHASE seconds=S`, `contact none`, "
    usage += "`contact frame=NAME axis=X,Y,Z half_angle_deg=A at_most_n=N seconds=S`, "
    usage += "`weigh [report|stop]`, `touched [ALARM]`, `nothing [ALARM]`, `learn yes|no`, `sim COMMAND` or `stop`"
    assert obey("sing", None, "x") == f"error: 'sing' must be {usage}"
    assert obey("profile", None, "x").startswith("error:") and obey("stop now", None, "x").startswith("error:")


def test_a_socket_obeys_lines_and_is_gone_afterwards(bundle, tmp_path):
    import socket

    class Asked:
        def use_profile(self, name, by):
            asked.append((name, by))

    asked, path = [], tmp_path / "control"
    path.touch()
    with pytest.raises(ConfigError, match="no control socket"):
        ControlSocket(path, Asked())  # a file that is none stays
    path.unlink()
    listening = ControlSocket(path, Asked())
    with pytest.raises(ConfigError, match="no control socket"):
        ControlSocket(path, Asked())  # another monitor's
    with socket.socket(socket.AF_UNIX) as caller:
        caller.connect(str(path))
        with caller.makefile("rw") as lines:
            lines.write("profile two words\nsing\nprofile a\rstop\nprofile b\r\n")
            lines.flush()
            assert lines.readline() == "ok\n" and lines.readline().startswith("error: 'sing'")
            assert (
                lines.readline() == "error: 'profile a\\rstop' must be printable text\n" and lines.readline() == "ok\n"
            )
    listening.close()
    # Only a line feed ends a line: no second command hides behind a carriage return.
    assert asked == [(name, "control socket") for name in ("two words", "b")] and not path.exists()


class Recorded:
    """A control that takes every request; its answer to the profile `none` has characters that act on a terminal."""

    def __init__(self):
        self.requests = []

    def use_profile(self, name, by):
        if name == "none":
            raise ConfigError("no profile \x1b[2J\r\nof this name")
        self.requests.append((name, by))

    def __getattr__(self, name):
        return lambda *values: self.requests.append((name, *values))


@pytest.mark.parametrize("number", ["1_0", "\u0663", "inf", "-inf", "nan", "1e999", "0x10", "\u00b2", "--1"])
@pytest.mark.parametrize(
    "line",
    [
        "load mass={}",
        "load mass=1 com=0,{},0",
        "load mass=1 ago={}",
        "expect seconds={} at_most=2",
        "expect seconds=1 at_most={}",
        "contact sanding seconds={}",
        "contact frame=tool0 axis=0,0,{} at_most_n=5 seconds=1",
        "contact frame=tool0 at_most_n={} seconds=1",
        "weigh reach={}",
        "touched {}7",
    ],
)
def test_a_control_line_takes_plain_numbers_alone(line, number):
    """Python's own float() takes underlines, digits of other scripts, infinity and NaN."""
    control = Recorded()
    assert obey(line.format("1"), control, "test") == "ok" and len(control.requests) == 1
    assert obey(line.format(number), control, "test").startswith("error: ") and len(control.requests) == 1


@pytest.mark.parametrize("text", ["-0.5", "+2", ".5", "2.", "1e-3", "1E3", "0"])
def test_plain_numbers_are_those_of_python(text):
    assert number_of(text) == float(text)


@pytest.mark.parametrize(
    "line",
    [
        "profile \x1b]0;x\x07",
        "profile a\x00",
        "touched \x1b[31m",
        "sim \x9b1m",
        "\u202eprofile a",
        "profile none",
        "\x1b",
    ],
)
def test_answers_hold_no_characters_that_act_on_a_terminal(line):
    control = Recorded()
    answer = obey(line, control, "test")
    assert answer.startswith("error: ") and answer.isprintable() and not control.requests


def test_notes_are_printed_without_characters_that_act_on_a_terminal(capsys):
    TextLines(None).note("stopped by \x1b[2Jx")
    assert capsys.readouterr().out.strip() == "stopped by \\x1b[2Jx"


# --- `tauext send`.


def test_send_prints_the_answer_of_a_monitor_and_refusals_end_with_two(tmp_path, capsys):
    control, path = Recorded(), tmp_path / "control"
    listening = ControlSocket(path, control)
    try:
        assert run_command(capsys, "send", path, "profile", "two", "words") == (0, "ok\n", "")
        assert run_command(capsys, "send", path, "acknowledge") == (0, "ok\n", "")
        assert control.requests == [("two words", "control socket"), ("acknowledge", "control socket")]
        code, printed, error = run_command(capsys, "send", path, "sing")
        assert code == 2 and printed == "" and error.startswith("tauext: error: 'sing' must be `profile NAME`")
        for words, why in (
            (("profile", "a\nstop"), "must be one line of at most 999 printable characters"),
            (("profile", "a" * 1000), "must be one line"),
            ((), "the line is missing"),
            (("stop", "--timeout-s", "0"), "must be > 0"),
        ):
            code, printed, error = run_command(capsys, "send", path, *words)
            assert code == 2 and printed == "" and why in error and error.count("\n") == 1
    finally:
        listening.close()
    assert len(control.requests) == 2


def test_send_ends_with_two_where_nobody_listens_or_answers(tmp_path, capsys):
    path = tmp_path / "control"
    deaf = listen_at(path)
    code, _, error = run_command(capsys, "send", path, "stop", "--timeout-s", "0.05")
    assert code == 2 and "no answer within 0.05 s; the monitor may still execute the line" in error
    deaf.close()
    (tmp_path / "file").write_text("x")
    (tmp_path / "empty").mkdir()
    for to, why in (
        (path, "no monitor listens at this socket (Connection refused)"),
        (tmp_path / "file", "no monitor listens at this socket"),
        (tmp_path / "missing", "no monitor listens at this socket (No such file or directory)"),
        (tmp_path / ("x" * 200), "no monitor listens at this socket"),
        (tmp_path / "empty", "is no socket, and no folder of `tauext commission`"),
    ):
        code, printed, error = run_command(capsys, "send", to, "stop")
        assert (code, printed, error.count("\n")) == (2, "", 1) and why in error


@pytest.mark.parametrize(
    "change, message",
    [
        (("highest = 3", "highest = 11"), r"\[profiles\] highest = 11 must be a number from 1 to 10"),
        (("lowest = 0.5", "lowest = 0.05"), r"\[profiles\] lowest = 0.05 must be a number from 0.1 to 1"),
        (("lowest = 0.5", ""), r"\[profiles\] lowest is missing"),
        (("contact = 3", "contact = 3.01"), r"\[profiles.pressing\] contact = 3.01 must be a number from 0.5 to 3"),
        (("contact = 3", "contact = nan"), r"contact = nan must be a number"),
        (("contact = 3", 'contact = "3"'), r"contact = '3' must be a number"),
        (("elbow = 2.0", "elbow = 9"), r"\[profiles.pressing.collision\] elbow = 9.0 must be a number from 0.5 to 3"),
        (
            ("elbow = 2.0", "wrist = 2"),
            r"\[profiles.pressing.collision\] unknown key 'wrist'; .*; known are shoulder, elbow, others",
        ),
        (("contact = 3", "contcat = 3"), r"\[profiles.pressing\] unknown key 'contcat'; the nearest"),
        (('start = "usual"', 'start = "none"'), r"\[profiles\] start = 'none' must be one of usual, pressing"),
        (("[profiles]", "[profiles"), "not readable as TOML"),
    ],
)
def test_a_profiles_file_that_breaks_a_rule_says_which(tmp_path, change, message):
    assert change[0] in TWO
    with pytest.raises(ConfigError, match=message):
        profiles_of(tmp_path, TWO.replace(*change))


def test_the_core_refuses_factors_out_of_its_bounds(bundle):
    monitor = _core.Monitor(bundle)
    for bad in ([0.05, 1.0], [1.0, 11.0], [np.nan, 1.0], [1.0]):
        with pytest.raises(TauextError, match=r"must be \(2,\)|factors must be 2 numbers"):
            monitor.set_limit_factors(np.array(bad), np.ones(2))


# Flights and recordings.


def test_flights_of_a_live_loop_are_written_with_the_profile_s_limits(bundle, tmp_path):
    profiles = profiles_of(tmp_path, TWO.replace('"usual"', '"pressing"'))
    recorder = _core.FlightRecorder(2, 1_000_000, 1.0, 0.2, True)
    sink = FlightSink(tmp_path, bundle, recorder, "script 1/2")
    recording = pushed(pushes=((2.0, 1, -4.5),))
    looped(bundle, ReplaySource(recording, None), sink, profiles=profiles, recorder=recorder)
    (news,) = sink.news()
    assert (news.what, news.number, news.error) == ("contact", 1, None)
    assert news.path.name.startswith("script-1-2-2.0")
    text = news.path.with_suffix(".txt").read_text()
    assert "over its contact threshold of 3.000 Nm" in text  # 1 Nm times 3
    flight = load_recording(news.path)
    assert flight.provenance["command"] == "tauext monitor" and flight.provenance["event"]["number"] == 1
    row = int(np.searchsorted(recording.t_ns, flight.t_ns[0]))
    np.testing.assert_array_equal(flight.q, recording.q[row : row + flight.samples])


def test_a_gap_in_a_live_loop_has_a_flight(bundle, tmp_path):
    everything = samples_of(pushed(pushes=()))
    recorder = _core.FlightRecorder(2, 1_000_000, 1.0, 0.01)
    sink = FlightSink(tmp_path, bundle, recorder, "script")
    script = [*everything[:1000], lambda: loop.missing >= 20, *everything[1500:1600]]
    loop = Loop(bundle, ScriptedSource(script), [sink], recorder=recorder)
    loop.run()
    (news,) = sink.news()
    assert (news.what, news.number) == ("fault", 0) and "gap" in news.path.with_suffix(".txt").read_text()


def test_recordings_hold_what_came_and_the_monitor_s_word_of_contact(bundle, tmp_path):
    recording = pushed()
    samples = samples_of(recording)
    bad = recording.q[700] * np.nan
    script = [*samples[:700], samples[700].__class__(samples[700].t_ns, bad, bad, bad, 0), samples[650], *samples[701:]]
    sink = RecordSink(tmp_path / "kept", settings_of(bundle), "script", 2.5, lambda: bundle.name)
    _, keeper = looped(bundle, ScriptedSource(script), sink)
    assert (sink.count.files, sink.count.samples, sink.count.unfit, sink.count.lost) == (3, 5999, 2, 0)
    parts = [load_recording(path) for path in sorted((tmp_path / "kept").iterdir())]
    kept = np.delete(np.arange(6000), 700)
    for signal in ("t_ns", "q", "dq", "tau"):
        whole = np.concatenate([getattr(part, signal) for part in parts])
        np.testing.assert_array_equal(whole, getattr(recording, signal)[kept], err_msg=signal)
    said = joined([v for v in keeper.verdicts if v.row not in (700, 701)])
    contact = np.where(said["alarm"] > 0, 1, np.where(said["health"] == OK, 0, -1))
    np.testing.assert_array_equal(np.concatenate([part.contact for part in parts]), contact)
    assert parts[0].provenance["bundle"] == "watching" and parts[0].torque_timing == "held"


WRONG_SIZES = ((1500, "q", 1), (1501, "dq", 3), (1502, "tau", 0), (1503, "q", 3))


def with_wrong_sizes(samples: list[Sample]) -> list[Sample]:
    for row, name, size in WRONG_SIZES:
        samples[row] = replace(samples[row], **{name: np.zeros(size)})
    return samples


def test_a_sample_of_the_wrong_size_is_a_fault_and_the_next_good_one_restarts(bundle, tmp_path):
    """As docs/loop.md promises: one joint too few or too many does not end the monitor."""
    recording = pushed(pushes=((3.5, 0, 20.0),))
    kept = RecordSink(tmp_path / "kept", settings_of(bundle), "script", 60.0, lambda: bundle.name)
    recorder = _core.FlightRecorder(2, 1_000_000, 0.5, 0.01)
    flights = FlightSink(tmp_path, bundle, recorder, "script")
    script = with_wrong_sizes(samples_of(recording, slice(0, 4000)))
    loop, keeper = looped(bundle, ScriptedSource(script), kept, flights, recorder=recorder)
    said = joined(keeper.verdicts)
    assert loop.told == [] and len(keeper.verdicts) == 4000
    assert (said["health"][1500:1504] == FAULT).all() and (said["health"][[1499, 3000]] == OK).all()
    assert {tuple(_core.cause_names(int(cause))) for cause in said["causes"][1500:1504]} == {("wrong size",)}
    assert not (said["health"][1504:] == FAULT).any() and COLLISION in said["alarm"][3500:]  # the push is found
    assert all(np.isnan(one.sample.q).all() and one.sample.q.shape == (2,) for one in keeper.verdicts[1500:1504])
    assert (kept.count.unfit, kept.count.lost) == (4, 0)
    assert "wrong size" in next(iter(flights.news())).path.with_suffix(".txt").read_text()


def test_a_sample_of_the_wrong_size_is_a_fault_before_there_is_a_bundle(bundle):
    script = with_wrong_sizes(samples_of(pushed(), slice(0, 1600)))
    keeper = Keeper()
    Loop(None, ScriptedSource(script), [keeper], arm=settings_of(bundle)).run()
    health = joined(keeper.verdicts)["health"]
    assert (health[1500:1504] == FAULT).all() and FAULT not in (*health[:1500], *health[1504:])


def test_every_signal_of_a_block_has_a_value_for_each_joint():
    good = samples_of(pushed(), slice(0, 1))[0]
    for name in ("q", "dq", "tau", "temperature", "q_des", "current", "duty", "voltage"):
        other = replace(good, **{name: np.ones(2)})
        for wrong in (np.zeros(1), np.zeros(3), np.zeros((1, 2)), np.zeros(()), np.float64(1.0)):
            bad = replace(good, **{name: wrong})
            blocks = list(blocks_of([good, other, other, bad, bad, good], 2))
            rest = [(len(block), is_sized) for block, is_sized in blocks][-2:]
            assert rest == [(2, False), (1, True)] and np.isnan(blocks[-2][0].q).all(), name
            assert sum(len(block) for block, _ in blocks) == 6 and (getattr(blocks[-3][0], name)[-1] == 1).all()


def test_recordings_of_currents_stay_currents(tmp_path):
    recording = pushed(seconds=1.0, pushes=((0.5, 0, 3.0),))
    bundle = taking_amperes(watching_bundle(), np.array([2.0, -0.5]))
    sink = RecordSink(tmp_path, settings_of(bundle), "script")
    looped(bundle, ScriptedSource(samples_of(recording)), sink)
    kept = load_recording(next(tmp_path.iterdir()))
    np.testing.assert_array_equal(kept.tau, recording.tau)
    assert in_amperes([kept])  # training finds their constants anew


@pytest.mark.parametrize(("unit", "constant"), [("A", "unknown"), ("Nm", ())])
def test_a_new_description_of_a_monitor_s_recordings_has_what_they_state(unit, constant, tmp_path, capsys):
    recording, bundle = pushed(seconds=12.0, pushes=()), watching_bundle()
    if unit == "A":
        bundle = taking_amperes(bundle, np.array([2.0, -0.5]))
    looped(bundle, ScriptedSource(samples_of(recording)), RecordSink(tmp_path, settings_of(bundle), "script"))
    (written,) = tmp_path.iterdir()
    metadata = pq.read_schema(written).metadata
    assert json.loads(metadata[b"units"])["tau"] == {"A": "A", "Nm": "N m"}[unit]
    arm = tmp_path / "arm.toml"
    assert run_command(capsys, "import", "--new", arm, "--source", written)[0] == 0
    described = load_arm(arm)  # nothing is left to confirm
    tau = described.signals["tau"]
    assert (tau.unit, tau.torque_constant, tau.timing) == (unit, constant, "held")
    assert described.robot.joints == JOINTS
    arm.write_text(f'{arm.read_text()}\n[split]\ntrain = ["{written.name}"]\n')
    code, _, err = run_command(capsys, "import", "--arm", arm, "--source", written, "--out", tmp_path / "data")
    assert code == 0, err
    for one in map(load_recording, (tmp_path / "data").glob("*.parquet")):
        expect_fit(bundle, one)
        np.testing.assert_array_equal(one.tau, recording.tau[np.isin(recording.t_ns, one.t_ns)])


def test_a_new_description_takes_joints_of_any_name_from_the_recording(tmp_path, capsys):
    """Names that elsewhere are goals, units, axes or sides of a gear."""
    for joints in (("d", "des"), ("x", "y"), ("motor", "link"), ("rad", "deg"), ("1", "2")):
        path, arm = tmp_path / f"{joints[0]}.parquet", tmp_path / f"{joints[0]}.toml"
        save_recording(replace(pushed(seconds=0.1, pushes=()), joints=joints), path)
        assert run_command(capsys, "import", "--new", arm, "--source", path)[0] == 0
        assert load_arm(arm).robot.joints == joints


def test_a_new_description_of_computed_torques_asks_for_the_servos_settings(tmp_path, capsys):
    recording = pushed(seconds=0.1, pushes=())
    for name in ("supply-current", "torque"):
        settings = _core.ServoSettings(
            getattr(_core.TorqueFrom, name.replace("-", "_")), [_core.ServoConstants()] * 2, 10, 1_000_000
        )
        facts = {"servo": servo_facts(settings)}
        path, arm = tmp_path / f"{name}.parquet", tmp_path / f"{name}.toml"
        save_recording(replace(recording, current=recording.tau, q_des=recording.q, provenance=facts), path)
        assert run_command(capsys, "import", "--new", arm, "--source", path)[0] == 0
        described = tomllib.loads(arm.read_text())
        assert described["servo"]["torque_from"] == f"?{name}"
        assert ("tau" in described["signals"]) == (name == "torque")
        assert described["signals"]["dq"]["columns"] == ""


def test_a_name_of_a_source_becomes_one_of_a_file():
    assert file_name("ur 10.0.0.2") == "ur-10.0.0.2" and file_name("../x") == "x" and file_name("//") == "live"
