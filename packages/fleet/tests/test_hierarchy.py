"""Mean and covariance of many arms' weights: found again where they are known, whatever one bad arm says."""

import numpy as np
import pytest
from tauext_fleet.hierarchy import LEAST_ARMS, Evidence, learn_hierarchy

BLOCKS = [np.arange(0, 3), np.arange(3, 5)]
MEAN = np.array([5.0, 1.0, -2.0, 0.5, 3.0])
COVARIANCE = np.zeros((5, 5))
COVARIANCE[:3, :3] = 0.3**2 * np.outer(MEAN[:3], MEAN[:3]) + 0.1**2 * np.eye(3)
COVARIANCE[3:, 3:] = [[0.04, 0.02], [0.02, 0.09]]


def arm(rng: np.random.Generator, weights: np.ndarray, rows: int = 400, noise: float = 0.5) -> Evidence:
    """Normal equations of rows with this noise, whose size is known."""
    X = rng.normal(size=(rows, len(weights))) * [1, 2, 0.5, 1, 1]
    y = X @ weights + noise * rng.normal(size=rows)
    return Evidence(X.T @ X / noise**2, X.T @ y / noise**2, rows)


def fleet(count: int, seed: int = 0) -> list[Evidence]:
    rng = np.random.default_rng(seed)
    return [arm(rng, rng.multivariate_normal(MEAN, COVARIANCE)) for _ in range(count)]


def test_mean_and_covariance_of_a_large_fleet_are_found():
    found = learn_hierarchy(fleet(200), BLOCKS)
    error = np.sqrt(np.diag(COVARIANCE) / 200)
    assert (np.abs(found.mean - MEAN) < 4 * error).all()
    # Of a variance from 200 draws the standard error is a tenth; MORE_ARMS take 2 % off the correlations.
    assert np.diag(found.covariance) == pytest.approx(np.diag(COVARIANCE), rel=0.4)
    size = np.sqrt(np.diag(found.covariance))
    true = np.sqrt(np.diag(COVARIANCE))
    assert found.covariance / np.outer(size, size) == pytest.approx(COVARIANCE / np.outer(true, true), abs=0.2)


def test_blocks_do_not_vary_together():
    assert not learn_hierarchy(fleet(20), BLOCKS).covariance[:3, 3:].any()


def test_one_bad_block_moves_nothing_and_is_named():
    good = fleet(15)
    usual = learn_hierarchy(good, BLOCKS)
    bad = arm(np.random.default_rng(9), MEAN * [4, 4, 4, 1, 1])
    found = learn_hierarchy([*good, bad], BLOCKS)
    size = np.sqrt(np.diag(usual.covariance))
    assert (np.abs(found.mean - usual.mean) < 0.25 * size).all()
    assert (np.diag(found.covariance) < 1.6 * np.diag(usual.covariance)).all()
    assert found.trust[-1, 0] < 0.05 < 0.5 < found.trust[-1, 1]
    assert found.trust[:, 0].argmin() == 15


def test_arms_that_agree_are_all_trusted():
    trust = learn_hierarchy(fleet(30), BLOCKS).trust
    assert np.median(trust) == 1 and (trust > 0.5).mean() > 0.95


def test_of_a_few_arms_none_is_the_odd_one_and_the_covariance_is_one():
    few = fleet(LEAST_ARMS - 1)
    found = learn_hierarchy(few, BLOCKS)
    assert (found.trust == 1).all()
    assert np.linalg.eigvalsh(found.covariance)[0] > 0


def test_a_weight_that_no_arm_shows_stays_zero():
    dark = []
    for one in fleet(8):
        gram, moment = one.gram.copy(), one.moment.copy()
        gram[4], gram[:, 4], moment[4] = 0, 0, 0
        dark.append(Evidence(gram, moment, one.rows))
    found = learn_hierarchy(dark, BLOCKS)
    assert found.mean[4] == 0 and not found.covariance[4].any() and np.diag(found.covariance)[:4].all()


def test_an_arm_that_shows_little_is_fitted_by_the_others():
    """Its own weights are the fleet's where its data say nothing."""
    many = fleet(40)
    silent = Evidence(1e-6 * np.eye(5), np.zeros(5), 1.0)
    found = learn_hierarchy([*many, silent], BLOCKS)
    assert found.weights[-1] == pytest.approx(found.mean, abs=1e-3)


@pytest.mark.parametrize("noise", [0.0, 1e-13])
def test_rounding_does_not_decide_what_a_fleet_learns(noise):
    """A fleet's covariance has a positive diagonal where any arm excites a column, whatever the last bits say."""
    rng, evidence = np.random.default_rng(1), []
    for _ in range(4):
        X = rng.normal(size=(200, 4))
        X = np.column_stack([X, X[:, 0] * (1 + noise * rng.normal(size=200)), 1e-6 * X[:, 1]])  # two undetermined pairs
        evidence.append(Evidence(X.T @ X, X.T @ (X[:, 0] + rng.normal(size=200)), 200.0))
    found = learn_hierarchy(evidence, [np.arange(3), np.arange(3, 6)])
    assert (np.diag(found.covariance) > 0).all() and np.linalg.eigvalsh(found.covariance)[0] > 0
    np.testing.assert_allclose(
        found.mean[0] + found.mean[4], 1.0, atol=0.3
    )  # 800 rows of unit noise, drawn to the fleet
