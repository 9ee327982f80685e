"""A fleet whose files and folders are in an object store."""

from pathlib import Path

import pytest
from made_fleets import workers_here
from made_planar import dataset, moving
from made_s3 import upload
from tauext_fleet.locations import fits, locations_of
from tauext_fleet.stages import STAGES

from tauext.cli import main


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A dataset on disk with training recordings alone."""
    folder = tmp_path_factory.mktemp("plant") / "data"
    return dataset(folder, *(moving(seed, 60.0, (1.0, 1.0), f"free-{seed}") for seed in range(2)))


def run(*words: object) -> int:
    return main([str(word) for word in words])


@pytest.mark.slow
def test_a_fleet_reads_from_a_store_and_sees_what_changed(s3, folder, tmp_path, capsys):
    upload(s3, folder)
    (tmp_path / "fleet.toml").write_text(
        'stages = ["train"]\ntrain.recipe = "friction"\n[[arms]]\nname = "one"\ndataset = "s3://arms/data"\n'
    )
    command = ("fleet", "run", tmp_path / "fleet.toml", "--out", tmp_path / "out", "--workers", 1)
    assert run(*command) == 0 and "1 tasks were done now" in capsys.readouterr().out
    alone = tmp_path / "one.tauext"
    assert run("train", "--data", folder, "--out", alone, "--recipe", "friction", "--threads", 1) == 0
    assert (tmp_path / "out/arms/one/train/one.tauext").read_bytes() == alone.read_bytes()
    assert not list((tmp_path / "cache/tauext/fleets").glob("*/*"))
    assert run(*command) == 0 and "0 tasks were done now" in capsys.readouterr().out
    s3.put("data/free-0.parquet", s3.objects["data/free-1.parquet"].content)
    assert run(*command, "--dry-run") == 0
    assert "inputs changed: dataset free-0.parquet" in capsys.readouterr().out


@pytest.mark.slow
def test_a_fleet_writes_to_a_store_what_it_writes_to_a_disk(s3, folder, tmp_path, capsys, monkeypatch, undrawn):
    """By workers in this process: test_a_fleet_reads_from_a_store has others."""
    workers_here(monkeypatch, STAGES)
    (tmp_path / "fleet.toml").write_text(
        f'stages = ["check", "train"]\ntrain.recipe = "friction"\n[[arms]]\nname = "one"\ndataset = "{folder}"\n'
    )
    command = ("fleet", "run", tmp_path / "fleet.toml", "--workers", 1, "--out")
    s3.put("fleet/arms/one/train/stale.txt", b"of other inputs")
    s3.put("fleet/arms/one/train/task.json", b'{"format": 1}')
    assert run(*command, tmp_path / "out") == run(*command, "s3://arms/fleet") == 0
    capsys.readouterr()
    written = {
        path.relative_to(tmp_path / "out").as_posix(): path.read_bytes() for path in (tmp_path / "out").rglob("*.*")
    }
    same = [name for name in written if name.startswith("arms/") and not name.endswith("wall_time_s.json")]
    assert len(same) >= 6
    for name in same:
        assert s3.objects[f"fleet/{name}"].content == written[name], name
    assert "fleet/arms/one/train/stale.txt" not in s3.objects and "fleet/fleet.json" in s3.objects
    sent = [
        r.key
        for r in s3.requests
        if r.method == "PUT" and r.key.startswith("fleet/arms/one/train/") and r.key[-1] != "/"
    ]
    assert sent[-1] == "fleet/arms/one/train/task.json" and sent.count(sent[-1]) == 1
    assert run(*command, "s3://arms/fleet") == 0 and "0 tasks were done now" in capsys.readouterr().out
    del s3.objects["fleet/arms/one/train/one.tauext"]
    assert run(*command, "s3://arms/fleet", "--dry-run") == 0 and "one train" in capsys.readouterr().out
    s3.fault = lambda request: "503" if request.method == "PUT" and request.key.endswith("one.tauext") else None
    assert run(*command, "s3://arms/fleet") == 1 and "is overloaded or failed" in capsys.readouterr().out
    assert "fleet/arms/one/train/task.json" not in s3.objects and s3.objects["fleet/arms/one/train.failed.txt"].content


def test_patterns_of_sources_fit_in_a_store(s3):
    for key in ("bags/a/1.mcap", "bags/a/2.mcap", "bags/b/deep/3.mcap", "bags/b/x.txt"):
        s3.put(key, b"x")
    found = [str(one) for one in locations_of("s3://arms/bags/*/*.mcap", Path("/"))]
    assert found == ["s3://arms/bags/a/1.mcap", "s3://arms/bags/a/2.mcap"]
    assert len(locations_of("s3://arms/bags/**/*.mcap", Path("/"))) == 3
    assert [one.name for one in locations_of("s3://arms/bags/*", Path("/"))] == ["a", "b"]
    assert fits(("a", "b", "c"), ("**", "c")) and not fits(("a", "b"), ("a",))
