"""Work goes on where a killed process left it, and a file from elsewhere does nothing."""

from __future__ import annotations

import json
import os
import pickle
import signal
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from made_bundles import pushed, watching_bundle
from tauext_lab.evaluate import comparison
from tauext_lab.evaluate.results_folder import evaluate_bundles

from tauext.config import AlarmConfig
from tauext.data.dataset import Split, load_dataset, save_split
from tauext.data.recording_file import save_recording
from tauext.files import checkpoint
from tauext.files.checkpoint import Checkpoint
from tauext.train import error_scale
from tauext.train.calibrate import recalibrate


@pytest.fixture
def at_once(monkeypatch):
    """Everything that is offered is written."""
    monkeypatch.setattr(checkpoint, "EVERY_S", 0.0)


@pytest.fixture
def place(tmp_path):
    """A dataset of six recordings, and two bundles."""
    names = [f"made-{k}" for k in range(6)]
    for k, name in enumerate(names):
        save_recording(pushed(name, pushes=((2.0, k % 2, 4.0 + k),)), tmp_path / f"{name}.parquet")
    files = [f"{name}.parquet" for name in names]
    save_split(Split(files[:1], files[1:2], files[2:4], files[4:]), tmp_path)
    bundle = watching_bundle()
    for name in ("one", "two"):
        bundle.save(str(tmp_path / f"{name}.tauext"))
    return tmp_path


def evaluated(place: Path, out: str) -> dict:
    bundles = {name: place / f"{name}.tauext" for name in ("one", "two")}
    evaluate_bundles(load_dataset(place), bundles, place / out, threads=1, sanity=True)
    return json.loads((place / out / "results.json").read_text())


def killed(module, name: str, at: int, work: Callable[[], object]) -> None:
    """Work in a process of its own that ends by SIGKILL, at this call of a module's function."""
    pid = os.fork()
    if pid == 0:
        called, calls = getattr(module, name), []

        def counted(*arguments):
            calls.append(1)
            if len(calls) == at:
                os.kill(os.getpid(), signal.SIGKILL)
            return called(*arguments)

        setattr(module, name, counted)
        work()
        os._exit(0)  # not reached
    assert os.WTERMSIG(os.waitpid(pid, 0)[1]) == signal.SIGKILL


def killed_while_evaluating(place: Path, out: str) -> None:
    """While the third recording is judged, of two bundles."""
    killed(comparison, "estimate_recording", 5, lambda: evaluated(place, out))


def test_a_killed_evaluation_goes_on_to_the_same_results(place, at_once, monkeypatch):
    whole = evaluated(place, "whole")
    assert not (place / "whole" / "evaluate.half-done").exists()
    killed_while_evaluating(place, "killed")
    assert (place / "killed" / "evaluate.half-done").exists() and not (place / "killed" / "results.json").exists()
    judged, again = comparison.estimate_recording, []
    monkeypatch.setattr(comparison, "estimate_recording", lambda *a: (again.append(a[1].name), judged(*a))[1])
    assert evaluated(place, "killed") == whole
    assert again == ["made-4", "made-4", "made-5", "made-5"]  # the two before are not judged again
    assert not (place / "killed" / "evaluate.half-done").exists()
    for file in (place / "whole" / "estimates").rglob("*.parquet"):
        assert file.read_bytes() == (place / "killed" / file.relative_to(place / "whole")).read_bytes()


def test_a_state_of_other_work_counts_as_none(place, at_once):
    killed_while_evaluating(place, "out")
    save_recording(pushed("made-3", pushes=((2.0, 1, 9.0),)), place / "made-3.parquet")
    assert evaluated(place, "out") == evaluated(place, "whole")


def test_what_is_damaged_or_asks_for_other_classes_is_no_state(tmp_path, at_once):
    path = tmp_path / "state"
    work = Checkpoint(path, "key")
    assert work.load(dict) is None
    work.offer({"rows": np.arange(4.0), "names": ["a"]})
    np.testing.assert_array_equal(work.load(dict)["rows"], np.arange(4.0))
    assert Checkpoint(path, "other").load(dict) is None
    whole = path.read_bytes()
    for end in range(0, len(whole), 7):
        path.write_bytes(whole[:end])
        assert work.load(dict) is None

    class Harm:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "harm"),)

    strings = [("key", "strings"), ("key", ["a"]), ("key", {"rows": 1}), "ab", ["key"]]
    path.write_bytes(pickle.dumps(("key", (["a"], ["b"]))))
    assert work.load(tuple[list[str], list[str]]) == (["a"], ["b"])
    for content in map(pickle.dumps, [*strings, ("key", (["a"], ["b"]))]):
        path.write_bytes(content)
        assert work.load(tuple[list[np.ndarray], list[str]]) is None
        assert work.load(tuple[np.ndarray, int]) is None
    for content in (pickle.dumps(("key", Harm())), pickle.dumps(("key", Path("x"))), pickle.dumps("key")):
        path.write_bytes(content)
        assert work.load(dict) is None
    assert not (tmp_path / "harm").exists()


def test_a_killed_calibration_goes_on_to_the_same_limits(place, at_once, monkeypatch):
    files = sorted(path.name for path in place.glob("made-*.parquet"))
    for k, name in enumerate(files):
        noise = np.random.default_rng(k).normal(0, 9, (30_000, 2))
        save_recording(pushed(Path(name).stem, seconds=30.0, pushes=(), tau=noise), place / name)
    save_split(Split((), (), (), (), calibration=tuple(files)), place)
    alarm = AlarmConfig(false_alarms=1.0, in_hours=0.001, holds_s=(0.0, 0.005))

    def calibrated(out: str) -> bytes:
        new = place / out / "new.tauext"
        recalibrate(place / "one.tauext", load_dataset(place), new, alarm, threads=1, accept=["limit-wide"])
        return new.read_bytes()

    killed(error_scale, "judge", 5, lambda: calibrated("killed"))
    kept = place / "killed" / "new.limits.half-done"
    assert kept.exists()
    judged, again = error_scale.judge, []
    monkeypatch.setattr(error_scale, "judge", lambda *a: (again.append(1), judged(*a))[1])
    resumed = calibrated("killed")
    assert 0 < len(again) < len(files) and not kept.exists()
    monkeypatch.undo()
    assert resumed == calibrated("whole")
