"""Settings of a fleet: its workers, and the stages whose commands have options instead."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from tauext.config import AT_LEAST_0, AlarmConfig, EventsConfig, Seed, Settings, Threads, require, within


@dataclass(frozen=True)
class CalibrateStage(AlarmConfig):
    """Settings of a fleet's stage calibrate."""

    refit_error_scale: bool = False
    """Refit how errors grow with the motion, on the first fifth of the calibration recordings."""

    @property
    def alarm(self) -> AlarmConfig:
        """The promised false alarm rate alone."""
        return AlarmConfig(**{name: getattr(self, name) for name in AlarmConfig.__dataclass_fields__})


@dataclass(frozen=True)
class EvaluateStage(EventsConfig):
    """Settings of a fleet's stage evaluate."""

    seed: Seed = 0
    """Seed of the choice of the ten collisions."""
    keep_free_estimates: Annotated[int, AT_LEAST_0] = 20
    """Number of free-motion test recordings, from the first, whose estimates are written."""


@dataclass(frozen=True)
class FleetConfig(Settings):
    """Workers of a fleet's tasks. No output depends on it."""

    workers: Threads = 0
    """Worker processes of Ray on this machine, one thread each; 0: one a core."""
    retries: Annotated[int, within(0, 100)] = 2
    """Number of retries of a task whose worker died (killed, out of memory, node lost). A task that reports an error is
    not retried."""
    ray: str | None = None
    """Address of the Ray cluster that runs the tasks; auto: the one that this machine belongs to. None: workers of this
    machine alone."""
    task_gb: Annotated[float, within(0, 1e6)] = 0.0
    """Memory that a task reserves on a node of Ray, [GB]; 0: none, and only cores count."""

    def __post_init__(self) -> None:
        super().__post_init__()
        own, words = self.ray is None, "left out with a cluster, whose nodes have their own"
        require(not own or self.task_gb == 0, "task_gb", self.task_gb, "left out unless --ray is given")
        require(own or self.workers == 0, "workers", self.workers, words)
