"""The commented arm.toml that a user begins with, filled in from the names in a file where they can be guessed."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from tauext.data.description import TIME_UNITS
from tauext.data.servo_types import SERVO_TYPES

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
    """As the recording names them; empty where it counts them."""
    count: int = 0
    """Number of joints, as q has columns."""
    time_unit: str = ""
    """Of the column of times, where its values show it."""


def guess(streams: Mapping[str, Sequence[str]]) -> Guess:
    """What the columns of a source may be, by their names alone."""
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
                # A file with torque and current: the torque needs no constant.
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
    """Unit of a column of times by its steps: 10 Hz to 10 kHz fit one unit only; empty: none.

    Args:
        times: (samples,), NaN where there is none.
    """
    steps = np.diff(times[np.isfinite(times)])
    steps = steps[steps > 0]
    if not len(steps):
        return ""
    step = float(np.median(steps))
    return next((unit for unit, ns in TIME_UNITS.items() if 1e5 < step * ns <= 1e8), "")


def template(guessed: Guess, model: str = "", joints: Sequence[str] = (), topics: Sequence[str] = ()) -> str:
    """The text of an arm.toml with every key explained.

    Args:
        model: robot file as it shall be written.
        joints: its joints.
        topics: topics of the source, to choose from.
    """
    in_file = guessed.joint_names
    count = len(in_file) or guessed.count
    numbered = tuple(f"joint{k + 1}" for k in range(count or 2))
    in_both = tuple(joint for joint in joints if joint in in_file)
    used = in_both or (tuple(joints[:count]) if count else tuple(joints)) or in_file or numbered
    in_file = in_both or in_file
    differ = bool(in_file) and tuple(in_file) != used
    columns = guessed.columns
    topic = guessed.topic if len(topics) > 1 else ""
    topic_line = f"topic = {json.dumps(topic)}" if topic else '# topic = "/joint_states"'
    dq = columns.get("dq", "")
    values = {
        "MODEL": json.dumps(model),
        "JOINTS": json.dumps(list(used)),
        "NAMES": f"names = {json.dumps(list(in_file))}" if differ else '# names = ["Base", "Shoulder"]',
        "TIME": json.dumps(columns.get("time", "")),
        "TIME_UNIT": json.dumps(guessed.time_unit or ("ns" if columns.get("time", "").endswith("_ns") else "s")),
        "TOPIC": topic_line,
        "TOPICS": f" The file holds {', '.join(topics)}." if topic else "",
        "Q": json.dumps(columns.get("q", "position")),
        "Q_UNIT": json.dumps("deg" if "deg" in columns.get("q", "") else "rad"),
        "DQ": json.dumps(dq),
        "DQ_UNIT": json.dumps("deg/s" if "deg" in dq else "rad/s"),
        "TAU": json.dumps(columns.get("tau", "effort")),
        "TAU_UNIT": json.dumps("A" if _is_current(columns.get("tau", "")) else "Nm"),
        "SERVOS": f"Types: {', '.join(SERVO_TYPES)}.",
        "LABEL": json.dumps(columns.get("label", "")),
    }
    values["CONSTANT"] = ("" if values["TAU_UNIT"] == '"A"' else "# ") + 'torque_constant = "unknown"'
    optional = ""
    for signal, text in OPTIONAL.items():
        lines = text.replace("@COLUMNS@", json.dumps(columns.get(signal, signal)))
        lines = lines.replace('"rad"', '"deg"') if "deg" in columns.get(signal, "") else lines
        optional += lines if signal in columns else re.sub(r"(?m)^(?=[\[a-z])", "# ", lines)
    text = TEMPLATE.replace("@OPTIONAL@", optional)
    for key, value in values.items():
        text = text.replace(f"@{key}@", value)
    made_of = next((source for signal, source in MADE_OF.items() if signal in columns), "")
    return _as_servos(text, made_of) if made_of and "q" in columns and "tau" not in columns else text


def _named_joints(names: Sequence[str]) -> tuple[str, ...]:
    """Joints of q_JOINT, pos_JOINT, position_JOINT or .../JOINT/position, in the order of two or more such names."""
    for pattern in (r"q_(.+)", r"pos_(.+)", r"position_(.+)", r".*?([^/]+)/position"):
        joints = tuple(match[1] for name in names if (match := re.fullmatch(pattern, name)))
        # q_d0 and q_des_0 are goals that are counted, and no joints.
        if len(joints) > 1 and not all(re.fullmatch(r"(d|des|desired|cmd|goal|target)?_?\d+", j) for j in joints):
            return joints
    return ()


def _as_servos(text: str, source: str) -> str:
    """The text with [servo] in force, and without a torque of its own."""
    text = text.replace("# [servo]", "[servo]", 1).replace('# torque_from = "torque"', f'torque_from = "{source}"', 1)
    begin = text.index("[signals.tau]")
    end = text.index("\n\n", begin)
    return text[:begin] + re.sub(r"(?m)^(?=[\[a-z])", "# ", text[begin:end]) + text[end:]


def _groups(names: Sequence[str]) -> dict[str, int]:
    """Names that differ in one number or element only: their pattern, and how many there are; others by themselves."""
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
    """Whether the pattern counts some of these names: wrist_{number}/position beside elbow/position."""
    counted = re.escape(group).replace(r"\{number\}", r"\d+").replace(r"\{index\}", r"\d+")
    return any(re.fullmatch(counted, name) for name in names)


def _is_current(pattern: str) -> bool:
    return re.fullmatch(r"\w*current\w*|i", _bare(pattern), re.IGNORECASE) is not None


def _bare(pattern: str) -> str:
    """The pattern's last part without its counter: what a person calls the signal."""
    name = re.sub(r"[_/]?\{\w+\}_?", "", pattern)
    return name if name.startswith(("observation.", "action")) else re.split(r"[./]", name)[-1]


