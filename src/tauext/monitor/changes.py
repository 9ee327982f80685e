"""Changes of state from one sample to the next, with their words and their facts as plain JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Literal, NamedTuple

import numpy as np

from tauext._core import DeclaredContact, Load, LoadFound, TouchPlace, cause_names
from tauext.bundle.estimates import (
    ALARMS,
    COLLISION,
    CONTACT,
    DECLARED,
    FAULT,
    FIRST_KIND,
    HEALTHS,
    NONE,
    OK,
    TOUCHES,
    WARMING_UP,
    number,
    unexplained,
)
from tauext.bundle.units import short
from tauext.monitor.loads import load_facts, load_words
from tauext.monitor.phases import bounds_words


def with_article(kind: str) -> str:
    """Return the word with its article: `an impact`, `a clamp`."""
    return f"{'an' if kind[0] in 'aeiou' else 'a'} {kind}"


APART_S = 0.5
"""Time within all limits after which a collision counts as another one, as in counts of false alarms."""


BEYOND = DECLARED.index("beyond")
"""From this state on a declared contact is not as declared."""
INFO, WARN, ERROR = 20, 30, 40
"""Urgency of a change: levels of rcl_interfaces/Log."""


@dataclass(frozen=True)
class Change:
    """A change of state at one sample.

    Terminal, flights and MCAP files print its words, JSON lines its facts; reactions follow its trigger.
    """

    row: int
    """Row of the sample, counted from the recording's first."""
    t_ns: int
    """Stamp of the sample, [ns]."""
    event: ClassVar[str]
    """Name of the kind."""

    def words(self, joints: tuple[str, ...], units: Sequence[str] = ()) -> list[str]:
        """A line of text or more.

        Args:
            units: units of the estimates, one a joint.
        """
        raise NotImplementedError

    def facts(self, joints: tuple[str, ...]) -> dict[str, Any]:
        """Content as plain JSON, beside event, row and time."""
        raise NotImplementedError

    @property
    def urgency(self) -> int:
        return INFO

    @property
    def trigger(self) -> Trigger | None:
        """What it means for reactions."""
        return None

    @property
    def ends_alarm(self) -> bool:
        """Whether an alarm that stood before this sample has ended."""
        return False

    @property
    def is_acknowledgement(self) -> bool:
        return False

    @property
    def learned(self) -> dict[str, Any]:
        """What becomes known of an alarm: fields of its Episode."""
        return {}

    @property
    def raised(self) -> tuple[int, int] | None:
        """Level and joint of an alarm that rose, to its first or to a higher level."""
        return None

    @property
    def declared(self) -> tuple[int, DeclaredContact] | None:
        """Number and bounds of a declared contact that the change is about."""
        return None

    @property
    def touched(self) -> TouchPlace | None:
        """Place of a touch that becomes known."""
        return None


class Trigger(NamedTuple):
    """An event for reactions."""

    kind: Literal["collision", "contact", "fault"]
    joint: int
    """The joint that raised the alarm, or that the fault concerns; -1: none."""
    number: int = 0
    """Number of the alarm; 0: a fault."""
    is_news: bool = True
    """Whether the alarm is new; False: only its kind of touch or place is."""
    of_place: bool = False


def trigger_of(alarm: int, *rest: Any) -> Trigger | None:
    """The trigger of an alarm of this level, with its further fields; None: no joint has raised it."""
    return Trigger("collision" if alarm == COLLISION else "contact", *rest) if alarm and rest[0] >= 0 else None


def _name(joint: int, joints: tuple[str, ...]) -> str | None:
    return joints[joint] if joint >= 0 else None


