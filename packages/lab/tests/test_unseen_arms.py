"""The simulator of arms as an integrator meets them: its truth is a truth, and fresh arms stay apart in the tables."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pyarrow.csv
import pytest

sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))
sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from unseen import recordings, working
from unseen.arms import JITTER_SHARE, arm_of, fresh_makers, makers, true_arm
from unseen.recordings import nearest, truth_of
from unseen.simulation import (
    ACCELERATIONS_RAD_S2,
    NUMBER,
    POINTER,
    PRESLIDING,
    RATE_HZ,
    STOP_S,
    WHOLE,
    Contact,
    Pressing,
    address,
    build,
    compiled,
    draw_contacts,
    draw_motion,
    joint_table,
    label,
    simulate,
)
from unseen_arms import Outcome, tables

from tauext.robot.read import load_tree

SEVEN = makers(Path())["seven_axis"]
FRESH = list(fresh_makers().values())
PUSH = Contact("push", 1.0, 1.8, 4, 0.7, (0.0, 0.6, 0.8), 40.0, (1.0, 1.8))


@pytest.fixture(scope="module", params=[SEVEN, *FRESH], ids=lambda maker: maker.name)
def pushed(request):
    maker, rng = request.param, request.param.random(0, 0)
    arm = true_arm(maker, rng)
    setpoints = draw_motion(maker, 3 * RATE_HZ, RATE_HZ, rng)
    return arm, setpoints, simulate(arm, load_tree(maker.model, maker.joints), setpoints, maker.torque_nm, [PUSH], 0.0)


def test_motor_friction_and_contact_are_all_that_changes_the_momentum(pushed):
    """dp/dt + beta = motor - friction + tau_ext by the core's tree, where MuJoCo moved the arm."""
    arm, _, run = pushed
    # Semi-implicit Euler: q takes the step's new dq.
    dq = np.diff(run.q, axis=0, prepend=run.q[:1]) * RATE_HZ
    p, beta = arm.tree.momentum(run.q, dq)
    left = np.diff(p, axis=0) * RATE_HZ + beta[:-1] - (run.motor_nm - run.friction_nm + run.tau_ext)[:-1]
    smooth = np.cumsum(left, axis=0)[50::50] / 50
    means = np.diff(smooth, axis=0)
    # Means over 50 ms; the integrator is of first order, the torques are of 10 to 60 Nm.
    assert np.abs(means).max() < 0.05
    assert np.abs(run.tau_ext[1400]).max() > 5 and not run.tau_ext[:1000].any() and not run.tau_ext[1801:].any()


