"""Force and moment at frames of the arm as ROS 2 messages: a WrenchStamped a frame, and its covariance beside it."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tauext import _core
from tauext.errors import ConfigError
from tauext.monitor.sink import Verdict
from tauext.sources.messages import (
    Float64MultiArray,
    Header,
    MultiArrayDimension,
    MultiArrayLayout,
    Time,
    Vector3,
    Wrench,
    WrenchStamped,
)
from tauext.sources.node import Node

LABEL = "force.x force.y force.z torque.x torque.y torque.z"
"""Of rows and columns of a covariance."""
SIDE = 6


class Wrenches:
    """Topics `wrench/NAME` and `wrench/NAME/covariance` of the frames that the settings name.

    A wrench is what the surroundings exert on the arm, at the frame's origin and along the frame's own axes, so that
    the header's frame_id is the frame and tf can turn it. Rows and columns of the covariance are those of LABEL.
    """

    def __init__(self, frames: Sequence[str], bundle: _core.Bundle | None):
        """Raises ConfigError where the bundle tells no force, or has no such frame."""
        self._frames = {topic_name(name): name for name in frames}
        if len(self._frames) < len(frames):
            raise ConfigError(f"ROS 2 wrench_frames {', '.join(frames)}: each needs a topic's name of its own")
        if not frames:
            return
        if bundle is None:
            raise ConfigError(f"ROS 2 wrench_frames {', '.join(frames)}: there is no bundle to tell forces with")
        self._model = _core.WrenchModel(bundle)
        if self._model.refused:
            raise ConfigError(f"ROS 2 wrench_frames {', '.join(frames)}: no force can be told, {self._model.refused}")
        known = [frame.name for frame in self._model.frames]
        for name in frames:
            if name not in known:
                raise ConfigError(f"ROS 2 wrench_frames {name!r} must be one of {', '.join(known)}")

    def open(self, node: Node) -> None:
        """Make the writers."""

        def writer(name: str, of: type) -> Any:
            return node.writer(node.settings.full_name(name), of, "reliable", "volatile", 8)

        self._writers = {
            frame: (writer(f"wrench/{topic}", WrenchStamped), writer(f"wrench/{topic}/covariance", Float64MultiArray))
            for topic, frame in self._frames.items()
        }

    @property
    def writers(self) -> list:
        """To be handed back to the node."""
        return [writer for pair in self._writers.values() for writer in pair]

    def tell(self, verdict: Verdict, stamp_ns: int, send: Callable[[Any, Any], bool]) -> None:
        """Send what is known of this sample; nothing of a frame of which nothing is."""
        if verdict.sample is None or not self._writers:
            return
        said, sample = verdict.said, verdict.sample
        rows = (sample.q[None], said["tau_ext"] - said["load_nm"], said["sigma_nm"])
        for frame, (wrenches, covariances) in self._writers.items():
            own = _core.WrenchAxes.frame
            told = self._model.wrenches(frame, *rows, None, own, said["contact_sigma_nm"], sample.dq[None])
            if np.isfinite(told["force"]).all():
                send(wrenches, wrench_message(frame, stamp_ns, told["force"][0], told["moment"][0]))
                send(covariances, covariance_message(told["covariance"][0]))


def topic_name(frame: str) -> str:
    """A frame's name with _ for what ROS 2 does not allow in a topic's."""
    name = re.sub(r"\W", "_", frame, flags=re.ASCII)
    return f"_{name}" if name[:1].isdigit() else name


def wrench_message(frame: str, stamp_ns: int, force: np.ndarray, moment: np.ndarray) -> WrenchStamped:
    """Force [N] and moment [N m] along the frame's own axes."""
    wrench = Wrench(Vector3(*force.tolist()), Vector3(*moment.tolist()))
    return WrenchStamped(Header(Time.of_ns(stamp_ns), frame), wrench)


def covariance_message(covariance: np.ndarray) -> Float64MultiArray:
    """(6, 6), row by row."""
    layout = MultiArrayLayout([MultiArrayDimension(LABEL, SIDE, SIDE * SIDE), MultiArrayDimension(LABEL, SIDE, SIDE)])
    return Float64MultiArray(layout, covariance.ravel().tolist())
