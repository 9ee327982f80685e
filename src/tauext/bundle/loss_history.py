"""How the loss fell while a bundle was trained, from the run file that training writes beside it."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from tauext import _core
from tauext.errors import ConfigError
from tauext.files.plain_file import json_of, read_text

LossHistory = list[list[float]]
"""[step, training loss, validation loss], by step."""


def read_loss_history(bundle: _core.Bundle, path: Path) -> LossHistory | None:
    """The history of the bundle that was loaded from this path, thinned; None where nothing was recorded.

    A bundle without its run file is a bundle that was copied, and nothing is wrong with it. A run file that cannot be
    read, or belongs to another bundle, is refused before hours of evaluation, not a curve to leave out.

    Raises:
        ConfigError: the run file is damaged, or of another training than the bundle.
    """
    run_file = path.with_suffix(".run.json")
    try:
        run = json_of(read_text(run_file))
        if not isinstance(run, dict):
            raise ValueError("it is no JSON object")
        history = check_history(run.get("loss_history") or [])
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise ConfigError(
            f"{run_file}: not a readable run file ({error}); train again, or remove it to do without its loss history"
        ) from error
    trained = json.loads(bundle.provenance or "{}")
    for key in sorted(run.keys() & trained.keys()):
        if run[key] != trained[key]:
            raise ConfigError(
                f"{run_file}: it is of another training than {path.name} ('{key}' differs); put the bundle's own "
                "there, or remove it to do without its loss history"
            )
    return thin(history) if history else None


def check_history(history: Any) -> LossHistory:
    """The same entries, if they are what they should be; else ValueError."""
    if not isinstance(history, list):
        raise ValueError("'loss_history' is no list")
    last = -1
    for k, entry in enumerate(history):
        kinds = [type(number) for number in entry] if isinstance(entry, list) else []
        if len(kinds) != 3 or kinds[0] is not int or not {*kinds} <= {int, float}:
            raise ValueError(
                f"loss_history[{k}] is {json.dumps(entry)[:60]}, must be [step, training, validation loss]"
            )
        if not entry[0] > last or not all(math.isfinite(loss) and loss >= 0 for loss in entry[1:]):
            raise ValueError(f"loss_history[{k}] is {entry}: steps must grow, losses be finite and not negative")
        last = entry[0]
    return history


def thin(history: LossHistory, most: int = 200) -> LossHistory:
    """At most so many entries: the first, the last, the lowest validation loss, and the closer the earlier.

    The loss falls fastest at the beginning, and is drawn over the logarithm of the steps.
    """
    if len(history) <= most:
        return history
    lowest = min(range(len(history)), key=lambda k: history[k][2])
    spread = (round((len(history) - 1) * (k / (most - 2)) ** 2) for k in range(most - 1))
    return [history[k] for k in sorted({*spread, lowest})]
