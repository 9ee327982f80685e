"""Execution of reactions: a thread or process each, a bounded queue, and counts of dropped events."""

from __future__ import annotations

import json
import os
import select
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from tauext.errors import ConfigError
from tauext.monitor.cell_file import Reaction
from tauext.monitor.latency import Latencies
from tauext.monitor.sink import Publisher, ReactionEvent, Sink
from tauext.monitor.source import Source, StopChecked, Stoppable

# --- Commands and functions of reactions in processes of their own: a process that hangs is killed, one that died is
# restarted.
# No reaction blocks the monitor's interpreter, and no event makes it fork: the process waits from the start.


HELPER = Path(__file__).with_name("reaction_helper.py")


class ReactionFailed(Exception):
    """A reaction failed; the message gives the reason."""


class ReactionProcess:
    """Runs one reaction, event after event; used by one thread."""

    def __init__(self, reaction: Reaction):
        """Starts the process.

        Raises:
            ConfigError: the program, module or function is missing.
        """
        self._reaction, self._closed = reaction, False
        expect_program(reaction)
        try:
            self._start()
        except ReactionFailed as error:
            raise ConfigError(f"reaction {reaction.name!r}: {' '.join(self._words())}: {error}") from error

    def act(self, event: ReactionEvent) -> int:
        """Run the reaction for this event; returns its start by time.monotonic_ns().

        Raises:
            ReactionFailed: it failed, died, or was killed after the timeout; the next event gets a new process.
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
            with suppress(ReactionFailed):  # now, so that a process is ready for the next event
                self._start()
            raise
        if answer["error"] is not None:
            raise ReactionFailed(answer["error"])
        return started_ns

    def close(self) -> None:
        """Kill the process and all that it started; another thread's act() fails."""
        self._closed = True
        self._drop()

    def _drop(self) -> None:
        self._kill()
        for end in (self._process.stdin, self._answers):
            with suppress(OSError):
                if end is not None:
                    end.close()

    def _kill(self) -> int:
        """Kill the process and return its exit status, unless it was waited for: its id may have been reused."""
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
            start_new_session=True,  # Ctrl-C reaches only the monitor, and the group can be killed at once
        )
        os.close(writing)
        self._answers, self._read = os.fdopen(reading, "rb", buffering=0), b""
        answer = self._answer(time.monotonic() + 20.0)  # [s], to import a module
        if not answer.get("ready"):
            self._drop()
            raise ReactionFailed(answer.get("error", "it did not start"))

    def _answer(self, until: float) -> dict[str, Any]:
        """The next line that the process prints."""
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


def expect_program(reaction: Reaction) -> None:
    """Raise ConfigError if the program of the reaction is missing."""
    if reaction.command and shutil.which(reaction.command[0]) is None:
        raise ConfigError(f"reaction {reaction.name!r}: there is no program {reaction.command[0]!r}")


def content_of(event: ReactionEvent) -> dict[str, Any]:
    """The content of the line that is sent to the process."""
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
    return {"facts": event.content, "environment": environment}


# --- Execution of reactions: a thread each, a bounded queue, and counts of dropped events.


END_S = 2.0
"""Time for waiting events at the end of the loop."""


@dataclass(frozen=True)
class ReactionNews:
    """A reaction that ran or failed."""

    reaction: str
    event: ReactionEvent
    start_us: float | None
    """Time from the sample's reception to the start; None: not started."""
    error: str | None = None


@dataclass
class ReactionCount:
    """Counts of the events of one reaction; done + failed + merged + held_back + left = all matching events."""

    done: int = 0
    failed: int = 0
    merged: int = 0
    """Replaced by newer events of the same kind and joint."""
    held_back: int = 0
    """Less than min_interval_s after the one before."""
    left: int = 0
    """Not started, or not finished, when the loop ended."""
    start: Latencies = field(default_factory=Latencies)
    """Time from a sample's reception to the reaction's start."""

    def summary(self) -> dict:
        counts = {name: getattr(self, name) for name in ("done", "failed", "merged", "held_back", "left")}
        return counts | {"start": self.start.summary()}


