"""`tauext monitor`: what it prints and writes, and how it refuses what cannot be."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from made_bundles import pushed, watching_bundle
from made_live import ScriptedSource
from made_results import run_command

from tauext.cli import main
from tauext.cli.monitor_output import output_thread
from tauext.data.recording_file import load_recording, save_recording

ROOT = Path(__file__).parent.parent
PROFILES = "[profiles]\nlowest = 0.5\nhighest = 3\n[profiles.usual]\n[profiles.pressing]\ncollision = 3\n"
REACTIONS = '[reactions.note]\non = ["collision"]\ncommand = ["true"]\n'


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with a bundle, a recording of two pushes, reactions and profiles; a replay does not wait in it."""
    watching_bundle().save(str(tmp_path / "watching.tauext"))
    save_recording(pushed(), tmp_path / "pushed.parquet")
    (tmp_path / "profiles.toml").write_text(PROFILES)
    (tmp_path / "reactions.toml").write_text(REACTIONS)
    (tmp_path / "cell.toml").write_text(PROFILES + REACTIONS)
    (tmp_path / "wrong.toml").write_text("[[reaction]]")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def monitor(capsys, *arguments: object) -> tuple[int, str, str]:
    """Exit code, stdout and stderr."""
    return run_command(capsys, "monitor", *arguments)


SOURCE = ("watching.tauext", "--source", "replay:pushed.parquet", "--speed", "1000")


def test_json_says_what_run_says_and_more(place, capsys):
    code, out, _ = monitor(capsys, *SOURCE, "--json", "--status-hz", 2, "--cell", "cell.toml")
    lines = [json.loads(line) for line in out.splitlines()]
    capsys.readouterr()
    assert main(["run", "watching.tauext", "pushed.parquet", "--json", "--status-hz", "2"]) == code == 0
    run = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    for event in ("health", "alarm", "status"):
        of = [{k: v for k, v in line.items() if k != "recording"} for line in lines if line["event"] == event]
        assert of == [{k: v for k, v in line.items() if k != "recording"} for line in run if line["event"] == event]
        assert of
    told = {line["event"]: line for line in lines}
    assert told["profile"]["new"] == "usual" and told["profile"]["by"] == "start"
    assert told["reaction"]["name"] == "note" and told["reaction"]["error"] is None and told["reaction"]["start_us"] > 0
    summary, other = told["summary"], run[-1]
    for key in ("samples", "alarms", "health_share", "worst_margin_nm", "bridged_ticks"):
        assert summary[key] == other[key], key
    assert summary["source"]["received"] == 6000 and summary["missing"] == 0
    assert summary["reactions"]["note"]["done"] == 1 and summary["reported_after"]["count"] == 6000


def test_lines_of_text_end_with_a_summary(place, capsys):
    code, out, _ = monitor(
        capsys, *SOURCE, "--cell", "reactions.toml", "--flights", "flights", "--record", "kept",
        "--acknowledge-after-s", 0.8, "--core", 0,
    )  # fmt: skip
    assert code == 0
    for part in (
        "replay pushed: waiting for the first sample, bundle watching; Ctrl-C ends\n",
        "\nreplay pushed: 2 joints at 1000 Hz\n",
        "COLLISION shoulder: |tau_ext|",
        "collision acknowledged",
        "reaction note to the collision of elbow: began ",
        "event log: flights/replay-pushed-2.015s-collision.parquet",
        "source        6,000 received, none lost",
        "alarms        contact shoulder 1, elbow 1; collision shoulder 1, elbow 1; 2 acknowledged",
        "event logs    2 written to flights",
        "reaction      note: 2 done; began after p50 ",
        "recorded      6,000 samples in 1 files",
    ):
        assert part in out, part
    (kept,) = Path("kept").iterdir()
    np.testing.assert_array_equal(load_recording(kept).q, pushed().q)


def test_what_a_standing_alarm_hides_is_shown_and_how_to_show_it(place, capsys):
    """The push of the elbow comes while the alarm of the shoulder's stands; acknowledged before, it is an alarm."""
    code, out, _ = monitor(capsys, *SOURCE)
    assert code == 0 and out.count("COLLISION") == 1
    (line,) = [line for line in out.splitlines() if "another collision" in line]
    seconds, text = line.split(" s  ", 1)
    assert 3.6 < float(seconds) < 3.9 and text.startswith("another collision, elbow: hidden by the alarm of 2.0")
    assert "to the end and hid 1 more collision; --acknowledge-after-s 1 " in out
    assert "collision shoulder 1; 1 more collision hidden by an alarm that stood" in out
    code, out, _ = monitor(capsys, *SOURCE, "--acknowledge-after-s", 0.8)
    assert out.count("COLLISION") == 2 and "hidden" not in out and "hid " not in out


