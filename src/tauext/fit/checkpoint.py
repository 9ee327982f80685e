"""Training state on disk, so that an interrupted run goes on where it stood."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from tauext.errors import ConfigError
from tauext.files.whole_file import whole_file
from tauext.fit.adam import Adam


@dataclass
class TrainState:
    """Everything that moves while training. Fields are replaced, never changed in place, so a copy stays as it is."""

    at: tuple[np.ndarray, Adam]  # parameters (float64) and the optimiser's state
    history: list[tuple[int, float, float]]  # (step, training loss, validation loss), scaled units
    best: np.ndarray  # float32, the parameters of the lowest validation loss so far
    seconds: float = 0.0
    running_loss: float | None = None
    """The training loss as the next entry of the history goes on from it; None before the first step."""


def save_checkpoint(state: TrainState, settings: dict, path: Path) -> None:
    """Write under a temporary name, then rename: an interruption leaves the last whole checkpoint."""
    parameters, adam = state.at
    with whole_file(path) as part, part.open("wb") as file:
        np.savez(
            file,
            parameters=parameters,
            m=adam.m,
            v=adam.v,
            steps=adam.steps,
            history=np.array(state.history, dtype=float).reshape(-1, 3),
            best=state.best,
            seconds=state.seconds,
            running_loss=np.nan if state.running_loss is None else state.running_loss,
            settings=json.dumps(settings, sort_keys=True),
        )


def load_checkpoint(settings: dict, path: Path) -> TrainState | None:
    """The state of an interrupted run with these settings, or None where there is no checkpoint.

    Raises:
        ConfigError: the checkpoint belongs to other settings or is damaged; names what differs.
    """
    if not path.exists():
        return None
    advice = "remove it to start anew, or write elsewhere"
    try:
        with np.load(path, allow_pickle=False) as stored:
            theirs = json.loads(str(stored["settings"]))
            running = float(stored["running_loss"])
            state = TrainState(
                (stored["parameters"], Adam(stored["m"], stored["v"], int(stored["steps"]))),
                [(int(step), float(loss), float(validation)) for step, loss, validation in stored["history"]],
                stored["best"],
                float(stored["seconds"]),
                None if np.isnan(running) else running,
            )
    except (OSError, KeyError, ValueError, BadZipFile) as error:
        raise ConfigError(f"{path}: this checkpoint cannot be read ({error}); {advice}") from error
    differing = sorted(key for key in settings.keys() | theirs.keys() if settings.get(key) != theirs.get(key))
    if differing:
        raise ConfigError(f"{path}: this checkpoint is of a run with other settings ({', '.join(differing)}); {advice}")
    return state
