"""Reads the small TOML files of a live monitor."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from tauext.errors import ConfigError
from tauext.files.places import Place
from tauext.files.plain_file import read_text, toml_of
from tauext.files.whole_file import whole_file


def read_toml(path: Place, option: str = "") -> dict[str, Any]:
    """The content of the file; option, if there is one, writes a template of it: `--new-reactions`.

    Raises:
        ConfigError: no such file, or not TOML.
    """
    try:
        return toml_of(read_text(path))
    except FileNotFoundError as error:
        advice = f"; `tauext monitor {option} {path}` writes a template" if option else ""
        raise ConfigError(f"{path}: there is no such file{advice}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from error
    except ValueError as error:
        raise ConfigError(f"{path}: not readable as TOML: {error}") from error


def number(where: str, value: Any, lowest: float, highest: float) -> float:
    """The value, if it is a number within the bounds."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ConfigError(f"{where} = {value!r} must be a number")
    if not lowest <= value <= highest:
        raise ConfigError(f"{where} = {value:g} must be {lowest:g} to {highest:g}")
    return float(value)


def write_template(path: Path, text: str) -> None:
    """Write a template; nothing is overwritten."""
    if path.exists():
        raise ConfigError(f"{path}: is there already; choose another name or remove it")
    try:
        with whole_file(path) as part:
            part.write_text(text, encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error
