"""Progress reports of stages: sentences and counts. Nothing here prints."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol

Show = Callable[[int, int, str], None]
"""Called with count done, total count and a note: `show(300, 1000, "loss 0.01")`."""


class Reporter(Protocol):
    """Receives a stage's progress; the command line prints it, a page draws it."""

    def say(self, sentence: str) -> None:
        """Report one sentence; lasting facts are also in the run file."""

    def progress(self, title: str) -> AbstractContextManager[Show]:
        """Context of a long task: `with report.progress("train arm") as show: ...`."""


class Silent:
    """Discards all messages."""

    def say(self, sentence: str) -> None:
        pass

    def progress(self, title: str) -> AbstractContextManager[Show]:
        return nullcontext(lambda done, total, note: None)


SILENT = Silent()
