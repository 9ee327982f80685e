"""A Ray cluster of nodes on this machine, one core each, whose processes can be killed one by one."""

from __future__ import annotations

import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Self

PATIENCE_S = 120.0
STORE_BYTES = 100_000_000
"""Of each node's memory for objects: a task's outcome is some letters."""
ENVIRONMENT = {
    "RAY_worker_niceness": "0",  # else a busy machine never gets to them
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_gcs_rpc_server_reconnect_timeout_s": "10",  # a lost head: Ray's own is a minute
    "RAY_AUTH_MODE": "token",
    "RAY_AUTH_TOKEN": secrets.token_hex(16),  # nodes and drivers of this process, and nobody else
}
"""Of nodes, and of drivers that are to use them."""


class Nodes:
    """A context: a head and as many more nodes as asked for, each a `ray start` of its own with its processes."""

    def __init__(self, more: int = 1) -> None:
        self._more = more
        self.address = f"127.0.0.1:{free_port()}"
        self.head: subprocess.Popen[bytes]
        self.others: list[subprocess.Popen[bytes]] = []
        self._folder = tempfile.TemporaryDirectory(prefix="ray-", ignore_cleanup_errors=True)  # sockets: a short path

    def __enter__(self) -> Self:
        port = self.address.rpartition(":")[2]
        ip, folder = "--node-ip-address=127.0.0.1", f"--temp-dir={self._folder.name}"
        self.head = start("--head", f"--port={port}", "--include-dashboard=false", ip, folder)
        try:
            until(lambda: answers(self.address), "Ray's head")
            for k in range(self._more):
                self.others.append(start(f"--address={self.address}", f"--node-ip-address=127.0.0.{k + 2}"))
            until(lambda: all(raylet_of(node) for node in self.others), "Ray's nodes")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        for node in [*self.others, self.head]:
            kill_all(node)
        self._folder.cleanup()

    def node_of(self, worker: int) -> subprocess.Popen[bytes]:
        """The node that started this process."""
        for node in [self.head, *self.others]:
            if worker in descendants(node.pid):
                return node
        raise ProcessLookupError(f"process {worker} belongs to no node")


def start(*words: str) -> subprocess.Popen[bytes]:
    """A node that runs until its `ray start` is ended."""
    ray = Path(sys.executable).with_name("ray")
    command = [str(ray), "start", "--block", "--num-cpus=1", f"--object-store-memory={STORE_BYTES}", *words]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "stdin": subprocess.DEVNULL}
    return subprocess.Popen(command, env=os.environ | ENVIRONMENT, start_new_session=True, **quiet)


def kill_all(node: subprocess.Popen[bytes]) -> None:
    """kill -9 of `ray start` and all that it started."""
    for pid in [node.pid, *descendants(node.pid)]:
        kill(pid)
    node.wait()


def kill_raylet(node: subprocess.Popen[bytes]) -> None:
    """kill -9 of the process that is the node to the cluster; its workers end with it."""
    raylet = raylet_of(node)
    assert raylet is not None, "the node has no raylet"
    kill(raylet)


def kill(pid: int) -> None:
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        pass


def raylet_of(node: subprocess.Popen[bytes]) -> int | None:
    """Its process; None: it has none yet."""
    return next((pid for pid in descendants(node.pid) if name_of(pid) == "raylet"), None)


def name_of(pid: int) -> str:
    try:
        return Path(f"/proc/{pid}/comm").read_text().strip()
    except OSError:
        return ""


def descendants(pid: int) -> list[int]:
    """Processes that it started, and those that they started."""
    parents: dict[int, list[int]] = {}
    for entry in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents.setdefault(int(entry.read_text().rpartition(")")[2].split()[1]), []).append(int(entry.parent.name))
        except OSError:
            continue  # it ended meanwhile
    found, waiting = [], [pid]
    while waiting:
        children = parents.get(waiting.pop(), [])
        found += children
        waiting += children
    return found


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def answers(address: str) -> bool:
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), 1).close()
    except OSError:
        return False
    return True


def until(there, what: str) -> None:
    """Wait; RuntimeError after PATIENCE_S."""
    end = time.monotonic() + PATIENCE_S
    while not there():
        if time.monotonic() > end:
            raise RuntimeError(f"{what}: not there after {PATIENCE_S:g} s")
        time.sleep(0.05)
