"""A fleet: what is done is kept, what changed is done again, and an arm that fails does so alone."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
import time
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from made_arms import PLANAR_RIG, planar_rig, urdf
from made_fleets import QUICK, QUICKER, arms_of, run_here, small_dataset, touched, workers_here, write_fleet, written
from made_recordings import JOINT_STATES, joint_rows, write_bag
from tauext_fleet import task as build_file
from tauext_fleet.book import plan_fleet
from tauext_fleet.config import FleetConfig
from tauext_fleet.fleet_file import EXAMPLE, load_fleet
from tauext_fleet.stages import STAGES
from tauext_fleet.task import MARKER, Outcome, Task, finished, locked, reason_and_report, run_task
from tauext_fleet.workers import Workers, short_folder
from test_import_table import files_imported, name_of

from tauext.cli import main
from tauext.config import TrainConfig
from tauext.data.dataset import load_dataset
from tauext.data.recording_file import load_recording, save_recording
from tauext.errors import ConfigError
from tauext.files.atomic_write import atomic_write
from tauext.train.stage import train_bundle

pytestmark = pytest.mark.usefixtures("undrawn")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return small_dataset(tmp_path_factory.mktemp("fleet") / "data")


@pytest.fixture(scope="module")
def whole_bag(tmp_path_factory):
    rows = joint_rows(("tip", "base"), 2000)
    return write_bag(tmp_path_factory.mktemp("bags") / "whole", "ros1", {"/joint_states": rows})


@pytest.fixture
def place(tmp_path, data, whole_bag):
    """A folder with the dataset, a robot file, its description, and two bags, of which one is cut off."""
    (tmp_path / "data").symlink_to(data)
    (tmp_path / "arm.urdf").write_text(urdf(planar_rig()))
    (tmp_path / "arm.toml").write_text(PLANAR_RIG + JOINT_STATES)
    raw = whole_bag.read_bytes()
    (tmp_path / "whole.bag").write_bytes(raw)
    (tmp_path / "broken.bag").write_bytes(raw[:200])  # before the first message
    return tmp_path


BAGS = """
stages = ["import"]
arm = "arm.toml"
[[arms]]
name = "one"
sources = ["whole.bag"]
[[arms]]
name = "two"
sources = ["broken.bag"]
"""


def whys(fleet, out) -> dict[tuple[str, str], str]:
    """Why each task that is to be done is."""
    steps = [step for arm in plan_fleet(load_fleet(fleet), out) for step in arm.steps]
    return {(step.task.arm, step.task.stage): step.why for step in steps if step.why}


def test_all_stages_are_done_once_and_bundles_are_those_of_train(place, monkeypatch):
    fleet = write_fleet(place, QUICK + arms_of("a", dataset="data"))
    end, done = run_here(fleet, place / "out", monkeypatch)
    assert end.book.counts() == {"arms": 1, "done": 1, "failed": 0, "waiting": 0}
    assert done == [("a", "check"), ("a", "train"), ("a", "evaluate")]
    config = TrainConfig(recipe="observer", threads=1)
    train_bundle(load_dataset(place / "data"), place / "a.tauext", config=config)
    assert (place / "out/arms/a/train/a.tauext").read_bytes() == (place / "a.tauext").read_bytes()
    before = touched(place / "out")
    end, done = run_here(fleet, place / "out", monkeypatch)
    assert done == [] and (end.done_now, end.kept) == (0, 3) and touched(place / "out") == before
    book = json.loads((place / "out/fleet.json").read_text())
    assert book["arms"][0]["bundle"] == "arms/a/train/a.tauext"
    assert (place / "out" / book["arms"][0]["results"] / "results.json").is_file()


def test_a_changed_setting_does_again_what_depends_on_it_and_says_so(place, monkeypatch):
    arms = arms_of("a", "b", dataset="data")
    out = place / "out"
    done = run_here(write_fleet(place, QUICK + arms), out, monkeypatch, QUICKER)[1]
    assert done == [(arm, stage) for stage in ("check", "train", "evaluate") for arm in "ab"]
    fleet = write_fleet(place, QUICK + arms + "evaluate.seed = 5\n")
    assert whys(fleet, out) == {("b", "evaluate"): "inputs changed: evaluate.seed"}
    assert run_here(fleet, out, monkeypatch, QUICKER)[1] == [("b", "evaluate")]
    fleet = write_fleet(place, QUICK + arms + "evaluate.seed = 5\ntrain.observer.gain_per_s = 25\n")
    changed = {"train": "inputs changed: train.observer.gain_per_s", "evaluate": "train is done again"}
    assert whys(fleet, out) == {("b", stage): why for stage, why in changed.items()}
    assert run_here(fleet, out, monkeypatch, QUICKER)[1] == [("b", "train"), ("b", "evaluate")]
    assert whys(fleet, out) == {}


def test_contents_count_and_not_places_or_times(place, monkeypatch, data):
    out, fleet = place / "out", write_fleet(place, BAGS.replace('sources = ["broken.bag"]', 'sources = ["whole.bag"]'))
    run_here(fleet, out, monkeypatch)
    os.utime(place / "whole.bag")
    (place / "else").mkdir()
    for name in ("whole.bag", "arm.toml", "arm.urdf", "fleet.toml"):
        shutil.move(place / name, place / "else" / name)
    fleet = place / "else/fleet.toml"
    assert whys(fleet, out) == {}
    with (place / "else/arm.urdf").open("a") as file:
        file.write("\n")
    assert whys(fleet, out) == {(arm, "import"): "inputs changed: robot file arm.urdf" for arm in ("one", "two")}
    with (place / "else/arm.toml").open("a") as file:
        file.write("\n")
    assert whys(fleet, out)["two", "import"] == "inputs changed: arm.toml, robot file arm.urdf"


def test_a_broken_bag_fails_alone_and_once_mended_goes_on_alone(place, capsys, monkeypatch):
    workers_here(monkeypatch, QUICKER | {"import": STAGES["import"]})
    text = BAGS.replace('"import"', '"import", "check"')
    fleet, out = str(write_fleet(place, text)), place / "out"
    assert main(["fleet", "run", fleet, "--out", str(out)]) == 1
    told = capsys.readouterr().out.splitlines()
    (line,) = [line for line in told if line.startswith("two: ")]
    assert line.startswith("two: import failed: ") and "broken.bag" in line
    book = {arm["name"]: arm for arm in json.loads((out / "fleet.json").read_text())["arms"]}
    assert book["two"]["state"] == "failed" and book["two"]["stages"]["import"]["reason"] in line
    check = book["two"]["stages"]["check"]
    assert (check["state"], check["seconds"], check["reason"]) == ("skipped", None, "import failed") and check["hash"]
    assert (out / "arms/one/import/one/split.json").is_file() and not (out / "arms/two/import").exists()
    assert (out / "arms/two/import.failed.txt").is_file()
    before = {name: at for name, at in touched(out).items() if name.startswith("arms/one/")}
    shutil.copy(place / "whole.bag", place / "broken.bag")
    capsys.readouterr()
    assert main(["fleet", "run", fleet, "--out", str(out), "--dry-run"]) == 0
    assert "two import: failed last time" in capsys.readouterr().out
    assert main(["fleet", "run", fleet, "--out", str(out), "--json"]) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [event["event"] for event in events] == ["start", "task", "task", "summary"]
    assert [(event["arm"], event["stage"]) for event in events[1:-1]] == [("two", "import"), ("two", "check")]
    counts = {"arms": 2, "done": 2, "failed": 0, "waiting": 0, "done_now": 2, "kept": 2}
    assert events[-1] == {"event": "summary", **counts, "failures": [], "file": str(out / "fleet.json")}
    assert before and before.items() <= touched(out).items()
    assert not (out / "arms/two/import.failed.txt").exists()


def test_what_the_doctor_refuses_is_done_and_nothing_follows_it(place, data, monkeypatch):
    shutil.copytree(data, place / "flipped")
    for path in (place / "flipped").glob("*.parquet"):
        recording = load_recording(path)
        save_recording(replace(recording, tau=recording.tau * np.array([1.0, -1.0])), path)
    stages = QUICKER | {"check": STAGES["check"]}
    fleet, out = write_fleet(place, QUICK + arms_of("a", dataset="flipped")), place / "out"
    end, done = run_here(fleet, out, monkeypatch, stages)
    assert done == [("a", "check")]
    ((arm, stage, reason),) = end.book.failures()
    assert (arm, stage) == ("a", "check") and "fault" in reason and "joint2" in reason and "\n" not in reason
    assert "joint2" in (out / "arms/a/check/check.txt").read_text()
    end, done = run_here(fleet, out, monkeypatch, stages)
    assert done == [] and end.book.failures() == [(arm, stage, reason)]
    codes = json.loads((out / "arms/a/check/check.json").read_text())["findings"]
    accept = json.dumps([finding["code"] for finding in codes if finding["severity"] == "fault"])
    fleet = write_fleet(place, f"accept = {accept}\n" + QUICK + arms_of("a", dataset="flipped"))
    assert whys(fleet, out)["a", "check"] == "inputs changed: accept"
    assert run_here(fleet, out, monkeypatch, stages)[1][:2] == [("a", "check"), ("a", "train")]


def test_a_lost_output_is_made_again_and_a_half_one_is_cleared_away(place, monkeypatch):
    fleet, out = write_fleet(place, QUICK + arms_of("a", dataset="data")), place / "out"
    run_here(fleet, out, monkeypatch, QUICKER)
    before = written(out)
    (out / "arms/a/train/told.json").unlink()
    (out / "arms/a/.train.part-elsewhere-1-0").mkdir()
    assert whys(fleet, out) == {("a", "train"): "an output is missing or of another size: told.json"}
    assert run_here(fleet, out, monkeypatch, QUICKER)[1] == [("a", "train")]
    assert written(out) == before


def test_calibrate_is_a_stage_where_something_says_for_what(place):
    shutil.copytree(place / "data", place / "nights", symlinks=False)
    text = QUICK + arms_of("a", dataset="data") + arms_of("b", dataset="data", more="calibrate = {in_hours = 2.0}")
    fleet = load_fleet(write_fleet(place, text + arms_of("c", dataset="data", more='calibration = "nights"')))
    assert [arm.stages[-2] for arm in fleet.arms] == ["train", "calibrate", "calibrate"]
    planned = [step.task for arm in plan_fleet(fleet, place / "out") for step in arm.steps]
    plan = {(task.arm, task.stage): task for task in planned}
    assert plan["b", "calibrate"].work["dataset"] == str(place / "data")
    assert plan["c", "calibrate"].work["dataset"] == str(place / "nights")
    assert plan["c", "evaluate"].work["bundle"] == str(place / "out/arms/c/calibrate/c.tauext")
    assert plan["a", "train"].inputs | {"name": "b"} == plan["b", "train"].inputs


def test_settings_stand_over_one_another_fleet_then_type_then_arm(place):
    text = 'train = { recipe = "prior", alarm = { in_hours = 4.0, false_alarms = 2.0 } }\n'
    text += "[types.light]\ntrain = { alarm = { in_hours = 6.0 } }\n"
    text += arms_of("a", dataset="data", more='type = "light"\ntrain.alarm.contact_hold_s = 0.5')
    (arm,) = load_fleet(write_fleet(place, text)).arms
    alarm = arm.train.alarm
    assert (arm.train.recipe, alarm.false_alarms, alarm.in_hours, alarm.contact_hold_s) == ("prior", 2.0, 6.0, 0.5)


ONE = '[[arms]]\nname = "a"\ndataset = "data"\n'
WRONG = [
    ("", ["arms is missing", "[[arms]]"]),
    ("arms = [", ["not readable as TOML"]),
    ("stage = []\n" + ONE, ["unknown key 'stage'", "nearest known is 'stages'"]),
    (ONE + "dat = 1", ["arm 1", "unknown key 'dat'"]),
    ('[[arms]]\nname = "../a"\ndataset = "data"', ["name = '../a'", "letters"]),
    (ONE + ONE, ["two arms are named 'a'"]),
    (ONE + ONE.replace('"a"', '"A"'), ["two arms are named 'a' and 'A'"]),
    ('[[arms]]\nname = "a"\n', ["either sources", "or dataset"]),
    ('[[arms]]\nname = "a"\nsources = ["whole.bag"]\n', ["arm is missing", "tauext import --new"]),
    ('[[arms]]\nname = "a"\nsources = ["*.mcap"]\narm = "arm.toml"\n', ["'*.mcap'", "no such file"]),
    ('[[arms]]\nname = "a"\ndataset = "gone"\n', ["gone", "no such dataset"]),
    (ONE + 'robot = "gone.urdf"', ["gone.urdf", "URDF or MJCF"]),
    (ONE + 'case = "bent"', ["case = 'bent'", "exact, mass"]),
    (ONE + 'accept = ["no-such"]', ["no-such", "no code"]),
    (ONE + 'stages = ["train", "report"]', ["'report'", "import, check, train"]),
    (ONE + 'stages = ["evaluate"]', ["lack train"]),
    (ONE + "stages = []", ["stages = [] must be one of import, check"]),
    (ONE + "[types.light]\n", ["type = ''", "light"]),
    (ONE + "train.max_stepz = 5", ["[train]", "unknown key 'max_stepz'", "'max_steps'"]),
    (ONE + "train.observer.gain_per_s = 'fast'", ["gain_per_s", 'or "auto"']),
    (ONE + "train.hidden = 0", ["hidden = 0 must be a whole number from 1"]),
    (ONE + "train.threads = 4", ["threads is not set here", "--workers"]),
    (ONE + "evaluate.seed = -1", ["[evaluate]", "seed = -1"]),
    (ONE + "calibrate = 3", ["[calibrate] is 3, must be a table"]),
]


@pytest.mark.parametrize("text, says", WRONG, ids=lambda value: str(value)[:50])
def test_a_wrong_fleet_file_gets_one_line_and_nothing_runs(place, capsys, text, says):
    assert main(["fleet", "run", str(write_fleet(place, text)), "--out", str(place / "out")]) == 2
    told = capsys.readouterr()
    assert len(told.err.strip().splitlines()) == 1 and told.out == "" and not (place / "out").exists()
    for part in ("tauext: error: ", "fleet.toml", *says):
        assert part in told.err


def test_a_pattern_that_fits_the_whole_disk_is_refused(place, capsys, monkeypatch):
    monkeypatch.setattr("tauext_fleet.locations.MOST_FOUND", 1000)
    text = '[[arms]]\nname = "a"\nsources = ["/**"]\narm = "arm.toml"\n'
    assert main(["fleet", "run", str(write_fleet(place, text)), "--out", str(place / "out")]) == 2
    assert "'/**' fits more than 1,000 files and folders; name a folder below" in capsys.readouterr().err


def test_a_full_disk_is_reported_with_the_file(tmp_path):
    """Python's error of a write names no file; /dev/full fails as a full disk does."""
    kept = tmp_path / "kept.json"
    with pytest.raises(OSError, match="No space left on device: .*kept.json") as told:
        with atomic_write(kept), open("/dev/full", "wb", buffering=0) as disk:
            disk.write(b"x")
    assert reason_and_report(told.value)[0] == f"{kept}: cannot be read or written (No space left on device)"
    assert list(tmp_path.iterdir()) == []


