"""Collisions that a latched alarm hides: held over a limit like any other, and raising nothing, since one stands."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tauext.monitor.changes import COLLISION, AlarmChange
from tauext.monitor.replay import Chunk

APART_S = 0.5
"""Without a joint over its limit for so long, the next time is another collision: as false alarms are counted."""


@dataclass(frozen=True)
class HiddenCollision:
    """One that raised no alarm."""

    t_ns: int
    joint: int
    """The one that is furthest over its limit."""


class HiddenFinder:
    """Finds them chunk after chunk of one recording."""

    def __init__(self) -> None:
        self._held_ns: int | None = None
        self._stands = False

    def find(self, chunk: Chunk) -> list[HiddenCollision]:
        """Those that begin in this chunk, in order."""
        t_ns, said = chunk.t_ns, chunk.said
        at = np.flatnonzero(said["held_alarm"] == COLLISION)
        stood = np.append(self._stands, said["alarm"][:-1] == COLLISION)
        self._stands = bool(said["alarm"][-1] == COLLISION)
        if len(at) == 0:
            return []
        before = np.append(t_ns[at[0]] if self._held_ns is None else self._held_ns, t_ns[at[:-1]])
        apart = t_ns[at] - before > round(APART_S * 1e9)
        self._held_ns = int(t_ns[at[-1]])
        raised = {one.t_ns for one in chunk.changes if isinstance(one, AlarmChange) and one.alarm == COLLISION}
        return [
            HiddenCollision(
                int(t_ns[k]), int(np.nanargmax(np.abs(said["tau_ext"][k] - said["load_nm"][k]) / said["limit_nm"][k]))
            )
            for k in at[apart & stood[at]].tolist()
            if int(t_ns[k]) not in raised
        ]
