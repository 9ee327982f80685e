"""What a stage reports while it works: sentences, progress, and wall times. A stage prints nothing itself."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from typing import Protocol

Show = Callable[[int, int, str], None]
"""Called with count done, total count and a note: `show(300, 1000, "loss 0.01")`."""


def in_plain_letters(text: str) -> str:
    """A text without characters that would act on a terminal: names of files and joints may hold them."""
    return "".join(one if one.isprintable() or one in "\n\t" else ascii(one)[1:-1] for one in text)


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """A line a row; the first column is aligned on its left, all others on their right."""
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]))]
    return [
        "  ".join([row[0].ljust(widths[0]), *(one.rjust(w) for one, w in zip(row[1:], widths[1:], strict=True))])
        for row in rows
    ]


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


@dataclass
class WallTimes:
    """Wall time of each phase of a stage, [s], in the order in which the phases began: `with times.phase("fit"): ...`.

    Phases do not nest. A phase that runs twice counts both times.
    """

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Add the time inside the context to the phase of this name."""
        self.seconds.setdefault(name, 0.0)
        started = time.monotonic()
        try:
            yield
        finally:
            self.seconds[name] += time.monotonic() - started

    def facts(self) -> dict[str, float]:
        """Facts for the file of wall times: NAME_s by phase."""
        return {f"{name}_s": round(seconds, 3) for name, seconds in self.seconds.items()}

    def sentence(self) -> str:
        """`took 9.5 s: check 1.2, fit 8.3`; phases shorter than 0.05 s are left out."""
        parts = [f"{name} {seconds:.1f}" for name, seconds in self.seconds.items() if seconds >= 0.05]
        total = f"took {sum(self.seconds.values()):.1f} s"
        return f"{total}: {', '.join(parts)}" if parts else total
