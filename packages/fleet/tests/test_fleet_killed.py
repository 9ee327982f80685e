"""Whatever ends a worker or the driver of a fleet costs the tasks that ran: real processes, killed midway."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from pathlib import Path

import pytest
from made_fleets import QUICK, arms_of, process_of, small_dataset, started, touched, write_fleet, written

pytestmark = pytest.mark.slow
PATIENCE_S = 300.0
"""Longer than any of this takes on a machine that is busy with other things."""


def heeds_ctrl_c() -> None:
    """What a shell starts behind an & ignores SIGINT, and so do its children; a test run may be one of them."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def driver_of(fleet: Path, out: Path, *more: str) -> subprocess.Popen:
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    return started(fleet, out, *more, preexec_fn=heeds_ctrl_c, **pipes)


def until(there, process: subprocess.Popen | None = None):
    """The first true answer, while the process runs."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        if answer := there():
            return answer
        assert process is None or process.poll() is None, process.communicate()
        time.sleep(0.005)
    raise AssertionError("waited in vain")


def parts(out: Path) -> list[Path]:
    return sorted(out.glob("arms/*/.*.part-*"))


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


def finished(fleet: Path, out: Path, workers: int) -> dict[str, bytes]:
    """What an undisturbed command has written at its end."""
    driver = driver_of(fleet, out, f"--workers={workers}")
    _, said = driver.communicate()
    assert driver.returncode == 0, said
    return written(out)


def test_a_killed_worker_costs_a_try_and_fails_its_task_after_the_stated_number(fleet, tmp_path):
    undisturbed = finished(fleet, fleet.parent / "out", 1)
    for retries, workers in ((1, 2), (0, 1)):
        out = tmp_path / str(retries)
        driver = driver_of(fleet, out, "--workers", str(workers), "--retries", str(retries), "--json")
        (first, *_) = until(lambda out=out: parts(out), driver)
        os.kill(process_of(first), signal.SIGKILL)
        told, said = driver.communicate(timeout=PATIENCE_S)
        summary = [json.loads(line) for line in told.splitlines()][-1]
        assert driver.returncode == 1 - retries, said
        assert (summary["done"], summary["failed"]) == (1 + retries, 1 - retries)
        if retries:
            assert written(out) == undisturbed and not parts(out)
    (failure,) = summary["failures"]
    assert failure["reason"].startswith("Ray gave it up: WorkerCrashedError: The worker died")


def test_ctrl_c_and_a_killed_driver_cost_the_tasks_that_ran(fleet, tmp_path):
    driver = driver_of(fleet, tmp_path, "--workers", "1")
    until(lambda: list(tmp_path.glob("arms/*/[!.]*/task.json")), driver)
    (running, *_) = until(lambda: parts(tmp_path), driver)
    driver.send_signal(signal.SIGINT)
    _, said = driver.communicate(timeout=PATIENCE_S)
    assert driver.returncode == 130 and "tauext: interrupted; finished tasks are kept" in said
    assert gone(process_of(running)) and not parts(tmp_path)
    counts = json.loads((tmp_path / "fleet.json").read_text())["counts"]
    assert counts == {"arms": 2, "done": 0, "failed": 0, "waiting": 2}
    kept = touched(tmp_path)

    driver = driver_of(fleet, tmp_path, "--workers", "1")
    (running, *_) = until(lambda: parts(tmp_path), driver)
    driver.kill()
    driver.communicate()
    until(lambda: gone(process_of(running)))  # no worker lives on without its driver

    assert finished(fleet, tmp_path, 2) == finished(fleet, tmp_path / "undisturbed", 1)
    assert kept and kept.items() <= touched(tmp_path).items() and not parts(tmp_path)
