"""Which link is touched and where: against multivariate normals in SciPy, touches drawn by chance, and Pinocchio."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from made_bundles import SEVEN_AXIS, seven_axis_bundle
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from tauext import _core

GOLDEN = Path(__file__).parent / "golden" / "format-1-prior.tauext"
SIGMA = np.array([0.3, 0.4, 0.25, 0.3, 0.15, 0.1, 0.08])
SIZES_N, ALONG, ACROSS, HOLDS, HOLDS_N = (3, 9, 27, 81, 243), 0.5, 0.4, 0.1, 50.0
RANKING_POINTS = 64


@pytest.fixture(scope="module")
def bundle() -> _core.Bundle:
    """A seven-axis arm with a capsule from each joint to the next, one with two."""
    hand, elbow = _core.Capsule(6, [0, 0, 0], [0, 0, 0.12], 0.04), _core.Capsule(3, [-0.05, 0, 0], [0.05, 0, 0], 0.06)
    return seven_axis_bundle(SIGMA, hand, elbow)


@pytest.fixture(scope="module")
def model(bundle) -> _core.PlaceModel:
    return _core.PlaceModel(bundle)


def of_link(bundle, link: int) -> list:
    return [one for one in bundle.capsules if one.link == link]


def columns(wrenches, bundle, link: int, q, point) -> np.ndarray:
    """(3, joints) along the link's axes."""
    return wrenches.columns(bundle.links[link].joint_name, list(q), list(point), _core.WrenchAxes.frame)[:3]


def test_probability_is_that_of_the_normal_distributions_of_its_definition(bundle, model):
    wrenches = _core.WrenchModel(bundle)
    rng = np.random.default_rng(5)
    for _ in range(3):
        q = rng.uniform(-1.5, 1.5, 7)
        surface = _core.surface_of(of_link(bundle, 4), RANKING_POINTS)
        at = rng.integers(len(surface["points"]))
        force = 25 * surface["inwards"][at] + rng.normal(size=3) * 3
        tau = columns(wrenches, bundle, 4, q, surface["points"][at]).T @ force + SIGMA * rng.normal(size=7)
        s = wrenches.covariance(True, tau.tolist(), SIGMA.tolist())
        logs = []
        for link in range(7):
            surface = _core.surface_of(of_link(bundle, link), RANKING_POINTS)
            terms = []
            for point, inwards, share in zip(*(surface[k] for k in ("points", "inwards", "share")), strict=True):
                j = columns(wrenches, bundle, link, q, point)
                along = np.outer(inwards, inwards)
                for size in SIZES_N:
                    spread = size**2 * (ALONG**2 * along + ACROSS**2 * (np.eye(3) - along))
                    found = multivariate_normal.logpdf(tau, size * inwards @ j, s + j.T @ spread @ j)
                    terms.append(found + np.log(share * (1 - HOLDS) / len(SIZES_N)))
                found = multivariate_normal.logpdf(tau, np.zeros(7), s + HOLDS_N**2 * j.T @ j)
                terms.append(found + np.log(share * HOLDS))
            logs.append(logsumexp(terms))
        told = model.find(q.tolist(), tau.tolist(), SIGMA.tolist(), places=False)
        np.testing.assert_allclose(told.probability, np.exp(logs - logsumexp(logs)), rtol=1e-6, atol=1e-12)
        assert told.ranked == np.argsort(-np.array(told.probability)).tolist()


def drawn(bundle, count: int, seed: int):
    """Touches as the prior has them: link, point on it, q, tau_ext."""
    wrenches, rng = _core.WrenchModel(bundle), np.random.default_rng(seed)
    surfaces = [_core.surface_of(of_link(bundle, link), 500) for link in range(7)]
    while count:
        link, q = int(rng.integers(7)), rng.uniform(-1.5, 1.5, 7)
        at = rng.choice(len(surfaces[link]["share"]), p=surfaces[link]["share"])
        point, inwards = surfaces[link]["points"][at], surfaces[link]["inwards"][at]
        across = rng.normal(size=3)
        size = rng.uniform(20, 60)
        force = size * (inwards + 0.3 * (across - inwards * (across @ inwards)))
        true = columns(wrenches, bundle, link, q, point).T @ force
        if np.abs(true / SIGMA).max() < 6:
            continue  # no alarm
        share = np.array([0.05] * 7)  # what a torque constant is off by, as the settings have it
        yield link, point, force, q, true + np.hypot(SIGMA, share * true) * rng.normal(size=7)
        count -= 1


