"""Robot files as people have them: odd but legal ones equal Pinocchio's reading, faulty ones end in one clear line."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pinocchio_oracle as oracle
import pytest
from made_arms import planar_rig, random_states, six_axis, urdf
from test_robot import INERTIAL, assert_same_dynamics, mjcf, two_links, write

from tauext import _core
from tauext.check.examination import Examination
from tauext.check.finding import Finding
from tauext.check.robot_file import file_findings
from tauext.cli import main
from tauext.errors import RobotError
from tauext.robot.capsules import write_shapes
from tauext.robot.read import load_tree, movable_joints
from tauext.robot.torque_limits import torque_limits
from tauext.robot.write import Payload, is_placeholder, write_robot

pin = oracle.pin
ARM = urdf(six_axis())
JOINTS = [part.joint for part in six_axis()]
LAST = "joint6_link"


def inertia(ixx: str, iyy: str, izz: str, rest: str = "") -> str:
    values = {"ixx": ixx, "iyy": iyy, "izz": izz, "ixy": "0", "ixz": "0", "iyz": "0"}
    return "<inertia " + " ".join(f'{key}="{value}"' for key, value in values.items()) + f"{rest}/>"


def link(name: str, mass: str = "", moments: str = inertia("0.01", "0.02", "0.015"), origin: str = "") -> str:
    return (
        f'<link name="{name}">'
        + (f'<inertial>{origin}<mass value="{mass}"/>{moments}</inertial>' * bool(mass))
        + "</link>"
    )


def joint(name: str, kind: str, parent: str, child: str, rest: str = '<axis xyz="0 0 1"/>') -> str:
    limit = '<limit lower="-1" upper="1" effort="1" velocity="1"/>' if kind in ("revolute", "prismatic") else ""
    return f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{rest}{limit}</joint>'


def with_more(*extra: str, text: str = ARM) -> str:
    return text.replace("</robot>", "\n".join([*extra, "</robot>"]))


def changed(pattern: str, by: str, count: int = 0) -> str:
    text = re.sub(pattern, by, ARM, count=count)
    assert text != ARM
    return text


# --- Odd, and legal.


LEGAL = {
    "frames without mass in a chain, with a tool at its end": with_more(
        *(link(f"f{k}") for k in range(4)), link("tool", "0.7", origin='<origin xyz="0 0.1 0"/>'),
        joint("k0", "fixed", LAST, "f0", '<origin xyz="0 0 0.1" rpy="0 1 0"/>'), joint("k1", "fixed", "f0", "f1", ""),
        joint("k2", "fixed", "f1", "f2", '<axis xyz="0 0 0"/>'), joint("k3", "fixed", "f2", "f3", ""),
        joint("k4", "fixed", "f3", "tool", '<origin xyz="0.1 0 0"/>')),
    "a floating joint beside the chain": with_more(link("box", "3"), joint("float", "floating", "base", "box", "")),
    "a floating joint behind the chain": with_more(link("box", "3"), joint("float", "floating", LAST, "box", "")),
    "a planar joint": with_more(link("sled", "3"), joint("plane", "planar", LAST, "sled")),
    "continuous joints": changed("revolute", "continuous"),
    "no limits": changed("<limit[^>]*>", '<limit effort="1" velocity="1"/>'),
    "no rpy": changed(' rpy="[^"]*"', ""),
    "no origin": changed("<origin[^>]*>", "", 9),
    "no axis": changed("<axis[^>]*>", ""),
    "an axis that is no unit vector": changed('<axis xyz="[^"]*"', '<axis xyz="0 3 4"'),
    "inertias without origin": changed("(<inertial>)<origin[^>]*>", r"\1"),
    "a leaf of mass zero": with_more(
        link("leaf", "0", inertia("0", "0", "0")), joint("k", "fixed", LAST, "leaf", "")),
    "a leaf with an inertia that no body has": with_more(
        link("leaf", "1e-8", inertia("1e-8", "1e-8", "1e-8").replace('"0"', '"1e-8"')),
        joint("k", "fixed", LAST, "leaf", "")),
    "tiny inertias": changed('(i[xyz]{2})="[^"]*"', r'\1="1e-12"'),
    "an inertia that violates the triangle inequality": changed('izz="[^"]*"', 'izz="9"', 3),
    "an inertia that is not positive": changed('ixx="[^"]*"', 'ixx="-0.02"', 2),
    "a link at the base with a negative mass": changed(
        '<link name="base"/>', link("base", "-1", inertia("-1", "2", "9"))),
    "masses in other notations": changed('mass value="[^"]*"', 'mass value="1.5E+0"'),
    "blanks in vectors": changed('axis xyz="[^"]*"', 'axis xyz=" 1.  0.5   -0E3 "'),
    "meshes that are not there": changed(
        "<inertial>", '<visual><geometry><mesh filename="package://arm/base.dae"/></geometry></visual><inertial>'),
    "a comment before the root": "<!-- made by hand -->\n" + ARM,
    "lines of dashes in comments": with_more("<!-- ---------- tool ---------- -->"),
    "an unused namespace": changed("<robot ", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" '),
    "a prefix without a namespace": with_more("<gz:plugin gz:x='1'/>"),
    "elements and attributes of others": with_more("<gazebo reference='base'><mu1>1</mu1></gazebo><sensor/>").replace(
        "<inertial>", '<selfCollide/><inertial uuid="7">'),
    "joints before their links": "<robot name='arm' xmlns:drake='d'>" + "\n".join(
        sorted(ARM.splitlines()[1:-1], reverse=True)).replace("</link>", "</link>\n") + "</robot>",
    "a base that is named world": ARM.replace('"base"', '"world"'),
    "a mimic joint in a gripper": with_more(
        link("jaw", "0.1"), link("jaw2", "0.1"), joint("grip", "prismatic", LAST, "jaw"),
        joint("grip2", "prismatic", LAST, "jaw2", '<axis xyz="0 1 0"/><mimic joint="grip" multiplier="-1"/>')),
    "turned by a quaternion": changed("<robot ", '<robot version="1.1" ').replace("</robot>", link("t", "1") + joint(
            "k", "fixed", LAST, "t", '<origin xyz="0 0 1" quat_xyzw="0.5 0.5 -0.5 0.5"/>') + "</robot>"),
}  # fmt: skip


def of_pinocchio(text: str):
    """Pinocchio's model with all joints but JOINTS held at their neutral position."""
    model = pin.buildModelFromXML(text)
    held = [model.getJointId(name) for name in list(model.names)[1:] if name not in JOINTS]
    return pin.buildReducedModel(model, held, pin.neutral(model))


