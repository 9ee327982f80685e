"""The leader that feels, with the real lerobot package: found, refused where it must be, torque on the wire."""

from __future__ import annotations

import sys
from dataclasses import dataclass, field
from types import SimpleNamespace

import numpy as np
import pytest

pytestmark = pytest.mark.slow
lerobot = pytest.importorskip("lerobot", reason="needs lerobot of version 0.4 or later")

from lerobot.robots import Robot, RobotConfig  # noqa: E402
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig, make_teleoperator_from_config  # noqa: E402
from lerobot.teleoperators.keyboard import KeyboardTeleopConfig  # noqa: E402, F401
from lerobot.teleoperators.koch_leader import KochLeaderConfig  # noqa: E402, F401
from lerobot.teleoperators.so_leader import SO101LeaderConfig  # noqa: E402, F401
from lerobot_robot_tauext import TauextLeader, TauextLeaderConfig  # noqa: E402
from lerobot_robot_tauext.programs import processors, teleoperate  # noqa: E402
from lerobot_robot_tauext.tauext_leader import radians_a_unit  # noqa: E402
from lerobot_robot_tauext.torque_ports import DamiaoPort, DynamixelPort, torque_port  # noqa: E402
from mock_arm import Plug  # noqa: E402

from tauext.errors import ConfigError  # noqa: E402

JOINTS = ("shoulder", "elbow")


@TeleoperatorConfig.register_subclass("fake_torque_leader")
@dataclass
class FakeTorqueLeaderConfig(TeleoperatorConfig):
    joints: list[str] = field(default_factory=lambda: [*JOINTS, "gripper"])


class FakeTorqueLeader(Plug, Teleoperator):
    """Takes torque through its own send_feedback, and keeps it."""

    config_class, name = FakeTorqueLeaderConfig, "fake_torque_leader"

    def __init__(self, config):
        super().__init__(config)
        self.joints, self.sent, self.q = config.joints, [], 0.0

    @property
    def action_features(self):
        return {f"{joint}.pos": float for joint in self.joints}

    @property
    def feedback_features(self):
        return {f"{joint}.torque": float for joint in self.joints}

    def get_action(self):
        return {f"{joint}.pos": self.q for joint in self.joints}

    def send_feedback(self, feedback):
        self.sent.append(feedback)


@RobotConfig.register_subclass("fake_felt_robot")
@dataclass
class FakeFeltRobotConfig(RobotConfig):
    tau_ext: float = -2.0


class FakeFeltRobot(Plug, Robot):
    """Feels the same at every joint."""

    config_class, name = FakeFeltRobotConfig, "fake_felt_robot"

    def __init__(self, config):
        super().__init__(config)
        self.config, self.actions = config, []

    @property
    def observation_features(self):
        return {f"{joint}.{value}": float for joint in JOINTS for value in ("pos", "tau_ext")}

    @property
    def action_features(self):
        return {f"{joint}.pos": float for joint in (*JOINTS, "gripper")}

    def get_observation(self):
        return {key: self.config.tau_ext if key.endswith("tau_ext") else 0.0 for key in self.observation_features}

    def send_action(self, action):
        self.actions.append(action)
        return action


@pytest.fixture
def leader(tmp_path, monkeypatch):
    """A connected leader whose clock is driven by hand: leader.tick(seconds)."""
    import lerobot_robot_tauext.tauext_leader as module

    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(module.time, "monotonic", lambda: clock.now)
    felt = {"dead_band_nm": 0.2, "cap_nm": 0.5, "slew_nm_s": 100.0, "gain": 1.0, "tank_j": 1.0}
    config = wrapping(tmp_path, "fake_torque_leader", **felt)
    made = make_teleoperator_from_config(config)
    made.connect()
    made.tick = lambda seconds=0.02: setattr(clock, "now", clock.now + seconds)
    yield made
    made.disconnect()


def wrapping(tmp_path, kind: str, options: dict | None = None, **settings) -> TauextLeaderConfig:
    """A tauext leader around one of a type."""
    leader = {"type": kind, "calibration_dir": str(tmp_path)} | (options or {})
    return TauextLeaderConfig(leader=leader, calibration_dir=tmp_path, **settings)


