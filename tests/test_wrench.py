"""Forces and moments at frames: against Pinocchio's Jacobian, least squares in NumPy, and errors drawn by chance."""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pinocchio_oracle as oracle
import pytest
from made_bundles import SEVEN_AXIS, seven_axis_bundle, without_constants
from scipy.stats import chi2
from tauext_lab.evaluate.noticed_force import noticed_force

from tauext import _core
from tauext.robot.frames import wrench_frames
from tauext.robot.read import load_tree
from tauext.train.hits import points
from tauext.train.wrench import correlation, factor

GOLDEN = Path(__file__).parent / "golden" / "format-1-prior.tauext"
BASE, FRAME = _core.WrenchAxes.base, _core.WrenchAxes.frame
SIGMA = np.array([0.8, 0.9, 0.6, 0.5, 0.3, 0.2, 0.15])
POSE = [0.3, -0.6, 0.5, -1.7, 0.4, 1.3, 0.2]


def together(joints: int, seed: int = 3) -> np.ndarray:
    """Some correlation."""
    z = np.random.default_rng(seed).normal(size=(200, joints))
    z[:, 1:] += 0.5 * z[:, :-1]
    return correlation(z, 1000.0)


def arm_bundle() -> _core.Bundle:
    """A seven-axis arm of which only model, error scale and frames are looked at."""
    made = seven_axis_bundle(SIGMA)
    settings = _core.WrenchSettings()
    settings.frames = wrench_frames(SEVEN_AXIS, load_tree(SEVEN_AXIS))
    settings.correlation = together(made.joints).ravel().tolist()
    settings.torque_share = [0.03] * made.joints
    settings.common_share = 0.02
    settings.radius, settings.residual_radius = [1.5, 1.2], [1.1, 1.3]
    made.wrench_settings = settings
    return made


@pytest.fixture(scope="module")
def bundle() -> _core.Bundle:
    return arm_bundle()


@pytest.fixture(scope="module")
def model(bundle) -> _core.WrenchModel:
    return _core.WrenchModel(bundle)


def torque(model, frame: str, q, wrench) -> np.ndarray:
    return model.columns(frame, list(q)).T @ wrench


def one(model, frame: str, q, tau, point=None, axes=BASE) -> dict:
    rows = (np.atleast_2d(np.asarray(values, dtype=float)) for values in (q, tau, SIGMA))
    return {name: column[0] for name, column in model.wrenches(frame, *rows, point, axes).items()}


def test_the_jacobian_is_pinocchio_s_at_every_frame_of_the_robot_file(bundle, model):
    pin = oracle.pin
    arm = oracle.read_model(SEVEN_AXIS.read_text())
    joints = [link.joint_name for link in bundle.links]
    rng = np.random.default_rng(0)
    assert len(bundle.wrench_settings.frames) >= 7
    for q in rng.uniform(-2, 2, (5, 7)):
        for frame in bundle.wrench_settings.frames:
            for axes, theirs in ((BASE, pin.LOCAL_WORLD_ALIGNED), (FRAME, pin.LOCAL)):
                wanted = oracle.frame_jacobian(arm, q, joints, frame.name, theirs)
                np.testing.assert_allclose(model.columns(frame.name, q.tolist(), axes=axes), wanted, atol=1e-9)


def test_a_point_of_a_frame_moves_as_the_frame_s_twist_says(model):
    point = np.array([0.02, -0.05, 0.11])
    at_origin, at_point = (model.columns("joint7", POSE, p, FRAME) for p in ([0, 0, 0], point.tolist()))
    np.testing.assert_allclose(at_point[:3], at_origin[:3] + np.cross(at_origin[3:].T, point).T, atol=1e-12)
    np.testing.assert_array_equal(at_point[3:], at_origin[3:])


