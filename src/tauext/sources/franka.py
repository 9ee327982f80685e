"""A Franka arm, by pylibfranka. Never run on hardware: tested on a mock of that library."""

from __future__ import annotations

from collections import deque
from pathlib import Path
from typing import Any

import numpy as np

from tauext.errors import ConfigError
from tauext.monitor.source import Sample, SourceFacts, SourceSettings
from tauext.plugins import optional_library
from tauext.sources.describing import joint_names
from tauext.sources.reader import ReaderSource, Unreachable, sample_of

RATE_HZ = 1000.0
JOINTS = tuple(f"joint{number}" for number in range(1, 8))
"""Names in the maker's robot files, behind a prefix such as fr3_."""


class FrankaSource(ReaderSource):
    """Reads q [rad], dq [rad/s] and tau_J [N m], the torque that the joints' sensors measure; 1 kHz, joints 1 to 7.

    Train the bundle on recordings of the same tau_J. The arm's own estimate, tau_ext_hat_filtered, is kept as a
    reference. stop() ends the current motion.
    """

    robot_joints = 7

    def __init__(self, host: str):
        super().__init__(f"franka {host}")
        self._host = host
        self._robot: Any = None
        self.reference: deque[tuple[int, np.ndarray]] = deque(maxlen=256)
        """Newest pairs of t_ns and tau_ext_hat_filtered (7,) [N m]."""

    def find_out(self, wait_s: float, robot: Path | None) -> SourceFacts:
        joints, notes = joint_names(JOINTS, robot, self.name)
        self.connect()
        self.read()
        settings = SourceSettings(joints, round(1e9 / RATE_HZ), ("N m",) * len(joints), "instant")
        return SourceFacts(settings, "torque", temperature=False, notes=notes)

    def open(self, settings: SourceSettings) -> None:
        rate_hz = 1e9 / settings.period_ns
        if abs(rate_hz / RATE_HZ - 1) > settings.rate_tolerance:
            raise ConfigError(f"{self.name} sends {RATE_HZ:g} samples a second, the bundle takes {rate_hz:g}")
        super().open(settings)

    def connect(self) -> None:
        library = self._library = optional_library("pylibfranka", "source franka", "pylibfranka")
        try:  # reading needs no real-time kernel
            self._robot = library.Robot(self._host, library.RealtimeConfig.kIgnore)
        except library.FrankaException as error:
            raise Unreachable(str(error)) from error

    def read(self) -> Sample | None:
        try:
            state = self._robot.read_once()
        except self._library.FrankaException as error:
            raise Unreachable(str(error)) from error
        sample = sample_of(state.time.to_sec(), state.q, state.dq, np.array(state.tau_J, dtype=float))
        self.reference.append((sample.t_ns, np.array(state.tau_ext_hat_filtered, dtype=float)))
        return sample

    def disconnect(self) -> None:
        self._robot = None  # its destructor closes the connection

    def stop(self) -> None:
        """End the current motion."""
        robot = self._robot
        if robot is not None:
            robot.stop()
