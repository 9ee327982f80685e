"""What touches an arm, as bodies with mass, springs and limits: each says its force from how the two sides move.

All of it happens along one line. `x_m` and `v_m_s` are the arm's place and speed along it, away from what touches; a
force of more than 0 pushes the arm that way. Nothing pulls.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

SUBSTEPS = 4
"""Of a free mass in a step of the arm."""
TREMOR_SHARE, TREMOR_HZ = 0.03, 9.0
"""Of a hand that pushes: physiological tremor."""
STRONGER = 1.5
"""Times what it wants to push with: so much a hand holds out before it gives way."""


class Cause(Protocol):
    """One touch."""

    def force_n(self, t_s: float, x_m: float, v_m_s: float, dt_s: float) -> float:
        """The force over the next step; called once a step, from t_s = 0 with x_m = 0 on."""
        ...


@dataclass
class Mass:
    """A free body that flies or swings into the arm, or stands where the arm runs into it; it bounces off."""

    mass_kg: float
    speed_m_s: float
    """Towards the arm; 0: it stands still."""
    stiffness_n_m: float
    damping_ratio: float
    place_m: float = 0.0
    gone: bool = False

    def force_n(self, t_s: float, x_m: float, v_m_s: float, dt_s: float) -> float:
        total, damping = 0.0, 2 * self.damping_ratio * np.sqrt(self.stiffness_n_m * self.mass_kg)
        for k in range(SUBSTEPS):
            into = self.place_m - (x_m + v_m_s * k * dt_s / SUBSTEPS)
            touches = into > 0 and not self.gone
            force = max(0.0, self.stiffness_n_m * into + damping * (self.speed_m_s - v_m_s)) if touches else 0.0
            self.gone = self.gone or (into < 0 and t_s > 0)
            self.speed_m_s -= force / self.mass_kg * dt_s / SUBSTEPS
            self.place_m += self.speed_m_s * dt_s / SUBSTEPS
            total += force / SUBSTEPS
        return total


@dataclass
class Hand:
    """A springy hand that wants to push with a force: its anchor follows, slowly, wherever that force is.

    F = clip(k (a - x) + c (da/dt - v), 0, 1.5 peak),  da/dt = (wanted - F) / (k yields_s)
    """

    peak_n: float
    rise_s: float
    hold_s: float
    fall_s: float
    stiffness_n_m: float
    yields_s: float
    damping_n_s_m: float = 20.0
    anchor_m: float = 0.0

    def wanted_n(self, t_s: float) -> float:
        """A raised cosine up, and one down again."""
        if t_s < self.rise_s:
            share = t_s / self.rise_s
        else:
            share = min(1.0, max(0.0, (self.rise_s + self.hold_s + self.fall_s - t_s) / self.fall_s))
        tremor = 1 + TREMOR_SHARE * np.sin(2 * np.pi * TREMOR_HZ * t_s)
        return self.peak_n * 0.5 * (1 - np.cos(np.pi * share)) * tremor

    def force_n(self, t_s: float, x_m: float, v_m_s: float, dt_s: float) -> float:
        wanted, follows = self.wanted_n(t_s), self.stiffness_n_m * self.yields_s
        # solved for F: with the anchor's speed of the step before, soft hands would swing from step to step
        force = self.stiffness_n_m * (self.anchor_m - x_m) + self.damping_n_s_m * (wanted / follows - v_m_s)
        force /= 1 + self.damping_n_s_m / follows
        most = STRONGER * self.peak_n
        if force > most:  # it is pushed back
            self.anchor_m -= (force - most) / self.stiffness_n_m
        force = min(max(force, 0.0), most)
        self.anchor_m += (wanted - force) / follows * dt_s
        return force


@dataclass
class Obstacle:
    """A wall, or a body part before one: it stays; or a press that closes at a steady speed up to a force."""

    stiffness_n_m: float
    damping_n_s_m: float
    closes_m_s: float = 0.0
    most_n: float = np.inf
    """Where a press stops."""
    place_m: float = field(default=0.0)

    def force_n(self, t_s: float, x_m: float, v_m_s: float, dt_s: float) -> float:
        into = self.place_m - x_m
        if into <= 0 and t_s > 0:
            closing, force = self.closes_m_s, 0.0
        else:
            closing = self.closes_m_s if self.stiffness_n_m * into < self.most_n else 0.0
            force = max(0.0, self.stiffness_n_m * into + self.damping_n_s_m * (closing - v_m_s))
        self.place_m += closing * dt_s
        return force
