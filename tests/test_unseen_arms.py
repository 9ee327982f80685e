"""The simulator of arms that nobody tuned for: its truth is a truth."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

from unseen.arms import makers, true_arm
from unseen.contacts import Contact, draw_contacts, label
from unseen.motions import ACCELERATIONS_RAD_S2, draw_motion
from unseen.simulation import RATE_HZ, simulate

from tauext.robot import load_tree

SEVEN = makers(Path())["seven_axis"]
PUSH = Contact("push", 1.0, 1.8, 4, 0.7, (0.0, 0.6, 0.8), 40.0, (1.0, 1.8))


@pytest.fixture(scope="module")
def pushed():
    rng = np.random.default_rng(0)
    arm = true_arm(SEVEN, rng)
    setpoints = draw_motion(SEVEN, 3 * RATE_HZ, RATE_HZ, rng)
    return arm, setpoints, simulate(arm, load_tree(SEVEN.model, SEVEN.joints), setpoints, SEVEN.torque_nm, [PUSH], 0.0)


def test_motor_friction_and_contact_are_all_that_changes_the_momentum(pushed):
    """dp/dt + beta = motor - friction + tau_ext by the core's tree, where MuJoCo moved the arm."""
    arm, _, run = pushed
    dq = np.vstack([np.zeros(7), np.diff(run.q, axis=0) * RATE_HZ])  # semi-implicit Euler: q takes the step's new dq
    p, beta = arm.tree.momentum(run.q, dq)
    left = np.diff(p, axis=0) * RATE_HZ + beta[:-1] - (run.motor_nm - run.friction_nm + run.tau_ext)[:-1]
    smooth = np.cumsum(left, axis=0)[50::50] / 50
    means = np.diff(smooth, axis=0)
    # Means over 50 ms; the integrator is of first order, the torques are of 10 to 60 Nm.
    assert np.abs(means).max() < 0.05
    assert np.abs(run.tau_ext[1400]).max() > 5 and not run.tau_ext[:1000].any() and not run.tau_ext[1801:].any()


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
    assert PUSH.force_n(1.4) == 40.0 and PUSH.force_n(0.99) == PUSH.force_n(1.81) == 0.0
    assert replace(PUSH, kind="impact").force_n(1.4) == pytest.approx(40.0)
