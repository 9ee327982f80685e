"""Arms at their dates: what stands in the fleet folders that `tauext fleet run` made."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from tauext.data.dataset import load_dataset
from tauext.data.recording_start import recording_date
from tauext.errors import ConfigError, TauextError
from tauext.files.place import Place, place_of
from tauext.files.plain_file import json_of, read_text

FLEET, FORMAT = "fleet.json", 1


@dataclass(frozen=True)
class Visit:
    """One arm at one date."""

    serial: str
    """Which arm it is."""
    name: str
    """What its fleet calls it."""
    type: str
    run: int
    """Which of the fleet folders it stands in, from 0 on."""
    date: str
    """YYYY-MM-DD; empty: nobody knows."""
    state: str
    reason: str
    """Why it is not done; empty where it is."""
    stage: str
    """The stage that failed."""
    folder: Place
    """Of the arm in its fleet's."""
    dataset: Place | None
    bundle: Place | None
    results: Place | None


def visits_of(fleets: Sequence[Place]) -> list[Visit]:
    """All arms of these fleet folders, each arm's dates in their order.

    A date is what FLEET.toml says, or the day of the first recording where its clock tells one. Where an arm has
    entries without a date, all of its entries are in the order of the folders.

    Raises:
        ConfigError: no fleet.json, not readable, or one folder twice.
    """
    places = [place.resolve() for place in fleets]
    twice = [str(fleets[k]) for k, place in enumerate(places) if place in places[:k]]
    if twice:
        raise ConfigError(f"{twice[0]}: the same fleet folder twice; give each date once")
    visits = [one for run, fleet in enumerate(fleets) for one in visits_in(fleet, run)]
    if not visits:
        raise ConfigError(f"{fleets[0] / FLEET}: it lists no arm")
    dated = {one.serial for one in visits} - {one.serial for one in visits if not one.date}
    return sorted(visits, key=lambda one: (one.date if one.serial in dated else "", one.run))


def visits_in(fleet: Place, run: int) -> list[Visit]:
    """Of one fleet folder."""
    path = fleet / FLEET
    try:
        content = json_of(read_text(path))
        if not isinstance(content, dict) or content.get("format") != FORMAT:
            raise ValueError("its format is another one")
        return [visit_of(entry, fleet, run) for entry in content["arms"]]
    except FileNotFoundError as error:
        raise ConfigError(
            f"{path}: there is no such fleet; `tauext fleet run FLEET.toml --out {fleet}` makes one"
        ) from error
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"{path}: cannot be read as a fleet of `tauext fleet run` ({error})") from error


def visit_of(entry: dict[str, Any], fleet: Place, run: int) -> Visit:
    """One entry of fleet.json."""

    def place(key: str) -> Place | None:
        return place_of(str(entry[key]), fleet) if entry.get(key) else None

    name, state = str(entry["name"]), str(entry["state"])
    stage, reason = "", ""
    for word, told in entry["stages"].items():
        if told["state"] in ("failed", "refused"):
            stage, reason = word, str(told.get("reason") or told["state"])
            break
    if not reason and state != "done":
        stage, reason = "", "not run to the end; the same `tauext fleet run` goes on"
    visit = Visit(
        serial=str(entry.get("serial") or name),
        name=name,
        type=str(entry.get("type") or ""),
        run=run,
        date=str(entry.get("date") or ""),
        state=state,
        reason=reason,
        stage=stage,
        folder=fleet / "arms" / name,
        dataset=place("dataset"),
        bundle=place("bundle"),
        results=place("results"),
    )
    return visit if visit.date else replace(visit, date=date_in(visit.dataset))


def date_in(dataset: Place | None) -> str:
    """Day of the first training recording; empty: its clock tells none, or it is not there."""
    if dataset is None:
        return ""
    try:
        files = load_dataset(dataset).files("train")
    except TauextError:
        return ""
    found = recording_date(files[0]) if files else None
    return found.isoformat() if found is not None else ""
