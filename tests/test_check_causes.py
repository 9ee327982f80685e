"""Causes first: turns, lost rows and another arm's robot file are named, and nothing that follows from them."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from check_cases import CURRENT, pressed, refreshed
from made_arms import _serial, six_axis_tree, urdf
from made_recordings import Drive, made_motion

from tauext.check.before_training import check_training
from tauext.check.checks import EXPLAINED, causes_only
from tauext.check.examine import examine, quick_checks
from tauext.check.finding import CODES, Finding
from tauext.check.motion import stretches
from tauext.check.robot_file import possible_inertia
from tauext.check.torque_changes import contacts_at_rest
from tauext.data.servo import AMPERES
from tauext.progress import Silent
from tauext.robot.read import CarriedBody, load_tree


def codes(recordings, robot) -> set[str]:
    return {finding.code for finding in examine(recordings, robot).findings}


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arm")
    tree = six_axis_tree(folder)
    return folder / "arm.urdf", tree, made_motion(tree, 1.5, pieces=3).recordings


@pytest.mark.parametrize("unit", [1.0, 180 / np.pi], ids=["rad", "degrees"])
def test_turns_are_the_only_finding_of_a_position_that_wraps(arm, unit):
    robot, tree, _ = arm
    half = np.pi * unit
    far = made_motion(tree, 1.5, pieces=2, ranges=np.array([4.5, 1.5, 1.5, 1.5, 1.5, 4.5])).recordings
    wraps = [replace(one, q=(one.q * unit + half) % (2 * half) - half, dq=one.dq * unit) for one in far]
    found = [finding for finding in examine(wraps, robot).findings if finding.severity == "fault"]
    turns = [finding for finding in found if finding.code == "position-wraps"]
    assert [f.joint for f in turns] == ["joint1", "joint6"] and "jumps by whole turns" in turns[0].evidence
    assert {f.code for f in found} <= {"position-wraps"} | ({"degrees"} if unit != 1 else set()), found
    assert found[0].code == "position-wraps" and "position-wraps" in {f.code for f in quick_checks(wraps[0], None)}


def test_rows_that_an_import_left_out_are_a_finding_above_one_percent(arm):
    robot, _, recordings = arm
    sentence = "40 rows left out: 'tau_3' is missing or no finite number, first line 701"
    facts = {"dropped": [sentence], "dropped_share": 0.02, "sorted_share": 0.0}
    few = recordings[0].provenance | facts | {"dropped_share": 0.009}
    many = recordings[0].provenance | facts
    assert "rows-dropped" not in codes([replace(recordings[0], provenance=few)], robot)
    (found,) = [
        f for f in examine([replace(recordings[0], provenance=many)], robot).findings if f.code == "rows-dropped"
    ]
    assert found.severity == "warning" and sentence in found.evidence and "2.0% of the rows" in found.evidence


@pytest.mark.parametrize("seed", [11, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (12, 13, 14))])
def test_another_arms_file_is_named_before_the_torque(arm, tmp_path, seed):
    """Arms of random axes: the torque has gravity, but not this file's."""
    _, _, recordings = arm
    other = tmp_path / "other.urdf"
    other.write_text(urdf(_serial(6, seed=seed, heaviest_kg=28.0)))
    names = tuple(link.joint_name for link in load_tree(other).links)
    diagnosis = examine([replace(one, joints=names) for one in recordings], other)
    faults = [finding.code for finding in diagnosis.findings if finding.severity == "fault"]
    # Some arms resemble each other in a joint; what must not come is advice on a torque that is right.
    assert not {"effort-compensated", "effort-sign"} & set(faults), diagnosis.findings


