"""The virtual rig obeys mechanics, its instruments do what they say, and its labels match its forces."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from tauext_lab.sim.collect import simulate_motion, simulate_recording
from tauext_lab.sim.config import DriveConfig, FrictionConfig, MotionConfig, RigConfig
from tauext_lab.sim.contacts import SHAPES, Pulse, force_torque, link_frames, spread
from tauext_lab.sim.rig import (
    arm_xml,
    build_scene,
    draw_motion,
    encoder,
    low_pass,
    measure,
    quintic,
    roll_out,
    velocity,
)

from tauext.errors import ConfigError

KINDS = ("free", "pulses", "pads")
BRIEF = replace(RigConfig(), collision_recording_s=20.0, collisions_per_recording=3)
NO_FRICTION = FrictionConfig(
    coulomb_nm=0.0,
    static_nm=0.0,
    load_share=0.0,
    stribeck_rad_s=0.05,
    viscous_nm_s_rad=0.0,
    bristle_nm_rad=0.0,
    bristle_damping_nm_s_rad=0.0,
    ripple_nm=0.0,
    ripple_cycles=0,
)


@pytest.fixture(scope="module", params=KINDS)
def motion(request):
    """Kind, truth, true external torque and force on each link, of 20 s."""
    q_des, dq_des = draw_motion(BRIEF.motion, 2, 20_000, BRIEF.rate_hz, np.random.default_rng(3))
    return request.param, *simulate_motion(BRIEF, request.param, q_des, dq_des, 1000, np.random.default_rng(4))


@pytest.fixture(scope="module", params=KINDS[1:])
def collisions(request):
    return simulate_recording(BRIEF, request.param, 20.0, seed=1, number=0)


def link_side(truth, every=1):
    """M ddq + C dq + g of the links alone, by MuJoCo's inverse dynamics of the plain arm without rotor inertia."""
    model = mujoco.MjModel.from_xml_string(arm_xml(BRIEF, true_com=True))
    model.dof_armature[:] = 0.0
    data = mujoco.MjData(model)
    torque = np.empty_like(truth.q[::every])
    for k, row in enumerate(range(0, len(truth.q), every)):
        data.qpos, data.qvel, data.qacc = truth.q[row], truth.dq[row], truth.ddq[row]
        mujoco.mj_inverse(model, data)
        torque[k] = data.qfrc_inverse
    return torque


def rotor_torque(truth):
    return truth.ddq * [link.rotor_inertia_kg_m2 for link in BRIEF.links]


def test_external_torque_is_what_inverse_dynamics_leaves_over(motion):
    kind, truth, tau_ext, force = motion
    left = link_side(truth, 3) - (truth.drive - truth.friction - rotor_torque(truth))[::3]
    # MuJoCo's forward and inverse dynamics agree to rounding: 1e-12 of torques near 100 N m.
    np.testing.assert_allclose(left, tau_ext[::3], atol=1e-9)
    assert (np.abs(tau_ext).max() > 1.0) == (kind != "free")
    assert (force.max() > 1.0) == (kind != "free")


def test_external_torque_of_pulses_is_what_the_simulator_applied(motion):
    kind, truth, tau_ext, _ = motion
    np.testing.assert_allclose(truth.others, tau_ext if kind == "pulses" else np.zeros_like(tau_ext), atol=1e-9)


def test_sensor_reference_is_the_low_pass_of_what_its_definition_says(motion):
    _, truth, tau_ext, _ = motion
    measured = measure(BRIEF, truth, tau_ext, np.random.default_rng(0))
    bracket = (link_side(truth) - measured["tau_jts"])[:4000]
    expected, a = bracket[0], np.exp(-20.0 / BRIEF.rate_hz)
    for k, row in enumerate(bracket):
        expected = a * expected + (1.0 - a) * row
        np.testing.assert_allclose(measured["tau_ext_sensor"][k], expected, atol=1e-9)


def test_sensor_reference_follows_the_true_torque_up_to_its_noise(collisions):
    # The low-pass leaves sqrt((1 - a) / (1 + a)) = 0.1 of white noise of 0.2 and 0.1 N m: 6 sigma are 0.12 and 0.06.
    a = np.exp(-20.0 / BRIEF.rate_hz)
    smooth = np.zeros(2)
    for k in range(collisions.samples):
        smooth = a * smooth + (1.0 - a) * collisions.tau_ext[k]
        if k > 300:  # the reference starts on its first, noisy sample
            assert (np.abs(collisions.tau_ext_sensor[k] - smooth) < [0.12, 0.06]).all()


