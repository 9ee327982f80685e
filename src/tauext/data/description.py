"""Description of a robot and its recordings: the meaning of each column, and what the robot file lacks."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from tauext import plugins
from tauext.config import AT_LEAST_0, NOT_0, NOT_EMPTY, Rule, above, within
from tauext.data.recording import TorqueTiming
from tauext.data.servo_types import SERVO_TYPES
from tauext.errors import ConfigError
from tauext.files.plain_file import parse_toml, read_toml
from tauext.files.typed_table import EachJoint, Example, OneOrMore, Text, expect_known, read_table

if TYPE_CHECKING:
    import numpy as np

Side = Literal["joint", "motor"]
Repeats = Literal["drop", "keep"]
NORMALISED = "normalised"
"""LeRobot's -100 to 100 over the range of its calibration; 0 to 100 of a gripper."""
TIME_UNITS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}


# --- Tables of an arm.toml: reader and template use the annotation, default and docstring of each key.


DIFFERENT = Rule(", names that differ", lambda names: len(set(names)) == len(names))
Names = Annotated[OneOrMore[Text], DIFFERENT]
NotZero = Annotated[float, NOT_0]
AtLeast0 = Annotated[float, AT_LEAST_0]
Positive = Annotated[float, above(0)]
Sign = Literal[1, -1]
Vector = Annotated[tuple[float, ...], Rule(", three of them", lambda value: len(value) in (0, 3))]
Span = Annotated[tuple[float, float], Rule(", [t0, t1] with t0 < t1", lambda span: span[0] < span[1])]


@dataclass(frozen=True)
class RobotTable:
    """Robot file and joints."""

    joints: Annotated[Names, NOT_EMPTY]
    """Joints in use, as the robot file names them, from the base on."""
    model: str = ""
    """URDF or MJCF file, relative to this file. "": no model; train then uses the case none."""
    names: Annotated[EachJoint[Text], DIFFERENT, Example('["Base", "Shoulder"]')] = ()
    """Names of these joints in the recording, where they differ."""
    locked: Annotated[Names, Example('["finger_joint1"]')] = ()
    """Movable joints of the robot file that are not in use. All others but a gripper's must be in use."""
    ignored: Annotated[Names, Example('["gripper"]')] = ()
    """Joints of the recording that are not used. All others but a gripper's must be used."""
    gear_ratio: Annotated[EachJoint[NotZero], Example("1")] = ()
    """Motor turns a joint turn. Used for signals of side "motor" and for the rotor inertia."""
    rotor_inertia_kg_m2: Annotated[EachJoint[AtLeast0], Example("0.0001")] = ()
    """Inertia of the motor and everything that turns with it, before the gear; times gear_ratio squared it is the
    joint's. It replaces the robot file's value. Left out: the file's."""
    gravity_m_s2: Annotated[Vector, Example("[0, 0, -9.81]")] = ()
    """Acceleration of free fall in the robot's base frame, for an arm that does not stand upright. Left out: the
    file's."""
    calibration: Annotated[str, Example('"my_arm.json"')] = ""
    """LeRobot's calibration file of the arm, for positions and goals of unit "normalised"."""


@dataclass(frozen=True)
class PayloadTable:
    """Load that the robot file lacks: a tool, a gripper, a sensor."""

    link: Annotated[str, Example('"tool0"')] = ""
    """Link of the robot file that carries the load."""
    mass_kg: AtLeast0 = 0.0
    com_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Centre of mass in that link's frame."""
    inertia_kg_m2: tuple[float, float, float, float, float, float] = (0.0,) * 6
    """Inertia about the centre of mass: xx, yy, zz, xy, xz, yz."""


@dataclass(frozen=True)
class TimeTable:
    """Times of the samples."""

    column: str = ""
    """Column of the sample times. "" for bags and LeRobot folders, which have stamps, or where rate_hz is enough. Bags
    have two clocks, "header" and "log", LeRobot folders "fps" and "timestamp": these names choose one."""
    unit: Literal["s", "ms", "us", "ns"] = "s"
    rate_hz: Annotated[float, within(0, 1e6)] = 0.0
    """Nominal rate of the recordings; stamps must agree with it within 2 %. 0: as measured (the median step of the
    first recording)."""
    repeats: Repeats = "keep"
    """Treatment of rows that repeat all measured values of the row before, for at most 0.1 s. keep: the clock stays
    regular, and a monitor with the same reader gets such rows too. drop: for a reader several times faster than the
    robot's state, where the monitor will get each state once."""


