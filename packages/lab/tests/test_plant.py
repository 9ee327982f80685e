"""A simulated arm sample by sample: its physics, pushes, weight, friction and commanded motion."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from made_bundles import SEVEN_AXIS
from tauext_lab.sim.arms import ARMS
from tauext_lab.sim.config import RigConfig
from tauext_lab.sim.contacts import force_torque
from tauext_lab.sim.plant import Mover, Plant
from tauext_lab.sim.rig import measure, roll_out
from tauext_lab.sim.source import weight

from tauext.robot.read import load_tree


@pytest.fixture(scope="module", params=ARMS)
def arm(request):
    return ARMS[request.param]()


def test_samples_one_by_one_are_those_of_a_rollout(arm):
    silent = replace(arm.sensors, torque_noise_nm=(0.0,) * len(arm.joints))
    arm = replace(arm, sensors=silent)
    mover, plant = Mover(arm), Plant(arm)
    setpoints, samples = [], []
    for _ in range(500):
        q_des, dq_des = mover.step()
        setpoints.append(np.stack([q_des, dq_des], axis=1).ravel())
        samples.append(plant.step(q_des, dq_des))
    truth = roll_out(arm, arm.model, np.array(arm.home), np.array(setpoints))
    measured = measure(arm, truth, np.zeros_like(truth.q), np.random.default_rng(0))
    for signal, first in (("q", 0), ("dq", 100), ("tau", 0)):  # only the batch knows the speed of the first sample
        np.testing.assert_allclose([getattr(s, signal) for s in samples[first:]], measured[signal][first:], atol=1e-9)


def test_a_push_on_link_5_is_pinocchios_jacobian_transposed():
    pin = pytest.importorskip("pinocchio")
    model = pin.buildModelFromUrdf(str(SEVEN_AXIS))
    data = model.createData()
    plant = Plant(ARMS["seven"]())
    plant.data.qpos[:] = np.linspace(-0.5, 0.7, 7)
    mujoco.mj_forward(plant.model, plant.data)
    pin.computeJointJacobians(model, data, plant.data.qpos)
    pin.updateFramePlacements(model, data)
    origin, rotation = plant.body_pose(4)
    local, force = np.array([0.03, -0.02, 0.07]), np.array([10.0, -20.0, 30.0])
    frame = model.addFrame(pin.Frame("grabbed", 5, pin.SE3(np.eye(3), local), pin.FrameType.OP_FRAME))
    data = model.createData()
    jacobian = pin.computeFrameJacobian(model, data, plant.data.qpos, frame, pin.LOCAL_WORLD_ALIGNED)[:3]
    sample = plant.step(plant.data.qpos, np.zeros(7), force, origin + rotation @ local, 4)
    np.testing.assert_allclose(sample.tau_ext, jacobian.T @ force, atol=1e-10)
    assert (sample.tau_ext[5:] == 0).all()


def test_a_push_on_the_rig_is_the_planar_torque():
    plant, q = Plant(ARMS["rig"]()), np.array([0.4, -1.1])
    plant.data.qpos[:] = q
    mujoco.mj_forward(plant.model, plant.data)
    origin, rotation = plant.body_pose(1)
    point, force = origin + rotation @ [0.0, 0.1, 0.2], np.array([12.0, 5.0, -7.0])
    tau_ext = plant.step(q, np.zeros(2), force, point, 1).tau_ext
    expected = force_torque(RigConfig(), q[None], 1, force[None, [0, 2]], point[None, [0, 2]])[0]
    np.testing.assert_allclose(tau_ext, expected, atol=1e-10)


def test_the_packaged_arm_is_the_one_of_the_benchmarks(tmp_path):
    path = tmp_path / "seven.xml"
    path.write_text(ARMS["seven"]().xml)
    ours, urdf = load_tree(path), load_tree(SEVEN_AXIS)
    rng = np.random.default_rng(0)
    q, dq = rng.uniform(-2, 2, (20, 7)), rng.uniform(-2, 2, (20, 7))
    for a, b in zip(ours.momentum(q, dq), urdf.momentum(q, dq), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)


def test_a_stop_comes_to_rest_without_a_jump_and_resume_moves_on(arm):
    mover = Mover(arm)
    path = [mover.step()[0] for _ in range(1500)]
    mover.stop()
    held = [mover.step() for _ in range(300)]
    speed = np.diff(path + [q_des for q_des, _ in held], axis=0) * arm.rate_hz
    assert np.abs(speed[1499]).max() > 0.15
    assert np.abs(np.diff(speed[1400:], axis=0)).max() < 0.05  # 50 rad/s^2; a speed that ends at once leaves all of it
    np.testing.assert_array_equal(held[-1][1], 0.0)
    np.testing.assert_array_equal(held[-1][0], held[220][0])
    mover.resume()
    assert np.abs(mover.step()[0] - held[-1][0]).max() < 1e-3
    for _ in range(1000):
        mover.step()
    assert np.abs(mover.q_des - held[-1][0]).max() > 0.01


def test_more_friction_is_felt_and_leaves_the_state_and_the_weight(arm):
    plant = Plant(arm)
    plant.hold(weight(2.0, 0.2))
    for _ in range(50):
        plant.step(np.array(arm.home) + 0.01, np.zeros(len(arm.joints)))
    before = plant.data.qpos.copy(), plant.data.qvel.copy()
    plant.set_friction(2.0)
    np.testing.assert_array_equal(plant.data.qpos, before[0])
    np.testing.assert_array_equal(plant.data.qvel, before[1])
    assert plant.model.body("held").mass == 2.0 and plant.model.nv == len(arm.joints)


def test_the_weights_torque_is_the_difference_of_two_arms():
    arm = ARMS["seven"]()
    plant, mover, load = Plant(arm), Mover(arm), weight(3.0, arm.hand_m)
    plant.hold(load)
    for _ in range(500):
        q, dq = plant.data.qpos.copy(), plant.data.qvel.copy()
        sample = plant.step(*mover.step())
    needed = []
    for model in (arm.model, arm.changed_model(1.0, load)):
        data, torque = mujoco.MjData(model), np.zeros(7)
        data.qpos[:], data.qvel[:] = q, dq
        mujoco.mj_forward(model, data)
        data.qacc[:] = plant.data.qacc
        mujoco.mj_rne(model, data, 1, torque)
        needed.append(torque)
    np.testing.assert_allclose(sample.tau_held, needed[0] - needed[1], atol=5e-3)  # speeds are of one step later
    assert np.abs(sample.tau_held).max() > 5.0
    plant.hold(None)
    assert not plant.step(q, dq).tau_held.any()
