"""Files of a folder of `tauext commission` that other commands read: facts, bundles and their history."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from tauext.data.labels import ALARM, labels_of
from tauext.errors import ConfigError
from tauext.files.journal import COMPACTED, Contents, read
from tauext.files.journal_lines import is_bundle_name, is_number, is_text, is_whole
from tauext.files.plain_file import expect_format, json_of, read_json, read_text

FACTS = "commission.json"
NOTED = "journal"
"""Entry of commission.json and coverage.json: number of a recent line of the journal; it shows a lost end."""
BUNDLES = "bundles"
COVERAGE = "coverage.json"
RESULTS = "results"
FINDINGS = "findings.json"
SHOWN_LINES = 3
"""Lines of the journal whose damage is printed."""


def is_commissioned(folder: Path) -> bool:
    """Whether `tauext commission` made this folder."""
    return (folder / FACTS).is_file()


def read_facts(folder: Path) -> dict[str, Any]:
    """Content of commission.json.

    Raises:
        ConfigError: it is missing or damaged, or of another format.
    """
    content = read_json(folder / FACTS, "there is no such file; `tauext commission` makes one in its folder")
    remedy = "use the version of tauext that made the folder"
    expect_format(content, folder / FACTS, remedy)
    if NOTED not in content:
        raise ConfigError(f"{folder}: was made by a version of tauext without a journal; {remedy}")
    return dict(content)


def lost_lines(folder: Path, noted: int | None = None) -> int:
    """Number of lines of the journal that are lost, until a person has accepted that.

    Args:
        noted: a number that a line had; None: that in commission.json or coverage.json.
    """
    if noted is None:
        noted = 0
        with suppress(ConfigError):
            noted = noted_in(read_facts(folder))
        noted = max(noted, noted_in(read_coverage(folder)))
    return sum(last - first + 1 for first, last in read(folder).lost(noted))


def noted_in(content: dict[str, Any]) -> int:
    """Number of a recent line of the journal, as commission.json and coverage.json note it."""
    number = content.get(NOTED, 0)
    return int(number) if is_whole(number, least=0) else 0


def expect_journal(folder: Path) -> None:
    """Raise ConfigError if lines of a commissioned folder's journal are lost: they may have been answers."""
    if is_commissioned(folder) and (lost := lost_lines(folder)):
        raise ConfigError(
            f"{folder}: {lost_words(lost, unusable_words(folder))}; nothing is trained on it before "
            f"`tauext commission --out {folder} --repair`"
        )


def lost_words(lost: int, unusable: str = "") -> str:
    """How many lines of the journal are lost.

    Args:
        unusable: see unusable_words().
    """
    why = f" ({unusable})" if unusable else ""
    return f"journal: at least {lost} confirmed line{'s are' if lost != 1 else ' is'} lost{why}"


def unusable_words(folder: Path) -> str:
    """Lines of the journal that are not used, the first ones with their reasons; empty: all are."""
    found = read(folder).unusable
    more = f"; and {len(found) - SHOWN_LINES} more" if len(found) > SHOWN_LINES else ""
    return "; ".join(found[:SHOWN_LINES]) + more


def bundle_file(folder: Path, name: object) -> Path | None:
    """File of a bundle of the folder; None: it is missing, or the name leads to another folder."""
    path = folder / BUNDLES / f"{name}.tauext" if is_bundle_name(name) else None
    return path if path is not None and path.is_file() else None


def active_bundle(folder: Path) -> Path | None:
    """File of the bundle that was put in charge last; None: none yet, or it is missing."""
    begun = read(folder).kinds.get("activation")
    return bundle_file(folder, begun[-1]["bundle"]) if begun else None


def received_s(folder: Path) -> float:
    """Samples received so far, [s]: of coverage.json, or of the newest line of the history where that is lost."""
    history = read_history(folder)
    return max(float(read_coverage(folder).get("seconds", 0.0)), float(history[-1]["seconds"]) if history else 0.0)


def read_history(folder: Path) -> list[dict[str, Any]]:
    """Trainings, activations, promises, steps and notes in order; each has `kind`, `wall`, `seconds` and `words`."""
    return list(_history(read(folder)))


@lru_cache(maxsize=4)
def _history(journal: Contents) -> tuple[dict[str, Any], ...]:
    return tuple(one for one in journal.lines if "words" in one and "seconds" in one)


