"""What a monitor bears beside its loop: callers who only hold the line, and a disk that is full."""

import socket
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import pytest
from made_bundles import pushed, watching_bundle

from tauext.cli import main
from tauext.data.recording_file import save_recording
from tauext.errors import RecordingError
from tauext.files import preflight
from tauext.monitor import record_sink
from tauext.monitor.control_lines import MOST_CONNECTIONS, ControlSocket


class Asked:
    """Takes what a control takes."""

    def acknowledge(self, by: str) -> None:
        pass


@pytest.fixture
def listening(tmp_path):
    made = ControlSocket(tmp_path / "control", Asked())
    yield tmp_path / "control"
    made.close()


def call(path: Path, stack: ExitStack) -> socket.socket:
    one = stack.enter_context(socket.socket(socket.AF_UNIX))
    one.settimeout(5)
    one.connect(str(path))
    return one


def ask(one: socket.socket) -> bytes:
    one.sendall(b"acknowledge\n")
    return one.recv(100)


def test_who_only_holds_the_line_does_not_lock_out_the_next(listening):
    with ExitStack() as stack:
        silent = [call(listening, stack) for _ in range(3 * MOST_CONNECTIONS)]
        assert ask(call(listening, stack)) == b"ok\n"
        assert silent[0].recv(1) == b""  # closed: it was silent longest


def test_who_speaks_stays_while_silent_ones_come_and_go(listening):
    with ExitStack() as stack:
        speaking = call(listening, stack)
        for _ in range(3 * MOST_CONNECTIONS):
            assert ask(speaking) == b"ok\n"
            call(listening, stack)
        assert ask(speaking) == b"ok\n"


def test_many_who_come_at_once_do_not_drive_out_who_spoke(listening):
    with ExitStack() as stack:
        speaking = call(listening, stack)
        assert ask(speaking) == b"ok\n"
        for _ in range(3 * MOST_CONNECTIONS):
            call(listening, stack)
        assert ask(call(listening, stack)) == b"ok\n"
        assert ask(speaking) == b"ok\n"


def test_many_at_once_that_read_no_answer_keep_nobody_out(listening):
    with ExitStack() as stack:
        for _ in range(400):
            call(listening, stack).sendall(b"acknowledge\n" * 20)  # EAGAIN where the queue of callers is full
        assert ask(call(listening, stack)) == b"ok\n"


@pytest.mark.slow
def test_who_takes_no_answers_is_closed(listening, monkeypatch):
    monkeypatch.setattr(ControlSocket, "unread_s", 1)
    with ExitStack() as stack:
        one = call(listening, stack)
        with pytest.raises(BrokenPipeError):
            while True:
                one.sendall(b"acknowledge\n" * 1000)


def test_a_line_that_is_executed_is_answered_however_many_come_meanwhile(listening, monkeypatch):
    go_on = threading.Event()
    monkeypatch.setattr(Asked, "resume", lambda self, by: go_on.wait(5), raising=False)
    with ExitStack() as stack:
        waiting = call(listening, stack)
        waiting.sendall(b"resume\n")
        for _ in range(3 * MOST_CONNECTIONS):
            assert ask(call(listening, stack)) == b"ok\n"
        go_on.set()
        assert waiting.recv(100) == b"ok\n"


@pytest.fixture
def place(tmp_path, monkeypatch):
    watching_bundle().save(str(tmp_path / "watching.tauext"))
    save_recording(pushed(), tmp_path / "pushed.parquet")
    monkeypatch.chdir(tmp_path)
    return tmp_path


RECORD = ["monitor", "watching.tauext", "--source", "replay:pushed.parquet", "--segment-s", "1", "--record", "kept"]


def test_a_recorder_that_loses_samples_says_so_while_it_runs_and_fails(place, capsys, monkeypatch):
    def full(recording, path):
        raise RecordingError(f"{path}: cannot be written (No space left on device)")

    monkeypatch.setattr(record_sink, "save_recording", full)
    began_s = time.monotonic()
    assert main([*RECORD, "--speed", "4"]) == 2
    took_s = time.monotonic() - began_s
    out, err = capsys.readouterr()
    told = [line for line in out.splitlines() if "RECORDING LOSES SAMPLES" in line]
    assert 1 <= len(told) <= took_s + 2  # once a second at most
    assert told[0] in out.split("ended")[0] and "No space left on device" in told[0]
    (line,) = err.splitlines()
    assert line.startswith("tauext: error: 6000 of 6000 samples of the recording are lost: ")


@pytest.mark.slow
def test_a_recorder_that_keeps_all_ends_with_0(place, capsys):
    assert main([*RECORD, "--speed", "1000"]) == 0
    assert "LOSES" not in capsys.readouterr().out


def test_a_full_disk_is_refused_before_anything_is_watched(place, capsys, monkeypatch):
    monkeypatch.setattr(preflight.shutil, "disk_usage", lambda folder: SimpleNamespace(free=4096))
    assert main([*RECORD, "--speed", "1000"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "4.1 kB are free" in line
