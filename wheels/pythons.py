"""Which Python interpreters are here."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path


def find_python(version: str) -> str | None:
    """TAUEXT_PYTHON_3_12, else python3.12 of the PATH where it runs, else pyenv's; None where there is none."""
    pyenv = Path(pyenv_root()) / "versions"
    named = os.environ.get(variable(version))
    candidates = [named] if named else [f"python{version}", *sorted(map(str, pyenv.glob(f"{version}.*/bin/python3")))]
    return next((python for python in candidates if runs(python, version)), None)


def pyenv_root() -> str:
    """The folder of pyenv, whether it is there or not."""
    return os.environ.get("PYENV_ROOT", str(Path.home() / ".pyenv"))


def variable(version: str) -> str:
    """The name in the environment that says where this Python is."""
    return f"TAUEXT_PYTHON_{version.replace('.', '_')}"


def runs(python: str, version: str) -> bool:
    """Whether it starts and is of that version; those that pyenv puts on the PATH may only say that none is chosen."""
    try:
        done = subprocess.run([python, "--version"], capture_output=True, text=True)
    except OSError:
        return False
    return done.returncode == 0 and done.stdout.startswith(f"Python {version}.")
