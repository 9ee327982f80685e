"""Damiao motors on python-can's virtual bus: frames out and in, by the manual of the DM-J4310."""

from __future__ import annotations

import struct
import sys
import threading
from dataclasses import replace
from uuid import uuid4

import numpy as np
import pytest
from made_servo_bus import PATIENCE_S, first_notes, first_sample, servo_settings, taken
from tauext_lerobot.damiao import CanBus, CanMotor, DamiaoSource, can_bus

from tauext.errors import ConfigError
from tauext.monitor.cell_file import load_cell
from tauext.monitor.source import SourceSettings, Stoppable

can = pytest.importorskip("can")
RANGES = (12.5, 30.0, 10.0)
KNOWN = (CanMotor("pan", 1, 0x11, ranges=RANGES), CanMotor("lift", 2, 0x12, ranges=RANGES))
UNITS = ("N m", "N m")
WAIT_S = 20.0
"""For what must come, however busy the machine is."""


class Motors:
    """Two motors that answer questions as the manual says; their states are what the test sets, 8 bytes each."""

    def __init__(self):
        self.channel = f"made {uuid4()}"
        self.bus = can.Bus(interface="virtual", channel=self.channel)
        self.states = {1: state_of(1), 2: state_of(2)}
        self.silent: set[int] = set()
        self.asked: list[tuple[int, bytes]] = []
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def say(self, id_: int, data: bytes) -> None:
        self.bus.send(can.Message(arbitration_id=0x10 + id_, data=data, is_extended_id=False))

    def close(self) -> None:
        self._end.set()
        self._thread.join(5)
        self.bus.shutdown()

    def _work(self) -> None:
        while not self._end.is_set():
            if (message := self.bus.recv(0.05)) is None:
                continue
            data = bytes(message.data)
            self.asked.append((message.arbitration_id, data))
            id_ = data[0]
            if message.arbitration_id != 0x7FF or id_ in self.silent or id_ not in self.states:
                continue
            if data[2] == 0xCC:
                self.say(id_, self.states[id_])
            elif data[2] == 0x33:
                self.say(id_, data[:4] + struct.pack("<f", dict(zip((21, 22, 23), RANGES, strict=True))[data[3]]))


def state_of(id_: int, status: int = 1, position=0x8000, speed=0x800, torque=0x800, celsius=35) -> bytes:
    """D[0] id and status, 16 bits position, 12 speed, 12 torque, degC of bridge and windings."""
    packed = position << 24 | speed << 12 | torque
    return bytes([status << 4 | id_]) + packed.to_bytes(5, "big") + bytes([30, celsius])


@pytest.fixture
def motors():
    made = Motors()
    yield made
    made.close()


def source_of(motors: Motors, *changed: CanMotor, **settings) -> DamiaoSource:
    known = {"pan": CanMotor("pan", 1, 0x11), "lift": CanMotor("lift", 2, 0x12)} | {one.name: one for one in changed}
    source = DamiaoSource(motors.channel, CanBus(known, "virtual", **settings))
    source.answer_s = PATIENCE_S
    return source


def open_it(source: DamiaoSource, period_ns: int = 5_000_000) -> None:
    source.open(SourceSettings(("pan", "lift"), period_ns, UNITS))


def test_questions_are_the_only_frames_that_are_sent(motors):
    source = source_of(motors)
    open_it(source)
    taken(source, 3)
    source.close()
    ranges = [(0x7FF, bytes([id_, 0, 0x33, register, 0, 0, 0, 0])) for id_ in (1, 2) for register in (21, 22, 23)]
    assert motors.asked[:6] == ranges
    assert set(motors.asked[6:]) == {(0x7FF, bytes([id_, 0, 0xCC, 0, 0, 0, 0, 0])) for id_ in (1, 2)}
    assert not isinstance(source, Stoppable)


