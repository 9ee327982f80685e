"""Sources of serial servos on a mocked bus, through the vendors' packet handlers: bytes by the manuals, and faults."""

from __future__ import annotations

import math
import os
import struct
import subprocess
import sys
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from made_live import Keeper
from made_servo_bus import (
    NAMES,
    Dynamixel,
    Feetech,
    MadeServoBus,
    bus_file,
    crc16,
    first_notes,
    first_sample,
    patient,
    servo_bundle,
    servo_settings,
    sts3215,
    taken,
    x_series,
)
from tauext_lerobot.bus_source import REPORTED_AFTER
from tauext_lerobot.servo import ServoSource
from tauext_lerobot.servo_bus_file import ServoJoint
from tauext_lerobot.servo_series import DYNAMIXEL, FEETECH

from tauext import _core
from tauext.data.recording import TURN
from tauext.data.servo_types import SERVO_TYPES
from tauext.errors import ConfigError
from tauext.monitor.cell_file import Cell, Reaction
from tauext.monitor.loop import Loop, LoopSettings
from tauext.monitor.reactions import start_reactions
from tauext.monitor.source import Stoppable
from tauext.sources.describing import why_another
from tauext.sources.open import open_source

pytest.importorskip("scservo_sdk")
pytest.importorskip("dynamixel_sdk")

KINDS = {"feetech": (Feetech, FEETECH, sts3215), "dynamixel": (Dynamixel, DYNAMIXEL, x_series)}
PLACES = {
    "feetech": {"position": ("H", 56), "goal": ("H", 42), "torque": ("B", 40), "mode": ("B", 33)},
    "dynamixel": {"position": ("i", 132), "goal": ("i", 116), "torque": ("B", 64), "mode": ("B", 11)},
}
RAD = 2 * math.pi / 4096
WAIT_S = 20.0
"""For what must come, however busy the machine is."""


class Servos(MadeServoBus):
    """Servos of a kind at rest."""

    def __init__(self, kind: str, servos: int = 2):
        protocol, self.series, power_on = KINDS[kind]
        super().__init__(protocol(), list(range(1, servos + 1)))
        self.kind = kind
        for id_ in self.registers:
            power_on(self, id_)

    def set(self, id_: int, what: str, value: int) -> None:
        self.put(id_, *PLACES[self.kind][what], value)

    def opened(self, *joints: ServoJoint, **settings) -> ServoSource:
        joints = joints or tuple(ServoJoint(NAMES[id_ - 1], id_) for id_ in self.registers)
        source = patient(ServoSource(self.series, self.port, bus_file(*joints)))
        source.open(servo_settings(len(joints), **settings))
        return source

    def sample(self, *joints: ServoJoint, **settings):
        """The first sample of a source."""
        return first_sample(self.opened(*joints, **settings))


@pytest.fixture(params=list(KINDS))
def rig(request):
    """Three servos of a kind, whose positions are the number of the reading, and their source."""
    with Servos(request.param, 3) as bus:
        bus.moves = lambda reading: [bus.set(id_, "position", reading % 2000) for id_ in (1, 2, 3)]
        source = patient(ServoSource(bus.series, bus.port, bus_file(*(ServoJoint(NAMES[k], k + 1) for k in range(3)))))
        opens = lambda **settings: source.open(servo_settings(3, **settings))  # noqa: E731
        with closing(source):
            yield SimpleNamespace(kind=bus.kind, bus=bus, source=source, open=opens)


@pytest.fixture(params=list(KINDS))
def two(request):
    """Two servos of a series."""
    with Servos(request.param) as bus:
        yield bus


@pytest.fixture
def feetech():
    with Servos("feetech") as bus:
        yield bus


@pytest.fixture
def dynamixel():
    with Servos("dynamixel") as bus:
        yield bus


def spoil(rig, readings: set[int], id_: int, how) -> None:
    """Answers of a servo to these readings."""
    rig.bus.sent = lambda one, packet: how(packet) if one == id_ and rig.bus.readings - 1 in readings else packet


