"""Files in a real S3 server on loopback that keeps its objects on disk: versitygw, where it is found.

    go install github.com/versity/versitygw/cmd/versitygw@latest     # to ~/go/bin
    TAUEXT_VERSITYGW=~/go/bin/versitygw python -m pytest packages/fleet/tests/test_store_server.py

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

import pytest
from made_s3 import s3_environment
from tauext_fleet.locations import located
from tauext_fleet.store import StoreError

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


def test_a_large_file_is_put_together_from_parts(gateway, tmp_path):
    content = os.urandom(25_000_000)
    (tmp_path / "large.bin").write_bytes(content)
    stored = located("s3://arms/a/large.bin")
    stored.upload(tmp_path / "large.bin")
    assert (gateway.objects / "arms/a/large.bin").read_bytes() == content == stored.read_bytes()
    stored.parent.download(tmp_path / "copy")
    assert (tmp_path / "copy/large.bin").read_bytes() == content


def test_a_server_that_stalls_dies_and_comes_back(gateway):
    stored = located("s3://arms/a.bin")
    stored.write_bytes(b"x")
    os.kill(gateway.process.pid, signal.SIGSTOP)
    with pytest.raises(StoreError, match="the store stalls"):
        stored.read_bytes()
    os.kill(gateway.process.pid, signal.SIGCONT)
    assert stored.read_bytes() == b"x"
    gateway.kill()
    with pytest.raises(StoreError, match="cannot be reached"):
        stored.read_bytes()
    gateway.start()
    assert stored.read_bytes() == b"x"


def test_a_wrong_key_is_reported(gateway, monkeypatch):
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "another")
    with pytest.raises(StoreError, match="access is denied"):
        located("s3://arms/arm.tauext").exists()


def test_a_killed_sender_leaves_nothing_under_the_name(gateway, tmp_path):
    code = (
        "import os, sys; from pathlib import Path; from tauext_fleet.store import Stored; "
        "Path(sys.argv[1]).write_bytes(os.urandom(200_000_000)); print('now', flush=True); "
        "Stored.of_url('s3://arms/killed.bin').upload(Path(sys.argv[1]))"
    )
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "large")], stdout=subprocess.PIPE)
    assert process.stdout and process.stdout.readline() == b"now\n"
    uploads = gateway.objects / "arms"
    deadline = time.monotonic() + 30
    while time.monotonic() < deadline and not any(path.is_file() for path in uploads.rglob("*")):
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert not located("s3://arms/killed.bin").exists()
