"""Files as the field has them: the arrays of the clean file, or one message that names the cause.

CASES lists, for each property of a file, how the log is changed, and what import makes of it in every format. Each cell
is one of two outcomes: the same arrays as from the clean file, less the rows that are left out and counted, or one
message.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from made_files import ARRAYS, BAGS, FORMATS, JOINTS, LEROBOT, NAMED, TABLES, Log, arm_text, clean_log, write

from tauext.cli.recordings import write_template
from tauext.data.description import open_entries
from tauext.data.importing import import_dataset
from tauext.data.recording_file import load_recording
from tauext.errors import TauextError

CLEAN = clean_log()
TABLE_LIKE = (*TABLES, *ARRAYS)
HALF = len(CLEAN.t_ns) // 2
PERIOD_NS = int(CLEAN.t_ns[1] - CLEAN.t_ns[0])


@dataclass(frozen=True)
class Case:
    """A property of a file in some formats, and its outcome: rows of the clean log, or a message."""

    name: str
    change: Callable[[Log], Log] = lambda log: log
    formats: tuple[str, ...] = FORMATS
    arm: dict = field(default_factory=dict)
    """Arguments of arm_text()."""
    runs: Sequence = (slice(None),)
    """Rows of the clean log in each recording that comes out."""
    said: str = ""
    """Part of a line that import prints."""
    refused: str = ""
    """Part of the message; empty: it is imported."""
    robot: tuple[str, ...] = ()
    """Joints of the robot file; empty: no robot file."""
    factor: tuple[float, ...] = ()
    """Of the clean log's positions and velocities, joint by joint; empty: none."""
    clock: bool = True
    """Whether the stamps are those of the clean log; else only their steps."""
    asked: tuple[str, ...] | None = None
    """The description is the one that `import --new` writes, once the entries that it marks are confirmed: these and no
    others. None: the one of arm_text()."""
    unused: str = ""
    """Columns that `import --new` lists as not in use."""
    joints: tuple[str, ...] = JOINTS
    """Names of the recordings' joints."""
    close: float = 0.0
    """Relative error of values that a unit changes twice."""


FAR = (4.0, 1.0, 5.0)


def put(signal: str, rows, joint, value) -> Callable[[Log], Log]:
    def change(log: Log) -> Log:
        values = getattr(log, signal).copy()
        values[rows, joint] = value
        return replace(log, **{signal: values})

    return change


def logged(log: Log) -> Log:
    """The log with the log times of the clean one."""
    return replace(log, log_ns=CLEAN.t_ns)


def two_runs(log: Log) -> Log:
    return logged(replace(log, t_ns=np.r_[log.t_ns[:HALF], log.t_ns[HALF:] - log.t_ns[HALF] + PERIOD_NS]))


def set_back(log: Log) -> Log:
    return logged(replace(log, t_ns=np.r_[log.t_ns[:HALF], log.t_ns[HALF:] - 503_000_000]))


def late(log: Log) -> Log:
    order = np.arange(len(log.t_ns))
    order[[100, 101, 300, 301]] = order[[101, 100, 301, 300]]
    return logged(log.rows(order))


def wrapped(log: Log) -> Log:
    return replace(log, q=(log.q * FAR + np.pi) % (2 * np.pi) - np.pi, dq=log.dq * FAR)


def every(**changes) -> Callable[[Log], Log]:
    """Change fields of the log by functions of the log."""
    return lambda log: replace(log, **{name: of(log) for name, of in changes.items()})


def joints(names: tuple[str, ...], of: Callable[[np.ndarray], np.ndarray]) -> Callable[[Log], Log]:
    """The log with these names and other columns in each array."""
    return lambda log: replace(
        log, names=names, **{a: np.ascontiguousarray(of(getattr(log, a))) for a in ("q", "dq", "tau")}
    )


def coarse(log: Log) -> np.ndarray:
    return log.t_ns // 10**8 * 10**8 + 10**9


