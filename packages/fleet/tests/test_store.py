"""Files in an object store: against a small S3 server, which faults are put into on purpose."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest
from made_s3 import Request
from tauext_fleet.config import StoreConfig
from tauext_fleet.locations import local_copy, local_work, located, named_files, text_of, with_urls
from tauext_fleet.store import Stored, StoreError

from tauext.errors import ConfigError


@pytest.mark.parametrize(
    "text", ["s3://arms/a/b.tauext", "gs://arms/a/b.tauext", "abfs://c@x.dfs.core.windows.net/a/b.tauext"]
)
def test_a_url_has_the_parts_of_a_path(text):
    stored = located(text)
    assert isinstance(stored, Stored) and (stored.name, stored.suffix) == ("b.tauext", ".tauext")
    assert str(stored) == text == str(stored.parent / "b.tauext") == str(stored.with_name("b.tauext"))
    assert (stored.parent / "../c//d").key == "c/d"


def test_all_else_is_a_path():
    assert located("x/y", Path("/base")) == Path("/base/x/y") and located("/x") == Path("/x")
    assert str(located("s3://arms/x", Path("/base"))) == "s3://arms/x"


@pytest.mark.parametrize(
    "text, told",
    [
        ("http://host/x", "no such store is known"),
        ("s3://", "it names no bucket"),
        ("s3://arms/x?secret_key=abc", "'secret_key' in its query is unknown"),
        ("s3://key:secret@arms/x", "must hold no key"),
        ("abfs://c:secret@x.dfs.core.windows.net/x", "must hold no key"),
    ],
)
def test_a_wrong_url_is_refused_without_what_may_be_secret(text, told):
    with pytest.raises(ConfigError, match=told) as error:
        located(text)
    assert "abc" not in str(error.value) and "key:secret" not in str(error.value) and "c:secret" not in str(error.value)


def test_a_query_locates_the_server_and_is_in_no_message():
    stored = located("s3://arms/x?endpoint_override=10.0.0.1:9000&scheme=http")
    assert str(stored / "y") == "s3://arms/x/y" and (stored / "y").endpoint == "10.0.0.1:9000"
    assert located(text_of(stored)) == stored


def test_pyarrow_is_loaded_with_the_first_request():
    code = (
        "import sys; from tauext_fleet.store import Stored; Stored.of_url('s3://arms/x') / 'y'; "
        "print('pyarrow' in sys.modules)"
    )
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert printed.stdout.strip() == "False"


# Copies


def test_inputs_of_a_task_are_copied_with_what_they_name(s3, tmp_path):
    mesh = b'<robot><mesh filename="../meshes/link.stl"/><mesh filename="gone.stl"/></robot>'
    for key, content in {
        "robots/urdf/arm.urdf": mesh,
        "robots/meshes/link.stl": b"solid",
        "made/train/arm.tauext": b"bundle",
        "made/train/arm.run.json": b"{}",
        "data/split.json": b"{}",
        "bags/day.csv": b"x",
        "arm.toml": b'[robot]\njoints = ["elbow"]\nmodel = "robots/urdf/arm.urdf"\n[time]\ncolumn = "t"\n'
        b'[signals.q]\ncolumns = "q0"\n[signals.tau]\ncolumns = "i0"\n',
    }.items():
        s3.put(key, content)
    given = {"dataset": "s3://arms/data", "bundle": "s3://arms/made/train/arm.tauext", "robot": None, "like": "/p.json"}
    given |= {"sources": ["s3://arms/bags/day.csv", "/here"], "description": "s3://arms/arm.toml", "name": "arm"}
    work = local_work(given, tmp_path)
    assert (work["name"], work["robot"], work["like"], work["sources"][1]) == ("arm", None, "/p.json", "/here")
    assert (Path(work["dataset"]).name, Path(work["sources"][0]).read_text()) == ("data", "x")
    assert Path(work["bundle"]).with_suffix(".run.json").is_file()
    assert (Path(work["description"]).parent / "robots/meshes/link.stl").read_bytes() == b"solid"
    assert with_urls(f"{work['dataset']}/x: no; {work['bundle']}: no", tmp_path) == (
        "s3://arms/data/x: no; s3://arms/made/train/arm.tauext: no"
    )
    robot = located("s3://arms/robots/urdf/arm.urdf")
    assert [file.name for file in named_files(robot)] == ["arm.urdf", "link.stl"]


def test_a_copy_goes_at_the_end_and_errors_name_the_url(s3):
    s3.put("a/b.toml", b"one")
    with (
        pytest.raises(ConfigError, match="^s3://arms/a/b.toml: no$"),
        local_copy(located("s3://arms/a/b.toml")) as path,
    ):
        assert path.read_bytes() == b"one" and path.name == "b.toml"
        raise ConfigError(f"{path}: no")
    assert not path.exists()


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
    """A stall lasts until the client gives up."""
    if fault == "stall":
        monkeypatch.setenv("TAUEXT_STORE_STALL_S", "1")


@pytest.mark.parametrize("fault", ["503", "cut", "short", "stall"])
def test_what_fails_once_is_tried_again(s3, tmp_path, monkeypatch, fault):
    given_up_soon(monkeypatch, fault)
    s3.put("a.bin", content := os.urandom(100_000))
    s3.fault = failing(fault, times=1)
    located("s3://arms/a.bin").download(tmp_path / "a.bin")
    assert (tmp_path / "a.bin").read_bytes() == content


@pytest.mark.parametrize(
    "fault, told",
    [
        ("503", "is overloaded or failed"),
        ("cut", "the connection was lost"),
        ("short", "the connection was lost"),
        pytest.param("stall", "the store stalls", marks=pytest.mark.slow),
        ("403", "access is denied"),
    ],
)
def test_what_goes_on_failing_ends_in_one_line(s3, tmp_path, monkeypatch, fault, told):
    given_up_soon(monkeypatch, fault)
    s3.put("a.bin", os.urandom(100_000))
    s3.fault = failing(fault)
    with pytest.raises(StoreError, match=f"^s3://arms/a.bin: .*{told}") as error:
        located("s3://arms/a.bin").download(tmp_path / "a.bin")
    assert "\n" not in str(error.value) and "secret-of-the-tester" not in str(error.value)


def test_wrong_keys_and_a_wrong_server_are_reported(s3, monkeypatch):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    with pytest.raises(StoreError, match="cannot be reached"):
        located("s3://arms/x").exists()
    monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://localhost:{s3.port}")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "wrong")
    with pytest.raises(StoreError, match="access is denied"):
        located("s3://arms/x").exists()


def test_a_file_that_is_replaced_while_it_is_read_is_an_error(s3, tmp_path):
    s3.put("a.bin", b"a" * 20_000_000)
    s3.objects["a.bin"].modified_s -= 60

    def replace_it(request: Request) -> None:
        if request.method == "GET":
            s3.put("a.bin", b"b" * 20_000_000)

    s3.fault = replace_it
    with pytest.raises(StoreError, match="it was replaced while it was read"):
        located("s3://arms/a.bin").download(tmp_path / "a.bin")


@pytest.mark.parametrize(
    "fault, size",
    [
        ("503", 100),
        ("cut", 12_000_000),
        pytest.param("cut", 100, marks=pytest.mark.slow),
        pytest.param("503", 12_000_000, marks=pytest.mark.slow),
    ],
)
def test_what_cannot_be_uploaded_is_not_there(s3, tmp_path, size, fault):
    (tmp_path / "file").write_bytes(os.urandom(size))
    stored = located("s3://arms/new/file")
    s3.fault = failing(fault, "PUT")
    with pytest.raises(StoreError, match="^s3://arms/new/file: "):
        stored.upload(tmp_path / "file")
    assert "new/file" not in s3.objects
    s3.fault = failing(fault, "PUT", times=1)
    stored.upload(tmp_path / "file")
    assert len(s3.objects["new/file"].content) == size


def test_a_killed_sender_leaves_nothing_under_the_name(s3, tmp_path):
    code = (
        "import os, sys; from pathlib import Path; from tauext_fleet.store import Stored; "
        "Path(sys.argv[1]).write_bytes(os.urandom(40_000_000)); "
        "Stored.of_url('s3://arms/killed.bin').upload(Path(sys.argv[1]))"
    )
    s3.fault = lambda request: "stall" if request.method == "PUT" else None
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "large")])
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline and not any(request.method == "PUT" for request in list(s3.requests)):
        time.sleep(0.01)
    process.kill()
    process.wait()
    s3.fault = lambda request: None
    assert not located("s3://arms/killed.bin").exists()


def test_limits_of_waiting_are_numbers(monkeypatch):
    monkeypatch.setenv("TAUEXT_STORE_TRIES", "many")
    with pytest.raises(ConfigError, match="TAUEXT_STORE_TRIES must be numbers"):
        StoreConfig.of_environment()
    monkeypatch.setenv("TAUEXT_STORE_TRIES", "0")
    with pytest.raises(ConfigError, match="TAUEXT_STORE_TRIES = 0 must be 1 to 100"):
        StoreConfig.of_environment()
