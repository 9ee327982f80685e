"""What is added to the frames of a LeRobot dataset."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tauext.bundle.estimates import COLLISION, CONTACT, OK

CONTACT_NAME, COLLISION_NAME = "contact", "collision"
UNKNOWN = -1.0
"""contact and collision while the monitor knows nothing: warming up, or a fault; tau_ext is 0 there, since a single NaN
makes LeRobot's statistics, and a policy that is normalised by them, NaN."""


@dataclass(frozen=True)
class Labels:
    """One row a frame, all float32, as LeRobot stores them; never NaN."""

    tau_ext: np.ndarray
    """(frames, joints), external torque in the bundle's estimate units; 0 where it is unknown."""
    contact: np.ndarray
    """(frames,), 1 touched (by a collision, too), 0 free, -1 unknown."""
    collision: np.ndarray
    """(frames,), 1, 0, -1."""

    @property
    def columns(self) -> np.ndarray:
        """(frames, joints + 2), in the order of element_names()."""
        return np.column_stack([self.tau_ext, self.contact, self.collision]).astype(np.float32)


def labels_of(health: np.ndarray, held_alarm: np.ndarray, tau_ext: np.ndarray) -> Labels:
    """Labels of a monitor's answers.

    Args:
        health: (frames,), by the core's number.
        held_alarm: (frames,), the level without latch.
        tau_ext: (frames, joints), float32.
    """
    known = (health == OK) & np.isfinite(tau_ext).all(axis=1)
    return Labels(
        np.where(known[:, None], tau_ext, np.float32(0)).astype(np.float32),
        np.where(known, held_alarm >= CONTACT, UNKNOWN).astype(np.float32),
        np.where(known, held_alarm >= COLLISION, UNKNOWN).astype(np.float32),
    )


def bare_name(element: str) -> str:
    """A joint as LeRobot calls its motor: without `.pos`."""
    return element.removesuffix(".pos")


def element_names(joints: Sequence[str]) -> list[str]:
    """Names of the labels' columns: `<joint>.tau_ext` of every joint as the dataset names it, contact, collision."""
    return [*(f"{bare_name(joint)}.tau_ext" for joint in joints), CONTACT_NAME, COLLISION_NAME]
