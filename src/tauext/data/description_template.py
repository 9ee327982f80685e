"""Write a commented arm.toml as a template, with values guessed from the names in a recording."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from tauext.data.clock import SHARED_STAMPS
from tauext.data.description import GUESSED, SIGNALS, TABLES, TIME_UNITS, SignalTable
from tauext.data.importers.raw import RawRecording, RawSignals, short_list
from tauext.data.joint_names import GRIPPER, match_joints
from tauext.files.typed_table import comment_lines, key_help, table_lines

_BEFORE = r"((actual|act|measured|meas|joints?|state|present|robot|motor|arm|ax[ei]s|gelenke?|achsen?|ist)_)*"
_AFTER = r"(_(actual|act|measured|meas|joints?|state|rad|deg|rads|rad_s|deg_s|nm))*"
_GOAL = r"(des|desired|cmd|commanded|command|ref|reference|target|goal|set)"


def _usual(core: str) -> str:
    return f"{_BEFORE}({core}){_AFTER}"


GUESSES = {
    "q": _usual(r"q|qpos|q_pos|pos|positions?|act_pos\w*|theta|angles?|winkel") + r"|observation\.state",
    "dq": _usual(r"dq|qd|v|qvel|q_vel|qdot|q_dot|vel|velocity|velocities|speeds?|geschw(indigkeit)?|act_vel\w*")
    + r"|observation\.velocity",
    "tau": _usual(
        r"tau(_?[jm])?|qfrc(_actuator|_applied|_motor)?|efforts?|eff|torques?|torq|trq|tq|act_torque\w*|current_as_torque|currents?|i|m|"
        r"(dreh)?moment[es]?|mom|str[oö]me?|motorstr[oö]me?"
    )
    + r"|observation\.effort",
    "tau_ext": r"(tau_ext\w*|external_torques?)",
    "q_des": rf"q_d|{_BEFORE}(q|pos|positions?)_{_GOAL}|{_GOAL}_(q|pos|positions?)\w*|ref_pos\w*|goal(_pos\w*)?|action",
    "temperature": _usual(r"temps?|temperatures?"),
    "duty": r"(duty|pwm|load|present_(load|pwm))",
    "voltage": r"(voltage|voltages|present_voltage)",
    "time": r"(_*(t|time|times|timestamps?|stamp)(_(s|sec|ms|us|ns))?|time_cont)",
    "label": r"(label|labels|contact|contacts|collision|collisions|touch)",
}
"""Usual names of each signal, without joint and counter."""


@dataclass
class Guess:
    """Names found in a file; empty where nothing fits."""

    columns: dict[str, str] = field(default_factory=dict)
    topic: str = ""
    joint_names: tuple[str, ...] = ()
    """Joint names in the recording; empty where it numbers them."""
    count: int = 0
    """Number of joints, from the columns of q."""
    values: dict[str, Any] = field(default_factory=dict)
    """Values of other keys that the recording's numbers show, by "table.key"."""
    why: dict[str, str] = field(default_factory=dict)
    """Evidence of guesses, a sentence by "table.key"."""


def guess(streams: Mapping[str, Sequence[str]], robot: Sequence[str] = ()) -> Guess:
    """Guess the signals of a source from its column names.

    Args:
        robot: joints of the robot file, whose names columns may contain.
    """
    found, left = Guess(), dict[str, int]()
    for stream, names in streams.items():
        groups, joints = _groups(names), _named_joints(names, robot)
        for pattern in sorted({name.replace(joints[0], "{joint}") for name in names if joints and joints[0] in name}):
            spelled = [pattern.replace("{joint}", joint) for joint in joints]
            if all(name in names for name in spelled):
                groups = {group: count for group, count in groups.items() if not _is_part(group, spelled)}
                groups[pattern] = len(joints)
        for signal, pattern in GUESSES.items():
            fits = [g for g in groups if re.fullmatch(pattern, _bare(g), re.IGNORECASE)]
            if signal == "q" and not fits and JOINT in groups:
                fits = [JOINT]  # columns named by the joint alone
            single = signal in ("time", "label")
            fits = [g for g in fits if (groups[g] == 1) == single or (single and g in names)]
            if fits and signal not in found.columns:
                # With torque and current in a file, prefer the torque, which needs no constant.
                fits.sort(key=lambda one: (signal == "tau" and _is_current(one), _is_unsure(signal, one), len(one)))
                found.columns[signal] = fits[0]
                _explain(found, signal, fits, groups[fits[0]])
                if signal == "q":
                    found.topic, found.count = stream, groups[fits[0]]
        left |= groups
        base = found.columns.get("q", "")
        elements = [n.removeprefix(f"{base}[")[:-1] for n in names if base and n.startswith(f"{base}[")]
        if elements and not all(e.isdigit() for e in elements):
            found.joint_names = tuple(elements)
        elif joints and "{joint}" in base:
            found.joint_names = joints
    _ask_for_missing(found, {group: count for group, count in left.items() if group not in found.columns.values()})
    return found


