"""Write a commented arm.toml as a template, with values guessed from the names in a recording."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import Any

import numpy as np

from tauext.data.clock import ARM_HZ, SHARED_STAMPS
from tauext.data.column_names import (
    GOAL,
    GUESSES,
    JOINT,
    NamedJoints,
    Spelled,
    groups_of,
    is_current,
    is_part,
    is_unit,
    is_unsure,
    motor_side,
    named_joints,
    side_of,
    spelled,
    unit_of,
)
from tauext.data.description import GUESSED, SIGNALS, TABLES, TIME_UNITS, SignalTable
from tauext.data.importers.raw import RawRecording, RawSignals, short_list
from tauext.data.joint_names import GRIPPER, match_joints
from tauext.data.recording import FLAGS
from tauext.data.recording_file import Description
from tauext.data.servo import in_amperes
from tauext.files.typed_table import comment_lines, key_help, table_lines


@dataclass
class Guess:
    """Names found in a file; empty where nothing fits."""

    columns: dict[str, str] = field(default_factory=dict)
    topic: str = ""
    joint_names: tuple[str, ...] = ()
    """Joint names in the recording; empty where it numbers them."""
    arm: frozenset[str] = frozenset()
    """Those of them that are the arm's: no gripper, no wheel, and none that a robot file lacks."""
    count: int = 0
    """Number of joints, from the columns of q."""
    units: dict[str, str] = field(default_factory=dict)
    """Units that names of columns state, by signal."""
    unused: list[str] = field(default_factory=list)
    """Columns of no signal."""
    values: dict[str, Any] = field(default_factory=dict)
    """Values of other keys that the recording's numbers show, by "table.key"."""
    why: dict[str, str] = field(default_factory=dict)
    """Evidence of guesses, a sentence by "table.key"."""


def guess_of(raw: RawRecording, robot: Sequence[str] = ()) -> Guess:
    """Guess the signals of a raw recording from names and numbers; of a recording that tauext wrote, as it states.

    Args:
        robot: joints of the robot file.
    """
    if raw.recorded is not None:
        return _stated(raw.recorded)
    found = guess(raw.streams, robot, raw.units)
    guess_values(found, raw)
    return found


def _stated(head: Description) -> Guess:
    """The signals of a recording that tauext wrote, by its metadata."""
    servo = head.provenance.get("servo")
    made_of = str(servo.get("torque_from", "")).replace("_", "-") if isinstance(servo, dict) else "torque"
    computed = ({"dq"} if servo else set()) | ({"tau"} if made_of != "torque" else set())
    columns = {name: f"{name}_{JOINT}" for name in head.signals if name in SIGNALS and name not in computed}
    columns |= {"time": "t_ns"} | ({"label": "contact"} if "contact" in head.signals else {})
    found = Guess(columns, joint_names=head.joints, arm=frozenset(head.joints), count=len(head.joints))
    found.units |= {"time": "ns", "tau": "A" if in_amperes([head]) else "Nm"}
    found.unused = [f"{name}_{JOINT}" for name in head.signals if name not in SIGNALS and name not in FLAGS]
    timing = f"{'servo' if 'tau' in computed else 'signals.tau'}.timing"
    found.values[timing] = head.torque_timing
    found.why |= dict.fromkeys(("robot.joints", "signals.tau.unit", timing), "as the file states")
    if servo:
        found.values["servo.torque_from"] = GUESSED + made_of
        found.why["servo.torque_from"] = (
            "velocity and torque were computed from what servos report: copy [servo] from the arm.toml of the training"
        )
    return found


ONE_A_ROW = ("time", "label")
"""Signals of one column, whatever the number of joints."""