@pytest.mark.parametrize(
    "how",
    [
        lambda packet: b"",
        lambda packet: packet[:-3],
        lambda packet: packet[:12] + bytes([packet[12] ^ 0x10]) + packet[13:],
        lambda packet: packet[:-1] + bytes([packet[-1] ^ 1]),
        lambda packet: b"\x00" + packet[3:],
        lambda packet: bytes(len(packet)),
    ],
    ids=["lost", "short", "corrupt", "checksum", "header", "zeros"],
)
@pytest.mark.parametrize("id_", [pytest.param(1, marks=pytest.mark.slow), 2, pytest.param(3, marks=pytest.mark.slow)])
def test_a_reading_with_a_spoilt_packet_is_refused_and_counted_and_the_next_are_whole(rig, how, id_):
    rig.source.bus.port.answer_s = 0.2
    spoil(rig, {4, 7}, id_, how)
    rig.open()
    samples = taken(rig.source, 8)
    rig.source.close()
    numbers = [round(one.q[0] / (2 * np.pi / 4096)) for one in samples]
    assert not {4, 7} & set(numbers), "a reading that was not whole is a sample"
    for one in samples:
        assert (one.q == one.q[0]).all(), "a sample is mixed from two readings"
    assert rig.source.counts.refused >= 2
    summary = rig.source.notes()[-1]
    assert "a servo was missing in " in summary and f"servo {id_} ({NAMES[id_ - 1]}) in " in summary


def test_a_packet_of_another_length_is_none_of_ours(rig):
    rig.source.bus.port.answer_s = 0.2
    spoil(rig, {3}, 2, lambda packet: rig.bus.protocol.answer(2, 0, bytes(30)))  # a byte too few, its check right
    rig.open()
    taken(rig.source, 4)
    rig.source.close()
    assert rig.source.counts.refused == 1
    assert rig.source.notes()[-1].endswith("servo 2 (lift) in 1; 1 unusable packets")


def test_a_late_answer_is_not_taken_for_one_to_the_next_request(rig):
    """Servo 3 answers a reading late, with the next one's request: its old position must not stand beside new ones."""
    kept = []

    def late(one: int, packet: bytes) -> bytes:
        if one == 3 and rig.bus.readings - 1 == 4:
            kept.append(packet)
            return b""
        return packet

    rig.source.bus.port.answer_s = 0.1
    rig.bus.sent = late
    rig.open()
    until_late = rig.source.bus.port.clearPort

    def clear() -> None:
        if kept:
            os.write(rig.bus._master, kept.pop())
        until_late()

    rig.source.bus.port.clearPort = clear
    for one in taken(rig.source, 10):
        assert (one.q == one.q[0]).all()


def test_a_servo_that_drops_out_is_named_and_waited_for(rig):
    rig.source.bus.port.answer_s = 0.03
    rig.open()
    taken(rig.source, 2)
    before = rig.source.counts.received
    rig.bus.sent = lambda one, packet: b"" if one == 2 else packet
    told = first_notes(rig.source)
    assert told[0] == "servo 2 (lift) does not answer: no sample until it does"
    assert rig.source.counts.refused >= REPORTED_AFTER and not rig.source.ended
    patient(rig.source)
    rig.bus.sent = lambda one, packet: packet
    taken(rig.source, before + 5 - rig.source.counts.received)
    assert any("servo 2 (lift) answers again, after " in text for text in told + rig.source.notes())


def test_a_port_that_goes_is_reported_and_waited_for(rig, monkeypatch):
    monkeypatch.setattr("tauext.sources.reader.RETRY_S", 0.05)
    rig.open()
    taken(rig.source, 2)
    rig.bus.close()
    (told, *_) = first_notes(rig.source)
    assert told.startswith(f"{rig.source.name} is disconnected: the port is lost: ") and told.endswith("; reconnecting")
    assert not rig.source.ended


