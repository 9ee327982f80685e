"""Shapes of links as capsules: against the shapes they are made of, MuJoCo's own places of them, and missing files."""

from __future__ import annotations

import json
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from tauext import _core
from tauext.cli.show import describe_shapes
from tauext.errors import RobotError
from tauext.robot.capsules import BodyCapsules, body_capsules, link_capsules, write_shapes
from tauext.robot.read import load_tree
from tauext.robot.write import write_robot

INERTIAL = '<inertial pos="0 0 0.1" mass="2" diaginertia="0.02 0.02 0.01"/>'
ARM = f"""<mujoco><worldbody>
  <geom type="box" size="1 1 0.1"/>
  <body name="upper" pos="0 0 0.3">{INERTIAL}
    <joint name="one" axis="0 1 0"/>
    <geom type="capsule" fromto="0 0 0 0 0.02 0.4" size="0.05"/>
    <geom type="cylinder" fromto="0 0 0.4 0 0.2 0.4" size="0.04"/>
    <geom type="sphere" pos="0.5 0 0" size="0.3" contype="0" conaffinity="0"/>
    <body name="fore" pos="0 0 0.4" euler="0 90 20">{INERTIAL}
      <joint name="two" axis="1 0.5 0"/>
      <geom type="sphere" pos="0.1 0 0" size="0.06" contype="0" conaffinity="0"/>
      <body name="hand" pos="0 0.1 0.3"><geom type="sphere" size="0.03"/></body>
    </body>
  </body>
</worldbody></mujoco>"""
URDF = """<robot name="r"><link name="base"/>
<joint name="one" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 0 1"/>
  <origin xyz="0 0 0.2" rpy="0 0.3 0"/><limit lower="-2" upper="2" effort="9" velocity="2"/></joint>
<link name="upper"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
  <visual><geometry><sphere radius="0.5"/></geometry></visual>
  <collision><origin xyz="0.1 0 0.2" rpy="0 1.5707963267948966 0"/>
    <geometry><cylinder radius="0.05" length="0.4"/></geometry></collision>
  {more}</link></robot>"""


def written(folder: Path, text: str, name: str) -> Path:
    path = folder / name
    path.write_text(text)
    return path


def test_capsules_stand_where_mujoco_has_the_shapes(tmp_path):
    path = written(tmp_path, ARM, "arm.xml")
    tree = load_tree(path)
    capsules, notes = link_capsules(path, tree)
    assert notes == [] and [one.link for one in capsules] == [
        0,
        0,
        1,
        1,
    ]  # what does not collide counts where nothing does
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    wrenches = model_of(tree)
    for q in np.random.default_rng(3).uniform(-2, 2, (4, 2)):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        middles = [(np.array(one.start) + one.end) / 2 for one in capsules]
        told = [wrenches.pose(tree.links[one.link].joint_name, q.tolist()) for one in capsules]
        at = np.array([rotation @ middle + origin for (rotation, origin), middle in zip(told, middles, strict=True)])
        np.testing.assert_allclose(at, data.geom_xpos[[1, 2, 4, 5]], atol=1e-9)
    sizes = [(np.linalg.norm(np.subtract(one.end, one.start)), one.radius_m) for one in capsules]
    expected = [(np.hypot(0.4, 0.02), 0.05), (0.2 - 2 * 0.04, 0.04), (0, 0.06), (0, 0.03)]
    np.testing.assert_allclose(sizes, expected, atol=1e-9)


def model_of(tree) -> _core.WrenchModel:
    bundle = _core.Bundle()
    bundle.links, bundle.gravity = tree.links, tree.gravity
    return _core.WrenchModel(bundle)


TURN = np.array([[np.cos(0.3), 0, np.sin(0.3)], [0, 1, 0], [-np.sin(0.3), 0, np.cos(0.3)]])
"""Base from link `upper` of the URDF at q = 0, which stands at (0, 0, 0.2)."""


def in_urdf_axes(path: Path, capsule) -> np.ndarray:
    """Its ends in the axes of the URDF's link; the core's link turns about the same z, by an angle of its own."""
    rotation, origin = model_of(load_tree(path)).pose("one", [0.0])
    ends = np.array([rotation @ one + origin for one in (capsule.start, capsule.end)]) - [0, 0, 0.2]
    ends = ends @ TURN
    return ends[np.argsort(ends[:, 0])]


