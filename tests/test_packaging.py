"""Files for package systems that cannot run here: they parse, and agree with pyproject.toml and with each other."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import pytest
from made_cpp import ROOT, build_of_library, run
from ruamel.yaml import YAML

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
NAME, VERSION = PROJECT["project"]["name"], PROJECT["project"]["version"]
PYTHONS = ["3.11", "3.12", "3.13"]
PACKAGES = [ROOT / "packages" / name / "package.xml" for name in ("tauext_vendor", "ros2_control")]
WORKFLOW = ROOT / ".github" / "workflows" / "wheels.yml"
RECIPE = ROOT / "packaging" / "conda" / "recipe.yaml"
ROSDEP = ROOT / "packaging" / "rosdep" / "tauext.yaml"
OF_CONDA = {"mujoco": "mujoco-python", "matplotlib": "matplotlib-base", "jinja2": "jinja2"}
"""Names of packages that conda-forge gives other names than pip's indexes do."""


def read(path: Path) -> dict:
    return YAML(typ="safe").load(path.read_text())


def of_conda(requirement: str) -> str:
    name, limits = re.fullmatch(r"([\w-]+)(.*)", requirement).groups()
    return f"{OF_CONDA.get(name.lower(), name.lower())} {limits}"


def limits_of_python() -> tuple[str, str]:
    return re.fullmatch(r">=([\d.]+),<([\d.]+)", PROJECT["project"]["requires-python"]).groups()


def test_the_pythons_that_pyproject_allows_are_those_that_wheels_are_made_and_tried_for(monkeypatch):
    first, end = (int(version.partition(".")[2]) for version in limits_of_python())
    assert [f"3.{minor}" for minor in range(first, end)] == PYTHONS
    monkeypatch.syspath_prepend(str(ROOT / "wheels"))
    assert __import__("pythons").SUPPORTED == PYTHONS
    (wheels,) = (step["env"] for step in read(WORKFLOW)["jobs"]["wheels"]["steps"] if "env" in step)
    assert wheels["CIBW_BUILD"].split() == [f"cp{version.replace('.', '')}-*" for version in PYTHONS]
    for page in ("docs/install.md",):
        assert f"Python {PYTHONS[0]} to {PYTHONS[-1]}" in (ROOT / page).read_text()


def test_the_workflow_pins_what_it_uses_and_may_only_read():
    workflow = read(WORKFLOW)
    assert workflow["permissions"] == {"contents": "read"}
    steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
    uses = {step["uses"] for step in steps if "uses" in step}
    assert uses and all(re.fullmatch(r"actions/[a-z-]+@[0-9a-f]{40}", one) for one in uses)
    installs = [words for step in steps for words in re.findall(r"pip install (.*)", step.get("run", ""))]
    assert installs and all("-c constraints.txt" in words or "==" in words for words in installs)


def test_the_workflow_and_the_page_state_where_wheels_are_made_and_where_not():
    jobs = read(WORKFLOW)["jobs"]
    for job in ("core", "wheels"):
        runners = jobs[job]["strategy"]["matrix"]["runner"]
        assert runners == ["ubuntu-24.04", "ubuntu-24.04-arm", "macos-15", "macos-15-intel"]
    part = (ROOT / "docs" / "install.md").read_text().partition("## Platforms")[2].partition("\n## ")[0]
    rows = {row.split("|")[1].strip(): row for row in part.splitlines() if row.startswith("| ")}
    assert "never compiled" in rows["macOS, x86-64 and Arm"] and "cannot work" in rows["Windows"]
    comment = WORKFLOW.read_text().partition("\nname: ")[0]
    assert "never compiled" in comment and "it cannot work" in comment


def test_the_recipe_of_conda_has_the_version_the_requirements_and_the_licences_of_pyproject():
    recipe, project = read(RECIPE), PROJECT["project"]
    assert recipe["context"] == {"name": NAME, "version": VERSION}
    folders = re.findall(r"\./(packages/\w+)", recipe["build"]["script"])
    packages = [tomllib.loads((ROOT / folder / "pyproject.toml").read_text())["project"] for folder in folders]
    needed = [one for part in (project, *packages) for one in part["dependencies"] if not one.startswith(NAME)]
    assert len(packages) == 2 and recipe["requirements"]["run"] == ["python", *dict.fromkeys(map(of_conda, needed))]
    assert set(map(of_conda, PROJECT["build-system"]["requires"])) < set(recipe["requirements"]["host"])
    assert recipe["about"]["license"] == project["license"]
    assert recipe["about"]["license_file"] == project["license-files"]
    assert recipe["about"]["summary"] == project["description"]
    first, end = limits_of_python()
    assert recipe["build"]["skip"] == ["win", f'match(python, "<{first}")', f'match(python, ">={end}")']
    assert (RECIPE.parent / recipe["source"]["path"]).resolve() == ROOT
    commands = next(test["script"] for test in recipe["tests"] if "script" in test)
    assert {command.split()[0] for command in commands} <= set(project["scripts"])


def test_the_keys_of_rosdep_name_packages_of_this_repository():
    projects = [PROJECT] + [
        tomllib.loads((ROOT / "packages" / name / "pyproject.toml").read_text()) for name in ("ros2",)
    ]
    keys = read(ROSDEP)
    assert keys == {
        f"python3-{project['project']['name']}-pip": {
            system: {"pip": {"packages": [project["project"]["name"]]}} for system in ("debian", "fedora", "ubuntu")
        }
        for project in projects
    }


