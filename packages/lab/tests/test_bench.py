"""The benchmark: a track with known answers, files of others, methods from outside, and what goes wrong."""

import hashlib
import html
import json
import shutil
import subprocess

import numpy as np
import pytest
from tauext_lab.bench.methods import WARM_UP_S, method_of
from tauext_lab.bench.run import run_bench
from tauext_lab.bench.track import TRACKS, Track, load_track
from tauext_lab.sim.collect import simulate_motion, simulate_recording
from tauext_lab.sim.other_friction import MaxwellSlip, OtherRig
from tauext_lab.sim.rig import arm_xml, draw_motion, joint_names

from tauext.config import PAPER_CASES
from tauext.errors import ConfigError
from tauext.robot.model_case import estimated_model

# Two joints whose torque is what pushes them, and 0.1 N m of noise as a sine: an arm that nothing is known of but q.
MAKE = """
import numpy as np
from tauext.data.dataset import Split, save_split
from tauext.data.recording import Recording
from tauext.data.recording_file import save_recording

def make(files, out):
    out.mkdir()
    assert files["pushes.txt"].read_text() == "5\\n"
    for name, seconds, starts in (("train", 30, ()), ("free", 60, ()), ("touched", 60, (10, 20, 30))):
        t = np.arange(100 * seconds) / 100
        noise = 0.1 * np.sin(7 * t) * (1.0 if name == "train" else 0.5)
        tau, contact = np.stack([noise, noise], axis=1), np.zeros(len(t), np.int8)
        tau_ext = np.zeros_like(tau)
        for start in starts:
            at = (t >= start) & (t < start + 0.5)
            tau_ext[at, 0], contact[at] = 5.0, 1
        q = np.sin(np.stack([t, 2 * t], axis=1))
        dq = np.stack([np.cos(t), 2 * np.cos(2 * t)], axis=1)
        one = Recording(name, ("a", "b"), (t * 1e9).astype(np.int64), q, dq, tau + tau_ext, 100.0, "held", "made", "",
                        tau_ext=tau_ext, contact=contact)
        save_recording(one, out / f"{name}.parquet")
    save_split(Split(("train.parquet",), (), ("free.parquet",), ("touched.parquet",)), out)
"""
METHODS = """
import numpy as np

def perfect(recordings):
    return lambda one: one.tau

def zero(recordings):
    return lambda one: 0 * one.tau

def nervous(recordings):
    def estimate(one):
        spikes = np.zeros_like(one.tau)
        if one.duration_s > 40 and not (one.tau > 1).any():
            for second in (5.0, 5.2, 40.0):
                spikes[(one.time_s >= second) & (one.time_s < second + 0.05), 1] = 1.0
        return one.tau + spikes
    return estimate

def always(recordings):
    return lambda one: (one.tau, np.full(one.samples, True))

def curious(recordings):
    assert all(one.tau_ext is None for one in recordings)
    def estimate(one):
        assert one.contact is None and one.tau_ext is None and "contacts" not in one.provenance
        return one.tau
    return estimate

def broken(recordings):
    raise KeyError("weights")

def misshapen(recordings):
    return lambda one: one.tau[:, :1]

def undefined(recordings):
    return lambda one: np.where(one.time_s[:, None] > 8, np.nan, one.tau)

def no_function(recordings):
    return 3
"""


@pytest.fixture
def place(tmp_path):
    folder = tmp_path / "made"
    folder.mkdir()
    (folder / "make.py").write_text(MAKE)
    sha256 = hashlib.sha256(b"5\n").hexdigest()
    (folder / "track.toml").write_text(
        'title = "Two joints"\nevidence = "made"\nlabels = "as made"\ntruth = true\nmade_by = "make.py:make"\n'
        f'[[files]]\nname = "pushes.txt"\nlicence = "none"\nsha256 = "{sha256}"\n'
    )
    (tmp_path / "data/below").mkdir(parents=True)
    (tmp_path / "data/below/pushes.txt").write_text("5\n")
    (tmp_path / "methods.py").write_text(METHODS)
    return tmp_path


def bench(place, *names, tracks=("made",), **more):
    methods = [name if "." in name else f"{place / 'methods.py'}:{name}" for name in names]
    return run_bench([place / one for one in tracks], methods, place / "out", place / "data", **more)