def _explain(found: Guess, signal: str, fits: Sequence[str], count: int) -> None:
    """Add the evidence of a signal's columns; names that may mean something else are marked as unsure."""
    key = {"time": "time.column", "label": "contact.column"}.get(signal, f"signals.{signal}.columns")
    words = "by its name" if signal in ("time", "label") else f"by the names of {count} columns"
    found.why[key] = f"{words}; {', '.join(fits[1:])} would fit, too" if fits[1:] else words
    if _is_unsure(signal, fits[0]):
        found.values[key] = GUESSED + fits[0]
        found.why[key] += f"; it may mean something else than {NEEDED_WORDS[signal]}"


NEEDED_WORDS = {"q": "a position", "dq": "a velocity", "tau": "a torque or a current"}


def _ask_for_missing(found: Guess, left: Mapping[str, int]) -> None:
    """Mark the needed signals without columns as entries to fill in.

    Args:
        left: columns of no signal, and the number of each.
    """
    joints = [group for group, count in left.items() if count == found.count > 0]
    for signal in NEEDED if found.columns or left else ():
        if signal in found.columns or (signal != "q" and _torque_source(found)) or (signal == "dq" and not joints):
            continue
        key = f"signals.{signal}.columns"
        found.values[key] = GUESSED
        found.why[key] = f"no column is named as {NEEDED_WORDS[signal]} usually is"
        found.why[key] += f"; not in use: {short_list(joints or left)}" if left else ""
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
            _guess_degrees(guessed, block)
            _guess_ur_effort(guessed, block)
            return


def _guess_clock(guessed: Guess, block: RawSignals, raw: RawRecording) -> None:
    column = guessed.columns.get("time", "")
    rate_hz = _rate_of_velocity(guessed, block)
    hints = raw.hints() + [f"positions and velocities fit about {rate_hz:.3g} rows a second"] * bool(rate_hz)
    if not column or column not in block.names:
        if block.t_ns is None:
            none = "no column of times: name it in column, or give the rate of the rows"
            guessed.why[RATE] = "; ".join([none, *hints])
        elif raw.clocks[0] and not column:
            guessed.why["time.column"] = f"the stamps of the file, '{raw.clocks[0]}', are the clock"
        return
    times = block.columns[:, block.names.index(column)]
    steps = np.diff(times[np.isfinite(times)])
    ahead, unit = steps[steps > 0], time_unit(times)
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
    sure = bool(unit) and not _contradicts(rate_hz, 1e9 / (step * TIME_UNITS[unit]))
    guessed.values["time.unit"] = unit if sure else GUESSED + (unit or "s")


def _contradicts(one_hz: float, other_hz: float, most: float = 1.2) -> bool:
    """Whether a rate, 0 where it is unknown, differs from another one by a larger factor than `most`.

    A factor of degrees to radians between them is no contradiction: check names it.
    """
    ratio = one_hz / other_hz
    return bool(ratio) and all(max(ratio / factor, factor / ratio) > most for factor in (1, 180 / np.pi, np.pi / 180))


def _rate_of_velocity(guessed: Guess, block: RawSignals) -> float:
    """Rows a second at which the velocity is the derivative of the position, [Hz]; 0: not to be found."""
    q, dq = (block.columns[:, _indices(guessed, block, signal)] for signal in ("q", "dq"))
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


def time_unit(times: np.ndarray) -> str:
    """Unit of a column of times from its steps: only one unit gives 10 Hz to 10 kHz; empty: none.

    Args:
        times: (samples,), NaN where there is none.
    """
    steps = np.diff(times[np.isfinite(times)])
    steps = steps[steps > 0]
    if not len(steps):
        return ""
    step = float(np.median(steps))
    return next((unit for unit, ns in TIME_UNITS.items() if 1e5 < step * ns <= 1e8), "")


def _guess_degrees(guessed: Guess, block: RawSignals) -> None:
    indices = _indices(guessed, block, "q")
    if not indices or "deg" in guessed.columns["q"]:
        return
    largest = np.nanmax(np.abs(np.nan_to_num(block.columns[:, indices])), axis=0)
    if (largest > 7.0).sum() < min(2, len(indices)):  # cables allow an arm's joint about a turn each way
        return
    guessed.values["signals.q.unit"] = f"{GUESSED}deg"
    guessed.why["signals.q.unit"] = f"positions reach {largest.max():.4g}"
    if "dq" in guessed.columns:
        guessed.values["signals.dq.unit"] = f"{GUESSED}deg/s"
        guessed.why["signals.dq.unit"] = "the unit of the positions, if they are in degrees; rad/s is the other choice"


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
    if not is_ur or not indices or _is_current(guessed.columns["tau"]):
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
        "time": {"column": columns.get("time", ""), "unit": "ns" if columns.get("time", "").endswith("_ns") else "s"},
        "contact": {"column": columns.get("label", "")},
    }
    signals = {name: _signal(name, columns.get(name, NEEDED.get(name, name))) for name in SIGNALS}
    in_force = {*found, *NEEDED, *columns}
    if made_of := _torque_source(guessed):
        found["servo"] = {"torque_from": made_of}
        in_force = (in_force | {"servo"}) - {"tau"}
    if len(topics) > 1 and guessed.topic:
        signals |= {name: signals[name] | {"topic": guessed.topic} for name in NEEDED}
    for entry, value in guessed.values.items():
        table, _, key = entry.rpartition(".")
        (signals[table.removeprefix("signals.")] if table.startswith("signals.") else found[table])[key] = value
    lines = _HEADER.splitlines()
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
        return {"joints": logged or tuple(f"joint{k + 1}" for k in range(count or 2))}, {}
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