def twin(J: np.ndarray, tau: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Generalised least squares with the prior of the core, by inverses."""
    S = radius * np.outer(SIGMA, SIGMA) * together(7) + 0.02**2 * np.outer(tau, tau) + np.diag((0.03 * tau) ** 2)
    P = np.diag([1000.0**2] * 3 + [100.0**2] * 3)[: len(J), : len(J)]
    covariance = np.linalg.inv(J @ np.linalg.inv(S) @ J.T + np.linalg.inv(P))
    return covariance @ J @ np.linalg.inv(S) @ tau, covariance, S


@pytest.mark.parametrize("point", [None, [0.0, 0.03, 0.1]])
def test_wrench_and_covariance_are_those_of_weighted_least_squares(model, point):
    rng = np.random.default_rng(1)
    for q in rng.uniform(-2, 2, (20, 7)):
        tau = 10 * rng.normal(size=7)
        J = model.columns("joint7", q.tolist(), point or [0, 0, 0])[: 3 if point else 6]
        wanted, covariance, S = twin(J, tau, 1.2 if point else 1.5)
        told = one(model, "joint7", q, tau, point)
        found = np.r_[told["force"], told["moment"]][: len(J)]
        np.testing.assert_allclose(found, wanted, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(told["covariance"], covariance, rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(model.covariance(point is not None, tau.tolist(), SIGMA.tolist()), S, rtol=1e-12)
        if told["blind"] == 0:
            left = tau - J.T @ np.linalg.inv(J @ np.linalg.inv(S) @ J.T) @ J @ np.linalg.inv(S) @ tau
            residual = left @ np.linalg.inv(S) @ left / (1.3 if point else 1.1)
            assert told["freedom"] == 7 - len(J)
            assert told["chi_square"] == pytest.approx(residual, rel=1e-5, abs=1e-7)
            assert told["consistent"] == pytest.approx(chi2.sf(residual, 7 - len(J)), rel=1e-5, abs=1e-12)


@pytest.mark.parametrize("freedom", range(1, 12))
def test_chi_square_is_scipy_s(freedom):
    for value in (0.0, 0.1, 1.0, 7.0, 40.0):
        assert _core.chi_square_beyond(value, freedom) == pytest.approx(chi2.sf(value, freedom), rel=1e-9)


def test_ellipsoids_hold_the_truth_as_often_as_they_say_where_errors_are_as_assumed(model):
    rng = np.random.default_rng(2)
    wrench = np.r_[30.0, -20.0, 25.0, 0.0, 0.0, 0.0]
    clean = torque(model, "joint7", POSE, wrench)
    S = model.covariance(True, clean.tolist(), SIGMA.tolist())
    tau = clean + rng.multivariate_normal(np.zeros(7), S, 4000)
    said = model.wrenches("joint7", np.tile(POSE, (4000, 1)), tau, np.tile(SIGMA, (4000, 1)), [0.0, 0.0, 0.0])
    off = said["force"] - wrench[:3]
    inside = np.einsum("ri,rij,rj->r", off, np.linalg.inv(said["covariance"]), off) <= chi2.ppf(0.95, 3)
    assert 0.93 <= inside.mean() <= 0.97
    assert np.abs(off.mean(axis=0)).max() < 1.0  # unbiased
    refuted = said["consistent"] < 0.05  # calibrated for errors 1.3 times as large
    assert 0.01 < refuted.mean() < 0.05


def test_axes_of_the_frame_are_the_base_s_turned(model):
    tau = torque(model, "joint5", POSE, np.r_[10.0, 20.0, 30.0, 0.0, 0.0, 0.0])
    base, own = (one(model, "joint5", POSE, tau, [0.0, 0.0, 0.05], axes) for axes in (BASE, FRAME))
    columns = [model.columns("joint5", POSE, [0.0, 0.0, 0.05], axes)[:3] for axes in (BASE, FRAME)]
    turned = columns[1] @ np.linalg.pinv(columns[0])  # frame from base
    for name in ("force", "moment"):
        np.testing.assert_allclose(own[name], turned @ base[name], rtol=1e-6, atol=1e-6)
        assert np.linalg.norm(own[name]) == pytest.approx(np.linalg.norm(base[name]))


def test_through_a_singularity_the_answer_is_continuous_and_the_blind_direction_is_named(model):
    """Stretched out, no joint feels a force along the arm; a pseudo-inverse jumps to zero there."""
    elbow = np.linspace(-0.8, 0.6, 4001)
    q = np.zeros((len(elbow), 7))
    q[:, 1], q[:, 3] = 0.5, elbow
    force = np.array([20.0, 0.0, 15.0])
    tau = np.array([torque(model, "joint5", pose, np.r_[force, 0, 0, 0]) for pose in q])
    rng = np.random.default_rng(0)
    tau += rng.normal(size=7) * SIGMA  # the same error at all poses
    said = model.wrenches("joint5", q, tau, np.tile(SIGMA, (len(q), 1)), [0.0, 0.0, 0.0])
    steps = np.linalg.norm(np.diff(said["force"], axis=0), axis=1)
    spread = np.sqrt(np.trace(said["covariance"], axis1=1, axis2=2))
    assert (steps < 0.1 * spread[1:] + 0.1).all()
    assert (np.abs(np.diff(np.log(spread))) < 0.05).all()
    jacobians = np.array([model.columns("joint5", pose.tolist())[:3] / SIGMA for pose in q])
    at_singular = np.argmin(np.linalg.svd(jacobians, compute_uv=False)[:, -1])
    assert said["blind"][at_singular] >= 1 and said["blind"][0] == 0
    direction = said["blind_directions"][at_singular, 0]
    along = model.columns("joint5", q[at_singular].tolist())[:3].T @ direction
    assert np.abs(along / SIGMA).max() < 0.01  # 1 N along it shows in no joint
    assert spread[at_singular] > 100
    off = said["force"] - force
    distance = np.sqrt(np.einsum("ri,rij,rj->r", off, np.linalg.inv(said["covariance"]), off))
    assert (distance < 4).all()


def test_a_touch_further_up_the_arm_is_no_touch_at_the_flange_and_one_further_down_is_refuted_below(model):
    at_tip = torque(model, "joint7", POSE, np.r_[40.0, 30.0, -20.0, 0, 0, 0])
    at_elbow = torque(model, "joint4", POSE, np.r_[40.0, 30.0, -20.0, 0, 0, 0])
    here = [0.0, 0.0, 0.0]
    assert one(model, "joint7", POSE, at_tip, here)["consistent"] > 0.9
    assert one(model, "joint4", POSE, at_elbow, here)["consistent"] > 0.9
    assert one(model, "joint4", POSE, at_tip, here)["consistent"] < 1e-3
    assert one(model, "joint7", POSE, at_elbow, here)["consistent"] < 0.05


def test_what_a_contact_adds_to_a_joints_error_is_independent_of_the_others():
    model, sigma, contact = _core.WrenchModel(_core.Bundle.load(str(GOLDEN))), [1.0, 0.5], [1.5, 0.5]
    tau = [7.0, -3.0]
    free, held = (model.covariance(True, tau, sigma, more) for more in ([], contact))
    of_constant = (0.05 * 7.0) ** 2  # the usual share of an old bundle; S has it in free motion too
    np.testing.assert_allclose(held - free, [[1.5**2 - 1.0**2 - of_constant, 0], [0, 0]], atol=1e-12)
    np.testing.assert_array_equal(model.covariance(True, tau, sigma, sigma), free)
    rows = (np.array([[0.3, 0.8]]), np.array([tau]), np.array([sigma]), [0.0, 0.0, 0.0], BASE)
    free, held = (model.wrenches("elbow", *rows, more) for more in (None, np.array([contact])))
    assert (np.linalg.eigvalsh(held["covariance"] - free["covariance"])[0] > -1e-6).all()
    assert np.trace(held["covariance"][0]) > np.trace(free["covariance"][0])
    for wrong in ([0.9, 0.5], [np.nan, 0.5], [np.inf, 0.5]):  # less than in free motion, or no number
        assert np.isnan(model.wrenches("elbow", *rows, np.array([wrong]))["force"]).all()
    with pytest.raises(_core.CoreError, match="contact_sigma_nm must have the shape of q"):
        model.wrenches("elbow", *rows, np.ones((2, 2)))
    with pytest.raises(_core.CoreError, match="tau_ext, sigma_nm and contact_sigma_nm must hold 2 values"):
        model.covariance(True, tau, sigma, [1.0])


def test_what_a_touch_adds_to_the_friction_of_moving_joints_is_taken_off_where_a_load_showed_it():
    """Friction s |load| against the motion: the arm's own part is the prior's, the touch's is in tau_ext."""
    shares, moving = np.array([0.0, 0.05, 0.0, 0.08, 0.0, 0.0, 0.0]), np.array([0.3, -0.4, 0.2, 0.5, 0.0, -0.3, 0.6])
    made, prior = arm_bundle(), _core.PriorSettings()
    prior.terms = [_core.Term(_core.TermKind.load, joint) for joint in (1, 3)]
    weights = np.zeros((7, 2))
    weights[[1, 3], [0, 1]] = -shares[[1, 3]]
    prior.weights = weights.ravel().tolist()
    made.prior = prior
    model = _core.WrenchModel(made)
    true = torque(model, "joint7", POSE, np.r_[20.0, -25.0, 30.0, 1.0, 0.5, -1.0])
    weight = _core.Tree(made.links, made.gravity).momentum(np.array([POSE]), np.zeros((1, 7)))[1][0]
    rubs = shares * np.sign(moving) * (np.abs(weight - true) - np.abs(weight))
    rows = (np.array([POSE]), (true - rubs)[None], SIGMA[None], None, BASE, None)
    before, after, standing = (
        model.wrenches("joint7", *rows, dq)["force"][0] for dq in (None, moving[None], 0 * moving[None])
    )
    assert np.linalg.norm(after - [20.0, -25.0, 30.0]) < 0.2 * np.linalg.norm(before - [20.0, -25.0, 30.0])
    np.testing.assert_array_equal(standing, before)
    # In contact_sigma, that friction is an error. Once it is taken off, 0.3 squared of its variance remains.
    taken = shares * np.sign(moving) * (np.abs(weight - (true - rubs)) - np.abs(weight))
    rubbing, remains = np.hypot(SIGMA, taken)[None], np.hypot(SIGMA, 0.3 * taken)[None]
    moved = model.wrenches("joint7", *rows[:-1], rubbing, moving[None])
    expected = model.wrenches("joint7", np.array([POSE]), (true - rubs + taken)[None], SIGMA[None], None, BASE, remains)
    np.testing.assert_allclose(moved["covariance"], expected["covariance"], rtol=1e-6)
    np.testing.assert_allclose(moved["force"], expected["force"], atol=1e-3)


def test_nothing_is_known_without_torques(model):
    tau = np.full(7, np.nan)
    told = one(model, "joint7", POSE, tau)
    assert np.isnan(told["force"]).all() and np.isnan(told["covariance"]).all() and np.isnan(told["consistent"])


def test_a_frame_that_there_is_none_and_a_bundle_that_cannot_tell_are_one_line(model, bundle):
    with pytest.raises(_core.CoreError, match=r"frame = 'elbow' must be one of joint1, .*joint7"):
        one(model, "elbow", POSE, np.zeros(7))
    empty = _core.Bundle()
    links = bundle.links
    for link in links:
        link.mass = 0.0
    empty.links = links
    refused = _core.WrenchModel(empty)
    assert "case none" in refused.refused
    with pytest.raises(_core.CoreError, match="no wrench: the bundle has no model"):
        refused.wrenches("joint7", np.zeros((1, 7)), np.zeros((1, 7)), np.ones((1, 7)))


def test_a_bundle_without_wrench_settings_tells_wrenches_at_its_links_with_usual_doubt():
    old = _core.Bundle.load(str(GOLDEN))
    model = _core.WrenchModel(old)
    assert not model.refused and old.wrench_settings.correlation == []
    names = [frame.name for frame in model.frames]
    assert names[:2] == ["shoulder", "elbow"]
    S = model.covariance(False, [10.0, -4.0], [1.0, 0.5])
    np.testing.assert_allclose(S, np.diag([1.0 + 0.25, 0.25 + 0.04]))
    monitor = _core.Monitor(old)
    told = monitor.wrench("elbow")
    assert not told.known and np.isnan(told.force).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"correlation": [1.0, 0.5, 0.4, 1.0]}, "must be symmetric"),
        ({"correlation": [1.0, 1.0, 1.0, 1.0]}, "positive definite"),
        ({"correlation": [1.0]}, "1 values where 4 belong"),
        ({"torque_share": [0.1, -0.1]}, "must be 0 to 1"),
        ({"radius": [0.0, 1.0]}, "must be above 0"),
        ({"frames": [_core.WrenchFrame("tool", 2)]}, "frame 'tool'"),
    ],
)
def test_settings_that_do_not_hold_together_are_refused(change, message):
    bundle = _core.Bundle.load(str(GOLDEN))
    for name, value in change.items():
        setattr(bundle.wrench_settings, name, value)
    with pytest.raises(_core.CoreError, match=message):
        bundle.to_bytes()


