"""Who did not answer: readings of a bus in which a servo is missing, counted by servo, told when it begins and ends."""

from __future__ import annotations

from collections.abc import Callable, Collection

TOLD_AFTER = 5
"""Readings in a row that a servo misses before a person is told: a lost packet is none."""


class DropOuts:
    """Of one bus."""

    def __init__(self, names: dict[int, str], note: Callable[[str], None]):
        """names: of the servos by id."""
        self._names, self._note = names, note
        self._in_a_row = dict.fromkeys(names, 0)
        self.missed = dict.fromkeys(names, 0)
        """Readings without it, by id."""
        self.corrupt = self.refused = 0
        """Packets that could not be used; readings in which a servo was missing."""

    def whole(self, came: Collection[int], corrupt: int) -> bool:
        """Whether all servos came; counts those that did not."""
        self.corrupt += corrupt
        for id_, name in self._names.items():
            if id_ not in came:
                self.missed[id_] += 1
                self._in_a_row[id_] += 1
                if self._in_a_row[id_] == TOLD_AFTER:
                    self._note(f"{name} does not answer: no sample until it does")
            else:
                if self._in_a_row[id_] >= TOLD_AFTER:
                    self._note(f"{name} answers again, after {self._in_a_row[id_]} readings without it")
                self._in_a_row[id_] = 0
        missing = len(came) < len(self._names)
        self.refused += missing
        return not missing

    def summary(self) -> str:
        """In one line what was missing; empty: nothing was."""
        if not self.refused:
            return ""
        by_name = ", ".join(f"{self._names[id_]} in {count}" for id_, count in self.missed.items() if count)
        packets = f"; {self.corrupt} packets could not be used" if self.corrupt else ""
        return f"a servo was missing in {self.refused} readings: {by_name}{packets}"

    def forget(self) -> None:
        """Begin to count anew."""
        self.refused = self.corrupt = 0
        self.missed = dict.fromkeys(self._names, 0)
