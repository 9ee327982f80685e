"""Copies on this machine of what cannot be read by ranges: bundles, robot files, bags."""

from __future__ import annotations

import atexit
import glob
import os
import shutil
import tempfile
from functools import cache
from pathlib import Path
from typing import overload

from tauext.errors import StoreError
from tauext.files.named_files import named_files
from tauext.files.place import Place
from tauext.files.reading import reading, version_of
from tauext.files.stored import StoredPlace

BLOCK = 8 << 20
COPIES: dict[StoredPlace, tuple[str, Path]] = {}
"""What this process fetched: which version, and where it lies."""


@overload
def local_file(place: Place) -> Path: ...
@overload
def local_file(place: None) -> None: ...


def local_file(place: Place | None) -> Path | None:
    """A path of this file: itself, or a copy of the same name that goes when the process ends. None stays None.

    A place where nothing is, or a folder, gives a path where nothing is.

    Raises:
        StoreError: the store cannot be reached, refuses or stalls; no disk is left.
    """
    if not isinstance(place, StoredPlace):
        return place
    try:
        there = version_of(place)
    except FileNotFoundError:
        return all_copies(os.getpid()) / "nothing" / place.name
    known = COPIES.get(place)
    if known is None or known[0] != there:
        path = copy_of(place)
        fetch(place, path)
        COPIES[place] = known = (there, path)
    return known[1]


def local_folder(place: Place) -> Path:
    """The same of a folder with all that is in it, or of a file.

    Raises:
        StoreError: as local_file.
    """
    if not isinstance(place, StoredPlace):
        return place
    files = [found for found in place.rglob("*") if found.is_file()]
    if not files:
        return local_file(place)
    folder = copy_of(place)
    expect_disk(place, folder, sum(file.stat().st_size for file in files))
    for file in files:
        path = folder / file.relative_to(place)
        path.parent.mkdir(parents=True, exist_ok=True)
        fetch(file, path)
    return folder


def local_beside(place: Place) -> Path:
    """The same of a file and of all beside it whose names begin like its own: NAME.run.json of NAME.tauext."""
    if not isinstance(place, StoredPlace):
        return place
    for file in place.parent.glob(f"{glob.escape(place.stem)}.*"):
        local_file(file)
    return local_file(place)


def local_robot(place: Place) -> Path:
    """A path of this robot file; of a store, what it names is copied, too, and lies to it as it does there."""
    if not isinstance(place, StoredPlace):
        return place
    for file in named_files(place):
        local_file(file)
    return local_file(place)


def fetch(place: StoredPlace, path: Path) -> None:
    """The whole file, to this path; under a temporary name first."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    with reading(place) as file, part.open("wb") as out:
        while block := file.read(BLOCK):
            out.write(block)
    changed_ns = place.stat().st_mtime_ns
    os.utime(part, ns=(changed_ns, changed_ns))  # the newest of a folder is so here, too
    os.replace(part, path)


def expect_disk(place: StoredPlace, folder: Path, size: int) -> None:
    """Raise StoreError where a copy of so many bytes does not fit."""
    free = shutil.disk_usage(all_copies(os.getpid())).free
    if free < size:
        raise StoreError(
            f"{place}: its copy needs {size / 1e9:.3g} GB, and {free / 1e9:.3g} GB are free in {folder.parent}; set "
            "TMPDIR to a folder with more"
        )


def copy_of(place: StoredPlace) -> Path:
    """Where its copy is: files of a bucket lie to one another as they do there."""
    return all_copies(os.getpid()) / f"{abs(hash(place.server)):x}" / place.key


@cache
def all_copies(process: int) -> Path:
    """A temporary folder of this process."""
    folder = Path(tempfile.mkdtemp(prefix="tauext-"))

    def clear() -> None:
        if os.getpid() == process:
            shutil.rmtree(folder, ignore_errors=True)

    atexit.register(clear)
    return folder
