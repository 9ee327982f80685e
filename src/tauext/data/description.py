"""A robot and how its recordings are to be read: what each column is, and what the robot file does not say."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

from tauext.data.recording import TorqueTiming
from tauext.data.servo_types import SERVO_TYPES, MotorCalibration, load_lerobot_calibration
from tauext.errors import ConfigError
from tauext.files.copies import local_robot
from tauext.files.places import Place, place_of

Side = Literal["joint", "motor"]
Repeats = Literal["drop", "keep"]
UNITS: dict[str, dict[str, float]] = {
    "q": {"rad": 1.0, "deg": math.pi / 180, "normalised": 1.0},
    "dq": {"rad/s": 1.0, "deg/s": math.pi / 180, "rpm": math.pi / 30},
    "tau": {"Nm": 1.0, "mNm": 1e-3, "kNm": 1e3, "A": 1.0, "mA": 1e-3},
    "tau_ext": {"Nm": 1.0, "mNm": 1e-3, "kNm": 1e3},
    "q_des": {"rad": 1.0, "deg": math.pi / 180, "normalised": 1.0},
    "temperature": {"degC": 1.0},
    "current": {"A": 1.0, "mA": 1e-3},
    "duty": {"1": 1.0, "%": 0.01, "permille": 0.001},
    "voltage": {"V": 1.0, "mV": 1e-3},
}
"""Units of each signal, and what one of them is in rad, rad/s, N m (A for currents), degrees Celsius, V, or 1."""
CURRENTS = ("A", "mA")
NORMALISED = "normalised"
"""LeRobot's -100 to 100 over the range of its calibration; 0 to 100 of a gripper."""
TIME_UNITS = {"s": 1e9, "ms": 1e6, "us": 1e3, "ns": 1.0}


@dataclass(frozen=True)
class RobotTable:
    """[robot]"""

    joints: tuple[str, ...]
    model: str = ""
    names: tuple[str, ...] = ()
    gear_ratio: tuple[float, ...] = ()
    rotor_inertia_kg_m2: tuple[float, ...] = ()
    gravity_m_s2: tuple[float, ...] = ()
    calibration: str = ""
    """LeRobot's calibration file of the arm, for positions that are normalised."""


@dataclass(frozen=True)
class PayloadTable:
    """[payload]"""

    link: str = ""
    mass_kg: float = 0.0
    com_m: tuple[float, ...] = (0.0, 0.0, 0.0)
    inertia_kg_m2: tuple[float, ...] = (0.0,) * 6


@dataclass(frozen=True)
class TimeTable:
    """[time]"""

    column: str = ""
    unit: str = "s"
    rate_hz: float = 0.0
    repeats: Repeats = "keep"


@dataclass(frozen=True)
class SignalTable:
    """[signals.NAME]; which of the keys a signal has is in KEYS."""

    columns: tuple[str, ...]
    """One name that stands for all joints, or one a joint; none: the velocity is derived from the position."""
    unit: str
    topic: str = ""
    side: Side = "joint"
    sign: tuple[float, ...] = ()
    offset: tuple[float, ...] = ()
    low_pass_hz: float = 20.0
    torque_constant: tuple[float, ...] | str = ()
    """[N m/A] a joint, or "unknown"."""
    timing: TorqueTiming = "instant"

    @property
    def is_current(self) -> bool:
        """Whether it is a motor current, [A]."""
        return self.unit in CURRENTS


TorqueSource = Literal["torque", "phase-current", "supply-current", "duty", "goal"]
NEEDS = {"phase-current": "current", "supply-current": "current", "duty": "duty", "goal": "q_des"}
"""The signal that a servo's torque is made of, by its source."""


@dataclass(frozen=True)
class ServoTable:
    """[servo]: joints are driven by servos, and what these report is turned into velocity and torque."""

    torque_from: TorqueSource
    type: tuple[str, ...] = ()
    """Of SERVO_TYPES, one that stands for all joints or one a joint; none: a servo nobody knows."""
    gain: tuple[float, ...] = ()
    """P gain of the position controller, in the servo's own unit; none: what its type usually has."""
    duty_per_rad: tuple[float, ...] = ()
    """Duty a rad of position error, in place of `gain`."""
    most_duty: tuple[float, ...] = ()
    """Largest duty that the servo's registers allow, at most 1; none: the type's."""
    voltage_v: tuple[float, ...] = ()
    """Of the supply, where no signal says it; none: the type's."""
    ohm: tuple[float, ...] = ()
    back_emf_v_s: tuple[float, ...] = ()
    torque_constant: tuple[float, ...] | str = ()
    """[N m/A] a joint, or "unknown"; none: the type's."""
    counts_a_turn: tuple[float, ...] = ()
    """Of the encoder; none: the type's, or else as the recordings show."""
    velocity_window_s: float = 0.2
    """Longest stretch that a velocity is derived from, [s]; 0: the velocity is taken as measured."""
    goal_delay_s: float | str = "period"
    """A goal acts so long after its stamp, [s]; "period": one sample period, since most loops read the position first
    and send the goal then, so that the next position is the first that it moves."""
    timing: TorqueTiming = "held"
    """Of the torque."""


