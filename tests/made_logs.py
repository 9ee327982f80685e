"""Logs of a simulated six-axis arm as UR's recorders, libfranka and ROS write them, with one contact at the end."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from made_motion import Drive, made_motion
from trees import six_axis, urdf

from tauext.data.recording import Recording
from tauext.robot.load import load_tree

UR_JOINTS = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)
NM_PER_A = (12.0, 12.0, 9.0, 4.5, 4.5, 4.5)
RATE_HZ = 125.0
CONTACT_S = (0.8, 0.3)
"""From the end of the last log to the begin and the end of the contact."""
PUSH_NM = np.array([0.0, -60.0, -40.0, 0.0, 0.0, 0.0])


def made_robot(path: Path) -> None:
    """A URDF of six joints with UR's names."""
    text = urdf(six_axis())
    for k, name in enumerate(UR_JOINTS):
        text = text.replace(f'"joint{k + 1}"', f'"{name}"')
    path.write_text(text)


def made_runs(robot: Path, minutes: float, amperes: bool) -> list[Recording]:
    """Two runs of free motion; something pushes the arm near the end of the second one."""
    tree = load_tree(robot, UR_JOINTS)
    drive = Drive(nm_per_a=NM_PER_A if amperes else None)
    runs = made_motion(tree, minutes, rate_hz=RATE_HZ, pieces=2, drive=drive).recordings
    time_s = runs[1].time_s
    touched = (time_s >= time_s[-1] - CONTACT_S[0]) & (time_s < time_s[-1] - CONTACT_S[1])
    push = PUSH_NM / (np.array(NM_PER_A) if amperes else 1.0)
    return [runs[0], replace(runs[1], tau=runs[1].tau - touched[:, None] * push)]


def write_ur(run: Recording, path: Path, separator: str) -> None:
    """As RTDE recorders write: the controller's seconds, currents, and the model's torque as target_moment."""
    arrays = {"target_moment": np.zeros_like(run.q), "actual_q": run.q, "actual_qd": run.dq, "actual_current": run.tau}
    names = ["timestamp", *(f"{name}_{k}" for name in arrays for k in range(6))]
    _write(path, separator.join(names), np.column_stack([5000 + run.time_s, *arrays.values()]), separator, "\r\n")


def write_franka(run: Recording, path: Path) -> None:
    """As logToCSV writes: milliseconds, a space after some commas of the header, six joints here."""
    arrays = {
        "q": run.q,
        "q_d": run.q,
        "dq": run.dq,
        "dq_d": run.dq,
        "tau_J": run.tau,
        "tau_ext_hat_filtered": 0 * run.q,
    }
    names = ["time", "success_rate", *(f"state.{name}[{k}]" for name in arrays for k in range(6))]
    table = np.column_stack([np.round(1e3 * run.time_s), np.ones(len(run.q)), *arrays.values()])
    _write(path, ", ".join(names), table, ",", "\n")


def write_echo(run: Recording, path: Path) -> None:
    """As `ros2 topic echo --csv` writes a JointState: no header, joints in the order of the alphabet."""
    order = np.argsort(UR_JOINTS)
    names = ",".join(UR_JOINTS[k] for k in order)
    numbers = np.column_stack([run.q[:, order], run.dq[:, order], run.tau[:, order]])
    lines = [
        f"{1_700_000_000 + ns // 10**9},{ns % 10**9},base,{names},{','.join(f'{x:.9g}' for x in row)}\n"
        for ns, row in zip(run.t_ns.tolist(), numbers.tolist(), strict=True)
    ]
    path.write_text("".join(lines))


def _write(path: Path, header: str, table: np.ndarray, separator: str, end: str) -> None:
    with path.open("w", newline="") as file:
        np.savetxt(file, table, "%.9g", separator, end, header=header, comments="")


def split(first: str, second: str) -> str:
    """[split] of arm.toml for the two runs."""
    return (
        f"\n[split]\ntrain = [{json.dumps(first)}]\nvalidation = []\ntest = []\ncollisions = [{json.dumps(second)}]\n"
    )