def test_a_servo_that_is_not_there_is_reported_at_once(rig):
    rig.source.bus.port.answer_s = 0.05
    rig.bus.sent = lambda one, packet: b"" if one == 3 else packet
    with pytest.raises(ConfigError, match=r"servo 3 \(elbow\) does not answer; 1, 2 do$"):
        rig.open()
    rig.bus.sent = lambda one, packet: b""
    with pytest.raises(ConfigError, match=r"no servo does: check the arm's power, and that 1000000 baud is set"):
        rig.open()


def test_another_servo_or_another_arm_is_refused(rig):
    rig.source._file = bus_file(ServoJoint("pan", 1, type="dm4310"), ServoJoint("lift", 2), ServoJoint("elbow", 3))
    with pytest.raises(ConfigError, match=r"servo 1 \(pan\) is a (sts3215|xl330-m288), bus.toml names dm4310"):
        rig.open()
    rig.source._file = bus_file(ServoJoint("pan", 1, homing_offset=-7), ServoJoint("lift", 2), ServoJoint("elbow", 3))
    with pytest.raises(ConfigError, match=r"pan\) has homing offset 0, bus.toml has -7: the calibration is of"):
        rig.open()
    rig.bus.put(1, *(("H", 31, 0x0807) if rig.kind == "feetech" else ("i", 20, -7)))  # sign in bit 11; in 32 bits
    rig.open()
    taken(rig.source, 1)
    rig.source.close()
    rig.bus.put(2, "H", 3 if rig.kind == "feetech" else 0, 999)
    with pytest.raises(ConfigError, match=r"servo 2 \(lift\) reports model 999; known are "):
        rig.open()


def test_what_the_bundle_cannot_take_is_refused(rig):
    settings = servo_settings(3)
    for refused, message in (
        (replace(settings, joints=("other", *settings.joints)), "joint 'other' of the bundle is missing; the file has"),
        (replace(settings, period_ns=1_000_000), "3 servos takes 1.. ms at 1000000 baud, the bundle needs one every 1"),
        (replace(settings, servo=None), r"does not compute torque from them: import its recordings with a \[servo\]"),
        (servo_settings(3, "torque"), "the bundle takes its torque from torque$"),
    ):
        with pytest.raises(ConfigError, match=message):
            rig.source.open(refused)
    assert isinstance(rig.source, Stoppable)


def test_a_port_that_another_process_has_is_refused(rig):
    opens = f"os.open({rig.bus.port!r}, os.O_RDWR | os.O_NOCTTY)"
    script = f"import os, sys; {opens}; print(1, flush=True); sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as other:
        other.stdout.readline()
        process = rf"python\S* \({other.pid}\)"
        with pytest.raises(ConfigError, match=f"the port is in use by another process: {process}; a bus serves one"):
            rig.open()
        other.stdin.close()
    rig.open()
    taken(rig.source, 1)


def test_a_port_that_is_none_is_refused(tmp_path):
    for path, message in (
        (str(tmp_path / "ttyACM7"), "there is no such port; (the ports are|there is none)"),
        ("/dev/null", "this is not a serial port"),
    ):
        source = ServoSource(FEETECH, path, bus_file(ServoJoint("pan", 1)))
        with pytest.raises(ConfigError, match=message):
            source.open(servo_settings(1))


@pytest.mark.parametrize("series", [FEETECH, DYNAMIXEL])
def test_a_library_that_is_not_installed_names_it(monkeypatch, series):
    monkeypatch.setitem(sys.modules, series.library, None)
    with pytest.raises(ConfigError, match=rf"pip install '{series.package}'"):
        ServoSource(series, "/dev/ttyACM0", bus_file(ServoJoint("pan", 1)))


