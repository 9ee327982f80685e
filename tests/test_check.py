"""The check names what is wrong, with its joint, and is silent on good data."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from check_cases import FAULTS, Case, Fault, beside, is_named, pressed, scara, standing
from made_arms import planar_arm, six_axis, urdf
from made_recordings import made_motion
from tauext_lab.sim.collect import simulate_recording
from tauext_lab.sim.config import RigConfig
from tauext_lab.sim.rig import arm_xml

from tauext.check.checks import CHECKS, NEEDS, STEPS
from tauext.check.effort import pose_findings
from tauext.check.examination import Examination
from tauext.check.examine import examine
from tauext.check.finding import CODES
from tauext.check.joint_fit import fit_joint, presliding, rows_of
from tauext.check.motion import compare, stretches
from tauext.check.robot_file import fit_load, with_load
from tauext.cli import main
from tauext.data.recording import Recording
from tauext.data.recording_file import save_recording
from tauext.data.servo import AMPERES
from tauext.errors import ConfigError, RobotError
from tauext.robot.read import load_tree

MINUTES, RATE_HZ = 0.5, 100.0


def six_axes(folder: Path, minutes: float) -> Case:
    path = folder / "six.urdf"
    path.write_text(urdf(six_axis()).replace('effort="100"', 'effort="3000"'))
    return Case(made_motion(load_tree(path), minutes, RATE_HZ, pieces=2), path, minutes, RATE_HZ)


@pytest.fixture(scope="session")
def six(tmp_path_factory) -> Case:
    return six_axes(tmp_path_factory.mktemp("arm"), MINUTES)


@pytest.fixture(scope="session")
def longer(tmp_path_factory) -> Case:
    """For what shows in more motion alone."""
    return six_axes(tmp_path_factory.mktemp("longer"), 1.2)


@pytest.fixture(scope="session")
def searched(tmp_path_factory) -> Case:
    """Just long enough for order, zero and delay to be judged."""
    return six_axes(tmp_path_factory.mktemp("searched"), 0.7)


@pytest.fixture(scope="session")
def rig(tmp_path_factory) -> Case:
    path = tmp_path_factory.mktemp("rig") / "robot.xml"
    path.write_text(arm_xml(RigConfig(), true_com=True))
    recordings = [simulate_recording(RigConfig(), "free", 21.0, 3, number) for number in range(2)]
    return Case(replace(made_motion(load_tree(path), 0.2), recordings=recordings), path, 0.7, 1000.0)


@pytest.mark.parametrize("arm", ["six", "rig"])
def test_good_data_have_no_finding_but_their_length(arm, request):
    case = request.getfixturevalue(arm)
    assert {f.code for f in examine(case.made.recordings, case.urdf).findings} == {"too-short"}


LONGER = {"joint-axis", "joint-order", "position-offset", "stuck", "torque-changes"}
"""Codes that take more motion."""
ELSEWHERE = {"effort-scale", "joint-names", "odd-recording", "robot-file-changed", "spike", "time-unit"}
"""Codes that other tests lead to as well, in this file or in those of their names."""


def telling(faults: list[Fault]) -> list:
    """The first fault of each code and words on every machine, its variants and what takes long where there is time."""
    named = [(fault.code, fault.words) for fault in faults]
    slow = [
        named.index((fault.code, fault.words)) < k or fault.code in ELSEWHERE | LONGER for k, fault in enumerate(faults)
    ]
    return [pytest.param(f, id=f.name, marks=[pytest.mark.slow] * s) for f, s in zip(faults, slow, strict=True)]


@pytest.mark.parametrize("fault", telling(FAULTS))
def test_fault_is_named_with_its_joint_and_nothing_else(six, searched, longer, fault: Fault, tmp_path):
    case = longer if fault.code in LONGER else searched if fault.code == "torque-delay" else six
    recordings, text = fault.broken(case)
    (tmp_path / "robot.urdf").write_text(text)
    diagnosis = examine(recordings, tmp_path / "robot.urdf")
    assert is_named(fault, recordings, diagnosis), diagnosis.findings
    assert not beside(fault, diagnosis)


@pytest.mark.parametrize(
    "name",
    [
        "effort of one joint negated",
        "torque 40 ms late",
        *(pytest.param(name, marks=pytest.mark.slow) for name in ("q and dq in degrees", "dq negated")),
    ],
)
def test_fault_of_the_rig_is_named(rig: Case, name: str):
    fault = next(fault for fault in FAULTS if fault.name == name)
    recordings, _ = fault.broken(rig)
    diagnosis = examine(recordings, rig.urdf)
    assert is_named(fault, recordings, diagnosis) and not beside(fault, diagnosis)


CAUSES = ("position-wraps", "robot-file-other", "rows-dropped")
OF_LIMITS = ("limit-fine", "limit-wide", "promise-worse")


def test_every_code_has_a_fault_that_leads_to_it_or_a_test_of_its_own():
    # an unusable file here, causes in test_check_causes.py, limits of a training in test_few_data.py
    elsewhere = {"contact-unknown", "model-unusable", *CAUSES, *OF_LIMITS}
    assert set(CODES) - {fault.code for fault in FAULTS} == elsewhere


def test_the_table_of_checks_has_every_code_but_those_of_limits():
    assert {code for check in CHECKS for code in check.codes} == set(CODES) - set(OF_LIMITS)
    assert all(check.step in STEPS and set(check.needs) <= set(NEEDS) for check in CHECKS)


def scaled(by):
    return lambda r: replace(r, tau=by * r.tau)


ALL = {f"joint{j}" for j in range(1, 7)}
MNM = [np.where(np.isin(np.arange(6), joints), 1000.0, 1.0) for joints in ([1], [0], range(6))]
TOLD = {
    # change of each recording, whether there is a model, the code, its joints, words of the evidence
    "second torque in mNm": (scaled(MNM[0]), False, "effort-scale", {"joint2"}, ""),
    "first torque in mNm": (scaled(MNM[1]), False, "effort-scale", {"joint1"}, ""),
    "all torques in mNm": (scaled(MNM[2]), False, "effort-scale", ALL, ""),  # 1000 Nm are possible, a million are not
    "mNm against a model": (scaled(1e3), True, "effort-scale", ALL, ""),
    "no fault without a model": (scaled(1.0), False, "effort-scale", set(), ""),
    "offset": (lambda r: replace(r, q=r.q - 0.3 * np.eye(6)[2]), True, "position-offset", {"joint3"},
               "+0.30 rad (+17 degrees)"),
    "positions divided by 57": (lambda r: replace(r, q=r.q * np.pi / 180), True, "velocity-unit", ALL,
                                "the position is in rad and was imported as degrees"),
    "a wrist that winds up": (lambda r: replace(r, q=r.q + np.eye(6)[5] * 16.0), False, "degrees", set(), ""),
    "currents that a lighter hand explains": (scaled(1 / np.linspace(14, 8, 6)), True, "effort-scale", None, ""),
    "turned without a model": (scaled(-1.0), False, "effort-sign", ALL, ""),
}  # fmt: skip
SLOW = {"second torque in mNm", "first torque in mNm", "all torques in mNm", "offset", "turned without a model"}


@pytest.mark.parametrize("case_name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in TOLD])
def test_one_fault_of_the_whole_motion_is_named_alone(six, searched, longer, case_name):
    change, with_model, code, joints, words = TOLD[case_name]
    case = longer if case_name.startswith("turned") else searched if case_name == "offset" else six
    found = examine([change(r) for r in case.made.recordings], case.urdf if with_model else None).findings
    named = [f for f in found if f.code == code]
    assert {f.code for f in found if f.severity == "fault"} == ({code} if named else set())
    assert joints is None or {f.joint for f in named} <= joints and bool(named) == bool(joints)
    assert all(words in f.evidence for f in named)


def advice(case: Case, change, code: str) -> str:
    """The one remedy of a code's findings."""
    found = examine([replace(r, tau=change * r.tau) for r in case.made.recordings], case.urdf).findings
    (one,) = {f.advice for f in found if f.code == code}
    return one