def read_events(folder: Path) -> list[dict[str, Any]]:
    """Alarms in order of their first line; of each id the newest line, and the answer of its label."""
    return [dict(one) for one in _events(read(folder))]


@lru_cache(maxsize=4)
def _events(journal: Contents) -> tuple[dict[str, Any], ...]:
    answered = (one for one in labels_of(journal) if one.is_answered)
    answers: dict[Any, dict[str, Any]] = {one.id: {"answer": one.answer, "by": one.by} for one in answered}
    newest: dict[Any, dict[str, Any]] = {}
    for one in journal.kinds.get(ALARM, ()):
        own = {key: value for key, value in one.items() if key not in ("number", "kind", "format", "journal")}
        newest[one.get("id")] = own | answers.get(one.get("id"), {"answer": None})
    return tuple(newest.values())


def left_out(folder: Path) -> dict[str, int]:
    """Collision alarms without an answer that the journal has left out, by bundle."""
    compacted = read(folder).kinds.get(COMPACTED, [{}])[-1]
    return dict(compacted.get("unanswered", {}))


def read_question(folder: Path) -> dict[str, Any]:
    """The change of the arm that waits for a person, with `answer` once it is given; empty: none."""
    kinds = read(folder).kinds
    asked = (kinds.get("step") or [{}])[-1]
    if not asked or "learned" in asked:
        return {}
    replies = [one for one in kinds.get("reply", ()) if one["number"] > asked["number"]]
    return asked | ({key: replies[-1].get(key) for key in ("answer", "by")} if replies else {})


@dataclass(frozen=True)
class Watch:
    """One time of a bundle in charge, in seconds of received samples."""

    bundle: str
    from_s: float
    to_s: float


def watches(history: list[dict[str, Any]], now_s: float) -> Iterator[Watch]:
    """Which bundle was in charge when, up to now: from its exchange on, which follows its activation late or never."""
    begun = [one for one in history if one["kind"] == "exchange"]
    begun = begun or [one for one in history if one["kind"] == "activation"]
    for one, following in zip(begun, [*begun[1:], None], strict=False):  # no line at all: only the None is left
        begin = float(one["seconds"])
        end = now_s if following is None else float(following["seconds"])
        yield Watch(str(one.get("bundle")), begin, max(begin, end))


def read_coverage(folder: Path) -> dict[str, Any]:
    """Content of coverage.json without damaged entries; empty where the file is missing or damaged."""
    content: Any = None
    with suppress(OSError, ValueError):
        content = json_of(read_text(folder / COVERAGE))
    if not isinstance(content, dict):
        return {}
    joints = content.get("joints")
    whole = [one for one in joints if _is_joint(one)] if isinstance(joints, list) else []
    numbers = {key: value for key, value in content.items() if key in COVERAGE_NUMBERS and is_number(value, 0.0)}
    others = {key: content[key] for key in (NOTED, "monitored") if key in content}
    return {**numbers, **others, "joints": whole}


COVERAGE_NUMBERS = ("seconds", "kept_s", "dropped_s", "bytes", "bytes_most", "needs_s", "monitored_hour")
"""Entries of coverage.json that are numbers of at least 0."""


def _is_joint(one: Any) -> bool:
    """Whether this is the entry of a joint in coverage.json."""
    if not isinstance(one, dict) or not is_text(one.get("joint")):
        return False
    missing = one.get("missing", [])
    return isinstance(missing, list) and all(map(is_text, missing))


def read_findings(folder: Path) -> list[dict[str, Any]]:
    """Findings of the last check of the stream, from findings.json; empty where it is missing or damaged."""
    with suppress(OSError, ValueError, LookupError, TypeError):
        found = json_of(read_text(folder / FINDINGS))["findings"]
        return [
            one
            for one in found
            if isinstance(one, dict)
            and all(one.get(key) is None or is_text(one[key]) for key in ("code", "joint", "severity", "words"))
        ]
    return []


def monitored_of(coverage: Any) -> dict[str, tuple[float, float]]:
    """Seconds that each bundle monitored, and counted seconds, from coverage.json; damaged entries are left out."""
    found: dict[str, tuple[float, float]] = {}
    entries = coverage.get("monitored") if isinstance(coverage, dict) else None
    for bundle, sums in entries.items() if isinstance(entries, dict) else ():
        with suppress(TypeError, ValueError):
            seconds, of_seconds = map(float, sums)
            if 0 <= seconds <= of_seconds < 1e12:
                found[str(bundle)] = (seconds, of_seconds)
    return found