def energy_range(rate_hz):
    """Largest less smallest energy of 5 s of free swinging, [J]."""
    config = replace(RigConfig(), drives=(DriveConfig(0.0, 0.0),) * 2, friction=(NO_FRICTION,) * 2, rate_hz=rate_hz)
    model = build_scene(config, "free")
    truth = roll_out(config, model, np.array([0.5, 1.0]), np.zeros((5 * rate_hz, 4)))
    assert np.ptp(truth.q[:, 0]) > 1.0
    model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_ENERGY
    data = mujoco.MjData(model)
    energy = []
    for q, dq in zip(truth.q[:: rate_hz // 20], truth.dq[:: rate_hz // 20], strict=True):
        data.qpos, data.qvel = q, dq
        mujoco.mj_forward(model, data)
        energy.append(data.energy.sum())
    return np.ptp(energy)


def test_energy_is_kept_without_drives_and_friction():
    # Semi-implicit Euler is of first order: 1.4 of 70 J at 1 kHz, and half as much for half the step.
    assert energy_range(1000) < 2.0
    coarse, fine = energy_range(8000), energy_range(16_000)
    assert coarse / fine == pytest.approx(2.0, rel=0.1)


def test_sliding_friction_is_coulomb_load_and_viscous_part_and_ripple(motion):
    _, truth, _, force = motion
    load = np.abs(link_side(truth))
    for j, friction in enumerate(BRIEF.friction):
        sliding = (np.abs(truth.dq[:, j]) > 0.3) & (force.max(axis=1) == 0.0)
        constant = friction.coulomb_nm + friction.load_share * load[:, j]
        expected = constant * np.sign(truth.dq[:, j]) + friction.viscous_nm_s_rad * truth.dq[:, j]
        # Bristles settle within milliseconds at this speed; Stribeck's exp(-36) is nothing. The load is held for 10 ms:
        # half of its change in 20 ms, 2 N m at the hardest acceleration, and longer after a touch has ended.
        error = np.abs(truth.friction[:, j] - expected)[sliding]
        assert np.quantile(error, 0.99) < friction.ripple_nm + 0.05 + 2.0 * friction.load_share
        assert np.median(error) < friction.ripple_nm


def test_the_robot_file_errs_by_the_given_gravity():
    arms = [mujoco.MjModel.from_xml_string(arm_xml(BRIEF, true_com)) for true_com in (False, True)]
    torques = []
    for model in arms:
        data = mujoco.MjData(model)
        data.qpos[:] = (np.pi / 2, 0.0)
        mujoco.mj_forward(model, data)
        torques.append(data.qfrc_bias.copy())
    difference = [9.81 * link.mass_kg * (link.true_com_m - link.com_m) for link in BRIEF.links]
    np.testing.assert_allclose(np.subtract(*torques), [sum(difference), difference[1]], atol=1e-9)


def test_a_joint_sticks_below_static_friction_and_breaks_away_above():
    friction = replace(RigConfig().friction[1], ripple_nm=0.0, load_share=0.0)
    config = replace(RigConfig(), drives=(DriveConfig(8000.0, 250.0), DriveConfig(1e-9, 0.0)), friction=(friction,) * 2)
    model = build_scene(config, "pulses")
    for share, slides in ((0.9, False), (1.1, True)):
        controls = np.zeros((3000, model.nu))
        controls[:, -1] = share * friction.static_nm * np.minimum(np.arange(3000) / 2000.0, 1.0)
        truth = roll_out(config, model, np.zeros(2), controls)
        moved = truth.q[-1, 1]
        assert (moved > 0.05) == slides
        if not slides:
            # Bristles creep as they near their limit: more than load / stiffness, but of its order.
            assert 0.9 < moved / (friction.static_nm / friction.bristle_nm_rad) < 5.0


def test_free_motion_holds_stuck_and_moving_joints():
    recording = simulate_recording(RigConfig(), "free", 60.0, seed=0, number=0)
    near_stiction = (np.abs(recording.dq) < 0.02).mean(axis=0)
    assert ((near_stiction > 0.05) & (near_stiction < 0.4)).all()
    assert np.abs(recording.q - recording.q_des).max() < 0.02  # a drive that follows
    assert (recording.contact == 0).all() and (recording.contact_link == -1).all()
    assert (recording.tau_ext == 0.0).all()


def test_recording_does_not_depend_on_what_else_is_simulated(collisions):
    kind = collisions.provenance["contacts"]
    again = simulate_recording(BRIEF, kind, 20.0, seed=1, number=0)
    other = simulate_recording(BRIEF, kind, 20.0, seed=1, number=1)
    for signal in ("q", "dq", "tau", "tau_jts", "tau_ext", "tau_ext_sensor"):
        np.testing.assert_array_equal(getattr(again, signal), getattr(collisions, signal))
        assert not np.array_equal(getattr(other, signal), getattr(collisions, signal))


def test_contact_labels_match_the_force(motion):
    kind, truth, tau_ext, force = motion
    touched = force.max(axis=1) > 0.0
    assert (tau_ext[~touched] == 0.0).all()
    beyond = touched & (force.argmax(axis=1) == 0)
    assert (tau_ext[beyond, 1] == 0.0).all()  # joint 2 feels nothing of a force on link 1
    if kind != "free":
        assert touched.any() and not touched[: round((BRIEF.gap_s - 0.1) * BRIEF.rate_hz)].any()


def test_recorded_labels_name_the_touched_link(collisions):
    touched = collisions.contact == 1
    assert touched.any() and ((collisions.contact_link >= 0) == touched).all()
    assert (collisions.tau_ext[touched & (collisions.contact_link == 0), 1] == 0.0).all()
    assert (collisions.tau_ext[~touched] == 0.0).all()


def test_every_collision_stands_alone(collisions):
    at = np.flatnonzero(collisions.contact == 1)
    gaps = np.diff(at)[np.diff(at) > 300]  # a pad may bounce
    assert len(gaps) == BRIEF.collisions_per_recording - 1
    assert gaps.min() >= BRIEF.gap_s * BRIEF.rate_hz


def test_starts_keep_their_gaps_and_refuse_what_does_not_fit():
    lengths = [1.0, 0.5, 0.2]
    for seed in range(50):
        starts = spread(lengths, 15.0, 3.0, np.random.default_rng(seed))
        edges = np.concatenate([[0.0], np.column_stack([starts, starts + lengths]).ravel(), [15.0]])
        assert (np.diff(edges)[::2] >= 3.0 - 1e-12).all()
    with pytest.raises(ConfigError, match=r"collision_recording_s = 13 must hold 3 collisions"):
        spread(lengths, 13.0, 3.0, np.random.default_rng(0))


@pytest.mark.parametrize("shape", SHAPES)
def test_pulse_has_its_height_length_and_no_zero_sample(shape):
    wrench = Pulse(shape, height_n=40.0, length_s=0.2, link=0, place_m=0.25, angle_rad=0.0).wrench(1000)
    assert len(wrench) == 200 and (wrench[:, 0] > 0.0).all()
    assert wrench[:, 0].max() == pytest.approx(40.0, rel=0.05)  # the peak may fall between samples
    np.testing.assert_allclose(wrench[:, 2], 0.25 * wrench[:, 0])


def test_a_drive_too_stiff_for_its_rate_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warning into a log file where it stands
    with pytest.raises(ConfigError, match="diverged"):
        simulate_recording(replace(RigConfig(), drives=(DriveConfig(1e7, 0.0),) * 2), "free", 5.0, seed=0, number=0)


def test_a_gap_too_short_for_the_pads_is_refused():
    with pytest.raises(ConfigError, match=r"gap_s = 1 must be >= 1.8"):
        simulate_recording(replace(BRIEF, gap_s=1.0), "pads", 20.0, seed=0, number=0)


def test_config_names_what_is_wrong():
    with pytest.raises(ConfigError, match=r"drives has 1 entries; it must have one a link, 2"):
        RigConfig(drives=RigConfig().drives[:1])
    with pytest.raises(ConfigError, match=r"motion\.pause_s\[1\] = -1 must be >= 0"):
        RigConfig(motion=MotionConfig(pause_s=(0.0, -1.0)))


def test_quintic_starts_and_ends_at_rest():
    done, rate = quintic(np.array([-1.0, 0.0, 0.5, 1.0, 2.0]))
    np.testing.assert_allclose(done, [0.0, 0.0, 0.5, 1.0, 1.0])
    np.testing.assert_allclose(rate, [0.0, 0.0, 15.0 / 8.0, 0.0, 0.0])
    h = 1e-4  # acceleration near an end: 60 s, so it vanishes there
    assert quintic(np.array([h]))[1][0] / h < 1e-2
    s = np.linspace(0.01, 0.99, 99)
    np.testing.assert_allclose((quintic(s + h)[0] - quintic(s - h)[0]) / (2 * h), quintic(s)[1], atol=1e-7)


def test_moves_keep_range_travel_and_mean_speed_of_the_fastest_joint():
    config = MotionConfig(pause_s=(0.1, 0.4))
    q_des, dq_des = draw_motion(config, 2, 300_000, 1000, np.random.default_rng(0))
    assert np.abs(q_des).max() <= np.pi
    moving = np.concatenate([[False], (dq_des != 0.0).any(axis=1), [False]])
    begins, ends = np.flatnonzero(moving[1:] & ~moving[:-1]), np.flatnonzero(~moving[1:] & moving[:-1])
    assert len(begins) > 30
    for begin, end in zip(begins[:-1], ends[:-1], strict=True):  # the clock cuts the last one
        travel = np.rad2deg(np.abs(q_des[end] - q_des[begin - 1])).max()
        assert travel >= config.least_travel_deg
        # The first and last moving samples are up to two periods inside the move.
        assert 20.0 * 0.99 < travel / ((end - begin) / 1000.0) < 50.0 * 1.01


def test_velocity_setpoint_is_the_derivative_of_the_position_setpoint():
    q_des, dq_des = draw_motion(MotionConfig(), 3, 20_000, 1000, np.random.default_rng(1))
    np.testing.assert_allclose(np.gradient(q_des, 1e-3, axis=0)[1:-1], dq_des[1:-1], atol=1e-4)


def test_low_pass_answers_a_step_with_its_time_constant():
    step = np.concatenate([[0.0], np.ones(500)])
    np.testing.assert_allclose(low_pass(step, 20.0, 1e-3), 1.0 - np.exp(-0.02 * np.arange(501)), atol=1e-12)


def test_encoder_reads_whole_counts_within_half_a_count():
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (1000, 2))
    step = 2.0 * np.pi / 4096
    read = encoder(q, 4096)
    np.testing.assert_allclose(read / step, np.round(read / step), atol=1e-9)
    assert np.abs(read - q).max() <= step / 2 + 1e-15


def test_velocity_of_a_ramp_is_its_slope_and_of_an_acceleration_lags():
    t = np.arange(2000)[:, None] * 1e-3
    np.testing.assert_allclose(velocity(0.7 * t, 300.0, 1e-3), np.full_like(t, 0.7), atol=1e-9)
    lag = t - velocity(0.5 * t**2, 300.0, 1e-3)
    # Half a sample for the difference, and a / (1 - a) samples for the filter.
    a = np.exp(-0.3)
    np.testing.assert_allclose(lag[500:], (0.5 + a / (1.0 - a)) * 1e-3, rtol=1e-3)


def test_force_torque_is_the_gradient_of_the_place_it_acts_on():
    rng, h = np.random.default_rng(0), 1e-6
    for link in (0, 1):
        q, force, along = rng.uniform(-3.0, 3.0, (1, 2)), rng.normal(size=(1, 2)), 0.2

        def place(q, link=link, along=along):
            origins, angles = link_frames(RigConfig(), q)
            return origins[:, link] + along * np.stack([np.sin(angles[:, link]), np.cos(angles[:, link])], axis=1)

        jacobian = [(place(q + h * e) - place(q - h * e))[0] / (2 * h) for e in np.eye(2)]
        torque = force_torque(RigConfig(), q, link, force, place(q))
        np.testing.assert_allclose(torque[0], jacobian @ force[0], atol=1e-8)