SLOW_LOG = every(log_ns=lambda log: log.t_ns * 3 // 2)
SLOW_COLUMN = every(timestamp_s=lambda log: log.t_ns * 1.5e-9)
COARSE_BAG = every(t_ns=coarse, log_ns=lambda log: log.t_ns)
NO_STAMPS = every(t_ns=lambda log: 0 * log.t_ns, log_ns=lambda log: log.t_ns)
ONE_STAMP = every(t_ns=lambda log: 0 * log.t_ns + 7 * 10**9, log_ns=lambda log: log.t_ns)
ONE_OUT = [np.r_[:250, 251:600]]
HALVES = [slice(HALF), slice(HALF, None)]
GAP = np.r_[:200, 260:600]
STAMPED = tuple(kind for kind in FORMATS if kind not in LEROBOT)
BY_RATE = {"time": "rate_hz = 50"}
BESIDE = {"time": 'column = "time"\nrate_hz = 50'}
WITH_60 = {"time": 'column = "time"\nrate_hz = 60'}
CONTRADICTS = "rate_hz = 60 Hz, but the stamps come at 50 Hz"
HAND = (*JOINTS, "hand")
CASES = [
    Case("clean"),
    Case("a gap", lambda log: log.rows(GAP), STAMPED, runs=[GAP]),
    # --- Clock
    Case("the clock begins again", two_runs, STAMPED, runs=HALVES, clock=False),
    Case("the clock is set back", set_back, STAMPED, runs=HALVES, clock=False),
    Case("late rows", late, STAMPED, said="2 samples out of order, sorted"),
    Case("falling stamps", lambda log: log.rows(slice(None, None, -1)), TABLE_LIKE, refused="rows are out of order"),
    Case(
        "all stamps are equal",
        every(t_ns=lambda log: 0 * log.t_ns + 5 * 10**9),
        TABLE_LIKE,
        refused=r'all 600 stamps are equal.*\[time\] column = "" and rate_hz',
    ),
    Case("all stamps are equal, the rate is given", NO_STAMPS, TABLE_LIKE, arm=BY_RATE, clock=False),
    Case(
        "the rate is given beside them", NO_STAMPS, TABLE_LIKE, arm=BESIDE, clock=False, said="stamps of 'time' are no"
    ),
    Case("all header stamps are zero", NO_STAMPS, BAGS, clock=False, said="a stamp of zero, timed by the bag's log"),
    Case("all header stamps are equal", ONE_STAMP, BAGS, clock=False, said="the same stamp, timed by the bag's log"),
    Case("stamps of one decimal", every(t_ns=coarse), TABLE_LIKE, refused="5 rows share each stamp.*resolve 0.1 s"),
    Case("header stamps of one decimal", COARSE_BAG, BAGS, refused='resolve 0.1 s.*column = "log"'),
    Case("the log's clock is chosen", COARSE_BAG, BAGS, arm={"time": 'column = "log"'}, clock=False),
    Case("a column counts rows", every(t_ns=lambda log: np.arange(600) * 10**9), TABLE_LIKE, refused="counts rows"),
    Case("header and log disagree", SLOW_LOG, BAGS, refused='header counts 11.98 s, log 17.97 s.*"header" or "log"'),
    Case("header and log disagree, one is chosen", SLOW_LOG, BAGS, arm={"time": 'column = "header"'}),
    Case("timestamp and fps disagree", SLOW_COLUMN, LEROBOT, refused="fps counts 11.98 s, timestamp 17.97 s"),
    Case("timestamp and fps disagree, one is chosen", SLOW_COLUMN, LEROBOT, arm={"time": 'column = "fps"'}),
    Case("a stated rate contradicts a column", arm=WITH_60, formats=TABLE_LIKE, refused=CONTRADICTS),
    Case("a stated rate contradicts", arm={"time": "rate_hz = 60"}, formats=(*BAGS, *LEROBOT), refused=CONTRADICTS),
    # --- Turns
    Case("wraps", wrapped, factor=FAR, said=r"unwrapped: it jumped by whole turns \(shoulder, wrist\)"),
    # --- Missing values
    Case("one NaN", put("tau", 250, 1, np.nan), runs=ONE_OUT, said="1 row left out: '.*' is missing or no .*, first"),
    Case("one infinite value", put("dq", 250, 2, np.inf), runs=ONE_OUT, said="1 row left out"),
    Case(
        "no torque of a joint",
        put("tau", slice(None), 2, np.nan),
        refused="600 of 600 rows are left out; tau of wrist .*take wrist out of",
    ),
    Case(
        "no torque of a joint that is left out",
        joints((*JOINTS, "hand"), lambda a: np.c_[a, np.full(600, np.nan)]),
        NAMED,
        arm={"robot": 'model = "arm.urdf"\nlocked = ["hand"]\nignored = ["hand"]'},
        robot=HAND,
        said="joints not in use: hand of the robot file; hand of the recording",
    ),
    Case(
        "a locked joint that is unknown",
        arm={"robot": 'model = "arm.urdf"\nlocked = ["hnad"]'},
        robot=HAND,
        refused=r'locked = \["hnad"\]: the robot file',
    ),
    Case("no velocity of a joint", put("dq", slice(None), 0, np.nan), refused=r'dq of shoulder .*columns = ""'),
    Case(
        "a quarter of the rows lacks a value",
        put("tau", slice(0, None, 4), 2, np.nan),
        refused="150 of 600 rows are left out; 150 rows left out: '.*' is missing or no finite number, first",
    ),
    # --- Joints
    Case("joints in another order", joints(("wrist", "shoulder", "elbow"), lambda a: a[:, [2, 0, 1]]), NAMED),
    Case(
        "a joint that arm.toml does not name",
        arm={"joints": JOINTS[:2]},
        formats=NAMED,
        refused=r'recording\'s wrist is not used; in \[robot\], ignored = \["wrist"\]',
    ),
    Case(
        "an ignored joint",
        joints((*JOINTS, "tool"), lambda a: np.c_[a, np.arange(600) * 1e-3]),
        NAMED,
        arm={"robot": 'ignored = ["tool"]'},
        said="joints not in use: tool of the recording",
    ),
    Case(
        "a gripper beside the arm",
        joints((*JOINTS, "gripper_joint"), lambda a: np.c_[a, np.arange(600) * 1e-3]),
        NAMED,
        said="joints not in use: gripper_joint of the recording",
    ),
    Case(
        "a joint of the robot file has no signal",
        arm={"robot": 'model = "arm.urdf"'},
        robot=HAND,
        refused=r'robot file\'s hand has no signal; in \[robot\], locked = \["hand"\]',
    ),
    Case(
        "a locked joint",
        arm={"robot": 'model = "arm.urdf"\nlocked = ["hand"]'},
        robot=HAND,
        said="joints not in use: hand of the robot file",
    ),
    Case(
        "one joint has another name",
        joints(("shoulder", "elbow", "joint3"), lambda a: a),
        NAMED,
        arm={"joints": JOINTS[:2], "robot": 'model = "arm.urdf"'},
        robot=JOINTS,
        refused="wrist has no signal, and the recording's joint3 is not used; perhaps 'joint3' is 'wrist'",
    ),
]
DEG = 180 / np.pi
IN_DEGREES = every(q=lambda log: log.q * DEG, dq=lambda log: log.dq * DEG)


def titled(*titles: str, change: Callable[[Log], Log] = lambda log: log, **more) -> Callable[[Log], Log]:
    """The log with these titles of its columns, and more columns that are functions of the log."""

    def titled_log(log: Log) -> Log:
        changed = replace(change(log), titles=titles)
        return replace(changed, more={name.replace("__", " "): of(log) for name, of in more.items()})

    return titled_log


def epoch(unit: float, hz: float = 50.0) -> Callable[[Log], Log]:
    """The log from March 2026 on, with times in this unit [s]."""
    start_ns = 1_772_000_000 * 10**9

    def since_1970(log: Log) -> Log:
        return replace(log, t_ns=start_ns + (log.t_ns - log.t_ns[0]), time_factor=1e-9 / unit)

    return since_1970


TWICE = np.repeat(np.arange(600), 2)
WHEELS = joints(
    (*JOINTS, "wheel_left", "wheel_right"), lambda a: np.c_[a, np.linspace(0, 900, 600), np.linspace(0, -900, 600)]
)
CASES += [
    # --- Columns and units that the file states, by `import --new`
    Case("the description is guessed", formats=NAMED, asked=()),
    Case(
        "units in brackets",
        titled("Time [sec]", "q_{joint} (deg)", "qd_{joint} (deg/s)", "tau_{joint} [N m]", change=IN_DEGREES),
        TABLES,
        asked=(),
        close=1e-13,
    ),
    Case(
        "units in brackets of numbered joints",
        titled("t (s)", "q{number} act [deg]", "dq{number} act [deg/s]", "torque{number} [Nm]", change=IN_DEGREES),
        TABLES,
        asked=(),
        close=1e-13,
    ),
    Case(
        "units after the names",
        titled("time_s", "pos_deg_{number}", "vel_deg_s_{number}", "effort_Nm_{number}", change=IN_DEGREES),
        TABLES,
        asked=(),
        close=1e-13,
    ),
    Case(
        "millinewton metres",
        titled("time", "q_{joint}", "dq_{joint}", "tau_{joint} (mNm)", change=every(tau=lambda log: log.tau * 1e3)),
        TABLES,
        asked=(),
        close=1e-13,
    ),
    Case(
        "torques that only their unit shows",
        titled("time", "q{number}", "dq{number}", "y{number} (Nm)"),
        TABLES,
        asked=(),
    ),
    Case(
        "milliseconds in the name",
        titled("Time (ms)", "q{number}", "dq{number}", "tau{number}", change=every(time_factor=lambda log: 1e-6)),
        TABLES,
        asked=(),
    ),
    Case(
        "goals beside what is measured",
        titled(
            "time",
            "q_act_{joint}",
            "dq_act_{joint}",
            "tau_{joint}",
            **{f"q_des_{j}": (lambda log, k=k: log.q[:, k] + 1) for k, j in enumerate(JOINTS)},
        ),
        TABLES,
        asked=(),
    ),
    Case(
        "numbered goals beside what is measured",
        titled(
            "time",
            "q_act_{number}",
            "dq_act_{number}",
            "tau_{number}",
            **{f"q_des_{k + 1}": (lambda log, k=k: log.q[:, k] + 1) for k in range(3)},
        ),
        TABLES,
        asked=(),
    ),
    Case(
        "positions of the motors beside the joints'",
        titled(
            "time",
            "joint_position_{number}",
            "velocity_{number}",
            "tau_{number}",
            **{f"motor_position_{k + 1}": (lambda log, k=k: log.q[:, k] * 100) for k in range(3)},
        ),
        TABLES,
        asked=("signals.q columns",),
        unused=r"not in use: motor_position_\{number\}",
    ),
    Case(
        "further columns",
        titled(
            "time",
            "q{number}",
            "dq{number}",
            "tau{number}",
            stage=lambda log: 0 * log.q[:, 0],
            ddq__des=lambda log: log.q[:, 0],
        ),
        TABLES,
        asked=(),
        unused="not in use: stage, ddq des",
    ),
    Case(
        "wheels turn by far",
        WHEELS,
        NAMED,
        robot=JOINTS,
        asked=(),
        said="joints not in use: wheel_left, wheel_right of the recording",
    ),
    Case("one state of all signals", every(one_state=lambda log: True, goal_first=lambda log: 0.5), LEROBOT, asked=()),
    Case(
        "one state of all signals, in degrees",
        lambda log: replace(IN_DEGREES(log), q=log.q * DEG * 20, dq=log.dq * DEG * 20, one_state=True),
        LEROBOT,
        asked=("signals.q unit",),
        factor=(20.0, 20.0, 20.0),
        close=1e-13,
    ),
    *(
        Case(f"epochs in {unit}", epoch(size), TABLE_LIKE, asked=(), clock=False)
        for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6), ("ns", 1e-9))
    ),
    Case(
        "every row twice",
        lambda log: replace(log, t_ns=log.t_ns + 10**9).rows(TWICE),
        (*TABLE_LIKE, *BAGS),
        asked=(),
        clock=False,
        said="600 samples dropped: stamp and values repeat the sample before",
    ),
]


