"""Damaged files: exceptions of the libraries that read them become one message in the words of this program."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

from tauext.errors import RecordingError


def too_large(path: object) -> RecordingError:
    """The error about a file that needs more memory than there is."""
    return RecordingError(
        f"{path}: what it states or unpacks to needs more memory than is free; split the file, or use a computer with "
        "more memory"
    )


@contextmanager
def whole(path: object, kind: str, broken: tuple[type[Exception], ...]) -> Iterator[None]:
    """Convert a library's exceptions on truncated or damaged files to RecordingError.

    Args:
        kind: what the file is read as: "Parquet", "episode 3 of a LeRobot dataset".
        broken: the library's exceptions.
    """
    try:
        yield
    except RecordingError:
        raise
    except MemoryError as error:
        raise too_large(path) from error
    except broken as error:
        if re.search("memory allocation failed|unable to allocate|out of memory", str(error), re.IGNORECASE):
            raise too_large(path) from error  # HDF5 and others report it as any other error
        raise RecordingError(f"{path}: cannot be read as {kind}: it is truncated or damaged; copy it again") from error
