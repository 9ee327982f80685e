"""What a stage tells while it works: sentences, and how far it is. It prints nothing itself."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Protocol

Show = Callable[[int, int, str], None]
"""Called with what is done, of how many, and a note: `show(300, 1000, "loss 0.01")`."""


class Reporter(Protocol):
    """Takes what a stage tells: the command line prints it, a page may draw it."""

    def say(self, sentence: str) -> None:
        """One line for people; what is worth keeping stands in the run file, too."""

    def progress(self, title: str) -> AbstractContextManager[Show]:
        """Something long begins, and ends with the context: `with report.progress("train arm") as show: ...`."""


class Silent:
    """Tells nobody."""

    def say(self, sentence: str) -> None:
        pass

    def progress(self, title: str) -> AbstractContextManager[Show]:
        return nullcontext(lambda done, total, note: None)


SILENT = Silent()
