"""A tool is told from a torque constant by where it shows."""

from __future__ import annotations

import numpy as np
import pytest
from made_arms import planar_arm

from tauext import _core
from tauext.fleet.compare import POSES, gravity_nm, tool_columns, weigh_all
from tauext.robot.inertial import inertial_parameters, with_inertial_parameters


@pytest.fixture
def poses() -> np.ndarray:
    return np.random.default_rng(0).uniform(-1.5, 1.5, (POSES, 2))


def heavier(tree: _core.Tree, kg: float, at_m: tuple[float, float, float]) -> _core.Tree:
    """With a point of this mass on the last link."""
    links = tree.links
    parameters = inertial_parameters(links[-1])
    parameters[:4] += kg * np.r_[1.0, at_m]
    links[-1] = with_inertial_parameters(links[-1], parameters)
    return _core.Tree(links, tree.gravity)


def standing_arm() -> _core.Tree:
    """The planar arm, in whose plane gravity is."""
    tree = planar_arm()
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (20, 2))
    if np.abs(gravity_nm(tree, q)).max() > 0:
        return tree
    return _core.Tree(tree.links, [9.81, 0.0, 0.0])


def weighed(y: np.ndarray, tree: _core.Tree, poses: np.ndarray):
    return weigh_all(
        [y] + [np.zeros_like(y)] * 4, gravity_nm(tree, poses), tool_columns(tree, poses), 0.1, np.zeros(2)
    )[0]


def test_a_tool_is_weighed_and_is_no_constant(poses):
    tree = standing_arm()
    y = gravity_nm(heavier(tree, 0.7, (0.1, 0.0, 0.0)), poses) - gravity_nm(tree, poses)
    found = weighed(y, tree, poses)
    assert found.kg == pytest.approx(0.7, abs=3 * found.kg_error + 0.01)
    assert np.abs(found.share).max() < 0.03


def test_a_constant_shows_at_its_own_joint_and_is_no_tool(poses):
    tree = standing_arm()
    y = np.zeros((POSES, 2))
    y[:, 1] = gravity_nm(tree, poses)[:, 1] * (1 / 1.1 - 1)  # a unit is worth more: less of them hold the arm
    found = weighed(y, tree, poses)
    assert found.share[1] == pytest.approx(0.09, abs=0.03)
    assert abs(found.kg) < found.kg_error
    assert abs(found.share[0]) < 0.03
