"""What a trained bundle depends on beside the data, so that it is told apart from one of other settings."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from tauext.config import FreeMotionConfig, ModelCase, TrainConfig
from tauext.errors import ConfigError
from tauext.files.plain_file import json_of, read_text
from tauext.recipes import Recipe


def training_settings(case: ModelCase, config: TrainConfig) -> dict:
    """What the trained bundle depends on beside the data; not the number of threads."""
    plain = asdict(config.resolved())
    if config.backend == "core":
        del plain["backend"]
    if config.minutes is None:
        del plain["minutes"]
    if config.margins == FreeMotionConfig():
        del plain["margins"]
    if config.load_frame is None:
        del plain["load_frame"]
    if config.fit_torque_constants is None:
        del plain["fit_torque_constants"]
    if config.torque_constants is None:
        del plain["torque_constants"]
    settings = {"case": asdict(case), "config": {k: v for k, v in plain.items() if k not in config.row.unused}}
    return json.loads(json.dumps(settings))  # as a file gives them back: lists, no tuples


def finished(bundle: Path, case: ModelCase, config: TrainConfig) -> bool:
    """Whether this bundle was already trained with these settings.

    Raises:
        ConfigError: a bundle of other settings stands there.
    """
    run = bundle.with_suffix(".run.json")
    if not bundle.exists() or not run.exists():
        return False
    settings = run_settings(run)
    if settings == training_settings(case, config):
        return True
    raise ConfigError(f"{bundle}: it was trained with other settings; choose another --out or remove it")


def run_settings(run: Path) -> dict:
    """The settings in a run file.

    Raises:
        ConfigError: it is damaged.
    """
    try:
        return json_of(read_text(run))["settings"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(
            f"{run}: not a readable run file ({error}); remove it and the bundle, or train elsewhere"
        ) from error


def why_impossible(recipe: Recipe, case: ModelCase) -> str | None:
    """Why there is no such bundle; None: there is."""
    if recipe.needs_model and case.no_model:
        return f"recipe = {recipe.name} needs a model, which the case '{case.name}' has not: {recipe.needs_model}"
    return None