@pytest.mark.parametrize("name", LEGAL)
def test_an_odd_file_is_read_as_pinocchio_reads_it(tmp_path, name):
    path = write(tmp_path, LEGAL[name], "arm.urdf")
    assert set(JOINTS) <= set(movable_joints(path))
    tree = load_tree(path, JOINTS)
    links = tree.links
    for one in links:
        one.rotor_inertia = 0.0
    tree = _core.Tree(links, tree.gravity)
    q, dq = random_states(len(JOINTS), 20, seed=1)
    expected = oracle.momentum(of_pinocchio(LEGAL[name]), q, dq, JOINTS)
    for found, right in zip(tree.momentum(q, dq), expected, strict=True):
        np.testing.assert_allclose(found, right, rtol=0, atol=1e-11 * np.abs(right).max())


DECLARED = '<?xml version="1.0" encoding="{}"?>\n<!-- Prüfstand -->\n'
BYTES = {
    "a byte order mark": b"\xef\xbb\xbf" + DECLARED.format("utf-8").encode() + ARM.encode(),
    "UTF-16": (DECLARED.format("utf-16") + ARM).encode("utf-16"),
    "Latin-1": (DECLARED.format("iso-8859-1") + ARM).encode("latin-1"),
    "a code page": (DECLARED.format("windows-1252") + ARM).encode("cp1252"),
    "Latin-1 that is declared as UTF-8": (DECLARED.format("utf-8") + ARM.replace("arm", "Prüf", 1)).encode("latin-1"),
    "UTF-8 that is declared as UTF-16": (DECLARED.format("utf-16") + ARM).encode(),
    "an encoding that nobody has": (DECLARED.format("latin-99") + ARM).encode(),
    "lines of Windows": (DECLARED.format("utf-8") + ARM).replace("\n", "\r\n").encode(),
    "blanks before the declaration": b"\n  " + DECLARED.format("utf-8").encode() + ARM.encode(),
    "a comment before the declaration": b"<!-- a -- b -->\n" + DECLARED.format("utf-8").encode() + ARM.encode(),
}


