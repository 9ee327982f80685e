"""What a refit expects of joints that hardly moved, from those that did."""

import numpy as np
import pytest
from tauext_fleet.expected_friction import agreeing, expectations, predicted, settings_with

ALIKE = 0.05**2 * (0.7 + 0.3 * np.eye(4))
"""Four joints whose friction goes up and down by 5 %, much of it together."""


def test_joints_that_moved_are_expected_as_without_a_fleet():
    settings = settings_with([1.0, 1.2], [0.1, 0.04], [False, True])
    assert settings.expected == [1.0, 1.2] and settings.expected_error == [0.3, 0.04]


def test_a_still_joint_is_expected_at_the_conditional_mean():
    factor, error = np.array([1.10, 1.10, 1.10, 0.3]), np.array([0.01, 0.01, 0.01, 0.5])
    told = expectations(factor, error, np.array([40.0, 40.0, 40.0, 0.0]), ALIKE)
    assert told is not None and told[2].tolist() == [False, False, False, True]
    # A draw of all joints beside what three of them show, by chance alone: where they show 10 %, the fourth is ...
    rng = np.random.default_rng(0)
    draws = rng.multivariate_normal(np.zeros(4), ALIKE, 200_000)
    shown = draws[:, :3] + 0.01 / 1.1 * rng.normal(size=(200_000, 3))
    fit = np.linalg.lstsq(shown, draws[:, 3], rcond=None)[0]
    assert np.log(told[0][3]) == pytest.approx(fit.sum() * np.log(1.1), rel=0.02)
    assert told[1][3] / told[0][3] == pytest.approx(np.std(draws[:, 3] - shown @ fit), rel=0.02)


def test_a_worn_joint_tells_the_others_nothing():
    log_factor = np.log([1.05, 1.06, 1.40, 1.05])
    assert agreeing(np.arange(4), log_factor, np.full(4, 0.01), ALIKE).tolist() == [0, 1, 3]
    told = expectations(np.exp(log_factor), np.full(4, 0.01), np.array([40.0, 40.0, 40.0, 2.0]), ALIKE)
    assert told is None  # what its own two seconds say is more than the others know
    told = expectations(np.exp(log_factor), np.array([0.01, 0.01, 0.01, 0.3]), np.array([40.0, 40, 40, 2]), ALIKE)
    assert told is not None and 1.02 < told[0][3] < 1.06


def test_one_joint_or_two_that_disagree_tell_nothing():
    error = np.array([0.01, 0.01, 0.3, 0.3])
    assert expectations(np.array([1.1, 1.0, 1.0, 1.0]), error, np.array([40.0, 0, 0, 0]), ALIKE) is None
    assert expectations(np.array([1.3, 0.9, 1.0, 1.0]), error, np.array([40.0, 40, 0, 0]), ALIKE) is None
    assert expectations(np.array([1.1, 1.1, 1.0, 1.0]), error, np.array([40.0, 40, 0, 0]), ALIKE) is not None
    assert predicted(0, np.array([], dtype=int), np.zeros(4), error, ALIKE) == (0.0, pytest.approx(0.05))