def observation(tau: float, **more: float) -> dict[str, float]:
    return {f"{joint}.tau_ext": tau for joint in JOINTS} | {"contact": 0.0} | more


def test_it_is_found_by_its_type_and_wraps_what_its_options_say(leader):
    assert TeleoperatorConfig.get_choice_class("tauext_leader") is TauextLeaderConfig
    assert isinstance(leader, TauextLeader) and isinstance(leader.leader, FakeTorqueLeader)
    assert leader.action_features == leader.leader.action_features
    assert leader.feedback_features == {f"{joint}.tau_ext": float for joint in JOINTS}  # no gripper


def test_beyond_the_dead_band_it_is_felt_in_its_direction_up_to_the_cap(leader):
    for tau, torque in [(0.1, 0.0), (0.5, 0.3), (-0.5, -0.3), (9.0, 0.5)]:
        leader.tick()
        leader.get_action()
        assert leader.send_feedback(observation(tau)) == pytest.approx(dict.fromkeys(JOINTS, torque))
        assert leader.leader.sent[-1] == pytest.approx({f"{joint}.torque": torque for joint in JOINTS})


def test_its_own_standard_error_widens_the_dead_band(leader):
    leader.get_action()
    sent = leader.send_feedback(observation(0.5, **{"shoulder.tau_ext_sigma": 0.05}))
    assert sent == pytest.approx({"shoulder": 0.1, "elbow": 0.3})  # 8 x 0.05, and the 0.2 that is given


def test_nan_silence_and_the_end_take_the_torque_away(leader):
    leader.get_action()
    assert leader.send_feedback(observation(0.5))["elbow"] == pytest.approx(0.3)
    leader.tick()
    assert leader.send_feedback(observation(np.nan))["elbow"] == 0.0
    leader.send_feedback(observation(0.5))
    leader.tick()
    assert leader.send_feedback(observation(0.5))["elbow"] == pytest.approx(0.3)
    leader.tick()
    assert leader.send_feedback(observation(0.5, contact=-1.0))["elbow"] == 0.0
    leader.tick()
    assert leader.send_feedback(observation(0.5, collision=1.0))["elbow"] == pytest.approx(0.3)
    leader.tick(0.1)
    leader.get_action()
    assert leader.leader.sent[-1]["elbow.torque"] == pytest.approx(0.3)
    leader.tick(0.2)
    leader.get_action()
    assert leader.leader.sent[-1]["elbow.torque"] == 0.0
    leader.send_feedback(observation(0.5))
    leader.disconnect()
    assert leader.leader.sent[-1] == {f"{joint}.torque": 0.0 for joint in JOINTS} and not leader.is_connected


def test_a_follower_that_tells_nothing_is_refused_at_the_first_tick(leader):
    leader.get_action()
    with pytest.raises(ConfigError, match="has no shoulder.tau_ext: use a robot that observes it"):
        leader.send_feedback({"shoulder.pos": 0.0})
    leader.config.dead_band_nm = None
    with pytest.raises(ConfigError, match="set dead_band_nm"):
        leader.send_feedback(observation(0.5))


@pytest.mark.parametrize(
    "options, said",
    [
        ({}, "leader needs a type"),
        ({"type": "tauext_leader"}, "cannot wrap itself"),
        ({"type": "koch_leader"}, "Missing required field"),
        ({"type": "no_such"}, "Couldn't find a choice class for 'no_such'"),
        ({"type": "so101_leader", "port": "/dev/none"}, "so_leader cannot take torque: its servos accept positions"),
    ],
)
def test_leaders_that_cannot_feel_are_refused(options, said, tmp_path):
    with pytest.raises(ConfigError, match=said):
        TauextLeader(TauextLeaderConfig(leader=options, calibration_dir=tmp_path))


def test_a_joint_that_is_not_there_is_refused(tmp_path):
    config = wrapping(tmp_path, "koch_leader", {"port": "/dev/none"}, joints=["knee"])
    with pytest.raises(ConfigError, match="has no motor 'knee'.*shoulder_pan"):
        TauextLeader(config)