@pytest.mark.parametrize("share", [1.0, pytest.param(100.0, marks=pytest.mark.slow)])
def test_factors_that_differ_are_listed_a_joint_each(six, share):
    """Of a share of each joint's largest torque; light joints, whose gravity is little, are among them."""
    largest_nm = np.geomspace(400.0, 30.0, 6)
    text = advice(six, share / largest_nm, "effort-scale")
    listed = dict(re.findall(r"(joint\d) (\S+?)[,.;] ", text.partition("multiply by ")[2].partition("These")[0] + " "))
    assert {j: float(listed[f"joint{j + 1}"]) for j in range(6)} == pytest.approx(
        dict(enumerate(largest_nm / share)), rel=0.02
    )


@pytest.mark.parametrize(
    ("factors", "wrong"), [([1, 1, 0.5, 1, 1, 1], "joint3 2 at"), ([1, 1, 1, 0.5, 1, 0.5], "joint4 2, joint6 2 at")]
)
def test_a_wrong_constant_of_some_joints_is_no_payload(six, factors, wrong):
    found = examine([replace(r, tau=np.array(factors) * r.tau) for r in six.made.recordings], six.urdf).findings
    assert {f.code for f in found} == {"effort-scale", "too-short"}
    assert all(f"multiply by {wrong} import" in f.advice for f in found if f.code == "effort-scale")


