"""LeRobot datasets as others write them: the frames come out as they were written, or one clear message does."""

from __future__ import annotations

import json
import re
from pathlib import Path

import lerobot_arm as arms
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from tauext_lerobot.lerobot_folder import IMPORTER

from tauext.cli import main
from tauext.data.importers.open_raw import open_raw
from tauext.data.recording import Recording
from tauext.errors import RecordingError

FRAMES, COUNT = 40, 4
RNG = np.random.default_rng(0)
EPISODES = [
    tuple(RNG.normal(size=(FRAMES, len(arms.MOTORS))).astype(np.float32) for _ in range(2)) for _ in range(COUNT)
]


def dataset(folder: Path, version: str = "v3.0") -> Path:
    return arms.write_dataset(folder, EPISODES, version)


def change_info(folder: Path, **entries):
    path = folder / "meta/info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | entries))


def change_feature(folder: Path, name: str, **entries):
    features = json.loads((folder / "meta/info.json").read_text())["features"]
    features[name] = features.get(name, {}) | entries
    change_info(folder, features=features)


def name_states(folder: Path, names: dict):
    change_feature(folder, "observation.state", names=names)


def change_frames(folder: Path, change):
    for path in sorted((folder / "data").glob("chunk-*/*.parquet")):
        pq.write_table(change(pq.read_table(path)), path)


def put(name: str, make):
    """A change that replaces a column, or adds one."""

    def change(table: pa.Table) -> pa.Table:
        at, values = table.schema.get_field_index(name), make(table)
        return table.append_column(name, values) if at < 0 else table.set_column(at, name, values)

    return change


def nested(table: pa.Table) -> pa.Array:
    return pa.array([[row] for row in table.column("observation.state").to_pylist()], pa.list_(pa.list_(pa.float32())))


def uneven(table: pa.Table) -> pa.Array:
    rows = table.column("observation.state").to_pylist()
    rows[5] = rows[5][:1]
    return pa.array(rows, pa.list_(pa.float32()))


def read(folder: Path) -> list:
    return [(source, *source.blocks()) for source in open_raw(folder)]


def assert_frames(folder: Path, numbers: range | list[int] = range(COUNT), missing: int | None = None):
    """Every episode has its states under the motors' names, and stamps of its frames."""
    found = read(folder)
    assert [source.name for source, _ in found] == [f"{folder.name}-episode-{number:03d}" for number in numbers]
    for number, (_, block) in zip(numbers, found, strict=True):
        columns = dict(zip(block.names, block.columns.T, strict=True))
        for k, motor in enumerate(arms.MOTORS):
            expected = EPISODES[number][0][:, k].astype(np.float64)
            if missing is not None and number in (0, 2):  # the first of each file
                expected[missing] = np.nan
            np.testing.assert_array_equal(columns[f"observation.state[{motor}.pos]"], expected)
        np.testing.assert_array_equal(block.t_ns, np.round(np.arange(FRAMES) * (1e9 / arms.FPS)).astype(np.int64))
    return found


NAMES = [f"{motor}.pos" for motor in arms.MOTORS]
SAME = {
    "as it is": lambda folder: None,
    "a state of one row": lambda folder: (
        change_frames(folder, put("observation.state", nested)),
        change_feature(folder, "observation.state", shape=[1, len(NAMES)]),
    ),
    "names by kind": lambda folder: name_states(folder, {"motors": NAMES}),
    "names by arm": lambda folder: name_states(folder, {"left": NAMES[:1], "right": NAMES[1:]}),
    "names with their index": lambda folder: name_states(folder, {name: NAMES.index(name) for name in NAMES[::-1]}),
    "no video": lambda folder: [path.unlink() for path in folder.rglob("*.mp4")],
    "frames out of order": lambda folder: change_frames(folder, lambda table: table.take(np.arange(len(table))[::-1])),
    "no action": lambda folder: change_frames(folder, lambda table: table.drop_columns("action")),
    "no timestamps": lambda folder: change_frames(folder, lambda table: table.drop_columns("timestamp")),
    "a feature without frames": lambda folder: change_feature(folder, "observation.effort", dtype="float32", shape=[2]),
    "fps in text": lambda folder: change_info(folder, fps=str(arms.FPS)),
}


@pytest.mark.parametrize("version", ["v3.0", "v2.1", "v2.0"])
@pytest.mark.parametrize("variation", SAME)
def test_a_dataset_of_each_form_gives_the_same_frames(tmp_path, version, variation):
    folder = dataset(tmp_path / "ds", version)
    SAME[variation](folder)
    if version == "v2.0":
        (folder / "meta/episodes_stats.jsonl").unlink()
    assert_frames(folder)


def test_flags_and_lists_of_another_length(tmp_path):
    folder = dataset(tmp_path / "ds")
    change_feature(folder, "next.done", dtype="bool", shape=[1])
    change_frames(folder, put("next.done", lambda table: pa.array(np.arange(len(table)) % FRAMES == FRAMES - 1)))
    change_frames(folder, put("observation.state", uneven))
    (source, block), *_ = assert_frames(folder, missing=5)
    assert block.columns[:, block.names.index("next.done")].sum() == 1
    assert source.counts == {"lists of 'observation.state' without 3 elements are missing values": 1}