def test_a_urdf_has_its_collision_shapes_and_else_what_is_seen(tmp_path):
    path = written(tmp_path, URDF.format(more=""), "arm.urdf")
    (capsule,), notes = link_capsules(path, load_tree(path))
    assert notes == [] and capsule.radius_m == pytest.approx(0.05)
    ends = in_urdf_axes(path, capsule)
    np.testing.assert_allclose(ends, [[-0.05, 0, 0.2], [0.25, 0, 0.2]], atol=1e-9)
    seen = URDF.format(more="").replace("<collision>", "<ignored>").replace("</collision>", "</ignored>")
    (only,), _ = link_capsules(written(tmp_path, seen, "seen.urdf"), load_tree(path))
    assert only.radius_m == 0.5


def stl(corners: np.ndarray) -> bytes:
    """Binary, of triangles (n, 3, 3)."""
    triangles = np.zeros(len(corners), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("rest", "<u2")])
    triangles["corners"] = corners
    return b" " * 80 + np.uint32(len(corners)).tobytes() + triangles.tobytes()


def tube(radius: float, length: float, around: int = 24) -> np.ndarray:
    """A closed cylinder along x, off its origin, in triangles."""
    turned = 2 * np.pi * np.arange(around + 1) / around
    ring = np.column_stack([np.zeros(around + 1), radius * np.cos(turned), radius * np.sin(turned)])
    near, far = ring + [0.1, 0, 0.05], ring + [0.1 + length, 0, 0.05]
    found = []
    for k in range(around):
        a, b, c, d = near[k], near[k + 1], far[k], far[k + 1]
        found += [[a, c, b], [b, c, d], [a, b, [0.1, 0, 0.05]], [c, [0.1 + length, 0, 0.05], d]]
    return np.array(found)


def distances(points: np.ndarray, capsules) -> np.ndarray:
    """Of points (n, 3) from the nearest capsule's surface, (n,)."""
    found = []
    for start, end, radius in capsules:
        way = np.subtract(end, start)
        share = np.clip((points - start) @ way / max(way @ way, 1e-12), 0, 1)
        found.append(np.abs(np.linalg.norm(points - start - share[:, None] * way, axis=1) - radius))
    return np.min(found, axis=0)


def test_meshes_are_read_where_they_are_and_noted_where_not(tmp_path):
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "tube.stl").write_bytes(stl(tube(0.05, 0.4) * 1000))
    mesh = '<collision><geometry><mesh filename="{}" scale="0.001 0.001 0.001"/></geometry></collision>'
    more = mesh.format("package://some_arm/meshes/tube.stl")
    path = written(tmp_path, URDF.format(more=more), "arm.urdf")
    (_, capsule), notes = link_capsules(path, load_tree(path))
    assert notes == []
    # A capsule as long as the tube, whose ends are rounder: within a fifth of its radius.
    assert capsule.radius_m == pytest.approx(0.05, rel=0.1)
    ends = in_urdf_axes(path, capsule)
    np.testing.assert_allclose(ends[:, 1:], [[0, 0.05], [0, 0.05]], atol=2e-3)
    np.testing.assert_allclose([ends[0, 0] - capsule.radius_m, ends[1, 0] + capsule.radius_m], [0.1, 0.5], atol=0.015)
    more += mesh.format("package://some_arm/meshes/none.stl") + mesh.format("hull.dae")
    path = written(tmp_path, URDF.format(more=more), "arm.urdf")
    capsules, (note,) = link_capsules(path, load_tree(path))
    assert capsules == []  # the parts that were read are not the whole link
    assert (
        "shapes of upper could not be read: there is no mesh file package://some_arm/meshes/none.stl and 1 more" in note
    )


def test_what_an_mjcf_without_its_meshes_still_has_is_not_a_whole_link(tmp_path):
    """Only the hand keeps its shape, since its inertia follows from it; the forearm that it is fixed to has lost its
    own."""
    text = ARM.replace("<mujoco>", '<mujoco><asset><mesh name="tube" file="tube.stl"/></asset>')
    text = text.replace('<joint name="one"', '<geom type="mesh" mesh="tube"/><joint name="one"')
    path = written(tmp_path, text, "arm.xml")
    assert [*body_capsules(path).bodies] == ["hand"]
    capsules, notes = link_capsules(path, load_tree(path))
    assert capsules == [] and len(notes) == 1


