"""What the parser of command lines does at length for nothing, left out: half of the time that `--help` took.

Both are the parser's own affairs. Where a version of it has other names, it is slower and says the same.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable
from typing import Any, get_args, get_origin

import tyro


def quicken() -> None:
    """Put the shorter ways in place, once."""
    for module, name, shorter in (
        ("_resolver", "is_instance", without_typeguard),
        ("_docstrings", "get_field_docstring", without_own_source),
    ):
        try:
            where = importlib.import_module(f"tyro.{module}")
            way = getattr(where, name)
        except (ImportError, AttributeError):
            continue
        if getattr(way, "shorter_by", None) is not shorter:
            setattr(where, name, shorter(way))


def without_typeguard(is_instance: Callable[..., bool]) -> Callable[..., bool]:
    """The check of a default against its type: of none, None and an empty tuple it says yes, and imports typeguard for
    that."""

    @functools.wraps(is_instance)
    def checked(kind: Any, value: Any) -> bool:
        if value is tyro.MISSING or value is tyro.MISSING_NONPROP:
            return True
        optional = value is None and type(None) in get_args(kind)
        several = value == () and get_origin(kind) is tuple and get_args(kind)[-1:] == (...,)
        return optional or several or is_instance(kind, value)

    checked.shorter_by = without_typeguard  # type: ignore[attr-defined]
    return checked


def without_own_source(field_docstring: Callable[..., str | None]) -> Callable[..., str | None]:
    """The help of a field, from its class's source: of the parser's own classes it is read in vain."""

    @functools.wraps(field_docstring)
    def found(owner: type, *about: Any) -> str | None:
        return None if owner.__module__.startswith("tyro.") else field_docstring(owner, *about)

    found.shorter_by = without_own_source  # type: ignore[attr-defined]
    return found
