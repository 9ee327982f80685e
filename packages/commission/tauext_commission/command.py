"""`tauext commission`: from a bare arm to a monitored arm."""

from __future__ import annotations

import os
import secrets
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tauext.cli.source_options import SOURCES, SourceOptions, SourceOptionsArg, given
from tauext.cli.train import AlarmOptions
from tauext.config import AlarmConfig, require
from tauext.errors import ConfigError, TauextError
from tauext.progress import in_plain_letters

if TYPE_CHECKING:
    from tauext_commission.answers import CurrentLoop
    from tauext_commission.run import Options

LEAST_DISK_GB, MOST_DISK_GB = 0.1, 1e5
KEYS = {"t": "touched", "n": "nothing", "y": "learn", "x": "leave"}
"""Keys of a terminal, and the answers that they give."""
STORED = {"touched": "touched", "nothing": "nothing there", "learn": "learn the change", "leave": "do not learn it"}
MOST_CORES = 1024


def commission(
    source: Annotated[str | None, tyro.conf.arg(help=f"source of the samples: {SOURCES}.")] = None,
    out: Path | None = None,
    robot: Path | None = None,
    options: SourceOptionsArg = SourceOptions(),  # noqa: B008
    cell: Path | None = None,
    no_page: Annotated[bool, tyro.conf.arg(name="no-page")] = False,
    host: str = "127.0.0.1",
    port: int = 8080,
    disk_gb: float = 5.0,
    core: int | None = None,
    priority: int | None = None,
    repair: bool = False,
    budget: Annotated[AlarmOptions, tyro.conf.arg(name="")] = {},  # noqa: B006
) -> None:
    """Commission a live arm: record, learn and monitor it, better every hour.

    Ctrl-C ends it; the same command continues. Guide: docs/commission.md.

    Args:
        out: folder of this arm. It holds description, recordings, labels, bundles, events and log.
        robot: URDF or MJCF of the arm. None: no model; the page shows bars.
        options: options of some sources.
        cell: TOML file of the cell: reactions to a collision, contact or fault, and bus, the joints of servos;
            docs/running.md.
        no_page: serve no page.
        host: address on which the page listens. 127.0.0.1: this computer only; 0.0.0.0: the network, with a token in
            the printed address.
        port: port of the page; if it is in use, the next free one.
        disk_gb: bound of recordings and event logs, [GB]; bundles and logs come on top.
        core: processor core of the loop and the receiver of samples. None: any.
        priority: real-time priority (SCHED_FIFO, 1 to 99) of the loop and the receiver of samples. None: normal
            scheduling.
        repair: print what was rebuilt and what is lost, accept it, and train again. Without --source that is all.
        budget: target false alarm rate. None: the one that was chosen last, 1 in 8 h in a new folder.
    """
    if repair and out is not None:
        repair_folder(out, source)
        if source is None:
            return
    if source is None or out is None:
        missing = "--out" if out is None else "--source"
        raise ConfigError(f"{missing} is missing: tauext commission --source ur:HOST --out cell7")
    require_ranges(disk_gb, priority, core, port)

    from tauext.monitor.cell_file import Cell, load_cell
    from tauext_commission.run import Options, run

    chosen = Options(
        robot=robot,
        source=given(options),
        cell=lambda joints: Cell() if cell is None else load_cell(cell, joints),
        host=host,
        disk_bytes=disk_gb * 1e9,
        core=core,
        priority=priority,
        alarm=AlarmConfig(**budget) if budget else None,
    )
    with keys() as listening:
        run(out, source, chosen if no_page else with_page(chosen, port), print_line, listening)


def require_ranges(disk_gb: float, priority: int | None, core: int | None, port: int) -> None:
    """Raise ConfigError for an option out of its range."""
    require(LEAST_DISK_GB <= disk_gb <= MOST_DISK_GB, "disk_gb", disk_gb, f"{LEAST_DISK_GB:g} to {MOST_DISK_GB:g}")
    require(priority is None or 1 <= priority <= 99, "priority", priority, "1 to 99")
    require(core is None or 0 <= core < MOST_CORES, "core", core, f"0 to {MOST_CORES - 1}")
    require(1 <= port <= 65535, "port", port, "1 to 65535")


def repair_folder(out: Path, source: str | None) -> None:
    """Print what was rebuilt in the folder, and what is lost."""
    from tauext_commission.run import repaired_folder

    for line in repaired_folder(out):
        print_line(line)
    if source is not None:
        print_line(f"{out}: the repair is complete; monitoring begins with {source}")


def with_page(options: Options, port: int) -> Options:
    """With a page on this port of the host; if it is in use, on the next free one."""
    from tauext_commission.page import serve
    from tauext_commission.page.access import LOOPBACK, listening_socket

    host = options.host
    listening = listening_socket(host, port)
    found = listening.getsockname()[1]
    token = "" if host in LOOPBACK else secrets.token_urlsafe(32)
    shown = "localhost" if host in ("127.0.0.1", "0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    reach = "from this computer only" if host in LOOPBACK else "whoever has this address can answer"
    address = f"http://{shown}:{found}/{f'?token={token}' if token else ''}  (the page, {reach})"
    if found != port:  # printed with the address, once the folder is known to be free
        address = f"port {port} is in use; the page is on port {found}\n{address}"
    return replace(options, page=serve, address=address, listening=listening, token=token)


def print_line(text: str) -> None:
    """Print a line at once; a closed terminal ends nothing."""
    with suppress(OSError):
        print(in_plain_letters(text), flush=True)


@contextmanager
def keys() -> Iterator[Callable[[CurrentLoop], None]]:
    """Keys of a terminal answer the newest alarm or a question; without a terminal nothing is read."""
    if not sys.stdin or not sys.stdin.isatty():
        yield lambda current_loop: None
        return
    import select
    import termios
    import tty

    file = sys.stdin.fileno()
    before, ended = termios.tcgetattr(file), threading.Event()
    reading: list[threading.Thread] = []

    def listen(current_loop: CurrentLoop) -> None:
        def work() -> None:
            while not ended.is_set():
                if not select.select([file], [], [], 0.2)[0]:
                    continue
                try:
                    typed = os.read(file, 100).decode(errors="ignore")
                except OSError:  # the terminal is gone
                    return
                if not typed:
                    return
                for key in typed:
                    answer(current_loop, key)

        reading.append(threading.Thread(target=work, name="keys", daemon=True))
        reading[0].start()
        print_line(
            "keys: t touched, n nothing there; after a question: y learn, x do not; Ctrl-C ends tauext, not the arm"
        )

    tty.setcbreak(file)
    try:
        yield listen
    finally:
        ended.set()
        for thread in reading:
            thread.join(1.0)
        with suppress(termios.error):
            termios.tcsetattr(file, termios.TCSADRAIN, before)


def answer(current_loop: CurrentLoop, key: str) -> None:
    """Give the answer of a key; other keys do nothing."""
    what = KEYS.get(key.lower())
    if what is None:
        return
    try:
        current_loop.answer(what, "key")  # type: ignore[arg-type]
    except TauextError as error:
        print_line(str(error))
    else:
        print_line(f"stored: {STORED[what]}")
