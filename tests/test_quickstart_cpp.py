"""docs/quickstarts/cpp.md: the printed program and CMakeLists.txt, built and run by the printed commands."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import pytest
from made_bundles import watching_bundle
from made_cpp import ROOT, TOOLS, build_of_library

pytestmark = pytest.mark.slow  # compiles a program
PAGE = (ROOT / "docs" / "quickstarts" / "cpp.md").read_text()


def printed(language: str) -> str:
    """The page's only block in this language."""
    (block,) = re.findall(rf"^```{language}\n(.*?)^```$", PAGE, flags=re.MULTILINE | re.DOTALL)
    return block


def commands(begin: str, end: str) -> list[str]:
    """Those between two headings."""
    part = PAGE[PAGE.index(f"## {begin}") : PAGE.index(f"## {end}")]
    return [line for line in re.findall(r"^    (\S.*)$", part, re.MULTILINE) if not line.startswith("sudo ")]


@pytest.fixture(scope="module")
def project(tmp_path_factory) -> Path:
    """The folder of the printed files, after the printed commands up to the program."""
    build = build_of_library(tmp_path_factory.mktemp("library"))
    folder = tmp_path_factory.mktemp("project")
    (folder / "main.cpp").write_text(printed("cpp"))
    (folder / "CMakeLists.txt").write_text(printed("cmake"))
    compile_library, install = commands("Install the library", "Write the program")
    assert compile_library.count("build/cpp") == 2  # done above, where the build is not up to date
    assert "--install build/cpp " in install
    *build_program, _ = commands("Build and run", "Rules for the loop")
    assert len(build_program) == 2
    for command in (install.replace("build/cpp", f"'{build}'"), *build_program):
        done = shell(command, folder)
        assert done.returncode == 0, done.stdout + done.stderr
    return folder


def shell(command: str, folder: Path) -> subprocess.CompletedProcess:
    environment = os.environ | {
        "HOME": str(folder / "home"),
        "PATH": TOOLS,
        "CMAKE_GENERATOR": "Ninja",
        "CXXFLAGS": "-Wall -Wextra -Werror",
    }
    return subprocess.run(command, shell=True, cwd=folder, env=environment, capture_output=True, text=True, timeout=300)


def test_the_printed_program_runs_with_the_printed_commands(project):
    watching_bundle().save(str(project / "arm.tauext"))
    done = shell(commands("Build and run", "Rules for the loop")[-1], project)
    assert done.returncode == 0, done.stderr
    *units, last = done.stdout.splitlines()
    assert units == ["shoulder: tau in N m", "elbow: tau in N m"]
    assert re.fullmatch(r"health (ok|fault|stale|warming up), alarm (none|contact|collision)", last)


def test_a_missing_bundle_is_one_line_and_status_two(project):
    done = shell("build/controller none.tauext", project)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.count("\n") == 1 and "none.tauext" in done.stderr


def test_without_the_prefix_path_the_package_is_not_found_as_the_page_states(project):
    *_, configure = (c for c in commands("Build and run", "Rules for the loop") if "CMAKE_PREFIX_PATH" in c)
    done = shell(re.sub(r" -DCMAKE_PREFIX_PATH=\S+", "", configure).replace("build", "other"), project)
    if done.returncode == 0:
        pytest.skip("a tauext is installed in a system folder")
    assert "tauextConfig.cmake" in done.stderr
