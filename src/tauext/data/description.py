"""Description of a robot and its recordings: the meaning of each column, and what the robot file lacks."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import MISSING, dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

from tauext.data.recording import TORQUE_TIMINGS, TorqueTiming
from tauext.data.servo_types import SERVO_TYPES, MotorCalibration, load_lerobot_calibration
from tauext.errors import ConfigError
from tauext.files.toml_file import (
    REQUIRED,
    Key,
    flag,
    number,
    numbers,
    one_of,
    parse_toml,
    read_table,
    read_toml,
    refuse_unknown,
    tables,
    text,
)

Side = Literal["joint", "motor"]
Repeats = Literal["drop", "keep"]
CURRENTS = ("A", "mA")
NORMALISED = "normalised"
"""LeRobot's -100 to 100 over the range of its calibration; 0 to 100 of a gripper."""
TIME_UNITS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}


# --- Tables of an arm.toml: each field is a key; reader and template use its rule, default, example and docstring.


def key(rule: Key | Callable[[int], Key], default: Any = MISSING, example: str = "") -> Any:
    """Make the dataclass field of a key.

    Args:
        rule: how its value is read; a rule that depends on the number of joints is a function of it.
        example: in TOML, for the template; empty: the default.
    """
    return field(default=default, metadata={"rule": rule, "example": example})


def each(of: Key, other: str = "") -> Callable[[int], Key]:
    """Rule for one value for all joints, a list of one a joint, or the word `other`."""

    def of_joints(joints: int) -> Key:
        def read(value: Any) -> tuple[Any, ...] | str:
            if other and value == other:
                return other
            found = tuple(map(of.read, value if isinstance(value, list) else [value] * joints))
            if len(found) not in (0, joints):
                raise ValueError
            return found

        word = f', or "{other}"' if other else ""
        return Key(read, f"{of.rule}, one for all joints or a list of {joints}{word}")

    return of_joints


def listed(of: Key, rule: str, default: Any = (), example: str = "") -> Any:
    """Make the field of a key with one value or a list of them; "" means none."""

    def read(value: Any) -> tuple[str, ...]:
        return tuple(map(of.read, value if isinstance(value, list) else [value] * (value != "")))

    return key(Key(read, rule), default, example)


def _spans(value: Any) -> dict[str, tuple[tuple[float, ...], ...]]:
    found = {
        name: tuple(map(SPAN.read, spans)) for name, spans in tables("[contact.intervals]", {}).read(value).items()
    }
    if not all(first < last for spans in found.values() for first, last in spans):
        raise ValueError
    return found


SPAN = numbers((2,), number())
WORD = text(empty=True)
POSITIVE = number().where(lambda value: value > 0, "a number > 0")
LEAST_0 = number().where(lambda value: value >= 0, "a number >= 0")
NOT_0 = number().where(lambda value: value != 0, "a number, not 0")
SIGN = number().where(lambda value: abs(value) == 1, "1 or -1")
TEXTS = "a text or a list of texts"
NUMBERS = "a number or a list of numbers"


@dataclass(frozen=True)
class RobotTable:
    """Robot file and joints."""

    joints: tuple[str, ...] = listed(text(), "the names of the joints in use, at least one", MISSING)
    """Joints in use, as the robot file names them, from the base on."""
    model: str = key(WORD, "")
    """URDF or MJCF file, relative to this file. "": no model; train then uses the case none."""
    names: tuple[str, ...] = listed(text(), TEXTS, example='["Base", "Shoulder"]')
    """Names of these joints in the recording, where they differ."""
    locked: tuple[str, ...] = listed(text(), TEXTS, example='["finger_joint1"]')
    """Movable joints of the robot file that are not in use. All others but a gripper's must be in use."""
    ignored: tuple[str, ...] = listed(text(), TEXTS, example='["gripper"]')
    """Joints of the recording that are not used. All others but a gripper's must be used."""
    gear_ratio: tuple[float, ...] = key(each(NOT_0), (), "1")
    """Motor turns a joint turn. Used for signals of side "motor" and for the rotor inertia."""
    rotor_inertia_kg_m2: tuple[float, ...] = key(each(LEAST_0), (), "0.0001")
    """Inertia of the motor and everything that turns with it, before the gear; times gear_ratio squared it is the
    joint's. It replaces the robot file's value. Left out: the file's."""
    gravity_m_s2: tuple[float, ...] = key(numbers((0, 3), number(), "three numbers"), (), "[0, 0, -9.81]")
    """Acceleration of free fall in the robot's base frame, for an arm that does not stand upright. Left out: the
    file's."""
    calibration: str = key(WORD, "", '"my_arm.json"')
    """LeRobot's calibration file of the arm, for positions and goals of unit "normalised"."""


