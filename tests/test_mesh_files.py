"""Meshes of a URDF: where they are found, that given folders come first, and what is reported where they are not."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from test_capsules import URDF, stl, tube

from tauext.errors import ConfigError
from tauext.robot.capsules import body_capsules, link_capsules, write_shapes
from tauext.robot.mesh_files import MeshFinder, MissingMeshError, expect_meshes, mesh_folders, packages_below
from tauext.robot.read import load_tree

MESH = '<collision><geometry><mesh filename="{}"/></geometry></collision>'
NAME = "package://some_arm/meshes/visual/tube.stl"


@pytest.fixture(autouse=True)
def bare(monkeypatch, tmp_path):
    """No descriptions of this machine."""
    for name in ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path / "no cache"))
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "no prefix"))


def put(path: Path, radius_m: float = 0.05) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(stl(tube(radius_m, 0.4)))
    return path


def arm(folder: Path, *names: str) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "arm.urdf"
    text = URDF.format(more="".join(map(MESH.format, names)))
    path.write_text(text.replace('<geometry><cylinder radius="0.05" length="0.4"/></geometry>', "<geometry/>"))
    return path


def radius_m(path: Path, *given: str) -> float:
    (only,), notes = link_capsules(path, load_tree(path), mesh_folders(given))
    assert notes == []
    return only.radius_m


# --- Where packages are found unasked.


@pytest.mark.parametrize(
    ("place", "variable", "value"),
    [
        ("robots/some_arm", "", ""),
        ("some_arm", "", ""),
        ("src/some_arm", "", ""),
        ("src/repository/some_arm", "", ""),
        ("elsewhere/some_arm", "ROS_PACKAGE_PATH", "nowhere:elsewhere"),
        ("elsewhere/some_arm", "ROS_PACKAGE_PATH", "elsewhere/some_arm"),
        ("elsewhere/src/repository/some_arm", "ROS_PACKAGE_PATH", "elsewhere"),
        ("elsewhere/share/some_arm", "AMENT_PREFIX_PATH", "nowhere:elsewhere"),
        ("elsewhere/example/robots/some_arm", "ROBOT_DESCRIPTIONS_CACHE", "elsewhere"),
    ],
)
def test_packages_are_found_where_descriptions_lie(tmp_path, monkeypatch, place, variable, value):
    path = arm(tmp_path / "mine" / "robots", NAME)
    root = tmp_path / "mine"
    put(root / place / "meshes/visual/tube.stl")
    if variable:
        monkeypatch.setenv(variable, ":".join(str(root / one) for one in value.split(":")))
    assert radius_m(path) == pytest.approx(0.05, rel=0.1)
    shapes = body_capsules(path)
    assert list(shapes.packages.values()) == ([root / place] if variable else [])


@pytest.mark.parametrize("module", ["", "lib/python3/site-packages/example_robot_data/__init__.py"])
@pytest.mark.parametrize(
    "name", ["package://example-robot-data/robots/some_arm/tube.stl", "package://some_arm/tube.stl"]
)
def test_an_installed_example_robot_data_is_found_and_not_imported(tmp_path, monkeypatch, name, module):
    """As the wheel, which holds data only, and as a system's Python package."""
    prefix = tmp_path / ("prefix" if module else "site-packages/cmeel.prefix")
    put(prefix / "share/example-robot-data/robots/some_arm/tube.stl")
    if module:
        (prefix / module).parent.mkdir(parents=True)
        (prefix / module).write_text("raise RuntimeError('imported')")
    monkeypatch.syspath_prepend((prefix / module).parents[1] if module else prefix.parent)
    assert radius_m(arm(tmp_path / "mine", name)) == pytest.approx(0.05, rel=0.1)


# --- Folders that are given.


