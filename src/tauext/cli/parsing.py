"""The words of a command line to one call; what cannot be understood is said in one line."""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stderr
from io import StringIO
from typing import Any

from tyro.extras import SubcommandApp

from tauext.cli.quick_parser import quicken
from tauext.errors import ConfigError

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