@pytest.mark.timing
def test_a_loop_makes_torque_of_what_servos_report_and_a_reaction_makes_them_hold(rig):
    """Duties of 0.4, 0 and -0.4 at standstill and 7.4 V (an XL330's 5 V): k_t V D / R of the settings, by hand. The
    model's masses would fly away, so something holds them: a collision."""
    for id_, share in ((1, 0.4), (2, 0.0), (3, -0.4)):
        if rig.kind == "feetech":
            rig.bus.put(id_, "H", 60, round(1000 * abs(share)) | (0x400 if share < 0 else 0))
        else:
            rig.bus.put(id_, "h", 124, round(885 * share))
    rig.bus.moves = lambda reading: None
    keeper = Keeper(lambda verdict: (len(rig.bus.writes) >= 3 or verdict.row == 2000) and keeper.control.stop("test"))
    reactions = start_reactions([Reaction("hold", ("contact", "collision"), stop=True)], rig.source, [])
    settings = LoopSettings(missing_after_s=5.0)
    Loop(servo_bundle(3, 0.3), rig.source, [keeper], reactions, settings=settings).run()
    volts = 7.4 if rig.kind == "feetech" else 5.0
    sample = next(verdict.sample for verdict in keeper.verdicts if verdict.sample is not None)
    np.testing.assert_allclose(sample.tau, 1.2 * volts * np.array([0.4, 0.0, -0.4]) / 2.75, rtol=1e-9)
    held = {id_ for _, id_, _ in rig.bus.writes}
    assert held == {1, 2, 3} and {address for address, _, _ in rig.bus.writes} == {PLACES[rig.kind]["goal"][1]}


# Bytes and registers, by the manuals of the makers.


def checked(asked: str) -> bytes:
    """A request of protocol 2.0 with its CRC."""
    packet = bytes.fromhex(asked)
    return packet + struct.pack("<H", crc16(packet))


def test_a_reading_is_one_sync_read_and_writes_nothing(two):
    with closing(two.opened()) as source:
        taken(source, 3)
    # Header, to all, length, sync read, first register, how many, ids, check: by the manuals, written out by hand.
    assert crc16(bytes.fromhex("ff ff fd 00 01 03 00 01")) == 0x4E19  # e-Manual, Protocol 2.0: a ping of id 1
    if two.kind == "feetech":
        asked = [bytes.fromhex("ff ff fe 06 82 03 1f 01 02 54"), bytes.fromhex("ff ff fe 06 82 28 1f 01 02 2f")]
    else:
        asked = [checked(f"ff ff fd 00 fe 09 00 82 {block} 01 02") for block in ("00 00 18 00", "74 00 1f 00")]
    assert two.requests[0] == asked[0] and set(two.requests[1:]) == {asked[1]}
    assert two.writes == []


def test_an_answer_of_the_servo_is_taken_byte_by_byte(two):
    """A whole answer as on the wire: goal 2100, position 2048, 12.3 V, 42 degC."""
    if two.kind == "feetech":  # FF FF, id, length 33, no error, 31 registers, ~sum
        body = bytes.fromhex(
            "01 21 00"
            "01 00 34 08 00 00 00 00 e8 03 00 00 00 00 00 00"  # 40: on, acceleration, goal, time, speed, limit 1000
            "00 08 2c 81 64 04 7b 2a 00 00 01 00 00 c8 00"  # 56: position, -300, -100, volts, degC, ..., current 200
        )
        packet = b"\xff\xff" + body + bytes([~sum(body) & 0xFF])
        dq, duty, current = -300 * RAD, -0.100, 1.3
    else:
        packet = checked(
            "ff ff fd 00 01 23 00 55 00"
            "34 08 00 00 00 00 00 00"  # 116: goal, tick, moving, status
            "8b fc d4 fe 9c ff ff ff 00 08 00 00"  # 124: PWM -885, current -300, velocity -100, position
            "00 00 00 00 00 00 00 00 7b 00 2a"  # 136: trajectories, volts, degC
        )
        dq, duty, current = -100 * 0.229 * 2 * math.pi / 60, -1.0, -0.3
    two.sent = lambda id_, made: packet if id_ == 1 and two.readings > 1 else made
    one = two.sample()
    assert one.q[0] == 0.0 and one.q_des[0] == pytest.approx(52 * RAD)
    assert (one.dq[0], one.duty[0], one.current[0]) == pytest.approx((dq, duty, current))
    assert one.voltage[0] == pytest.approx(12.3) and one.temperature[0] == 42.0
    assert np.isnan(one.tau).all()


