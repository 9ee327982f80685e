"""Whatever ends a worker or the driver of a fleet costs the tasks that ran: real processes, killed midway."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from made_fleets import QUICK, arms_of, small_dataset, touched, write_fleet, written

PATIENCE_S = 300.0
"""Longer than any of this takes on a machine that is busy with other things."""


def command(fleet: Path, out: Path, *more: str) -> list[str]:
    return [sys.executable, "-m", "tauext", "fleet", "run", str(fleet), "--out", str(out), *more]


def heeds_ctrl_c() -> None:
    """What a shell starts behind an & ignores SIGINT, and so do its children; a test run may be one of them."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def started(fleet: Path, out: Path, *more: str) -> subprocess.Popen:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return subprocess.Popen(command(fleet, out, *more), preexec_fn=heeds_ctrl_c, **pipes)


def until(there, process: subprocess.Popen):
    """The first true answer, while the process runs."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        if answer := there():
            return answer
        assert process.poll() is None, process.communicate()
        time.sleep(0.005)
    raise AssertionError("waited in vain")


def parts(out: Path) -> list[Path]:
    return sorted(out.glob("arms/*/.*.part-*"))


def process_of(part: Path) -> int:
    """The worker's that writes there."""
    return int(re.search(r"-(\d+)-\w+$", part.name)[1])


def gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fleet")
    small_dataset(folder / "data")
    return write_fleet(folder, 'stages = ["train", "evaluate"]\n' + QUICK + arms_of("a", "b", dataset="data"))


@pytest.fixture(scope="module")
def undisturbed(fleet) -> dict[str, bytes]:
    out = fleet.parent / "out"
    done = subprocess.run(command(fleet, out, "--workers", "1"), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return written(out)


@pytest.mark.slow
def test_a_killed_worker_costs_the_task_it_was_at(fleet, undisturbed, tmp_path):
    driver = started(fleet, tmp_path, "--workers", "2", "--retries", "1")
    (first, *_) = until(lambda: parts(tmp_path), driver)
    os.kill(process_of(first), signal.SIGKILL)
    _, said = driver.communicate(timeout=PATIENCE_S)
    assert driver.returncode == 0, said
    assert written(tmp_path) == undisturbed and not parts(tmp_path)


@pytest.mark.slow
def test_a_task_whose_worker_dies_each_time_fails_after_the_stated_number(fleet, tmp_path):
    driver = started(fleet, tmp_path, "--workers", "1", "--retries", "0", "--json")
    (first, *_) = until(lambda: parts(tmp_path), driver)
    os.kill(process_of(first), signal.SIGKILL)
    told, _ = driver.communicate(timeout=PATIENCE_S)
    summary = [json.loads(line) for line in told.splitlines()][-1]
    assert driver.returncode == 1 and (summary["done"], summary["failed"]) == (1, 1)
    (failure,) = summary["failures"]
    assert failure["reason"].startswith("Ray gave it up: WorkerCrashedError: The worker died")


@pytest.mark.slow
def test_ctrl_c_and_a_killed_driver_cost_the_tasks_that_ran(fleet, undisturbed, tmp_path):
    driver = started(fleet, tmp_path, "--workers", "1")
    until(lambda: list(tmp_path.glob("arms/*/[!.]*/task.json")), driver)
    (running, *_) = until(lambda: parts(tmp_path), driver)
    driver.send_signal(signal.SIGINT)
    _, said = driver.communicate(timeout=PATIENCE_S)
    assert driver.returncode == 130 and "tauext: interrupted; finished tasks are kept" in said
    assert gone(process_of(running)) and not parts(tmp_path)
    counts = json.loads((tmp_path / "fleet.json").read_text())["counts"]
    assert counts == {"arms": 2, "done": 0, "failed": 0, "waiting": 2}
    kept = touched(tmp_path)

    driver = started(fleet, tmp_path, "--workers", "1")
    (running, *_) = until(lambda: parts(tmp_path), driver)
    driver.kill()
    driver.communicate()
    end = time.monotonic() + PATIENCE_S
    while not gone(process_of(running)):
        assert time.monotonic() < end, "a worker lives on without its driver"
        time.sleep(0.01)

    done = subprocess.run(command(fleet, tmp_path, "--workers", "2"), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert kept and kept.items() <= touched(tmp_path).items()
    assert written(tmp_path) == undisturbed and not parts(tmp_path)
