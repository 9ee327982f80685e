"""Time that was monitored: counted against a timeline made by hand, in a loop, in the folder and in words."""

import math
import os
import socket

import numpy as np
import pytest
from made_bundles import pushed, watching_bundle
from made_commission import add_event
from made_live import Clock, Keeper, ScriptedSource, samples_of
from tauext_commission.budget import Promise
from tauext_commission.connect import held_rate
from tauext_commission.folder import CommissionFolder
from tauext_commission.history import Kept, describe_folder, kept_of
from tauext_commission.history_file import monitored_of
from tauext_commission.motion_recorder import MotionRecorder

from tauext import _core
from tauext.bundle.estimates import OK
from tauext.data.labels import Label
from tauext.monitor.control_lines import ControlSocket
from tauext.monitor.latency import how_to_hold_the_rate
from tauext.monitor.loop import Loop
from tauext.monitor.monitored_time import (
    CAME_LATE,
    LATE_S,
    Monitored,
    MonitoredNews,
    MonitoredTime,
    blind_words,
    percent,
)
from tauext.monitor.record_sink import FlightSink
from tauext.monitor.sink import LoopReport
from tauext.monitor.source import SourceCounts, settings_of


@pytest.mark.parametrize("seed", range(3))
def test_the_shares_are_those_of_the_timeline(seed):
    """Waits, faults and late answers at random, for over an hour; NumPy sums the same intervals."""
    rng = np.random.default_rng(seed)
    wait_s = rng.choice([0.01, 0.015, 0.2, 0.7], 60_000, p=[0.5, 0.3, 0.12, 0.08])
    valid, age_s = rng.random(len(wait_s)) < 0.9, rng.choice([0.001, 2 * LATE_S], len(wait_s), p=[0.95, 0.05])
    at_ns = np.cumsum(np.round(wait_s * 1e9)).astype(np.int64)
    valid[0] = True
    watched, second_ns, closed = MonitoredTime(0.003), 0, 0
    for k, now_ns in enumerate(at_ns.tolist()):
        watched.add(now_ns, valid[k] and age_s[k] <= LATE_S)
        if now_ns - second_ns > 1e9:
            found, second_ns, closed = watched.second(), now_ns, k
    good = valid & (wait_s <= LATE_S) & (age_s <= LATE_S)
    spans = slice(1, closed + 1)  # the count begins with the first valid estimate
    assert found.seconds == pytest.approx((wait_s * good)[spans].sum(), abs=1e-6)
    assert found.of_seconds == pytest.approx(wait_s[spans].sum(), abs=1e-6)
    for share, span_s in ((found.minute, 60), (found.hour, 3600)):
        inside = spans.start + np.flatnonzero(at_ns[spans] > at_ns[closed] - span_s * 1e9)
        assert share == pytest.approx((wait_s * good)[inside].sum() / wait_s[inside].sum(), abs=0.03)
    assert found.why == CAME_LATE and found.level == 2


def test_nothing_counts_before_the_first_estimate_and_no_share_is_stated_at_once():
    watched = MonitoredTime(0.003)
    for k in range(5000):
        watched.add(k * 1_000_000, False)
    assert watched.second() == Monitored() or math.isnan(watched.second().minute)
    for k in range(5000, 9000):
        watched.add(k * 1_000_000, True)
    found = watched.second()
    assert math.isnan(found.minute) and found.level == 0 and found.of_seconds == pytest.approx(3.999)


def test_a_loop_counts_gaps_and_faults(monkeypatch):
    clock = Clock()
    monkeypatch.setattr("tauext.monitor.loop.time", clock)
    everything = samples_of(pushed(pushes=()))
    keeper = Keeper()

    def pause(seconds):
        """Samples come one after the other; before this one, none for so long."""
        until_ns: list[int] = []

        def over():
            until_ns or until_ns.append(clock.monotonic_ns() + round(seconds * 1e9))
            return clock.monotonic_ns() >= until_ns[0]

        return over

    script = []
    for k, one in enumerate(everything[:3000]):
        script += [pause(1.5) if k == 1500 else lambda: clock.sleep(1e-3) or True, one]
    loop = Loop(watching_bundle(), ScriptedSource(script, clock), [keeper])
    loop.run()
    ok = np.array([one.estimates["health"][0] == OK for one in keeper.verdicts if one.sample is not None])
    begun, found = int(np.argmax(ok)), loop.monitored
    assert found.of_seconds == pytest.approx(1e-3 * (3000 - begun) + 1.5, abs=0.01)
    blind_s = 1.5 + 1e-3 * (~ok[begun:]).sum()  # the gap, and the warm-up of the observer after it
    assert found.of_seconds - found.seconds == pytest.approx(blind_s, abs=0.01)
    watched = MonitoredTime(0.003)
    watched.add(0, True)
    watched.add(10**9, False, 1)  # bit 0 of the causes
    assert watched.second().why == _core.cause_names(1)[0] and watched.second().why == "not finite"


