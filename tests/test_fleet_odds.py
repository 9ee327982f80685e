"""Probabilities of a table of arms and joints: closed forms, invariances, and what is no wear."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import halfnorm, norm

from tauext.fleet.compare import FLEET_FRICTION, OWN_FRICTION, OWN_TOOL
from tauext.fleet.odds import NAMED, ODD_ARM, Question, Spreads, Table, learn_odds

ERROR = 0.01


def healthy(arms: int, joints: int = 6, arm_spread: float = 0.08, joint_spread: float = 0.03, seed: int = 0):
    """Changes of arms of which none wears."""
    rng = np.random.default_rng(seed)
    return rng.normal(0, arm_spread, (arms, 1)) + rng.normal(0, joint_spread, (arms, joints))


def asked(values: np.ndarray, question: Question = OWN_FRICTION):
    return learn_odds(values, np.full(values.shape, ERROR), question)


def density(x: float, spread: float, jump: float) -> tuple[float, float, float]:
    """Of a healthy number, of one that is more, of one that is less; by summing over w."""
    w = np.linspace(0, 8 * jump, 8001)
    at = halfnorm.pdf(w, scale=jump) * np.r_[0.5, np.ones(7999), 0.5] * (w[1] - w[0])
    up, down = (float(at @ norm.pdf(x + sign * w, scale=spread)) for sign in (-1, 1))
    return norm.pdf(x, scale=spread), up, down


@pytest.mark.parametrize("x", [-0.4, 0.0, 0.1, 0.3])
def test_a_single_number_has_the_probability_of_bayes(x):
    table = Table(np.array([[x]]), np.array([[ERROR]]), np.array([[True]]), OWN_TOOL)
    found = table.sums(Spreads(0.0, 0.05), np.zeros(1), np.zeros(1)).posterior(0.02)
    same, up, down = density(x, np.hypot(0.05, ERROR), OWN_TOOL.jump)
    whole = 0.98 * same + 0.01 * (up + down)
    assert found.more[0, 0] == pytest.approx(0.01 * up / whole, rel=1e-4)
    assert found.less[0, 0] == pytest.approx(0.01 * down / whole, rel=1e-4, abs=1e-11)


def test_what_an_arm_does_is_integrated_over():
    x, spread = np.array([0.30, 0.05, 0.02]), 0.05
    table = Table(x[None], np.full((1, 3), ERROR), np.ones((1, 3), dtype=bool), OWN_FRICTION)
    found = table.sums(Spreads(0.08, spread), np.zeros(3), np.zeros(3)).posterior(0.02)

    def together(shift: float, worn: bool) -> float:
        odd = np.hypot(OWN_FRICTION.odd_arm, 0.08)
        at = (1 - ODD_ARM) * norm.pdf(shift, scale=0.08) + ODD_ARM * norm.pdf(shift, scale=odd)
        for k, value in enumerate(x):
            same, up, down = density(value - shift, np.hypot(spread, ERROR), OWN_FRICTION.jump)
            at *= 0.01 * up if worn and k == 0 else 0.98 * same + 0.01 * (up + down)
        return at

    grid = np.linspace(-0.4, 0.6, 81)
    worn, whole = (sum(together(shift, which) for shift in grid) for which in (True, False))
    assert found.more[0, 0] == pytest.approx(worn / whole, rel=1e-3)


def test_a_worn_joint_is_named_and_no_other():
    x = healthy(20)
    x[3, 2] += np.log(1.3)
    found = asked(x)
    assert found.more[3, 2] > 0.9
    assert np.delete(np.maximum(found.more, found.less).ravel(), 3 * 6 + 2).max() < NAMED
    assert 1.05 < np.exp(found.named_from) < 1.3


@pytest.mark.slow
def test_less_friction_is_told_from_more():
    x = healthy(20)
    x[3, 2] -= np.log(1.4)
    found = asked(x)
    assert found.less[3, 2] > 0.9 > 0.1 > found.more[3, 2]


def test_a_cold_day_of_an_arm_and_a_winter_of_all_are_no_wear():
    x = healthy(15) + np.log(1.15)
    x[4] += np.log(1.35)
    found = asked(x)
    assert np.maximum(found.more, found.less).max() < 0.2
    assert found.shift[4] == pytest.approx(np.log(1.35), abs=0.15)
    assert found.centre.mean() + found.shift.mean() == pytest.approx(x.mean(), abs=0.05)


@pytest.mark.slow
def test_days_that_differ_much_hide_what_calm_ones_show():
    worn = np.zeros((20, 6))
    worn[3, 2] = np.log(1.3)
    calm, rough = asked(healthy(20, joint_spread=0.02) + worn), asked(healthy(20, joint_spread=0.10) + worn)
    assert calm.more[3, 2] > 0.99
    assert rough.more[3, 2] < NAMED
    assert rough.joint_spread > 2 * calm.joint_spread
    assert rough.named_from > calm.named_from


def test_beside_the_fleet_alone_a_factor_of_1_3_is_not_named():
    rng = np.random.default_rng(2)
    x = np.log(rng.uniform(0.7, 1.3, (20, 6)))
    x[5, 1] = np.log(1.3)
    found = asked(x, FLEET_FRICTION)
    assert found.more[5, 1] < 0.1
    assert np.exp(found.named_from) > 1.5


def test_order_of_arms_and_joints_and_the_unit_do_not_matter():
    x = healthy(8)
    x[1, 2] += 0.25
    rows, columns = np.random.default_rng(1).permutation(8), np.random.default_rng(2).permutation(6)
    first, moved = asked(x, FLEET_FRICTION), asked(x[rows][:, columns] + np.log(3.6), FLEET_FRICTION)
    assert moved.more == pytest.approx(first.more[rows][:, columns], abs=2e-3)
    assert moved.joint_spread == pytest.approx(first.joint_spread, rel=1e-2)


def test_a_number_that_is_not_there_says_nothing_and_harms_no_other():
    x = healthy(10)
    x[1, 2] += np.log(1.4)
    x[0, 0] = np.nan
    found = asked(x)
    assert np.isnan(found.more[0, 0])
    assert np.isfinite(np.delete(found.more.ravel(), 0)).all()
    assert found.more[1, 2] > 0.9
