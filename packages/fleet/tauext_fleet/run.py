"""The driver: starts tasks whose inputs exist, and records their outcomes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from tauext.files.preflight import expect_folder
from tauext_fleet.book import ARMS, Book, Planned, PlannedArm, plan_fleet
from tauext_fleet.config import FleetConfig
from tauext_fleet.fleet_file import Fleet
from tauext_fleet.locations import Location
from tauext_fleet.store import Stored, StoreError
from tauext_fleet.task import Outcome, Task, clean, locked
from tauext_fleet.workers import Ended, Workers


class Watcher(Protocol):
    """Receives progress; the command line prints it."""

    def reading(self, done: int, of: int) -> None:
        """So many of all files are read to detect changes."""

    def started(self, plan: Sequence[PlannedArm]) -> None:
        """All tasks, done or not."""

    def begun(self, task: Task) -> None:
        """A worker of this machine begins it; a cluster has it in its queue."""

    def ended(self, ended: Ended) -> None:
        """It is done, refused or failed."""


@dataclass
class FleetEnd:
    """How a run ended."""

    book: Book
    done_now: int = 0
    """Tasks that this run did."""
    kept: int = 0
    """Tasks that had been done before."""


@dataclass
class Progress:
    """Which task of each arm comes next."""

    book: Book
    left: dict[str, list[Planned]] = field(default_factory=dict)
    """Steps of an arm that are neither done nor given to a worker, by the arm's name."""
    end: FleetEnd = field(init=False)

    def __post_init__(self) -> None:
        self.end = FleetEnd(self.book)

    def next_of(self, arm: str) -> Task | None:
        """The next task to run; finished tasks are skipped, and nothing follows a refused one."""
        while self.left[arm]:
            step = self.left[arm].pop(0)
            if step.there is None:
                return step.task
            self.end.kept += 1
            if not self.settled(step.task, step.there):
                break
        return None

    def settled(self, task: Task, outcome: Outcome) -> bool:
        """Note how it ended; whether the arm may go on."""
        self.book.note(task, outcome)
        if outcome.state == "done":
            return True
        for step in self.left[task.arm]:
            self.book.note(step.task, Outcome("skipped", f"{task.stage} {outcome.state}"))
        self.left[task.arm].clear()
        return False


def run_fleet(fleet: Fleet, out: Location, config: FleetConfig, watcher: Watcher) -> FleetEnd:
    """Run all tasks that are not done yet; OUT/fleet.json holds the state of all, after an interruption too.

    Tasks are given out in the order in which they become possible, so that all imports come before the first training:
    faults are reported early.

    Raises:
        ConfigError: a folder that cannot be written to, another driver in it, no cluster.
        KeyboardInterrupt: as it came; what was finished is kept.
    """
    if isinstance(out, Stored):
        expect_bucket(out)
    else:
        expect_folder(out)
        out.mkdir(parents=True, exist_ok=True)
    with locked(out):
        for arm in fleet.arms:
            clean(out / ARMS / arm.name)
        plan = plan_fleet(fleet, out, watcher.reading)
        book = Book(fleet, plan, out)
        watcher.started(plan)
        progress = Progress(book, {one.arm.name: list(one.steps) for one in plan})
        try:
            first = [task for one in plan if (task := progress.next_of(one.arm.name)) is not None]
            if first:
                with Workers(config, len(first), watcher.begun) as workers:
                    work_off(first, workers, progress, watcher)
        finally:
            book.write()
            for arm in fleet.arms:
                clean(out / ARMS / arm.name)
    return progress.end


def expect_bucket(out: Stored) -> None:
    """Raise StoreError where the bucket does not exist or cannot be reached."""
    if not Stored(out.bucket, "", out.query).exists():
        raise StoreError(f"{out}: there is no bucket '{out.root}'; make it, or correct the URL")


def work_off(first: Sequence[Task], workers: Workers, progress: Progress, watcher: Watcher) -> None:
    """Run tasks until none is possible."""
    under_way = 0
    for task in first:
        workers.submit(task)
        under_way += 1
    while under_way:
        ended = workers.wait()
        under_way -= 1
        progress.end.done_now += ended.outcome.state != "failed"
        on = progress.settled(ended.task, ended.outcome)
        watcher.ended(ended)
        progress.book.write(now=False)
        following = progress.next_of(ended.task.arm) if on else None
        if following is not None:
            workers.submit(following)
            under_way += 1
