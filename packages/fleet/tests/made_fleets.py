"""Small fleets: planar arms whose friction differs, a simulated dataset, and workers in the same process."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from made_planar import dataset, moving
from tauext_fleet import run
from tauext_fleet.config import FleetConfig
from tauext_fleet.fleet_file import load_fleet
from tauext_fleet.run import FleetEnd
from tauext_fleet.stages import STAGES
from tauext_fleet.task import Stage, Task, run_task
from tauext_fleet.workers import Ended
from tauext_lab.sim.collect import simulate_dataset
from tauext_lab.sim.config import RigConfig

FRICTION = ((1.0, 0.9), (0.8, 1.1), (1.2, 1.0), (0.9, 1.2), (1.1, 0.8), (1.0, 3.0))
"""Of each arm's joints by that of the type; the last arm's elbow is the odd one."""


def fleet(folder: Path) -> list[Path]:
    """Datasets of two minutes and a half each."""
    return [dataset(folder / f"arm-{k}" / "data", moving(k, 150.0, one)) for k, one in enumerate(FRICTION)]


QUICK = '[train]\nrecipe = "observer"\n[evaluate]\nkeep_free_estimates = 1\n'


def small_dataset(folder: Path) -> Path:
    """The planar rig for a minute, with one recording of collisions."""
    simulate_dataset(folder, RigConfig(), 0, 1.0, 1, lambda *told: None)
    return folder


def write_fleet(folder: Path, text: str) -> Path:
    path = folder / "fleet.toml"
    path.write_text(text)
    return path


QUIET = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "stdin": subprocess.DEVNULL}


def started(fleet: Path, out: Path, *more: str, **settings: Any) -> subprocess.Popen:
    """The command in a process of its own."""
    command = [sys.executable, "-m", "tauext", "fleet", "run", str(fleet), "--out", str(out), *more]
    return subprocess.Popen(command, **settings)


def process_of(part: Path) -> int:
    """The worker's that writes this folder of an unfinished task."""
    named = re.search(r"-(\d+)-\w+$", part.name)
    assert named is not None
    return int(named[1])


def arms_of(*names: str, dataset: str, more: str = "") -> str:
    return "".join(f'[[arms]]\nname = "{name}"\ndataset = "{dataset}"\n{more}\n' for name in names)


class Here:
    """Workers: this process, one task after the other; notes what was done."""

    def __init__(self, stages: Mapping[str, Stage]) -> None:
        self._stages = stages
        self.done: list[tuple[str, str]] = []
        self._waiting: deque[Task] = deque()

    def __enter__(self) -> Here:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def submit(self, task: Task) -> None:
        self._waiting.append(task)

    def wait(self) -> Ended:
        task = self._waiting.popleft()
        self.done.append((task.arm, task.stage))
        return Ended(task, run_task(task, self._stages))


class Nobody:
    """Watches and says nothing."""

    def reading(self, done, of) -> None:
        pass

    def started(self, plan) -> None:
        pass

    def begun(self, task) -> None:
        pass

    def ended(self, ended) -> None:
        pass


def says_what_it_was_told(work: Mapping[str, Any], part: Path) -> None:
    """A stage that takes no time, and whose output depends on all that it is called with."""
    (part / "told.json").write_text(json.dumps(work))


QUICKER: dict[str, Stage] = dict.fromkeys(STAGES, says_what_it_was_told)


def workers_here(monkeypatch, stages: Mapping[str, Stage]) -> Here:
    """Whoever runs a fleet gets these."""
    here = Here(stages)
    monkeypatch.setattr(run, "Workers", lambda *settings: here)
    return here


def run_here(
    fleet: Path, out: Path, monkeypatch, stages: Mapping[str, Stage] = STAGES
) -> tuple[FleetEnd, list[tuple[str, str]]]:
    """How it ended, and which tasks were done in which order."""
    here = workers_here(monkeypatch, stages)
    return run.run_fleet(load_fleet(fleet), out, FleetConfig(), Nobody()), here.done


def written(out: Path) -> dict[str, bytes]:
    """Every file of the arms but wall times, and the book without its seconds."""
    files = sorted(path for path in (out / "arms").rglob("*") if path.is_file())
    found = {str(p.relative_to(out)): p.read_bytes() for p in files if not p.name.endswith("wall_time_s.json")}
    book = json.loads((out / "fleet.json").read_text())
    for arm in book["arms"]:
        for stage in arm["stages"].values():
            del stage["seconds"]
    return found | {"fleet.json": json.dumps(book).encode()}


def touched(out: Path) -> dict[str, int]:
    """When each file of the arms was written."""
    return {str(p.relative_to(out)): p.stat().st_mtime_ns for p in (out / "arms").rglob("*") if p.is_file()}
