"""Files of a folder of `tauext commission` that other commands read: facts, bundles and their history."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from tauext.files.append_file import read_lines
from tauext.files.copies import version_of
from tauext.files.places import Place, is_stored
from tauext.files.plain_file import expect_format, json_of, read_json, read_text

FACTS = "commission.json"
ACTIVE = "active.json"
HISTORY = "history.jsonl"
EVENTS = "events.jsonl"
BUNDLES = "bundles"
RESULTS = "results"


def is_commissioned(folder: Place) -> bool:
    """Whether `tauext commission` made this folder."""
    return (folder / FACTS).is_file()


def read_facts(folder: Place) -> dict[str, Any]:
    """Content of commission.json.

    Raises:
        ConfigError: it is missing or damaged, or of another format.
    """
    content = read_json(folder / FACTS, "there is no such file; `tauext commission` makes one in its folder")
    expect_format(content, folder / FACTS, "use the version of tauext that made the folder")
    return dict(content)


def active_bundle(folder: Place) -> Place | None:
    """File of the bundle that monitors, or that did last; None: none yet."""
    try:
        content = json_of(read_text(folder / ACTIVE))
        path = folder / BUNDLES / f"{content['bundle']}.tauext"
    except (OSError, ValueError, KeyError, TypeError):
        return None
    return path if path.is_file() else None


def read_history(folder: Place) -> list[dict[str, Any]]:
    """Trainings, activations, promises, steps and notes in order; each has `kind`, `wall`, `seconds` and `words`."""
    path = folder / HISTORY
    return list(_history(path, "" if is_stored(path) else version_of(path))) if path.is_file() else []


@lru_cache(maxsize=4)
def _history(path: Place, version: str) -> tuple[dict[str, Any], ...]:
    return tuple(one for one in read_lines(path) if isinstance(one.get("kind"), str))


def read_events(folder: Place) -> list[dict[str, Any]]:
    """Alarms in order of their first line; of each id the newest line."""
    newest: dict[Any, dict[str, Any]] = {}
    for one in read_lines(folder / EVENTS):
        with suppress(TypeError):
            newest[one.get("id")] = one
    return [one for key, one in newest.items() if key is not None]


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
        end = now_s if following is None else float(following.get("seconds") or 0.0)
        yield Watch(str(one.get("bundle")), float(one.get("seconds") or 0.0), end)