@pytest.mark.parametrize(
    "register, word, signal, value",
    [
        (56, 0x8005, "q", (-5 - 2048 + 4096) * RAD),  # sign in bit 15; within half a turn of the zero
        (58, 0x012C, "dq", 300 * RAD),
        (58, 0x812C, "dq", -300 * RAD),
        (58, 0x8000, "dq", 0.0),
        (60, 0x03E8, "duty", 1.0),
        (60, 0x07E8, "duty", -1.0),  # sign in bit 10
        (60, 0x0400, "duty", 0.0),
        (69, 0x0064, "current", 0.65),
        (69, 0x8064, "current", -0.65),
        (42, 0x0834, "q_des", 52 * RAD),
        (42, 0x8034, "q_des", (-52 - 2048) * RAD),
    ],
)
def test_signs_of_feetech_are_in_the_bits_that_the_manual_says(feetech, register, word, signal, value):
    feetech.put(1, "H", register, word)
    assert getattr(feetech.sample(), signal)[0] == pytest.approx(value, abs=1e-12)


@pytest.mark.parametrize("model, ampere", [(1200, 0.001), (1190, 0.001), (1020, 0.00269), (1120, 0.00269)])
def test_currents_of_dynamixel_are_signed_and_in_the_step_of_the_model(dynamixel, model, ampere):
    x_series(dynamixel, 1, model)
    for counts in (1, -1, 1193, -32768):
        dynamixel.put(1, "h", 126, counts)
        assert dynamixel.sample().current[0] == pytest.approx(counts * ampere)


def test_an_xl430_has_no_current(dynamixel):
    x_series(dynamixel, 1, model=1060)
    dynamixel.put(1, "h", 126, 500)  # its load, an estimate
    one = dynamixel.sample()
    assert np.isnan(one.current[0]) and one.current[1] == 0.0
    with pytest.raises(ConfigError, match=r"a xl430-w250, reports duty, goal, the bundle takes its torque from phase"):
        dynamixel.opened(torque_from="phase_current")


def test_bytes_like_a_header_are_stuffed_and_come_back(dynamixel):
    """FF FF FD in the registers: a position of -131073 is FF FF FD FF, after which the packet is a byte longer."""
    dynamixel.set(1, "position", -131073)
    one = dynamixel.sample(ServoJoint("pan", 1, 0.0, multi_turn=True), ServoJoint("lift", 2))
    assert one.q[0] == pytest.approx(-131073 * RAD)


def test_zeros_directions_and_turns_are_those_of_the_file(feetech):
    feetech.put(1, "HHH", 56, 3048, 100, 50)
    feetech.set(1, "goal", 3148)
    feetech.put(1, "H", 69, 10)
    feetech.set(2, "position", 0x8000 | 5000)
    one = feetech.sample(ServoJoint("lift", 1, 1048.0, -1), ServoJoint("pan", 2, 0.0, 1, multi_turn=True))
    assert one.q == pytest.approx([-5000 * RAD, -2000 * RAD])  # in the order of the bundle: pan, lift
    assert one.q_des[1] - one.q[1] == pytest.approx(-100 * RAD)
    assert one.dq[1] == pytest.approx(-100 * RAD) and one.duty[1] == pytest.approx(-0.05)
    assert one.current[1] == pytest.approx(0.065)  # what the supply gives has no direction


def test_turns_are_counted_in_32_bits_and_directions_turn_phase_currents_too(dynamixel):
    dynamixel.put(1, "hhii", 124, 100, 7, -5, 3 * 4096 + 10)
    dynamixel.set(1, "mode", 4)  # extended position
    one = dynamixel.sample(ServoJoint("pan", 1, 10.0, -1, multi_turn=True), ServoJoint("lift", 2))
    assert one.q[0] == pytest.approx(-6 * math.pi)
    assert one.current[0] == pytest.approx(-0.007) and one.duty[0] == pytest.approx(-100 / 885) and one.dq[0] > 0


