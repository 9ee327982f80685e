"""Goals that are sent to the arm during and after a collision."""

from __future__ import annotations

from collections.abc import Mapping

Action = dict[str, float]


class CollisionStop(RuntimeError):
    """The arm collided and on_collision is stop: it holds its position, and the program ends."""


class Hold:
    """Holds the arm where it collided until the commanded goal returns there.

    Goals are elements `<joint>.pos`; other elements of an action pass unchanged.
    """

    def __init__(self, resume_within: float):
        self._within = resume_within
        self._held: Action = {}

    @property
    def holding(self) -> bool:
        """Whether goals are replaced."""
        return bool(self._held)

    def begin(self, present: Mapping[str, float]) -> Action:
        """Hold this position; a position that is held already stays."""
        if not self._held:
            self._held = dict(present)
        return dict(self._held)

    def end(self) -> None:
        """End the hold: goals pass again."""
        self._held = {}

    def passed(self, action: Mapping[str, float], touching: bool) -> Action:
        """The action to send, with held goals. A hold ends if the goal is near it and nothing touches the arm."""
        if self._held and not touching:
            near = all(abs(float(action[k]) - held) <= self._within for k, held in self._held.items() if k in action)
            if near:
                self.end()
        return dict(action) | {k: held for k, held in self._held.items() if k in action}
