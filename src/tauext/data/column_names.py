"""What the name of a column states: its signal, its unit, its joint, and whether it is measured or commanded."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

# --- Usual names of signals.


MEASURED = r"(actual|act|measured|meas|present|state|ist)"
GOAL = r"(des|desired|cmd|commanded|command|ref|reference|target|goal|set|setpoint|soll)"
_BEFORE = rf"(({MEASURED}|joints?|jnt|j|robot|motor|arm|ax[ei]s|gelenke?|achsen?)_)*"
_AFTER = rf"(_({MEASURED}|joints?|jnt|j|a|motor|ax[ei]s|gelenke?|achsen?))*"
_ANGLE = r"q|qpos|q_pos|pos|positions?|theta|angles?|winkel"


def _usual(core: str) -> str:
    return f"{_BEFORE}({core}){_AFTER}"


GUESSES = {
    "q": _usual(rf"{_ANGLE}|act_pos\w*") + r"|observation\.state",
    "dq": _usual(r"dq|qd|v|qvel|q_vel|qdot|q_dot|vel|velocity|velocities|speeds?|geschw(indigkeit)?|act_vel\w*"),
    "tau": _usual(
        r"tau(_?[jm])?|qfrc(_actuator|_applied|_motor)?|efforts?|eff|torques?|torq|trq|tq|act_torque\w*|current_as_torque|currents?|i|m|"
        r"(dreh)?moment[es]?|mom|str[oö]me?|motorstr[oö]me?"
    ),
    "tau_ext": r"(tau_ext\w*|external_torques?)",
    "q_des": rf"q_d|{_BEFORE}({_ANGLE})_{GOAL}|{GOAL}_(joints?_)*({_ANGLE})(_(joints?|\d+))*|ref_pos\w*|goal(_pos\w*)?"
    "|action",
    "temperature": _usual(r"temps?|temperatures?"),
    "duty": r"(duty|pwm|load|present_(load|pwm))",
    "voltage": r"(voltage|voltages|present_voltage)",
    "time": r"_*((elapsed|sim|simulation|ros|system|robot|log|rel|relative)_)?(t|times?|time_?stamps?|stamp)|"
    r"time_cont|zeit",
    "label": r"(label|labels|contact|contacts|collision|collisions|touch)",
}
"""Usual names of each signal, without joint, counter and unit."""


def fits(signal: str, words: str) -> bool:
    """Whether the words usually name the signal."""
    return re.fullmatch(GUESSES[signal], words, re.IGNORECASE) is not None


def is_current(words: str) -> bool:
    """Whether the words of a torque usually name a motor current."""
    return re.fullmatch(r"\w*current(?!_as_torque)\w*|\w*str[oö]me?|(\w*_)?i", words, re.IGNORECASE) is not None


def is_unsure(signal: str, words: str) -> bool:
    """Whether the words may mean something else: a motor, metres."""
    return signal == "tau" and re.fullmatch(_usual("m"), words, re.IGNORECASE) is not None


# --- Units in names: `q1 (deg)`, `Time [sec]`, `effort_Nm_3`.


_PER_S = r"(( ?/ ?|_|p| per |_per_)(s|sec|seconds?)|[ .·*]?s(\^|\*\*)?[-−]1|[ .·*]?s⁻¹)"
_ANGLES = {"rad": r"rads?|radians?", "deg": r"degs?|degrees?|°|grad"}
_TORQUES = {"Nm": r"n[ .*·_-]?m|newton[ _-]?met(er|re)s?", "mNm": r"mn[ .*·_-]?m|n[ .*·]?mm", "kNm": r"kn[ .*·_-]?m"}
_AMPERES = {"A": r"a|amps?|amperes?", "mA": r"ma|milliamps?|milliamperes?"}
UNITS: dict[str, dict[str, str]] = {
    "q": _ANGLES,
    "q_des": _ANGLES,
    "dq": {
        "rad/s": rf"rads|1/s|(rads?|radians?){_PER_S}",
        "deg/s": rf"degs|(degs?|degrees?|°|grad){_PER_S}|dps",
        "rpm": r"rpm|rev/min|r/min|u/min|1/min",
    },
    "tau": _TORQUES | _AMPERES,
    "tau_ext": _TORQUES,
    "temperature": {"degC": r"°? ?c|deg_?c|celsius"},
    "duty": {"%": r"%|percent", "permille": r"permille|‰"},
    "voltage": {"V": r"v|volts?", "mV": r"mv|millivolts?"},
    "time": {
        "s": r"s|secs?|seconds?",
        "ms": r"ms|msecs?|millis?|milliseconds?",
        "us": r"us|µs|μs|usecs?|micros?|microseconds?",
        "ns": r"ns|nsecs?|nanos?|nanosecs?|nanoseconds?",
    },
    "label": {},
}
"""Units of each signal as arm.toml has them, and how names spell them."""
_ANY_UNIT = "|".join(dict.fromkeys(spelled for units in UNITS.values() for spelled in units.values()))
_IN_BRACKETS = re.compile(r"\s*[\[(<{]\s*([^\[\](){}<>]+?)\s*[\])>}]")
_PLACE = r"\{(?:joint|index|number)\}"
_AT_END = re.compile(rf"(?:[_ /.,-]+(?:in[_ ])?({_ANY_UNIT})|(?-i:(?<=[a-z])(mNm|Nm|Deg|Rad)))$", re.IGNORECASE)
_AT_BEGIN = re.compile(rf"(?=[^_ ]{{2}})({_ANY_UNIT})[_ ]+", re.IGNORECASE)


def unit_of(signal: str, text: str) -> str:
    """The unit of this signal that a text spells, as arm.toml has it; empty: none."""
    spelled = ((unit, pattern) for unit, pattern in UNITS[signal].items())
    return next((unit for unit, pattern in spelled if re.fullmatch(pattern, text.strip(), re.IGNORECASE)), "")


def is_unit(text: str) -> bool:
    """Whether a text spells the unit of a signal."""
    return re.fullmatch(_ANY_UNIT, text.strip(), re.IGNORECASE) is not None


_SIDES = r"(left|right|arm_?\d*|robot_?\d*|follower|puppet)"


@dataclass(frozen=True)
class Spelled:
    """What a pattern of columns states."""

    words: str
    """Its last part in words, without joint, counter and unit: the signal's usual name."""
    unit: str = ""
    """The unit as the name spells it; empty: none."""
    certain: bool = False
    """Whether the unit stands in brackets, so that nothing else can be meant."""

    def names(self, signal: str) -> bool:
        """Whether words and unit are those of the signal."""
        if self.certain and not unit_of(signal, self.unit):
            return False
        # A last word such as `s` or `a` is no unit of other signals, and then belongs to the name.
        return fits(signal, self.words if not self.unit or unit_of(signal, self.unit) else self.all_words)

    @property
    def all_words(self) -> str:
        """The words with a unit that is not in brackets."""
        return "_".join(filter(None, [self.words, "" if self.certain else self.unit]))


