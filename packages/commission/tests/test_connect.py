"""A live stream is judged in words, and the arm's description written: what fits, what is wrong, what must wait."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from made_live import ScriptedSource
from tauext_commission.connect import (
    REMEDIES,
    TOPICS,
    another_arm,
    as_data,
    as_entries,
    connect,
    facts_of_data,
    judge,
    provenance_of,
    recording_of,
    settled,
    write_arm,
)
from tauext_lab.sim.arms import ARMS
from tauext_lab.sim.source import KINDS, DrivenArm, SimSource, write_robot_file

from tauext import _core
from tauext.data.assemble import assemble
from tauext.data.importers.open_raw import open_raw
from tauext.data.recording_file import save_recording
from tauext.data.servo import AMPERES, FROM_AMPERES, servo_facts, servo_settings, settings_by_type
from tauext.errors import ConfigError, RobotError
from tauext.monitor.source import Sample, SourceFacts, SourceSettings
from tauext.robot.write import is_placeholder

FACTS, SEVEN = KINDS["rig"].facts(), KINDS["seven"].facts()
MS = 1_000_000


@pytest.fixture(scope="module")
def samples() -> list[Sample]:
    """35 s of the rig."""
    arm = DrivenArm(ARMS["rig"](), 1)
    rows = [arm.step() for _ in range(35_000)]
    return [Sample(k * MS, q, dq, tau, 0) for k, (q, dq, tau, _) in enumerate(rows)]


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    return write_robot_file("rig", tmp_path_factory.mktemp("robot"))


def judged(samples, robot=None, facts=FACTS, **changed) -> dict:
    """What is said of these samples, by code; changed: factors on their signals."""
    changed = {name: np.asarray(factor) for name, factor in changed.items()}
    made = [replace(one, **{name: getattr(one, name) * factor for name, factor in changed.items()}) for one in samples]
    recording, missing = recording_of(made, facts)
    lives = [*missing, *judge([recording] if recording else [], robot, facts)]
    assert not any("at import" in live.remedy or "arm.toml" in live.remedy for live in lives)
    return {live.code: live for live in lives}


@pytest.mark.slow
def test_a_good_stream_is_confirmed_topic_by_topic(samples, robot):
    found = judged(samples, robot)
    assert set(TOPICS) <= set(found) and {found[topic].severity for topic in TOPICS} == {"good"}
    assert "agrees with friction, inertia and gravity after" in found["sign"].words
    assert "a torque in N m" in found["signal"].words and found["joints"].words == "2 joints: joint1, joint2"
    assert not any(live.severity in ("fault", "warning") for live in found.values())


@pytest.mark.slow
def test_early_topics_wait_for_motion_and_nothing_is_a_fault(samples, robot):
    found = judged(samples[:2000], robot)
    assert found["sign"].waits and found["robot-file"].waits and found["rate"].severity == "good"
    still = [replace(one, q=samples[0].q, dq=0 * one.dq) for one in samples[:3000]]
    for topics, source in ((("sign", "signal", "robot-file", "units"), judged(still, robot)), (TOPICS, judged([]))):
        assert all(source[topic].waits and source[topic].remedy is not None for topic in topics)
        assert not any(live.severity == "fault" for live in source.values())


def test_without_a_robot_file_the_sign_is_judged_by_friction_alone(samples):
    found = judged(samples, facts=replace(FACTS, signal="unknown"))
    assert "friction and inertia after" in found["sign"].words
    assert "--robot" in found["robot-file"].remedy and "only a robot file can confirm" in found["signal"].words


@pytest.mark.parametrize(
    ("changed", "code", "severity", "words"),
    [
        ({"tau": [1, -1]}, "effort-sign", "fault", "must be positive where the motor drives"),
        ({"tau": [0.08, 0.11]}, "effort-scale", "fault", "training finds the torque constants"),
        ({"dq": [-1, -1]}, "velocity-sign", "fault", "in the driver"),
        ({"q": 180 / np.pi, "dq": 180 / np.pi}, "degrees", "fault", "in the driver"),
    ],
)
def test_a_wrong_stream_is_a_fault_with_a_remedy_within_ten_seconds_of_motion(
    samples, robot, changed, code, severity, words
):
    found = judged(samples[:12_000], robot, **changed)
    assert found[code].severity == severity and words in found[code].remedy, found[code]
    spoiled = next(topic for topic, codes in TOPICS.items() if code in codes)
    assert spoiled not in found, "a topic is good beside a fault of it"
    assert json.loads(json.dumps(as_entries(found.values())))[0].keys() == {
        "code", "severity", "joint", "words", "remedy", "waits",
    }  # fmt: skip


def test_a_joint_that_moves_too_little_is_not_judged_by_its_torque(samples, robot):
    """Beside one that moves."""
    held = [replace(one, q=one.q * [1, 0.01], dq=one.dq * [1, 0.01]) for one in samples[:12_000]]
    found = judged(held, robot, tau=[-1, -1])
    assert found["effort-sign"].joint == "joint1" and found["excitation-low"].joint == "joint2"
    lives = judge([recording_of(held, FACTS)[0]], robot, FACTS)
    assert not any(live.joint == "joint2" and not live.waits for live in lives)


def test_an_unknown_effort_that_gravity_shows_to_be_a_current_becomes_one(samples, robot):
    unknown = replace(FACTS, signal="unknown")
    lives = judged(samples[:12_000], robot, unknown, tau=[0.08, 0.11]).values()
    known = settled(unknown, lives)
    assert known.signal == "current" and known.settings.torque_units == ("A", "A")
    assert provenance_of(known) == {"torque": AMPERES} and provenance_of(unknown) == {}
    found = judged(samples[:12_000], robot, known, tau=[0.08, 0.11])
    assert not any(live.severity == "fault" for live in found.values())
    assert settled(unknown, []) is unknown and settled(FACTS, lives) is FACTS


def test_lost_samples_another_rate_and_missing_numbers_are_named(samples):
    assert (
        "1.0% of the samples are lost"
        in judged([s for k, s in enumerate(samples[:5000]) if k % 100])["clock-gaps"].words
    )
    slower = [replace(one, t_ns=one.t_ns * 11 // 10) for one in samples[:5000]]
    assert "909.1 samples a second came, 1000 were described" in judged(slower)["wrong-rate"].words
    assert "500 samples a second came, 1000" in judged(samples[:5000:2])["wrong-rate"].words
    broken = [replace(one, dq=np.array([one.dq[0], np.nan])) for one in samples[:1000]]
    live = judged(broken)["not-measured"]
    assert (live.joint, live.words) == ("joint2", "its velocity is not a number in 100% of the samples")


def test_samples_without_sense_are_left_out(samples):
    some = [*samples[:10], samples[3], replace(samples[11], q=np.array([np.inf, 0])), *samples[12:20]]
    recording, lives = recording_of(some, FACTS)
    assert recording.samples == 18 and not lives
    assert recording_of(samples[:1], FACTS)[0] is None


@pytest.mark.parametrize("made, share", [(lambda t, k: 7, "100%"), (lambda t, k: t - 3600 * 10**9 * (k >= 600), "40%")])
def test_a_clock_that_stands_still_or_is_set_back_is_the_one_fault(samples, robot, made, share):
    some = [replace(one, t_ns=made(one.t_ns, k)) for k, one in enumerate(samples[:1000])]
    recording, lives = recording_of(some, FACTS)
    lives += judge([recording] if recording else [], robot, FACTS)
    (fault,) = [live for live in lives if live.severity in ("fault", "warning")]
    assert (fault.code, share in fault.words) == ("clock-irregular", True)


def test_a_wrapped_stream_is_judged_as_the_continuous_one(samples, robot):
    """The seam lies within the range of both joints."""
    seam = np.median([one.q for one in samples], axis=0)
    wrapped = [replace(one, q=(one.q - seam) % (2 * np.pi) + seam) for one in samples]
    assert np.ptp([one.q for one in wrapped], axis=0).min() > 6
    assert judged(wrapped, robot) == judged(samples, robot)


# --- The first look.


class Silent(ScriptedSource):
    def describe(self, wait_s, robot=None):
        return FACTS


def test_connect_describes_looks_and_closes(samples):
    source = SimSource("rig", 1, None)
    connected = connect(lambda: source)
    assert connected.facts == source.facts and source._process is not None and not source._process.is_alive()
    assert {live.code for live in connected.lives} >= {"joints", "rate", "sign"}
    noted = Silent(samples[:50])
    noted.describe = lambda wait_s, robot: replace(FACTS, notes=("left out: gripper",))
    assert connect(lambda: noted).lives[-1].words == "left out: gripper" and noted.closed == 1


def test_an_arm_that_is_silent_or_cannot_describe_itself_is_refused_and_closed():
    silent = Silent([lambda: False])
    with pytest.raises(ConfigError, match="script: no sample within 0.2 s: it is silent"):
        connect(lambda: silent, wait_s=0.2)
    assert silent.closed == 1
    with pytest.raises(ConfigError, match="cannot describe itself"):
        connect(lambda: ScriptedSource([]))


# --- The description.


def servo_facts_of(types: list[str], torque_from: str = "duty") -> SourceFacts:
    servo, known = settings_by_type(types, ("pan", "lift"), torque_from, 100.0)
    settings = SourceSettings(("pan", "lift"), 10_000_000, ("N m" if known else "A",) * 2, "held", servo)
    return SourceFacts(settings, "duty" if torque_from == "duty" else "current", True, ("a note",))


ALL = {
    "torque": FACTS,
    "current": replace(FACTS, signal="current", settings=replace(FACTS.settings, torque_units=("A", "A"))),
    "servo": servo_facts_of(["sts3215-7.4v", "sts3215-12v"]),
    "unknown servo": servo_facts_of(["", "sts3215-7.4v"]),
    "phase current": servo_facts_of(["xl330-m288"] * 2, "phase-current"),
}


@pytest.mark.parametrize("facts", ALL.values(), ids=ALL)
def test_facts_survive_json_and_damage_is_refused(facts):
    data = json.loads(json.dumps(as_data(facts)))
    again = facts_of_data(data)
    assert as_data(again) == as_data(facts) and another_arm(facts, again) is None
    for key in data:
        with pytest.raises(ConfigError, match="the description of the arm is damaged"):
            facts_of_data({name: value for name, value in data.items() if name != key})
    with pytest.raises(ConfigError, match="damaged"):
        facts_of_data(data | {"period_ns": "often"})


def test_another_arm_is_a_fault_with_another_folder_as_its_remedy():
    live = another_arm(FACTS, SEVEN)
    assert live.severity == "fault" and live.words.startswith("the source does not match this folder: it has joints")
    assert live.remedy == "restore it, or use another --out"


@pytest.mark.parametrize("facts", ALL.values(), ids=ALL)
def test_the_description_is_an_arm_toml_that_says_the_same(facts, tmp_path):
    arm = write_arm(facts, None, tmp_path)
    assert arm.robot.joints == facts.settings.joints and arm.time.rate_hz == 1e9 / facts.settings.period_ns
    assert is_placeholder(tmp_path / "robot.urdf") and arm.model is None
    servo = facts.settings.servo
    if servo is None:
        assert arm.signals["tau"].unit == ("A" if facts.signal == "current" else "Nm")
        assert arm.signals["tau"].timing == facts.settings.torque_timing
    else:
        made = servo_facts(servo_settings(arm, arm.time.rate_hz, np.zeros((0, 2))))
        for one, other in zip(made.pop("joints"), (said := servo_facts(servo)).pop("joints"), strict=True):
            assert one == pytest.approx(other, rel=1e-12)
        assert made == said
        assert provenance_of(facts)["torque"] == (FROM_AMPERES if facts.settings.torque_units[0] == "N m" else AMPERES)


def test_the_robot_file_is_copied_with_its_shapes_and_an_existing_description_stays(samples, robot, tmp_path):
    arm = write_arm(FACTS, robot, tmp_path)
    assert arm.model == tmp_path / "robot.xml" and (tmp_path / "robot.shapes.json").exists()
    before = (tmp_path / "arm.toml").read_bytes()
    assert write_arm(SEVEN, None, tmp_path).robot.joints == FACTS.settings.joints
    assert (tmp_path / "arm.toml").read_bytes() == before
    recording, _ = recording_of(samples[:3000], FACTS)
    save_recording(recording, tmp_path / "seg-000001.parquet")
    (source,) = open_raw(tmp_path / "seg-000001.parquet", arm.topics)
    (again,) = assemble(source, arm)
    np.testing.assert_array_equal(again.tau, recording.tau)
    np.testing.assert_array_equal(again.q, recording.q)


def test_a_robot_file_without_the_joints_leaves_no_description(robot, tmp_path):
    with pytest.raises(RobotError, match="joint3"):
        write_arm(SEVEN, robot, tmp_path)
    assert not (tmp_path / "arm.toml").exists()
    with pytest.raises(RobotError):
        write_arm(FACTS, tmp_path / "missing.urdf", tmp_path)


def test_a_robot_file_that_fails_late_leaves_nothing_for_the_next_one(robot, tmp_path, monkeypatch):
    def unreadable(source, folder):
        raise RobotError("a mesh cannot be read")

    folder = tmp_path / "cell"
    folder.mkdir()
    with monkeypatch.context() as patched:
        patched.setattr("tauext_commission.connect.write_shapes", unreadable)
        with pytest.raises(RobotError, match="mesh"):
            write_arm(FACTS, robot, folder)
    assert list(folder.iterdir()) == []
    write_arm(FACTS, robot, folder)
    assert (folder / "arm.toml").exists()


def test_own_remedies_are_of_known_codes():
    from tauext.check.finding import codes

    assert set(REMEDIES) <= set(codes())
    own = {"not-measured", "wrong-rate"}
    assert {code for listed in TOPICS.values() for code in listed} <= set(codes()) | own
    assert _core.TorqueFrom.duty.name == "duty"
