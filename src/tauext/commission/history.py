"""What a commissioned arm was promised and what happened, and its history in words."""

from __future__ import annotations

import json
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from tauext.bundle.bundle_file import load_bundle
from tauext.bundle.history_file import active_bundle, read_events, read_facts, read_history, watches
from tauext.errors import TauextError
from tauext.files.places import Place
from tauext.files.plain_file import json_of, read_text
from tauext.fit.tail import duration, is_kept

# --- The promise of the bundle in charge, and its false alarms.


@dataclass(frozen=True)
class Kept:
    """Promise of a bundle and what happened while it monitored."""

    bundle: str
    promised_per_hour: float | None
    """None: its limits promise nothing."""
    sentence: str
    hours: float
    """Hours that it monitored."""
    false: int
    """Collision alarms that a person answered with `nothing`."""
    unanswered: int
    """Collision alarms without an answer, which may be false."""

    @property
    def kept(self) -> bool:
        """Whether so many false alarms are plausible under the promise."""
        if self.promised_per_hour is None or not self.hours:
            return True
        return is_kept(self.false, self.hours, self.promised_per_hour)

    def words(self) -> str:
        """One sentence."""
        happened = f"{self.false} false alarm{'s' * (self.false != 1)} in {duration(self.hours)}" if self.hours else ""
        if self.promised_per_hour is None:
            return f"{self.bundle} promises nothing" + (f"; {happened}" if happened else "")
        promised = f"{self.bundle} promises at most 1 false alarm in {duration(1 / self.promised_per_hour)}"
        if not happened:
            return promised
        more = f", and {self.unanswered} without an answer" if self.unanswered else ""
        return f"{promised}; there were {happened}{more}: {'kept' if self.kept else 'BROKEN'}"


def kept_of(folder: Place, bundle: str, seconds: float) -> Kept:
    """The promise of a bundle of this folder, up to so many received seconds."""
    hours = sum(one.to_s - one.from_s for one in watches(read_history(folder), seconds) if one.bundle == bundle) / 3600
    alarms = [one for one in read_events(folder) if one.get("bundle") == bundle and one.get("level") == "collision"]
    answers = [one.get("answer") for one in alarms]
    promised, sentence = promise_of(folder, bundle)
    return Kept(bundle, promised, sentence, hours, answers.count("nothing"), answers.count(None))


def promise_of(folder: Place, bundle: str) -> tuple[float | None, str]:
    """False alarms an hour that a bundle's limits are set for, and its sentence; None, "" without a promise."""
    try:
        limits = json.loads(load_bundle(folder / "bundles" / f"{bundle}.tauext").provenance or "{}").get("limits") or {}
    except (TauextError, ValueError):
        return None, ""
    promise = limits.get("promise")
    if not isinstance(promise, dict):
        return None, str(limits.get("sentence") or "")
    budget = promise["asked" if promise["supported"] else "supported_budget"]
    return float(budget["rate_per_hour"]), str(limits.get("sentence") or "")


# --- A folder for `tauext show`.


def describe_folder(folder: Place) -> dict[str, Any]:
    """What a folder of `tauext commission` holds, as plain JSON.

    Raises:
        ConfigError: its commission.json is damaged.
    """
    facts, history, events = read_facts(folder), read_history(folder), read_events(folder)
    coverage: dict[str, Any] = {}
    with suppress(OSError, ValueError):
        coverage = json_of(read_text(folder / "coverage.json"))
    seconds = float(coverage.get("seconds") or 0.0)
    active = active_bundle(folder)
    content: dict[str, Any] = {
        "source": facts.get("source"),
        "created": facts.get("created"),
        "bundle": None if active is None else active.stem,
        "received_hours": round(seconds / 3600, 3),
        "kept_minutes": round(float(coverage.get("kept_s") or 0.0) / 60, 2),
        "dropped_hours": round(float(coverage.get("dropped_s") or 0.0) / 3600, 3),
        "recordings_gb": round(float(coverage.get("bytes") or 0.0) / 1e9, 3),
        "trainings": sum(one["kind"] == "training" for one in history),
        "bundles_in_charge": sum(one["kind"] == "activation" for one in history),
        "alarms": len(events),
        "touched": sum(one.get("answer") == "touched" for one in events),
        "nothing": sum(one.get("answer") == "nothing" for one in events),
        "unanswered": sum(one.get("answer") is None for one in events),
        "missing": {one["joint"]: one["missing"] for one in coverage.get("joints", []) if one.get("missing")},
        "promise": None if active is None else kept_of(folder, active.stem, seconds).words(),
        "history": [{key: one.get(key) for key in ("wall", "kind", "words")} for one in history],
    }
    return content