def _signal(name: str, columns: str) -> dict[str, Any]:
    """Values of a signal's keys, guessed from its column names."""
    unit = next(iter(SIGNALS[name].units))
    if name == "tau" and _is_current(columns):
        return {"columns": columns, "unit": "A", "torque_constant": "unknown"}
    return {"columns": columns, "unit": unit.replace("rad", "deg") if "deg" in columns else unit}


def _shared_keys(topics: Sequence[str]) -> list[str]:
    """Comment that explains the shared keys."""
    lines = ["# Signals. Keys of several of them:"]
    for name, words in key_help(SignalTable).items():
        if name in SHARED and words:
            more = f" The source has {', '.join(topics)}." if name == "topic" and len(topics) > 1 else ""
            lines += comment_lines(f"{name}: {words}{more}", "#   ")
    return [*lines, ""]


JOINT = "{joint}"


def _named_joints(names: Sequence[str], robot: Sequence[str]) -> tuple[str, ...]:
    """Joint names in q_JOINT, JOINT_pos, .../JOINT/position and the like, in order; at least two such columns.

    Columns that contain a name of the robot file, alone or beside other words, give the joints first.
    """
    for joint in robot:
        for column in names:
            if re.search(rf"(?<![A-Za-z0-9]){re.escape(joint)}(?![A-Za-z0-9])", column) is None or "[" in column:
                continue
            before, _, after = column.partition(joint)
            of = re.compile(f"{re.escape(before)}(.+){re.escape(after)}")
            joints = tuple(match[1] for name in names if (match := of.fullmatch(name)))
            if not before and not after:
                joints = tuple(name for name in names if name in robot)
            elif not re.fullmatch(GUESSES["q"], _bare(f"{before}{JOINT}{after}"), re.IGNORECASE):
                continue
            if len(joints) > 1:
                return joints
    q = "(q|pos|position|positions|angle)"
    for pattern in (rf"{q}[_.](?P<joint>.+)", rf".*?(?P<joint>[^/]+)/{q}", rf"(?P<joint>.+?)[_. ]{q}"):
        joints = tuple(match["joint"] for name in names if (match := re.fullmatch(pattern, name, re.IGNORECASE)))
        # q_d0 and q_des_0 are numbered goals, q_x is a coordinate: not joints.
        none = rf"(d|{_GOAL})?_?\d*|[xyzw]|r[xyz]|q[xyzw]|roll|pitch|yaw"
        if len(joints) > 1 and not all(re.fullmatch(none, joint, re.IGNORECASE) for joint in joints):
            return joints
    return ()


def _groups(names: Sequence[str]) -> dict[str, int]:
    """Group names that differ only in one number or element: pattern and count; others stay single."""
    groups: dict[str, list[int]] = {}
    for name in names:
        pattern, number = re.sub(r"\[[^\]]*\]$", "", name) or name, 0
        if pattern == name and (match := re.fullmatch(r"(.*?\D)(\d+)(\D*)", name)):
            pattern, number = f"{match[1]}{{#}}{match[3]}", int(match[2])
        groups.setdefault(pattern, []).append(number)
    return {
        pattern.replace("{#}", "{number}" if min(numbers) else "{index}"): len(numbers)
        for pattern, numbers in groups.items()
    }


def _is_part(group: str, names: Sequence[str]) -> bool:
    """Whether the pattern covers only some of these names: wrist_{number}/position beside elbow/position."""
    counted = re.escape(group).replace(r"\{number\}", r"\d+").replace(r"\{index\}", r"\d+")
    return any(re.fullmatch(counted, name) for name in names)


def _is_current(pattern: str) -> bool:
    return (
        re.fullmatch(r"\w*current(?!_as_torque)\w*|\w*str[oö]me?|(\w*_)?i", _bare(pattern), re.IGNORECASE) is not None
    )


def _is_unsure(signal: str, pattern: str) -> bool:
    """Whether the name may mean something else: a motor, metres."""
    return signal == "tau" and re.fullmatch(_usual("m"), _bare(pattern), re.IGNORECASE) is not None


def _bare(pattern: str) -> str:
    """Last part of the pattern without its counter, in small letters with underscores: the signal's usual name."""
    name = re.sub(r"[_/. ]?\{\w+\}[_. ]?", "", pattern)
    if name.startswith(("observation.", "action")):
        return name
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", re.split(r"[./]", name)[-1]).replace(" ", "_").replace("-", "_")
