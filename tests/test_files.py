"""Places in an object store: against a small S3 server, which faults are put into on purpose."""

import json
import os
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
import pytest
from made_arms import PLANAR_MJCF
from made_planar import moving
from made_s3 import Request, upload
from tauext_lab.commands import command_line

from tauext.bundle.bundle_file import load_bundle
from tauext.cli import main
from tauext.data import dataset as stretches_module
from tauext.data import recording_file
from tauext.data.dataset import Split, ahead, load_dataset, save_split, stretches
from tauext.data.recording_file import describe, fingerprint, load_recording, save_recording
from tauext.errors import ConfigError, StoreError
from tauext.files.atomic_write import atomic_files, atomic_folder, atomic_write
from tauext.files.copies import added, local_file, local_folder, local_robot, put, send, staged
from tauext.files.places import place_of
from tauext.train.promised_limits import checkpoint_file

SIGNALS = ("t_ns", "q", "dq", "tau", "q_des", "tau_jts", "temperature", "contact")


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


# Places


@pytest.mark.parametrize(
    "text", ["s3://arms/a/b.tauext", "gs://arms/a/b.tauext", "abfs://c@x.dfs.core.windows.net/a/b.tauext"]
)
def test_a_stored_place_is_asked_as_a_path_is(text):
    place, path = place_of(text), PurePosixPath("/a/b.tauext")
    assert (place.name, place.stem, place.suffix) == (path.name, path.stem, path.suffix)
    assert str(place) == text and str(place.parent / "b.tauext") == text
    assert place.with_suffix(".run.json").name == path.with_suffix(".run.json").name
    assert (place.parent / "../c//d").key == "c/d"
    assert place.relative_to(place.parent).as_posix() == "b.tauext"


def test_all_else_is_a_path():
    assert place_of("runs/data") == Path("runs/data")
    assert place_of("file:///runs/a%20b") == Path("/runs/a b")
    assert place_of("x/y", Path("/base")) == Path("/base/x/y")
    assert str(place_of("x/y", place_of("s3://arms/base"))) == "s3://arms/base/x/y"
    assert str(place_of("s3://arms/x", Path("/base"))) == "s3://arms/x"


@pytest.mark.parametrize(
    "text, told",
    [
        ("http://host/x", "no such store is known"),
        ("s3://", "it names no bucket"),
        ("file://host/x", "begins with file:///"),
        ("s3://arms/x?secret_key=abc", "'secret_key' in its query is unknown"),
        ("s3://key:secret@arms/x", "must hold no key"),
        ("abfs://c:secret@x.dfs.core.windows.net/x", "must hold no key"),
    ],
)
def test_a_url_that_is_none_is_refused_without_what_may_be_secret(text, told):
    with pytest.raises(ConfigError, match=told) as error:
        place_of(text)
    assert "abc" not in str(error.value) and "key:secret" not in str(error.value) and "c:secret" not in str(error.value)


def test_a_query_says_where_the_store_is_and_stands_in_no_message(monkeypatch):
    place = place_of("s3://arms/x?endpoint_override=10.0.0.1:9000&scheme=http")
    assert str(place / "y") == "s3://arms/x/y" and (place / "y").server.endpoint == ("10.0.0.1:9000", "http")
    assert place_of(place.url) == place
    monkeypatch.setattr(sys, "argv", ["tauext", "train", "--data=s3://arms/x?region=eu", "s3://arms/y?region=eu"])
    assert command_line() == "tauext train --data=s3://arms/x s3://arms/y"


def test_nothing_of_pyarrow_is_loaded_before_a_store_is_asked():
    code = (
        "import sys; from tauext.files.places import place_of; place_of('s3://arms/x') / 'y'; "
        "print('pyarrow' in sys.modules)"
    )
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.strip() == "False"


# Commands


def run(*words: object) -> int:
    return main([str(word) for word in words])


