"""A worker process: reads tasks from stdin, one JSON a line, does them, and writes outcomes to stdout.

It ends when its stdin does: a killed driver leaves no worker running.
"""

from __future__ import annotations

import json
import os
import queue
import signal
import sys
import threading
from dataclasses import asdict

from tauext_fleet.stages import STAGES
from tauext_fleet.task import expect_json, run_task


def work() -> None:
    """Do tasks until stdin ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C goes to the driver, which stops the workers
    reports = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # output of libraries is no outcome
    waiting: queue.SimpleQueue[str] = queue.SimpleQueue()
    threading.Thread(target=read_on, args=(waiting,), daemon=True).start()
    while True:
        outcome = run_task(expect_json(json.loads(waiting.get())), STAGES)
        reports.write(json.dumps(asdict(outcome)) + "\n")
        reports.flush()


def read_on(waiting: queue.SimpleQueue[str]) -> None:
    """Hand on what comes, and end the process with its driver, in the midst of a task too."""
    for line in sys.stdin:
        waiting.put(line)
    os._exit(0)


if __name__ == "__main__":
    work()
