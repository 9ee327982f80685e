"""Files of a folder of `tauext commission` that other commands read: facts, bundles and their history."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import Any, get_args

from tauext.data.labels import Label, LabelAnswer
from tauext.errors import ConfigError
from tauext.files.plain_file import expect_format, json_of, read_json, read_text
from tauext_commission.journal import COMPACTED, Contents, read
from tauext_commission.journal_lines import is_bundle_name, is_number, is_text, is_whole

FACTS = "commission.json"
NOTED = "journal"
"""Entry of commission.json and coverage.json: number of a recent line of the journal; it shows a lost end."""
KIND, ALARM = "label", "event"
"""Kinds of lines: of an answer, and of an alarm, whose stamps its label has."""
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


def control_socket(folder: Path) -> Path:
    """Path of the socket that takes control lines for this folder's arm."""
    return folder / str(read_facts(folder).get("control") or "control.sock")


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


# --- Labels.


def read_labels(folder: Path, to_train: bool = False) -> tuple[Label, ...]:
    """The newest label of each id in the journal of a folder; see tauext.data.labels.read_labels()."""
    if to_train:
        expect_journal(folder)
    return labels_of(read(folder))


@lru_cache(maxsize=8)
def labels_of(journal: Contents) -> tuple[Label, ...]:
    """The newest label of each id in these lines."""
    newest: dict[int, Label] = {}
    alarms: dict[int, Label] = {}
    for content in journal.lines:
        with suppress(KeyError, TypeError, ValueError):
            if content.get("kind") == ALARM:
                alarms[content["id"]] = label_of_alarm(content)
                newest.setdefault(content["id"], alarms[content["id"]])
            elif content.get("kind") == KIND:
                label = label_of(content)
                is_late = label.id in newest and newest[label.id].is_answered
                if label.answer != "withdrawn" or not is_late:  # the answer came while labels were withdrawn
                    newest[label.id] = label
    labels = (label for label in newest.values() if label.answer != "withdrawn")
    return tuple(one if one.id not in alarms else alarms[one.id].answered(one) for one in labels)


def label_of_alarm(content: Mapping[str, Any]) -> Label:
    """Make the label of an unanswered alarm from its line; KeyError or ValueError where it is none."""
    span = int(content["t_ns"]), int(content.get("held_ns") or content["t_ns"])
    words = str(content.get("wall") or ""), str(content.get("bundle") or "")
    return Label(int(content["id"]), int(content["epoch"]), *span, "unanswered", "nobody", *words)


def label_of(content: Mapping[str, Any]) -> Label:
    """The label in one line; KeyError or ValueError where it is none."""
    label = Label(**{field.name: type_of(field.type)(content[field.name]) for field in fields(Label)})
    if label.answer not in get_args(LabelAnswer):
        raise ValueError(label.answer)
    return label


def type_of(name: object) -> type:
    return int if name == "int" else str


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
        own = {key: value for key, value in one.items() if key not in ("number", "kind")}
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
    """A time in which a bundle was in charge, in seconds of received samples."""

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