@pytest.mark.parametrize("path", PACKAGES, ids=lambda path: path.parent.name)
def test_a_ros_package_has_the_version_of_pyproject_and_finds_what_it_depends_on(path):
    package = ElementTree.parse(path).getroot()
    order = ["name", "version", "description", "maintainer", "license", "buildtool_depend", "depend", "export"]
    assert package.get("format") == "3" and sorted({one.tag for one in package}, key=order.index) == list(
        dict.fromkeys(one.tag for one in package)
    )
    assert package.findtext("version") == VERSION and package.findtext("license") == PROJECT["project"]["license"]
    cmake = (path.parent / "CMakeLists.txt").read_text()
    assert package.findtext("name") == re.search(r"^project\((\w+) ", cmake, re.MULTILINE)[1]
    found = re.findall(r"find_package\((\w+)[^)]*REQUIRED\)", cmake)
    depends = [one.text for one in package if one.tag.endswith("depend")]
    assert sorted(set(found) - {NAME}) == sorted(depends)
    versions = re.findall(rf"find_package\({NAME} ([\d.]+)", cmake)
    assert all(VERSION.startswith(f"{version}.") for version in versions)


def vendored(tmp_path: Path, *options: object) -> dict[str, str]:
    """Arguments of ament_vendor, by a mock that takes the documented ones, after tauext_vendor has been configured."""
    macro = (
        "macro(ament_vendor name)\n"
        '  cmake_parse_arguments(_ARG "GLOBAL_HOOK;SKIP_INSTALL" '
        '"SOURCE_SUBDIR;VCS_TYPE;VCS_URL;VCS_VERSION;SATISFIED" "CMAKE_ARGS;PATCHES" ${ARGN})\n'
        '  file(WRITE ${CMAKE_BINARY_DIR}/arguments "name=${name}\\nunknown=${_ARG_UNPARSED_ARGUMENTS}\\n'
        'type=${_ARG_VCS_TYPE}\\nurl=${_ARG_VCS_URL}\\nsatisfied=${_ARG_SATISFIED}\\noptions=${_ARG_CMAKE_ARGS}\\n")\n'
        "endmacro()\n"
    )
    mocks = {"ament_cmake": "function(ament_package)\nendfunction()\n", "ament_cmake_vendor_package": macro}
    for name, text in mocks.items():
        folder = tmp_path / "ros" / "lib" / "cmake" / name
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}Config.cmake").write_text(text)
    built = tmp_path / "built"
    configure = ("cmake", "-S", PACKAGES[0].parent, "-B", built, f"-DCMAKE_PREFIX_PATH={tmp_path / 'ros'}")
    code, out, err = run(*configure, *options)
    if code:
        return {"error": " ".join(err.split())}
    return dict(line.split("=", 1) for line in (built / "arguments").read_text().splitlines())


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")
def test_the_vendor_package_builds_the_library_of_this_source_tree_or_uses_an_installed_one(tmp_path):
    made = vendored(tmp_path)
    assert (made["name"], made["unknown"], made["type"], made["satisfied"]) == (NAME, "", "path", "0")
    assert Path(made["url"]) == ROOT
    cmake = (ROOT / "CMakeLists.txt").read_text()
    options = [re.fullmatch(r"-D(\w+)=OFF", one)[1] for one in made["options"].split(";")]
    assert options and all(f"option({one} " in cmake for one in options)

    code, _, err = run("cmake", "--install", build_of_library(tmp_path / "library"), "--prefix", tmp_path / "there")
    assert code == 0, err
    assert vendored(tmp_path, f"-Dtauext_ROOT={tmp_path / 'there'}")["satisfied"] == "1"

    refused = vendored(tmp_path, f"-DTAUEXT_SOURCE={tmp_path}")["error"]
    assert f"TAUEXT_SOURCE = {tmp_path} must be the source folder of tauext" in refused


def test_no_file_advises_to_install_by_a_name_that_no_index_has():
    if not (ROOT / ".git").exists():
        pytest.skip("needs git's list of files")
    names = {NAME} | {
        tomllib.loads(path.read_text())["project"]["name"] for path in (ROOT / "packages").glob("*/pyproject.toml")
    }
    advice = re.compile(rf"pip3? install (?:-\S+ )*['\"]?(?:{'|'.join(map(re.escape, names))})(?![\w./-])")
    texts = [
        name for name in of_git() if name.endswith((".md", ".py", ".toml", ".yml", ".yaml", ".txt", ".cpp", ".xml"))
    ]
    assert len(texts) > 300
    assert not [name for name in texts if advice.search((ROOT / name).read_text(errors="replace"))]


@pytest.mark.slow
def test_the_sdist_has_the_files_of_the_repository_and_nothing_beside_them(tmp_path):
    if not (ROOT / ".git").exists():
        pytest.skip("needs git's list of files")
    code = "import sys; from scikit_build_core.build import build_sdist; print(build_sdist(sys.argv[1]))"
    subprocess.run([sys.executable, "-c", code, tmp_path], cwd=ROOT, check=True, capture_output=True)
    with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as archive:
        held = {one.name.partition("/")[2] for one in archive if one.isfile()}
    left_out = tuple(f"{folder}/" for folder in PROJECT["tool"]["scikit-build"]["sdist"]["exclude"])
    assert {"docs/results/", ".ci/", "runs/"} <= set(left_out)
    wanted = {name for name in of_git() if not name.startswith(left_out)}
    assert wanted <= held and held - wanted - set(of_git("--others", "--exclude-standard")) == {"PKG-INFO"}


def of_git(*options: str) -> list[str]:
    """Files of the repository that are there."""
    command = ["git", "ls-files", "-z", *options]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [name for name in listed.split("\0") if name and (ROOT / name).exists()]
