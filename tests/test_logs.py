"""docs/start/logs.md: its commands as they stand there, from logs in each form to an alarm; and damaged logs."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_arms import six_axis, urdf
from made_recordings import Drive, made_motion

from tauext.bundle.bundle_file import load_bundle
from tauext.cli import main
from tauext.data.description_template import time_unit
from tauext.data.importers.open_raw import open_raw
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.errors import RecordingError
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


PAGE = (Path(__file__).parent.parent / "docs" / "start" / "logs.md").read_text()
WRITERS = {
    "UR": ("free.csv", lambda run, path: write_ur(run, path, "," if path.stem == "free" else " ")),
    "libfranka": ("free.csv", write_franka),
    "JointState": ("free.csv", write_echo),
}
UNITS = {"UR": '"s"', "libfranka": '"ms"', "JointState": '"s"'}


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    robot = tmp_path_factory.mktemp("robot") / "robot.urdf"
    made_robot(robot)
    return robot, made_runs(robot, 3, amperes=True), made_runs(robot, 3, amperes=False)


def commands() -> list[str]:
    return re.findall(r"^    tauext (.*)$", PAGE, flags=re.MULTILINE)


@pytest.mark.slow
@pytest.mark.parametrize("form", WRITERS)
def test_the_page_leads_from_each_log_to_the_alarm(form, arm, tmp_path, monkeypatch, capsys):
    robot, amperes, newtons = arm
    monkeypatch.chdir(tmp_path)
    Path("robot.urdf").write_text(robot.read_text())
    runs = amperes if form == "UR" else newtons
    for run, name in zip(runs, ("free.csv", "touched.csv"), strict=True):
        WRITERS[form][1](run, Path(name))
    for command in commands():
        capsys.readouterr()
        assert main(shlex.split(command)) == 0, capsys.readouterr().err
        if "--new" in command:
            text = Path("arm.toml").read_text()
            assert f"unit = {UNITS[form]}" in text[text.index("[time]") : text.index("[signals.q]")]
            assert ('\nunit = "A"' in text) == (form == "UR")
            Path("arm.toml").write_text(text + split("free.csv", "touched.csv"))
    out = capsys.readouterr().out
    alarms = [float(line.split()[0]) for line in out.splitlines() if "collision" in line and line.split()[1] == "s"]
    touched = load_recording("data/touched.parquet")
    assert touched.joints == UR_JOINTS
    np.testing.assert_allclose(touched.q, runs[1].q, atol=1e-6)
    begins_s = runs[1].time_s[-1] - 0.8
    assert any(0 <= at - begins_s < 0.5 for at in alarms), out
    assert sum(at < begins_s for at in alarms) <= 1, out
    if form == "UR":
        bundle = load_bundle("arm.tauext")
        assert sum(bundle.in_newtons) >= 3 and len(NM_PER_A) == len(bundle.in_newtons)


@pytest.mark.parametrize(("step", "unit"), [(0.008, "s"), (2.0, "ms"), (1.0, "ms"), (2000.0, "us"), (8e6, "ns")])
def test_the_unit_of_time_is_found_by_its_steps(step, unit):
    assert time_unit(1e3 + step * np.arange(20)) == unit


def raw_names(path: Path) -> tuple[str, ...]:
    (raw,) = open_raw(path)
    return raw.streams()[""]


def test_an_echoed_joint_state_has_names_of_joints_and_stamps(tmp_path):
    path = tmp_path / "joint_states.csv"
    path.write_text("17,5,base,b,a,1,2,3,4,5,6\n17,8000005,base,b,a,1,2,3,4,5,6\n")
    (raw,) = open_raw(path)
    (block,) = raw.blocks()
    assert block.names[2:4] == ("position[b]", "position[a]") and block.names[-1] == "effort[a]"
    assert block.t_ns.tolist() == [17 * 10**9 + 5, 17 * 10**9 + 8000005]
    path.write_text("%time,field.name0,field.name1,field.position0,field.position1\n1,b,a,0.5,1\n2,b,a,0.5,1\n")
    assert raw_names(path) == ("%time", "field.position[b]", "field.position[a]")


def test_quotes_spaces_and_windows_line_ends_are_no_obstacle(tmp_path):
    path = tmp_path / "run.csv"
    path.write_bytes(b'"timestamp" "actual q 0" "actual_qd_0"\r\r\n0.0 1 2\r\r\n0.008 1 2\r\r\n')
    assert raw_names(path) == ("timestamp", "actual q 0", "actual_qd_0")
    path.write_text("time, success_rate, state.q[0]\n1,1,0.5\n2,1,0.5\n")
    assert raw_names(path) == ("time", "success_rate", "state.q[0]")


def test_rows_with_another_separator_than_the_header_are_refused_with_both_lines(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text("timestamp,q_0,q_1\n0.0;1;2\n0.1;1;2\n")
    with pytest.raises(RecordingError, match=r"first line has 3 cells between ',', its next has 1: '0.0;1;2'"):
        open_raw(path)


def test_a_missing_column_is_named_with_its_neighbours_once_each(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("run.csv").write_text("t,q_0,q_1,tau_0,tau_1\n0,1,2,3,4\n0.01,1,2,3,4\n")
    assert main(["import", "--new", "arm.toml", "--source", "run.csv"]) == 0
    Path("run.csv").write_text("t,q_0,q_1,tau_0\n0,1,2,3\n0.01,1,2,3\n")
    assert main(["import", "--source", "run.csv", "--arm", "arm.toml", "--out", "data"]) == 2
    assert "'tau_1' is not in run.csv; near to it: tau_0, q_1, t; " in capsys.readouterr().err
