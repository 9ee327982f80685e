"""arm.toml, the file of a robot description: every key known, every value of its type, or one clear message."""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable
from dataclasses import MISSING, fields, replace
from pathlib import Path
from typing import Any, get_args

from tauext.data.description import (
    KEYS,
    UNITS,
    Arm,
    ContactTable,
    PayloadTable,
    Repeats,
    RobotTable,
    ServoTable,
    Side,
    SignalTable,
    SplitTable,
    TimeTable,
    TorqueSource,
)
from tauext.data.recording import TORQUE_TIMINGS
from tauext.data.servo import made_torque
from tauext.errors import ConfigError
from tauext.files.places import Place, place_of
from tauext.files.plain_file import read_text, toml_of


def load_arm(path: Place | str, calibration: Path | None = None) -> Arm:
    """Read an arm.toml.

    Args:
        calibration: LeRobot's calibration file, in place of the one that it names.

    Raises:
        ConfigError: no such file, not TOML, an unknown key (the nearest known one is named), a value of the wrong type
            or against its rule.
    """
    path = place_of(path)
    try:
        return parse_arm(read_text(path), path, calibration)
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: there is no such file; `tauext import --new {path}` writes a template") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error})") from error


def parse_arm(text: str, path: Place | str = "arm.toml", calibration: Path | None = None) -> Arm:
    """As load_arm, from the text of the file."""
    path = place_of(path)
    try:
        content = toml_of(text)
    except ValueError as error:
        raise ConfigError(f"{path}: not readable as TOML: {error}") from error
    tables = {"robot": RobotTable, "payload": PayloadTable, "time": TimeTable}
    tables |= {"contact": ContactTable, "split": SplitTable, "servo": ServoTable}
    refuse_unknown(path, "", content, (*tables, "signals"))
    if not isinstance(content.get("robot"), dict):
        raise ConfigError(f"{path}: the table [robot] is missing")
    signals = content.get("signals", {})
    refuse_unknown(path, "signals", signals, tuple(KEYS))
    joints = content["robot"].get("joints", [])
    count = len(joints) if isinstance(joints, list) else 0
    read = {
        name: _table(path, name, cls, content[name], None, count) for name, cls in tables.items() if name in content
    }
    units = {name: next(iter(UNITS[name])) for name in UNITS}
    read["signals"] = {
        name: _table(path, f"signals.{name}", SignalTable, {"columns": "", "unit": units[name]} | table, keys, count)
        for name, keys in KEYS.items()
        if (table := _a_table(path, f"signals.{name}", signals.get(name))) is not None
    }
    read["signals"].setdefault("dq", SignalTable((), "rad/s"))
    if calibration is not None:
        read["robot"] = replace(read["robot"], calibration=str(calibration.absolute()))
    servo = read.get("servo")
    if servo is not None and servo.torque_from != "torque" and "tau" not in signals:
        read["signals"]["tau"] = made_torque(servo, count)
    return Arm(**read, path=path)


def _a_table(path: Place, name: str, value: Any) -> dict | None:
    if value is None or isinstance(value, dict):
        return value
    raise ConfigError(f"{path}: [{name}] is {value!r}, must be a table")


def refuse_unknown(path: Place, table: str, content: Any, known: tuple[str, ...]) -> None:
    """ConfigError unless the table of this name ("": the file's top) is one, and all of its keys are known."""
    if not isinstance(content, dict):
        raise ConfigError(f"{path}: [{table}] is {content!r}, must be a table")
    where = f"in [{table}]" if table else "at the top"
    for key in content:
        if key not in known:
            near = difflib.get_close_matches(key, known, 1, 0.0)
            nearest = f"the nearest known is '{near[0]}'" if near else "none is known"
            raise ConfigError(f"{path}: unknown key '{key}' {where}; {nearest}; known are {', '.join(known)}")


def _table(path: Place, name: str, cls: type, content: Any, keys: tuple[str, ...] | None, joints: int) -> Any:
    """The dataclass of a table, each value of its field's type."""
    known = {f.name: f for f in fields(cls)}
    refuse_unknown(path, name, content, keys or tuple(known))
    values = {}
    for key, value in content.items():
        read, rule = READERS[str(known[key].type)]
        try:
            values[key] = read(value, joints)
        except (TypeError, ValueError) as error:
            raise ConfigError(f"{path}: [{name}] {key} = {value!r} must be {rule}") from error
    for key, known_field in known.items():
        if key not in values and known_field.default is MISSING and known_field.default_factory is MISSING:
            raise ConfigError(f"{path}: [{name}] {key} is missing")
    return cls(**values)


def _text(value: Any, _: int) -> str:
    if not isinstance(value, str):
        raise TypeError
    return value


def _flag(value: Any, _: int) -> bool:
    if not isinstance(value, bool):
        raise TypeError
    return value


def _number(value: Any, _: int = 0) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise TypeError
    return float(value)


def _texts(value: Any, _: int) -> tuple[str, ...]:
    listed = ([value] if value else []) if isinstance(value, str) else value
    if not isinstance(listed, list):
        raise TypeError
    return tuple(_text(one, 0) for one in listed)


def _numbers(value: Any, joints: int) -> tuple[float, ...]:
    """One number stands for every joint."""
    if isinstance(value, list):
        return tuple(map(_number, value))
    return (_number(value),) * max(joints, 1)


def _constants(value: Any, joints: int) -> tuple[float, ...] | str:
    return "unknown" if value == "unknown" else _numbers(value, joints)


def _number_or_period(value: Any, _: int) -> float | str:
    return "period" if value == "period" else _number(value)


def _spans(value: Any, _: int) -> dict[str, tuple[tuple[float, ...], ...]]:
    if not isinstance(value, dict):
        raise TypeError
    return {name: tuple(tuple(map(_number, span)) for span in spans) for name, spans in value.items()}


def _one_of(choices: tuple[str, ...]) -> tuple[Callable[[Any, int], str], str]:
    def read(value: Any, _: int) -> str:
        if value not in choices:
            raise ValueError
        return value

    return read, f"one of {', '.join(choices)}"


READERS: dict[str, tuple[Callable[[Any, int], Any], str]] = {
    "str": (_text, "text"),
    "bool": (_flag, "true or false"),
    "float": (_number, "a number"),
    "tuple[str, ...]": (_texts, "a text or a list of texts"),
    "tuple[float, ...]": (_numbers, "a number or a list of numbers"),
    "tuple[float, ...] | str": (_constants, 'a number, a list of numbers, or "unknown"'),
    "float | str": (_number_or_period, 'a number, or "period"'),
    "dict[str, tuple[tuple[float, float], ...]]": (_spans, "a table of lists [[t0, t1], ...]"),
    "Side": _one_of(get_args(Side)),
    "Repeats": _one_of(get_args(Repeats)),
    "TorqueTiming": _one_of(TORQUE_TIMINGS),
    "TorqueSource": _one_of(get_args(TorqueSource)),
}
"""How a value of a field's type is read, and how a message names that type."""
