"""A place of a file or folder, as a person writes it."""

from __future__ import annotations

import re
from pathlib import Path
from urllib.parse import unquote

from tauext.errors import ConfigError
from tauext.files.stored import SCHEMES, StoredPlace

Place = Path | StoredPlace
"""Whoever takes both asks it as a path is asked: name, parent, /, is_file(), open("rb"), ..."""
URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*)://")


def place_of(text: Place | str, base: Place | None = None) -> Place:
    """The place of this name: s3://, gs://, abfs:// and abfss:// are stores, file:// and all else are paths.

    Args:
        base: what a relative path counts from; None: the working directory.

    Raises:
        ConfigError: a URL of another scheme, without a bucket, or with a secret in it.
    """
    if not isinstance(text, str):
        return text
    found = URL.match(text)
    if found is None:
        return Path(text) if base is None else base / text
    scheme = found[1].lower()
    if scheme == "file":
        host, slash, path = text[found.end() :].partition("/")
        if host not in ("", "localhost") or not slash:
            raise ConfigError(f"{text}: a file URL of this machine begins with file:///")
        return Path("/" + unquote(path))
    if scheme not in SCHEMES:
        known = ", ".join(f"{name}://" for name in (*SCHEMES, "file"))
        raise ConfigError(f"{scheme}://...: no such store is known; a place is a path, or a URL of {known}")
    return StoredPlace.of_url(text)


def same_place(one: Place, other: Place) -> bool:
    """Whether both are the same file, which is there."""
    if isinstance(one, Path) and isinstance(other, Path):
        return one.exists() and other.exists() and one.samefile(other)
    return one == other


def is_stored(place: Place) -> bool:
    """Whether it lies in an object store."""
    return isinstance(place, StoredPlace)
