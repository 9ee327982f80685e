"""Write a commented arm.toml as a template, with values guessed from the names in a recording."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from tauext.data.description import SIGNALS, TABLES, TIME_UNITS, SignalTable
from tauext.files.toml_file import Key, comment_lines, field_help

GUESSES = {
    "q": r"(q|pos|position|positions|joint_pos(ition)?s?|act_pos\w*|actual_q|theta|angles?|observation\.state)",
    "dq": r"(dq|qd|vel|velocity|velocities|joint_vel(ocitie)?s?|act_vel\w*|actual_qd|observation\.velocity)",
    "tau": r"(tau(_?[jm])?|effort|efforts|torque|torques|joint_torques?|act_torque\w*|current|currents|i|actual_current"
    r"|observation\.effort)",
    "tau_ext": r"(tau_ext\w*|external_torques?)",
    "q_des": r"(q_d(es)?|q_cmd|q_ref|target_q|ref_pos\w*|goal|goal_pos\w*|action)",
    "temperature": r"(temp|temps|temperature|temperatures|joint_temperatures?)",
    "duty": r"(duty|pwm|load|present_(load|pwm))",
    "voltage": r"(voltage|voltages|present_voltage)",
    "time": r"(_*(t|time|times|timestamp|stamp)(_s|_ms|_us|_ns)?|time_cont)",
    "label": r"(label|labels|contact|contacts|collision|collisions|touch)",
}


@dataclass
class Guess:
    """Names found in a file; empty where nothing fits."""

    columns: dict[str, str] = field(default_factory=dict)
    topic: str = ""
    joint_names: tuple[str, ...] = ()
    """Joint names in the recording; empty where it numbers them."""
    count: int = 0
    """Number of joints, from the columns of q."""
    time_unit: str = ""
    """Unit of the column of times, where its values determine it."""


def guess(streams: Mapping[str, Sequence[str]]) -> Guess:
    """Guess the signals of a source from its column names."""
    found = Guess()
    for stream, names in streams.items():
        groups, joints = _groups(names), _named_joints(names)
        for pattern in sorted({name.replace(joints[0], "{joint}") for name in names if joints and joints[0] in name}):
            spelled = [pattern.replace("{joint}", joint) for joint in joints]
            if all(name in names for name in spelled):
                groups = {group: count for group, count in groups.items() if not _is_part(group, spelled)}
                groups[pattern] = len(joints)
        for signal, pattern in GUESSES.items():
            fits = [g for g in groups if re.fullmatch(pattern, _bare(g), re.IGNORECASE)]
            single = signal in ("time", "label")
            fits = [g for g in fits if (groups[g] == 1) == single or (single and g in names)]
            if fits and signal not in found.columns:
                # With torque and current in a file, prefer the torque, which needs no constant.
                found.columns[signal] = min(
                    fits, key=lambda group: (signal == "tau" and _is_current(group), len(group))
                )
                if signal == "q":
                    found.topic, found.count = stream, groups[fits[0]]
        base = found.columns.get("q", "")
        elements = [n.removeprefix(f"{base}[")[:-1] for n in names if base and n.startswith(f"{base}[")]
        if elements and not all(e.isdigit() for e in elements):
            found.joint_names = tuple(elements)
        elif joints and "{joint}" in base:
            found.joint_names = joints
    return found


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


WIDTH = 120
HEADER = """\
# arm.toml: description of a robot and of its recordings.
# A list has one entry a joint, in the order of [robot] joints; one number instead stands for all joints.
# Unknown keys are refused. A key after # is not set: the line shows its default or an example.

"""
NEEDED = {"q": "position", "dq": "", "tau": "effort"}
"""Signals of every arm.toml, with their default columns."""
SHARED = [one.name for one in fields(SignalTable) if sum(one.name in signal.keys for signal in SIGNALS.values()) > 1]
"""Keys of several signals, explained once before them."""
MADE_OF = {"duty": "duty", "q_des": "goal"}
"""Sources of a servo's torque without a torque column, by the available signal; best first."""


def template(guessed: Guess, model: str = "", joints: Sequence[str] = (), topics: Sequence[str] = ()) -> str:
    """Text of an arm.toml that explains every key and sets the keys found.

    Args:
        model: path of the robot file.
        joints: its joints.
        topics: topics of the source, to choose from.
    """
    in_file, columns = guessed.joint_names, guessed.columns
    count = len(in_file) or guessed.count
    numbered = tuple(f"joint{k + 1}" for k in range(count or 2))
    in_both = tuple(joint for joint in joints if joint in in_file)
    used = in_both or (tuple(joints[:count]) if count else tuple(joints)) or in_file or numbered
    in_file = in_both or in_file
    made_of = next((source for signal, source in MADE_OF.items() if signal in columns), "")
    found: dict[str, dict[str, Any]] = {
        "robot": {"model": model, "joints": used} | ({"names": in_file} if in_file and in_file != used else {}),
        "time": {
            "column": columns.get("time", ""),
            "unit": guessed.time_unit or ("ns" if columns.get("time", "").endswith("_ns") else "s"),
        },
        "contact": {"column": columns.get("label", "")},
    }
    signals = {name: _signal(name, columns.get(name, NEEDED.get(name, name))) for name in SIGNALS}
    in_force = {*found, *NEEDED, *columns}
    if made_of and "q" in columns and "tau" not in columns:
        found["servo"] = {"torque_from": made_of}
        in_force = (in_force | {"servo"}) - {"tau"}
    if len(topics) > 1 and guessed.topic:
        signals |= {name: signals[name] | {"topic": guessed.topic} for name in NEEDED}
    text = HEADER
    for name, kind in TABLES.items():
        text += _table(name, kind, kind.__doc__ or "", found.get(name, {}), name in in_force)
        if name == "time":  # the signals follow
            text += _shared_keys(topics if guessed.topic else ())
            for signal, (_, keys, words) in SIGNALS.items():
                shown = keys if signal in NEEDED else ("columns", "unit")
                text += _table(f"signals.{signal}", SignalTable, words, signals[signal], signal in in_force, shown)
    return text.rstrip() + "\n"


