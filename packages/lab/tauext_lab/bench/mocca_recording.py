"""The recording of the paper's own arm: its segments, collisions, motor torque, and what its authors' network needs.

DATA holds collisions.csv and no_model_network/, made from the authors' code [Mocca2020] (docs/references.md). The file
states the observer's output for the exact model at RECORDED_GAIN_PER_S, so the motor torque follows from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.config import PAPER_CASES, FreeMotionConfig
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.robot.model_case import estimated_model
from tauext_lab.sim.config import RigConfig
from tauext_lab.sim.rig import arm_xml, joint_names

RECORDED_GAIN_PER_S = 5.0
"""Gain K0 of the recorded observer: the authors' no-model network fits the torque that follows from it, no other."""
RATE_HZ = 100.0
ONSETS_S = {0: (5.57,), 1: (2.66,), 2: (3.81,), 4: (4.18, 12.06), 5: (13.42, 24.42), 6: (2.84,), 7: (2.92,), 8: (6.95,)}
"""Onsets of the ten collisions by segment, read off the signals by eye, [s]."""
LEAST_S = 1.0
"""Shorter segments are left out."""
MARGINS = FreeMotionConfig(before_s=0.0, after_s=0.0)
"""Of near_contact, which begins 0.3 s before a collision and ends 1.2 s after it."""


@dataclass(frozen=True)
class Segment:
    """Rows of one move or several, 10 ms apart, from the first row with an observer's output on."""

    number: int
    time_s: np.ndarray
    """(samples,), from the file's start of the segment."""
    q: np.ndarray
    """(samples, 2), [rad]."""
    dq: np.ndarray
    residual: np.ndarray
    """(samples, 2): r of docs/method/theory.md, minus the file's, for the exact model, [N m]."""
    early_lstm: np.ndarray
    """The same of the authors' early network (five steps, 40 units) on these rows."""
    near_contact: np.ndarray
    """(samples,) bool: from before a collision's onset to about a second after it, by the file."""

    @property
    def onsets_s(self) -> np.ndarray:
        """Onset of each collision on the clock of time_s."""
        return np.array(ONSETS_S.get(self.number, ()))


def read_segments(data: Path) -> list[Segment]:
    """The segments of DATA/collisions.csv of at least LEAST_S.

    Raises:
        ConfigError: there is no such file, or it lacks a column.
    """
    path = data / "collisions.csv"
    if not path.is_file():
        raise ConfigError(f"{path}: is no file; DATA is the folder that holds it")
    rows = np.genfromtxt(path, delimiter=",", names=True)
    names = rows.dtype.names or ()
    wanted = ("segment", "t_s", "q1", "q2", "dq1", "dq2", "r1", "r2", "lstm1", "lstm2", "near_contact")
    if missing := [name for name in wanted if name not in names]:
        raise ConfigError(f"{path}: has no column {', '.join(missing)}; its columns are {', '.join(names)}")
    pairs = {name: np.column_stack([rows[f"{name}1"], rows[f"{name}2"]]) for name in ("q", "dq", "r", "lstm")}
    found = []
    for number in np.unique(rows["segment"]).astype(int):
        at = np.flatnonzero((rows["segment"] == number) & ~np.isnan(pairs["r"]).any(axis=1))
        if len(at) >= LEAST_S * RATE_HZ:
            found.append(
                Segment(
                    int(number),
                    rows["t_s"][at],
                    pairs["q"][at],
                    pairs["dq"][at],
                    -pairs["r"][at],
                    -pairs["lstm"][at],
                    rows["near_contact"][at] > 0,
                )
            )
    return found


def nominal_tree(robot: Path) -> _core.Tree:
    """The paper's nominal model, whose file this writes."""
    robot.parent.mkdir(parents=True, exist_ok=True)
    robot.write_text(arm_xml(RigConfig()))
    return estimated_model(robot, tuple(joint_names(RigConfig())), PAPER_CASES["exact"])


def motor_torque(segment: Segment, tree: _core.Tree) -> np.ndarray:
    """Motor torque averaged over the step that ends at each sample, (samples, 2), [N m].

    r_k = a r_{k-1} + (1 - a) d_k gives d_k = (p_k - p_{k-1})/dt - tau_k + mean of beta, the disturbance torque of each
    step. With the nominal model's p and beta the torque tau_k follows; no second derivative is needed.
    The first sample repeats the second.
    """
    a = np.exp(-RECORDED_GAIN_PER_S / RATE_HZ)
    disturbance = (segment.residual[1:] - a * segment.residual[:-1]) / (1 - a)
    p, beta = tree.momentum(segment.q, segment.dq)
    tau = np.diff(p, axis=0) * RATE_HZ + 0.5 * (beta[1:] + beta[:-1]) - disturbance
    return np.vstack([tau[:1], tau])


def recording(segment: Segment, tree: _core.Tree) -> Recording:
    """The segment as a recording whose contacts are near_contact; train with MARGINS, as these rows have them."""
    t_ns = np.round((segment.time_s - segment.time_s[0]) * 1e9).astype(np.int64)
    return Recording(
        name=f"segment-{segment.number}",
        joints=tuple(joint_names(RigConfig())),
        t_ns=t_ns,
        q=segment.q,
        dq=segment.dq,
        tau=motor_torque(segment, tree),
        contact=segment.near_contact.astype(np.int8),
        rate_hz=RATE_HZ,
        torque_timing="averaged",
        source="recording of MOCCA [Mocca2020]",
        robot_sha256="",
    )