def test_no_gear_is_advised_that_no_machine_has(six):
    """Position errors of a servo, for instance: the torque divided by its stiffness."""
    found = examine([replace(r, tau=r.tau / 12_000) for r in six.made.recordings], six.urdf).findings
    assert {f.code for f in found} == {"effort-scale", "too-short"}
    assert not any("gear ratio" in f.advice for f in found)
    assert all("no gear and no torque constant is so large" in f.advice for f in found if f.code == "effort-scale")


def test_beside_an_impossible_inertia_the_torque_is_compared_with_the_model(six, tmp_path):
    (tmp_path / "robot.urdf").write_text(re.sub(r'izz="[^"]*"', 'izz="9"', six.urdf.read_text(), count=1))
    found = examine([replace(r, tau=3 * r.tau) for r in six.made.recordings], tmp_path / "robot.urdf").findings
    assert {f.code for f in found if f.severity == "fault"} == {"inertia-impossible", "effort-scale"}


@pytest.mark.slow
def test_an_arm_that_is_pressed_half_of_the_time_is_reported(tmp_path):
    case = six_axes(tmp_path, 1.2)
    found = examine([replace(r, **pressed(r, k)) for k, r in enumerate(case.made.recordings)], case.urdf).findings
    assert any(f.code == "contact-in-free-motion" and "often off" in f.evidence for f in found)


def test_currents_that_are_torques_are_reported(six):
    as_current = [replace(r, provenance={"torque": AMPERES}) for r in six.made.recordings]
    (one,) = [f for f in examine(as_current, six.urdf).findings if f.code == "effort-scale"]
    assert one.joint is None and one.severity == "warning" and 'unit = "Nm"' in one.advice


def test_axis_along_gravity_has_no_offset(tmp_path):
    """Turned about the vertical every zero is as good as another."""
    path = tmp_path / "scara.urdf"
    path.write_text(urdf(scara()).replace('effort="100"', 'effort="3000"'))
    made = made_motion(load_tree(path), MINUTES, RATE_HZ, pieces=2)
    turned = [replace(r, q=r.q + 0.5 * np.eye(4)[0]) for r in made.recordings]
    assert {f.code for f in examine(turned, path).findings} <= {"too-short"}


def test_sign_at_rest_is_reported_of_loaded_joints_alone(six):
    recordings, _ = standing(six, [-1.0] * 6)
    loads = np.abs(six.tree.momentum(np.stack([r.q[0] for r in recordings]), np.zeros((4, 6)))[1]).max(axis=0)
    found = [f.joint for f in pose_findings(Examination(recordings, tree=six.tree))]
    assert {f"joint{j + 1}" for j in np.flatnonzero(loads > 0.5 * loads.max())} <= set(found)
    assert not list(pose_findings(Examination(standing(six, [1.0] * 6)[0], tree=six.tree)))


@pytest.mark.slow
def test_the_evidence_of_currents_is_in_amperes(six):
    """Efforts of recordings without a torque constant are labelled A; torques and limits of the model stay in Nm."""
    amperes = {"torque": AMPERES}

    def evidence(recordings: list[Recording], code: str) -> str:
        return next(f.evidence for f in examine(recordings, six.urdf).findings if f.code == code)

    poses, _ = standing(six, [-1.0] * 6)
    at_rest = evidence([replace(r, provenance=amperes) for r in poses], "effort-sign")
    assert re.search(r"the effort is \S+ A where gravity takes \S+ Nm \(.* A apart\)", at_rest)
    driven = [replace(r, tau=-5000.0 * r.tau, provenance=amperes) for r in six.made.recordings]
    assert re.search(r"is \S+ A rad/s on average; friction resists with \S+ As/rad", evidence(driven, "effort-sign"))
    assert re.search(r"torques up to \S+ A, limit \S+ Nm;", evidence(driven, "beyond-limit"))
    assert re.search(r"the effort varies by \S+ A, gravity .* by \S+ Nm:", evidence(driven, "effort-scale"))
    one, *others = [replace(r, provenance=amperes) for r in six.made.recordings]
    odd = evidence([replace(one, tau=3.0 * one.tau), *others], "odd-recording")
    assert re.search(r"torque but for \S+ A at .* leaves \S+ A", odd) and "Nm" not in odd


