"""Tasks of a fleet and fleet.json: state, inputs and reasons."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tauext.files.plain_file import FORMAT
from tauext.files.provenance import VERSION, json_text
from tauext.files.toml_file import flat, plain
from tauext_fleet.fleet_file import (
    STAGES,
    Arm,
    Fleet,
    dataset_files,
    digests,
    files_of,
    like_files,
    robot_files,
    source_files,
)
from tauext_fleet.locations import Location, located, text_of, write_text
from tauext_fleet.task import Contents, Outcome, Task, finished, marker_of

# --- Tasks of a fleet: what each depends on, whether it is done, and why it is to be done again.


MOST_NAMED = 4
"""Number of changed inputs that are listed by name; further ones are counted."""
ARMS, MEMORY = "arms", "inputs.json"


@dataclass(frozen=True)
class Planned:
    """A task and its state before the run."""

    task: Task
    there: Outcome | None
    """Its outcome; None: it has to run."""
    why: str
    """Why it has to run; empty if it is done."""


@dataclass(frozen=True)
class PlannedArm:
    """An arm's tasks in order; each depends on the ones before it."""

    arm: Arm
    steps: tuple[Planned, ...]


def plan_fleet(
    fleet: Fleet, out: Location, show: Callable[[int, int], object] = lambda done, of: None
) -> list[PlannedArm]:
    """All tasks of all arms; contents of files not hashed yet are read.

    Args:
        out: folder of the fleet, which may not exist yet.
        show: called with the number of files read and the total.

    Raises:
        ConfigError: a file that cannot be read.
    """
    contents = Contents(out / MEMORY)
    try:
        contents.read((file for arm in fleet.arms for file in files_of(arm)), show)
    finally:
        if out.exists():
            contents.keep()
    return [plan_arm(arm, out, contents) for arm in fleet.arms]


def plan_arm(arm: Arm, out: Location, contents: Contents) -> PlannedArm:
    """The tasks of one arm."""
    steps: list[Planned] = []
    for task in tasks_of(arm, out, contents):
        before = next((step for step in steps if not step.why == "" and step.task.hash in task.inputs.values()), None)
        steps.append(planned(task, None if before is None else before.task.stage))
    return PlannedArm(arm, tuple(steps))


def tasks_of(arm: Arm, out: Location, contents: Contents) -> list[Task]:
    """In the order of the stages."""
    tasks: dict[str, Task] = {}
    data = data_inputs(arm, contents)
    robot = digests(robot_files(arm.robot), contents)
    dataset: Location | None = arm.dataset
    bundle: Location | None = None
    given: dict[str, Any] = {"name": arm.name, "robot": None if arm.robot is None else text_of(arm.robot)}
    accepted = {"accept": ", ".join(arm.accept)}

    def add(stage: str, inputs: Mapping[str, str], **work: Any) -> Task:
        folder = out / ARMS / arm.name / stage
        tasks[stage] = Task(arm.name, stage, text_of(folder), {"name": arm.name, **inputs}, given | work)
        return tasks[stage]

    for stage in arm.stages:
        if stage == "import":
            sources = [text_of(source) for source in arm.sources]
            named = {"sources": ", ".join(source.name for source in arm.sources)}
            files = digests(source_files(arm), contents)
            made = add(stage, named | files, sources=sources, description=text_of(arm.description))
            dataset, data = located(made.folder) / arm.name, {"import": made.hash}
        elif stage == "check":
            add(stage, data | robot | accepted, dataset=text_of(dataset), accept=list(arm.accept))
        elif stage == "train":
            settings = without_threads(plain(arm.train.resolved()))
            depends_on = (
                {"case": arm.case or ""} | accepted | flat(settings, "train.") | digests(like_files(arm), contents)
            )
            work = {"case": arm.case, "accept": list(arm.accept), "settings": without_threads(plain(arm.train))}
            work |= {"like": None if arm.like is None else text_of(arm.like)}
            made = add(stage, data | robot | depends_on, dataset=text_of(dataset), **work)
            bundle = located(made.folder) / f"{arm.name}.tauext"
        elif stage == "calibrate":
            settings, used = plain(arm.calibrate), data
            if arm.calibration is not None:
                files = digests(dataset_files(arm.calibration, "calibration"), contents)
                used = {"calibration": arm.calibration.name} | files
            work = {
                "dataset": text_of(arm.calibration or dataset),
                "accept": list(arm.accept),
                "settings": settings,
            }
            depends_on = {"train": tasks["train"].hash} | accepted | flat(settings, "calibrate.")
            made = add(stage, used | depends_on, bundle=text_of(bundle), **work)
            bundle = located(made.folder) / f"{arm.name}.tauext"
        else:
            settings, maker = plain(arm.evaluate), "calibrate" if "calibrate" in tasks else "train"
            depends_on = {maker: tasks[maker].hash} | flat(settings, "evaluate.")
            add(
                stage,
                data | depends_on,
                dataset=text_of(dataset),
                bundle=text_of(bundle),
                settings=settings,
            )
    return list(tasks.values())