def scores(content):
    return {one["name"]: one for one in content["tracks"][0]["methods"]}


# --- A track with known answers.


def test_a_perfect_estimator_finds_all_and_a_zero_one_nothing(place):
    made = scores(bench(place, "perfect", "zero"))
    perfect, zero = made["perfect"], made["zero"]
    for point in (perfect["equal"], perfect["own"]):
        assert (point["found"], point["contacts"], point["false"]) == (3, 3, 0)
        assert point["delay_median_s"] == pytest.approx(0.0, abs=0.011)  # of a label that begins within a sample
    # 3 of 3: the lower end of Clopper and Pearson is 0.025 ** (1 / 3).
    assert perfect["equal"]["found_share"] == pytest.approx([0.025 ** (1 / 3), 1.0])
    assert (zero["own"]["found"], zero["equal"]["found"]) == (0, 0)
    assert perfect["l1_free"] == pytest.approx([0.05 * 2 / np.pi] * 2, rel=0.02)
    assert zero["l1_contact"][0] == pytest.approx(5.0 * 50 / 70, rel=0.05)  # half a second of 0.5 + 2 x 0.1 s
    assert perfect["training_minutes"] == pytest.approx(0.5, rel=0.01)
    # 120 s, less 2 s to warm up twice, and 0.5 s of contact with 0.1 s around it and 0.5 s of rest three times.
    assert 3600 * perfect["equal"]["hours"] == pytest.approx(120 - 2 * WARM_UP_S - 3 * 1.2, abs=0.2)


def test_false_alarms_are_those_counted_by_hand(place):
    made = scores(bench(place, "nervous"))["nervous"]
    assert made["own"]["false"] == 2  # at 5.0 and 5.2 s, less than half a second apart, and at 40 s
    assert made["equal"]["false"] == 0 and made["equal"]["found"] == 3
    assert made["equal"]["factor"] == pytest.approx(10.0, abs=0.5)  # the spikes' 1.0 N m and noise over 0.1


def test_an_alarm_that_is_always_on_finds_nothing(place):
    assert scores(bench(place, "always"))["always"]["own"]["found"] == 0


def test_methods_see_neither_labels_of_the_test_nor_the_truth(place):
    assert scores(bench(place, "curious"))["curious"]["own"]["found"] == 3


# --- What goes wrong is one sentence, and stops nothing else.


def test_broken_methods_stand_beside_a_good_one(place):
    content = bench(place, "broken", "misshapen", "undefined", "no_function", "perfect")
    assert list(scores(content)) == ["perfect"]
    assert content["missing"] == [
        "broken on made: fit raised KeyError: 'weights'",
        "misshapen on made: tau_ext of 'train' has shape (3000, 1); it must be (3000, 2)",
        "undefined on made: tau_ext of 'train' is not finite at 8.010 s; it must be from 2 s on",
        "no_function on made: fit() returned int; it must return a function of a recording",
    ]
    page = (place / "out/bench.html").read_text()
    assert "fit raised KeyError" in page and "3 of 3 (0 false)" in page


def test_a_file_with_another_checksum_is_refused_and_the_other_tracks_are_run(place):
    other = place / "other"
    other.mkdir()
    text = (place / "made/track.toml").read_text()
    (other / "track.toml").write_text(text.replace('sha256 = "', 'sha256 = "00'))
    content = bench(place, "perfect", tracks=("other", "made"))
    (words,) = content["missing"]
    assert words.startswith("track other: pushes.txt: its sha256 is ") and "\n" not in words
    assert [track["name"] for track in content["tracks"]] == ["made"]
    assert not (place / "out/other/data").exists()


def test_unknown_methods_and_tracks_are_named_with_the_choices(place):
    with pytest.raises(ConfigError, match=r"--method magic: must be FILE.py:FUNCTION.*prior.*stall-rule"):
        run_bench([place / "made"], ["magic"], place / "out")
    with pytest.raises(ConfigError, match="tracks of the package are .*mocca"):
        run_bench([place / "nowhere"], ["zero"], place / "out")


# --- Files of others by git; estimates made elsewhere; interruptions.


