"""`tauext commission`: options, one process a folder, and the same state again after a kill in each of them."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
from made_bundles import pushed, watching_bundle
from tauext_commission.command import answer, keys
from tauext_commission.connect import as_data
from tauext_commission.folder import CommissionFolder
from tauext_commission.history_file import read_events, read_labels
from tauext_commission.run import TEND_S, Options, run
from tauext_lab.sim.source import KINDS, write_robot_file

from tauext.cli import main
from tauext.data.labels import Label
from tauext.data.recording_file import save_recording
from tauext.errors import AwayError, ConfigError, RobotError
from tauext.monitor.control_lines import obey
from tauext.robot.write import write_placeholder

PATIENCE_S = 300.0


# --- Options.


@pytest.mark.parametrize(
    ("words", "error"),
    [
        ("--source sim:rig", "--out is missing"),
        ("--out {}/a", "--source is missing"),
        ("--source moon:1 --out {}/a", "--source 'moon:1' must be one of replay:FILE, ur:HOST, franka:HOST"),
        ("--source sim:moon --out {}/a", "moon"),
        ("--source sim: --out {}/a", "sim"),
        ("--source ur: --out {}/a", "--source 'ur:' must be one of"),
        ("--source replay:{}/none.parquet --out {}/a", "there is no such recording"),
        ("--source sim:rig --out {}/a --torque-constants {}/c.toml", "--torque-constants"),
        ("--source sim:rig --out {}/a --robot {}/none.urdf", "no such file"),
        ("--source sim:rig --out {}/a --disk-gb 0", "--disk-gb = 0.0 must be 0.1 to 100000"),
        ("--source sim:rig --out {}/a --disk-gb nan", "--disk-gb = nan"),
        ("--source sim:rig --out {}/a --port 0", "port = 0 must be 1 to 65535"),
        ("--source sim:rig --out {}/a --host moon.example.invalid", "must be an address of this machine"),
        ("--source sim:rig --out {}/a --priority 100", "priority = 100 must be 1 to 99"),
        ("--source sim:rig --out {}/a --core -1", "core = -1 must be"),
    ],
)
def test_a_wrong_option_is_refused_before_a_folder_is_made(words, error, tmp_path, capsys):
    assert main(["commission", *words.replace("{}", str(tmp_path)).split()]) == 2
    said = capsys.readouterr().err
    assert said.startswith("tauext: error: ") and error in said and said.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def cell_file(folder: Path, *lines: str) -> Path:
    path = folder / "cell.toml"
    path.write_text("\n".join(["[reactions.r]", 'on = ["collision"]', *lines]) + "\n")
    return path


@pytest.mark.parametrize(
    ("source", "lines", "error"),
    [
        ("sim:rig", ["stop = true", "publish = true"], "publish and stop are given"),
        ("sim:rig", ["joints = 3", "stop = true"], "joints = 3 must be the name of a joint, or a list of such"),
        ("sim:rig", ['command = ["no-such-program"]'], "there is no program 'no-such-program'"),
        ("sim:rig", ["publish = true"], "publishes nothing"),
    ],
)
def test_a_wrong_cell_file_is_refused_before_a_folder_is_made(source, lines, error, tmp_path, capsys):
    path = cell_file(tmp_path, *lines)
    words = ["commission", "--source", source, "--out", str(tmp_path / "cell"), "--cell", str(path), "--no-page"]
    assert main(words) == 2
    assert error in capsys.readouterr().err and not (tmp_path / "cell").exists()


def test_a_cell_file_of_other_joints_is_refused_once_they_are_known(tmp_path, capsys):
    path = cell_file(tmp_path, 'joints = ["elbow"]', "stop = true")
    out = tmp_path / "cell"
    words = ["commission", "--source", "sim:rig", "--out", str(out), "--cell", str(path), "--no-page"]
    began = time.monotonic()
    assert main(words) == 2 and time.monotonic() < began + 10.0
    assert "joints = ['elbow'] must be one of joint1, joint2, or a list of such" in capsys.readouterr().err
    assert not (out / "arm.toml").exists() and not list(out.glob("robot.*"))
    folder = CommissionFolder.open(out)  # known from an earlier run: refused before anything is started
    folder.save(arm=as_data(KINDS["rig"].facts()))
    with folder.locked():
        assert main(words) == 2
    assert "must be one of joint1, joint2, or a list of such" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("robot", "error"),
    [
        ("other.urdf", "no joint 'joint1'; its joints are a, b"),
        ("mesh.xml", "none.stl"),
    ],
)
def test_a_robot_file_that_does_not_fit_ends_the_command(robot, error, tmp_path, capsys):
    write_placeholder(["a", "b"], tmp_path).rename(tmp_path / "other.urdf")
    rig = write_robot_file("rig", tmp_path)
    mesh = '<asset><mesh name="m" file="none.stl"/></asset>'
    cup = '<body name="cup"><joint name="lid"/><geom type="mesh" mesh="m"/></body>'
    (tmp_path / "mesh.xml").write_text(rig.read_text().replace("<worldbody>", f"{mesh}<worldbody>{cup}"))
    out = tmp_path / "cell"
    words = ["commission", "--source", "sim:rig", "--out", str(out), "--no-page", "--robot", str(tmp_path / robot)]
    assert main(words) == 2
    caught = capsys.readouterr()
    assert error in caught.err and caught.err.count("\n") == 1 and "tried again" not in caught.out
    assert not [path for path in out.glob("*") if path.name.startswith(("robot.", "arm.toml", "seg-"))]


class Away:
    """A source whose descriptions fail with these errors, one after the other."""

    name = "away"

    def __init__(self, errors: list[Exception]):
        self.errors, self.closed = errors, 0

    def describe(self, wait_s, robot=None):
        raise self.errors.pop(0)

    def close(self):
        self.closed += 1


@pytest.mark.parametrize("last", [ConfigError("it has 7 joints, the file 6"), RobotError("arm.urdf: no joint 'a'")])
def test_an_arm_that_is_away_is_tried_again_and_one_that_does_not_fit_is_not(last, tmp_path, monkeypatch):
    errors, made, said = [AwayError("no controller answers"), AwayError("no sample"), last], [], []

    def opened(text, options, cell):
        made.append(Away(errors))
        return made[-1], ()

    monkeypatch.setattr("tauext_commission.run.open_source", opened)
    monkeypatch.setattr("tauext_commission.run.RETRY_S", 0.01)
    with pytest.raises(type(last)) as raised:
        run(tmp_path / "cell", "ur:there", Options(), said.append)
    assert raised.value is last and not errors and all(one.closed for one in made)
    assert [line for line in said if "again" in line] == [
        "no controller answers; it is tried again",
        "no sample; it is tried again",
    ]
    with CommissionFolder.open(tmp_path / "cell", create=True).locked():  # the same command takes the folder
        assert not (tmp_path / "cell" / "arm.toml").exists()


@pytest.mark.slow
def test_a_source_that_ends_is_trained_on_until_the_command_is_stopped(tmp_path):
    save_recording(pushed(seconds=4), tmp_path / "log.parquet")
    lines, controls = [], []
    words = tmp_path / "cell", f"replay:{tmp_path / 'log.parquet'}", Options(), lines.append, controls.append
    command = threading.Thread(target=run, args=words, daemon=True)
    command.start()
    end = time.monotonic() + PATIENCE_S
    while "NOTHING IS MONITORED: the source has ended" not in lines:
        assert command.is_alive() and time.monotonic() < end, lines
        time.sleep(0.01)
    assert obey("learn yes", controls[0], "test") == "error: no arm is connected"
    time.sleep(2 * TEND_S)
    assert any("has ended; training continues" in line for line in lines) and "samples come again" not in lines
    assert obey("stop", controls[0], "test") == "ok"
    command.join(PATIENCE_S)
    assert not command.is_alive()


@pytest.mark.slow
def test_a_new_alarm_never_has_the_number_of_a_label_whose_event_was_lost(tmp_path):
    """A full disk keeps the label of alarm 7, for which space is reserved, and loses the line of its event."""
    save_recording(pushed(), tmp_path / "log.parquet")
    folder = CommissionFolder.open(tmp_path / "cell", create=True)
    watching_bundle().save(str(folder.bundles / "b0001.tauext"))
    folder.activate("b0001", "it passes", 0.0)
    lost = Label(7, 1, 0, 1_000_000_000, "touched", "page", "2026-01-01T00:00:00Z", "b0001")
    folder.append_label(lost)
    lines, controls = [], []
    words = folder.path, f"replay:{tmp_path / 'log.parquet'}", Options(), lines.append, controls.append
    command = threading.Thread(target=run, args=words, daemon=True)
    command.start()
    until(lambda: "NOTHING IS MONITORED: the source has ended" in lines, "the end of the recording")
    until(lambda: read_events(folder.path), "the alarm of the push", 30.0)
    assert obey("stop", controls[0], "test") == "ok"
    command.join(PATIENCE_S)
    assert [event["id"] for event in read_events(folder.path)] == [8]
    labels = {label.id: label for label in read_labels(folder.path)}
    assert labels[7] == lost and labels[8].answer == "unanswered"


def test_a_folder_belongs_to_one_process(tmp_path, capsys):
    with CommissionFolder.open(tmp_path / "cell", create=True).locked():
        assert main(["commission", "--source", "sim:rig", "--out", str(tmp_path / "cell"), "--no-page"]) == 2
    assert "another `tauext commission` uses this folder" in capsys.readouterr().err


def test_keys_are_answers(capsys):
    class Asked:
        given = []

        def answer(self, what, by, alarm=None):
            if what == "nothing":
                raise ConfigError("nothing: there is no alarm without an answer")
            self.given.append((what, by))

    for key in "tTnyx q\x1b":
        answer(Asked(), key)
    assert Asked.given == [("touched", "key"), ("touched", "key"), ("learn", "key"), ("leave", "key")]
    assert "there is no alarm without an answer" in capsys.readouterr().out


def test_a_key_of_a_terminal_is_read_at_once_and_the_terminal_is_as_before(monkeypatch):
    import pty
    import termios

    class Asked:
        given = []

        def answer(self, what, by, alarm=None):
            self.given.append((what, by))

    far, near = pty.openpty()
    with open(near, closefd=False) as terminal:
        before = termios.tcgetattr(near)
        monkeypatch.setattr("sys.stdin", terminal)
        with keys() as listen:
            listen(Asked())
            os.write(far, b"t")  # without a line's end
            until(lambda: Asked.given == [("touched", "key")], "the answer", 10)
        assert termios.tcgetattr(near) == before
    os.close(far)
    os.close(near)


def test_without_a_terminal_nothing_is_read(monkeypatch, tmp_path):
    (tmp_path / "lines").write_text("t\nt\n")
    with (tmp_path / "lines").open() as file:
        monkeypatch.setattr("sys.stdin", file)
        with keys() as listen:
            listen(None)
        assert file.read() == "t\nt\n"


# --- The whole command, on a simulated arm.


@contextmanager
def running(folder: Path, *words: str):
    """The command as a process of its own."""
    command = [sys.executable, "-m", "tauext", "commission", "--source", "sim:rig", "--out", str(folder), *words]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT}
    process = subprocess.Popen(command, **pipes, text=True, start_new_session=True)
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        process.stdout.close()


def until(true, what: str, patience_s: float = PATIENCE_S):
    end = time.monotonic() + patience_s
    while True:
        with suppress(OSError, ValueError, KeyError, ConfigError):
            if value := true():
                return value
        assert time.monotonic() < end, what
        time.sleep(0.1)


def control(folder: Path, line: str) -> str:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as wire:
        wire.settimeout(PATIENCE_S)
        wire.connect(json.loads((folder / "commission.json").read_text())["control"])
        wire.sendall(line.encode() + b"\n")
        with wire.makefile() as answers:
            return answers.readline().strip()


def live(folder: Path) -> dict:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as wire:
        wire.settimeout(5)
        wire.connect(json.loads((folder / "commission.json").read_text())["live"])
        with wire.makefile() as lines:
            return json.loads(lines.readline())


def of_state(folder: Path, state: str, bundle: str | None = None):
    """The line of the loop once it is in one of these states, with this bundle."""

    def reached():
        line = live(folder)
        return line if line["state"] in state.split() and line["bundle"] == bundle and line.get("t_ns") else None

    return until(reached, f"{state} with {bundle}")


def kill(process) -> None:
    """kill -9 of the loop alone; its children must end by themselves."""
    os.kill(process.pid, signal.SIGKILL)
    process.wait()

    def others():
        words = ["ps", "-o", "pid=,stat=", "-g", str(process.pid)]
        found = subprocess.run(words, capture_output=True, text=True).stdout
        return [line for line in found.splitlines() if " Z" not in line]

    until(lambda: not others(), "the children to end", 20.0)


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> Path:
    """A bundle of the simulated arm, trained on a minute of what the command recorded."""
    folder = tmp_path_factory.mktemp("trained") / "cell"
    with running(folder, "--no-page"):
        until(lambda: len(list(folder.glob("seg-*.parquet"))) >= 5, "recordings", 300)
    out = folder.parent / "b0001.tauext"
    assert main(["train", "--data", str(folder), "--recipe", "prior", "--out", str(out)]) == 0
    return out


def put_bundle(folder: Path, bundle: Path) -> None:
    """What the training process does after a bundle has passed."""
    there = CommissionFolder.open(folder)
    (there.bundles / bundle.name).write_bytes(bundle.read_bytes())
    there.activate(bundle.stem, "it passes", there.seconds())


WATCHED = "monitoring asking"
"""States with a bundle: limits from less than a minute may raise an alarm at any time."""


@pytest.mark.slow
def test_a_kill_in_each_state_loses_nothing_that_was_confirmed(trained, tmp_path):
    folder = tmp_path / "cell"
    with running(folder, "--port", "8790") as process:
        page = process.stdout.readline().split()[0]
        until(lambda: b"NOTHING IS MONITORED" in urllib.request.urlopen(page, timeout=5).read(), "the page")
        assert process.stdout.readline() == "sim:rig: connecting; NOTHING IS MONITORED\n"
        kill(process)  # while connecting, or soon after
    with running(folder, "--no-page") as process:
        of_state(folder, "learning")
        assert control(folder, "touched") == "ok"  # nobody has noticed a touch
        kill(process)
    assert [label.answer for label in read_labels(folder)] == ["touched"]
    with running(folder, "--no-page") as process:
        of_state(folder, "learning")
        put_bundle(folder, trained)
        of_state(folder, WATCHED, "b0001")
        kill(process)
    with running(folder, "--no-page") as process:
        of_state(folder, WATCHED, "b0001")
        assert control(folder, "sim push joint=joint2 force=0,0,-60 seconds=0.5") == "ok"
        asked = until(lambda: (line := live(folder)) and line["alarm"] and line, "the alarm")
        time.sleep(4.0)  # two copies of what is carried
        kill(process)
    with running(folder, "--no-page") as process:
        still = of_state(folder, "asking", "b0001")
        number = asked["alarm"]["id"]
        assert still["alarm"] is None or still["alarm"]["id"] >= number
        assert control(folder, f"nothing {number}") == "ok"
        kill(process)
    labels = {label.id: label.answer for label in read_labels(folder)}
    assert labels[number] == "nothing"
    with running(folder, "--no-page") as process:
        of_state(folder, WATCHED, "b0001")
        until(lambda: (live(folder)["alarm"] or {}).get("id") != number, "the answered alarm is acknowledged", 20.0)
        process.send_signal(signal.SIGTERM)
        assert process.wait(PATIENCE_S) == 0
    epochs = {label.epoch for label in read_labels(folder)}
    assert len(epochs) >= 2 and json.loads((folder / "commission.json").read_text())["epoch"] >= 5


@pytest.mark.slow
def test_a_killed_page_or_training_starts_again_and_the_loop_goes_on(tmp_path):
    folder = tmp_path / "cell"
    with running(folder, "--port", "8791") as process:
        page = process.stdout.readline().split()[0]
        of_state(folder, "learning")
        before = live(folder)["t_ns"]
        children = subprocess.run(["pgrep", "-P", str(process.pid), "-f", "spawn_main"], capture_output=True, text=True)
        simulation = int(children.stdout.split()[-2])  # the loop's source, which is no child of the supervisor
        for child in map(int, children.stdout.split()):
            if child != simulation:
                os.kill(child, signal.SIGKILL)
        until(lambda: b"NOTHING" in urllib.request.urlopen(page, timeout=5).read(), "the page")
        assert live(folder)["t_ns"] > before
        assert process.poll() is None
