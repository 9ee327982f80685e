"""Many arms: what stands in FLEET.toml as tasks with their inputs' hash, done once, by whichever worker."""

from tauext.fleet.fleet_file import Arm, Fleet, load_fleet
from tauext.fleet.plan import Planned, plan_fleet
from tauext.fleet.run import FleetEnd, Watcher, run_fleet
from tauext.fleet.task import Outcome, Task

__all__ = [
    "Arm",
    "Fleet",
    "FleetEnd",
    "Outcome",
    "Planned",
    "Task",
    "Watcher",
    "load_fleet",
    "plan_fleet",
    "run_fleet",
]
