"""The eleven inertial parameters of a link: there and back, and momentum and gravity linear in them."""

import numpy as np
import pytest
from made_arms import ARMS, random_states, urdf

from tauext import _core
from tauext.robot.inertial import PARAMETERS, inertial_parameters, with_inertial_parameters
from tauext.robot.read import load_tree


@pytest.fixture(params=ARMS)
def tree(request, tmp_path):
    path = tmp_path / "arm.urdf"
    path.write_text(urdf(ARMS[request.param]()))
    return load_tree(path)


def with_parameters(tree: _core.Tree, parameters: np.ndarray) -> _core.Tree:
    """The tree with these parameters, (n, 11)."""
    links = [with_inertial_parameters(link, own) for link, own in zip(tree.links, parameters, strict=True)]
    return _core.Tree(links, tree.gravity)


def parameters_of(tree: _core.Tree) -> np.ndarray:
    return np.array([inertial_parameters(link) for link in tree.links])


def momentum(tree: _core.Tree, parameters: np.ndarray, seed: int = 1) -> np.ndarray:
    """p and beta of random states, one after the other."""
    return np.stack(with_parameters(tree, parameters).momentum(*random_states(tree.size, 50, seed)))


def random_parameters(n: int, seed: int) -> np.ndarray:
    """Of no particular body: a mass and a rotor inertia > 0, the rest of either sign."""
    rng = np.random.default_rng(seed)
    parameters = rng.normal(size=(n, len(PARAMETERS)))
    parameters[:, [0, 10]] = rng.uniform(0.1, 5, (n, 2))
    return parameters


def assert_relative(found: np.ndarray, expected: np.ndarray) -> None:
    # 1e-9 of the largest value: sums of some hundred products round in the 16th digit, and a mass of 0.1 kg multiplies
    # what m c c^T takes off the inertia and adds again by some tens.
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


def test_a_link_from_its_own_parameters_is_the_same_link(tree):
    for link in tree.links:
        again = with_inertial_parameters(link, inertial_parameters(link))
        for name in ("joint_name", "parent", "type", "rotation", "translation", "mass", "rotor_inertia"):
            assert getattr(again, name) == getattr(link, name)
        # Rounding of m c and of m (|c|^2 1 - c c^T), of the size of the inertia about the origin.
        np.testing.assert_allclose(again.com, link.com, rtol=0, atol=1e-15)
        np.testing.assert_allclose(
            again.inertia, link.inertia, rtol=0, atol=1e-14 * inertial_parameters(link)[4:7].max()
        )


def test_parameters_of_a_link_made_from_parameters_are_those_parameters(tree):
    for link, parameters in zip(tree.links, random_parameters(tree.size, seed=2), strict=True):
        again = inertial_parameters(with_inertial_parameters(link, parameters))
        # At 0.1 kg and 3 kg m a centre of mass lies 30 m off: 100 kg m^2 are taken off and added again.
        np.testing.assert_allclose(again, parameters, rtol=0, atol=1e-12)


def test_parameters_stand_in_their_order_and_about_the_joints_origin():
    link = _core.Link()
    link.mass, link.com, link.rotor_inertia = 2.0, [0.1, 0.2, 0.3], 0.7
    link.inertia = [1.0, 2.0, 3.0, 0.4, 0.5, 0.6]
    expected = {
        "m": 2.0, "hx": 0.2, "hy": 0.4, "hz": 0.6,
        "Ixx": 1 + 2 * (0.2**2 + 0.3**2), "Iyy": 2 + 2 * (0.1**2 + 0.3**2), "Izz": 3 + 2 * (0.1**2 + 0.2**2),
        "Ixy": 0.4 - 2 * 0.1 * 0.2, "Ixz": 0.5 - 2 * 0.1 * 0.3, "Iyz": 0.6 - 2 * 0.2 * 0.3, "rotor": 0.7,
    }  # fmt: skip
    assert tuple(expected) == PARAMETERS
    np.testing.assert_allclose(inertial_parameters(link), list(expected.values()), rtol=1e-15)


def test_momentum_and_beta_of_a_sum_of_parameters_are_the_sum_of_theirs(tree):
    own, a, b = parameters_of(tree), random_parameters(tree.size, seed=3), random_parameters(tree.size, seed=4)
    assert_relative(momentum(tree, a + b), momentum(tree, a) + momentum(tree, b))
    assert_relative(momentum(tree, 3.5 * a), 3.5 * momentum(tree, a))
    np.testing.assert_array_equal(momentum(tree, 0 * a), 0)
    np.testing.assert_array_equal(parameters_of(tree), own)  # a link is left as it was


def test_a_links_parameters_move_only_the_joints_that_carry_it(tree):
    parents = [link.parent for link in tree.links]
    base = parameters_of(tree)
    for link in range(tree.size):
        carriers, at = set(), link
        while at >= 0:
            carriers.add(at)
            at = parents[at]
        changed = base.copy()
        changed[link, :10] += np.random.default_rng(link).uniform(0.1, 1, 10)
        difference = momentum(tree, changed) - momentum(tree, base)
        others = [joint for joint in range(tree.size) if joint not in carriers]
        np.testing.assert_allclose(difference[:, :, others], 0, atol=1e-9)
        assert np.abs(difference[0][:, link]).max() > 1e-3
