"""docs/quickstarts/ur.md as printed, from a recording to a stop; logs in other forms; damaged logs."""

from __future__ import annotations

import json
import re
import shlex
import socket
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_arms import six_axis, urdf
from made_bundles import watching_bundle
from made_recordings import Drive, made_motion
from made_ur import Controller

from tauext.bundle.bundle_file import load_bundle
from tauext.cli import main
from tauext.data.description_template import time_unit
from tauext.data.importers.open_raw import open_raw
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.robot.read import load_tree
from tauext.sources.ur import VARIABLES, UrSource
from tauext.sources.ur_dashboard import PORT

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
    return [runs[0], touched_at_the_end(runs[1], amperes)]


def touched_at_the_end(run: Recording, amperes: bool) -> Recording:
    time_s = run.time_s
    touched = (time_s >= time_s[-1] - CONTACT_S[0]) & (time_s < time_s[-1] - CONTACT_S[1])
    push = PUSH_NM / (np.array(NM_PER_A) if amperes else 1.0)
    return replace(run, tau=run.tau - touched[:, None] * push)


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


# The page, block by block.

PAGE = (Path(__file__).parent.parent / "docs" / "quickstarts" / "ur.md").read_text()
HOST = "192.168.0.2"


def blocks() -> list[tuple[str, str]]:
    """Commands, TOML and Python of the page in their order, each with its language."""
    found = re.findall(r"^    tauext (\w[^\n]*)$|^```(toml|python)\n(.*?)^```$", PAGE, flags=re.MULTILINE | re.DOTALL)
    return [("command", command) if command else (language, text) for command, language, text in found]


class Arm:
    """Stands in for rtde_receive: writes a recording of free motion, and plays a touched one until it is stopped."""

    POLLS_A_PACKET = 4

    def __init__(self, free: Recording, touched: Recording):
        self.free, self.played, self.polls, self.asked = free, touched, 0, []
        self.stopped = threading.Event()

    def RTDEReceiveInterface(self, host: str, rate_hz: float, variables: Sequence[str] = ()) -> Arm:
        self.asked.append((host, rate_hz, *variables))
        return self

    def startFileRecording(self, name: str, variables: list[str]) -> bool:
        assert {"timestamp", "actual_q", "actual_qd", "actual_current"} <= set(variables)
        write_ur(self.free, Path(name), ",")
        return True

    def stopFileRecording(self) -> bool:
        return True

    def getTimestamp(self) -> float:
        self.polls += 1
        if self.stopped.is_set():
            raise EOFError("the program was stopped")
        return self.polls // self.POLLS_A_PACKET / RATE_HZ

    def __getattr__(self, name: str) -> Callable:
        row = self.polls // self.POLLS_A_PACKET % self.played.samples
        signals = {"getActualQ": "q", "getActualQd": "dq", "getActualCurrent": "tau"}
        if name in signals:
            return lambda: getattr(self.played, signals[name])[row].tolist()
        answers = {"getJointTemperatures": [30.0] * 6, "isConnected": True, "disconnect": None}
        return lambda: answers[name]