def test_the_example_is_a_fleet(tmp_path, data):
    for name in ("ur10e.toml", "cell-02.toml"):
        (tmp_path / name).write_text(PLANAR_RIG + JOINT_STATES)
    (tmp_path / "arm.urdf").write_text(urdf(planar_rig()))
    for folder in ("bags/cell-01", "bags/cell-02", "datasets"):
        (tmp_path / folder).mkdir(parents=True)
    (tmp_path / "bags/cell-01/a.mcap").touch()
    for name in ("cell-03", "cell-03-nights"):
        (tmp_path / "datasets" / name).symlink_to(data)
    fleet = load_fleet(write_fleet(tmp_path, EXAMPLE))
    assert [len(arm.stages) for arm in fleet.arms] == [4, 4, 4] and fleet.arms[1].train.minutes == 20


def test_an_error_of_our_own_fails_one_task_and_is_reported_in_full(tmp_path):
    def stage(work, part):
        (part / "half").touch()
        raise KeyError("joint9")

    outcome = run_task(Task("a", "check", str(tmp_path / "check"), {}), {"check": stage})
    assert outcome.state == "failed" and "KeyError: 'joint9'" in outcome.reason and "test_fleet.py:" in outcome.reason
    assert [path.name for path in tmp_path.iterdir()] == ["check.failed.txt"]
    assert "Traceback" in (tmp_path / "check.failed.txt").read_text()


