"""The episode of an alarm: from its rise to its end, with its number, joint, kind, place and touch.

The core numbers alarms and decides when a touch is over: no torque, less an expected load, has been over a limit, and
all were known, for `contact_release_s` of the bundle. A contact ends then; so does a collision that was answered.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from tauext.bundle.estimates import NONE
from tauext.monitor.changes import AlarmChange, Change, TouchChange
from tauext.monitor.touch_place import PlaceChange

LASTS_NS = 5_000_000_000
"""A touch that lasts is reported again after this time, [ns]: a process may be killed before its end."""


@dataclass(frozen=True)
class Episode:
    """What is known of one alarm so far."""

    number: int
    """Counted by the core, from 1; of a source whose loop runs again, continued."""
    alarm: int
    """Its level; at its end the last one."""
    joint: int
    """The joint that raised it to this level."""
    bundle: str
    """The bundle that raised it."""
    t_ns: int | None = None
    """Stamp at which it rose, [ns]; None: under an earlier process, whose clock may have been another."""
    touch_t_ns: int = 0
    """Last stamp at which a torque was over a limit, [ns]; it grows until the alarm ends."""
    tau_ext_nm: float = np.nan
    """Torque of the joint when the alarm rose to its level."""
    limit_nm: float = np.nan
    touch: int = 0
    """Kind of touch, an index of TOUCHES."""
    place: PlaceChange | None = None
    """The newest place; None: none is known."""
    q: tuple[float, ...] = ()
    """Positions at the sample of the place, [rad]; empty: unknown."""
    over: tuple[float, ...] = ()
    """Largest torque of each joint while it was touched, divided by its collision limit."""
    is_touched: bool = True
    """Whether its touch lasts."""
    ended: bool = False


class EpisodeFinder:
    """Follows the alarm that stands, sample after sample."""

    def __init__(self, bundle: str = ""):
        self.bundle = bundle
        """Name of the bundle that raises the next alarm."""
        self.standing: Episode | None = None
        """The alarm that stands; None: none does."""
        self._over, self._touch_t_ns, self._last_ns = np.zeros(0), 0, 0

    def stand(self, number: int, alarm: int, joint: int) -> None:
        """This alarm stands from before the first sample on."""
        self.standing = Episode(number, alarm, joint, self.bundle)

    def find(
        self, t_ns: int, estimates: Mapping[str, np.ndarray], changes: Sequence[Change], q: np.ndarray | None = None
    ) -> tuple[Episode, ...]:
        """Alarms of which something is new at this sample, usually none.

        Args:
            estimates: one row of Monitor.run.
            changes: at this sample.
            q: positions, (joints,), [rad]; None: the sample is missing.
        """
        if self.standing is None and not changes:
            return ()
        news: dict[int, Episode] = {}
        for change in changes:
            if isinstance(change, AlarmChange):
                if self.standing is not None and NONE in (change.alarm, change.was):
                    news[self.standing.number] = replace(self._so_far(), is_touched=False, ended=True)
                    self.standing = None
                if change.alarm != NONE and change.joint >= 0:
                    self._rise(t_ns, change, news)
            elif isinstance(change, TouchChange):
                self._learn(change.number, news, touch=change.touch)
            elif isinstance(change, PlaceChange):
                self._learn(change.number, news, place=change, q=() if q is None else tuple(q.tolist()))
        if (one := self.standing) is not None:
            if estimates["held_alarm"][0]:
                share = 1 - estimates["margin_nm"][0] / estimates["limit_nm"][0]
                self._over = np.fmax(self._over, share) if len(self._over) else share
            self._touch_t_ns = max(self._touch_t_ns, int(estimates["touch_t_ns"][0]))
            is_touched = not estimates["touch_over"][0]
            so_far = self._so_far()
            lasts = is_touched and so_far.touch_t_ns > one.touch_t_ns + LASTS_NS
            was_set_back = q is not None and t_ns < self._last_ns and so_far != one  # what follows is of another clock
            self._last_ns = self._last_ns if q is None else t_ns
            if one.number in news or lasts or was_set_back or (one.is_touched and not is_touched):
                self.standing = news[one.number] = replace(so_far, is_touched=is_touched)
            elif is_touched and not one.is_touched:  # again; its end is news
                self.standing = replace(one, is_touched=True)
        return tuple(news.values())

    def _rise(self, t_ns: int, change: AlarmChange, news: dict[int, Episode]) -> None:
        """To the first or to a higher level."""
        if self.standing is None:
            self._over, self._touch_t_ns, self._last_ns = np.zeros(0), t_ns, t_ns
            self.standing = Episode(change.number, change.alarm, change.joint, self.bundle, t_ns, t_ns)
        self._learn(
            self.standing.number,
            news,
            alarm=change.alarm,
            joint=change.joint,
            tau_ext_nm=change.tau_ext_nm,
            limit_nm=change.limit_nm,
        )

    def _learn(self, number: int, news: dict[int, Episode], **values: Any) -> None:
        """Set what became known of an alarm that stands or has just ended."""
        if self.standing is not None and self.standing.number == number:
            self.standing = news[number] = replace(self.standing, **values)
        elif number in news:
            news[number] = replace(news[number], **values)

    def _so_far(self) -> Episode:
        """The alarm that stands with its touch up to here. A clock that was set back adds nothing."""
        assert self.standing is not None
        if self.standing.t_ns is None:
            return self.standing
        return replace(self.standing, touch_t_ns=self._touch_t_ns, over=tuple(self._over.tolist()))