def guess(
    streams: Mapping[str, Sequence[str]], robot: Sequence[str] = (), stated: Mapping[str, str] = MappingProxyType({})
) -> Guess:
    """Guess the signals of a source from its column names.

    Args:
        robot: joints of the robot file, whose names columns may contain.
        stated: units that the file states beside the names, by column.
    """
    found, left = Guess(), dict[str, int]()
    for stream, names in _arms_stream_first(found, streams, robot).items():
        named = named_joints(names, robot)
        groups = groups_of(names)
        for pattern, count in named.patterns.items():
            columns = [pattern.replace(JOINT, joint) for joint in named.joints]
            groups = {
                group: n for group, n in groups.items() if group not in named.arrays and not is_part(group, columns)
            }
            groups[pattern] = count
        spellings = {group: _with_unit(group, named.joints, stated) for group in groups}
        for signal in GUESSES:
            fits = [group for group, one in spellings.items() if one.names(signal)]
            if signal == "q" and not fits and JOINT in groups:
                fits = [JOINT]  # columns named by the joint alone
            fits = _of_joints(found, signal, fits, groups)
            if fits and signal not in found.columns:
                _choose(found, signal, fits, groups, spellings)
                if signal == "q":
                    found.topic, found.count = stream, groups[found.columns["q"]]
        _by_units(found, groups, spellings)
        left |= groups
        _name_joints(found, names, named, robot)
    used = {*found.columns.values(), *(("action",) if "goal" in found.columns.values() else ())}
    left = {
        group: n for group, n in left.items() if group not in used and group.replace("action", "goal", 1) not in used
    }
    found.unused = [group for group in left if group not in COUNTERS]
    _ask_for_missing(found, left)
    return found


COUNTERS = ("index", "frame_index", "episode_index", "task_index", "next.done")
"""Columns that count LeRobot's frames."""
WHEEL = re.compile(r"wheel|caster", re.IGNORECASE)


def _with_unit(group: str, joints: Sequence[str], stated: Mapping[str, str]) -> Spelled:
    """What the group's name states, with the unit that the file states beside it."""
    one = spelled(group)
    column = group.replace(JOINT, joints[0]) if joints else group
    of_columns = re.escape(column).replace(r"\{number\}", r"\d+").replace(r"\{index\}", r"\d+")
    texts = (text for name, text in stated.items() if re.fullmatch(rf"{of_columns}(\[.*\])?", name))
    text = next((text.strip(" []()") for text in texts), "")
    return Spelled(one.all_words, text, True) if is_unit(text) and not one.certain else one


def _arms_stream_first(
    found: Guess, streams: Mapping[str, Sequence[str]], robot: Sequence[str]
) -> dict[str, Sequence[str]]:
    """The stream of the arm's positions, then those without positions; several of one kind are a question."""
    arms: dict[str, set[str]] = {}
    for stream, names in streams.items():
        joints = {
            name.removesuffix("]").rpartition("[")[2] for name in names if spelled(name.rpartition("[")[0]).names("q")
        }
        if joints:
            arms[stream] = {joint for joint in joints if not GRIPPER.search(joint)}
    if len(arms) < 2:
        return dict(streams)
    order = sorted(arms, key=lambda stream: (-len(arms[stream] & {*robot}), not arms[stream]))
    first = order[0]
    others = [stream for stream in order[1:] if arms[stream]]
    if any(len(arms[stream] & {*robot}) == len(arms[first] & {*robot}) for stream in others):
        why = f"{', '.join([first, *others])} have positions of joints: choose the arm's"
        why += "; for another arm, import the same file again with a description of its own"
        for signal in NEEDED:
            found.values[f"signals.{signal}.topic"] = GUESSED + first
            found.why[f"signals.{signal}.topic"] = why
    return {first: streams[first]} | {stream: names for stream, names in streams.items() if stream not in arms}


def _of_joints(found: Guess, signal: str, fits: Sequence[str], groups: Mapping[str, int]) -> list[str]:
    """Those of the groups that have as many columns as the signal needs: one for a clock, one a joint for others."""
    if signal in ONE_A_ROW:
        return [group for group in fits if groups[group] == 1]
    several = [group for group in fits if groups[group] > 1]
    alone = found.count == 1 or (
        signal == "q" and not any(n > 1 and spelled(g).names(s) for g, n in groups.items() for s in ("dq", "tau"))
    )
    return [group for group in fits if groups[group] == 1] if not several and alone else several


