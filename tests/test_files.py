"""Recordings and datasets as files: what is read of them, stretches, folders that appear whole; URLs are refused."""

import json
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_arms import PLANAR_MJCF
from made_planar import moving

from tauext.bundle.bundle_file import load_bundle
from tauext.cli import main
from tauext.data import dataset as stretches_module
from tauext.data import recording_file
from tauext.data.dataset import Split, ahead, save_split, stretches
from tauext.data.recording_file import load_recording, save_recording
from tauext.files.atomic_write import atomic_folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A dataset on disk with two training recordings and three for limits."""
    folder = tmp_path_factory.mktemp("plant") / "data"
    folder.mkdir()
    (folder / "robot.xml").write_text(PLANAR_MJCF)
    names = [f"free-{k}" for k in range(5)]
    for seed, name in enumerate(names):
        recording = moving(seed, 60.0, (1.0, 1.0), name)
        more = {"q_des": recording.q + 1e-3, "tau_jts": recording.tau * 0.9, "tau_ext": np.zeros_like(recording.tau)}
        save_recording(replace(recording, **more), folder / f"{name}.parquet")
    files = tuple(f"{name}.parquet" for name in names)
    save_split(Split(files[:2], (), (), (), files[2:]), folder)
    return folder


def run(*words: object) -> int:
    return main([str(word) for word in words])


def test_a_recording_is_read_by_the_signals_that_are_requested(folder):
    path = folder / "free-0.parquet"
    few, whole = load_recording(path, ("temperature", "contact")), load_recording(path)
    for signal in ("t_ns", "q", "dq", "tau"):
        np.testing.assert_array_equal(getattr(few, signal), getattr(whole, signal))
    assert few.q_des is None and few.tau_jts is None and whole.q_des is not None


def test_a_long_recording_comes_in_stretches(folder, monkeypatch):
    monkeypatch.setattr(recording_file, "ROW_GROUP", 1000)
    monkeypatch.setattr(stretches_module, "ROW_GROUP", 1000)
    whole = load_recording(folder / "free-0.parquet")
    long = folder.with_name("long.parquet")
    save_recording(replace(whole, name="long"), long)
    for path in (long, folder / "free-0.parquet"):  # the last has one row group
        parts = [load() for load in stretches([path], None)]
        assert len(parts) == -(-whole.samples // 1000) and {part.name[-3:] for part in parts} >= {"-00", "-01"}
        for signal in ("t_ns", "q", "dq", "tau", "q_des", "tau_jts"):
            np.testing.assert_array_equal(
                np.concatenate([getattr(part, signal) for part in parts]), getattr(whole, signal)
            )
        assert parts[1].provenance["part"]["from_s"] == pytest.approx(parts[1].t_ns[0] * 1e-9 - whole.t_ns[0] * 1e-9)


def test_one_recording_is_read_ahead_and_no_more(folder):
    loaded, one = [], load_recording(folder / "free-0.parquet")
    lock = threading.Lock()

    def load_one(k: int):
        def load():
            with lock:
                loaded.append(k)
            return replace(one, name=str(k))

        return load

    for k, recording in enumerate(ahead([load_one(k) for k in range(5)])):
        assert recording.name == str(k)
        deadline = time.monotonic() + 10
        while len(loaded) < min(5, k + 2) and time.monotonic() < deadline:
            time.sleep(1e-3)
        assert loaded == list(range(min(5, k + 2)))


def test_limits_of_long_recordings_come_from_their_stretches(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(stretches_module, "ROW_GROUP", 3000)
    assert run("train", "--data", folder, "--out", tmp_path / "a" / "arm.tauext", "--recipe", "friction") == 0
    command = ("calibrate", "--bundle", tmp_path / "a" / "arm.tauext", "--data", folder, "--threads", 2)
    assert run(*command, "--out", tmp_path / "again.tauext") == 0
    names = json.loads(load_bundle(tmp_path / "again.tauext").provenance)["limits"]["recordings"]
    assert names[:3] == ["free-2-00", "free-2-01", "free-2-02"] and len(names) == 9


def test_a_folder_of_findings_is_known_to_be_whole_by_its_last_file(tmp_path, monkeypatch):
    moved, replace_file = [], Path.replace
    monkeypatch.setattr(Path, "replace", lambda path, to: (moved.append(path.name), replace_file(path, to)))
    with atomic_folder(tmp_path / "check") as part:
        for name in ("check.json", "check.txt", "torque.png"):
            (part / name).write_text("x")
    assert moved == ["check.txt", "torque.png", "check.json"]
    assert sorted(path.name for path in (tmp_path / "check").iterdir()) == ["check.json", "check.txt", "torque.png"]
    monkeypatch.chdir(tmp_path)
    with atomic_folder(Path()) as part:
        (part / "here.txt").write_text("x")
    assert (tmp_path / "here.txt").exists() and not (tmp_path / ".part").exists()


@pytest.mark.parametrize(
    "words",
    [
        ("show", "s3://key:secret@arms/arm.tauext"),
        ("run", "arm.tauext", "gs://secret/push.parquet"),
        ("train", "--data", "data", "--out", "abfs://c:secret@x.dfs.core.windows.net/arm.tauext"),
        ("monitor", "arm.tauext", "--source", "replay:x.parquet", "--record", "file:///secret"),
    ],
)
def test_a_url_is_refused_in_one_line_without_what_may_be_secret(words, capsys):
    assert run(*words) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and "is a URL, and paths are local; copy the files first" in line
    assert "secret" not in line