def test_a_state_is_taken_bit_by_bit(motors):
    # All of the position, no speed: -VMAX, all of the torque.
    motors.states[1] = bytes.fromhex("11 ff ff 00 0f ff 1e 2a")
    motors.states[2] = bytes.fromhex("12 00 00 ff f0 00 1e 2b")
    source = source_of(motors)
    open_it(source)
    one = first_sample(source)
    assert one.q.tolist() == [12.5, -12.5] and one.dq.tolist() == [-30.0, 30.0] and one.tau.tolist() == [10.0, -10.0]
    assert one.temperature.tolist() == [42.0, 43.0] and one.q_des is None and one.current is None


def test_a_state_between_the_ends_is_linear(motors):
    rng = np.random.default_rng(5)
    for _ in range(5):
        numbers = [int(rng.integers(0, 1 << bits)) for bits in (16, 12, 12)]
        motors.states[1] = state_of(1, 1, *numbers)
        source = source_of(motors, CanMotor("pan", 1, 0x11, 0.5, -1))
        open_it(source)
        one = first_sample(source)
        q, dq, tau = (
            -end + 2 * end * k / (2**bits - 1) for end, k, bits in zip(RANGES, numbers, (16, 12, 12), strict=True)
        )
        assert (one.q[0], one.dq[0], one.tau[0]) == pytest.approx((-(q - 0.5), -dq, -tau), abs=1e-12)


def test_a_motor_that_drops_out_is_named_and_its_samples_are_refused(motors):
    source = source_of(motors)
    open_it(source)
    taken(source, 2)
    motors.silent, source.answer_s = {2}, 0.02
    told = first_notes(source)
    assert told[0] == "motor 0x02 (lift) does not answer: no sample until it does" and source.counts.refused >= 5
    motors.silent, source.answer_s = set(), PATIENCE_S
    taken(source, 3)
    source.close()
    assert any("motor 0x02 (lift) answers again" in text for text in told + source.notes())


def test_faults_are_reported_and_other_frames_are_not_taken_for_states(motors):
    source = source_of(motors)
    open_it(source)
    taken(source, 1)
    motors.states[1] = state_of(1, 0xE)
    motors.say(1, bytes([1, 0, 0x33, 21]) + struct.pack("<f", 12.5))  # somebody else's question for a register
    motors.say(1, b"\x11\x00")
    motors.say(7, state_of(7))
    for one in taken(source, 10):
        assert abs(one.q[0]) < 1e-3
    assert source.notes() == ["motor 0x01 (pan) reports: overload"]
    motors.states[1] = state_of(1, 0)
    taken(source, 10)
    source.close()
    assert source.notes() == ["motor 0x01 (pan) reports no error"]


def test_answers_to_another_program_are_overheard_and_nothing_is_sent(motors):
    source = source_of(motors, *KNOWN, ask=False)
    open_it(source)
    for k in range(4):
        motors.say(1, state_of(1, position=1000 * k))
        if k != 2:  # lost
            motors.say(2, state_of(2, position=1000 * k))
    positions = [np.rint((one.q + 12.5) / 25 * 65535).tolist() for one in taken(source, 3)]
    source.close()
    assert positions == [[0, 0], [1000, 1000], [3000, 3000]] and source.counts.refused == 1
    assert motors.asked == []


def test_a_motor_that_is_not_there_and_what_cannot_fit_is_refused(motors):
    motors.silent = {2}
    usual = SourceSettings(("pan", "lift"), 5_000_000, UNITS)
    for settings, message in (
        (usual, r"motor 0x02 \(lift\) does not answer: check its power, its id and its answer id"),
        (replace(usual, joints=("elbow",)), "joint 'elbow' of the bundle is missing; the file has pan, lift"),
        (replace(usual, torque_units=("A", "A")), "reports torque in N m, the bundle takes A, A"),
        (servo_settings(2, "phase_current"), "reports torque, the bundle takes its torque from phase-current"),
    ):
        with pytest.raises(ConfigError, match=message):
            source_of(motors).open(settings)
    with pytest.raises(ConfigError, match="damiao can99: .*; is the interface up"):
        open_it(DamiaoSource("can99", CanBus(dict(source_of(motors)._of_bus.joints))))