@pytest.mark.parametrize(
    "given",
    [
        "{0}/some_arm",
        "{0}",
        "{0}/..",
        "{0}/some_arm/meshes",
        "{0}/some_arm/meshes/visual",
        "some_arm={0}/some_arm",
        "some_arm={0}/some_arm/meshes",
    ],
)
def test_a_given_folder_comes_first(tmp_path, given):
    path = arm(tmp_path / "mine", NAME)
    put(tmp_path / "mine/some_arm/meshes/visual/tube.stl", 0.03)
    put(tmp_path / "other/place/some_arm/meshes/visual/tube.stl", 0.06)
    assert radius_m(path) == pytest.approx(0.03, rel=0.1)
    assert radius_m(path, given.format(tmp_path / "other/place")) == pytest.approx(0.06, rel=0.1)


def test_a_given_folder_holds_meshes_without_a_package_too(tmp_path):
    put(tmp_path / "other/meshes/tube.stl")
    for name in ("../meshes/tube.stl", "file:///elsewhere/arm/meshes/tube.stl"):
        path = arm(tmp_path / "mine", name)
        assert len(link_capsules(path, load_tree(path))[1]) == 1
        assert radius_m(path, str(tmp_path / "other")) == pytest.approx(0.05, rel=0.1)


@pytest.mark.parametrize(
    ("given", "names", "words"),
    [
        (["{0}/none"], [NAME], "--meshes {0}/none: there is no folder '{0}/none'; give FOLDER or PACKAGE=FOLDER"),
        (["some_arm="], [NAME], "--meshes some_arm=: there is no folder ''; give FOLDER or PACKAGE=FOLDER"),
        (
            ["{0}/empty"],
            [NAME],
            "--meshes {0}/empty: none of the 1 meshes of arm.urdf is there; " + NAME + " was searched for as "
            "some_arm/meshes/visual/tube.stl, meshes/visual/tube.stl, visual/tube.stl, tube.stl; give the folder of "
            "package some_arm, or one that holds it",
        ),
        (["other={0}/empty"], [NAME], "--meshes other={0}/empty: none of the 1 meshes of arm.urdf is there; " + NAME),
        (["{0}/empty"], ["a/b.stl"], "a/b.stl was searched for as a/b.stl, b.stl; give its folder"),
        (["{0}/empty"], [], "--meshes: {0}/mine/arm.urdf names no mesh; leave --meshes out"),
    ],
)
def test_a_wrong_folder_is_refused_with_what_was_tried(tmp_path, given, names, words):
    (tmp_path / "empty").mkdir()
    path = arm(tmp_path / "mine", *names)
    with pytest.raises(ConfigError) as error:
        expect_meshes(path, mesh_folders([one.format(tmp_path) for one in given]))
    assert words.format(tmp_path) in str(error.value) and "\n" not in str(error.value)


def test_an_mjcf_has_its_own_folder_of_meshes(tmp_path):
    (tmp_path / "arm.xml").write_text("<mujoco/>")
    with pytest.raises(ConfigError, match="names the folder of its meshes itself"):
        expect_meshes(tmp_path / "arm.xml", mesh_folders([str(tmp_path)]))


# --- What cannot be read, and the remedies that are named.


def test_a_format_that_is_not_read_is_named_and_a_readable_file_of_its_name_used(tmp_path):
    path = arm(tmp_path / "mine", "package://some_arm/meshes/visual/tube.ply")
    (_, (missing,)) = link_capsules(path, load_tree(path))
    assert "there is no mesh file package://some_arm/meshes/visual/tube.ply" in missing
    meshes = tmp_path / "mine/some_arm/meshes"
    (meshes / "visual").mkdir(parents=True)
    (meshes / "visual/tube.ply").write_text("ply")
    (capsules, (note,)) = link_capsules(path, load_tree(path))
    assert capsules == [] and note == (
        "shapes of upper could not be read: package://some_arm/meshes/visual/tube.ply: meshes are read from .stl, "
        ".obj, .dae, .msh; put tube.stl or tube.obj beside it or in ../collision"
    )
    put(meshes / "collision/tube.STL", 0.06)
    assert radius_m(path) == pytest.approx(0.06, rel=0.1)
    put(meshes / "visual/tube.stl", 0.05)
    assert radius_m(path) == pytest.approx(0.05, rel=0.1)


