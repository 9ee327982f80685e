"""Changes from one sample to the next: health, alarm, drift at its bound; independent of the chunks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from tauext._core import DeclaredContact, Load, LoadFound
from tauext.bundle.estimates import COLLISION, CONTACT, DECLARED, FIRST_KIND, NONE, OK, WARMING_UP, unexplained


def with_article(kind: str) -> str:
    """Return the word with its article: `an impact`, `a clamp`."""
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"


APART_S = 0.5
"""Time within all limits after which a collision counts as another one, as in counts of false alarms."""


BEYOND = DECLARED.index("beyond")
"""From this state on a declared contact is not as declared."""
DECLARED_NUMBERS = ("declared_size", "declared_sigma", "declared_moment_nm", "declared_travel_m")
"""Of the estimates, in the order of DeclaredChange."""


@dataclass(frozen=True)
class Change:
    """An event at one sample, made by replay and live loop and printed as text, JSON and in the panel."""

    row: int
    """Row of the sample, counted from the recording's first."""
    t_ns: int
    """Stamp of the sample, [ns]."""


@dataclass(frozen=True)
class HealthChange(Change):
    """The health, or the cause of a bad health, changed at this sample."""

    health: int
    was: int
    causes: int
    """Bits of the causes; tauext._core.cause_names returns their names."""
    joint: int
    """First joint that a cause concerns, -1 for none."""


@dataclass(frozen=True)
class AlarmChange(Change):
    """The alarm level changed at this sample, or the alarm was acknowledged before it."""

    alarm: int
    was: int
    joint: int
    """The joint that raised it, -1 where it fell."""
    tau_ext_nm: float = np.nan
    """tau_ext of that joint at this sample; NaN where the alarm fell."""
    limit_nm: float = np.nan
    """Limit of that joint for this level: the contact limit for a contact, else the collision limit."""
    near_stiction: bool = False
    acknowledged: bool = False
    """Whether an acknowledgement ended the alarm."""
    sigma_nm: float = np.nan
    """Standard error of tau_ext_nm; NaN without an error scale."""
    number: int = 0
    """Number of the alarm."""


@dataclass(frozen=True)
class HiddenCollision(Change):
    """A collision that raised no alarm: a collision alarm was already latched."""

    joint: int
    """The joint furthest over its limit."""


@dataclass(frozen=True)
class TouchChange(Change):
    """The kind of the alarm's touch became known, or was corrected, at this sample."""

    touch: int
    """Index of TOUCHES."""
    was: int
    alarm: int
    """Present level."""
    joint: int
    """The joint that raised it."""
    since_s: float
    """Time since the alarm rose to this level, [s]."""
    number: int = 0
    """Number of the alarm."""


@dataclass(frozen=True)
class DriftChange(Change):
    """The drift of a joint reached its bound for the first time since the monitor was made: retrain."""

    joint: int


@dataclass(frozen=True)
class DeclaredChange(Change):
    """A declared contact came into effect or ended, or its force went beyond its bounds, at this sample."""

    state: int
    """Index of DECLARED."""
    contact: int
    """Number of the contact, of Monitor.expect_contact(); -1: none."""
    size: float = np.nan
    """Its force, [N]; of a joint the torque."""
    sigma: float = np.nan
    moment_nm: float = np.nan
    travel_m: float = np.nan
    phase: str = ""
    """Name of the phase that declared it; empty: unknown."""
    bounds: DeclaredContact | None = None


@dataclass(frozen=True)
class LoadChange(Change):
    """The load of the arm was set just before this sample."""

    load: Load
    by: str = ""
    """Origin of the change; empty: the start of the replay."""
    since_ns: int | None = None
    """Time from which the load applies; None: from this sample on."""
    left_out: tuple[str, ...] = ()
    """Joints without an estimate in N m: their limits are higher while the load is set."""


@dataclass(frozen=True)
class FoundLoad(Change):
    """An expected load was found or weighed more accurately at this sample, and was set."""

    mass_kg: float
    """Total mass of the load; 0: none."""
    error_kg: float
    """Standard error of the change."""


@dataclass(frozen=True)
class WeighChange(Change):
    """Just before this sample weighing began or ended, or its result was requested."""

    what: str
    """`start`, `stop` or `report`."""
    by: str
    frame: str
    """Name of the frame of the lengths, for messages."""
    beside: Load
    """The load already set, which the result excludes."""
    found: LoadFound | None = None
    """The result so far; None at the start."""