def _choose(
    found: Guess, signal: str, fits: list[str], groups: Mapping[str, int], spellings: Mapping[str, Spelled]
) -> None:
    """Set the columns of a signal, their unit and the evidence; what names leave open is marked."""
    side = side_of(found.columns.get("q", ""))

    def rank(group: str) -> tuple:
        # With torque and current in a file, prefer the torque, which needs no constant.
        of_motor = signal in ("q", "dq") and motor_side(group)
        current = signal == "tau" and is_current(spellings[group].words)
        other = side_of(group) != side, groups[group] != found.count > 0
        return of_motor, signal != "q" and other, current, is_unsure(signal, spellings[group].words), len(group)

    fits.sort(key=rank)
    first = fits[0]
    found.columns[signal] = first
    if unit := unit_of(signal, spellings[first].unit):
        found.units[signal] = unit
    key = {"time": "time.column", "label": "contact.column"}.get(signal, f"signals.{signal}.columns")
    words = "by its name" if signal in ONE_A_ROW else f"by the names of {groups[first]} columns"
    found.why[key] = f"{words}; {', '.join(fits[1:])} would fit, too" if fits[1:] else words
    open_end = ""
    if is_unsure(signal, spellings[first].words):
        open_end = f"it may mean something else than {NEEDED_WORDS[signal]}"
    elif signal == "q" and len({motor_side(group) for group in fits}) > 1:
        open_end = "some may be of the motors, before the gear"
    elif signal == "q" and len({side_of(group) for group in fits}) > 1:
        open_end = "choose the arm"
    elif signal in ("dq", "tau") and groups[first] != found.count > 1 and not _is_array_of_names(first, groups):
        open_end = f"there are {groups[first]} of them, and {found.count} positions"
    if open_end:
        found.values[key] = GUESSED + first
        found.why[key] += f"; {open_end}"


def _is_array_of_names(group: str, groups: Mapping[str, int]) -> bool:
    """Whether a group is an array, whose elements may have names."""
    return "{" not in group and groups[group] > 1


def _by_units(found: Guess, groups: Mapping[str, int], spellings: Mapping[str, Spelled]) -> None:
    """Columns of a needed signal that only their unit in brackets shows: `c1 (A)`; of several, a person chooses."""
    goal = re.compile(rf"(.*_)?({GOAL}|err|error|ext|external|max|min|limit)(_.*)?", re.IGNORECASE)
    for signal in NEEDED:
        if signal in found.columns or (signal != "q" and not found.count):
            continue
        with_unit = [
            group
            for group, one in spellings.items()
            if one.certain and unit_of(signal, one.unit) and not goal.fullmatch(one.words)
            if group not in found.columns.values() and groups[group] == (found.count or max(groups[group], 2))
        ]
        if with_unit:
            one = found.columns[signal] = with_unit[0]
            unit = found.units[signal] = unit_of(signal, spellings[one].unit)
            key = f"signals.{signal}.columns"
            found.why[key] = f"by the unit of {groups[one]} columns, {unit}"
            found.count = found.count or groups[one]
            if with_unit[1:]:
                found.values[key] = GUESSED + one
                found.why[key] += f"; {', '.join(with_unit[1:])} would fit, too"


def _name_joints(found: Guess, names: Sequence[str], named: NamedJoints, robot: Sequence[str]) -> None:
    """Set the joints that the columns of the position name, and those of them that are the arm's."""
    base = found.columns.get("q", "")
    elements = [n.removeprefix(f"{base}[")[:-1] for n in names if base and n.startswith(f"{base}[")]
    if elements and not all(e.isdigit() for e in elements):
        found.joint_names = tuple(elements)
    elif named.joints and JOINT in base:
        found.joint_names = named.joints
    arm = {name for name in found.joint_names if not GRIPPER.search(name) and not WHEEL.search(name)}
    if robot:
        matched = match_joints(robot, found.joint_names)
        there = {*matched.pairs.values(), *matched.proposed.values()}
        arm = arm & there or arm
    found.arm = frozenset(arm)