@pytest.mark.parametrize(
    ("shape", "most", "off_m"),
    [
        ('box" size="0.05 0.05 0.2', 2, 0.012),
        ('ellipsoid" size="0.05 0.06 0.2', 2, 0.01),
        ('box" size="0.15 0.15 0.02', 4, 0.03),
    ],
)
def test_other_shapes_are_near_their_capsules(tmp_path, shape, most, off_m):
    """Points of the shape's surface, drawn here, are near that of one of its capsules."""
    body = f'<body name="a">{INERTIAL}<joint name="j"/><geom type="{shape}"/></body>'
    arm = f"<mujoco><worldbody>{body}</worldbody></mujoco>"
    capsules = body_capsules(written(tmp_path, arm, "arm.xml")).bodies["a"]
    assert 1 <= len(capsules) <= most
    half = np.array([float(x) for x in shape.split('"')[-1].split()])
    points = np.random.default_rng(0).normal(size=(500, 3))
    if shape.startswith("box"):
        points /= np.abs(points).max(axis=1)[:, None]
    else:
        points /= np.linalg.norm(points, axis=1)[:, None]
    off = distances(points * half, capsules)
    assert np.sqrt(np.mean(np.square(off))) < off_m


def turned(corners: np.ndarray) -> np.ndarray:
    """The triangles along none of the axes."""
    flat = np.empty(9)
    mujoco.mju_quat2Mat(flat, np.array([0.5, 0.7, -0.2, 0.4]) / np.linalg.norm([0.5, 0.7, -0.2, 0.4]))
    return corners @ flat.reshape(3, 3).T


def obj(corners: np.ndarray, *stray: str) -> bytes:
    """An OBJ of triangles (n, 3, 3), and further lines before its faces."""
    points = [f"v {x} {y} {z}" for x, y, z in corners.reshape(-1, 3)]
    faces = [f"f {k} {k + 1} {k + 2}" for k in range(1, len(points), 3)]
    return "\n".join([*points, *stray, *faces]).encode()


def box(*half: float) -> np.ndarray:
    """A closed box about (0.1, 0, 0.05), in triangles."""
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half + [0.1, 0, 0.05]
    return corners[ConvexHull(corners).simplices]


def rounded(radius: float, length: float) -> np.ndarray:
    """A capsule along z, in triangles; its ends are at (0.1, 0, ±length / 2)."""
    ball = np.random.default_rng(0).normal(size=(1500, 3))
    ball *= radius / np.linalg.norm(ball, axis=1)[:, None]
    points = ball + np.sign(ball[:, 2:]) * [0, 0, length / 2] + [0.1, 0, 0]
    return points[ConvexHull(points).simplices]


def ring(radius: float, wide: float, around: int = 24) -> np.ndarray:
    """A band about z, open inside."""
    turned = 2 * np.pi * np.arange(around + 1) / around
    low = np.column_stack([radius * np.cos(turned), radius * np.sin(turned), np.zeros(around + 1)])
    high = low + [0, 0, wide]
    return np.concatenate([[[low[k], low[k + 1], high[k]], [low[k + 1], high[k], high[k + 1]]] for k in range(around)])


