"""Sources describe themselves before a bundle exists, each on its stand-in; a lost one is replaced by a new object."""

from __future__ import annotations

import time
from dataclasses import replace

import pytest
from made_bundles import pushed
from made_live import ScriptedSource, samples_of
from tauext_commission import lasting
from tauext_commission.lasting import LastingSource

from tauext import _core
from tauext.data.servo import AMPERES, FROM_AMPERES, servo_facts
from tauext.errors import ConfigError, RobotError
from tauext.monitor.source import Describes, SourceFacts, SourceSettings
from tauext.robot.write import write_placeholder
from tauext.sources.describing import chosen_joints, joint_names, learnt_period_ns, nominal_period_ns, why_another
from tauext.sources.franka import FrankaSource
from tauext.sources.replay import ReplaySource
from tauext.sources.ur import JOINTS as UR_JOINTS
from tauext.sources.ur import UrSource

WAIT_S = 20.0
"""For what must come, however busy the machine is."""


# --- Robots of known makers.


@pytest.mark.parametrize(("period_s", "rate_hz"), [(0.002, 500), (0.008, 125)])
def test_a_ur_has_six_known_joints_currents_and_its_controllers_rate(ur, period_s, rate_hz):
    ur.period_s = period_s
    source = UrSource("10.0.0.2")
    assert isinstance(source, Describes)
    facts = source.describe(WAIT_S)
    assert facts.settings == SourceSettings(UR_JOINTS, round(1e9 / rate_hz), ("A",) * 6, "held")
    assert facts.signal == "current" and facts.temperature and not facts.notes
    assert ur.asked["frequency"] == -1.0  # the controller's own
    source.open(facts.settings)
    assert source.next_sample(WAIT_S).q.shape == (6,) and ur.asked["frequency"] == rate_hz
    source.close()


def test_a_ur_with_torque_constants_gives_newton_metres_and_they_must_fit_its_names(ur, tmp_path):
    constants = tmp_path / "constants.toml"
    constants.write_text("[nm_per_ampere]\n" + "".join(f"{name} = 10\n" for name in UR_JOINTS))
    facts = UrSource("h", constants).describe(WAIT_S)
    assert set(facts.settings.torque_units) == {"N m"} and facts.signal == "current"
    with pytest.raises(ConfigError, match="unknown key"):
        UrSource("h", constants).describe(WAIT_S, write_placeholder([f"cell_{name}" for name in UR_JOINTS], tmp_path))


def test_an_arm_that_is_off_or_silent_is_refused_in_words_and_can_be_tried_again(ur):
    ur.reachable = False
    with pytest.raises(ConfigError, match="ur h: Timeout connecting to UR"):
        UrSource("h").describe(0.5)
    ur.reachable, ur.period_s = True, 0.0
    with pytest.raises(ConfigError, match="0 samples came; 21 are needed"):
        UrSource("h").describe(0.05)
    ur.period_s = 0.002
    assert UrSource("h").describe(WAIT_S).settings.period_ns == 2_000_000


def test_a_franka_is_known_and_takes_the_prefix_of_its_robot_file(franka, tmp_path):
    names = [f"fr3_joint{k}" for k in range(1, 8)]
    facts = FrankaSource("h").describe(WAIT_S, write_placeholder([*names, "fr3_finger_joint1"], tmp_path))
    assert facts.settings == SourceSettings(tuple(names), 1_000_000, ("N m",) * 7, "instant")
    assert FrankaSource("h").describe(WAIT_S).settings.joints == tuple(f"joint{k}" for k in range(1, 8))
    franka.reachable = False
    with pytest.raises(ConfigError, match="Connection timeout"):
        FrankaSource("h").describe(WAIT_S)