NEEDED_WORDS = {"q": "a position", "dq": "a velocity", "tau": "a torque or a current"}


def _ask_for_missing(found: Guess, left: Mapping[str, int]) -> None:
    """Mark the needed signals without columns as entries to fill in.

    Args:
        left: columns of no signal, and the number of each.
    """
    joints = [group for group, count in left.items() if count == found.count > 0]
    for signal in NEEDED if found.columns or left else ():
        made_of = _torque_source(found) if signal == "tau" else ""
        if (
            signal in found.columns
            or (made_of and not joints)
            or (signal == "dq" and (not joints or _torque_source(found)))
        ):
            continue
        key = f"signals.{signal}.columns" if not made_of else "servo.torque_from"
        found.values[key] = GUESSED + made_of
        found.why[key] = f"no column is named as {NEEDED_WORDS[signal]} usually is"
        found.why[key] += f"; not in use: {short_list(joints or left)}" if left else ""
        if made_of:
            found.why[key] += "; where one of them is the torque, name it in [signals.tau] and leave [servo] out"
        else:
            found.why[key] += '; "" derives it from the position' if signal == "dq" else "; check the unit, too"


def _torque_source(found: Guess) -> str:
    """Source of a servo's torque, where no column holds the torque; empty: none."""
    if "q" not in found.columns or "tau" in found.columns:
        return ""
    made_of = {"duty": "duty", "q_des": "goal"}  # best first
    return next((source for signal, source in made_of.items() if signal in found.columns), "")


RATE = "time.rate_hz"
"""Key that must be given where no column is a clock."""


def guess_values(guessed: Guess, raw: RawRecording) -> None:
    """Add what the first block of numbers shows: unit and use of the stamps, and degrees."""
    for block in raw.blocks():
        if block.stream == guessed.topic or not guessed.topic:
            _guess_clock(guessed, block, raw)
            _guess_angles(guessed, block)
            _guess_ur_effort(guessed, block)
            return


def _guess_clock(guessed: Guess, block: RawSignals, raw: RawRecording) -> None:
    column = guessed.columns.get("time", "")
    rate_hz = _rate_of_velocity(guessed, block)
    if column and column == raw.clocks[1] and block.t_ns is not None:  # LeRobot's `timestamp` has single precision
        guessed.columns.pop("time")
        guessed.units.pop("time", None)
        column = ""
    hints = raw.hints() + [f"positions and velocities fit about {rate_hz:.3g} rows a second"] * bool(rate_hz)
    if not column or column not in block.names:
        if block.t_ns is None:
            none = "no column of times: name it in column, or give the rate of the rows"
            guessed.why[RATE] = "; ".join([none, *hints])
        elif raw.clocks[0] and not column:
            guessed.why["time.column"] = f"the stamps of the file, '{raw.clocks[0]}', are the clock"
        return
    times = block.columns[:, block.names.index(column)]
    same = (block.columns[1:] == block.columns[:-1]) | np.isnan(block.columns[1:])
    times = times[np.r_[True, ~same.all(axis=1)]]  # rows twice are dropped at import
    steps = np.diff(times[np.isfinite(times)])
    ahead, unit = steps[steps > 0], guessed.units.get("time") or time_unit(times)
    if not len(steps) or (steps < 0).mean() > 0.5:
        return  # the import names the order of the rows
    why = "" if len(ahead) else f"'{column}' is constant"
    if len(ahead) and (steps == 0).mean() > SHARED_STAMPS:
        shared = len(steps) / len(ahead)
        why = f"{shared:.3g} rows share each stamp of '{column}', which resolves {np.median(ahead):.4g}"
    elif len(ahead) and (ahead == 1).all() and (not unit or _contradicts(rate_hz, 1e9 / TIME_UNITS[unit])):
        why = f"'{column}' grows by exactly 1 a row: it counts rows"
    if why:
        guessed.columns["time"] = ""
        guessed.why.pop("time.column", None)
        guessed.why[RATE] = "; ".join([f"{why}, so it is no clock: give the rate of the rows", *hints])
        return
    step = float(np.median(ahead))
    guessed.why["time.unit"] = "; ".join([f"the steps of '{column}' are {step:.4g}", *hints])
    hz = 1e9 / (step * TIME_UNITS[unit or "s"])
    sure = bool(unit) and not _contradicts(rate_hz, hz) and ("time" not in guessed.units or 1 <= hz <= ARM_HZ[1])
    if "time" in guessed.units:
        guessed.why["time.unit"] = f"by the name of the column; {guessed.why['time.unit']}"
    guessed.values["time.unit"] = unit if sure else GUESSED + (unit or "s")


