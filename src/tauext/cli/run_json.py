"""`tauext run --json`: JSON lines for programs; docs/files.md lists them."""

from __future__ import annotations

import json
from typing import Any, Self

from tauext._core import Bundle, cause_names
from tauext.bundle.estimates import HEALTHS, number
from tauext.cli.run_text import FlightCount
from tauext.data.recording import Recording
from tauext.monitor.changes import (
    ALARMS,
    TOUCHES,
    Change,
    DriftChange,
    FoundLoad,
    HealthChange,
    LoadChange,
    TouchChange,
    WeighChange,
)
from tauext.monitor.flight_files import FlightNews
from tauext.monitor.loads import load_facts
from tauext.monitor.places import PlaceChange, place_facts
from tauext.monitor.replay import Chunk, StatusClock, Tally, sample_facts


class JsonLines:
    """One object an event, each written at once; times count from the recording's first sample."""

    def __init__(self, status_hz: float):
        self._status_ns = round(1e9 / status_hz) if status_hz else 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def start(self, bundle: Bundle, recording: Recording, number: int, of: int) -> None:
        self._recording, self._joints, self._start_ns = recording.name, recording.joints, int(recording.t_ns[0])
        self._clock = StatusClock(self._start_ns, self._status_ns) if self._status_ns else None
        self._write(
            "start",
            bundle=bundle.name,
            joints=recording.joints,
            estimate_units=bundle.estimate_units,
            samples=recording.samples,
            duration_s=recording.duration_s,
            rate_hz=recording.rate_hz,
            t_ns=self._start_ns,
        )

    def chunk(self, chunk: Chunk, tally: Tally) -> None:
        """Changes and status lines in the order of their samples."""
        lines = [(change.row, self._change(change)) for change in chunk.changes]
        for k in self._clock.rows(chunk.t_ns) if self._clock else ():
            where = {"row": chunk.first_row + k, **self._when(chunk.t_ns[k])}
            lines.append((chunk.first_row + k, ("status", where | sample_facts(chunk.said, k))))
        for _, (event, content) in sorted(lines, key=lambda line: line[0]):
            self._write(event, **content)

    def flight(self, news: FlightNews) -> None:
        told = {"file": str(news.path)} if news.path else {"file": None, "error": news.error}
        self._write("flight", what=news.what, **self._when(news.t_ns), **told)

    def end(self, tally: Tally, flights: FlightCount, complete: bool) -> None:
        self._write("end", complete=complete, **tally.summary(), flights=flights.summary())

    def total(self, tally: Tally, flights: FlightCount, recordings: int, interrupted: bool) -> None:
        content = {"recordings": recordings, "interrupted": interrupted, **tally.summary()}
        print(json.dumps({"event": "summary", **content, "flights": flights.summary()}, allow_nan=False), flush=True)

    def _when(self, t_ns: int) -> dict[str, Any]:
        return {"t_ns": int(t_ns), "time_s": (int(t_ns) - self._start_ns) * 1e-9}

    def _change(self, change: Change) -> tuple[str, dict[str, Any]]:
        where = {"row": change.row, **self._when(change.t_ns)}
        if isinstance(change, LoadChange):
            told = {"by": change.by, "since_ns": change.since_ns, "left_out": list(change.left_out)}
            return "load", {**where, **load_facts(change.load), **told}
        if isinstance(change, FoundLoad):
            return "load", {**where, "mass_kg": change.mass_kg, "mass_error_kg": change.error_kg, "by": "expected"}
        if isinstance(change, WeighChange):
            return "weigh", {**where, "what": change.what, "by": change.by, **found_facts(change)}
        joint = self._joints[change.joint] if change.joint >= 0 else None
        if isinstance(change, DriftChange):
            return "drift", {**where, "joint": joint, "advice": "recalibrate"}
        if isinstance(change, TouchChange):
            kinds = {"touch": TOUCHES[change.touch], "was": TOUCHES[change.was], "alarm": ALARMS[change.alarm]}
            return "touch", {**where, **kinds, "joint": joint, "since_s": change.since_s}
        if isinstance(change, PlaceChange):
            raised = {"alarm": ALARMS[change.alarm], "joint": joint, "since_s": change.since_s}
            return "place", {**where, **raised, **place_facts(change, self._joints)}
        if isinstance(change, HealthChange):
            said = {"health": HEALTHS[change.health], "was": HEALTHS[change.was], "causes": cause_names(change.causes)}
            return "health", {**where, **said, "joint": joint}
        return "alarm", {
            **where,
            "alarm": ALARMS[change.alarm],
            "was": ALARMS[change.was],
            "joint": joint,
            "tau_ext_nm": number(change.tau_ext_nm),
            "sigma_nm": number(change.sigma_nm),
            "limit_nm": number(change.limit_nm),
            "near_stiction": change.near_stiction if joint else None,
            "acknowledged": change.acknowledged,
        }

    def _write(self, event: str, **content: Any) -> None:
        print(json.dumps({"event": event, "recording": self._recording, **content}, allow_nan=False), flush=True)


def found_facts(change: WeighChange) -> dict[str, Any]:
    """As plain JSON: what was found, and the load to set."""
    from tauext.monitor.weighing import load_facts as facts_of_found

    if change.found is None:
        return {"frame": change.frame, "found": None, "load": None}
    load = {**load_facts(change.found.load), "error_share": change.found.load.error_share}
    return {"frame": change.frame, "found": facts_of_found(change.found), "load": load}
