"""Torque constants and a model's inertia, corrected together."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_arms import no_model, planar_arm, prismatic_mass
from made_recordings import Drive, made_motion
from scipy.optimize import approx_fprime
from scipy.stats import multivariate_normal
from test_kinematics import arm

from tauext import _core
from tauext.config import ObserverConfig
from tauext.errors import ConfigError
from tauext.fit.torque_constants import (
    ConstantsConfig,
    Evidence,
    ScaledArm,
    as_it_is,
    between_given,
    common_and_own,
    drawn_to_given,
    fit_torque_constants,
    sliding_rows,
    unexplained,
)
from tauext.robot.inertial import inertial_parameters, with_inertial_parameters

CONSTANTS = np.array([12.0, 11.0, 8.0, 5.0])
JOINTS = ("joint0", "joint1", "joint2", "joint3")


@pytest.fixture(scope="module")
def motion():
    return made_motion(arm(), 2.0).recordings


def without_tool(mass_kg: float = 1.2, at_m: tuple = (0.15, 0.0, 0.05)) -> _core.Tree:
    """The arm's model, which knows nothing of a tool on its last link, and links that are off by some percent."""
    links = arm().links
    at = np.array(at_m)
    inertia = mass_kg * (at @ at * np.eye(3) - np.outer(at, at))
    tool = np.r_[mass_kg, mass_kg * at, np.diag(inertia), inertia[[0, 0, 1], [1, 2, 2]]]
    parameters = [inertial_parameters(link) for link in links]
    parameters[-1][:10] -= tool
    for p, share in zip(parameters, (1.05, 0.94, 1.07, 0.95), strict=True):
        p[:10] *= share
    return _core.Tree([with_inertial_parameters(*both) for both in zip(links, parameters, strict=True)], arm().gravity)


def small_problem(seed: int = 0):
    rng = np.random.default_rng(seed)
    Z, r = rng.normal(size=(2, 7, 3)), rng.normal(size=(2, 7))
    columns = np.concatenate([Z, r[:, :, None]], axis=2)
    start, spread = np.array([2.0, -0.5]), np.array([0.3, 0.2, 0.1])
    evidence = Evidence(columns.transpose(0, 2, 1) @ columns, np.array([1.0, 0.5, -0.7]), spread, start, 0.4)
    return evidence, Z, r


def test_the_cost_is_the_logarithm_of_the_density_of_what_was_measured():
    evidence, Z, r = small_problem()
    weights = np.array([3.0, 5.0])

    def slow(at: np.ndarray) -> float:
        """ln p(r, x, tau) from the covariance of all samples, theta being a random vector."""
        k, tau = evidence.start * np.exp(at[:2]), np.exp(at[2])
        columns = np.concatenate(Z / k[:, None, None])
        noise = np.diag(np.repeat(1 / weights, 7))
        covariance = columns @ np.diag((tau * evidence.spread) ** 2) @ columns.T + noise
        measured = multivariate_normal(columns @ evidence.model, covariance).logpdf(r.ravel())
        return measured - np.sum((at[:2] / 0.4) ** 2) / 2 - at[2] ** 2 / 2

    places = np.random.default_rng(1).normal(0, 0.5, (6, 3))
    both = np.array([[evidence.cost(at, weights)[0], slow(at)] for at in places])
    np.testing.assert_allclose(both.sum(axis=1), both[0].sum(), rtol=1e-10)  # constant: they differ in sign alone


def test_the_gradient_is_that_of_the_cost():
    evidence, _, _ = small_problem(3)
    weights = np.array([3.0, 5.0])
    for at in np.random.default_rng(2).normal(0, 0.5, (4, 3)):
        numeric = approx_fprime(at, lambda x: evidence.cost(x, weights)[0], 1e-6)
        np.testing.assert_allclose(evidence.cost(at, weights)[1], numeric, rtol=1e-4, atol=1e-4)  # one-sided


def test_the_least_squares_left_are_those_of_the_most_likely_parameters():
    evidence, Z, r = small_problem(4)
    at, weights = np.array([0.1, -0.2, 0.3]), np.array([3.0, 5.0])
    theta = evidence.cost(at, weights)[2]
    left = ((r - (Z @ theta) / evidence.constants(at)[:, None]) ** 2).sum(axis=1)
    np.testing.assert_allclose(evidence.squares(at, weights), left, rtol=1e-10)


def test_a_tool_that_the_model_lacks_does_not_go_into_the_constants(motion):
    currents = [replace(r, tau=r.tau / CONSTANTS) for r in motion]
    found = fit_torque_constants(without_tool(), currents, ObserverConfig())
    off = found.nm_per_unit / CONSTANTS
    # Masses alone say what a N m is, and they are off by 5 % and a tool; how the joints compare is known better.
    assert found.determined.all() and np.abs(np.log(off)).max() < 0.1
    assert np.std(np.log(off)) < 0.03