def spelled(pattern: str) -> Spelled:
    """What a column or a pattern of columns states, such as `q{number} (deg)` or `observation.state[{joint}.vel]`."""
    unit, certain = "", False
    if (array := re.fullmatch(r"(.+)\[([^\]]*\{joint\}[^\]]*)\]", pattern)) is not None:
        element = spelled(array[2])  # of a goal, all elements are goals
        of_goal = fits("q_des", of_array := spelled(array[1]).words) and fits("q", element.words)
        return Spelled(of_array, element.unit, element.certain) if of_goal else element
    name = re.sub(rf"[_/. ]?{_PLACE}[_. ]?", " ", pattern).strip(" _/.")
    for match in _IN_BRACKETS.finditer(name):
        if is_unit(match[1]):
            name, unit, certain = (name[: match.start()] + name[match.end() :]).strip(" _"), match[1], True
            break
    if name.startswith(("observation.", "action")):
        words = re.sub(rf"(?<=[._]){_SIDES}[._]|[._]{_SIDES}$", "", name)
        words = words if words in ("observation.state", "action") else words.removeprefix("observation.")
        return Spelled(_in_words(words), unit, certain)
    name = re.sub(rf"^{_SIDES}[_ ./]|[_ ./]{_SIDES}$", "", name)
    # of torque_A1, A is the axis
    letter = re.search(r"[_ ][A-Za-z]\{(number|index)\}", pattern)
    if not unit and not letter and (at_end := _AT_END.search(name)) and at_end.start() > 0:
        name, unit = name[: at_end.start()], at_end[1] or at_end[2]
    if not unit and (first := _AT_BEGIN.match(name)) and _is_signal_in(name[first.end() :], first[1]):
        name, unit = name[first.end() :], first[1]
    return Spelled(_in_words(re.split(r"[./]", name)[-1]), unit, certain)