def test_names_come_from_the_robot_file_and_another_arms_file_is_refused(tmp_path):
    def file(*names: str):
        return write_placeholder(names, tmp_path)

    assert joint_names(("a", "b"), None, "arm") == (("a", "b"), ())
    assert joint_names(("a", "b"), file("r_a", "left_a", "left_b"), "arm")[0] == ("left_a", "left_b")
    names, notes = joint_names(("a", "b"), file("hip", "knee", "gripper_joint"), "arm")
    assert names == ("hip", "knee") and "in the order of robot.urdf: hip, knee" in notes[0]
    with pytest.raises(ConfigError, match="arm has 2 joints, robot.urdf has 3: x, y, z"):
        joint_names(("a", "b"), file("x", "y", "z"), "arm")
    with pytest.raises(RobotError):
        joint_names(("a", "b"), tmp_path / "missing.urdf", "arm")
    assert chosen_joints(["b", "gripper", "a"], None, "arm") == (("b", "a"), ("left out: gripper",))
    assert chosen_joints(["b", "gripper", "a"], file("a", "b", "gripper"), "arm")[0] == ("a", "b")
    assert chosen_joints(["gripper"], None, "arm") == (("gripper",), ())
    with pytest.raises(ConfigError, match="none of which robot.urdf has"):
        chosen_joints(["b"], file("x"), "arm")
    with pytest.raises(
        ConfigError, match="robot.urdf's elbow and arm's joint3 match no joint; perhaps 'joint3' is 'elbow'"
    ):
        chosen_joints(["a", "joint3", "c"], file("a", "elbow", "c"), "arm")
    assert chosen_joints(["a"], file("a", "lift"), "arm")[1] == (
        "not in the stream, held at the robot file's rest position: lift",
    )


def test_rates_are_learnt_in_spite_of_gaps_and_jitter():
    stamps = [round(k * 2e6 + (k % 3) * 2e5) for k in range(40) if k % 7]
    assert learnt_period_ns(stamps, "arm") == 2_000_000
    assert nominal_period_ns(1e9 / 83) == round(1e9 / 83) and nominal_period_ns(1e9 / 499) == 2_000_000
    with pytest.raises(ConfigError, match="3 samples came"):
        learnt_period_ns([0, 1, 2, 1], "arm")
    with pytest.raises(ConfigError, match="30 samples came, and their time stamps rose 0 times: their clock"):
        learnt_period_ns([5] * 30, "arm")


# --- Recordings.


def test_a_recording_describes_itself_by_its_file():
    recording = pushed(seconds=0.2)
    facts = ReplaySource(recording).describe(0.0)
    period_ns = round(1e9 / recording.rate_hz)
    assert facts.settings == SourceSettings(recording.joints, period_ns, ("N m",) * 2, recording.torque_timing)
    assert facts.signal == "torque"
    ReplaySource(recording).open(facts.settings)
    for torque, unit in ((AMPERES, "A"), (FROM_AMPERES, "N m")):
        facts = ReplaySource(replace(recording, provenance={"torque": torque})).describe(0.0)
        assert facts.signal == "current" and set(facts.settings.torque_units) == {unit}
    servo = _core.ServoSettings(_core.TorqueFrom.duty, [_core.ServoConstants()] * 2, 0, period_ns)
    facts = ReplaySource(replace(recording, provenance={"servo": servo_facts(servo)})).describe(0.0)
    assert facts.signal == "duty" and servo_facts(facts.settings.servo) == servo_facts(servo)


# --- What lasts.


FACTS = SourceFacts(SourceSettings(("a", "b"), 1_000_000, ("N m", "N m"), "held"), "torque", False)


class Describing(ScriptedSource):
    """A script that says what it is."""

    def __init__(self, script, facts=FACTS, opens=True):
        super().__init__(script)
        self.facts, self.opens = facts, opens

    def describe(self, wait_s, robot=None):
        return self.facts

    def open(self, settings):
        if not self.opens:
            raise ConfigError("the cable is out")
        super().open(settings)


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(lasting, "RETRY_S", 0.01)
    monkeypatch.setattr(lasting, "LONGEST_RETRY_S", 0.02)


class Broken(Describing):
    """Its library raises at the end of a dead link."""

    def close(self):
        super().close()
        raise ValueError("shutdown on a dead link")


