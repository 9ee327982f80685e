"""LeRobot datasets with labels: what a dataset gets, that frames alone get the same, and what is refused.

docs/quickstarts/lerobot.md: its quickstart as printed, on synthetic datasets.
"""

import ast
import json
import re
import shutil
from importlib.metadata import distribution
from pathlib import Path

import lerobot_arm as arms
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from doc_pages import Page
from tauext_lerobot.frames import FrameLabeller, element_names
from tauext_lerobot.labels import label_dataset

from tauext.bundle.bundle_file import load_bundle
from tauext.cli import main
from tauext.config import PriorConfig, TrainConfig
from tauext.data.dataset import load_dataset
from tauext.data.description import load_arm, parse_arm
from tauext.data.importers.open_raw import open_raw
from tauext.data.importing import import_dataset
from tauext.errors import BundleError, ConfigError, RecordingError
from tauext.train.stage import train_bundle

FRAMES, COUNT = 240, 4
ADDED = ["shoulder.tau_ext", "elbow.tau_ext", "wrist.tau_ext", "contact", "collision"]


def described(folder: Path, unit: str) -> Path:
    (folder / "calibration.json").write_text(json.dumps(arms.calibration()))
    path = folder / "arm.toml"
    path.write_text(arms.ARM.replace("UNIT", unit).replace("[robot]", '[robot]\ncalibration = "calibration.json"'))
    return path


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A bundle of 4 minutes of free motion, and what it is to label: four episodes that meet a wall halfway."""
    folder = tmp_path_factory.mktemp("label")
    arms.write_dataset(folder / "free", arms.episodes(range(6), 1200), "v2.1")
    import_dataset([folder / "free"], described(folder, "deg"), folder / "data", "tauext", lambda _: None)
    data = load_dataset(folder / "data")
    no_ripple = PriorConfig(most_ripples=0)  # this arm has none, and to look for it takes most of a training
    train_bundle(
        data,
        folder / "arm.tauext",
        config=TrainConfig(recipe="prior", prior=no_ripple, limits="supported"),
        check=False,
    )
    walls = arms.episodes(range(100, 100 + COUNT), FRAMES, wall=True)
    arms.write_dataset(folder / "v3.0", walls, "v3.0")
    arms.write_dataset(folder / "v2.1", walls, "v2.1")
    (folder / "normalised").mkdir()
    described(folder / "normalised", "normalised")
    normal = arms.episodes(range(100, 100 + COUNT), FRAMES, "normalised", wall=True)
    arms.write_dataset(folder / "normalised/v3.0", normal, "v3.0")
    return folder


def labelled(place: Path, out: Path, source: str | Path = "v3.0", **settings):
    bundle, arm = load_bundle(place / "arm.tauext"), load_arm(place / "arm.toml")
    return label_dataset(place / source, bundle, arm, out, **settings)


def columns(path: Path) -> list[dict[str, np.ndarray]]:
    return [dict(zip(block.names, block.columns.T, strict=True)) for raw in open_raw(path) for block in raw.blocks()]


@pytest.mark.parametrize("version", [pytest.param("v3.0", marks=pytest.mark.slow), "v2.1"])
def test_a_wall_is_found_in_old_demonstrations(place, tmp_path, version):
    report = labelled(place, tmp_path / "out", version)
    assert report.episodes == COUNT and report.frames == COUNT * FRAMES
    assert 0 < report.unknown <= COUNT * arms.FPS  # at most a second of each
    met = 0
    for before, after in zip(columns(place / version), columns(tmp_path / "out"), strict=True):
        for name, values in before.items():  # all that there was is as it was
            np.testing.assert_array_equal(after[name], values)
        contact = after["observation.state[contact]"]
        assert set(contact) <= {-1, 0, 1} and contact[0] == -1
        assert not (contact[arms.FPS : FRAMES // 2] == 1).any()
        met += bool((contact[FRAMES // 2 :] == 1).any())
        unknown = contact == -1
        for joint in arms.MOTORS:
            tau_ext = after[f"observation.state[{joint}.tau_ext]"]
            assert np.isfinite(tau_ext).all() and not tau_ext[unknown].any() and tau_ext[~unknown].all()
    assert met >= COUNT - 1


def test_both_versions_get_the_same_labels(place, tmp_path):
    for version in ("v3.0", "v2.1"):
        labelled(place, tmp_path / version, version)
    for one, other in zip(columns(tmp_path / "v3.0"), columns(tmp_path / "v2.1"), strict=True):
        for name in ADDED:
            np.testing.assert_array_equal(one[f"observation.state[{name}]"], other[f"observation.state[{name}]"])


def test_frame_by_frame_gives_the_same_bits(place, tmp_path):
    """What a robot says while it records is what the label says of the recorded dataset."""
    labelled(place, tmp_path / "out")
    names = [f"{kind}[{motor}.pos]" for kind in ("observation.state", "goal") for motor in arms.MOTORS]
    labeller = FrameLabeller(load_bundle(place / "arm.tauext"), load_arm(place / "arm.toml"), names, arms.FPS)
    for episode in columns(tmp_path / "out"):
        labeller.restart()
        for k in range(FRAMES):
            (said,) = labeller.step({name: episode[name][k] for name in names}).columns
            held = [episode[f"observation.state[{name}]"][k] for name in ADDED]
            np.testing.assert_array_equal(said, np.float32(held))


@pytest.mark.parametrize("version", ["v3.0", "v2.1"])
@pytest.mark.parametrize("into", ["state", "features"])
def test_features_and_statistics_are_those_of_the_frames(place, tmp_path, version, into):
    labelled(place, tmp_path / "out", version, into=into)
    info = json.loads((tmp_path / "out/meta/info.json").read_text())
    held = columns(tmp_path / "out")
    if into == "state":
        state = info["features"]["observation.state"]
        assert state["names"] == [f"{m}.pos" for m in arms.MOTORS] + ADDED and state["shape"] == [8]
        feature, names = "observation.state", state["names"]
    else:
        assert info["features"]["observation.state"]["shape"] == [3]
        assert info["features"]["observation.contact"] == {"dtype": "float32", "shape": [1], "names": None}
        feature, names = "observation.tau_ext", arms.MOTORS
    values = [np.array([e[f"{feature}[{name}]"] for name in names]).T for e in held]
    stats = stats_of(tmp_path / "out", feature)
    for own, of_episode in zip(values, stats, strict=True):
        np.testing.assert_allclose(of_episode["mean"], own.mean(0), atol=1e-5)
        np.testing.assert_allclose(of_episode["std"], own.std(0), atol=1e-5)
        np.testing.assert_array_equal(of_episode["max"], own.max(0).astype(np.float32))
        assert of_episode["count"] == [FRAMES]
    if version == "v3.0":
        total = json.loads((tmp_path / "out/meta/stats.json").read_text())[feature]
        np.testing.assert_allclose(total["std"], np.concatenate(values).std(0), atol=1e-5)
        np.testing.assert_allclose(total["mean"], np.concatenate(values).mean(0), atol=1e-5)


def stats_of(path: Path, feature: str) -> list[dict]:
    if (path / "meta/episodes_stats.jsonl").is_file():
        lines = (path / "meta/episodes_stats.jsonl").read_text().splitlines()
        return [json.loads(line)["stats"][feature] for line in lines]
    rows = pq.read_table(path / "meta/episodes/chunk-000/file-000.parquet").to_pylist()
    return [{kind: row[f"stats/{feature}/{kind}"] for kind in ("mean", "std", "max", "count")} for row in rows]


def test_values_from_minus_100_to_100_are_angles_by_the_calibration(place, tmp_path):
    """The same motion, stored otherwise: contacts are found where they are found in degrees."""
    bundle, arm = load_bundle(place / "arm.tauext"), load_arm(place / "normalised/arm.toml")
    labelled(place, tmp_path / "deg")
    label_dataset(place / "normalised/v3.0", bundle, arm, tmp_path / "normalised")
    name = "observation.state[contact]"
    for one, other in zip(columns(tmp_path / "deg"), columns(tmp_path / "normalised"), strict=True):
        if (one[name] == 1).any():
            assert abs(np.argmax(one[name] == 1) - np.argmax(other[name] == 1)) <= 2
    with pytest.raises(ConfigError, match="only with the arm's LeRobot calibration file"):
        parse_arm(arms.ARM.replace("UNIT", "normalised"))


def test_labels_that_were_there_are_replaced_and_compared(place, tmp_path):
    first = labelled(place, tmp_path / "once")
    again = labelled(place, tmp_path / "twice", tmp_path / "once")
    assert first.held == 0 and again.held == again.equal == COUNT * FRAMES
    info = [json.loads((tmp_path / one / "meta/info.json").read_text()) for one in ("once", "twice")]
    assert info[0] == info[1]


def test_a_goal_is_the_action_of_the_frame_before_unless_one_is_recorded(place, tmp_path):
    """A goal that was sent may be another than the recorded action: clipped, or held after a collision."""
    (first, *_) = columns(place / "v3.0")
    action, state, goal = (first[f"{name}[elbow.pos]"] for name in ("action", "observation.state", "goal"))
    np.testing.assert_array_equal(goal, np.r_[state[0], action[:-1]])
    path = arms.write_dataset(tmp_path / "goals", arms.episodes(range(1), 60), "v3.0")
    file = path / "data/chunk-000/file-000.parquet"
    info = json.loads((path / "meta/info.json").read_text())
    info["features"]["observation.state"]["names"][2] = "elbow.goal"
    (path / "meta/info.json").write_text(json.dumps(info))
    (block,) = columns(path)
    state = np.array(pq.read_table(file)["observation.state"].to_pylist())
    np.testing.assert_array_equal(block["goal[elbow.pos]"], state[:, 2])


def files_of(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_the_dataset_is_only_read_and_a_video_that_is_a_link_is_copied(place, tmp_path):
    """What is written into the output must not reach a file outside the dataset."""
    source, outside = tmp_path / "linked", tmp_path / "outside.mp4"
    shutil.copytree(place / "v3.0", source)
    videos = [f"videos/observation.images.{name}/chunk-000/file-000.mp4" for name in ("top", "side")]
    outside.write_bytes(b"mine")
    (source / videos[1]).parent.mkdir(parents=True)
    (source / videos[1]).symlink_to(outside)
    before = files_of(source)
    labelled(place, tmp_path / "out", source)
    assert before == files_of(source)
    plain, linked = (tmp_path / "out" / video for video in videos)
    assert plain.read_bytes() == (source / videos[0]).read_bytes()
    assert linked.read_bytes() == b"mine" and not linked.is_symlink()
    assert outside.stat().st_nlink == 1 and outside.stat().st_ino != linked.stat().st_ino


def test_an_interrupted_label_leaves_nothing(place, tmp_path, monkeypatch):
    def killed(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("tauext_lerobot.labels.with_labels", killed)
    with pytest.raises(KeyboardInterrupt):
        labelled(place, tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_what_cannot_be_labelled_is_refused_in_words(place, tmp_path):
    bundle, arm = load_bundle(place / "arm.tauext"), load_arm(place / "arm.toml")
    out, whole = tmp_path / "out", place / "v3.0"
    radians = parse_arm(arms.ARM.replace("UNIT", "rad"))
    other = parse_arm(arms.ARM.replace("UNIT", "deg").replace('"shoulder", "elbow"', '"elbow", "shoulder"'))
    slow = arms.write_dataset(tmp_path / "slow", arms.episodes(range(1), 60), "v3.0")
    (slow / "meta/info.json").write_text(json.dumps(json.loads((whole / "meta/info.json").read_text()) | {"fps": 50}))
    for source, described_by, target, error, words in (
        (whole, radians, out, RecordingError, "is no angle in rad: set the unit of .* to 'deg' or 'normalised'"),
        (whole, arm, place, ConfigError, "is not empty"),
        (place / "data", arm, out, RecordingError, "data: is not a LeRobot dataset: it has no meta/info.json"),
        (whole, arm, whole / "labelled", ConfigError, "is inside the dataset"),
        (slow, arm, out, BundleError, "runs at 30 Hz, these frames at 50"),
        (whole, other, out, BundleError, "is for joints shoulder, elbow, wrist"),
    ):
        with pytest.raises(error, match=words):
            label_dataset(source, bundle, described_by, target)
    assert not out.exists()


def test_the_command_counts(place, tmp_path, capsys):
    words = ["label", "--dataset", place / "v2.1", "--bundle", place / "arm.tauext", "--arm", place / "arm.toml"]
    assert main([*map(str, words), "--out", str(tmp_path / "out"), "--json"]) == 0
    counts = json.loads(capsys.readouterr().out)
    assert counts["frames"] == COUNT * FRAMES and counts["held"] == 0
    assert main([*map(str, words), "--out", str(tmp_path / "out")]) == 2
    assert "is not empty" in capsys.readouterr().err


def test_elements_are_called_as_a_wrapped_robot_calls_them():
    assert element_names(["elbow.pos", "wrist"]) == ["elbow.tau_ext", "wrist.tau_ext", "contact", "collision"]


def frames_with(change):
    def damage(file: Path) -> None:
        pq.write_table(change(pq.read_table(file)), file)

    return damage


def cut(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:-20])


def wide(file: Path) -> None:
    info = json.loads(file.read_text())
    info["features"]["observation.state"]["shape"] = [10**9]
    file.write_text(json.dumps(info))


FRAMES_OF_TWO = "data/chunk-000/file-000.parquet"
DAMAGE = {
    "statistics cut off": ("meta/stats.json", cut, "cannot be read"),
    "frames cut off": (FRAMES_OF_TWO, cut, "cannot be read"),
    "no numbers of episodes": (
        FRAMES_OF_TWO,
        frames_with(lambda t: t.set_column(4, "episode_index", pa.nulls(len(t)))),
        "episode_index is not a whole number in every row",
    ),
    "columns described by no table": (
        FRAMES_OF_TWO,
        frames_with(lambda t: t.replace_schema_metadata({"huggingface": "[null]"})),
        "the description of its columns cannot be read",
    ),
    "no frames": (FRAMES_OF_TWO, frames_with(lambda t: t[:0]), "no data file holds frames of episode 0, 1"),
    "a billion elements": ("meta/info.json", wide, "observation.state has 1,000,000,000 elements"),
}


@pytest.mark.parametrize("what", DAMAGE)
def test_a_damaged_dataset_is_refused_by_the_name_of_its_file(place, tmp_path, what):
    file, damage, told = DAMAGE[what]
    shutil.copytree(place / "v3.0", tmp_path / "damaged")
    damage(tmp_path / "damaged" / file)
    with pytest.raises(RecordingError, match=told) as refused:
        labelled(place, tmp_path / "out", tmp_path / "damaged")
    assert what == "no frames" or file in str(refused.value)
    assert not (tmp_path / "out").exists() and not (tmp_path / "out.part").exists()


PAGE = "quickstarts/lerobot.md"
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
HERE = Path(__file__).parents[1]


@pytest.mark.parametrize("text", [Page(PAGE).text, (HERE / "README.md").read_text()])
def test_options_of_the_wrapped_robot_exist(text):
    """By its settings' source: lerobot need not be installed."""
    settings: set[str] = set()
    for name in ("config_wrapping", "config_tauext", "config_tauext_guard"):
        path = HERE / "lerobot_robot_tauext" / f"{name}.py"
        for config in (node for node in ast.parse(path.read_text()).body if isinstance(node, ast.ClassDef)):
            settings |= {node.target.id for node in config.body if isinstance(node, ast.AnnAssign)}
    printed = set(re.findall(r"--robot\.(\w+)", text))
    assert {"bundle", "arm", "robot"} <= printed
    assert printed <= settings | {"type", "id"}, printed - settings


