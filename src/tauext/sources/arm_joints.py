"""The arm's joints in messages that may hold them in any order, beside others, or not at all."""

from __future__ import annotations

import numpy as np

from tauext.sources.messages import JointState

FIELDS = ("position", "velocity", "effort")


class ArmJoints:
    """Picks positions, velocities and efforts of the arm, (joints,) each, in the order of `names`."""

    def __init__(self, names: tuple[str, ...]):
        """names: as the messages name them."""
        self.names = names
        self._of: list[str] = []
        self._rows: list[int] = []
        self._missing: list[str] = []

    def is_here(self, message: JointState) -> bool:
        """Whether the message has every joint of the arm; others may be in it."""
        if message.name != self._of:
            row = {name: k for k, name in reversed(list(enumerate(message.name)))}
            self._of, self._missing = message.name, [name for name in self.names if name not in row]
            self._rows = [row[name] for name in self.names if name in row]
        return not self._missing

    def missing(self, message: JointState) -> str:
        """Which joints a message lacks, in words."""
        self.is_here(message)
        return f"no {', '.join(self._missing)} among its joints {', '.join(message.name) or '(none)'}"

    def pick(self, message: JointState) -> tuple[np.ndarray, np.ndarray, np.ndarray] | str:
        """q [rad], dq [rad/s], tau [N m] of a message in which the arm is; or, in words, why there are none.

        NaN is handed on, since the monitor has a fault of its own for it.
        """
        values = [getattr(message, field) for field in FIELDS]
        for field, numbers in zip(FIELDS, values, strict=True):
            if len(numbers) != len(message.name):
                return (
                    f"{field} is empty: position, velocity and effort are needed"
                    if not numbers
                    else f"{field} has {len(numbers)} values for {len(message.name)} names"
                )
        q, dq, tau = (np.array(numbers, dtype=np.float64)[self._rows] for numbers in values)
        return q, dq, tau

    def not_finite(self, arrays: tuple[np.ndarray, ...]) -> str | None:
        """Which numbers are NaN or infinite, in words."""
        bad = [
            f"{field} of {', '.join(self.names[j] for j in np.flatnonzero(~np.isfinite(values)))}"
            for field, values in zip(FIELDS, arrays, strict=True)
            if not np.isfinite(values).all()
        ]
        return f"{' and '.join(bad)} is not a number" if bad else None
