"""What page and training do to the loop of `tauext commission`: a simulated arm in real time, without and with them.

    python benchmarks/commission_latency.py [--arm rig] [--seconds 150] [--core 1] [--priority 80]

The command runs twice: without a page, then with one whose live stream is read. A training begins after a minute of
motion. The loop states each second the 99 % quantile of the time from a sample's reception until every sink has its
verdict; the table has the median and the largest of these seconds.
"""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
from common import arguments, free_port, head, loop_arguments, loop_flags, table_row
from websockets.exceptions import WebSocketException
from websockets.sync.client import connect

READY_S = 60.0


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--arm", default="rig", help="of sim:, default: %(default)s")
    parser.add_argument("--seconds", type=float, default=150.0, help="of each run, default: %(default)s")
    loop_arguments(parser)
    options = parser.parse_args()
    flags = loop_flags(options)
    print("\n".join(head("page | training | seconds | p99, median of the seconds [µs] | largest [µs]")), flush=True)
    for with_page in (False, True):
        seen = measured(options.arm, options.seconds, with_page, flags)
        for trains in (False, True):
            values = [p99 for training, p99 in seen if training == trains]
            if values:
                shown = f"{np.median(values):.0f}", f"{max(values):.0f}"
                print(
                    table_row(*("yes" if one else "no" for one in (with_page, trains)), len(values), *shown), flush=True
                )


def measured(arm: str, seconds: float, with_page: bool, flags: list[str]) -> list[tuple[bool, float]]:
    """Whether a training ran, and the quantile [us], for each second of a run."""
    seen: list[tuple[bool, float]] = []
    with tempfile.TemporaryDirectory() as temporary:
        folder, port = Path(temporary) / "arm", free_port()
        words = ["commission", "--source", f"sim:{arm}", "--out", str(folder), *flags]
        words += ["--port", str(port)] if with_page else ["--no-page"]
        command = subprocess.Popen([sys.executable, "-m", "tauext", *words], stdout=subprocess.DEVNULL)
        try:
            live = connected(command, folder / "live.sock")
            if with_page:
                threading.Thread(target=read_page, args=(port,), daemon=True).start()
            end = time.monotonic() + seconds
            newest = 0.0
            for line in live.makefile():
                if time.monotonic() > end:
                    break
                p99 = json.loads(line).get("tick_p99_us")
                if p99 is not None and time.monotonic() > newest + 1:
                    newest = time.monotonic()
                    doing = ""
                    with suppress(OSError, ValueError):
                        doing = json.loads((folder / "trainer.json").read_text())["doing"]
                    seen.append((doing.startswith("training"), float(p99)))
            command.send_signal(signal.SIGINT)
            command.wait(READY_S)
        finally:
            command.kill()
            command.wait()
    return seen


def connected(command: subprocess.Popen[bytes], path: Path) -> socket.socket:
    until = time.monotonic() + READY_S
    while True:
        live = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            live.connect(str(path))
        except OSError:
            live.close()
            if command.poll() is not None:
                sys.exit(command.returncode)  # it has printed why
            if time.monotonic() > until:
                raise
            time.sleep(0.2)
        else:
            return live


def read_page(port: int) -> None:
    """Read the page's live stream, as a browser does."""
    with suppress(OSError, WebSocketException):
        time.sleep(2.0)
        with connect(f"ws://127.0.0.1:{port}/live", origin=f"http://127.0.0.1:{port}") as stream:
            for _ in stream:
                pass


if __name__ == "__main__":
    main()