@pytest.mark.slow
def test_every_command_makes_the_same_of_a_store_as_of_a_disk(s3, folder, tmp_path, capsys, undrawn):
    upload(s3, folder)
    there, here = place_of("s3://arms"), tmp_path
    for base, data in ((here, folder), (there, "s3://arms/data")):
        assert run("train", "--data", data, "--out", base / "arm.tauext", "--recipe", "friction", "--threads", 1) == 0
        again = ("calibrate", "--bundle", base / "arm.tauext", "--data", data, "--in-hours", 1, "--threads", 1)
        assert run(*again, "--out", base / "again" / "arm.tauext") == 0
        assert run("check", "--data", data, "--out", base / "check") == 0
        assert run("show", base / "arm.tauext") == 0
    for name in ("arm.tauext", "arm.run.json", "again/arm.tauext", "check/check.json"):
        assert s3.objects[name].content == (here / name).read_bytes(), name
    out = capsys.readouterr().out
    assert "s3://arms/again/arm.tauext" in out and "staged" not in out
    assert not list((tmp_path / "cache" / "tauext" / "staged").rglob("*.part"))


def test_a_bundle_comes_after_what_stands_beside_it(s3, folder):
    upload(s3, folder)
    assert run("train", "--data", "s3://arms/data", "--out", "s3://arms/arm.tauext", "--recipe", "friction") == 0
    sent = [request.key for request in s3.requests if request.method == "PUT"]
    assert sent == ["arm.run.json", "arm.wall_time_s.json", "arm.tauext"]


def test_flights_and_results_and_pages_go_to_a_store(s3, folder, tmp_path, capsys, undrawn):
    recording = load_recording(folder / "free-4.parquet")
    push = np.where((recording.time_s > 20) & (recording.time_s < 21), 30.0, 0.0)[:, None]
    touched = replace(recording, tau=recording.tau - push, contact=(push[:, 0] > 0).astype(np.int8))
    save_recording(replace(touched, name="push"), tmp_path / "push.parquet")
    upload(s3, folder)
    s3.put("data/push.parquet", (tmp_path / "push.parquet").read_bytes())
    s3.put(
        "data/split.json",
        (folder / "split.json").read_bytes().replace(b'"collisions": []', b'"collisions": ["push.parquet"]'),
    )
    assert run("train", "--data", folder, "--out", tmp_path / "arm.tauext", "--recipe", "friction") == 0
    bundle = tmp_path / "arm.tauext"
    for _ in range(2):  # names that are there are not taken again
        assert run("run", bundle, "s3://arms/data/push.parquet", "--flights", "s3://arms/flights", "--json") == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines() if line.startswith("{")]
    told = [line["file"].removeprefix("s3://arms/") for line in lines if line["event"] == "flight"]
    assert len(told) >= 2 and len(set(told)) == len(told) and set(told) <= set(s3.objects)
    assert run("evaluate", "--data", "s3://arms/data", "--bundles", bundle, "--out", "s3://arms/results") == 0
    assert run("report", "--flight", f"s3://arms/{told[0]}", "--out", "s3://arms/page", "--page-mb", 0) == 0
    sent = [request.key for request in s3.requests if request.method == "PUT" and request.key.startswith("results/")]
    assert sent[-1] == "results/results.json" and "results/estimates/arm/push.parquet" in sent
    assert any(key.startswith("page/") and key.endswith(".html") for key in s3.objects)


def test_a_dataset_is_simulated_and_imported_into_a_store(s3, tmp_path, capsys):
    assert run("simulate", "--out", "s3://arms/rig", "--minutes", 1, "--collision-recordings", 0) == 0
    assert load_dataset("s3://arms/rig").split.train and s3.objects["rig/robot.xml"]
    rows = [f"{k * 0.01:.2f},{0.1 * np.sin(0.05 * k):.6f},{np.cos(0.05 * k):.6f}" for k in range(3000)]
    s3.put("logs/day.csv", "\n".join(["time,q0,i0", *rows]).encode())
    arm = '[robot]\njoints = ["elbow"]\n[time]\ncolumn = "time"\n'
    arm += '[signals.q]\ncolumns = "q0"\n[signals.tau]\ncolumns = "i0"\n'
    s3.put("logs/arm.toml", arm.encode())
    out = ("--arm", "s3://arms/logs/arm.toml", "--out", "s3://arms/imported")
    assert run("import", "--source", "s3://arms/logs/day.csv", *out) == 0, capsys.readouterr().err
    assert load_dataset("s3://arms/imported").split.train
    assert run("import", "--source", "s3://arms/logs/day.csv", *out) == 2
    assert "s3://arms/imported: is not empty" in capsys.readouterr().err


