"""Training checks its data first: faults refuse unless accepted, and the same data are checked once."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_arms import six_axis, urdf
from made_recordings import made_motion

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.check.before_training import SHARE, ShareRules, folder, refuse_faults, shares
from tauext.check.finding import CODES, Finding
from tauext.cli import main
from tauext.config import AlarmConfig, TrainConfig
from tauext.data.dataset import Split, load_dataset, save_split
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording, save_recording
from tauext.data.servo import FROM_AMPERES
from tauext.errors import ConfigError, FaultyDataError
from tauext.progress import Silent, WallTimes
from tauext.robot.read import load_tree
from tauext.train.calibrate import recalibrate
from tauext.train.limits import LIMITS
from tauext.train.stage import train_bundle

OBSERVER = TrainConfig(recipe="observer", limits="paper")


class Heard(Silent):
    def __init__(self):
        self.said: list[str] = []

    def say(self, sentence: str) -> None:
        self.said.append(sentence)


@pytest.fixture(scope="module")
def good(tmp_path_factory) -> Path:
    """A dataset of a six-axis arm without a fault: two recordings to train, one to validate, one to calibrate."""
    path = tmp_path_factory.mktemp("good")
    (path / "robot.urdf").write_text(urdf(six_axis()).replace('effort="100"', 'effort="3000"'))
    made = made_motion(load_tree(path / "robot.urdf"), 1.0, 100.0, pieces=4).recordings
    names = ("one", "two", "three", "four")
    for name, recording in zip(names, made, strict=True):
        save_recording(replace(recording, name=name), path / f"{name}.parquet")
    files = [f"{name}.parquet" for name in names]
    save_split(Split(files[:2], files[2:3], (), (), files[3:]), path)
    return path


@pytest.fixture
def data(good, tmp_path) -> Path:
    """A copy of it that a test may spoil."""
    for file in good.iterdir():
        (tmp_path / "data").mkdir(exist_ok=True)
        (tmp_path / "data" / file.name).write_bytes(file.read_bytes())
    return tmp_path / "data"


@pytest.fixture(autouse=True)
def forgotten(monkeypatch, tmp_path):
    """Each test begins without a memory."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def spoil(data: Path, name: str, **changes) -> None:
    """Change signals of a recording: each a function of the signal."""
    file = data / f"{name}.parquet"
    recording = load_recording(file)
    made = {signal: change(getattr(recording, signal).copy()) for signal, change in changes.items()}
    save_recording(replace(recording, **made), file)


def spike(tau: np.ndarray) -> np.ndarray:
    tau[1000, 1] = 1e6
    return tau


def kept(bundle: Path) -> dict:
    return json.loads(_core.Bundle.load(str(bundle)).provenance)["checks"]


def train(data: Path, out: Path, *options: str) -> int:
    given = {"--recipe": "observer", "--limits": "paper"}
    few = [word for name, value in given.items() if name not in options for word in (name, value)]
    return main(["train", "--data", str(data), "--out", str(out), *few, *options])


def test_good_data_is_trained_on_and_the_bundle_holds_the_checks(data, tmp_path, capsys):
    assert train(data, tmp_path / "a.tauext") == 0
    assert kept(tmp_path / "a.tauext")["training"]["accepted"] == []
    assert "fault" not in capsys.readouterr().err


def test_one_sample_in_one_file_is_refused_in_one_block_and_nothing_is_written(data, tmp_path, capsys, unexamined):
    spoil(data, "two", tau=spike)
    assert train(data, tmp_path / "a.tauext") == 2
    err = capsys.readouterr().err
    told = err[err.index("tauext: error: ") :]
    for word in ("spike", "joint joint2", "recording two", "1e+06 Nm at 10.000 s", "-> ", "--accept spike:joint2"):
        assert word in told, word
    assert told.count("spike (") == 1
    assert not list(tmp_path.glob("a*"))


