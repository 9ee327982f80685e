"""Phases of a task with the contact that each means: from phases.toml, or a control line."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tauext._core import Bundle, DeclaredContact, Monitor, WrenchAxes
from tauext.errors import ConfigError
from tauext.files.plain_file import number_of
from tauext.files.toml_file import Key, flag, number, numbers, one_of, read_table, read_toml, text
from tauext.monitor.changes import DeclaredChange

AXES = {"frame": WrenchAxes.frame, "base": WrenchAxes.base}
ZEROS = (0.0, 0.0, 0.0)
VECTOR = numbers((3,), number(), default=ZEROS)
LARGEST = 1e6
"""Largest force, moment and time; a larger one is a mistake of units."""
SECONDS = number(0.0, LARGEST)
CONTACT_KEYS: dict[str, Key] = {
    "frame": text("name of a frame", default=""),
    "joint": text("name of a joint", default=""),
    "point": VECTOR,
    "axis": VECTOR,
    "axes": one_of(tuple(AXES), "frame"),
    "half_angle_deg": number(0.0, 90.0, 0.0),
    "at_most_n": number(0.0, LARGEST, 0.0),
    "at_most_nm": number(0.0, LARGEST, 0.0),
    "at_most_travel_m": number(0.0, LARGEST, math.inf),
}
VECTORS = ("point", "axis")
USAGE = (
    "`contact PHASE seconds=S` of --phases, `contact none [PHASE]`, or `contact frame=NAME axis=X,Y,Z half_angle_deg=A "
    "at_most_n=N at_most_nm=M seconds=S`, with joint=NAME at_most_nm=M instead for a torque of one joint; further "
    "keys: point, axes=frame|base, at_most_travel_m"
)


def read_pairs(value: Any) -> tuple[tuple[float, float], ...]:
    """Pairs of rising times, [s], each after the one before."""
    found = [tuple(map(SECONDS.read, pair)) for pair in value]
    flat = [time for pair in found for time in pair]
    if any(len(pair) != 2 for pair in found) or any(b <= a for a, b in zip(flat, flat[1:], strict=False)):
        raise ValueError
    return tuple((begin, end) for begin, end in found)


def read_box(value: Any) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Lowest and highest corner, [m]."""
    lowest, highest = (VECTOR.read(corner) for corner in value)
    return lowest, highest


PHASE_KEYS = CONTACT_KEYS | {
    "box": Key(read_box, "two corners: [[X, Y, Z], [X, Y, Z]], in m along the axes of the base", None),
    "always": flag(False),
    "during": Key(read_pairs, "rising pairs of times of a recording, in s: [[FROM, TO], ...]", ()),
}


@dataclass(frozen=True)
class Phase:
    """A named contact that the task means."""

    name: str
    contact: DeclaredContact
    always: bool = False
    """From the start on; one with a box always is."""
    during: tuple[tuple[float, float], ...] = ()
    """Times of a recording in which it is declared, [s] since the first sample."""


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
            must = f"must be one of {known}" if known else "needs phases: --phases FILE reads some"
            raise ConfigError(f"phase {name!r} {must}")
        return self.by_name[name]

    def start(self, monitor: Monitor) -> None:
        """Declare the phases that are always on, to a new monitor."""
        self.declared.clear()
        for phase in self.by_name.values():
            if phase.always:
                self.declare(monitor, phase.name, phase.contact, math.inf)

    def declare(self, monitor: Monitor, name: str, contact: DeclaredContact, seconds: float) -> None:
        """Declare one contact.

        Raises:
            CoreError: the monitor refuses it.
        """
        self.declared[monitor.expect_contact(contact, seconds)] = name, contact

    def end(self, monitor: Monitor, name: str) -> int:
        """End the contacts of this phase; of all that are not always on if the name is empty. Returns their number."""
        always = {one.name for one in self.by_name.values() if one.always}
        chosen = [k for k, (of, _) in self.declared.items() if (of == name if name else of not in always)]
        return sum(monitor.end_contact(k) for k in chosen)

    def timed(self, start_ns: int) -> list[tuple[DeclaredContact, int, float]]:
        """Contacts with start [ns] and duration [s] for a recording whose first stamp is start_ns, by rising start."""
        return [(contact, from_ns, seconds) for _, contact, from_ns, seconds in self.scheduled(start_ns)]

    def scheduled(self, start_ns: int) -> list[tuple[str, DeclaredContact, int, float]]:
        """The same with the phases' names."""

        def each() -> Iterator[tuple[str, DeclaredContact, int, float]]:
            for phase in self.by_name.values():
                if phase.always:
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

    def with_names(self, change: DeclaredChange) -> DeclaredChange:
        """The change with the name and the bounds of its contact."""
        from dataclasses import replace

        name, bounds = self.declared.get(change.contact, ("", None))
        return replace(change, phase=name, bounds=bounds)


