"""A load weighed by the arm's own joints: its columns, what is found, what is refused, and a weight that is known."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_arms import planar_rig, six_axis_tree, urdf
from made_bundles import without_constants
from made_live import replay
from made_recordings import Drive, made_motion
from scipy.optimize import least_squares

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.cli import main
from tauext.config import ObserverConfig, TrainConfig
from tauext.data.recording import Recording
from tauext.data.recording_file import save_recording
from tauext.errors import ConfigError
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.monitor.explanation import explain
from tauext.monitor.flight_content import Flight, rows_kept
from tauext.monitor.flight_files import FlightSource
from tauext.monitor.known_load import weigh_constants, with_provenance
from tauext.monitor.weighing import (
    WeighedMotion,
    constants_errors,
    constants_sentence,
    expect_weighable,
    identify,
    load_frame,
    load_sentences,
    mass_error,
    see,
    weighing_joints,
)
from tauext.robot.inertial import inertial_parameters, with_inertial_parameters
from tauext.robot.read import load_tree
from tauext.train.preparation import known_constants

MASS, COM = 1.6, np.array([0.03, -0.05, 0.08])
QUIET = Drive(friction=0.0, noise=0.003)
COULOMB, GEAR = 11, 18
"""Columns of `_core.load_rows`."""
REACH_M = 0.3


def phi_of(mass: float, com: np.ndarray, radius: float = 0.04) -> np.ndarray:
    """m, h, I about the frame's origin of a ball."""
    inertia = 0.4 * mass * radius**2 * np.eye(3) + mass * (com @ com * np.eye(3) - np.outer(com, com))
    return np.r_[mass, mass * com, np.diag(inertia), inertia[0, 1], inertia[0, 2], inertia[1, 2]]


def phi_of_ball(mass: float, com: np.ndarray) -> np.ndarray:
    """An aluminium ball, as the core assumes where nothing but mass and centre are known."""
    return phi_of(mass, com, np.cbrt(3 * mass / (4 * np.pi * 2700)))


def carrying(tree: _core.Tree, phi: np.ndarray) -> _core.Tree:
    links = tree.links
    links[-1] = with_inertial_parameters(links[-1], inertial_parameters(links[-1]) + np.r_[phi, 0.0])
    return _core.Tree(links, tree.gravity)