IN_UNITS = {
    "rad": 1.0,
    "deg": DEG,
    "rad/s": 1.0,
    "deg/s": DEG,
    "rpm": 30 / np.pi,
    "Nm": 1.0,
    "mNm": 1e3,
    "s": 1e-9,
    "ms": 1e-6,
    "us": 1e-3,
    "ns": 1.0,
}
"""Numbers of a radian, a radian a second, a newton metre and a nanosecond in units of columns."""
SPELLINGS = (
    ("t {ms}", "ms", "q_{joint} {deg}", "deg", "dq_{joint}{deg/s}", "deg/s", "tau_{joint} {Nm}", "Nm"),
    (
        "Zeit_[ms]",
        "ms",
        "A{number}_pos_[deg]",
        "deg",
        "A{number}_vel_[deg/s]",
        "deg/s",
        "A{number}_trq_[Nm]",
        "Nm",
        "A{number}",
    ),
    ("time (ms)", "ms", "q {joint} [deg]", "deg", "dq {joint} [deg/s]", "deg/s", "tau {joint} [Nm]", "Nm"),
    (
        "Time [sec]",
        "s",
        "{joint}_position (rad)",
        "rad",
        "{joint}_velocity (rad/s)",
        "rad/s",
        "{joint}_effort (N m)",
        "Nm",
    ),
    (
        "t [s]",
        "s",
        "position[deg] joint {number}",
        "deg",
        "velocity[deg/s] joint {number}",
        "deg/s",
        "torque[Nm] joint {number}",
        "Nm",
        "joint {number}",
    ),
    (
        "Time",
        "s",
        "Joint {number} Position (°)",
        "deg",
        "Joint {number} Velocity (°/s)",
        "deg/s",
        "Joint {number} Torque (N·m)",
        "Nm",
        "Joint {number}",
    ),
    (
        "Timestamp (ns)",
        "ns",
        "J{number}[deg]",
        "deg",
        "dq_J{number} [deg/s]",
        "deg/s",
        "torque_J{number} [Nm]",
        "Nm",
        "J{number}",
    ),
    ("time_ms", "ms", "{joint}_pos_deg", "deg", "{joint}_vel_deg_s", "deg/s", "{joint}_torque_Nm", "Nm"),
    ("elapsed time (s)", "s", "{joint} (deg)", "deg", "{joint} (deg/s)", "deg/s", "{joint} (Nm)", "Nm"),
    (
        "timestamp[us]",
        "us",
        "position [rad] {joint}",
        "rad",
        "velocity [rad/s] {joint}",
        "rad/s",
        "effort [mNm] {joint}",
        "mNm",
    ),
    ("ms_time", "ms", "deg_pos_{number}", "deg", "rpm_speed_{number}", "rpm", "Nm_tau_{number}", "Nm"),
    (
        "Zeit [s]",
        "s",
        "Winkel A{number} [°]",
        "deg",
        "Geschwindigkeit A{number} [°/s]",
        "deg/s",
        "Drehmoment A{number} [Nm]",
        "Nm",
    ),
    ("[s] time", "s", "[deg] q{number}", "deg", "[deg/s] dq{number}", "deg/s", "[N*m] tau{number}", "Nm"),
    (
        "TimeStamp_ms",
        "ms",
        "theta_{number} / rad",
        "rad",
        "qd_{number} [rad s^-1]",
        "rad/s",
        "Moment {number} <Nm>",
        "Nm",
    ),
    (
        "sim_time",
        "s",
        "{joint} angle in degrees",
        "deg",
        "{joint} speed (deg/sec)",
        "deg/s",
        "{joint} torque (newton metres)",
        "Nm",
    ),
    (
        "system time / s",
        "s",
        "Actual Position J{number} [rad]",
        "rad",
        "Actual Speed J{number} [rad.s-1]",
        "rad/s",
        "Actual Torque J{number} [N.m]",
        "Nm",
    ),
    ("t [µs]", "us", "Position_A{number}", "rad", "Velocity_A{number}", "rad/s", "Torque_A{number}", "Nm", "A{number}"),
)
"""Titles of time, positions, velocities and torques, each with its unit; and names of joints that contain a number."""


