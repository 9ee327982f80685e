"""A robot's frames labelled while they are made, from the numbers that the dataset will hold."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from tauext import _core
from tauext.data.description import Arm
from tauext.data.lerobot_folder import frame_stamps
from tauext.errors import BundleError
from tauext.sources.labels import Labels, labels_of
from tauext.sources.servo_frames import ServoFrames


class FrameLabeller:
    """Labels frame after frame what `tauext label` says of the same frames in a dataset, to the last bit.

    It sees what is stored: numbers in single precision, at frame_index / fps. Frames are counted from the last restart.

    Args:
        names: of the numbers that step() gets, as the importer names them: `observation.state[elbow.pos]`.
        fps: of the dataset.

    Raises:
        BundleError: the bundle is for other joints or another rate, or for no servos.
        ConfigError: what the description names is not among the names.
    """

    def __init__(self, bundle: _core.Bundle, arm: Arm, names: Sequence[str], fps: float):
        expect_rate(bundle, fps)
        self._frames = ServoFrames(bundle, arm, names, "the robot")
        self._names = tuple(names)
        self._input, self._monitor = _core.ServoInput(bundle.servo), _core.Monitor(bundle)
        self._fps, self._frame = fps, 0

    @property
    def frame(self) -> int:
        """Frames since the last restart."""
        return self._frame

    def restart(self) -> None:
        """The next frame is the first of an episode; the monitor begins anew and warms up."""
        self._input.reset()
        self._monitor.reset()
        self._frame = 0

    def step(self, values: Mapping[str, float]) -> Labels:
        """Labels of one more frame, a row each."""
        row = np.array([[values[name] for name in self._names]], dtype=np.float32).astype(np.float64)
        signals = {key: rows[0] for key, rows in self._frames.signals(row).items()}
        t_ns = int(frame_stamps(np.array([self._frame]), self._fps)[0])
        self._frame += 1
        q = signals.pop("q")
        dq, tau = self._input.step(t_ns, q, **signals)
        said = self._monitor.step(t_ns, q, dq, tau)
        return labels_of(
            np.array([said.health.value]),
            np.array([said.held_alarm.value]),
            np.array([said.tau_ext]).astype(np.float32),
        )


def expect_rate(bundle: _core.Bundle, fps: float) -> None:
    """Refuse frames that come at another rate than the bundle's recordings."""
    rate_hz = 1e9 / bundle.observer.sample_period_ns
    if abs(fps / rate_hz - 1) > bundle.rate_tolerance:
        raise BundleError(
            f"bundle '{bundle.name}' runs at {rate_hz:g} Hz, these frames at {fps:g}; train one on recordings of "
            "that rate"
        )