def test_lines_come_on_change_and_seldom_however_it_flickers():
    news, lines = MonitoredNews("close other programs"), []
    for second in range(3600):
        share = 0.985 if second % 7 < 3 else 0.995
        if line := news.line(float(second), Monitored(share, why=CAME_LATE)):
            lines.append((second, line))
    assert 1 <= len(lines) <= 6 and lines[0][0] == 0
    words = "only 98.5 % of the last minute was monitored: samples came late or not at all; close other programs"
    assert lines[0][1] == words
    news = MonitoredNews("")
    levels = [(0, 0.985), (1, 0.5), (2, 0.97), (3, 1.0), (70, 1.0), (80, 0.98)]
    found = [(at, line) for at, share in levels if (line := news.line(at, Monitored(share, why="gap")))]
    assert [at for at, _ in found] == [0, 1, 70]
    assert found[1][1] == "ONLY 50.0 % OF THE LAST MINUTE WAS MONITORED: gap"
    assert found[2][1] == "monitored 100 % of the last minute again"
    assert percent(0.99999) == "99.9 %" and blind_words(Monitored(0.98, why="x"), "close").endswith(": x")


def test_faults_of_one_cause_are_one_flight_a_minute(tmp_path):
    everything = samples_of(pushed(pushes=()))
    recorder = _core.FlightRecorder(2, 1_000_000, 0.2, 0.01)
    sink = FlightSink(tmp_path, watching_bundle(), recorder, "script")
    script = []
    for k in range(5):
        script += [*everything[600 * k : 600 * k + 500], lambda n=20 * (k + 1): loop.missing >= n]
    loop = Loop(watching_bundle(), ScriptedSource([*script, *everything[3000:3100]]), [sink], recorder=recorder)
    loop.run()
    assert len(sink.news()) == 1 and sink.repeated == 4 and len(list(tmp_path.glob("*.txt"))) == 1


def report(seconds, of_seconds, hour=math.nan):
    return LoopReport(0, 0, 0, 0.0, SourceCounts(), 0, 0, 0, "", Monitored(hour, hour, seconds, of_seconds))


def test_the_promise_counts_monitored_hours_only_also_after_a_restart(tmp_path):
    folder = CommissionFolder.open(tmp_path / "cell", create=True)
    folder.note("exchange", 0.0, "b0001 monitors", bundle="b0001")
    arm = settings_of(watching_bundle())
    for _ in range(2):
        sink = MotionRecorder(folder, arm, "script", 1e9, lambda: "b0001")
        sink.open(arm.joints, None)
        sink.every_second(report(900.0 * 0.4, 900.0))
        sink.every_second(report(1800.0 * 0.9, 1800.0, 0.905))
        sink._tidy()
        sink.close()
    add_event(folder, id=1, level="collision", bundle="b0001")
    folder.append_label(Label(1, 1, 0, 0, "nothing", "page", "", "b0001"))
    assert monitored_of(folder.coverage()) == {"b0001": (3240.0, 3600.0)}
    found = kept_of(folder.path, "b0001", 7200.0)
    assert (found.hours, found.of_hours, found.false) == (0.9, 1.0, 1)
    shown = describe_folder(folder.path)
    assert shown["monitored"] == "90.0 % of 1 h in all"
    words = Kept("b0001", Promise(1.0, 1.0), 0.9, (), 0, 1.0).words()
    assert words.endswith("Counted: 0 false alarms in 54 minutes (monitored 90.0 % of 1 h): kept."), words
    folder.coverage_file.write_text("{")  # the received time of the history remains
    assert kept_of(folder.path, "b0001", 7200.0).hours == 2.0


def test_damaged_sums_are_left_out():
    entries = {"b1": [1, 2], "b2": [3, 2], "b3": None, "b4": ["x", 1], "b5": [math.nan, 1], "b6": [1]}
    assert monitored_of({"monitored": entries}) == {"b1": (1.0, 2.0)}
    assert monitored_of({"monitored": 3}) == monitored_of(None) == {}


def test_the_first_check_reports_a_computer_that_is_too_slow(monkeypatch):
    (good,) = held_rate(Monitored(seconds=3.0, of_seconds=3.0), 1000.0, "")
    assert (good.severity, good.words) == ("good", "this computer holds the rate of 1000 samples a second")
    (slow,) = held_rate(Monitored(seconds=2.4, of_seconds=3.0), 1000.0, "close other programs")
    assert (slow.severity, slow.remedy) == ("warning", "close other programs") and "only 80.0 %" in slow.words
    assert held_rate(Monitored(seconds=0.1, of_seconds=0.2), 1000.0, "") == []
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: {0, 3})
    assert how_to_hold_the_rate(None, None) == "close other programs, or start with --core 3 --priority 50"
    assert how_to_hold_the_rate(3, 50) == "close other programs"


def test_lines_of_a_known_process_have_its_name(tmp_path):
    by: list[str] = []

    class Listener:
        def acknowledge(self, origin):
            by.append(origin)

    names = {os.getpid(): "page"}
    control = ControlSocket(tmp_path / "c.sock", Listener(), lambda process: names.get(process, "control socket"))
    try:
        for _ in range(2):
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as wire:
                wire.connect(str(tmp_path / "c.sock"))
                wire.sendall(b"acknowledge\n")
                assert wire.recv(10) == b"ok\n"
            names.clear()
    finally:
        control.close()
    assert by == ["page", "control socket"]
