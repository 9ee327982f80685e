"""Labels for the frames of a LeRobot robot while they are recorded."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.bundle.estimates import COLLISION, CONTACT, OK
from tauext.data.assemble import Columns, find_columns, in_si
from tauext.data.description import NEEDS, Arm, ContactTable, TimeTable
from tauext.data.importers.raw import RawRecording, RawSignals
from tauext.errors import BundleError, ConfigError, RecordingError
from tauext.monitor.source import settings_of
from tauext.monitor.turns import Turns
from tauext_lerobot.lerobot_folder import frame_stamps

# --- Labels of the frames of a LeRobot dataset.


UNKNOWN = -1.0
"""contact and collision while there is no estimate: warming up, or a fault. tau_ext is 0 there, since a single NaN
would make LeRobot's statistics NaN, and with them every policy normalised by these."""


@dataclass(frozen=True)
class Labels:
    """One row per frame, float32 as LeRobot stores it; never NaN."""

    tau_ext: np.ndarray
    """(frames, joints), external torque in the bundle's estimate units; 0 where it is unknown."""
    contact: np.ndarray
    """(frames,), 1 contact or collision, 0 free, -1 unknown."""
    collision: np.ndarray
    """(frames,), 1, 0, -1."""

    @property
    def columns(self) -> np.ndarray:
        """(frames, joints + 2), in the order of element_names()."""
        return np.column_stack([self.tau_ext, self.contact, self.collision]).astype(np.float32)


def labels_of(health: np.ndarray, held_alarm: np.ndarray, tau_ext: np.ndarray) -> Labels:
    """Labels from a monitor's estimates.

    Args:
        health: (frames,), the core's numbers.
        held_alarm: (frames,), alarm level without the latch.
        tau_ext: (frames, joints), float32.
    """
    known = (health == OK) & np.isfinite(tau_ext).all(axis=1)
    return Labels(
        np.where(known[:, None], tau_ext, np.float32(0)).astype(np.float32),
        np.where(known, held_alarm >= CONTACT, UNKNOWN).astype(np.float32),
        np.where(known, held_alarm >= COLLISION, UNKNOWN).astype(np.float32),
    )


def bare_name(element: str) -> str:
    """Name of a joint's motor in LeRobot: without `.pos`."""
    return element.removesuffix(".pos")


def element_names(joints: Sequence[str]) -> list[str]:
    """Names of the labels' columns: `<joint>.tau_ext` of every joint as the dataset names it, contact, collision."""
    return [*(f"{bare_name(joint)}.tau_ext" for joint in joints), "contact", "collision"]


# --- From numbers of LeRobot frames to signals in SI units, for a whole episode or one frame.


