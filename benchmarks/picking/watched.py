"""What the monitor says of a take: with the gripper's word, without it, and with the load told exactly."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from carrying import load_of

from picking.takes import WINDOW_S
from tauext import Monitor, Recording, load_bundle
from tauext.data.recording_file import load_recording

FIRST_S = 1.3
"""Observer and alarms have warmed up."""
APART_S = 0.5
"""Collisions farther apart are two."""
AT_MOST_KG = 3.5
"""What the gripper says that it may pick up."""
LATE_S = 0.7
"""After the end of a contact its alarm may still come: the observer, and a decision."""
EARLY_S = 0.2
"""Before a table takes the load the gripper says that it will open."""
DOWN = 0.9
"""Cosine of the angle to gravity, 26 degrees, within which a force on the arm is listed apart: a load pulls so."""


@dataclass(frozen=True)
class Outcome:
    """Of one take."""

    arm: str
    take: str
    truth: dict[str, Any]
    seconds: float
    in_windows: int = 0
    """False collisions while a load, or its going, is expected."""
    elsewhere: int = 0
    told_elsewhere: int = 0
    """The same outside those windows where the load is told exactly (set_load) by somebody who sees it."""
    untold: int = 0
    mass_kg: float = 0.0
    """When the window is over."""
    error_kg: float = 0.0
    carried_kg: float = 0.0
    """Before it is put down."""
    left_kg: float = 0.0
    """At the end."""
    strength: float = 0.0
    """Of a contact: the largest of its torques, each over that joint's error in free motion."""
    down: bool = False
    delay_s: float | None = None
    plain_delay_s: float | None = None
    """Without the window."""


class Watch:
    """A monitor on a recording, told things on the way."""

    def __init__(self, bundle: Any, recording: Recording) -> None:
        self.monitor, self.recording, self.at = Monitor(bundle), recording, 0
        self.said: list[dict[str, np.ndarray]] = []

    def to(self, time_s: float) -> None:
        end = int(np.searchsorted(self.recording.time_s, time_s))
        rows, r = slice(self.at, end), self.recording
        if end > self.at:
            self.said.append(self.monitor.run(r.t_ns[rows], r.q[rows], r.dq[rows], r.tau[rows]))
        self.at = max(self.at, end)

    def collisions(self) -> np.ndarray:
        """Whether each sample shows one: over a limit, or an alarm that was held back until then."""
        self.to(np.inf)
        alarm = np.concatenate([said["alarm"] for said in self.said]) == 2
        detection = np.concatenate([said["detection"] for said in self.said]).astype(bool)
        return detection | (alarm & ~np.append(False, alarm[:-1]))

    def times(self) -> np.ndarray:
        """Of the collisions, [s], those that begin less than APART_S after another one left out."""
        at = self.recording.time_s[self.collisions() & (self.recording.time_s >= FIRST_S)]
        return at[np.append(True, np.diff(at) > APART_S)] if len(at) else at


def watch(arm: str, path: Path, data: Path, raw: Path, take: str, error_nm: list[float]) -> Outcome:
    bundle, recording = load_bundle(path), load_recording(data / f"{take}.parquet")
    truth = json.loads((raw / f"{take}.truth.json").read_text())
    facts = (
        picked(bundle, recording, truth) if truth["contact"] is None else touched(bundle, recording, truth, error_nm)
    )
    return Outcome(arm, take, truth, float(recording.time_s[-1] - FIRST_S), **facts)


def picked(bundle: Any, recording: Recording, truth: dict[str, Any]) -> dict[str, Any]:
    grasp, put = truth["grasp_s"], truth["put_s"]
    expects = Watch(bundle, recording)
    expects.to(grasp)
    expects.monitor.expect_load(WINDOW_S, AT_MOST_KG)
    expects.to(grasp + WINDOW_S + 0.1)
    found = expects.monitor.load.mass, expects.monitor.last.load_error_kg
    expects.to(put - EARLY_S)
    carried = expects.monitor.load.mass
    expects.monitor.expect_load(WINDOW_S, 0.0)
    at = expects.times()
    told = Watch(bundle, recording)
    told.to(truth["lift_s"] + truth["lifts_s"])
    told.monitor.set_load(**load_of(bundle, truth, 1.0, 0.03), since_ns=int(recording.t_ns[told.at - 1]))
    told.to(truth["put_s"])
    told.monitor.clear_load()
    told_at = told.times()
    begins = [grasp, put - EARLY_S]
    inside = np.any([(at >= begin) & (at <= begin + WINDOW_S + 0.5) for begin in begins], axis=0)
    told_inside = np.any([(told_at >= begin) & (told_at <= begin + WINDOW_S + 0.5) for begin in begins], axis=0)
    return {
        "in_windows": int(inside.sum()),
        "elsewhere": int((~inside).sum()),
        "told_elsewhere": int((~told_inside).sum()),
        "untold": len(Watch(bundle, recording).times()),
        "mass_kg": found[0],
        "error_kg": found[1],
        "carried_kg": carried,
        "left_kg": expects.monitor.load.mass,
    }


def touched(bundle: Any, recording: Recording, truth: dict[str, Any], error_nm: list[float]) -> dict[str, Any]:
    contact = truth["contact"]
    delays = {}
    for how in ("plain", "expects"):
        watched = Watch(bundle, recording)
        if truth["in_hand"]:
            watched.monitor.set_load(**load_of(bundle, truth, 1.0, 0.03))
        watched.to(truth["grasp_s"])
        if how == "expects":
            watched.monitor.expect_load(WINDOW_S, 0.0 if truth["in_hand"] else AT_MOST_KG)
        t = recording.time_s
        during = (t > contact["start_s"]) & (t < contact["end_s"] + LATE_S)
        at = t[watched.collisions() & during]
        delays[how] = float(at[0] - contact["start_s"]) if len(at) else None
    return {
        "strength": float(np.max(np.array(truth["peak_nm"]) / error_nm)),
        "down": -contact["direction"][2] >= DOWN,
        "delay_s": delays["expects"],
        "plain_delay_s": delays["plain"],
    }


def errors(path: Path, data: Path, takes: list[str]) -> list[float]:
    """RMS of tau_ext of each joint in free motion, [N m]."""
    squares = []
    for take in takes:
        recording = load_recording(data / f"{take}.parquet")
        said = Monitor(load_bundle(path)).run(recording.t_ns, recording.q, recording.dq, recording.tau)
        squares.append(np.nanmean(said["tau_ext"] ** 2, axis=0))
    return np.sqrt(np.mean(squares, axis=0)).tolist()
