"""Bundles from their files."""

from __future__ import annotations

from pathlib import Path

from tauext import _core
from tauext.errors import BundleError


def load_bundle(path: Path | str) -> _core.Bundle:
    """The bundle in a file NAME.tauext, checked and its reference replayed; `Bundle.save` writes one.

    Raises:
        BundleError: there is no such file.
        CoreError: damaged, of another format, or with torque constants that its loop had to apply (`tauext convert`).
    """
    if not Path(path).is_file():
        raise BundleError(f"{path}: there is no such bundle; `tauext train` makes one")
    return _core.Bundle.load(str(path))
