"""Sources keep one contract; those of robots against stand-ins that have the functions of the real libraries."""

from __future__ import annotations

import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
from made_arms import prismatic_mass
from made_bundles import JOINTS, pushed
from made_live import AllAtOnce, Keeper, samples_of

from tauext import _core
from tauext.config import ObserverConfig
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.monitor.loop import Loop
from tauext.monitor.source import SourceSettings
from tauext.sources.franka import FrankaSource
from tauext.sources.replay import ReplaySource
from tauext.sources.ur import UrSource

UR_JOINTS = ("base", "shoulder", "elbow", "wrist_1", "wrist_2", "wrist_3")
FRANKA_JOINTS = tuple(f"joint{k}" for k in range(1, 8))
CONSTANTS = {name: 2.0 + k for k, name in enumerate(UR_JOINTS)}


@pytest.fixture
def constants(tmp_path):
    path = tmp_path / "constants.toml"
    path.write_text("[nm_per_ampere]\n" + "".join(f"{name} = {value}\n" for name, value in CONSTANTS.items()))
    return path


@pytest.fixture(params=["replay", "script", "ur", "franka"])
def any_source(request):
    """A source that is not open, what it is opened with, and the torque of its packet 0 over that of a sample."""
    if request.param in ("ur", "franka"):
        arm = request.getfixturevalue(request.param)
        if request.param == "ur":
            file = request.getfixturevalue("constants")
            return UrSource("10.0.0.2", file), SourceSettings(UR_JOINTS, 2_000_000), arm
        return FrankaSource("10.0.0.3"), SourceSettings(FRANKA_JOINTS, 1_000_000), arm
    recording = pushed(seconds=0.2)
    source = ReplaySource(recording, None) if request.param == "replay" else AllAtOnce(samples_of(recording))
    return source, SourceSettings(JOINTS, 1_000_000), None


def taken(source, count: int) -> list:
    found = []
    while len(found) < count:
        sample = source.next_sample(5.0)
        assert sample is not None
        found.append(sample)
    return found


def test_every_source_keeps_the_contract(any_source):
    source, settings, _ = any_source
    source.open(settings)
    try:
        before = time.monotonic_ns()
        samples = taken(source, 20)
        for one in samples:
            assert isinstance(one.t_ns, int) and one.received_ns <= time.monotonic_ns()
            for signal in (one.q, one.dq, one.tau):
                assert signal.shape == (len(settings.joints),) and signal.dtype == np.float64
        assert samples[-1].received_ns >= before
        stamps = [one.t_ns for one in samples]
        assert sorted(set(stamps)) == stamps and isinstance(source.name, str)
        assert source.notes() == [] and not source.ended
        assert source.counts.lost == source.counts.overrun == source.counts.refused == 0
    finally:
        source.close()
        source.close()


def test_ur_sends_positions_velocities_and_currents_times_constants(ur, constants):
    source = UrSource("10.0.0.2", constants)
    source.open(SourceSettings(UR_JOINTS, 2_000_000))
    try:
        (one,) = taken(source, 1)
    finally:
        source.close()
    k = round((one.t_ns - 100_000_000_000) / 2_000_000)
    np.testing.assert_array_equal(one.q, ur.signal(1, k))
    np.testing.assert_array_equal(one.dq, ur.signal(2, k))
    np.testing.assert_allclose(one.tau, np.array(ur.signal(3, k)) * list(CONSTANTS.values()), rtol=1e-15)
    np.testing.assert_array_equal(one.temperature, ur.signal(4, k))
    assert ur.asked == {
        "hostname": "10.0.0.2",
        "frequency": 500.0,
        "variables": ["timestamp", "actual_q", "actual_qd", "actual_current", "joint_temperatures"],
    }


def test_a_sample_of_ur_is_never_torn_between_two_packets(ur, constants):
    ur.torn = True
    source = UrSource("10.0.0.2", constants)
    source.open(SourceSettings(UR_JOINTS, 2_000_000))
    try:
        for one in taken(source, 50):
            k = round((one.t_ns - 100_000_000_000) / 2_000_000)
            assert (one.q[0], one.dq[0]) == (ur.signal(1, k)[0], ur.signal(2, k)[0])
    finally:
        source.close()
    assert source.counts.lost > 0  # packets that were overtaken


def test_franka_sends_measured_torques_and_keeps_its_own_estimate_beside(franka):
    source = FrankaSource("10.0.0.3")
    source.open(SourceSettings(FRANKA_JOINTS, 1_000_000))
    try:
        one = taken(source, 1)[0]
        source.stop()
    finally:
        source.close()
    k = round((one.t_ns - 100_000_000_000) / 1_000_000)
    for which, signal in ((1, one.q), (2, one.dq), (3, one.tau)):
        np.testing.assert_array_equal(signal, franka.signal(which, k))
    t_ns, reference = source.reference[0]
    assert t_ns == one.t_ns and reference.tolist() == franka.signal(4, k)
    assert franka.asked == {"host": "10.0.0.3", "config": "ignore"} and franka.stopped == 1


@pytest.mark.parametrize("kind", ["ur", "franka"])
def test_a_robot_that_goes_is_waited_for_and_connected_anew(kind, request, constants, monkeypatch):
    monkeypatch.setattr("tauext.sources.reader.RETRY_S", 0.01)
    arm = request.getfixturevalue(kind)
    source = UrSource("h", constants) if kind == "ur" else FrankaSource("h")
    joints, period_ns = (UR_JOINTS, 2_000_000) if kind == "ur" else (FRANKA_JOINTS, 1_000_000)
    source.open(SourceSettings(joints, period_ns))
    try:
        taken(source, 3)
        arm.reachable = False
        while source.next_sample(0.05) is not None:
            pass
        gone = source.notes()
        lost = source.counts.lost
        arm.number += 100_000
        arm.reachable = True
        taken(source, 3)
        assert "is disconnected: " in gone[0] and "reconnecting" in gone[0] and not source.ended
        assert source.notes() == [f"{source.name} is reconnected"]
        assert arm.connections == 2 and source.counts.lost == lost  # while it was away nothing was sent
    finally:
        source.close()