def test_what_another_worker_finished_meanwhile_stays(tmp_path):
    task = Task("a", "check", str(tmp_path / "check"), {})

    def write(work, part):
        (part / "out.txt").write_text("same")

    def overtaken(work, part):
        assert run_task(task, {"check": write}).state == "done"
        write(work, part)

    assert run_task(task, {"check": overtaken}).state == "done"
    assert finished(task) is not None and sorted(p.name for p in tmp_path.iterdir()) == ["check"]
    (tmp_path / "check" / MARKER).write_text("{")
    assert finished(task) is None and run_task(task, {"check": write}).state == "done"


def test_another_version_is_refused_by_the_worker(tmp_path):
    outcome = run_task(Task("a", "check", str(tmp_path / "check"), {}, {}, build="0.0.1+abc"), {})
    assert outcome == Outcome("failed", outcome.reason) and "0.0.1+abc" in outcome.reason


def test_code_that_decides_the_bytes_is_another_build(tmp_path, monkeypatch):
    roots = tuple(tmp_path / name for name in build_file.COUNTED)
    counted = "tauext/train/fitting.py", "tauext_lab/evaluate/events.py", "tauext_lab/torch_backend.py"
    for name in (*counted, "tauext/cli/show.py", "tauext_lab/report/page.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text("K = 1")
    monkeypatch.setattr(build_file, "ROOTS", roots)
    asked = build_file.build.__wrapped__
    builds = [asked()]
    assert re.fullmatch(r"\d[^+]*\+[0-9a-f]{12}", builds[0])
    for name in ("tauext/cli/show.py", "tauext_lab/report/page.py"):
        (tmp_path / name).write_text("K = 2")
    assert asked() == builds[0]
    for name in counted:
        (tmp_path / name).write_text("K = 2")
        builds.append(asked())
    (roots[0] / "train/fitting.py").rename(roots[0] / "train/other.py")
    assert len({*builds, asked()}) == 5


def test_no_stage_can_import_what_does_not_count_to_the_build():
    """The backend of `backend = torch` is loaded by its entry point, which no import shows."""
    modules = {name_of(file, root): (root, file) for root in build_file.ROOTS for file in root.rglob("*.py")}
    files = {module: file for module, (_, file) in modules.items()}
    commands = {"tauext_lab", "tauext_fleet"}  # the packages' own files list their commands
    reached, waiting = set(), {"tauext_fleet.stages", "tauext_lab.torch_backend"}
    while waiting - commands:
        module = (waiting - commands).pop()
        reached.add(module)
        waiting = (waiting | files_imported(files[module], set(files))) - reached
    names = [(root.name, file.relative_to(root)) for root, file in map(modules.get, reached)]
    assert [one for one in names if not build_file.is_counted(*one)] == []
    assert len(reached) > 100


def test_another_build_does_the_work_again_and_says_so(place, monkeypatch):
    fleet = write_fleet(place, QUICK + arms_of("a", dataset="data"))
    run_here(fleet, place / "out", monkeypatch, QUICKER)
    assert whys(fleet, place / "out") == {}
    mine = build_file.build()
    marker = place / "out/arms/a/check" / MARKER
    said = json.loads(marker.read_text())
    assert said["build"] == mine
    marker.write_text(json.dumps(said | {"build": "0.1.0+000000000000", "hash": "0" * 64}))
    assert whys(fleet, place / "out") == {("a", "check"): f"made by tauext 0.1.0+000000000000, this is {mine}"}


def test_two_drivers_do_not_share_a_folder(tmp_path):
    for _ in range(2):
        with locked(tmp_path), pytest.raises(ConfigError, match=f"at work here .process {os.getpid()}"):
            locked(tmp_path).__enter__()


def processes_with(mark: str) -> list[Path]:
    """Folders of /proc of those that have this in their environment, as what a marked process starts."""
    found = []
    for name in filter(str.isdigit, os.listdir("/proc")):
        with suppress(OSError):
            found += [Path("/proc", name)] * (mark.encode() in Path("/proc", name, "environ").read_bytes())
    return found


@pytest.mark.slow  # Ray's start
def test_one_process_can_run_two_fleets_one_after_the_other():
    """Ray reads its token once a process: a second one of ours would not be let in."""
    twice = "for _ in range(2): Workers(FleetConfig(workers=1), 1, lambda task: None).__exit__()"
    words = f"from tauext_fleet.workers import Workers; from tauext_fleet.config import FleetConfig\n{twice}"
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


@pytest.mark.slow  # Ray's start
def test_ray_writes_the_bytes_of_this_process_and_leaves_nothing_behind(place, monkeypatch):
    """In an environment of long and strange names, without a home."""
    fleet = write_fleet(place, 'stages = ["train"]\n' + QUICK + arms_of("a", "b", dataset="data"))
    run_here(fleet, place / "here", monkeypatch)
    long = place / ("a long way é " * 8)
    long.mkdir()
    strange = {"TMPDIR": str(long), "HOME": str(place / "no home"), "LC_ALL": "C"}
    command = [sys.executable, "-m", "tauext", "fleet", "run", str(fleet), "--out", str(place / "out"), "--workers=2"]
    done = subprocess.run(command, env=os.environ | strange, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert written(place / "out") == written(place / "here") and not list(long.iterdir())
    end = time.monotonic() + 60
    while left := processes_with(str(long)):
        assert time.monotonic() < end, [(one / "cmdline").read_text() for one in left]
        time.sleep(0.1)


def test_sockets_get_short_names():
    with short_folder() as folder:
        longest = f"{folder}/session_2026-11-28_12-16-20_012389_4194304/sockets/plasma_store"
        assert len(longest) <= 107 and longest.isascii()


class OwnRay:
    """What of Ray is used, in this process: a task of an arm named `lost` is one that Ray gives up."""

    class exceptions:
        class RayError(Exception):
            pass

    def __init__(self) -> None:
        self.claims: dict = {}

    def init(self, **settings) -> None:
        if settings["address"] != "auto":
            raise ConnectionError("nobody\nanswers")

    def remote(self, **claims):
        self.claims = claims
        return lambda function: SimpleNamespace(remote=lambda task: (task["arm"], function, json.dumps(task)))

    def wait(self, asked, num_returns):
        return asked[-1:], asked[:-1]

    def get(self, ready):
        arm, function, task = ready
        if arm == "lost":
            raise self.exceptions.RayError("The node died.\nIts log is far away.")
        return function(json.loads(task))

    def shutdown(self) -> None:
        self.claims = {}


def test_with_ray_its_retries_and_resources_count_and_what_it_gives_up_has_a_reason(tmp_path, data, monkeypatch):
    ray = OwnRay()
    monkeypatch.setitem(sys.modules, "ray", ray)
    work = {"dataset": str(data), "robot": None, "accept": []}
    tasks = {name: Task(name, "check", str(tmp_path / name / "check"), {}, work) for name in ("a", "lost")}
    with Workers(FleetConfig(ray="auto", task_gb=1.5), 2, lambda task: None) as workers:
        assert ray.claims == {"num_cpus": 1, "max_retries": 2, "memory": 1_500_000_000}
        for task in tasks.values():
            workers.submit(task)
        ended = {one.task.arm: one.outcome for one in (workers.wait(), workers.wait())}
    assert ended["a"].state == "done" and finished(tasks["a"]) is not None
    assert ended["lost"] == Outcome("failed", "Ray gave it up: RayError: The node died.")
    assert ray.claims == {}


def test_without_a_cluster_one_line_says_so(place, capsys, monkeypatch):
    fleet = str(write_fleet(place, arms_of("a", dataset="data")))
    monkeypatch.setitem(sys.modules, "ray", OwnRay())
    assert main(["fleet", "run", fleet, "--out", str(place / "out"), "--ray", "10.0.0.1:6379"]) == 2
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert "--ray 10.0.0.1:6379: no cluster there lets us in" in line and "nobody answers" in line
    for options, says in ((("--task-gb", "1"), "--ray"), (("--ray", "auto", "--workers", "2"), "workers = 2")):
        assert main(["fleet", "run", fleet, "--out", str(place / "out"), *options]) == 2
        assert says in capsys.readouterr().err