def _contradicts(one_hz: float, other_hz: float, most: float = 1.2) -> bool:
    """Whether a rate, 0 where it is unknown, differs from another one by a larger factor than `most`.

    A factor of degrees to radians between them is no contradiction: check names it.
    """
    ratio = one_hz / other_hz
    return bool(ratio) and all(max(ratio / factor, factor / ratio) > most for factor in (1, 180 / np.pi, np.pi / 180))


RADIANS = {"rad": 1.0, "deg": np.pi / 180, "rpm": np.pi / 30}


def _rate_of_velocity(guessed: Guess, block: RawSignals) -> float:
    """Rows a second at which the velocity is the derivative of the position, [Hz]; 0: not to be found."""
    q, dq = (block.columns[:, _indices(guessed, block, signal)] for signal in ("q", "dq"))
    if {"q", "dq"} <= {*guessed.units}:
        q, dq = (x * RADIANS[guessed.units[signal].removesuffix("/s")] for x, signal in ((q, "q"), (dq, "dq")))
    if q.shape[1] == 0 or q.shape != dq.shape or len(q) < 100:
        return 0.0
    moved, mean = np.diff(q, axis=0), (dq[1:] + dq[:-1]) / 2
    usable = np.isfinite(moved).all(axis=1) & np.isfinite(mean).all(axis=1)
    moved, mean = moved[usable], mean[usable]
    rates = []
    for a, b in zip(moved.T, mean.T, strict=True):
        keep = np.abs(a) <= np.percentile(np.abs(a), 99) if len(a) else np.zeros(0, bool)  # jumps of turns
        size = float(np.linalg.norm(a[keep]) * np.linalg.norm(b[keep]))
        if size > 0 and float(a[keep] @ b[keep]) > 0.8 * size:
            rates.append(float(np.linalg.norm(b[keep]) / np.linalg.norm(a[keep])))
    return float(np.median(rates)) if rates else 0.0


def _indices(guessed: Guess, block: RawSignals, signal: str) -> list[int]:
    """Columns of the block that the guessed pattern of a signal covers."""
    pattern = guessed.columns.get(signal, "")
    names = {"{joint}": "|".join(map(re.escape, guessed.joint_names)) or ".+", "{index}": r"\d+", "{number}": r"\d+"}
    spelled = re.escape(pattern)
    for key, words in names.items():
        spelled = spelled.replace(re.escape(key), f"({words})")
    return [k for k, name in enumerate(block.names) if pattern and re.fullmatch(rf"{spelled}(\[.*\])?", name)]


EPOCH_S = (1e9, 4e9)
"""Times of the years 2001 to 2096, counted from 1970, [s]."""


