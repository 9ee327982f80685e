"""What the checks find on simulated servos: what their effort is, and their play."""

from dataclasses import replace

import numpy as np
import pytest
from made_servos import COUNT_RAD, Servo, drive, recorded
from tauext_lab.report.check_picture import draw
from tauext_lerobot.backlash import backlash_widths, play_of
from tauext_lerobot.servo_torque import efforts_of, servo_findings

from tauext.check.examine import as_data, as_text, examine, quick_checks

DEGREE = np.pi / 180
LOADED, PAN, PLAY, WIDE = 0, 1, 2, 3
SERVOS = [
    Servo(gravity_nm=0.4, duty_per_rad=2.8),
    Servo(duty_per_rad=2.8),
    Servo(play_rad=1.0 * DEGREE),
    Servo(play_rad=1.5 * DEGREE, gravity_nm=0.05),
    Servo(encoder="link"),
    Servo(bend_rad=0.01),
    Servo(play_rad=1.0 * DEGREE, gravity_nm=1.0),
]
RATE_HZ = 50.0


@pytest.fixture(scope="module")
def driven():
    return drive(SERVOS, 60.0, RATE_HZ)


@pytest.fixture(scope="module")
def two(driven):
    """The first two servos alone: the first carries something."""
    return replace(driven, **{name: getattr(driven, name)[:, :2] for name in ("goal", "q", "dq", "duty", "torque")})


def supply(driven):
    """Amperes: duty times current of the windings, which stall at 2.7 A, without a sign, in steps of 6.5 mA."""
    return np.round(np.abs(driven.duty * 2.7 * driven.torque / 1.9) / 0.0065) * 0.0065


def codes(recording):
    return {(f.code, f.joint) for f in servo_findings(recording.joints, efforts_of([recording]))}


def test_the_supply_current_is_named_by_its_square_law(two):
    recording = recorded(two, supply(two))
    efforts = efforts_of([recording])
    assert [e.kind for e in efforts] == ["supply current"] * 2
    loaded = efforts[LOADED]
    assert loaded.law.exponent == pytest.approx(2, abs=0.25)  # friction at rest scatters, rounding bends
    assert loaded.law.gain == pytest.approx(2.7 * 2.8**2, rel=0.1)  # stall current times (duty a rad)^2
    found = servo_findings(recording.joints, efforts)
    assert {(f.code, f.severity) for f in found} == {("supply-current", "fault")}
    assert all('torque_from = "supply-current"' in f.advice for f in found)


def test_a_round_with_a_supply_current_says_nothing_of_signs_or_scales(two, tmp_path):
    diagnosis = examine([recorded(two, supply(two))])
    told = {f.code for f in diagnosis.findings}
    assert "supply-current" in told
    assert not told & {"effort-sign", "effort-scale", "torque-delay", "effort-compensated", "stuck"}
    facts = diagnosis.facts[LOADED]
    assert facts["torque_is"] == "supply current" and facts["position_step_rad"] == pytest.approx(COUNT_RAD)
    assert facts["torque_step_nm"] == pytest.approx(0.0065)
    assert "supply current" in as_text(diagnosis) and as_data(diagnosis)["facts"]["servo1"] == facts
    assert "servos.png" in {path.name for path in draw(diagnosis, tmp_path)}


def test_without_goals_an_unsigned_current_is_a_fault_all_the_same(two):
    recording = recorded(two, supply(two), goals=False)
    assert codes(recording) == {("unsigned-torque", "servo1"), ("unsigned-torque", "servo2")}
    assert {f.code for f in quick_checks(recording, None)} >= {"unsigned-torque"}
    diagnosis = examine([recording])
    assert diagnosis.faulty and not {f.code for f in diagnosis.findings} & {"effort-sign", "spike"}


