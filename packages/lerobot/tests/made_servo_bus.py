"""Servos behind a bus of a maker's protocol, and what sources of servo buses have in common."""

from __future__ import annotations

import os
import pty
import select
import struct
import threading
import time
import tty
from collections.abc import Callable
from pathlib import Path

import numpy as np
from made_arms import prismatic_mass
from tauext_lerobot.servo import ServoSource
from tauext_lerobot.servo_bus_file import ServoBusFile, ServoJoint

from tauext import _core
from tauext.config import ObserverConfig
from tauext.data.recording import Recording
from tauext.fit.bundle_writing import build_setup, make_bundle
from tauext.monitor.source import Sample, SourceSettings

READ, WRITE, SYNC_READ, SYNC_WRITE, TO_ALL = 0x02, 0x03, 0x82, 0x83, 0xFE


class Feetech:
    """FF FF id length instruction parameters ~sum; an answer has its error bits in the place of the instruction."""

    def packets(self, buffer: bytearray) -> list[tuple[int, int, bytes]]:
        """id, instruction and parameters of every whole packet, which are taken off the buffer."""
        found = []
        while len(buffer) >= 4 and len(buffer) >= buffer[3] + 4:
            packet = bytes(buffer[: buffer[3] + 4])
            assert packet[:2] == b"\xff\xff" and packet[-1] == ~sum(packet[2:-1]) & 0xFF, packet.hex(" ")
            del buffer[: len(packet)]
            found.append((packet[2], packet[4], packet[5:-1]))
        return found

    def answer(self, id_: int, error: int, data: bytes) -> bytes:
        body = bytes([id_, len(data) + 2, error]) + data
        return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])

    def block(self, parameters: bytes) -> tuple[int, int, bytes]:
        """Address, length, and what follows them, of a sync read or write."""
        return parameters[0], parameters[1], parameters[2:]


