"""Where a person wants the hand: free moves, a press on the table, taps."""

from __future__ import annotations

import numpy as np

from felt.session import Wish

LOW_M, HIGH_M = np.array([-0.07, -0.15, -0.06]), np.array([0.03, 0.15, 0.09])
"""Free moves stay within, beside where the hand began: far from the arm being straight or folded."""


def moves(seconds: float, rng: np.random.Generator) -> Wish:
    """Minimum-jerk moves between random places, 0.7 to 2.5 s long, some with a rest of up to 1 s after them."""
    ends, places = [0.0], [np.zeros(3)]
    while ends[-1] < seconds:
        ends.append(ends[-1] + rng.uniform(0.7, 2.5))
        places.append(rng.uniform(LOW_M, HIGH_M))
        if rng.random() < 0.3:
            ends.append(ends[-1] + rng.uniform(0.2, 1.0))
            places.append(places[-1])

    def wish(t: float) -> np.ndarray:
        k = min(int(np.searchsorted(ends, t, side="right")), len(ends) - 1)
        s = float(np.clip((t - ends[k - 1]) / (ends[k] - ends[k - 1]), 0, 1))
        return places[k - 1] + (10 * s**3 - 15 * s**4 + 6 * s**5) * (places[k] - places[k - 1])

    return wish


def press(deep_m: float, down_s: float = 1.0, until_s: float = np.inf) -> Wish:
    """Down by deep_m within down_s, there until until_s, and up again."""

    def wish(t: float) -> np.ndarray:
        down = np.clip(min(t - 1.0, until_s + down_s - t) / down_s, 0, 1)
        return np.array([0, 0, -deep_m * down])

    return wish


def taps(deep_m: float, hz: float) -> Wish:
    """Up and down from the second second on, down to deep_m."""

    def wish(t: float) -> np.ndarray:
        return np.array([0, 0, -deep_m * (0.5 - 0.5 * np.cos(2 * np.pi * hz * max(t - 1.0, 0)))])

    return wish