def test_a_library_that_is_not_installed_names_its_extra(monkeypatch, motors):
    monkeypatch.setitem(sys.modules, "can", None)
    with pytest.raises(ConfigError, match=r"pip install 'python-can'"):
        open_it(source_of(motors))


def test_a_bus_file_is_read(tmp_path):
    path = tmp_path / "cell.toml"
    path.write_text(
        "[bus]\nfd_baud = 5000000\nask = false\n[bus.joints.a]\nid = 0x01\nranges = [12.5, 30, 10]\n"
        "[bus.joints.b]\nid = 2\nanswer_id = 0\nsign = -1\nzero_rad = 0.3\nranges = [12.5, 45, 54]\n"
    )
    file = can_bus(load_cell(path))
    assert file.joints["a"] == CanMotor("a", 1, 0x11, 0.0, 1, (12.5, 30.0, 10.0))
    assert file.joints["b"] == CanMotor("b", 2, 0, 0.3, -1, (12.5, 45.0, 54.0))
    assert (file.interface, file.baud, file.fd_baud, file.ask) == ("socketcan", 1_000_000, 5_000_000, False)


CAN_BUS = [
    ("[bus]\n", "joints is missing"),
    ("[bus]\n[bus.joints.a]\n", r"\[bus.joints.a\] id is missing"),
    ("[bus]\n[bus.joints.a]\nid = 0x7ff\n", "id = 2047 must be a whole number from 1 to 2046"),
    ("[bus]\n[bus.joints.a]\nid = 1\nsign = 2\n", "sign = 2 must be one of 1, -1"),
    ("[bus]\n[bus.joints.a]\nid = 1\nrange = 2\n", ".bus.joints.a. unknown key 'range'; the nearest known is 'ranges'"),
    ("[bus]\n[bus.joints.a]\nid = 1\nranges = 2\n", r"ranges = 2 must be a list of 3, each .*, \[PMAX, VMAX, TMAX\]"),
    ("[bus]\nask = false\n[bus.joints.a]\nid = 1\n", r"ranges = \[PMAX, VMAX, TMAX\] is missing: with ask = false"),
    ("[bus]\nask = 1\n[bus.joints.a]\nid = 1\n", "ask = 1 must be true or false"),
    (
        "[bus]\n[bus.joints.a]\nid = 1\n[bus.joints.b]\nid = 0x21\nanswer_id = 0x11\n",
        "joints 'a' and 'b' cannot be distinguished",
    ),
]


@pytest.mark.parametrize("text, message", CAN_BUS)
def test_a_file_that_breaks_a_rule_says_which(tmp_path, text, message):
    path = tmp_path / "file.toml"
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        can_bus(load_cell(path))


@pytest.mark.parametrize("ask", [True, False])
def test_damiao_motors_are_timed_or_overheard(motors, ask):
    if ask:
        facts = source_of(motors).describe(WAIT_S)
        assert facts.settings.period_ns in (1_000_000, 2_000_000, 5_000_000, 10_000_000, 20_000_000)
        motors.silent.add(2)
        silent = source_of(motors)
        silent.answer_s = 0.05
        with pytest.raises(ConfigError, match="motor 0x02 .* does not answer"):
            silent.describe(0.5)
    else:
        ended = threading.Event()

        def other_program() -> None:
            while not ended.wait(0.01):
                for id_ in (1, 2):
                    motors.say(id_, state_of(id_))

        threading.Thread(target=other_program, daemon=True).start()
        facts = source_of(motors, *KNOWN, ask=False).describe(WAIT_S)
        ended.set()
        assert 5_000_000 < facts.settings.period_ns < 50_000_000 and not motors.asked
    assert facts.settings.joints == ("pan", "lift") and facts.settings.torque_units == UNITS
    assert facts.signal == "torque" and facts.temperature