def time_unit(times: np.ndarray) -> str:
    """Unit of a column of times: by its size if it counts from 1970, else by its steps, of which only one unit gives
    10 Hz to 10 kHz; empty: none.

    Args:
        times: (samples,), NaN where there is none.
    """
    times = times[np.isfinite(times)]
    steps = np.diff(times)
    steps = steps[steps > 0]
    if not len(steps):
        return ""
    step, middle = float(np.median(steps)), float(np.median(times))
    for unit, ns in TIME_UNITS.items():
        # A clock that counts ns from its start may have the size of an epoch in s, but not its steps.
        if EPOCH_S[0] <= middle * ns * 1e-9 <= EPOCH_S[1] and 1e4 <= step * ns <= 1e10:
            return unit
    return next((unit for unit, ns in TIME_UNITS.items() if 1e5 < step * ns <= 1e8), "")


def _guess_angles(guessed: Guess, block: RawSignals) -> None:
    """Units of positions, velocities and goals: as their names state, else by the size of the arm's positions."""
    indices = _indices(guessed, block, "q")
    if guessed.arm:
        indices = [k for k in indices if _joint_of(guessed, block.names[k]) in guessed.arm] or indices
    if not indices:
        return
    unit = guessed.units.get("q", "")
    largest = np.nanmax(np.abs(np.nan_to_num(block.columns[:, indices])), axis=0)
    # Cables allow an arm's joint about a turn each way.
    if not unit and (largest > 7.0).sum() >= min(2, len(indices)):
        unit = "deg"
        guessed.values["signals.q.unit"] = f"{GUESSED}deg"
        guessed.why["signals.q.unit"] = f"positions reach {largest.max():.4g}"
    if unit != "deg":
        return
    if "dq" in guessed.columns and "dq" not in guessed.units:
        unit, why = f"{GUESSED}deg/s", "the unit of the positions, if they are in degrees; rad/s is the other choice"
        rates = _rate_of_velocity(guessed, block), _rate_of_stamps(guessed, block)
        for factor, fits in ((1.0, "deg/s"), (np.pi / 180, "rad/s")):
            if all(rates) and abs(rates[0] / rates[1] / factor - 1) < 0.2:
                unit, why = fits, f"velocities are {factor:.4g} times the change of the positions a second"
        guessed.values["signals.dq.unit"], guessed.why["signals.dq.unit"] = unit, why
    if "q_des" in guessed.columns and "q_des" not in guessed.units:
        guessed.values["signals.q_des.unit"] = "deg"
        guessed.why["signals.q_des.unit"] = "the unit of the positions"


def _rate_of_stamps(guessed: Guess, block: RawSignals) -> float:
    """Rows a second by the stamps, [Hz]; 0: not known."""
    column, unit = guessed.columns.get("time", ""), str(guessed.values.get("time.unit", ""))
    if column in block.names and unit in TIME_UNITS:
        t_ns = block.columns[:, block.names.index(column)] * TIME_UNITS[unit]
    elif block.t_ns is not None:
        t_ns = block.t_ns.astype(np.float64)
    else:
        return 0.0
    steps = np.diff(t_ns)
    steps = steps[steps > 0]
    return 1e9 / float(np.median(steps)) if len(steps) else 0.0


def _joint_of(guessed: Guess, column: str) -> str:
    """The joint of a column of the position; empty: the column names none."""
    before, joint, after = guessed.columns["q"].partition(JOINT)
    if joint:
        return column.removeprefix(before).removesuffix(after)
    return column.removesuffix("]").rpartition("[")[2]


UR_JOINTS = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint")
"""Ends of the names of five joints of every UR arm, by its ROS driver."""
UR_EFFORT = (
    "the UR driver gives motor currents as effort, or torques where use_currents_as_efforts is false (PolyScope 5.23 "
    "and 10.11 on)"
)
MOST_UR_A = 10.0
"""Largest current of a UR joint in usual motion, [A]; a shoulder's torque is larger in nearly any."""


