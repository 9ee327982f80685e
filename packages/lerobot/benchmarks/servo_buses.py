"""Servo buses: how many of a minute's readings are whole and in time.

    python packages/lerobot/benchmarks/servo_buses.py [--seconds 60] [--hz 50 100 200] [--priority 80]

Buses are mocked: a process of its own answers on a pty, by the makers' protocols, with the wire's time (1 Mbaud) before
each answer; Damiao's motors answer on python-can's virtual bus in a thread, without it. No hardware.
Reported for six servos at each rate: samples, those refused (a packet was missing), lost (their time passed: the
machine was late) and overrun; from the request to the sample, in ms.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[3] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))
from common import arguments, head, table_row
from made_servo_bus import NAMES, Dynamixel, Feetech, MadeServoBus, bus_file, servo_settings, sts3215, x_series
from tauext_lerobot import servo_bus
from tauext_lerobot.damiao import CanMotor
from tauext_lerobot.servo import ServoSource
from tauext_lerobot.servo_bus_file import ServoJoint
from tauext_lerobot.servo_series import DYNAMIXEL, FEETECH
from test_damiao_source import Motors, source_of, state_of

from tauext.monitor.source import SourceSettings

KINDS = {"feetech": (Feetech, FEETECH, sts3215), "dynamixel": (Dynamixel, DYNAMIXEL, x_series)}
BYTE_S = 10 / 1e6
SERVOS = 6


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--seconds", type=float, default=60.0, help="default: %(default)s")
    parser.add_argument("--hz", type=float, nargs="+", default=[50.0, 100.0, 200.0])
    parser.add_argument("--priority", type=int, help="SCHED_FIFO for this process and the one that answers")
    parser.add_argument("--serve", choices=list(KINDS), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.priority is not None:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(options.priority))
    if options.serve:
        serve(options.serve)
        return
    servo_bus.users_of = lambda path: ""  # the process that answers has the pty open, too
    print("\n".join(head("bus | Hz | samples | refused | lost | overrun | ms p50 | p99 | max")))
    for hz in options.hz:
        for kind, (_, series, _) in KINDS.items():
            with served(kind, options.priority) as port:
                one = ServoSource(series, port, bus_file(*(ServoJoint(NAMES[k], k + 1) for k in range(SERVOS))))
                measured(kind, one, servo_settings(SERVOS, period_ns=round(1e9 / hz)), hz, options.seconds)
        motors = Motors()
        motors.states = {k + 1: state_of(k + 1) for k in range(SERVOS)}
        one = source_of(motors, *(CanMotor(NAMES[k], k + 1, 0x11 + k) for k in range(SERVOS)))
        measured("damiao", one, SourceSettings(NAMES, round(1e9 / hz), ("N m",) * SERVOS), hz, options.seconds)
        motors.close()


def measured(kind: str, source, settings: SourceSettings, hz: float, seconds: float) -> None:
    """One row: readings for so long."""
    source.open(settings)
    took_ms, until = [], time.monotonic() + seconds
    while time.monotonic() < until:
        if (sample := source.next_sample(0.1)) is not None:
            took_ms.append((sample.received_ns - sample.t_ns) * 1e-6)
    source.close()
    counts, (p50, p99) = source.counts, np.quantile(took_ms, [0.5, 0.99])
    counted = (counts.received, counts.refused, counts.lost, counts.overrun)
    print(table_row(kind, f"{hz:g}", *counted, *(f"{ms:.2f}" for ms in (p50, p99, max(took_ms)))), flush=True)


@contextmanager
def served(kind: str, priority: int | None) -> Iterator[str]:
    """The port of a bus in another process."""
    command = [sys.executable, __file__, "--serve", kind] + (["--priority", str(priority)] if priority else [])
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        yield process.stdout.readline().strip()
        process.stdin.close()


def serve(kind: str) -> None:
    """Answer until stdin ends; positions are the number of the reading."""
    protocol, _, power_on = KINDS[kind]
    layout, address = ("H", 56) if kind == "feetech" else ("i", 132)
    with MadeServoBus(protocol(), list(range(1, SERVOS + 1))) as bus:
        for id_ in bus.registers:
            power_on(bus, id_)
        bus.moves = lambda reading: [bus.put(id_, layout, address, reading % 4096) for id_ in bus.registers]

        def sent(id_: int, packet: bytes) -> bytes:
            time.sleep(len(packet) * BYTE_S)
            return packet

        bus.sent = sent
        print(bus.port, flush=True)
        sys.stdin.read()


if __name__ == "__main__":
    main()