def data_inputs(arm: Arm, contents: Contents) -> dict[str, str]:
    """Of the arm's own dataset; where it is imported, the import's inputs count instead."""
    if arm.dataset is None:
        return {}
    return {"dataset": arm.dataset.name} | digests(dataset_files(arm.dataset, "dataset"), contents)


def without_threads(settings: dict[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in settings.items() if key != "threads"}


def planned(task: Task, before: str | None) -> Planned:
    """before: required stage that is still to be done; None: none."""
    there = finished(task)
    if there is not None:
        return Planned(task, there, "")
    folder = located(task.folder)
    marker = marker_of(folder)
    if marker is None:
        failed = folder.with_name(f"{task.stage}.failed.txt").exists()
        return Planned(task, None, "failed last time" if failed else "not done yet")
    if marker.hash == task.hash:
        return Planned(task, None, f"an output is missing or of another size: {marker.lacks(folder)}")
    if marker.build != task.build:
        return Planned(task, None, f"made by tauext {marker.build}, this is {task.build}")
    changed = changes(marker.inputs, task.inputs)
    if before is not None and changed == [before]:
        return Planned(task, None, f"{before} is done again")
    more = f" and {len(changed) - MOST_NAMED} more" if len(changed) > MOST_NAMED else ""
    return Planned(task, None, f"inputs changed: {', '.join(changed[:MOST_NAMED])}{more}")


def changes(old: Mapping[str, str], new: Mapping[str, str]) -> list[str]:
    """Names of inputs that were changed, removed or added."""
    return [name for name in {**new, **old} if old.get(name) != new.get(name)]


# --- fleet.json: state, inputs and reason of failure of every stage of every arm.


FILE = "fleet.json"
EVERY_S = 5.0
"""Least time between two writes of the file while tasks end."""


class Book:
    """State of each task: done, refused, failed, skipped or waiting."""

    def __init__(self, fleet: Fleet, plan: Sequence[PlannedArm], out: Location):
        self._fleet, self._plan, self._out = fleet, plan, out
        self._outcomes: dict[tuple[str, str], Outcome] = {}
        self._written = time.monotonic()

    def note(self, task: Task, outcome: Outcome) -> None:
        self._outcomes[task.arm, task.stage] = outcome

    def of(self, arm: str, stage: str) -> Outcome:
        """Outcome of the task, `waiting` before it ends."""
        return self._outcomes.get((arm, stage), Outcome("waiting"))

    def state(self, arm: PlannedArm) -> str:
        """done, failed (a stage failed, or refuses), or waiting."""
        states = {self.of(arm.arm.name, step.task.stage).state for step in arm.steps}
        return "failed" if states & {"failed", "refused"} else "waiting" if "waiting" in states else "done"

    @property
    def plan(self) -> Sequence[PlannedArm]:
        return self._plan

    @property
    def path(self) -> Location:
        return self._out / FILE

    def counts(self) -> dict[str, int]:
        """Arms by their state."""
        found = Counter(self.state(arm) for arm in self._plan)
        return {"arms": len(self._plan)} | {state: found[state] for state in ("done", "failed", "waiting")}

    def failures(self) -> list[tuple[str, str, str]]:
        """Arm, stage and reason of every arm that failed."""
        return [
            (arm.arm.name, step.task.stage, standing.reason)
            for arm in self._plan
            for step in arm.steps
            if (standing := self.of(arm.arm.name, step.task.stage)).state in ("failed", "refused")
        ]

    def write(self, now: bool = True) -> None:
        """now: write at once; else only if the last write was some seconds ago."""
        if not now and time.monotonic() - self._written < EVERY_S:
            return
        content = {"format": FORMAT, "version": VERSION, "fleet": self._fleet.path.name, "counts": self.counts()}
        write_text(self.path, json_text(content | {"arms": [self._arm(arm) for arm in self._plan]}))
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
        entry = {"name": name, "type": arm.arm.type, "state": self.state(arm)}
        return entry | {"dataset": data, "bundle": bundle, "results": results, "stages": stages}

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
