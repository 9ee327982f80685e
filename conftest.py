"""How workers (pytest-xdist, --dist loadfile) share the tests, and what tests of several files need.

A file's tests run on one worker, one after the other, so what its fixtures of module scope train, simulate or build is
made once in a run. Files that TOGETHER names share a worker, too. Tests of the files in APART go to any, and what their
fixtures of session scope make on each of them costs little.
"""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest
from made_robot_libraries import Arm, franka_library, rtde_library

# As in the Makefile, and before NumPy is imported: threads of two workers would wait for each other.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
# A shell without job control starts what it puts in the background with Ctrl-C ignored; tests send one.
signal.signal(signal.SIGINT, signal.default_int_handler)

TOGETHER = ("test_page", "test_ros2", "test_fleet")
"""Beginnings of names of files that use one training, talk in one DDS domain, or start Ray, one at a time."""
APART = ("test_check.py", "test_kinematics.py", "test_small_datasets.py")
"""Files whose tests go, one by one, to whichever worker is free: a third of all the time."""


def shared_by(nodeid: str) -> str:
    """Tests of the same answer run on the same worker."""
    file = nodeid.split("::")[0].split("/")[-1]
    if file in APART:
        return nodeid
    return next((begin for begin in TOGETHER if file.startswith(begin)), file)


@pytest.hookimpl(optionalhook=True)  # pytest runs without pytest-xdist, too
def pytest_xdist_make_scheduler(config: pytest.Config, log):
    # The mark xdist_group is for this, but with --dist loadgroup xdist 3.8 ignores it under pytest 9.2.
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadScopeScheduling

    class Shared(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return shared_by(nodeid)

    return Shared(config, log)


DURATIONS = "tauext/durations_s"
"""Seconds that each test took when it ran last, in pytest's cache."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--shorter-than", type=float, metavar="SECONDS", help="leave out tests that took longer last time")


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    longest_s = config.getoption("--shorter-than")
    if longest_s is None or not config.pluginmanager.hasplugin("cacheprovider"):
        return
    took_s = config.cache.get(DURATIONS, {})
    left_out = [item for item in items if took_s.get(item.nodeid, 0.0) > longest_s]
    config.hook.pytest_deselected(items=left_out)
    items[:] = [item for item in items if took_s.get(item.nodeid, 0.0) <= longest_s]


class Durations:
    """Remembers how long each test took, with what its fixtures needed first."""

    def __init__(self, config: pytest.Config):
        self.config, self.took_s = config, config.cache.get(DURATIONS, {})

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        before_s = 0.0 if report.when == "setup" else self.took_s.get(report.nodeid, 0.0)
        self.took_s[report.nodeid] = round(before_s + report.duration, 3)

    def pytest_sessionfinish(self) -> None:
        self.config.cache.set(DURATIONS, self.took_s)


def pytest_configure(config: pytest.Config) -> None:
    if not hasattr(config, "workerinput") and config.pluginmanager.hasplugin("cacheprovider"):
        config.pluginmanager.register(Durations(config))


def of_this_run(tmp_path_factory) -> Path:
    """A folder that all workers of this run share."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory):
    """What tests remember and keep is none of the user's; what one worker has looked at, none looks at again."""
    folder = of_this_run(tmp_path_factory) / "cache"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder))
        yield folder


@pytest.fixture(scope="session", autouse=True)
def uncollected():
    """Loops begin without a full garbage collection, which takes 0.15 s with all that a test run has loaded."""
    from types import SimpleNamespace

    nothing = dict.fromkeys(("collect", "freeze", "unfreeze"), lambda: None)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tauext.monitor.loop.gc", SimpleNamespace(**nothing))
        yield


@pytest.fixture
def undrawn():
    """Pages of this test hold a pixel for each picture."""
    import made_results

    with made_results.undrawn():
        yield


@pytest.fixture
def unexamined(monkeypatch, tmp_path_factory) -> list[list[str]]:
    """The recordings of each examination before a training or after an import, in which all but the cheap checks find
    nothing: an examination takes longer than many a training."""
    from types import SimpleNamespace

    calls: list[list[str]] = []
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("unexamined")))  # no other test is to remember it

    def nothing_found(recordings, robot):
        calls.append([r.name for r in recordings])
        return SimpleNamespace(findings=[])

    monkeypatch.setattr("tauext.check.before_training.examine", nothing_found)
    return calls


# --- Libraries of makers, replaced by stand-ins.


@pytest.fixture
def ur(monkeypatch):
    arm = Arm(6, 0.002)
    monkeypatch.setitem(sys.modules, "rtde_receive", rtde_library(arm))
    monkeypatch.setattr("tauext.sources.ur.expect_controller", lambda host: None)
    return arm


@pytest.fixture
def franka(monkeypatch):
    arm = Arm(7, 0.001)
    monkeypatch.setitem(sys.modules, "pylibfranka", franka_library(arm))
    return arm