@dataclass(frozen=True)
class SignalTable:
    """A signal's columns and units; SIGNALS lists the keys of each signal."""

    columns: OneOrMore[Text] = ()
    """An array whose elements are the joints ("position"), a pattern with {joint} (name in the recording), {index}
    (from 0) or {number} (from 1), or a list of names."""
    unit: str = ""
    topic: Annotated[str, Example('"/joint_states"')] = ""
    """Topic of a bag, where several are read; signals of several topics are merged by their stamps."""
    side: Side = "joint"
    """joint, or motor where it is measured before the gear (then gear_ratio applies)."""
    sign: Annotated[EachJoint[Sign], Example("1")] = ()
    """1, or -1 where the recording's direction is opposite to the robot file's."""
    offset: Annotated[EachJoint[float], Example("0")] = ()
    """Added last, in the signal's unit, where the recording's zero differs from the robot file's."""
    low_pass_hz: AtLeast0 = 20.0
    """Cut-off of the low-pass of a derived velocity; 0: none. A measured velocity is not filtered."""
    torque_constant: Annotated[EachJoint[NotZero] | Literal["unknown"], Example('"unknown"')] = ()
    """For currents: Nm/A, at the motor where side = "motor", else at the joint; "unknown": to be fitted."""
    timing: TorqueTiming = "instant"
    """instant: measured at its stamp. held: commanded, acts from its stamp to the next. averaged: mean over the step
    before."""

    @property
    def is_current(self) -> bool:
        """Whether it is a motor current, [A]."""
        return self.unit in _AMPERES


class Signal(NamedTuple):
    """One table of [signals]."""

    units: dict[str, float]
    """Factor of each unit to rad, rad/s, N m (A for currents), degrees Celsius, V, or 1."""
    keys: tuple[str, ...]
    """Keys of SignalTable that the signal has."""
    help: str


_ANGLES = {"rad": 1.0, "deg": math.pi / 180, "normalised": 1.0}
_TORQUES = {"Nm": 1.0, "mNm": 1e-3, "kNm": 1e3}
_AMPERES = {"A": 1.0, "mA": 1e-3}
_MEASURED = ("columns", "topic", "unit")
_SIGNED = (*_MEASURED, "sign")
SIGNALS = {
    "q": Signal(
        _ANGLES,
        (*_SIGNED, "side", "offset"),
        "Joint position; normalised: LeRobot's -100 to 100, which needs [robot] calibration.",
    ),
    "dq": Signal(
        {"rad/s": 1.0, "deg/s": math.pi / 180, "rpm": math.pi / 30},
        (*_SIGNED, "side", "low_pass_hz"),
        'Joint velocity. Without columns (""): derived from the position, through a first-order low-pass.',
    ),
    "tau": Signal(
        _TORQUES | _AMPERES,
        (*_SIGNED, "side", "torque_constant", "timing"),
        "Motor torque with friction not subtracted, or motor current. Positive where the motor drives the joint in its "
        "positive direction.",
    ),
    "q_des": Signal(_ANGLES, (*_SIGNED, "side", "offset"), "Commanded position. Optional; keys as of q."),
    "tau_ext": Signal(
        _TORQUES,
        _SIGNED,
        "External torque as the robot itself estimates it, to compare with; positive where the environment pushes the "
        "joint in its positive direction (sign = -1 reverses it). Optional.",
    ),
    "temperature": Signal({"degC": 1.0}, _MEASURED, "Motor temperature. Optional."),
    "current": Signal(
        _AMPERES, _SIGNED, "Current as a servo reports it: of its windings or of its supply, see [servo]. Optional."
    ),
    "duty": Signal(
        {"1": 1.0, "%": 0.01, "permille": 0.001},
        _SIGNED,
        "Share of the supply voltage at a servo's motor, from -1 to 1; Feetech: load, Dynamixel: PWM. Optional.",
    ),
    "voltage": Signal({"V": 1.0, "mV": 1e-3}, _MEASURED, "Supply voltage of a servo. Optional."),
}


if TYPE_CHECKING:
    ServoName = str
else:
    ServoName = Literal[tuple(SERVO_TYPES)]
TorqueSource = Literal["torque", "phase-current", "supply-current", "duty", "goal"]
NEEDS = {"phase-current": "current", "supply-current": "current", "duty": "duty", "goal": "q_des"}
"""Signal from which a servo's torque is computed, by its source."""