def _guess_ur_effort(guessed: Guess, block: RawSignals) -> None:
    """Unit of the effort of a UR arm, by its size; `check` compares it with gravity."""
    indices = _indices(guessed, block, "tau")
    is_ur = all(any(name.endswith(joint) for name in guessed.joint_names) for joint in UR_JOINTS)
    if not is_ur or not indices or "tau" in guessed.units or is_current(spelled(guessed.columns["tau"]).words):
        return
    largest = float(np.nanmax(np.abs(np.nan_to_num(block.columns[:, indices]))))
    current = largest <= MOST_UR_A
    if current:
        guessed.values |= {"signals.tau.unit": "A", "signals.tau.torque_constant": "unknown"}
    what = "a current" if current else "a torque"
    guessed.why["signals.tau.unit"] = (
        f"{UR_EFFORT}; values up to {largest:.3g} are {what}, and check compares with gravity"
    )


_HEADER = """\
# arm.toml: description of a robot and of its recordings.
# A list has one entry a joint, in the order of [robot] joints; one number instead stands for all joints.
# Unknown keys are refused. A key after # is not set: the line shows its default or an example.

"""
NEEDED = {"q": "position", "dq": "", "tau": "effort"}
"""Signals of every arm.toml, with their default columns."""
SHARED = [one.name for one in fields(SignalTable) if sum(one.name in signal.keys for signal in SIGNALS.values()) > 1]
"""Keys of several signals, explained once before them."""


def template(guessed: Guess, model: str = "", joints: Sequence[str] = (), topics: Sequence[str] = ()) -> str:
    """Text of an arm.toml that explains every key and sets the keys found.

    Args:
        guessed: evidence about the joints is added to it.
        model: path of the robot file.
        joints: its joints.
        topics: topics of the source, to choose from.
    """
    columns, why = guessed.columns, guessed.why
    robot, evidence = _joint_entries(guessed, joints)
    why |= {f"robot.{key}": words for key, words in evidence.items()}
    found: dict[str, dict[str, Any]] = {
        "robot": {"model": model} | robot,
        "time": {"column": columns.get("time", ""), "unit": guessed.units.get("time", "s")},
        "contact": {"column": columns.get("label", "")},
    }
    signals = {name: _signal(guessed, name, columns.get(name, NEEDED.get(name, name))) for name in SIGNALS}
    in_force = {*found, *NEEDED, *columns}
    if made_of := guessed.values.get("servo.torque_from", "").removeprefix(GUESSED) or _torque_source(guessed):
        found["servo"] = {"torque_from": made_of}
        in_force = (in_force | {"servo"}) - ({"tau"} if made_of != "torque" else set())
    if len(topics) > 1 and guessed.topic:
        signals |= {name: signals[name] | {"topic": guessed.topic} for name in NEEDED}
    for entry, value in guessed.values.items():
        table, _, key = entry.rpartition(".")
        (signals[table.removeprefix("signals.")] if table.startswith("signals.") else found[table])[key] = value
    lines = _HEADER.splitlines()
    if guessed.unused:
        lines += [*comment_lines(f"Columns of the source that are not in use: {short_list(guessed.unused, 24)}."), ""]
    for name, kind in TABLES.items():
        evidence = {key.removeprefix(f"{name}."): words for key, words in why.items()}
        lines += table_lines(kind, name, kind.__doc__ or "", found.get(name), None, evidence, name in in_force)
        if name == "time":  # the signals follow
            lines += _shared_keys(topics if guessed.topic else ())
            for signal in SIGNALS:
                evidence = {key.removeprefix(f"signals.{signal}."): words for key, words in why.items()}
                helps = _signal_help(signal, SIGNALS[signal].keys if signal in NEEDED else ("columns", "unit"))
                shown = SIGNALS[signal].help, signals[signal], helps, evidence
                lines += table_lines(SignalTable, f"signals.{signal}", *shown, signal in in_force)
    return "\n".join(lines)


def _signal_help(signal: str, keys: Sequence[str]) -> dict[str, str]:
    """Help of a signal's own keys; that of shared ones is above all signals."""
    helps = {key: "" if key in SHARED else words for key, words in key_help(SignalTable).items() if key in keys}
    return helps | {"unit": f"One of {', '.join(SIGNALS[signal].units)}."}


