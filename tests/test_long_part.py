"""make test-all: a test that fails and then passes alone is unstable; a part ends all that it started."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PYPROJECTS = [ROOT / "pyproject.toml", *sorted(ROOT.glob("packages/*/pyproject.toml"))]
PYPROJECTS += sorted(ROOT.glob("examples/*/pyproject.toml"))

FLAKY = """
import pathlib, pytest
def test_once(): assert True
@pytest.mark.parametrize("name", ["of two words"])
def test_unstable(name):
    mark = pathlib.Path(__file__).with_name("tried")
    assert mark.exists() or mark.touch()
"""


@pytest.fixture(scope="module")
def long_part():
    spec = importlib.util.spec_from_file_location("long_part", ROOT / "tests" / "long_part.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules["long_part"] = module  # where dataclasses look for their types
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def run(long_part, monkeypatch, tmp_path):
    """A run of a part without a time limit, on the tests of a folder of its own."""
    monkeypatch.setattr(long_part, "LOGS", tmp_path)
    (tmp_path / "pytest.ini").write_text("[pytest]\n")
    (tmp_path / "made.log").touch()
    return long_part.Run("made", tmp_path / "made.log", 300.0)


def test_a_test_that_fails_once_and_passes_alone_is_listed_as_unstable_with_its_reason(run):
    folder = run.log.parent
    (folder / "test_made.py").write_text(FLAKY)
    run.pytest("not slow", "--rootdir", folder, "-c", folder / "pytest.ini", folder, venv=Path(sys.prefix), workers="0")
    (line,) = run.unstable
    assert line.partition("::")[2].startswith("test_unstable[of two words]: AssertionError: assert (False or None)")
    assert run.notes == ["1 failed, 1 passed"]


def test_a_part_past_its_limit_fails_and_leaves_no_process(run, long_part):
    run.limit_s = 0.5
    child = run.log.with_name("child")
    with pytest.raises(long_part.Failed, match="past its limit"):
        run.command(["sh", "-c", f"sleep 100 & echo $! > '{child}'; wait"])
    status = Path(f"/proc/{child.read_text().strip()}/stat")
    for _ in range(100):  # the system may take a moment
        if not status.exists() or status.read_text().split()[2] == "Z":
            return
        time.sleep(0.05)
    pytest.fail("the child still runs")


@pytest.mark.parametrize("path", PYPROJECTS, ids=lambda path: path.parent.name)
def test_every_package_names_the_pythons_that_are_tested(path):
    wanted = tomllib.loads(PYPROJECTS[0].read_text())["project"]["requires-python"]
    assert tomllib.loads(path.read_text())["project"]["requires-python"] == wanted


def test_the_table_of_contributing_has_every_part(long_part):
    text = (ROOT / "CONTRIBUTING.md").read_text().partition("| part |")[2].partition("\n\n")[0]
    parts = [re.sub(r"^python3\.\d+$", "python3.x", name) for name in long_part.PARTS]
    assert re.findall(r"^\| `([\w.]+)`", text, re.MULTILINE) == list(dict.fromkeys(parts))


def made_python(folder: Path, version: str, headers: bool) -> None:
    """A program that answers as a Python of this version would, with headers or without."""
    path = folder / f"python{version}"
    path.write_text(
        f"#!/bin/sh\ncase \"$2\" in *'({version.replace('.', ', ')})'*) exit {int(not headers)};; esac\nexit 1\n"
    )
    path.chmod(0o755)


@pytest.mark.parametrize(
    ("ready", "found"),
    [({"3.11": True, "3.12": True}, "3.12"), ({"3.11": True, "3.13": False}, "3.11"), ({}, None)],
)
def test_make_setup_takes_the_newest_python_that_has_headers_or_names_what_it_needs(tmp_path, ready, found):
    settings = {"PATH": f"{tmp_path}:/usr/bin:/bin", "PYENV_ROOT": str(tmp_path), "HOME": str(tmp_path)}
    for minor in (11, 12, 13):  # a Python of this machine is never found
        version = f"3.{minor}"
        settings[f"TAUEXT_PYTHON_3_{minor}"] = f"python{version}" if version in ready else str(tmp_path / "none")
    for version, headers in ready.items():
        made_python(tmp_path, version, headers)
    words = [sys.executable, ROOT / "wheels" / "pythons.py"]
    done = subprocess.run(words, env=settings, capture_output=True, text=True)
    if found:
        assert done.stdout.strip() == f"python{found}", done.stderr
        return
    assert done.returncode == 1 and len(done.stderr.splitlines()) == 1
    assert "3.11, 3.12, 3.13" in done.stderr and "python3-dev" in done.stderr
