"""fleet.json: per arm and stage what stands, of what inputs, and why where it does not."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

from tauext.files.place import Place
from tauext.files.provenance import VERSION, write_json
from tauext.fleet.fleet_file import STAGES, Fleet
from tauext.fleet.plan import PlannedArm
from tauext.fleet.task import Outcome, Task

FILE, FORMAT = "fleet.json", 1
EVERY_S = 5.0
"""Between two writings while tasks end."""


class Book:
    """How each task stands: done, refused, failed, skipped or waiting."""

    def __init__(self, fleet: Fleet, plan: Sequence[PlannedArm], out: Place):
        self._fleet, self._plan, self._out = fleet, plan, out
        self._outcomes: dict[tuple[str, str], Outcome] = {}
        self._written = time.monotonic()

    def note(self, task: Task, outcome: Outcome) -> None:
        self._outcomes[task.arm, task.stage] = outcome

    def of(self, arm: str, stage: str) -> Outcome:
        """How it stands."""
        return self._outcomes.get((arm, stage), Outcome("waiting"))

    def state(self, arm: PlannedArm) -> str:
        """done, failed (a stage failed, or refuses), or waiting."""
        states = {self.of(arm.arm.name, step.task.stage).state for step in arm.steps}
        return "failed" if states & {"failed", "refused"} else "waiting" if "waiting" in states else "done"

    @property
    def plan(self) -> Sequence[PlannedArm]:
        return self._plan

    @property
    def path(self) -> Place:
        return self._out / FILE

    def counts(self) -> dict[str, int]:
        """Arms by their state."""
        found = Counter(self.state(arm) for arm in self._plan)
        return {"arms": len(self._plan)} | {state: found[state] for state in ("done", "failed", "waiting")}

    def failures(self) -> list[tuple[str, str, str]]:
        """Arm, stage and reason of every arm that failed."""
        return [
            (arm.arm.name, step.task.stage, said.reason)
            for arm in self._plan
            for step in arm.steps
            if (said := self.of(arm.arm.name, step.task.stage)).state in ("failed", "refused")
        ]

    def write(self, now: bool = True) -> None:
        """now: else only where the last writing is some seconds ago."""
        if not now and time.monotonic() - self._written < EVERY_S:
            return
        content = {"format": FORMAT, "version": VERSION, "fleet": self._fleet.path.name, "counts": self.counts()}
        write_json(content | {"arms": [self._arm(arm) for arm in self._plan]}, self.path)
        self._written = time.monotonic()

    def _arm(self, arm: PlannedArm) -> dict[str, Any]:
        name, dataset = arm.arm.name, arm.arm.dataset
        stages = {step.task.stage: self._stage(step.task) for step in arm.steps}
        imported = self.of(name, "import").state == "done"
        data = f"arms/{name}/import/{name}" if imported else None if dataset is None else str(dataset)
        made = [stage for stage in ("train", "calibrate") if self.of(name, stage).state == "done"]
        wanted = [stage for stage in ("train", "calibrate") if stage in stages]
        bundle = f"arms/{name}/{made[-1]}/{name}.tauext" if made and made == wanted else None
        results = f"arms/{name}/evaluate" if self.of(name, "evaluate").state == "done" else None
        said = {"name": name, "serial": arm.arm.serial, "date": arm.arm.date or None, "type": arm.arm.type}
        said |= {"state": self.state(arm)}
        return said | {"dataset": data, "bundle": bundle, "results": results, "stages": stages}

    def _stage(self, task: Task) -> dict[str, Any]:
        outcome = self.of(task.arm, task.stage)
        ran = outcome.state not in ("waiting", "skipped")
        seconds = round(outcome.seconds, 3) if ran else None
        return {"state": outcome.state, "hash": task.hash, "seconds": seconds, "reason": outcome.reason or None}


def stage_counts(book: Book) -> dict[str, Counter[str]]:
    """States of the tasks by stage, in the order of the stages."""
    found: dict[str, Counter[str]] = {stage: Counter() for stage in STAGES}
    for arm in book.plan:
        for step in arm.steps:
            found[step.task.stage][book.of(arm.arm.name, step.task.stage).state] += 1
    return {stage: counts for stage, counts in found.items() if counts}
