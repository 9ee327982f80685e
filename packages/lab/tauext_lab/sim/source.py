"""Simulated arms as a source, `sim:ARM`: in a process of its own, in real time or as fast as the loop takes samples."""

from __future__ import annotations

import gc
import math
import multiprocessing
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Protocol

import numpy as np

from tauext import _core
from tauext.config import within
from tauext.data.servo import settings_by_type
from tauext.errors import ConfigError
from tauext.files.typed_table import JointName, read_table, table_of_line
from tauext.monitor.source import Sample, SourceCounts, SourceFacts, SourceSettings
from tauext.monitor.stop_signals import without_interrupts
from tauext_lab.sim.arms import ARMS, GearedArm
from tauext_lab.sim.plant import Mover, Plant
from tauext_lab.sim.rig import encoder
from tauext_lab.sim.servo_arm import (
    COMMAND_TICKS,
    COUNTS,
    HAND_M,
    SO101_FILE,
    SO101_JOINTS,
    SO101_TYPE,
    TICKS_HZ,
    Poses,
    ServoPlant,
    so101_arm,
)

# --- Commands, as lines: `push joint=joint2 force=0,0,-40 seconds=1`.


Force = Annotated[float, within(-1000, 1000)]
Metres = Annotated[float, within(-100, 100)]


@dataclass(frozen=True)
class Push:
    """A force on the link of a joint for some seconds; the next push replaces it."""

    joint: JointName
    force: tuple[Force, Force, Force]
    """[N], in the base frame."""
    point: tuple[Metres, Metres, Metres] | None = None
    """Where it acts, in the base frame, [m]; None: at the centre of mass."""
    seconds: Annotated[float, within(0, 3600)] = 0.5


@dataclass(frozen=True)
class NewFriction:
    """A factor on the arm's own friction."""

    factor: Annotated[float, within(0.1, 10)]
    start: Annotated[float, within(0.1, 10)] | None = None
    """Factor from which it is reached; None: the present one."""
    minutes: Annotated[float, within(0, 1e5)] = 0.0
    """Time constant of the change, [min]."""


@dataclass(frozen=True)
class Weight:
    """A weight in the hand; 0 takes it out."""

    mass: Annotated[float, within(0, 10)]


@dataclass(frozen=True)
class Off:
    """No sample for some seconds."""

    seconds: Annotated[float, within(0, 1e7)]


@dataclass(frozen=True)
class Jump:
    """Stamps jump."""

    seconds: Annotated[float, within(-1e9, 1e9)]


@dataclass(frozen=True)
class Halt:
    """stop, move: the arm comes to rest, and goes on."""


COMMANDS = {
    "push": Push, "friction": NewFriction, "load": Weight, "off": Off, "clock": Jump, "stop": Halt, "move": Halt,
}  # fmt: skip
USAGE = "`push joint=NAME force=X,Y,Z`, `friction factor=F`, `load mass=KG`, `off seconds=S`, `clock seconds=S`, `stop`"


class Command(NamedTuple):
    """A command with checked values."""

    name: str
    values: Any


def command_of(text: str, joints: Sequence[str]) -> Command:
    """Parse a line.

    Raises:
        ConfigError: names the command, the key and the rule.
    """
    name = text.split(maxsplit=1)[0] if text.strip() else ""
    head, table = table_of_line(COMMANDS.get(name, Halt), text, f"sim: {name}")
    if name not in COMMANDS or head != name:
        raise ConfigError(f"sim: {text[:60]!r} must be {USAGE} or `move`")
    return Command(name, read_table(COMMANDS[name], table, f"sim: {name}", joints))


# --- Simulated arms, one sample at a time.


class SimulatedArm(Protocol):
    """What the simulating process steps."""

    def step(self) -> np.ndarray:
        """Signals (signals, joints) of the next sample, and below them the true external torque, [N m]."""
        ...

    def obey(self, command: Command) -> None:
        """Execute push, friction, load, stop or move."""
        ...


