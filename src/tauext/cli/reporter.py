"""What a stage tells, on a terminal: sentences and a progress bar, all on stderr, so that stdout stays clean."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager

from tauext.cli.progress import ProgressBar
from tauext.progress import Show


class Terminal:
    """Prints a line a sentence, and draws a bar for whatever takes long (see tauext.progress.Reporter)."""

    def say(self, sentence: str) -> None:
        print(sentence, file=sys.stderr)

    @contextmanager
    def progress(self, title: str) -> Iterator[Show]:
        with ProgressBar(title) as bar:
            yield bar.update
