"""From the words of a command line to one call; errors are one line."""

from __future__ import annotations

import functools
import importlib
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr
from io import StringIO
from typing import Any, get_args, get_origin

import tyro
from tyro.extras import SubcommandApp

from tauext.errors import ConfigError

# --- What the parser of command lines does at length for nothing, left out: half of the time that `--help` took.
#
# Both are the parser's own affairs. Where a version of it has other names, it is slower and says the same.


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


# --- The words of a command line to one call; what cannot be understood is said in one line.


HELP_INDENT = 8
"""The parser's box indents the help of an option by so many blanks, and the option by fewer."""
LEFT_OUT = ("Argument helptext", "For full helptext")
"""Beginnings of sections of that box that a line has no room for: the line names the help instead."""


def understood(app: SubcommandApp, prog: str, description: str, arguments: Sequence[str]) -> Callable[[], Any]:
    """The call that the arguments ask for; `--help` prints and exits here.

    Args:
        app: holds commands that are `deferred`.

    Raises:
        ConfigError: they cannot be understood.
    """
    quicken()
    said = StringIO()
    try:
        with redirect_stderr(said):
            call: Callable[[], Any] = app.cli(prog=prog, description=description, args=list(arguments))
    except SystemExit as stop:
        if not stop.code:
            raise
        verb = next((word for word in arguments[:1] if not word.startswith("-")), "")
        raise ConfigError(
            f"{in_one_line(said.getvalue())}; see `{' '.join(filter(None, (prog, verb)))} --help`"
        ) from None
    sys.stderr.write(said.getvalue())
    return call


def deferred(command: Callable[..., Any]) -> Callable[..., Callable[[], Any]]:
    """The command for a parser: called with arguments, it gives the call to make once they are all understood."""

    @functools.wraps(command)
    def later(*arguments: Any, **named: Any) -> Callable[[], Any]:
        return functools.partial(command, *arguments, **named)

    return later


def in_one_line(box: str) -> str:
    """What stands in a box of the parser, without its frame, help texts and advice."""
    sections: list[list[str]] = [[]]
    for line in box.splitlines():
        inside = line.strip("│|")
        if not inside.strip(" ─-") or line.startswith(("╭", "╰", "+")):
            sections.append([])
        elif len(inside) - len(inside.lstrip()) < HELP_INDENT:
            sections[-1].append(inside.strip())
    told = [" ".join(section) for section in sections if section and not section[0].startswith(LEFT_OUT)]
    return "; ".join(told) or "the options cannot be understood"
