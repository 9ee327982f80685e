"""A file appears whole or not at all: an interrupted run leaves the last whole one under its name."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tauext.errors import ConfigError


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """The name NAME.part beside it to write under; renamed at the end, removed where writing fails.

    Folders are not made. Errors of the system come out as they are.
    """
    with atomic_files(path) as (part,):
        yield part


@contextmanager
def atomic_files(*paths: Path) -> Iterator[tuple[Path, ...]]:
    """Write files that belong together: none is renamed before all are written; the last one is renamed last."""
    parts = tuple(path.with_name(path.name + ".part") for path in paths)
    try:
        yield parts
        for part, path in zip(parts, paths, strict=True):
            part.replace(path)
    except BaseException as error:
        if isinstance(error, OSError) and not error.filename:  # a full disk: write() does not name the file
            error.filename = str(paths[0])
        for part in parts:
            with suppress(OSError):
                part.unlink(missing_ok=True)
        raise


def expect_empty(folder: Path) -> None:
    """Raise ConfigError where there is something of this name, other than an empty folder."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise ConfigError(f"{folder}: is not empty; choose another folder or remove it")


@contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """A folder NAME.part beside it to write into, which takes its name at the end; removed where writing fails.

    Raises:
        ConfigError: the folder is not empty, or cannot be written.
    """
    expect_empty(folder)
    part = folder.with_name(folder.name + ".part")
    shutil.rmtree(part, ignore_errors=True)  # of a run that was killed
    part.mkdir(parents=True)
    try:
        yield part
        if folder.exists():
            folder.rmdir()
        part.rename(folder)
    except OSError as error:
        raise ConfigError(f"{folder}: cannot be written ({error.strerror or error})") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)


@contextmanager
def atomic_folder(folder: Path) -> Iterator[Path]:
    """A folder NAME.part beside it to write into; its files move into the folder at the end, which is made.

    Other files of the folder stay. If writing fails, nothing has changed.
    """
    part = folder.with_name(folder.name + ".part") if folder.name else folder / ".part"
    shutil.rmtree(part, ignore_errors=True)  # of a run that was killed
    part.mkdir(parents=True)
    try:
        yield part
        last = ("report.html", "check.json")  # a folder with these is whole
        for file in sorted((one for one in part.rglob("*") if one.is_file()), key=lambda one: (one.name in last, one)):
            path = folder / file.relative_to(part)
            path.parent.mkdir(parents=True, exist_ok=True)
            file.replace(path)
    finally:
        shutil.rmtree(part, ignore_errors=True)