def test_a_robot_file_comes_with_what_it_names(s3):
    s3.put("robots/urdf/arm.urdf", b'<robot><mesh filename="../meshes/link.stl"/><mesh filename="gone.stl"/></robot>')
    s3.put("robots/meshes/link.stl", b"solid")
    copy = local_robot(place_of("s3://arms/robots/urdf/arm.urdf"))
    assert (copy.parent / "../meshes/link.stl").read_bytes() == b"solid"


def test_a_live_loop_writes_to_no_store(capsys):
    assert run("monitor", "arm.tauext", "--source", "replay:x.parquet", "--record", "s3://arms/live") == 2
    assert "a live loop waits for no store" in capsys.readouterr().err


# Recordings


def test_a_stored_recording_is_read_by_the_columns_that_are_asked_for(s3, folder):
    upload(s3, folder)
    place = place_of("s3://arms/data/free-0.parquet")
    size = len(s3.objects["data/free-0.parquet"].content)
    before = s3.bytes_sent
    recording = load_recording(place, ("temperature", "contact"))
    few = s3.bytes_sent - before
    assert few < 0.8 * size  # q_des, tau_jts and tau_ext are half of its columns, the last of them zeros
    whole = load_recording(folder / "free-0.parquet")
    for signal in ("t_ns", "q", "dq", "tau"):
        np.testing.assert_array_equal(getattr(recording, signal), getattr(whole, signal))
    assert recording.q_des is None and recording.tau_jts is None and whole.q_des is not None
    assert describe(place) == describe(folder / "free-0.parquet")
    assert fingerprint(place) == fingerprint(folder / "free-0.parquet")