def koch_bus(tmp_path, written: list[bytes]):
    """The bus of a Koch leader whose port keeps what is written."""
    leader = TauextLeader(wrapping(tmp_path, "koch_leader", {"port": "/dev/none"}))
    bus = leader.leader.bus
    bus.port_handler.is_open = True
    bus.port_handler.clearPort = lambda: None
    bus.port_handler.writePort = lambda packet: written.append(bytes(packet)) or len(packet)
    return leader, bus


def test_goal_currents_of_a_koch_leader_byte_by_byte(tmp_path):
    """Sync write of protocol 2.0 to register 102, two bytes each, in steps of 1 mA: 0.0146 N m are 100 mA."""
    written: list[bytes] = []
    leader, bus = koch_bus(tmp_path, written)
    assert leader._joints == ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
    port = DynamixelPort(bus, ("shoulder_pan", "elbow_flex"), None)
    port._written_s = port._now()
    constant = 0.215 / 1.47
    port.write({"shoulder_pan": 0.1 * constant, "elbow_flex": -0.003 * constant})
    (packet,) = written
    assert packet[:4] == b"\xff\xff\xfd\x00" and packet[4] == 0xFE and packet[7] == 0x83
    assert packet[8:12] == bytes([102, 0, 2, 0])
    assert packet[12:18] == bytes([1, 100, 0, 3, 0xFD, 0xFF])


def test_the_watchdog_is_set_before_the_first_current_and_after_a_pause(tmp_path):
    written: list[bytes] = []
    leader, bus = koch_bus(tmp_path, written)
    told: list[tuple] = []
    bus.write = lambda register, joint, value: told.append((register, joint, value))
    bus.enable_torque = lambda joints: told.append(("on", tuple(joints)))
    bus.disable_torque = lambda joints: told.append(("off", tuple(joints)))
    clock = SimpleNamespace(now=0.0)
    port = DynamixelPort(bus, ("elbow_flex",), None, now=lambda: clock.now)
    port.begin()
    set_again = [("Bus_Watchdog", "elbow_flex", 0), ("Bus_Watchdog", "elbow_flex", 10)]
    assert told == [("off", ("elbow_flex",)), ("Operating_Mode", "elbow_flex", 0), ("on", ("elbow_flex",)), *set_again]
    told.clear()
    for _ in range(5):  # one that is collected lets its motors go: the leader must live on
        clock.now += 0.02
        port.write({"elbow_flex": 0.01})
    assert not told
    clock.now += 1.0
    port.write({"elbow_flex": 0.01})
    assert told == set_again
    port.end()
    assert (
        told[-2:] == [("Bus_Watchdog", "elbow_flex", 0), ("off", ("elbow_flex",))]
        and written[-1][12:15] == b"\x03\x00\x00"
    )


def test_positions_of_calibrated_ranges_become_radians():
    motors = {"a": ("range_m100_100", 1024, 3072), "b": ("range_0_100", 0, 2048), "c": ("degrees", 0, 4095)}
    bus = SimpleNamespace(
        motors={name: SimpleNamespace(norm_mode=mode, model="xl330-m077") for name, (mode, _, _) in motors.items()},
        calibration={name: SimpleNamespace(range_min=low, range_max=high) for name, (_, low, high) in motors.items()},
        model_resolution_table={"xl330-m077": 4096},
    )
    leader = SimpleNamespace(bus=bus)
    found = radians_a_unit(leader, ("a", "b", "c"), "deg")
    assert found == pytest.approx({"a": np.pi / 200, "b": np.pi / 100, "c": np.pi / 180})
    bus.calibration.clear()
    with pytest.raises(ConfigError, match="'a' reports its position as a share of a range that is not calibrated"):
        radians_a_unit(leader, ("a",), "deg")


