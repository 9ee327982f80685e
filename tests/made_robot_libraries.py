"""Stand-ins with the functions of the real libraries of robots, ur_rtde and pylibfranka."""

from __future__ import annotations

import time
from types import ModuleType, SimpleNamespace


class Arm:
    """What the stand-ins read: packets of known numbers, handed out one at a time, and what goes wrong."""

    def __init__(self, joints: int, period_s: float):
        self.joints, self.period_s, self.number, self.reachable, self.torn = joints, period_s, 0, True, False
        self.stopped, self.connections, self.asked = 0, 0, {}

    def signal(self, which: int, number: int | None = None) -> list[float]:
        k = self.number if number is None else number
        return [which + 0.1 * joint + 0.001 * k for joint in range(self.joints)]


def rtde_library(arm: Arm) -> ModuleType:
    """ur_rtde 1.6: RTDEReceiveInterface keeps the newest packet; every getter reads it by itself."""

    class RTDEReceiveInterface:
        def __init__(self, hostname, frequency=-1.0, variables=(), verbose=False, use_upper_range_registers=False):
            if not arm.reachable:
                raise RuntimeError("Timeout connecting to UR")
            arm.connections += 1
            arm.asked = {"hostname": hostname, "frequency": frequency, "variables": list(variables)}
            self.polls = 0

        def getTimestamp(self):
            self.polls += 1
            if self.polls % 4 == 0 and arm.reachable:
                arm.number += 1
            return 100.0 + arm.number * arm.period_s

        def getActualQ(self):
            if arm.torn and arm.number % 3 == 0:  # the next packet comes between two getters
                arm.number += 1
            return arm.signal(1)

        def getActualQd(self):
            return arm.signal(2)

        def getActualCurrent(self):
            return arm.signal(3)

        def getJointTemperatures(self):
            return arm.signal(4)

        def isConnected(self):
            return arm.reachable

        def disconnect(self):
            pass

    receive = ModuleType("rtde_receive")
    receive.RTDEReceiveInterface = RTDEReceiveInterface
    return receive


def franka_library(arm: Arm) -> ModuleType:
    """pylibfranka 0.21: Robot.read_once() waits for the next state; state.time has to_sec() alone."""

    class FrankaException(Exception):
        pass

    class Robot:
        def __init__(self, robot_ip_address, realtime_config="enforce"):
            if not arm.reachable:
                raise FrankaException("libfranka: Connection timeout")
            arm.connections += 1
            arm.asked = {"host": robot_ip_address, "config": realtime_config}

        def read_once(self):
            if not arm.reachable:
                raise FrankaException("libfranka: UDP receive: Timeout")
            time.sleep(0.0002)
            arm.number += 1
            return SimpleNamespace(
                time=SimpleNamespace(to_sec=lambda stamp_s=100.0 + arm.number * arm.period_s: stamp_s),
                q=arm.signal(1),
                dq=arm.signal(2),
                tau_J=arm.signal(3),
                tau_ext_hat_filtered=arm.signal(4),
            )

        def stop(self):
            arm.stopped += 1

    library = ModuleType("pylibfranka")
    library.Robot, library.FrankaException = Robot, FrankaException
    library.RealtimeConfig = SimpleNamespace(kEnforce="enforce", kIgnore="ignore")
    return library