@dataclass(frozen=True)
class ServoTable:
    """Joints driven by servos: velocity and torque are computed from what servos report, in recordings and live."""

    torque_from: Annotated[TorqueSource, Example('"torque"')]
    """torque: [signals.tau]; leave that out for all others. phase-current: [signals.current] is that of the windings,
    signed. supply-current: [signals.current] is what the servo draws, unsigned. duty: [signals.duty]. goal: gain of the
    position loop times goal minus position, [signals.q_des] minus q."""
    type: Annotated[EachJoint[ServoName], Example('"sts3215-7.4v"')] = ()
    """Left out: an unknown servo. The constants below are those that the type lacks or that differ from it, all at the
    joint, after the gear."""
    gain: Annotated[EachJoint[Positive], Example("16")] = ()
    """P gain of the position controller, in register units."""
    duty_per_rad: Annotated[EachJoint[Positive], Example("2.7")] = ()
    """Duty a rad of position error; replaces gain."""
    most_duty: Annotated[EachJoint[Annotated[float, above(0, 1)]], Example("0.97")] = ()
    """Largest duty that its registers allow; LeRobot halves a Feetech gripper's (Max_Torque_Limit = 500)."""
    voltage_v: Annotated[EachJoint[Positive], Example("7.4")] = ()
    """Supply voltage where there is no [signals.voltage]."""
    ohm: Annotated[EachJoint[Positive], Example("2.75")] = ()
    """Resistance of the windings."""
    back_emf_v_s: Annotated[EachJoint[AtLeast0], Example("1.28")] = ()
    """Back-EMF constant, V s/rad."""
    torque_constant: Annotated[EachJoint[float] | Literal["unknown"], Example('"unknown"')] = ()
    """Torque constant, Nm/A, or "unknown": to be fitted."""
    counts_a_turn: Annotated[EachJoint[Positive], Example("4096")] = ()
    """Step of the encoder; left out: the type's, else found in the recordings."""
    velocity_window_s: Annotated[float, within(0, 2)] = 0.2
    """Longest time span for deriving the velocity; 0: the velocity is [signals.dq]."""
    goal_delay_s: Annotated[float, within(0, 0.5)] | Literal["period"] = "period"
    """Delay from a goal's stamp until it acts. "period": one sample period, since most loops read the position and then
    send the goal, which moves the next position first."""
    timing: TorqueTiming = "held"
    """Timing of the torque, as in [signals.tau]."""


@dataclass(frozen=True)
class ContactTable:
    """Labels of contacts."""

    column: str = ""
    """Column that marks whether the arm is touched. "": none."""
    topic: Annotated[str, Example('"/touch"')] = ""
    """Topic of that column, where several are read."""
    contact_values: OneOrMore[float] = (1.0,)
    """Values that mean contact."""
    free_values: OneOrMore[float] = (0.0,)
    """Values that mean free; all others mean unknown."""
    intervals: Annotated[dict[str, tuple[Span, ...]], Example('{"run2.bag" = [[40.7, 41.0]]}')] = field(
        default_factory=dict
    )
    """Contacts by file where there is no label, in s after its first sample."""
    before_s: AtLeast0 = 0.5
    """Time cut out before each contact in training, validation, test and calibration."""
    after_s: AtLeast0 = 1.0
    """Time cut out after each contact."""
    cut: bool = True
    """false: recordings keep their contacts, for short free times between them. Training and limits still leave
    labelled contacts out (--margins of train)."""


@dataclass(frozen=True)
class SplitTable:
    """Sets of the recordings, by file name or a part in s after its first sample: "run2.bag[0:40]". Left out:
    recordings with contacts go to collisions, the others are split whole (6 or more) or each by time."""

    train: Annotated[OneOrMore[Text], Example('["run1.bag"]')] = ()
    validation: OneOrMore[Text] = ()
    """Empty: train finds limits on parts of the training motion, each left out of a fit."""
    test: Annotated[OneOrMore[Text], Example('["run2.bag[0:40]"]')] = ()
    collisions: Annotated[OneOrMore[Text], Example('["run2.bag[40:]"]')] = ()
    calibration: OneOrMore[Text] = ()
    """Free motion for limits only."""
    gap_s: AtLeast0 = 2.0
    """Gap between two parts of one recording."""

    @property
    def named(self) -> bool:
        """Whether any recording is named."""
        return bool(self.train or self.validation or self.test or self.collisions or self.calibration)


