"""Messages of another process that do not decode as JointState: counted, reported once, not printed."""

import os
import socket
import struct
import subprocess
import sys

import pytest

pytest.importorskip("cyclonedds")

from made_ros2 import DOMAIN, until
from tauext_ros2.messages import Header, JointState, Time
from tauext_ros2.node import LINE
from tauext_ros2.settings import Ros2Settings

from tauext.monitor.source import SourceSettings
from tauext.sources.open import open_source

PUBLISHER = """
import sys
from tauext_ros2.settings import Ros2Settings
from tauext_ros2.messages import JointState
from tauext_ros2.node import Node
node = Node(Ros2Settings(topic=sys.argv[1], domain=int(sys.argv[2])))
writer = node.writer(sys.argv[1], JointState, "best-effort", "volatile", 1)
print(writer.guid.bytes.hex(), flush=True)
sys.stdin.read()
"""
TOPIC = f"/unreadable_{os.getpid()}"
FIRST_PORT, A_DOMAIN, A_PARTICIPANT, USER_UNICAST, PARTICIPANTS = 7400, 250, 2, 11, 60
"""Ports of RTPS 2.x, 9.6.1.1."""


@pytest.fixture
def writer():
    """The id of a writer in another process."""
    arguments = [sys.executable, "-c", PUBLISHER, TOPIC, str(DOMAIN)]
    with subprocess.Popen(arguments, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        yield bytes.fromhex(process.stdout.readline())
        process.stdin.close()


def send(writer: bytes, payloads: list[bytes]) -> None:
    """DATA submessages as from this writer, to whoever listens in the domain on this machine."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        for number, payload in enumerate(payloads, 1):
            body = struct.pack("<HH", 0, 16) + bytes(4) + writer[12:] + struct.pack("<iI", 0, number) + payload
            body += bytes(-len(body) % 4)
            packet = b"RTPS\x02\x05\x01\x10" + writer[:12] + struct.pack("<BBH", 0x15, 0x05, len(body)) + body
            for participant in range(PARTICIPANTS):
                port = FIRST_PORT + A_DOMAIN * DOMAIN + USER_UNICAST + A_PARTICIPANT * participant
                wire.sendto(packet, ("127.0.0.1", port))


def test_a_publisher_of_garbage_is_counted_reported_once_and_not_printed(writer, capfd):
    live, _ = open_source("ros2", {"ros2": Ros2Settings(topic=TOPIC, domain=DOMAIN)})
    live.open(SourceSettings(("a", "b"), 1_000_000))
    good = JointState(Header(Time(1, 0)), ["a", "b"], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]).serialize(use_version_2=False)
    cut, long = good[:60], good[:20] + struct.pack("<I", 2**31 - 1) + good[24:]
    try:
        until(lambda: live._inbox.reader.get_matched_publications(), "the publisher")
        live.next_sample(0.01)
        live.notes()
        capfd.readouterr()
        send(writer, [cut, long] * 200 + [good])
        until(lambda: live.next_sample(0.01) or live.counts.refused == 400, "all to be counted")
        os.write(2, b"what else is printed\n")
        assert live.counts.received >= 400 and live.counts.refused == 400
        (note,) = live.notes()
        assert "messages do not decode as JointState" in note
    finally:
        live.close()
    assert capfd.readouterr().err == "what else is printed\n"


def test_the_library_s_line_tells_the_topic():
    line = "1.5 [7] recv: data(application, vendor 1.16): 1:2:3:203 #2: deserialization rt/a/b/"
    assert LINE.search(f"{line}sensor_msgs::msg::dds_::JointState_ failed (for reasons unknown)")[1] == "/a/b"
    assert not LINE.search("failed to join the domain")