def test_an_angle_goes_on_where_the_counts_wrap(two):
    two.moves = lambda reading: two.set(1, "position", (4090 + 2 * reading) % 4096)
    with closing(two.opened(ServoJoint("pan", 1, 4000.0), ServoJoint("lift", 2))) as source:
        q = np.array([one.q[0] for one in taken(source, 12)])
    np.testing.assert_allclose(np.diff(q), 2 * RAD, atol=1e-12)
    assert q[0] > 0


@pytest.mark.parametrize("kind, register, value", [*((kind, "mode", 1) for kind in KINDS), ("feetech", "torque", 0)])
def test_a_servo_in_another_mode_or_a_feetech_without_torque_has_no_goal(kind, register, value):
    with Servos(kind) as bus:
        bus.set(1, register, value)
        one = bus.sample()
    assert np.isnan(one.q_des[0]) and one.q_des[1] == 0.0 and np.isfinite([one.q, one.duty]).all()


def test_stop_writes_the_present_position_as_goal_to_servos_whose_torque_is_on(two):
    two.set(1, "position", 0x8123 if two.kind == "feetech" else -77)
    two.set(2, "torque", 0)
    with closing(two.opened()) as source:
        taken(source, 2)
        assert two.writes == []
        source.stop()
    # Header, to all, length, sync write, register, how many bytes, id 1 and its position, check.
    if two.kind == "feetech":
        address, goal, sent = 42, b"\x23\x81", bytes.fromhex("ff ff fe 07 83 2a 02 01 23 81 a6")
    else:
        sent = checked("ff ff fd 00 fe 0c 00 83 74 00 04 00 01 b3 ff ff ff")
        address, goal = 116, struct.pack("<i", -77)
    assert two.writes == [(address, 1, goal)] and sent in b"".join(two.requests)


def test_stop_says_what_does_not_hold(two):
    two.set(2, "mode", 1)
    source = two.opened()
    with pytest.raises(RuntimeError, match=r"does not hold: servo 2 \(lift\) is in an operating mode without goal"):
        source.stop()
    assert [id_ for _, id_, _ in two.writes] == [1]
    patient(source, 0.05)
    two.sent = lambda id_, packet: b"" if id_ == 1 else packet
    with pytest.raises(RuntimeError, match=r"servo 1 \(pan\) does not answer"):
        source.stop()
    two.sent = lambda id_, packet: packet
    patient(source)
    source.bus.write = lambda *_: None  # on its way it is lost
    two.set(1, "goal", 99)
    with pytest.raises(RuntimeError, match=r"servo 1 \(pan\) does not take the goal"):
        source.stop()
    source.close()


def test_what_a_servo_complains_of_is_reported_once(two):
    error, text = (36, "overheated, overload") if two.kind == "feetech" else (0x80, "a hardware alert; its register 70")
    with closing(two.opened()) as source:
        taken(source, 2)
        two.errors[2] = error
        taken(source, 10)
        (note,) = source.notes()
        assert note.startswith(f"servo 2 (lift) reports: {text}")
        two.errors[2] = 0
        taken(source, 10)
        assert source.notes() == ["servo 2 (lift) reports no error"]


@pytest.mark.slow
def test_six_servos_are_read_six_thousand_times_and_each_time_whole():
    """At 100 Hz. How late they are depends on the machine: benchmarks/servo_buses.py."""
    with Servos("feetech", 6) as bus:
        bus.moves = lambda reading: [bus.set(id_, "position", (reading + 100 * id_) % 4096) for id_ in bus.registers]
        with closing(bus.opened(period_ns=10_000_000)) as source:
            q = np.array([one.q for one in taken(source, 6000, 300.0)])
        assert source.counts.refused == source.counts.overrun == 0 and source.notes() == []
    steps = np.diff(q, axis=0) / RAD
    assert np.isin(np.rint(steps), (1, -4095)).all()  # no reading twice, none mixed from two


# Sources describe themselves before a bundle exists.


def servo_source(bus: MadeServoBus, kind: str, joints: list[ServoJoint], monkeypatch):
    monkeypatch.setattr("tauext_lerobot.servo_bus_file.servo_bus", lambda cell: bus_file(*joints))
    source, _ = open_source(f"{kind}:{bus.port}", {}, cell=Cell(bus={}))
    return patient(source)


