"""A plug-in: a robot of your own for `tauext monitor` and `commission`, and a command.

    pip install ./examples/04_plugin
    tauext commission --source my-arm:HOST --out cell7
    tauext monitor ARM.tauext --source my-arm:HOST --amplitude-rad 0.3
    tauext my-arm ARM.tauext --seconds 10

pyproject.toml names KIND and COMMAND as entry points; tauext needs nothing else. No arm is attached: a sine of each
joint stands in for it where the comment says YOUR ARM.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

import tauext
from tauext.cli.commands import Command
from tauext.config import require
from tauext.errors import ConfigError
from tauext.monitor.loop import Loop, LoopSettings
from tauext.monitor.sink import LoopReport, Verdict
from tauext.monitor.source import Sample, Source, SourceCounts, SourceFacts, SourceSettings
from tauext.sources.describing import joint_names
from tauext.sources.open import Option, SourceKind

JOINTS, PERIOD_NS = ("shoulder", "elbow"), 10_000_000


class MyArm:
    """A sample a period, by the clock of this computer."""

    ended = False

    def __init__(self, host: str, amplitude_rad: float):
        self.name = f"my arm {host}"
        self.counts, self._amplitude_rad = SourceCounts(), amplitude_rad

    def describe(self, wait_s: float, robot: Path | None = None) -> SourceFacts:
        # YOUR ARM: connect, ask for number of joints, rate and unit of the torque, and disconnect.
        joints, notes = joint_names(JOINTS, robot, self.name)
        settings = SourceSettings(joints, PERIOD_NS, ("N m",) * len(joints), "instant")
        return SourceFacts(settings, "torque", temperature=False, notes=notes)

    def open(self, settings: SourceSettings) -> None:
        if others := set(settings.torque_units) - {"N m"}:
            raise ConfigError(f"{self.name} measures torques in N m, the bundle has {', '.join(sorted(others))}")
        self._speed = 1.0 + 0.3 * np.arange(len(settings.joints))
        self._period_ns, self._due_ns = settings.period_ns, time.monotonic_ns()

    def next_sample(self, timeout_s: float) -> Sample | None:
        left_s = (self._due_ns - time.monotonic_ns()) * 1e-9
        time.sleep(max(0.0, min(left_s, timeout_s)))
        if left_s > timeout_s:
            return None
        # YOUR ARM: read q [rad], dq [rad/s], tau [N m] and the time at which they were measured.
        t_ns, self._due_ns = self._due_ns, self._due_ns + self._period_ns
        angle = self._speed * t_ns * 1e-9
        q, dq = self._amplitude_rad * np.sin(angle), self._amplitude_rad * self._speed * np.cos(angle)
        self.counts.received += 1
        return Sample(t_ns, q, dq, 2.0 * dq, time.monotonic_ns())

    def notes(self) -> list[str]:
        return []

    def close(self) -> None:
        pass


class Printer:
    """Prints what changes."""

    def open(self, joints: tuple[str, ...], control: object) -> None:
        self._joints = joints

    def verdict(self, verdict: Verdict) -> None:
        for change in verdict.changes:
            print(f"sample {change.row}: {change}")

    def every_second(self, report: LoopReport) -> None:
        print(f"{report.rate_hz:.0f} Hz, {report.missing} missing, reported after {report.tick_p99_us:.0f} us (p99)")

    def close(self) -> None:
        pass


def open_arm(target: str, bundle: tauext.Bundle | None, amplitude_rad: float = 0.5) -> Source:
    """Called for --source my-arm:HOST; it does not connect yet."""
    require(0 < amplitude_rad <= 1, "amplitude_rad", amplitude_rad, "> 0, at most 1")
    return MyArm(target, amplitude_rad)


AMPLITUDE = Option("amplitude_rad", float | None, "with --source my-arm, amplitude of its motion, [rad]. None: 0.5.")
KIND = SourceKind(open_arm, "HOST", (AMPLITUDE,))


def watch(
    bundle: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="ARM.tauext")], seconds: float = 10.0
) -> None:
    """Run a bundle on this arm, and print what changes.

    Args:
        bundle: bundle (*.tauext) to run.
        seconds: time after which the command ends, [s].
    """
    settings = LoopSettings(duration_s=seconds)
    loop = Loop(tauext.load_bundle(bundle), MyArm("localhost", 0.5), [Printer()], settings=settings)
    loop.run()
    print(f"{loop.samples} samples")


COMMAND = Command("run a bundle on my arm", "my_arm:watch")
