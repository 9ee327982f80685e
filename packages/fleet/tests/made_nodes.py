"""A Ray cluster on this machine whose worker, node, head or driver is killed midway through a fleet's command.

The cluster is two nodes of one core each. Midway: some tasks are finished, and the victim is at work. Untouched: what
was finished then has the same bytes and times at the end. Equal: outputs, and the book without its seconds, are those
of an undisturbed run with one local worker.
"""

from __future__ import annotations

import os
import secrets
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from made_fleets import QUIET, process_of, started, written

# --- A Ray cluster of nodes on this machine, one core each, whose processes can be killed one by one.


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
    return subprocess.Popen(command, env=os.environ | ENVIRONMENT, start_new_session=True, **QUIET)


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
    for name in filter(str.isdigit, os.listdir("/proc")):
        try:
            stat = Path("/proc", name, "stat").read_text()
            parents.setdefault(int(stat.rpartition(")")[2].split()[1]), []).append(int(name))
        except OSError:
            continue  # it ended meanwhile
    found, waiting = [], [pid]
    while waiting:
        children = parents.get(waiting.pop(), [])
        found += children
        waiting += children
    return found


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


# --- The cases.


MIDWAY = 3
"""Finished tasks before anything is killed."""


@dataclass
class Running:
    """A fleet's command under way."""

    out: Path
    driver: subprocess.Popen[bytes]

    def victim(self, of: Callable[[int], bool] = lambda pid: True) -> int:
        """A process that is at work on a task, once MIDWAY are done."""
        found: list[int] = []

        def there() -> bool:
            assert self.driver.poll() is None, (
                f"the driver ended with {self.driver.returncode} before anything was killed"
            )
            parts = self.out.glob("arms/*/.*.part-*") if len(done(self.out)) >= MIDWAY else ()
            found[:] = [pid for part in parts if of(pid := process_of(part))]
            return bool(found)

        until(there, "a task under way")
        return found[0]


def done(out: Path) -> list[Path]:
    return list(out.glob("arms/*/[!.]*/task.json"))


def touched(out: Path) -> dict[str, tuple[int, bytes]]:
    """Time and bytes of each file of finished tasks."""
    files = [file for marker in done(out) for file in marker.parent.rglob("*") if file.is_file()]
    return {str(file): (file.stat().st_mtime_ns, file.read_bytes()) for file in files}


def free_port() -> int:
    """A port of this computer that nothing listens on."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def outputs(out: Path) -> dict[str, bytes]:
    """What was written, without the folder's name in reasons."""
    return {name: content.replace(str(out).encode(), b"OUT") for name, content in written(out).items()}


@contextmanager
def under_way(fleet: Path, out: Path, *more: str) -> Iterator[Running]:
    """The command, which does not live on."""
    driver = started(fleet, out, *more, env=os.environ | ENVIRONMENT, **QUIET)
    try:
        yield Running(out, driver)
    finally:
        driver.kill()
        driver.wait()


Disturb = Callable[[Running, Nodes], object]


def worker(running: Running, nodes: Nodes) -> None:
    kill(running.victim())


def node(running: Running, nodes: Nodes) -> None:
    lost = nodes.others[0]
    running.victim(lambda pid: belongs(nodes, pid, lost))
    kill_raylet(lost)


def head(running: Running, nodes: Nodes) -> None:
    running.victim()
    kill_all(nodes.head)


def driver(running: Running, nodes: Nodes) -> None:
    running.victim()
    running.driver.kill()


def belongs(nodes: Nodes, pid: int, to: subprocess.Popen[bytes]) -> bool:
    try:
        return nodes.node_of(pid) is to
    except ProcessLookupError:
        return False


CASES: dict[str, tuple[Disturb, bool]] = {
    "a worker process": (worker, False),
    "a worker node": (node, False),
    "the head, then a new cluster": (head, False),
    "the head, then local workers": (head, True),
    "the driver, then the same cluster": (driver, False),
    "the driver, then local workers": (driver, True),
}
"""What is killed, and whether local workers go on."""


def expect_nothing_lost(case: str, fleet: Path, out: Path, undisturbed: dict[str, bytes]) -> None:
    """One case, with a cluster of its own; only a worker costs the command nothing."""
    disturb, local = CASES[case]
    with Nodes() as nodes:
        with under_way(fleet, out, "--ray", nodes.address) as running:
            disturb(running, nodes)
            kept, finished = touched(out), len(done(out))
            exits = [running.driver.wait()]
        if exits[0] != 0 and not local and disturb is not head:
            exits.append(again(fleet, out, "--ray", nodes.address))
    if exits[0] != 0 and local:
        exits.append(again(fleet, out, "--workers", "2"))
    elif exits[0] != 0 and disturb is head:
        with Nodes() as nodes:
            exits.append(again(fleet, out, "--ray", nodes.address))
    assert exits[-1] == 0 and (len(exits) == 1) == case.startswith("a worker"), exits
    assert finished >= MIDWAY and kept and kept.items() <= touched(out).items()
    assert outputs(out) == undisturbed and not list(out.glob("arms/*/.*.part-*"))


def again(fleet: Path, out: Path, *more: str) -> int:
    with under_way(fleet, out, *more) as running:
        return running.driver.wait()
