"""reactions.toml: what shall happen at a collision, a contact, a fault, and when all is well again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

from tauext.data.description_file import refuse_unknown
from tauext.errors import ConfigError
from tauext.files.places import Place
from tauext.files.toml_file import number, read_toml
from tauext.monitor.changes import TOUCHES
from tauext.monitor.sink import EVENT_KINDS, EventKind

TEMPLATE = """\
# What shall happen when the monitor finds something. Each [[reaction]] has a thread of its own: one that fails, hangs
# or is slow delays neither the monitor nor the others. Events that come while it is at work wait; of those with the
# same kind and joint the newest stands for all.
#
#   on               collision, contact, fault, cleared (healthy and no alarm, for the first time after any of them)
#   joints           of collisions and contacts, and of faults of a joint; left out: all
#   touch            kinds of touch, of collisions and contacts: impact, push, clamp, load, when they are known, most of
#                    them 0.2 s after the alarm; unknown: at the alarm; left out: at the alarm, whatever it is
#   links            joints that carry them: when one of these links is touched, more likely than not
#   newtons_over     when the force where the arm is touched is more than this; both are known 0.1 s after the alarm,
#                    and a reaction bound to them runs once an alarm
#   min_interval_s   an event of the same kind sooner than this after one that was taken is counted and left alone; 0
#   timeout_s        a command or function that takes longer is killed; 5
#   and one of:
#   command          program and arguments, no shell. It finds the facts in TAUEXT_EVENT, TAUEXT_JOINT, TAUEXT_TOUCH,
#                    TAUEXT_LINK, TAUEXT_NEWTONS, TAUEXT_T_NS, TAUEXT_TAU_EXT_NM, TAUEXT_LIMIT_NM, TAUEXT_HEALTH,
#                    TAUEXT_CAUSES, and all of them as JSON on stdin
#   python           "module:function", called with the facts as a dict, in a process of its own; modules are looked
#                    for in the folder that the monitor was started in, too
#   publish = true   publishes the event where the source can (ros2)
#   stop = true      makes the robot stop where the source can (ur: its program; franka: its motion)

[[reaction]]
name = "log"
on = ["collision", "contact", "fault", "cleared"]
command = ["logger", "-t", "tauext", "the monitor found something"]

# [[reaction]]
# name = "stop the arm"
# on = ["collision", "fault"]
# stop = true

# [[reaction]]
# name = "lamp"
# on = ["collision", "cleared"]
# joints = ["elbow"]
# min_interval_s = 1.0
# timeout_s = 2.0
# python = "lamp:react"

# [[reaction]]
# name = "open the clamp"
# on = ["collision", "contact"]
# touch = ["clamp"]
# python = "retreat:back_along_the_way"

# [[reaction]]
# name = "somebody leans on the forearm"
# on = ["collision", "contact"]
# links = ["elbow", "wrist_1"]
# newtons_over = 40.0
# command = ["./slow-down"]
"""


@dataclass(frozen=True)
class Reaction:
    """One entry of the file: when, and what."""

    name: str
    on: tuple[EventKind, ...]
    joints: tuple[str, ...] | None = None
    """None: all."""
    min_interval_s: float = 0.0
    timeout_s: float = 5.0
    command: tuple[str, ...] = ()
    python: str = ""
    publish: bool = False
    stop: bool = False
    touch: tuple[str, ...] | None = None
    """None: at the alarm; else when its kind of touch is known to be one of these."""
    links: tuple[str, ...] | None = None
    """Joints that carry them. None: any; else when one of them is touched, more likely than not."""
    newtons_over: float | None = None
    """None: any; else when the force at the most probable place is more than this."""


ACTIONS = ("command", "python", "publish", "stop")


def load_reactions(path: Place, joints: Sequence[str]) -> list[Reaction]:
    """Read a reactions.toml for an arm of these joints.

    Raises:
        ConfigError: names the file, the key, the value and the rule that it breaks.
    """
    content = read_toml(path, "--new-reactions")
    refuse_unknown(path, "", content, ("reaction",))
    tables = content.get("reaction", [])
    if not isinstance(tables, list) or not tables:
        raise ConfigError(f"{path}: there are no reactions: a table [[reaction]] for each is missing")
    found = [_reaction(path, table, joints) for table in tables]
    names = [reaction.name for reaction in found]
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(f"{path}: [[reaction]] name = {name!r} stands there {names.count(name)} times")
    return found


def _reaction(path: Place, table: Any, joints: Sequence[str]) -> Reaction:
    refuse_unknown(path, "reaction", table, tuple(field.name for field in fields(Reaction)))
    name = table.get("name")
    if not isinstance(name, str) or not name.strip():
        raise ConfigError(f"{path}: [[reaction]] name = {name!r} must be text, not empty")
    here = f"{path}: [[reaction]] {name!r}:"
    on = _names(f"{here} on", table.get("on", []), EVENT_KINDS, "events")
    chosen = _names(f"{here} joints", table["joints"], joints, "joints") if "joints" in table else None
    touch = _names(f"{here} touch", table["touch"], TOUCHES[1:], "kinds of touch") if "touch" in table else None
    if touch is not None and not {"collision", "contact"} & set(on):
        raise ConfigError(
            f"{here} touch = {table['touch']!r} says nothing of {', '.join(on)}; on needs collision or contact"
        )
    links = _names(f"{here} links", table["links"], joints, "links, by their joints,") if "links" in table else None
    over = number(f"{here} newtons_over", table["newtons_over"], 0.0, 1e4) if "newtons_over" in table else None
    if (links is not None or over is not None) and not {"collision", "contact"} & set(on):
        raise ConfigError(
            f"{here} links and newtons_over say nothing of {', '.join(on)}; on needs collision or contact"
        )
    given = [key for key in ACTIONS if table.get(key) not in (None, False)]
    if len(given) != 1:
        what = f"{' and '.join(given)} are given" if given else "nothing to do is given"
        raise ConfigError(f"{here} {what}; it must be one of {', '.join(ACTIONS)}")
    command, function = table.get("command", []), table.get("python", "")
    if not isinstance(command, list) or any(not isinstance(word, str) for word in command):
        raise ConfigError(f'{here} command = {command!r} must be a list of texts: ["program", "argument"]')
    if given == ["command"] and not (command and command[0]):
        raise ConfigError(f"{here} command = {command!r} must begin with a program")
    module, colon, rest = function.partition(":") if isinstance(function, str) else ("", "", "")
    if function != "" and not (module and colon and rest.isidentifier()):
        raise ConfigError(f'{here} python = {function!r} must be "module:function"')
    for key in ("publish", "stop"):
        if not isinstance(table.get(key, False), bool):
            raise ConfigError(f"{here} {key} = {table[key]!r} must be true or false")
    return Reaction(
        name,
        on,
        chosen,
        number(f"{here} min_interval_s", table.get("min_interval_s", 0.0), 0.0, 86400.0),
        number(f"{here} timeout_s", table.get("timeout_s", 5.0), 0.01, 3600.0),
        tuple(command),
        function,
        given == ["publish"],
        given == ["stop"],
        touch,
        links,
        over,
    )


def _names(where: str, value: Any, known: Sequence[str], what: str) -> tuple[Any, ...]:
    listed = [value] if isinstance(value, str) else value
    if not isinstance(listed, list) or not listed:
        raise ConfigError(f"{where} = {value!r} must be a list of {what}: {', '.join(known)}")
    for one in listed:
        if one not in known:
            raise ConfigError(f"{where} names {one!r}; {what} are {', '.join(known)}")
    return tuple(listed)
