"""Checks before work begins that a request fits: memory, disk, time, and a place for the output."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tauext.errors import ConfigError

LEAST_ROOM = 1 << 20
"""Free space that a disk must have for a bundle, a page or a description, [bytes]."""


def expect_new_file(path: Path, size: float = LEAST_ROOM) -> None:
    """Raise ConfigError unless a file can be written under this name, of so many bytes."""
    expect_text(path)
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder, where a file is to be written; choose another name")
    if path.exists() and not path.is_file():
        raise ConfigError(f"{path}: is no file that could be replaced; choose another name")
    expect_folder(path.parent, size)


def expect_text(path: Path) -> None:
    """Raise ConfigError where the name is no text: the core, libraries and terminals take no other."""
    try:
        str(path).encode()
    except UnicodeEncodeError as error:
        raise ConfigError(f"{path}: this name is no UTF-8; choose another") from error
    if not path.name.isprintable():
        raise ConfigError(f"{path}: this name has characters that cannot be printed; choose another")


def expect_folder(folder: Path, size: float = LEAST_ROOM, what: str = "") -> None:
    """Raise ConfigError unless the folder is there or can be made, can be written to, and has room.

    Args:
        size: of what is to be written, [bytes].
        what: setting that needs so much: `minutes = 1e9`.
    """
    expect_text(folder)
    there = folder.absolute()
    try:
        while not there.exists() and there != there.parent:
            there = there.parent
        if not there.is_dir():
            raise ConfigError(f"{folder}: {there.name or there} is no folder; choose another place to write to")
        if not os.access(there, os.W_OK | os.X_OK):
            raise ConfigError(f"{folder}: cannot be written to (Permission denied); choose another place")
        free = shutil.disk_usage(there).free
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written to ({error.strerror or error})") from error
    if free < size:
        needs, remedy = "the output needs", "free some, or choose another place"
        if what:
            needs, remedy = f"{what} needs", "request less"
        raise ConfigError(f"{folder}: {needs} {in_words(size)} of disk, and {in_words(free)} are free; {remedy}")


def expect_memory(size: float, what: str, remedy: str = "request less") -> None:
    """Raise ConfigError where the request needs more bytes than the machine has free."""
    there = free_memory()
    if there is not None and not size <= there:
        raise ConfigError(f"{what} needs {in_words(size)} of memory, and {in_words(there)} are free; {remedy}")


def expect_rows_fit(path: Path, rows: int, columns: int) -> None:
    """Raise ConfigError where a table of numbers is larger than the free memory: a small file can state 1e9 rows."""
    what = f"{path}: to read {rows:,} rows of {columns} columns"
    copies = 2  # of the table, in memory while it is read
    expect_memory(8.0 * copies * rows * columns, what, "split the file, or use a computer with more memory")


def expect_time(seconds: float, what: str) -> None:
    """Raise ConfigError where the request takes more than a month even by a lower bound."""
    month_s = 30 * 86400.0
    if not seconds <= month_s:
        raise ConfigError(f"{what} takes {span(seconds)} at least, and {span(month_s)} are the most; request less")


@contextmanager
def within_memory() -> Iterator[None]:
    """More memory than is free at the beginning is a MemoryError here, where the system would end the process.

    A file of a few kilobytes can state, or unpack to, any size, and libraries allocate what it states. Linux only.
    """
    limits, free = None, free_memory()
    with suppress(ImportError, OSError, ValueError, StopIteration):
        import resource

        limits = resource.getrlimit(resource.RLIMIT_DATA)
        with open("/proc/self/status") as file:
            used = next(1024 * int(line.split()[1]) for line in file if line.startswith("VmData:"))
        if free is not None and (limits[0] == resource.RLIM_INFINITY or used + free < limits[0]):
            resource.setrlimit(resource.RLIMIT_DATA, (used + free, limits[1]))
    try:
        yield
    finally:
        if limits is not None:
            resource.setrlimit(resource.RLIMIT_DATA, limits)


def free_memory() -> int | None:
    """Memory that the system, or the group of processes that this one is in, has available, [bytes]; None: unknown."""
    there = [one for one in (_free_in_system(), _free_in_group()) if one is not None]
    return min(there) if there else None


def _free_in_group() -> int | None:
    """What a container's limit leaves, by cgroup v2; None: there is none."""
    try:
        with open("/sys/fs/cgroup/memory.max") as most, open("/sys/fs/cgroup/memory.current") as now:
            return max(0, int(most.read()) - int(now.read()))
    except (OSError, ValueError):
        return None


def _free_in_system() -> int | None:
    try:
        with open("/proc/meminfo") as file:
            for line in file:
                if line.startswith("MemAvailable:"):
                    return 1024 * int(line.split()[1])
    except (OSError, ValueError, IndexError):
        pass
    return None


def in_words(size: float) -> str:
    """A number of bytes for people: `3.2 GB`."""
    units = ("bytes", "kB", "MB", "GB", "TB", "PB")
    power = 0 if size < 1000 else min(int(math.log10(min(size, 1e300)) / 3), len(units) - 1)
    return f"{size / 1000**power:.3g} {units[power]}"


def span(seconds: float) -> str:
    """A time for people, in its largest unit: `3.5 years`."""
    for name, length in (("years", 365.25 * 86400), ("days", 86400), ("hours", 3600), ("minutes", 60)):
        if seconds >= length:
            return f"{seconds / length:.3g} {name}"
    return f"{seconds:.3g} seconds"
