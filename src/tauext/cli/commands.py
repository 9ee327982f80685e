"""Commands by name: those of tauext, and those of plug-ins."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tauext import plugins
from tauext.errors import ConfigError


@dataclass(frozen=True)
class Folders:
    """Folders that a command makes, and what `tauext show`, `tauext report` and `tauext send` do with them."""

    mark: str
    """Name of a file that each of them holds."""
    show: str
    """`module:function` of a folder and whether JSON is asked for, which prints what is in it."""
    report: str
    """`module:function` of some folders and the folder of pages, which draws their history."""
    socket: str
    """`module:function` of a folder, which returns the path of its control socket."""


@dataclass(frozen=True)
class Command:
    """A command, or a group of commands. Packages add their own as entry points of the group tauext.commands."""

    help: str
    """A line of the overview."""
    function: str = ""
    """`module:function`, imported when the command is called. Its parameters and its docstring are the options and
    their help; it returns the exit status, None for 0."""
    commands: Mapping[str, Command] = field(default_factory=dict)
    """Commands of a group, which has no function."""
    title: str = "Plug-ins"
    """Title of the part of the overview that lists a plug-in's command."""
    folders: Folders | None = None
    """None: it makes no folders that other commands show."""

    def load(self) -> Callable[..., Any]:
        """Import the function."""
        return loaded(self.function)


def loaded(function: str) -> Callable[..., Any]:
    """Import `module:function`."""
    module, _, name = function.partition(":")
    return getattr(importlib.import_module(module), name)


GROUPS: Mapping[str, Mapping[str, Command]] = {
    "Recordings": {
        "import": Command(
            "make a dataset from recordings of a real arm; --new writes arm.toml", "tauext.cli.recordings:import_data"
        ),
        "check": Command("find wrong units, signs, joint order and timing", "tauext.cli.recordings:check"),
    },
    "Trained detectors (bundles)": {
        "train": Command("train a bundle on a dataset's free motion", "tauext.cli.train:train"),
        "calibrate": Command("set other thresholds in a trained bundle", "tauext.cli.train:calibrate"),
        "refit": Command("update a bundle's friction with a minute of today's motion", "tauext.cli.train:refit"),
        "show": Command("print a bundle, a recording, a prior or a commissioned arm", "tauext.cli.show:show"),
    },
    "Monitor": {
        "run": Command("run the monitor on recordings", "tauext.cli.run:run"),
        "monitor": Command("run the monitor on a live arm", "tauext.cli.monitor:monitor"),
        "send": Command("send a control line to a running monitor", "tauext.cli.send:send"),
        "load": Command("identify a payload, or find torque constants from a known payload", "tauext.cli.load:load"),
    },
}
"""The commands of this package, in the groups of the overview."""
OWN = {name: command for group in GROUPS.values() for name, command in group.items()}


def groups() -> dict[str, dict[str, Command]]:
    """The commands of this package in groups, then those of plug-ins; a plug-in that cannot be loaded shows why."""
    added = {}
    for name, entry in plugins.installed(plugins.COMMANDS, OWN).items():
        try:
            added[name] = plugins.load(entry, Command)
        except ConfigError as error:
            added[name] = Command(str(error))
    shown = {title: dict(group) for title, group in GROUPS.items()}
    for name, command in added.items():
        shown.setdefault(command.title, {})[name] = command
    return shown


def all_commands() -> dict[str, Command]:
    """Every command by name."""
    return {name: command for group in groups().values() for name, command in group.items()}


def command_named(name: str) -> Command | None:
    """The command of this name, see plugins.named()."""
    return plugins.named(name, OWN, plugins.COMMANDS, Command)


def folders_like(folder: Path) -> Folders | None:
    """What other commands do with this folder; None: no command makes such folders.

    Raises:
        ConfigError: the package whose command made it is not installed.
    """
    for command in all_commands().values():
        if command.folders and (folder / command.folders.mark).is_file():
            return command.folders
    for mark, name in plugins.MARKS.items():
        if (folder / mark).is_file():
            raise ConfigError(f"{folder}: is of `tauext {name}`; {plugins.how_to_add(name)}")
    return None