@dataclass(frozen=True)
class Arm:
    """Description of a robot and its recordings, validated when made. Lists run over `robot.joints`.

    Raises:
        ConfigError: names the table, the key, the value and the rule.
    """

    robot: RobotTable
    signals: dict[str, SignalTable]
    payload: PayloadTable = PayloadTable()
    time: TimeTable = TimeTable()
    contact: ContactTable = field(default_factory=ContactTable)
    split: SplitTable = SplitTable()
    servo: ServoTable | None = None
    path: Path = Path("arm.toml")
    """File of the description; the robot model's path is relative to it."""

    def __post_init__(self) -> None:
        robot, payload = self.robot, self.payload
        for name, used in (("locked", robot.joints), ("ignored", self.names)):
            both = [one for one in getattr(robot, name) if one in used]
            self._require(not both, "robot", name, both, "joints that are not in use")
        if payload.mass_kg:
            self._require(bool(robot.model), "robot", "model", "''", "a robot file, where there is a payload")
            self._require(bool(payload.link), "payload", "link", "''", "the link that carries the payload")
        for name in ("q", "tau"):
            if name not in self.signals:
                raise ConfigError(f"{self.path}: [signals.{name}] is missing; position and torque are needed")
        if self.servo is not None:
            self._check_servo(self.servo)
        for name, signal in self.signals.items():
            self._check_signal(name, signal)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints in the recording."""
        return self.robot.names or self.robot.joints

    @property
    def gear_ratio(self) -> tuple[float, ...]:
        """Motor turns a joint turn, one a joint."""
        return self.robot.gear_ratio or (1.0,) * len(self.robot.joints)

    @property
    def model(self) -> Path | None:
        """The robot file; None: there is no model."""
        return self.path.parent / self.robot.model if self.robot.model else None

    @property
    def topics(self) -> tuple[str, ...]:
        """All topics named, without repeats."""
        named = [*(signal.topic for signal in self.signals.values()), self.contact.topic]
        return tuple(dict.fromkeys(topic for topic in named if topic))

    @cached_property
    def radians_of_normalised(self) -> Callable[[np.ndarray, bool], np.ndarray]:
        """Converts LeRobot's normalised positions or, if sent, goals (samples, joints) to angles [rad].

        Raises:
            ConfigError: the package for LeRobot is not installed, or the calibration file does not fit.
        """
        return plugins.part("lerobot-calibration")(self)

    def _check_signal(self, name: str, signal: SignalTable) -> None:
        table = f"signals.{name}"
        if signal.unit == NORMALISED and not self.robot.calibration:
            raise ConfigError(
                f"{self.path}: [{table}] unit = '{NORMALISED}': values from -100 to 100 are angles only with the arm's "
                "LeRobot calibration file: name it in [robot] calibration, or with --calibration of `tauext label`; "
                "LeRobot keeps it below ~/.cache/huggingface/lerobot/calibration/robots"
            )
        none = not signal.columns
        derived = name == "dq" or (name == "tau" and self.makes_torque)
        self._require(not none or derived, table, "columns", "''", "given (only a velocity can be derived)")
        joints = len(self.robot.joints)
        counts = len(signal.columns) in (0, 1, joints)
        self._require(counts, table, "columns", list(signal.columns), f"as many as joints, {joints}")
        if name != "tau":
            return
        constant: Any = signal.torque_constant
        rule = f"left out, since the unit is {signal.unit}"
        if signal.is_current:
            rule = 'Nm/A, one a joint, or "unknown" (to be fitted), since the unit is a current\'s'
            constant = list(constant)
        self._require(bool(constant) == signal.is_current, table, "torque_constant", constant, rule)

    @property
    def makes_torque(self) -> bool:
        """Whether the torque is computed from servo signals instead of read from a column."""
        return self.servo is not None and self.servo.torque_from != "torque"

    def _check_servo(self, servo: ServoTable) -> None:
        if servo.torque_from == "torque":
            return
        needed, chosen = NEEDS[servo.torque_from], f"[servo] torque_from = '{servo.torque_from}'"
        if needed not in self.signals:
            raise ConfigError(f"{self.path}: {chosen} needs [signals.{needed}], which is missing")
        if self.signals["tau"].columns:
            raise ConfigError(f"{self.path}: [signals.tau] must be left out, since {chosen} makes it")
        if servo.torque_from == "supply-current" and not {"q_des", "duty"} & set(self.signals):
            raise ConfigError(
                f"{self.path}: {chosen} has no sign: it uses that of [signals.duty], or of goal minus position, "
                "[signals.q_des]; both are missing"
            )

    def _require(self, ok: bool, table: str, key: str, value: object, rule: str) -> None:
        if not ok:
            raise ConfigError(f"{self.path}: [{table}] {key} = {value} must be {rule}")


# --- The file.


_KINDS = (RobotTable, PayloadTable, TimeTable, ServoTable, ContactTable, SplitTable)
TABLES: dict[str, type] = {kind.__name__.removesuffix("Table").lower(): kind for kind in _KINDS}


def load_arm(path: Path | str, calibration: Path | None = None) -> Arm:
    """Read an arm.toml.

    Args:
        calibration: LeRobot's calibration file; replaces the one named in the file.

    Raises:
        ConfigError: no such file, not TOML, an unknown key (the nearest known one is named), a value of the wrong type
            or against its rule.
    """
    path = Path(path)
    return _arm(read_toml(path, f"`tauext import --new {path}` writes a template"), path, calibration)


def parse_arm(content: str, path: Path | str = "arm.toml") -> Arm:
    """Parse the text of an arm.toml, as load_arm()."""
    path = Path(path)
    return _arm(parse_toml(content, path), path)


GUESSED = "?"
"""First character of an entry that a person must confirm, by removing the character, or fill in."""


def open_entries(content: Any, table: str = "", key: str = "") -> list[str]:
    """The entries that are marked as guesses, each with its table and key."""
    if isinstance(content, dict):
        tables = {name: f"{table}.{key}".strip(".") for name in content}
        return [entry for name, value in content.items() for entry in open_entries(value, tables[name], name)]
    if isinstance(content, list):
        return [entry for value in content for entry in open_entries(value, table, key)]
    guessed = isinstance(content, str) and content.startswith(GUESSED)
    return [f"[{table}] {key} has '{content}'"] if guessed else []


def _arm(content: dict[str, Any], path: Path, calibration: Path | None = None) -> Arm:
    if entries := open_entries(content):
        raise ConfigError(
            f"{path}: {'; '.join(entries)}: the comment above each gives its evidence; remove the '{GUESSED}' where "
            "the guess is right, else replace it"
        )
    expect_known(f"{path}:", content, (*TABLES, "signals"))
    signals = content.pop("signals", {})
    if "robot" not in content:
        raise ConfigError(f"{path}: the table [robot] is missing")
    expect_known(f"{path}: [signals]", signals, SIGNALS)
    robot = content["robot"]
    joints = robot.get("joints", []) if isinstance(robot, dict) else []
    joints = joints if isinstance(joints, list) else [joints]
    tables = {name: (TABLES[name], table, f"{path}: [{name}]", joints) for name, table in content.items()}
    read: dict[str, Any] = {name: read_table(*how) for name, how in tables.items()}
    given = {name: signals[name] for name in SIGNALS if name in signals}
    found = {name: _signal(name, table, f"{path}: [signals.{name}]", joints) for name, table in given.items()}
    found.setdefault("dq", SignalTable((), "rad/s"))
    if calibration is not None:
        read["robot"] = replace(read["robot"], calibration=str(calibration.absolute()))
    servo = read.get("servo")
    if servo is not None and servo.torque_from != "torque" and "tau" not in found:
        found["tau"] = _made_torque(servo)
    return Arm(**read, signals=found, path=path)


def _signal(name: str, content: Any, where: str, joints: Sequence[str]) -> SignalTable:
    """The table of a signal, which has the keys and units of that signal."""
    table = read_table(SignalTable, content, where, joints, SIGNALS[name].keys)
    units = list(SIGNALS[name].units)
    if "unit" in content and table.unit not in units:
        raise ConfigError(f"{where} unit = {table.unit!r} must be one of {', '.join(units)}")
    return replace(table, unit=table.unit or units[0])


def _made_torque(servo: ServoTable) -> SignalTable:
    """Table of a torque computed from servo signals, as if read from a column; in A without a torque constant."""
    known = servo.torque_constant or tuple(SERVO_TYPES[name].nm_per_ampere or 0.0 for name in servo.type)
    constant: Any = "unknown" if not known or isinstance(known, str) or 0.0 in known else known
    return SignalTable((), "A", torque_constant=constant, timing=servo.timing)