@pytest.fixture
def theirs(place):
    """A repository of others, whose file "logs/a run.txt" is what the track wants in its first commit alone."""
    folder = place / "theirs"

    def git(*words):
        command = ["git", "-c", "user.name=a", "-c", "user.email=a@b.c", "-C", str(folder), *words]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()

    (folder / "logs").mkdir(parents=True)
    git("init", "-q")
    git("config", "uploadpack.allowFilter", "true")  # as the large hosts
    for number in ("5\n", "6\n"):
        (folder / "logs/a run.txt").write_text(number)
        git("add", ".")
        git("commit", "-q", "-m", "x")
    (place / "data/below/pushes.txt").unlink()
    return f"file://{folder}", git("rev-parse", "HEAD~1"), git("rev-parse", "HEAD")


def name_source(place, repository, commit, path="logs/a run.txt"):
    """Writes where the track's file comes from."""
    with (place / "made/track.toml").open("a") as toml:
        toml.write(f'repository = "{repository}"\ncommit = "{commit}"\npath = "{path}"\n')


def test_files_come_from_the_named_commit_of_a_repository(place, theirs):
    repository, first, _ = theirs
    name_source(place, repository, first)
    assert scores(bench(place, "perfect"))["perfect"]["own"]["found"] == 3
    (clone,) = (place / "out/made/files/repositories").iterdir()
    count = ["git", "-C", str(clone), "rev-list", "--objects", "--all", "--missing=print", first]
    assert len(subprocess.run(count, check=True, capture_output=True, text=True).stdout.split("\n")) == 5  # one commit


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"commit": "0" * 40}, "could not be fetched from file://"),
        ({"path": "logs/b.txt"}, "could not be fetched from file://"),
        ({"repository": "file:///nowhere"}, "could not be fetched from file:///nowhere at"),
        ({"path": ""}, "is in no repository in this form; give a folder that holds it with --data"),
        ({"commit": None}, "it is not the file that was labelled, and is not used"),
    ],
)
def test_a_file_that_its_repository_lacks_or_has_otherwise_is_one_sentence(place, theirs, wrong, words):
    repository, first, second = theirs
    source = {"repository": repository, "commit": first} | wrong
    name_source(place, **source | {"commit": source["commit"] or second})
    content = bench(place, "perfect")
    assert content["tracks"] == [] and len(content["missing"]) == 1
    assert content["missing"][0].startswith("track made: pushes.txt: ") and words in content["missing"][0]
    assert "\n" not in content["missing"][0]


def test_without_a_name_all_tracks_of_the_package_are_run_and_those_missing_stated(place, monkeypatch):
    for name in ("absent", "broken"):
        shutil.copytree(place / "made", place / name)
    text = (place / "made/track.toml").read_text()
    (place / "absent/track.toml").write_text(text.replace("pushes.txt", "elsewhere.csv"))
    (place / "broken/track.toml").write_text(text.replace('sha256 = "', 'sha256 = "00'))
    monkeypatch.setattr("tauext_lab.bench.track.TRACKS", place)
    content = bench(place, "perfect", tracks=())
    assert [track["name"] for track in content["tracks"]] == ["made"]
    assert [words.partition(": its")[0].partition(": is")[0] for words in content["missing"]] == [
        "track absent: elsewhere.csv",
        "track broken: pushes.txt",
    ]


def test_estimates_in_a_file_score_as_the_method_that_made_them(place):
    bench(place, "perfect")
    from tauext.data.dataset import load_dataset

    dataset, lines = load_dataset(place / "out/made/data"), ["track,recording,t_ns,tau_ext_1,tau_ext_2"]
    for name in ("train", "test", "collisions"):
        for one in dataset.recordings(name):
            lines += [f"made,{one.name},{t},{a!r},{b!r}" for t, (a, b) in zip(one.t_ns, one.tau.tolist(), strict=True)]
    (place / "mine.csv").write_text("\n".join(lines))
    (place / "short.csv").write_text("\n".join(lines[:-1]))
    content = bench(place, "perfect", str(place / "mine.csv"), str(place / "short.csv"))
    made = scores(content)
    for part in ("equal", "own", "curve", "l1_free", "l1_contact"):
        assert made["mine"][part] == made["perfect"][part]
    assert "must have one row for each of the 6000 samples of 'touched'" in content["missing"][0]