def test_unknown_contact_is_left_out_of_the_fits_and_stated(arm):
    """A push of unknown contact changes nothing; where nothing is known, motion is checked, and the note says so."""
    robot, _, recordings = arm
    free = [replace(one, contact=np.zeros(one.samples, np.int8)) for one in recordings]
    unknown = free[0].contact.copy()
    unknown[: free[0].samples // 2] = -1
    tau = free[0].tau + 8.0 * (unknown == -1)[:, None]
    odd = [replace(free[0], tau=tau, contact=unknown), *free[1:]]
    found = examine(odd, robot).findings
    assert {f.code for f in found} == codes(free, robot) | {"contact-unknown"}
    (note,) = [finding for finding in found if finding.code == "contact-unknown"]
    assert f"unknown, in {(unknown == -1).sum() / free[0].rate_hz:.1f} s of" in note.evidence
    nothing = [replace(one, tau=-one.tau, contact=np.full(one.samples, -1, np.int8)) for one in free]
    found = examine(nothing, robot).findings
    assert {"effort-sign", "contact-unknown"} <= {finding.code for finding in found}
    assert any("no motion is known to be free" in finding.advice for finding in found)


def test_presses_are_found_in_currents_of_unknown_constants(arm):
    """What the constants explain is no reason not to search."""
    robot, tree, _ = arm
    recordings = made_motion(tree, 3.0, pieces=3).recordings
    amperes = np.array([8.0, 12.0, 10.0, 5.0, 4.0, 3.0])

    def in_amperes(one, k, changes):
        changed = replace(one, **changes)
        return replace(changed, tau=changed.tau / amperes, provenance=one.provenance | {"torque": AMPERES})

    free = [in_amperes(one, k, {}) for k, one in enumerate(recordings)]
    touched = [in_amperes(one, k, pressed(one, k)) for k, one in enumerate(recordings)]
    assert "contact-in-free-motion" not in codes(free, robot)
    assert "contact-in-free-motion" in codes(touched, robot)


class Heard(Silent):
    def __init__(self):
        self.sentences = []

    def say(self, sentence):
        self.sentences.append(sentence)


RESTING = {
    "moves": Drive(pause_s=3.0),
    "currents": replace(CURRENT, pause_s=3.0),
    "trapezoids": Drive(profile="trapezoid", presliding_rad=1e-3, noise=0.03, pause_s=3.0),
}


def at_rest(recording, settled_s: float) -> np.ndarray:
    """Whether all joints have rested for so long, (samples,)."""
    moves, time_s = (np.abs(recording.dq) > 0.02).any(axis=1), recording.time_s
    return ~moves & (time_s - np.maximum.accumulate(np.where(moves, time_s, -np.inf)) > settled_s)


def held_by_brakes(r, k):
    """Drives are off 0.8 s after each motion."""
    off, noise = at_rest(r, 0.8), np.random.default_rng(k).standard_normal(r.tau.shape)
    return {"tau": np.where(off[:, None], 0.02 * r.tau.std(axis=0) * noise, r.tau)}


def wound_down(r, k):
    """An integral action forgets the friction of the motion within a second."""
    moves = (np.abs(r.dq) > 0.02).any(axis=1)
    since_s = r.time_s - np.maximum.accumulate(np.where(moves, r.time_s, r.time_s[0]))
    return {"tau": r.tau + (~moves * np.exp(-since_s))[:, None] * 0.5 * r.tau.std(axis=0)}


def swung_out(r, k):
    """Vibration of 3 Hz after each stop."""
    moves = (np.abs(r.dq) > 0.02).any(axis=1)
    since_s = r.time_s - np.maximum.accumulate(np.where(moves, r.time_s, r.time_s[0]))
    swing = ~moves * np.exp(-since_s / 0.4) * np.sin(2 * np.pi * 3 * since_s)
    return {"tau": r.tau + swing[:, None] * 0.5 * r.tau.std(axis=0)}


def coarse(r, k):
    step = r.tau.std(axis=0) / 5
    return {"tau": np.round(r.tau / step) * step}


@pytest.mark.parametrize("drive", RESTING)
def test_presses_are_found_at_rest_without_a_model(tmp_path, drive):
    """Nothing else changes the torque there: no brake, vibration, integral action, step or slow refresh."""
    made = made_motion(six_axis_tree(tmp_path), 4.0, pieces=3, drive=RESTING[drive]).recordings

    def found(change) -> list[Finding]:
        changed = [replace(one, **change(one, k)) for k, one in enumerate(made)]
        return contacts_at_rest(stretches(changed), changed)

    (one,) = found(pressed)
    assert re.match(r"2\d changes of the torque in \d\d s in which all joints rest, .* of 'free-\d'", one.evidence)
    assert found(lambda r, k: coarse(replace(r, **pressed(r, k)), k))
    for free in (lambda r, k: {}, held_by_brakes, wound_down, swung_out, coarse, lambda r, k: refreshed(r, "tau", 8)):
        assert not found(free), free
    labelled = [replace(one, **pressed(one, k), contact=np.ones(one.samples, np.int8)) for k, one in enumerate(made)]
    assert not contacts_at_rest(stretches(labelled), labelled)


def test_the_check_without_a_model_names_presses_and_the_training_what_it_misses(tmp_path, monkeypatch):
    made = made_motion(six_axis_tree(tmp_path), 3.0, pieces=3, drive=RESTING["trapezoids"]).recordings
    touched = [replace(one, **pressed(one, k)) for k, one in enumerate(made)]
    assert "contact-in-free-motion" not in codes(made, None)
    assert "contact-in-free-motion" in codes(touched, None)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    heard = Heard()
    assert "contact-in-free-motion" in {one.code for one in check_training(touched, None, None, False, 1, heard)}
    assert "no robot model: contacts without a label are only found where all joints rest" in heard.sentences


def test_the_table_of_causes_hides_what_they_explain():
    assert set(EXPLAINED) <= set(CODES) and {code for of in EXPLAINED.values() for code in of} <= set(CODES)
    found = [Finding(code, "fault", "a", "", "") for code in ("effort-sign", "effort-scale", "stuck")]
    assert causes_only(found) == found
    order = Finding("joint-order", "fault", "a", "", "")
    assert [f.code for f in causes_only([*found, order])] == ["joint-order", "stuck"]
    only_warned = replace(order, severity="warning")
    assert len(causes_only([*found, only_warned])) == 4


@pytest.mark.parametrize(("excess", "severity"), [(0.09, "note"), (30.0, "fault")])
def test_an_impossible_inertia_is_a_fault_where_its_effect_shows(arm, tmp_path, excess, severity):
    """The largest moment of a link's inertia exceeds the sum of the others; the torques are those of the true file."""
    robot, _, recordings = arm
    number = count(1)

    def third(match: re.Match) -> str:
        if next(number) != 3:
            return match[0]
        return f'<inertia ixx="0.02" iyy="0.03" izz="{0.05 * (1 + excess)}" ixy="0" ixz="0" iyz="0"/>'

    path = tmp_path / "arm.urdf"
    path.write_text(re.sub(r"<inertia .*?/>", third, robot.read_text()))
    (one,) = [f for f in examine(recordings, path).findings if f.code == "inertia-impossible"]
    assert one.severity == severity
    assert re.search(r"exceeds the sum of the others by .* it changes the torque of '\w+' by up to .* Nm", one.evidence)


def test_one_factor_at_all_joints_is_a_unit_and_no_payload(arm):
    """Torques in pound-force feet: less load would explain some of it, and only at some joints."""
    robot, _, recordings = arm
    found = examine([replace(one, tau=one.tau / 1.3558) for one in recordings], robot).findings
    assert "payload" not in {one.code for one in found}
    (one,) = [one for one in found if one.code == "effort-scale"]
    assert one.evidence == "effort = 0.738 times the model's torque at all 6 joints that show it"
    assert "multiply the effort by 1.36, or correct the model" in one.advice


def test_the_nearest_possible_inertia_keeps_what_is_possible_and_shares_the_excess():
    for given, nearest in (([1.0, 2.0, 2.5], [1.0, 2.0, 2.5]), ([1.0, 2.0, 3.4], [1.2, 2.2, 3.4])):
        np.testing.assert_allclose(possible_inertia(CarriedBody("l", "j", 5.0, np.array(given))), nearest)
    # A litre of water as a sphere: r = 62.04 mm.
    ball = possible_inertia(CarriedBody("l", "j", 1.0, np.zeros(3)))
    np.testing.assert_allclose(ball, 0.4 * 0.06204**2, rtol=1e-3)


def test_motion_without_a_model_is_no_zero_that_grows(tmp_path):
    """Minutes of moves leave errors of gravity that follow the time; a zero that grows does so in each part of it."""
    drive = Drive(profile="trapezoid", presliding_rad=1e-3, noise=0.03, pause_s=1.0)
    made = made_motion(six_axis_tree(tmp_path), 3.0, pieces=3, drive=drive).recordings
    assert "torque-changes" not in [found.code for found in examine(made, None).findings]
    at_s, growing = np.cumsum([0.0, *(one.duration_s for one in made)]), []
    for one, start_s in zip(made, at_s, strict=False):
        tau = one.tau.copy()
        tau[:, 4] += 3.0 * one.tau[:, 4].std() / 60 * (start_s + one.time_s)
        growing.append(replace(one, tau=tau))
    found = [found for found in examine(growing, None).findings if found.code == "torque-changes"]
    assert [one.joint for one in found] == ["joint5"] and "zero changes" in found[0].evidence