COMMON = ("columns", "topic", "unit", "sign")
KEYS = {
    "q": (*COMMON, "side", "offset"),
    "dq": (*COMMON, "side", "low_pass_hz"),
    "tau": (*COMMON, "side", "torque_constant", "timing"),
    "tau_ext": COMMON,
    "q_des": (*COMMON, "side", "offset"),
    "temperature": ("columns", "topic", "unit"),
    "current": COMMON,
    "duty": COMMON,
    "voltage": ("columns", "topic", "unit"),
}
"""Keys of each table of [signals]."""


@dataclass(frozen=True)
class ContactTable:
    """[contact]"""

    column: str = ""
    topic: str = ""
    contact_values: tuple[float, ...] = (1.0,)
    free_values: tuple[float, ...] = (0.0,)
    intervals: dict[str, tuple[tuple[float, float], ...]] = field(default_factory=dict)
    before_s: float = 0.5
    after_s: float = 1.0
    cut: bool = True


@dataclass(frozen=True)
class SplitTable:
    """[split]"""

    train: tuple[str, ...] = ()
    validation: tuple[str, ...] = ()
    test: tuple[str, ...] = ()
    collisions: tuple[str, ...] = ()
    calibration: tuple[str, ...] = ()
    gap_s: float = 2.0

    @property
    def named(self) -> bool:
        """Whether any recording is named."""
        return bool(self.train or self.validation or self.test or self.collisions or self.calibration)