def test_what_a_person_accepts_stands_in_bundle_and_run_file_and_is_shown(data, tmp_path, capsys, unexamined):
    spoil(data, "two", tau=spike)
    out = tmp_path / "a.tauext"
    assert train(data, out, "--accept", "spike:joint1") == 2  # of another joint
    assert train(data, out, "--accept", "resolution", "spike:joint2") == 0
    assert "accepted: spike (joint2)" in capsys.readouterr().err
    (entry,) = kept(out)["training"]["accepted"]
    assert (entry["code"], entry["joint"], entry["recordings"], entry["count"]) == ("spike", "joint2", ["two"], 1)
    assert json.loads(out.with_suffix(".run.json").read_text())["checks"] == kept(out)
    assert main(["show", str(out)]) == 0
    assert "accepted in training: spike of joint2" in capsys.readouterr().out


def test_the_wall_time_of_every_phase_is_printed_and_written(data, tmp_path, capsys, unexamined):
    assert train(data, tmp_path / "a.tauext") == 0
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("a: took ") and " s" in last
    times = json.loads((tmp_path / "a.wall_time_s.json").read_text())
    names = ["read", "check", "prepare", "observe", "fit", "suspects", "gate", "calibrate", "signals", "write"]
    assert list(times) == [f"{name}_s" for name in names]  # recipe observer trains no network
    assert all(seconds >= 0 for seconds in times.values())
    assert float(last.split()[2]) == pytest.approx(sum(times.values()), abs=0.06)


def test_phases_add_up_and_those_of_no_length_are_left_out_of_the_sentence():
    times = WallTimes({"check": 1.25, "gate": 0.0})
    with times.phase("gate"):
        pass
    with pytest.raises(ConfigError), times.phase("write"):
        raise ConfigError("full disk")
    assert list(times.facts()) == ["check_s", "gate_s", "write_s"] and times.facts()["check_s"] == 1.25
    assert times.sentence() == "took 1.3 s: check 1.2"
    assert WallTimes().sentence() == "took 0.0 s"


@pytest.mark.parametrize(
    ("accept", "words"),
    [("spikes", ["'spikes' is no code", *CODES]), ("spike:joint9", ["no joint 'joint9'", "joint1, joint2", "joint6"])],
)
def test_a_code_or_joint_that_does_not_exist_is_refused_with_the_choices(accept, words, data, tmp_path, capsys):
    assert train(data, tmp_path / "a.tauext", "--accept", accept) == 2
    err = capsys.readouterr().err
    assert all(word in err for word in words) and len(err.splitlines()) == 1
    with pytest.raises(ConfigError, match="accept = "):
        recalibrate(tmp_path / "none.tauext", load_dataset(data), tmp_path / "b.tauext", AlarmConfig(), accept=["x"])


def test_the_same_data_are_checked_once_and_other_data_again(data, tmp_path, unexamined):
    def once_more(**settings):
        train_bundle(load_dataset(data), tmp_path / "a.tauext", config=OBSERVER, **settings)
        return len(unexamined)

    assert once_more() == 1 and once_more() == 1
    assert unexamined == [["one", "two", "three"]]
    spoil(data, "three", tau=lambda tau: tau + np.where(np.arange(len(tau))[:, None] == 500, 1e-9, 0.0))
    assert once_more() == 2  # one sample of one recording
    robot = data / "robot.urdf"
    robot.write_text(robot.read_text() + "<!-- -->")
    assert once_more() == 3
    (file,) = [
        f for f in folder().iterdir() if f.stat().st_mtime_ns == max(f.stat().st_mtime_ns for f in folder().iterdir())
    ]
    file.write_text("[{")  # damaged: checked again
    assert once_more() == 4 and once_more() == 4
    assert once_more(check=False) == 4 and "checks" not in json.loads((tmp_path / "a.run.json").read_text())


def test_what_is_remembered_refuses_and_warns_as_what_is_seen(data, tmp_path, unexamined):
    spoil(data, "one", tau=spike)
    messages = []
    for _ in range(2):
        with pytest.raises(FaultyDataError) as caught:
            train_bundle(load_dataset(data), tmp_path / "a.tauext", config=OBSERVER)
        messages.append(str(caught.value))
        assert {finding.code for finding in caught.value.findings} == {"spike"}
    assert messages[0] == messages[1] and len(unexamined) == 1


def test_a_cache_that_cannot_be_written_is_no_error(data, tmp_path, monkeypatch, unexamined):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    for _ in range(2):
        train_bundle(load_dataset(data), tmp_path / "a.tauext", config=OBSERVER)
    assert len(unexamined) == 2


