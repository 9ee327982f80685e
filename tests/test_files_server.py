"""Places in a real S3 server on loopback that keeps its objects on disk: versitygw, where it is found.

    go install github.com/versity/versitygw/cmd/versitygw@latest     # to ~/go/bin
    TAUEXT_VERSITYGW=~/go/bin/versitygw python -m pytest tests/test_files_server.py

It is started as `versitygw --access KEY --secret SECRET --port 127.0.0.1:PORT posix FOLDER`; a folder in FOLDER is a
bucket.
"""

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from made_arms import PLANAR_MJCF
from made_planar import moving
from made_s3 import s3_environment

from tauext.cli import main
from tauext.data.dataset import Split, load_dataset, save_split
from tauext.data.recording_file import load_recording, save_recording
from tauext.errors import StoreError
from tauext.files.atomic_write import atomic_write
from tauext.files.copies import send_folder
from tauext.files.places import place_of

PROGRAM = os.environ.get("TAUEXT_VERSITYGW") or shutil.which("versitygw") or ""
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not PROGRAM, reason="no versitygw: neither on PATH nor named by TAUEXT_VERSITYGW"),
]


class Gateway:
    """The server, which can be stopped, killed and started again on the same port and folder."""

    def __init__(self, objects: Path):
        self.objects = objects
        (objects / "arms").mkdir(parents=True)
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.start()

    def start(self) -> None:
        command = [PROGRAM, "--access", "tester", "--secret", "secret-of-the-tester", "--quiet"]
        command += ["--port", f"127.0.0.1:{self.port}", "posix", str(self.objects)]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        deadline = time.monotonic() + 30
        while time.monotonic() < deadline:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            time.sleep(0.05)
        raise AssertionError("versitygw does not listen")

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture
def gateway(tmp_path, monkeypatch):
    gateway = Gateway(tmp_path / "objects")
    more = {"TAUEXT_STORE_STALL_S": "1", "XDG_CACHE_HOME": str(tmp_path / "cache")}
    for name, value in (s3_environment(gateway.port) | more).items():
        monkeypatch.setenv(name, value)
    yield gateway
    gateway.kill()


@pytest.fixture
def folder(tmp_path) -> Path:
    """A dataset with two training recordings and three for limits."""
    folder = tmp_path / "data"
    folder.mkdir()
    (folder / "robot.xml").write_text(PLANAR_MJCF)
    names = [f"free-{k}" for k in range(5)]
    for seed, name in enumerate(names):
        save_recording(moving(seed, 60.0, (1.0, 1.0), name), folder / f"{name}.parquet")
    files = tuple(f"{name}.parquet" for name in names)
    save_split(Split(files[:2], (), (), (), files[2:]), folder)
    return folder


def run(*words: object) -> int:
    return main([str(word) for word in words])


def test_training_and_limits_are_the_same_from_a_real_server(gateway, folder, tmp_path):
    send_folder(folder, place_of("s3://arms/data"))
    assert load_dataset("s3://arms/data").split == load_dataset(folder).split
    for data, base in ((folder, tmp_path), ("s3://arms/data", place_of("s3://arms/out"))):
        assert run("train", "--data", data, "--out", base / "arm.tauext", "--recipe", "friction") == 0
        again = ("calibrate", "--bundle", base / "arm.tauext", "--data", data, "--in-hours", 1)
        assert run(*again, "--out", base / "again.tauext") == 0
    for name in ("arm.tauext", "again.tauext", "again.run.json"):
        assert (gateway.objects / "arms" / "out" / name).read_bytes() == (tmp_path / name).read_bytes()


def test_a_large_file_is_put_together_from_parts(gateway):
    content = os.urandom(25_000_000)
    with atomic_write(place_of("s3://arms/a/large.bin")) as part:
        part.write_bytes(content)
    assert (gateway.objects / "arms/a/large.bin").read_bytes() == content
    assert place_of("s3://arms/a/large.bin").read_bytes() == content


def test_a_server_that_stalls_dies_and_comes_back(gateway, folder, capsys):
    send_folder(folder, place_of("s3://arms/data"))
    name = "s3://arms/data/free-0.parquet"
    os.kill(gateway.process.pid, signal.SIGSTOP)
    with pytest.raises(StoreError, match="stalled, tried 2 times"):
        load_recording(name)
    os.kill(gateway.process.pid, signal.SIGCONT)
    np.testing.assert_array_equal(load_recording(name).tau, load_recording(folder / "free-0.parquet").tau)
    gateway.kill()
    assert run("show", name) == 2
    assert "cannot be reached" in (told := capsys.readouterr().err) and told.count("\n") == 1
    gateway.start()
    assert run("show", name) == 0


def test_a_wrong_key_and_a_bucket_that_is_not_there_are_said(gateway, capsys, monkeypatch):
    assert run("show", "s3://none/arm.tauext") == 2
    assert "there is no bucket 'none'" in capsys.readouterr().err
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "another")
    assert run("show", "s3://arms/arm.tauext") == 2
    assert "access is denied" in capsys.readouterr().err


def test_a_killed_sender_leaves_nothing_under_the_name(gateway, tmp_path):
    code = (
        "import os, threading, sys; from pathlib import Path; from tauext.files.places import place_of; "
        "from tauext.files.copies import send; Path(sys.argv[1]).write_bytes(os.urandom(200_000_000)); "
        "print('now', flush=True); send(Path(sys.argv[1]), place_of('s3://arms/killed.bin'))"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "large")], stdout=subprocess.PIPE)
    assert process.stdout and process.stdout.readline() == b"now\n"
    uploads = gateway.objects / "arms"
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline and not any(path.is_file() for path in uploads.rglob("*")):
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert not place_of("s3://arms/killed.bin").exists()
