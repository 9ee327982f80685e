"""How much a packed file may unpack to: more than any recording, and too little to fill the memory."""

from __future__ import annotations

from pathlib import Path

from tauext.errors import RecordingError
from tauext.files.preflight import in_words

LEAST = 1 << 28
"""Bytes that every file may unpack to; also the most of a part that is unpacked at once."""
RATIO = 200
"""Largest ratio of the sizes unpacked and packed: an arm at rest has below 100."""


def most_unpacked(packed: float) -> float:
    """Bytes that a file of so many bytes may unpack to."""
    return max(LEAST, RATIO * packed)


class Unpacked:
    """Counts what a file unpacks to, part by part; a part that is read twice counts once."""

    def __init__(self, path: Path) -> None:
        self._path, self._packed = path, path.stat().st_size
        self.most = most_unpacked(self._packed)
        self._parts: dict[int, int] = {}
        self._total = 0

    def add(self, size: int, part: int = -1) -> None:
        """Count the bytes of a part by its position, or more bytes of a stream.

        Raises:
            RecordingError: no recording unpacks to so much.
        """
        self._total += size - self._parts.get(part, 0)
        if part >= 0:
            self._parts[part] = size
        if self._total > self.most:
            raise RecordingError(
                f"{self._path}: it unpacks to more than {in_words(self.most)}, from {in_words(self._packed)}; no "
                "recording is packed like that"
            )