def test_labelled_contacts_are_left_out_and_no_fault(data, tmp_path, capsys):
    file = data / "one.parquet"
    recording = load_recording(file)
    contact = np.zeros(recording.samples, np.int8)
    contact[500:520] = 1
    pushed = recording.tau + 30.0 * contact[:, None]
    save_recording(replace(recording, contact=contact, tau=pushed, provenance={"contacts": "none"}), file)
    assert train(data, tmp_path / "a.tauext", "--recipe", "friction") == 0
    assert not kept(tmp_path / "a.tauext")["training"]["accepted"]


def test_contacts_are_searched_for_beyond_the_share_that_all_checks_read(data, tmp_path, monkeypatch):
    """A push of 0.3 s at the end of one recording, once with a label that comes 0.5 s late, once with the right one."""
    monkeypatch.setattr("tauext.check.before_training.SHARE", ShareRules(moving_s=20.0, recording_s=8.0))
    whole = load_recording(data / "one.parquet")
    push = (whole.time_s > 14.0) & (whole.time_s < 14.3)
    tau = whole.tau + 4 * whole.tau.std(axis=0) * push[:, None]
    for late_s in (0.5, 0.0):
        label = np.roll(push, round(late_s * whole.rate_hz)).astype(np.int8)
        save_recording(replace(whole, contact=label, tau=tau), data / "one.parquet")
        train_bundle(load_dataset(data), tmp_path / f"{late_s}.tauext", config=OBSERVER)
        warned = kept(tmp_path / f"{late_s}.tauext")["training"]["warnings"]
        contacts = [w["evidence"] for w in warned if w["code"] == "contact-in-free-motion"]
        assert len(contacts) == (1 if late_s else 0) and all("at 14." in told for told in contacts)


def test_calibrate_checks_its_recordings_and_keeps_what_training_found(data, tmp_path, capsys, monkeypatch, unexamined):
    """Its 20 s of motion support no limits: no limits are searched for."""
    monkeypatch.setitem(LIMITS, "asked", lambda bundle, motion: {"sentence": "found"})
    spoil(data, "one", tau=spike)
    bundle, out = tmp_path / "a.tauext", tmp_path / "b.tauext"
    assert train(data, bundle, "--accept", "spike") == 0
    spoil(data, "four", tau=spike)
    calibrate = ["calibrate", "--bundle", str(bundle), "--data", str(data), "--out", str(out), "--in-hours", "0.001"]
    capsys.readouterr()
    assert main(calibrate) == 2
    err = capsys.readouterr().err
    assert "spike" in err and "recording four" in err and "recording one" not in err
    assert not list(tmp_path.glob("b*"))
    assert main([*calibrate, "--accept", "spike:joint2"]) == 0
    assert "accepted: spike (joint2)" in capsys.readouterr().err
    checked = kept(out)
    assert [e["recordings"] for e in checked["training"]["accepted"]] == [["one"]]
    assert [e["recordings"] for e in checked["calibration"]["accepted"]] == [["four"]]


def test_training_with_a_promise_checks_the_calibration_recordings_too(data, tmp_path, unexamined):
    spoil(data, "four", tau=spike)
    train_bundle(load_dataset(data), tmp_path / "a.tauext", config=OBSERVER)  # the paper's limits do not use them
    with pytest.raises(FaultyDataError, match="recording four"):
        train_bundle(load_dataset(data), tmp_path / "b.tauext", config=TrainConfig(recipe="observer"))