@pytest.mark.parametrize(("full", "step"), [(1.0, 0.001), (1000.0, 1.0)])
def test_a_duty_is_named_with_its_gain(two, full, step):
    recording = recorded(two, np.round(full * two.duty / step) * step)
    found = servo_findings(recording.joints, efforts_of([recording]))
    assert {(f.code, f.severity) for f in found} == {("effort-duty", "warning")} and len(found) == 2
    assert efforts_of([recording])[LOADED].law.gain == pytest.approx(2.8 * full, rel=0.02)


def test_a_duty_is_named_by_its_limit_alone(two):
    limited = np.clip(8 * two.duty, -1, 1) * 1000  # a stiffer servo, at its limit now and then
    assert codes(recorded(two, np.round(limited), goals=False)) == {("effort-duty", j) for j in ("servo1", "servo2")}


def test_a_load_register_with_its_sign_bit_is_named(two):
    load = np.round(1000 * two.duty)
    assert codes(recorded(two, np.where(load < 0, 1024 - load, load))) == {
        ("load-sign-bit", "servo1"),
        ("load-sign-bit", "servo2"),
    }


def test_a_phase_current_is_found_by_its_back_emf_and_is_no_finding(two):
    efforts = efforts_of([recorded(two, 2.7 * two.torque / 1.9)])
    assert [e.kind for e in efforts] == ["phase current"] * 2
    assert not servo_findings(("servo1", "servo2"), efforts)


def test_a_torque_that_gravity_keeps_above_zero_is_not_unsigned(two):
    recording = recorded(two, two.torque + 1.05 * np.abs(two.torque).max(axis=0))
    assert not codes(recording)


def test_what_was_made_of_signals_is_held_against_those(two):
    """A table that says phase-current, duty or supply-current, and columns that are something else."""

    def made(source, current=None, duty=None):
        provenance = {"servo": {"torque_from": source, "velocity_steps": 10}}
        return replace(recorded(two, two.torque), current=current, duty=duty, provenance=provenance)

    phase = 2.7 * two.torque / 1.9
    assert codes(made("phase_current", supply(two))) == {("supply-current", j) for j in ("servo1", "servo2")}
    assert not codes(made("supply_current", supply(two))) and not codes(made("phase_current", phase))
    assert codes(made("supply_current", phase)) == {("current-signed", j) for j in ("servo1", "servo2")}
    assert not codes(made("duty", duty=two.duty)) and not codes(made("goal"))
    assert {code for code, _ in codes(made("duty", duty=np.abs(two.duty)))} == {"unsigned-torque"}
    assert efforts_of([made("goal")])[0].kind == "goal"


def test_play_is_found_where_friction_loads_the_joint(driven):
    """0.15 degrees: 1.7 counts of the encoder; the motor stops and slips when it meets the load again."""
    widths, errors = backlash_widths([recorded(driven, driven.torque)])
    for j in (PLAY, WIDE):
        assert widths[j] == pytest.approx(SERVOS[j].play_rad, abs=0.15 * DEGREE)
        assert COUNT_RAD <= errors[j] < 0.2 * DEGREE
    others = [j for j in range(len(SERVOS)) if j not in (PLAY, WIDE)]
    assert (widths[others] == 0).all() and np.isnan(errors[others]).all()  # none, a bend, or gravity holds it


def test_play_is_found_from_goals_where_the_current_has_no_sign(driven):
    play = play_of([recorded(driven, supply(driven))], WIDE)
    assert play.lost_rad == pytest.approx(1.5 * DEGREE, abs=0.25 * DEGREE)  # a duty knows speed less well


def test_few_turns_tell_no_play(driven):
    short = recorded(driven, driven.torque)
    short = replace(short, **{name: getattr(short, name)[:300] for name in ("t_ns", "q", "dq", "tau", "q_des")})
    assert np.isnan(backlash_widths([short])[0]).all()


def test_play_is_a_note_with_its_width(driven):
    one = replace(driven, **{n: getattr(driven, n)[:, [WIDE]] for n in ("goal", "q", "dq", "duty", "torque")})
    found = [f for f in examine([recorded(one, one.torque)]).findings if f.code == "backlash"]
    assert [f.severity for f in found] == ["note"] and "degrees" in found[0].evidence
