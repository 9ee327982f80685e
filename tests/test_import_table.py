"""Who may import whom: the order of the packages and of the layers of the C++ core, which keeps the parts apart."""

import ast
import re
import tomllib
from functools import cache
from pathlib import Path

import pytest

SOURCE = Path(__file__).parent.parent / "src" / "tauext"
OPEN = {"errors", "config", "recipes", "progress", "plugins", "files", "_core"}
"""What every package may import."""
ORDER = {
    "files": set(),
    "robot": {"numpy", "mujoco"},
    "data": {"numpy", "pyarrow"},
    "bundle": {"numpy", "pyarrow"},
    "check": {"numpy", "scipy"},
    "fit": {"numpy", "scipy"},
    "train": {"numpy", "scipy"},
    "monitor": {"numpy"},
    "sources": {"numpy"},
    "cli": {"tyro", "rich"},
}
"""Packages in order, with their outside libraries: each may import those before it."""
ALSO = {
    "robot/capsules": {"scipy"},
    "data/importers/ros": {"rosbags", "ruamel"},
    "data/importers/bag": {"rosbags"},
    "data/importers/hdf5": {"h5py", "scipy"},
    "sources/ur": {"rtde_receive"},
    "sources/franka": {"pylibfranka"},
}
"""Libraries that one file of a package imports, and no other."""
ROOT = {"errors", "config", "recipes", "progress", "plugins"}
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
    assert not in_circles(left)


def in_circles(needed: dict[str, set[str]]) -> dict[str, list[str]]:
    """What needs itself in a circle, or is on the way to one, with what it needs of that."""
    left = dict(needed)
    while free := {name for name, others in left.items() if not others & left.keys()}:
        left = {name: others for name, others in left.items() if name not in free}
    return {name: sorted(others & left.keys()) for name, others in left.items()}


def name_of(file: Path, root: Path = SOURCE) -> str:
    """tauext.data.free_motion of data/free_motion.py, tauext.data of data/__init__.py; root: folder of the package."""
    return ".".join([root.name, *file.relative_to(root).with_suffix("").parts]).removesuffix(".__init__")


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


PROJECTS = {
    project.parent: tomllib.loads(project.read_text())
    for project in sorted((SOURCE.parents[1] / "packages").glob("*/pyproject.toml"))
}
"""What the pyproject.toml of each package beside tauext states, by its folder."""
PACKAGES = {
    name.partition(".")[0]: folder / name.partition(".")[0]
    for folder, stated in PROJECTS.items()
    for name in stated["tool"]["setuptools"]["packages"]
}
"""Folders of packages of their own beside tauext, by name."""


def needed_by(folder: Path) -> set[str]:
    """Names of the packages beside tauext that a package depends on, as its pyproject.toml states."""
    wanted = {re.split(r"[<>=; \[]", one)[0] for one in PROJECTS[folder]["project"]["dependencies"]}
    ours = {stated["project"]["name"]: other for other, stated in PROJECTS.items()}
    return {name for name, root in PACKAGES.items() if root.parent in {ours[one] for one in wanted & ours.keys()}}


def top_names(file: Path) -> set[str]:
    return {name.partition(".")[0] for name in imports_of(file)}


@pytest.mark.parametrize("package", PACKAGES)
def test_a_package_imports_of_others_those_it_depends_on_and_no_file_of_its_own_in_a_circle(package):
    root = PACKAGES[package]
    modules = {name_of(file, root): file for file in root.rglob("*.py")}
    others = {name for name, folder in PACKAGES.items() if folder.parent != root.parent}
    assert {top for file in modules.values() for top in top_names(file)} & others <= needed_by(root.parent)
    assert not in_circles({name: files_imported(file, {*modules}) - {name} for name, file in modules.items()})


def test_packages_depend_on_each_other_in_no_circle():
    needed = {name: needed_by(root.parent) for name, root in PACKAGES.items()}
    assert needed["tauext_commission"] == {"tauext_lab"} and not in_circles(needed)


def test_tauext_imports_none_of_its_packages():
    """It finds them by their entry points."""
    assert not {top for file in FILES for top in top_names(file)} & PACKAGES.keys()