def _is_signal_in(name: str, unit: str) -> bool:
    """Whether a name is usual for a signal that has this unit."""
    return any(unit_of(signal, unit) and fits(signal, _in_words(name)) for signal in UNITS)


def _without_unit(name: str) -> str:
    """A name without the unit in brackets or at its end; empty: its unit is no angle's."""
    for match in _IN_BRACKETS.finditer(name):
        if is_unit(match[1]) or match[1] in ("m", "mm", "cm", "-"):
            bare = (name[: match.start()] + name[match.end() :]).strip(" _.")
            return bare if unit_of("q", match[1]) else ""
    angle = f"({_ANGLES['rad']}|{_ANGLES['deg']})"
    return re.sub(rf"^{angle}[_ ]+|[_ ,]+(in )?{angle}$", "", name, flags=re.IGNORECASE)


def _in_words(name: str) -> str:
    """A name with underscores between its words."""
    words = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", name)
    return words if words.startswith("observation.") else re.sub(r"[\s./-]+", "_", words).strip("_")


def side_of(pattern: str) -> str:
    """The arm of several that a name states: left, right, arm_1; empty: none."""
    found = re.search(rf"(?:^|[._/]){_SIDES}(?=[._/\[]|$)", pattern)
    return found[1] if found else ""


def motor_side(pattern: str) -> bool:
    """Whether a name states the motor's side of the gear."""
    return re.search(r"(?:^|[_./ ])(motor|rotor)(?:[_./ ]|$)", re.sub(_PLACE, "", pattern), re.IGNORECASE) is not None


# --- Columns that differ in their joint or number only.


JOINT = "{joint}"


def groups_of(names: Sequence[str]) -> dict[str, int]:
    """Group names that differ only in one number or element: pattern and count; others stay single."""
    groups: dict[str, list[int]] = {}
    arrays = _arrays(names)
    for name in names:
        pattern, number = name, 0
        if (element := re.search(r"\[[^\[\]]*\]$", name)) and name[: element.start()] in arrays:
            pattern = name[: element.start()]
        else:
            bare, after = name, ""
            if (unit := re.search(r"\s*[\[({][^\[\](){}]*[\])}]\s*$", name)) and unit.start():
                bare, after = name[: unit.start()], unit[0]
            # Of several numbers, the last one counts; q1 and q2 need no other number to differ.
            if match := re.fullmatch(r"(.*?\D)(\d+)(\D*)", bare) or re.fullmatch(r"(.*\D)(\d+)(\D*)", bare):
                pattern, number = f"{match[1]}{{#}}{match[3]}{after}", int(match[2])
        groups.setdefault(pattern, []).append(number)
    found = {}
    for pattern, numbers in groups.items():
        counted = pattern.replace("{#}", "{number}" if min(numbers) else "{index}")
        if len(numbers) == 1 and "{#}" in pattern and re.search(r"\d", pattern):
            counted = pattern.replace("{#}", str(numbers[0]))
        found[counted] = len(numbers)
    return found