@pytest.mark.parametrize(
    ("given", "options", "warned"),
    [
        ({}, {"config": OBSERVER}, None),
        ({}, {"config": OBSERVER, "case": "none"}, set()),  # the robot file is held against nobody
        ({}, {"config": replace(OBSERVER, fit_torque_constants=True)}, set()),
        ({"torque": FROM_AMPERES}, {"config": OBSERVER}, {"effort-scale"}),  # training corrects it, and says so
    ],
    ids=["fault", "no model", "constants are found", "constants were given"],
)
def test_half_the_torque_is_a_fault_against_the_model_alone(given, options, warned, data, tmp_path):
    for name in ("one", "two", "three"):
        recording = load_recording(data / f"{name}.parquet")
        half = replace(recording, tau=0.5 * recording.tau, provenance=recording.provenance | given)
        save_recording(half, data / f"{name}.parquet")
    if warned is None:
        with pytest.raises(FaultyDataError, match="effort-scale"):
            train_bundle(load_dataset(data), tmp_path / "a.tauext", **options)
        return
    train_bundle(load_dataset(data), tmp_path / "a.tauext", **options)
    assert {w["code"] for w in kept(tmp_path / "a.tauext")["training"]["warnings"]} >= warned


def test_warnings_are_reported_once_and_faults_of_many_joints_are_accepted_by_their_code():
    heard = Heard()
    many = [Finding("clock-gaps", "warning", None, f"'{k}': gaps", "look", str(k)) for k in range(50)]
    facts = refuse_faults({"training": many}, "data", [], heard)
    assert heard.said == ["warning: clock-gaps: '0': gaps (and 49 more)"]
    (entry,) = facts["training"]["warnings"]
    assert entry["count"] == 50 and len(entry["recordings"]) < 50
    faults = [Finding("effort-sign", "fault", f"joint{j}", "-1", "negate") for j in range(6)]
    with pytest.raises(FaultyDataError) as caught:
        refuse_faults({"training": faults}, "data", [], heard)
    assert str(caught.value).splitlines()[-1].strip() == "--accept effort-sign"
    refuse_faults({"training": faults}, "data", ["effort-sign"], heard)


def moving(seconds: float, still_s: float) -> Recording:
    """A joint that stands, then turns."""
    t_ns = np.arange(round((still_s + seconds) * 10), dtype=np.int64) * 100_000_000
    dq = np.where(t_ns[:, None] * 1e-9 < still_s, 0.0, 1.0)
    zeros = np.zeros_like(dq)
    return Recording("made", ("a",), t_ns, zeros, dq, zeros, 10.0, "instant", "test", "")


def test_a_share_of_every_recording_is_checked_and_all_of_it_where_there_is_little():
    little = [moving(60.0, 10.0), moving(60.0, 0.0)]
    assert shares(little) == little
    much = [moving(0.5 * SHARE.moving_s, 20.0), moving(4 * SHARE.moving_s, 0.0), moving(0.5 * SHARE.moving_s, 5.0)]
    seconds = [float((r.dq[:, 0] != 0).sum() / r.rate_hz) for r in shares(much)]
    assert abs(sum(seconds) - SHARE.moving_s) < 5.0 and min(seconds) > 0.09 * SHARE.moving_s
    assert all(r.t_ns[0] == 0 for r in shares(much))  # so that times are those of the recording


def test_stamps_of_another_unit_leave_rows_enough_to_tell_it():
    good = [moving(60.0, 0.0), moving(60.0, 0.0)]
    slow = [replace(r, t_ns=r.t_ns * 1_000_000, rate_hz=r.rate_hz / 1e6) for r in good]
    assert min(r.samples for r in shares(slow)) >= 200


def test_what_no_training_could_keep_is_refused_before_it_begins(data, tmp_path, capsys, unexamined):
    split = load_dataset(data).split
    save_split(replace(split, calibration=()), data)
    for options, told in (
        (["--limits", "promised"], "needs calibration recordings"),
        (["--minutes", "1e-308"], "must be longer than one sample"),
    ):
        assert train(data, tmp_path / "out" / "a.tauext", *options) == 2
        assert told in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_show_refuses_a_provenance_that_lost_a_key(data, tmp_path, capsys, unexamined):
    assert train(data, tmp_path / "a.tauext", "--recipe", "observer") == 0
    bundle = load_bundle(tmp_path / "a.tauext")
    facts = json.loads(bundle.provenance)
    facts["checks"]["training"]["warnings"] = [{"code": "spike", "joint": None}]
    bundle.provenance = json.dumps(facts)
    bundle.save(str(tmp_path / "b.tauext"))
    capsys.readouterr()
    assert main(["show", str(tmp_path / "b.tauext")]) == 2
    assert "its provenance is damaged" in capsys.readouterr().err