def test_a_source_that_ends_is_replaced_and_its_counts_go_on(quick):
    samples = samples_of(pushed(seconds=0.2))
    first, second = Broken(samples[:3]), Describing(samples[3:6])
    first.counts.lost, second.counts.lost = 2, 3
    others = [ConfigError("still booting"), RuntimeError("of a library"), second]
    other_arm = replace(FACTS, settings=replace(FACTS.settings, joints=("a", "c")))

    def again():
        if isinstance(one := others.pop(0) if others else Describing([], other_arm), Exception):
            raise one
        return one

    source = LastingSource(first, again, FACTS)
    source.open(FACTS.settings)
    came, notes, until = [], [], time.monotonic() + WAIT_S
    while "does not match" not in source.away and time.monotonic() < until:
        if (sample := source.next_sample(0.01)) is not None:
            came.append(sample.t_ns)
        notes += source.notes()
    assert came == [one.t_ns for one in samples[:6]] and not source.ended and source.counts.lost == 5
    assert [note.partition("script ")[2] for note in notes[:4]] == [
        "is away: it has ended; it is tried again",
        "is away: still booting",
        "is away: of a library",
        "is back",
    ]
    assert source.away == "the source does not match this folder: it has joints a, c, not a, b"
    assert source.next_sample(0.01) is None
    with pytest.raises(RuntimeError, match="is away"):
        source.stop()
    source.close()
    assert source.ended and first.closed and second.closed


def test_after_a_silence_a_source_must_still_have_the_rate_of_its_arm(monkeypatch):
    """Sources that connect again by themselves are not described again."""
    samples = samples_of(pushed(seconds=0.5))
    monkeypatch.setattr(lasting, "SILENT_S", 0.05)

    def silence():
        time.sleep(2 * lasting.SILENT_S)
        return True

    slower = [replace(one, t_ns=4 * one.t_ns) for one in samples]
    script = [*samples[:10], silence, *slower[10:100], silence, *samples[400:450]]
    source = LastingSource(Describing(script), lambda: Describing([]), FACTS)
    source.open(FACTS.settings)
    came, notes, why = [], [], set()
    while source._source.script:
        if (sample := source.next_sample(0.01)) is not None:
            came.append(sample.t_ns)
        why.add(source.away)
        notes += source.notes()
    assert came == [one.t_ns for one in [*samples[:10], *samples[420:450]]]
    other = "the source does not match this folder: it has 250 samples a second, not 1000"
    assert other in why and source.away == ""
    assert notes == [f"script is away: {other}", "script is back"] and source.counts.refused == 110
    source.close()


def test_an_arm_that_was_away_at_the_start_must_show_its_rate_first():
    samples = samples_of(pushed(seconds=0.1))
    source = LastingSource(Describing(samples), lambda: Describing([]), FACTS, is_described=False)
    source.open(FACTS.settings)
    came = [source.next_sample(0.01) for _ in samples]
    assert [one is not None for one in came] == [k >= 20 for k in range(100)]
    source.close()


def test_a_source_that_cannot_be_opened_is_tried_again_and_its_replacement_closed_with_it(quick):
    second = Describing(samples_of(pushed(seconds=0.2)))
    source = LastingSource(Describing([], opens=False), lambda: second, FACTS)
    source.open(FACTS.settings)
    assert source.away == "the cable is out"
    until = time.monotonic() + WAIT_S
    while source.next_sample(0.01) is None:
        assert time.monotonic() < until
    assert source.away == ""
    source._last_ns = time.monotonic_ns() - 5_000_000_000
    assert source.away == "no sample for 5 s"
    with pytest.raises(ConfigError, match="takes no commands"):
        source.command("push")
    with pytest.raises(ConfigError, match="cannot stop its robot"):
        source.check_stop()
    source.close()
    source.close()
    assert second.closed == 1


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"joints": ("a",)}, "it has joints a, not a, b"),
        ({"period_ns": 1_020_000}, ""),
        ({"period_ns": 2_000_000}, "500 samples a second, not 1000"),
        ({"torque_units": ("A", "A")}, "its torque is in A, A, not N m, N m"),
        ({"torque_timing": "instant"}, "its torque is instant, not held"),
        (
            {"servo": _core.ServoSettings(_core.TorqueFrom.duty, [_core.ServoConstants()] * 2, 0, 1_000_000)},
            "servos are",
        ),
        ({"servo": _core.ServoSettings()}, ""),
    ],
)
def test_another_arm_is_named_by_what_differs(changed, words):
    why = why_another(FACTS, replace(FACTS, settings=replace(FACTS.settings, **changed)))
    assert words in why and bool(why) == bool(words)