@pytest.mark.parametrize("kind", ["ur", "franka"])
def test_a_library_that_breaks_ends_the_source_and_says_so(kind, request, constants, monkeypatch):
    request.getfixturevalue(kind)
    source = UrSource("h", constants) if kind == "ur" else FrankaSource("h")
    joints, period_ns = (UR_JOINTS, 2_000_000) if kind == "ur" else (FRANKA_JOINTS, 1_000_000)
    broken = threading.Event()

    def read(self):
        broken.set()
        raise ZeroDivisionError("theirs")

    monkeypatch.setattr(type(source), "read", read)
    source.open(SourceSettings(joints, period_ns))
    assert broken.wait(20) and source.next_sample(20.0) is None and source.ended
    assert source.notes() == [f"{source.name} cannot be read: ZeroDivisionError: theirs"]
    source.close()


def test_what_cannot_fit_is_refused(ur, franka, constants):
    six, seven = SourceSettings(UR_JOINTS, 2_000_000), SourceSettings(FRANKA_JOINTS, 1_000_000)
    own = SourceSettings(UR_JOINTS, 2_000_000, torque_units=("A",) * 6)
    for source, settings, message in (
        (UrSource("h", constants), SourceSettings(("a", "b"), 2_000_000), "must not|is missing|unknown key"),
        (UrSource("h"), six, "sends motor currents, the bundle takes N m: --torque-constants FILE"),
        (UrSource("h", constants), own, "the bundle takes amperes, as they come"),
        (FrankaSource("h"), six, "sends 1000 samples a second, the bundle takes 500"),
        (FrankaSource("h"), SourceSettings(UR_JOINTS, 1_000_000), "has 7 joints, the bundle 6"),
    ):
        with pytest.raises(ConfigError, match=message):
            source.open(settings)
    ur.reachable = franka.reachable = False
    with pytest.raises(ConfigError, match="ur h: Timeout connecting to UR"):
        UrSource("h", constants).open(six)
    with pytest.raises(ConfigError, match="franka h: libfranka: Connection timeout"):
        FrankaSource("h").open(seven)


def test_a_library_that_is_not_installed_is_named_as_pip_finds_it(monkeypatch, constants):
    for module in ("rtde_receive", "pylibfranka"):
        monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ConfigError, match=r"source ur needs ur_rtde: pip install 'ur_rtde'"):
        UrSource("h", constants).open(SourceSettings(UR_JOINTS, 2_000_000))
    with pytest.raises(ConfigError, match=r"pip install 'pylibfranka'"):
        FrankaSource("h").open(SourceSettings(FRANKA_JOINTS, 1_000_000))


def test_a_replay_waits_for_its_time_and_loses_nothing(monkeypatch):
    now, slept = [5.0], []

    def sleep(seconds):
        slept.append(seconds)
        now[0] += seconds

    own = SimpleNamespace(sleep=sleep, monotonic_ns=time.monotonic_ns)  # other threads go on sleeping
    monkeypatch.setattr("tauext.sources.replay.time", own)
    source = ReplaySource(pushed(seconds=1.0), 2.0)
    source._pace._clock, source._pace._sleep = (lambda: now[0]), sleep
    source.open(SourceSettings(JOINTS, 1_000_000))
    first = source.next_sample(0.1)
    assert first.t_ns == 7_000_000_000 and slept == []
    assert source.next_sample(0.0001) is None and slept == [0.0001]  # its time has not come
    assert source.next_sample(0.1).t_ns == 7_001_000_000 and now[0] == pytest.approx(5.0005)
    now[0] += 60.0  # a late loop finds all of them
    rest = [source.next_sample(0.0) for _ in range(998)]
    assert [one.t_ns for one in rest] == [7_000_000_000 + k * 1_000_000 for k in range(2, 1000)]
    assert source.ended and source.counts.received == 1000


def sliding_masses(joints):
    """A bundle of an arm whose joints slide, a mass on each."""
    links = []
    for k, joint in enumerate(joints):
        (link,) = prismatic_mass(1.0).links
        link.joint_name, link.parent = joint, k - 1
        links.append(link)
    n = len(joints)
    signals = {"t_ns": np.arange(1001) * 1_000_000} | {s: np.zeros((1001, n)) for s in ("q", "dq", "tau")}
    meta = {"rate_hz": 1000.0, "torque_timing": "instant", "source": "", "robot_sha256": ""}
    made = Recording(name="still", joints=joints, **signals, **meta)
    bundle = make_bundle("masses", build_setup(_core.Tree(links, [0, 0, 0]), made, ObserverConfig()), 0.02, made)
    bundle.sliding_limit_nm = bundle.near_stiction_limit_nm = [2.0] * n
    return bundle


def test_a_loop_runs_on_a_stand_in_of_a_robot(franka):
    keeper = Keeper(lambda verdict: verdict.row == 50 and verdict.sample and keeper.control.stop("test"))
    source = FrankaSource("h")
    Loop(sliding_masses(FRANKA_JOINTS), source, [keeper]).run()
    # The block that holds row 50 is finished; on a busy computer it has further samples.
    assert len([v for v in keeper.verdicts if v.sample is not None]) >= 51 and source._robot is None