def test_the_distribution_has_the_name_of_the_module_that_lerobot_imports():
    """register_third_party_plugins: names of distributions that begin with lerobot_robot_, as written."""
    name = "lerobot_robot_tauext"
    assert (HERE / name / "__init__.py").is_file() and distribution(name).metadata["Name"] == name


def test_the_current_is_added_as_the_page_describes():
    first, current = Page(PAGE).blocks("toml")
    for made_from in ("goal", "supply-current", "phase-current"):
        arm = parse_arm(first.replace('torque_from = "goal"', f'torque_from = "{made_from}"') + current)
        assert set(arm.signals) >= {"q", "q_des", "current"} and arm.servo.torque_from == made_from


@pytest.mark.slow
def test_the_quickstart_runs_as_printed(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    arms.write_dataset(Path("free"), arms.six_joints(range(6), 220), "v3.0", motors=JOINTS)
    arms.write_dataset(Path("demos"), arms.six_joints(range(100, 103), 240, wall=True), "v3.0", motors=JOINTS)
    quickstart = Page(PAGE, "Quickstart")
    (description,), (program,) = quickstart.blocks("toml"), quickstart.blocks("python")
    Path("arm.toml").write_text(description)
    for command in quickstart.commands():
        assert main(command) == 0, command
    capsys.readouterr()
    exec(compile(program, PAGE, "exec"), {})
    printed = re.findall(r"^file-\d+\.parquet (\d+) of (\d+) frames in contact$", capsys.readouterr().out, re.MULTILINE)
    assert [int(frames) for _, frames in printed] == [480, 240]
    assert all(0 < int(contact) < int(frames) / 2 for contact, frames in printed)