SETTLE_S = 1.0
"""Simulated before the first sample: the arm starts on its setpoint, without the sag and the friction it will have."""
WARM_EVERY_S = 1.0
STEEL_KG_M3 = 7850.0
RIG_HAND_M = 0.3
SO101_HZ = 50
SUPPLY_STEP_A, SUPPLY_NOISE_A, DUTY_STEP, VOLTAGE_STEP_V = 0.0065, 0.004, 0.001, 0.1
"""Registers of a Feetech servo, and what its converter of the current adds."""


class Friction:
    """A factor on friction that goes from one value to another with a time constant."""

    def __init__(self, rate_hz: float):
        self._rate_hz = rate_hz
        self._begin, self._end, self._constant, self._since = 1.0, 1.0, 1.0, 0

    def change(self, values: NewFriction, tick: int) -> float:
        """Follow the command `friction` from this tick on; returns the factor now."""
        constant, begin = 60 * values.minutes * self._rate_hz, values.start
        start = self.at(tick) if begin is None else begin
        self._begin, self._end = start if constant else values.factor, values.factor
        self._constant, self._since = constant or 1.0, tick
        return self._begin

    def at(self, tick: int) -> float:
        """The factor at a tick."""
        return self._end + (self._begin - self._end) * math.exp(-(tick - self._since) / self._constant)

    def is_due(self, tick: int) -> bool:
        """Whether the factor has changed enough to be set again."""
        return self._begin != self._end and tick % round(WARM_EVERY_S * self._rate_hz) == 0


class DrivenArm:
    """An arm of tauext_lab.sim.arms with geared drives that moves around its home for ever."""

    def __init__(self, arm: GearedArm, seed: int):
        self._arm, self._plant, self._mover = arm, Plant(arm, seed), Mover(arm, seed)
        self._push: tuple[int, np.ndarray, np.ndarray] | None = None
        self._push_until = 0
        self._friction, self._tick = Friction(arm.rate_hz), 0
        for _ in range(round(SETTLE_S * arm.rate_hz)):
            self.step()

    def step(self) -> np.ndarray:
        plant, tick = self._plant, self._tick
        if self._friction.is_due(tick):
            plant.set_friction(self._friction.at(tick))
        if self._push is not None and tick >= self._push_until:
            self._push = None
        joint, force, point = self._force()
        sample = plant.step(*self._mover.step(), force, point, joint)
        self._tick += 1
        return np.stack([sample.q, sample.dq, sample.tau, sample.tau_ext + sample.tau_held])

    def obey(self, command: Command) -> None:
        name, values = command
        if name == "push":
            joint = self._arm.joints.index(values.joint)
            origin, rotation = self._plant.body_pose(joint)
            point = values.point
            given = self._plant.data.xipos[joint + 1] if point is None else np.array(point)
            self._push = joint, np.array(values.force), rotation.T @ (given - origin)
            self._push_until = self._tick + round(values.seconds * self._arm.rate_hz)
        elif name == "friction":
            self._plant.set_friction(self._friction.change(values, self._tick))
        elif name == "load":
            self._plant.hold(weight(values.mass, RIG_HAND_M if self._arm.hand_m is None else self._arm.hand_m))
        elif name == "stop":
            self._mover.stop()
        elif name == "move":
            self._mover.resume()

    def _force(self) -> tuple[int, np.ndarray | None, np.ndarray | None]:
        """Joint whose link is pushed, force and where it acts now, in the base frame."""
        if self._push is None:
            return 0, None, None
        joint, force, local = self._push
        origin, rotation = self._plant.body_pose(joint)
        return joint, force, origin + rotation @ local


def weight(mass_kg: float, along_m: float) -> _core.Load | None:
    """A steel ball in the hand, so far along the last link; None: nothing."""
    if mass_kg == 0:
        return None
    radius = (3 * mass_kg / (4 * math.pi * STEEL_KG_M3)) ** (1 / 3)
    return _core.Load(mass_kg, [0.0, 0.0, along_m], [0.4 * mass_kg * radius**2] * 3 + [0.0] * 3)


