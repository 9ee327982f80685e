"""From numbers of LeRobot frames to what the chain takes: the same for a whole episode and for one frame."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.data.columns import Columns, find_columns
from tauext.data.conversion import in_si
from tauext.data.description import NEEDS, Arm, ContactTable, TimeTable
from tauext.data.importers.raw import RawRecording, RawSignals
from tauext.errors import BundleError, ConfigError, RecordingError

MOST_RAD = 8 * math.pi
"""Joints do not turn four times: positions beyond are in other units."""


class ServoFrames:
    """Position and raw servo signals, in SI, of frames whose numbers have these names.

    Raises:
        BundleError: the bundle makes no torque of what servos report, or its joints are others.
        ConfigError: a column that the description names is not there, or what the torque is made of is not named.
    """

    def __init__(self, bundle: _core.Bundle, arm: Arm, names: Sequence[str], where: str):
        if not bundle.servo.on:
            raise BundleError(
                f"bundle '{bundle.name}' takes torque as it is measured, which LeRobot's state and action do not hold; "
                'train one with a table [servo] in arm.toml (torque_from = "goal")'
            )
        joints = tuple(link.joint_name for link in bundle.links)
        if arm.robot.joints != joints:
            described = ", ".join(arm.robot.joints)
            raise BundleError(f"bundle '{bundle.name}' is for joints {', '.join(joints)}; {arm.path} names {described}")
        source = bundle.servo.torque_from.name.replace("_", "-")
        needed = NEEDS.get(source, "tau")
        if needed not in arm.signals or not arm.signals[needed].columns:
            raise ConfigError(
                f"{arm.path}: [signals.{needed}] is missing, of which bundle '{bundle.name}' makes torque ({source})"
            )
        used = {"q", "q_des", "dq", "current", "duty", "voltage"} | ({"tau"} if needed == "tau" else set())
        wanted = {name: table for name, table in arm.signals.items() if name in used or name == "tau"}
        arm = replace(arm, signals=wanted, contact=ContactTable(), time=TimeTable())
        self.arm = arm
        self._names = tuple(names)
        blank = RawSignals("", self._names, np.zeros(1, np.int64), np.zeros((1, len(self._names))))
        raw = RawRecording(where, Path(where), "LeRobot", lambda: iter((blank,)))
        columns: Columns = find_columns(arm, raw)
        place = {name: k for k, name in enumerate(self._names)}
        (listed,) = columns.streams.values()
        self._places = {key: [place[listed[k]] for k in places] for key, (_, places) in columns.signals.items()}

    def signals(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """q [rad] and what else is measured, (rows, joints) each, of numbers (rows, names).

        Raises:
            RecordingError: positions that no joint reaches, so that they are in other units.
        """
        made = {
            key: np.ascontiguousarray(in_si(key, self.arm.signals[key], rows[:, places], self.arm))
            for key, places in self._places.items()
        }
        far = np.abs(made["q"]) > MOST_RAD
        if far.any():
            row, joint = np.argwhere(far)[0]
            column, unit = self._places["q"][joint], self.arm.signals["q"].unit
            raise RecordingError(
                f"{self._names[column]} = {rows[row, column]:g} is no angle in {unit}: say in {self.arm.path}, "
                "[signals.q] and [signals.q_des], whether unit is 'deg' or 'normalised' (LeRobot's -100 to 100, with "
                "its calibration file)"
            )
        return made
