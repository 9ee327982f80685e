"""Which tauext does the work: the release, and a digest of all code that decides an output's bytes."""

from __future__ import annotations

import hashlib
from functools import cache
from pathlib import Path

from tauext import _core
from tauext.files.provenance import VERSION

COUNTED = ("files", "robot", "data", "bundle", "check", "fit", "train", "evaluate")
"""Packages whose code decides a task's output, beside the root modules and the stages themselves."""
STAGES = ("fleet/stages.py", "fleet/task.py")
DIGITS = 12


@cache
def build() -> str:
    """As "0.1.0+3f9c0a1be2d4": one release may be built from several states of the code, or for several processors.

    Of libraries only the core's own counts: another NumPy does nothing anew, and stands in each output's provenance.
    """
    root = Path(__file__).parent.parent
    digest = hashlib.sha256(Path(_core.__file__).read_bytes())
    for file in sorted(root.rglob("*.py")):
        name = file.relative_to(root)
        if name.parts[0] in COUNTED or len(name.parts) == 1 or name.as_posix() in STAGES:
            digest.update(f"{name.as_posix()}\0".encode())
            digest.update(file.read_bytes())
    return f"{VERSION}+{digest.hexdigest()[:DIGITS]}"
