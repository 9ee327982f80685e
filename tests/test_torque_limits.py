"""Torque limits from robot files that state them in every way, and in none."""

import numpy as np
import pytest

from tauext.data.free_motion import free_pieces
from tauext.data.recording import Recording
from tauext.errors import RobotError
from tauext.robot.torque_limits import torque_limits
from tauext.train.preparation import passed_limits

URDF = """
<robot name="arm">
  <link name="base"/><link name="a"/><link name="b"/><link name="c"/>
  <joint name="j1" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
    <limit effort="87.5" lower="-1" upper="1" velocity="2"/></joint>
  <joint name="j2" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint>
  <joint name="j3" type="revolute"><parent link="b"/><child link="c"/><axis xyz="0 0 1"/>
    <limit effort="0" lower="-1" upper="1" velocity="2"/></joint>
</robot>
"""
MJCF = """
<mujoco><worldbody>
  <body><joint name="j1" axis="0 0 1" actuatorfrclimited="true" actuatorfrcrange="-40 30"/><geom size="0.1" mass="1"/>
    <body pos="1 0 0"><joint name="j2" axis="0 0 1"/><geom size="0.1" mass="1"/>
      <body pos="1 0 0"><joint name="j3" axis="0 0 1"/><geom size="0.1" mass="1"/></body></body></body>
</worldbody><actuator>
  <motor joint="j1" forcelimited="true" forcerange="-1 1" gear="50"/>
  <motor joint="j2" forcelimited="true" forcerange="-1 1" gear="50"/>
  <motor joint="j3"/>
</actuator></mujoco>
"""


@pytest.mark.parametrize(
    "name, text, limits", [("a.urdf", URDF, [87.5, np.inf, np.inf]), ("a.xml", MJCF, [40, 50, np.inf])]
)
def test_the_least_stated_limit_holds_and_none_is_infinite(tmp_path, name, text, limits):
    (tmp_path / name).write_text(text)
    np.testing.assert_array_equal(torque_limits(tmp_path / name, ["j1", "j2", "j3"]), limits)
    np.testing.assert_array_equal(torque_limits(tmp_path / name, ["j3", "j1"]), [limits[2], limits[0]])


@pytest.mark.parametrize("effort", ["-1", "strong", "nan"])
def test_an_effort_that_is_no_torque_is_refused(tmp_path, effort):
    (tmp_path / "a.urdf").write_text(URDF.replace("87.5", effort))
    with pytest.raises(RobotError, match="joint 'j1': effort = .* must be a number >= 0"):
        torque_limits(tmp_path / "a.urdf", ["j1"])


def test_a_file_that_cannot_be_read_is_refused(tmp_path):
    with pytest.raises(RobotError, match=r"none\.urdf: no such file"):
        torque_limits(tmp_path / "none.urdf", ["j1"])


def test_a_limit_is_passed_where_free_motion_reaches_it_however_often_contacts_do():
    n = 4000
    contact = np.r_[np.zeros(n // 2), np.ones(n // 2)].astype(np.int8)
    tau = np.full((n, 3), 1.0)
    tau[:8, 0] = 40.0  # 0.2 % of 4000, 0.44 % of the free motion before the contact's margin
    tau[:2, 1] = -50.0
    tau[n // 2 :, 2] = 60.0
    still = np.zeros((n, 3))
    recording = Recording(
        "a", ("j1", "j2", "j3"), np.arange(n) * 10**7, still, still, tau, 100.0, "held", "rig", "",
        contact=contact,
    )  # fmt: skip
    limits = np.array([40.0, 50.0, 60.0])
    np.testing.assert_array_equal(passed_limits(free_pieces([recording]), limits, (1.0,)), [True, False, False])
    np.testing.assert_array_equal(passed_limits(free_pieces([recording]), 2 * limits, (2.0,)), [True, False, False])
    assert not passed_limits([], limits, (1.0,)).any()