def test_settings_are_kept_by_the_file():
    bundle = _core.Bundle.load(str(GOLDEN))
    settings = bundle.wrench_settings
    settings.frames = [_core.WrenchFrame("tool", 1, [0, -1, 0, 1, 0, 0, 0, 0, 1], [0.1, 0.2, 0.3])]
    settings.correlation, settings.torque_share, settings.common_share = [1.0, 0.3, 0.3, 1.0], [0.1, 0.2], 0.05
    settings.radius, settings.residual_radius = [2.0, 3.0], [4.0, 5.0]
    bundle.wrench_settings = settings
    again = _core.Bundle.from_bytes(bundle.to_bytes()).wrench_settings
    for name in ("correlation", "torque_share", "common_share", "radius", "residual_radius"):
        assert getattr(again, name) == getattr(settings, name)
    assert [(f.name, f.link, f.rotation[1], f.translation[2]) for f in again.frames] == [("tool", 1, -1.0, 0.3)]


def test_errors_that_joints_share_are_found_and_shrunk_by_how_little_motion_there_was():
    rng = np.random.default_rng(0)
    z = rng.normal(size=(5000, 3))
    z[:, 1] = 0.8 * z[:, 0] + 0.6 * z[:, 1]
    z[::100, 2] *= 50  # rare large errors
    long, short = correlation(z, 3600.0), correlation(z, 3.0)
    assert long[0, 1] == pytest.approx(0.8 * 0.95, abs=0.03) and abs(long[0, 2]) < 0.05
    assert short[0, 1] == pytest.approx(0.5 * 0.8, abs=0.03)
    assert np.linalg.eigvalsh(correlation(np.ones((10, 3)), 1e6)).min() > 0.04