def test_a_long_recording_comes_in_stretches_of_which_each_reads_its_own(s3, folder, monkeypatch):
    monkeypatch.setattr(recording_file, "ROW_GROUP", 1000)
    monkeypatch.setattr(stretches_module, "ROW_GROUP", 1000)
    whole = load_recording(folder / "free-0.parquet")
    long = folder.with_name("long.parquet")
    save_recording(replace(whole, name="long"), long)
    s3.put("long.parquet", long.read_bytes())
    for place in (long, place_of("s3://arms/long.parquet"), folder / "free-0.parquet"):  # the last has one row group
        parts = [load() for load in stretches([place], None)]
        assert len(parts) == -(-whole.samples // 1000) and {part.name[-3:] for part in parts} >= {"-00", "-01"}
        for signal in ("t_ns", "q", "dq", "tau", "q_des", "tau_jts"):
            np.testing.assert_array_equal(
                np.concatenate([getattr(part, signal) for part in parts]), getattr(whole, signal)
            )
        assert parts[1].provenance["part"]["from_s"] == pytest.approx(parts[1].t_ns[0] * 1e-9 - whole.t_ns[0] * 1e-9)
    before = s3.bytes_sent
    stretches([place_of("s3://arms/long.parquet")])[0]()
    assert s3.bytes_sent - before < 0.5 * long.stat().st_size


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


def test_limits_of_long_recordings_are_the_same_from_a_store(s3, folder, tmp_path, monkeypatch):
    monkeypatch.setattr(stretches_module, "ROW_GROUP", 3000)
    upload(s3, folder)
    assert run("train", "--data", folder, "--out", tmp_path / "a" / "arm.tauext", "--recipe", "friction") == 0
    for data, out in ((folder, "here"), ("s3://arms/data", "there")):
        command = ("calibrate", "--bundle", tmp_path / "a" / "arm.tauext", "--data", data, "--threads", 2)
        assert run(*command, "--out", tmp_path / out / "arm.tauext") == 0
    assert (tmp_path / "here/arm.tauext").read_bytes() == (tmp_path / "there/arm.tauext").read_bytes()
    names = json.loads(load_bundle(tmp_path / "here/arm.tauext").provenance)["limits"]["recordings"]
    assert names[:3] == ["free-2-00", "free-2-01", "free-2-02"] and len(names) == 9


# Faults


def failing(fault: str, method: str = "GET", times: int = 10**9):
    """The first so many requests of this method."""
    left = [times]

    def put_in(request: Request) -> str | None:
        if request.method != method or left[0] <= 0:
            return None
        left[0] -= 1
        return fault

    return put_in


def given_up_soon(monkeypatch, fault: str) -> None:
    """A stall is waited for in earnest."""
    if fault == "stall":
        monkeypatch.setenv("TAUEXT_STORE_STALL_S", "1")


@pytest.mark.parametrize("fault", ["503", "cut", "short", "stall"])
def test_what_fails_once_is_tried_again(s3, folder, monkeypatch, fault):
    given_up_soon(monkeypatch, fault)
    upload(s3, folder)
    s3.fault = failing(fault, times=1)
    recording = load_recording("s3://arms/data/free-0.parquet")
    np.testing.assert_array_equal(recording.tau, load_recording(folder / "free-0.parquet").tau)


@pytest.mark.parametrize(
    "fault, told",
    [
        ("503", "is overloaded or failed, tried 2 times"),
        ("cut", "the connection to 127.0.0.1:.* was lost, tried 2 times"),
        ("short", "the connection to 127.0.0.1:.* was lost, tried 2 times"),
        pytest.param("stall", "stalled, tried 2 times: nothing came for 1 s", marks=pytest.mark.slow),
        ("403", "access is denied"),
    ],
)
def test_what_goes_on_failing_ends_in_one_line(s3, folder, tmp_path, capsys, monkeypatch, fault, told):
    given_up_soon(monkeypatch, fault)
    upload(s3, folder)
    s3.fault = failing(fault)
    with pytest.raises(StoreError, match=f"^s3://arms/data/free-0.parquet: .*{told}"):
        load_recording("s3://arms/data/free-0.parquet")
    assert run("show", "s3://arms/data/free-0.parquet") == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and "secret-of-the-tester" not in line


def test_what_is_not_there_is_said(s3, capsys, monkeypatch):
    s3.put("x", b"x")
    for words, told in (
        (("show", "s3://none/arm.tauext"), "there is no bucket 'none' at 127.0.0.1"),
        (("show", "s3://arms/arm.tauext"), "there is no such file"),
        (
            ("calibrate", "--bundle", "s3://arms/a.tauext", "--data", "s3://arms/d", "--out", "o.tauext"),
            "no such dataset",
        ),
        (("check", "--data", "s3://arms/d.parquet"), "there is no such recording"),
    ):
        assert run(*words) == 2
        assert told in capsys.readouterr().err
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "wrong")
    assert run("show", "s3://arms/x.tauext") == 2 and "access is denied" in capsys.readouterr().err
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    assert run("show", "s3://arms/x.tauext") == 2 and "cannot be reached" in capsys.readouterr().err


def test_a_recording_that_is_replaced_while_it_is_read_is_an_error(s3, folder):
    upload(s3, folder)
    other = s3.objects["data/free-1.parquet"].content

    def replace_it(request: Request) -> None:
        if request.method == "GET" and request.key == "data/free-0.parquet" and request.number == 2:
            s3.put("data/free-0.parquet", other)

    s3.fault = replace_it
    with pytest.raises((StoreError, recording_file.RecordingError), match="s3://arms/data/free-0.parquet"):
        load_recording("s3://arms/data/free-0.parquet")


def test_the_same_size_and_layout_does_not_hide_a_replacement(s3):
    s3.put("a.bin", b"a" * 20_000_000)

    def replace_it(request: Request) -> None:
        if request.method == "GET":
            s3.put("a.bin", b"b" * 20_000_000)

    s3.fault = replace_it
    with pytest.raises(StoreError, match="it was replaced while it was read"):
        local_file(place_of("s3://arms/a.bin"))


def test_a_copy_is_fetched_once_and_again_when_it_changed(s3):
    place = place_of("s3://arms/a/b.toml")
    s3.put("a/b.toml", b"one")
    assert local_file(place).read_bytes() == b"one" and local_file(place).name == "b.toml"
    assert s3.count("GET", "a/b.toml") == 1
    s3.put("a/b.toml", b"two")
    assert local_file(place).read_bytes() == b"two"
    assert sorted(path.name for path in local_folder(place.parent).iterdir()) == ["b.toml"]


