"""The episode of an alarm: from its rise to its end, with its number, joint, kind, place and touch.

The core numbers alarms and decides when a touch is over: no torque, less an expected load, has been over a limit, and
all were known, for `contact_release_s` of the bundle. A contact ends then; so does a collision that was answered.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Any

import numpy as np

from tauext.bundle.estimates import ALARMS, COLLISION, CONTACT, FIRST_KIND, TOUCHES, number, rounded, unexplained
from tauext.bundle.units import short
from tauext.monitor.changes import Change, with_article
from tauext.monitor.touch_place import PlaceChange, force_words, run_of

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
    torque_nm: float = np.nan
    """Torque of the joint, less what a load or a declared contact explains, where it exceeded its limit most."""
    limit_nm: float = np.nan
    """Limit of that sample, of the alarm's level."""
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
    row: int = 0
    """Number of the sample at which the newest of this became known."""

    @property
    def placed(self) -> PlaceChange | None:
        """The place, if a single force on a link explains the touch."""
        return self.place if self.place is not None and self.place.explains else None

    def sentence(self, joints: tuple[str, ...]) -> str:
        """`Touched at joint6, 70 to 100 N`; without a place the joint whose torque is too large."""
        if (place := self.placed) is None:
            return f"Touched at {joints[self.joint]} or beyond it"
        return f"Touched at {links_at(place, joints)}, {force_words(place.interval_n)}"

    def words(self, joints: tuple[str, ...], units: Sequence[str]) -> str:
        """`COLLISION, a push on the link of joint2: 12.4 Nm at joint2, limit 6.1 Nm`."""
        unit = short(units[self.joint]) if units else "Nm"
        kind = f", {with_article(TOUCHES[self.touch])}" if self.touch >= FIRST_KIND else ""
        place = "" if self.placed is None else f" on {self.placed.on(joints)}"
        level = ALARMS[self.alarm].upper() if self.alarm == COLLISION else ALARMS[self.alarm].capitalize()
        torque = abs(self.torque_nm)
        sizes = [f"{torque:.3g} {unit} at {joints[self.joint]}"] if math.isfinite(torque) else []
        sizes += [f"threshold {self.limit_nm:.3g} {unit}"] if math.isfinite(self.limit_nm) else []
        return f"{level}{kind}{place}: {', '.join(sizes) or joints[self.joint]}"

    def facts(self, joints: tuple[str, ...], units: Sequence[str]) -> dict[str, Any]:
        """What is known, as plain JSON. Of an alarm that stands since an earlier process, what is new."""
        facts: dict[str, Any] = {"id": self.number, "ended": self.ended}
        if self.t_ns is not None:
            held = {"held_ns": self.touch_t_ns, "over": rounded(self.over)}
            facts |= {"bundle": self.bundle, "t_ns": self.t_ns, **held, "touch": None, "links": []}
            facts |= {"newtons": None, "newtons_interval": None}
        if self.touch >= FIRST_KIND:
            facts["touch"] = TOUCHES[self.touch]
        if math.isfinite(self.limit_nm):  # else it has risen under an earlier process
            facts |= {"level": ALARMS[self.alarm], "joint": joints[self.joint], "limit_nm": number(self.limit_nm)}
            facts |= {"tau_ext_nm": number(self.torque_nm), "sentence": self.sentence(joints)}
            facts["details"] = self.words(joints, units)
        if (place := self.placed) is not None:
            best = {name: list(getattr(place.best, name)) for name in ("point", "force")}
            facts |= {
                "at": links_at(place, joints),
                "links": [[joints[link], round(share, 3)] for link, share in place.links],
                "newtons": number(place.newtons),
                "newtons_interval": rounded(place.interval_n),
                "on": place.on(joints),
                "place": {"link": place.best.link, **best, "q": rounded(self.q)},
            }
        return facts


def links_at(place: PlaceChange, joints: tuple[str, ...]) -> str:
    """`joint2, joint3 or joint4`: the joints that carry the stated links."""
    first, last, _ = run_of(place.links)
    names = [*joints[first : last + 1], *(joints[link] for link in place.straight)]
    return " or ".join([", ".join(names[:-1])] * (len(names) > 1) + names[-1:])