@dataclass(frozen=True)
class PayloadTable:
    """Load that the robot file lacks: a tool, a gripper, a sensor."""

    link: str = key(WORD, "", '"tool0"')
    """Link of the robot file that carries the load."""
    mass_kg: float = key(LEAST_0, 0.0)
    com_m: tuple[float, ...] = key(numbers((3,), number(), "three numbers"), (0.0,) * 3)
    """Centre of mass in that link's frame."""
    inertia_kg_m2: tuple[float, ...] = key(numbers((6,), number(), "six numbers: xx, yy, zz, xy, xz, yz"), (0.0,) * 6)
    """Inertia about the centre of mass: xx, yy, zz, xy, xz, yz."""


@dataclass(frozen=True)
class TimeTable:
    """Times of the samples."""

    column: str = key(WORD, "")
    """Column of the sample times. "" for bags and LeRobot folders, which have stamps, or where rate_hz is enough. Bags
    have two clocks, "header" and "log", LeRobot folders "fps" and "timestamp": these names choose one."""
    unit: str = key(one_of(tuple(TIME_UNITS)), "s")
    rate_hz: float = key(number(0, 1e6), 0.0)
    """Nominal rate of the recordings; stamps must agree with it within 2 %. 0: as measured (the median step of the
    first recording)."""
    repeats: Repeats = key(one_of(get_args(Repeats)), "keep")
    """Treatment of rows that repeat all measured values of the row before, for at most 0.1 s. keep: the clock stays
    regular, and a monitor with the same reader gets such rows too. drop: for a reader several times faster than the
    robot's state, where the monitor will get each state once."""


@dataclass(frozen=True)
class SignalTable:
    """A signal's columns and units; SIGNALS lists the keys of each signal."""

    columns: tuple[str, ...] = listed(text(), TEXTS)
    """An array whose elements are the joints ("position"), a pattern with {joint} (name in the recording), {index}
    (from 0) or {number} (from 1), or a list of names."""
    unit: str = key(WORD, "")
    topic: str = key(WORD, "", '"/joint_states"')
    """Topic of a bag, where several are read; signals of several topics are merged by their stamps."""
    side: Side = key(one_of(get_args(Side)), "joint")
    """joint, or motor where it is measured before the gear (then gear_ratio applies)."""
    sign: tuple[float, ...] = key(each(SIGN), (), "1")
    """1, or -1 where the recording's direction is opposite to the robot file's."""
    offset: tuple[float, ...] = key(each(number()), (), "0")
    """Added last, in the signal's unit, where the recording's zero differs from the robot file's."""
    low_pass_hz: float = key(LEAST_0, 20.0)
    """Cut-off of the low-pass of a derived velocity; 0: none. A measured velocity is not filtered."""
    torque_constant: tuple[float, ...] | str = key(each(NOT_0, "unknown"), (), '"unknown"')
    """For currents: Nm/A, at the motor where side = "motor", else at the joint; "unknown": to be fitted."""
    timing: TorqueTiming = key(one_of(TORQUE_TIMINGS), "instant")
    """instant: measured at its stamp. held: commanded, acts from its stamp to the next. averaged: mean over the step
    before."""

    @property
    def is_current(self) -> bool:
        """Whether it is a motor current, [A]."""
        return self.unit in CURRENTS


class Signal(NamedTuple):
    """One table of [signals]."""

    units: dict[str, float]
    """Factor of each unit to rad, rad/s, N m (A for currents), degrees Celsius, V, or 1."""
    keys: tuple[str, ...]
    """Keys of SignalTable that the signal has."""
    help: str


