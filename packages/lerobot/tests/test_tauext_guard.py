# ruff: noqa: E402
"""The guarding robot with the real lerobot and simulated servos: what it sends, and what it leaves alone."""

from __future__ import annotations

import logging
import math

import lerobot_arm as arms
import pytest

pytest.importorskip("lerobot")
make_robot = pytest.importorskip("lerobot.utils.import_utils", exc_type=ImportError)
if not hasattr(make_robot, "register_third_party_plugins"):
    pytest.skip("this lerobot knows no plugins (0.4 and later do)", allow_module_level=True)

from lerobot.robots import RobotConfig, make_robot_from_config
from lerobot_robot_tauext import TauextGuard, TauextGuardConfig, tauext_guard
from mock_arm import NAMES, MockArm, MockArmConfig, Player
from tauext_lerobot.guard import Grip
from tauext_lerobot.make_guard import learned, settings_text

import tauext

SEED, WALL = 101, 120
BEYOND = 40.0
"""Degrees by which the player's goal of the first joint goes on behind the wall."""


@pytest.fixture(scope="module")
def folder(trained, tmp_path_factory):
    """A guard of the simulated arm whose last joint, the wrist, counts as gripper."""
    folder = tmp_path_factory.mktemp("guard")
    bundle = tauext.load_bundle(trained / "arm.tauext")
    settings, notes = learned(bundle, tauext.load_dataset(trained / "data").training(), "wrist", 5.0)
    (folder / "guard.toml").write_text(settings_text(settings, bundle, [trained], 4.0, notes))
    (folder / "arm.toml").write_text((trained / "arm.toml").read_text())
    (folder / "arm.tauext").write_bytes((trained / "arm.tauext").read_bytes())
    return folder


class Clock:
    """Time of the loop, in its place."""

    def __init__(self, period_ns: int = 33_333_333):
        self.now_ns, self.period_ns = 1_000_000_000, period_ns

    def monotonic_ns(self) -> int:
        return self.now_ns


@pytest.fixture
def clock(monkeypatch, caplog):
    caplog.set_level(logging.WARNING)
    clock = Clock()
    monkeypatch.setattr(tauext_guard, "time", clock)
    return clock


def guarding(folder, **settings) -> TauextGuard:
    inner = MockArmConfig(id="inner", calibration_dir=folder / "calibration", wall_at=WALL)
    robot = make_robot_from_config(
        TauextGuardConfig(id="test", calibration_dir=folder / "calibration", robot=inner, guard=folder, **settings)
    )
    assert isinstance(robot, TauextGuard) and isinstance(robot.robot, MockArm)
    robot.connect()
    return robot


def play(robot: TauextGuard, clock: Clock, ticks: int = 240) -> list[tuple[dict, dict, dict]]:
    """Observation, commanded and sent action of each tick; the first joint's goal goes on behind the wall."""
    player, rows = Player(SEED), []
    for k in range(ticks):
        action, seen = player.action(), robot.get_observation()
        if k >= WALL:
            action[NAMES[0]] = rows[WALL - 1][0][NAMES[0]] + BEYOND
        rows.append((seen, action, robot.send_action(action)))
        clock.now_ns += clock.period_ns
    return rows


def words(caplog) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.name.startswith(("lerobot_robot", "tauext_"))]


def test_lerobot_finds_it_by_its_name():
    make_robot.register_third_party_plugins()
    assert RobotConfig.get_choice_class("tauext_guard") is TauextGuardConfig


def test_a_report_writes_nothing_of_its_own(folder, clock, caplog):
    robot = guarding(folder)
    rows = play(robot, clock)
    assert robot.robot.sent == [action for _, action, _ in rows]
    assert list(rows[0][0]) == NAMES and robot.observation_features == robot.robot.observation_features
    assert any("shoulder stalls" in line and line.endswith("; report") for line in words(caplog))


