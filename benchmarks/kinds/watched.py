"""What the monitor says of a touch: when its alarm came, and what kind it was taken for as time went on."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tauext import Monitor, Touch, load_bundle
from tauext.data.recording_file import load_recording

DEADLINE_S = 0.2
"""Since the alarm."""
EARLY_S = 0.005
"""Stamps jitter: an alarm so long before the touch is one of it."""


@dataclass(frozen=True)
class Watched:
    """One touch; the kinds are none where it raised no alarm."""

    arm: str
    name: str
    kind: str
    """That it is."""
    way: str
    rise_s: float
    """Of a push."""
    delay_s: float
    """From the touch to its alarm; NaN: there was none."""
    told: str = "none"
    """DEADLINE_S after the alarm."""
    told_s: float = np.nan
    """Since when it has been that."""
    last: str = "none"
    """At the end of the recording, a second after the touch."""
    ever: tuple[str, ...] = ()


def watch(arm: str, bundle: Path, data: Path, raw: Path, name: str) -> Watched:
    truth = json.loads((raw / f"{name}.truth.json").read_text())
    recording = load_recording(data / f"{name}.parquet")
    said = Monitor(load_bundle(bundle)).run(recording.t_ns, recording.q, recording.dq, recording.tau)
    facts = (arm, name, truth["kind"], truth["way"], truth.get("rise_s", 0.0))
    time_s = recording.time_s
    over = np.flatnonzero((said["held_alarm"] > 0) & (time_s >= truth["start_s"] - EARLY_S))
    if not len(over):
        return Watched(*facts, np.nan)
    since_s = time_s[over[0] :] - time_s[over[0]]
    kinds = np.array(said["touch"][over[0] :])
    known = kinds[since_s <= DEADLINE_S]
    other = np.flatnonzero(known != known[-1])
    return Watched(
        *facts,
        float(time_s[over[0]] - truth["start_s"]),
        Touch(int(known[-1])).name,
        float(since_s[other[-1] + 1]) if len(other) else 0.0,
        Touch(int(kinds[-1])).name,
        tuple(Touch(int(kind)).name for kind in np.unique(kinds)),
    )