def shifted(last: int, values: np.ndarray) -> np.ndarray:
    """Predecessor of each value; `last` precedes the first. The live loop has single samples: np.append takes 4 us."""
    before = np.empty_like(values)
    before[0], before[1:] = last, values[:-1]
    return before


def number_at(estimates: Mapping[str, np.ndarray], row: int) -> int:
    """Number of the newest alarm at this row; 0 in estimates without it."""
    return int(estimates["alarm_number"][row]) if "alarm_number" in estimates else 0


class ChangeFinder:
    """Finds every change in the estimates, chunk after chunk; the first sample follows a new monitor."""

    def __init__(self) -> None:
        self._last = {"health": WARMING_UP, "causes": 0, "alarm": NONE}
        self._saturated: set[int] = set()
        self._found_ns, self._reported_kg, self._reported_error_kg = 0, np.nan, np.nan
        self._touch, self._alarm_ns, self._number = 0, 0, 0
        self._held_ns: int | None = None
        self._declared, self._declared_contact, self._beyond_ns = 0, -1, -math.inf

    def acknowledged(self, row: int, t_ns: int) -> AlarmChange:
        """The alarm was acknowledged just before this sample; an alarm at the sample was raised again there."""
        was, self._last["alarm"] = self._last["alarm"], NONE
        return AlarmChange(row, int(t_ns), NONE, was, -1, acknowledged=True, number=self._number)

    def stand(self, alarm: int, number: int) -> None:
        """This alarm stands from before the first sample on."""
        self._last["alarm"], self._number = alarm, number

    def forget_drift(self) -> None:
        """Another monitor makes the estimates from here on: its drift is another."""
        self._saturated.clear()

    def find(self, first_row: int, t_ns: np.ndarray, estimates: dict[str, np.ndarray]) -> list[Change]:
        """Changes at these samples in order; of one sample health, alarm, touch, drift, hidden collision.

        Args:
            first_row: the chunk's first row, counted from the recording's first sample.
            t_ns: (rows,), [ns].
            estimates: as returned by Monitor.run for these samples, not empty.
        """
        before = {name: shifted(last, estimates[name]) for name, last in self._last.items()}
        differs = {name: before[name] != estimates[name] for name in self._last}
        self._last = {name: int(estimates[name][-1]) for name in self._last}
        changes: list[Change] = []
        for k in (differs["health"] | differs["causes"] | differs["alarm"]).nonzero()[0].tolist():
            row, t = first_row + k, int(t_ns[k])
            if differs["health"][k] or differs["causes"][k]:
                health, causes, joint = (int(estimates[name][k]) for name in ("health", "causes", "cause_joint"))
                changes.append(HealthChange(row, t, health, int(before["health"][k]), causes, joint))
            if differs["alarm"][k]:
                changes.append(self._alarm_change(row, t, k, int(before["alarm"][k]), estimates))
        if "alarm_number" in estimates:
            self._number = int(estimates["alarm_number"][-1])
        if "load_found_ns" in estimates:
            changes += self._found(first_row, t_ns, estimates)
        if "declared" in estimates and (self._declared or estimates["declared"].any()):
            changes += self._declarations(first_row, t_ns, estimates)
        if "touch" in estimates:
            changes += self._touches(first_row, t_ns, estimates, before["alarm"])
        changes += self._drift(first_row, t_ns, estimates["drift_saturated"])
        if "held_alarm" in estimates:
            changes += self._hidden(first_row, t_ns, estimates, before["alarm"])
        return sorted(changes, key=lambda change: change.row)

    def _found(self, first_row: int, t_ns: np.ndarray, estimates: dict[str, np.ndarray]) -> list[FoundLoad]:
        """First load of a window, and loads that differ by more than the error reported last."""
        found_ns = estimates["load_found_ns"]
        reported: list[FoundLoad] = []
        for k in (found_ns != shifted(self._found_ns, found_ns)).nonzero()[0].tolist():
            kg, error_kg = float(estimates["load_kg"][k]), float(estimates["load_error_kg"][k])
            before_ns = found_ns[k - 1] if k else self._found_ns
            news = before_ns == 0 or not abs(kg - self._reported_kg) <= self._reported_error_kg
            if found_ns[k] and (news or (kg == 0) != (self._reported_kg == 0)):
                reported.append(FoundLoad(first_row + k, int(t_ns[k]), kg, error_kg))
                self._reported_kg, self._reported_error_kg = kg, error_kg
        self._found_ns = int(found_ns[-1])
        return reported

    def _declarations(self, first_row: int, t_ns: np.ndarray, estimates: dict[str, np.ndarray]) -> list[DeclaredChange]:
        """States of the declared contact. One that returns beyond its bounds within APART_S is not reported again."""
        state, which = estimates["declared"], estimates["declared_contact"]
        differs = (state != shifted(self._declared, state)) | (which != shifted(self._declared_contact, which))
        found: list[DeclaredChange] = []
        for k in (differs & (estimates["health"] == OK)).nonzero()[0].tolist():
            now, contact = int(state[k]), int(which[k])
            if self._declared >= BEYOND:  # until here
                self._beyond_ns = float(t_ns[k])
            beyond = now >= BEYOND
            returns = beyond and 0 <= t_ns[k] - self._beyond_ns <= APART_S * 1e9  # a clock that was set back: not soon
            ends = now == 0 and self._declared
            if not returns and (beyond or ends or contact != self._declared_contact):
                size, sigma, moment_nm, travel_m = (float(estimates[name][k]) for name in DECLARED_NUMBERS)
                of = self._declared_contact if ends else contact
                found.append(DeclaredChange(first_row + k, int(t_ns[k]), now, of, size, sigma, moment_nm, travel_m))
            self._declared, self._declared_contact = now, contact
        return found

    def _touches(
        self, first_row: int, t_ns: np.ndarray, estimates: dict[str, np.ndarray], alarm_before: np.ndarray
    ) -> list[TouchChange]:
        """Kinds of touches that became known."""
        touch, alarm = estimates["touch"], estimates["alarm"]
        before = shifted(self._touch, touch)
        touches: list[TouchChange] = []
        for k in ((touch != before) | (alarm > alarm_before)).nonzero()[0].tolist():
            if alarm[k] > alarm_before[k]:
                self._alarm_ns = int(t_ns[k])
            if touch[k] >= FIRST_KIND and touch[k] != before[k]:
                since_s = (int(t_ns[k]) - self._alarm_ns) * 1e-9
                joint = int(estimates["alarm_joint"][k])
                touches.append(
                    TouchChange(
                        first_row + k,
                        int(t_ns[k]),
                        int(touch[k]),
                        int(before[k]),
                        int(alarm[k]),
                        joint,
                        since_s,
                        number_at(estimates, k),
                    )
                )
        self._touch = int(touch[-1])
        return touches

    def _drift(self, first_row: int, t_ns: np.ndarray, saturated: np.ndarray) -> list[DriftChange]:
        if not saturated.any():
            return []
        new = [j for j in np.flatnonzero(saturated.any(axis=0)).tolist() if j not in self._saturated]
        self._saturated.update(new)
        rows = [int(np.argmax(saturated[:, j])) for j in new]
        return [DriftChange(first_row + k, int(t_ns[k]), j) for k, j in zip(rows, new, strict=True)]

    def _hidden(
        self, first_row: int, t_ns: np.ndarray, estimates: dict[str, np.ndarray], alarm_before: np.ndarray
    ) -> list[HiddenCollision]:
        at = (estimates["held_alarm"] == COLLISION).nonzero()[0]
        if len(at) == 0:
            return []
        before_ns = np.append(t_ns[at[0]] if self._held_ns is None else self._held_ns, t_ns[at[:-1]])
        self._held_ns = int(t_ns[at[-1]])
        hidden = []
        since_ns = t_ns[at] - before_ns
        apart = (since_ns > round(APART_S * 1e9)) | (since_ns < 0)  # or the clock was set back
        for k in at[apart & (alarm_before[at] == COLLISION)].tolist():
            share = np.abs(unexplained(estimates)[k]) / estimates["limit_nm"][k]
            hidden.append(HiddenCollision(first_row + k, int(t_ns[k]), int(np.nanargmax(share))))
        return hidden

    @staticmethod
    def _alarm_change(row: int, t_ns: int, k: int, was: int, estimates: dict[str, np.ndarray]) -> AlarmChange:
        alarm, joint = int(estimates["alarm"][k]), int(estimates["alarm_joint"][k])
        if alarm <= was or joint < 0:
            return AlarmChange(row, t_ns, alarm, was, -1, number=number_at(estimates, k))
        return AlarmChange(
            row,
            t_ns,
            alarm,
            was,
            joint,
            float(estimates["tau_ext"][k, joint]),
            float(estimates["contact_limit_nm" if alarm == CONTACT else "limit_nm"][k, joint]),
            bool(estimates["near_stiction"][k, joint]),
            sigma_nm=float(estimates["sigma_nm"][k, joint]),
            number=number_at(estimates, k),
        )
