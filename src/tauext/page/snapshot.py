"""What a viewer is told of a simulation: how things stand, and what happened since it last asked."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from tauext.page.hand import Held
from tauext.page.places import Placed


@dataclass(frozen=True)
class Verdict:
    """What one method says now."""

    health: str
    alarm: str
    joint: int
    """That raised the alarm, -1 for none."""
    kind: str = "none"
    """Of the touch: impact, push, clamp or load; unknown, or none without an alarm."""
    force_n: float = float("nan")
    """Of the touch at its most probable place, when it was felt last; NaN where nothing says it."""


@dataclass(frozen=True)
class Event:
    """A method raised a contact or a collision."""

    time_s: float
    method: str
    alarm: str
    joint: int
    after_push_s: float | None
    """Since a push began; None: nothing pushed."""
    by_weight: bool = False
    """A weight in the hand of which this method does not know, or that has just gone; without push or weight the alarm
    is false."""


@dataclass(frozen=True)
class Touch:
    """A push, true and estimated."""

    joint: int
    point_m: np.ndarray
    target_m: np.ndarray
    """Where the pointer pulls to."""
    force_n: np.ndarray
    estimate_n: np.ndarray
    directions: int
    """Of the force that the joints' torques show, 0 to 3."""


@dataclass
class Snapshot:
    """What a viewer draws; arrays over the joints where nothing else is said."""

    time_s: float
    poses: np.ndarray
    """Of the links in the base frame: position and quaternion w, x, y, z, (joints, 7)."""
    doing: str
    method: str
    tau_ext: np.ndarray
    """Estimate of the method shown, [N m]; NaN while it warms up."""
    limit_nm: np.ndarray
    verdicts: dict[str, Verdict]
    touch: Touch | None
    trace: np.ndarray
    """Since the last snapshot, (rows, 1 + 4 joints): time, estimate, standard error (0: unknown), limit, truth."""
    events: list[Event] = field(default_factory=list)
    """Since the last snapshot."""
    real_time_factor: float = float("nan")
    held: Held | None = None
    """The weight in the hand."""
    placed: Placed | None = None
    """Where the method shown takes the touch to be; None while no joint of it is over a limit."""
    places_refused: str = ""
    """Why that method tells no place; empty: it does."""