class ServoFrames:
    """Extracts position and raw servo signals, in SI units, from frames whose numbers have the given names.

    Raises:
        BundleError: the bundle does not compute torque from servo signals, or has other joints.
        ConfigError: a column of the description is missing, or the description lacks the signal of the torque.
    """

    def __init__(self, bundle: _core.Bundle, arm: Arm, names: Sequence[str], where: str):
        if not bundle.servo.on:
            raise BundleError(
                f"bundle '{bundle.name}' takes measured torque, which LeRobot's state and action do not hold; "
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
                f"{arm.path}: [signals.{needed}] is missing; bundle '{bundle.name}' computes torque from it ({source})"
            )
        used = {"q", "q_des", "dq", "current", "duty", "voltage"} | ({"tau"} if needed == "tau" else set())
        wanted = {name: table for name, table in arm.signals.items() if name in used or name == "tau"}
        arm = replace(arm, signals=wanted, contact=ContactTable(), time=TimeTable())
        self.arm, self._bundle = arm, bundle
        self._names, self._input = tuple(names), _core.ServoInput(bundle.servo)
        self.restart()
        blank = RawSignals("", self._names, np.zeros(1, np.int64), np.zeros((1, len(self._names))))
        raw = RawRecording(where, Path(where), "LeRobot", lambda: iter((blank,)))
        columns: Columns = find_columns(arm, raw)
        place = {name: k for k, name in enumerate(self._names)}
        (listed,) = columns.streams.values()
        self._places = {key: [place[listed[k]] for k in places] for key, (_, places) in columns.signals.items()}

    def restart(self) -> None:
        """Begin another episode with the next frame."""
        self._turns = Turns(settings_of(self._bundle), self._bundle)
        self._input.reset()

    def signals(self, t_ns: np.ndarray, rows: np.ndarray) -> dict[str, np.ndarray]:
        """q [rad] without jumps of whole turns, and the other measured signals, (rows, joints) each.

        Args:
            t_ns: stamps, (rows,), [ns].
            rows: numbers, (rows, names), of frames that follow those of the last call.

        Raises:
            RecordingError: positions are beyond any joint's range, so they are in other units.
        """
        made = {
            key: np.ascontiguousarray(in_si(key, self.arm.signals[key], rows[:, places], self.arm))
            for key, places in self._places.items()
        }
        far = np.abs(made["q"]) > 8 * math.pi  # four turns
        if far.any():
            row, joint = np.argwhere(far)[0]
            column, unit = self._places["q"][joint], self.arm.signals["q"].unit
            raise RecordingError(
                f"{self._names[column]} = {rows[row, column]:g} is no angle in {unit}: set the unit of [signals.q] and "
                f"[signals.q_des] in {self.arm.path} to 'deg' or 'normalised' (LeRobot's -100 to 100, with its "
                "calibration file)"
            )
        made["q"], goals = self._turns.rows(t_ns, made["q"], made.get("q_des"))
        return made if goals is None else made | {"q_des": goals}

    def sample(self, t_ns: int, values: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q, dq and tau, (joints,) each, of the next frame: as a monitor takes them. Raises as signals()."""
        row = np.array([[values[name] for name in self._names]], dtype=np.float32).astype(np.float64)
        signals = {key: rows[0] for key, rows in self.signals(np.array([t_ns]), row).items()}
        q = signals.pop("q")
        return q, *self._input.step(t_ns, q, **signals)


# --- Labels of a robot's frames while they are recorded.


class FrameLabeller:
    """Labels each frame as `tauext label` labels the same frame in a dataset, equal to the last bit.

    The input are the numbers that the dataset stores: in single precision, at frame_index / fps. Frames are counted
    from the last restart.

    Args:
        names: names of the numbers that step() receives, as the importer writes them: `observation.state[elbow.pos]`.
        fps: rate of the dataset.

    Raises:
        BundleError: the bundle has other joints or another rate, or takes no servo signals.
        ConfigError: a column of the description is not among the names.
    """

    def __init__(self, bundle: _core.Bundle, arm: Arm, names: Sequence[str], fps: float):
        expect_rate(bundle, fps)
        self._frames, self._monitor = ServoFrames(bundle, arm, names, "the robot"), _core.Monitor(bundle)
        self._fps, self.frame = fps, 0
        """Frames since the last restart."""

    def restart(self) -> None:
        """Begin an episode with the next frame: reset the monitor, which warms up."""
        self._monitor.reset()
        self._frames.restart()
        self.frame = 0

    def step(self, values: Mapping[str, float]) -> Labels:
        """Labels of the next frame, one row."""
        t_ns = int(frame_stamps(np.array([self.frame]), self._fps)[0])
        sample = self._frames.sample(t_ns, values)
        self.frame += 1
        verdict = self._monitor.step(t_ns, *sample)
        return labels_of(
            np.array([verdict.health.value]),
            np.array([verdict.held_alarm.value]),
            np.array([verdict.tau_ext]).astype(np.float32),
        )


def expect_rate(bundle: _core.Bundle, fps: float) -> None:
    """Refuse frames of another rate than the bundle's.

    Raises:
        BundleError: the rates differ.
    """
    rate_hz = 1e9 / bundle.observer.sample_period_ns
    if abs(fps / rate_hz - 1) > bundle.rate_tolerance:
        raise BundleError(
            f"bundle '{bundle.name}' runs at {rate_hz:g} Hz, these frames at {fps:g} Hz; train one on recordings "
            "of that rate"
        )