def in_units(time: str, q: str, dq: str, tau: str) -> Callable[[Log], Log]:
    """The log in these units."""

    def changed(log: Log) -> Log:
        numbers = {"q": log.q * IN_UNITS[q], "dq": log.dq * IN_UNITS[dq], "tau": log.tau * IN_UNITS[tau]}
        return replace(log, time_factor=IN_UNITS[time], **numbers)

    return changed


CASES += [
    Case(
        f"titles {', '.join(titles[:8:2])}",
        titled(*titles[:8:2], change=in_units(*titles[1::2])),
        ("csv",),
        asked=(),
        close=1e-13,
        joints=tuple(name.replace("{number}", str(k)) for name in titles[8:] for k in (1, 2, 3)) or JOINTS,
    )
    for titles in SPELLINGS
]


def between(log: Log, other: Log, every_other: int = 2) -> Log:
    """Rows of another writer after each of the log's, with stamps of their own, between them or equal."""
    step = PERIOD_NS // every_other
    parts = [replace(log), *(replace(other, t_ns=log.t_ns + step * (k + 1)) for k in range(every_other - 1))]
    order = np.argsort(np.concatenate([one.t_ns for one in parts]), kind="stable")
    joined = {a: np.concatenate([getattr(one, a) for one in parts])[order] for a in ("t_ns", "q", "dq", "tau")}
    return replace(log, **joined)


