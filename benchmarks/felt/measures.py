"""What a session shows: how far the leader swings, what its motors gave, what was felt of the truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from felt.follower import TICK_S
from felt.session import Course

FIRST_S, LAST_S = (3.0, 5.0), (10.0, 12.0)
"""Stretches of a press that lasts 12 s: after the hand has come down, and the end."""


@dataclass(frozen=True)
class Swing:
    """Of one press."""

    first_mm: float
    """Peak to peak of the leader's hand along z in FIRST_S."""
    last_mm: float
    """In LAST_S."""
    given_j: float
    """What the leader's motors gave the hand in all, [J]; negative: they took."""
    most_given_j: float
    """The most that they had given at any time."""
    felt: float
    """Mean torque of the leader in LAST_S as a share of the wall's at the follower, joints that the wall loads."""

    @property
    def settles(self) -> bool:
        """Does not swing at the end: by no more than the hand trembles under the estimate's noise."""
        return self.last_mm < 3.0

    @property
    def grows(self) -> bool:
        """More at the end than at first."""
        return self.last_mm > 1.1 * self.first_mm and not self.settles


def swing(course: Course) -> Swing:
    """Of a press."""
    first, last = (slice(round(a / TICK_S), round(b / TICK_S)) for a, b in (FIRST_S, LAST_S))
    z = 1000 * course.leader_tip[:, 2]
    truth = np.abs(course.outside_nm[last].mean(axis=0))
    loaded = truth > 0.1
    felt = np.abs(course.torque_nm[last].mean(axis=0))[loaded].sum() / max(truth[loaded].sum(), 1e-9)
    given = course.given_j
    return Swing(float(np.ptp(z[first])), float(np.ptp(z[last])), float(given[-1]), float(given.max()), float(felt))
