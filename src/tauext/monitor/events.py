"""From what the monitor says to what reactions react to."""

from __future__ import annotations

import time
from typing import Any

from tauext import _core
from tauext.bundle.estimates import HEALTHS
from tauext.monitor.changes import (
    ALARMS,
    COLLISION,
    CONTACT,
    FAULT,
    NONE,
    OK,
    TOUCHES,
    AlarmChange,
    HealthChange,
    TouchChange,
)
from tauext.monitor.places import PlaceChange, newtons, place_facts
from tauext.monitor.sink import Event, EventKind, Verdict
from tauext.monitor.status import number

TORQUES = ("tau_ext", "sigma_nm", "contact_sigma_nm", "limit_nm", "contact_limit_nm", "margin_nm", "residual")


class EventFinder:
    """Finds the events of one verdict after the other."""

    def __init__(self, joints: tuple[str, ...], facts: dict[str, Any]):
        """facts: what every event shall say beside the monitor's numbers: bundle, source."""
        self._joints, self._facts = joints, facts
        self._unsettled = False
        self._place: PlaceChange | None = None
        self._alarm_t_ns = 0

    def find(self, verdict: Verdict) -> list[Event]:
        """Usually none. At one sample a fault goes before an alarm."""
        if not verdict.changes and not self._unsettled:
            return []
        events = []
        for change in verdict.changes:
            if isinstance(change, HealthChange) and change.health == FAULT and change.was != FAULT:
                events.append(self._event("fault", change.joint, verdict))
            elif isinstance(change, AlarmChange) and change.joint >= 0 and change.alarm in (CONTACT, COLLISION):
                kind: EventKind = "collision" if change.alarm == COLLISION else "contact"
                if change.was == NONE:
                    self._place, self._alarm_t_ns = None, change.t_ns
                events.append(self._event(kind, change.joint, verdict))
            elif isinstance(change, TouchChange) and change.alarm in (CONTACT, COLLISION):
                kind = "collision" if change.alarm == COLLISION else "contact"
                events.append(self._event(kind, change.joint, verdict, news=False))
            elif isinstance(change, PlaceChange) and change.alarm in (CONTACT, COLLISION):
                kind, self._place = "collision" if change.alarm == COLLISION else "contact", change
                events.append(self._event(kind, change.joint, verdict, news=False, of_place=True))
        if events:
            self._unsettled = True
        elif self._unsettled and verdict.said["health"][0] == OK and verdict.said["alarm"][0] == NONE:
            self._unsettled = False
            events.append(self._event("cleared", -1, verdict))
        return events

    def _event(self, kind: EventKind, joint: int, verdict: Verdict, news: bool = True, of_place: bool = False) -> Event:
        said, sample = verdict.said, verdict.sample
        touch = TOUCHES[said["touch"][0]]
        facts = {
            **self._facts,
            "joints": list(self._joints),
            "row": verdict.row,
            "health": HEALTHS[said["health"][0]],
            "causes": _core.cause_names(int(said["causes"][0])),
            "alarm": ALARMS[said["alarm"][0]],
            "touch": touch,
            **{name.removesuffix("_nm") + "_nm": [number(v) for v in said[name][0].tolist()] for name in TORQUES},
        }
        received_ns = sample.received_ns if sample is not None else time.monotonic_ns()
        name = self._joints[joint] if joint >= 0 else None
        touched = kind in ("collision", "contact")
        place = self._place if touched else None
        facts["place"] = None if place is None else place_facts(place, self._joints)
        return Event(
            kind,
            name,
            verdict.t_ns,
            received_ns,
            facts,
            touch=touch if touched else None,
            news=news,
            links=() if place is None else tuple((self._joints[link], share) for link, share in place.links),
            newtons=None if place is None else newtons(place.best),
            alarm_t_ns=self._alarm_t_ns,
            of_place=of_place,
        )