class EpisodeFinder:
    """Follows the alarm that stands, block after block; the result does not depend on the blocks."""

    def __init__(self, bundle: str = ""):
        self.bundle = bundle
        """Name of the bundle that raises the next alarm."""
        self.standing: Episode | None = None
        """The alarm that stands; None: none does."""
        self._over, self._touch_t_ns, self._last_ns = np.zeros(0), 0, 0
        self._peak = (np.nan, np.nan)
        """Torque of the alarm's joint where it exceeded its limit most, and that limit."""

    def stand(self, number: int, alarm: int, joint: int) -> None:
        """This alarm stands from before the first sample on."""
        self.standing = Episode(number, alarm, joint, self.bundle)

    def find(
        self,
        first_row: int,
        t_ns: np.ndarray,
        estimates: Mapping[str, np.ndarray],
        changes: Sequence[Change],
        q: np.ndarray | None = None,
    ) -> tuple[Episode, ...]:
        """Alarms of which something is new at these samples, usually none, in order.

        Args:
            first_row: number of samples before these.
            t_ns: (rows,), [ns].
            estimates: their rows of Monitor.run.
            changes: at these samples, by rising row.
            q: positions, (rows, joints), [rad]; None: the sample is missing.
        """
        if self.standing is None and not changes:
            return ()
        by_row = {row - first_row: list(group) for row, group in groupby(changes, key=lambda change: change.row)}
        found: list[Episode] = []
        begin = 0
        for k in self._turning_points(t_ns, estimates, by_row):
            self._follow(t_ns, estimates, slice(begin, k), q is not None)
            news = self._apply(by_row.get(k, ()), int(t_ns[k]), None if q is None else q[k])
            self._judge(k, t_ns, estimates, news, q is not None)
            found += [replace(one, row=first_row + k) for one in news.values()]
            begin = k + 1
        return tuple(found)

    def _turning_points(
        self, t_ns: np.ndarray, estimates: Mapping[str, np.ndarray], by_row: Mapping[int, list[Change]]
    ) -> list[int]:
        """Rows at which something may be new, and the last one."""
        rows = {0, len(t_ns) - 1, *by_row}
        if len(t_ns) > 1:
            ends, is_set_back = np.diff(estimates["touch_over"].astype(int)) != 0, np.diff(t_ns) < 0
            rows |= set((1 + np.flatnonzero(ends | is_set_back)).tolist())
            if self.standing is not None:
                lasts = estimates["touch_t_ns"] > self.standing.touch_t_ns + LASTS_NS
                rows |= {int(lasts.argmax())}
        return sorted(rows)

    def _apply(self, changes: Sequence[Change], t_ns: int, q: np.ndarray | None) -> dict[int, Episode]:
        """Changes at one sample; alarms of which they bring news, by number."""
        news: dict[int, Episode] = {}
        for change in changes:
            if self.standing is not None and change.ends_alarm:
                news[self.standing.number] = replace(self._so_far(), is_touched=False, ended=True)
                self.standing = None
            if learned := change.learned:
                self._learn(t_ns, learned, news, q, change.raised)
        return news

    def _follow(self, t_ns: np.ndarray, estimates: Mapping[str, np.ndarray], rows: slice, came: bool) -> None:
        """Largest torques and the end of the touch at these samples."""
        if self.standing is None or rows.start == rows.stop:
            return
        held = estimates["held_alarm"][rows] != 0
        if held.any():
            margin, limit = estimates["margin_nm"][rows][held], estimates["limit_nm"][rows][held]
            share = np.fmax.reduce(1 - margin / limit, axis=0)
            self._over = np.fmax(self._over, share) if len(self._over) else share
            self._follow_peak(estimates, rows.start + np.flatnonzero(held))
        self._touch_t_ns = max(self._touch_t_ns, int(estimates["touch_t_ns"][rows].max()))
        if came:
            self._last_ns = int(t_ns[rows.stop - 1])

    def _follow_peak(self, estimates: Mapping[str, np.ndarray], rows: np.ndarray) -> None:
        """The largest ratio of the torque to its limit at these rows."""
        assert self.standing is not None
        joint = self.standing.joint
        if joint < 0 or "tau_ext" not in estimates:
            return
        limit_nm = estimates["contact_limit_nm" if self.standing.alarm == CONTACT else "limit_nm"][rows, joint]
        torque_nm = unexplained(estimates)[rows, joint]
        over = np.nan_to_num(np.abs(torque_nm) / limit_nm, nan=0.0)
        k = int(over.argmax())
        if over[k] > 1 and not over[k] <= abs(self._peak[0]) / self._peak[1]:
            self._peak = float(torque_nm[k]), float(limit_nm[k])

    def _judge(
        self, k: int, t_ns: np.ndarray, estimates: Mapping[str, np.ndarray], news: dict[int, Episode], came: bool
    ) -> None:
        """Whether there is news of the alarm that stands at one sample."""
        if (one := self.standing) is None:
            return
        last_ns, is_touched = self._last_ns, not estimates["touch_over"][k]
        self._follow(t_ns, estimates, slice(k, k + 1), came)
        so_far = self._so_far()
        lasts = is_touched and so_far.touch_t_ns > one.touch_t_ns + LASTS_NS
        was_set_back = came and t_ns[k] < last_ns and so_far != one  # what follows is of another clock
        if one.number in news or lasts or was_set_back or (one.is_touched and not is_touched):
            self.standing = news[one.number] = replace(so_far, is_touched=is_touched)
        elif is_touched and not one.is_touched:  # again; its end is news
            self.standing = replace(one, is_touched=True)

    def _learn(
        self,
        t_ns: int,
        learned: dict[str, Any],
        news: dict[int, Episode],
        q: np.ndarray | None,
        raised: tuple[int, int] | None,
    ) -> None:
        """Set what becomes known of an alarm that rises, stands or has just ended."""
        number = learned["number"]
        if raised is not None and self.standing is None:
            self._over, self._touch_t_ns, self._last_ns = np.zeros(0), t_ns, t_ns
            self.standing = Episode(number, *raised, self.bundle, t_ns, t_ns)
        if raised is not None:
            self._peak = learned["torque_nm"], learned["limit_nm"]
        if "place" in learned:
            learned["q"] = () if q is None else tuple(q.tolist())
        if self.standing is not None and (raised is not None or self.standing.number == number):
            learned["number"] = self.standing.number
            self.standing = news[self.standing.number] = replace(self.standing, **learned)
        elif number in news:
            news[number] = replace(news[number], **learned)

    def _so_far(self) -> Episode:
        """The alarm that stands with its touch up to here. A clock that was set back adds nothing."""
        assert self.standing is not None
        if self.standing.t_ns is None:
            return self.standing
        torque_nm, limit_nm = self._peak
        return replace(
            self.standing,
            touch_t_ns=self._touch_t_ns,
            over=tuple(self._over.tolist()),
            torque_nm=torque_nm,
            limit_nm=limit_nm,
        )


