"""A file appears whole or not at all: an interrupted run leaves the last whole one under its name.

What is written to a store is a file of this machine until it is whole; then it is sent.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tauext.errors import ConfigError
from tauext.files.copies import in_order, put, written_as
from tauext.files.places import Place


@contextmanager
def atomic_write(path: Place) -> Iterator[Path]:
    """The name NAME.part beside it to write under; renamed at the end, removed where writing fails.

    Folders are not made. Errors of the system come out as they are.
    """
    with atomic_files(path) as (part,):
        yield part


@contextmanager
def atomic_files(*paths: Place) -> Iterator[tuple[Path, ...]]:
    """Write files that belong together: none is renamed before all are written; the last one is renamed last."""
    parts = tuple(written_as(path) for path in paths)
    try:
        yield parts
        for part, path in zip(parts, paths, strict=True):
            put(part, path)
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
def atomic_folder(folder: Place) -> Iterator[Path]:
    """A folder NAME.part beside it to write into; its files move into the folder at the end, which is made.

    Other files of the folder stay. If writing fails, nothing has changed.
    """
    part = written_as(folder)
    shutil.rmtree(part, ignore_errors=True)  # of a run that was killed
    part.mkdir(parents=True)
    try:
        yield part
        for file in sorted((path for path in part.rglob("*") if path.is_file()), key=in_order):
            place = folder / file.relative_to(part).as_posix()
            place.parent.mkdir(parents=True, exist_ok=True)
            put(file, place)
    finally:
        shutil.rmtree(part, ignore_errors=True)
