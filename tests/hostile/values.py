"""Every option of every command, found by looking at the commands themselves, and values that hurt."""

from __future__ import annotations

import types
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from tauext.files.typed_table import hints_of

FLOATS = ("inf", "-inf", "nan", "-1", "0", "-0.0", "1e-308", "1e308", "1e9", "1e18", "-1e9", "0.5", "1e400")
INTEGERS = ("-1", "0", "1", "1000000000", "2147483648", "9223372036854775808", str(10**30), "1e9", "1.5", "nan", "-5")
WORDS = ("", " ", "x", "-", "--", "none", "None", "True", "\n", "ä\udcff", "a" * 5000, "../..", "{}", "[]", "%s", "0x1")
PLACES = ("missing", ".", "/", "", "/dev/null", "/dev/full", "/dev/zero", "/proc/self/mem", "pipe", "a" * 300, "\udcff")
PLACES += ("full/x", "read-only/x", "robot.xml", "robot.xml/x", "data", "empty", "loop", "new\nline", "-", "~")
PLACES += ("missing/x/y",)


AT_TOP = ("SourceOptions", "FlightOptions", "SinkOptions", "PrintOptions")
AT_TOP += ("TrainOptions", "AlarmOptions", "EventsConfig", "FleetConfig")
NAMES = {"as-json": "json"}


@dataclass(frozen=True)
class Option:
    """One option of a command."""

    name: str
    """As it is typed: --max-steps."""
    kind: Any
    """Its type."""


def options_of(command: Callable[..., Any]) -> list[Option]:
    """All, those of nested settings too."""
    hints = typing.get_type_hints(command)
    return [Option(f"--{NAMES.get(name, name)}", kind) for name, kind in _options(hints, "")]


def _options(hints: dict[str, Any], group: str) -> Iterator[tuple[str, Any]]:
    """Names as they are typed, and types; settings of a command stand at the top, but for those of ros2."""
    for name, kind in hints.items():
        kind, spelled = plain(kind), group + name.replace("_", "-")
        if is_dataclass(kind) or typing.is_typeddict(kind):
            held = typing.get_type_hints(kind, include_extras=True)
            yield from _options(held, "" if kind.__name__ in AT_TOP else f"{spelled}.")
        elif name != "return":
            yield spelled, kind


def keys_of(settings: type) -> list[tuple[str, Any]]:
    """Keys of a file of settings, with their types: alarm.in_hours."""
    return [(name.replace("-", "_"), kind) for name, kind in _options(hints_of(settings), "")]


def plain(kind: Any) -> Any:
    """Without `| None` and annotations."""
    if typing.get_origin(kind) is typing.Annotated:
        return plain(typing.get_args(kind)[0])
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        rest = [one for one in typing.get_args(kind) if one is not type(None)]
        return plain(rest[0])
    return kind


def hostile_words(option: Option, rng: np.random.Generator) -> list[str]:
    """The option with a value that hurts, as it would be typed."""
    kind = option.kind
    if typing.get_origin(kind) is tuple:
        one = plain(typing.get_args(kind)[0])
        count = int(rng.choice([0, 1, 2, 3, 3, 200]))
        return [option.name, *(hostile_value(one, rng) for _ in range(count))]
    if kind is bool:
        flag = option.name if rng.random() < 0.7 else option.name.replace("--", "--no-", 1)
        return [flag] if rng.random() < 0.7 else [flag, str(rng.choice(WORDS))]
    return [option.name, hostile_value(kind, rng)]


def hostile_value(kind: Any, rng: np.random.Generator) -> str:
    """Mostly of the right kind and a bad value; now and then of another kind."""
    if typing.get_origin(kind) is Literal and rng.random() < 0.7:
        return str(rng.choice([str(choice) for choice in typing.get_args(kind)]))
    own = {float: FLOATS, int: INTEGERS, Path: PLACES}.get(kind, WORDS)
    chosen = own if rng.random() < 0.85 else (FLOATS, INTEGERS, WORDS, PLACES)[int(rng.integers(4))]
    return str(chosen[int(rng.integers(len(chosen)))])
