"""Damaged files: exceptions of the libraries that read them become one message in the words of this program."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from tauext.errors import RecordingError


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
    except broken as error:
        raise RecordingError(f"{path}: cannot be read as {kind}: it is truncated or damaged; copy it again") from error
