"""The force that an alarm's touch would be at a frame that the user names, in newtons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tauext._core import Bundle, WrenchModel
from tauext.errors import ConfigError

SURE = 2.0
"""Standard errors that a force is said to be wrong by at most, along its worst direction: 19 of 20 are less."""
INCONSISTENT = 0.01
"""Less probable than this, and no force at the frame explains what the joints show."""


@dataclass(frozen=True)
class FrameForce:
    """A force alone at a frame's origin, along the base's axes."""

    frame: str
    force_n: tuple[float, float, float]
    covariance: tuple[float, ...]
    """(3, 3) row by row, [N^2]."""
    blind: int
    """Directions that the pose cannot show."""
    consistent: float
    """Probability that a force there leaves so much unexplained."""
    blind_directions: tuple[tuple[float, ...], ...] = ()
    """Those that the pose cannot show, unit vectors along the base's axes."""
    left_out: tuple[str, ...] = ()
    """Joints that do not answer in N m: they tell nothing of it."""

    @property
    def size_n(self) -> float:
        return float(np.linalg.norm(self.force_n))

    @property
    def off_n(self) -> float:
        """What it may be wrong by, [N]."""
        return SURE * float(np.sqrt(np.linalg.eigvalsh(np.reshape(self.covariance, (3, 3)))[-1]))


class ForceAtFrame:
    """Tells forces at one frame of a bundle's arm."""

    def __init__(self, bundle: Bundle, frame: str) -> None:
        """Raises ConfigError where the bundle tells no force, or has no such frame."""
        self._model, self._frame = WrenchModel(bundle), frame
        if self._model.refused:
            raise ConfigError(f"wrench = {frame!r}: no force can be told, {self._model.refused}")
        names = [one.name for one in self._model.frames]
        if frame not in names:
            raise ConfigError(f"wrench = {frame!r} must be one of {', '.join(names)}")

    def find(self, q: np.ndarray, dq: np.ndarray | None, said: dict[str, np.ndarray], row: int) -> FrameForce | None:
        """Of a row of what the monitor said; None where it is not known."""
        at = slice(row, row + 1)
        told = self._model.wrenches(
            self._frame,
            q[at],
            said["tau_ext"][at] - said["load_nm"][at],
            said["sigma_nm"][at],
            [0.0, 0.0, 0.0],
            contact_sigma_nm=said["contact_sigma_nm"][at],
            dq=None if dq is None else dq[at],
        )
        if not np.isfinite(told["force"]).all():
            return None
        x, y, z = told["force"][0].tolist()
        blind = int(told["blind"][0])
        return FrameForce(
            frame=self._frame,
            force_n=(x, y, z),
            covariance=tuple(told["covariance"][0].ravel().tolist()),
            blind=blind,
            blind_directions=tuple(tuple(way) for way in told["blind_directions"][0][:blind, :3].tolist()),
            left_out=tuple(self._model.left_out),
            consistent=float(told["consistent"][0]),
        )


def frame_force_words(force: FrameForce) -> str:
    """`23 N at tool0 (up to 4 N wrong), 12° from -z`: from the nearest of the base's axes."""
    if force.consistent < INCONSISTENT:
        return f"no force at {force.frame} explains it"
    axis = int(np.argmax(np.abs(force.force_n)))
    along = abs(force.force_n[axis]) / max(force.size_n, 1e-9)
    degrees = np.degrees(np.arccos(min(along, 1.0)))
    sign = "-" if force.force_n[axis] < 0 else "+"
    if force.blind:
        ways = f"{force.blind} direction{'s' * (force.blind != 1)}"
        without = f" without {', '.join(force.left_out)}" if force.left_out else ""
        along_ways = " and ".join(f"({', '.join(f'{x:.1f}' for x in way)})" for way in force.blind_directions)
        doubt = f"and {ways} that this pose cannot show{without}{': ' if along_ways else ''}{along_ways}"
    else:
        doubt = f"up to {max(force.off_n, 1):.0f} N wrong"
    return f"{force.size_n:.0f} N at {force.frame} ({doubt}), {degrees:.0f}° from {sign}{'xyz'[axis]}"


def frame_force_facts(force: FrameForce) -> dict:
    """As plain JSON."""
    return {
        "frame": force.frame,
        "force_n": list(force.force_n),
        "covariance": list(force.covariance),
        "blind": force.blind,
        "blind_directions": [list(way) for way in force.blind_directions],
        "left_out": list(force.left_out),
        "consistent": force.consistent,
    }