def test_friction_that_holds_the_arm_has_no_sign_of_gravity(six):
    """One pose whose torque is a twentieth of the load, either way: the gears hold it."""
    recordings, _ = standing(six, [1.0] * 6)
    held = [replace(r, tau=-0.05 * r.tau) for r in recordings[:1]]
    little = [replace(r, tau=r.tau * np.where(np.arange(6) == 1, -0.05, 1.0)) for r in recordings[:1]]
    assert "joint2" not in {f.joint for f in pose_findings(Examination(little, tree=six.tree))}
    assert examine(held).findings  # without a model: that nothing moves
    assert "effort-sign" not in {f.code for f in examine(held).findings}


def test_presliding_states_are_stop_operators_sample_by_sample():
    rng = np.random.default_rng(0)
    q = np.cumsum(rng.normal(size=(300, 2)), axis=0) * 1e-3
    low, high, slow = np.full(2, -2e-3), np.full(2, 2e-3), np.zeros((300, 2))
    for k in range(1, 300):
        low, high = (np.clip(z + q[k] - q[k - 1], -2e-3, 2e-3) for z in (low, high))
        slow[k] = (low + high) / 2 / 2e-3
    assert presliding(q, (2e-3, 5e-3), 100.0)[..., 0] == pytest.approx(slow, abs=1e-12)  # rounding


def test_contact_that_nobody_labelled_is_reported_with_time_joint_and_torque(searched):
    def touched(r):
        shape = np.exp(-(((r.time_s - 20.0) / 0.05) ** 2))
        return replace(r, tau=r.tau + 0.8 * r.tau.std(axis=0)[2] * shape[:, None] * np.eye(6)[2], contact=None)

    first, second = searched.made.recordings
    (found,) = [f for f in examine([first, touched(second)], searched.urdf).findings if f.code != "too-short"]
    assert found.severity == "warning" and "'joint3' at 20.0 s of 'free-1'" in found.evidence


def test_velocity_that_stands_still_by_chance_near_its_mean_is_stuck(six):
    """Over the whole second the joint goes as far as the held value says, in between it does not."""
    arm = six.made.recordings[0]
    speed = arm.dq[:, 1]
    at = int(np.argmax(speed)) - 30
    way = arm.q[at + 99, 1] - arm.q[at, 1]
    dq = arm.dq.copy()
    dq[at : at + 100, 1] = way / (arm.time_s[at + 99] - arm.time_s[at])
    found = [f for f in examine([replace(arm, dq=dq)]).findings if f.code == "stuck"]
    assert [f.joint for f in found] == ["joint2"] and "dq stays" in found[0].evidence


@pytest.mark.parametrize(("beat", "stuck"), [(0.9, False), (0.5, True)])
def test_a_slow_cruise_whose_velocity_beats_with_the_samples_is_not_stuck(six, beat, stuck):
    """Counts of the encoder in step with the samples: each says the same velocity, and it is some per cent off."""
    arm = six.made.recordings[0]
    cruise = slice(1000, 1000 + round(1.5 * arm.rate_hz))
    q, dq = arm.q.copy(), arm.dq.copy()
    since_s = arm.time_s[cruise] - arm.time_s[cruise.start]
    q[cruise, 1] = q[cruise.start, 1] + 0.024 * since_s
    dq[cruise, 1] = beat * 0.024
    found = [f for f in examine([replace(arm, q=q, dq=dq)]).findings if f.code == "stuck" and "dq stays" in f.evidence]
    assert bool(found) == stuck


def test_coarse_current_that_rests_on_a_level_is_not_stuck():
    """A slow joint of a current in steps of a tenth of its spread keeps each level for a while."""
    t = np.arange(6000) / 100.0
    q = np.stack([np.sin(0.2 * t), np.sin(0.9 * t)], axis=1)
    tau = np.round(np.stack([np.cos(0.2 * t), np.cos(0.9 * t)], axis=1) / 0.1) * 0.1
    recording = made_motion(planar_arm(), 1.0, pieces=1).recordings[0]
    recording = replace(recording, q=q, dq=np.gradient(q, 0.01, axis=0), tau=tau)
    assert "stuck" not in {f.code for f in examine([recording]).findings}


def test_a_tool_taken_off_is_less_load(six, tmp_path):
    lighter = with_load(six.tree, np.array([-0.7 * six.tree.links[-1].mass, 0, 0, 0]))
    found = examine(six.anew(lighter), six.urdf).findings
    assert any(f.code == "payload" and "less payload" in f.evidence for f in found)


