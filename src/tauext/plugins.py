"""What is installed beside tauext: plug-ins, found by their entry points, and libraries that one part needs.

A package adds a robot, a command, a recipe, a format or an output in its pyproject.toml:

    [project.entry-points."tauext.sources"]
    myarm = "my_package:KIND"        # a tauext.sources.open.SourceKind
    [project.entry-points."tauext.commands"]
    mycommand = "my_package:COMMAND"  # a tauext.cli.commands.Command
    [project.entry-points."tauext.recipes"]
    myrecipe = "my_package:RECIPE"   # a tauext.recipes.Recipe of this name
    [project.entry-points."tauext.importers"]
    myformat = "my_package:IMPORTER"  # a tauext.data.importers.raw.Importer
    [project.entry-points."tauext.sinks"]
    myoutput = "my_package:OUTPUT"   # a tauext.monitor.sink_kind.SinkKind: the option --myoutput
    [project.entry-points."tauext.checks"]
    mycheck = "my_package:CHECK"      # a tauext.check.finding.Check

Parts of tauext's own commands that need a library for drawing, or that few users need, are entry points of the group
tauext.parts: functions by name.

`examples/04_plugin` holds one of each. The names of tauext itself cannot be replaced.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Collection, Mapping
from importlib.metadata import EntryPoint, entry_points
from types import FunctionType
from typing import Any, TypeVar

from tauext.errors import ConfigError

Added = TypeVar("Added")
SOURCES, COMMANDS, IMPORTERS, SINKS, CHECKS, RECIPES, PARTS = GROUPS = (
    "tauext.sources",
    "tauext.commands",
    "tauext.importers",
    "tauext.sinks",
    "tauext.checks",
    "tauext.recipes",
    "tauext.parts",
)
"""Groups of entry points."""
FOLDERS = {
    name: folders
    for folders, names in {
        "lab commission": "commission touch-labels",
        "ros2": "ros2",
        "lab fleet": "fleet like prior-content",
        "lab twin": "twin",
        "lab": "sim mcap simulate evaluate report reproduce bench joint-picture check-pictures force network torch",
        "lerobot": (
            "lerobot lerobot-calibration label guard feetech dynamixel damiao servo-torque servo-signals backlash"
        ),
    }.items()
    for name in names.split()
}
"""Folders of packages/ to install, by the entry point that the last one adds. No registry has these yet: their names
there may be those of strangers."""
MARKS = {"commission.json": "commission"}
"""Commands of packages by the files that mark the folders they make."""
LABELLED = ("journal.db", "journal.backup.db")
"""Files that mark folders whose recordings have labels; the part `touch-labels` reads them."""
IMPORTED = {"meta/info.json": "lerobot"}
"""Importers of packages by the files that mark the folders they read."""


def installed(group: str, taken: Collection[str] = ()) -> dict[str, EntryPoint]:
    """Entry points of the group by name, in the order of names, without the names that are taken.

    Of two packages that add the same name, the one whose value comes last in the alphabet is used.
    """
    found = sorted(entry_points(group=group), key=lambda one: (one.name, one.value))
    return {one.name: one for one in found if one.name not in taken}


def named(name: str, own: Mapping[str, Added], group: str, kind: type[Added]) -> Added | None:
    """What has this name, of tauext's own or, searched only then, of a plug-in; None: nothing has it.

    Raises:
        ConfigError: a plug-in adds it and cannot be loaded.
    """
    if name in own:
        return own[name]
    entry = installed(group, own).get(name)
    return None if entry is None else load(entry, kind)


def every(group: str, kind: type[Added], taken: Collection[str] = ()) -> dict[str, Added]:
    """All plug-ins of the group by name, without the names that are taken.

    Raises:
        ConfigError: one of them cannot be loaded.
    """
    return {name: load(entry, kind) for name, entry in installed(group, taken).items()}


def part(name: str) -> Callable[..., Any]:
    """The function of this name in the group tauext.parts.

    Raises:
        ConfigError: the package that adds it is not installed, or cannot be loaded.
    """
    entry = installed(PARTS).get(name)
    if entry is None:
        raise ConfigError(how_to_add(name) or f"no package adds '{name}'")
    return load(entry, FunctionType)


def how_to_add(name: str) -> str | None:
    """Which package adds the entry point of this name; None: it is there, or no package of this repository adds it."""
    folders = "" if any(name in installed(group) for group in GROUPS) else FOLDERS.get(name, "")
    named = " ".join(f"./packages/{folder}" for folder in folders.split())
    return f"'{name}' is a plug-in: pip install {named} in the source folder of tauext" if named else None


def optional_library(module: str, who: str, package: str) -> Any:
    """Import a module of a library that only one part needs.

    Raises:
        ConfigError: the library is not installed.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise not_installed(who, package) from error


def not_installed(who: str, package: str) -> ConfigError:
    """The error of a library that is not installed. It names the library: no registry has tauext's extras yet."""
    return ConfigError(f"{who} needs {package}: pip install '{package}'")


def load(entry: EntryPoint, kind: type[Added]) -> Added:
    """The object of this entry point.

    Raises:
        ConfigError: its package cannot be imported or needs a library, holds no such object, or one of another type.
    """
    of = f"plug-in {entry.name} ({entry.dist.name if entry.dist else 'unknown package'}, {entry.value})"
    try:
        loaded = entry.load()
    except ConfigError:  # a library that the package needs is not installed
        raise
    except Exception as error:  # a package of others may raise anything
        raise ConfigError(f"{of}: cannot be loaded: {type(error).__name__}: {error}") from None
    if not isinstance(loaded, kind):
        raise ConfigError(f"{of}: must be a {kind.__module__}.{kind.__name__}, not a {type(loaded).__name__}")
    return loaded
