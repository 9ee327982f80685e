"""Files of JSON lines that several processes append to; a line survives `kill -9`, a reboot and a full disk."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from tauext.files.places import Place
from tauext.files.plain_file import json_of, read_text

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


def append_line(path: Path, content: Mapping[str, Any]) -> None:
    """Append one JSON object as a line and wait until the disk holds it.

    A line that a killed process left incomplete is closed first, so that it damages no other line.

    Raises:
        OSError: the line cannot be written; the file then ends as before.
    """
    line = json.dumps(content, allow_nan=False).encode() + b"\n"
    is_new = not path.exists()
    file = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        lock(file)
        end = os.lseek(file, 0, os.SEEK_END)
        if end and os.pread(file, 1, end - 1) != b"\n":
            line = b"\n" + line

        def write() -> None:
            try:
                write_all(file, line)
                os.fsync(file)
            except OSError:
                os.ftruncate(file, end)
                raise

        write_reserved(path.parent, write)
    finally:
        os.close(file)
    if is_new:
        sync_folder(path.parent)


def read_lines(path: Place) -> list[dict[str, Any]]:
    """The objects in order; incomplete and damaged lines are left out, and a missing file has none."""
    try:
        text = read_text(path)
    except FileNotFoundError:
        return []
    except ValueError:  # a damaged block: keep the lines that are text
        text = path.read_bytes().decode("utf-8", errors="replace")
    found = []
    for line in text.splitlines():
        with suppress(ValueError):
            if isinstance(one := json_of(line), dict):
                found.append(one)
    return found


def write_synced(path: Path, text: str) -> None:
    """Replace a small file so that after a power failure either content is there, never half of one."""
    part = path.with_name(path.name + ".part")

    def write() -> None:
        with part.open("w", encoding="utf-8") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())

    write_reserved(path.parent, write)
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


def write_all(file: int, line: bytes) -> None:
    while line:
        line = line[os.write(file, line) :]