@pytest.mark.parametrize("factor", [1.0, 1.5])
def test_timestamps_are_the_second_clock(tmp_path, factor):
    folder = dataset(tmp_path / "ds")
    stamps = (np.arange(FRAMES) / arms.FPS * factor).astype(np.float32)
    change_frames(folder, put("timestamp", lambda table: pa.array(np.tile(stamps, len(table) // FRAMES))))
    for source, block in assert_frames(folder):
        assert source.clocks == ("fps", "timestamp")
        np.testing.assert_allclose(block.other_ns, stamps.astype(np.float64) * 1e9, atol=1)
    change_frames(folder, put("timestamp", lambda table: pa.array(np.zeros(len(table), np.float32))))
    assert all(block.other_ns is None for _, block in assert_frames(folder))


def test_a_gap_in_the_frames_is_a_gap_in_time(tmp_path):
    folder = dataset(tmp_path / "ds")
    change_frames(folder, put("frame_index", lambda table: pa.array(
        [k + 10 * (k >= 20) for k in table.column("frame_index").to_pylist()]
    )))  # fmt: skip
    (_, block), *_ = read(folder)
    np.testing.assert_allclose(np.diff(block.t_ns)[19], 11e9 / arms.FPS, atol=1)


def shortened(table: pa.Table) -> pa.Table:
    """Without the last frame of episode 1."""
    last = (np.array(table.column("episode_index")) == 1) & (np.array(table.column("frame_index")) == FRAMES - 1)
    return table.filter(~last)


@pytest.mark.parametrize("version", ["v3.0", "v2.1"])
def test_a_bad_episode_is_left_out_with_a_note(tmp_path, version):
    folder = dataset(tmp_path / "ds", version)
    change_frames(folder, shortened)
    found = assert_frames(folder, [0, 2, 3])
    why = f"episode 1 has {FRAMES - 1} frames, its metadata lists {FRAMES}"
    assert found[0][0].notes == [f"episodes left out: 1; {why}"]
    path = sorted((folder / "data").rglob("*.parquet"))[-1]
    path.write_bytes(path.read_bytes()[:200])
    left = [0] if version == "v3.0" else [0, 2]
    (source, *_), *_ = assert_frames(folder, left)
    bad = ", ".join(str(number) for number in range(COUNT) if number not in left)
    broken = path.relative_to(folder)
    assert source.notes == [f"episodes left out: {bad}; {why}; {broken} is truncated or damaged: copy it again"]


def cut(part: str):
    return lambda folder: [path.write_bytes(path.read_bytes()[:99]) for path in (folder / part).rglob("*.parquet")]


REFUSED = {
    "no episode is whole": (
        lambda folder: change_frames(folder, lambda table: table.slice(0, 10)),
        f"episode 0 has 10 frames, its metadata lists {FRAMES}",
    ),
    "truncated": (cut("data"), "data/chunk-000/file-000.parquet is truncated or damaged: copy it again"),
    "episodes truncated": (cut("meta"), "its episodes cannot be read: truncated or damaged; copy it again"),
    "an old version": (
        lambda folder: change_info(folder, codebase_version="v1.6"),
        "a LeRobot dataset of version v1.6; v3.0, v2.1, v2.0 are read: convert it with LeRobot's own script",
    ),
}


@pytest.mark.parametrize("kind", REFUSED)
def test_a_dataset_that_cannot_be_read_is_refused_with_the_cause(tmp_path, kind):
    folder = dataset(tmp_path / "ds")
    change, message = REFUSED[kind]
    change(folder)
    with pytest.raises(RecordingError, match=re.escape(message)) as refused:
        read(folder)
    assert "Parquet" not in str(refused.value) and "arrow" not in str(refused.value).lower()


def test_exported_recordings_are_read_back(tmp_path):
    rng = np.random.default_rng(1)
    q, dq, tau = rng.normal(size=(3, 200, 2))
    t_ns = np.arange(200) * 10_000_000 + rng.integers(0, 1000, 200)
    run = Recording("run", ("elbow", "shoulder"), t_ns, q, dq, tau, 100.0, "instant", "made", "")
    assert IMPORTER.export([run, run, run], tmp_path / "out") == 3
    sources = open_raw(tmp_path / "out")
    assert [source.name for source in sources] == ["out-episode-000", "out-episode-001", "out-episode-002"]
    (block,) = sources[1].blocks()
    np.testing.assert_array_equal(block.t_ns, t_ns)
    columns = dict(zip(block.names, block.columns.T, strict=True))
    np.testing.assert_array_equal(columns["observation.state[elbow]"], q[:, 0])
    np.testing.assert_array_equal(columns["observation.effort[shoulder]"], tau[:, 1])
    info = json.loads((tmp_path / "out/meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0" and info["fps"] == 100 and info["total_frames"] == 600


def test_the_command_imports_a_dataset_and_writes_another(tmp_path, capsys):
    arms.write_dataset(tmp_path / "ds", arms.episodes(range(2), 60), "v3.0")
    (tmp_path / "arm.toml").write_text(arms.ARM.replace("UNIT", "deg") + '[split]\ntrain = ["ds"]\n')
    words = ["--source", str(tmp_path / "ds"), "--arm", str(tmp_path / "arm.toml"), "--out", str(tmp_path / "out")]
    assert main(["import", *words, "--format", "lerobot"]) == 0
    out = capsys.readouterr().out
    assert "[split] is not used: a dataset of format lerobot has no sets\n" in out and "2 episodes\n" in out
    for read_again, (source, block) in zip(read(tmp_path / "out"), read(tmp_path / "ds"), strict=True):
        assert read_again[0].name == source.name.replace("ds-", "out-")
        np.testing.assert_array_equal(read_again[1].t_ns, block.t_ns)
    assert main(["import", *words, "--format", "csv"]) == 2
    assert capsys.readouterr().err == "tauext: error: --format = csv must be one of tauext, lerobot\n"
