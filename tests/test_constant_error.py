"""Bundles with constant limits have a standard error; filtered residuals have no direction of a touch."""

from __future__ import annotations

import numpy as np
import pytest
from made_arms import planar_arm
from test_few_data import motion

from tauext import _core
from tauext.config import ObserverConfig
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.train.error_scale import Rows, put_constant_error


def rows_of(error_nm: np.ndarray, near: np.ndarray) -> Rows:
    count, joints = error_nm.shape
    features = np.ones((count, joints, 1))
    t_ns = np.arange(count, dtype=np.int64) * 10_000_000
    return Rows(error_nm, near, features, 0.01, t_ns, np.zeros(count, dtype=int), ("made",))


def bundle_of(recipe: str = "observer") -> _core.Bundle:
    recording = motion(seconds=20.0, seed=3)
    tree = _core.Tree(planar_arm().links, planar_arm().gravity)
    return make_bundle("made", build_setup(tree, recording, ObserverConfig(), recipe), 0.02, recording)


def test_the_standard_error_is_that_of_each_region_and_limits_stay():
    bundle, rng = bundle_of(), np.random.default_rng(1)
    near = rng.random((20_000, 2)) < 0.3
    size = np.where(near, [0.8, 0.3], [0.5, 0.2])
    put_constant_error(bundle, rows_of(np.abs(rng.normal(0, size)), near))
    scale = bundle.error_scale
    assert scale.on and not scale.follows
    # 68 % of 6,000 normal errors: known to about a hundredth.
    np.testing.assert_allclose(scale.sigma_weights, [0.5, 0.2], rtol=0.04)
    np.testing.assert_allclose(scale.sigma_near_weights, [0.8, 0.3], rtol=0.04)
    made = motion(seconds=5.0, seed=4)
    said = _core.estimate(bundle, made.t_ns, made.q, made.dq, made.tau, 1)
    healthy = said["health"] == 1
    assert (said["limit_scale"][healthy] == 1).all()
    expected = np.where(said["near_stiction"][healthy], scale.sigma_near_weights, scale.sigma_weights)
    np.testing.assert_array_equal(said["sigma_nm"][healthy], expected)
    assert not _core.WrenchModel(bundle).refused and not _core.PlaceModel(bundle).refused


def test_a_region_without_rows_has_the_error_of_both():
    bundle = bundle_of()
    put_constant_error(bundle, rows_of(np.full((1000, 2), 0.4), np.zeros((1000, 2), dtype=bool)))
    assert bundle.error_scale.sigma_near_weights == pytest.approx([0.4, 0.4])


@pytest.mark.parametrize("recipe", ["bandpass", "highpass"])
def test_a_filtered_residual_is_refused_for_forces_and_places(recipe):
    bundle = bundle_of(recipe)
    put_constant_error(bundle, rows_of(np.full((1000, 2), 0.4), np.zeros((1000, 2), dtype=bool)))
    for model in (_core.WrenchModel(bundle), _core.PlaceModel(bundle)):
        assert "its residual is filtered" in model.refused and "recipe observer" in model.refused