class BusArm:
    """An SO-101 whose servos are read and get their next goal once a sample: registers, not torques."""

    def __init__(self, rate_hz: int, seed: int):
        rng, noise = (np.random.default_rng(stream) for stream in np.random.SeedSequence(seed).spawn(2))
        self._rate_hz, self._noise, self._tick = rate_hz, noise, 0
        self._poses, self._friction = Poses(rate_hz, rng), Friction(rate_hz)
        self._plant = ServoPlant(so101_arm(), self._poses.goal)
        self._push_until = 0

    def step(self) -> np.ndarray:
        plant, tick = self._plant, self._tick
        if self._friction.is_due(tick):
            plant.set_friction(self._friction.at(tick))
        if tick == self._push_until:
            plant.push(0, None)
        came = plant.tick()
        goal = encoder(self._poses.next(), COUNTS)
        for passed in range(1, round(TICKS_HZ / self._rate_hz)):
            if passed == COMMAND_TICKS:
                plant.goal = goal
            plant.tick()
        self._tick += 1
        ampere = np.abs(came.supply_a) + SUPPLY_NOISE_A * self._noise.standard_normal(len(goal))
        return np.stack(
            [
                encoder(came.q, COUNTS),
                came.speed,
                np.full(len(goal), np.nan),
                came.goal,
                np.round(np.maximum(ampere, 0) / SUPPLY_STEP_A) * SUPPLY_STEP_A,
                np.round(came.duty / DUTY_STEP) * DUTY_STEP,
                np.full(len(goal), round(came.volts / VOLTAGE_STEP_V) * VOLTAGE_STEP_V),
                came.tau_ext,
            ]
        )

    def obey(self, command: Command) -> None:
        name, values = command
        if name == "push":
            point = values.point
            joint = SO101_JOINTS.index(values.joint)
            self._plant.push(joint, np.array(values.force), None if point is None else np.array(point))
            self._push_until = self._tick + round(values.seconds * self._rate_hz)
        elif name == "friction":
            self._plant.set_friction(self._friction.change(values, self._tick))
        elif name == "load":
            self._plant.hold(weight(values.mass, HAND_M))
        elif name in ("stop", "move"):
            self._poses.stopped = name == "stop"


# --- The arms by name.


class Kind(NamedTuple):
    """A simulated arm."""

    make: Callable[[int], SimulatedArm]
    """Makes it from a seed of motion and noise."""
    signals: tuple[str, ...]
    """Fields of Sample that step() returns, in order."""
    facts: Callable[[], SourceFacts]
    robot_file: Callable[[], tuple[str, str]]
    """Name and text of the robot file that an integrator has."""


def driven(make: Callable[[], GearedArm]) -> Kind:
    """An arm of tauext_lab.sim.arms."""

    def facts() -> SourceFacts:
        arm = make()
        units = ("N m",) * len(arm.joints)
        return SourceFacts(SourceSettings(arm.joints, round(1e9 / arm.rate_hz), units, "held"), "torque", False)

    def robot_file() -> tuple[str, str]:
        arm = make()
        return f"{arm.name}.xml", arm.xml

    return Kind(lambda seed: DrivenArm(make(), seed), ("q", "dq", "tau"), facts, robot_file)


def servo_facts_of_so101() -> SourceFacts:
    servo, _ = settings_by_type([SO101_TYPE] * len(SO101_JOINTS), SO101_JOINTS, "duty", SO101_HZ)
    units = ("N m",) * len(SO101_JOINTS)
    return SourceFacts(SourceSettings(SO101_JOINTS, round(1e9 / SO101_HZ), units, "held", servo), "duty", False)


KINDS = {name: driven(make) for name, make in ARMS.items()} | {
    "so101": Kind(
        lambda seed: BusArm(SO101_HZ, seed),
        ("q", "dq", "tau", "q_des", "current", "duty", "voltage"),
        servo_facts_of_so101,
        lambda: (SO101_FILE.name, SO101_FILE.read_text(encoding="utf-8")),
    )
}


# --- The simulating process: samples in blocks of bytes through a pipe, commands the other way.


BLOCK_S = 0.02
"""Simulated time of a block where samples are not paced."""
MOST_BEHIND_S = 0.1
"""Further behind the clock the arm does not catch up: simulated time then passes more slowly."""