def test_a_surface_presses_on_the_tool_and_resists_its_sliding():
    """The force is that of the rows, across the surface against the tip's motion; the joints feel nothing else."""
    rng, tip_m, axis = SEVEN.random(0, 0), np.array([0.01, 0.0, 0.15]), np.array([0.0, 0.0, -1.0])
    arm, known = true_arm(SEVEN, rng), load_tree(SEVEN.model, SEVEN.joints)
    setpoints = draw_motion(SEVEN, 3 * RATE_HZ, RATE_HZ, rng)
    rows = np.tile([30.0, 0.2, *tip_m], (3 * RATE_HZ, 1))
    rows[:RATE_HZ, 0] = 0.0
    run = simulate(arm, known, setpoints, SEVEN.torque_nm, [], 0.0, pressing=Pressing(axis, rows))
    assert not run.tool_n[:RATE_HZ].any() and not run.tau_ext[:RATE_HZ].any()
    model = build(arm.tree)
    data = mujoco.MjData(model)
    at, tips, normals = np.arange(RATE_HZ + 50, len(run.q), 100), [], []
    for q in (run.q[k + step] for k in at for step in (-1, 0)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        rotation = data.xmat[-1].reshape(3, 3)
        tips.append(data.xpos[-1] + rotation @ tip_m)
        normals.append(rotation @ axis)
    moved, normal = np.diff(tips, axis=0)[::2], np.array(normals[1::2])
    force = run.tool_n[at]
    np.testing.assert_allclose((force * normal).sum(axis=1), 30.0, rtol=1e-3)
    across = force - (force * normal).sum(axis=1, keepdims=True) * normal
    slides = np.linalg.norm(moved, axis=1) * RATE_HZ > 0.1
    assert slides.sum() > 5
    np.testing.assert_allclose(np.linalg.norm(across[slides], axis=1), 6.0, rtol=0.01)
    # the power that the surface takes is the joints' power
    dq = np.diff(run.q, axis=0)[at - 1]
    np.testing.assert_allclose((run.tau_ext[at] * dq).sum(axis=1), (force * moved).sum(axis=1), atol=2e-5)


COULOMB_NM, STATIC, STRIBECK_RAD_S, BENT_RAD = 4.0, 1.25, 0.02, 5e-4
STEADY_NM = STATIC * COULOMB_NM
STEP_S = 1e-4


def friction_of(presliding, x, dt=STEP_S):
    """Friction of a joint along these positions from 0, [N m]: no viscous part, ripple or bristle damping."""
    arm, one = true_arm(SEVEN, np.random.default_rng(0)), np.ones(1)
    plain = {"viscous_nm_s_rad": 0 * one, "ripple_nm": 0 * one, "asymmetry": 0 * one, "load_share": 0 * one}
    plain |= {"coulomb_nm": COULOMB_NM * one, "static_share": STATIC * one, "stribeck_rad_s": STRIBECK_RAD_S * one}
    plain |= {"warm_drop": one, "ripple_cycles": one, "ripple_phase_rad": one, "presliding_rad": BENT_RAD * one}
    table = joint_table(replace(arm, **plain, presliding=presliding), 0 * one, one, [1.0])
    speed, out = np.diff(x, prepend=0.0) / dt, np.empty(len(x))
    arguments = (POINTER, POINTER, NUMBER, WHOLE, POINTER)
    compiled("arm_steps", arguments, None, "friction_steps")(
        address(np.ascontiguousarray(table[:, 0])), address(speed), dt, len(x), address(out)
    )
    return out


@pytest.mark.parametrize("presliding", PRESLIDING)
@pytest.mark.parametrize("speed", [-1.0, -0.01, 0.001, 0.02, 0.5])
def test_friction_in_steady_sliding_is_the_stribeck_curve(presliding, speed):
    x = speed * STEP_S * np.arange(1, 1 + round(0.02 / abs(speed) / STEP_S))
    curve = COULOMB_NM * (1 + (STATIC - 1) * np.exp(-((speed / STRIBECK_RAD_S) ** 2)))
    assert friction_of(presliding, x)[-1] == pytest.approx(np.sign(speed) * curve, rel=1e-9)


def wave(middle, amplitude, cycles, steps=2000):
    """Positions, from the middle on, at so slow a speed that friction is the static one."""
    return middle + amplitude * np.sin(2 * np.pi * np.arange(1, 1 + cycles * steps) / steps)


@pytest.mark.parametrize("presliding", PRESLIDING)
def test_a_small_displacement_is_that_of_a_spring_and_vibration_straightens_lugre_s_alone(presliding):
    small = 0.2 * BENT_RAD
    spring = friction_of(presliding, np.linspace(0, small, 1001), dt=1.0)
    bends = 1 - np.exp(-small / BENT_RAD) if presliding == "lugre" else small / BENT_RAD
    assert spring[-1] == pytest.approx(STEADY_NM * bends, rel=1e-6)
    # The load that keeps the middle of a vibration in place: LuGre's falls by exp(-4 a / BENT_RAD) a cycle, so that the
    # joint would drift under a load that stays.
    cycles, amplitude = 20, 0.02 * BENT_RAD
    there = np.append(np.linspace(0, small, 1001), wave(small, amplitude, cycles))
    after = friction_of(presliding, there, dt=1.0)[-1]
    kept = np.exp(-4 * cycles * amplitude / BENT_RAD) if presliding == "lugre" else 1.0
    assert after == pytest.approx(kept * spring[-1], rel=0.02 if presliding == "lugre" else 1e-6)


def test_the_loop_of_maxwell_slip_has_the_area_of_its_slips():
    amplitude, steps, elements = 1.2 * BENT_RAD, 20_000, np.arange(1, 7)
    x = wave(0.0, amplitude, 2, steps)
    force = friction_of("maxwell-slip", x, dt=1.0)
    area = np.sum((force[1:] + force[:-1])[-steps:] / 2 * np.diff(x)[-steps:])
    slip_from = elements * np.sum(1 / elements) / 6 * BENT_RAD
    assert area == pytest.approx(np.sum(4 * STEADY_NM / 6 * np.maximum(amplitude - slip_from, 0)), rel=1e-3)


def test_the_drive_follows_and_friction_opposes_the_motion(pushed):
    arm, (q_des, dq_des, _), run = pushed
    assert np.abs(run.q - q_des)[500:1000].max() < 0.01
    steady = np.abs(dq_des) > 0.2
    assert (run.friction_nm * dq_des)[steady].min() > 0
    assert (np.abs(run.friction_nm)[steady] > 0.8 * np.broadcast_to(arm.coulomb_nm, steady.shape)[steady]).mean() > 0.95


def test_motions_keep_the_arm_s_bounds_and_setpoints_belong_together():
    q, dq, ddq = draw_motion(SEVEN, 60 * RATE_HZ, RATE_HZ, np.random.default_rng(1))
    assert (q >= np.array(SEVEN.low_rad) - 1e-9).all() and (q <= np.array(SEVEN.high_rad) + 1e-9).all()
    assert (np.abs(dq).max(axis=0) <= SEVEN.speed_rad_s).all()
    assert np.abs(ddq).max() <= 1.01 * ACCELERATIONS_RAD_S2[1]  # a move lasts whole milliseconds
    np.testing.assert_allclose(np.diff(q, axis=0) * RATE_HZ, (dq[1:] + dq[:-1]) / 2, atol=0.01)


def test_contacts_are_apart_and_labels_are_within_their_error():
    contacts = draw_contacts(25, 300.0, 7, np.random.default_rng(2))
    assert all(a.end_s + 1 < b.start_s for a, b in zip(contacts, contacts[1:], strict=False))
    time_s = np.arange(300_000) / 1000
    marked = label(contacts, time_s)
    rises = time_s[np.flatnonzero(np.diff(marked) == 1) + 1]
    assert len(rises) == 25 and np.abs(rises - [c.start_s for c in contacts]).max() <= 0.031


def test_the_first_arms_keep_their_draws_and_fresh_ones_have_their_own():
    assert SEVEN.random(3, 4).uniform() == np.random.default_rng([3, 4]).uniform()
    first = {maker.random(3, 4).uniform() for maker in (SEVEN, *FRESH)}
    assert len(first) == 1 + len(FRESH)


@pytest.mark.parametrize("maker", FRESH, ids=lambda maker: maker.name)
def test_programs_of_fresh_arms_end_in_abrupt_stops(maker):
    q, dq, ddq = draw_motion(maker, 180 * RATE_HZ, RATE_HZ, np.random.default_rng(1))
    assert (q >= np.array(maker.low_rad)).all() and (q <= np.array(maker.high_rad)).all()
    assert (np.abs(dq).max(axis=0) <= maker.speed_rad_s).all()
    np.testing.assert_allclose(np.diff(q, axis=0) * RATE_HZ, (dq[1:] + dq[:-1]) / 2, atol=0.03)
    abrupt = np.abs(ddq).max(axis=1) > 1.01 * ACCELERATIONS_RAD_S2[1]
    edges = np.flatnonzero(np.diff(abrupt.astype(int), prepend=0))
    lasting_s = (edges[1::2] - edges[::2]) / RATE_HZ
    assert len(lasting_s) >= 4 and lasting_s.min() >= STOP_S[0] and lasting_s.max() <= STOP_S[1]
    assert not dq[edges[1::2]].any()


@pytest.mark.parametrize("maker", FRESH, ids=lambda maker: maker.name)
def test_logs_of_fresh_arms_have_jittering_stamps_and_lack_samples(maker, tmp_path):
    recordings.write_take(maker, 0, 0, tmp_path, [recordings.Take("short", "train", 0.2, 1)])
    table = pyarrow.csv.read_csv(tmp_path / "short.csv")
    time_s, touched = table["time"].to_numpy(), table["touched"].to_numpy()
    assert (np.diff(time_s) > 0).all()
    place = np.round(time_s * maker.rate_hz)
    jitter = time_s * maker.rate_hz - place
    assert np.std(jitter) == pytest.approx(JITTER_SHARE, rel=0.15) and np.abs(jitter).max() < 0.41
    assert 1 - len(place) / (12 * maker.rate_hz) == pytest.approx(maker.missing_share, abs=0.02)
    (contact,) = json.loads((tmp_path / "short.truth.json").read_text())
    begin_s, end_s = contact["label_s"]
    inside = (place / maker.rate_hz >= begin_s) & (place / maker.rate_hz <= max(end_s, begin_s + 0.03))
    np.testing.assert_array_equal(touched, inside)
    assert touched.any() and max(contact["peak_nm"]) > 0
    assert maker.measured_velocity == ("velocity_1" in table.column_names)


def outcome(arm: str, fresh: bool, recipe: str, found: int, free: int, after: int) -> Outcome:
    return Outcome(
        arm=arm,
        fresh=fresh,
        model="urdf",
        recipe=recipe,
        rmse_nm=np.ones(2),
        rmse_share=np.ones(2) / 10,
        limit_nm=np.ones(2) * 5,
        found=np.arange(4) < found,
        strength=np.array([4.0, 4.0, 4.0, 1.0]),
        kinds=np.array(["impact", "push", "hold", "push"]),
        false_after_contact=after,
        false_free=free,
        free_hours=0.5,
        delays=dict.fromkeys(f"delay_{kind}_s" for kind in ("median", "p95", "from_onset_median", "from_onset_p95")),
    )


def test_tables_keep_fresh_arms_apart_and_total_each_group():
    old = [outcome("ur5", False, "prior", 3, 0, 1), outcome("panda", False, "prior", 4, 2, 0)]
    new = [outcome("palletizer", True, "prior", 1, 1, 2), outcome("palletizer", True, "friction", 0, 5, 5)]
    before, after = "\n".join(tables([*old, *new])).split("## Arms run once, afterwards")
    assert "## Arms used for development" in before and "palletizer" not in before and "ur5" not in after
    assert "| ur5 | urdf | prior | 3/4 | 3/3 | 2.0 | 0 | 1 |" in before
    assert "| **all** | urdf | prior | 7/8 | 6/6 | 3.0 | 2 | 1 |" in before
    assert "| **all** | urdf | prior | 1/4 | 1/3 | 6.0 | 1 | 2 |" in after
    assert "| **all** | urdf | friction | 0/4 | 0/3 | 20.0 | 5 | 5 |" in after
    assert "run once" not in "\n".join(tables(old))


def test_a_label_is_held_against_its_contact_whether_its_take_was_cut_or_not():
    truths = {"contacts-1": [{"label_s": [10.0, 11.0]}, {"label_s": [170.0, 171.0]}], "contacts-2": []}
    assert truth_of("contacts-1", truths) is truth_of("contacts-1-01", truths) is truths["contacts-1"]
    assert truth_of("contacts-2-00", truths) == []
    assert nearest(truths["contacts-1"], 9.8 + 160.2)["label_s"] == [170.0, 171.0]  # 9.8 s into the second piece


def test_arms_of_one_type_share_links_and_gears_and_differ_in_friction_tool_and_constants():
    maker = replace(SEVEN, type_seed=3)
    one, other = (arm_of(maker, seed) for seed in (0, 1))
    assert (one.ripple_cycles == other.ripple_cycles).all()
    share = one.coulomb_nm / other.coulomb_nm
    assert (share != 1).all() and (share > 0.7 * 0.9 / 1.3 / 1.1).all()
    for a, b in zip(one.tree.links[:-1], other.tree.links[:-1], strict=True):
        assert a.com == b.com and a.mass == pytest.approx(b.mass, rel=0.021) and a.rotor_inertia == b.rotor_inertia
    assert abs(one.tree.links[-1].mass - other.tree.links[-1].mass) > 0.02
    assert arm_of(maker, 0).tree.links[-1].mass == one.tree.links[-1].mass
    assert recordings.told_constants(maker, 0, True) == recordings.told_constants(maker, 1, True)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rig", "palletizer", "so101"])
def test_arms_at_work_repeat_programs_touches_differ_and_loads_weigh(name, monkeypatch):
    monkeypatch.setattr(working, "STRETCH_S", 20.0)
    monkeypatch.setattr(working, "REPEATED", 1.0)
    monkeypatch.setattr(working, "PROGRAMS", 1)
    arm, bare = working.working(name, 0), working.Part("bare", 1.0)
    first, second, loaded, calm = (
        arm.stretch(0, number, part, 0.0, touches)
        for number, part, touches in ((1, bare, 1), (2, bare, 1), (1, working.Part("load", 1.0, 2), 1), (1, bare, 0))
    )
    touched = first.contact == 1
    assert touched.any() and not np.abs(first.tau_ext[~touched]).max() > working.TOUCHED_NM_ARM
    assert not (calm.contact == 1).any() and np.isfinite(calm.tau).all()
    untouched = ~touched & (second.contact == 0) & (first.time_s < np.argmax(touched) / first.rate_hz)
    np.testing.assert_allclose(first.q[untouched], second.q[untouched], atol=0.02)  # the same program
    assert (first.contact != second.contact).any()
    moved = np.abs(loaded.tau - first.tau)[untouched].mean(axis=0) / np.abs(first.tau[untouched]).mean(axis=0)
    assert moved.max() > 0.05
