"""Simulated arms as a source, `sim:ARM`: in a process of its own, in real time or as fast as the loop takes samples."""

from __future__ import annotations

import gc
import math
import multiprocessing
import re
import signal
import threading
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from tauext import _core
from tauext.errors import ConfigError
from tauext.files.toml_file import number, numbers, one_of, read_table
from tauext.monitor.source import Sample, SourceCounts, SourceFacts, SourceSettings
from tauext.sim.arms import ARMS, DemoArm
from tauext.sim.plant import Mover, Plant

# --- Commands, as lines: `push joint=joint2 force=0,0,-40 seconds=1`.


COMMANDS = {
    "push": {
        "joint": one_of(()),  # those of the arm, see command_of()
        "force": numbers((3,), number(-1000, 1000)),
        "point": numbers((3,), number(-100, 100), default=None),
        "seconds": number(0, 3600, 0.5),
    },
    "friction": {"factor": number(0.1, 10), "from": number(0.1, 10, None), "minutes": number(0, 1e5, 0.0)},
    "load": {"mass": number(0, 10)},
    "off": {"seconds": number(0, 1e7)},
    "clock": {"seconds": number(-1e9, 1e9)},
    "stop": {},
    "move": {},
}
"""push: a force on the link of a joint, at a point of it (its centre of mass where left out), both in the base frame,
for some seconds; the next push replaces it. friction: a factor on the arm's own, reached from another one with a time
constant in minutes. load: a weight in the hand; 0 takes it out. off: no sample for some seconds. clock: stamps jump.
stop, move: the arm comes to rest, and goes on."""
USAGE = "`push joint=NAME force=X,Y,Z`, `friction factor=F`, `load mass=KG`, `off seconds=S`, `clock seconds=S`, `stop`"


class Command(NamedTuple):
    """A command with checked values."""

    name: str
    values: dict[str, Any]


def command_of(text: str, joints: Sequence[str]) -> Command:
    """Parse a line.

    Raises:
        ConfigError: names the command, the key and the rule.
    """
    name, *rest = text.split() or [""]
    if name not in COMMANDS:
        raise ConfigError(f"sim: {text[:60]!r} must be {USAGE} or `move`")
    table: dict[str, Any] = {}
    for one in rest:
        key, _, value = one.partition("=")
        words = value.split(",")
        table[key] = words[0] if key == "joint" else _numbers(words)
    return Command(name, read_table("sim", name, table, COMMANDS[name] | _joint_key(name, joints)))


def _joint_key(name: str, joints: Sequence[str]) -> dict:
    return {"joint": one_of(tuple(joints))} if name == "push" else {}


def _numbers(words: list[str]) -> Any:
    """A number, or a list of several; text where one is not a number, which no rule accepts."""
    plain = re.compile(r"[-+]?[0-9]*\.?[0-9]+(e[-+]?[0-9]+)?")
    if not all(plain.fullmatch(word) for word in words):
        return ",".join(words)
    return float(words[0]) if len(words) == 1 else [float(word) for word in words]


# --- Simulated arms, one sample at a time.


class SimulatedArm(Protocol):
    """What the simulating process steps."""

    signals: tuple[str, ...]
    """Fields of Sample that step() returns, in order."""
    period_ns: int

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


class DrivenArm:
    """An arm of tauext.sim.arms with geared drives that moves around its home for ever."""

    signals: tuple[str, ...] = ("q", "dq", "tau")

    def __init__(self, arm: DemoArm, seed: int):
        self.period_ns = round(1e9 / arm.rate_hz)
        self._arm, self._plant, self._mover = arm, Plant(arm, seed), Mover(arm, seed)
        self._push: tuple[int, np.ndarray, np.ndarray] | None = None
        self._push_until = 0
        self._friction = (1.0, 1.0, 1.0)  # from, to, time constant [samples]
        self._since = self._tick = 0
        self._measured = self._plant.data.qpos.copy(), self._plant.data.qvel.copy()
        for _ in range(round(SETTLE_S * arm.rate_hz)):
            self.step()

    def step(self) -> np.ndarray:
        plant, tick = self._plant, self._tick
        if self._friction[0] != self._friction[1] and tick % round(WARM_EVERY_S * self._arm.rate_hz) == 0:
            begin, end, constant = self._friction
            plant.set_friction(end + (begin - end) * math.exp(-(tick - self._since) / constant))
        if self._push is not None and tick >= self._push_until:
            self._push = None
        joint, force, point = self._force()
        q, dq = self._measured
        sample = plant.step(*self._mover.step(q, dq, plant.data.qfrc_bias), force, point, joint)
        self._measured = sample.q, sample.dq
        self._tick += 1
        return np.stack([sample.q, sample.dq, sample.tau, sample.tau_ext + sample.tau_held])

    def obey(self, command: Command) -> None:
        name, values = command
        if name == "push":
            joint = self._arm.joints.index(values["joint"])
            origin, rotation = self._plant.body_pose(joint)
            point = values["point"]
            given = self._plant.data.xipos[joint + 1] if point is None else np.array(point)
            self._push = joint, np.array(values["force"]), rotation.T @ (given - origin)
            self._push_until = self._tick + round(values["seconds"] * self._arm.rate_hz)
        elif name == "friction":
            end, begin = values["factor"], values["from"]
            constant = 60 * values["minutes"] * self._arm.rate_hz
            start = self._factor() if begin is None else begin
            self._friction = (start, end, constant) if constant else (end, end, 1.0)
            self._since = self._tick
            self._plant.set_friction(self._friction[0])
        elif name == "load":
            self._plant.hold(weight(self._arm, values["mass"]) if values["mass"] else None)
        elif name == "stop":
            self._mover.react("stop")
        elif name == "move":
            self._mover.resume()

    def _force(self) -> tuple[int, np.ndarray | None, np.ndarray | None]:
        """Joint whose link is pushed, force and where it acts now, in the base frame."""
        if self._push is None:
            return 0, None, None
        joint, force, local = self._push
        origin, rotation = self._plant.body_pose(joint)
        return joint, force, origin + rotation @ local

    def _factor(self) -> float:
        begin, end, constant = self._friction
        return end + (begin - end) * math.exp(-(self._tick - self._since) / constant)