def zeros(log: Log) -> Log:
    return replace(log, q=0 * log.q, dq=0 * log.dq, tau=0 * log.tau)


def away(log: Log) -> Log:
    """The log far from zero, so that a writer of zeros is another one."""
    return replace(log, t_ns=log.t_ns + 10**9, q=log.q + 0.5)


def joined_stretches(log: Log) -> Log:
    """Six stretches of 100 rows in another order, with the stamps of one."""
    order = np.concatenate([np.arange(100) + 100 * k for k in (0, 3, 5, 1, 4, 2)])
    return replace(log.rows(order), t_ns=log.t_ns)


STRETCHES = [slice(100 * k, 100 * (k + 1)) for k in (0, 3, 5, 1, 4, 2)]
CASES += [
    # --- Rows of several origins
    Case(
        "a second writer of zeros",
        lambda log: between(away(log), zeros(log)),
        (*TABLE_LIKE, *BAGS),
        refused="alternate between two writers: one has positions of .*, the other zeros",
    ),
    Case(
        "two further rows of zeros",
        lambda log: between(away(log), zeros(log), 3),
        (*TABLE_LIKE, *BAGS),
        refused="alternate between two writers",
    ),
    Case(
        "a second arm",
        lambda log: between(log, replace(log, q=-log.q - 1)),
        (*TABLE_LIKE, *BAGS),
        refused="alternate between two writers: one has positions of .*, the other positions of",
    ),
    Case("joined stretches", joined_stretches, runs=STRETCHES, clock=False, said="stretches of 100 rows were joined"),
    Case(
        "joined stretches of other lengths",
        lambda log: replace(log.rows(np.r_[300:417, :150, 450:600]), t_ns=log.t_ns[:417]),
        runs=[slice(300, 417), slice(150), slice(450, 600)],
        clock=False,
        said="stretches of 117 to 150 rows were joined",
    ),
    Case(
        "joined stretches without a clock",
        joined_stretches,
        TABLE_LIKE,
        arm=BY_RATE,
        runs=STRETCHES,
        clock=False,
        said="stretches of 100 rows were joined",
    ),
]
CELLS = [pytest.param(case, kind, id=f"{case.name}-{kind}") for case in CASES for kind in case.formats]


