"""An arm without a model: its axes and link lengths are found in its motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_arms import no_model, planar_arm, prismatic_mass, random_states, settings
from made_bundles import constants_of
from made_recordings import made_motion

from tauext import _core
from tauext.config import PriorConfig
from tauext.data.recording import Recording
from tauext.fit.find_kinematics import Kinematics, frame_of, pieces, thinned
from tauext.fit.prior import Inertia, fit_prior, weighs_on
from tauext.fit.prior_facts import arm_found
from tauext.fit.prior_terms import ESTIMATED, PriorFit
from tauext.fit.torque_constants import with_constants
from tauext.fit.training_set import Setup
from tauext.robot.inertial import inertial_parameters, with_inertial_parameters

X, Y, Z = np.eye(3)
UPPER_M, LOWER_M = 0.4, 0.35
CONFIG = PriorConfig((1e-3,), False, coulomb_speeds_rad_s=(0.02, 0.1), most_ripples=0)
BASIS = replace(CONFIG, find_kinematics=False)


def arm(gravity=(0.0, 0.0, -9.81)) -> _core.Tree:
    """A turntable, an upper and a lower arm with parallel axes, and a wrist across them."""
    axes = np.array([Z, Y, Y, X])
    origins = np.array([[0, 0, 0], [0, 0, 0.2], [0, 0, 0.2 + UPPER_M], [0.1, 0, 0.2 + UPPER_M + LOWER_M]])
    bare = Kinematics(axes, origins).tree([f"joint{k}" for k in range(4)], gravity)
    rng = np.random.default_rng(4)
    links = []
    for k, (link, mass) in enumerate(zip(bare.links, (6.0, 5.0, 3.0, 1.5), strict=True)):
        com = rng.uniform(-0.05, 0.05, 3) + (np.array(bare.links[k + 1].translation) / 2 if k < 3 else [0.1, 0, 0.03])
        inertia = mass * rng.uniform(0.002, 0.01, 3)
        link.mass, link.com, link.inertia = mass, com.tolist(), [*inertia, 0, 0, 0]
        link.rotor_inertia = 0.1
        links.append(link)
    return _core.Tree(links, list(gravity))


def setup_of(tree: _core.Tree, rate_hz: float = 100.0) -> Setup:
    prior = _core.PriorSettings()
    prior.widths_rad = list(CONFIG.widths_rad)
    observer = settings("instant", rate_hz)
    return Setup(no_model(tree), observer, 100, prior)


def left_nm(setup: Setup, fit: PriorFit, recordings: list[Recording]) -> np.ndarray:
    """RMS of what the prior does not explain, (n,)."""
    errors = []
    for made in recordings:
        said = _core.observe(setup.tree, setup.observer, *made.signals, fit.settings)
        errors.append((said.residual - said.prior)[said.warm.astype(bool)])
    return np.sqrt((np.concatenate(errors) ** 2).mean(axis=0))


# --- an arm of given axes


@pytest.mark.parametrize("gravity", [(0.0, 0.0, -9.81), (0.0, -9.81, 0.0), (4.0, -3.0, 7.0), (0.0, 0.0, 9.81)])
def test_a_frame_of_an_axis_is_a_rotation_onto_it(gravity):
    axis = np.array(gravity) / np.linalg.norm(gravity)
    frame = frame_of(axis)
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(frame @ Z, axis, atol=1e-15)
    assert np.linalg.det(frame) == pytest.approx(1)


def test_the_planar_arm_from_its_axes_has_its_momentum_and_gravity():
    """Two level axes 0.3 m apart; gravity points along -y in the planar arm's base, and must be turned with them."""
    planar = planar_arm()
    bare = Kinematics(np.array([X, X]), np.array([[0, 0, 0], [0, 0.3, 0]])).tree(["a", "b"], planar.gravity)
    along = np.array(bare.links[1].translation) / 0.3  # the links, seen in their own frames
    links = []
    for link, like in zip(bare.links, planar.links, strict=True):
        p = inertial_parameters(like)
        p[1:4] = like.mass * like.com[0] * along
        p[4:10] = 0, 0, like.inertia[2] + like.mass * like.com[0] ** 2, 0, 0, 0  # about the axis: what a plane shows
        links.append(with_inertial_parameters(link, p))
    q, dq = random_states(2, 50, seed=1)
    momentum, beta = _core.Tree(links, planar.gravity).momentum(q, dq)
    # Both lie level at q = 0, this one perhaps to the other side, turning the other way.
    same = [planar.momentum(sign * q + [side, 0], sign * dq) for sign in (1, -1) for side in (0, np.pi)]
    assert min(np.abs(p - momentum * s).max() for (p, _), s in zip(same, (1, 1, -1, -1), strict=True)) < 1e-12
    assert min(np.abs(b - beta * s).max() for (_, b), s in zip(same, (1, 1, -1, -1), strict=True)) < 1e-12


