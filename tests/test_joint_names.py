"""Joints matched by name: what a rule matches, what is proposed, and what is left to a person."""

from __future__ import annotations

import pytest

from tauext.data.joint_names import match_joints

J6 = tuple(f"j{k}" for k in range(1, 7))
UR = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint")
PENDANT = ("Base", "Shoulder", "Elbow", "Wrist 1", "Wrist 2", "Wrist 3")
LEROBOT = ("shoulder_pan.pos", "shoulder_lift.pos", "elbow_flex.pos", "wrist_flex.pos", "wrist_roll.pos", "gripper.pos")
PANDA = tuple(f"panda_joint{k}" for k in range(1, 8))


@pytest.mark.parametrize(
    ("robot", "logged"),
    [
        (J6, tuple(name.upper() for name in J6)),
        (J6, tuple(f"Joint_{k}" for k in range(1, 7))),
        (tuple(f"ur10_{name}" for name in UR), UR),
        (UR, tuple(name.removesuffix("_joint") for name in UR)),
        (UR, PENDANT),
        (UR, tuple(name.lower() for name in PENDANT)),
        (PANDA, tuple(f"fr3_joint{k}" for k in range(1, 8))),
        (tuple(f"joint_a{k}" for k in range(1, 8)), tuple(f"A{k}" for k in range(1, 8))),
        (("joint_1_s", "joint_2_l", "joint_3_u", "joint_4_r", "joint_5_b", "joint_6_t"), J6),
        (tuple("slurbt"), J6),
        (("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw"), LEROBOT),
        (("leftJoint01", "leftJoint02", "leftJoint10"), ("left_joint_1", "left_joint_2", "left_joint_10")),
    ],
)  # fmt: skip
def test_one_rule_matches_all_joints_in_any_order(robot, logged):
    for turned in (logged, logged[::-1]):
        found = match_joints(robot, turned)
        assert found.pairs == dict(zip(robot, logged, strict=True))
        assert found.rule and not found.proposed and not found.robot_left and not found.logged_left


def test_a_gripper_may_be_left_on_either_side():
    found = match_joints((*PANDA, "panda_finger_joint1"), tuple(f"fr3_joint{k}" for k in range(1, 8)))
    assert len(found.pairs) == 7 and found.robot_left == ("panda_finger_joint1",)
    found = match_joints(UR, (*PENDANT, "robotiq_knuckle"))
    assert len(found.pairs) == 6 and found.logged_left == ("robotiq_knuckle",)


@pytest.mark.parametrize(
    ("robot", "logged", "proposed"),
    [
        (J6, ("j1", "j2", "joint3", "j4", "j5", "j6"), {"j3": "joint3"}),  # by rule
        (UR, (*UR[:2], "forearm", *UR[3:]), {"elbow_joint": "forearm"}),  # the only pair left
        (J6, tuple(f"J{k}" for k in range(6)), {f"j{k + 1}": f"J{k}" for k in range(6)}),  # from 0 and from 1
        (UR, (*UR[:2], "forearm", *UR[3:], "gripper"), {"elbow_joint": "forearm"}),
    ],
)
def test_what_no_common_rule_supports_is_proposed(robot, logged, proposed):
    found = match_joints(robot, logged)
    assert found.proposed == proposed
    assert not set(found.pairs) & set(proposed)


@pytest.mark.parametrize(
    ("robot", "logged"),
    [
        (J6, ("a", "b", "c", "d", "e", "f")),
        (("left_j1", "left_j2", "right_j1", "right_j2"), ("j1", "j2")),  # either arm
        (J6, ("axis_9", "axis_8", "axis_7", "axis_10", "axis_11", "axis_12")),
    ],
)
def test_nothing_is_matched_by_position(robot, logged):
    found = match_joints(robot, logged)
    assert not found.pairs and not found.proposed
    assert found.robot_left == robot and found.logged_left == logged