MORE = {
    "materials that are named twice": with_more('<material name="m"><color rgba="1 0 0 1"/></material>' * 2),
    "signs and tabs in numbers": ARM.replace('mass value="', 'mass value="\t+'),
    "a mesh as visual without file": ARM.replace(
        "<inertial>", "<visual><geometry><mesh/></geometry></visual><inertial>"
    ),
}
"""Read here, and not by Pinocchio."""
BYTES |= {name: text.encode() for name, text in MORE.items()}


@pytest.mark.parametrize("name", BYTES)
def test_a_file_is_read_in_any_encoding(tmp_path, name):
    path = tmp_path / "arm.urdf"
    path.write_bytes(BYTES[name])
    clean = load_tree(write(tmp_path, ARM, "clean.urdf"))
    assert_same_dynamics(load_tree(path, JOINTS), clean, 0.0)
    assert not is_placeholder(path)
    copied = load_tree(write_robot(path, tmp_path, {JOINTS[0]: (1e-4, 50.0)}), JOINTS)
    assert copied.links[0].rotor_inertia == pytest.approx(0.25) and copied.links[1].mass == clean.links[1].mass


def opened(path: Path) -> tuple[list[Finding], bool, list[str]]:
    """Findings of a robot file of these joints, whether it can be used, and joints whose inertias need a motion to be
    judged."""
    x = Examination([SimpleNamespace(joints=tuple(JOINTS), robot_sha256="")], path)  # type: ignore[list-item]
    return list(file_findings(x)), x.tree is not None, [one.joint for one in x.impossible]


def test_a_link_that_no_joint_in_use_moves_is_not_judged(tmp_path):
    broken = [link("bad", "-3", inertia("nan", "-1", "1")), joint("tilt", "revolute", "base", "bad")]
    path = write(tmp_path, with_more(*broken), "arm.urdf")
    assert_same_dynamics(load_tree(path, JOINTS), load_tree(write(tmp_path, ARM)), 0.0)
    assert opened(path) == ([], True, [])
    with pytest.raises(RobotError, match=r"link 'bad': mass = -3 kg must be >= 0"):
        load_tree(path)


def test_an_impossible_inertia_is_a_finding_and_a_note_where_it_changes_nothing(tmp_path):
    (note,), usable, _ = opened(write(tmp_path, LEGAL["a leaf with an inertia that no body has"], "arm.urdf"))
    assert (note.code, note.severity, note.joint) == ("inertia-impossible", "note", "joint6")
    assert "link 'leaf'" in note.evidence and usable
    broken, usable, judged = opened(
        write(tmp_path, LEGAL["an inertia that violates the triangle inequality"], "a.urdf")
    )
    assert not broken and usable and judged == list(JOINTS[:3])


# --- What is refused, with its line.