def test_given_constants_are_corrected_and_kept_where_the_motion_says_nothing(motion):
    given = np.array([1.0, 1.09, 0.92, 1.06])
    rng = np.random.default_rng(0)
    measured = [replace(r, tau=r.tau * given) for r in motion]
    found = fit_torque_constants(without_tool(), measured, ObserverConfig(), given=True)
    assert np.std(np.log((found.used * given)[1:])) < 0.02 < np.std(np.log(given[1:]))
    said = found.sentences(JOINTS)[0]
    assert "corrected by a factor: " in said and "joint1 0.9" in said and "The bundle applies them" in said
    assert found.facts(JOINTS)["given"] is True and not found.guessed.any()

    noise = [replace(r, tau=np.c_[r.tau[:, :3], rng.normal(0, 30, len(r.tau))]) for r in measured]
    drowned = fit_torque_constants(without_tool(), noise, ObserverConfig(), given=True)
    assert not drowned.determined[3] and drowned.used[3] == 1.0
    assert "kept for joint3" in drowned.sentences(JOINTS)[0]


def test_given_constants_are_corrected_by_the_arm_found_where_there_is_no_model():
    given = np.array([1.09, 0.92])
    measured = [replace(r, tau=r.tau * given) for r in made_motion(planar_arm(), 1.0).recordings]
    found = fit_torque_constants(no_model(planar_arm()), measured, ObserverConfig(), given=True)
    assert found.determined.all() and found.kinematics is not None
    left = np.log(found.used * given)
    assert abs(left[0] - left[1]) < 0.05 < abs(np.diff(np.log(given))[0]) and abs(left.mean()) < 0.05


def test_where_no_arm_can_be_found_given_constants_are_kept_and_unknown_ones_are_an_error():
    slide = no_model(prismatic_mass(5.0))
    measured = made_motion(prismatic_mass(5.0), 1.0, pieces=1).recordings
    kept = fit_torque_constants(slide, measured, ObserverConfig(), given=True)
    assert kept.used == [1.0]
    assert kept.sentences(("slide",)) == ["torque constants of the import are kept: the motion does not improve them"]
    with pytest.raises(ConfigError, match="--fit-torque-constants False trains in the recordings' own unit"):
        fit_torque_constants(slide, measured, ObserverConfig())


def test_corrections_are_drawn_to_what_was_given_as_far_as_the_motion_leaves_them_open():
    found = drawn_to_given(np.array([2.4, 2.0, 2.0, np.nan]), np.array([0.0, 0.0, 0.4, np.nan]))
    # Certain but for ARM_OFF, the first two keep 80 % of their distance: 0.06^2 / (0.06^2 + 0.03^2).
    assert np.log(found.used[0] / found.used[1]) == pytest.approx(0.8 * np.log(1.2))
    assert found.determined.tolist() == [True, True, False, False] and found.used[2:] == [1.0, 1.0]


def test_a_joint_without_current_has_no_constant_and_harms_no_other(motion):
    dead = [replace(r, tau=r.tau / CONSTANTS * [1, 1, 1, 0]) for r in motion]
    found = fit_torque_constants(arm(), dead, ObserverConfig())
    assert np.isfinite(found.nm_per_unit).all()
    np.testing.assert_allclose(found.nm_per_unit[:3], CONSTANTS[:3], rtol=0.05)


def test_what_friction_holds_of_an_arm_at_rest_is_no_part_of_its_constants():
    moves = made_motion(arm(), 2.0, drive=Drive(pause_s=2.0)).recordings
    held = [replace(r, tau=np.where(np.abs(r.dq) < 0.01, 0.5, 1.0) * r.tau / CONSTANTS) for r in moves]
    assert np.mean([(np.abs(r.dq) < 0.01).mean() for r in held]) > 0.3
    found = fit_torque_constants(arm(), held, ObserverConfig())
    np.testing.assert_allclose(found.nm_per_unit, CONSTANTS, rtol=0.05)


def test_a_joint_that_hardly_slides_has_its_rests_counted():
    speed = np.zeros((1000, 3))
    speed[:250, 0], speed[:249, 1] = 0.03, 0.03  # 10 s of rows, and less
    counted = sliding_rows(SimpleNamespace(speed_rad_s=speed))
    assert counted.sum(axis=0).tolist() == [250, 1000, 1000]


def test_a_pendulums_constant_is_as_uncertain_as_its_mass_and_centre():
    link = planar_arm().links[0]
    pendulum = _core.Tree([link], [0, -9.81, 0])
    motion = made_motion(pendulum, 1.0, drive=Drive(friction=0.0, noise=1e-3)).recordings
    found = fit_torque_constants(pendulum, [replace(r, tau=r.tau / 12.0) for r in motion], ObserverConfig())
    assert found.nm_per_unit == pytest.approx([12.0], rel=0.01)
    # Gravity shows m c / k alone. Neither its rotor nor its inertia about the joint shows the scale of k.
    size = np.sqrt(inertial_parameters(link)[4:7].sum() / (2 * link.mass))
    file = ConstantsConfig
    expected = np.linalg.norm([file.file_mass, file.file_common, file.file_centre * size / link.com[0], file.least_own])
    assert found.shares == pytest.approx([expected], rel=0.05) and found.common_share == 0


