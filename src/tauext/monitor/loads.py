"""What the arm carries, as people write it: in a line of text, in a TOML table, in a file with times."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tauext._core import Load, LoadSettings
from tauext.data.description_file import refuse_unknown
from tauext.errors import ConfigError
from tauext.files.places import Place
from tauext.files.plain_file import read_text, toml_of

KEYS = ("mass", "com", "inertia", "error")
USAGE = "none, or mass=KG com=X,Y,Z inertia=XX,YY,ZZ,XY,XZ,YZ error=SHARE; mass alone has to be there"
EXPECTED_KEYS = ("seconds", "at_most")
EXPECTED_USAGE = "seconds=S at_most=KG: for how long, and the most that may be carried then"
NOTHING = Load()
MOST_AGO_S = 1e6
MOST_FROM_S = 1e9
"""Stamps in nanoseconds hold nine times as much."""


@dataclass(frozen=True)
class TimedLoad:
    """A load, and from when on."""

    from_s: float
    """Since the recording's first sample, [s]: it is set before the first sample that is not earlier."""
    load: Load


@dataclass(frozen=True)
class Expected:
    """The gripper's word: for so long, what the arm carries may become anything up to that."""

    seconds: float
    at_most_kg: float


def expected_of_text(text: str) -> Expected:
    """What a line says: `seconds=3 at_most=2.5`.

    Raises:
        ConfigError: says what is wrong and how it is written.
    """
    where = f"expect {text.strip()[:80]!r}"
    head, *rest = re.split(r"(?:^|(?<=[\s,]))([a-z_]+)\s*=", text.strip())
    if head.strip(" ,\t") or len(rest) != 4:
        raise ConfigError(f"{where} cannot be read; it is {EXPECTED_USAGE}")
    return expected_of_table(
        where, {key: value.strip(" ,\t") for key, value in zip(rest[::2], rest[1::2], strict=True)}
    )


def expected_of_table(where: str, table: Mapping[str, Any]) -> Expected:
    """The same of a table.

    Raises:
        ConfigError: names the key, the value and the rule.
    """
    if set(table) != set(EXPECTED_KEYS):
        raise ConfigError(f"{where}: has {', '.join(table) or 'nothing'}; it is {EXPECTED_USAGE}")
    return Expected(*(_number(f"{where}: {key}", table[key]) for key in EXPECTED_KEYS))


def load_of_text(text: str) -> Load:
    """The load that a line says: `mass=2.8 com=0,0,0.05`, or `none`.

    Raises:
        ConfigError: says what is wrong and how it is written.
    """
    return load_and_ago_of_text(text, extra=())[0]


def load_and_ago_of_text(text: str, extra: Sequence[str] = ("ago",)) -> tuple[Load, float | None]:
    """The same, and how many seconds ago it was picked up where the line says `ago=0.4`."""
    where = f"load {text.strip()[:80]!r}"
    head, *rest = re.split(r"(?:^|(?<=[\s,]))([a-z]+)\s*=", text.strip())
    first = head.strip(" ,\t")
    if first not in ("", "none"):
        raise ConfigError(f"{where} cannot be read; a load is {USAGE}")
    table: dict[str, Any] = {}
    for key, value in zip(rest[::2], rest[1::2], strict=True):
        if key not in (*KEYS, *extra) or key in table:
            raise ConfigError(f"{where}: {key} is {'there twice' if key in table else 'unknown'}; a load is {USAGE}")
        numbers = [_number(where, one) for one in re.split(r"[\s,]+", value.strip("[]() ,\t")) if one]
        if len(numbers) != 1 and key not in ("com", "inertia"):
            raise ConfigError(f"{where}: {key} must be one number; a load is {USAGE}")
        table[key] = numbers if key in ("com", "inertia") else numbers[0]
    ago = table.pop("ago", None)
    if ago is not None and not 0 <= ago <= MOST_AGO_S:
        raise ConfigError(f"{where}: ago = {ago:g} s must be 0 to {MOST_AGO_S:g}")
    if first == "none" and table:
        raise ConfigError(f"{where}: none has no {next(iter(table))}")
    return (NOTHING if first == "none" else load_of_table(where, table)), ago


def load_of_table(where: str, table: Mapping[str, Any]) -> Load:
    """The load of a table with mass, com, inertia and error; three numbers of inertia are its diagonal.

    Raises:
        ConfigError: names the key, the value and the rule.
    """
    if "mass" not in table:
        raise ConfigError(f"{where}: mass is missing; a load is {USAGE}")
    lengths = {"mass": (1,), "error": (1,), "com": (3,), "inertia": (3, 6)}
    found: dict[str, list[float]] = {}
    for key, value in table.items():
        numbers = value if isinstance(value, list) else [value]
        if len(numbers) not in lengths[key]:
            allowed = " or ".join(str(count) for count in lengths[key])
            raise ConfigError(f"{where}: {key} = {value} must be {allowed} number{'s' * (lengths[key] != (1,))}")
        found[key] = [_number(f"{where}: {key}", one) for one in numbers]
    com, inertia = found.get("com", [0.0] * 3), found.get("inertia", [0.0] * 6)
    load = Load(found["mass"][0], com, inertia + [0.0] * (6 - len(inertia)))
    return Load(load.mass, load.com, load.inertia, found["error"][0]) if "error" in found else load


def read_loads(path: Place) -> list[TimedLoad]:
    """Loads with their times, from a TOML file of tables [[load]]: from_s, mass, com, inertia, error.

    Raises:
        ConfigError: no such file, or a value that breaks a rule.
    """
    try:
        content = toml_of(read_text(path))
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: there is no such file") from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read as TOML ({error})") from error
    refuse_unknown(path, "", content, ("load",))
    tables = content.get("load", [])
    if not isinstance(tables, list) or not tables:
        raise ConfigError(f"{path}: there are no loads: a table [[load]] with from_s and mass for each is missing")
    found: list[TimedLoad] = []
    for number, table in enumerate(tables, 1):
        refuse_unknown(path, f"load {number}", table, ("from_s", *KEYS))
        where = f"{path}: load {number}"
        from_s = _number(f"{where}: from_s", table.get("from_s", 0.0))
        if from_s < (found[-1].from_s if found else 0.0):
            raise ConfigError(f"{where}: from_s = {from_s:g} must be >= 0 and not before the load above it")
        if from_s > MOST_FROM_S:
            raise ConfigError(f"{where}: from_s = {from_s:g} must be at most {MOST_FROM_S:g}")
        found.append(TimedLoad(from_s, load_of_table(where, {k: v for k, v in table.items() if k != "from_s"})))
    return found


def expect_load(settings: LoadSettings, load: Load) -> None:
    """Raise ConfigError with the reason where a bundle of these settings would refuse the load."""
    if reason := settings.why_not(load):
        raise ConfigError(reason)


def load_words(load: Load, frame: str = "") -> str:
    """`2.8 kg at tool0, centre of mass 0 0 0.05 m`, or `nothing`."""
    if load.mass == 0:
        return "nothing"
    com = " ".join(f"{value:.4g}" for value in load.com)
    return f"{load.mass:.4g} kg{f' at {frame}' if frame else ''}, centre of mass {com} m"


def load_facts(load: Load) -> dict[str, Any]:
    """As plain JSON."""
    return {"mass_kg": load.mass, "com_m": list(load.com), "inertia_kg_m2": list(load.inertia)}


def _number(where: str, value: Any) -> float:
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not math.isfinite(number):
        raise ConfigError(f"{where}: {value!r} must be a finite number")
    return number
