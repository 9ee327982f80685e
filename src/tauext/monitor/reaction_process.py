"""Commands and functions of reactions in processes of their own: what hangs is killed, what died is begun anew.

No reaction holds the monitor's interpreter, and no event makes it fork: the process waits for events from the start.
"""

from __future__ import annotations

import json
import os
import select
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from tauext.errors import ConfigError
from tauext.monitor.reaction_file import Reaction
from tauext.monitor.sink import Event

HELPER = Path(__file__).with_name("reaction_helper.py")
START_S = 20.0
"""A module that takes longer to import counts as broken."""


class ReactionFailed(Exception):
    """What went wrong in a reaction, in words."""


class ReactionProcess:
    """Runs one reaction, event after event; used by one thread."""

    def __init__(self, reaction: Reaction):
        """Starts the process.

        Raises:
            ConfigError: there is no such program, module or function.
        """
        self._reaction, self._closed = reaction, False
        if reaction.command and shutil.which(reaction.command[0]) is None:
            raise ConfigError(f"reaction {reaction.name!r}: there is no program {reaction.command[0]!r}")
        try:
            self._start()
        except ReactionFailed as error:
            raise ConfigError(f"reaction {reaction.name!r}: {' '.join(self._words())}: {error}") from error

    def act(self, event: Event) -> int:
        """Run it for this event; when it began, by time.monotonic_ns().

        Raises:
            ReactionFailed: it failed, died, or was killed since it took too long; the next one finds a new process.
        """
        try:
            if self._process.poll() is not None:
                self._start()
            until = time.monotonic() + self._reaction.timeout_s
            assert self._process.stdin is not None  # a pipe
            try:
                self._process.stdin.write(json.dumps(content_of(event)).encode() + b"\n")
                self._process.stdin.flush()
            except OSError:
                raise ReactionFailed("the process ended") from None
            started_ns, answer = 0, {}
            while "error" not in answer:
                answer = self._answer(until)
                started_ns = answer.get("started_ns", started_ns)
        except ReactionFailed:
            self._drop()
            with suppress(ReactionFailed):  # now, so that the next event finds one that is ready
                self._start()
            raise
        if answer["error"] is not None:
            raise ReactionFailed(answer["error"])
        return started_ns

    def close(self) -> None:
        """Kill the process and all that it started, for good; another thread's act() fails."""
        self._closed = True
        self._drop()

    def _drop(self) -> None:
        self._kill()
        for end in (self._process.stdin, self._answers):
            with suppress(OSError):
                if end is not None:
                    end.close()

    def _kill(self) -> int:
        """Its exit status; a process that has been waited for is not killed, its number may be another's by now."""
        if self._process.returncode is None:
            with suppress(OSError):
                os.killpg(self._process.pid, signal.SIGKILL)
        return self._process.wait()

    def _words(self) -> tuple[str, ...]:
        kind = "command" if self._reaction.command else "python"
        return (kind, *(self._reaction.command or (self._reaction.python,)))

    def _start(self) -> None:
        if self._closed:
            raise ReactionFailed("the monitor has ended")
        reading, writing = os.pipe()
        self._process = subprocess.Popen(
            [sys.executable, str(HELPER), str(writing), *self._words()],
            stdin=subprocess.PIPE,
            stdout=2,
            pass_fds=(writing,),
            start_new_session=True,  # a Ctrl-C at the terminal is for the monitor, and all of it can be killed at once
        )
        os.close(writing)
        self._answers, self._read = os.fdopen(reading, "rb", buffering=0), b""
        answer = self._answer(time.monotonic() + START_S)
        if not answer.get("ready"):
            self._drop()
            raise ReactionFailed(answer.get("error", "it did not start"))

    def _answer(self, until: float) -> dict[str, Any]:
        """The next line of the process."""
        while b"\n" not in self._read:
            left = until - time.monotonic()
            if left <= 0 or not select.select([self._answers], [], [], left)[0]:
                raise ReactionFailed(f"took longer than {self._reaction.timeout_s:g} s and was killed")
            more = self._answers.read(4096)
            if not more:
                with suppress(subprocess.TimeoutExpired):
                    self._process.wait(0.1)
                raise ReactionFailed(f"its process ended with status {self._kill()}")
            self._read += more
        line, _, self._read = self._read.partition(b"\n")
        return json.loads(line)


def content_of(event: Event) -> dict[str, Any]:
    """What the process is sent."""
    facts = {"event": event.kind, "joint": event.joint, "t_ns": event.t_ns, "merged": event.merged, **event.facts}
    j = event.facts["joints"].index(event.joint) if event.joint is not None and "joints" in event.facts else None
    environment = {
        "TAUEXT_EVENT": event.kind,
        "TAUEXT_JOINT": event.joint or "",
        "TAUEXT_TOUCH": event.touch or "",
        "TAUEXT_LINK": event.links[0][0] if event.links else "",
        "TAUEXT_NEWTONS": "" if event.newtons is None else f"{event.newtons:.4g}",
        "TAUEXT_T_NS": str(event.t_ns),
        "TAUEXT_HEALTH": str(event.facts.get("health", "")),
        "TAUEXT_CAUSES": ", ".join(event.facts.get("causes", ())),
    }
    limit = "contact_limit_nm" if event.kind == "contact" else "limit_nm"
    for variable, name in (("TAUEXT_TAU_EXT_NM", "tau_ext_nm"), ("TAUEXT_LIMIT_NM", limit)):
        value = event.facts[name][j] if j is not None and name in event.facts else None
        environment[variable] = "" if value is None else f"{value:.9g}"
    return {"facts": facts, "environment": environment}
