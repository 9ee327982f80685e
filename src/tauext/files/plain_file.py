"""Text, JSON and TOML from a path that may be anything: a pipe without a writer, a device without an end."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import stat
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tauext.errors import ConfigError, TauextError

FORMAT = 1
"""Format number of every kind of file that this version writes and reads."""

BUNDLE_MAGIC = b"TAUEXT"
LARGEST_TEXT = 1 << 28
"""Largest size of a file that is read whole, [bytes]; results of a thousand hours are a hundredth of it."""


def expect_file(path: Path) -> None:
    """Raise OSError unless the path is a file: opening a pipe blocks, and a device may have no end."""
    mode = path.stat().st_mode
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, "Not a file but a device, pipe or socket", str(path))


def expect_format(
    content: object, path: Path, remedy: str, error: type[TauextError] = ConfigError, key: str = "format"
) -> None:
    """Raise the error unless a file's content names, under this key, the format that this version reads."""
    found = content.get(key) if isinstance(content, dict) else None
    if found is None:
        raise error(f"{path}: its '{key}' is missing, must be {FORMAT}; {remedy}")
    if str(found) != str(FORMAT):
        raise error(
            f"{path}: format {found} instead of {FORMAT}: made by a development version before 0.1.0 or by a later "
            f"version; {remedy}"
        )


def read_bytes(path: Path) -> bytes:
    """The content of a file.

    Raises:
        OSError: there is no such file, or it is none, or larger than any that is meant.
    """
    expect_file(path)
    with path.open("rb") as file:
        raw = file.read(LARGEST_TEXT + 1)
    if len(raw) > LARGEST_TEXT:
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG), str(path))
    return raw


def read_text(path: Path) -> str:
    """The text of a file.

    Raises:
        OSError: see read_bytes().
        ValueError: it is a bundle, or no UTF-8.
    """
    raw = read_bytes(path)
    if raw.startswith(BUNDLE_MAGIC):
        raise ValueError("it is a bundle")
    return raw.decode("utf-8")


def json_of(text: str | bytes, parse_constant: Callable[[str], Any] | None = None) -> Any:
    """The value of a JSON text; ValueError where it is none."""
    try:
        return json.loads(text, parse_constant=parse_constant)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None


def read_json(path: Path, missing: str = "there is no such file", kind: str = "") -> Any:
    """The value in a JSON file.

    Args:
        missing: text of the message where there is no file.
        kind: of file, for messages: `no LeRobot calibration file: `.

    Raises:
        ConfigError: there is no such file, or it is not JSON.
    """
    return _parsed(path, lambda: json_of(read_text(path)), f"{kind}not readable as JSON", missing)


def read_toml(path: Path, advice: str = "") -> dict[str, Any]:
    """The content of a TOML file.

    Args:
        advice: how to get such a file, for the message where there is none.

    Raises:
        ConfigError: there is no such file, or it is not TOML.
    """
    missing = f"there is no such file{advice and f'; {advice}'}"
    return _parsed(path, lambda: toml_of(read_text(path)), "not readable as TOML", missing)


def parse_toml(content: str, path: Path) -> dict[str, Any]:
    """The content of a TOML text; raises as read_toml."""
    return _parsed(path, lambda: toml_of(content), "not readable as TOML")


def _parsed(path: Path, parse: Callable[[], Any], wrong: str, missing: str = "") -> Any:
    try:
        return parse()
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: {missing}") from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: {wrong} ({error})") from error


def number_of(text: str) -> float:
    """The value of a plain decimal number; ValueError for `1_0`, `inf`, `nan`, `1e999` and digits other than 0 to 9."""
    is_plain = re.fullmatch(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?", text)
    if not is_plain or not math.isfinite(value := float(text)):
        raise ValueError(f"{text[:40]!r} is no plain number")
    return value


def toml_of(text: str) -> dict[str, Any]:
    """The content of a TOML text; ValueError where it is none."""
    if re.search(r"""(?<![\w.-])(?:("[^"\n]*"|'[^'\n]*'|[\w-]+)[ \t]*\.[ \t]*){64}""", text):
        raise ValueError("it is nested too deeply")  # dotted keys of many parts would take hours
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