@pytest.mark.parametrize(
    "fault, size",
    [
        ("503", 100),
        ("cut", 12_000_000),
        pytest.param("cut", 100, marks=pytest.mark.slow),
        pytest.param("503", 12_000_000, marks=pytest.mark.slow),
    ],
)
def test_what_cannot_be_sent_is_not_there(s3, tmp_path, size, fault):
    path = tmp_path / "file"
    path.write_bytes(os.urandom(size))
    place = place_of("s3://arms/new/file")
    s3.fault = failing(fault, "PUT")
    with pytest.raises(StoreError, match="^s3://arms/new/file: "):
        send(path, place)
    assert "new/file" not in s3.objects
    s3.fault = failing(fault, "PUT", times=1)
    put(path, place)
    assert len(s3.objects["new/file"].content) == size and not path.exists()


def test_what_fails_while_it_is_written_leaves_the_old_one(s3):
    s3.put("a.json", b"old")
    one, two = place_of("s3://arms/a.json"), place_of("s3://arms/b.json")
    with pytest.raises(ZeroDivisionError), atomic_write(one) as part:
        part.write_text("new")
        raise ZeroDivisionError
    assert s3.objects["a.json"].content == b"old" and not part.exists()
    with atomic_files(one, two) as parts:
        for part in parts:
            part.write_text("new")
    assert s3.objects["a.json"].content == s3.objects["b.json"].content == b"new"


def test_a_staged_folder_is_kept_where_work_fails_and_sent_with_what_says_that_it_is_whole_at_last(s3):
    place = place_of("s3://arms/results")
    with pytest.raises(ConfigError, match="^s3://arms/results/x: no"), staged(place) as folder:
        folder.mkdir(parents=True)
        (folder / "results.json").write_text("{}")
        raise ConfigError(f"{folder}/x: no")
    assert not s3.objects
    with staged(place) as folder:
        (folder / "estimates").mkdir()
        for name in ("run.json", "z.parquet", "estimates/a.parquet"):
            (folder / name).write_text("x")
    sent = [request.key for request in s3.requests if request.method == "PUT"]
    assert sent == [f"results/{n}" for n in ("estimates/a.parquet", "z.parquet", "run.json", "results.json")]
    assert not folder.exists()
    with pytest.raises(KeyboardInterrupt), added(place) as folder:
        assert (folder / "z.parquet").exists()
        (folder / "flight").write_text("x")
        raise KeyboardInterrupt
    assert s3.objects["results/flight"].content == b"x" and s3.objects["results/z.parquet"].content == b"x"


def test_a_folder_of_findings_is_known_to_be_whole_by_its_last_file(s3, tmp_path, monkeypatch):
    for place in (place_of("s3://arms/check"), tmp_path / "check"):
        with atomic_folder(place) as part:
            for name in ("check.json", "check.txt", "torque.png"):
                (part / name).write_text("x")
    assert [r.key for r in s3.requests if r.method == "PUT"][-1] == "check/check.json"
    assert sorted(path.name for path in (tmp_path / "check").iterdir()) == ["check.json", "check.txt", "torque.png"]
    monkeypatch.chdir(tmp_path)
    with atomic_folder(Path()) as part:
        (part / "here.txt").write_text("x")
    assert (tmp_path / "here.txt").exists() and not (tmp_path / ".part").exists()


def test_checkpoint_work_on_a_url_is_kept_here_and_told_apart_by_server(s3, tmp_path, monkeypatch):
    place = place_of("s3://arms/new/arm.tauext")
    kept = checkpoint_file(place)
    assert kept.is_relative_to(tmp_path / "cache") and kept == checkpoint_file(place_of(place.url))
    assert kept != checkpoint_file(place_of("s3://arms/old/arm.tauext"))
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://10.0.0.1:9000")
    assert kept != checkpoint_file(place)


def test_limits_of_waiting_are_numbers(s3, monkeypatch, capsys):
    monkeypatch.setenv("TAUEXT_STORE_TRIES", "many")
    assert run("show", "s3://arms/x.tauext") == 2
    assert "TAUEXT_STORE_TRIES must be numbers" in capsys.readouterr().err
    monkeypatch.setenv("TAUEXT_STORE_TRIES", "0")
    assert run("show", "s3://arms/x.tauext") == 2
    assert "TAUEXT_STORE_TRIES = 0 must be 1 to 100" in capsys.readouterr().err
