"""Who may import whom: the table that keeps the stages apart."""

import ast
from functools import cache
from pathlib import Path

import pytest

SOURCE = Path(__file__).parent.parent / "src" / "tauext"
EVERYTHING = {"*"}
OPEN = {
    "errors",
    "config",
    "recipes",
    "progress",
    "provenance",
    "whole_file",
    "plain_file",
    "room",
    "ties",
    "half_done",
    "caching",
    "bundles",
    "store",
}
"""Standard library, and of the core what knows no NumPy: open to all."""
STAGES = {"robot", "data", "rig", "learn", "calibrate", "train", "refit", "evaluate", "report"}
FLEET = {"_core", "importing", "doctor", "look", "data", "learn", "train", "calibrate", "evaluate"}
# folder or module, or one file of a folder: (ours beside OPEN, outside libraries); only `__main__` imports `cli`.
TABLE = {
    "errors": (set(), set()),
    "config": (set(), set()),
    "recipes": (set(), set()),
    "progress": (set(), set()),
    "provenance": ({"_core"}, set()),
    "whole_file": (set(), set()),
    "half_done": (set(), set()),
    "caching": (set(), set()),
    "plain_file": (set(), set()),
    "bundles": ({"_core"}, set()),
    "room": (set(), set()),
    "ties": (set(), set()),
    "store": (set(), {"pyarrow"}),
    "robot": ({"_core"}, {"numpy", "mujoco"}),
    "robot/capsule_fit": (set(), {"numpy", "scipy"}),
    "data": ({"_core"}, {"numpy", "pyarrow"}),
    "data/importers/ros1": (set(), {"rosbags"}),
    "data/importers/ros2": (set(), {"rosbags", "ruamel"}),
    "data/importers/hdf5": (set(), {"numpy", "h5py"}),
    "data/importers/matlab": (set(), {"numpy", "scipy"}),
    "importing": ({"robot", "data"}, set()),
    "rig": ({"robot", "data"}, {"numpy", "mujoco"}),
    "learn": ({"_core", "robot", "data"}, {"numpy", "scipy"}),
    "learn/torch_backend": ({"_core"}, {"numpy", "torch"}),
    "train": ({"_core", "learn", "calibrate", "look", "robot", "data"}, {"numpy"}),
    "fleet_prior": ({"_core", "train", "learn", "calibrate", "robot", "data"}, {"numpy"}),
    "fleet_report": ({"_core", "robot", "data"}, {"numpy", "scipy"}),
    "calibrate": ({"_core", "look", "robot", "data"}, {"numpy", "scipy"}),
    "refit": ({"_core", "learn", "calibrate", "look", "data"}, {"numpy"}),
    "doctor": ({"_core", "robot", "data"}, {"numpy", "scipy"}),
    "look": ({"doctor", "data"}, {"numpy"}),
    "doctor/picture": ({"data", "report"}, {"numpy", "matplotlib"}),
    "evaluate": ({"_core", "robot", "data", "calibrate"}, {"numpy", "scipy"}),
    "report": ({"data"}, {"numpy", "matplotlib", "jinja2"}),
    "load": ({"_core", "data"}, {"numpy"}),
    "label": ({"_core", "data"}, {"numpy", "pyarrow"}),
    "monitor": ({"_core", "data", "load"}, {"numpy"}),
    "live": ({"_core", "data", "monitor"}, {"numpy"}),
    "live/ur_source": ({"_core", "data", "monitor"}, {"numpy", "rtde_receive", "dashboard_client"}),
    "live/franka_source": ({"_core", "data", "monitor"}, {"numpy", "pylibfranka"}),
    "live/servo_port": (set(), {"serial"}),
    "live/feetech_source": ({"_core", "data"}, {"numpy", "scservo_sdk"}),
    "live/dynamixel_source": ({"_core", "data"}, {"numpy", "dynamixel_sdk"}),
    "live/damiao_source": ({"_core", "data"}, {"numpy", "can"}),
    "ros2": ({"_core", "monitor", "live"}, {"numpy", "cyclonedds"}),
    "demo": ({"_core", "data", "load", "robot", "rig", "train"}, {"numpy", "mujoco"}),
    "demo/page": (set(), {"viser"}),
    "demo/panel": (set(), {"numpy", "viser"}),
    "demo/hand_panel": (set(), {"viser"}),
    "demo/sent_html": (set(), {"viser"}),
    "demo/drawing": (set(), {"numpy", "mujoco", "viser", "trimesh"}),
    "demo/arrow": (set(), {"numpy", "viser", "trimesh"}),
    "demo/place_drawing": (set(), {"numpy", "viser"}),
    "fleet": (FLEET, set()),
    "fleet/ray_workers": (set(), {"ray"}),
    "cli": (EVERYTHING, {"tyro", "rich"}),
    "reproduce": (STAGES, set()),
    "__init__": (STAGES | {"_core"}, set()),
    "__main__": ({"cli"}, set()),
}
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


@pytest.mark.parametrize("part", sorted({part_of(file) for file in FILES}))
def test_files_import_only_what_the_table_allows(part):
    assert part in TABLE, f"{part} is new: say in the table what it may import"
    for file in FILES:
        if part_of(file) == part:
            expect_allowed(file, part)


def expect_allowed(file: Path, part: str) -> None:
    within = file.relative_to(SOURCE).with_suffix("")
    ours, libraries = TABLE.get(within.as_posix(), TABLE[part])
    for name in imports_of(file):
        top, *rest = name.split(".")
        if top == "tauext":
            target = rest[0] if rest else "__init__"
            allowed = ours == EVERYTHING or target in ours | {part} | OPEN
        else:
            allowed = top in STANDARD | libraries
        assert allowed, f"{within} may not import {name}"


def test_nothing_but_the_program_itself_imports_the_command_line():
    assert {name for name, (ours, _) in TABLE.items() if "cli" in ours or ours == EVERYTHING} == {"cli", "__main__"}


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
    """tauext.data.cut of data/cut.py, tauext.data of data/__init__.py."""
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


def test_the_table_names_nothing_that_is_gone():
    assert all((SOURCE / name).is_dir() or (SOURCE / f"{name}.py").is_file() for name in TABLE)
