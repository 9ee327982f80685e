"""Recordings of a simulated fleet: some minutes of arms that work already, and of new ones all that judges them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from unseen.arms import Maker
from unseen.cold import command
from unseen.recordings import Take, description, write_take

FLEET_TAKES = (Take("work-1", "train", 3), Take("work-2", "train", 3, 0, 600))
NEW_TAKES = (
    Take("own-1", "train", 1, 0, 120),
    Take("own-2", "train", 4.5, 0, 180),
    Take("own-3", "train", 4.5, 0, 600),
    Take("free-1", "test", 4, 0, 60),
    Take("contacts-1", "collisions", 4, 25, 360),
    Take("contacts-2", "collisions", 4, 25, 900),
)
"""The first minute of its own is all that a prior gets; the test begins at another time of the day."""


def make_arm(maker: Maker, seed: int, folder: Path, takes: Sequence[Take]) -> Path:
    """The dataset of one arm of the maker's type, simulated and imported with its URDF; not what is there."""
    raw, data = folder / "csv", folder / "data"
    raw.mkdir(parents=True, exist_ok=True)
    missing = [k for k, take in enumerate(takes) if not (raw / f"{take.name}.truth.npz").exists()]
    for number in missing:
        write_take(maker, seed, number, raw, takes)
    if missing or not data.is_dir():
        (raw / "arm.toml").write_text(description(maker, seed, True, takes))
        files = [str(raw / f"{take.name}.csv") for take in takes]
        command("import", "--source", *files, "--arm", raw / "arm.toml", "--out", data)
    return data