def simulate(
    pipe: Connection, name: str, seed: int, speed: float | None, script: Sequence[tuple[float, Command]]
) -> None:
    """Step an arm until the pipe closes. A row of a block: stamp [ns], time of sending [ns], signals, true torque."""
    arm, period_ns = KINDS[name].make(seed), KINDS[name].facts().settings.period_ns
    gc.freeze()
    stamps = Stamps(period_ns)
    due = deque(sorted(script, key=lambda entry: entry[0]))
    clock = None if speed is None else Clock(period_ns * 1e-9 / speed)
    block = max(1, round(BLOCK_S * 1e9 / period_ns))
    with suppress(EOFError, OSError):
        while True:
            while pipe.poll(0 if clock is None else clock.left_s()):
                _obey(pipe.recv(), arm, stamps)
            rows = []
            for _ in range(block if clock is None else clock.due()):
                while due and due[0][0] * 1e9 <= stamps.elapsed_ns:
                    _obey(due.popleft()[1], arm, stamps)
                if not stamps.is_off(skip=clock is None):
                    rows.append((stamps.next_ns(), arm.step()))
            if rows:
                pipe.send_bytes(_packed(rows))
    gc.unfreeze()


def _obey(command: Command, arm: SimulatedArm, stamps: Stamps) -> None:
    if command.name == "off":
        stamps.off_ns = round(command.values.seconds * 1e9)
    elif command.name == "clock":
        stamps.ahead_ns += round(command.values.seconds * 1e9)
    else:
        arm.obey(command)


def _packed(rows: Sequence[tuple[int, np.ndarray]]) -> bytes:
    packed = np.empty((len(rows), 2 + rows[0][1].size))
    packed[:, :2].view(np.int64)[:] = [[t_ns, time.monotonic_ns()] for t_ns, _ in rows]
    packed[:, 2:] = [signals.ravel() for _, signals in rows]
    return packed.tobytes()