@dataclass(frozen=True)
class HealthChange(Change):
    """The health, or the cause of a bad health, changed at this sample."""

    health: int
    was: int
    causes: int
    """Bits of the causes; tauext._core.cause_names returns their names."""
    joint: int
    """First joint that a cause concerns, -1 for none."""
    event = "health"

    def words(self, joints: tuple[str, ...], units: Sequence[str] = ()) -> list[str]:
        """`fault: not finite, joint2 (was ok)`."""
        causes = ", ".join(cause_names(self.causes))
        where = f", {joints[self.joint]}" if self.joint >= 0 else ""
        why = f": {causes}{where}" if causes else ""
        was = f" (was {HEALTHS[self.was]})" if self.was != self.health else ""
        return [f"{HEALTHS[self.health]}{why}{was}"]

    def facts(self, joints: tuple[str, ...]) -> dict[str, Any]:
        facts = {"health": HEALTHS[self.health], "was": HEALTHS[self.was], "causes": cause_names(self.causes)}
        return {**facts, "joint": _name(self.joint, joints)}

    @property
    def urgency(self) -> int:
        return INFO if self.health == OK else ERROR if self.health == FAULT else WARN

    @property
    def trigger(self) -> Trigger | None:
        return Trigger("fault", self.joint) if self.health == FAULT and self.was != FAULT else None


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
    explained_nm: float = 0.0
    """Part of tau_ext_nm that an expected load or a declared contact explains: only the rest is compared."""
    event = "alarm"

    @property
    def torque_nm(self) -> float:
        """What is compared with the limit."""
        return self.tau_ext_nm - self.explained_nm

    def words(self, joints: tuple[str, ...], units: Sequence[str] = ()) -> list[str]:
        """`COLLISION joint1: |tau_ext| 6.21 Nm (standard error 0.35 Nm), collision limit 4.62 Nm`."""
        if self.acknowledged:
            return [f"{ALARMS[self.was]} acknowledged"]
        if self.joint < 0:
            return [f"no {ALARMS[self.was]} any more" if self.alarm == 0 else ALARMS[self.alarm]]
        level, unit = ALARMS[self.alarm], short(units[self.joint])
        region = " near stiction" if self.near_stiction else ""
        explained = " - explained" if self.explained_nm else ""
        error = f" (standard error {self.sigma_nm:.2f} {unit})" if math.isfinite(self.sigma_nm) else ""
        return [
            f"{level.upper()} {joints[self.joint]}: |tau_ext{explained}| {abs(self.torque_nm):.2f} {unit}{error}, "
            f"{level} threshold{region} {self.limit_nm:.2f} {unit}"
        ]

    def facts(self, joints: tuple[str, ...]) -> dict[str, Any]:
        joint = _name(self.joint, joints)
        return {
            "number": self.number,
            "alarm": ALARMS[self.alarm],
            "was": ALARMS[self.was],
            "joint": joint,
            "tau_ext_nm": number(self.tau_ext_nm),
            "sigma_nm": number(self.sigma_nm),
            "explained_nm": number(self.explained_nm),
            "limit_nm": number(self.limit_nm),
            "near_stiction": self.near_stiction if joint else None,
            "acknowledged": self.acknowledged,
        }

    @property
    def urgency(self) -> int:
        return INFO if self.alarm <= self.was else ERROR if self.alarm == COLLISION else WARN

    @property
    def trigger(self) -> Trigger | None:
        return trigger_of(self.alarm, self.joint, self.number)

    @property
    def ends_alarm(self) -> bool:
        return NONE in (self.alarm, self.was)

    @property
    def is_acknowledgement(self) -> bool:
        return self.acknowledged

    @property
    def learned(self) -> dict[str, Any]:
        names = ("number", "alarm", "joint", "torque_nm", "limit_nm") if self.raised else ()
        return {name: getattr(self, name) for name in names}

    @property
    def raised(self) -> tuple[int, int] | None:
        return (self.alarm, self.joint) if self.alarm != NONE and self.joint >= 0 else None


