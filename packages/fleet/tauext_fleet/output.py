"""Output of `tauext fleet run`: a table on a terminal, lines elsewhere, JSON lines for programs."""

from __future__ import annotations

import json
import sys
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

from tauext.cli.progress import PrintContext
from tauext.progress import aligned
from tauext_fleet.book import Book, PlannedArm, stage_counts
from tauext_fleet.fleet_file import STAGES
from tauext_fleet.run import FleetEnd
from tauext_fleet.task import Outcome, Task
from tauext_fleet.workers import Ended

MOST_ROWS = 60
"""Arms that are listed one by one at the end; of more, stages are counted."""
READING_EVERY_S = 5.0
"""Between two lines while files are read, which terabytes take long."""
STATES = ("done", "refused", "failed", "skipped", "waiting")


def open_watcher(as_json: bool) -> JsonLines | TextLines:
    """JSON lines if as_json, a table that is redrawn on a terminal, else a line a task."""
    if as_json:
        return JsonLines()
    if sys.stderr.isatty():
        return LiveTable()
    return TextLines()


class JsonLines(PrintContext):
    """On stdout, an object an event; docs/reference/files.md lists them."""

    def __init__(self) -> None:
        self._out = sys.stdout  # also while Ray has another one

    def reading(self, done: int, of: int) -> None:
        pass

    def started(self, plan: Sequence[PlannedArm]) -> None:
        steps = [step for arm in plan for step in arm.steps]
        to_do = sum(step.there is None for step in steps)
        self._write("start", arms=len(plan), tasks=len(steps), to_do=to_do)

    def begun(self, task: Task) -> None:
        self._write("begun", arm=task.arm, stage=task.stage)

    def ended(self, ended: Ended) -> None:
        self._write("task", **about(ended.task), **outcome_facts(ended.outcome))

    def finish(self, end: FleetEnd) -> None:
        failed = [{"arm": arm, "stage": stage, "reason": why} for arm, stage, why in end.book.failures()]
        counts = end.book.counts() | {"done_now": end.done_now, "kept": end.kept}
        self._write("summary", **counts, failures=failed, file=str(end.book.path))

    def _write(self, event: str, **content: Any) -> None:
        print(json.dumps({"event": event} | content, allow_nan=False), file=self._out, flush=True)


class TextLines(PrintContext):
    """A line on stderr for each task that ends; tables and failures on stdout at the end."""

    def __init__(self) -> None:
        self._done = self._of = 0
        self._printed_s = time.monotonic()

    def reading(self, done: int, of: int) -> None:
        if time.monotonic() - self._printed_s > READING_EVERY_S:
            self._printed_s = time.monotonic()
            self.print_line(f"reading what the arms depend on: {done} of {of} files")

    def started(self, plan: Sequence[PlannedArm]) -> None:
        steps = [step for arm in plan for step in arm.steps]
        self._of = sum(step.there is None for step in steps)
        self.print_line(f"{len(plan)} arms, {len(steps)} tasks, of which {len(steps) - self._of} are done already")

    def begun(self, task: Task) -> None:
        pass

    def ended(self, ended: Ended) -> None:
        self._done += 1
        self.print_line(f"[{self._done}/{self._of}] {task_line(ended)}")

    def finish(self, end: FleetEnd) -> None:
        for line in summary_lines(end):
            print(line)

    def print_line(self, line: str) -> None:
        print(line, file=sys.stderr, flush=True)


