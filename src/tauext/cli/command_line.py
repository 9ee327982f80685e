"""The command as typed, for what it writes."""

from __future__ import annotations

import sys


def command_line() -> str:
    """The command as typed, without the path of the program."""
    return " ".join(["tauext", *sys.argv[1:]])