@dataclass(frozen=True)
class HiddenCollision(Change):
    """A collision that raised no alarm: a collision alarm was already latched. It is in words and counts only."""

    joint: int
    """The joint furthest over its limit."""
    event = "hidden"

    def words(self, joints: tuple[str, ...], units: Sequence[str] = ()) -> list[str]:
        return [f"collision at {joints[self.joint]} behind the alarm that stands"]

    @property
    def urgency(self) -> int:
        return WARN


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
    event = "touch"

    def words(self, joints: tuple[str, ...], units: Sequence[str] = ()) -> list[str]:
        """`the collision is a clamp, 164 ms after the alarm`."""
        kind = TOUCHES[self.touch]
        was = f" (was taken for {TOUCHES[self.was]})" if TOUCHES[self.was] not in ("none", "unknown") else ""
        return [f"the {ALARMS[self.alarm]} is {with_article(kind)}, {self.since_s * 1e3:.0f} ms after the alarm{was}"]

    def facts(self, joints: tuple[str, ...]) -> dict[str, Any]:
        kinds = {"touch": TOUCHES[self.touch], "was": TOUCHES[self.was], "alarm": ALARMS[self.alarm]}
        return {"number": self.number, **kinds, "joint": _name(self.joint, joints), "since_s": self.since_s}

    @property
    def trigger(self) -> Trigger | None:
        return trigger_of(self.alarm, self.joint, self.number, False)

    @property
    def learned(self) -> dict[str, Any]:
        return {"number": self.number, "touch": self.touch}


@dataclass(frozen=True)
class DriftChange(Change):
    """The drift of a joint reached its bound for the first time since the monitor was made: retrain."""

    joint: int
    event = "drift"

    def words(self, joints: tuple[str, ...], units: Sequence[str] = ()) -> list[str]:
        return [f"recalibrate: joint {joints[self.joint]}'s adaptive bias is at its bound"]

    def facts(self, joints: tuple[str, ...]) -> dict[str, Any]:
        return {"joint": _name(self.joint, joints), "advice": "recalibrate"}

    @property
    def urgency(self) -> int:
        return WARN


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
    event = "declared"

    def words(self, joints: tuple[str, ...], units: Sequence[str] = ()) -> list[str]:
        """`sanding: 34 N at tool0, of at most 30 N`; `sanding: contact at tool0 of at most 30 N`."""
        return [f"{self.phase}: " * bool(self.phase) + self._state_words()]

    def _state_words(self) -> str:
        bounds = self.bounds
        if bounds is None or self.state == 0:
            return "no expected contact any more"
        if self.state < BEYOND:
            return f"contact {bounds_words(bounds)}"
        if DECLARED[self.state] == "moved":
            return (
                f"{bounds.frame} moved {abs(self.travel_m) * 1e3:.0f} mm along the contact's axis, of at most "
                f"{bounds.at_most_travel_m * 1e3:.0f} mm; nothing is explained until the force has gone"
            )
        error = f"{float(format(self.sigma, '.1g')):g}"
        if bounds.joint:
            return f"{self.size:.3g} ± {error} at joint {bounds.joint}, of at most {bounds.at_most_nm:g}"
        moment = f" and {self.moment_nm:.2g} N m" if bounds.at_most_nm else ""
        most = f"{bounds.at_most_n:g} N" + (f" and {bounds.at_most_nm:g} N m" if bounds.at_most_nm else "")
        return f"{self.size:.0f} ± {error} N{moment} at {bounds.frame}, of at most {most}"

    def facts(self, joints: tuple[str, ...]) -> dict[str, Any]:
        facts: dict[str, Any] = {"phase": self.phase or None, "state": DECLARED[self.state]}
        if (bounds := self.bounds) is not None:
            facts |= {"frame": bounds.frame or None, "joint": bounds.joint or None}
            facts |= {"at_most_n": bounds.at_most_n, "at_most_nm": bounds.at_most_nm}
        sizes = {"size": self.size, "size_error": self.sigma, "moment_nm": self.moment_nm, "travel_m": self.travel_m}
        return facts | {key: number(value) for key, value in sizes.items()}

    @property
    def urgency(self) -> int:
        return WARN if self.state >= BEYOND else INFO

    @property
    def declared(self) -> tuple[int, DeclaredContact] | None:
        return None if self.bounds is None else (self.contact, self.bounds)


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
    event = "load"

    def words(self, joints: tuple[str, ...], units: Sequence[str] = ()) -> list[str]:
        since = f" since {(self.t_ns - self.since_ns) * 1e-9:.3f} s" if self.since_ns is not None else ""
        words = f"carries {load_words(self.load)}{since}" + (f", by {self.by}" if self.by else "")
        if not self.left_out or self.load.mass == 0:
            return [words]
        return [f"{words}; thresholds of {', '.join(self.left_out)}, not in Nm, are higher by its largest torque there"]

    def facts(self, joints: tuple[str, ...]) -> dict[str, Any]:
        facts = {"by": self.by, "since_ns": self.since_ns, "left_out": list(self.left_out)}
        return {**load_facts(self.load), **facts}


