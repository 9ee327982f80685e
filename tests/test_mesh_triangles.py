"""Triangles of mesh files, against the triangles that the files were written from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from test_capsules import TUBE, obj, stl

from tauext.robot.mesh_triangles import triangles_of

QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5]])
POINTS = np.array([[x, y, z] for x in (0, 1) for y in (0, 2) for z in (0, 3)], dtype=float)
IN_QUADS = POINTS[[[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5]]]
"""Two sides of a box as a fan of triangles each."""


def read(folder: Path, name: str, content: bytes | str) -> np.ndarray:
    path = folder / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return triangles_of(path)


def text_stl(corners: np.ndarray) -> str:
    facets = [
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x!r} {y!r} {z!r}\n" for x, y, z in one)
        + "endloop\nendfacet"
        for one in corners.tolist()
    ]
    return "\n".join(["solid tube", *facets, "endsolid"])


def msh(corners: np.ndarray) -> bytes:
    count = 3 * len(corners)
    head, points = np.array([count, 0, 0, len(corners)], dtype="<i4"), corners.astype("<f4")
    return head.tobytes() + points.tobytes() + np.arange(count, dtype="<i4").tobytes()


def test_stl_obj_and_msh_files_have_their_triangles(tmp_path):
    np.testing.assert_allclose(read(tmp_path, "a.stl", stl(TUBE)), TUBE, atol=1e-7)
    np.testing.assert_allclose(read(tmp_path, "b.STL", text_stl(TUBE)), TUBE)
    np.testing.assert_allclose(read(tmp_path, "solid.stl", b"solid" + stl(TUBE)[5:] + b"more"), TUBE, atol=1e-7)
    np.testing.assert_allclose(read(tmp_path, "a.obj", obj(TUBE)), TUBE)
    np.testing.assert_allclose(read(tmp_path, "a.msh", msh(TUBE)), TUBE, atol=1e-7)


def test_every_object_and_polygon_of_an_obj_counts(tmp_path):
    """MuJoCo reads the first object alone. Numbers below zero count from the last point; points carry textures."""
    points = [f"v {x} {y} {z}" for x, y, z in POINTS]
    lines = ["o one", *points[:4], "vt 0 0", "f 1/1 2/1/1 4//1 3", "g two", *points[4:], "f -4 -2 -1 -3", "l 1 2"]
    np.testing.assert_allclose(read(tmp_path, "a.obj", "\n".join(lines)), IN_QUADS)


GROUPS = {
    "polylist": f"<vcount>4 4</vcount><p>{' '.join(f'9 {k}' for k in QUADS.ravel())}</p>",
    "polygons": "".join(f"<p>{' '.join(f'9 {k}' for k in quad)}</p>" for quad in QUADS),
    "trifans": "".join(f"<p>{' '.join(f'9 {k}' for k in quad)}</p>" for quad in QUADS),
    "triangles": "<p>9 0 9 1 9 3 9 0 9 3 9 2</p><p>9 4 9 6 9 7 9 4 9 7 9 5</p>",
}


def dae(kind: str = "triangles", nodes: str = '<node><instance_geometry url="#box"/></node>', asset: str = "") -> str:
    """The two sides, with normals before the points; a second geometry that no node shows."""
    inputs = '<input semantic="NORMAL" source="#n" offset="0"/><input semantic="VERTEX" source="#v" offset="1"/>'
    numbers = " ".join(str(x) for x in POINTS.ravel())
    mesh = f"""<mesh><source id="p"><float_array>{numbers}</float_array></source>
      <source id="n"><float_array>0 0 1</float_array></source>
      <vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
      <{kind}>{inputs}{GROUPS[kind]}</{kind}></mesh>"""
    return f"""<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
      <asset>{asset}</asset>
      <library_geometries>
        <geometry id="box">{mesh}</geometry><geometry id="hidden"><mesh/></geometry>
      </library_geometries>
      <library_visual_scenes>
        <visual_scene id="s">{nodes}</visual_scene><visual_scene id="other"/>
      </library_visual_scenes>
      <scene><instance_visual_scene url="#s"/></scene></COLLADA>"""


@pytest.mark.parametrize("kind", GROUPS)
def test_collada_polygons_are_fans_of_triangles(tmp_path, kind):
    np.testing.assert_allclose(read(tmp_path, "a.dae", dae(kind)), IN_QUADS)


def test_collada_nodes_place_their_geometry_and_the_unit_scales_it(tmp_path):
    """A point p of the inner node is at 0.01 (T R S (M p)); the up axis changes nothing."""
    inner = '<node><matrix>1 0 0 5 0 1 0 0 0 0 1 0 0 0 0 1</matrix><instance_geometry url="#box"/></node>'
    place = "<translate>0 0 7</translate><rotate>0 0 2 90</rotate><scale>1 -2 1</scale>"
    nodes = f'<node id="a">{place}{inner}</node><node><instance_node url="#a"/></node>'
    asset = '<unit name="centimeter" meter="0.01"/><up_axis>Y_UP</up_axis>'
    moved = (IN_QUADS + [5, 0, 0]) * [1, -2, 1]
    turned = np.stack([-moved[..., 1], moved[..., 0], moved[..., 2]], axis=-1) + [0, 0, 7]
    found = read(tmp_path, "a.dae", dae(nodes=nodes, asset=asset))
    np.testing.assert_allclose(found, 0.01 * np.tile(turned, (2, 1, 1)), atol=1e-12)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("a.stl", b""),
        ("a.stl", stl(TUBE)[:-60]),
        ("a.stl", stl(TUBE * np.nan)),
        ("a.obj", "v 0 0 0\n"),
        ("a.obj", "v 0 0 0\nf 1 2 3\n"),
        ("a.msh", msh(TUBE)[:-5]),
        ("a.dae", "<COLLADA/>"),
        ("a.dae", dae()[:-20]),
        ("a.dae", dae(nodes='<node><instance_geometry url="#none"/></node>')),
        ("a.dae", dae(nodes='<node id="a"><instance_node url="#a"/></node>')),
        ("a.dae", dae(nodes='<node><skew>1 2 3</skew><instance_geometry url="#box"/></node>')),
    ],
)
def test_a_damaged_file_is_refused_by_name(tmp_path, name, content):
    with pytest.raises(ValueError, match=f"^{name} is no mesh that can be read$"):
        read(tmp_path, name, content)