ANGLES = {"rad": 1.0, "deg": math.pi / 180, "normalised": 1.0}
TORQUES = {"Nm": 1.0, "mNm": 1e-3, "kNm": 1e3}
AMPERES = {"A": 1.0, "mA": 1e-3}
MEASURED = ("columns", "topic", "unit")
SIGNED = (*MEASURED, "sign")
SIGNALS = {
    "q": Signal(
        ANGLES,
        (*SIGNED, "side", "offset"),
        "Joint position; normalised: LeRobot's -100 to 100, which needs [robot] calibration.",
    ),
    "dq": Signal(
        {"rad/s": 1.0, "deg/s": math.pi / 180, "rpm": math.pi / 30},
        (*SIGNED, "side", "low_pass_hz"),
        'Joint velocity. Without columns (""): derived from the position, through a first-order low-pass.',
    ),
    "tau": Signal(
        TORQUES | AMPERES,
        (*SIGNED, "side", "torque_constant", "timing"),
        "Motor torque with friction not subtracted, or motor current. Positive where the motor drives the joint in its "
        "positive direction.",
    ),
    "q_des": Signal(ANGLES, (*SIGNED, "side", "offset"), "Commanded position. Optional; keys as of q."),
    "tau_ext": Signal(
        TORQUES,
        SIGNED,
        "External torque as the robot itself estimates it, to compare with; positive where the environment pushes the "
        "joint in its positive direction (sign = -1 reverses it). Optional.",
    ),
    "temperature": Signal({"degC": 1.0}, MEASURED, "Motor temperature. Optional."),
    "current": Signal(
        AMPERES,
        SIGNED,
        "Current as a servo reports it: of its windings or of its supply, see [servo]. Optional.",
    ),
    "duty": Signal(
        {"1": 1.0, "%": 0.01, "permille": 0.001},
        SIGNED,
        "Share of the supply voltage at a servo's motor, from -1 to 1; Feetech: load, Dynamixel: PWM. Optional.",
    ),
    "voltage": Signal({"V": 1.0, "mV": 1e-3}, MEASURED, "Supply voltage of a servo. Optional."),
}


TorqueSource = Literal["torque", "phase-current", "supply-current", "duty", "goal"]
NEEDS = {"phase-current": "current", "supply-current": "current", "duty": "duty", "goal": "q_des"}
"""Signal from which a servo's torque is computed, by its source."""
DELAY = number(0, 0.5)


@dataclass(frozen=True)
class ServoTable:
    """Joints driven by servos: velocity and torque are computed from what servos report, in recordings and live."""

    torque_from: TorqueSource = key(one_of(get_args(TorqueSource)), example='"torque"')
    """torque: [signals.tau]; leave that out for all others. phase-current: [signals.current] is that of the windings,
    signed. supply-current: [signals.current] is what the servo draws, unsigned. duty: [signals.duty]. goal: gain of the
    position loop times goal minus position, [signals.q_des] minus q."""
    type: tuple[str, ...] = listed(
        one_of(tuple(SERVO_TYPES)), f"one of {', '.join(SERVO_TYPES)}, or one a joint", example='"sts3215-7.4v"'
    )
    """Left out: an unknown servo. The constants below are those that the type lacks or that differ from it, all at the
    joint, after the gear."""
    gain: tuple[float, ...] = key(each(POSITIVE), (), "16")
    """P gain of the position controller, in register units."""
    duty_per_rad: tuple[float, ...] = key(each(POSITIVE), (), "2.7")
    """Duty a rad of position error; replaces gain."""
    most_duty: tuple[float, ...] = key(
        each(POSITIVE.where(lambda duty: duty <= 1, "a number > 0, at most 1")), (), "0.97"
    )
    """Largest duty that its registers allow; LeRobot halves a Feetech gripper's (Max_Torque_Limit = 500)."""
    voltage_v: tuple[float, ...] = key(each(POSITIVE), (), "7.4")
    """Supply voltage where there is no [signals.voltage]."""
    ohm: tuple[float, ...] = key(each(POSITIVE), (), "2.75")
    """Resistance of the windings."""
    back_emf_v_s: tuple[float, ...] = key(each(LEAST_0), (), "1.28")
    """Back-EMF constant, V s/rad."""
    torque_constant: tuple[float, ...] | str = key(each(number(), "unknown"), (), '"unknown"')
    """Torque constant, Nm/A, or "unknown": to be fitted."""
    counts_a_turn: tuple[float, ...] = key(each(POSITIVE), (), "4096")
    """Step of the encoder; left out: the type's, else found in the recordings."""
    velocity_window_s: float = key(number(0, 2), 0.2)
    """Longest time span for deriving the velocity; 0: the velocity is [signals.dq]."""
    goal_delay_s: float | str = key(
        Key(lambda value: value if value == "period" else DELAY.read(value), f'{DELAY.rule}, or "period"'), "period"
    )
    """Delay from a goal's stamp until it acts. "period": one sample period, since most loops read the position and then
    send the goal, which moves the next position first."""
    timing: TorqueTiming = key(one_of(TORQUE_TIMINGS), "held")
    """Timing of the torque, as in [signals.tau]."""


