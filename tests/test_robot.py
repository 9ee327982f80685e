"""Reading robot files: what ends up in the tree, and one clear message for each file or choice that cannot be used."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np
import pytest
from made_arms import branched, planar_rig, random_states, six_axis, urdf

from tauext import _core
from tauext.errors import RobotError
from tauext.robot.model_case import empty, perturbed
from tauext.robot.read import load_tree, robot_sha256

INERTIAL = '<inertial pos="0 0 0.1" mass="1" diaginertia="0.01 0.01 0.002"/>'


def write(folder, text: str, name: str = "arm.xml"):
    path = folder / name
    path.write_text(text)
    return path


def mjcf(bodies: str, rest: str = "") -> str:
    return f'<mujoco><compiler angle="radian"/><worldbody>{bodies}</worldbody>{rest}</mujoco>'


def two_links(first: str = "", second: str = "", rest: str = "") -> str:
    """Joints `a` and `b` about y, with further attributes each."""
    return mjcf(
        f'<body name="upper"><joint name="a" axis="0 1 0" {first}/>{INERTIAL}'
        f'<body name="lower" pos="0 0 0.3"><joint name="b" axis="0 1 0" {second}/>{INERTIAL}</body></body>',
        rest,
    )


def rotor_inertia(tree: _core.Tree) -> list[float]:
    return [link.rotor_inertia for link in tree.links]


def names(tree: _core.Tree) -> list[str]:
    return [link.joint_name for link in tree.links]


def assert_same_dynamics(left: _core.Tree, right: _core.Tree, tolerance: float = 1e-12):
    q, dq = random_states(left.size, 50, seed=1)
    for a, b in zip(left.momentum(q, dq), right.momentum(q, dq), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=tolerance * np.abs(b).max())


# What ends up in the tree


def test_a_planar_rig_is_read_as_it_is_written(tmp_path):
    tree = load_tree(write(tmp_path, urdf(planar_rig()), "arm.urdf"))
    shoulder, elbow = tree.links
    assert names(tree) == ["shoulder", "elbow"] and (shoulder.parent, elbow.parent) == (-1, 0)
    assert (shoulder.mass, elbow.mass) == (8.191, 9.920)
    np.testing.assert_allclose(np.reshape(shoulder.rotation, (3, 3))[:, 2], [0, 1, 0], atol=1e-15)
    assert np.linalg.norm(elbow.com) == pytest.approx(0.16078, rel=1e-14)
    assert rotor_inertia(tree) == pytest.approx([0.6, 0.3], rel=1e-14)
    assert tree.gravity == [0.0, 0.0, -9.81]


def test_missing_meshes_are_no_obstacle_in_a_urdf(tmp_path):
    plain = urdf(six_axis())
    shape = '<geometry><mesh filename="package://arm_description/meshes/base.dae"/></geometry>'
    meshed = plain.replace("<inertial>", f"<visual>{shape}</visual><collision>{shape}</collision><inertial>")
    assert_same_dynamics(load_tree(write(tmp_path, meshed)), load_tree(write(tmp_path, plain, "plain.urdf")))


def test_fixed_joints_fuse_what_they_carry(tmp_path):
    parts = six_axis()
    tool = (
        '<link name="tool"><inertial><origin xyz="0.01 0 0.1"/><mass value="2"/><inertia ixx="0.01" iyy="0.02" '
        'izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link><joint name="flange" type="fixed"><parent '
        'link="joint6_link"/><child link="tool"/></joint>'
    )
    tree = load_tree(write(tmp_path, urdf(parts, tool)))
    assert tree.size == 6 and tree.links[5].mass == pytest.approx(parts[5].mass + 2)


def test_joints_come_in_the_order_asked_for_and_the_others_are_locked(tmp_path):
    path = write(tmp_path, urdf(branched()))
    tree = load_tree(path, joints=["left_elbow", "torso", "left_shoulder"])
    assert names(tree) == ["left_elbow", "torso", "left_shoulder"]
    assert [link.parent for link in tree.links] == [2, -1, 1]
    assert sum(link.mass for link in tree.links) == pytest.approx(15 + 4 + 4 + 2 + 1.5)


def test_unstated_joints_are_locked_at_zero_or_at_the_reference_of_the_file(tmp_path):
    path = write(tmp_path, urdf(six_axis()))
    joints = ["joint1", "joint3", "joint4", "joint5", "joint6"]
    assert_same_dynamics(load_tree(path, joints), load_tree(path, locked={"joint2": 0.0}))
    path = write(tmp_path, two_links(second='ref="0.5"'))
    assert_same_dynamics(load_tree(path, ["a"]), load_tree(path, locked={"b": 0.5}))


def test_a_reference_position_shifts_the_zero_of_a_joint(tmp_path):
    plain, shifted = (
        load_tree(write(tmp_path, two_links(), "1.xml")),
        load_tree(write(tmp_path, two_links('ref="0.5"'), "2.xml")),
    )
    q, dq = random_states(2, 20, seed=2)
    for left, right in zip(plain.momentum(q, dq), shifted.momentum(q + [0.5, 0.0], dq), strict=True):
        np.testing.assert_allclose(left, right, atol=1e-13)


def test_a_body_with_several_joints_hangs_on_the_last(tmp_path):
    joints = '<joint name="a" axis="0 1 0"/><joint name="b" type="slide"/><joint name="c" axis="1 0 0" pos="0 0 0.1"/>'
    tree = load_tree(write(tmp_path, mjcf(f'<body name="cart">{joints}{INERTIAL}</body>')))
    assert [link.mass for link in tree.links] == [0.0, 0.0, 1.0] and [link.parent for link in tree.links] == [-1, 0, 1]
    assert tree.links[1].type == _core.JointType.prismatic
    locked = load_tree(tmp_path / "arm.xml", locked={"c": 0.0})
    assert [link.mass for link in locked.links] == [0.0, 1.0]


def test_rotor_inertia_is_taken_from_joints_and_motors_with_the_gear_squared(tmp_path):
    motors = (
        '<actuator><dcmotor name="m" joint="b" gear="50" armature="0.0002" motorconst="1" resistance="1"/>'
        '<motor name="n" joint="b" gear="-2" armature="0.01"/><motor name="o" joint="a"/></actuator>'
    )
    tree = load_tree(write(tmp_path, two_links('armature="0.3"', 'armature="0.1"', motors)))
    assert rotor_inertia(tree) == pytest.approx([0.3, 0.1 + 0.0002 * 50**2 + 0.01 * 2**2], rel=1e-14)


def test_rotor_inertia_of_a_urdf_comes_from_its_transmissions(tmp_path):
    text = urdf(planar_rig())
    standard = text.replace("drake:gear_ratio value=", "ignored value=").replace(
        "</actuator>", "<mechanicalReduction>100</mechanicalReduction></actuator>"
    )
    assert rotor_inertia(load_tree(write(tmp_path, standard))) == pytest.approx([0.6, 0.3], rel=1e-14)
    reversed_gear = text.replace('gear_ratio value="100', 'gear_ratio value="-100')
    assert rotor_inertia(load_tree(write(tmp_path, reversed_gear))) == pytest.approx([0.6, 0.3], rel=1e-14)
    silent = text.replace("drake:rotor_inertia", "ignored")
    assert rotor_inertia(load_tree(write(tmp_path, silent))) == [0.0, 0.0]


def test_gravity_is_the_files_unless_given(tmp_path):
    tilted = '<option gravity="1 0 -9"/>'
    assert load_tree(write(tmp_path, two_links(rest=tilted))).gravity == [1.0, 0.0, -9.0]
    assert load_tree(tmp_path / "arm.xml", gravity=(0, 3, 0)).gravity == [0.0, 3.0, 0.0]
    off = '<option><flag gravity="disable"/></option>'
    assert load_tree(write(tmp_path, two_links(rest=off))).gravity == [0.0, 0.0, 0.0]


def test_free_and_ball_joints_outside_the_choice_are_held(tmp_path):
    others = f'<body name="box"><freejoint name="float"/>{INERTIAL}</body>'
    ball = f'<body name="hand" pos="0 0 0.2"><joint name="ball" type="ball"/>{INERTIAL}</body>'
    scene = (
        two_links().replace("<worldbody>", f"<worldbody>{others}").replace("</body></body>", f"{ball}</body></body>")
    )
    tree = load_tree(write(tmp_path, scene), ["a", "b"])
    assert [link.mass for link in tree.links] == [1.0, 2.0]


def test_inactive_constraints_and_unused_followers_are_no_obstacle(tmp_path):
    follows = '<equality><joint joint1="b" joint2="a" active="{}"/></equality>'
    assert load_tree(write(tmp_path, two_links(rest=follows.format("false")))).size == 2
    assert load_tree(write(tmp_path, two_links(rest=follows.format("true"))), ["a"]).size == 1


def test_a_massless_link_is_allowed_where_a_fixed_one_gives_it_mass_or_its_joint_is_locked(tmp_path):
    tip = f'<body name="tip"><joint name="c"/><body name="tool">{INERTIAL}</body></body></body></body>'
    assert load_tree(write(tmp_path, two_links().replace("</body></body>", tip))).links[2].mass == 1.0
    bare = '<body name="tip"><joint name="c"/></body></body></body>'
    assert load_tree(write(tmp_path, two_links().replace("</body></body>", bare)), locked={"c": 0.0}).size == 2


def test_point_masses_have_no_inertia(tmp_path):
    parts = [replace(part, inertia=np.zeros((3, 3))) for part in planar_rig()]
    link = load_tree(write(tmp_path, urdf(parts))).links[0]
    assert link.mass == 8.191 and not any(link.inertia)


def test_the_hash_is_of_the_files_bytes(tmp_path):
    path = write(tmp_path, two_links())
    assert robot_sha256(path) == hashlib.sha256(path.read_bytes()).hexdigest()
    with pytest.raises(RobotError, match=r"missing\.urdf: cannot be read: No such file"):
        robot_sha256(tmp_path / "missing.urdf")


def test_perturbed_and_empty_models_leave_the_original_as_it_was(tmp_path):
    tree = load_tree(write(tmp_path, two_links('armature="0.3"')))
    light = perturbed(tree, mass_factor=0.5, com_factor=0.25)
    assert light.links[1].mass == 0.5 and light.links[1].com == [0.25 * x for x in tree.links[1].com]
    assert light.links[1].inertia == tree.links[1].inertia and rotor_inertia(light) == rotor_inertia(tree)
    nothing = empty(tree).links[0]
    assert not any([nothing.mass, nothing.rotor_inertia, *nothing.com, *nothing.inertia])
    assert tree.links[1].mass == 1.0


# What is refused, and in which words


def refused(message: str):
    return pytest.raises(RobotError, match=message)


RIG = urdf(planar_rig())
FLOATING = RIG.replace('"shoulder" type="revolute"', '"shoulder" type="floating"')
MASSLESS = urdf([replace(part, mass=0.0 if part.joint == "elbow" else 1.0) for part in planar_rig()])
ONLY_COLLISION = (
    '<link name="wrist"><collision><geometry><sphere radius="1"/></geometry></collision></link>'
    '<joint name="roll" type="continuous"><parent link="elbow_link"/><child link="wrist"/></joint>'
)
TWO_ROTORS = (
    '<transmission name="t"><joint name="x"/><joint name="y"/>'
    '<actuator name="m"><rotor_inertia>1</rotor_inertia></actuator></transmission>'
)
SITES = two_links(rest='<equality><weld site1="s" site2="t"/></equality>')
SITES = SITES.replace(INERTIAL, INERTIAL + '<site name="s"/>', 1).replace("<worldbody>", '<worldbody><site name="t"/>')
TENDON = '<tendon><fixed name="belt" {}><joint joint="a" coef="1"/><joint joint="b" coef="-1"/></fixed></tendon>'
BELT_MOTOR = '<actuator><motor tendon="belt" armature="0.1"/></actuator>'
NONE_LEFT = "no moving joint is left; a robot needs at least one that is not fixed or locked"
SENSE = "must be >= 0, and mass, centre of mass and inertia must be f"


@pytest.mark.parametrize(
    ("text", "options", "message"),
    [
        ("no robot at all", {}, r"arm\.xml: not readable as XML: .*line 1"),
        ("", {}, r"arm\.xml: not readable as XML: no element found"),
        ('<robot name="arm"><link></robot>', {}, r"arm\.xml: not readable as XML: mismatched tag"),
        ("<sdf/>", {}, r"arm\.xml: its root element is <sdf>; a URDF has <robot>, an MJCF <mujoco>"),
        (
            '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arm/></robot>',
            {},
            r"arm\.xml: is a xacro template; expand it first: xacro arm\.xml > robot\.urdf",
        ),
        (
            RIG.replace('<joint name="elbow"', '<joint name="shoulder"'),
            {},
            "line 4: 2 joints are named 'shoulder', the first in line 3; every joint needs a name of its own",
        ),
        (urdf(planar_rig(), '<link name="base"/>'), {}, "2 links are named 'base', the first in line 2; every link"),
        (
            RIG.replace('rotor_inertia value="', 'rotor_inertia value="big" x="', 1),
            {},
            "joint 'shoulder': rotor_inertia = 'big' in its transmission must be a finite number >= 0",
        ),
        (
            RIG.replace('gear_ratio value="100', 'gear_ratio value="inf', 1),
            {},
            "joint 'shoulder': gear_ratio = 'inf' in its transmission must be a finite number$",
        ),
        (urdf(planar_rig(), TWO_ROTORS), {}, "rotor inertia in a transmission of 2 joints; it must be one"),
        (
            FLOATING,
            {},
            r"joint 'shoulder' of body 'shoulder_link' has several axes \(floating, .*\); joints in use must be",
        ),
        (FLOATING, {"locked": {"shoulder": 0.0}}, "joint 'shoulder' has several axes, and no single position to be"),
        (
            two_links(second='type="ball"'),
            {"joints": ["a", "b"]},
            "joint 'b' of body 'lower' has several axes .*; joints in use must be hinges or slides",
        ),
        (MASSLESS, {}, "joint 'elbow' moves link 'elbow_link', which has no mass; every moving link needs one"),
        (urdf(planar_rig(), ONLY_COLLISION), {}, "joint 'roll' moves link 'wrist', which has no mass"),
        (two_links().replace('mass="1"', 'mass="-1"', 1), {}, rf"arm\.xml: link 'upper': mass = -1 kg {SENSE}"),
        (RIG.replace('mass value="8', 'mass value="-8'), {}, r"link 'shoulder_link': mass = -8\.191 kg"),
        (RIG.replace('ixx="', 'ixx="nan" x="', 1), {}, rf"link 'shoulder_link': mass = 8\.191 kg {SENSE}"),
        (two_links('armature="-1"'), {}, r"arm\.xml: joint 'a': rotor inertia = -1\.0+ must be >= 0"),
        (two_links(second='pos="nan 0 0"'), {}, r"arm\.xml: joint 'b': every number of a link must be finite"),
        (
            two_links().replace('mass="1"', 'mass="1e300"', 1),
            {},
            r"every number of a link must be within \+-1e\+09, not 1e\+300",
        ),
        (two_links(), {"joints": ["a", "elbow"]}, "no joint 'elbow'; its joints are a, b"),
        (two_links(), {"locked": {"wrist": 0.1}}, "no joint 'wrist'; its joints are a, b"),
        (two_links(), {"joints": ["a", "b", "a"]}, "joint 'a' is named twice; name every joint once"),
        (
            two_links(),
            {"joints": ["a", "b"], "locked": {"b": 0.3}},
            "joint 'b' is both in use and locked at 0.3; choose one",
        ),
        (two_links(), {"locked": {"b": np.nan}}, r"joint 'b': locked position nan must be finite, \[rad or m\]"),
        (two_links(), {"locked": {"a": 0.0, "b": 0.0}}, NONE_LEFT),
        (two_links(), {"joints": []}, NONE_LEFT),
        ('<robot name="stone"><link name="base"/></robot>', {}, NONE_LEFT),
        (SITES, {}, "bodies 'upper' and 'world' close a kinematic loop"),
        (
            two_links(rest=TENDON.format('armature="0.1"')),
            {},
            "tendon 'belt' has armature and moves joints in use; rotor inertia must be given at a joint",
        ),
        (two_links(rest=TENDON.format("") + BELT_MOTOR), {}, "tendon 'belt' has armature"),
        (two_links(), {"gravity": [9.81]}, r"gravity = \[9\.81\] must be three finite numbers"),
    ],
)
def test_what_is_no_arm_is_refused_with_the_rule(tmp_path, monkeypatch, text, options, message):
    monkeypatch.chdir(tmp_path)  # MuJoCo logs a NaN where it stands
    with refused(message):
        load_tree(write(tmp_path, text), **options)


def test_what_is_not_in_use_is_no_obstacle(tmp_path):
    assert load_tree(write(tmp_path, two_links(rest=TENDON.format("")))).size == 2
    assert load_tree(write(tmp_path, SITES), ["b"]).size == 1
    with refused(r"nowhere\.urdf: no such file; a robot is a URDF or MJCF file"):
        load_tree(tmp_path / "nowhere.urdf")


def test_more_joints_than_the_core_holds_are_refused(tmp_path):
    body = f'<body pos="0 0 0.1"><joint name="j{{}}"/>{INERTIAL}'
    chain = "".join(body.format(i) for i in range(33)) + "</body>" * 33
    path = write(tmp_path, mjcf(chain))
    with refused("33 joints in use, at most 32 can be: lock the others"):
        load_tree(path)
    assert load_tree(path, locked={"j7": 0.0}).size == 32


def test_a_joint_without_a_name_is_refused_unless_it_is_held(tmp_path):
    path = write(tmp_path, two_links().replace('name="b"', ""))
    with refused("a joint of body 'lower' has no name; recordings name their joints: give it one in the file"):
        load_tree(path)
    assert load_tree(path, ["a"]).size == 1


def test_joints_that_follow_others_must_be_locked(tmp_path):
    mimic = urdf(planar_rig()).replace('upper="3" effort="100" velocity="3"/></joint>', 'upper="3"/>{}</joint>')
    shoulder, elbow = mimic.split("{}", 1)
    text = shoulder + elbow.replace("{}", '<mimic joint="shoulder" multiplier="-1"/>')
    with refused(r"joint 'elbow' follows 'shoulder' \(mimic\) and is not independent: lock it, with locked={'elbow'"):
        load_tree(write(tmp_path, text))
    assert names(load_tree(tmp_path / "arm.xml", locked={"elbow": 0.2})) == ["shoulder"]
    held = two_links(rest='<equality><joint joint1="b"/></equality>')
    with refused("joint 'b' is fixed by an equality and is not independent: lock it"):
        load_tree(write(tmp_path, held))


def test_closed_loops_between_moving_links_are_refused(tmp_path):
    weld = two_links(rest='<equality><connect body1="lower" body2="world" anchor="0 0 0"/></equality>')
    path = write(tmp_path, weld)
    with refused("bodies 'lower' and 'world' close a kinematic loop; a tree has none: lock the joints in it"):
        load_tree(path)


def test_perturbations_must_be_numbers_that_make_sense(tmp_path):
    path = write(tmp_path, two_links())
    with refused("mass_factor = -0.5 must be finite and >= 0; 1 leaves the model as it is"):
        perturbed(load_tree(path), mass_factor=-0.5)
    with refused("com_factor = nan must be finite and >= 0"):
        perturbed(load_tree(path), com_factor=float("nan"))


def test_the_core_refuses_links_that_never_reach_the_base(tmp_path):
    links = load_tree(write(tmp_path, two_links())).links
    links[0].parent = 1
    with pytest.raises(_core.CoreError, match="joint 'a': its chain of parents ends in a ring, never at the base"):
        _core.Tree(links, [0.0, 0.0, -9.81])
