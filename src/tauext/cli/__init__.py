"""The command line: one verb a stage. Heavy imports stand inside each command, so that `--help` answers at once."""

from __future__ import annotations

import os
import sys

# The fits solve many small systems: more threads of the linear algebra only wait for each other. NumPy reads it once.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Nothing is drawn by MuJoCo here. Its import would look for a window system in a process of its own, and lose a Ctrl-C.
os.environ.setdefault("MUJOCO_GL", "disable")

import tyro

from tauext.cli.calibrate import calibrate
from tauext.cli.check import check
from tauext.cli.convert import convert
from tauext.cli.demo import demo
from tauext.cli.evaluate import evaluate
from tauext.cli.import_data import import_data
from tauext.cli.monitor import monitor
from tauext.cli.report import report
from tauext.cli.reproduce import reproduce
from tauext.cli.run import run
from tauext.cli.show import show
from tauext.cli.simulate import simulate
from tauext.cli.train import train
from tauext.errors import TauextError

DESCRIPTION = (
    "External joint torque and collision detection for robot arms, from encoders and motor torque alone. "
    "simulate (or import: your own recordings) -> train -> evaluate -> report; reproduce does all four. "
    "check: what recordings and robot file have wrong, before anyone trains. "
    "train -> run: the monitor on recordings; monitor: on a live arm. calibrate: other limits for a trained bundle. "
    "demo: push a simulated arm in the browser. convert: a bundle of an older format."
)


def spelled_out(argv: list[str]) -> list[str]:
    """`--ros2` is `--source ros2`: no option of its own, since --ros2.topic and others stand for a group."""
    return [word for arg in argv for word in (("--source", "ros2") if arg == "--ros2" else (arg,))]


def main(argv: list[str] | None = None) -> int:
    """Run one command; 0 done, 1 a fault (check), 2 bad input (one line on stderr), 130 interrupted, 141 no reader."""
    app = tyro.extras.SubcommandApp()
    for command in (reproduce, simulate, check, train, calibrate, evaluate, report, run, monitor, show, demo, convert):
        app.command(command)
    app.command(name="import")(import_data)
    try:
        status = app.cli(
            prog="tauext", description=DESCRIPTION, args=spelled_out(sys.argv[1:] if argv is None else argv)
        )
    except TauextError as error:
        print(f"tauext: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as stop:
        kept = str(stop) or "what was finished is kept, and the same command goes on from there"
        print(f"tauext: interrupted; {kept}", file=sys.stderr)
        return 130
    except BrokenPipeError:  # `tauext run --json | head`: nobody reads on, and Python must not flush what is left
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    return status if isinstance(status, int) else 0
