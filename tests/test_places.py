"""Which link is touched and where: against multivariate normals in SciPy, touches drawn by chance, and Pinocchio."""

from __future__ import annotations

import os
from itertools import pairwise
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from made_bundles import SEVEN_AXIS, constant_error_scale, seven_axis_bundle
from scipy.special import logsumexp
from scipy.stats import multivariate_normal
from scipy.stats import t as student_t

from tauext import _core
from tauext.monitor.touch_place import run_of
from tauext.robot.read import load_tree

GOLDEN = Path(__file__).parent / "golden" / "format-1-prior.tauext"
SIGMA = np.array([0.3, 0.4, 0.25, 0.3, 0.15, 0.1, 0.08])
SIZES_N, ALONG, HOLDS, HOLDS_N, TRUST = (6, 12, 24, 48, 96, 192, 384), 0.35, 0.1, 50.0, 0.85
SIZE_WEIGHTS = student_t.pdf(np.log(SIZES_N), 4, np.log(50), 0.5)
SIZE_WEIGHTS /= SIZE_WEIGHTS.sum()
ACROSS, NORMAL, NORMAL_GUESSED = (0.12, 0.4), 0.1, 0.3
POINTS = 320


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


def normal_logs(x: np.ndarray, means: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Log densities of x for many normal distributions, (n,)."""
    off = x - means
    squares = np.einsum("ni,ni->n", off, np.linalg.solve(covariances, off[:, :, None])[:, :, 0])
    return -0.5 * (squares + np.linalg.slogdet(2 * np.pi * covariances)[1])


def evidence(wrenches, bundle, link: int, q, tau, s, surface, normal: float) -> float:
    """Logarithm of the probability density of tau for a touch on this link, by its definition.

    Args:
        normal: error of the surface's normals, [rad].
    """
    points, inwards, share, _ = surface
    whole = wrenches.columns(bundle.links[link].joint_name, list(q), [0.0] * 3, _core.WrenchAxes.frame)
    j = whole[:3] + np.cross(points[:, None, :], np.eye(3)) @ whole[3:]  # a force at p has the moment p x f
    along, terms = inwards[:, :, None] * inwards[:, None, :], []
    for size, weight in zip(SIZES_N, SIZE_WEIGHTS, strict=True):
        for across in np.hypot(ACROSS, normal):
            spread = size**2 * (ALONG**2 * along + across**2 * (np.eye(3) - along))
            means = size * np.einsum("pi,pij->pj", inwards, j)
            found = normal_logs(tau, means, s + np.swapaxes(j, 1, 2) @ spread @ j)
            terms.append(found + np.log(share * (1 - HOLDS) / len(ACROSS) * weight))
    found = normal_logs(tau, np.zeros((len(points), len(tau))), s + HOLDS_N**2 * np.swapaxes(j, 1, 2) @ j)
    return float(logsumexp([*terms, found + np.log(share * HOLDS)]))


def probabilities(logs: list[float], surfaces: list) -> np.ndarray:
    """Of the links, from their evidence and areas."""
    logs = TRUST * np.array(logs) + np.log([float(np.squeeze(area)) for *_, area in surfaces])
    return np.exp(logs - logsumexp(logs))


def test_probability_is_that_of_the_normal_distributions_of_its_definition(bundle, model):
    wrenches = _core.WrenchModel(bundle)
    rng = np.random.default_rng(5)
    for _ in range(3):
        q = rng.uniform(-1.5, 1.5, 7)
        surface = _core.surface_of(of_link(bundle, 4), POINTS)
        at = rng.integers(len(surface["points"]))
        force = 25 * surface["inwards"][at] + rng.normal(size=3) * 3
        tau = columns(wrenches, bundle, 4, q, surface["points"][at]).T @ force + SIGMA * rng.normal(size=7)
        s = wrenches.covariance(True, tau.tolist(), SIGMA.tolist())
        surfaces = [list(_core.surface_of(of_link(bundle, link), POINTS).values()) for link in range(7)]
        logs = [evidence(wrenches, bundle, link, q, tau, s, surface, NORMAL) for link, surface in enumerate(surfaces)]
        told = model.find(q.tolist(), tau.tolist(), SIGMA.tolist(), places=False)
        np.testing.assert_allclose(told.probability, probabilities(logs, surfaces), rtol=1e-6, atol=1e-12)
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


def placed(bundle, link: int, q, point) -> np.ndarray:
    """A point of a link in the base, by Pinocchio."""
    arm = pin.buildModelFromUrdf(str(SEVEN_AXIS))
    data = arm.createData()
    pin.forwardKinematics(arm, data, np.array(q))
    return data.oMi[link + 1].act(np.array(point))


def test_links_are_as_probable_as_they_are_right_and_places_are_found(bundle, model):
    first, second, stated, off = [], [], [], []
    held = []
    for link, point, force, q, tau in drawn(bundle, 400, 11):
        told = model.find(q.tolist(), tau.tolist(), SIGMA.tolist())
        low_n, high_n = told.force_interval_n
        far_m = np.linalg.norm(told.best.point - placed(bundle, link, q, point))
        size = np.linalg.norm(force)
        held.append((low_n <= size <= high_n, 0.5 < told.force_n / size < 2, far_m <= told.within_m))
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
    interval, factor_two, near = np.mean(held, axis=0)
    assert 0.85 <= interval <= 0.99 and factor_two >= 0.85 and 0.85 <= near <= 0.99
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
    np.testing.assert_allclose(place.point, placed(bundle, 6, q, place.on_link), atol=1e-9)


def test_the_interval_of_the_force_is_that_of_touches_drawn_from_the_prior(bundle, model):
    """Weighted by their probability to cause these torques."""
    wrenches, rng, q = _core.WrenchModel(bundle), np.random.default_rng(6), [0.4, -0.7, 0.3, -1.5, 0.6, 1.1, -0.2]
    points, inwards, share, _ = _core.surface_of(of_link(bundle, 4), POINTS).values()
    at = rng.choice(len(share), 400_000, p=share)
    across = np.hypot(rng.choice(ACROSS, len(at)), NORMAL)[:, None]
    size = rng.choice(SIZES_N, len(at), p=SIZE_WEIGHTS)[:, None]
    noise = rng.normal(size=(len(at), 3))
    n = inwards[at]
    upright = np.sum(noise * n, axis=1, keepdims=True)
    forces = size * (n + ALONG * upright * n + across * (noise - upright * n))
    holds = rng.uniform(size=len(at)) < HOLDS
    forces[holds] = HOLDS_N * rng.normal(size=(holds.sum(), 3))
    whole = wrenches.columns("joint5", q, [0.0] * 3, _core.WrenchAxes.frame)
    taus = forces @ whole[:3] + np.cross(points[at], forces) @ whole[3:]
    tau, sigma = np.array([2.0, -4.0, 3.0, -5.0, 0.5, 0.0, 0.0]), 8 * SIGMA  # few draws suffice
    s = wrenches.covariance(True, tau.tolist(), sigma.tolist())
    weights = np.exp(-0.5 * np.einsum("pi,ij,pj->p", tau - taus, np.linalg.inv(s), tau - taus))
    assert weights.sum() ** 2 / np.square(weights).sum() > 1000
    sizes = np.linalg.norm(forces, axis=1)
    order = np.argsort(sizes)
    below = np.cumsum(weights[order]) / weights.sum()
    expected = [sizes[order][np.searchsorted(below, one)] for one in (0.05, 0.5, 0.95)]
    found = model.find(q, tau.tolist(), sigma.tolist(), link=4)
    low_n, high_n = found.force_interval_n
    np.testing.assert_allclose([low_n, found.force_n, high_n], expected, rtol=0.08)


OFFSET_WRIST = SEVEN_AXIS.parents[1] / "packages" / "lab" / "benchmarks" / "unseen" / "offset_wrist.urdf"
SHARED = Path(os.environ.get("TAUEXT_SHARED_DATA", Path(__file__).parents[2] / "shared" / "data"))
UR5 = SHARED / "models" / "ur5_robot.urdf"


POSE = [0.3, 0.4, -0.2, 0.4, 0.3, 0.2]


def across(wrenches, link: str, point, newtons: float, tilt: float) -> list[float]:
    """Torques of a force across the plane of the arm in POSE that is tilted within it by this share."""
    aside, out = np.array([-np.sin(POSE[0]), np.cos(POSE[0]), 0]), np.array([np.cos(POSE[0]), np.sin(POSE[0]), 0])
    way = aside + tilt * (0.6 * out - [0, 0, 0.8])
    columns = wrenches.columns(link, POSE, list(point))[:3]
    return (newtons / np.linalg.norm(way) * way @ columns).tolist()


def six_axis_model(robot: Path) -> tuple[_core.Bundle, _core.PlaceModel]:
    """With guessed shapes."""
    tree, bundle = load_tree(robot), _core.Bundle()
    bundle.links, bundle.gravity, bundle.error_scale = tree.links, tree.gravity, constant_error_scale(SIX_SIGMA)
    return bundle, _core.PlaceModel(bundle)


SIX_SIGMA = [1.05, 1.05, 1.05, 0.2, 0.2, 0.2]


@pytest.mark.parametrize("tilt", [0.1, 0.2, 0.4])
@pytest.mark.parametrize(
    ("link", "point", "newtons"), [(4, (0, 0, 0.03), 40.0), (4, (0, 0, 0.03), 63.0), (1, (0, -0.45, -0.027), 63.0)]
)
def test_a_push_across_the_arm_is_no_huge_force_beside_the_first_axis(link, point, newtons, tilt):
    """A force near the first axis has nearly the same torques, but no hand presses so hard."""
    bundle, model = six_axis_model(OFFSET_WRIST)
    tau = across(_core.WrenchModel(bundle), bundle.links[link].joint_name, point, newtons, tilt)
    found = model.find(POSE, tau, SIX_SIGMA)
    low_n, high_n = found.force_interval_n
    assert low_n < newtons < high_n < 250 and found.force_n / newtons < 2 and found.probability[0] < 0.1
    assert sum(found.probability[max(link - 1, 1) : link + 1]) > 0.5  # a joint is at the far end of the link before it
    assert found.within_m > 0.15


@pytest.mark.skipif(not UR5.exists(), reason="no robot file of a UR5")
@pytest.mark.parametrize(
    ("q", "force"), [([0.0, -1.0, 1.0, -1.57, -1.57, 0.0], 38.0), ([0.3, -1.2, 1.6, -1.9, -1.57, 0.4], 43.0)]
)
def test_a_push_at_the_wrist_of_a_real_arm_is_not_369_newtons_at_its_shoulder(q, force):
    bundle, model = six_axis_model(UR5)
    found = model.find(q, [-23.7, -3.0, -0.4, 0.0, 0.0, 0.0], SIX_SIGMA)
    low_n, high_n = found.force_interval_n
    assert low_n < force * 1.03 < high_n and found.force_n < 120
    assert found.probability[0] < 0.05 < found.probability[3]
    first, last, _ = run_of([(k, found.probability[k]) for k in found.ranked])
    assert (first, last) == (1, 2) or last == 3
    assert found.within_m > 0.3  # it cannot be distinguished, and the words show it


def test_a_force_at_a_frame_is_distinguished_from_touches_elsewhere(bundle, model):
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
    for size, weight in zip(SIZES_N, SIZE_WEIGHTS, strict=True):
        points.append(multivariate_normal.logpdf(tau, np.zeros(7), s + size**2 / 3 * at.T @ at) + np.log(weight))
    surfaces = [list(_core.surface_of(of_link(bundle, link), POINTS).values()) for link in range(7)]
    areas = np.array([float(area[0]) for *_, area in surfaces])
    elsewhere = [
        evidence(wrenches, bundle, link, q, tau, s, surface, NORMAL) + np.log(areas[link] / areas.sum())
        for link, surface in enumerate(surfaces)
    ]
    log = logsumexp(elsewhere) - logsumexp(points)
    assert said[-1] == pytest.approx(1 / (1 + np.exp(log)), rel=1e-6)


def test_a_joint_that_a_nearer_link_cannot_move_rules_it_out(model):
    tau = np.array([0.0, 0, 0, 0, 8.0, 0, 0])
    told = model.find([0.3] * 7, tau.tolist(), SIGMA.tolist())
    assert sum(told.probability[:4]) < 1e-3
    assert sum(told.probability) == pytest.approx(1)


def test_two_touches_are_reported_as_no_single_one(bundle, model):
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
    # Area: that of the union's points within 0.1 mm below its surface, by chance.
    box, rng = np.array([[-0.06, -0.15, -0.06], [0.06, 0.15, 0.36]]), np.random.default_rng(1)
    inside = np.full((2_000_000, 2), np.inf)
    points = rng.uniform(*box, size=(len(inside), 3))
    for k, part in enumerate(parts):
        start, way = np.array(part.start), np.subtract(part.end, part.start)
        along = np.clip((points - start) @ way / (way @ way), 0, 1)
        inside[:, k] = np.linalg.norm(points - start - along[:, None] * way, axis=1) - part.radius_m
    shell = np.abs(inside.min(axis=1)) < 1e-3
    assert surface["area_m2"][0] == pytest.approx(shell.mean() * np.prod(box[1] - box[0]) / 2e-3, rel=0.02)

    sphere = _core.surface_of([_core.Capsule(0, [0, 0, 0.2], [0, 0, 0.2], 0.1)], 300)
    out = (sphere["points"] - [0, 0, 0.2]) / 0.1
    np.testing.assert_allclose(out, -sphere["inwards"], atol=1e-9)
    np.testing.assert_allclose(sphere["share"] @ out, 0, atol=0.01)
    # The second moments of an even sphere are 1/3 each; rows at a step of some 20 degrees are off by a few percent.
    np.testing.assert_allclose(np.diag(out.T @ (sphere["share"][:, None] * out)), 1 / 3, atol=0.02)


def guessing(bundle) -> _core.Bundle:
    """The bundle without shapes but that of the third link, and with a flange."""
    bare = _core.Bundle()
    bare.links, bare.gravity, bare.error_scale = bundle.links, bundle.gravity, bundle.error_scale
    bare.capsules = of_link(bundle, 2)
    settings = _core.WrenchSettings()
    settings.frames = [_core.WrenchFrame("flange", 6, np.eye(3).ravel().tolist(), [0.0, 0.0, 0.12])]
    bare.wrench_settings = settings
    return bare


def crossing(links: list, link: int, u: float = 0.5) -> tuple[float, float]:
    """Where the parent's axis and the link's own are nearest to each other, along each, [m]; u: where, if parallel."""
    own = links[link]
    origin, axis = np.array(own.translation), np.reshape(own.rotation, (3, 3))[:, 2]
    if own.parent < 0:
        return 0.0, -float(origin @ axis)
    if 1 - axis[2] ** 2 < 0.25:
        heights = [0, origin[2], links[own.parent].com[2]]
        height = min(heights) + u * (max(heights) - min(heights))
        return height, float((np.array([0, 0, height]) - origin) @ axis)
    found = np.linalg.lstsq(np.column_stack([[0, 0, 1], -axis]), origin, rcond=None)[0]
    return float(found[0]), float(found[1])


def shapes_drawn(links: list, link: int, end: np.ndarray, arm_m: float, count: int, rng) -> tuple:
    """Points, inwards and areas of the same guess with other random numbers, for a serial arm, without masses. Points
    inside their shape have no area; `count` points have one."""

    def leaves(k: int, u: float) -> float:
        return crossing(links, k + 1, u)[0] if k + 1 < len(links) else end[2]

    def joint(a: float, b: float) -> float:
        return float(np.clip(0, min(a, b), max(a, b)) if rng.uniform() < 0.5 else rng.uniform(min(a, b), max(a, b)))

    points, inwards, seen_m2 = [], [], []
    while np.count_nonzero(seen_m2) < count:
        radius = arm_m * np.exp(rng.uniform(np.log(0.02), np.log(0.08)))
        beyond, longer, u = rng.uniform(size=3)
        own = crossing(links, link, u)[1]
        path = [np.array([0, 0, joint(own, leaves(link, u))]), np.array([0, 0, leaves(link, u)])]
        stretch = [radius * (2 * beyond - 1), radius * (2 * longer - 1)]
        if link + 1 < len(links):
            origin, turn = np.array(links[link + 1].translation), np.reshape(links[link + 1].rotation, (3, 3))
            reaches = crossing(links, link + 1, u)[1]
            path += [origin + at * turn[:, 2] for at in (reaches, joint(reaches, leaves(link + 1, u)))]
        else:
            path.append(end)
            stretch[1] += 0.05 * arm_m * longer
        parts = [[a, (b - a) / np.linalg.norm(b - a), np.linalg.norm(b - a)] for a, b in pairwise(path) if any(a != b)]
        parts = [part for part in parts if part[2] > 1e-6] or [[path[0], np.array([0.0, 0, 1]), 0.0]]
        first = max(stretch[0], -parts[0][2])
        parts[0][0], parts[0][2] = parts[0][0] - first * parts[0][1], parts[0][2] + first
        parts[-1][2] += max(stretch[1], -parts[-1][2])
        areas = np.array([2 * np.pi * radius * part[2] + 4 * np.pi * radius**2 for part in parts])
        start, along, length = parts[chosen := int(rng.choice(len(parts), p=areas / areas.sum()))]
        # A point of an even sphere, moved apart by the cylinder where that is hit instead.
        way = rng.normal(size=3)
        way /= np.linalg.norm(way)
        at = length * (way @ along > 0)
        if rng.uniform() < length / (length + 2 * radius):
            at, way = rng.uniform(0, length), way - (way @ along) * along
            way /= np.linalg.norm(way)
        point = start + at * along + radius * way
        apart = [
            np.linalg.norm(point - a - np.clip((point - a) @ b, 0, c) * b) >= 0.999 * radius
            for k, (a, b, c) in enumerate(parts)
            if k != chosen
        ]
        points.append(point)
        inwards.append(-way)
        seen_m2.append(areas.sum() if all(apart) else 0.0)
    return np.array(points), np.array(inwards), np.array(seen_m2)


def mass_allows(link, points: np.ndarray) -> np.ndarray:
    xx, yy, zz, xy, xz, yz = link.inertia
    inertia = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    covariance = (np.trace(inertia) / 2 * np.eye(3) - inertia) / link.mass + 0.03**2 * np.eye(3)
    off = points - link.com
    beyond = np.sqrt(np.einsum("pi,ij,pj->p", off, np.linalg.inv(covariance), off)) - np.sqrt(5)
    return 0.1 + 0.9 * np.exp(-(np.maximum(beyond, 0) ** 2))


def with_mass(body, points: np.ndarray, inwards: np.ndarray, areas: np.ndarray) -> tuple:
    """Points with an area, inwards, share and mean area."""
    share, seen = mass_allows(body, points), areas > 0
    return points[seen], inwards[seen], share[seen] / share[seen].sum(), share @ areas / share.sum()


@pytest.mark.parametrize("arm", ["seven_axis.urdf", "../packages/lab/benchmarks/unseen/palletizer.urdf"])
def test_a_guess_has_the_shapes_of_its_definition(arm):
    """Means and covariances of points and normals, masses considered. Axes of the palletizer are parallel."""
    tree, end, rng = load_tree(SEVEN_AXIS.parent / arm), np.array([0.01, 0, 0.12]), np.random.default_rng(3)
    bare, settings = _core.Bundle(), _core.WrenchSettings()
    settings.frames = [_core.WrenchFrame("flange", tree.size - 1, translation=end.tolist())]
    bare.links, bare.wrench_settings = tree.links, settings
    arm_m = sum(np.linalg.norm(one.translation) for one in bare.links) + np.linalg.norm(end)
    for link, body in enumerate(bare.links):
        ours = _core.guessed_surface(bare, link, 4000)
        assert 2000 < len(ours["share"]) <= 4000 and ours["share"].sum() == pytest.approx(1)
        np.testing.assert_allclose(np.linalg.norm(ours["inwards"], axis=1), 1, atol=1e-9)
        drawn = with_mass(body, *shapes_drawn(bare.links, link, end, arm_m, 1000, rng))
        both = [
            (np.concatenate([points, 0.1 * inwards], axis=1), share)
            for points, inwards, share, _ in (list(ours.values()), drawn)
        ]
        assert ours["area_m2"][0] == pytest.approx(drawn[3], rel=0.1)
        # Standard errors of 1000 draws are 0.3 to 0.6 % of the arm's length.
        np.testing.assert_allclose(*(share @ one for one, share in both), atol=0.02 * arm_m)
        spreads = [np.cov(one.T, aweights=share) for one, share in both]
        np.testing.assert_allclose(*spreads, atol=0.0025 * arm_m**2)


def test_probabilities_of_guessed_links_are_sums_over_shapes(bundle):
    bare, rng = guessing(bundle), np.random.default_rng(3)
    bare.capsules = []
    end, arm_m = np.array([0, 0, 0.12]), sum(np.linalg.norm(one.translation) for one in bare.links) + 0.12
    surfaces = [
        with_mass(body, *shapes_drawn(bare.links, link, end, arm_m, 1000, rng)) for link, body in enumerate(bare.links)
    ]
    wrenches, model, q = _core.WrenchModel(bare), _core.PlaceModel(bare), [0.4, -0.7, 0.3, -1.5, 0.6, 1.1, -0.2]
    for link, point, force in ((4, [0.05, 0, -0.15], [-30.0, 5, 5]), (2, [0, 0.05, -0.08], [0, -25.0, 9])):
        tau, sigma = columns(wrenches, bare, link, q, point).T @ force, 3 * SIGMA  # few draws suffice
        s = wrenches.covariance(True, tau.tolist(), sigma.tolist())
        logs = [evidence(wrenches, bare, k, q, tau, s, one, NORMAL_GUESSED) for k, one in enumerate(surfaces)]
        told = model.find(q, tau.tolist(), sigma.tolist(), places=False).probability
        np.testing.assert_allclose(told, probabilities(logs, surfaces), atol=0.08)


def test_a_link_whose_next_joint_coincides_gets_length(bundle):
    """The fifth link ends at the joint that it carries: its body is before it, along its axis. In a wrist whose axes
    meet, the body reaches into the next link, up to the flange."""
    bare = guessing(bundle)
    assert np.allclose(bare.links[5].translation, 0)
    along = _core.guessed_surface(bare, 4, 500)["points"][:, 2]
    before = crossing(bare.links, 4)[1]
    assert before < -0.3 and np.quantile(along, 0.1) < before / 3 and np.quantile(along, 0.9) < 0.1
    links = list(bare.links)
    links[6].translation = [0.0, 0.0, 0.0]
    bare.links = links
    wrist = _core.guessed_surface(bare, 5, 500)["points"]
    forward = wrist @ np.reshape(links[6].rotation, (3, 3))[:, 2]
    assert np.quantile(forward, 0.95) > np.quantile(-forward, 0.95) + 0.02


@pytest.mark.parametrize("inertia", [[1e-9] * 3 + [0.0] * 3, [1.0, 0.1, 0.1, 0.0, 0.0, 0.0]])
def test_a_mass_distribution_of_no_body_bounds_no_shape(bundle, inertia):
    bare, links = guessing(bundle), list(bundle.links)
    links[3].inertia = inertia
    bare.links = links
    share = _core.guessed_surface(bare, 3, 100)["share"]
    np.testing.assert_allclose(share, 1 / len(share))


def test_an_arm_without_lengths_gets_shapes():
    bare, links = _core.Bundle(), list(load_tree(SEVEN_AXIS).links)
    for link in links:
        link.translation = [0.0, 0.0, 0.0]
    bare.links = links
    points = _core.guessed_surface(bare, 6, 200)["points"]
    assert np.isfinite(points).all() and 0.002 < np.linalg.norm(points, axis=1).max() < 0.1


def test_shapes_that_are_given_are_not_guessed(bundle):
    bare = guessing(bundle)
    model = _core.PlaceModel(bare)
    assert model.guessed == [0, 1, 3, 4, 5, 6] and _core.PlaceModel(bundle).guessed == []
    tau = columns(_core.WrenchModel(bundle), bundle, 6, [0.3] * 7, [0.04, 0, 0.1]).T @ [-30, 0, 0]
    found = model.find([0.3] * 7, tau.tolist(), SIGMA.tolist())
    assert {place.link: place.guessed for place in found.places} == {
        place.link: place.link != 2 for place in found.places
    }


@pytest.mark.parametrize("given", [{"link": 7}, {"link": -1}, {"points": 0}])
def test_a_guess_of_no_link_or_no_points_is_refused(bundle, given):
    with pytest.raises(_core.CoreError, match="must be"):
        _core.guessed_surface(bundle, **{"link": 0, "points": 10} | given)


def test_guessed_links_are_as_probable_as_they_are_right(bundle):
    """Touches on shapes that the guess does not have: those of the bundle, from joint to joint."""
    model, told = _core.PlaceModel(guessing(bundle)), []
    for link, _, _, q, tau in drawn(bundle, 400, 12):
        found = model.find(q.tolist(), tau.tolist(), SIGMA.tolist(), places=False)
        told.append((found.probability[found.ranked[0]], found.ranked[0] == link, link in found.ranked[:2]))
    said, right, two = np.array(told, dtype=float).T
    assert abs(said.mean() - right.mean()) < 0.1
    assert right.mean() > 0.55 and two.mean() > 0.8
    stated = said >= 0.9
    assert stated.sum() > 40 and right[stated].mean() > 0.85


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
    tau, sigma, bare = [1.0] * 7, SIGMA.tolist(), _core.Bundle()
    for broken in ([np.nan] + tau[1:], [np.inf] + tau[1:]):
        told = model.find([0.0] * 7, broken, sigma)
        assert not told.known and told.places == told.ranked == []
        assert told.best is None and np.isnan(told.consistent)
    assert not model.find([0.0] * 7, tau, [0.0] * 7).known
    assert not model.find([0.0] * 7, tau, sigma, dq=[np.nan] * 7).known
    for q, dq in (([0.0] * 7, [0.0]), ([0.0] * 6, None)):
        with pytest.raises(_core.CoreError, match="must hold 7 values"):
            model.find(q, tau, tau, **({"dq": dq} if dq else {}))
    bare.links = bundle.links
    refused = _core.PlaceModel(bare)
    assert "error scale" in refused.refused
    with pytest.raises(_core.CoreError, match="no contact places: .*error scale"):
        refused.find([0.0] * 7, tau, tau)
