"""What stands wrong now, in words, and what of it nobody was told yet."""

from __future__ import annotations

HOLD_NS = 2_000_000_000
"""A condition stands for so long after it was last seen: longer than the second between two diagnostics."""


class Conditions:
    """Sentences by key: one that comes again renews the old one."""

    def __init__(self) -> None:
        self._standing: dict[str, tuple[str, int]] = {}
        self._untold: list[str] = []

    def say(self, key: str, text: str, now_ns: int) -> None:
        """key: what it is about; a new text of a standing key takes the old one's place without being told again."""
        before = self._standing.get(key)
        if before is None or now_ns - before[1] > HOLD_NS:
            self._untold.append(text)
        self._standing[key] = (text, now_ns)

    def standing(self, now_ns: int) -> list[str]:
        """What was said within the last two seconds."""
        return [text for text, seen_ns in list(self._standing.values()) if now_ns - seen_ns <= HOLD_NS]

    def untold(self) -> list[str]:
        """What began since the last call."""
        told, self._untold = self._untold, []
        return told