def test_lerobots_own_loop_makes_the_leader_feel(tmp_path):
    from lerobot.scripts.lerobot_teleoperate import teleop_loop

    config = wrapping(tmp_path, "fake_torque_leader", dead_band_nm=0.2, cap_nm=0.1, slew_nm_s=100.0)
    leader, robot = TauextLeader(config), FakeFeltRobot(FakeFeltRobotConfig(calibration_dir=tmp_path))
    leader.connect()
    step, robot_action, robot_observation = processors()
    teleop_loop(leader, robot, 50, step, robot_action, robot_observation, duration=0.2)
    assert leader.leader.sent[-1] == pytest.approx({f"{joint}.torque": -0.1 for joint in JOINTS})
    assert robot.actions and set(robot.actions[0]) == {"shoulder.pos", "elbow.pos", "gripper.pos"}
    ticks = len(leader.leader.sent)
    leader.disconnect()
    assert leader.leader.sent[ticks] == {f"{joint}.torque": 0.0 for joint in JOINTS}
    teleop_loop(leader, robot, 50, step, robot_action, robot_observation, duration=0.05)
    assert len(leader.leader.sent) == ticks + 1  # one that is not connected is told nothing


def test_the_program_is_lerobots_with_the_step(tmp_path, monkeypatch):
    from lerobot.scripts import lerobot_teleoperate as program

    made = []

    def make(config):
        made.append(make_teleoperator_from_config(config))
        return made[-1]

    monkeypatch.setattr(program, "make_default_processors", program.make_default_processors)  # put back afterwards
    monkeypatch.setattr(program, "make_teleoperator_from_config", make)
    leader = f"{{type: fake_torque_leader, calibration_dir: {tmp_path}}}"
    options = [f"--teleop.leader={leader}", "--teleop.dead_band_nm=0.2", f"--teleop.calibration_dir={tmp_path}"]
    options += ["--robot.type=fake_felt_robot", f"--robot.calibration_dir={tmp_path}", "--teleop_time_s=0.2"]
    monkeypatch.setattr(sys, "argv", ["lerobot-tauext-teleoperate", "--teleop.type=tauext_leader", *options])
    teleoperate()
    assert made[0].leader.sent[-2]["shoulder.torque"] < 0 == made[0].leader.sent[-1]["shoulder.torque"]


def heard(wire) -> list[tuple[int, str]]:
    """Ids and bytes of the frames since the last call."""
    return [(frame.arbitration_id, bytes(frame.data).hex(" ")) for frame in iter(lambda: wire.recv(0), None)]


def test_torque_alone_goes_to_damiao_motors_byte_by_byte():
    """LeRobot's own bus on python-can's virtual one: no stiffness, no damping, 12 bits of torque from -10 to 10 N m."""
    can = pytest.importorskip("can")
    from lerobot.motors import Motor, MotorNormMode
    from lerobot.motors.damiao import DamiaoMotorsBus

    motors = {
        name: Motor(k + 1, "dm4310", MotorNormMode.DEGREES, motor_type_str="dm4310", recv_id=0x11 + k)
        for k, name in enumerate((*JOINTS, "gripper"))
    }
    bus = DamiaoMotorsBus("tauext-leader", motors, can_interface="virtual", use_can_fd=False)
    with can.interface.Bus("tauext-leader", interface="virtual") as wire:
        bus.connect(handshake=False)
        leader = SimpleNamespace(name="openarm_leader", feedback_features={}, bus=bus)
        port = torque_port(leader, [], None)
        assert isinstance(port, DamiaoPort) and port.joints == JOINTS  # no gripper
        port.begin()
        still = [(1, "7f ff 7f f0 00 00 07 ff"), (2, "7f ff 7f f0 00 00 07 ff")]
        assert heard(wire) == [(1, "ff ff ff ff ff ff ff fc"), (2, "ff ff ff ff ff ff ff fc"), *still]
        port.write({"shoulder": 1.0, "elbow": -10.0})
        assert heard(wire) == [(1, "7f ff 7f f0 00 00 08 cc"), (2, "7f ff 7f f0 00 00 00 00")]
        port.end()
        assert heard(wire) == [*still, (1, "ff ff ff ff ff ff ff fd"), (2, "ff ff ff ff ff ff ff fd")]
        bus.disconnect(disable_torque=False)
