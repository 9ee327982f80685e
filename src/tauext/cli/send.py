"""`tauext send`: a control line to a running monitor."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from tauext.cli.commands import folders_like, loaded
from tauext.cli.monitor import require_positive
from tauext.errors import ConfigError


def send(
    to: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SOCKET|FOLDER")],
    line: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LINE ...")],
    timeout_s: float = 10.0,
) -> None:
    """Send a control line to a running monitor, and print its answer.

    Examples: `tauext send control profile pressing`, `tauext send cell7 touched`. Lines: docs/running.md.

    Args:
        to: socket of `tauext monitor --control`, or folder of `tauext commission`.
        line: words of the line, such as `acknowledge` or `load mass=2.8 com=0,0,0.05`.
        timeout_s: time after which a missing answer is an error, [s].
    """

    from tauext.monitor.control_lines import send_line

    require_positive(timeout_s=timeout_s)
    if not line:
        raise ConfigError("the line is missing: tauext send SOCKET acknowledge")
    if to.is_dir() and (folders := folders_like(to)) is None:
        raise ConfigError(f"{to}: is no socket, and no folder of `tauext commission`")
    answer = send_line(loaded(folders.socket)(to) if to.is_dir() and folders else to, " ".join(line), timeout_s)
    if answer != "ok":
        raise ConfigError(answer.removeprefix("error: "))
    print(answer)