def _arrays(names: Sequence[str]) -> set[str]:
    """Names before brackets that are arrays: several elements, or one that is no unit."""
    elements: dict[str, set[str]] = {}
    for name in names:
        if match := re.fullmatch(r"(.+?)\[([^\[\]]*)\]", name):
            elements.setdefault(match[1], set()).add(match[2])
    several = {
        base for base, of in elements.items() if len(of) > 1 or not all(map(is_unit, of)) or _is_other_unit(base, of)
    }
    known = {element for base in several for element in elements[base]}
    return several | {base for base, of in elements.items() if of & known}


def _is_other_unit(base: str, elements: Collection[str]) -> bool:
    """Whether the only element of an array is spelled as a unit of another signal: joint `a` of position[a]."""
    signals = [signal for signal in UNITS if fits(signal, _in_words(base.strip()))]
    return bool(signals) and not any(unit_of(signal, one) for signal in signals for one in elements)


def is_part(group: str, names: Sequence[str]) -> bool:
    """Whether the pattern covers only some of these names: wrist_{number}/position beside elbow/position."""
    counted = re.escape(group).replace(r"\{number\}", r"\d+").replace(r"\{index\}", r"\d+")
    return any(re.fullmatch(counted, name) for name in names)


@dataclass(frozen=True)
class NamedJoints:
    """Joints that names state."""

    joints: tuple[str, ...] = ()
    patterns: Mapping[str, int] = field(default_factory=dict)
    """Patterns with {joint} that have a column for each joint, and their number."""
    arrays: frozenset[str] = frozenset()
    """Arrays whose elements the patterns cover."""


def named_joints(names: Sequence[str], robot: Sequence[str]) -> NamedJoints:
    """Joints in the names of columns, or in elements such as `observation.state[joint_1.vel]`; without them, empty."""
    joints = _in_columns(names, robot)
    if joints:
        patterns = {name.replace(joints[0], JOINT) for name in names if joints[0] in name}
        whole = [p for p in sorted(patterns) if all(p.replace(JOINT, joint) in names for joint in joints)]
        return NamedJoints(joints, dict.fromkeys(whole, len(joints)))
    return _in_elements(names)


def _in_columns(names: Sequence[str], robot: Sequence[str]) -> tuple[str, ...]:
    """Joint names in q_JOINT, JOINT_pos, .../JOINT/position and the like, in order; at least two such columns.

    Columns that contain a name of the robot file, alone or beside other words, give the joints first.
    """
    arrays = _arrays(names)
    plain = [name for name in names if name.rpartition("[")[0] not in arrays]
    for joint in robot:
        for column in plain:
            if re.search(rf"(?<![A-Za-z0-9]){re.escape(joint)}(?![A-Za-z0-9])", column) is None:
                continue
            before, _, after = column.partition(joint)
            of = re.compile(f"{re.escape(before)}(.+){re.escape(after)}")
            joints = tuple(match[1] for name in plain if (match := of.fullmatch(name)))
            if not before and not after:
                joints = tuple(name for name in plain if name in robot)
            elif not spelled(f"{before}{JOINT}{after}").names("q"):
                continue
            if len(joints) > 1:
                return joints
    q = r"(q|pos|position|positions|angle)"
    bare = [found for name in plain if (found := _without_unit(name))]
    alone = [_without_unit(name) for name in plain if _IN_BRACKETS.search(name)]  # "shoulder (deg)"
    alone = [
        one for one in alone if one and not any(spelled(re.sub(r"\d+", "", one)).names(signal) for signal in GUESSES)
    ]
    patterns = (rf"{q}[_. ](?P<joint>.+)", rf".*?(?P<joint>[^/]+)/{q}", rf"(?P<joint>.+?)[_. ]{q}")
    for pattern, columns in (*((one, bare) for one in patterns), (r"(?P<joint>.+)", alone)):
        matches = [re.fullmatch(pattern, name, re.IGNORECASE) for name in columns]
        joints = _without_words(tuple(dict.fromkeys(match["joint"] for match in matches if match)))
        # q_d0 and q_des_0 are numbered goals, q_x is a coordinate: not joints.
        none = rf"(d|{_ANGLES['rad']}|{_ANGLES['deg']})?_?\d*|[xyzw]|r[xyz]|q[xyzw]|roll|pitch|yaw"
        if len(joints) > 1 and not all(re.fullmatch(none, joint, re.IGNORECASE) for joint in joints):
            return joints
    return ()