def test_a_limit_is_sent_in_the_tick_that_finds_the_stall_and_only_to_that_joint(folder, clock, caplog):
    robot = guarding(folder, on_stall="limit")
    rows = play(robot, clock)
    count = len(rows)
    assert len(robot.robot.sent) == count + 1  # one more, by the reaction itself
    limited = [k for k, (_, action, sent) in enumerate(rows) if sent != action]
    assert limited and limited == list(range(limited[0], count)) and limited[0] >= WALL + 9
    for k in limited:
        seen, action, sent = rows[k]
        assert sent | {NAMES[0]: None} == action | {NAMES[0]: None}
        assert 0 < sent[NAMES[0]] - seen[NAMES[0]] < 0.5 * BEYOND
    back = dict(robot.get_observation())
    assert robot.send_action(back) == back
    assert any("follows its goal again" in line for line in words(caplog))


def test_a_bus_that_fails_during_the_reaction_is_reported_and_the_next_action_is_limited(
    folder, clock, caplog, monkeypatch
):
    robot = guarding(folder, on_stall="limit")
    send, failed = robot.robot.send_action, []

    def failing(action):
        if action[NAMES[0]] - robot._positions[NAMES[0]] < 0.9 * BEYOND and robot._limits._limits and not failed:
            failed.append(action)
            raise ConnectionError("the port is lost")
        return send(action)

    monkeypatch.setattr(robot.robot, "send_action", failing)
    rows = play(robot, clock)
    assert len(failed) == 1 and len(rows) == 240
    assert any("was not sent (the port is lost)" in line for line in words(caplog))
    _, action, sent = rows[-1]
    assert sent[NAMES[0]] < action[NAMES[0]]
    monkeypatch.setattr(robot.robot, "send_action", lambda action: (_ for _ in ()).throw(ConnectionError("lost")))
    with pytest.raises(ConnectionError):  # the program's own write fails as without a guard
        robot.send_action(action)


@pytest.mark.parametrize("reaction", ["limit", "open"])
def test_a_grip_beyond_the_declared_one_is_limited_or_opened(folder, clock, reaction, monkeypatch):
    robot = guarding(folder, on_grip=reaction, open_at=-80.0)
    object.__setattr__(robot._guard.settings, "grip", Grip("shoulder", 0.3))
    weak = type(robot._guard)(robot._guard._bundle, robot._guard.settings)
    monkeypatch.setattr(robot, "_guard", weak)
    monkeypatch.setattr(robot, "_gripper", NAMES[0])
    monkeypatch.setattr(robot._limits, "_gripper", NAMES[0])
    rows = play(robot, clock)
    seen, action, sent = rows[-1]
    if reaction == "open":
        assert sent[NAMES[0]] == -80.0 and seen[NAMES[0]] < rows[WALL + 5][0][NAMES[0]] - 10
    else:
        assert seen[NAMES[0]] < sent[NAMES[0]] < action[NAMES[0]]


def test_nan_does_not_end_the_program(folder, clock, caplog, monkeypatch):
    robot = guarding(folder, on_stall="limit")
    observe = robot.robot.get_observation
    monkeypatch.setattr(robot.robot, "get_observation", lambda: observe() | {NAMES[1]: math.nan})
    rows = play(robot, clock, ticks=100)
    assert [sent for *_, sent in rows] == [action for _, action, _ in rows]
    assert [line for line in words(caplog) if "nothing is guarded" in line]


def test_a_loop_of_twice_the_rate_is_guarded_and_another_rate_is_reported(folder, clock, caplog):
    clock.period_ns = 33_333_333 // 2
    robot = guarding(folder)
    robot.robot.arm.run, run = lambda: run(0.5 / arms.FPS), robot.robot.arm.run
    play(robot, clock)
    assert any("shoulder stalls" in line for line in words(caplog))
    caplog.clear()
    clock.period_ns = 50_000_000
    robot.connect()
    play(robot, clock, ticks=80)
    (line,) = [line for line in words(caplog) if "no estimate: wrong rate" in line]
    assert line.endswith("; the loop must run at 30 Hz, or at two to four times that")


def test_wrong_settings_are_refused(folder):
    with pytest.raises(ValueError, match="on_stall = 'stop' must be one of report, limit, open"):
        guarding(folder, on_stall="stop")
    with pytest.raises(ValueError, match="open_at = nan must be a finite number"):
        guarding(folder, open_at=math.nan)
    with pytest.raises(tauext.ConfigError, match=r"none/guard.toml: there is no such file; `tauext guard` writes"):
        TauextGuard(TauextGuardConfig(robot=MockArmConfig(), guard=folder / "none"))
