"""Joints of a robot file and of a recording, matched by name; what matches by no rule is left to a person."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

from tauext.errors import ConfigError

GRIPPER = re.compile(r"gripper|finger|jaw|robotiq|knuckle", re.IGNORECASE)
_FILLERS = frozenset("joint joints jnt jt j axis ax a act actuator motor m link drive dof servo pos position q".split())
"""Words of a joint's name that do not tell it from others."""
_FAMILIES = (
    # Universal Robots: the ROS driver, the teach pendant.
    (
        "shoulder pan, shoulder lift, elbow, wrist 1, wrist 2, wrist 3",
        "base, shoulder, elbow, wrist 1, wrist 2, wrist 3",
    ),
    # SO-100 and SO-101: LeRobot, the URDF of the SO-100, the numbers of its motors.
    (
        "shoulder pan, shoulder lift, elbow flex, wrist flex, wrist roll, gripper",
        "rotation, pitch, elbow, wrist pitch, wrist roll, jaw",
        "1, 2, 3, 4, 5, 6",
    ),
    ("s, l, u, r, b, t", "1, 2, 3, 4, 5, 6"),  # Yaskawa Motoman
)
"""Names that makers and their drivers give to the same joints, from the base on."""


@dataclass
class Matched:
    """Joints of a recording by the robot file's names, and what is left on both sides."""

    pairs: dict[str, str] = field(default_factory=dict)
    """Name in the recording of each matched joint of the robot file."""
    proposed: dict[str, str] = field(default_factory=dict)
    """Pairs that no common rule supports: a person must confirm them."""
    rule: str = ""
    """How the pairs were matched, where names differ."""
    robot_left: tuple[str, ...] = ()
    logged_left: tuple[str, ...] = ()


def match_joints(robot: Sequence[str], logged: Sequence[str]) -> Matched:
    """Match the joints of a robot file and of a recording by name.

    Equal names match. If none is equal, one rule must match all: other prefixes, suffixes, case and separators; the
    number in the name; or the names of a maker. Grippers may be left on either side. Where some names are equal, or
    a rule matches only some, the others are proposals: those that a rule matches, and a single pair that is left.
    Numbers from 0 on one side and from 1 on the other are proposals too.

    Args:
        robot: movable joints of the robot file, from the base on.
        logged: joints of the recording.
    """
    found = Matched({name: name for name in robot if name in logged})
    renamed = dict(zip(_from_one(robot, logged), logged, strict=True))
    counted_otherwise = list(renamed) != list(logged)
    if not found.pairs:
        for rule, keys_of in RULES.items():
            pairs = _by_key(robot, list(renamed), keys_of)
            if pairs and (_all_of(renamed, pairs.values()) or _all_of(robot, pairs)):
                named = {name: renamed[there] for name, there in pairs.items()}
                found = Matched({}, named) if counted_otherwise else Matched(named, rule=rule)
                break
    left = _left(robot, logged, found)
    if left[0] and left[1] and not counted_otherwise:
        for keys_of in RULES.values() if found.pairs else (_spelled, _words):
            found.proposed |= _by_key(robot, logged, keys_of, left)
            left = _left(robot, logged, found)
        arms = [[name for name in names if not GRIPPER.search(name)] for names in left]
        if len(arms[0]) == len(arms[1]) == 1:
            found.proposed[arms[0][0]] = arms[1][0]
    found.robot_left, found.logged_left = (tuple(names) for names in _left(robot, logged, found))
    return found


def expect_all_placed(
    path: object,
    robot: Sequence[str],
    logged: Sequence[str],
    placed: Mapping[str, str],
    locked: Sequence[str],
    ignored: Sequence[str],
) -> str:
    """Refuse a description that leaves a joint out without naming it: a joint that moves would be held.

    Joints with the name of a gripper may be left out. Returns a line that names all that are left out; empty: none.

    Args:
        path: of the description, for the message.
        robot: movable joints of the robot file; empty without one.
        logged: joints that the recording names; empty where it numbers them.
        placed: name in the recording of each joint in use.
        locked, ignored: joints that the description leaves out.
    """
    unknown = [name for name in locked if robot and name not in robot]
    if unknown:
        raise ConfigError(
            f"{path}: [robot] locked = {json.dumps(unknown)}: the robot file's joints are {', '.join(robot)}"
        )
    left = [name for name in robot if name not in placed], [name for name in logged if name not in placed.values()]
    still, unused = (
        [name for name in names if name not in listed and not GRIPPER.search(name)]
        for names, listed in zip(left, (locked, ignored), strict=True)
    )
    if not still and not unused:
        both = zip(("of the robot file", "of the recording"), left, strict=True)
        words = "; ".join(f"{', '.join(names)} {where}" for where, names in both if names)
        return f"joints not in use: {words}" if words else ""
    parts, ways = [], []
    if still:
        parts.append(f"the robot file's {', '.join(still)} {'has' if len(still) == 1 else 'have'} no signal")
        ways.append(f"locked = {json.dumps(still)} holds {'it' if len(still) == 1 else 'them'} at the rest position")
    if unused:
        parts.append(f"the recording's {', '.join(unused)} {'is' if len(unused) == 1 else 'are'} not used")
        ways.append(f"ignored = {json.dumps(unused)} leaves {'it' if len(unused) == 1 else 'them'} out")
    matched = match_joints(still, unused)
    pairs = matched.proposed | matched.pairs
    perhaps = "".join(f"; perhaps '{there}' is '{here}'" for here, there in pairs.items())
    if still and unused:
        ways.insert(0, "joints and names list both names of a pair")
    raise ConfigError(f"{path}: {', and '.join(parts)}{perhaps}; in [robot], {', '.join(ways)}")