def test_finished_results_are_kept_until_the_method_or_the_track_changes(place):
    counted = place / "calls.txt"
    source = f"def fit(recordings):\n    open({str(counted)!r}, 'a').write('x')\n    return lambda one: one.tau\n"
    (place / "mine.py").write_text(source)

    def calls():
        bench(place, f"{place / 'mine.py'}:fit")
        return len(counted.read_text())

    assert [calls(), calls()] == [1, 1]
    (place / "mine.py").write_text(source + "# another state\n")
    assert calls() == 2
    make = place / "made/make.py"
    make.write_text(make.read_text().replace("(10, 20, 30)", "(10, 20)"))
    assert calls() == 3
    content = json.loads((place / "out/bench.json").read_text())
    assert scores(content)["fit"]["own"]["contacts"] == 2  # the dataset was made anew, too


# --- Tracks of the package, and friction of other families.


def test_every_track_of_the_package_is_readable_and_names_licence_and_checksum():
    tracks = {path.parent.name: load_track(path.parent) for path in TRACKS.glob("*/track.toml")}
    assert {"lugre", "maxwell-slip", "belt", "mocca", "panda-touches", "ur3", "so101-stalls"} <= set(tracks)
    for track in tracks.values():
        assert isinstance(track, Track) and track.labels
        assert all(len(one.sha256) == 64 and one.licence for one in track.files)


def test_maxwell_slip_slides_at_its_level_and_remembers_reversals():
    one = MaxwellSlip(4.5, 6.0, 0.03, 3e-4, 400.0)
    for _ in range(3000):
        sliding = one.step(0.5, 1e-3)
    assert sliding == pytest.approx(4.5, rel=1e-3)  # the Stribeck part is gone at 17 times its speed
    # Reversals within presliding close their loop: back where it was, the force is the one it had.
    two = MaxwellSlip(4.5, 4.5, 0.03, 3e-4, 400.0)
    for v in [1e-3] * 500:
        before = two.step(v, 1e-3)
    loop = [two.step(v, 1e-3) for v in [-1e-3] * 200 + [1e-3] * 200]
    assert loop[-1] == pytest.approx(before, abs=0.05) and min(loop) < before - 1


@pytest.mark.parametrize(("family", "within_nm"), [("maxwell-slip", 1e-3), ("belt", 0.5)])
def test_the_simulated_arm_obeys_the_equation_of_motion(tmp_path, family, within_nm):
    """dp/dt = drive - friction - beta by the core's model; the belt's stretch moves the link by up to 5 mrad."""
    config, rng = OtherRig(family=family), np.random.default_rng(0)
    (tmp_path / "true.xml").write_text(arm_xml(config, true_com=True))
    tree = estimated_model(tmp_path / "true.xml", tuple(joint_names(config)), PAPER_CASES["exact"])
    truth, _, _ = simulate_motion(config, "free", *draw_motion(config.motion, 2, 6000, 1000, rng), 1000, rng)
    p, beta = tree.momentum(truth.q, truth.dq)
    net = np.cumsum(truth.drive - truth.friction - beta, axis=0)
    error = (p[201:] - p[1:-200]) / 0.2 - (net[200:-1] - net[:-201]) / 200
    assert np.abs(error).max() < within_nm < 0.1 * np.abs(truth.friction).max()


def test_a_family_has_its_own_arm_and_a_seed_always_the_same():
    made = {one: simulate_recording(OtherRig(family=one), "free", 5.0, 0, 0) for one in ("maxwell-slip", "belt")}
    assert np.abs(made["belt"].tau - made["maxwell-slip"].tau).max() > 2.0
    again = simulate_recording(OtherRig(family="belt"), "free", 5.0, 0, 0)
    np.testing.assert_array_equal(again.tau, made["belt"].tau)


def test_only_networks_take_steps():
    with pytest.raises(ConfigError, match="only a recipe with a network has steps"):
        method_of("prior@100")
    assert method_of("dense@100").max_steps == 100


def test_the_page_lists_no_track_where_none_could_be_made(place):
    (place / "data/below/pushes.txt").write_text("7\n")
    content = bench(place, "perfect")
    assert content["tracks"] == [] and len(content["missing"]) == 1
    assert json.loads((place / "out/bench.json").read_text())["missing"] == content["missing"]
    assert content["missing"][0] in html.unescape((place / "out/bench.html").read_text())