def test_links_are_as_probable_as_they_are_right_and_places_are_found(bundle, model):
    first, second, stated, off = [], [], [], []
    for link, point, _, q, tau in drawn(bundle, 400, 11):
        told = model.find(q.tolist(), tau.tolist(), SIGMA.tolist())
        best = told.ranked[0]
        first.append((told.probability[best], best == link))
        second.append(link in told.ranked[:2])
        if told.probability[best] >= 0.9:
            stated.append(best == link)
        of_first = [place for place in told.places if place.link == best]
        assert told.best.on_link == (of_first or told.places)[0].on_link
        here = [place for place in told.places if place.link == link]
        if link >= 4 and here:
            off.append((np.linalg.norm(here[0].on_link - point), here[0].spread_m))
    said, right = np.array(first, dtype=float).T
    # 400 draws: a share's standard error is 2.5 %, so that four of them are 0.1.
    assert abs(said.mean() - right.mean()) < 0.1
    assert right.mean() > 0.6 and np.mean(second) > 0.85
    assert len(stated) > 60 and np.mean(stated) > 0.85
    distance, spread = np.array(off).T
    assert np.median(distance) < 0.035 and 0.4 < np.median(distance) / np.median(spread) < 1.5


def test_a_place_explains_what_a_sharp_touch_shows(bundle, model):
    """Without errors to speak of: the grid's point, the force that acts, in the base's axes."""
    wrenches, q = _core.WrenchModel(bundle), [0.4, -0.7, 0.3, -1.5, 0.6, 1.1, -0.2]
    fine = _core.surface_of(of_link(bundle, 6), 320)
    at = int(np.argmax(fine["points"][:, 2] * (np.abs(fine["inwards"][:, 2]) < 0.1)))
    point, force = fine["points"][at], 40 * fine["inwards"][at]
    tau = columns(wrenches, bundle, 6, q, point).T @ force
    told = model.find(q, tau.tolist(), (SIGMA * 1e-3).tolist())
    place = told.places[0]
    assert place.link == 6 and told.consistent > 0.05
    assert np.linalg.norm(place.on_link - point) < 0.03
    turned = wrenches.columns("joint7", q, list(point))[:3]
    np.testing.assert_allclose(turned.T @ place.force, tau, atol=0.1 * np.abs(tau).max())
    assert np.linalg.norm(place.force) == pytest.approx(40, rel=0.1)

    arm = pin.buildModelFromUrdf(str(SEVEN_AXIS))
    data = arm.createData()
    pin.forwardKinematics(arm, data, np.array(q))
    np.testing.assert_allclose(place.point, data.oMi[7].act(np.array(place.on_link)), atol=1e-9)


def test_a_force_at_a_frame_is_told_from_touches_elsewhere(bundle, model):
    """Right as often as it says, both kinds being as frequent; and by the normal distributions of its definition."""
    wrenches, rng = _core.WrenchModel(bundle), np.random.default_rng(8)
    said, right = [], []
    for _, _, _, q, tau in drawn(bundle, 150, 21):
        said.append(model.find(q.tolist(), tau.tolist(), SIGMA.tolist(), frame="joint7").at_frame)
        right.append(False)
        way = rng.normal(size=3)
        true = columns(wrenches, bundle, 6, q, [0, 0, 0]).T @ (way * rng.uniform(20, 60) / np.linalg.norm(way))
        tau = true + np.hypot(SIGMA, 0.05 * true) * rng.normal(size=7)
        said.append(model.find(q.tolist(), tau.tolist(), SIGMA.tolist(), frame="joint7").at_frame)
        right.append(True)
    assert abs(np.mean(said) - 0.5) < 0.1
    taken = np.array(said) > 0.5
    assert np.mean(taken == np.array(right)) > 0.85
    assert np.isnan(model.find(q.tolist(), tau.tolist(), SIGMA.tolist()).at_frame)

    s = wrenches.covariance(True, tau.tolist(), SIGMA.tolist())
    at, points = columns(wrenches, bundle, 6, q, [0, 0, 0]), []
    for size in SIZES_N:
        points.append(multivariate_normal.logpdf(tau, np.zeros(7), s + size**2 / 3 * at.T @ at) - np.log(len(SIZES_N)))
    elsewhere = []
    for link in range(7):
        surface = _core.surface_of(of_link(bundle, link), RANKING_POINTS)
        for point, inwards, share in zip(*(surface[k] for k in ("points", "inwards", "share")), strict=True):
            j, along = columns(wrenches, bundle, link, q, point), np.outer(inwards, inwards)
            for size in SIZES_N:
                spread = size**2 * (ALONG**2 * along + ACROSS**2 * (np.eye(3) - along))
                found = multivariate_normal.logpdf(tau, size * inwards @ j, s + j.T @ spread @ j)
                elsewhere.append(found + np.log(share * (1 - HOLDS) / len(SIZES_N) / 7))
            found = multivariate_normal.logpdf(tau, np.zeros(7), s + HOLDS_N**2 * j.T @ j)
            elsewhere.append(found + np.log(share * HOLDS / 7))
    log = logsumexp(elsewhere) - logsumexp(points)
    assert said[-1] == pytest.approx(1 / (1 + np.exp(log)), rel=1e-6)


def test_a_joint_that_a_nearer_link_cannot_move_rules_it_out(model):
    tau = np.array([0.0, 0, 0, 0, 8.0, 0, 0])
    told = model.find([0.3] * 7, tau.tolist(), SIGMA.tolist())
    assert sum(told.probability[:4]) < 1e-3
    assert sum(told.probability) == pytest.approx(1)