def _joint_entries(guessed: Guess, joints: Sequence[str]) -> tuple[dict[str, Any], dict[str, str]]:
    """Entries of [robot] for the joints, and the evidence of each; what is not sure begins with "?".

    Args:
        joints: movable joints of the robot file, empty without one.
    """
    logged, count = guessed.joint_names, len(guessed.joint_names) or guessed.count
    if not joints:
        wheels = [name for name in logged if WHEEL.search(name)]
        arm = tuple(name for name in logged if name not in wheels) or tuple(f"joint{k + 1}" for k in range(count or 2))
        if wheels:
            return {"joints": arm, "ignored": wheels}, {"ignored": "wheels are no joints of an arm"}
        return {"joints": arm}, {}
    arms = [name for name in joints if not GRIPPER.search(name)]
    if not logged:
        return _numbered_entries(joints, arms, count)
    matched = match_joints(joints, logged)
    open_names = [name for name in matched.logged_left if not GRIPPER.search(name)]
    candidates = matched.robot_left if open_names else ()
    known = {*matched.pairs, *matched.proposed, *(name for name in arms if name in candidates)}
    used = [name for name in joints if name in known] or arms
    names = [matched.pairs.get(name) or GUESSED + matched.proposed.get(name, "") for name in used]
    entries, why = dict[str, Any](joints=used), {}
    if names != used:
        entries["names"] = names
        why["names"] = f"matched by {matched.rule}" if matched.rule else "names that are equal match"
        if matched.proposed:
            pairs = ", ".join(f"'{there}' of the recording with '{here}'" for here, there in matched.proposed.items())
            why["names"] += f"; proposed: {pairs}"
        if open_names:
            why["names"] += f"; the recording also has {', '.join(open_names)}: fill them in, or list them in ignored"
    left = [name for name in joints if name not in used]
    if left:
        entries["locked"] = [name if GRIPPER.search(name) else GUESSED + name for name in left]
        why["locked"] = "the recording has no signal of them"
    ignored = [name for name in matched.logged_left if not (open_names and any(GUESSED == n for n in names))]
    if ignored:
        entries["ignored"] = ignored
        why["ignored"] = "the robot file has no such joint"
    return entries, why


def _numbered_entries(joints: Sequence[str], arms: Sequence[str], count: int) -> tuple[dict[str, Any], dict[str, str]]:
    """Entries of [robot] for a recording that numbers its joints: their order is all that it gives."""
    order = "the recording numbers its joints, so they are taken in the robot file's order"
    used = list(joints if count in (0, len(joints)) else arms)
    entries: dict[str, Any] = {"joints": used}
    if count in (0, len(used)):
        left = [name for name in joints if name not in used]
        return entries | ({"locked": left} if left else {}), {"joints": order} if count else {}
    entries["joints"] = [GUESSED + name for name in used[:count]]
    if len(used) > count:
        entries["locked"] = [GUESSED + name for name in joints if name not in used[:count]]
    return entries, {"joints": f"{order}; but it has {count}, the robot file {len(used)} joints: choose them"}


def _signal(guessed: Guess, name: str, columns: str) -> dict[str, Any]:
    """Values of a signal's keys, guessed from its column names."""
    unit = guessed.units.get(name, "")
    if name == "tau" and not unit and is_current(spelled(columns).words):
        unit = "A"
    known = {"columns": columns, "unit": unit or next(iter(SIGNALS[name].units))}
    return known | ({"torque_constant": "unknown"} if name == "tau" and SignalTable((), unit).is_current else {})


def _shared_keys(topics: Sequence[str]) -> list[str]:
    """Comment that explains the shared keys."""
    lines = ["# Signals. Keys of several of them:"]
    for name, words in key_help(SignalTable).items():
        if name in SHARED and words:
            more = f" The source has {', '.join(topics)}." if name == "topic" and len(topics) > 1 else ""
            lines += comment_lines(f"{name}: {words}{more}", "#   ")
    return [*lines, ""]