class ReactionThread:
    """Thread of one reaction. Its queue is bounded: one event of each kind and joint."""

    def __init__(
        self, reaction: Reaction, act: Callable[[ReactionEvent], int | None], close: Callable[[], None] | None = None
    ):
        """act: runs the reaction; may return its start by time.monotonic_ns(), and may raise anything."""
        self.reaction, self.count = reaction, ReactionCount()
        self._act, self._close = act, close
        self._waiting: dict[tuple, ReactionEvent] = {}
        self._changed = threading.Condition()
        self._ended = False
        self._busy = self._left = False
        self._last_ns: dict[str, int] = {}
        self._answered: int | None = None
        """Number of the alarm for which a place rule has run, as it runs once an alarm."""
        self._news: list[ReactionNews] = []
        self._thread = threading.Thread(target=self._work, name=f"reaction {reaction.name}", daemon=True)
        self._thread.start()

    def put(self, event: ReactionEvent) -> None:
        """Queue the event; never waits for the reaction."""
        rule = self.reaction
        if event.kind not in rule.on or (rule.joints and event.joint is not None and event.joint not in rule.joints):
            return
        if not self._is_for(event):
            return
        last_ns = self._last_ns.get(event.kind)
        if last_ns is not None and event.received_ns - last_ns < rule.min_interval_s * 1e9:
            self.count.held_back += 1
            return
        self._last_ns[event.kind] = event.received_ns
        with self._changed:
            older = self._waiting.pop((event.kind, event.joint), None)
            if older is not None:
                self.count.merged += 1
                event = replace(event, merged=older.merged + 1)
            self._waiting[event.kind, event.joint] = event  # moved to the end: the latest event comes last
            self._changed.notify()

    def _is_for(self, event: ReactionEvent) -> bool:
        """Whether the rule applies to this event; a rule of a place applies once per alarm."""
        rule = self.reaction
        if event.kind not in ("collision", "contact"):
            return True
        if rule.links is None and rule.newtons_over is None:
            return event.news if rule.touch is None else event.touch in rule.touch and not event.of_place
        if self._answered == event.number or (rule.touch is not None and event.touch not in rule.touch):
            return False
        if rule.links is not None and sum(p for link, p in event.links if link in rule.links) < 0.5:
            return False
        if rule.newtons_over is not None and not (event.newtons is not None and event.newtons > rule.newtons_over):
            return False
        self._answered = event.number
        return True

    def news(self) -> list[ReactionNews]:
        """Reactions since the last call."""
        with self._changed:
            news, self._news = self._news, []
        return news

    def end(self, until: float) -> None:
        """Finish waiting events until this time.monotonic(), then abandon the rest."""
        with self._changed:
            self._ended = True
            self._changed.notify()
        self._thread.join(max(0.0, until - time.monotonic()))
        with self._changed:
            self._left = self._busy
            self.count.left += len(self._waiting) + self._busy
            self._waiting.clear()
        if self._close is not None:
            self._close()

    def _work(self) -> None:
        while True:
            with self._changed:
                while not self._waiting and not self._ended:
                    self._changed.wait()
                if not self._waiting:
                    return
                event = self._waiting.pop(next(iter(self._waiting)))
                self._busy = True
            began_ns, error = time.monotonic_ns(), None
            try:
                began_ns = self._act(event) or began_ns
            except BaseException as failure:  # SystemExit too: the next event may succeed
                began_ns = began_ns if not isinstance(failure, ReactionFailed) else 0
                error = str(failure) or type(failure).__name__
            with self._changed:
                if self._left:
                    return
                self._busy = False
                if began_ns:
                    self.count.start.add(began_ns - event.received_ns)
                self.count.done += error is None
                self.count.failed += error is not None
                start_us = (began_ns - event.received_ns) * 1e-3 if began_ns else None
                self._news.append(ReactionNews(self.reaction.name, event, start_us, error))


class Reactions:
    """All reactions of a monitor: a context; put() is called by the loop."""

    def __init__(self, threads: Sequence[ReactionThread] = ()):
        self.threads = tuple(threads)

    def put(self, event: ReactionEvent) -> None:
        """Queue the event for every reaction with a matching rule; returns at once."""
        for thread in self.threads:
            thread.put(event)

    def news(self) -> list[ReactionNews]:
        """Reactions since the last call."""
        return [news for thread in self.threads for news in thread.news()]

    def end(self) -> None:
        """Give all reactions END_S in total for waiting events, then end their processes."""
        until = time.monotonic() + END_S
        for thread in self.threads:
            thread.end(until)


def expect_actions(rules: Sequence[Reaction], source: Source, sinks: Sequence[Sink]) -> None:
    """Raise ConfigError if a program is missing, or this source, which need not be open, can never stop or publish."""
    for rule in rules:
        expect_program(rule)
        if rule.stop and not isinstance(source, Stoppable):
            raise ConfigError(f"reaction {rule.name!r}: source {source.name} has no way to stop its robot")
        if rule.publish and not any(isinstance(sink, Publisher) for sink in sinks):
            raise ConfigError(f"reaction {rule.name!r}: source {source.name} publishes nothing")


def start_reactions(rules: Sequence[Reaction], source: Source, sinks: Sequence[Sink]) -> Reactions:
    """Start a thread and, if needed, a process for each reaction.

    Raises:
        ConfigError: a program, module or function is missing, or the source cannot stop or publish.
    """
    expect_actions(rules, source, sinks)
    publishers = [sink for sink in sinks if isinstance(sink, Publisher)]
    processes: list[ReactionProcess] = []
    threads: list[Callable[[], ReactionThread]] = []

    def publish(event: ReactionEvent) -> None:
        for publisher in publishers:
            publisher.publish_event(event)

    try:
        for rule in rules:
            if rule.stop:
                assert isinstance(source, Stoppable)  # checked above
                if isinstance(source, StopChecked):
                    source.check_stop()
                threads.append(partial(ReactionThread, rule, lambda event: source.stop()))
            elif rule.publish:
                threads.append(partial(ReactionThread, rule, publish))
            else:
                process = ReactionProcess(rule)
                processes.append(process)
                threads.append(partial(ReactionThread, rule, process.act, process.close))
    except BaseException:
        for process in processes:
            process.close()
        raise
    return Reactions([start() for start in threads])
