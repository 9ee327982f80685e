"""Loads of the arm from text: a line, a TOML table, or a file with times."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar

from tauext._core import Load, LoadSettings
from tauext.config import Rule, within
from tauext.errors import ConfigError
from tauext.files.plain_file import read_toml
from tauext.files.typed_table import expect_known, read_table, table_of_line

USAGE = "none, or mass=KG com=X,Y,Z inertia=XX,YY,ZZ,XY,XZ,YZ error=SHARE; only mass is required"
NOTHING = Load()


@dataclass(frozen=True)
class LoadTable:
    """Keys of a load."""

    mass: float
    """[kg]."""
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of mass in the load frame, [m]."""
    inertia: Annotated[tuple[float, ...], Rule(", 3 or 6 of them", lambda value: len(value) in (3, 6))] = (0.0,) * 6
    """About the centre of mass, [kg m2]: xx, yy, zz, and xy, xz, yz where they are not 0."""
    error: float | None = None
    """Relative error of the load; None: the core's default."""

    @property
    def load(self) -> Load:
        whole = self.mass, self.com, self.inertia + (0.0,) * (6 - len(self.inertia))
        return Load(*whole) if self.error is None else Load(*whole, self.error)


AnyLoad = TypeVar("AnyLoad", bound=LoadTable)


@dataclass(frozen=True)
class LaterLoad(LoadTable):
    """Keys of a load in a file of loads."""

    from_s: Annotated[float, within(0, 1e9)] = 0.0  # stamps in nanoseconds allow nine times as much


@dataclass(frozen=True)
class TimedLoad:
    """A load and its start time."""

    from_s: float
    """Time since the recording's first sample, [s]; the load is set before the first sample at or after it."""
    load: Load


@dataclass(frozen=True)
class Expected:
    """Expected load: for `seconds` the load may change to any mass up to `at_most`, [kg]."""

    seconds: float
    at_most: float


@dataclass(frozen=True)
class LoadLine(LoadTable):
    """Keys of a load in a control line."""

    ago: Annotated[float, within(0, 1e6)] | None = None
    """Time since the load was picked up, [s]."""


def expected_of_text(text: str) -> Expected:
    """Parse the expected load in a line such as `seconds=3 at_most=2.5`.

    Raises:
        ConfigError: names the error and the syntax.
    """
    where = f"expect {text.strip()[:80]!r}"
    head, table = table_of_line(Expected, text, where)
    if head or not table:
        raise ConfigError(
            f"{where} cannot be read; it is seconds=S at_most=KG: for how long, and the most that may be carried then"
        )
    return read_table(Expected, table, f"{where}:")


def load_of_text(text: str) -> Load:
    """Parse the load in a line such as `mass=2.8 com=0,0,0.05`, or `none`.

    Raises:
        ConfigError: names the error and the syntax.
    """
    return _load_of_line(LoadTable, text).load


def load_and_ago_of_text(text: str) -> tuple[Load, float | None]:
    """Parse the load in a line, and the time since it was picked up, [s], if the line has `ago=0.4`."""
    found = _load_of_line(LoadLine, text)
    return found.load, found.ago


def _load_of_line(kind: type[AnyLoad], text: str) -> AnyLoad:
    where = f"load {text.strip()[:80]!r}"
    first, table = table_of_line(kind, text, where)
    if first not in ("", "none") or not (first or table):
        bare = re.fullmatch(r"([0-9.eE+-]+)\s*(?:kg)?", first)
        meant = f"; did you mean 'mass={bare[1]}'?" if bare and not table else ""
        raise ConfigError(f"{where} cannot be read{meant}; a load is {USAGE}")
    if first == "none":
        if more := [key for key in table if key != "ago"]:
            raise ConfigError(f"{where}: none has no {more[0]}")
        table["mass"] = 0.0
    return read_table(kind, table, f"{where}:")


def read_loads(path: Path) -> list[TimedLoad]:
    """Read loads with times from a TOML file of tables [[load]]: from_s, mass, com, inertia, error.

    Raises:
        ConfigError: no such file, or a value that breaks a rule.
    """
    content, found = read_toml(path), list[TimedLoad]()
    expect_known(f"{path}:", content, ("load",))
    if not isinstance(listed := content.get("load"), list) or not listed:
        raise ConfigError(f"{path}: load is missing; it must be one or more tables [[load]]")
    for count, table in enumerate(listed, 1):
        one = read_table(LaterLoad, table, f"{path}: [[load]] {count}")
        if found and one.from_s < found[-1].from_s:
            raise ConfigError(f"{path}: [[load]] {count} from_s = {one.from_s:g} must not be before the load above it")
        found.append(TimedLoad(one.from_s, one.load))
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
