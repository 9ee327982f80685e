"""Who may import whom: the order of the packages, which keeps the stages apart."""

import ast
from functools import cache
from pathlib import Path

import pytest

SOURCE = Path(__file__).parent.parent / "src" / "tauext"
OPEN = {"errors", "config", "recipes", "progress", "files", "_core"}
"""What every package may import."""
ORDER = {
    "files": {"pyarrow"},
    "robot": {"numpy", "mujoco"},
    "data": {"numpy", "pyarrow"},
    "bundle": {"numpy", "pyarrow"},
    "check": {"numpy", "scipy"},
    "fit": {"numpy", "scipy"},
    "train": {"numpy", "scipy"},
    "monitor": {"numpy"},
    "sources": {"numpy"},
    "evaluate": {"numpy", "scipy"},
    "report": {"numpy", "matplotlib", "jinja2"},
    "fleet": {"numpy", "scipy"},
    "sim": {"numpy", "mujoco"},
    "commission": {"numpy"},
    "page": {"numpy", "aiohttp"},
    "cli": {"tyro", "rich"},
}
"""Packages in order, with their outside libraries: each may import those before it."""
ALSO = {
    "robot/capsules": {"scipy"},
    "data/importers/ros": {"rosbags", "ruamel"},
    "data/importers/ros1_bag": {"rosbags"},
    "data/importers/hdf5": {"h5py", "scipy"},
    "fit/torch_backend": {"torch"},
    "sources/ur": {"rtde_receive"},
    "sources/franka": {"pylibfranka"},
    "sources/servo_bus": {"serial", "scservo_sdk", "dynamixel_sdk"},
    "sources/damiao": {"can"},
    "sources/ros2_messages": {"cyclonedds"},
    "sources/ros2_node": {"cyclonedds"},
    "sources/ros2_publisher": {"cyclonedds"},
    "sources/ros2_source": {"cyclonedds"},
    "sources/lerobot_labels": {"pyarrow"},
    "fleet/ray_workers": {"ray"},
}
"""Libraries that one file of a package imports, and no other."""
ROOT = {"errors", "config", "recipes", "progress"}
STANDARD = set(__import__("sys").stdlib_module_names)


@cache
def imports_in(file: Path) -> list[ast.Import | ast.ImportFrom]:
    """Every import of the file, also inside functions."""
    return [node for node in ast.walk(ast.parse(file.read_text())) if isinstance(node, ast.Import | ast.ImportFrom)]


def imports_of(file: Path) -> set[str]:
    """Dotted names of everything that the file imports."""
    found = set()
    for node in imports_in(file):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: relative imports hide where a name comes from"
            if node.module == "tauext":
                found |= {f"tauext.{alias.name}" for alias in node.names}
            else:
                found.add(node.module)
    return found


def part_of(file: Path) -> str:
    """The folder, or the file that stands beside the folders."""
    return file.relative_to(SOURCE).with_suffix("").parts[0]


FILES = sorted(SOURCE.rglob("*.py"))


def allowed_to(file: Path) -> tuple[set[str], set[str]]:
    """Packages and modules of ours, and outside libraries, that the file may import."""
    part, within = part_of(file), file.relative_to(SOURCE).with_suffix("").as_posix()
    if part in ROOT:
        return ROOT, set()
    if part == "__init__":
        return {"*"}, set()
    if part == "__main__":
        return {"cli"}, set()
    order = list(ORDER)
    return OPEN | set(order[: order.index(part) + 1]), ORDER[part] | ALSO.get(within, set())


@pytest.mark.parametrize("part", sorted({part_of(file) for file in FILES}))
def test_files_import_only_packages_before_their_own(part):
    for file in FILES:
        if part_of(file) == part:
            ours, libraries = allowed_to(file)
            for name in imports_of(file):
                top, *rest = name.split(".")
                if top == "tauext":
                    allowed = "*" in ours or (rest[0] if rest else "__init__") in ours
                else:
                    allowed = top in STANDARD | libraries
                assert allowed, f"{file.relative_to(SOURCE)} may not import {name}"


def test_every_package_stands_in_the_order():
    packages = {file.parent.name for file in SOURCE.glob("*/__init__.py")}
    assert packages == set(ORDER)
    assert {file.stem for file in SOURCE.glob("*.py")} == ROOT | {"__init__", "__main__"}
    assert all((SOURCE / f"{name}.py").is_file() for name in ALSO)


def test_no_file_imports_itself_in_a_circle():
    """Also not inside a function, nor for a type: what is understood alone can be changed alone."""
    modules = {name_of(file): file for file in SOURCE.rglob("*.py")}
    known = {*modules, "tauext._core"}
    left = {name: files_imported(file, known) - {name} for name, file in modules.items()}
    inside = sorted(name for name, needed in left.items() if "tauext" in needed)
    assert not inside, f"the front door is for programs; {inside} are inside"
    while free := {name for name, needed in left.items() if not needed & left.keys()}:
        left = {name: needed for name, needed in left.items() if name not in free}
    circle = {name: sorted(needed & left.keys()) for name, needed in left.items()}
    assert not circle, f"in circles, or on the way to one: {circle}"


def name_of(file: Path) -> str:
    """tauext.data.free_motion of data/free_motion.py, tauext.data of data/__init__.py."""
    return ".".join(["tauext", *file.relative_to(SOURCE).with_suffix("").parts]).removesuffix(".__init__")


def files_imported(file: Path, modules: set[str]) -> set[str]:
    """Modules of ours that the file names in an import; `from tauext.data import cut` means the file cut."""
    found = set()
    for node in imports_in(file):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            names = {f"{node.module}.{alias.name}" for alias in node.names}
            found |= names & modules | ({node.module} if names - modules else set())
    return found & modules


def test_the_circles_test_finds_one(tmp_path):
    (tmp_path / "a.py").write_text("def late():\n    from tauext.cli import main\n")
    assert files_imported(tmp_path / "a.py", {"tauext.cli", "tauext"}) == {"tauext.cli"}