class LiveTable(TextLines):
    """Text lines on a terminal, where a table of stages is redrawn below the lines of what failed."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.live import Live

        super().__init__()
        self._console = Console(stderr=True, highlight=False)
        self._live = Live(console=self._console, refresh_per_second=4, transient=True)
        self._counts: dict[str, Counter[str]] = {}
        self._running: list[str] = []

    def started(self, plan: Sequence[PlannedArm]) -> None:
        self._counts = {stage: Counter() for stage in STAGES}
        for step in (step for arm in plan for step in arm.steps):
            self._counts[step.task.stage][step.there.state if step.there else "waiting"] += 1
        super().started(plan)
        self._draw()

    def begun(self, task: Task) -> None:
        self._running.append(f"{task.arm} {task.stage}")
        self._draw()

    def ended(self, ended: Ended) -> None:
        task = ended.task
        self._done += 1
        if f"{task.arm} {task.stage}" in self._running:
            self._running.remove(f"{task.arm} {task.stage}")
        self._counts[task.stage]["waiting"] -= 1
        self._counts[task.stage][ended.outcome.state] += 1
        if ended.outcome.state != "done":
            self.print_line(task_line(ended))
        self._draw()

    def print_line(self, line: str) -> None:
        self._console.print(line, markup=False)

    def _draw(self) -> None:
        from rich.table import Table

        shown = ("done", "refused", "failed", "waiting")
        table = Table(*("stage", *shown), title=f"{self._done}/{self._of} tasks", title_justify="left")
        for stage, counts in self._counts.items():
            if counts:
                table.add_row(stage, *(str(counts[state] or "") for state in shown))
        few = self._running[:8]
        more = f" and {len(self._running) - len(few)} more" if len(self._running) > len(few) else ""
        table.caption = f"under way: {', '.join(few)}{more}" if few else ""
        self._live.update(table)


def print_plan(plan: Sequence[PlannedArm], as_json: bool) -> None:
    """Print what would be done, and why; the first stage of each arm gives the reason, the later ones follow from
    it."""
    to_do = 0
    for arm in plan:
        for step in arm.steps:
            to_do += step.there is None
            if as_json:
                state = "to do" if step.there is None else step.there.state
                event = {"event": "task", **about(step.task), "state": state, "why": step.why or None}
                print(json.dumps(event, allow_nan=False))
            elif step.there is None:
                print(f"{arm.arm.name} {step.task.stage}: {step.why}")
            elif step.there.state == "refused":
                print(f"{arm.arm.name} {step.task.stage}: done, and refuses what follows: {step.there.reason}")
    tasks = sum(len(arm.steps) for arm in plan)
    if as_json:
        print(json.dumps({"event": "plan", "arms": len(plan), "tasks": tasks, "to_do": to_do}))
    else:
        print(f"{to_do} of {tasks} tasks of {len(plan)} arms would be done")


def about(task: Task) -> dict[str, Any]:
    return {"arm": task.arm, "stage": task.stage, "hash": task.hash}


def outcome_facts(outcome: Outcome) -> dict[str, Any]:
    return {"state": outcome.state, "seconds": round(outcome.seconds, 3), "reason": outcome.reason or None}


def task_line(ended: Ended) -> str:
    """`cell-01 train: done in 12.3 s`."""
    task, outcome = ended.task, ended.outcome
    if outcome.state == "done":
        return f"{task.arm} {task.stage}: done in {outcome.seconds:.1f} s"
    return f"{task.arm} {task.stage}: {outcome.state}: {outcome.reason}"


def summary_lines(end: FleetEnd) -> list[str]:
    """Stages of every arm, or counts where there are many; then a line a failed arm, and the sum."""
    book = end.book
    lines = arm_table(book) if len(book.plan) <= MOST_ROWS else stage_table(book)
    lines.append("")
    for arm, stage, why in book.failures():
        lines.append(f"{arm}: {stage} {book.of(arm, stage).state}: {why}")
    counts = book.counts()
    lines.append(
        f"{counts['done']} of {counts['arms']} arms are done, {counts['failed']} failed; "
        f"{end.done_now} tasks were done now, {end.kept} before"
    )
    return [*lines, str(book.path)]


def arm_table(book: Book) -> list[str]:
    """A row an arm, a column a stage: seconds where it is done, else its state."""
    stages = list(stage_counts(book))
    rows = [["arm", *stages]]
    for arm in book.plan:
        has = {step.task.stage for step in arm.steps}
        rows.append([arm.arm.name, *(cell(book.of(arm.arm.name, stage)) if stage in has else "-" for stage in stages)])
    return aligned(rows)


def cell(outcome: Outcome) -> str:
    return f"{outcome.seconds:.1f} s" if outcome.state == "done" else outcome.state


def stage_table(book: Book) -> list[str]:
    """A row a stage, a column a state."""
    found = stage_counts(book)
    shown = [state for state in STATES if any(counts[state] for counts in found.values())]
    return aligned(
        [["stage", *shown], *([stage, *(str(counts[state]) for state in shown)] for stage, counts in found.items())]
    )
