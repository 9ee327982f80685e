"""Which of several publishers on one topic is followed."""

from __future__ import annotations

TAKEOVER_NS = 500_000_000
"""Silence after which another publisher is followed: longer than any pause that an arm's driver makes."""


class Followed:
    """The first that publishes the arm, until it is silent; then whoever publishes next. Never two at once."""

    def __init__(self) -> None:
        self._handle: int | None = None
        self._last_ns = 0

    def is_another(self, handle: int, now_ns: int) -> bool:
        """Whether this publisher is not the one that is followed now."""
        return self._handle not in (None, handle) and now_ns - self._last_ns <= TAKEOVER_NS

    def take(self, handle: int, now_ns: int) -> bool:
        """A sample by this publisher is used; True for the first since another one was followed."""
        changed = handle != self._handle
        self._handle, self._last_ns = handle, now_ns
        return changed
