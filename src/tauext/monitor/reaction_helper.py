"""Process that runs commands and functions of reactions.

It is started by its path and needs only the standard library. A line of JSON on stdin is an event, {"facts": {...},
"environment": {...}}; answers are lines on the file descriptor given first: {"ready": true}, then for each event
{"started_ns": time.monotonic_ns()} and {"error": null or text}.
"""

import json
import os
import signal
import subprocess
import sys
import threading
import time
import typing

Begun = typing.Callable[[], None]
Act = typing.Callable[[dict, Begun], None]
"""Runs the action for an event and calls the given function at its start."""


def main() -> None:
    """helper.py FD command WORD... | FD python MODULE:FUNCTION."""
    descriptor, kind, *words = sys.argv[1:]
    answers = os.fdopen(int(descriptor), "w")

    def answer(**content: object) -> None:
        answers.write(json.dumps(content) + "\n")
        answers.flush()

    usual_priority()
    threading.Thread(target=end_with, args=(os.getppid(),), daemon=True).start()
    try:
        act = command(words) if kind == "command" else function(words[0])
    except BaseException as error:
        answer(ready=False, error=f"{type(error).__name__}: {error}")
        return
    answer(ready=True)
    for line in sys.stdin:
        try:
            act(json.loads(line), lambda: answer(started_ns=time.monotonic_ns()))
        except Exception as error:
            answer(error=f"{type(error).__name__}: {error}" if str(error) else type(error).__name__)
        else:
            answer(error=None)


def usual_priority() -> None:
    """Allow any core and reset to normal priority, regardless of the monitor's settings."""
    try:
        os.sched_setaffinity(0, range(os.cpu_count() or 1))
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    except (AttributeError, OSError):  # unsupported, or not permitted and then never set
        pass


def end_with(monitor: int) -> None:
    """End this process and all that it started when the monitor is killed."""
    while os.getppid() == monitor:
        time.sleep(0.5)
    os.killpg(0, signal.SIGKILL)


def command(words: list) -> Act:
    """Make the action that runs a program with the facts in its environment and as JSON on stdin."""

    def act(event: dict, started: Begun) -> None:
        with subprocess.Popen(words, stdin=subprocess.PIPE, stdout=2, env=os.environ | event["environment"]) as process:
            started()
            process.communicate(json.dumps(event["facts"]).encode() + b"\n")
        if process.returncode:
            raise RuntimeError(f"exit status {process.returncode}")

    return act


def function(name: str) -> Act:
    """Make the action that calls the function with the facts."""
    import importlib

    sys.path.insert(0, os.getcwd())
    module, _, attribute = name.partition(":")
    called = getattr(importlib.import_module(module), attribute)
    if not callable(called):
        raise TypeError(f"{name} cannot be called")

    def act(event: dict, started: Begun) -> None:
        started()
        called(event["facts"])

    return act


if __name__ == "__main__":
    main()
