"""A recording that disagrees with the others is named, with what would mend it; other motion does not make one odd."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from check_cases import parallel, scara
from made_arms import planar_arm, six_axis, urdf
from made_recordings import Drive, made_motion

from tauext.check import odd_torque
from tauext.check.checks import CHECKS, SIGNALS, VELOCITIES, run
from tauext.check.corrections import search_stretches
from tauext.check.effort import SignVote
from tauext.check.examination import Examination
from tauext.check.examine import examine
from tauext.check.finding import Finding
from tauext.check.joint_fit import COULOMB_SPEEDS_RAD_S, PRESLIDING_RAD, FitRows, fit_joint, presliding, rows_of
from tauext.check.motion import Stretch, stretches
from tauext.check.odd_motion import motion_of
from tauext.check.robot_file import with_load
from tauext.check.torque_changes import growth_findings, often_disturbed, step_findings
from tauext.data.free_motion import cut
from tauext.data.recording import Recording
from tauext.robot.read import load_tree

J, ODD = 1, 2


def six_axes(folder: Path, minutes: float):
    path = folder / "six.urdf"
    path.write_text(urdf(six_axis()).replace('effort="100"', 'effort="30000"'))
    return path, load_tree(path), made_motion(load_tree(path), minutes, 100.0, pieces=4).recordings


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    return six_axes(tmp_path_factory.mktemp("arm"), 1.2)


@pytest.fixture(scope="module")
def longer(tmp_path_factory):
    """For what shows in more motion alone."""
    return six_axes(tmp_path_factory.mktemp("longer"), 2.0)


def one(r: Recording, signal: str, change) -> np.ndarray:
    x = getattr(r, signal).copy()
    x[:, J] = change(x[:, J])
    return x


def swapped(x: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(x[:, [0, 2, 1, 3, 4, 5]])


CHANGES = {
    "the torque of": lambda r: {"tau": -r.tau},
    "its torque negated": lambda r: {"tau": one(r, "tau", np.negative)},
    "divided by 0.5": lambda r: {"tau": one(r, "tau", lambda x: x / 2)},
    "of another unit": lambda r: {"tau": one(r, "tau", lambda x: x * 1000)},
    "the torques of 'joint2' and 'joint3' exchanged": lambda r: {"tau": swapped(r.tau)},
    "exchanged": lambda r: {name: swapped(getattr(r, name)) for name in ("q", "dq", "tau")},
    "velocity is -": lambda r: {"dq": one(r, "dq", np.negative)},
    "velocity is 57": lambda r: {"dq": r.dq * 180 / np.pi},
    "in degrees": lambda r: {"q": r.q * 180 / np.pi, "dq": r.dq * 180 / np.pi},
    "1 turns": lambda r: {"q": one(r, "q", lambda x: x + 2 * np.pi)},
}


def odd(recordings: list[Recording], path=None) -> list[Finding]:
    """Findings of odd recordings, by the steps that name some."""
    checks = [check for check in CHECKS if check.step in (SIGNALS, VELOCITIES)]
    return [f for f in run(checks, Examination(recordings, path), str) if f.code == "odd-recording"]


TELLING = ("the torque of", "exchanged", "in degrees")
VARIANTS = [pytest.param(told, marks=[pytest.mark.slow] * (told not in TELLING)) for told in CHANGES]


@pytest.mark.parametrize("told", VARIANTS)
def test_odd_recording_is_named_with_its_mend(arm, told):
    path, _, good = arm
    recordings = [replace(r, **CHANGES[told](r)) if k == ODD else r for k, r in enumerate(good)]
    diagnosis = examine(recordings, path)
    (found,) = [f for f in diagnosis.findings if f.code == "odd-recording"]
    assert found.recording == good[ODD].name and told in found.evidence
    assert {f.code for f in diagnosis.findings} <= {"odd-recording", "too-short", "beyond-limit"}


WITHOUT_MODEL = {
    "negated": CHANGES["the torque of"],
    "negated friction resists": CHANGES["its torque negated"],
    "exchanged": lambda r: {"tau": np.ascontiguousarray(r.tau[:, ::-1])},
    **{told: CHANGES[told] for told in ("of another unit", "velocity is -", "in degrees")},
}


@pytest.fixture(scope="module")
def planar() -> list[Recording]:
    return made_motion(planar_arm(), 3.0, 100.0, pieces=4).recordings


@pytest.mark.parametrize("told", WITHOUT_MODEL)
def test_odd_recording_is_named_without_a_model(planar, told):
    recordings = [replace(r, **WITHOUT_MODEL[told](r)) if k == ODD else r for k, r in enumerate(planar)]
    (found,) = odd(recordings)
    assert found.recording == planar[ODD].name and told in found.evidence


@pytest.mark.parametrize(("scale", "told"), [(1.1, "1.1"), (0.9, "0.9"), (-1.0, ""), (1.0, None)])
def test_a_torque_constant_that_is_off_is_advised_by_its_ratio(planar, monkeypatch, scale, told):
    """The sign of the friction alone is no proof of an inverted torque: the other recordings' torque has the same sign.
    The vote on the sign is taken as lost, as in a servo arm whose friction the fit cannot find."""
    scaled = [replace(r, tau=r.tau * [scale if k == ODD else 1.0, 1.0]) for k, r in enumerate(planar)]
    x = Examination(scaled)
    x.correct(rows=rows_of(x.motion, planar_arm()))
    parts = {k: x.rows.taken(x.rows.recording == k) for k in range(len(planar))}
    parts[ODD] = replace(parts[ODD], dq=-np.sign(parts[ODD].tau) * np.abs(parts[ODD].dq))  # lowered: negative work
    monkeypatch.setattr(SignVote, "inverted", True)
    pool = odd_torque.Pool.of([parts[k] for k in parts if k != ODD])
    predicted = pool.predicted(x.rows.taken(x.rows.recording == ODD))
    monkeypatch.setattr(odd_torque.Pool, "predicted", lambda self, rows: predicted)
    findings = list(odd_torque.Comparison(x, parts, pool).driven(list(parts)))
    found = [one for one in findings if one.recording == planar[ODD].name]
    if told is None:
        assert found == []
        return
    (one,) = found
    assert one.joint == planar[0].joints[0] and ("negate" in one.advice) == (scale < 0)
    assert f"divide its torque by {told}" in one.advice if told else one.severity == "fault"


def test_good_recordings_are_not_odd(arm, planar):
    path, _, good = arm
    assert not odd(good, path) and not odd(planar)


@pytest.mark.parametrize(
    "by, told",
    [
        (0.3, "-0.3"),
        pytest.param(-1.0, "+1.0", marks=pytest.mark.slow),
        pytest.param(np.pi / 2, "-1.57", marks=pytest.mark.slow),
    ],
)
def test_shifted_zero_is_named_in_rad(arm, by, told):
    path, _, good = arm
    recordings = [replace(r, q=one(r, "q", lambda x: x + by)) if k == ODD else r for k, r in enumerate(good)]
    (found,) = odd(recordings, path)
    assert (found.recording, found.joint) == (good[ODD].name, "joint2") and told in found.evidence
    assert found.severity == ("fault" if abs(by) > 0.5 else "warning")


@pytest.mark.parametrize("late_s", [0.025, pytest.param(-0.06, marks=pytest.mark.slow)])
def test_a_recording_whose_torque_comes_late_is_named_in_ms(longer, late_s):
    path, _, good = longer
    shifted = np.round(late_s * good[ODD].rate_hz).astype(int)
    recordings = [replace(r, tau=np.roll(r.tau, shifted, axis=0)) if k == ODD else r for k, r in enumerate(good)]
    (found,) = odd(recordings, path)
    assert (found.recording, found.joint, found.severity) == (good[ODD].name, None, "warning")
    told_ms = float(found.evidence.split(" by ")[1].split()[0])
    assert abs(told_ms - 1e3 * late_s) < 0.2 * 1e3 * abs(late_s)  # the fit is by the torque's slope alone


def test_a_short_recording_that_begins_in_motion_has_its_true_velocity_delay(arm):
    """Four seconds of dq = 0.1 + 0.08 sin(t + phase) with encoder noise; the recorded velocity comes 8 ms late."""
    _, _, good = arm
    one, phase, rng = cut(good[ODD], slice(0, 1000)), np.arange(6.0), np.random.default_rng(1)
    one = replace(one, t_ns=np.arange(1000) * 4_000_000, rate_hz=250.0)
    angle = one.time_s[:, None] + phase
    q = 0.1 * angle - 0.08 * np.cos(angle) + 1e-4 * rng.standard_normal((1000, 6))
    one = replace(one, q=q, dq=0.1 + 0.08 * np.sin(angle - 0.008))
    assert np.abs(motion_of(one, stretches([one])).lag_s - 0.008).max() < 5e-3  # `odd_motions` reports 15 ms


def test_a_zero_that_is_a_little_off_is_named(longer):
    """Less than what doubles the error."""
    path, _, good = longer
    recordings = [replace(r, q=one(r, "q", lambda x: x + 0.1)) if k == ODD else r for k, r in enumerate(good)]
    (found,) = odd(recordings, path)
    assert (found.recording, found.joint, found.severity) == (good[ODD].name, "joint2", "warning")


def test_another_load_is_a_warning(arm):
    path, tree, good = arm
    heavier = made_motion(with_load(tree, np.array([6.0, 0.1, 0.0, 0.5])), 0.5, 100.0, seed=5, pieces=1).recordings[0]
    (found,) = odd([*good, replace(heavier, name="loaded")], path)
    assert (found.recording, found.severity) == ("loaded", "warning") and "kg more" in found.evidence


@pytest.mark.parametrize("with_model", [True, pytest.param(False, marks=pytest.mark.slow)], ids=["model", "no model"])
def test_other_poses_speeds_and_warmth_are_not_odd(arm, with_model):
    path, tree, good = arm
    narrow = made_motion(tree, 0.5, 100.0, seed=7, pieces=1, ranges=0.4).recordings[0]
    wide = made_motion(tree, 0.5, 100.0, seed=8, pieces=1, ranges=2.8).recordings[0]
    cold = made_motion(tree, 0.5, 100.0, seed=9, pieces=1, drive=Drive(friction=1.4)).recordings[0]
    still = made_motion(tree, 0.5, 100.0, seed=10, pieces=1, still=1).recordings[0]
    others = [replace(r, name=f"other-{k}") for k, r in enumerate((narrow, wide, cold, still))]
    assert not odd([*good, *others], path if with_model else None)


def test_robot_file_that_changed_is_a_warning_that_names_recordings(arm):
    from tauext.robot.read import robot_sha256

    path, _, good = arm
    known = [replace(cut(r, slice(0, 600)), robot_sha256=robot_sha256(path)) for r in good]
    assert "robot-file-changed" not in {f.code for f in examine(known, path).findings}
    one_other = [replace(r, robot_sha256="f" * 64) if k == ODD else r for k, r in enumerate(known)]
    (found,) = [f for f in examine(one_other, path).findings if f.code == "robot-file-changed"]
    assert (found.severity, found.recording) == ("warning", good[ODD].name) and "ffffffffffff" in found.evidence


def test_a_recording_of_another_rate_is_named(planar):
    names = ("t_ns", "q", "dq", "tau", "contact")
    half = {name: np.ascontiguousarray(getattr(planar[ODD], name)[::2]) for name in names}
    slow = replace(planar[ODD], rate_hz=planar[ODD].rate_hz / 2, **half)  # type: ignore[arg-type]
    (found,) = odd([slow if k == ODD else r for k, r in enumerate(planar)])
    assert (found.recording, found.severity) == (slow.name, "fault") and "samples a second" in found.evidence


def test_stamps_far_too_long_leave_rows_to_search(arm):
    _, _, good = arm
    slow = stretches([replace(r, t_ns=r.t_ns * 1_000_000, rate_hz=r.rate_hz / 1e6) for r in good])
    assert min(len(s.q) for s in search_stretches(slow, 30.0)) > 9


@pytest.mark.parametrize("length_s", [4.0, 30.0, 100.0])
def test_the_search_has_its_time_of_motion_however_short_the_stretches_are(arm, length_s):
    """Servo arms move for seconds and rest: a share of each stretch was too short to count, and 51 rows were left."""
    _, _, good = arm
    whole = max(stretches(good), key=lambda s: s.seconds)
    rows = round(length_s * whole.rate_hz)
    one = whole.changed(lambda x: np.resize(x, (rows, *x.shape[1:])))
    few = search_stretches([one] * round(600 / length_s))
    assert sum(moving_s(s) for s in few) == pytest.approx(60.0, rel=0.05)
    assert min(s.seconds for s in few) >= 2.0


def moving_s(stretch: Stretch) -> float:
    return float((np.abs(stretch.dq) > 0.02).any(axis=1).mean()) * stretch.seconds


def test_the_search_has_its_time_of_motion_where_the_arm_stands(arm):
    """An arm that stands at first: in its first seconds, what friction holds would decide order and axes."""
    _, _, good = arm
    whole = max(stretches(good), key=lambda s: s.seconds)
    stands = whole.changed(lambda x: np.concatenate([np.repeat(x[:1], 2 * len(x), axis=0), x]))
    still = np.arange(len(stands.q))[:, None] < 2 * len(whole.q)
    stands = stands.changed(lambda dq: np.where(still, 0.0, dq), ("dq",))
    (few,) = search_stretches([stands], 0.5 * whole.seconds)
    assert moving_s(few) > 0.2 * whole.seconds


@pytest.mark.parametrize(("rests", "steps"), [(False, [J]), (True, [])])
def test_what_friction_holds_while_a_joint_rests_is_no_step_of_its_torque(longer, rests, steps):
    """A joint that stands while the others move is off, by what friction takes up, in a third of the time."""
    _, tree, recordings = longer
    x = Examination(recordings, tree=tree)
    rows, off = x.rows, (x.rows.time_s // 3).astype(int) % 3 == 0
    tau, dq = rows.tau.copy(), rows.dq.copy()
    tau[off, J] += 3 * tau[:, J].std()
    if rests:
        dq[off, J] = 0.0
    x.rows = replace(rows, tau=tau, dq=dq)
    x.__dict__.pop("fits", None)
    assert [x.joints.index(one.joint) for one in step_findings(x)] == steps
    assert len(often_disturbed(x.rows, x.joints, x.unit)) == len(steps)


@pytest.mark.parametrize(("pushed", "steps"), [(False, []), (True, [J])])
def test_torque_that_moves_the_other_links_is_no_step_without_a_model(tmp_path, pushed, steps):
    """The elbow of a SCARA turns the column: without a model, that torque is off in a quarter of the motion."""
    path = tmp_path / "scara.urdf"
    path.write_text(urdf(scara()))
    x = Examination(made_motion(load_tree(path), 4.0, 100.0, seed=3, drive=Drive(friction=0.5)).recordings)
    off = pushed & ((x.rows.time_s // 3).astype(int) % 6 == 0)
    tau = x.rows.tau.copy()
    tau[:, J] += off * 8 * tau[:, J].std()
    x.rows = replace(x.rows, tau=tau)
    assert [x.joints.index(one.joint) for one in step_findings(x)] == steps


def test_friction_that_grows_with_gravity_is_no_contact(tmp_path):
    path = tmp_path / "parallel.urdf"
    path.write_text(urdf(parallel()))
    drive = Drive(presliding_rad=5e-3, pause_s=3.0, load=0.1, profile="trapezoid")
    x = Examination(made_motion(load_tree(path), 8.0, 100.0, seed=3, drive=drive).recordings, tree=load_tree(path))
    assert not often_disturbed(x.rows, x.joints, x.unit)


@pytest.mark.parametrize(("rests", "grown"), [(False, [J]), (True, [])])
def test_what_friction_holds_in_long_rests_is_no_growth(longer, rests, grown):
    """The offset grows all the time, or only while the joint rests: in two thirds of the time."""
    _, tree, recordings = longer
    x = Examination(recordings, tree=tree)
    rows, off = x.rows, (x.rows.time_s // 3).astype(int) % 3 > 0
    tau, dq = rows.tau.copy(), rows.dq.copy()
    growth = 3 * tau[:, J].std() * (rows.time_s % 30.0) / 30.0
    tau[:, J] += np.where(off | (not rests), growth, 0.0)
    if rests:
        dq[off, J] = 0.0
    x.rows = replace(rows, tau=tau, dq=dq)
    assert [x.joints.index(one.joint) for one in growth_findings(x)] == grown


def moves_between_rests(moves: int, growth_a_s: float, seed: int) -> FitRows:
    """Rows at 10 Hz of a chain of seven joints that moves for 2.8 s of every 10 s, under gravity and friction."""
    rng, time_s = np.random.default_rng(seed), np.arange(0, 10.0 * moves, 0.1)
    poses, move = rng.uniform(-1.2, 1.2, (moves + 1, 7)), (time_s // 10.0).astype(int)
    done = np.clip(time_s % 10.0 / 2.8, 0, 1)[:, None]
    q = poses[move] + (poses[move + 1] - poses[move]) * (3 * done**2 - 2 * done**3)
    dq, none = np.gradient(q, 0.1, axis=0), np.zeros_like(q)
    gravity = np.sin(np.cumsum(q, axis=1)) @ rng.normal(size=(7, 7))
    friction = [np.ones_like(q), dq, *(np.tanh(dq / speed) for speed in COULOMB_SPEEDS_RAD_S)]
    friction += list(np.moveaxis(presliding(q, PRESLIDING_RAD, 10.0), 2, 0))
    tau = gravity + 0.3 * np.tanh(dq / 0.05) + growth_a_s * time_s[:, None]
    of_motion = (none, none, np.gradient(dq, 0.1, axis=0), np.stack(friction, axis=2))
    return FitRows(time_s, np.zeros(len(time_s), int), q, dq, tau, *of_motion)


@pytest.mark.parametrize(("moves", "growth_a_s", "grown"), [(14, 0.0, []), (60, 0.04, [0, 1])])
def test_a_few_moves_between_rests_show_no_growth_without_a_model(longer, moves, growth_a_s, grown):
    """Sines of seven joints follow the errors of gravity in fourteen moves, and the time with them."""
    x = Examination(longer[2])
    x.rows = moves_between_rests(moves, growth_a_s, seed=5)
    x.fits = [fit_joint(x.rows, j) for j in (0, 1)]
    assert [x.joints.index(one.joint) for one in growth_findings(x)] == grown


@pytest.mark.parametrize(("sign", "is_odd"), [(1.0, False), (-1.0, True)])
def test_what_friction_holds_at_rest_makes_no_recording_odd(sign, is_odd):
    """An arm stands for 72 % of the time; in the rests of one recording friction holds 1 N m more of gravity.
    Compared at rest, too, its score was 3.4. A negated torque shows where the arm moves."""
    rows = moves_between_rests(60, 0.0, seed=5)
    part, rests = (rows.time_s // 150.0).astype(int), np.abs(rows.dq).max(axis=1) < 0.02
    tau = (rows.tau + ((part == ODD) & rests)[:, None]) * np.where(part == ODD, sign, 1.0)[:, None]
    parts = {k: replace(rows, tau=tau).taken(part == k) for k in range(4)}
    _, pool = odd_torque._consensus(parts)
    scores = {k: pool.score(pool.errors(one), pool.usual_nm) for k, one in parts.items()}
    assert [k for k, score in scores.items() if score > odd_torque.SUSPECT] == [ODD] * is_odd
