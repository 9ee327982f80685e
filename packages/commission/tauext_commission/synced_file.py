"""Small files that stay whole: reserved space for a full disk, locks, names of damaged files."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

RESERVE = ".reserve"
"""File in the same folder that holds space for lines and small files, released when the disk is full."""
RESERVED = 1 << 20
"""Its size, [bytes]: several thousand lines."""


def reserve(folder: Path) -> None:
    """Reserve space for lines, or as much of it as the disk has."""
    with suppress(OSError), (folder / RESERVE).open("ab", buffering=0) as file:
        if (missing := RESERVED - file.tell()) > 0:
            file.write(os.urandom(missing))  # a file of zeros takes no space on some disks


def write_reserved(folder: Path, write: Callable[[], None]) -> None:
    """Write; a full disk first releases the reserve of this folder, and reserves again what is left of it."""
    try:
        write()
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT) or not (folder / RESERVE).exists():
            raise
        (folder / RESERVE).unlink(missing_ok=True)
        try:
            write()
        finally:
            reserve(folder)


def set_aside(path: Path) -> Path:
    """Rename what lies in the place of a file, so that it is kept and the place is free; returns its new name."""
    number, there = 1, path.with_name(f"{path.name}.damaged")
    while os.path.lexists(there):
        number += 1
        there = path.with_name(f"{path.name}.damaged-{number}")
    path.rename(there)
    return there


def write_synced(path: Path, text: str) -> None:
    """Replace a small file so that after a power failure either content is there, never half of one."""
    part = path.with_name(path.name + ".part")

    def write() -> None:
        with part.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())

    write_reserved(path.parent, write)
    if path.is_dir() and not path.is_symlink():
        set_aside(path)
    part.replace(path)
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Wait until the disk holds the folder's list of files."""
    with suppress(OSError):  # some systems open no folders
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


def lock(file: int) -> None:
    """Wait for the other processes' lines; systems without flock append whole lines anyway."""
    with suppress(ImportError):
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX)
