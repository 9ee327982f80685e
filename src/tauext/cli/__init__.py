"""The command line: one verb a stage. Heavy imports stand inside each command, so that `--help` answers at once."""

from __future__ import annotations

import sys

import tyro

from tauext.cli.evaluate import evaluate
from tauext.cli.report import report
from tauext.cli.reproduce import reproduce
from tauext.cli.show import show
from tauext.cli.simulate import simulate
from tauext.cli.train import train
from tauext.errors import TauextError

DESCRIPTION = (
    "External joint torque and collision detection for robot arms, from encoders and motor torque alone. "
    "simulate (or your own recordings) -> train -> evaluate -> report; reproduce does all four."
)


def main(argv: list[str] | None = None) -> int:
    """Run one command; 0 done, 2 bad input (one line on stderr), 130 interrupted."""
    app = tyro.extras.SubcommandApp()
    for command in (reproduce, simulate, train, evaluate, report, show):
        app.command(command)
    try:
        app.cli(prog="tauext", description=DESCRIPTION, args=argv)
    except TauextError as error:
        print(f"tauext: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(
            "tauext: interrupted; what was finished is kept, and the same command goes on from there", file=sys.stderr
        )
        return 130
    return 0
