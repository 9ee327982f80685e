"""A thread beside the loop that does one thing after the other: output, recordings, files for viewers."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable


class BackgroundWorker:
    """Calls what it is given in a thread, in order. The first thing that raises ends it: the rest is left out."""

    def __init__(self, name: str, most_waiting: int, failed: Callable[[], object] = lambda: None):
        """
        Args:
            most_waiting: number of things that may wait.
            failed: called in the thread after an error.
        """
        self.patient = False
        """Whether put() waits for the thread instead of leaving things out: for a source faster than real time."""
        self.error: BaseException | None = None
        self._most, self._failed = most_waiting, failed
        self._waiting: queue.SimpleQueue[Callable[[], object] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._work, name=name, daemon=True)

    def start(self) -> None:
        self._thread.start()

    def put(self, what: Callable[[], object], must: bool = False) -> bool:
        """Hand over one thing at once; returns whether it will be done: False if too many wait.

        Args:
            must: do it however many wait.
        """
        while self.patient and self._waiting.qsize() >= self._most and self._thread.is_alive():
            time.sleep(1e-3)
        will_be_done = must or self.patient or self._waiting.qsize() < self._most
        if will_be_done:
            self._waiting.put(what)
        return will_be_done

    def end(self, wait_s: float | None = None) -> None:
        """Wait until everything is done, at most so long; None: without a bound."""
        self._waiting.put(None)
        self._thread.join(wait_s)

    def _work(self) -> None:
        while (what := self._waiting.get()) is not None:
            try:
                what()
            except BaseException as error:
                self.error = error
                self._failed()
                return