def _signal(name: str, columns: str) -> dict[str, Any]:
    """Values of a signal's keys, guessed from its column names."""
    unit = next(iter(SIGNALS[name].units))
    if name == "tau" and _is_current(columns):
        return {"columns": columns, "unit": "A", "torque_constant": "unknown"}
    return {"columns": columns, "unit": unit.replace("rad", "deg") if "deg" in columns else unit}


def _shared_keys(topics: Sequence[str]) -> str:
    """Comment that explains the shared keys."""
    words = field_help(SignalTable)
    lines = ["# Signals. Keys of several of them:"]
    for name in (name for name in SHARED if name in words):
        more = f" The source has {', '.join(topics)}." if name == "topic" and len(topics) > 1 else ""
        lines += comment_lines(f"{name}: {words[name]}{more}", "#   ")
    return "\n".join(lines) + "\n\n"


def _table(
    table: str, kind: type, about: str, found: Mapping[str, Any], in_force: bool, shown: Collection[str] = ()
) -> str:
    """Lines of a table, with the keys found set; commented out where the table is not in force.

    Args:
        shown: keys; empty: all.
    """
    helps, signal = field_help(kind), table.removeprefix("signals.")
    lines = [*comment_lines(about), f"{'' if in_force else '# '}[{table}]"]
    for one in (one for one in fields(kind) if not shown or one.name in shown):
        rule = one.metadata["rule"]
        choices = (rule if isinstance(rule, Key) else rule(1)).rule.partition("one of ")[2]
        if kind is SignalTable:
            choices = ", ".join(SIGNALS[signal].units) if one.name == "unit" else ""
        words = "" if kind is SignalTable and one.name in SHARED else helps.get(one.name, "")
        words += f"{' ' * bool(words)}One of {choices}." if choices else ""
        value = json.dumps(found[one.name]) if one.name in found else one.metadata["example"] or json.dumps(one.default)
        line = f"{'' if in_force and one.name in found else '# '}{one.name} = {value}"
        beside = f"{line}  # {words}".removesuffix(".") if words else line
        lines += [beside] if len(beside) <= WIDTH else [*comment_lines(words), line]
    return "\n".join(lines) + "\n\n"


def _named_joints(names: Sequence[str]) -> tuple[str, ...]:
    """Joint names in q_JOINT, pos_JOINT, position_JOINT or .../JOINT/position, in order; at least two such columns."""
    for pattern in (r"q_(.+)", r"pos_(.+)", r"position_(.+)", r".*?([^/]+)/position"):
        joints = tuple(match[1] for name in names if (match := re.fullmatch(pattern, name)))
        # q_d0 and q_des_0 are numbered goals, not joints.
        if len(joints) > 1 and not all(re.fullmatch(r"(d|des|desired|cmd|goal|target)?_?\d+", j) for j in joints):
            return joints
    return ()


def _groups(names: Sequence[str]) -> dict[str, int]:
    """Group names that differ only in one number or element: pattern and count; others stay single."""
    groups: dict[str, list[int]] = {}
    for name in names:
        if match := re.fullmatch(r"(.+)\[[^\]]*\]", name):
            groups.setdefault(match[1], []).append(0)
        elif match := re.fullmatch(r"(.*?\D)(\d+)(\D*)", name):
            groups.setdefault(f"{match[1]}{{#}}{match[3]}", []).append(int(match[2]))
        else:
            groups.setdefault(name, []).append(0)
    spelled: dict[str, int] = {}
    for pattern, numbers in groups.items():
        key = "index" if min(numbers) == 0 else "number"
        spelled[pattern.replace("{#}", f"{{{key}}}")] = len(numbers)
    return spelled


def _is_part(group: str, names: Sequence[str]) -> bool:
    """Whether the pattern covers only some of these names: wrist_{number}/position beside elbow/position."""
    counted = re.escape(group).replace(r"\{number\}", r"\d+").replace(r"\{index\}", r"\d+")
    return any(re.fullmatch(counted, name) for name in names)


def _is_current(pattern: str) -> bool:
    return re.fullmatch(r"\w*current\w*|i", _bare(pattern), re.IGNORECASE) is not None


def _bare(pattern: str) -> str:
    """Last part of the pattern without its counter: the signal's usual name."""
    name = re.sub(r"[_/]?\{\w+\}_?", "", pattern)
    return name if name.startswith(("observation.", "action")) else re.split(r"[./]", name)[-1]