def with_masses(tree: _core.Tree, shares) -> _core.Tree:
    links = tree.links
    for link, share in zip(links, shares, strict=True):
        link.mass, link.inertia = share * link.mass, [share * value for value in link.inertia]
    return _core.Tree(links, tree.gravity)


def test_masses_that_are_off_together_go_into_every_constant_and_are_in_their_common_error(motion):
    currents = [replace(r, tau=r.tau / CONSTANTS) for r in motion]
    right, heavy = (fit_torque_constants(with_masses(arm(), [s] * 4), currents, ObserverConfig()) for s in (1.0, 1.2))
    np.testing.assert_allclose(heavy.nm_per_unit / right.nm_per_unit, 1.2, rtol=0.02)
    for found in (right, heavy):
        assert ConstantsConfig.file_common < found.common_share < 0.15 and (found.shares < found.common_share).all()
    said = right.sentences(JOINTS)[0]
    assert f"all together ± {right.common_share:.0%}" in said and "tauext load --known-kg" in said
    assert right.facts(JOINTS)["common_share"] == right.common_share


def test_constants_are_within_two_errors_where_masses_of_the_file_are_off_by_up_to_20_percent(motion):
    currents, rng = [replace(r, tau=r.tau / CONSTANTS) for r in motion[:2]], np.random.default_rng(0)
    off, said = [], []
    for _ in range(12):
        found = fit_torque_constants(with_masses(arm(), rng.uniform(0.8, 1.2, 4)), currents, ObserverConfig())
        off.append(np.log(found.nm_per_unit / CONSTANTS))
        said.append(np.hypot(found.shares, found.common_share))
    inside = np.mean(np.abs(off) < 2 * np.array(said))
    assert inside >= 0.9 and 0.7 < np.sqrt(np.mean(np.square(said)) / np.mean(np.square(off))) < 1.6


def test_what_is_common_and_what_is_each_joints_own_make_up_the_covariance():
    own = np.array([0.05, 0.03, 0.04, 0.8])
    covariance = np.diag(own**2) + 0.1**2
    covariance[3, :3] = covariance[:3, 3] = 0.0  # no better than a guess: no part in the common factor
    common, beside = common_and_own(covariance)
    assert common == pytest.approx(0.1) and beside[:3] == pytest.approx(own[:3]) and beside[3] == pytest.approx(0.8)
    assert common_and_own(np.array([[0.01]])) == (0.0, pytest.approx([0.1]))


def test_given_constants_keep_the_scale_that_the_masses_do_not_show():
    ratio = np.array([1.25, 1.05, 1.15])
    loose = between_given(ScaledArm(ratio, np.full((3, 3), 1.0) + 1e-6 * np.eye(3), 1.0))
    assert np.exp(np.mean(np.log(loose.nm_per_unit))) == pytest.approx(1.0, abs=1e-3)
    np.testing.assert_allclose(loose.nm_per_unit / loose.nm_per_unit[0], ratio / ratio[0], rtol=1e-3)
    sure = between_given(ScaledArm(ratio, 1e-6 * np.eye(3), 1.0))
    np.testing.assert_allclose(sure.nm_per_unit, ratio, rtol=1e-3)
    assert sure.common_share < 0.005 < 0.03 < loose.common_share  # 0.06 / sqrt(3)


def test_where_the_model_as_it_is_says_nothing_the_others_mean_is_where_to_begin():
    rng = np.random.default_rng(0)
    model, Z = np.array([1.0, 2.0]), rng.normal(size=(3, 50, 2))
    r = np.stack([Z[0] @ model / 4.0, Z[1] @ model / -9.0, rng.normal(size=50)])
    columns = np.concatenate([Z, r[:, :, None]], axis=2)
    np.testing.assert_allclose(as_it_is(columns.transpose(0, 2, 1) @ columns, model, np.full(3, 5.0)), [4.0, -9.0, 6.0])


def test_what_columns_leave_is_at_right_angles_to_those_beside_them():
    columns, beside = np.random.default_rng(0).normal(size=(2, 30, 3))
    np.testing.assert_allclose(beside.T @ unexplained(columns, beside), 0, atol=1e-12)


def test_planar_arm_of_a_true_model_keeps_its_scale():
    motion = made_motion(planar_arm(), 1.0).recordings
    found = fit_torque_constants(planar_arm(), motion, ObserverConfig())
    np.testing.assert_allclose(found.nm_per_unit, 1.0, rtol=0.01)  # noise is 1 % of the torque