def imported(case: Case, kind: str, folder: Path, capsys) -> tuple[list, list[str]]:
    """Recordings and printed lines of an import of the case's file in this format."""
    path = write(kind, folder, case.change(CLEAN))
    if case.robot:
        (folder / "arm.urdf").write_text(robot_text(case.robot))
    arm = folder / "arm.toml"
    lines: list[str] = []
    if case.asked is None:
        text = arm_text(kind, **case.arm)
    else:
        write_template(arm, (path,), folder / "arm.urdf" if case.robot else None)
        lines += capsys.readouterr().err.splitlines()
        text = arm.read_text()
        marked = [
            f"{entry[0]} {entry[1]}"
            for entry in re.findall(r"\[([\w.]+)\] (\w+) has", "; ".join(open_entries(tomllib.loads(text))))
        ]
        assert tuple(dict.fromkeys(marked)) == case.asked, text
        text = re.sub(r'"\?(?=[^"])', '"', text)
        text = text.replace('joints = ["joint1", "joint2", "joint3"]', f"joints = {json.dumps(JOINTS)}")
        text = text.replace("# [split]", "")
    arm.write_text(text + f'\n[split]\ntrain = ["{path.name}"]\n')
    import_dataset([path], arm, folder / "out", "tauext", lines.append)
    files = sorted((folder / "out").glob("*.parquet"))
    return [load_recording(file) for file in files], "\n".join(lines).splitlines()


