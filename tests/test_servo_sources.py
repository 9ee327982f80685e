"""What sources of serial servos share: lost, short and corrupt packets, silent servos, ports, and what is refused."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import numpy as np
import pytest
from made_live import Keeper
from made_servos import NAMES, Dynamixel, Feetech, MadeServoBus, bus_file, patient, servo_bundle, servo_settings, taken
from test_dynamixel_source import x_series
from test_feetech_source import sts3215

from tauext.errors import ConfigError
from tauext.monitor.loop import TOLD_AFTER, Loop, LoopSettings
from tauext.monitor.reaction_file import Reaction
from tauext.monitor.reactions import start_reactions
from tauext.monitor.source import Stoppable
from tauext.sources.dynamixel import DynamixelSource
from tauext.sources.feetech import FeetechSource
from tauext.sources.reader import Ticks
from tauext.sources.servo_bus_file import ServoJoint

KINDS = {"feetech": (Feetech, FeetechSource, sts3215), "dynamixel": (Dynamixel, DynamixelSource, x_series)}
POSITION = {"feetech": ("H", 56), "dynamixel": ("i", 132)}


class Rig:
    """Three servos of a kind, whose positions are the number of the reading."""

    def __init__(self, kind: str):
        protocol, source, power_on = KINDS[kind]
        self.kind, self.bus = kind, MadeServoBus(protocol(), [1, 2, 3])
        for id_ in (1, 2, 3):
            power_on(self.bus, id_)
        self.bus.moves = self._move
        self.source = patient(source(self.bus.port, bus_file(*(ServoJoint(NAMES[k], k + 1, 0.0) for k in range(3)))))

    def _move(self, reading: int) -> None:
        for id_ in (1, 2, 3):
            self.bus.put(id_, POSITION[self.kind][0], POSITION[self.kind][1], reading % 2000)

    def open(self, **settings) -> None:
        self.source.open(servo_settings(3, **settings))


@pytest.fixture(params=list(KINDS))
def rig(request):
    made = Rig(request.param)
    yield made
    made.source.close()
    made.bus.close()


def spoil(rig: Rig, readings: set[int], id_: int, how) -> None:
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
    """Its check is right, and it has a byte too few."""
    rig.source.bus.port.answer_s = 0.2
    spoil(rig, {3}, 2, lambda packet: rig.bus.protocol.answer(2, 0, bytes(30)))
    rig.open()
    taken(rig.source, 4)
    rig.source.close()
    assert rig.source.counts.refused == 1
    assert rig.source.notes()[-1].endswith("servo 2 (lift) in 1; 1 packets could not be used")


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
    told, until = [], time.monotonic() + 20
    while not told and time.monotonic() < until:
        rig.source.next_sample(0.05)
        told = rig.source.notes()
    assert told[0] == "servo 2 (lift) does not answer: no sample until it does"
    assert rig.source.counts.refused >= TOLD_AFTER and not rig.source.ended
    patient(rig.source)
    rig.bus.sent = lambda one, packet: packet
    while rig.source.counts.received < before + 5 and time.monotonic() < until:
        rig.source.next_sample(0.05)
    assert any("servo 2 (lift) answers again, after " in text for text in told + rig.source.notes())


def test_a_port_that_goes_is_told_and_waited_for(rig, monkeypatch):
    monkeypatch.setattr("tauext.sources.reader.RETRY_S", 0.05)
    rig.open()
    taken(rig.source, 2)
    rig.bus.close()
    told, until = [], time.monotonic() + 20
    while not told and time.monotonic() < until:
        rig.source.next_sample(0.05)
        told = rig.source.notes()
    assert told[0].startswith(f"{rig.source.name} is gone: the port has gone: ") and told[0].endswith("; trying again")
    assert not rig.source.ended


def test_a_servo_that_is_not_there_is_told_at_once(rig):
    rig.source.bus.port.answer_s = 0.05
    rig.bus.sent = lambda one, packet: b"" if one == 3 else packet
    with pytest.raises(ConfigError, match=r"servo 3 \(elbow\) does not answer; 1, 2 do$"):
        rig.open()
    rig.bus.sent = lambda one, packet: b""
    with pytest.raises(ConfigError, match=r"nor does any other: is the arm's power on, and are they at 1000000 baud\?"):
        rig.open()


def test_another_servo_or_another_arm_is_refused(rig):
    rig.source._file = bus_file(ServoJoint("pan", 1, type="dm4310"), ServoJoint("lift", 2), ServoJoint("elbow", 3))
    with pytest.raises(ConfigError, match=r"servo 1 \(pan\) is a (sts3215|xl330-m288), bus.toml says dm4310"):
        rig.open()
    rig.source._file = bus_file(ServoJoint("pan", 1, homing_offset=-7), ServoJoint("lift", 2), ServoJoint("elbow", 3))
    with pytest.raises(ConfigError, match=r"pan\) has homing offset 0, bus.toml -7: is it another arm's calibration"):
        rig.open()
    rig.bus.put(1, *(("H", 31, 0x0807) if rig.kind == "feetech" else ("i", 20, -7)))  # sign in bit 11; in 32 bits
    rig.open()
    taken(rig.source, 1)
    rig.source.close()
    rig.bus.put(2, "H", 3 if rig.kind == "feetech" else 0, 999)
    with pytest.raises(ConfigError, match=r"servo 2 \(lift\) says model 999; known are "):
        rig.open()


def test_what_the_bundle_cannot_take_is_refused(rig):
    with pytest.raises(ConfigError, match="joint 'pan' of the bundle is missing; there are other"):
        rig.source._file, kept = bus_file(ServoJoint("other", 1)), rig.source._file
        rig.open()
    rig.source._file = kept
    with pytest.raises(
        ConfigError, match="a reading of 3 servos takes 1.. ms at 1000000 baud, the bundle takes one every 1"
    ):
        rig.open(period_ns=1_000_000)
    settings = servo_settings(3)
    with pytest.raises(
        ConfigError, match=r"of which the bundle makes no torque: import its recordings with a \[servo\]"
    ):
        rig.source.open(type(settings)(settings.joints, settings.period_ns))
    with pytest.raises(ConfigError, match="the bundle takes its torque from torque$"):
        rig.open(torque_from="torque")
    assert isinstance(rig.source, Stoppable)


def test_a_port_that_another_process_has_is_refused(rig):
    script = (
        f"import os, sys; os.open({rig.bus.port!r}, os.O_RDWR | os.O_NOCTTY); print(1, flush=True); sys.stdin.read()"
    )
    other = subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        other.stdout.readline()
        with pytest.raises(
            ConfigError, match=rf"another process has the port: python\S* \({other.pid}\); a bus takes one"
        ):
            rig.open()
    finally:
        other.communicate()
    rig.open()
    taken(rig.source, 1)


def test_a_port_that_is_none_is_refused(tmp_path):
    for path, message in (
        (str(tmp_path / "ttyACM7"), "there is no such port; there (are|is none)"),
        ("/dev/null", "this is no serial port"),
    ):
        source = FeetechSource(path, bus_file(ServoJoint("pan", 1)))
        with pytest.raises(ConfigError, match=message):
            source.open(servo_settings(1))


@pytest.mark.parametrize("module, source", [("scservo_sdk", FeetechSource), ("dynamixel_sdk", DynamixelSource)])
def test_a_library_that_is_not_installed_names_its_extra(monkeypatch, module, source):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ConfigError, match=r"pip install 'tauext\[(feetech|dynamixel)\]'"):
        source("/dev/ttyACM0", bus_file(ServoJoint("pan", 1)))


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
    assert held == {1, 2, 3} and {address for address, _, _ in rig.bus.writes} == {rig.source.goal[0]}


def test_ticks_keep_their_times_and_skip_those_that_passed():
    now, slept = [100.0], []

    def sleep(seconds):
        slept.append(seconds)
        now[0] += seconds

    ticks = Ticks(0.25, lambda: now[0], sleep)
    assert ticks.wait(1.0) == 0 and slept == []  # the first at once
    now[0] += 0.125  # an answer came
    assert ticks.wait(1.0) == 0 and now[0] == 100.25
    now[0] += 0.375  # 100.625: the tick of 100.5 is late and not skipped
    assert ticks.wait(1.0) == 0 and now[0] == 100.625
    assert ticks.wait(1.0) == 0 and now[0] == 100.75
    now[0] += 0.8125  # 101.5625: of 101.0, 101.25, 101.5 the last is still to be used
    assert ticks.wait(1.0) == 2 and now[0] == 101.5625
    assert ticks.wait(1.0) == 0 and now[0] == 101.75
    assert ticks.wait(0.125) is None and now[0] == 101.875
    assert ticks.wait(0.125) == 0 and now[0] == 102.0
