"""Reactions at work: a thread each, a bounded queue, and counts of whatever was not done."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

from tauext.errors import ConfigError
from tauext.monitor.latency import Latencies
from tauext.monitor.reaction_file import Reaction
from tauext.monitor.reaction_process import ReactionFailed, ReactionProcess
from tauext.monitor.sink import Event, Publisher, Sink
from tauext.monitor.source import Source, Stoppable

LEAST_PROBABILITY = 0.5
"""That one of a rule's links is touched: more likely than not."""
END_S = 2.0
"""At the end of the loop reactions have so long for what still waits."""


@dataclass(frozen=True)
class ReactionNews:
    """A reaction that was done, or failed."""

    reaction: str
    event: Event
    start_us: float | None
    """From the sample's reception to its start; None where it did not get that far."""
    error: str | None = None


@dataclass
class ReactionCount:
    """What became of events for one reaction; done + failed + merged + held_back + left = the events that it is for."""

    done: int = 0
    failed: int = 0
    merged: int = 0
    """Newer ones of the same kind and joint stood for them."""
    held_back: int = 0
    """Sooner than min_interval_s."""
    left: int = 0
    """Not begun, or not ended, when the loop ended."""
    start: Latencies = field(default_factory=Latencies)
    """From a sample's reception to the reaction's start."""

    def summary(self) -> dict:
        counts = {name: getattr(self, name) for name in ("done", "failed", "merged", "held_back", "left")}
        return counts | {"start": self.start.summary()}


class ReactionThread:
    """One reaction. Its queue holds one event of each kind and joint: it cannot grow."""

    def __init__(self, reaction: Reaction, act: Callable[[Event], int | None], close: Callable[[], None] | None = None):
        """act: does it, and may return when it began, by time.monotonic_ns(); raises what it likes."""
        self.reaction, self.count = reaction, ReactionCount()
        self._act, self._close = act, close
        self._waiting: dict[tuple, Event] = {}
        self._changed = threading.Condition()
        self._ended = False
        self._busy = self._left = False
        self._last_ns: dict[str, int] = {}
        self._answered_ns: int | None = None
        """The alarm, by when it rose, that a rule of a place has answered: once is enough."""
        self._news: list[ReactionNews] = []
        self._thread = threading.Thread(target=self._work, name=f"reaction {reaction.name}", daemon=True)
        self._thread.start()

    def put(self, event: Event) -> None:
        """Never waits for the reaction."""
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
            self._waiting[event.kind, event.joint] = event  # last: a reaction ends with what came last
            self._changed.notify()

    def _is_for(self, event: Event) -> bool:
        """Whether what the rule waits for is known, and has not been answered."""
        rule = self.reaction
        if event.kind not in ("collision", "contact"):
            return True
        if rule.links is None and rule.newtons_over is None:
            return event.news if rule.touch is None else event.touch in rule.touch and not event.of_place
        if self._answered_ns == event.alarm_t_ns or (rule.touch is not None and event.touch not in rule.touch):
            return False
        if rule.links is not None and sum(p for link, p in event.links if link in rule.links) < LEAST_PROBABILITY:
            return False
        if rule.newtons_over is not None and not (event.newtons is not None and event.newtons > rule.newtons_over):
            return False
        self._answered_ns = event.alarm_t_ns
        return True

    def news(self) -> list[ReactionNews]:
        """What was done since the last call."""
        with self._changed:
            told, self._news = self._news, []
        return told

    def end(self, until: float) -> None:
        """Let it finish what waits, but not beyond this time.monotonic(); then leave it."""
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
            except BaseException as failure:  # SystemExit too: whatever it is, the next event may go well
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

    def put(self, event: Event) -> None:
        """Hand the event to every reaction that is for it; returns at once."""
        for thread in self.threads:
            thread.put(event)

    def news(self) -> list[ReactionNews]:
        """What was done since the last call."""
        return [news for thread in self.threads for news in thread.news()]

    def end(self) -> None:
        """Give all of them END_S together for what still waits; then end their processes."""
        until = time.monotonic() + END_S
        for thread in self.threads:
            thread.end(until)


def start_reactions(rules: Sequence[Reaction], source: Source, sinks: Sequence[Sink]) -> Reactions:
    """A thread, and where it needs one a process, for each reaction.

    Raises:
        ConfigError: a program, module or function is not there; or the source cannot stop, and nothing publishes.
    """
    publishers = [sink for sink in sinks if isinstance(sink, Publisher)]
    processes: list[ReactionProcess] = []
    threads: list[Callable[[], ReactionThread]] = []
    try:
        for rule in rules:
            if rule.stop:
                if not isinstance(source, Stoppable):
                    raise ConfigError(f"reaction {rule.name!r}: source {source.name} has no way to stop its robot")
                threads.append(partial(ReactionThread, rule, _stop(source)))
            elif rule.publish:
                if not publishers:
                    raise ConfigError(f"reaction {rule.name!r}: source {source.name} publishes nothing; ros2 does")
                threads.append(partial(ReactionThread, rule, _publish_to(publishers)))
            else:
                process = ReactionProcess(rule)
                processes.append(process)
                threads.append(partial(ReactionThread, rule, process.act, process.close))
    except BaseException:
        for process in processes:
            process.close()
        raise
    return Reactions([start() for start in threads])


def _stop(source: Stoppable) -> Callable[[Event], None]:
    return lambda event: source.stop()


def _publish_to(publishers: Sequence[Publisher]) -> Callable[[Event], None]:
    def publish(event: Event) -> None:
        for publisher in publishers:
            publisher.publish_event(event)

    return publish
