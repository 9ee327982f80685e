"""Decisions between options that are equally good: their order decides, not rounding."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_arms import planar_arm, random_states
from made_recordings import made_motion
from test_kinematics import CONFIG, arm, setup_of

from tauext import _core
from tauext.fit.find_kinematics import ArmSearch, Kinematics, KinematicSample, directions, frame_of
from tauext.fit.prior import fit_prior
from tauext.fit.prior_terms import encoder_count, own_terms
from tauext.fit.regression import RIDGES, NormalEquations, Regression
from tauext.fit.stable_choice import ranked, simplest

MIRROR = np.diag([1.0, -1.0, 1.0])
NOISE = 1e-13


def test_the_first_option_within_the_margin_is_taken():
    costs = {"none": 1.04, "one": 1.0, "two": 1.2}
    assert simplest(list(costs), costs.__getitem__, 0.05) == "none"
    assert simplest(list(costs), costs.__getitem__, 0.03) == "one"
    assert simplest(["two", "one"], costs.__getitem__, 0.25) == "two"
    assert simplest(["one"], lambda _: 0.0, 0.0) == "one"


@pytest.mark.parametrize("seed", range(5))
def test_equal_costs_keep_their_order_however_they_are_rounded(seed):
    rng = np.random.default_rng(seed)
    costs = np.repeat([3.0, 1.0, 2.0], 4)
    rounded = costs * (1 + 1e-15 * rng.integers(-9, 9, len(costs)))
    assert ranked(range(12), rounded.__getitem__, 1e-6, 6) == [4, 5, 6, 7, 8, 9]
    assert ranked(range(3), costs.__getitem__, 1e-6, 9) == [0, 1, 2]


def mirrored(tree: _core.Tree, axes: np.ndarray, origins: np.ndarray) -> _core.Tree:
    """The mirror image of a standing arm at the plane of x and z: axes are axial vectors, all else is polar."""
    image = Kinematics(-axes @ MIRROR, origins @ MIRROR)
    links = image.tree([link.joint_name for link in tree.links], tree.gravity).links
    for link, of, axis, other in zip(links, tree.links, axes, image.axes, strict=True):
        turn = frame_of(other).T @ MIRROR @ frame_of(axis)
        xx, yy, zz, xy, xz, yz = of.inertia
        inertia = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
        link.mass, link.com, link.rotor_inertia = of.mass, (turn @ of.com).tolist(), of.rotor_inertia
        link.inertia = [*np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]
    return _core.Tree(links, list(tree.gravity))


def test_an_arm_and_its_mirror_image_have_the_same_torques():
    """So no search can tell them apart, and their errors differ by rounding alone."""
    axes = np.array([[0, 0, 1], [0, 1, 0], [0, 1, 0], [1, 0, 0]], dtype=float)
    origins = np.array([[0, 0, 0], [0, 0, 0.2], [0, 0, 0.6], [0.1, 0, 0.95]])
    image = mirrored(arm(), axes, origins)
    assert not np.allclose([link.com for link in image.links], [link.com for link in arm().links])
    q, dq = random_states(4, 50, 1)
    for ours, theirs in zip(arm().momentum(q, dq), image.momentum(q, dq), strict=True):
        np.testing.assert_allclose(theirs, ours, rtol=1e-9, atol=1e-9)


def test_of_mirror_images_the_search_keeps_the_one_that_it_tried_first():
    setup = setup_of(planar_arm())
    recordings = made_motion(planar_arm(), 0.5, pieces=1).recordings
    own = [own_terms(setup, CONFIG, joint) for joint in range(2)]
    sample = KinematicSample(setup.tree, setup.observer, recordings, own, setup.widths_rad)
    found = directions(sample)
    assert 1 < len(found) <= ArmSearch.beam
    pairs = 0
    for k, one in enumerate(found):
        image = one.kinematics.axes * [1, -1, -1]  # mirrored, and turned about the vertical by half a turn
        others = [m for m, other in enumerate(found) if m != k and np.array_equal(other.kinematics.axes, image)]
        for m in others:
            pairs += 1
            assert found[m].error == pytest.approx(one.error, rel=1e-9)
            across = one.kinematics.axes[np.abs(one.kinematics.axes[:, 0]) < 0.5]
            assert (k < m) == bool(across[0].sum() > 0)
    assert pairs >= 2


def test_rounding_changes_no_decision_of_an_arm_without_a_model():
    made = made_motion(planar_arm(), 0.5, pieces=2).recordings
    rng = np.random.default_rng(3)

    def off(values: np.ndarray) -> np.ndarray:
        return values * (1 + NOISE * rng.standard_normal(values.shape))

    fits = [fit_prior(setup_of(planar_arm()), made, CONFIG)]
    fits += [
        fit_prior(setup_of(planar_arm()), [replace(r, q=off(r.q), dq=off(r.dq), tau=off(r.tau)) for r in made], CONFIG)
        for _ in range(2)
    ]
    for fit in fits[1:]:
        assert fit.ridge == fits[0].ridge
        assert [(t.kind, t.a, t.b) for t in fit.settings.terms] == [(t.kind, t.a, t.b) for t in fits[0].settings.terms]
        np.testing.assert_allclose(fit.kinematics.axes, fits[0].kinematics.axes, atol=1e-6)
        np.testing.assert_allclose(fit.error_nm, fits[0].error_nm, rtol=1e-6)


def test_of_ridges_that_the_data_cannot_tell_apart_the_strongest_is_taken():
    """Two orthogonal columns and a million rows: a weak ridge takes its share of the rows from a weight."""
    columns, weights, rows = (np.array([0, 1]),), np.array([3.0, -2.0]), 200_000
    pieces = []
    for fold in range(5):
        off = 1e-3 * np.array([np.cos(fold), np.sin(fold)])  # what chance makes of a fold's moment
        moment = rows * (weights + off)
        pieces.append(NormalEquations(columns, [rows * np.eye(2)], [moment], np.array([rows * 14.0]), rows))
    ridge, error = Regression(pieces).choose_ridge()
    # A ridge leaves (ridge |w|)^2 more, of a variance of 14 - 13: 1e-6 of it at a ridge of 0.00028.
    assert ridge == RIDGES[RIDGES < 0.00028].max()
    assert error[0] == pytest.approx(1.0, abs=1e-3)


def test_rounding_is_no_count_of_an_encoder():
    count, rng = 2 * np.pi / 4096, np.random.default_rng(0)
    made = made_motion(planar_arm(), 0.2, pieces=1).recordings[0]
    counted = np.round(made.q / count) * count
    noisy = counted * (1 + NOISE * rng.standard_normal(counted.shape))
    rounding = np.abs(np.diff(noisy, axis=0)[np.diff(counted, axis=0) == 0])
    assert 0 < rounding.max() < 1e-11
    for q in (counted, noisy):
        assert encoder_count([replace(made, q=q)]) == pytest.approx(count, rel=1e-6)
