"""A bus of serial servos as a source: one transaction per period, missing servos, holding position."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tauext.data.servo import settings_by_type
from tauext.data.servo_types import COUNTS_A_TURN, SERVO_TYPES
from tauext.errors import ConfigError
from tauext.monitor.source import Sample, SourceFacts, SourceSettings
from tauext.sources.describing import chosen_joints
from tauext.sources.reader import Misfit, Unreachable
from tauext_lerobot.bus_source import TRIES, BusSource, shortest_period_ns
from tauext_lerobot.servo_bus import ServoBus, ServoPort
from tauext_lerobot.servo_bus_file import ServoBusFile, ServoJoint
from tauext_lerobot.servo_series import Series

COUNT_RAD = 2 * np.pi / COUNTS_A_TURN


@dataclass(frozen=True)
class Identity:
    """Model and settings of a servo, read once."""

    model: str
    """Name for the model number."""
    reports: tuple[str, ...]
    """Values of torque_from that the servo supports beside goal (data.servo_types)."""
    homing_offset: float
    """[counts]."""
    holds: bool
    """Whether the operating mode follows a goal position."""
    ampere: float
    """Current per count, [A]; NaN: the servo measures no current."""


class ServoSource(BusSource):
    """Reads angles, speeds, goals, currents, duties, voltages and temperatures of the bundle's joints once per period.

    A reading with a missing servo or a corrupt packet is dropped and counted as refused. Reading writes no register.
    Only stop() writes: goals of servos whose torque is on.

    A supply current has no direction. q_des is NaN if a servo follows no goal: its torque is off, or its operating mode
    has no goal.
    """

    def __init__(self, series: Series, port: str, file: ServoBusFile):
        super().__init__(f"{series.kind} {port}")
        self._series, self._file = series, file
        self.bus = ServoBus(ServoPort(port, file.baud), series)
        """For a program that drives the arm through the same port in this process: see ServoBus.lock."""
        self._servos: list[ServoJoint] = []
        self._identities: dict[int, Identity] = {}

    # The interface of a source.

    def open(self, settings: SourceSettings) -> None:
        self._prepare(settings.joints)
        least_s = self.bus.transaction_s(len(self._ids), self._series.state[1])
        if least_s * 1e9 > settings.period_ns:
            raise ConfigError(
                f"{self.name}: a reading of {len(self._ids)} servos takes {least_s * 1e3:.2g} ms at {self._file.baud} "
                f"baud, the bundle needs one every {settings.period_ns * 1e-6:g} ms"
            )
        self._note_delay(settings)
        super().open(settings)

    def find_out(self, wait_s: float, robot: Path | None) -> SourceFacts:
        """Read which servos there are and time some readings.

        The torque comes from the best signal that all servos report; constants are those of their types.
        """
        joints, notes = chosen_joints(list(self._file.joints), robot, self.name)
        self._prepare(joints)
        self.bus.port.close()
        self.bus.port.open()
        self._identify()
        samples = self.several(wait_s)
        least_ns = self.bus.transaction_s(len(self._ids), self._series.state[1]) * 1e9
        period_ns = shortest_period_ns(samples, (5, 10, 20, 33.333333, 50), self.name, least_ns)
        signal = self._series.current if self._series.current == "phase-current" else "duty"
        if not all(signal in self._identities[id_].reports for id_ in self._ids):
            signal = "duty"
        assert samples[-1].voltage is not None
        servo, known = settings_by_type(self._types(samples[-1].voltage), joints, signal, 1e9 / period_ns)
        if not known:
            notes += ("no constants are known of these servos: the torque is in units that training converts",)
        settings = SourceSettings(joints, period_ns, ("N m" if known else "A",) * len(joints), "held", servo)
        return SourceFacts(settings, "duty" if signal == "duty" else "current", temperature=True, notes=notes)

    def _types(self, volts: np.ndarray) -> list[str]:
        """Names in SERVO_TYPES of the servos at this supply voltage, [V]; "": unknown."""
        found = []
        for servo, supply in zip(self._servos, volts.tolist(), strict=True):
            model = servo.type if servo.type in SERVO_TYPES else self._identities[servo.id].model
            fits = [name for name in SERVO_TYPES if name.startswith(model)]
            found.append(min(fits, key=lambda name: abs(SERVO_TYPES[name].volts - supply), default=""))
        return found

    def connect(self) -> None:
        port = self.bus.port
        port.close()
        port.open()
        try:
            self._identify()
            for servo in self._servos:
                self._expect(servo, self._identities[servo.id])
        except Unreachable:
            port.close()
            raise
        self._due_s = None

    def ask(self) -> Sample | None:
        reading = self.bus.read(*self._series.state, self._ids)
        if not self.whole(reading.data.keys(), reading.corrupt):
            return None
        for id_, error in reading.errors.items():
            texts = [text for bit, text in self._series.complaints.items() if error & bit] or [f"error {error}"]
            self.reports(id_, ", ".join(texts) if error else "")
        return self._sample(reading.t_ns, [reading.data[id_] for id_ in self._ids])

    def disconnect(self) -> None:
        self.bus.port.close()

    def stop(self) -> None:
        """Hold: write the present position as goal of every servo whose torque is on, and read it back.

        Nothing else is written; torque that is off stays off.

        Raises:
            RuntimeError: a servo follows no goals, does not answer, or does not take the goal.
        """
        torque, position, goal = (self._series.registers[name].block for name in ("torque", "position", "goal"))
        silent, unlike = set(self._ids), set[int]()
        for _ in range(TRIES):
            on = self.bus.read(*torque, sorted(silent | unlike)).data
            present = self.bus.read(*position, list(on)).data
            silent -= present.keys()
            goals = {id_: data for id_, data in present.items() if on[id_] == b"\x01" and self._identities[id_].holds}
            taken = {}
            if goals:
                self.bus.write(*goal, goals)
                taken = self.bus.read(*goal, list(goals)).data
            unlike = {id_ for id_, data in goals.items() if taken.get(id_) != data} | (unlike - present.keys())
            if not silent | unlike:
                break
        by_why = (
            (silent, "does not answer"),
            (unlike, "does not take the goal"),
            ({id_ for id_ in self._ids if not self._identities[id_].holds}, "is in an operating mode without goal"),
        )
        failures = [f"{one} {why}" for ids, why in by_why for one in self._servos if one.id in ids]
        if failures:
            raise RuntimeError(f"{self.name} does not hold: {', '.join(failures)}")

    # Inside.

    def _prepare(self, joints: Sequence[str]) -> None:
        self._servos = self.motors_of(joints, self._file.path, self._file.joints)
        self._ids = [servo.id for servo in self._servos]

    def _all_of(self, address: int, length: int) -> dict[int, bytes]:
        """Read registers of all servos. Raises Unreachable: a servo does not answer."""
        came: dict[int, bytes] = {}
        for _ in range(TRIES):
            came |= self.bus.read(address, length, [id_ for id_ in self._ids if id_ not in came]).data
            if len(came) == len(self._ids):
                return came
        silent = ", ".join(str(one) for one in self._servos if one.id not in came)
        there = ", ".join(str(one.id) for one in self._servos if one.id in came)
        found = (
            f"{there} do" if there else f"no servo does: check the arm's power, and that {self._file.baud} baud is set"
        )
        raise Unreachable(f"{silent} does not answer; {found}")

    def _identify(self) -> None:
        """Read model and settings of all servos. Raises Unreachable: one does not answer; Misfit: an unknown model."""
        blocks = self._all_of(*self._series.identity)
        self._identities = {one.id: self._identified(one, blocks[one.id]) for one in self._servos}

    def _identified(self, servo: ServoJoint, data: bytes) -> Identity:
        """Decode the block `identity`. Raises Misfit: the model is unknown."""
        series, first = self._series, self._series.identity[0]
        model, mode, homing = (series.registers[name].of(data, first) for name in ("model", "mode", "homing"))
        if model not in series.models:
            known = ", ".join(f"{name} ({number})" for number, (name, _) in series.models.items())
            raise Misfit(f"{servo} reports model {model}; known are {known}")
        name, ampere = series.models[int(model)]
        reports = ("duty",) if ampere is None else (series.current, "duty")
        return Identity(name, reports, homing, mode in series.holds, np.nan if ampere is None else ampere)

    def _expect(self, servo: ServoJoint, identity: Identity) -> None:
        """Check the servo against the bus file and the bundle. Raises Misfit: they differ."""
        if servo.type and not (servo.type.startswith(identity.model) or identity.model.startswith(servo.type)):
            raise Misfit(f"{servo} is a {identity.model}, {self._file.path} names {servo.type}")
        if servo.homing_offset is not None and servo.homing_offset != identity.homing_offset:
            raise Misfit(
                f"{servo} has homing offset {identity.homing_offset}, {self._file.path} has {servo.homing_offset}: the "
                "calibration is of another arm or outdated"
            )
        made_from = self.settings.servo
        if made_from is None or not made_from.on:
            raise Misfit(
                "servos report current, duty and goal, but the bundle does not compute torque from them: import its "
                "recordings with a [servo] table in arm.toml"
            )
        needed = made_from.torque_from.name.replace("_", "-")
        if needed not in (*identity.reports, "goal"):
            raise Misfit(
                f"{servo}, a {identity.model}, reports {', '.join((*identity.reports, 'goal'))}, "
                f"the bundle takes its torque from {needed}"
            )

    def _note_delay(self, settings: SourceSettings) -> None:
        """Note a mismatch of goal delays: a goal in a register acts at once, a goal that a loop writes acts later."""
        servo = settings.servo
        if servo is not None and servo.on and servo.torque_from.name == "goal" and servo.goal_delay_ns > 0:
            self._note(
                f"the bundle's goals act {servo.goal_delay_ns * 1e-6:g} ms after their stamp, but a register holds the "
                "goal that acts now: train on recordings of --record, with goal_delay_s = 0"
            )

    def _sample(self, t_ns: int, data: Sequence[bytes]) -> Sample:
        registers, first = self._series.registers, self._series.state[0]

        def column(name: str) -> np.ndarray:
            return np.array([registers[name].of(one, first) for one in data], dtype=float)

        identities = [self._identities[id_] for id_ in self._ids]
        follows = np.array([identity.holds for identity in identities])
        if registers["torque"].address >= first:
            follows &= column("torque") == 1
        sign = np.array([servo.sign for servo in self._servos], dtype=float)
        counts = column("position")
        from_zero = np.array([angle_counts(servo, count) for servo, count in zip(self._servos, counts, strict=True)])
        to_goal = np.where(follows, column("goal") - counts, np.nan)
        current = column("current") * np.array([identity.ampere for identity in identities])
        return Sample(
            t_ns=t_ns,
            q=sign * from_zero * COUNT_RAD,
            dq=sign * column("speed") * COUNT_RAD,
            tau=np.full(len(data), np.nan),
            received_ns=time.monotonic_ns(),
            temperature=column("celsius"),
            q_des=sign * (from_zero + to_goal) * COUNT_RAD,
            current=sign * current if self._series.current == "phase-current" else current,
            duty=sign * column("duty"),
            voltage=column("voltage"),
        )


def angle_counts(servo: ServoJoint, count: float) -> float:
    """Counts from the zero, within half a turn of it unless the servo counts turns. The angle is continuous where the
    counts wrap from 4095 to 0."""
    away = count - servo.zero
    return away if servo.multi_turn else (away + COUNTS_A_TURN / 2) % COUNTS_A_TURN - COUNTS_A_TURN / 2