@pytest.fixture(scope="module")
def arm(tmp_path_factory) -> _core.Tree:
    return six_axis_tree(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def loaded_motion(arm) -> Recording:
    return made_motion(carrying(arm, phi_of(MASS, COM)), 0.4, pieces=1, seed=3, drive=QUIET).recordings[0]


@pytest.fixture(scope="module")
def free_motion(arm) -> Recording:
    return made_motion(arm, 0.2, pieces=1, seed=4, drive=QUIET).recordings[0]


def bundle_of(tree: _core.Tree, recording: Recording) -> _core.Bundle:
    """The plain observer, whose error is a fifth of its limits."""
    setup = build_setup(tree, recording, ObserverConfig())
    bundle = make_bundle("arm", setup, 0.02, recording)
    spread = recording.tau.std(axis=0)
    bundle.sliding_limit_nm = bundle.near_stiction_limit_nm = (5 * (0.01 * spread + 0.02)).tolist()
    bundle.possible_torque_nm = [1e6] * tree.size
    return bundle


def test_an_unmodelled_load_shows_what_its_columns_say(arm, free_motion):
    phi = phi_of(MASS, COM)
    signals = (free_motion.t_ns, free_motion.q, free_motion.dq, free_motion.tau)
    bundle = bundle_of(arm, free_motion)
    without = _core.observe(arm, bundle.observer, *signals).residual
    carrying_it = _core.observe(carrying(arm, phi), bundle.observer, *signals).residual
    rows = np.arange(0, free_motion.samples, 7)
    columns = _core.load_rows(bundle, _core.LoadFrame(5), [0.0] * 10, *signals[:3], rows)
    # tau_ext of the arm that carries it, seen by the model that lacks it, is lower by what the model would add
    np.testing.assert_allclose(columns[..., :10] @ phi, (without - carrying_it)[rows], atol=1e-9)
    assert np.abs(columns[..., GEAR]).max() == 0


def rows_of(bundle: _core.Bundle, motion: WeighedMotion, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns of mass and first moment, (rows, n, 4), those of Coulomb friction, and tau_ext without phi's inertia."""
    r = motion.recording
    z = _core.load_rows(bundle, load_frame(bundle).frame, phi.tolist(), r.t_ns, r.q, r.dq, motion.samples)
    return z[..., :4], z[..., COULOMB], motion.tau_ext - z[..., GEAR] - z[..., 4:10] @ phi[4:]


def noise_of(left: np.ndarray, motion: WeighedMotion) -> np.ndarray:
    """Weights of the squared errors, (rows, n), by the size of what is left and by its sums over blocks of a second."""
    error, worth = left / motion.sigma, motion.worth
    square = np.maximum((worth * error**2).sum(axis=0) / worth.sum(axis=0), 0.25)
    blocks = np.array([block.sum(axis=0) for block in np.split(worth * error, range(100, len(left), 100))])
    alike = ((blocks**2).sum(axis=0) / square).sum() / ((worth * error**2).sum(axis=0) / square).sum()
    return worth / motion.sigma**2 / square / np.clip(alike, 30, 100)


def sizes_of(bundle: _core.Bundle) -> np.ndarray:
    """Standard deviations of offset and Coulomb friction, (n, 2): of a bundle without drift."""
    return 0.3 * np.array(bundle.sliding_limit_nm)[:, None] * [0.07, 0.2]


def test_the_load_is_the_least_squares_of_numpy(arm, loaded_motion, free_motion):
    bundle, n = bundle_of(arm, free_motion), 6
    motion = see(bundle, loaded_motion)
    found = identify(bundle, load_frame(bundle), [motion])
    columns, coulomb, target = rows_of(bundle, motion, found.phi)
    design = np.zeros((*target.shape, 4 + 2 * n))
    design[..., :4] = columns
    for j in range(n):
        design[:, j, 4 + 2 * j], design[:, j, 5 + 2 * j] = 1, coulomb[:, j]
    before = np.diag(1 / np.r_[1000.0, [found.mass_kg * REACH_M / 2] * 3, sizes_of(bundle).ravel()])
    weights = motion.worth / motion.sigma**2 / 100
    for _ in range(4):
        root = np.sqrt(weights)
        whole = np.concatenate([(root[..., None] * design).reshape(-1, 4 + 2 * n), before])
        x = np.linalg.lstsq(whole, np.r_[(root * target).ravel(), np.zeros(4 + 2 * n)], rcond=None)[0]
        left = target - design @ x
        weights = noise_of(left, motion)
    np.testing.assert_allclose(found.phi[:4], x[:4], rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(found.covariance, np.linalg.inv(whole.T @ whole)[:4, :4], rtol=1e-3, atol=1e-9)
    scaled = (motion.worth * (left / motion.sigma) ** 2).sum() / motion.worth.sum()
    assert found.misfit == pytest.approx(scaled, rel=1e-3)  # of the inertia known a round before


def test_torque_constants_of_a_known_weight_are_the_least_squares_of_scipy(arm, loaded_motion, free_motion):
    bundle = wrong_constants(arm, free_motion, 1.12)
    motion = see(bundle, loaded_motion)
    known = weigh_constants(bundle, load_frame(bundle), [motion], MASS)
    assert all(known.shows)
    a = 1 / known.factors
    columns, coulomb, target = rows_of(bundle, motion, phi_of_ball(MASS, known.com_m))
    carried, sizes = motion.tau_ext - target, sizes_of(bundle)
    # 5 % of each constant and half of the common factor, as of a bundle without shares
    about_a = np.linalg.cholesky(np.linalg.inv(np.diag([(0.05 * a.mean()) ** 2] * 6) + (0.5 * a.mean()) ** 2)).T

    def left(x: np.ndarray) -> np.ndarray:
        h, factors, offsets, frictions = np.split(x, [3, 9, 15])
        # inertia and gears are taken off by the factors found: they tell nothing about them
        return motion.tau_ext - a * carried - factors * (columns @ np.r_[MASS, h]) - offsets - frictions * coulomb

    def errors(x: np.ndarray, weights: np.ndarray) -> np.ndarray:
        h, factors, own = x[:3] / (MASS * REACH_M / 2), about_a @ (x[3:9] - a.mean()), x[9:] / sizes.T.ravel()
        return np.r_[(np.sqrt(weights) * left(x)).ravel(), h, factors, own]

    x, weights = np.r_[MASS * known.com_m, a, np.zeros(12)], motion.worth / motion.sigma**2 / 100
    for _ in range(4):
        solved = least_squares(errors, x, args=(weights,))
        x, weights = solved.x, noise_of(left(solved.x), motion)
    np.testing.assert_allclose(a, x[3:9], rtol=1e-4)
    np.testing.assert_allclose(MASS * known.com_m, x[:3], atol=1e-5)
    of_a = np.sqrt(np.diag(np.linalg.inv(solved.jac.T @ solved.jac)))[3:9]
    np.testing.assert_allclose(known.errors, of_a / a**2, rtol=1e-2)


@pytest.mark.parametrize("joint", [4, 5])
def test_a_joint_in_amperes_weighs_nothing(arm, loaded_motion, free_motion, joint):
    """Its numbers may be any; five joints tell mass and centre as they do where the sixth is not there."""
    found = []
    for nm_per_ampere in (0.1, 5.0):
        amperes = np.where(np.arange(6) == joint, 1 / nm_per_ampere, 1.0)
        bundle = without_constants(bundle_of(arm, replace(free_motion, tau=free_motion.tau * amperes)), [joint])
        assert [j for j, weighs in enumerate(weighing_joints(bundle)) if not weighs] == [joint]
        motion = see(bundle, replace(loaded_motion, tau=loaded_motion.tau * amperes))
        found.append(identify(bundle, load_frame(bundle), [motion]))
    for one in found:
        assert one.verdict == "load" and one.misfit < 1  # 734 and 1,453 with the amperes as N m
        assert abs(one.mass_kg - MASS) < 4 * one.mass_error_kg and one.mass_error_kg < 0.02
        assert np.linalg.norm(one.com_m - COM) < 0.01
    np.testing.assert_allclose(found[0].mass_kg, found[1].mass_kg, rtol=1e-6)


def test_a_frame_where_no_joint_feels_a_weight_tells_no_mass(tmp_path, arm, free_motion, loaded_motion, capsys):
    """The first joint stands upright: a load on its link weighs on none."""
    bundle = bundle_of(arm, free_motion)
    found = identify(bundle, load_frame(bundle, "joint1"), [see(bundle, loaded_motion)])
    assert not found.mass_seen and found.mass_error_kg > 100
    command = [*saved(tmp_path, bundle, loaded_motion), "--frame", "joint1"]
    assert main(command) == 0
    assert capsys.readouterr().out.startswith(
        "no weight is visible there: gravity never pulls a payload at the link of joint1"
    )
    assert main([*command, "--known-kg", "1.6"]) == 2
    assert "cannot set torque constants: no weight is visible there" in capsys.readouterr().err


def test_a_recording_given_twice_is_refused(tmp_path, arm, free_motion, loaded_motion, capsys):
    """Its errors would fall with the root of how often it is given."""
    command = saved(tmp_path, bundle_of(arm, free_motion), loaded_motion)
    save_recording(loaded_motion, tmp_path / "copy.parquet")
    for again in (command[2], str(tmp_path / "copy.parquet")):
        assert main([*command, again]) == 2
        assert "are the same motion; give each one once" in capsys.readouterr().err


def test_amperes_of_all_joints_are_no_scales(arm, free_motion):
    bundle = bundle_of(arm, free_motion)
    bundle.units = _core.TorqueUnits(_core.TorqueUnit.ampere)
    with pytest.raises(ConfigError, match="has no torque constant of any joint"):
        expect_weighable(bundle)


def test_a_heavy_load_far_out_is_found_from_little_motion(arm, free_motion):
    """Levers of a light load, assumed at the beginning, would leave 0.4 kg of it."""
    mass, com = 2.95, np.array([-0.10, 0.22, -0.04])
    recording = made_motion(carrying(arm, phi_of(mass, com)), 0.2, pieces=1, seed=116, drive=QUIET).recordings[0]
    bundle = bundle_of(arm, free_motion)
    motion = see(bundle, recording)
    rows = np.arange(len(motion.samples))
    for begin in (0, 300, 600, 900):
        found = identify(bundle, load_frame(bundle), [motion.part((rows >= begin) & (rows < begin + 60))])
        assert found.verdict == "load" and abs(found.mass_kg - mass) < 3 * max(found.mass_error_kg, 0.05)


def test_the_friction_that_a_load_adds_is_part_of_it(arm, free_motion):
    bundle = bundle_of(arm, free_motion)
    prior = _core.PriorSettings()
    prior.terms = [_core.Term(_core.TermKind.load, j, speed=0.01) for j in range(6)]
    weights = np.zeros((6, 6))
    np.fill_diagonal(weights, [-0.08, -0.08, 0.3, -9.0, -0.02, 0.0])
    prior.weights = weights.ravel().tolist()
    bundle.prior = prior
    # friction that grows with the load lies within a gear's: what was fitted to hardly any load is not believed
    np.testing.assert_allclose(_core.load_friction_shares(bundle), [0.08, 0.08, 0, 0.15, 0.02, 0])
    rng = np.random.default_rng(0)
    t_ns = np.arange(400) * 10_000_000
    q = np.repeat(rng.uniform(-1, 1, (1, 6)), 400, axis=0)
    dq = np.full((400, 6), 1.0)  # all joints slide on in one pose: friction has its full size
    rows = np.array([399])
    phi = phi_of(MASS, COM)
    p, beta = _core.load_columns(arm, _core.LoadFrame(5), q[:1], dq[:1])
    own = arm.momentum(q[:1], dq[:1])[1][0]
    columns = _core.load_rows(bundle, _core.LoadFrame(5), phi.tolist(), t_ns, q, dq, rows)[0]
    shares = np.array([0.08, 0.08, 0, 0.15, 0.02, 0])
    friction = -shares * (np.abs(own + beta[0] @ phi) - np.abs(own))
    np.testing.assert_allclose(columns[:, :10] @ phi + columns[:, GEAR], -beta[0] @ phi + friction, atol=1e-6)


def pushed(arm: _core.Tree, recording: Recording, force_n: np.ndarray) -> Recording:
    """With a constant force at the last joint's origin."""
    frame = _core.LoadFrame(5)
    pull = _core.load_columns(_core.Tree(arm.links, force_n.tolist()), frame, recording.q, 0 * recording.dq)[1][..., 0]
    return replace(recording, tau=recording.tau + pull)  # beta of a weight is what the motors give against it


def test_each_verdict_has_its_sentence(arm, free_motion, loaded_motion):
    bundle = bundle_of(arm, free_motion)
    lighter = made_motion(carrying(arm, phi_of(-0.5, COM)), 0.2, pieces=1, seed=5, drive=QUIET).recordings[0]
    contact = "this does not turn as gravity would: a constant force of (20."
    cases = [
        (free_motion, 0.3, "nothing", "no payload is visible"),
        (pushed(arm, free_motion, np.array([20.0, 5.0, 0.0])), 0.3, "contact", contact),
        (lighter, 0.3, "lifts", "the estimated force pulls up, as 0.5"),
        (loaded_motion, 0.03, "load", "(--reach-m)"),
    ]
    for recording, reach_m, verdict, words in cases:
        found = identify(bundle, load_frame(bundle), [see(bundle, recording)], reach_m)
        assert found.verdict == verdict
        assert words in " ".join(load_sentences(found, "it", "N m"))
    lifted = identify(bundle, load_frame(bundle), [see(bundle, pushed(arm, free_motion, np.array([0.0, 0.0, 15.0])))])
    assert lifted.verdict in ("contact", "lifts")


def test_one_pose_hides_the_centre_along_gravity_and_some_poses_do_not(arm, free_motion):
    bundle, phi = bundle_of(arm, free_motion), phi_of(MASS, COM)
    loaded, rng = carrying(arm, phi), np.random.default_rng(5)

    def standing(poses: int) -> Recording:
        q = np.repeat(rng.uniform(-1.5, 1.5, (poses, 6)), 200, axis=0)
        tau = loaded.momentum(q, 0 * q)[1] + 0.01 * rng.standard_normal(q.shape)
        t_ns = np.arange(len(q), dtype=np.int64) * 10_000_000
        return replace(free_motion, t_ns=t_ns, q=q, dq=0 * q, tau=tau, contact=None)

    # jumps from pose to pose are no motion: the chain is asked about each stand alone
    parts = [see(bundle, standing(1)) for _ in range(5)]
    several = identify(bundle, load_frame(bundle), parts)
    assert several.verdict == "load" and several.mass_seen and not several.unseen
    assert abs(several.mass_kg - MASS) < 0.05 and np.linalg.norm(several.com_m - COM) < 0.02
    single = identify(bundle, load_frame(bundle), parts[:1])
    assert abs(single.mass_kg - MASS) < 0.1 and len(single.unseen) == 1
    pose = parts[0].recording.q[:1]
    up = _core.load_columns(arm, load_frame(bundle).frame, pose, 0 * pose)[1][0]
    # moving the mass along what is not seen changes no joint's torque
    assert np.abs(up[:, 1:4] @ single.unseen[0]).max() < 0.05 * np.abs(up[:, 1:4]).max()


def test_what_gravity_never_turns_across_is_named(tmp_path):
    (tmp_path / "rig.urdf").write_text(urdf(planar_rig()))
    rig = load_tree(tmp_path / "rig.urdf")
    com = np.array([0.05, 0.04, 0.1])  # z of the frame is the joint's axis: level all the time
    recording = made_motion(carrying(rig, phi_of(2.0, com)), 0.3, pieces=1, seed=1, drive=QUIET).recordings[0]
    bundle = bundle_of(rig, recording)
    found = identify(bundle, load_frame(bundle), [see(bundle, recording)])
    assert found.verdict == "load"
    assert abs(found.mass_kg - 2.0) < 0.1 and np.linalg.norm(found.com_m[:2] - com[:2]) < 0.01
    assert [int(np.abs(axis).argmax()) for axis in found.unseen] == [2]
    assert "along the z axis of the frame is not visible" in load_sentences(found, "it", "N m")[-1]


def wrong_constants(arm: _core.Tree, recording: Recording, factor: float) -> _core.Bundle:
    """A bundle whose N m are too large by `factor`: its arm is too light by as much, as training finds it."""
    return _core.scaled_bundle(bundle_of(arm, recording), 1 / factor)


def test_a_known_weight_tells_the_torque_constants(arm, loaded_motion, free_motion):
    bundle = wrong_constants(arm, free_motion, 1.12)
    frame, motion = load_frame(bundle), see(bundle, loaded_motion)
    assert abs(identify(bundle, frame, [motion]).mass_kg * 1.12 - MASS) < 0.03
    known = weigh_constants(bundle, frame, [motion], MASS)
    assert known.common == pytest.approx(1.12, abs=0.01)
    assert np.linalg.norm(known.com_m - COM) < 0.01
    right = _core.corrected_bundle(bundle, known)
    assert abs(identify(right, frame, [see(right, loaded_motion)]).mass_kg - MASS) < 0.02
    placed = weigh_constants(bundle, frame, [motion], MASS, com_m=COM)
    assert placed.common == pytest.approx(1.12, abs=0.01)


def with_shares(bundle: _core.Bundle, common: float, own: list[float]) -> _core.Bundle:
    """The bundle with these relative errors of its torque constants."""
    settings = bundle.wrench_settings
    settings.common_share, settings.torque_share = common, own
    bundle.wrench_settings = settings
    return bundle


def test_a_common_factor_changes_every_weight_by_its_share(arm, loaded_motion, free_motion):
    found = []
    for common, own in ((0.0, [0.0] * 6), (0.12, [0.0] * 6), (0.0, [])):
        bundle = with_shares(bundle_of(arm, free_motion), common, own)
        found.append(identify(bundle, load_frame(bundle), [see(bundle, loaded_motion)]))
    exact, common, old = found
    assert exact.constants_error_kg == 0 and common.constants_error_kg == pytest.approx(0.12 * MASS, rel=0.01)
    for other in (common, old):  # the errors of the motion, and the verdict, are those of exact constants
        assert other.mass_error_kg == exact.mass_error_kg and other.verdict == exact.verdict
        np.testing.assert_array_equal(other.covariance, exact.covariance)
    np.testing.assert_allclose(common.com_error_m, exact.com_error_m, rtol=0.02)  # the centre does not depend on it
    assert 0.05 / 6**0.5 < old.constants_error_kg / MASS < 0.05  # bundles without shares: 5 % a joint
    assert (old.com_error_m > exact.com_error_m).all()
    sentence = load_sentences(common, "it", "N m")[0]
    assert sentence.startswith(
        "load 1.60 kg ± 12 % common to all masses found with this bundle (identify a known payload: tauext load "
        "--known-kg), ± 0.0"
    )
    assert load_sentences(exact, "it", "N m")[0].startswith("load 1.60 ± 0.0")


@pytest.mark.parametrize("joint", [1, 2, 4])
def test_a_joint_whose_constant_is_wrong_moves_the_load_by_what_its_share_promises(
    arm, loaded_motion, free_motion, joint
):
    bundle = with_shares(bundle_of(arm, free_motion), 0.0, [0.03 * (j == joint) for j in range(6)])
    frame, motion = load_frame(bundle), see(bundle, loaded_motion)
    right = identify(bundle, frame, [motion])
    wrong = identify(bundle, frame, [replace(motion, tau_ext=motion.tau_ext * (1 + 0.03 * (np.arange(6) == joint)))])
    moved = abs(wrong.mass_kg - right.mass_kg)
    assert right.constants_error_kg == pytest.approx(moved, rel=0.2, abs=0.002)
    of_com = right.com_error_m**2 - np.diag(right.com_covariance)
    np.testing.assert_allclose(np.sqrt(of_com), np.abs(wrong.com_m - right.com_m), rtol=0.3, atol=1e-3)


def test_a_known_weight_removes_the_common_error(arm, loaded_motion, free_motion):
    bundle = with_shares(wrong_constants(arm, free_motion, 1.12), 0.12, [0.02] * 6)
    frame = load_frame(bundle)
    known = weigh_constants(bundle, frame, [see(bundle, loaded_motion)], MASS)
    right = _core.corrected_bundle(bundle, known)
    settings = right.wrench_settings
    assert settings.common_share == pytest.approx(known.common_error / known.common) and settings.common_share < 0.01
    assert all(settings.own_share(j) <= 0.02 for j in range(6))
    found = identify(right, frame, [see(right, loaded_motion)])
    assert abs(found.mass_kg - MASS) < 2 * np.hypot(found.mass_error_kg, found.constants_error_kg) < 0.1
    assert "--known-kg" not in load_sentences(found, "it", "N m")[0]


@pytest.fixture(scope="module")
def second_motion(arm) -> Recording:
    return made_motion(carrying(arm, phi_of(2.8, COM)), 0.4, pieces=1, seed=5, drive=QUIET).recordings[0]


@pytest.fixture(scope="module")
def other_motion(arm) -> Recording:
    """With 2 kg elsewhere, which are to be weighed."""
    load = phi_of(2.0, np.array([0.0, 0.06, 0.04]))
    return made_motion(carrying(arm, load), 0.4, pieces=1, seed=11, drive=QUIET).recordings[0]


def seen_with(bundle: _core.Bundle, recording: Recording, true: np.ndarray) -> WeighedMotion:
    """As joints see a load whose torque constants are off by these factors beside the bundle's."""
    motion = see(bundle, recording)
    return replace(motion, tau_ext=motion.tau_ext / true)


def known_twice(arm, free_motion, motions, true: np.ndarray):
    """A bundle without a known weight, with one of 1.6 kg, and with one of 2.8 kg after it."""
    bundle = with_shares(bundle_of(arm, free_motion), 0.097, [0.05] * 6)
    yield bundle
    for motion, kg in zip(motions, (MASS, 2.8), strict=True):
        known = weigh_constants(bundle, load_frame(bundle), [seen_with(bundle, motion, true)], kg)
        bundle = _core.corrected_bundle(bundle, known)
        with_provenance(bundle, known, kg, [motion.name])
        yield bundle


DIFFERENT = 1.08 * np.array([1.05, 0.95, 1.04, 0.97, 1.06, 0.94])
"""Torque constants of joints that differ by 5 %."""


@pytest.mark.parametrize("true", [np.full(6, 1.08), DIFFERENT])
def test_each_known_weight_lowers_the_error_of_the_constants(
    arm, free_motion, loaded_motion, second_motion, other_motion, true
):
    """2 kg elsewhere are right within two standard errors, which fall with each known weight, and so is their error."""
    shares, off = [], []
    for bundle in known_twice(arm, free_motion, (loaded_motion, second_motion), true):
        bundle = _core.Bundle.from_bytes(bundle.to_bytes())
        found = identify(bundle, load_frame(bundle), [seen_with(bundle, other_motion, true)])
        assert abs(found.mass_kg - 2.0) < 2 * mass_error(found)
        shares.append(found.constants_error_kg / 2.0)
        off.append(abs(found.mass_kg / 2.0 - 1))
    assert shares[0] > 0.08 and shares[1] < 0.004 and shares[2] < 0.85 * shares[1]
    assert off[0] > 0.05 and max(off[1:]) < 0.005


def test_the_factors_of_joints_are_those_that_they_have(arm, free_motion, loaded_motion, second_motion):
    *_, bundle = known_twice(arm, free_motion, (loaded_motion, second_motion), DIFFERENT)
    settings = bundle.wrench_settings
    told = np.array(bundle.observer.nm_per_unit) / settings.torque_factor
    errors = np.array([np.hypot(settings.common_share, settings.own_share(joint)) for joint in range(6)])
    assert (np.abs(told / DIFFERENT - 1) < 2.5 * errors).all() and (errors[:5] < 0.01).all()


def test_the_error_after_a_second_weight_is_that_of_both_together(arm, free_motion, loaded_motion, second_motion):
    """Two weighings, one after the other, or their precisions added by NumPy."""
    before, one, two = known_twice(arm, free_motion, (loaded_motion, second_motion), np.ones(6))
    known = weigh_constants(before, load_frame(before), [see(before, second_motion)], 2.8)
    alone = _core.corrected_bundle(before, known)
    first, second, both = (np.linalg.inv(covariance_of(bundle)) for bundle in (one, alone, two))
    prior = np.linalg.inv(np.diag([0.05**2] * 6) + 0.5**2)
    np.testing.assert_allclose(np.linalg.inv(first + second - prior), np.linalg.inv(both), rtol=0.15, atol=1e-6)


def covariance_of(bundle: _core.Bundle) -> np.ndarray:
    settings = bundle.wrench_settings
    own = np.array([settings.own_share(joint) for joint in range(bundle.joints)])
    alike = np.reshape(settings.torque_correlation, (len(own), len(own)))
    return settings.common_share**2 + alike * np.outer(own, own) + 1e-7 * np.eye(len(own))


def test_what_makes_the_error_of_the_constants_is_stated_with_its_remedy(
    arm, free_motion, loaded_motion, second_motion, other_motion
):
    sentences = []
    for bundle in known_twice(arm, free_motion, (loaded_motion, second_motion), DIFFERENT):
        found = identify(bundle, load_frame(bundle), [seen_with(bundle, other_motion, DIFFERENT)])
        errors = constants_errors(bundle, found)
        sentences.append(constants_sentence(found, errors))
        if not bundle.wrench_settings.torque_factor:
            assert np.sqrt(np.sum(np.square([*errors.values()]))) == pytest.approx(found.constants_error_kg, rel=1e-6)
    assert "the factor common to all joints 9.7 %" in sentences[0] and "every joint turns" in sentences[0]
    for after in sentences[1:]:
        assert "of the 0." in after and "A known payload lowers it" in after


def test_forces_take_the_factors_of_joints(arm, free_motion, loaded_motion, second_motion):
    """Torques of 30 N as these joints measure them: right with the factors, 1 N or more off without."""
    *_, bundle = known_twice(arm, free_motion, (loaded_motion, second_motion), DIFFERENT)
    scale = bundle.error_scale
    scale.features, scale.limit_weights, scale.largest = [_core.MotionFeature.constant], [1.0] * 6, [3.0] * 6
    scale.sigma_weights, scale.sigma_near_weights, scale.largest_sigma = [0.05] * 6, [0.05] * 6, [0.15] * 6
    q, force = [0.3, -0.8, 0.9, 0.4, 0.7, -0.2], np.array([12.0, -18.0, 21.0])
    columns = _core.WrenchModel(bundle).columns("joint6", q, [0.0, 0.0, 0.1], _core.WrenchAxes.base)[:3]
    measured = force @ columns / DIFFERENT * np.array(bundle.observer.nm_per_unit)
    off = []
    for factor in (bundle.wrench_settings.torque_factor, [1.0] * 6):
        settings = bundle.wrench_settings
        settings.torque_factor = factor
        bundle.wrench_settings = settings
        found = _core.WrenchModel(bundle).wrenches("joint6", [q], [measured], [[0.05] * 6], point=[0.0, 0.0, 0.1])
        off.append(np.linalg.norm(found["force"][0] - force))
    assert off[0] < 0.2 < 1.0 < off[1]


def test_a_mass_of_0_has_no_share_of_the_constants():
    nothing = SimpleNamespace(mass_kg=0.0, mass_error_kg=0.0, constants_error_kg=0.0)
    assert constants_sentence(nothing, {"joint1": 0.0}) is None


def full_bundle(arm: _core.Tree, recording: Recording) -> _core.Bundle:
    """With every field that is a torque: a prior with friction by load, a corrected model, drift, an error scale."""
    bundle, n = bundle_of(arm, recording), arm.size
    rng, kind = np.random.default_rng(2), _core.TermKind
    prior = _core.PriorSettings()
    prior.widths_rad = [1e-3]
    prior.terms = [
        term
        for j in range(n)
        for term in (
            _core.Term(kind.coulomb, j, speed=0.05),
            _core.Term(kind.presliding, j),
            _core.Term(kind.load, j, speed=0.05, form=1),
            _core.Term(kind.momentum, j, j),
        )
    ]
    prior.weights = (0.1 * rng.standard_normal(n * len(prior.terms))).tolist()
    prior.corrected_links = carrying(arm, phi_of(0.5, COM)).links
    bundle.prior = prior
    bundle.drift.time_constant_s, bundle.drift.size_nm = 10.0, [2.0] * n
    bundle.drift.rate_share_per_s, bundle.drift.freeze_s = 0.1, 1.0
    bundle.drift.freeze_share, bundle.drift.freeze_floor_nm = 0.5, [0.3] * n
    scale = bundle.error_scale
    scale.features = [_core.MotionFeature.constant, _core.MotionFeature.speed]
    scale.limit_weights, scale.largest = [1.0, 0.5] * n, [3.0] * n
    scale.sigma_weights = scale.sigma_near_weights = [0.2, 0.1] * n
    scale.largest_sigma = [2.0] * n
    bundle.sliding_limit_nm = bundle.contact_sliding_limit_nm = [4.0] * n
    bundle.answer_reference()
    return bundle


def test_one_factor_scales_all_that_the_chain_says(arm, free_motion, loaded_motion):
    bundle = full_bundle(arm, free_motion)
    before = bundle.to_bytes()
    scaled = _core.Bundle.from_bytes(_core.scaled_bundle(bundle, 1.3).to_bytes())
    assert bundle.to_bytes() == before
    signals = (loaded_motion.t_ns, loaded_motion.q, loaded_motion.dq, loaded_motion.tau, 1)
    was, now = _core.estimate(bundle, *signals), _core.estimate(scaled, *signals)
    for name in ("residual", "prior", "drift", "tau_ext", "doubt", "sigma_nm", "limit_nm"):
        np.testing.assert_allclose(now[name], 1.3 * was[name], rtol=1e-9, atol=1e-9, err_msg=name)
    for name in ("alarm", "health", "limit_scale"):
        np.testing.assert_allclose(now[name], was[name], rtol=1e-12, err_msg=name)


def saved(tmp_path, bundle: _core.Bundle, recording: Recording) -> list[str]:
    bundle.save(str(tmp_path / "arm.tauext"))
    save_recording(recording, tmp_path / "loaded.parquet")
    return ["load", str(tmp_path / "arm.tauext"), str(tmp_path / "loaded.parquet")]


def test_the_command_says_what_is_carried(tmp_path, arm, loaded_motion, free_motion, capsys):
    command = saved(tmp_path, bundle_of(arm, free_motion), loaded_motion)
    assert main(command) == 0
    said = capsys.readouterr().out
    assert (
        "load 1.60 kg ± 2.9 % common to all masses found with this bundle, ± 0.0" in said
        and "of the link of joint6" in said
    )
    assert "by windows of 4 s each alone, ± from motion: 5 give" in said
    assert main([*command, "--json", "--from", "5", "--to", "10"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["verdict"] == "load" and abs(facts["mass_kg"] - MASS) < 0.1 and facts["seconds"] < 5.1
    assert main([*command, "--frame", "hand"]) == 2
    assert "must be the joint whose link carries the payload, of joint1" in capsys.readouterr().err
    assert main([*command, "--out", str(tmp_path / "x.tauext")]) == 2
    assert "need --known-kg" in capsys.readouterr().err
    assert main([*command, "--from", "500"]) == 2
    assert "too few to identify a payload" in capsys.readouterr().err


def test_the_command_writes_a_bundle_by_a_known_weight(tmp_path, arm, loaded_motion, free_motion, capsys):
    command = saved(tmp_path, wrong_constants(arm, free_motion, 1.12), loaded_motion)
    out = tmp_path / "right.tauext"
    assert main([*command, "--known-kg", str(MASS), "--out", str(out)]) == 0
    assert "multiply the torques of all joints by 1.12" in capsys.readouterr().out
    right = load_bundle(out)
    assert right.observer.nm_per_unit == pytest.approx([1.0] * 6, abs=0.01)
    assert json.loads(right.provenance)["known_weight"]["mass_kg"] == MASS
    assert main(["show", str(out)]) == 0
    corrected = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("torques corrected"))
    assert "times 1.12" in corrected and f"{MASS:g} kg" in corrected
    assert main(["load", str(out), command[2], "--json"]) == 0
    assert abs(json.loads(capsys.readouterr().out)["mass_kg"] - MASS) < 0.03
    assert main([*command, "--known-kg", "1600"]) == 2
    assert "torque constants are not off by so much" in capsys.readouterr().err
    assert main([*command, "--known-kg", "1", "--out", command[1]]) == 2
    assert "it is the bundle to correct" in capsys.readouterr().err


def test_a_known_weight_skips_a_joint_without_a_constant_and_names_it(
    tmp_path, arm, loaded_motion, free_motion, capsys
):
    amperes = np.array([1, 1, 1, 1, 1, 0.2])
    recordings = [replace(one, tau=one.tau * amperes) for one in (free_motion, loaded_motion)]
    bundle = without_constants(bundle_of(arm, recordings[0]), [5])
    out = tmp_path / "right.tauext"
    command = [*saved(tmp_path, bundle, recordings[1]), "--known-kg", str(1.12 * MASS), "--out", str(out)]
    assert main(command) == 0
    said = capsys.readouterr().out
    assert "multiply the torques of all joints by 1.12" in said and "skipped: joint6, whose" in said
    right = load_bundle(out)
    assert right.estimate_units[:5] == ["N m"] * 5 and right.estimate_units[5].startswith("A / 1.1")
    assert right.in_newtons == [True] * 5 + [False]
    assert main([*command[:3], "--known-kg", str(1.12 * MASS), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["left_out"] == ["joint6"] and facts["joints"]["joint6"]["nm_per_unit"] == 1.0


def test_known_constants_are_taken_as_they_are(free_motion):
    told = known_constants((2.0,) * 6, [free_motion])
    assert told.used == [2.0] * 6 and told.given and not told.guessed.any()
    with pytest.raises(ConfigError, match="must be 6, one for each of joint1"):
        known_constants((2.0,), [free_motion])
    with pytest.raises(ConfigError, match=r"torque_constants = \(0.0,\) must be .*, of a size from 1e-9 to 1e9"):
        TrainConfig(torque_constants=(0.0,))
    with pytest.raises(ConfigError, match="left out with torque_constants"):
        TrainConfig(torque_constants=(1.0,), fit_torque_constants=True)


BALL_COM = np.array([0.03, -0.02, 0.06])
ON = 600
"""The sample, of 1200 in 12 s, from which on something is added."""


def from_then_on(before: Recording, after: Recording) -> Recording:
    """The motion of both, which is the same, with what the second adds."""
    tau = before.tau.copy()
    tau[ON:] = after.tau[ON:]
    return replace(before, tau=tau)


def with_load(arm: _core.Tree, free: Recording, mass: float) -> Recording:
    """What the motors give for a ball at the last joint too, at rest: its inertia is left out."""
    p, beta = _core.load_columns(arm, _core.LoadFrame(5), free.q, 0 * free.dq)
    return from_then_on(free, replace(free, tau=free.tau + beta @ phi_of(mass, BALL_COM)))


def flight_of(bundle: _core.Bundle, recording: Recording) -> Flight:
    recorder = _core.FlightRecorder(bundle.joints, bundle.observer.sample_period_ns, 2.0, 1.0)
    monitor = _core.Monitor(bundle)
    flights = []
    replay(monitor, recording, recorder=recorder, chunk_s=0.5, each=lambda chunk: flights.append(recorder.take()))
    return next(flight for flight in flights if flight)
    raise AssertionError("no alarm")


def said(bundle: _core.Bundle, flight: Flight, recording: Recording) -> list[str]:
    text = explain(flight, rows_kept(flight), FlightSource.of(bundle, recording))
    return [line for line in text.splitlines() if "fit a payload" in line]


def test_what_came_on_as_a_load_is_weighed_from_the_second_behind_the_alarm(arm, free_motion):
    bundle, motion = bundle_of(arm, free_motion), with_load(arm, free_motion, 2.2)
    (line,) = said(bundle, flight_of(bundle, motion), motion)
    words = line.split()
    mass, error = (float(words[words.index("±") + k]) for k in (-1, 1))
    assert abs(mass - 2.2) < 3 * error and error < 0.5
    assert line.endswith(f"kg at {load_frame(bundle).name}: if the arm picked something up, set its load.")
    assert float(words[1]) >= 5 / bundle.observer.gain_per_s - 0.011  # r has settled by then


@pytest.mark.parametrize("force", [(60.0, 15.0, 0.0), (0.0, -50.0, 0.0), (0.0, 0.0, 60.0)])
def test_a_force_to_the_side_or_upwards_is_called_no_load(arm, free_motion, force):
    bundle = bundle_of(arm, free_motion)
    motion = from_then_on(free_motion, pushed(arm, free_motion, np.array(force)))
    assert said(bundle, flight_of(bundle, motion), motion) == []


def test_a_push_that_has_ended_is_no_load(arm, free_motion):
    bundle, tau = bundle_of(arm, free_motion), with_load(arm, free_motion, 5.0).tau.copy()
    tau[ON + 12 :] = free_motion.tau[ON + 12 :]
    motion = replace(free_motion, tau=tau)
    assert said(bundle, flight_of(bundle, motion), motion) == []


def test_nobody_weighs_in_another_unit_or_without_the_bundle(arm, free_motion):
    bundle, motion = bundle_of(arm, free_motion), with_load(arm, free_motion, 2.2)
    flight, source = flight_of(bundle, motion), FlightSource.of(bundle, motion)
    kept = rows_kept(flight)
    assert "fit a payload" in explain(flight, kept, source)
    without_constants(bundle, range(6))
    assert "fit a payload" not in explain(flight, kept, FlightSource.of(bundle, motion))