REFUSED = {
    "a mistyped attribute": (
        'axis xyz="', 'axis xzy="',
        r"joint 'joint\d': <axis> has no attribute 'xzy'; did you mean 'xyz'\?"),
    "an attribute in capitals": (
        'mass value="', 'mass Value="',
        "<mass> has no attribute 'Value'; did you mean 'value'"),
    "a wrong attribute": ('child link="', 'child name="', "<child> has no attribute 'name'; it has link"),
    "a mistyped inertia": ('iyz="', 'izy="', "<inertia> has no attribute 'izy'; did you mean 'iyz'"),
    "a missing inertia": ('iyy="', 'other="', "<inertia> has no iyy"),
    "a mistyped type": (
        'type="revolute"', 'type="revolut"',
        "type = 'revolut' must be one of revolute, .*; did you mean 'revolute'"),
    "an unknown type": (
        'type="revolute"', 'type="screw"',
        "type = 'screw' must be one of revolute, continuous, prismatic"),
    "no type": ('type="revolute"', "", "type = None must be one of revolute, continuous, prismatic"),
    "no name": ('joint name="joint3"', "joint", "a joint has no name; every joint needs one"),
    "an unknown parent": (
        'parent link="joint2_link"', 'parent link="joint2_lnk"',
        "its parent link 'joint2_lnk' is not in the file; did you mean 'joint2_link'"),
    "an unknown child": (
        'child link="joint2_link"', 'child link="forearm"',
        "its child link 'forearm' is not in the file"),
    "a parent without link": ('parent link="joint2_link"', "parent", "joint 'joint3': <parent> has no link"),
    "no parent": ('<parent link="joint2_link"/>', "<!-- gone -->", "joint 'joint3': has no <parent link=...>"),
    "two parents": (
        'child link="joint5_link"', 'child link="joint4_link"',
        "link 'joint4_link' is the child of joints 'joint4' and 'joint5'; a link has one parent"),
    "a loop": (
        'parent link="base"', 'parent link="joint6_link"',
        "hang on each other and not on a base; a robot file is a tree"),
    "an axis without direction": ('axis xyz="', 'axis xyz="0 0 0" other="', "<axis xyz='0 0 0'> has no direction"),
    "a word for a number": (
        'origin xyz="', 'origin xyz="0 0 a" other="',
        "<origin xyz='0 0 a'> must be 3 finite numbers, separated by blanks"),
    "a decimal comma": ('mass value="', 'mass value="1,5" other="', "must be a finite number; a comma is neither a"),
    "commas": (
        'axis xyz="', 'axis xyz="0,0,1" other="',
        "<axis xyz='0,0,1'> must be 3 finite numbers, separated by blanks"),
    "two numbers": ('rpy="', 'rpy="0 1" other="', "<origin rpy='0 1'> must be 3 finite numbers"),
    "no number": ('mass value="', 'mass value="" other="', "<mass value=''> must be a finite number"),
    "not a number in a position": (
        'origin xyz="', 'origin xyz="nan 0 0" other="',
        "<origin xyz='nan 0 0'> must be 3 finite numbers"),
    "a mistyped element": ("<origin", "<orgin", "<orgin> is unknown; did you mean <origin>"),
    "a mistyped inertial": ("<inertial>", "<inertal>", "<inertal> is unknown; did you mean <inertial>"),
    "no mass": ("<mass ", "<weight ", "link 'joint1_link': <inertial> has no <mass>"),
    "a value of xacro": (
        'mass value="', 'mass value="${m}" other="',
        "must be a finite number; the file is a xacro template: expand it"),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_fault_is_named_with_its_line_and_its_remedy(tmp_path, name):
    old, new, message = REFUSED[name]
    lines = ARM.replace("><", ">\n<").splitlines()
    at = next(k for k, line in enumerate(lines) if old in line)
    lines[at] = lines[at].replace(old, new, 1)
    text = (
        "\n".join(lines)
        .replace("</orgin>", "")
        .replace("</inertial>", "</inertal>" if "inertal" in new else "</inertial>", 1)
    )
    with pytest.raises(RobotError, match=rf"^[^\n]*arm\.urdf, line (\d+): [^\n]*{message}[^\n]*$") as refused:
        load_tree(write(tmp_path, text, "arm.urdf"))
    line = int(re.search(r", line (\d+)", str(refused.value))[1])
    # A loop, a missing child and a missing mass are reported at the element that lacks something.
    assert line == at + 1 or line < at + 1 <= line + 6, (line, at + 1)
    assert "MuJoCo" not in str(refused.value)


def test_a_part_beside_the_robot_is_refused_unless_it_neither_moves_nor_weighs(tmp_path):
    stray = with_more(link("camera"), link("lens"), joint("k", "fixed", "camera", "lens", ""))
    assert_same_dynamics(load_tree(write(tmp_path, stray)), load_tree(write(tmp_path, ARM, "clean.urdf")), 0.0)
    with pytest.raises(RobotError, match="line .*: links 'base', 'camera' have no parent; a robot has one base"):
        load_tree(write(tmp_path, with_more(link("camera", "0.3"))))


def test_a_file_without_any_mass_is_named_as_such_and_the_ways_on_work(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    frame = link("flange") + joint("k", "fixed", LAST, "flange", "")
    path = write(tmp_path, with_more(frame, text=re.sub("<inertial>.*?</inertial>", "", ARM)), "arm.urdf")
    log = "t," + ",".join(f"{name}.{joint}" for name in ("q", "dq", "tau") for joint in JOINTS)
    write(tmp_path, log + "\n" + "\n".join(",".join([str(k / 100)] + ["0.1"] * 18) for k in range(300)), "log.csv")
    for load in (load_tree, movable_joints):
        with pytest.raises(RobotError, match=r"arm\.urdf: none of its links has a mass, .*leave --robot out"):
            load(path)
    new = ["import", "--new", "arm.toml", "--source", "log.csv"]
    assert main([*new, "--robot", "arm.urdf"]) == 2
    assert "none of its links has a mass" in capsys.readouterr().err and not (tmp_path / "arm.toml").exists()
    assert main(new) == 0
    assert 'model = ""' in (tmp_path / "arm.toml").read_text()


def test_a_single_link_without_mass_is_named_whatever_frames_hang_on_it(tmp_path):
    text = re.sub(rf'(<link name="{LAST}">)<inertial>.*?</inertial>', r"\1", ARM)
    frames = (link("flange"), joint("k", "fixed", LAST, "flange", ""), link("tip", "0", inertia("0", "0", "0")))
    for extra in ((), frames[:2], (*frames, joint("k2", "fixed", "flange", "tip", ""))):
        with pytest.raises(RobotError, match=f"joint 'joint6' moves link '{LAST}', which has no mass"):
            load_tree(write(tmp_path, with_more(*extra, text=text), "arm.urdf"))


# --- MJCF.


def of_body(inertial: str = INERTIAL, shape: str = "", rest: str = "") -> str:
    return mjcf(f'<body name="upper"><joint name="a" axis="0 1 0"/>{inertial}{shape}</body>', rest)


MESH = (
    '<asset><mesh name="m" file="gone.stl"/><texture name="t" type="2d" file="gone.png"/>'
    '<material name="x" texture="t"/></asset>'
)
SHAPE = '<geom type="mesh" mesh="m" material="x"/>'
READABLE = {
    "a mesh and a texture that are not there": (of_body(shape=SHAPE, rest=MESH), of_body()),
    "a mesh without mass that is not there": (
        of_body("", '<geom type="mesh" mesh="m" mass="0"/><geom size="0.1" mass="2" material="x"/>', MESH),
        of_body("", '<geom size="0.1" mass="2"/>')),
    "a base whose mesh is not there": (
        of_body(rest=MESH).replace("<worldbody>", f"<worldbody><body>{SHAPE}</body>"), of_body()),
    "sensors and key frames of another file": (
        of_body(rest='<sensor><jointpos joint="z"/></sensor><keyframe><key qpos="1 2 3"/></keyframe>'), of_body()),
    "a limit with its ends exchanged": (
        of_body().replace('name="a"', 'name="a" range="1 -1" limited="true"'), of_body()),
    "an impossible body that is not moved": (
        of_body().replace(
            "<worldbody>", '<worldbody><body><inertial pos="0 0 0" mass="1" diaginertia="1 1 9"/></body>'), of_body()),
}  # fmt: skip


@pytest.mark.parametrize("name", READABLE)
def test_an_mjcf_is_read_where_what_is_wrong_does_not_matter(tmp_path, name):
    text, clean = READABLE[name]
    path, folder = write(tmp_path, text), tmp_path / "dataset"
    folder.mkdir()
    right = load_tree(write(tmp_path, clean, "clean.xml"))
    assert_same_dynamics(load_tree(path), right, 0.0)
    assert_same_dynamics(load_tree(write_robot(path, folder, {})), right)
    left_out = "shapes are left out, since a mesh, a texture or a name is missing in arm.xml"
    assert write_shapes(path, folder).notes == [left_out] * ("gone" in text and "geom" in text)
    assert torque_limits(path, ["a"]) == np.inf


def test_an_impossible_inertia_of_an_mjcf_is_read_and_written_as_it_is(tmp_path):
    full = '<inertial pos="0 0 0.1" mass="2" fullinertia="1 2 0.5 0.1 0 -0.3"/>'
    path = write(tmp_path, of_body(full))
    link = load_tree(path).links[0]
    turn = np.reshape(link.rotation, (3, 3))
    xx, yy, zz, xy, xz, yz = link.inertia
    found = turn @ np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) @ turn.T
    np.testing.assert_allclose(found, [[1, 0.1, 0], [0.1, 2, -0.3], [0, -0.3, 0.5]], rtol=0, atol=1e-14)
    load = Payload("upper", 0.5, (0.0, 0.0, 0.1), (0.0,) * 6)
    written = load_tree(write_robot(path, tmp_path, {}, load)).links[0]
    assert written.mass == 2.5
    np.testing.assert_allclose(written.inertia, link.inertia, rtol=0, atol=1e-6)  # MuJoCo writes the axes so


FAULTY = {
    "<joint name='a' axiss='0 1 0'/>": r"line 1: <joint> has no attribute 'axiss'$",
    "<joint name='a' axis='0 1'/>": "line 1: <joint>: axis has too few numbers$",
    "<joint name='a' axis='0 1 a'/>": "line 1: <joint>: axis must be numbers$",
    "<joint name='a' axis='0 0 0'/>": "line 1: 'a': its axis has no direction; give a unit vector$",
    "<joint name='a' type='screw'/>": "line 1: <joint>: 'screw' is none of the words that MJCF defines there$",
    "<joint name='a'/><joint name='a'/>": "line 1: two elements <joint> are named 'a'; every one needs a name of its o",
    "<joint name='a' class='none'/>": "line 1: <joint> has the class 'none', which no <default> defines$",
    "<joint name='a'/><hinge/>": "line 1: <hinge> is not allowed there$",
    "<joint name='a'/><geom type='mesh' mesh='m'/>": "line 1: a geom names the mesh 'm', which is not in the file$",
}  # fmt: skip


@pytest.mark.parametrize("element", FAULTY)
def test_what_mujoco_refuses_is_named_in_our_words(tmp_path, element):
    text = of_body("", '<geom size="0.1" mass="1"/>').replace('<joint name="a" axis="0 1 0"/>', element)
    with pytest.raises(RobotError, match=FAULTY[element]):
        load_tree(write(tmp_path, text))


def test_a_mesh_that_an_inertia_needs_is_named_with_its_body(tmp_path):
    with pytest.raises(RobotError, match=r"body 'upper' has no <inertial>, and the mesh 'gone\.stl' from which"):
        load_tree(write(tmp_path, of_body("", SHAPE, MESH)))
    with pytest.raises(RobotError, match=r"line 1: the file 'gone\.xml' that it names cannot be opened; put it there"):
        load_tree(write(tmp_path, "<mujoco><include file='gone.xml'/></mujoco>"))


def cut_and_bent(text: str, count: int, seed: int) -> list[str]:
    """The text with an attribute lost, doubled, exchanged or bent, or an element lost."""
    rng, found = np.random.default_rng(seed), []
    attributes = [found.span() for found in re.finditer(r'[\w:]+="[^"]*"', text)]
    elements = [found.span() for found in re.finditer(r"<\w+[^<>]*/>", text)]
    values = [
        "",
        "nan",
        "-1",
        "0",
        "1e400",
        "0 0",
        "0 0 0",
        "a",
        "1 2 3 4",
        "base",
        "joint3",
        "joint6_link",
        "&#0;",
        "inf",
    ]
    for _ in range(count):
        places = attributes if rng.random() < 0.8 or not elements else elements
        start, end = places[rng.integers(len(places))]
        key = text[start:end].split("=")[0]
        new = f'{key}="{values[rng.integers(len(values))]}"' if text[start] != "<" and rng.random() < 0.8 else ""
        found.append(text[:start] + new + text[end:])
    return found


@pytest.mark.parametrize("name", ["urdf", "mjcf"])
def test_no_fault_ends_in_words_of_mujoco(tmp_path, name):
    text = urdf(planar_rig()) if name == "urdf" else two_links("armature='1'", rest="<option gravity='0 0 -9'/>")
    ends = {"read": 0, "refused": 0}
    for text_of_one in cut_and_bent(text, 150, seed=1):
        path = Path(write(tmp_path, text_of_one, "arm." + name))
        try:
            load_tree(path)
            ends["read"] += 1
        except RobotError as error:
            ends["refused"] += 1
            assert "\n" not in str(error) and not re.search(r"Error|balance|MuJoCo (?!XML)", str(error)), str(error)
    assert min(ends.values()) > 10