@dataclass(frozen=True)
class Arm:
    """A robot and how its recordings are to be read; checked when made. Lists run over `robot.joints`.

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
    path: Place = Path("arm.toml")
    """Its file; the robot model's path is relative to it."""

    def __post_init__(self) -> None:
        robot = self.robot
        self._require(bool(robot.joints), "robot", "joints", [], "the names of the joints in use, at least one")
        for key in ("joints", "names"):
            listed = getattr(robot, key)
            self._require(len(set(listed)) == len(listed), "robot", key, list(listed), "names that differ")
        for key in ("names", "gear_ratio", "rotor_inertia_kg_m2"):
            self._check_count("robot", key, getattr(robot, key))
        self._require(all(g != 0 for g in robot.gear_ratio), "robot", "gear_ratio", robot.gear_ratio, "not 0")
        inertia = robot.rotor_inertia_kg_m2
        self._require(all(j >= 0 for j in inertia), "robot", "rotor_inertia_kg_m2", inertia, ">= 0")
        self._require(len(robot.gravity_m_s2) in (0, 3), "robot", "gravity_m_s2", robot.gravity_m_s2, "three numbers")
        self._check_payload()
        rate_hz, unit = self.time.rate_hz, self.time.unit
        self._require(0 <= rate_hz <= 1e6, "time", "rate_hz", rate_hz, ">= 0, at most 1e6; 0: as measured")
        self._require(unit in TIME_UNITS, "time", "unit", repr(unit), f"one of {', '.join(TIME_UNITS)}")
        for name in ("q", "tau"):
            if name not in self.signals:
                raise ConfigError(f"{self.path}: [signals.{name}] is missing; position and torque are needed")
        if self.servo is not None:
            self._check_servo(self.servo)
        for name, signal in self.signals.items():
            self._check_signal(name, signal)
        for name, spans in self.contact.intervals.items():
            for span in spans:
                self._require(
                    len(span) == 2 and span[0] < span[1], "contact.intervals", name, span, "[t0, t1], t0 < t1"
                )
        for key in ("before_s", "after_s"):
            value = getattr(self.contact, key)
            self._require(value >= 0, "contact", key, value, ">= 0")
        self._require(self.split.gap_s >= 0, "split", "gap_s", self.split.gap_s, ">= 0")

    @property
    def names(self) -> tuple[str, ...]:
        """Of the joints in the recording."""
        return self.robot.names or self.robot.joints

    @property
    def gear_ratio(self) -> tuple[float, ...]:
        """Motor turns a joint turn, one a joint."""
        return self.robot.gear_ratio or (1.0,) * len(self.robot.joints)

    @property
    def model(self) -> Path | None:
        """The robot file, or its copy on this machine; None: there is no model."""
        if not self.robot.model:
            return None
        return local_robot(place_of(self.robot.model, self.path.parent))

    @property
    def topics(self) -> tuple[str, ...]:
        """Topics that are named, each once."""
        named = [*(signal.topic for signal in self.signals.values()), self.contact.topic]
        return tuple(dict.fromkeys(topic for topic in named if topic))

    def _check_payload(self) -> None:
        payload = self.payload
        self._require(payload.mass_kg >= 0, "payload", "mass_kg", payload.mass_kg, ">= 0")
        self._require(len(payload.com_m) == 3, "payload", "com_m", payload.com_m, "three numbers")
        rule = "six numbers: xx, yy, zz, xy, xz, yz"
        self._require(len(payload.inertia_kg_m2) == 6, "payload", "inertia_kg_m2", payload.inertia_kg_m2, rule)
        if payload.mass_kg:
            self._require(bool(self.robot.model), "robot", "model", "''", "a robot file, where there is a payload")
            self._require(bool(payload.link), "payload", "link", "''", "the link that carries the payload")

    @cached_property
    def motors(self) -> tuple[MotorCalibration, ...]:
        """Calibrations of the joints' motors, which the recording names with or without `.pos`.

        Raises:
            ConfigError: no such file, not one of LeRobot's, or a joint that is not in it.
        """
        path = place_of(self.robot.calibration, self.path.parent)
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
        self._require(signal.unit in UNITS[name], table, "unit", repr(signal.unit), f"one of {', '.join(UNITS[name])}")
        none = not signal.columns
        derived = name == "dq" or (name == "tau" and self.makes_torque)
        self._require(not none or derived, table, "columns", "''", "given (only a velocity can be derived)")
        if len(signal.columns) > 1:
            self._check_count(table, "columns", signal.columns)
        for key in ("sign", "offset"):
            self._check_count(table, key, getattr(signal, key))
        self._require(all(s in (-1, 1) for s in signal.sign), table, "sign", signal.sign, "1 or -1")
        self._require(signal.low_pass_hz >= 0, table, "low_pass_hz", signal.low_pass_hz, ">= 0; 0: no low-pass")
        if name != "tau":
            return
        constant = signal.torque_constant
        if signal.is_current:
            rule = 'Nm/A, one a joint, or "unknown" (to be fitted), since the unit is a current\'s'
            self._require(bool(constant), table, "torque_constant", list(constant), rule)
        else:
            rule = f"left out, since the unit is {signal.unit}"
            self._require(not constant, table, "torque_constant", constant, rule)
        if not isinstance(constant, str):  # "unknown"
            self._check_count(table, "torque_constant", constant)
            self._require(all(k != 0 for k in constant), table, "torque_constant", constant, "not 0; signs go in sign")

    @property
    def makes_torque(self) -> bool:
        """Whether the torque is made of what servos report, and no column holds it."""
        return self.servo is not None and self.servo.torque_from != "torque"

    def _check_servo(self, servo: ServoTable) -> None:
        known = ", ".join(SERVO_TYPES)
        for name in servo.type:
            self._require(name in SERVO_TYPES, "servo", "type", repr(name), f"one of {known}")
        if len(servo.type) > 1:
            self._check_count("servo", "type", servo.type)
        for key in ("gain", "duty_per_rad", "most_duty", "voltage_v", "ohm", "back_emf_v_s", "counts_a_turn"):
            values = getattr(servo, key)
            self._check_count("servo", key, values)
            least = key == "back_emf_v_s"
            rule = ">= 0" if least else "> 0"
            self._require(all(v > 0 or (least and v == 0) for v in values), "servo", key, list(values), rule)
        duties = list(servo.most_duty)
        self._require(all(v <= 1 for v in duties), "servo", "most_duty", duties, "at most 1")
        if not isinstance(servo.torque_constant, str):
            self._check_count("servo", "torque_constant", servo.torque_constant)
        window_s = servo.velocity_window_s
        self._require(0 <= window_s <= 2, "servo", "velocity_window_s", window_s, "0 to 2")
        delay_s = 0.0 if isinstance(servo.goal_delay_s, str) else servo.goal_delay_s
        self._require(0 <= delay_s <= 0.5, "servo", "goal_delay_s", delay_s, '0 to 0.5, or "period"')
        if servo.torque_from == "torque":
            return
        needed = NEEDS[servo.torque_from]
        if needed not in self.signals:
            raise ConfigError(
                f"{self.path}: [servo] torque_from = '{servo.torque_from}' is made of [signals.{needed}], which is "
                "missing"
            )
        if self.signals["tau"].columns:
            raise ConfigError(
                f"{self.path}: [signals.tau] must be left out, since [servo] torque_from = '{servo.torque_from}' "
                "makes it"
            )
        if servo.torque_from == "supply-current" and not {"q_des", "duty"} & set(self.signals):
            raise ConfigError(
                f"{self.path}: [servo] torque_from = 'supply-current' has no sign: it takes that of [signals.duty], or "
                "of goal minus position, [signals.q_des]; both are missing"
            )

    def _check_count(self, table: str, key: str, values: tuple) -> None:
        joints = len(self.robot.joints)
        self._require(len(values) in (0, joints), table, key, list(values), f"as many as joints, {joints}")

    def _require(self, ok: bool, table: str, key: str, value: object, rule: str) -> None:
        if not ok:
            raise ConfigError(f"{self.path}: [{table}] {key} = {value} must be {rule}")