def _from_one(robot: Sequence[str], logged: Sequence[str]) -> list[str]:
    """The recording's names, with their numbers changed by one where one list counts from 0 and the other from 1."""
    first = [min((int(k) for k in _numbers(names).values()), default=None) for names in (robot, logged)]
    if sorted(map(str, first)) != ["0", "1"] or set(robot) & set(logged):
        return list(logged)
    change = 1 if first[1] == 0 else -1
    return [re.sub(r"\d+(?=\D*$)", lambda digits: str(int(digits[0]) + change), name) for name in logged]


def _left(robot: Sequence[str], logged: Sequence[str], found: Matched) -> tuple[list[str], list[str]]:
    used = found.pairs | found.proposed
    return [name for name in robot if name not in used], [name for name in logged if name not in used.values()]


def _all_of(names: Iterable[str], matched: Iterable[str]) -> bool:
    """Whether all but grippers are matched."""
    there = set(matched)
    return all(name in there for name in names if not GRIPPER.search(name))


KeysOf = Callable[[Sequence[str]], Mapping[str, str | tuple[str, ...]]]


def _by_key(
    robot: Sequence[str],
    logged: Sequence[str],
    keys_of: KeysOf,
    only: tuple[Sequence[str], Sequence[str]] | None = None,
) -> dict[str, str]:
    """Pairs with one key, which no other name of either list has; `only` restricts the pairs, not the keys."""
    names: list[dict[str | tuple[str, ...], list[str]]] = [{}, {}]
    for of, listed in zip(names, (robot, logged), strict=True):
        for name, key in keys_of(listed).items():
            of.setdefault(key, []).append(name)
    pairs = {}
    for key, here in names[0].items():
        there = names[1].get(key, [])
        if key and len(here) == len(there) == 1 and (only is None or (here[0] in only[0] and there[0] in only[1])):
            pairs[here[0]] = there[0]
    return pairs


def _spelled(names: Sequence[str]) -> dict[str, str]:
    """Names without case and separators."""
    return {name: re.sub(r"[^a-z0-9]", "", name.lower()) for name in names}


def _words(names: Sequence[str]) -> dict[str, tuple[str, ...]]:
    """Words of each name, without fillers and without words that all arm joints share; numbers without zeros."""
    split = {name: re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name) for name in names}
    words = {name: [str(int(w)) if w.isdigit() else w.lower() for w in found] for name, found in split.items()}
    own = [words[name] for name in names if not GRIPPER.search(name)] or list(words.values())
    shared = set(own[0]).intersection(*map(set, own)) if len(own) > 1 else set()
    return {name: tuple(word for word in of if word not in _FILLERS | shared) for name, of in words.items()}


def _numbers(names: Sequence[str]) -> dict[str, str]:
    """The last number of each name; grippers have none."""
    numbered = {name: re.findall(r"\d+", name) for name in names if not GRIPPER.search(name)}
    return {name: str(int(numbers[-1])) for name, numbers in numbered.items() if numbers}


def _family(family: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Indices in a family of names, if all of these belong to it."""
    by_words = {name: " ".join(words) for name, words in _words(names).items()}
    arms = {words for name, words in by_words.items() if not GRIPPER.search(name)}
    for listed in (variant.split(", ") for variant in family):
        if arms <= set(listed):
            return {name: str(listed.index(words)) for name, words in by_words.items() if words in listed}
    return {}


RULES: dict[str, KeysOf] = {
    "names that differ in case and separators": _spelled,
    "names that differ in prefix, suffix or words such as 'joint'": _words,
    "the numbers in their names": _numbers,
    **{f"the makers' names {family[0]}": partial(_family, family) for family in _FAMILIES},
}
"""Rules by which names match, the strictest first."""
