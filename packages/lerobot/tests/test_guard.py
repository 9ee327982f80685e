"""The guard against stalls, on simulated servos: what it reports, limits and refuses; and `tauext guard`."""

from __future__ import annotations

import io
import json
import math
import re
from contextlib import redirect_stdout
from dataclasses import replace
from types import SimpleNamespace

import lerobot_arm as arms
import numpy as np
import pytest
from tauext_lerobot import make_guard
from tauext_lerobot.calibration import motors_of
from tauext_lerobot.guard import (
    BLIND_S,
    HOLD_S,
    RELEASE_S,
    STILL_RAD,
    Grip,
    Guard,
    GuardSettings,
    StallRule,
    Usual,
    held_at_rest,
    load_guard,
    watch,
)
from tauext_lerobot.guard_limits import Limits
from tauext_lerobot.make_guard import described, expect_motion, grip_of, learned, settings_text

import tauext
from tauext.cli import main
from tauext.data.importing import import_dataset
from tauext.errors import ConfigError

PERIOD_NS = 33_333_333
WALL_FRAME = 150


MOTORS = ("shoulder", "elbow", "gripper")


def write_dataset(folder, seeds, frames, wall=False):
    return arms.write_dataset(folder, arms.episodes(seeds, frames, wall=wall), "v3.0", motors=MOTORS)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with the dataset `free` and what `tauext guard` makes of it, and the lines that the command prints."""
    folder = tmp_path_factory.mktemp("made")
    write_dataset(folder / "free", range(2), 900)
    printed = io.StringIO()
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(printed):
        patch.setattr(make_guard, "LEAST_MINUTES", 0.5)
        patch.setattr("tauext.check.before_training.examine", lambda recordings, robot: SimpleNamespace(findings=[]))
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        status = main(f"guard --source {folder / 'free'} --out {folder / 'guard'}".split())
    assert status == 0
    return folder, printed.getvalue()


def recorded(folder, arm):
    """The recordings of a LeRobot dataset."""
    import_dataset([folder], arm, folder.with_suffix(".data"), "tauext", lambda _: None)
    return tauext.load_dataset(folder.with_suffix(".data")).recordings("train")


@pytest.fixture(scope="module")
def recordings(made, tmp_path_factory):
    """Free motion, and the same with a wall in front of the first joint from WALL_FRAME on, outside the training."""
    folder = tmp_path_factory.mktemp("stalls")
    arm = (made[0] / "guard/arm.toml").read_text()
    found = {}
    for name, wall in (("free", False), ("walls", True)):
        write_dataset(folder / name, range(40, 43), 2 * WALL_FRAME, wall)
        (folder / "arm.toml").write_text(arm.replace('train = ["free"]', f'train = ["{name}"]'))
        found[name] = recorded(folder / name, folder / "arm.toml")
    return found


@pytest.fixture(scope="module")
def guarded(made):
    """Bundle and settings, without a gripper."""
    bundle, _, settings = load_guard(made[0] / "guard")
    return bundle, replace(settings, grip=None)


def stalls(events):
    return [(event.kind, event.joint) for event in events if event.kind in ("stall", "grip")]


def test_a_joint_at_the_wall_stalls_and_free_motion_does_not(guarded, recordings):
    for free in recordings["free"]:
        assert watch(*guarded, free) == []
    found = 0
    for walls in recordings["walls"]:
        events = watch(*guarded, walls)
        assert set(stalls(events)) <= {("stall", "shoulder")}
        # Independent of the bundle: the goal is far beyond a joint that rests.
        ahead = np.abs(walls.q_des - walls.q)[:, 0]
        rests = held_at_rest(ahead[WALL_FRAME:, None], walls.q[WALL_FRAME:, :1], walls.rate_hz, HOLD_S + 0.1)
        if rests[0] > 0.25:
            found += 1
            assert events and (events[0].t_ns - walls.t_ns[WALL_FRAME]) * 1e-9 >= HOLD_S
            assert events[0].torque > events[0].most > 0
    assert found >= 1


def test_a_declared_grip_is_no_stall_and_a_stronger_one_is_reported_as_grip(guarded, recordings):
    bundle, settings = guarded
    (walls,) = [one for one in recordings["walls"] if stalls(watch(bundle, settings, one))][:1]
    strong = watch(bundle, settings, walls)[0].torque
    for most, expected in ((2 * strong, []), (0.2 * strong, [("grip", "shoulder")])):
        declared = replace(settings, grip=Grip("shoulder", most))
        assert stalls(watch(bundle, declared, walls))[:1] == expected


@pytest.mark.parametrize("signal", ["q", "dq", "tau"])
def test_nan_is_reported_as_no_guard_and_never_as_a_stall(guarded, recordings, signal):
    (free, *_) = recordings["free"]
    values = getattr(free, signal).copy()
    first, last = 100, 100 + math.ceil((BLIND_S + 0.5) * 30)
    values[first:last, 1] = math.nan
    guard, events = Guard(*guarded), []
    columns = {"q": free.q, "dq": free.dq, "tau": free.tau} | {signal: values}
    for k, row in enumerate(zip(free.t_ns.tolist(), *columns.values(), strict=True)):
        events += [(k, event) for event in guard.step(*row)]
    assert [event.kind for _, event in events] == ["blind", "guards"]
    (blind, event), (again, _) = events
    assert first + 30 * BLIND_S <= blind <= last and last <= again <= last + 45
    assert "not finite" in str(event) and "nothing is guarded" in str(event)


def shifted(t_ns, row, jump):
    """Stamps that go back or ahead by an hour from this row on, or stand still for ten seconds."""
    t_ns = t_ns.copy()
    if jump == "stop":
        t_ns[row:] = np.maximum(t_ns[row:] - 10_000_000_000, t_ns[row - 1])
    else:
        t_ns[row:] += 3_600_000_000_000 * (1 if jump == "ahead" else -1)
    return t_ns


@pytest.mark.parametrize("jump", ["back", "ahead", "stop"])
def test_a_guard_counts_its_times_in_samples_where_the_stamps_jump(guarded, recordings, jump):
    """A stall ends and is found again, and blindness is reported, as without the jump: not an hour later."""
    (free, *_) = recordings["free"]
    q, tau = np.repeat(free.q[:1], 600, axis=0), np.repeat(free.tau[:1], 600, axis=0)
    guard = Guard(*guarded)
    guard._rule.step = lambda t_ns, q, over: np.array([stalls[k], *[False] * (len(guard.joints) - 1)])
    stalls = np.zeros(600, bool)
    stalls[100:120] = stalls[200:220] = True
    t_ns, events = shifted(np.arange(600) * PERIOD_NS, 110, jump), []
    tau[300:] = np.nan
    for k in range(600):
        events += [(k, event.kind) for event in guard.step(int(t_ns[k]), q[k], np.zeros_like(q[k]), tau[k])]
    kinds = [kind for k, kind in events if kind in ("stall", "over")]
    assert kinds == ["stall", "over", "stall", "over"]
    over = [k for k, kind in events if kind == "over"]
    assert all(abs(k - end - 30 * RELEASE_S) <= 2 for k, end in zip(over, (119, 219), strict=True))
    (blind,) = [k for k, kind in events if kind == "blind"]  # where stamps stand still, 100 samples later
    assert 200 < blind <= 300 + 30 * BLIND_S + 2


def test_a_stall_needs_its_time_at_one_place():
    """Against a rule by hand, on random runs over the limit with a travel that now and then exceeds STILL_RAD."""
    rng, hold = np.random.default_rng(0), 9
    rule = StallRule(1, hold * PERIOD_NS)
    over = np.repeat(rng.random(60) < 0.7, 5)
    q = np.cumsum(np.where(rng.random(300) < 0.05, 1.5 * STILL_RAD, 0.0))
    expected, begun = [], 0
    for k in range(300):
        if not over[k] or k == 0 or not over[k - 1] or abs(q[k] - q[begun]) > STILL_RAD:
            begun = k
        expected.append(bool(over[k] and k - begun >= hold))
    found = [bool(rule.step(k * PERIOD_NS, q[k : k + 1], over[k : k + 1])[0]) for k in range(300)]
    assert found == expected and any(found) and not all(found)


def test_held_at_rest_is_the_least_of_a_window_without_motion():
    q = np.concatenate([np.linspace(0, 1, 50), np.ones(50), np.linspace(1, 2, 50)])[:, None]
    torque = np.full((150, 1), 5.0)
    torque[55:95] = 2.0
    torque[70:72] = 9.0
    assert held_at_rest(torque, q, 30.0).tolist() == [2.0]
    assert held_at_rest(torque, np.linspace(0, 3, 150)[:, None], 30.0).tolist() == [0.0]
    assert held_at_rest(torque[:5], q[:5], 30.0).tolist() == [0.0]


def test_settings_that_do_not_fit_the_bundle_are_refused(guarded):
    bundle, settings = guarded
    with pytest.raises(ConfigError, match=r"\[grip\] joint = 'claw' must be one of .*: shoulder, elbow, gripper"):
        Guard(bundle, replace(settings, grip=Grip("claw", 1.0)))
    with pytest.raises(ConfigError, match=r"\[joints\] names claw; it must name shoulder, elbow, gripper"):
        Guard(bundle, GuardSettings({"claw": Usual(0.1, 0.2)}))


# --- Limited goals.


def limits(gripper: str = "") -> Limits:
    return Limits({"elbow": "elbow.pos", "gripper": "gripper.pos"}, gripper, 100.0)


def test_a_stalled_joint_keeps_its_share_of_the_way_until_it_is_commanded_back():
    one = limits()
    one.begin("elbow", 0.1, {"elbow.pos": 50.0}, {"elbow.pos": 10.0}, opens=False)
    assert one.passed({"elbow.pos": 60.0, "pan.pos": 3.0}, {"elbow.pos": 10.0}) == {"elbow.pos": 14.0, "pan.pos": 3.0}
    for goal, sent in (
        (60.0, 34.0),  # it yields: the goal moves along
        (math.nan, 30.0),
        (5.0, 5.0),  # past the position, between two ticks
        (60.0, 60.0),
    ):
        assert one.passed({"elbow.pos": goal}, {"elbow.pos": 30.0}) == {"elbow.pos": sent}


@pytest.mark.parametrize("lacking", [{}, {"elbow.pos": math.nan}])
def test_a_goal_or_position_that_is_unknown_changes_nothing_unsafe(lacking):
    one = limits()
    one.begin("elbow", 0.1, lacking, {"elbow.pos": 10.0}, opens=False)
    sent = one.passed({"elbow.pos": 60.0}, {"elbow.pos": 10.0})
    assert sent == {"elbow.pos": 10.0}


def test_an_opened_gripper_stays_open_until_it_is_commanded_to_open():
    one = limits("gripper.pos")
    one.begin("gripper", 0.5, {"gripper.pos": 0.0}, {"gripper.pos": 20.0}, opens=True)
    for goal, position, sent in ((0, 20, 100), (0, 60, 100), (0, 99, 100), (25, 99, 25), (0, 25, 0)):
        assert one.passed({"gripper.pos": goal}, {"gripper.pos": position}) == {"gripper.pos": sent}


# --- The command.


def test_the_command_makes_a_folder_that_guards(made, monkeypatch, capsys):
    folder, printed = made
    assert "gripper: nothing is gripped in the data; a quarter of the servo's stall torque is used" in printed
    motor = arms.MOTOR
    quarter = 0.25 * motor.most_duty * motor.volts / motor.ohm * motor.nm_per_ampere
    bundle, arm, settings = load_guard(folder / "guard")
    assert settings.grip == Grip("gripper", pytest.approx(quarter, rel=1e-3))
    assert arm.robot.joints == MOTORS and settings.hold_s == HOLD_S
    assert all(0 < usual.held < usual.largest for usual in settings.joints.values())
    assert sorted(path.name for path in (folder / "guard").iterdir()) == [
        "arm.run.json", "arm.tauext", "arm.toml", "arm.wall_time_s.json", "guard.toml",
    ]  # fmt: skip
    before = (folder / "guard/guard.toml").read_text()
    monkeypatch.setattr(make_guard, "LEAST_MINUTES", 0.0)
    assert main(f"guard --source {folder / 'free'} --out {folder / 'guard'}".split()) == 2  # not overwritten
    assert "is not empty" in capsys.readouterr().err and (folder / "guard/guard.toml").read_text() == before


def test_files_that_a_given_arm_toml_names_are_found_from_its_place_and_kept(made, tmp_path, monkeypatch):
    def trained(dataset, out, **_):
        out.write_bytes((made[0] / "guard/arm.tauext").read_bytes())
        return tauext.load_bundle(out)

    monkeypatch.setattr("tauext.train.stage.train_bundle", trained)
    monkeypatch.setattr(make_guard, "LEAST_MINUTES", 0.0)
    write_dataset(tmp_path / "free", range(2), 90)
    (tmp_path / "arm").mkdir()
    text = (made[0] / "guard/arm.toml").read_text().replace("[robot]", '[robot]\ncalibration = "../motors.json"')
    (tmp_path / "arm/arm.toml").write_text(text)
    motors = {name.replace("wrist", "gripper"): one for name, one in arms.calibration().items()}
    (tmp_path / "motors.json").write_text(json.dumps(motors))
    paths = f"--source {tmp_path / 'free'} --arm {tmp_path / 'arm/arm.toml'} --out {tmp_path / 'guard'}"
    assert main(f"guard {paths} --gripper none".split()) == 0
    (tmp_path / "motors.json").unlink()
    _, arm, settings = load_guard(tmp_path / "guard")
    assert [motor.name for motor in motors_of(arm)] == list(MOTORS) and settings.grip is None


@pytest.mark.parametrize(
    ("held", "moving", "stall", "grip"),
    [
        (0.9, 0.2, 3.3, 0.9),
        (0.9, 0.2, math.nan, 0.9),
        (2.5, 0.2, 3.3, 1.65),  # as strong as that is a stall
        (0.3, 0.2, 3.3, 0.825),  # friction holds as much
        (0.3, math.nan, 3.3, 0.825),  # it never moves
    ],
)
def test_the_declared_grip_is_the_strongest_of_the_data_within_half_of_the_stall_torque(held, moving, stall, grip):
    samples = np.full(20, moving)[: 20 * math.isfinite(moving)]
    assert grip_of(held, samples, stall)[0] == pytest.approx(grip)
    with pytest.raises(ConfigError, match="its stall torque is unknown: set --at-most-nm"):
        grip_of(0.1, np.full(20, 0.2), math.nan)


def test_a_stall_in_the_data_is_named(guarded, recordings):
    walls = [one for one in recordings["walls"] if stalls(watch(*guarded, one))]
    settings, notes = learned(guarded[0], walls, "", None)
    assert "warning: shoulder holds" in notes[0] and "leave the recording out" in notes[0]
    assert learned(guarded[0], walls, "shoulder", 0.7)[0].grip == Grip("shoulder", 0.7)
    assert learned(guarded[0], recordings["free"], "gripper", None)[1][0].startswith("gripper: nothing is gripped")


@pytest.mark.parametrize(
    ("words", "error"),
    [
        ("--source free", "0.1 minutes of motion are too few for a guard; record at least 5, better 10"),
        ("--source free --gripper claw", "--gripper claw: must be one of shoulder, elbow, gripper, or none"),
        ("--source free --at-most-nm 0", "at-most-nm = 0.0 must be > 0"),
        ("--source nothing", "nothing: is no LeRobot dataset"),
        ("--source log.csv", "log.csv: is no LeRobot dataset (it has no meta/info.json); describe other recordings"),
        ("--source free --arm none.toml", "none.toml: there is no such file"),
        ("--source free --arm arm.toml --calibration c.json", "--calibration goes without --arm"),
        ("--source free --calibration c.json", "c.json: there is no such LeRobot calibration file"),
    ],
)
def test_bad_input_is_refused_in_one_line_and_nothing_is_left(words, error, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    if "claw" in words:
        monkeypatch.setattr(make_guard, "LEAST_MINUTES", 0.0)
    write_dataset(tmp_path / "free", range(2), 90)
    (tmp_path / "log.csv").write_text("t,q\n0,1\n")
    (tmp_path / "arm.toml").write_text(arms.ARM.replace("UNIT", "deg"))
    assert main(f"guard {words} --out guard".split()) == 2
    printed = capsys.readouterr().err
    assert error in printed and printed.count("\n") == 1
    assert not (tmp_path / "guard").exists() and not (tmp_path / "guard.part").exists()


def write_radians(folder):
    """An arm that moves by 42 degrees: 0.7 rad, and 0.7 degrees are less than the usual motion of any arm."""
    episodes = [(state * math.pi / 180, action * math.pi / 180) for state, action in arms.episodes(range(2), 90)]
    return arms.write_dataset(folder, episodes, "v3.0", motors=MOTORS)


def test_the_command_writes_no_guard_of_radians_that_are_taken_for_degrees(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(make_guard, "LEAST_MINUTES", 0.0)
    write_radians(tmp_path / "free")
    assert main(f"guard --source {tmp_path / 'free'} --out {tmp_path / 'guard'}".split()) == 2
    printed = capsys.readouterr().err
    assert re.search(r"covers [01]\.\d+ deg, must be more than 6\.3 deg; .*check the unit of q", printed), printed
    assert printed.count("\n") == 1 and not (tmp_path / "guard").exists()


@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_motion_in_the_declared_unit_is_accepted(unit, tmp_path):
    folder = write_radians(tmp_path / "free") if unit == "rad" else write_dataset(tmp_path / "free", range(2), 90)
    text = arms.ARM.replace("UNIT", unit).replace("wrist", "gripper")
    (tmp_path / "arm.toml").write_text(f'{text}[split]\ntrain = ["free"]\n')
    expect_motion(recorded(folder, tmp_path / "arm.toml"), [folder])


def info(folder, names=None, **changes):
    """Change entries of a dataset, and names of elements by feature."""
    path = folder / "meta/info.json"
    content = json.loads(path.read_text()) | changes
    for feature, of_elements in (names or {}).items():
        content["features"][feature]["names"] = of_elements
    path.write_text(json.dumps(content))


def test_the_description_follows_from_the_dataset(tmp_path):
    folder = write_dataset(tmp_path / "free", range(1), 60)
    text = described([folder], normalised=False)
    assert 'joints = ["shoulder", "elbow", "gripper"]' in text and 'torque_from = "goal"' in text
    assert 'type = "sts3215-7.4v"' in text and 'unit = "deg"' in text
    info(folder, robot_type="koch_follower")
    text = described([folder], normalised=True)
    assert "type =" not in text and 'unit = "normalised"' in text and 'calibration = "calibration.json"' in text


@pytest.mark.parametrize(("sign", "source"), [(1, "supply-current"), (-1, "phase-current")])
def test_a_current_is_preferred_and_its_sign_names_its_kind(tmp_path, sign, source):
    state, action = arms.episodes(range(1), 60)[0]
    wide = np.hstack([state, np.abs(state) * sign]).astype(np.float32)
    motors = ["a.pos", "b.pos", "c.pos"]
    folder = arms.write_dataset(tmp_path / "wide", [(wide, wide)], "v3.0", motors=("a", "b", "c", "d", "e", "f"))
    names = [*motors, "a.current", "b.current", "c.current"]
    info(folder, {"observation.state": names, "action": [*motors, "x", "y", "z"]})
    text = described([folder], normalised=False)
    assert f'torque_from = "{source}"' in text
    assert '[signals.current]\ncolumns = "observation.state[{joint}.current]"' in text
    info(folder, {"action": ["u", "v", "w", "x", "y", "z"]})
    with pytest.raises(ConfigError, match="share no joint; describe the dataset with --arm"):
        described([folder], normalised=False)


def test_guard_toml_is_read_back_and_a_wrong_key_is_refused(guarded, made, tmp_path):
    bundle, settings = guarded
    settings = replace(settings, grip=Grip("gripper", 0.4))
    bundle.save(str(tmp_path / "arm.tauext"))
    (tmp_path / "arm.toml").write_text((made[0] / "guard/arm.toml").read_text())
    text = settings_text(settings, bundle, [tmp_path], 10.0, ["a note"])
    (tmp_path / "guard.toml").write_text(text)
    again = load_guard(tmp_path)[2]
    assert again.grip == settings.grip and again.joints.keys() == settings.joints.keys()
    for wrong, error in (
        (text.replace("at_most_nm", "most_nm"), r"\[grip\] unknown key 'most_nm'"),
        (text.replace("hold_s = 0.3", "hold_s = 0"), "hold_s"),
        (text.replace("held", "help"), r"\[joints.shoulder\] unknown key 'help'"),
        (text.replace('"shoulder" =', '"claw" ='), "claw"),
    ):
        (tmp_path / "guard.toml").write_text(wrong)
        with pytest.raises(ConfigError, match=error):
            Guard(bundle, load_guard(tmp_path)[2])