@dataclass(frozen=True)
class ContactTable:
    """Labels of contacts."""

    column: str = key(WORD, "")
    """Column that marks whether the arm is touched. "": none."""
    topic: str = key(WORD, "", '"/touch"')
    """Topic of that column, where several are read."""
    contact_values: tuple[float, ...] = listed(number(), NUMBERS, (1.0,))
    """Values that mean contact."""
    free_values: tuple[float, ...] = listed(number(), NUMBERS, (0.0,))
    """Values that mean free; all others mean unknown."""
    intervals: dict[str, tuple[tuple[float, float], ...]] = field(
        default_factory=dict,
        metadata={
            "rule": Key(_spans, "a table of lists [[t0, t1], ...], t0 < t1"),
            "example": '{"run2.bag" = [[40.7, 41.0]]}',
        },
    )
    """Contacts by file where there is no label, in s after its first sample."""
    before_s: float = key(LEAST_0, 0.5)
    """Time cut out before each contact in training, validation, test and calibration."""
    after_s: float = key(LEAST_0, 1.0)
    """Time cut out after each contact."""
    cut: bool = key(flag(), True)
    """false: recordings keep their contacts, for short free times between them. Training and limits still leave
    labelled contacts out (--margins of train)."""


@dataclass(frozen=True)
class SplitTable:
    """Sets of the recordings, by file name or a part in s after its first sample: "run2.bag[0:40]". Left out:
    recordings with contacts go to collisions, the others are split whole (6 or more) or each by time."""

    train: tuple[str, ...] = listed(text(), TEXTS, example='["run1.bag"]')
    validation: tuple[str, ...] = listed(text(), TEXTS)
    """Empty: train finds limits on parts of the training motion, each left out of a fit."""
    test: tuple[str, ...] = listed(text(), TEXTS, example='["run2.bag[0:40]"]')
    collisions: tuple[str, ...] = listed(text(), TEXTS, example='["run2.bag[40:]"]')
    calibration: tuple[str, ...] = listed(text(), TEXTS)
    """Free motion for limits only."""
    gap_s: float = key(LEAST_0, 2.0)
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
        for name in ("joints", "names", "locked", "ignored"):
            listed = getattr(robot, name)
            self._require(len(set(listed)) == len(listed), "robot", name, list(listed), "names that differ")
        self._require(bool(robot.joints), "robot", "joints", [], "the names of the joints in use, at least one")
        self._check_count("robot", "names", robot.names)
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
        if not self.robot.model:
            return None
        return self.path.parent / self.robot.model

    @property
    def topics(self) -> tuple[str, ...]:
        """All topics named, without repeats."""
        named = [*(signal.topic for signal in self.signals.values()), self.contact.topic]
        return tuple(dict.fromkeys(topic for topic in named if topic))

    @cached_property
    def motors(self) -> tuple[MotorCalibration, ...]:
        """Calibrations of the joints' motors; the recording's names may end in `.pos`.

        Raises:
            ConfigError: no such file, no LeRobot calibration file, or a joint is missing in it.
        """
        path = self.path.parent / self.robot.calibration
        listed = load_lerobot_calibration(path)
        for name in self.names:
            if name.removesuffix(".pos") not in listed:
                raise ConfigError(
                    f"{path}: it has no motor '{name.removesuffix('.pos')}', which {self.path} names; "
                    f"it has {', '.join(listed)}"
                )
        return tuple(listed[name.removesuffix(".pos")] for name in self.names)

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
        if len(signal.columns) > 1:
            self._check_count(table, "columns", signal.columns)
        if name != "tau":
            return
        constant = signal.torque_constant
        if signal.is_current:
            rule = 'Nm/A, one a joint, or "unknown" (to be fitted), since the unit is a current\'s'
            self._require(bool(constant), table, "torque_constant", list(constant), rule)
        else:
            rule = f"left out, since the unit is {signal.unit}"
            self._require(not constant, table, "torque_constant", constant, rule)

    @property
    def makes_torque(self) -> bool:
        """Whether the torque is computed from servo signals instead of read from a column."""
        return self.servo is not None and self.servo.torque_from != "torque"

    def _check_servo(self, servo: ServoTable) -> None:
        if len(servo.type) > 1:
            self._check_count("servo", "type", servo.type)
        if servo.torque_from == "torque":
            return
        needed = NEEDS[servo.torque_from]
        if needed not in self.signals:
            raise ConfigError(
                f"{self.path}: [servo] torque_from = '{servo.torque_from}' needs [signals.{needed}], which is missing"
            )
        if self.signals["tau"].columns:
            raise ConfigError(
                f"{self.path}: [signals.tau] must be left out, since [servo] torque_from = '{servo.torque_from}' "
                "makes it"
            )
        if servo.torque_from == "supply-current" and not {"q_des", "duty"} & set(self.signals):
            raise ConfigError(
                f"{self.path}: [servo] torque_from = 'supply-current' has no sign: it uses that of [signals.duty], or "
                "of goal minus position, [signals.q_des]; both are missing"
            )

    def _check_count(self, table: str, key: str, values: tuple) -> None:
        joints = len(self.robot.joints)
        self._require(len(values) in (0, joints), table, key, list(values), f"as many as joints, {joints}")

    def _require(self, ok: bool, table: str, key: str, value: object, rule: str) -> None:
        if not ok:
            raise ConfigError(f"{self.path}: [{table}] {key} = {value} must be {rule}")