class Acknowledgement:
    """Decides when an alarm that stands is acknowledged: after a set time, or, once it is answered, after its touch."""

    def __init__(self, after_s: float | None):
        """after_s: time after which a collision is acknowledged, [s]; None: only once it is answered."""
        self.answered = 0
        """Number of the answered alarm that is acknowledged once its touch is over; 0: none."""
        self._after_ns = None if after_s is None else round(after_s * 1e9)
        self._due_ns: int | None = None
        """Counted time at which the alarm that stands is acknowledged; None: it is not."""

    def follow(self, news: Sequence[Episode], times_ns: np.ndarray, alarm: np.ndarray) -> None:
        """Alarms that begin and end at samples of these counted times, (rows,)."""
        if any(one.ended for one in news):
            self._due_ns = None
        if self._after_ns is not None and self._due_ns is None and alarm[-1] == COLLISION:
            self._due_ns = int(times_ns[(alarm == COLLISION).argmax()]) + self._after_ns

    def rows(self, times_ns: np.ndarray) -> int:
        """Number of samples of these counted times, at least one, before any of which nothing can become due."""
        if self.answered or self._after_ns is None or len(times_ns) == 1:
            return 1 if self.answered else len(times_ns)
        due_ns = times_ns[0] + self._after_ns if self._due_ns is None else self._due_ns
        return max(1, int(np.searchsorted(times_ns, due_ns)))

    def is_due(self, now_ns: int, standing: int) -> bool:
        """Whether the time has come, before the next sample, to acknowledge the alarm that stands.

        Args:
            now_ns: counted time of that sample.
            standing: number of the alarm; 0: none.
        """
        if self.answered and self.answered != standing:  # it has ended by itself
            self.end()
        if self.answered and self._due_ns is None and self._after_ns is not None:  # a contact that lasts
            self._due_ns = now_ns + self._after_ns
        return self._due_ns is not None and now_ns >= self._due_ns

    def end(self) -> None:
        """The alarm is ended."""
        self._due_ns, self.answered = None, 0