def bounds_words(contact: DeclaredContact) -> str:
    """`at tool0 of at most 40 N`, `of joint gripper of at most 1.5`."""
    if contact.joint:
        return f"of joint {contact.joint} of at most {contact.at_most_nm:g}"
    sizes = [f"{contact.at_most_n:g} N"] if contact.at_most_n else []
    sizes += [f"{contact.at_most_nm:g} N m"] if contact.at_most_nm else []
    return f"at {contact.frame} of at most {' and '.join(sizes)}"


def contact_of_table(where: str, values: Mapping[str, Any]) -> DeclaredContact:
    """The contact of these values of CONTACT_KEYS, and perhaps a box.

    Raises:
        ConfigError: neither a frame nor a joint, or both.
    """
    if bool(values["frame"]) == bool(values["joint"]):
        raise ConfigError(f"{where}: give a frame or a joint, and not both")
    box = values.get("box")
    return DeclaredContact(
        **{key: values[key] for key in CONTACT_KEYS if key not in ("axes",)}, axes=AXES[values["axes"]], box=box
    )


def read_phases(path: Path) -> Phases:
    """Read a phases.toml: a table [NAME] for each phase.

    Raises:
        ConfigError: names the file, the key, the value and the rule that it breaks.
    """
    content = read_toml(path, "docs/contacts.md has examples")
    if not content:
        raise ConfigError(f"{path}: there must be one or more tables [PHASE]")
    found = {}
    for name, table in content.items():
        if not re.fullmatch(r"[\w.-]+", name) or name == "none":
            raise ConfigError(f"{path}: phase name {name!r} must be one word, other than 'none'")
        values = read_table(path, f"[{name}]", table, PHASE_KEYS)
        contact = contact_of_table(f"{path}: [{name}]", values)
        found[name] = Phase(name, contact, values["always"] or values["box"] is not None, values["during"])
    return Phases(found)


def announced_of_text(line: str) -> Announced:
    """Parse the rest of a control line `contact ...`, see USAGE.

    Raises:
        ConfigError: names the error and the syntax.
    """
    where = f"contact {line.strip()[:80]!r}"
    words = line.split()
    plain = [word for word in words if "=" not in word]
    pairs = [word.partition("=") for word in words if "=" in word]
    keys = [key for key, _, _ in pairs]
    if unknown := [key for key in keys if key not in (*CONTACT_KEYS, "seconds")]:
        raise ConfigError(f"{where}: {unknown[0]} is unknown; it is {USAGE}")
    if len(set(keys)) < len(keys):
        raise ConfigError(f"{where}: a key is given twice")
    if plain[:1] == ["none"] and len(plain) < 3 and not pairs:
        return Announced(plain[1] if len(plain) == 2 else "", ends=True)
    table: dict[str, Any] = {key: _value(where, key, value) for key, _, value in pairs}
    bounds = {key: value for key, value in table.items() if key != "seconds"}
    if len(plain) != (not bounds):
        raise ConfigError(f"{where} cannot be read; it is {USAGE}")
    given = {key: value for key, value in table.items() if key == "seconds"}
    seconds = read_table(where, "", given, {"seconds": SECONDS})["seconds"]
    if plain:
        return Announced(plain[0], seconds=seconds)
    return Announced("", contact_of_table(where, read_table(where, "", bounds, CONTACT_KEYS)), seconds)


def _value(where: str, key: str, value: str) -> Any:
    if key in ("frame", "joint", "axes"):
        return value
    try:
        found = [number_of(one) for one in value.split(",")]
    except ValueError as error:
        raise ConfigError(
            f"{where}: {key} = {value[:40]!r} must be {'three numbers' if key in VECTORS else 'a number'}"
        ) from error
    return found if key in VECTORS else found[0] if len(found) == 1 else found


def phases_of(path: Path | None, bundle: Bundle) -> tuple[Phases | None, list[str]]:
    """The phases of this file, and what is not monitored during them; None without a file.

    Raises:
        ConfigError: the file, or a contact that the bundle refuses.
    """
    if path is None:
        return None, []
    phases = read_phases(path)
    return phases, phases.check(Monitor(bundle))
