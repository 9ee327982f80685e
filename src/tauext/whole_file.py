"""A file appears whole or not at all: an interrupted run leaves the last whole one under its name."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """The name NAME.part beside it to write under; renamed at the end, removed where writing fails.

    Folders are not made. Errors of the system come out as they are.
    """
    part = path.with_name(path.name + ".part")
    try:
        yield part
        os.replace(part, path)
    except BaseException:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise
