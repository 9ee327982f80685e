"""The command line: one verb a stage. Heavy imports stand inside each command, so that `--help` answers at once."""

from __future__ import annotations

import _thread
import os
import sys
import warnings
from contextlib import suppress
from io import TextIOWrapper
from typing import Any

# The fits solve many small systems: more threads of the linear algebra only wait for each other. NumPy reads it once.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# Nothing is drawn by MuJoCo here. Its import would look for a window system in a process of its own, and lose a Ctrl-C.
os.environ.setdefault("MUJOCO_GL", "disable")

import tyro

from tauext.cli.calibrate import calibrate
from tauext.cli.check import check
from tauext.cli.demo import demo
from tauext.cli.evaluate import evaluate
from tauext.cli.fleet import HELP as FLEET_HELP
from tauext.cli.fleet import fleet_app
from tauext.cli.import_data import import_data
from tauext.cli.label import label
from tauext.cli.load import load
from tauext.cli.monitor import monitor
from tauext.cli.parsing import deferred, understood
from tauext.cli.place_argument import RULE
from tauext.cli.purposes import arranged_help
from tauext.cli.refit import refit
from tauext.cli.report import report
from tauext.cli.reproduce import reproduce
from tauext.cli.run import run
from tauext.cli.show import show
from tauext.cli.simulate import simulate
from tauext.cli.train import train
from tauext.errors import FaultyDataError, TauextError

KILLED = (
    "Whatever ends a process (Ctrl-C, kill -9, a power cut) leaves whole files, and costs at most the last 30 s of "
    "simulated, trained, calibrated or evaluated motion: the same command goes on there. What is fitted in between "
    "(a prior, the gate) is done again; so is an import, a check and a report."
)
DESCRIPTION = (
    "External joint torque and collision detection for robot arms, from encoders and motor torque alone. "
    "simulate (or import: your own recordings) -> train -> evaluate -> report; reproduce does all four. "
    "check: what recordings and robot file have wrong, before anyone trains. "
    "train -> run: the monitor on recordings; monitor: on a live arm. calibrate: other limits for a trained bundle. "
    "label: contact and collision in a LeRobot dataset. "
    "load: what the arm carries, or torque constants by a known weight. "
    "refit: its friction brought up to date by a minute of today's motion. "
    "fleet: all of this for many arms, on many cores, and what arms of one type tell the next one (train --like). "
    "demo: push a simulated arm in the browser. "
    "Where a path may stand, a URL of an object store may: s3://, gs://, abfs://. "
    "--version: of package, core, its compiler and bundles. "
    f"{RULE} {KILLED}"
)


LONGEST_ERROR = 1500
"""Letters of an error: what a hostile file holds is quoted no further."""


def spelled_out(argv: list[str]) -> list[str]:
    """`--ros2` is `--source ros2`: no option of its own, since --ros2.topic and others stand for a group."""
    return [word for arg in argv for word in (("--source", "ros2") if arg == "--ros2" else (arg,))]


def version_text() -> str:
    """Versions of the package, of its core and of the compiler that made it, its kernels; which bundles both read and
    write."""
    from importlib.metadata import version

    from tauext import _core
    from tauext.files.provenance import VERSION

    compiler = _core.COMPILER.partition(" (")[0]  # clang adds where its sources came from
    built = f"core {VERSION} by {compiler} with {_core.simd_in_use()}"
    return f"tauext {version('tauext')}, {built}, bundle format {_core.BUNDLE_FORMAT}"


def main(argv: list[str] | None = None) -> int:
    """Run one command and return its exit status.

    0 done, 1 a fault (check) or a failed arm (fleet), 2 bad input (one line on stderr), 130 interrupted, 141 no reader.
    """
    argv = sys.argv[1:] if argv is None else argv
    app = tyro.extras.SubcommandApp()
    for command in (
        reproduce,
        simulate,
        check,
        train,
        calibrate,
        refit,
        evaluate,
        report,
        run,
        monitor,
        label,
        load,
        show,
        demo,
    ):
        app.command(deferred(command))
    app.command(name="import")(deferred(import_data))
    app.command(fleet_app(), name="fleet", help=FLEET_HELP)
    # What overflows is found by whoever checks the number; the interpreter's own words about it are none of ours.
    warnings.filterwarnings("ignore", category=RuntimeWarning)
    sys.unraisablehook = not_swallowed
    try:
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, TextIOWrapper):
                stream.reconfigure(errors="backslashreplace")  # names of files may be any bytes
        if os.environ.get("TAUEXT_SIMD"):  # refused before hours of work; unset, the core need not be loaded
            from tauext import _core

            _core.simd_in_use()
        if argv == ["--version"]:
            print(version_text())
            return 0
        if (told := arranged_help(app, "tauext", argv)) is not None:
            print(told)
            flush()
            return 0
        status = understood(app, "tauext", DESCRIPTION, spelled_out(argv))()
        flush()
    except FaultyDataError as error:
        tell(f"tauext: error: {error}")  # a block: what is found in data, and how to mend it
        return 2
    except TauextError as error:
        return refused(str(error))
    except KeyboardInterrupt as stop:
        kept = str(stop) or "what was finished is kept, and the same command goes on from there"
        tell(f"tauext: interrupted; {kept}")
        return 130
    except BrokenPipeError:  # `tauext run --json | head`: nobody reads on
        forget(sys.stdout)
        return 141
    except OSError as error:
        forget(sys.stdout)
        return refused(f"{error.filename or 'output'}: cannot be read or written ({error.strerror or error})")
    except UnicodeError as error:
        return refused(f"a name or text is no UTF-8: {error}")
    except MemoryError as error:
        return refused(f"this needs more memory than there is; ask for less at a time ({str(error) or 'none is left'})")
    return status if isinstance(status, int) else 0


def not_swallowed(lost: sys.UnraisableHookArgs) -> None:
    """A Ctrl-C that came within a destructor, where Python would print it and go on, comes again."""
    if issubclass(lost.exc_type, KeyboardInterrupt):
        _thread.interrupt_main()
    else:
        sys.__unraisablehook__(lost)


def refused(why: str) -> int:
    """Say in one line why there is nothing; the exit status."""
    line = " ".join(why.split())
    tell(f"tauext: error: {line if len(line) <= LONGEST_ERROR else f'{line[:LONGEST_ERROR]} ...'}")
    return 2


def tell(line: str) -> None:
    """On stderr, which may be full or closed."""
    try:
        print(line, file=sys.stderr, flush=True)
    except OSError:
        forget(sys.stderr)


def flush() -> None:
    """What is printed and does not arrive is an error here, not a word of the interpreter at its end."""
    if sys.stdout is not None:
        sys.stdout.flush()


def forget(stream: Any) -> None:
    """What stands in its buffer cannot be written: the interpreter shall not try again at its end."""
    with suppress(OSError, AttributeError, ValueError):  # none, closed or a test's own
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
