"""Output beside the loop: a terminal that draws, or a pipe that nobody reads, delays no sample."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable

MOST_WAITING = 1000
"""Things to tell before those that may be left out are: twenty seconds of chunks."""
END_S = 5.0
"""A reader has so long for what is left at the end."""


class Aside:
    """Does one thing after the other in a thread: a context, whose end waits for what is left.

    The first thing that raises ends it: the rest is left out, `failed` is called, and the end of the context raises it.
    """

    def __init__(self, failed: Callable[[], None]):
        self.left_out = 0
        """Things that were not told, as too many waited."""
        self._failed = failed
        self._error: BaseException | None = None
        self._waiting: queue.SimpleQueue[Callable[[], None] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name="output", daemon=True)

    def __enter__(self) -> Aside:
        self._thread.start()
        return self

    def __exit__(self, kind: type | None, error: BaseException | None, trace: object) -> None:
        self._waiting.put(None)
        self._thread.join(END_S)
        if self._error is not None and error is None:
            raise self._error

    def do(self, what: Callable[[], None], may_be_left_out: bool = False) -> None:
        """Returns at once."""
        if may_be_left_out and self._waiting.qsize() > MOST_WAITING:
            self.left_out += 1
        else:
            self._waiting.put(what)

    def _work(self) -> None:
        while (what := self._waiting.get()) is not None:
            try:
                what()
            except BaseException as error:
                self._error = error
                self._failed()
                return
