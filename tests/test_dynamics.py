"""p and beta of the sweep: against Pinocchio and MuJoCo, finite differences, and what must not change them."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from made_arms import ARMS, branched, planar_rig, random_states, six_axis, urdf

from tauext import _core
from tauext.robot.model_case import empty, perturbed
from tauext.robot.read import load_tree

MODELS = Path(os.environ.get("TAUEXT_DATA", "")) / "models"
FILE_ARMS = {
    "panda": {"panda_finger_joint1": 0.02, "panda_finger_joint2": 0.02},
    "ur10_robot": {},
    "kinova": {},
}


@pytest.fixture(params=ARMS)
def parts(request):
    return ARMS[request.param]()


def read(folder, parts, **options) -> _core.Tree:
    path = folder / "arm.urdf"
    path.write_text(urdf(parts))
    return load_tree(path, **options)


def assert_relative(found, expected, tolerance):
    """Every joint to `tolerance` of its own largest value, or of a thousandth of the arm's: a vertical first joint has
    beta = 0 at all times."""
    found, expected = np.asarray(found), np.asarray(expected)
    scale = np.maximum(np.abs(expected).max(axis=0), 1e-3 * np.abs(expected).max())
    worst = (np.abs(found - expected).max(axis=0) / scale).max()
    assert worst <= tolerance, f"relative difference {worst:.3g}, wanted {tolerance:.3g}"


@pytest.mark.parametrize("name", [*ARMS, *FILE_ARMS])
def test_p_and_beta_equal_those_of_pinocchio(tmp_path, name):
    pinocchio = pytest.importorskip("pinocchio_oracle")
    if name in ARMS:
        arm = ARMS[name]()
        tree, model = read(tmp_path, arm), pinocchio.read_model(urdf(arm), {p.joint: p.rotor_inertia for p in arm})
    else:
        path = MODELS / f"{name}.urdf"
        if not os.environ.get("TAUEXT_DATA") or not path.is_file():
            pytest.skip("TAUEXT_DATA names no folder with models/")
        tree = load_tree(path, locked=FILE_ARMS[name])
        model = pinocchio.locked(pinocchio.read_model(path.read_text()), FILE_ARMS[name])
    q, dq = random_states(tree.size, 1000, seed=1)
    joints = [link.joint_name for link in tree.links]
    # Both round in the 16th digit; 1e-10 leaves room for the readers' own trigonometry and inertia axes.
    for found, expected in zip(tree.momentum(q, dq), pinocchio.momentum(model, q, dq, joints), strict=True):
        assert_relative(found, expected, 1e-10)


MUJOCO_ONLY = """
<mujoco>
  <compiler angle="radian"/>
  <option gravity="1.2 -0.7 -9.3"/>
  <worldbody>
    <body name="wrist" pos="0.1 0.2 0.3" quat="0.9 0.1 -0.3 0.2">
      <joint name="pan" axis="0.2 0.1 1" pos="0.03 -0.02 0.1" ref="0.4" armature="0.05"/>
      <joint name="lift" type="slide" axis="1 0.3 0" ref="-0.2"/>
      <joint name="roll" axis="0 1 0.2" pos="-0.1 0.04 0"/>
      <geom type="box" size="0.1 0.2 0.05" pos="0.1 0 0.02" euler="0.3 0.2 0.1" mass="4"/>
      <body name="plate" pos="0 0.1 0" euler="0.4 0 0.2">
        <geom type="capsule" size="0.03 0.1" pos="0 0 0.1" mass="1"/>
        <body name="finger" pos="0 0 0.2">
          <joint name="bend" axis="0 1 0" pos="0 0 -0.02"/>
          <geom type="ellipsoid" size="0.02 0.05 0.08" pos="0.02 0.01 0.05" mass="0.4"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>
    <dcmotor name="bend_motor" joint="bend" gear="20" armature="0.0002" motorconst="0.1" resistance="1"/>
    <motor name="lift_motor" joint="lift" gear="-3" armature="0.1"/>
  </actuator>
