"""README.md and docs/install.md: their commands fit together; `make test-dist` runs them in the sdist."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PAGE = (ROOT / "docs" / "install.md").read_text()
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
FOR_DEVELOPERS = {"dev", "docs", "browser"}


@pytest.fixture
def install_block(monkeypatch) -> Callable[[str], str]:
    monkeypatch.syspath_prepend(str(ROOT / "wheels"))
    return importlib.import_module("try_wheels").install_block


@pytest.fixture
def block(install_block) -> list[str]:
    return [line.strip() for line in install_block(PAGE).splitlines()]


def made_wheel(folder: Path) -> None:
    """A wheel of this version without content."""
    version = PROJECT["version"]
    info = f"tauext-{version}.dist-info"
    folder.mkdir(parents=True)
    with zipfile.ZipFile(folder / f"tauext-{version}-py3-none-any.whl", "w") as wheel:
        wheel.writestr(
            f"{info}/METADATA",
            f"Metadata-Version: 2.1\nName: tauext\nVersion: {version}\n",
        )
        wheel.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        wheel.writestr(f"{info}/RECORD", "")


def test_the_block_makes_an_environment_a_wheel_and_installs_it(block):
    make, activate, wheel, install, run = block
    environment = re.fullmatch(r"python3 -m venv (\S+)", make)[1]
    assert activate == f". {environment}/bin/activate" and run == "tauext --version"
    folder = re.fullmatch(r"pip wheel \. \./packages/lab \./packages/commission --no-deps -w (\S+)", wheel)[1]
    assert install == f"pip install {folder}/tauext*.whl"
    assert f"`{wheel}`" in (ROOT / "CONTRIBUTING.md").read_text()


def test_readme_prints_the_same_commands(block, install_block):
    shorter = install_block((ROOT / "README.md").read_text()).replace(" && ", "\n").splitlines()
    assert [line.strip() for line in shorter] == block[:-1]


def test_pip_takes_the_wheel_as_the_page_names_it_with_an_extra_and_without(block, tmp_path):
    made_wheel(tmp_path / re.search(r"-w (\S+)", "\n".join(block))[1])
    (extra,) = re.findall(r'^    (pip install ".*whl\)\[ur\]")', PAGE, re.MULTILINE)
    for install in (next(line for line in block if line.startswith("pip install ")), extra):
        command = install.replace(
            "pip install ", f"'{sys.executable}' -m pip install --dry-run --no-index --no-deps --target t "
        )
        done = subprocess.run(command, shell=True, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0 and f"Would install tauext-{PROJECT['version']}" in done.stdout, done.stderr


def test_every_extra_for_users_is_in_the_table_and_no_other():
    (table,) = re.findall(r"^\| extra \| library \| adds \|\n(.*?)\n\n", PAGE, re.MULTILINE | re.DOTALL)
    named = {cells[1].strip(" `"): cells[2].strip() for cells in (row.split("|") for row in table.splitlines()[1:])}
    extras = {
        name: re.match(r"\w+", requirement)[0]
        for name, (requirement, *_) in PROJECT["optional-dependencies"].items()
        if name not in FOR_DEVELOPERS | {"all"}
    }
    assert named == extras


def test_the_extra_all_names_every_package():
    projects = [tomllib.loads(path.read_text())["project"]["name"] for path in ROOT.glob("packages/*/pyproject.toml")]
    assert sorted(PROJECT["optional-dependencies"]["all"]) == sorted(name.replace("_", "-") for name in projects)


def test_every_make_target_of_the_page_is_there():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    named = re.findall(r"(?:^    |`)make ([a-z-]+)", PAGE, re.MULTILINE)
    assert len(named) > 4 and set(named) <= targets