def test_load_of_least_squares_is_the_load_that_was_mounted(six):
    mounted = np.array([4.0, 0.2, -0.1, 0.4])
    motion = stretches(six.anew(with_load(six.tree, mounted)))
    load_found = fit_load(motion, six.tree, rows_of(motion, six.tree))
    # noise of 1 % of the torque over a minute
    assert load_found.mass_kg == pytest.approx(4.0, rel=0.02)
    assert load_found.com_m == pytest.approx(mounted[1:] / 4.0, abs=0.01)


def test_rows_hold_the_equation_of_motion(six):
    """Without friction and noise the torque is gravity + inertial, whatever filter both went through."""
    made = six.made
    quiet = [replace(r, tau=r.tau - f) for r, f in zip(made.recordings, made.friction, strict=True)]
    rows = rows_of(stretches(quiet), six.tree)
    for j in range(rows.joints):
        fit = fit_joint(rows, j)
        assert fit.gravity_factor[0] == pytest.approx(1.0, abs=0.005)  # noise is 1 %
        assert fit.error_nm < 0.01 * fit.torque_nm


@pytest.mark.parametrize("late_s", [-0.05, 0.0, 0.003, 0.08])
def test_velocity_delay_is_measured_to_a_millisecond(six, late_s):
    def shift(r):
        t = r.time_s
        return replace(r, dq=np.stack([np.interp(t - late_s, t, x) for x in np.gradient(r.q, t, axis=0).T], axis=1))

    assert compare(stretches([shift(r) for r in six.made.recordings]), 0).lag_s == pytest.approx(late_s, abs=1e-3)


def test_a_joint_at_rest_with_a_noisy_velocity_has_no_unit(six):
    rng = np.random.default_rng(0)
    still = [replace(r, q=r.q * 0 + 1e-5 * rng.standard_normal(r.q.shape)) for r in six.made.recordings]
    assert compare(stretches([replace(r, dq=rng.standard_normal(r.q.shape)) for r in still]), 0) is None


def test_bad_input_is_refused(six, tmp_path):
    with pytest.raises(ConfigError, match="no recording to check"):
        examine([])
    other = replace(six.made.recordings[0], joints=tuple("abcdef"))
    with pytest.raises(ConfigError, match="must be of one arm"):
        examine([six.made.recordings[0], other])
    with pytest.raises(RobotError, match="no such robot file"):
        examine(six.made.recordings, tmp_path / "gone.urdf")


def test_unreadable_robot_file_is_a_fault_and_the_signals_are_checked(six, tmp_path):
    (tmp_path / "robot.urdf").write_text("<robot")
    recordings = [replace(r, dq=-r.dq) for r in six.made.recordings]
    codes = {f.code for f in examine(recordings, tmp_path / "robot.urdf").findings}
    assert {"model-unusable", "velocity-sign"} <= codes


def test_joints_of_an_mjcf_are_taken_in_its_order_where_names_differ(rig):
    recordings = [replace(r, joints=("a", "b")) for r in rig.made.recordings]
    assert {f.code for f in examine(recordings, rig.urdf).findings} == {"joint-names", "too-short"}


def test_command_writes_text_json_and_a_picture_a_joint(six, tmp_path, capsys, undrawn):
    import json

    (tmp_path / "in").mkdir()
    for r in six.made.recordings:
        save_recording(replace(r, tau=-r.tau), tmp_path / "in" / f"{r.name}.parquet")
    arguments = ["check", "--data", str(tmp_path / "in"), "--robot", str(six.urdf), "--out", str(tmp_path / "out")]
    assert main([*arguments, "--json"]) == 1
    said = json.loads(capsys.readouterr().out)
    assert said == json.loads((tmp_path / "out" / "check.json").read_text())
    assert said["faulty"] and {f["code"] for f in said["findings"]} == {"effort-sign", "too-short"}
    assert {p.name for p in (tmp_path / "out").glob("*.png")} == {
        "torque.png",
        *(f"torque-{j}.png" for j in range(1, 7)),
    }


def test_command_exits_0_without_a_fault_and_2_without_recordings(six, tmp_path, capsys):
    for r in six.made.recordings:
        save_recording(r, tmp_path / f"{r.name}.parquet")
    assert main(["check", "--data", str(tmp_path), "--robot", str(six.urdf)]) == 0
    assert "0 faults" in capsys.readouterr().out
    (tmp_path / "empty").mkdir()
    assert main(["check", "--data", str(tmp_path / "empty")]) == 2
    assert "no recording" in capsys.readouterr().err
