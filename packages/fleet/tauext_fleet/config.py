"""Settings of a fleet: its workers, and the stages whose commands have options instead."""

from __future__ import annotations

import os
from dataclasses import dataclass

from tauext_lab.evaluate.config import EventsConfig

from tauext.config import MOST_THREADS, AlarmConfig, require, require_seed
from tauext.errors import ConfigError


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

    seed: int = 0
    """Seed of the choice of the ten collisions."""
    keep_free_estimates: int = 20
    """Number of free-motion test recordings, from the first, whose estimates are written."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_seed(self.seed)
        require(self.keep_free_estimates >= 0, "keep_free_estimates", self.keep_free_estimates, ">= 0")


@dataclass(frozen=True)
class FleetConfig:
    """Workers of a fleet's tasks. No output depends on it."""

    workers: int = 0
    """Worker processes of Ray on this machine, one thread each; 0: one a core."""
    retries: int = 2
    """Number of retries of a task whose worker died (killed, out of memory, node lost). A task that reports an error is
    not retried."""
    ray: str | None = None
    """Address of the Ray cluster that runs the tasks; auto: the one that this machine belongs to. None: workers of this
    machine alone."""
    task_gb: float = 0.0
    """Memory that a task reserves on a node of Ray, [GB]; 0: none, and only cores count."""

    def __post_init__(self) -> None:
        most = f"0 (one a core) to {MOST_THREADS}"
        require(0 <= self.workers <= MOST_THREADS, "workers", self.workers, most)
        require(0 <= self.retries <= 100, "retries", self.retries, "0 to 100")
        require(0 <= self.task_gb <= 1e6, "task_gb", self.task_gb, ">= 0, at most 1e6")
        own, words = self.ray is None, "left out with a cluster, whose nodes have their own"
        require(not own or self.task_gb == 0, "task_gb", self.task_gb, "left out unless --ray is given")
        require(own or self.workers == 0, "workers", self.workers, words)


@dataclass(frozen=True)
class StoreConfig:
    """Timeouts and retries of object stores."""

    connect_s: float = 5.0
    """Time to establish a connection, [s]."""
    stall_s: float = 20.0
    """Time without data after which a request is retried, [s]. Even a slow line sends something every second."""
    tries: int = 4
    """Number of attempts of a request, with growing pauses, before the command fails."""

    @classmethod
    def of_environment(cls) -> StoreConfig:
        """TAUEXT_STORE_STALL_S and TAUEXT_STORE_TRIES, where they are set.

        Raises:
            ConfigError: one of them is no number, or out of range.
        """
        try:
            stall_s = float(os.environ.get("TAUEXT_STORE_STALL_S") or cls.stall_s)
            tries = int(os.environ.get("TAUEXT_STORE_TRIES") or cls.tries)
        except ValueError as error:
            raise ConfigError(f"TAUEXT_STORE_STALL_S and TAUEXT_STORE_TRIES must be numbers ({error})") from error
        require(1 <= stall_s <= 3600, "TAUEXT_STORE_STALL_S", stall_s, "1 to 3600")
        require(1 <= tries <= 100, "TAUEXT_STORE_TRIES", tries, "1 to 100")
        return cls(min(cls.connect_s, stall_s), stall_s, tries)