_WORDS = rf"({GOAL}|{MEASURED}|filt|filtered|raw|err|error)"
_OF_SIDES = r"(motor|rotor|joint|link|load|output|input)"


def _without_words(joints: tuple[str, ...]) -> tuple[str, ...]:
    """Joints without words that tell a goal from what was measured, or the motor from the joint: q_des and q_act are of
    one joint, q_des_1 and q_act_1 of joint 1."""
    for words, distinct in ((_WORDS, 1), (_OF_SIDES, 2)):
        for form in (rf"(?P<word>{words})([_. ](?P<rest>.+)|\d*)", rf"((?P<rest>.+)[_. ])?(?P<word>{words})\d*"):
            found = [re.fullmatch(form, joint, re.IGNORECASE) for joint in joints]
            if len({match["word"].lower() for match in found if match}) < distinct:
                continue
            others = [joint for joint, match in zip(joints, found, strict=True) if not match]
            rest = [match["rest"] or "" for match in found if match]
            if not others:
                joints = tuple(dict.fromkeys(filter(None, rest)))
            elif distinct == 1 and set(rest) & {*others, ""}:  # q_j1 beside q_des_j1
                joints = tuple(others)
    return joints


def _in_elements(names: Sequence[str]) -> NamedJoints:
    """Joints of arrays whose elements are of several signals: `joint_1.pos`, `joint_1.vel`, `joint_1.torque`."""
    elements: dict[str, dict[str, tuple[str, str]]] = {}
    for name in names:
        if match := re.fullmatch(r"(.+?)\[([^\[\]]+)\]", name):
            joint, pattern = _joint_of_element(match[2])
            elements.setdefault(match[1], {})[match[2]] = joint, pattern
    for held in elements.values():
        by_pattern: dict[str, list[str]] = {}
        for joint, pattern in held.values():
            by_pattern.setdefault(pattern, []).append(joint)
        of_q = [pattern for pattern in by_pattern if pattern and spelled(pattern).names("q")]
        joints = tuple(by_pattern[of_q[0]]) if of_q else ()
        whole = [pattern for pattern, of in by_pattern.items() if pattern and set(joints) <= set(of)]
        if not joints or not any(spelled(one).names(signal) for one in whole for signal in ("dq", "tau")):
            continue
        there = set(names)
        patterns = {}
        for other, of in elements.items():
            for pattern in dict.fromkeys(pattern for _, pattern in of.values() if pattern):
                if all(f"{other}[{pattern.replace(JOINT, joint)}]" in there for joint in joints):
                    patterns[f"{other}[{pattern}]"] = len(joints)
        return NamedJoints(joints, patterns, frozenset(pattern.rpartition("[")[0] for pattern in patterns))
    return NamedJoints()


def _joint_of_element(element: str) -> tuple[str, str]:
    """Joint of an element such as `joint_1.pos`, and its pattern `{joint}.pos`; the element alone where it has none."""
    parts = re.split(r"([._/ ]+)", element)
    for k in range(len(parts) - 1, 1, -2):
        rest = "".join(parts[k - 1 :])
        words = spelled(f"{JOINT}{rest}")
        if any(words.names(signal) for signal in ("q", "dq", "tau", "temperature", "duty", "voltage")):
            before = 0
            while k - 2 - before > 0 and re.fullmatch(rf"{GOAL}|{MEASURED}", parts[k - 2 - before], re.IGNORECASE):
                before += 2
            cut = k - 1 - before
            return "".join(parts[:cut]), JOINT + "".join(parts[cut:])
    return element, ""