def test_angles_and_distances_of_an_arm_are_those_of_its_drawing():
    facts = arm_found(
        Kinematics(np.array([Z, Y, Y, X]), np.array([[0, 0, 0], [0.1, 0, 0.2], [0.1, 5, 0.6], [9, 0, 0.7]]))
    )
    assert [fact.get("angle_deg") for fact in facts] == [None, 90, 0, 90]
    assert [fact.get("distance_m") for fact in facts] == [None, 0.1, 0.4, 0.1]


def test_a_joint_that_shifts_takes_those_behind_it_along():
    start = Kinematics(np.array([Z, Y, X]), np.zeros((3, 3)))
    shifts = np.zeros((3, 2))
    shifts[1] = [0.3, -0.2]
    moved = start.moved(np.zeros((3, 2)), shifts)
    np.testing.assert_array_equal(moved.axes, start.axes)
    np.testing.assert_array_equal(moved.origins[1], moved.origins[2])
    assert moved.origins[1] @ Y == 0 and np.linalg.norm(moved.origins[1]) == pytest.approx(np.hypot(0.3, 0.2))


# --- the sample


def test_pieces_are_spread_over_all_recordings():
    long = made_motion(arm(), 2.0, pieces=2).recordings
    cut = pieces(long, 30.0, 10.0)
    assert len(cut) == 3 and {piece.name for piece in cut} == {made.name for made in long}
    assert pieces(long, 1000.0, 10.0) == long


def test_of_an_arm_that_rests_for_most_of_the_time_the_pieces_that_move_are_taken():
    (moves,) = made_motion(arm(), 1.0, pieces=1).recordings
    rests = [replace(moves, name=f"rest {k}", dq=0 * moves.dq, q=0 * moves.q) for k in range(9)]
    cut = pieces([*rests[:6], moves, *rests[6:]], 30.0, 10.0)
    assert [piece.name for piece in cut] == [moves.name] * 3
    assert len(pieces(rests, 30.0, 10.0)) == 3


def test_thinned_torque_is_the_mean_of_what_was_left_out():
    whole = made_motion(arm(), 0.2, rate_hz=500.0, pieces=1).recordings[0]
    thin = thinned(whole, 5)
    assert thin.rate_hz == 100 and thin.torque_timing == "averaged"
    for k in (0, 7):
        np.testing.assert_allclose(thin.tau[k], whole.tau[5 * k : 5 * k + 5].mean(axis=0), rtol=1e-12)
        np.testing.assert_array_equal(thin.q[k], whole.q[5 * k + 4])
        assert thin.t_ns[k] == whole.t_ns[5 * k + 4]


# --- the search


