"""The files of a flight: recording, estimates and explanation; whole or not at all, and never over another's."""

from __future__ import annotations

import csv
import os
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tauext.bundle.estimates import save_estimates
from tauext.data.amperes import AMPERES
from tauext.data.recording_file import save_recording
from tauext.errors import RecordingError
from tauext.files.provenance import VERSION
from tauext.files.whole_file import whole_file
from tauext.monitor.explanation import explain
from tauext.monitor.flight_content import (
    Flight,
    FlightSource,
    as_estimates,
    as_recording,
    carried,
    event_kind,
    event_numbers,
    rows_kept,
)
from tauext.monitor.loads import load_facts

ENDINGS = (".txt", ".dropped.csv", ".estimates.parquet", ".parquet")
"""In the order of writing: who sees FLIGHT.parquet finds the others beside it."""


@dataclass(frozen=True)
class Reservation:
    """A name in a folder that nobody else uses, held by a file NAME.txt.part."""

    folder: Path
    name: str

    def path(self, ending: str) -> Path:
        return self.folder / f"{self.name}{ending}"


def write_flight(flight: Flight, folder: Path, source: FlightSource) -> Path:
    """Write FLIGHT.parquet, FLIGHT.estimates.parquet and FLIGHT.txt; returns the path of the first.

    FLIGHT is <recording>-<time of the event>s-<what>, with a number behind it where that name is taken. Samples that a
    recording cannot hold stand in FLIGHT.dropped.csv instead. Where it can hold none at all, there is no recording, no
    estimates, and the path is that of FLIGHT.txt.

    Args:
        folder: exists.

    Raises:
        RecordingError: a file cannot be written; none of the flight's is left.
    """
    kept = rows_kept(flight)
    text = explain(flight, kept, source)
    event = event_numbers(flight, source)
    provenance = {
        "command": source.command,
        "version": VERSION,
        "recording": source.recording,
        "bundle": source.bundle,
        "event": event,
        "dropped_samples": int((~kept).sum()),
        "loads": [{"t_ns": int(flight["t_ns"][row])} | load_facts(load) for row, load in carried(flight)],
        "explanation": text,
    }
    if "A" in source.torque_units:
        provenance["torque"] = AMPERES
    wanted = f"{source.recording}-{event['time_s']:.3f}s-{event_kind(flight)}"
    try:
        place = reserve(folder, wanted)
        try:
            if not kept.all():
                write_dropped(flight, kept, source, place.path(".dropped.csv"))
            if kept.any():
                save_estimates(as_estimates(flight, kept, source), place.path(".estimates.parquet"))
                recording = as_recording(flight, kept, place.name, source, provenance)
            place.path(".txt.part").write_text(text + "\n", encoding="utf-8")
            os.replace(place.path(".txt.part"), place.path(".txt"))
            if kept.any():
                save_recording(recording, place.path(".parquet"))
        except BaseException:
            remove(place)
            raise
    except OSError as error:
        raise RecordingError(f"{folder / wanted}: the flight cannot be written ({error.strerror or error})") from error
    return place.path(".parquet" if kept.any() else ".txt")


def reserve(folder: Path, wanted: str) -> Reservation:
    """The wanted name or, where a file of it exists or is being written, one with a number behind it."""
    number = 1
    while True:
        place = Reservation(folder, wanted if number == 1 else f"{wanted}-{number}")
        number += 1
        try:
            place.path(".txt.part").open("x").close()
        except FileExistsError:
            continue
        if not any(place.path(ending).exists() for ending in ENDINGS):
            return place
        place.path(".txt.part").unlink()


def remove(place: Reservation) -> None:
    """Take back whatever stands there under this name."""
    for ending in (*ENDINGS, ".txt.part"):
        with suppress(OSError):
            place.path(ending).unlink(missing_ok=True)


def write_dropped(flight: Flight, kept: np.ndarray, source: FlightSource, path: Path) -> None:
    """The samples that the recording cannot hold, all of them, with the monitor's health."""
    with whole_file(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file)
        signals = [f"{signal}_{joint}" for signal in ("q", "dq", "tau") for joint in source.joints]
        table.writerow(["row", "t_ns", *signals, "health", "causes"])
        for row in np.flatnonzero(~kept).tolist():
            values = [float(value) for signal in ("q", "dq", "tau") for value in flight[signal][row]]
            flags = [int(flight["health"][row]), int(flight["causes"][row])]
            table.writerow([row, int(flight["t_ns"][row]), *values, *flags])