# --- The file.


TABLES = {
    "robot": RobotTable, "payload": PayloadTable, "time": TimeTable, "servo": ServoTable, "contact": ContactTable,
    "split": SplitTable,
}  # fmt: skip


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


def _expect_confirmed(content: dict[str, Any], path: Path) -> None:
    """Raise ConfigError where a guess of the template is neither confirmed nor replaced."""
    entries = open_entries(content)
    if entries:
        raise ConfigError(
            f"{path}: {'; '.join(entries)}: the comment above each gives its evidence; remove the '{GUESSED}' where "
            "the guess is right, else replace it"
        )


def _arm(content: dict[str, Any], path: Path, calibration: Path | None = None) -> Arm:
    _expect_confirmed(content, path)
    top: dict[str, Key] = {name: tables(f"[{name}]", None) for name in ("robot", *TABLES, "signals")}
    given = {name: table for name, table in read_table(path, "", content, top).items() if table is not None}
    if "robot" not in given:
        raise ConfigError(f"{path}: the table [robot] is missing")
    joints = given["robot"].get("joints", [])
    count = len(joints) if isinstance(joints, list) else 1
    signals = given.pop("signals", {})
    refuse_unknown(path, "[signals]", signals, SIGNALS)
    read = {name: _table(path, name, TABLES[name], table, count) for name, table in given.items()}
    read["signals"] = {
        name: _table(path, f"signals.{name}", SignalTable, signals[name], count, name)
        for name in SIGNALS
        if name in signals
    }
    read["signals"].setdefault("dq", SignalTable((), "rad/s"))
    if calibration is not None:
        read["robot"] = replace(read["robot"], calibration=str(calibration.absolute()))
    servo = read.get("servo")
    if servo is not None and servo.torque_from != "torque" and "tau" not in signals:
        read["signals"]["tau"] = _made_torque(servo, count)
    return Arm(**read, path=path)


def _table(path: Path, name: str, kind: type, content: Any, joints: int, signal: str = "") -> Any:
    """Read a table into its dataclass; a signal's has the keys and units of that signal."""
    keys = {}
    for one in fields(kind):
        rule = one.metadata["rule"]
        default = REQUIRED if one.default is MISSING and one.default_factory is MISSING else one.default
        keys[one.name] = (rule if isinstance(rule, Key) else rule(joints))._replace(default=default)
    if signal:
        units = tuple(SIGNALS[signal].units)
        keys = {key: keys[key] for key in SIGNALS[signal].keys} | {"unit": one_of(units, units[0])}
    values = read_table(path, f"[{name}]", content, keys)
    return kind(**{key: value for key, value in values.items() if value is not MISSING})


def _made_torque(servo: ServoTable, joints: int) -> SignalTable:
    """Table of a torque computed from servo signals, as if read from a column; in A without a torque constant."""
    known = servo.torque_constant or tuple(SERVO_TYPES[name].nm_per_ampere or 0.0 for name in servo.type)
    known = known * joints if len(known) == 1 and not isinstance(known, str) else known
    constant = "unknown" if not known or isinstance(known, str) or 0.0 in known else known
    return SignalTable((), "A", torque_constant=constant, timing=servo.timing)
