"""The command as typed, for what it writes."""

from __future__ import annotations

import re
import sys

QUERY = re.compile(r"((?:^|[=:])(?:s3|gs|abfss?)://[^?]*)\?.*", re.I)


def command_line() -> str:
    """The command as typed, without the path of the program and the queries of URLs."""
    return " ".join(["tauext", *(QUERY.sub(r"\1", word) for word in sys.argv[1:])])
