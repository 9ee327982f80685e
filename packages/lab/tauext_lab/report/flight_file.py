"""A flight as the report reads it: the recording, its estimates, and its provenance."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tauext.bundle.estimates import COLUMNS, Estimates, load_estimates
from tauext.bundle.units import of_all, short
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.errors import ConfigError, RecordingError

ESTIMATES = ".estimates.parquet"
LISTS: dict[str, Any] = dict.fromkeys([column.key for column in COLUMNS if column.in_messages], int | float | None)
LISTS |= dict.fromkeys(("tau", "dq_rad_s"), int | float | None)
LISTS |= {"near_stiction": bool, "torque_units": str, "estimate_units": str}
"""Fields of an event with one value per joint, and their kinds."""
NEEDED = {"what", "t_ns", "joint", *LISTS}
"""Required fields of an event."""


@dataclass(frozen=True)
class Flight:
    """One event and the seconds around it."""

    recording: Recording
    estimates: Estimates
    event: dict[str, Any]
    """The monitor's report of the event."""
    explanation: tuple[str, ...]
    """A paragraph each; the first is the headline."""
    facts: dict[str, Any]
    """The rest of the provenance."""

    @property
    def since_s(self) -> np.ndarray:
        """Time of every sample counted from the event, (samples,), [s]."""
        return (self.recording.t_ns - self.event["t_ns"]) * 1e-9

    @property
    def loads(self) -> list[tuple[float, float]]:
        """Assumed loads, [kg], and their start times, [s] from the event; empty if there was no load.

        The first is of the whole time before the second.
        """
        entries = self.facts["loads"]
        if not any(one["mass_kg"] for one in entries):
            return []
        return [((one["t_ns"] - self.event["t_ns"]) * 1e-9, one["mass_kg"]) for one in entries]

    @property
    def torque_unit(self) -> str:
        """Unit of the motor torque: Nm, A or the bundle's other unit."""
        return of_all(self.event["torque_units"])

    @property
    def estimate_unit(self) -> str:
        """Unit of external torque and limits, which may differ from Nm if the arm had no model."""
        return of_all(self.event["estimate_units"])

    def estimate_unit_of(self, joint: int) -> str:
        """Unit of one joint's estimates."""
        return short(self.event["estimate_units"][joint])

    @property
    def limit_nm(self) -> np.ndarray:
        """What |tau_ext| had to exceed for the event's level, (samples, joints)."""
        limit = self.estimates.contact_limit_nm if self.limit_level == "contact" else self.estimates.limit_nm
        assert limit is not None  # flights have both
        return limit

    @property
    def limit_level(self) -> str:
        """`contact` or `collision`: whose limits are shown."""
        return "contact" if self.event["what"] == "contact" else "collision"

    @property
    def joint(self) -> int:
        """The event's joint or, where it concerns none, the one that came nearest to its limit."""
        if self.event["joint"] in self.recording.joints:
            return self.recording.joints.index(self.event["joint"])
        share = np.abs(self.estimates.tau_ext) / self.limit_nm
        return int(np.argmax(np.nan_to_num(share).max(axis=0)))


def load_flight(path: Path) -> Flight:
    """Read FLIGHT.parquet and FLIGHT.estimates.parquet.

    Raises:
        ConfigError: no such file.
        RecordingError: a file is damaged, no flight, or of another one.
    """
    recording = load_recording(path)
    facts = dict(recording.provenance)
    event, explanation = facts.pop("event", None), facts.pop("explanation", None)
    is_explained = isinstance(explanation, str) and bool(explanation.strip())
    if not isinstance(event, dict) or not is_explained:
        raise RecordingError(
            f"{path}: a recording, but no event log: its provenance has no event; "
            "`tauext run --flights` writes event logs"
        )
    beside = path.with_name(path.stem + ESTIMATES)
    estimates = load_estimates(beside)
    if estimates.contact_limit_nm is None:
        raise RecordingError(f"{beside}: its contact thresholds are missing; record the event log again")
    if estimates.joints != recording.joints or not np.array_equal(estimates.t_ns, recording.t_ns):
        raise RecordingError(f"{beside}: its joints or times are not those of {path.name}; it is of another event log")
    check_event(path, event, len(recording.joints))
    loads, of = facts.get("loads"), {"t_ns", "mass_kg"}
    if not isinstance(loads, list) or not all(isinstance(one, dict) and of <= one.keys() for one in loads):
        raise RecordingError(f"{path}: its loads are no list of {{t_ns, mass_kg, ...}}; record it again")
    return Flight(recording, estimates, event, tuple(explanation.splitlines()), facts)


def check_event(path: Path, event: dict[str, Any], joints: int) -> None:
    """Raise RecordingError unless every field of the event has its kind: text, whole numbers, or a list a joint."""
    if missing := NEEDED - event.keys():
        raise RecordingError(f"{path}: its event has no {', '.join(sorted(missing))}; record it again")
    kinds: dict[str, Any] = {"what": str, "t_ns": int, "joint": str | None}
    for name, kind in kinds.items():
        if not isinstance(event[name], kind) or isinstance(event[name], bool):
            raise RecordingError(f"{path}: its event's {name} = {event[name]!r} is of the wrong kind; record it again")
    for name, of in LISTS.items():
        value = event[name]
        if not isinstance(value, list) or len(value) != joints or not all(isinstance(one, of) for one in value):
            raise RecordingError(f"{path}: its event's {name} is no list of {joints} values; record it again")


def flights_in(folder: Path) -> list[Path]:
    """Flights of a folder in the order of their names.

    Raises:
        ConfigError: there is none.
    """
    flights = [path for path in folder.glob("*.parquet") if path.with_name(path.stem + ESTIMATES).is_file()]
    if not flights:
        raise ConfigError(f"{folder}: there are no event logs in this folder; `tauext run --flights` writes them")
    return sorted(flights)
