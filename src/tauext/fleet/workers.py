"""What a fleet's driver needs of those who do its tasks: processes of this machine, or Ray."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from tauext.fleet.task import Outcome, Task

Begun = Callable[[Task], None]
"""Called when somebody begins a task, where that is known."""


@dataclass(frozen=True)
class Ended:
    """A task that somebody did, or that nobody could do."""

    task: Task
    outcome: Outcome
    begun: int = 1
    """How often it was begun, where that is known."""


class Workers(Protocol):
    """A context: on its way out nobody works any more."""

    def __enter__(self) -> Workers: ...

    def __exit__(self, *error: object) -> None: ...

    def submit(self, task: Task) -> None:
        """It is done when somebody is free, in the order of these calls where they can choose."""

    def wait(self) -> Ended:
        """The next task that ends, in whatever order; there is one under way."""
