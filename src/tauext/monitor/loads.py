"""Loads of the arm from text: a line, a TOML table, or a file with times."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tauext._core import Load, LoadSettings
from tauext.errors import ConfigError
from tauext.files.plain_file import number_of
from tauext.files.toml_file import number, numbers, read_table, read_toml, tables

KEYS = {
    "mass": number(),
    "com": numbers((3,), number(), default=(0.0,) * 3),
    "inertia": numbers((3, 6), number(), default=(0.0,) * 6),
    "error": number(default=None),
}
USAGE = "none, or mass=KG com=X,Y,Z inertia=XX,YY,ZZ,XY,XZ,YZ error=SHARE; only mass is required"
EXPECTED_USAGE = "seconds=S at_most=KG: for how long, and the most that may be carried then"
NOTHING = Load()
MOST_AGO_S = 1e6
EXPECTED_KEYS = {"seconds": number(), "at_most": number()}
FROM_S = number(0.0, 1e9, 0.0)
"""Largest time of a load, [s]; stamps in nanoseconds allow nine times as much."""


@dataclass(frozen=True)
class TimedLoad:
    """A load and its start time."""

    from_s: float
    """Time since the recording's first sample, [s]; the load is set before the first sample at or after it."""
    load: Load


@dataclass(frozen=True)
class Expected:
    """Expected load: for `seconds` the load may change to any mass up to `at_most_kg`."""

    seconds: float
    at_most_kg: float


def expected_of_text(text: str) -> Expected:
    """Parse the expected load in a line such as `seconds=3 at_most=2.5`.

    Raises:
        ConfigError: names the error and the syntax.
    """
    where = f"expect {text.strip()[:80]!r}"
    head, *rest = re.split(r"(?:^|(?<=[\s,]))([a-z_]+)\s*=", text.strip())
    if head.strip(" ,\t") or len(rest) != 4:
        raise ConfigError(f"{where} cannot be read; it is {EXPECTED_USAGE}")
    table = {key: _number(where, value.strip(" ,\t")) for key, value in zip(rest[::2], rest[1::2], strict=True)}
    return expected_of_table(where, "", table)


def expected_of_table(path: Path | str, table: str, content: Any) -> Expected:
    """Read the expected load in a table.

    Raises:
        ConfigError: names the key, the value and the rule.
    """
    return Expected(*read_table(path, table, content, EXPECTED_KEYS).values())


def load_of_text(text: str) -> Load:
    """Parse the load in a line such as `mass=2.8 com=0,0,0.05`, or `none`.

    Raises:
        ConfigError: names the error and the syntax.
    """
    return load_and_ago_of_text(text, extra=())[0]


def load_and_ago_of_text(text: str, extra: Sequence[str] = ("ago",)) -> tuple[Load, float | None]:
    """Parse the load in a line, and the time since it was picked up, [s], if the line has `ago=0.4`."""
    where = f"load {text.strip()[:80]!r}"
    head, *rest = re.split(r"(?:^|(?<=[\s,]))([a-z]+)\s*=", text.strip())
    first = head.strip(" ,\t")
    if first not in ("", "none"):
        bare = re.fullmatch(r"([0-9.eE+-]+)\s*(?:kg)?", first)
        meant = f"; did you mean 'mass={bare[1]}'?" if bare and not rest else ""
        raise ConfigError(f"{where} cannot be read{meant}; a load is {USAGE}")
    table: dict[str, Any] = {}
    for key, value in zip(rest[::2], rest[1::2], strict=True):
        if key not in (*KEYS, *extra) or key in table:
            raise ConfigError(f"{where}: {key} is {'given twice' if key in table else 'unknown'}; a load is {USAGE}")
        numbers = [_number(where, one) for one in re.split(r"[\s,]+", value.strip("[]() ,\t")) if one]
        if len(numbers) != 1 and key not in ("com", "inertia"):
            raise ConfigError(f"{where}: {key} must be one number; a load is {USAGE}")
        table[key] = numbers if key in ("com", "inertia") else numbers[0]
    ago = table.pop("ago", None)
    if ago is not None and not 0 <= ago <= MOST_AGO_S:
        raise ConfigError(f"{where}: ago = {ago:g} s must be 0 to {MOST_AGO_S:g}")
    if first == "none" and table:
        raise ConfigError(f"{where}: none has no {next(iter(table))}")
    return (NOTHING if first == "none" else load_of_table(where, "", table)), ago


def load_of_table(path: Path | str, table: str, content: Any) -> Load:
    """Read the load in a table of mass, com, inertia and error; three numbers of inertia are the diagonal.

    Raises:
        ConfigError: names the key, the value and the rule.
    """
    mass, com, inertia, error = read_table(path, table, content, KEYS).values()
    load = Load(mass, com, inertia + (0.0,) * (6 - len(inertia)))
    return load if error is None else Load(load.mass, load.com, load.inertia, error)


def read_loads(path: Path) -> list[TimedLoad]:
    """Read loads with times from a TOML file of tables [[load]]: from_s, mass, com, inertia, error.

    Raises:
        ConfigError: no such file, or a value that breaks a rule.
    """
    found: list[TimedLoad] = []
    for count, table in enumerate(read_table(path, "", read_toml(path), {"load": tables("[[load]]")})["load"], 1):
        where = f"load {count}"
        from_s = read_table(path, where, table, {"from_s": FROM_S} | KEYS)["from_s"]
        if found and from_s < found[-1].from_s:
            raise ConfigError(f"{path}: {where} from_s = {from_s:g} must not be before the load above it")
        found.append(TimedLoad(from_s, load_of_table(path, where, {k: v for k, v in table.items() if k != "from_s"})))
    return found


def expect_load(settings: LoadSettings, load: Load) -> None:
    """Raise ConfigError with the reason if a bundle with these settings would refuse the load."""
    if reason := settings.why_not(load):
        raise ConfigError(reason)


def load_words(load: Load, frame: str = "") -> str:
    """Describe a load: `2.8 kg at tool0, centre of mass 0 0 0.05 m`, or `nothing`."""
    if load.mass == 0:
        return "nothing"
    com = " ".join(f"{value:.4g}" for value in load.com)
    return f"{load.mass:.4g} kg{f' at {frame}' if frame else ''}, centre of mass {com} m"


def load_facts(load: Load) -> dict[str, Any]:
    """Convert the load to plain JSON."""
    return {"mass_kg": load.mass, "com_m": list(load.com), "inertia_kg_m2": list(load.inertia)}


def _number(where: str, value: str) -> float:
    try:
        return number_of(value)
    except ValueError:
        raise ConfigError(f"{where}: {value[:40]!r} must be a number") from None
