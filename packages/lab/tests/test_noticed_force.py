"""What force is noticed: closed forms of a planar arm, a search over directions, Pinocchio, and the chain itself."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pinocchio_oracle as oracle
import pytest
from made_arms import regular_times, settings
from made_bundles import SEVEN_AXIS, planar_arm_bundle, planar_tool_bundle, pushed, watching_bundle, with_error_scale
from made_results import run_command
from scipy.spatial import HalfspaceIntersection
from tauext_lab.evaluate.comparison import evaluate
from tauext_lab.evaluate.noticed_force import (
    MOST_N,
    least_force,
    noticed,
    noticed_force,
    usual_limits,
    worst_force,
)
from tauext_lab.evaluate.results import NoticedForce, OverPoses, to_json

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.bundle.estimates import load_estimates
from tauext.data.recording_file import save_recording
from tauext.errors import BundleError, ConfigError
from tauext.robot.frames import wrench_frames
from tauext.robot.read import load_tree
from tauext.train.hits import even_ways, points
from tauext.train.wrench import ForceErrors, poses

LIMITS, NEAR, LENGTH = [6.0, 3.0], [9.0, 4.0], 0.3


def told(bundle: _core.Bundle, per_speed: float = 0.0) -> _core.Bundle:
    """With an error scale, which telling a force needs: its limits are those of the bundle at any speed."""
    return with_error_scale(bundle, per_speed)


@pytest.fixture
def planar() -> _core.Bundle:
    return planar_tool_bundle()


def at_poses(bundle, q, limit=LIMITS, which=-1, frames=()):
    q = np.atleast_2d(np.asarray(q, dtype=float))
    return noticed_force(bundle, q, np.tile(np.asarray(limit, dtype=float), (len(q), 1)), points(bundle, frames))[which]


def test_it_takes_the_limit_over_the_lever(planar):
    straight = at_poses(planar, [0, 0])  # both levers along x: 0.5 m to the shoulder, 0.2 m to the elbow
    assert straight.y == OverPoses(pytest.approx(6 / 0.5), pytest.approx(6 / 0.5), 0)
    assert straight.x == OverPoses(None, None, 1)  # along the arm nobody feels it
    assert straight.z.blind_share == straight.worst_way.blind_share == 1  # out of the plane never
    bent = at_poses(planar, [0, np.pi / 2])  # the tool stands 0.3 m beside the shoulder and 0.2 m above it
    assert bent.x.worst_n == pytest.approx(min(6 / 0.2, 3 / 0.2))
    assert bent.y.worst_n == pytest.approx(6 / 0.3)  # through the elbow's axis


def test_a_link_is_asked_at_its_end_and_a_frame_by_its_name(planar):
    names = [point.name for point in points(planar, ["elbow"])]
    assert names == ["link of shoulder, at elbow", "load's frame tool", "frame elbow"]
    end = at_poses(planar, [0.7, 0.4], which=0)
    assert np.hypot(1 / end.x.worst_n, 1 / end.y.worst_n) == pytest.approx(LENGTH / 6)
    assert at_poses(planar, [0.7, 0.4], which=2, frames=["elbow"]).y == end.y
    load = planar.load_settings
    load.link = -1
    planar.load_settings = load
    assert [point.name for point in points(planar)][-1] == "link of elbow, at its origin"
    with pytest.raises(ConfigError, match="frame = 'wrist' must be one of shoulder, elbow"):
        points(planar, ["wrist"])


def test_median_and_worst_are_over_the_poses(planar):
    poses_ = [[0, 0], [0.3, 0.8], [0.6, -1.2]]
    alone = [at_poses(planar, q).y.worst_n for q in poses_]
    of_all = at_poses(planar, poses_)
    assert of_all.y.worst_n == pytest.approx(max(alone)) and of_all.y.median_n == pytest.approx(np.median(alone))
    assert of_all.x.blind_share == pytest.approx(1 / 3) and of_all.x.worst_n is None
    assert of_all.x.median_n is not None
    twice = at_poses(planar, poses_, limit=[12.0, 6.0])
    assert twice.every_way.median_n == pytest.approx(2 * of_all.every_way.median_n)


def test_ways_are_even_on_half_a_sphere_and_a_force_counts_as_its_opposite():
    ways = even_ways()
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), 1)
    both = np.vstack([ways, -ways])
    np.testing.assert_allclose(both.T @ both / len(both), np.eye(3) / 3, atol=0.01)  # as of an even sphere
    w = np.random.default_rng(0).normal(size=(5, 7, 3))
    np.testing.assert_array_equal(least_force(w, ways), least_force(w, -ways))


@pytest.mark.parametrize("joints", [3, 4, 7])
def test_the_worst_way_is_the_farthest_corner_of_what_nobody_notices(joints):
    rng = np.random.default_rng(joints)
    w = rng.normal(size=(20, joints, 3)) / 20
    worst, all_ways = worst_force(w), least_force(w, even_ways()).max(axis=1)
    assert np.isfinite(worst).sum() > 10
    for rows, found, at_least in zip(w, worst, all_ways, strict=True):
        sides = np.hstack([np.vstack([rows, -rows]), -np.ones((2 * joints, 1))])  # w . x - 1 <= 0
        farthest = np.linalg.norm(HalfspaceIntersection(sides, np.zeros(3)).intersections, axis=1).max()
        assert found == (pytest.approx(farthest, rel=1e-6) if farthest <= MOST_N else np.inf)
        assert found >= at_least


def test_a_direction_that_nobody_feels_is_blind_and_no_number():
    w = np.random.default_rng(1).normal(size=(1, 7, 3))
    w[:, :, 2] = 0
    assert np.isinf(worst_force(w)).all() and np.isinf(least_force(w, np.eye(3))[0, 2])
    w[:, :, 2] = 1e-17  # what rounding leaves of it
    assert np.isinf(worst_force(w)).all() and np.isinf(least_force(w, np.eye(3))[0, 2])
    assert np.isfinite(least_force(w, np.eye(3))[0, :2]).all()
    assert np.isinf(worst_force(w[:, :2])).all()  # two joints never feel all directions


def test_levers_are_pinocchio_s_at_a_frame_of_the_robot_file():
    tree = load_tree(SEVEN_AXIS)
    bundle = _core.Bundle()
    bundle.links, bundle.gravity, bundle.observer = tree.links, tree.gravity, settings()
    asked = _core.WrenchSettings()
    asked.frames = wrench_frames(SEVEN_AXIS, tree)
    bundle.wrench_settings = asked
    told(bundle)
    pin, arm = oracle.pin, oracle.read_model(SEVEN_AXIS.read_text())
    joints = [link.joint_name for link in tree.links]
    limit, rng = np.array([8.0, 9.0, 6.0, 5.0, 2.0, 2.0, 1.0]), np.random.default_rng(4)
    frame = asked.frames[-1]
    for q in rng.uniform(-2, 2, (5, 7)):
        J = oracle.frame_jacobian(arm, q, joints, frame.name, pin.LOCAL_WORLD_ALIGNED)[:3]
        found = at_poses(bundle, q, limit, frames=[frame.name])
        for axis, row in zip("xyz", J, strict=True):
            wanted = 1 / np.abs(row / limit).max()
            assert getattr(found, axis).worst_n == (pytest.approx(wanted) if wanted <= MOST_N else None)


@pytest.fixture(scope="module")
def arm_bundle() -> _core.Bundle:
    return planar_arm_bundle()


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("way", ["x", "y"])
def test_the_chain_goes_over_its_limit_from_the_stated_force_on(arm_bundle, which, way):
    tree, model = _core.Tree(arm_bundle.links, arm_bundle.gravity), _core.WrenchModel(arm_bundle)
    point = points(arm_bundle)[which]
    for q in np.random.default_rng(6).uniform(-1.5, 1.5, (3, 2)):
        still = np.tile(q, (1500, 1))
        _, gravity = tree.momentum(still, np.zeros_like(still))
        lever = model.columns(point.frame, q.tolist(), list(point.point_m))["xyz".index(way)]
        for limits, key in (
            (usual_limits(arm_bundle, 1)["collision near stiction"], "limit_nm"),
            (usual_limits(arm_bundle, 1)["contact near stiction"], "contact_limit_nm"),
        ):
            stated = at_poses(arm_bundle, q, limits[0], which)
            stated = getattr(stated, way).worst_n
            for times, over in ((0.97, False), (1.03, True), (-0.97, False), (-1.03, True)):
                tau = gravity - times * stated * lever
                said = _core.Monitor(arm_bundle).run(regular_times(1500), still, np.zeros_like(still), tau)
                assert (np.abs(said["tau_ext"][-1]) > said[key][-1]).any() == over


def test_the_contact_limit_of_an_evaluation_is_that_of_the_monitor(arm_bundle):
    made = pushed()
    bundle = with_error_scale(watching_bundle())
    for one in (arm_bundle, bundle):
        signals = (made.t_ns, made.q, made.dq, made.tau)
        told_ = _core.estimate(one, *signals, 1)["contact_limit_nm"]
        np.testing.assert_array_equal(told_, _core.Monitor(one).run(*signals)["contact_limit_nm"])


def test_a_force_that_stays_is_reported_when_the_observer_shows_it(arm_bundle):
    found = noticed(arm_bundle, np.zeros((1, 2)), {}, 0.0)
    assert found.twice_after_s["contact"] == pytest.approx(np.log(2) / 20 + arm_bundle.contact_hold_s)
    still = np.zeros((1200, 2))
    tau = _core.Tree(arm_bundle.links, arm_bundle.gravity).momentum(still, still)[1]
    tau[1000:, 1] -= 2 * arm_bundle.near_stiction_limit_nm[1]
    wobble = still + 1e-7 * (np.arange(1200) % 2)[:, None]  # an encoder that never moves would be a fault
    said = _core.Monitor(arm_bundle).run(regular_times(1200), wobble, still, tau)
    over = np.flatnonzero(np.abs(said["tau_ext"][:, 1]) > said["limit_nm"][:, 1])[0]
    assert (over - 1000) * 1e-3 == pytest.approx(np.log(2) / 20, abs=2e-3)


def test_an_evaluation_holds_it_over_its_test_recordings_or_says_why_not(arm_bundle, tmp_path):
    bundles = {"planar": arm_bundle, "none": with_error_scale(watching_bundle())}
    made = pushed(pushes=(), seconds=8.0)
    found, refused = (one.forces.lasting for one in evaluate(bundles, [lambda: made], [], tmp_path, 0, 1).bundles)
    assert 6 <= found.poses <= 8 and set(found.limits) == {"collision", "contact"}
    assert refused == NoticedForce(_core.WrenchModel(bundles["none"]).refused)
    kept_ = load_estimates(tmp_path / "planar" / "pushed.parquet")
    assert kept_.contact_limit_nm is None  # that of a flight's estimates alone
    every = [one.every_way.median_n for one in (*found.limits["collision"], *found.limits["contact"])]
    usual = usual_limits(arm_bundle, 1)
    regions = ("collision while sliding", "collision near stiction")
    ends = [at_poses(arm_bundle, made.q[::1000], usual[name][0]) for name in regions]
    assert ends[0].every_way.median_n * 0.9 < every[1] < ends[1].every_way.median_n * 1.1


def test_a_bundle_keeps_poses_that_are_even_in_time():
    q = np.linspace(0, 6.3, 5000)[:, None] * np.ones(3)
    kept = np.array(poses(q))
    assert kept.shape == (ForceErrors.poses, 3) and kept[0, 0] == 0 and kept[-1, 0] == 6.3
    assert np.ptp(np.diff(kept[:, 0])) < 0.004
    assert poses(q[:5]) == np.round(q[:5], 3).tolist() and poses(q[:0]) == []


def saved(bundle: _core.Bundle, path: Path, facts: dict) -> str:
    bundle.provenance = json.dumps(facts)
    bundle.save(str(path))
    return str(path)


@pytest.fixture
def kept(arm_bundle, tmp_path) -> str:
    """Its file, with poses."""
    return saved(arm_bundle, tmp_path / "arm.tauext", {"wrench": {"poses": [[0.0, 0.0], [0.3, 0.8], [0.6, -1.2]]}})


def show(capsys, *arguments) -> tuple[int, str, str]:
    return run_command(capsys, "show", *arguments)


def test_show_force_tells_it_in_lines_and_as_json(kept, arm_bundle, capsys):
    code, out, _ = show(capsys, kept, "--force")
    assert (
        code == 0 and "ISO/TS 15066" in out and "load's frame tool" in out and "threshold: contact while sliding" in out
    )
    code, out, _ = show(capsys, kept, "--force", "--json", "--frame", "elbow")
    found = json.loads(out)
    assert found["poses"] == 3 and len(found["limits"]) == 4
    wanted = at_poses(arm_bundle, [[0.0, 0.0], [0.3, 0.8], [0.6, -1.2]], which=1)
    assert found["limits"]["collision while sliding"][1] == to_json(wanted)
    assert found["limits"]["contact near stiction"][2]["place"] == "frame elbow"


def test_show_force_takes_recordings_with_the_limits_as_they_held(kept, tmp_path, capsys):
    save_recording(pushed(pushes=()), tmp_path / "motion.parquet")
    bundle = load_bundle(kept)
    told(bundle, per_speed=1.0)  # limits that grow with the speed
    faster = saved(bundle, tmp_path / "faster.tauext", {})
    forces = []
    for file in (kept, faster):
        code, out, error = show(capsys, file, "--force", "--json", "--data", tmp_path / "motion.parquet")
        assert code == 0, error
        forces.append(json.loads(out))
    assert list(forces[0]["limits"]) == ["collision", "contact"] and 3 <= forces[0]["poses"] <= 6
    usual, raised = (one["limits"]["collision"][1]["every_way"]["median_n"] for one in forces)
    assert raised > 1.3 * usual


def test_show_force_draws_a_picture(kept, tmp_path, capsys):
    code, _, error = show(capsys, kept, "--force", "--picture", tmp_path / "force.png")
    assert code == 0, error
    assert (tmp_path / "force.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("{none}", "--force"), "the minimum detectable force is not known"),
        (("{old}", "--force"), "--data REC.parquet"),
        (("{damaged}", "--force"), "provenance is damaged"),
        (("{kept}", "--force", "--frame", "wrist"), "must be one of shoulder, elbow, tool"),
        (("{kept}", "--force", "--data", "gone.parquet"), "gone.parquet: there is no such recording"),
        (("{kept}", "--force", "--picture", "force.jpg"), "ends in .png"),
        (("{kept}", "--frame", "elbow"), "belong to --force"),
        (("{recording}", "--force"), "--force needs a bundle"),
    ],
)
def test_what_tells_no_force_is_refused_in_one_line(arguments, words, kept, arm_bundle, tmp_path, capsys):
    files = {
        "kept": kept,
        "none": saved(with_error_scale(watching_bundle()), tmp_path / "none.tauext", {}),
        "old": saved(load_bundle(kept), tmp_path / "old.tauext", {"wrench": {"torque_share": [0.05, 0.05]}}),
        "damaged": saved(load_bundle(kept), tmp_path / "damaged.tauext", {"wrench": {"poses": [[1.0, 2.0, 3.0]]}}),
        "recording": tmp_path / "motion.parquet",
    }
    save_recording(pushed(pushes=()), files["recording"])
    code, out, error = show(capsys, *(one.format(**files) for one in arguments))
    assert code == 2 and out == "" and words in error and error.count("\n") == 1


def test_a_bundle_without_an_error_scale_is_refused(planar):
    planar.error_scale = _core.ErrorScaleSettings()
    with pytest.raises(BundleError, match="planar: the minimum detectable force is not known"):
        points(planar)
