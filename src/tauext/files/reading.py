"""Reading a file by ranges, the same one from the first byte to the last."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tauext.errors import StoreError
from tauext.files.answers import answers
from tauext.files.place import Place
from tauext.files.stored import StoredPlace


@contextmanager
def reading(place: Place) -> Iterator[Any]:
    """What libraries read a place by: the path itself, or a stored file, of which only what is asked for is sent.

    A connection that is lost is tried again. A range that comes short is an error.

    Raises:
        FileNotFoundError: there is no such file.
        StoreError: the store cannot be reached, refuses or stalls, or the file was replaced while it was read.
    """
    if not isinstance(place, StoredPlace):
        yield place
        return
    with answers(place), place.open() as file:
        before = version(file)
        yield file
        with place.open() as again:
            if version(again) != before:
                raise StoreError(f"{place}: it was replaced while it was read; begin again")


def version_of(place: Place) -> str:
    """Something that differs when the content does: ETag and size where a store has them, else size and time."""
    if not isinstance(place, StoredPlace):
        status = place.stat()
        return f"{status.st_size} {status.st_mtime_ns}"
    with answers(place), place.open() as file:
        return version(file)


def version(file: Any) -> str:
    """Of an open file: the store's own mark of its content, time of change where it has none, and size."""
    facts = {key.lower(): value for key, value in (file.metadata() or {}).items()}
    mark = facts.get("etag") or facts.get("last-modified") or b""
    return f"{mark.decode(errors='replace') if isinstance(mark, bytes) else mark} {file.size()}"
