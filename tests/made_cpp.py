"""Programs against the C++ library: commands, and a build of the library that is made once."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
TOOLS = os.pathsep.join([os.path.dirname(sys.executable), os.environ["PATH"]])
"""cmake and ninja stand beside the Python that the tests run with."""


def run(*command: object, text: str = "") -> tuple[int, list[str], str]:
    """Exit code, lines of stdout, stderr."""
    environment = os.environ | {"PATH": TOOLS}
    done = subprocess.run(
        [str(part) for part in command], input=text, capture_output=True, text=True, env=environment, timeout=300
    )
    return done.returncode, done.stdout.splitlines(), done.stderr


def build(source: Path, folder: Path, *options: str) -> None:
    for command in (
        ("cmake", "-S", source, "-B", folder, "-G", "Ninja", *options),
        ("cmake", "--build", folder),
    ):
        code, out, err = run(*command)
        assert code == 0, "\n".join([*out, err])


def build_of_library(folder: Path) -> Path:
    """A build of the library: that of `make build` if it is up to date, since compiling takes a minute."""
    if shutil.which("g++") is None:
        pytest.skip("C and C++ programs need g++")
    library = ROOT / "build" / "cpp" / "libtauext_core.a"
    sources = [ROOT / "CMakeLists.txt", ROOT / "pyproject.toml", *(ROOT / "cpp" / "src").iterdir()]
    sources += (ROOT / "cpp" / "include" / "tauext").iterdir()
    if library.exists() and library.stat().st_mtime > max(source.stat().st_mtime for source in sources):
        return library.parent
    build(ROOT, folder)
    return folder