def test_feetech_servos_are_recognised_by_model_and_supply(monkeypatch):
    with MadeServoBus(Feetech(), [1, 2, 6]) as bus:
        for id_ in (1, 2, 6):
            sts3215(bus, id_)
        joints = [ServoJoint("pan", 1), ServoJoint("lift", 2), ServoJoint("gripper", 6)]

        def made() -> ServoSource:
            return servo_source(bus, "feetech", joints, monkeypatch)

        source = made()
        facts = source.describe(WAIT_S)
        assert facts.settings.joints == ("pan", "lift") and facts.notes == ("left out: gripper",)
        assert facts.signal == "duty" and facts.temperature and facts.settings.torque_units == ("N m", "N m")
        servo = facts.settings.servo
        assert servo.on and servo.torque_from == _core.TorqueFrom.duty and servo.velocity_steps > 1
        assert servo.joints[0].nm_per_ampere == SERVO_TYPES["sts3215-7.4v"].nm_per_ampere
        source.open(facts.settings)
        assert source.next_sample(WAIT_S) is not None
        source.close()
        bus.put(1, "B", 62, 120)  # 12 V
        bus.put(2, "B", 62, 118)
        again = made().describe(WAIT_S)
        assert again.settings.servo.joints[1].nm_per_ampere == SERVO_TYPES["sts3215-12v"].nm_per_ampere
        same_rate = replace(again.settings, period_ns=facts.settings.period_ns)
        assert "servos are of another type" in why_another(facts, replace(again, settings=same_rate))
        bus.put(1, "H", 3, 2825)  # sts3250, of which no constant is known
        unknown = made().describe(WAIT_S)
        assert unknown.settings.torque_units == ("A", "A") and "no constants are known" in unknown.notes[-1]
        assert unknown.settings.servo.joints[0].count_rad == pytest.approx(2 * np.pi / 4096)
        bus.registers.pop(2)
        silent = made()
        silent.bus.port.answer_s = 0.05
        with pytest.raises(ConfigError, match=r"servo 2 \(lift\) does not answer; 1 do"):
            silent.describe(WAIT_S)


def test_dynamixel_servos_give_their_phase_current_or_else_their_duty(monkeypatch):
    with Servos("dynamixel") as bus:
        joints = [ServoJoint(NAMES[k], k + 1) for k in range(2)]
        facts = servo_source(bus, "dynamixel", joints, monkeypatch).describe(WAIT_S)
        assert facts.signal == "current" and facts.settings.servo.torque_from == _core.TorqueFrom.phase_current
        x_series(bus, 2, model=1060)  # XL430 measures no current
        assert servo_source(bus, "dynamixel", joints, monkeypatch).describe(WAIT_S).signal == "duty"


@pytest.mark.parametrize("kind", list(KINDS))
def test_servos_whose_counts_wrap_turn_on(kind):
    """Three servos pass the seam of their counts; the Dynamixels count turns and lose one at a reboot."""

    def move(reading: int) -> None:
        counts = 1800 + 15 * reading
        for id_ in (1, 2, 3):
            bus.set(id_, "position", counts % 4096 if kind == "feetech" else counts - 4096 * (reading > 30))

    joints = (ServoJoint(NAMES[k], k + 1, 0.0, multi_turn=kind == "dynamixel") for k in range(3))
    with Servos(kind, 3) as bus:
        bus.moves = move
        source = patient(ServoSource(bus.series, bus.port, bus_file(*joints)))
        keeper = Keeper(lambda verdict: verdict.row >= 60 and keeper.control.stop("test"))
        Loop(None, source, [keeper], settings=LoopSettings(missing_after_s=60.0), arm=servo_settings(3)).run()
    counts = np.array([one.sample.q for one in keeper.verdicts]) * 4096 / TURN
    steps = np.diff(counts, axis=0)
    assert np.abs(steps / 15 - np.round(steps / 15)).max() < 1e-6 and steps.max() < 300 and np.ptp(counts) >= 60 * 15