def test_two_touches_are_said_to_be_no_single_one(bundle, model):
    """On the last link and, the other way, on the second: each explains what the other does not."""
    wrenches, rng, small = _core.WrenchModel(bundle), np.random.default_rng(2), []
    for _ in range(20):
        q = rng.uniform(-1, 1, 7)
        tau = columns(wrenches, bundle, 6, q, [0.04, 0, 0.1]).T @ rng.normal(size=3) * 40
        tau += columns(wrenches, bundle, 1, q, [0, -0.2, 0.05]).T @ rng.normal(size=3) * 120
        small.append(model.find(q.tolist(), tau.tolist(), (0.2 * SIGMA).tolist()).consistent)
    assert np.mean(np.array(small) < 0.01) > 0.8


def test_surface_points_lie_on_the_surface_and_share_its_area():
    parts = [_core.Capsule(0, [0, 0, 0], [0, 0, 0.3], 0.05), _core.Capsule(0, [0, -0.1, 0.15], [0, 0.1, 0.15], 0.04)]
    surface = _core.surface_of(parts, 4000)
    distance = np.empty((2, len(surface["points"])))
    for k, part in enumerate(parts):
        start, way = np.array(part.start), np.subtract(part.end, part.start)
        along = np.clip((surface["points"] - start) @ way / (way @ way), 0, 1)
        distance[k] = np.linalg.norm(surface["points"] - start - along[:, None] * way, axis=1) - part.radius_m
    np.testing.assert_allclose(np.abs(distance).min(axis=0), 0, atol=1e-9)
    assert distance.min() > -1e-3 * 0.05  # none within the other part
    assert surface["share"].sum() == pytest.approx(1)
    np.testing.assert_allclose(np.linalg.norm(surface["inwards"], axis=1), 1, atol=1e-12)

    sphere = _core.surface_of([_core.Capsule(0, [0, 0, 0.2], [0, 0, 0.2], 0.1)], 300)
    out = (sphere["points"] - [0, 0, 0.2]) / 0.1
    np.testing.assert_allclose(out, -sphere["inwards"], atol=1e-9)
    np.testing.assert_allclose(sphere["share"] @ out, 0, atol=0.01)
    # The second moments of an even sphere are 1/3 each; rows at a step of some 20 degrees are off by a few percent.
    np.testing.assert_allclose(np.diag(out.T @ (sphere["share"][:, None] * out)), 1 / 3, atol=0.02)


def test_links_without_a_shape_get_a_guess(bundle):
    bare = _core.Bundle()
    bare.links, bare.capsules = bundle.links, of_link(bundle, 2)
    guessed = _core.capsules_or_guess(bare)
    assert sorted({one.link for one in guessed}) == list(range(7))
    forearm = next(one for one in guessed if one.link == 4)
    np.testing.assert_allclose(forearm.end, bundle.links[5].translation)
    assert forearm.radius_m == 0.05 and len([one for one in guessed if one.link == 2]) == 1


@pytest.mark.parametrize(
    ("capsule", "words"),
    [
        (_core.Capsule(7, [0, 0, 0], [0, 0, 1], 0.1), "link 7: the bundle has links 0 to"),
        (_core.Capsule(0, [0, 0, np.nan], [0, 0, 1], 0.1), "nan m away"),
        (_core.Capsule(0, [0, 0, 0], [0, 0, 1], 0.0), "radius_m = 0 must be 0.0001 to 10"),
    ],
)
def test_bundles_keep_capsules_and_refuse_broken_ones(capsule, words):
    bundle = _core.Bundle.load(str(GOLDEN))
    assert bundle.capsules == []
    good = _core.Capsule(1, [0, 0.1, 0], [0.2, 0, 0.3], 0.07)
    bundle.capsules = [good]
    (kept,) = _core.Bundle.from_bytes(bundle.to_bytes()).capsules
    assert (kept.link, kept.start, kept.end, kept.radius_m) == (good.link, good.start, good.end, good.radius_m)
    bundle.capsules = [good, capsule]
    with pytest.raises(_core.CoreError, match=words):
        bundle.to_bytes()


def test_what_is_not_known_and_what_does_not_fit(bundle, model):
    tau = [1.0] * 7
    for broken in ([np.nan] + tau[1:], [np.inf] + tau[1:]):
        told = model.find([0.0] * 7, broken, SIGMA.tolist())
        assert (
            not told.known
            and told.places == []
            and told.best is None
            and told.ranked == []
            and np.isnan(told.consistent)
        )
    assert not model.find([0.0] * 7, tau, [0.0] * 7).known
    assert not model.find([0.0] * 7, tau, SIGMA.tolist(), dq=[np.nan] * 7).known
    with pytest.raises(_core.CoreError, match="must hold 7 values"):
        model.find([0.0] * 7, tau, tau, dq=[0.0])
    with pytest.raises(_core.CoreError, match="must hold 7 values"):
        model.find([0.0] * 6, tau, tau)
    bare = _core.Bundle()
    bare.links = bundle.links
    refused = _core.PlaceModel(bare)
    assert "error scale" in refused.refused
    with pytest.raises(_core.CoreError, match="no contact places: .*error scale"):
        refused.find([0.0] * 7, tau, tau)
