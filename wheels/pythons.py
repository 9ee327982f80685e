"""Which Python interpreters are here.

    python3 wheels/pythons.py

prints the newest one that tauext supports and that has what a build needs. Any Python 3.7 can run it.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

REQUIRES = re.search(
    r'^requires-python = ">=3\.(\d+),<3\.(\d+)"$',
    (Path(__file__).resolve().parent.parent / "pyproject.toml").read_text(encoding="utf-8"),
    re.MULTILINE,
)
if REQUIRES is None:
    sys.exit('pyproject.toml must have a line such as requires-python = ">=3.11,<3.14"')
SUPPORTED = [f"3.{minor}" for minor in range(int(REQUIRES[1]), int(REQUIRES[2]))]
"""The versions that pyproject.toml names, the oldest first."""
READY = (
    "import ensurepip, os, sys, sysconfig; "
    "headers = os.path.exists(os.path.join(sysconfig.get_path('include'), 'Python.h')); "
    "sys.exit(not headers or sys.version_info[:2] != ({}))"
)
"""What a Python must run: it can make an environment, has headers, and is of this version."""


def find_python(version: str) -> str | None:
    """TAUEXT_PYTHON_3_12, else python3.12 of the PATH where it runs, else pyenv's; None where none has headers."""
    pyenv = Path(pyenv_root()) / "versions"
    named = os.environ.get(variable(version))
    candidates = [named] if named else [f"python{version}", *sorted(map(str, pyenv.glob(f"{version}.*/bin/python3")))]
    return next((python for python in candidates if runs(python, version)), None)


def newest() -> str:
    """The newest supported Python. Ends with one sentence where there is none."""
    found = next(filter(None, map(find_python, reversed(SUPPORTED))), None)
    if found is None:
        sys.exit(
            f"no Python of {', '.join(SUPPORTED)} with venv and headers on the PATH or by pyenv (Debian and Ubuntu: "
            "apt-get install python3-venv python3-dev); make PYTHON=... names another"
        )
    return found


def pyenv_root() -> str:
    """The folder of pyenv, whether it is there or not."""
    return os.environ.get("PYENV_ROOT", str(Path.home() / ".pyenv"))


def variable(version: str) -> str:
    """The name in the environment that says where this Python is."""
    return f"TAUEXT_PYTHON_{version.replace('.', '_')}"


def runs(python: str, version: str) -> bool:
    """Whether it starts, is of that version, and has venv and headers. A shim of pyenv may start nothing."""
    try:
        done = subprocess.run([python, "-c", READY.format(version.replace(".", ", "))], capture_output=True)
    except OSError:
        return False
    return done.returncode == 0


def keep_objects(build: Path) -> None:
    """Let the next Python's build in this folder compile the module alone.

    scikit-build-core removes all objects where it runs from another environment than before, as a file there states.
    Without it they stay, and Ninja compiles those whose command has changed. CMake searches its Python again.
    """
    for name in (".skbuild-info.json", "CMakeCache.txt"):
        (build / name).unlink(missing_ok=True)


if __name__ == "__main__":
    print(newest())