MADE_OF = {"duty": "duty", "q_des": "goal"}
"""Sources of a servo's torque where no column holds it, by the signal that is there; best first."""
OPTIONAL = {
    signal: f"\n{comment}\n[signals.{signal}]\ncolumns = @COLUMNS@\n" + (f'unit = "{unit}"\n' if unit else "")
    for signal, unit, comment in (
        ("q_des", "rad", "# Commanded position. Optional; keys as of q."),
        (
            "tau_ext",
            "Nm",
            "# External torque as the robot itself estimates it, to compare with; positive where the environment "
            "pushes the joint in\n# its positive direction (sign = -1 turns it). Optional.",
        ),
        ("temperature", "", "# Motor temperature, degC. Optional."),
        (
            "current",
            "mA",
            "# Current as a servo reports it, A or mA: of its windings or of its supply, see [servo]. Optional.",
        ),
        (
            "duty",
            "1",
            "# Share of the supply voltage at a servo's motor, 1 (from -1 to 1), % or permille; Feetech: load, "
            "Dynamixel: PWM.\n# Optional.",
        ),
        ("voltage", "V", "# Supply voltage of a servo, V or mV. Optional."),
    )
}

TEMPLATE = """\
# arm.toml: description of a robot and of its recordings.
# A list has one entry a joint, in the order of [robot] joints; one number instead stands for all joints.
# Keys that are not known are refused. Lines that begin with # are comments or keys left at their default.

[robot]
# URDF or MJCF file, relative to this file. "": there is no model; train takes the case none.
model = @MODEL@
# Joints in use, as the robot file names them, from the base on. All others are held at the file's rest position.
joints = @JOINTS@
# The same joints as the recording names them, where it names them otherwise.
@NAMES@
# Motor turns a joint turn. Used for signals of side = "motor" and for the rotor inertia.
# gear_ratio = 1
# Inertia of motor, rotor and whatever turns with it, before the gear, kg m^2; times gear_ratio squared it is the
# joint's. It replaces the robot file's; left out, the file's holds.
# rotor_inertia_kg_m2 = 0.0001
# Acceleration of free fall in the robot's base frame, for an arm that does not stand upright. Left out: the file's.
# gravity_m_s2 = [0, 0, -9.81]
# LeRobot's calibration file of the arm, for positions and goals of unit = "normalised".
# calibration = "my_arm.json"

# What the arm carries and the robot file lacks: a tool, a gripper, a sensor.
# [payload]
# link = "tool0"              # of the robot file
# mass_kg = 0.0
# com_m = [0, 0, 0]           # centre of mass in that link's frame
# inertia_kg_m2 = [0, 0, 0, 0, 0, 0]  # about the centre of mass: xx, yy, zz, xy, xz, yz

[time]
# Column of the sample times. "" for bags and LeRobot folders, which bring stamps, or where rate_hz is enough.
column = @TIME@
# s, ms, us or ns.
unit = @TIME_UNIT@
# Nominal rate of the recordings, Hz. 0: as measured (the median step of the first recording).
rate_hz = 0
# Rows whose measured values all equal the row before, for at most 0.1 s, hold one measurement: keep or drop them.
# keep: the clock stays regular, and a monitor behind the same reader gets such rows too. drop: for a reader several
# times faster than the robot's state, where the monitor will be fed each state once.
repeats = "keep"

# Signals. columns is an array whose elements are the joints ("position"), a pattern with {joint} (name in the
# recording), {index} (from 0) or {number} (from 1), or a list of names. Every signal has:
#   topic: of a bag, where several are read; signals of several topics are merged by their stamps.@TOPICS@
#   unit, and sign: 1 or -1, -1 where the recording counts against the robot file.
#   side: "joint", or "motor" where it is measured before the gear (then gear_ratio applies).

[signals.q]
# Joint position, rad or deg; "normalised": LeRobot's -100 to 100, which needs [robot] calibration.
columns = @Q@
@TOPIC@
unit = @Q_UNIT@
side = "joint"
sign = 1
# Added after all else, in the unit above: where the recording's zero is not the robot file's.
# offset = 0

[signals.dq]
# Joint velocity, rad/s, deg/s or rpm. columns = "": derived from the position, through a first-order low-pass.
columns = @DQ@
@TOPIC@
unit = @DQ_UNIT@
side = "joint"
sign = 1
# Cut-off of that low-pass, Hz; 0: none. Without effect on a measured velocity.
low_pass_hz = 20

[signals.tau]
# Motor torque with friction not subtracted, or motor current: Nm, mNm, kNm, A or mA.
# Positive where the motor drives the joint in its positive direction.
columns = @TAU@
@TOPIC@
unit = @TAU_UNIT@
side = "joint"
sign = 1
# For currents: Nm/A, at the motor where side = "motor", else at the joint; "unknown": it is to be fitted.
@CONSTANT@
# instant: measured at its stamp. held: commanded, acts from its stamp to the next. averaged: over the step before.
timing = "instant"
@OPTIONAL@
# Joints driven by servos: velocity and torque are made of what these report, in recordings and live loops alike.
# [servo]
# torque: it is [signals.tau]. phase-current: [signals.current] is that of the windings, signed. supply-current: it is
# what the servo draws, unsigned. duty: [signals.duty]. goal: [signals.q_des] minus q, by the position loop's gain.
# For all but the first [signals.tau] is left out.
# torque_from = "torque"
# @SERVOS@
# One name, or one a joint; left out: an unknown servo.
# type = "sts3215-7.4v"
# Constants that the type lacks, or that differ from it; all at the joint, after the gear.
# gain = 16                   # P gain of the position controller, as its register has it
# duty_per_rad = 2.7          # or: duty a rad of position error
# most_duty = 0.97            # that its registers allow; LeRobot halves a Feetech gripper's (Max_Torque_Limit = 500)
# voltage_v = 7.4             # where no [signals.voltage] is
# ohm = 2.75                  # of the windings
# back_emf_v_s = 1.28         # V s/rad
# torque_constant = "unknown" # Nm/A, or "unknown": it is to be fitted
# counts_a_turn = 4096        # of the encoder
# Longest stretch that a velocity is derived from, s; 0: the velocity is [signals.dq].
# velocity_window_s = 0.2
# A goal acts so long after its stamp, s; "period": one sample period, where a loop reads first and then sends it.
# goal_delay_s = "period"
# Of the torque, as in [signals.tau].
# timing = "held"

[contact]
# Column that marks whether the arm is touched. "": there is none.
column = @LABEL@
# Its topic, where several are read.
# topic = "/touch"
# Values that mean contact and free; all others mean unknown.
contact_values = [1]
free_values = [0]
# Contacts are cut out of training, validation, test and calibration, with this much before and after, s.
before_s = 0.5
after_s = 1.0
# false: recordings keep their contacts, where the free stretches between them are short; training and limits leave
# them out by their label all the same (--margins of train).
# cut = false
# Where there is no label: contacts by file, in s after its first sample.
# [contact.intervals]
# "run2.bag" = [[40.7, 41.0]]

# Which recording serves for what, by file name, or a part of it in s after its first sample: "run2.bag[0:40]".
# Left out: recordings with contacts are for collisions, the others are split whole (6 or more) or each by time.
# [split]
# train = ["run1.bag"]
# validation = []             # none: train finds limits on training motion that it leaves out in turn
# test = ["run2.bag[0:40]"]
# collisions = ["run2.bag[40:]"]
# calibration = []            # free motion for the limits alone
# gap_s = 2.0                 # between two parts of one recording
"""