def weight(arm: DemoArm, mass_kg: float) -> _core.Load:
    """A steel ball in the hand, in the frame of the last link; the rig carries it at its tip."""
    radius = (3 * mass_kg / (4 * math.pi * STEEL_KG_M3)) ** (1 / 3)
    along = RIG_HAND_M if arm.hand_m is None else arm.hand_m
    return _core.Load(mass_kg, [0.0, 0.0, along], [0.4 * mass_kg * radius**2] * 3 + [0.0] * 3)


# --- The simulating process: samples in blocks of bytes through a pipe, commands the other way.


BLOCK_S = 0.02
"""Simulated time of a block where samples are not paced."""
MOST_BEHIND_S = 0.1
"""Further behind the clock the arm does not catch up: simulated time then passes more slowly."""


def simulate(
    pipe: Connection, name: str, seed: int, speed: float | None, script: Sequence[tuple[float, Command]]
) -> None:
    """Step an arm until the pipe closes. A row of a block: stamp [ns], time of sending [ns], signals, true torque."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the loop ends this process
    arm = made_arm(name, seed)
    gc.freeze()
    stamps = Stamps(arm.period_ns)
    due = deque(sorted(script, key=lambda entry: entry[0]))
    clock = None if speed is None else Clock(arm.period_ns * 1e-9 / speed)
    block = max(1, round(BLOCK_S * 1e9 / arm.period_ns))
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


def made_arm(name: str, seed: int) -> SimulatedArm:
    return DrivenArm(ARMS[name](), seed)


def _obey(command: Command, arm: SimulatedArm, stamps: Stamps) -> None:
    if command.name == "off":
        stamps.off_ns = round(command.values["seconds"] * 1e9)
    elif command.name == "clock":
        stamps.ahead_ns += round(command.values["seconds"] * 1e9)
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
            arm: a key of ARMS.
            seed: of motion and noise; None: another one at every start, so that a restart repeats no motion.
            speed: factor on real time; None: as fast as the loop takes the samples.
            script: commands with the simulated time since the start at which they are executed, [s].

        Raises:
            ConfigError: there is no such arm, or a command of the script is wrong.
        """
        if arm not in ARMS:
            raise ConfigError(f"--source sim:{arm[:60]} must be one of {', '.join(f'sim:{name}' for name in ARMS)}")
        self.name, self.counts = f"sim {arm}", SourceCounts()
        self.facts = facts_of(arm)
        self.tau_ext = np.zeros(len(self.facts.settings.joints))
        """True external torque at the last sample, [N m]."""
        joints = self.facts.settings.joints
        entries = [(at_s, command_of(text, joints)) for at_s, text in script]
        seed = int(np.random.SeedSequence().generate_state(1)[0]) if seed is None else seed
        self._arguments = (arm, seed, speed, entries)
        self._signals, self._paced = made_signals(arm), speed is not None
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


def facts_of(arm: str) -> SourceFacts:
    """Description of a simulated arm."""
    made = ARMS[arm]()
    units = ("N m",) * len(made.joints)
    return SourceFacts(SourceSettings(made.joints, round(1e9 / made.rate_hz), units, "held"), "torque", False)


def made_signals(arm: str) -> tuple[str, ...]:
    return DrivenArm.signals


def write_robot_file(arm: str, folder: Path) -> Path:
    """Write the arm's robot file into a folder and return its path: what an integrator would have of a real arm."""
    path = folder / f"{arm}.xml"
    path.write_text(ARMS[arm]().xml, encoding="utf-8")
    return path
