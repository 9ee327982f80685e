"""Arms that were trained warm and are met cold: takes of both, made and imported as an integrator would."""

from __future__ import annotations

import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from unseen.arms import Maker
from unseen.recordings import Take, description, write_take

WARM_S = 1800.0
"""Five times the slowest warm-up: nothing falls any more."""
MORNING_S = 70.0
TAKES = (
    Take("warm-1", "train", 3, 0, WARM_S),
    Take("warm-2", "train", 3, 6, WARM_S),
    Take("warm-3", "train", 3, 0, WARM_S),
    Take("morning", "test", MORNING_S / 60, 0, 0),
    Take("cold-1", "test", 5, 0, MORNING_S),
    Take("cold-2", "test", 5, 0, MORNING_S),
    Take("cold-3", "test", 5, 0, MORNING_S),
    Take("touched", "collisions", 5, 25, MORNING_S),
)
"""The morning's minute, and what follows it, drawn several times."""


def make_cold(maker: Maker, folder: Path, seed: int, workers: int) -> Path:
    """The dataset of an arm with its URDF, and a bundle of recipe prior from its warm takes; not what is there.

    Returns: the bundle; the dataset stands beside it, in data.
    """
    raw, data, bundle = folder / "csv", folder / "data", folder / "warm.tauext"
    raw.mkdir(parents=True, exist_ok=True)
    missing = [number for number, take in enumerate(TAKES) if not (raw / f"{take.name}.truth.npz").exists()]
    with ProcessPoolExecutor(workers) as pool:
        for done in [pool.submit(write_take, maker, seed, number, raw, TAKES) for number in missing]:
            done.result()
    if missing or not data.is_dir():
        (raw / "arm.toml").write_text(description(maker, seed, True, TAKES))
        files = [str(raw / f"{take.name}.csv") for take in TAKES]
        command("import", "--source", *files, "--arm", raw / "arm.toml", "--out", data)
    if missing or not bundle.exists():
        command("train", "--data", data, "--recipe", "prior", "--out", bundle)
    return bundle


def command(*arguments: str | Path) -> None:
    """Run `tauext ARGUMENTS`; RuntimeError with what it printed where it failed."""
    words = [sys.executable, "-m", "tauext", *map(str, arguments)]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    if ended.returncode:
        raise RuntimeError(f"{' '.join(words)}:\n{ended.stdout}{ended.stderr}")