def robot_text(joints) -> str:
    """A URDF of these joints in a row."""
    inertial = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    links = "".join(f'<link name="l{k}">{inertial}</link>' for k in range(len(joints) + 1))
    parts = "".join(
        f'<joint name="{name}" type="continuous"><parent link="l{k}"/><child link="l{k + 1}"/></joint>'
        for k, name in enumerate(joints)
    )
    return f'<robot name="arm">{links}{parts}</robot>'


@pytest.mark.parametrize(("case", "kind"), CELLS)
def test_a_file_gives_the_clean_arrays_or_one_message(case, kind, tmp_path, capsys):
    if case.refused:
        with pytest.raises(TauextError, match=case.refused) as caught:
            imported(case, kind, tmp_path, capsys)
        assert "\n" not in str(caught.value) and not (tmp_path / "out").exists()
        return
    recordings, lines = imported(case, kind, tmp_path, capsys)
    wanted = [CLEAN.rows(rows) for rows in case.runs]
    assert len(recordings) == len(wanted)
    for recording, log in zip(recordings, wanted, strict=True):
        assert recording.joints == case.joints and recording.rate_hz == 50
        t_ns = log.t_ns if case.clock else log.t_ns - log.t_ns[0] + recording.t_ns[0]
        # Seconds in a column are rounded, those since 1970 to 0.24 us.
        assert np.abs(recording.t_ns - t_ns).max() <= (1 if t_ns[0] < 10**17 else 256)
        factor = case.factor or (1.0, 1.0, 1.0)
        np.testing.assert_allclose(recording.dq, log.dq * factor, rtol=case.close, atol=0)
        np.testing.assert_allclose(recording.tau, log.tau, rtol=case.close, atol=0)
        if case.factor:  # the first turn is free
            np.testing.assert_allclose(
                np.diff(recording.q, axis=0), np.diff(log.q, axis=0) * factor, rtol=0, atol=1e-12
            )
        else:
            np.testing.assert_allclose(recording.q, log.q, rtol=case.close, atol=0)
    for words in filter(None, (case.said, case.unused)):
        assert any(re.search(words, line) for line in lines), lines
