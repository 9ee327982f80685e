"""What is sent to the arm while and after it collides."""

from __future__ import annotations

from collections.abc import Mapping

Action = dict[str, float]


class CollisionStop(RuntimeError):
    """The arm collided and on_collision is stop: it was told to stay where it is, and the program ends."""


class Hold:
    """Keeps the arm where it collided until the commanded goal comes back there.

    Goals are elements `<joint>.pos`; other elements of an action pass as they are.
    """

    def __init__(self, resume_within: float):
        self._within = resume_within
        self._held: Action = {}

    @property
    def holding(self) -> bool:
        """Whether goals are replaced."""
        return bool(self._held)

    def begin(self, present: Mapping[str, float]) -> Action:
        """Hold this position; it stays if one is held already."""
        if not self._held:
            self._held = dict(present)
        return dict(self._held)

    def end(self) -> None:
        """Goals pass again."""
        self._held = {}

    def passed(self, action: Mapping[str, float], touching: bool) -> Action:
        """The action to send: the held position in it, unless it comes back to that and nothing is touched any more."""
        if self._held and not touching:
            near = all(abs(float(action[k]) - held) <= self._within for k, held in self._held.items() if k in action)
            if near:
                self.end()
        return dict(action) | {k: held for k, held in self._held.items() if k in action}
