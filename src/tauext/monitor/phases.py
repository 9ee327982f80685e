"""Phases of a task with the contact that each means: from the cell's file, or a control line."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property
from itertools import pairwise
from typing import Annotated, Literal

from tauext._core import DeclaredContact, Monitor, WrenchAxes
from tauext.config import Rule, within
from tauext.errors import ConfigError
from tauext.files.typed_table import TableName, read_table, table_of_line

Vector = tuple[float, float, float]
LARGEST = 1e6
"""Largest force, moment and time; a larger one is a mistake of units."""
Amount = Annotated[float, within(0, LARGEST)]
USAGE = (
    "`contact PHASE seconds=S` of the cell's file, `contact none [PHASE]`, or `contact frame=NAME axis=X,Y,Z "
    "half_angle_deg=A at_most_n=N at_most_nm=M seconds=S`, with joint=NAME at_most_nm=M instead for a torque of one "
    "joint; further keys: point, axes=frame|base, at_most_travel_m"
)


def are_rising(pairs: Sequence[tuple[float, float]]) -> bool:
    """Whether each time is after the one before it."""
    return all(a < b for a, b in pairwise(time for pair in pairs for time in pair))


@dataclass(frozen=True)
class ContactTable:
    """Keys of a contact that a task means."""

    frame: str = ""
    """Frame at which the force acts."""
    joint: str = ""
    """Joint of a torque, instead of a frame."""
    point: Vector = (0.0, 0.0, 0.0)
    """Where the force acts, in the frame, [m]."""
    axis: Vector = (0.0, 0.0, 0.0)
    """Direction of the force; zeros: any."""
    axes: Literal["frame", "base"] = "frame"
    """Axes of `axis` and of the moment."""
    half_angle_deg: Annotated[float, within(0, 90)] = 0.0
    at_most_n: Amount = 0.0
    at_most_nm: Amount = 0.0
    at_most_travel_m: Amount = math.inf

    def __post_init__(self) -> None:
        if bool(self.frame) == bool(self.joint):
            raise ConfigError("needs a frame or a joint, and not both")

    @cached_property
    def contact(self) -> DeclaredContact:
        values = {one.name: getattr(self, one.name) for one in fields(ContactTable)}
        return DeclaredContact(**values | {"axes": getattr(WrenchAxes, self.axes), "box": getattr(self, "box", None)})


@dataclass(frozen=True)
class Phase(ContactTable):
    """A named contact that the task means: a table [phases.NAME] of the cell's file."""

    name: TableName = ""
    box: tuple[Vector, Vector] | None = None
    """Two corners, [m], along the axes of the base: declared while the point is inside."""
    always: bool = False
    """Declared from the start on, as a phase with a box is."""
    during: Annotated[tuple[tuple[Amount, Amount], ...], Rule(", rising pairs of times in s", are_rising)] = ()
    """Times of a recording in which it is declared, [s] since the first sample."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not re.fullmatch(r"[\w.-]+", self.name) or self.name == "none":
            raise ConfigError(f"phase name {self.name!r} must be one word, other than 'none'")

    @property
    def lasts(self) -> bool:
        """Whether it is declared from the start on."""
        return self.always or self.box is not None


@dataclass(frozen=True)
class PhaseLine:
    """The key of a control line that announces a phase."""

    seconds: Amount


@dataclass(frozen=True)
class ContactLine(ContactTable):
    """Keys of a control line that announces a contact."""

    seconds: Amount = field(kw_only=True)


@dataclass(frozen=True)
class Announced:
    """A control line: declare a phase, or a contact without a name, for some time, or end one or all."""

    name: str
    """Name of the phase; empty: without one, or all."""
    contact: DeclaredContact | None = None
    seconds: float = math.inf
    ends: bool = False


@dataclass
class Phases:
    """The phases of a file, and what is declared of them to one monitor."""

    by_name: dict[str, Phase] = field(default_factory=dict)
    declared: dict[int, tuple[str, DeclaredContact]] = field(default_factory=dict)
    """By the monitor's number: name of the phase, and its contact; kept after its end, for reports."""

    def check(self, monitor: Monitor) -> list[str]:
        """What is not monitored during each phase, in sentences.

        Raises:
            ConfigError: the monitor refuses a contact.
        """
        notes = []
        for phase in self.by_name.values():
            if reason := monitor.why_no_contact(phase.contact):
                raise ConfigError(f"phase {phase.name}: {reason}")
            if words := monitor.unmonitored(phase.contact):
                notes.append(f"phase {phase.name}: {words}")
        return notes

    def named(self, name: str) -> Phase:
        """The phase of this name.

        Raises:
            ConfigError: there is none; the message lists the phases.
        """
        if name not in self.by_name:
            known = ", ".join(self.by_name)
            must = f"must be one of {known}" if known else "needs a table [phases.NAME] of --cell FILE"
            raise ConfigError(f"phase {name!r} {must}")
        return self.by_name[name]

    def start(self, monitor: Monitor) -> None:
        """Declare the phases that are always on, to a new monitor."""
        self.declared.clear()
        for phase in self.by_name.values():
            if phase.lasts:
                self.declare(monitor, phase.name, phase.contact, math.inf)

    def declare(self, monitor: Monitor, name: str, contact: DeclaredContact, seconds: float) -> None:
        """Declare one contact.

        Raises:
            CoreError: the monitor refuses it.
        """
        self.declared[monitor.expect_contact(contact, seconds)] = name, contact

    def end(self, monitor: Monitor, name: str) -> int:
        """End the contacts of this phase; of all that are not always on if the name is empty. Returns their number."""
        always = {one.name for one in self.by_name.values() if one.lasts}
        chosen = [k for k, (of, _) in self.declared.items() if (of == name if name else of not in always)]
        return sum(monitor.end_contact(k) for k in chosen)

    def timed(self, start_ns: int) -> list[tuple[DeclaredContact, int, float]]:
        """Contacts with start [ns] and duration [s] for a recording whose first stamp is start_ns, by rising start."""
        return [(contact, from_ns, seconds) for _, contact, from_ns, seconds in self.scheduled(start_ns)]

    def scheduled(self, start_ns: int) -> list[tuple[str, DeclaredContact, int, float]]:
        """Contacts as timed() returns them, with the names of their phases."""

        def each() -> Iterator[tuple[str, DeclaredContact, int, float]]:
            for phase in self.by_name.values():
                if phase.lasts:
                    yield phase.name, phase.contact, start_ns, math.inf
                for begin, end in phase.during:
                    yield phase.name, phase.contact, start_ns + round(begin * 1e9), end - begin

        return sorted(each(), key=lambda one: one[2])

    def after_the_end(self, duration_s: float, where: str) -> list[str]:
        """A sentence on each time of `during` that declares nothing, since it begins after the end of a recording.

        Args:
            where: the recording, for the sentences.
        """
        return [
            f"phase {phase.name}: during = [[{begin:g}, {end:g}]] declares nothing: {where} ends at {duration_s:.4g} s"
            for phase in self.by_name.values()
            for begin, end in phase.during
            if begin >= duration_s
        ]

    def without_recording(self) -> list[str]:
        """A sentence on each phase whose times of a recording declare nothing with a live source."""
        return [
            f"phase {phase.name}: during gives times of a recording and declares nothing with a live source; announce "
            f"the phase with the control line `contact {phase.name} seconds=S`"
            for phase in self.by_name.values()
            if phase.during
        ]