class Dynamixel:
    """FF FF FD 00 id length instruction parameters CRC; an answer's instruction is 55, then comes its error."""

    def packets(self, buffer: bytearray) -> list[tuple[int, int, bytes]]:
        found = []
        while len(buffer) >= 7 and len(buffer) >= (size := struct.unpack_from("<H", buffer, 5)[0] + 7):
            packet = bytes(buffer[:size])
            assert packet[:4] == b"\xff\xff\xfd\x00", packet.hex(" ")
            assert struct.unpack_from("<H", packet, size - 2)[0] == crc16(packet[:-2]), packet.hex(" ")
            del buffer[:size]
            found.append((packet[4], packet[7], packet[8:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")))
        return found

    def answer(self, id_: int, error: int, data: bytes) -> bytes:
        body = bytes([0x55, error]) + data.replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
        packet = b"\xff\xff\xfd\x00" + bytes([id_]) + struct.pack("<H", len(body) + 2) + body
        return packet + struct.pack("<H", crc16(packet))

    def block(self, parameters: bytes) -> tuple[int, int, bytes]:
        return *struct.unpack_from("<HH", parameters), parameters[4:]


def crc16(data: bytes) -> int:
    """CRC-16 of the polynomial 0x8005, bit by bit, from 0."""
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x8005 if crc & 0x8000 else crc << 1
            crc &= 0xFFFF
    return crc


class MadeServoBus:
    """Servos by id, each 256 bytes of registers, answering in the order that they are asked in."""

    def __init__(self, protocol: Feetech | Dynamixel, ids: list[int]):
        self.protocol = protocol
        self.registers = {id_: bytearray(256) for id_ in ids}
        self.errors = dict.fromkeys(ids, 0)
        self.sent: Callable[[int, bytes], bytes] = lambda id_, packet: packet
        """What becomes of an answer on its way: b"" is lost."""
        self.moves: Callable[[int], None] = lambda reading: None
        """Called before the answers to the sync read of this number."""
        self.readings = 0
        self.requests: list[bytes] = []
        """All bytes that came, a chunk an entry."""
        self.writes: list[tuple[int, int, bytes]] = []
        """Address, id, bytes."""
        self._master, self._slave = pty.openpty()
        tty.setraw(self._slave)
        self.port = os.ttyname(self._slave)
        self._quit, self._wake = os.pipe()
        self._thread = threading.Thread(target=self._work, daemon=True)
        self._thread.start()

    def put(self, id_: int, layout: str, address: int, *values: int) -> None:
        """Registers of a servo, little-endian, from the address on."""
        struct.pack_into("<" + layout, self.registers[id_], address, *values)

    def close(self) -> None:
        if self._thread.is_alive():
            os.write(self._wake, b"x")
            self._thread.join(5)
            for descriptor in (self._master, self._slave, self._quit, self._wake):
                os.close(descriptor)

    def __enter__(self) -> MadeServoBus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _work(self) -> None:
        buffer = bytearray()
        while True:
            ready, _, _ = select.select([self._master, self._quit], [], [])
            if self._quit in ready:
                return
            came = os.read(self._master, 4096)
            self.requests.append(came)
            buffer += came
            for id_, instruction, parameters in self.protocol.packets(buffer):
                self._obey(id_, instruction, parameters)

    def _obey(self, id_: int, instruction: int, parameters: bytes) -> None:
        if instruction == SYNC_READ:
            address, length, ids = self.protocol.block(parameters)
            self.moves(self.readings)
            self.readings += 1
            for one in ids:
                if one in self.registers:
                    data = bytes(self.registers[one][address : address + length])
                    packet = self.sent(one, self.protocol.answer(one, self.errors[one], data))
                    if packet:
                        os.write(self._master, packet)
        elif instruction == SYNC_WRITE:
            address, length, rest = self.protocol.block(parameters)
            for k in range(0, len(rest), length + 1):
                self.writes.append((address, rest[k], rest[k + 1 : k + 1 + length]))
                self.registers[rest[k]][address : address + length] = rest[k + 1 : k + 1 + length]
        else:
            self.writes.append((-1, id_, bytes([instruction]) + parameters))


NAMES = ("pan", "lift", "elbow", "wrist", "roll", "grip")
PATIENCE_S = 1.0
"""An answer that is on its way is waited for, however busy the machine is."""


def sts3215(bus: MadeServoBus, id_: int, model: int = 777, position: int = 2048) -> None:
    """Registers after power-on, torque on, goal at the position: 7.4 V, 31 degC."""
    bus.put(id_, "H", 3, model)
    bus.put(id_, "B", 40, 1)
    bus.put(id_, "H", 42, position)
    bus.put(id_, "HHHBB", 56, position, 0, 0, 74, 31)


def x_series(bus: MadeServoBus, id_: int, model: int = 1200, position: int = 2048) -> None:
    """Registers after power-on, in position mode, torque on, goal at the position: 5 V, 30 degC."""
    bus.put(id_, "H", 0, model)
    bus.put(id_, "BB", 10, 0, 3)
    bus.put(id_, "B", 64, 1)
    bus.put(id_, "i", 116, position)
    bus.put(id_, "hhii", 124, 0, 0, 0, position)
    bus.put(id_, "HB", 144, 50, 30)


def servo_settings(joints: int, torque_from: str = "duty", period_ns: int = 5_000_000) -> SourceSettings:
    """Of a bundle of these servos."""
    known = {"volts": 7.4, "ohm": 2.75, "back_emf_v_s": 1.2, "nm_per_ampere": 1.2}
    one = _core.ServoConstants(**known, duty_per_rad=2.6, most_duty=0.97, count_rad=0.00153)
    servo = _core.ServoSettings(getattr(_core.TorqueFrom, torque_from), [one] * joints, 0, period_ns)
    return SourceSettings(NAMES[:joints], period_ns, ("N m",) * joints, "instant", servo)


def servo_bundle(joints: int, limit_nm: float) -> _core.Bundle:
    """A bundle of an arm of sliding masses that servos drive."""
    links = []
    for k in range(joints):
        (link,) = prismatic_mass(1.0).links
        link.joint_name, link.parent = NAMES[k], k - 1
        links.append(link)
    settings = servo_settings(joints)
    t_ns, still = np.arange(401) * settings.period_ns, np.zeros((401, joints))
    made = Recording("still", NAMES[:joints], t_ns, still, still, still, 200.0, "instant", "", "")
    bundle = make_bundle("masses", build_setup(_core.Tree(links, [0, 0, 0]), made, ObserverConfig()), 0.02, made)
    bundle.sliding_limit_nm = bundle.near_stiction_limit_nm = [limit_nm] * joints
    bundle.servo = settings.servo
    return bundle


def bus_file(*joints: ServoJoint) -> ServoBusFile:
    return ServoBusFile(Path("bus.toml"), {joint.name: joint for joint in joints})


def patient(source: ServoSource, seconds: float = PATIENCE_S) -> ServoSource:
    """The source, waiting so long for late answers."""
    source.bus.port.answer_s = seconds
    return source


def taken(source, count: int, within_s: float = 20.0) -> list[Sample]:
    """The next samples."""
    samples, until = [], time.monotonic() + within_s
    while len(samples) < count and time.monotonic() < until:
        if (sample := source.next_sample(0.1)) is not None:
            samples.append(sample)
    assert len(samples) == count, f"{len(samples)} of {count} samples; {source.counts}; {source.notes()}"
    return samples


def first_notes(source) -> list[str]:
    """The first notes of a source."""
    told, until = [], time.monotonic() + 20.0
    while not told and time.monotonic() < until:
        source.next_sample(0.05)
        told = source.notes()
    return told


def first_sample(source: ServoSource) -> Sample:
    """The next sample of an open source, which is then closed."""
    try:
        return taken(source, 1)[0]
    finally:
        source.close()