def test_the_radius_is_that_of_the_tail():
    heavy = np.random.default_rng(0).standard_t(3, size=(20000, 1)) ** 2
    found = factor(heavy.sum(axis=1), 1)
    assert (heavy[:, 0] / found <= chi2.ppf(0.95, 1)).mean() == pytest.approx(0.95, abs=1e-3)
    assert factor(np.full(100, 0.7 * chi2.ppf(0.95, 3)), 3) == pytest.approx(0.7)
    assert factor(np.zeros(100), 3) == 0.5  # an arm that stood still is not believed


def without(own: list[int]) -> _core.Bundle:
    """The arm, these joints in amperes."""
    bundle = arm_bundle()
    return without_constants(bundle, own)


@pytest.mark.parametrize("point", [None, [0.0, 0.02, 0.1]])
def test_a_joint_without_newton_metres_is_no_row_of_the_least_squares(point):
    """Whatever it answers."""
    less, q = _core.WrenchModel(without([6])), np.array(POSE)
    assert less.refused == "" and less.left_out == [less.frames[6].name]
    rng, keep = np.random.default_rng(5), slice(0, 6)
    tau = rng.normal(size=7)
    frame = less.left_out[0]
    s = less.covariance(point is not None, tau, SIGMA)[keep, keep]
    columns = less.columns(frame, list(q), point or [0.0, 0.0, 0.0])[: 6 if point is None else 3, keep]
    prior = np.diag([1e-6] * 3 + [1e-4] * (len(columns) - 3))
    information = columns @ np.linalg.solve(s, columns.T) + prior
    wanted = np.linalg.solve(information, columns @ np.linalg.solve(s, tau[keep]))
    for last in (tau[6], 1e3 * tau[6], np.nan):
        told = one(less, frame, q, np.r_[tau[keep], last], point)
        said = np.r_[told["force"], told["moment"]][: len(wanted)]
        np.testing.assert_allclose(said, wanted, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(told["covariance"], np.linalg.inv(information), rtol=1e-6, atol=1e-6)


def test_what_the_left_out_joints_alone_would_show_is_blind():
    q = np.array(POSE)
    whole, less = _core.WrenchModel(without([])), _core.WrenchModel(without([5, 6]))
    frame = less.left_out[1]
    assert one(whole, frame, q, np.ones(7))["blind"] == 0
    told, columns = one(less, frame, q, np.ones(7)), less.columns(frame, list(q))[:, :5]
    ways = told["blind_directions"][: told["blind"]] * [1, 1, 1, 0.1, 0.1, 0.1]
    assert np.abs(ways @ columns).max(axis=1).min() < 1e-6  # [N m] of 1 N: five rows leave one direction of six


def test_too_few_joints_in_newton_metres_tell_no_force():
    assert _core.WrenchModel(without([3, 4, 5, 6])).refused == ""
    refused = _core.WrenchModel(without([2, 3, 4, 5, 6])).refused
    assert refused.startswith("only 2 of 7 joints in N m") and refused.endswith("and a force is in newtons")
    assert _core.WrenchModel(without(list(range(7)))).refused.startswith("none of 7 joints in N m")


def test_a_joint_without_newton_metres_notices_no_force():
    """As if its limit were infinite."""
    rng = np.random.default_rng(2)
    less, whole, q, limit = without([3]), without([]), rng.uniform(-1, 1, (20, 7)), rng.uniform(1, 5, (20, 7))
    found = noticed_force(less, q, limit, points(less))
    assert found != noticed_force(whole, q, limit, points(whole))
    limit[:, 3] = 1e12
    same = noticed_force(whole, q, limit, points(whole))
    assert len(found) == len(same) == 7
    for one_point, other in zip(found, same, strict=True):
        for way in ("every_way", "x", "y", "z", "worst_way"):
            for name, value in asdict(getattr(one_point, way)).items():
                expected = getattr(getattr(other, way), name)
                assert value == (expected and pytest.approx(expected, rel=1e-6)), (way, name)


def test_a_wrench_prints_its_frame_its_values_with_standard_errors_and_their_units():
    monitor = _core.Monitor(_core.Bundle.load(str(GOLDEN)))
    assert repr(monitor.wrench("elbow")) == "<Wrench at elbow, axes of the base: unknown>"
    t_ns = np.arange(0, int(2e9), monitor.sample_period_ns)
    speed = np.array([0.5, 0.9])
    angle = np.outer(t_ns * 1e-9, speed)
    monitor.run(t_ns, np.sin(angle), speed * np.cos(angle), 2.0 + np.cos(angle))
    full = monitor.wrench("elbow", _core.WrenchAxes.frame)
    text = repr(full)
    assert text.startswith("<Wrench at elbow, axes of the frame: force (")
    assert text.endswith(f"{len(full.blind)} blind directions>")
    number = r"(-?\d+\.?\d*) ± (\d+\.?\d*)"
    forces, moments = re.search(r"force \((.*)\) N, moment \((.*)\) N m", text).groups()
    printed = [[float(one) for one in pair] for part in (forces, moments) for pair in re.findall(number, part)]
    errors = np.sqrt(np.diag(full.covariance))
    assert len(printed) == 6
    for (value, error), true, sigma in zip(printed, [*full.force, *full.moment], errors, strict=True):
        assert abs(value - true) <= 0.05 * sigma and abs(error - sigma) <= 0.05 * sigma  # two digits of the error
    alone = monitor.force("elbow", [0.0, 0.0, 0.1])
    assert repr(alone).startswith("<Wrench at elbow (0, 0, 0.1) m, axes of the base: force (")
    assert "moment" not in repr(alone)
    assert (alone.frame, alone.axes, alone.point) == ("elbow", BASE, [0.0, 0.0, 0.1]) and full.point is None