</mujoco>
"""


class MujocoOracle:
    """p = M dq; beta = c + g - (dM/dt) dq, since dM/dt = C + C^T; dM/dt by differences of p along dq."""

    STEP_S = 1e-3

    def __init__(self, xml: str, rotor_inertia: dict[str, float]):
        self.model = mujoco.MjSpec.from_string(xml).compile()
        for joint, inertia in rotor_inertia.items():
            self.model.dof_armature[self.model.joint(joint).dofadr] = inertia
        self.data = mujoco.MjData(self.model)

    def p(self, q, dq):
        self.data.qpos[:], self.data.qvel[:] = q, dq
        mujoco.mj_forward(self.model, self.data)
        out = np.empty(self.model.nv)
        mujoco.mj_mulM(self.model, self.data, out, np.array(dq))
        return out

    def beta(self, q, dq):
        h = self.STEP_S
        ahead = [self.p(q + k * h * dq, dq) for k in (-2, -1, 1, 2)]
        rate = (ahead[0] - 8 * ahead[1] + 8 * ahead[2] - ahead[3]) / (12 * h)
        self.p(q, dq)
        return self.data.qfrc_bias - rate


@pytest.mark.parametrize("name", [*ARMS, "mujoco_only"])
def test_p_and_beta_equal_those_of_mujoco(tmp_path, name):
    if name == "mujoco_only":
        (tmp_path / "arm.xml").write_text(MUJOCO_ONLY)
        tree, oracle = load_tree(tmp_path / "arm.xml"), MujocoOracle(MUJOCO_ONLY, {})
    else:
        arm = ARMS[name]()
        tree = read(tmp_path, arm)
        oracle = MujocoOracle(urdf(arm), {part.joint: part.rotor_inertia for part in arm})
    q, dq = random_states(tree.size, 100, seed=3)
    p, beta = tree.momentum(q, dq)
    assert_relative(p, [oracle.p(*state) for state in zip(q, dq, strict=True)], 1e-10)
    # Fourth-order differences over 1 ms: truncation (2 rad/s * 7 joints * 1e-3 s)^4 / 30 ~ 1e-9, rounding ~ 1e-12.
    assert_relative(beta, [oracle.beta(*state) for state in zip(q, dq, strict=True)], 1e-8)
    at_rest = tree.momentum(q, np.zeros_like(q))[1]
    assert_relative(at_rest, [gravity_torque(oracle, row) for row in q], 1e-10)


def gravity_torque(oracle: MujocoOracle, q: np.ndarray) -> np.ndarray:
    oracle.p(q, np.zeros_like(q))
    return np.array(oracle.data.qfrc_bias)


@pytest.mark.parametrize("order", [[0, 1, 4, 5, 2, 3], [5, 4, 3, 2, 1, 0], [4, 0, 5, 1, 2, 3]])
def test_permuting_the_joints_permutes_the_results_even_where_a_child_comes_before_its_parent(tmp_path, order):
    arm = branched()
    plain = read(tmp_path, arm)
    permuted = read(tmp_path, arm, joints=[plain.links[i].joint_name for i in order])
    assert order[0] == 0 or any(link.parent > i for i, link in enumerate(permuted.links))
    q, dq = random_states(len(arm), 100, seed=8)
    for left, right in zip(plain.momentum(q, dq), permuted.momentum(q[:, order], dq[:, order]), strict=True):
        assert_relative(right, left[:, order], 1e-13)  # sums over branches in another order


@pytest.mark.parametrize("arm", [six_axis, branched])
def test_a_locked_joint_equals_one_at_rest_at_that_position(tmp_path, arm):
    parts, position = arm(), 0.7
    held, free = parts[2].joint, [0, 1, 3, 4, 5]
    q, dq = random_states(len(parts), 100, seed=9)
    q[:, 2], dq[:, 2] = position, 0.0
    whole = read(tmp_path, parts).momentum(q, dq)
    fused = read(tmp_path, parts, locked={held: position}).momentum(q[:, free].copy(), dq[:, free].copy())
    for left, right in zip(whole, fused, strict=True):
        assert_relative(right, left[:, free], 1e-12)


def test_a_perturbed_model_equals_the_arm_built_that_way(tmp_path):
    parts = planar_rig()  # joint frames are the links' frames, so the centre of mass scales in the file alike
    changed = [replace(part, mass=0.5 * part.mass, com=0.5 * part.com) for part in parts]
    q, dq = random_states(2, 100, seed=10)
    found = perturbed(read(tmp_path, parts), mass_factor=0.5, com_factor=0.5).momentum(q, dq)
    for left, right in zip(found, read(tmp_path, changed).momentum(q, dq), strict=True):
        assert_relative(left, right, 1e-14)


def test_perturbing_by_one_changes_nothing_and_no_model_is_zero(tmp_path, parts):
    tree = read(tmp_path, parts)
    q, dq = random_states(tree.size, 50, seed=12)
    for left, right in zip(perturbed(tree).momentum(q, dq), tree.momentum(q, dq), strict=True):
        np.testing.assert_array_equal(left, right)
    p, beta = empty(tree).momentum(q, dq)
    assert not p.any() and not beta.any()
    assert [link.joint_name for link in empty(tree).links] == [link.joint_name for link in tree.links]