class Stamps:
    """Simulated time, and stamps of the samples: the same unless the clock was set."""

    def __init__(self, period_ns: int):
        self._period_ns, self.elapsed_ns = period_ns, 0
        self.ahead_ns = self.off_ns = 0
        """How far the stamps are ahead of simulated time; how long no sample comes."""

    def next_ns(self) -> int:
        """Stamp of the sample that is stepped now."""
        stamp_ns = self.elapsed_ns + self.ahead_ns
        self.elapsed_ns += self._period_ns
        return stamp_ns

    def is_off(self, skip: bool) -> bool:
        """Whether no sample is due at this tick, which passes; skip: pass all such ticks at once."""
        if self.off_ns <= 0:
            return False
        ns = self.off_ns if skip else self._period_ns
        ns = -(-ns // self._period_ns) * self._period_ns
        self.elapsed_ns, self.off_ns = self.elapsed_ns + ns, self.off_ns - ns
        return not skip


class Clock:
    """How many samples are due by the wall clock."""

    def __init__(self, period_s: float):
        self._period_s, self._next_s = period_s, time.perf_counter()

    def left_s(self) -> float:
        """Time until the next sample is due, [s]."""
        return max(0.0, self._next_s - time.perf_counter())

    def due(self) -> int:
        """Samples to step now."""
        now_s = time.perf_counter()
        self._next_s = max(self._next_s, now_s - MOST_BEHIND_S)
        count = max(0, 1 + math.floor((now_s - self._next_s) / self._period_s))
        self._next_s += count * self._period_s
        return count


# --- The source.


END_S = 2.0
UNPACED_S = 10.0
"""Longest wait for a sample that is not paced: the loop waits for the simulation, so that no sample counts as
missing."""


class SimSource:
    """A simulated arm that moves around its home until it is closed; see COMMANDS.

    Samples carry the torque that the drives give, friction not subtracted. Nothing is lost: a late loop finds the
    samples waiting.
    """

    def __init__(
        self,
        arm: str,
        seed: int | None = None,
        speed: float | None = 1.0,
        script: Sequence[tuple[float, str]] = (),
    ):
        """Args:
            arm: a key of KINDS.
            seed: of motion and noise; None: another one at every start, so that a restart repeats no motion.
            speed: factor on real time; None: as fast as the loop takes the samples.
            script: commands with the simulated time since the start at which they are executed, [s].

        Raises:
            ConfigError: there is no such arm, or a command of the script is wrong.
        """
        if arm not in KINDS:
            raise ConfigError(f"--source sim:{arm[:60]} must be one of {', '.join(f'sim:{name}' for name in KINDS)}")
        self.name, self.counts = f"sim {arm}", SourceCounts()
        self.facts = KINDS[arm].facts()
        self.tau_ext = np.zeros(len(self.facts.settings.joints))
        """True external torque at the last sample, [N m]."""
        joints = self.facts.settings.joints
        entries = [(at_s, command_of(text, joints)) for at_s, text in script]
        seed = int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else seed
        self._arguments = (arm, seed, speed, entries)
        self._signals, self._paced = KINDS[arm].signals, speed is not None
        self._samples: deque[tuple[int, int, np.ndarray]] = deque()
        """Stamp, time of sending, and signals with the true torque below them."""
        self._sending = threading.Lock()
        self._pipe: Connection | None = None
        self._process: BaseProcess | None = None
        self._ended = False
        self._notes: list[str] = []

    def describe(self, wait_s: float, robot: Path | None = None) -> SourceFacts:
        return self.facts

    def open(self, settings: SourceSettings) -> None:
        """Start the simulation; its first sample comes about a second later."""
        own = self.facts.settings
        if settings.joints != own.joints:
            raise ConfigError(f"{self.name} has joints {', '.join(own.joints)}, not {', '.join(settings.joints)}")
        if abs(settings.period_ns / own.period_ns - 1) > settings.rate_tolerance:
            raise ConfigError(f"{self.name} has {1e9 / own.period_ns:g} Hz, not {1e9 / settings.period_ns:g} Hz")
        context = multiprocessing.get_context("spawn")
        self._pipe, there = context.Pipe()
        self._process = context.Process(target=simulate, args=(there, *self._arguments), daemon=True)
        with without_interrupts():
            self._process.start()
        there.close()

    def next_sample(self, timeout_s: float) -> Sample | None:
        if not self._samples:
            self._receive(timeout_s if self._paced else max(timeout_s, UNPACED_S))
        if not self._samples:
            return None
        t_ns, received_ns, row = self._samples.popleft()
        self.tau_ext = row[-1]
        self.counts.received += 1
        if not self._paced:
            received_ns = time.monotonic_ns()
        return Sample(t_ns, received_ns=received_ns, **dict(zip(self._signals, row, strict=False)))

    def _receive(self, timeout_s: float) -> None:
        if self._pipe is None or self._ended:
            return
        try:
            if not self._pipe.poll(timeout_s):
                return
            data = self._pipe.recv_bytes()
        except (EOFError, OSError):
            self._ended = True
            self._notes.append(f"{self.name}: the simulation has ended")
            return
        joints = len(self.facts.settings.joints)
        packed = np.frombuffer(data).reshape(-1, 2 + joints * (len(self._signals) + 1))
        times = packed[:, :2].view(np.int64).tolist()
        rows = packed[:, 2:].reshape(len(packed), -1, joints)
        self._samples.extend((t_ns, sent_ns, row) for (t_ns, sent_ns), row in zip(times, rows, strict=True))

    def command(self, text: str) -> None:
        command = command_of(text, self.facts.settings.joints)
        if self._pipe is None or self._ended:
            raise ConfigError(f"{self.name} is not running")
        with self._sending, suppress(OSError):  # the process has ended, which next_sample() reports
            self._pipe.send(command)

    @property
    def ended(self) -> bool:
        return self._ended and not self._samples

    def notes(self) -> list[str]:
        notes, self._notes = self._notes, []
        return notes

    def stop(self) -> None:
        """Bring the arm to rest; the command `move` lets it go on."""
        self.command("stop")

    def close(self) -> None:
        self._ended = True
        if self._pipe is not None and self._process is not None:
            self._pipe.close()
            self._process.join(END_S)
            self._process.kill()
            self._pipe = None


def write_robot_file(arm: str, folder: Path) -> Path:
    """Write the arm's robot file into a folder and return its path: what an integrator would have of a real arm."""
    name, content = KINDS[arm].robot_file()
    (folder / name).write_text(content, encoding="utf-8")
    return folder / name