def bounds_words(contact: DeclaredContact) -> str:
    """`at tool0 of at most 40 N`, `of joint gripper of at most 1.5`."""
    if contact.joint:
        return f"of joint {contact.joint} of at most {contact.at_most_nm:g}"
    sizes = [f"{contact.at_most_n:g} N"] if contact.at_most_n else []
    sizes += [f"{contact.at_most_nm:g} N m"] if contact.at_most_nm else []
    return f"at {contact.frame} of at most {' and '.join(sizes)}"


def announced_of_text(line: str) -> Announced:
    """Parse the rest of a control line `contact ...`, see USAGE.

    Raises:
        ConfigError: names the error and the syntax.
    """
    where = f"contact {line.strip()[:80]!r}"
    head, table = table_of_line(ContactLine, line, where)
    plain, has_bounds = head.split(), bool(set(table) - {"seconds"})
    if plain[:1] == ["none"] and len(plain) < 3 and not table:
        return Announced(plain[1] if len(plain) == 2 else "", ends=True)
    if len(plain) != (not has_bounds):
        raise ConfigError(f"{where} cannot be read; it is {USAGE}")
    if plain:
        return Announced(plain[0], seconds=read_table(PhaseLine, table, f"{where}:").seconds)
    found = read_table(ContactLine, table, f"{where}:")
    return Announced("", found.contact, found.seconds)
