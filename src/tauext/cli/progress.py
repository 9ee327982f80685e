"""Output of commands: sentences and progress bars on stderr, so that stdout stays clean; tables."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any, Self

from tauext.progress import Show, in_plain_letters

PLAIN_LINE_EVERY_S = 10.0


class ProgressBar:
    """One bar at a time: `with ProgressBar("train exact") as bar: bar.update(done, total, "loss 0.01")`."""

    def __init__(self, title: str):
        self._title = title
        self._bar: Any = None  # rich.progress.Progress
        self._task: Any = None
        self._started = self._last_line = time.monotonic()
        self._first: tuple[int, float] | None = None
        """What was done at the first update, and when: a resumed training begins with the steps of its checkpoint."""

    def __enter__(self) -> ProgressBar:
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                TextColumn("{task.completed:.0f}/{task.total:.0f}  {task.fields[note]}"),
                TimeElapsedColumn(),
                TextColumn("left"),
                TimeRemainingColumn(),
            )
            self._bar = Progress(*columns, console=Console(stderr=True))
            self._task = self._bar.add_task(self._title, total=1, note="")
            self._bar.start()
        return self

    def update(self, done: int, total: int, note: str = "") -> None:
        """Show that `done` of `total` are done; on a plain stream at most a line every few seconds."""
        if self._bar is not None:
            self._bar.update(self._task, completed=done, total=total, note=note)
            return
        now = time.monotonic()
        first, since = self._first = self._first or (done, now)
        if done < total and now - self._last_line < PLAIN_LINE_EVERY_S:
            return
        self._last_line = now
        left = f", {(now - since) / (done - first) * (total - done):.0f} s left" if first < done < total else ""
        print(f"{self._title}: {done}/{total} {note}, {now - self._started:.0f} s{left}", file=sys.stderr, flush=True)

    def __exit__(self, kind: type | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._bar is not None:
            self._bar.stop()


class Terminal:
    """Prints a line a sentence, and draws a bar for whatever takes long (see tauext.progress.Reporter)."""

    def say(self, sentence: str) -> None:
        print(in_plain_letters(sentence), file=sys.stderr)

    @contextmanager
    def progress(self, title: str) -> Iterator[Show]:
        with ProgressBar(title) as bar:
            yield bar.update


class PrintContext:
    """A context in which a command prints events; subclasses that redraw a view keep it in `_live`."""

    _live: Any = None  # rich.live.Live

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._live is not None:
            self._live.stop()
