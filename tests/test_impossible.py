"""What no arm sends: found as the monitor finds it, left out of training and limits, told with its time."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from test_few_data import motion, trained

from tauext import _core
from tauext.cli import main
from tauext.cli.live_view import text_number
from tauext.config import AlarmConfig
from tauext.data.free_motion import LeftOut, SignalBounds, possible_parts
from tauext.data.recording import Recording
from tauext.errors import TrainingError
from tauext.fit.training_set import signal_bounds
from tauext.monitor.explanation import signals
from tauext.train.limits import LIMITS
from tauext.train.paper_limits import LimitMotion

PERIOD_NS = 8_000_000
BOUNDS = SignalBounds(np.array([300.0, 200.0]), np.array([10.0, 10.0]))
FAULT = 3


def observer(**changes) -> _core.ObserverSettings:
    settings = {"gain_per_s": 20.0, "timing": _core.TorqueTiming.averaged}
    return _core.ObserverSettings(**settings, sample_period_ns=PERIOD_NS, network_stride=1, **changes)


def with_values(recording: Recording, signal: str, values: dict[tuple[int, int], float]) -> Recording:
    """Some numbers of a signal, by (sample, joint), replaced."""
    column = getattr(recording, signal).copy()
    for at, value in values.items():
        column[at] = value
    return replace(recording, **{signal: column})


class Listener:
    """A reporter that keeps what it was told."""

    def __init__(self):
        self.said = []

    def say(self, sentence):
        self.said.append(sentence)

    def progress(self, title):
        from contextlib import nullcontext

        return nullcontext(lambda done, total, note: None)


def test_what_no_arm_sends_is_found_and_the_rest_is_not():
    made = motion(seconds=20.0)
    bad = with_values(made, "tau", {(500, 1): 1e6, (501, 1): -200.1, (800, 0): 299.9})
    bad = with_values(bad, "dq", {(900, 0): -10.1, (1000, 0): 9.9})
    bad = with_values(bad, "q", {(1500, 1): bad.q[1500, 1] + 1.0, (1700, 0): bad.q[1700, 0] + 0.1})
    counted = LeftOut("training")
    assert counted.find(bad, observer(), BOUNDS).tolist() == [500, 501, 900, 1500]
    assert [(one.cause, one.joint) for one in counted.found] == [
        ("impossible torque", "elbow"),
        ("impossible torque", "elbow"),
        ("impossible velocity", "shoulder"),
        ("impossible position", "elbow"),
    ]
    assert counted.sentence() == (
        "left out 4 impossible samples of the training recordings: elbow's torque of 1e+06 at 4 s of 'made', "
        "elbow's torque of -200.1 at 4.008 s of 'made', shoulder's velocity of -10.1 at 7.2 s of 'made' and 1 more in "
        "1 recording"
    )
    assert counted.found[3].value == pytest.approx(1.0, abs=0.05)  # how far it jumps
    assert counted.facts()["samples"] == 4 and counted.facts()["of"] == 2500
    assert json.loads(json.dumps(counted.facts()))["listed"][2]["time_s"] == 7.2


def test_bounds_hold_for_the_torque_behind_its_constants():
    made = motion(seconds=4.0)
    amperes = with_values(replace(made, tau=made.tau / [-10, 1]), "tau", {(100, 0): 40.0, (200, 0): -25.0})
    found = LeftOut("training").find(amperes, observer(nm_per_unit=[-10.0, 1.0]), BOUNDS)
    assert found.tolist() == [100]


def test_a_monitor_refuses_the_same_samples(tmp_path, monkeypatch):
    bundle, _ = trained(tmp_path, monkeypatch, [motion()], recipe="observer")
    bundle.possible_torque_nm, bundle.possible_speed_rad_s = BOUNDS.torque_nm.tolist(), BOUNDS.speed_rad_s.tolist()
    rng = np.random.default_rng(1)
    made = motion(seconds=60.0, seed=5)
    for signal, size in (("tau", 2e3), ("dq", 30.0), ("q", 3.0)):
        for length in (1, 2, 7):
            at = int(rng.integers(100, made.samples - 100))
            values = getattr(made, signal)[:, 1] + size
            made = with_values(made, signal, {(k, 1): values[k] for k in range(at, at + length)})
    found = LeftOut("calibration").find(made, bundle.observer, SignalBounds.of(bundle))
    said = _core.estimate(bundle, made.t_ns, made.q, made.dq, made.tau, 1)
    np.testing.assert_array_equal(found, np.flatnonzero(said["health"] == FAULT))
    assert len(found) == 2 * 10 + 1 + 2 + 2  # a position that stays for two samples or more jumps there and back


def test_the_chain_begins_anew_where_a_sample_was_left_out():
    made = motion(seconds=20.0)
    bad = with_values(made, "tau", {(1000, 1): 1e6})
    counted = LeftOut("training")
    assert possible_parts([made], observer(), BOUNDS, counted)[0] is made and counted.sentence() == ""
    (part,) = possible_parts([bad], observer(), BOUNDS, counted)
    assert np.abs(part.tau).max() < 200 and part.name == "made"
    first = int(np.argmax(np.diff(part.t_ns))) + 1
    assert first == 1000 and bad.samples - part.samples == 5
    tree = arm()
    seen = _core.observe(tree, observer(), part.t_ns, part.q, part.dq, part.tau)
    tail = _core.observe(tree, observer(), part.t_ns[first:], part.q[first:], part.dq[first:], part.tau[first:])
    assert seen.restarts == 1
    np.testing.assert_array_equal(seen.residual[first:], tail.residual)


def arm() -> _core.Tree:
    from made_arms import planar_arm

    return planar_arm()


def test_too_much_that_is_impossible_is_no_glitch():
    bad = with_values(motion(seconds=20.0), "tau", {(k, 0): 1e5 for k in range(600, 603)})
    with pytest.raises(TrainingError, match=r"^3 of 2500 samples of the training recordings are impossible.*'made'"):
        possible_parts([bad], observer(), BOUNDS, LeftOut("training"))


def test_what_is_possible_follows_from_drives_and_from_training_but_not_from_its_glitches():
    made = motion(seconds=40.0)
    needed, fast = (
        np.sort(np.abs(signal), axis=0)[-6] for signal in (made.tau, made.dq)
    )  # 5 of 5000 are the thousandth
    bad = with_values(with_values(made, "tau", {(100, 0): 1e6, (200, 1): -1e6}), "dq", {(300, 0): 1e5})
    bounds = signal_bounds([bad])
    np.testing.assert_allclose(bounds.torque_nm, 10 * needed, rtol=0.02)
    np.testing.assert_allclose(bounds.speed_rad_s, 5 * np.maximum(fast, 2.0), rtol=0.02)
    # Twice what the drive gives; a drive that gives less than was measured is not the one.
    bounds = signal_bounds([bad], [100.0, needed[1] / 2])
    np.testing.assert_allclose(bounds.torque_nm, [200.0, 10 * needed[1]], rtol=0.02)
    # Constants turn it into the answers' unit.
    np.testing.assert_allclose(signal_bounds([bad], None, [3.0, -2.0]).torque_nm, 10 * needed * [3, 2], rtol=0.02)
    # A wrist that hardly needed any torque may need as much as the shoulder; a few samples hold one glitch.
    weak = replace(made, tau=made.tau * [1, 1e-3])
    assert signal_bounds([weak]).torque_nm[1] == pytest.approx(max(10.0, needed[0]), rel=0.02)
    short = with_values(motion(seconds=2.0), "tau", {(50, 0): 1e6})
    assert signal_bounds([short]).torque_nm[0] < 1e3


@pytest.mark.parametrize(
    ("signal", "value"),
    [
        ("tau", 1000.0),
        pytest.param("q", 50.0, marks=pytest.mark.slow),
        pytest.param("tau", 1e6, marks=pytest.mark.slow),
        pytest.param("dq", 1e4, marks=pytest.mark.slow),
    ],
)
def test_one_impossible_sample_changes_neither_limits_nor_friction(signal, value, tmp_path, monkeypatch):
    recordings = [motion(seconds=30.0, seed=k, name=f"made-{k}") for k in range(3)]
    clean, before = trained(tmp_path, monkeypatch, recordings, recipe="prior")
    recordings[1] = with_values(recordings[1], signal, {(2000, 1): value})
    bundle, facts = trained(tmp_path, monkeypatch, recordings, recipe="prior")
    # Limits are chosen together: a second of motion less moves all of them.
    np.testing.assert_allclose(bundle.sliding_limit_nm, clean.sliding_limit_nm, rtol=0.1)
    np.testing.assert_allclose(bundle.prior.weights, clean.prior.weights, atol=0.02 * np.abs(clean.prior.weights).max())
    np.testing.assert_allclose(bundle.error_scale.largest, clean.error_scale.largest, rtol=0.05)
    np.testing.assert_allclose(bundle.largest_torque_nm, clean.largest_torque_nm, rtol=0.01)
    np.testing.assert_allclose(bundle.coverage.fastest_rad_s, clean.coverage.fastest_rad_s, rtol=0.01)
    (told,) = facts["impossible"]["listed"]
    assert (told["recording"], told["time_s"], told["joint"]) == ("made-1", 16.0, "elbow")
    assert any("left out 1 impossible sample" in note and "16 s of 'made-1'" in note for note in facts["notes"])
    assert "impossible" not in before and not any("impossible" in note for note in before["notes"])


@pytest.mark.slow
def test_calibration_recordings_leave_them_out_and_tell(tmp_path, monkeypatch):
    bundle, _ = trained(tmp_path, monkeypatch, [motion()], recipe="observer")
    made = motion(seconds=200.0, seed=7, name="hours")
    bad = with_values(made, "tau", {(9000, 1): -1e300, (15000, 0): 1e5})
    limits, said = [], []

    def put(recording):
        motion = LimitMotion("x", AlarmConfig(), 1, note=said.append, calibration=[lambda: recording])
        return LIMITS["promised"](bundle, motion)

    for recording in (made, bad):
        facts = put(recording)
        limits.append(bundle.sliding_limit_nm)
    np.testing.assert_allclose(limits[1], limits[0], rtol=0.05)
    assert facts["impossible"]["samples"] == 2 and facts["impossible"]["of"] == 25000
    assert len(said) == 1 and "elbow's torque of -1e+300 at 72 s of 'hours'" in said[0]
    flood = with_values(made, "tau", {(k, 1): 1e7 for k in range(2000, 2100)})
    with pytest.raises(TrainingError, match="100 of 25000 samples of the calibration recordings are impossible"):
        put(flood)


def test_numbers_of_a_fault_stay_readable(tmp_path, monkeypatch, capsys):
    flight = {"q": np.array([[0.5]]), "dq": np.array([[-1e300]]), "tau": np.array([[1e300]])}
    source = SimpleNamespace(bundle=SimpleNamespace(torque_units=("N m",)))
    assert signals(flight, 0, 0, source) == "q = 0.50000 rad, dq = -1e+300 rad/s, tau = +1e+300 Nm"
    assert text_number(1e300, "+") == "+1e+300" and text_number(-12.345) == "-12.35"
    trained(tmp_path, monkeypatch, [motion()], recipe="observer")
    capsys.readouterr()
    assert main(["show", str(tmp_path / "made.tauext")]) == 0
    told = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("a fault beyond"))
    assert "Nm and 1" in told and "rad/s, also from one position to the next" in told