@pytest.mark.parametrize(
    "gravity",
    [
        pytest.param((0.0, 0.0, -9.81), id="standing", marks=pytest.mark.slow),
        pytest.param((0.0, 9.81, 0.0), id="on a wall"),
    ],
)
def test_an_arm_is_found_in_a_minute_of_its_motion(gravity):
    """Half of the sphere of poses is seen in training; what is unseen is where sines and cosines fail."""
    tree = arm(gravity)
    made = made_motion(tree, 1.0, pieces=2, ranges=0.8).recordings
    far = made_motion(tree, 0.5, pieces=1, ranges=2.5, seed=9).recordings
    setup, said = setup_of(tree), []
    fit, basis = fit_prior(setup, made, CONFIG, said.append), fit_prior(setup, made, BASIS)
    facts = arm_found(fit.kinematics)
    assert [fact["angle_deg"] for fact in facts[1:]] == [90, pytest.approx(0, abs=1e-3), 90]
    assert facts[2]["distance_m"] == pytest.approx(UPPER_M, abs=0.02)  # 5 %: friction is fitted beside it
    assert facts[3]["distance_m"] == pytest.approx(LOWER_M, abs=0.06)  # of a light wrist: seeds scatter by 0.03
    assert len(said) == 7 and "arm found" in said[-1]  # three lines of motion, and of motion with its rests
    assert not fit.corrections.size or basis.kinematics is None
    torque = np.sqrt(np.mean(np.concatenate([r.tau for r in far]) ** 2, axis=0))
    ours, theirs = left_nm(setup, fit, far), left_nm(setup, basis, far)
    assert (ours < 0.06 * torque).all()
    assert (ours[:3] < 0.5 * theirs[:3]).all()


@pytest.mark.slow
def test_friction_that_grows_with_the_load_is_that_of_the_arm_found():
    fit = fit_prior(setup_of(arm()), made_motion(arm(), 1.0, pieces=2).recordings, CONFIG)
    loads = [term for term in fit.settings.terms if term.kind == _core.TermKind.load]
    # nothing weighs on the turntable, and little on the wrist
    assert {(term.a, term.form) for term in loads} == {(1, 1), (2, 1)}
    assert len(fit.settings.corrected_links) == 4 and all(link.mass > 0 for link in fit.settings.corrected_links)


def test_what_shows_of_a_load_does_not_depend_on_the_unit_of_the_torque():
    setup = replace(setup_of(arm()), tree=arm())
    made = made_motion(arm(), 0.5, pieces=1).recordings
    in_amperes = [replace(one, tau=one.tau / 50.0) for one in made]
    known = replace(setup, observer=with_constants(setup.observer, constants_of(np.full(4, 50.0))))
    shows = weighs_on(setup, made, Inertia(load=ESTIMATED))
    assert shows.tolist() == [False, True, True, False]
    np.testing.assert_array_equal(weighs_on(known, in_amperes, Inertia(load=ESTIMATED)), shows)
    assert weighs_on(setup, in_amperes, Inertia(load=ESTIMATED))[3]  # what it would say of numbers in another unit


@pytest.mark.slow
def test_the_same_motion_finds_the_same_arm():
    made = made_motion(arm(), 0.5, pieces=1).recordings
    first, second = (fit_prior(setup_of(arm()), made, CONFIG) for _ in "ab")
    np.testing.assert_array_equal(first.kinematics.origins, second.kinematics.origins)
    np.testing.assert_array_equal(first.settings.weights, second.settings.weights)


@pytest.mark.parametrize("tree, minutes", [(prismatic_mass(5.0), 1.0), (arm(), 0.1)], ids=["slide", "six seconds"])
def test_where_no_arm_can_be_found_sines_and_cosines_stay(tree, minutes):
    fit = fit_prior(setup_of(tree), made_motion(tree, minutes, pieces=1).recordings, CONFIG)
    assert fit.kinematics is None and not fit.settings.corrected_links


def test_an_arm_that_is_no_open_chain_keeps_the_better_description():
    """A parallelogram: the lower arm's motor turns it against the base, so no serial arm weighs like this one."""
    made = made_motion(planar_arm(), 1.0, pieces=2).recordings

    def linked(r: Recording) -> Recording:
        q, dq, tau = (values.copy() for values in (r.q, r.dq, r.tau))
        q[:, 1], dq[:, 1] = r.q.sum(axis=1), r.dq.sum(axis=1)
        tau[:, 0] = r.tau[:, 0] - r.tau[:, 1]
        return replace(r, q=q, dq=dq, tau=tau)

    setup = setup_of(planar_arm())
    fit, basis = (fit_prior(setup, [linked(r) for r in made], config) for config in (CONFIG, BASIS))
    assert (fit.error_nm <= basis.error_nm * 1.12).all()