def test_shapes_lost_at_import_are_read_later_and_the_others_stay(tmp_path):
    """The dataset's copy of the URDF is not beside the meshes, which are read from its shapes file."""
    source, dataset = arm(tmp_path / "mine", NAME), tmp_path / "data"
    dataset.mkdir()
    text = source.read_text().replace('<link name="base"/>', '<link name="base">{}</link>')
    source.write_text(text.replace("{}", MESH.format("own/tube.stl"), 1))
    put(tmp_path / "mine/own/tube.stl", 0.03)
    kept = dataset / "robot.urdf"
    kept.write_text(source.read_text())
    assert write_shapes(source, dataset).lost == ["upper"]
    tree = load_tree(kept)
    (capsules, (note,)) = link_capsules(kept, tree)
    assert capsules == [] and note == (
        f"shapes of upper could not be read: there is no mesh file {NAME}; give their folder with --meshes FOLDER "
        "(import, train), or put package some_arm beside the robot file"
    )
    put(tmp_path / "elsewhere/some_arm/meshes/visual/tube.stl")
    for words in ("elsewhere", "elsewhere/some_arm", "elsewhere/some_arm/meshes"):
        given = mesh_folders([str(tmp_path / words)])
        expect_meshes(kept, given)
        assert [len(found) for found in link_capsules(kept, tree, given)] == [1, 0]
    earlier = json.loads((dataset / "robot.shapes.json").read_text())
    del earlier["lost"]  # as written before the file listed them
    (dataset / "robot.shapes.json").write_text(json.dumps(earlier))
    assert [len(found) for found in link_capsules(kept, tree, given)] == [1, 0]
    put(dataset / "some_arm/meshes/visual/tube.stl", 0.06)
    assert radius_m(kept) == pytest.approx(0.06, rel=0.1)


# --- Hostile robot files and deep disks.


@pytest.mark.parametrize(
    "name",
    ["package://../secret/tube.stl", "package:///tube.stl", "package://a/../../tube.stl", "package://./tube.stl", ""],
)
def test_a_name_out_of_its_package_is_missing(tmp_path, name):
    put(tmp_path / "tube.stl")
    put(tmp_path / "mine/secret/tube.stl")
    (tmp_path / "mine/a").mkdir(parents=True)
    finder = MeshFinder(arm(tmp_path / "mine/b", name), mesh_folders([str(tmp_path / "mine/a")]))
    with pytest.raises(MissingMeshError, match="there is no mesh file"):
        finder.find(name)


def test_the_search_has_a_bound(tmp_path, monkeypatch):
    """A thousand packages and ten thousand missing files cost as much as a few."""
    deep = tmp_path / "a/b/c/d/some_arm"
    deep.mkdir(parents=True)
    assert list(packages_below(tmp_path, "some_arm")) == []
    assert list(packages_below(tmp_path / "a/b", "some_arm")) == [deep]
    (tmp_path / "a/loop").symlink_to(tmp_path)
    assert list(packages_below(tmp_path, "other")) == []
    monkeypatch.setenv("ROS_PACKAGE_PATH", str(tmp_path))
    listed, scandir = [], __import__("os").scandir
    monkeypatch.setattr("os.scandir", lambda path: listed.append(path) or scandir(path))
    finder, before = MeshFinder(tmp_path / "arm.urdf"), time.process_time()
    for number in range(10_000):
        with pytest.raises(MissingMeshError):
            finder.find(f"package://p{number % 1000}/{number}.stl")
    assert time.process_time() - before < 5
    assert len(listed) < 50 * 200
    wide = tmp_path / "wide"
    for number in range(20):
        (wide / f"{number:02d}").mkdir(parents=True)
    (wide / "19/some_arm").mkdir()
    assert list(packages_below(wide, "some_arm", most_listed=10)) == []


def test_capsules_do_not_depend_on_where_a_mesh_was_found(tmp_path):
    path = arm(tmp_path / "mine", NAME)
    put(tmp_path / "mine/some_arm/meshes/visual/tube.stl")
    near = link_capsules(path, load_tree(path))[0]
    put(tmp_path / "other/tube.stl")
    given = link_capsules(path, load_tree(path), mesh_folders([str(tmp_path / "other")]))[0]
    np.testing.assert_array_equal([near[0].start, near[0].end], [given[0].start, given[0].end])