@pytest.mark.parametrize(
    "arguments, message",
    [
        ((), "the bundle is missing"),
        (("watching.tauext",), "--source is missing"),
        (("none.tauext", "--source", "replay:pushed.parquet"), "none.tauext: there is no such bundle"),
        (("watching.tauext", "--source", "usb"), "must be one of replay:FILE, ur:HOST, franka:HOST"),
        (("watching.tauext", "--source", "replay:"), "must be one of"),
        (("watching.tauext", "--source", "replay:none.parquet"), "none.parquet: there is no such recording"),
        (("watching.tauext", "--source", "ros2", "--speed", "2"), "--speed is for source replay, not for ros2"),
        (("watching.tauext", "--source", "ur:h", "--speed", "2"), "--speed is for source replay, not for ur"),
        ((*SOURCE, "--torque-constants", "x"), "--torque-constants is for source ur, not for replay"),
        (("watching.tauext", "--source", "franka:h"), "franka h has 7 joints, the bundle 2: shoulder, elbow"),
        ((*SOURCE[:-1], "0"), "speed = 0 must be >= 1"),
        ((*SOURCE[:-1], "0.5"), "speed = 0.5 must be >= 1"),
        ((*SOURCE, "--segment-s", "0.5"), "--segment-s = 0.5 must be 1 to 3600"),
        ((*SOURCE, "--priority", "100"), "priority = 100 must be 1 to 99"),
        ((*SOURCE, "--status-hz", "1"), "--status-hz = 1.0 must be left out unless --json is given"),
        ((*SOURCE, "--cell", "none.toml"), "none.toml: there is no such file; docs/running.md has an example"),
        ((*SOURCE, "--cell", "wrong.toml"), "unknown key 'reaction'; the nearest known is 'reactions'"),
        ((*SOURCE, "--control", "no/such"), "no/such: no control socket"),
        ((*SOURCE, "--flights", "pushed.parquet"), "pushed.parquet: no folder for event logs"),
        ((*SOURCE, "--record", "pushed.parquet"), "pushed.parquet: no folder for recordings"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(place, capsys, arguments, message):
    code, _, err = monitor(capsys, *arguments)
    assert code == 2 and err.startswith("tauext: error: ") and message in err and err.count("\n") == 1


@pytest.mark.parametrize(
    ("script", "words", "refused", "message"),
    [
        ([], (), 0, "script: no sample came in"),
        ([lambda: False], ("--duration-s", "0.05"), 0, "script: no sample came in"),
        ([], (), 7, "script: none of 7 samples could be used in"),
    ],
)
def test_a_monitor_that_received_no_sample_ends_with_status_2(
    place, capsys, monkeypatch, script, words, refused, message
):
    source = ScriptedSource(script)
    source.counts.refused = refused
    monkeypatch.setattr("tauext.cli.monitor.open_source", lambda *_: (source, ()))
    code, out, err = monitor(capsys, "watching.tauext", "--source", "my-arm:x", *words)
    assert code == 2 and message in err and "check that the robot sends" in err and err.count("\n") == 1, (out, err)


def test_a_monitor_that_is_stopped_before_the_first_sample_ends_with_status_0(place, capsys, monkeypatch):
    monkeypatch.setattr("tauext.cli.monitor.open_source", lambda *_: (ScriptedSource([lambda: False]), ()))
    monkeypatch.setattr("sys.stdin", io.StringIO("stop\n"))
    assert monitor(capsys, "watching.tauext", "--source", "my-arm:x", "--control", "-")[::2] == (0, "")


def run_beside(place, *arguments: str, **pipes) -> subprocess.Popen:
    command = [sys.executable, "-m", "tauext", "monitor", "watching.tauext", "--source", "replay:pushed.parquet"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    return subprocess.Popen([*command, *arguments], cwd=place, env=environment, text=True, **pipes)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_it_with_a_summary(place, number):
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with run_beside(place, "--cell", "reactions.toml", **pipes) as running:
        first = [running.stdout.readline() for _ in range(2)]
        running.send_signal(number)
        out, err = running.communicate(timeout=60)
    assert "Ctrl-C ends" in first[0] and running.returncode == 0 and err == ""
    by = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM", signal.SIGHUP: "the closed terminal"}[number]
    assert f"stopped by {by}" in out and "worst margin" in out


def test_lines_on_stdin_steer_it(place):
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with run_beside(place, "--json", "--cell", "profiles.toml", "--control", "-", **pipes) as running:
        out, err = running.communicate("profile pressing\nprofile none\nsing\nstop\n", timeout=60)
    lines = [json.loads(line) for line in out.splitlines()]
    assert running.returncode == 0 and lines[-1]["event"] == "summary"
    assert [(one["by"], one["new"]) for one in lines if one["event"] == "profile"][1:] == [("stdin", "pressing")]
    assert "tauext: error: profile 'none' must be one of usual, pressing" in err and "'sing' must be" in err


def test_a_reader_that_goes_ends_it(place):
    with run_beside(place, "--json", "--status-hz", "100", stdout=subprocess.PIPE, stderr=subprocess.PIPE) as running:
        running.stdout.readline()
        running.stdout.close()
        err = running.stderr.read()
        running.wait(timeout=60)
    assert running.returncode == 141 and err == ""


def test_an_output_that_waits_holds_up_nobody_and_its_fault_is_raised_at_the_end():
    import threading

    gate, told, failed = threading.Event(), [], []
    with output_thread(lambda: failed.append(True)) as worker:
        worker.put(gate.wait)
        will_be_done = sum(worker.put(lambda k=k: told.append(k)) for k in range(1500))
        worker.put(lambda: told.append("change"), must=True)
        gate.set()
    assert told[-1] == "change" and len(told) - 1 == will_be_done <= 1010
    with pytest.raises(OSError, match="gone"), output_thread(lambda: failed.append(True)) as worker:
        worker.put(lambda: (_ for _ in ()).throw(OSError("gone")))
    assert failed == [True]


def test_every_kind_of_source_is_documented():
    from tauext.sources.open import kinds

    text = (ROOT / "docs" / "running.md").read_text()
    for name, kind in kinds().items():
        target = kind.target.replace("|", r"\|")
        assert f"`{name}:{target}`" in text or f"`{name}`" in text, name