TUBE = tube(0.05, 0.4)
PLATE = np.array([[[0, 0, 0], [0.3, 0, 0], [0, 0.2, 0]], [[0.3, 0, 0], [0.3, 0.2, 0], [0, 0.2, 0]]])
FIN = np.array([[[0.1, 0, 0.05], [0.1, 0, 0.051], [1.6, 0, 0.05]]])
"""A triangle to one vertex that is far from the others."""
MESHES = {
    "closed": ("a.stl", stl(TUBE), "1 1 1", TUBE),
    "open": ("a.stl", stl(TUBE[1::4]), "1 1 1", TUBE[1::4]),
    "a part": ("a.stl", stl(TUBE[: len(TUBE) // 3]), "1 1 1", TUBE[: len(TUBE) // 3]),
    "a box": ("a.stl", stl(box(0.05, 0.08, 0.2)), "1 1 1", box(0.05, 0.08, 0.2)),
    "a turned box": ("a.stl", stl(turned(box(0.05, 0.08, 0.2))), "1 1 1", turned(box(0.05, 0.08, 0.2))),
    "a capsule": ("a.obj", obj(turned(rounded(0.06, 0.3))), "1 1 1", turned(rounded(0.06, 0.3))),
    "a ring": ("a.stl", stl(turned(ring(0.1, 0.03))), "1 1 1", turned(ring(0.1, 0.03))),
    "flat": ("a.stl", stl(np.tile(PLATE, (2, 1, 1))), "1 1 1", PLATE),
    "flat and turned": ("a.obj", obj(turned(PLATE)), "1 1 1", turned(PLATE)),
    "a thin plate": ("a.stl", stl(turned(box(0.2, 0.15, 0.002))), "1 1 1", turned(box(0.2, 0.15, 0.002))),
    "thin": ("a.stl", stl(turned(tube(5e-4, 0.4))), "1 1 1", turned(tube(5e-4, 0.4))),
    "mirrored": ("a.stl", stl(TUBE), "1 -1 1", TUBE * [1, -1, 1]),
    "in mm": ("a.stl", stl(TUBE * 1000), "0.001 0.001 0.001", TUBE),
    "scaled unevenly": ("a.stl", stl(turned(TUBE)), "2 1 0.1", turned(TUBE) * [2, 1, 0.1]),
    "with a stray vertex": ("a.obj", obj(TUBE, "v 40 0 0"), "1 1 1", TUBE),
    "with a triangle to a far vertex": ("a.stl", stl(np.concatenate([TUBE, FIN])), "1 1 1", TUBE),
    "with triangles without area": ("a.stl", stl(np.concatenate([TUBE, np.full((4, 3, 3), 0.3)])), "1 1 1", TUBE),
}


def mesh_body(folder: Path, name: str, content: bytes, scale: str = "1 1 1") -> BodyCapsules:
    """The shapes of a link of this mesh alone, whose origin is moved and turned in the link."""
    (folder / name).write_bytes(content)
    origin = '<origin xyz="0.2 -0.1 0.3" rpy="0.4 -0.7 1.1"/>'
    mesh = f'<collision>{origin}<geometry><mesh filename="{name}" scale="{scale}"/></geometry></collision>'
    text = re.sub("<(collision|visual)>.*</(collision|visual)>", "", URDF, flags=re.DOTALL).format(more=mesh)
    return body_capsules(written(folder, text, "arm.urdf"))


def placed(corners: np.ndarray) -> np.ndarray:
    """Points of the mesh of mesh_body() in the link's axes."""
    return corners.reshape(-1, 3) @ Rotation.from_euler("xyz", [0.4, -0.7, 1.1]).as_matrix().T + [0.2, -0.1, 0.3]


@pytest.mark.parametrize("kind", MESHES)
def test_capsules_stay_within_the_convex_hull_of_their_mesh(tmp_path, kind):
    """Grown by a tenth of its diagonal: in every direction no capsule reaches farther. They are near the mesh."""
    name, content, scale, corners = MESHES[kind]
    shapes = mesh_body(tmp_path, name, content, scale)
    assert shapes.notes == [] and 1 <= len(shapes.bodies["upper"]) <= 4
    points = placed(corners)
    directions = np.random.default_rng(1).normal(size=(3000, 3))
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    margin = 0.1 * np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0))
    for start, end, radius in shapes.bodies["upper"]:
        reach = np.maximum(directions @ start, directions @ end) + radius
        assert (reach - (points @ directions.T).max(axis=0)).max() < margin + 1e-4
    off = distances(placed(corners.mean(axis=1)), shapes.bodies["upper"])
    assert np.sqrt(np.mean(off**2)) < margin


def test_a_mesh_that_is_a_capsule_becomes_that_capsule(tmp_path):
    ((start, end, radius),) = mesh_body(tmp_path, "a.stl", stl(turned(rounded(0.06, 0.3)))).bodies["upper"]
    ends = placed(turned(np.array([[0.1, 0, -0.15], [0.1, 0, 0.15]])))
    off = min(np.abs(np.subtract([start, end], one)).max() for one in (ends, ends[::-1]))
    assert off < 5e-3 and radius == pytest.approx(0.06, abs=3e-3)  # 600 drawn points leave the poles out by millimetres


@pytest.mark.parametrize(
    ("name", "content", "note"),
    [
        ("a.stl", stl(np.zeros((4, 3, 3))), "a.stl has no surface"),
        ("a.stl", stl(TUBE * np.nan), "a.stl is no mesh that can be read"),
        ("a.stl", stl(TUBE)[:-60], "a.stl is no mesh that can be read"),
        ("a.stl", stl(TUBE[:0]), "a.stl is no mesh that can be read"),
        ("a.stl", b"", "a.stl is no mesh that can be read"),
        ("a.obj", b"v 0 0 0", "a.obj is no mesh that can be read"),
        ("a.stl", stl(TUBE * 1000), "a shape reaches 503 m: a mesh in mm needs scale = 0.001"),
        ("a.stl", stl(TUBE * 10), "a shape reaches 5.03 m: a mesh in mm needs scale = 0.001"),
    ],
)
def test_a_mesh_that_is_no_link_is_noted_and_its_link_guessed(tmp_path, name, content, note):
    (tmp_path / name).write_bytes(content)
    more = f'<collision><geometry><mesh filename="{name}"/></geometry></collision>'
    path = written(tmp_path, URDF.format(more=more), "arm.urdf")
    capsules, (line,) = link_capsules(path, load_tree(path))
    assert capsules == [] and line.startswith("shapes of upper could not be read: a") and note in line


def test_shapes_kept_by_a_version_that_fitted_them_far_away_are_not_used(tmp_path):
    """A forearm of 0.4 m whose kept capsule ends 4.75 m from its joint: its mesh is read again, or the link guessed."""
    (tmp_path / "dataset").mkdir()
    (tmp_path / "a.stl").write_bytes(stl(TUBE))
    text = re.sub("<(collision|visual)>.*</(collision|visual)>", "", URDF, flags=re.DOTALL)
    source = written(
        tmp_path, text.format(more='<visual><geometry><mesh filename="a.stl"/></geometry></visual>'), "a.urdf"
    )
    kept = write_robot(source, tmp_path / "dataset", {})
    write_shapes(source, tmp_path / "dataset")
    file, tree = tmp_path / "dataset" / "robot.shapes.json", load_tree(kept)
    assert len(link_capsules(kept, tree)[0]) == 1 and link_capsules(kept, tree)[1] == []
    content = json.loads(file.read_text())
    content["bodies"]["upper"][0]["end_m"] = [0.0, 0.0, 4.75]
    file.write_text(json.dumps(content))
    capsules, (note,) = link_capsules(kept, tree)
    assert capsules == [] and note.startswith("shapes of upper could not be read: there is no mesh file a.stl")
    (tmp_path / "dataset" / "a.stl").write_bytes(stl(TUBE))
    (again,), notes = link_capsules(kept, tree)
    assert notes == [] and max(np.abs(again.start + again.end)) < 0.6


def test_show_states_why_links_are_guessed(tmp_path):
    bundle, names = _core.Bundle(), ["one", "two"]
    bundle.links = load_tree(written(tmp_path, ARM, "arm.xml")).links
    bundle.capsules = [_core.Capsule(0, [0, 0, 0], [0, 0, 0.3], 0.05)]
    content = describe_shapes(bundle, names, ["shapes of fore could not be read: there is no mesh file a.stl"])
    assert content["guessed"] == ["two"] and content["why_guessed"].endswith("there is no mesh file a.stl")
    assert describe_shapes(bundle, names, [])["why_guessed"] == "the robot file has no geometry for them"
    bundle.capsules = [*bundle.capsules, _core.Capsule(1, [0, 0, 0], [0, 0, -0.3], 0.05)]
    assert "why_guessed" not in describe_shapes(bundle, names, [])


def test_far_shapes_of_an_mjcf_are_noted_and_rails_and_fixed_bodies_may_be_long(tmp_path):
    """A link is guessed beyond 1 m and the distances of all joints, 1.0 m; a rail may be as long as its travel."""
    long = ARM.replace('size="0.06"', 'size="2.5"')
    path = written(tmp_path, long, "far.xml")
    capsules, (note,) = link_capsules(path, load_tree(path))
    assert [one.link for one in capsules] == [
        0,
        0,
    ] and "shapes of fore could not be read: a shape reaches 2.6 m" in note
    rail = long.replace('<joint name="two" axis="1 0.5 0"/>', '<joint name="two" type="slide" range="0 3"/>')
    path = written(tmp_path, rail.replace("<mujoco>", '<mujoco><compiler autolimits="true"/>'), "rail.xml")
    assert link_capsules(path, load_tree(path))[1] == []


def test_shapes_stay_with_a_robot_file_whose_meshes_do_not(tmp_path):
    source, folder = written(tmp_path, ARM, "arm.xml"), tmp_path / "dataset"
    folder.mkdir()
    kept = write_robot(source, folder, {})
    tree = load_tree(source)
    assert link_capsules(kept, tree)[0] == [] or kept.suffix == ".urdf"
    write_shapes(source, folder)
    own, there = link_capsules(source, tree)[0], link_capsules(kept, load_tree(kept))[0]
    for one, other in zip(own, there, strict=True):
        np.testing.assert_allclose(one.start, other.start, atol=1e-6)
        np.testing.assert_allclose(one.end, other.end, atol=1e-6)
        assert (one.link, one.radius_m) == (other.link, other.radius_m)
    (folder / "robot.shapes.json").write_text(json.dumps({"format": 1, "bodies": {"upper": [{"start_m": 1}]}}))
    with pytest.raises(RobotError, match="robot.shapes.json: not a file of shapes"):
        link_capsules(kept, tree)
