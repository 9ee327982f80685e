"""What the values of a journal's line must be: types, ranges, and names that lead nowhere else."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Any, get_args

from tauext.data.labels import LabelAnswer

LARGEST_ID = 2**31 - 1
"""Largest number of an alarm: the core counts alarms in 32 bits."""
LARGEST_STAMP = 2**61
"""Largest stamp, [ns]: its margins are whole numbers of 64 bits, too."""
LARGEST = 1e15
"""Largest size of another number."""

Line = Mapping[str, Any]
Rule = tuple[Callable[[Any], bool], str]


def is_file_name(name: object) -> bool:
    """Whether it names a file of the folder itself: no path, no name of another folder."""
    return isinstance(name, str) and re.fullmatch(r"(?!\.\.?$)[^/\\\x00-\x1f\x7f:]{1,200}", name) is not None


def is_bundle_name(name: object) -> bool:
    """Whether it names a bundle of a commissioned folder, `b0001` for example: none leads to another folder."""
    return isinstance(name, str) and re.fullmatch(r"b[0-9]{1,15}", name) is not None


def is_whole(value: object, most: float = LARGEST, least: float | None = None) -> bool:
    """Whether it is a whole number up to this size; a truth value is none."""
    least = -most if least is None else least
    return isinstance(value, int) and not isinstance(value, bool) and least <= value <= most


def is_number(value: object, least: float = -LARGEST) -> bool:
    """Whether it is a finite number; a truth value is none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and least <= value <= LARGEST


def is_text(value: object) -> bool:
    """Whether it is a text that a file can hold: no half of a pair of surrogates."""
    return isinstance(value, str) and re.search("[\ud800-\udfff]", value) is None


def is_ranges(value: object) -> bool:
    """Whether it is a list of first and last numbers."""
    return isinstance(value, list) and all(
        isinstance(one, list) and len(one) == 2 and all(is_whole(n, least=1) for n in one) and one[0] <= one[1]
        for one in value
    )


def is_plain(value: object, depth: int = 8) -> bool:
    """Whether all numbers in it are finite and of usual size, and all texts can be written to a file."""
    if depth == 0:
        return False
    if isinstance(value, dict):
        return all(is_text(key) and is_plain(one, depth - 1) for key, one in value.items())
    if isinstance(value, list):
        return all(is_plain(one, depth - 1) for one in value)
    return (
        value is None or isinstance(value, bool) or is_whole(value, LARGEST_STAMP) or is_number(value) or is_text(value)
    )


def _each(check: Callable[[Any], bool], kind: type[list[Any] | dict[str, Any]] = list) -> Callable[[Any], bool]:
    """Whether it is a list, or an object, whose values all pass the check."""

    def passes(value: Any) -> bool:
        return isinstance(value, kind) and all(map(check, value.values() if isinstance(value, dict) else value))

    return passes


def _or_none(check: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda value: value is None or check(value)


RULES: dict[str, Rule] = {
    key: (check, words)
    for keys, check, words in (
        ("kind words wall sentence text by source created running", is_text, "a text"),
        ("answer details level joint touch at on why worse bundle replaces", _or_none(is_text), "a text or null"),
        ("passed kept learned ended", lambda value: isinstance(value, bool), "true or false"),
        ("id", lambda value: is_whole(value, LARGEST_ID), f"a whole number up to {LARGEST_ID}"),
        ("epoch first learn_from segment alarms format", lambda value: is_whole(value, least=0),
         f"a whole number of 0 to {LARGEST:g}"),
        ("t_ns held_ns from_ns to_ns", lambda value: is_whole(value, LARGEST_STAMP), "a whole number of ns"),
        ("seconds minutes hours replayed_s", lambda value: is_number(value, 0.0), f"a number of 0 to {LARGEST:g}"),
        ("false_alarms in_hours", lambda value: is_number(value, 1e-6) and value <= 1e6, "a number of 1e-6 to 1e6"),
        ("between_per_hour newtons_interval", _or_none(lambda value: isinstance(value, list) and len(value) == 2 and
         all(map(is_number, value))), "two finite numbers or null"),
        ("promised_per_hour proved_per_hour per_hour before hits error_ratio test_minutes tau_ext_nm limit_nm newtons "
         "took_us", _or_none(is_number), "a finite number or null"),
        ("joints units", _each(is_text), "a list of texts"),
        ("lost dropped", is_ranges, "pairs of a first and a last number"),
        ("name", is_file_name, "the name of a file of this folder, without a path"),
        ("flight", _or_none(is_file_name), "the name of a file, without a path, or null"),
        ("over", _each(is_number), "a list of finite numbers"),
        ("error", _each(_or_none(is_number)), "a list of finite numbers or null"),
        ("friction", _each(lambda value: is_number(value, 1e-9), dict), "a number > 0 of each joint"),
        ("unanswered", _each(lambda value: is_whole(value, least=0), dict), "a count of each bundle"),
        ("arm", lambda value: isinstance(value, dict) and is_plain(value), "an object"),
    )
    for key in keys.split()
}  # fmt: skip
"""Rule of each key, whatever the kind of its line, and the rule in words."""
OF_KIND: dict[tuple[str, str], Rule] = {
    ("label", "answer"): (lambda value: value in get_args(LabelAnswer), f"one of {', '.join(get_args(LabelAnswer))}"),
    ("activation", "bundle"): (is_bundle_name, "the name of a bundle of this folder, b0001 for example"),
}
"""Rules that hold for one kind of line."""
NEEDED = {
    "event": ("id",),
    "label": ("id", "epoch", "from_ns", "to_ns", "answer", "by", "wall", "bundle"),
    "file": ("name", "text"),
    "activation": ("bundle", "words", "seconds"),
    "repair": ("lost",),
    "compacted": ("dropped",),
    "reply": ("answer",),
    "budget": ("false_alarms", "in_hours", "words", "seconds"),
}
"""Keys that a line of a kind must have."""


def why_unusable(line: Line) -> str:
    """Why a line cannot be used, in one sentence; empty: it can."""
    kind = line.get("kind")
    if not is_text(kind):
        return f"its kind {shown(kind)} must be a text"
    for key in NEEDED.get(str(kind), ()):
        if key not in line:
            return f"{shown(kind)}: its {key} is missing"
    for key, value in line.items():
        check, words = OF_KIND.get((str(kind), key)) or RULES.get(key) or (is_plain, "finite numbers and texts")
        if not check(value):
            return f"{shown(kind)}: its {key if is_text(key) else shown(key)} {shown(value)} must be {words}"
    return ""


def shown(value: object) -> str:
    """A value in a message: short, and without characters that act on a terminal."""
    if isinstance(value, float) and not math.isfinite(value):
        return "nan" if math.isnan(value) else f"{value:g}"
    text = ascii(value)
    return text if len(text) <= 60 else f"{text[:60]}..."