def test_the_circles_test_finds_one(tmp_path):
    (tmp_path / "a.py").write_text("def late():\n    from tauext.cli import main\n")
    assert files_imported(tmp_path / "a.py", {"tauext.cli", "tauext"}) == {"tauext.cli"}
    assert in_circles({"a": {"b", "c"}, "b": {"a"}, "c": set()}) == {"a": ["b"], "b": ["a"]}


CPP = SOURCE.parents[1] / "cpp"
PUBLIC = {
    "bundle": {"types.hpp", "link.hpp", "load.hpp", "settings.hpp", "bundle.hpp"},
    "chain": {"sample.hpp", "tree.hpp", "servo_input.hpp"},
    "alarm": {"estimate.hpp"},
    "touch": {"wrench.hpp", "touch_place.hpp", "declared_contact.hpp"},
    "fit": {"refit.hpp"},
    "api": {"monitor.hpp", "flight_recorder.hpp", "tauext.h"},
}
"""Layers of the headers of cpp/include/tauext, which stand in one folder."""


def table_of_layers() -> dict[str, tuple[bool, set[str]]]:
    """Layers in the order of the table in architecture.md: whether one is optional, and what it may include."""
    text = (SOURCE.parents[1] / "docs" / "architecture.md").read_text().partition("## Layers of the core")[2]
    rows = [line.split("|") for line in text.partition("\n## ")[0].splitlines() if line.startswith("| `")]
    return {row[1].split("`")[1]: ("optional" in row[1], set(re.findall(r"`(.*?)`", row[3]))) for row in rows}


LAYERS = table_of_layers()


def layer_of(file: Path) -> str:
    """Folder of a file of the core; of a public header its layer."""
    if file.parent.name == "tauext":
        return next(layer for layer, names in PUBLIC.items() if file.name in names)
    return file.parent.name


def files_included(file: Path) -> set[Path]:
    """Files of the core that it includes; they are named from cpp/src, from cpp/include or from their own folder."""
    names = re.findall(r'^\s*#\s*include\s*["<](.+?)[">]', file.read_text(), re.MULTILINE)
    places = (CPP / "src", CPP / "include", file.parent)
    return {place / name for name in names for place in places if (place / name).is_file()}


CORE = {
    file: files_included(file)
    for folder in ("src", "include", "learn")
    for file in sorted((CPP / folder).rglob("*"))
    if file.suffix in (".cpp", ".hpp", ".h")
}


def test_every_file_of_the_core_is_in_a_layer_of_the_table():
    assert {layer_of(file) for file in CORE} == set(LAYERS)
    assert sorted(name for names in PUBLIC.values() for name in names) == sorted(
        file.name for file in (CPP / "include" / "tauext").iterdir()
    )
    assert len(CORE) > 80 and sum(map(len, CORE.values())) > 200


@pytest.mark.parametrize("layer", LAYERS)
def test_layers_include_what_their_row_allows_and_need_all_of_it(layer):
    others = {other for file, needed in CORE.items() if layer_of(file) == layer for other in needed}
    named = {other: f"{other.parent.name}/{other.name}" for other in others}
    used = {named[other] if named[other] in LAYERS[layer][1] else layer_of(other) for other in others}
    assert used - {layer} == LAYERS[layer][1]


def test_layers_include_layers_above_them_in_the_table_and_optional_ones_by_named_headers():
    before: dict[str, bool] = {}
    for layer, (optional, allowed) in LAYERS.items():
        headers = {name for name in allowed if "/" in name}
        assert allowed - headers <= set(before), layer
        assert optional or not any(before[name] for name in allowed - headers), f"{layer} is not optional"
        for name in headers:
            header = next(CPP / part / name for part in ("src", "include") if (CPP / part / name).is_file())
            assert before[layer_of(header)], f"{layer} names {name}, whose layer is not optional or stands below"
        before[layer] = optional
    assert sum(before.values()) > 2


def test_no_file_of_the_core_includes_itself_in_a_circle():
    assert not in_circles({str(file): set(map(str, needed)) for file, needed in CORE.items()})