@dataclass(frozen=True)
class FoundLoad(Change):
    """An expected load was found or weighed more accurately at this sample, and was set."""

    mass_kg: float
    """Total mass of the load; 0: none."""
    error_kg: float
    """Standard error of the change."""
    event = "load"

    def words(self, joints: tuple[str, ...], units: Sequence[str] = ()) -> list[str]:
        if self.mass_kg == 0:
            return ["the expected payload was put down: carries nothing"]
        error_kg = max(self.error_kg, 0.005)
        return [f"the expected payload was picked up: carries {self.mass_kg:.2f} ± {error_kg:.2f} kg"]

    def facts(self, joints: tuple[str, ...]) -> dict[str, Any]:
        return {"mass_kg": self.mass_kg, "mass_error_kg": self.error_kg, "by": "expected"}


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
    event = "weigh"

    def words(self, joints: tuple[str, ...], units: Sequence[str] = ()) -> list[str]:
        """The result of weighing in sentences."""
        from tauext.monitor.weighing import load_sentences

        if self.found is None:
            beside = f" besides {load_words(self.beside)}" if self.beside.mass > 0 else ""
            return [f"identifying the payload{beside}, by {self.by}"]
        sentences = load_sentences(self.found, self.frame, "N m")
        if self.beside.mass > 0 and self.found.verdict == "load":
            sentences.append(f"with the {self.beside.mass:.4g} kg that are set: {load_words(self.found.load)}")
        return sentences

    def facts(self, joints: tuple[str, ...]) -> dict[str, Any]:
        """The result of weighing, and the load to set."""
        from tauext.monitor.weighing import found_facts

        facts: dict[str, Any] = {"what": self.what, "by": self.by, "frame": self.frame, "found": None, "load": None}
        if self.found is not None:
            load = {**load_facts(self.found.load), "error_share": self.found.load.error_share}
            facts |= {"found": found_facts(self.found), "load": load}
        return facts


# --- All changes in the estimates.


def shifted(last: int, values: np.ndarray) -> np.ndarray:
    """Predecessor of each value; `last` precedes the first. The live loop has single samples: np.append takes 4 us."""
    before = np.empty_like(values)
    before[0], before[1:] = last, values[:-1]
    return before


def number_at(estimates: Mapping[str, np.ndarray], row: int) -> int:
    """Number of the newest alarm at this row; 0 in estimates without it."""
    return int(estimates["alarm_number"][row]) if "alarm_number" in estimates else 0


class ChangeFinder:
    """Finds every change in the estimates, block after block; the first sample follows a new monitor."""

    def __init__(self, contacts: Mapping[int, tuple[str, DeclaredContact]] = MappingProxyType({})) -> None:
        """contacts: name of the phase and bounds of each declared contact, by its number."""
        self._contacts = contacts
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
                of = self._declared_contact if ends else contact
                names = ("declared_size", "declared_sigma", "declared_moment_nm", "declared_travel_m")
                size, sigma, moment_nm, travel_m = (float(estimates[name][k]) for name in names)
                numbers, named = (size, sigma, moment_nm, travel_m), self._contacts.get(of, ("", None))
                found.append(DeclaredChange(first_row + k, int(t_ns[k]), now, of, *numbers, *named))
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
            explained_nm=float((estimates["tau_ext"] - unexplained(estimates))[k, joint]),
        )