@pytest.mark.slow
def test_the_quickstart_leads_from_a_recording_to_a_stopped_arm(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    robot = Path("robot.urdf")
    made_robot(robot)
    tree, drive = load_tree(robot, UR_JOINTS), Drive(nm_per_a=NM_PER_A)
    free, touched = (
        made_motion(tree, minutes, rate_hz=RATE_HZ, seed=seed, pieces=1, drive=drive).recordings[0]
        for seed, minutes in ((0, 0.7), (1, 0.2))  # a search for ripple takes 45 s of motion
    )
    touched = touched_at_the_end(touched, amperes=True)
    write_ur(touched, Path("touched.csv"), " ")
    arm = Arm(free, touched)
    controller = Controller(stopped=arm.stopped.set)
    monkeypatch.setitem(sys.modules, "rtde_receive", arm)
    monkeypatch.setattr("tauext.sources.ur.expect_controller", lambda host: None)
    monkeypatch.setattr(time, "sleep", lambda seconds, sleep=time.sleep: sleep(min(seconds, 0.1)))
    monkeypatch.setattr(UrSource, "dashboard_port", controller.port)
    printed = []
    for language, text in blocks():
        capsys.readouterr()
        if language == "python":
            exec(compile(text, "docs/quickstarts/ur.md", "exec"), {})
        elif "[split]" in text:
            Path("arm.toml").write_text(f"{Path('arm.toml').read_text()}\n{text}")
        elif language == "toml":
            Path("cell.toml").write_text(text)
        else:
            words = shlex.split(text.replace(HOST, "127.0.0.1"))
            # A stall of this machine is no missing sample. The live monitor ends with the arm's program, not by Ctrl-C.
            words += ["--missing-after-ms", "1e5"] if words[0] == "monitor" else []
            assert main(words) == 0, (text, capsys.readouterr().err)
        printed.append(capsys.readouterr().out)
    by_text = {text: out for (_, text), out in zip(blocks(), printed, strict=True)}
    begins_s = float(touched.time_s[-1]) - CONTACT_S[0]
    run, replayed, live = (out for text, out in by_text.items() if text.startswith(("run", "monitor")))
    for out in (run, replayed):
        (at_s,) = (float(line.split()[0]) for line in out.splitlines() if " s  COLLISION" in line)
        assert 0 <= at_s - begins_s < 0.3, out
    for out in (replayed, live):
        assert "reaction stop the arm to the collision of shoulder_lift_joint: began " in out, out
    assert controller.commands == ["is in remote control", "stop"]
    assert arm.asked == [(HOST, 500.0), ("127.0.0.1", RATE_HZ, *VARIABLES)]
    assert sum(load_bundle("arm.tauext").in_newtons) >= 3
    assert list(Path("flights").glob("*.parquet")) and list(Path("flight-report").rglob("*.html"))
    controller.close()


def test_the_refusal_on_the_page_is_the_one_that_is_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    monkeypatch.setattr(UrSource, "dashboard_port", port)
    watching_bundle().save("arm.tauext")
    (rules,) = (text for language, text in blocks() if "[reactions." in text)
    Path("cell.toml").write_text(rules)
    assert main(["monitor", "arm.tauext", "--source", "ur:127.0.0.1", "--cell", "cell.toml"]) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert f"    {err.replace('127.0.0.1', HOST).replace(str(port), str(PORT))}" in PAGE


# Other forms of logs: the same commands.

COMMANDS = (
    "import --new arm.toml --source free.csv --robot robot.urdf",
    "import --source free.csv touched.csv --arm arm.toml --out data",
    "train --data data --recipe prior --out arm.tauext",
    "run arm.tauext data/touched.parquet --acknowledge-after-s 1",
)
WRITERS = {"libfranka": write_franka, "JointState": write_echo}
UNITS = {"libfranka": '"ms"', "JointState": '"s"'}


@pytest.mark.slow
@pytest.mark.parametrize("form", WRITERS)
def test_a_log_of_each_form_leads_to_the_alarm(form, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    made_robot(Path("robot.urdf"))
    runs = made_runs(Path("robot.urdf"), 3, amperes=False)
    for run, name in zip(runs, ("free.csv", "touched.csv"), strict=True):
        WRITERS[form](run, Path(name))
    for command in COMMANDS:
        capsys.readouterr()
        assert main(shlex.split(command)) == 0, capsys.readouterr().err
        if "--new" in command:
            text = Path("arm.toml").read_text()
            assert f"unit = {UNITS[form]}" in text[text.index("[time]") : text.index("[signals.q]")]
            assert '\nunit = "A"' not in text
            Path("arm.toml").write_text(text + split("free.csv", "touched.csv"))
    out = capsys.readouterr().out
    alarms = [float(line.split()[0]) for line in out.splitlines() if "collision" in line and line.split()[1] == "s"]
    touched = load_recording("data/touched.parquet")
    assert touched.joints == UR_JOINTS
    np.testing.assert_allclose(touched.q, runs[1].q, atol=1e-6)
    begins_s = runs[1].time_s[-1] - CONTACT_S[0]
    assert any(0 <= at - begins_s < 0.5 for at in alarms), out
    assert sum(at < begins_s for at in alarms) <= 1, out


@pytest.mark.parametrize(("step", "unit"), [(0.008, "s"), (2.0, "ms"), (1.0, "ms"), (2000.0, "us"), (8e6, "ns")])
def test_the_unit_of_time_is_found_by_its_steps(step, unit):
    assert time_unit(1e3 + step * np.arange(20)) == unit


def raw_names(path: Path) -> tuple[str, ...]:
    (raw,) = open_raw(path)
    return raw.streams[""]


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


def test_a_missing_column_is_named_with_its_neighbours_once_each(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("run.csv").write_text("t,q_0,q_1,tau_0,tau_1\n0,1,2,3,4\n0.01,1,2,3,4\n")
    assert main(["import", "--new", "arm.toml", "--source", "run.csv"]) == 0
    Path("run.csv").write_text("t,q_0,q_1,tau_0\n0,1,2,3\n0.01,1,2,3\n")
    assert main(["import", "--source", "run.csv", "--arm", "arm.toml", "--out", "data"]) == 2
    assert "'tau_1' is not in run.csv; similar: tau_0, q_1, t; " in capsys.readouterr().err
