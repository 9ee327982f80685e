"""An arm of Universal Robots over RTDE, by ur_rtde. Never run on hardware: tested on mocked packets of a controller."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from tauext.config import NOT_0, within
from tauext.errors import ConfigError
from tauext.files.plain_file import read_toml
from tauext.files.typed_table import expect_known, read_table
from tauext.monitor.source import Sample, SourceFacts, SourceSettings
from tauext.plugins import optional_library
from tauext.sources.describing import LEARNT_STEPS, joint_names, learnt_period_ns
from tauext.sources.reader import ReaderSource, Unreachable, sample_of
from tauext.sources.ur_dashboard import PORT, Dashboard, DashboardError

# --- Torque constants of an arm that reports motor currents, from a file.


@dataclass(frozen=True)
class ConstantsFile:
    """A file of torque constants."""

    nm_per_ampere: dict[str, Annotated[float, within(-1e6, 1e6), NOT_0]]
    """Joint torque a unit of current, after the gear, [N m/A]."""


def load_torque_constants(path: Path, joints: Sequence[str]) -> np.ndarray:
    """Joint torque a unit of current, after the gear, (joints,) [N m/A], from a TOML file of one table:

        [nm_per_ampere]
        shoulder_pan_joint = 12.2

    A negative constant means that the current's sign is the other way round.

    Raises:
        ConfigError: names the file, the joint and the rule that is broken.
    """
    constants = read_table(ConstantsFile, read_toml(path), f"{path}:").nm_per_ampere
    expect_known(f"{path}: [nm_per_ampere]", constants, joints)
    if missing := [joint for joint in joints if joint not in constants]:
        raise ConfigError(f"{path}: [nm_per_ampere] {missing[0]} is missing; it must be a number, not 0")
    return np.array([constants[joint] for joint in joints])


# --- The source.


VARIABLES = ["timestamp", "actual_q", "actual_qd", "actual_current", "joint_temperatures"]
JOINTS = (
    "shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint",
)  # fmt: skip
"""Names in the maker's robot files, in the order of the controller."""
RTDE_PORT = 30004
ANSWER_S = 2.0


def expect_controller(host: str) -> None:
    """Raise Unreachable unless an RTDE server answers.

    The library waits for an answer without end and holds Python's lock meanwhile: the whole process would stand still
    beside a controller that boots.
    """
    try:
        with socket.create_connection((host, RTDE_PORT), ANSWER_S) as one:
            one.sendall(struct.pack(">HcH", 5, b"V", 2))  # asks for version 2 of RTDE; every controller answers
            if not one.recv(16):
                raise Unreachable("the controller does not accept the connection: is it still booting?")
    except OSError as error:
        raise Unreachable(f"no controller answers on port {RTDE_PORT}: {error}") from error


class UrSource(ReaderSource):
    """actual_q [rad], actual_qd [rad/s] and actual_current, joints base to wrist 3; currents as they come for a bundle
    that takes amperes, times torque constants [N m/A] for one that takes N m; joint_temperatures [degC].

    The stamp is the controller's time since its start. stop() ends the program on the controller, through the dashboard
    server.
    """

    robot_joints = 6
    dashboard_port = PORT

    def __init__(self, host: str, torque_constants: Path | None = None):
        """torque_constants: file (torque_constants_file.py); None where the bundle takes amperes."""
        super().__init__(f"ur {host}")
        self._host, self._file = host, torque_constants
        self._receive: Any = None
        self._dashboard = Dashboard(host, self.dashboard_port)

    def open(self, settings: SourceSettings) -> None:
        amperes = "A" in settings.torque_units
        if amperes and self._file is not None:
            raise ConfigError(f"{self.name}: the bundle takes amperes, as they come; leave {self._file} out")
        if not amperes and self._file is None:
            raise ConfigError(
                f"{self.name} sends motor currents, the bundle takes N m: --torque-constants FILE converts them"
            )
        self._constants = np.ones(len(settings.joints))
        if self._file is not None:
            self._constants = load_torque_constants(self._file, settings.joints)
        super().open(settings)

    def find_out(self, wait_s: float, robot: Path | None) -> SourceFacts:
        """Count the controller's stamps at its own rate: 500 Hz of an e-Series, 125 Hz of a CB3."""
        until = time.monotonic() + wait_s
        joints, notes = joint_names(JOINTS, robot, self.name)
        if self._file is not None:
            load_torque_constants(self._file, joints)
        self._connect(-1.0)  # the controller's own rate
        stamps = [self._stamp_s]
        while len(stamps) <= LEARNT_STEPS and time.monotonic() < until:
            if not self._receive.isConnected():
                raise Unreachable("the connection is closed")
            if (stamp_s := self._receive.getTimestamp()) != stamps[-1]:
                stamps.append(stamp_s)
            else:
                time.sleep(2e-4)
        period_ns = learnt_period_ns([round(stamp_s * 1e9) for stamp_s in stamps], self.name)
        amperes = self._file is None
        settings = SourceSettings(joints, period_ns, ("A" if amperes else "N m",) * len(joints), "held")
        return SourceFacts(settings, "current", temperature=True, notes=notes)

    def connect(self) -> None:
        self._connect(1e9 / self.settings.period_ns)

    def _connect(self, rate_hz: float) -> None:
        library = optional_library("rtde_receive", "source ur", "ur_rtde")
        expect_controller(self._host)
        try:
            self._receive = library.RTDEReceiveInterface(self._host, rate_hz, VARIABLES)
        except Exception as error:  # the library's are plain RuntimeErrors
            raise Unreachable(str(error) or type(error).__name__) from error
        self._stamp_s = self._receive.getTimestamp()

    def read(self) -> Sample | None:
        until = time.monotonic() + 0.1
        while (stamp_s := self._receive.getTimestamp()) == self._stamp_s:
            if not self._receive.isConnected():
                raise Unreachable("the connection is closed")
            if time.monotonic() > until:
                return None
            # The library has its own thread and keeps the newest packet alone: a new one is seen by its time stamp.
            time.sleep(self.settings.period_ns * 1e-10)
        while True:  # the getters read the newest packet each: all of one sample must be of one packet
            q, dq, current, celsius = (get() for get in self._getters())
            again_s = self._receive.getTimestamp()
            if again_s == stamp_s:
                break
            stamp_s = again_s
        self._stamp_s = stamp_s
        tau = np.array(current, dtype=float) * self._constants
        return sample_of(stamp_s, q, dq, tau, np.array(celsius, dtype=float))

    def disconnect(self) -> None:
        if self._receive is not None:
            self._receive.disconnect()
            self._receive = None

    def check_stop(self) -> None:
        try:
            self._dashboard.check()
        except DashboardError as error:
            raise ConfigError(f"{self.name}: `stop = true` would fail: {error}") from error

    def stop(self) -> None:
        """Ends the program that the controller runs."""
        self._dashboard.stop()

    def close(self) -> None:
        super().close()
        self._dashboard.close()

    def _getters(self) -> Sequence:
        receive = self._receive
        return receive.getActualQ, receive.getActualQd, receive.getActualCurrent, receive.getJointTemperatures
