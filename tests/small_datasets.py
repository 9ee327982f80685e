"""Small synthetic datasets that lack something, and what becomes of each: a healthy bundle or one line of refusal.

A dataset is one of ARMS moved and measured as one of SIGNALS says; its number gives both and the seed.
"""

from __future__ import annotations

import os
import tempfile
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
from made_arms import Part, six_axis, urdf
from made_recordings import Drive, made_motion

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.config import AlarmConfig, PriorConfig, TrainConfig
from tauext.data.dataset import Split, load_dataset, save_split
from tauext.data.recording import Recording
from tauext.data.recording_file import save_recording
from tauext.errors import FaultyDataError, TauextError
from tauext.recipes import RECIPES
from tauext.robot.read import load_tree
from tauext.train.preparation import NOTHING, Start

RATE_HZ = 50.0
LEAST_HEALTHY = 0.98
NM_PER_A = (9.0, 4.0, -2.5, 6.0, 1.5, 3.0, 0.7)
BASE = (0.0, 0.0, 1.0)
WARMING_UP, OK = 0, 1  # health, as `estimate` numbers it


@dataclass(frozen=True)
class Arm:
    """A true arm, and the model of it that the dataset holds."""

    axes: Callable[[int], list[tuple[float, float, float]]]
    """Of so many joints, in the frame of the base at q = 0."""
    least: int = 1
    most: int = 7
    case: str | None = None
    model: Callable[[list[Part], np.random.Generator], list[Part]] = lambda parts, rng: parts
    slides: bool = False
    """The first joint is prismatic."""


def crossed(joints: int) -> list[tuple[float, float, float]]:
    turns = [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)]
    return [turns[k % 4] for k in range(joints)]


def level(joints: int) -> list[tuple[float, float, float]]:
    return [(0.0, 1.0, 0.0)] * joints


def upright(joints: int) -> list[tuple[float, float, float]]:
    return [BASE] * joints


def heavier(parts: list[Part], rng: np.random.Generator) -> list[Part]:
    """Masses off by a factor of up to 5, centres of mass anywhere, rotors forgotten or ten times too large."""
    return [
        replace(
            part,
            mass=part.mass * float(np.exp(rng.uniform(-1.6, 1.6))),
            com=rng.uniform(-0.3, 0.3, 3),
            rotor_inertia=part.rotor_inertia * float(rng.choice([0.0, 1.0, 10.0])),
        )
        for part in parts
    ]


def longer(parts: list[Part], rng: np.random.Generator) -> list[Part]:
    """Links of other lengths."""
    return [replace(part, xyz=part.xyz * rng.uniform(0.2, 3.0)) for part in parts]


def weightless(parts: list[Part], rng: np.random.Generator) -> list[Part]:
    """Links of a gram: a file that was drawn for its looks."""
    return [replace(part, mass=1e-3, inertia=1e-6 * np.eye(3), rotor_inertia=0.0) for part in parts]


ARMS = {
    "one joint": Arm(level, most=1),
    "one upright joint": Arm(upright, most=1),
    "one joint, no model": Arm(level, most=1, case="none"),
    "crossed": Arm(crossed, least=2),
    "crossed, no model": Arm(crossed, least=2, most=3, case="none"),
    "crossed, half the mass": Arm(crossed, least=2, most=6, case="mass+com"),
    "wrong masses": Arm(crossed, least=2, most=5, model=heavier),
    "wrong lengths": Arm(crossed, least=2, most=5, model=longer),
    "weightless links": Arm(crossed, least=1, most=4, model=weightless),
    "parallel": Arm(level, least=3, most=5),
    "parallel, no model": Arm(level, least=3, most=3, case="none"),
    "parallel upright": Arm(upright, least=2, most=4),
    "on a rail": Arm(crossed, least=2, most=4, slides=True),
}


@dataclass(frozen=True)
class Signals:
    """How an arm is moved and measured; `bend` changes a recording after it was made."""

    seconds: float = 26.0
    pieces: int = 2
    drive: Drive = Drive(friction=1.0)
    ranges: float = 1.2
    bend: Callable[[Recording, np.random.Generator], Recording] = lambda recording, rng: recording
    provenance: str = "N m"
    twice: bool = False
    """Every recording stands there a second time under another name."""
    broken: bool = False
    """A NaN is written into the file."""


Bend = Callable[[Recording, np.random.Generator], Recording]


def held(joints: Callable[[int, np.random.Generator], np.ndarray]) -> Bend:
    """These joints keep their first place; their torque stays as it was."""

    def bend(recording: Recording, rng: np.random.Generator) -> Recording:
        still = joints(len(recording.joints), rng)
        q, dq = recording.q.copy(), recording.dq.copy()
        q[:, still], dq[:, still] = q[0, still], 0.0
        return replace(recording, q=q, dq=dq)

    return bend


def torque(change: Callable[[np.ndarray, np.random.Generator], np.ndarray]) -> Bend:
    return lambda recording, rng: replace(recording, tau=change(recording.tau, rng))


def one_way(recording: Recording, rng: np.random.Generator) -> Recording:
    """Every joint turns on and on; torques are friction and noise."""
    speed = rng.uniform(0.1, 0.5, len(recording.joints))
    q = recording.q[0] + recording.time_s[:, None] * speed
    tau = recording.tau.mean(axis=0) + 0.05 * rng.standard_normal(q.shape)
    return replace(recording, q=q, dq=np.tile(speed, (len(q), 1)), tau=tau)


def touched(share: float) -> Bend:
    """Contacts over this share of the time, in runs of a second, with a push on every joint."""

    def bend(recording: Recording, rng: np.random.Generator) -> Recording:
        runs = rng.random(1 + int(recording.duration_s)) < share
        contact = runs[np.minimum(recording.time_s.astype(int), len(runs) - 1)].astype(np.int8)
        return replace(recording, contact=contact, tau=recording.tau - 5.0 * contact[:, None])

    return bend


def gaps(recording: Recording, rng: np.random.Generator) -> Recording:
    """A third of the rows are gone, in stretches of half a second, as an import drops what is NaN."""
    keep = (recording.time_s % 1.5) >= 0.5
    names = ("t_ns", "q", "dq", "tau", "contact")
    return replace(recording, **{name: getattr(recording, name)[keep] for name in names})


def every_other(recording: Recording, rng: np.random.Generator) -> Recording:
    """Rows that repeat the one before."""
    at = np.arange(recording.samples) // 2 * 2
    return replace(recording, q=recording.q[at], dq=recording.dq[at], tau=recording.tau[at])


def one_offset(tau: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    tau = tau.copy()
    tau[:, rng.integers(tau.shape[1])] += 1e4
    return tau


def last_of(value: float) -> Callable[[np.ndarray, np.random.Generator], np.ndarray]:
    return lambda tau, rng: np.column_stack([tau[:, :-1], np.full(len(tau), value)])


def all_of(n: int, rng: np.random.Generator) -> np.ndarray:
    return np.arange(n)


AMPERES = "amperes: the torque constant is unknown"

SIGNALS = {
    "plain": Signals(seconds=45.0),
    "minute": Signals(seconds=64.0, pieces=3),
    "one recording": Signals(pieces=1),
    "few seconds": Signals(seconds=6.0),
    "three seconds": Signals(seconds=3.0, pieces=1),
    "a tenth of a second": Signals(seconds=0.1, pieces=1),
    "many short recordings": Signals(seconds=24.0, pieces=12),
    "first joint still": Signals(bend=held(lambda n, rng: np.array([0]))),
    "last joint still": Signals(bend=held(lambda n, rng: np.array([n - 1]))),
    "one joint moves": Signals(bend=held(lambda n, rng: np.delete(np.arange(n), rng.integers(n)))),
    "nothing moves": Signals(bend=held(all_of)),
    "frozen": Signals(bend=lambda r, rng: replace(held(all_of)(r, rng), tau=np.tile(r.tau[0], (r.samples, 1)))),
    "constant torque": Signals(bend=torque(lambda tau, rng: np.tile(tau[0], (len(tau), 1)))),
    "zero torque": Signals(bend=torque(lambda tau, rng: np.zeros_like(tau))),
    "last torque zero": Signals(bend=torque(last_of(0.0))),
    "last torque constant": Signals(bend=torque(last_of(3.0))),
    "pure noise": Signals(bend=torque(lambda tau, rng: rng.standard_normal(tau.shape))),
    "noise of microunits": Signals(bend=torque(lambda tau, rng: 1e-6 * rng.standard_normal(tau.shape))),
    "huge torques": Signals(bend=torque(lambda tau, rng: 1e7 * tau)),
    "torques turned": Signals(bend=torque(lambda tau, rng: -tau)),
    "one huge offset": Signals(bend=torque(one_offset)),
    "coarse torque": Signals(
        bend=torque(lambda tau, rng: np.round(tau / (0.3 * np.abs(tau).max())) * 0.3 * np.abs(tau).max())
    ),
    "twice the same": Signals(twice=True),
    "same file, no friction, no noise": Signals(drive=Drive(friction=0.0, noise=0.0, velocity_filter_s=0.0)),
    "one way": Signals(bend=one_way),
    "barely moves": Signals(ranges=2e-3),
    "contacts everywhere": Signals(bend=touched(1.0)),
    "contacts half the time": Signals(bend=touched(0.4)),
    "currents": Signals(seconds=32.0, drive=Drive(nm_per_a=NM_PER_A), provenance=AMPERES),
    "currents, few seconds": Signals(seconds=6.0, drive=Drive(nm_per_a=NM_PER_A), provenance=AMPERES),
    "currents of zero": Signals(seconds=32.0, bend=torque(lambda tau, rng: np.zeros_like(tau)), provenance=AMPERES),
    "currents of noise": Signals(
        seconds=32.0, bend=torque(lambda tau, rng: rng.standard_normal(tau.shape)), provenance=AMPERES
    ),
    "gaps": Signals(bend=gaps),
    "NaN in the file": Signals(broken=True),
    "no velocity": Signals(bend=lambda recording, rng: replace(recording, dq=np.zeros_like(recording.dq))),
    "repeated rows": Signals(bend=every_other),
    "friction alone": Signals(bend=lambda r, rng: replace(r, tau=2 * np.tanh(r.dq / 0.02) + r.dq)),
}

COUNT = len(ARMS) * len(SIGNALS)
MAIN = ("prior", "tauext")
OTHERS = tuple(name for name in RECIPES if name not in MAIN)
"""One of them a dataset, in turn."""
SMALL_NETWORK = {"hidden": 2, "max_steps": 20, "batch": 8}
SMALL_PRIOR = PriorConfig(widths_rad=(1e-3, 1e-2), coulomb_speeds_rad_s=(0.03, 0.2), most_ripples=1)


@dataclass(frozen=True)
class Small:
    """One dataset, by its number."""

    number: int

    @property
    def arm_name(self) -> str:
        return list(ARMS)[self.number % len(ARMS)]

    @property
    def signals_name(self) -> str:
        return list(SIGNALS)[self.number // len(ARMS) % len(SIGNALS)]

    @property
    def known_as(self) -> tuple[int, str]:
        return self.number, f"{self.arm_name}: {self.signals_name}"

    @property
    def recipes(self) -> tuple[str, ...]:
        return (*MAIN, OTHERS[self.number % len(OTHERS)])

    def rng(self, of: int = 0) -> np.random.Generator:
        return np.random.default_rng((self.number, of))

    def parts(self) -> list[Part]:
        """The true arm."""
        arm, rng = ARMS[self.arm_name], self.rng()
        axes = arm.axes(int(rng.integers(arm.least, arm.most + 1)))
        like = six_axis()
        return [
            replace(
                like[k % 6],
                joint=f"joint{k + 1}",
                parent=f"joint{k}" if k else None,
                kind="prismatic" if arm.slides and k == 0 else "revolute",
                axis=np.array(axis),
                rpy=np.zeros(3),
                mass=8.0 * 0.7**k,
                inertia=like[k % 6].inertia * 0.7**k / 4,
            )
            for k, axis in enumerate(axes)
        ]

    def write(self, folder: Path, arm: int = 0) -> Path:
        """The dataset's folder; another `arm` of the type differs in friction and motion alone."""
        folder.mkdir(parents=True)
        kind, signals, parts = ARMS[self.arm_name], SIGNALS[self.signals_name], self.parts()
        (folder / "true.urdf").write_text(urdf(parts))
        tree = load_tree(folder / "true.urdf", [part.joint for part in parts])
        (folder / "true.urdf").unlink()
        limit = 'effort="100"' if self.number % 5 == 0 else 'effort="2000"'
        (folder / "robot.urdf").write_text(urdf(kind.model(parts, self.rng(1))).replace('effort="100"', limit))
        drive = replace(signals.drive, friction=signals.drive.friction * (1 + 0.2 * arm))
        made = made_motion(
            tree, signals.seconds / 60, RATE_HZ, self.number + 1000 * arm, signals.pieces, signals.ranges, drive=drive
        )
        rng, names = self.rng(2 + arm), []
        for recording in made.recordings:
            recording = signals.bend(recording, rng)
            recording = replace(recording, provenance=recording.provenance | {"torque": signals.provenance})
            for name in (recording.name, f"{recording.name}-again")[: 1 + signals.twice]:
                save_recording(replace(recording, name=name), folder / f"{name}.parquet")
                names.append(f"{name}.parquet")
        if signals.broken:
            break_file(folder / names[0])
        # A third of the datasets have validation recordings, a third calibration recordings too.
        apart = min(self.number % 3, len(names) - 1)
        train, rest = names[: len(names) - apart], names[len(names) - apart :]
        save_split(Split(tuple(train), tuple(rest[:1]), (), calibration=tuple(rest[1:])), folder)
        return folder

    def config(self, recipe: str) -> TrainConfig:
        """As a user has it, but for a small network; every other dataset has a small prior, too."""
        settings: dict = {"recipe": recipe, "threads": 1}
        row = TrainConfig(recipe=recipe).row
        if row.network is not None:
            settings |= SMALL_NETWORK
        if self.number % 2:
            settings["prior"] = SMALL_PRIOR
        return TrainConfig(**settings)


def break_file(path: Path) -> None:
    """Put a NaN into a column of a recording's file."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    values = table["tau_joint1"].to_numpy().copy()
    values[len(values) // 2 :][:10] = np.nan
    column = table.column_names.index("tau_joint1")
    pq.write_table(table.set_column(column, "tau_joint1", pa.array(values)), path)


@dataclass(frozen=True)
class Ending:
    """What became of one stage of one dataset: a bundle (no message), one line, or a fault."""

    number: int
    words: str
    stage: str
    message: str = ""
    fault: str = ""


def ended(number: int, words: str, stage: str, work: Callable[[], str]) -> Ending:
    """The ending of some work on a dataset, which returns what is wrong with its result, or nothing.

    A warning of NumPy's is a fault, too: it stands on the user's screen, and NaN comes of it.
    """
    message = fault = ""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always", RuntimeWarning)
        try:
            fault = work()
        except FaultyDataError as error:
            message = f"the doctor: {error.findings[0].code}"
        except Exception as error:
            of_core = isinstance(error.__cause__, _core.CoreError) and "refit" not in stage
            if isinstance(error, TauextError) and not of_core:
                message = str(error)
                fault = "" if message and "\n" not in message else f"not one line: {message}"
            else:
                name = "CoreError" if of_core else type(error).__name__
                fault = f"{name}: {' '.join(str(error).split())}\n{traceback.format_exc()}"
    runtime = [one for one in told if issubclass(one.category, RuntimeWarning)]
    if runtime and not fault:
        where = f"{Path(runtime[0].filename).name}:{runtime[0].lineno}"
        fault = f"RuntimeWarning: {runtime[0].message} ({where})"
    return Ending(number, words, stage, message, fault)


def train(small: Small, data: Path, out: Path, recipe: str, accept: Sequence[str] = (), start: Start = NOTHING) -> str:
    """Train as the command line does; what is wrong with the bundle, or nothing."""
    from tauext.train.stage import train_bundle

    dataset = load_dataset(data)
    train_bundle(dataset, out, ARMS[small.arm_name].case, None, small.config(recipe), accept=accept, start=start)
    return unhealthy(out, dataset.training())


def unhealthy(path: Path, training: Sequence[Recording]) -> str:
    """Nothing, where the bundle loads and is healthy on its own training motion."""
    bundle = load_bundle(path)
    healthy = counted = 0
    for recording in training:
        said = _core.estimate(bundle, recording.t_ns, recording.q, recording.dq, recording.tau, 1, None)
        ok, warm = said["health"] == OK, said["health"] != WARMING_UP
        if not np.isfinite(said["tau_ext"][ok]).all():
            return f"{recording.name}: tau_ext of healthy samples is not finite"
        healthy, counted = healthy + int(ok.sum()), counted + int(warm.sum())
    if healthy < LEAST_HEALTHY * counted:
        return f"healthy on {healthy} of {counted} samples of its own training motion"
    return ""


def endings(small: Small, folder: Path) -> Iterator[Ending]:
    """Train a dataset by its recipes, with what the doctor minds accepted, and use what comes of it."""
    from tauext.check.finding import codes

    data = small.write(folder / "data")
    for recipe in small.recipes:
        out = folder / f"{recipe}.tauext"
        yield (first := ended(*small.known_as, recipe, lambda out=out, recipe=recipe: train(small, data, out, recipe)))
        if first.message.startswith("the doctor"):
            work = lambda out=out, recipe=recipe: train(small, data, out, recipe, tuple(codes()))  # noqa: E731
            yield ended(*small.known_as, f"{recipe} --accept", work)
        if out.is_file():
            yield from uses(small, data, out)


def uses(small: Small, data: Path, bundle: Path) -> Iterator[Ending]:
    """Refit, calibrate, weigh and correct the constants on the bundle's own dataset."""
    from tauext.check.finding import codes
    from tauext.cli.load import load
    from tauext.train.calibrate import recalibrate
    from tauext.train.refit import refit_bundle

    dataset, recipe, accept = load_dataset(data), bundle.stem, tuple(codes())
    train, recording = dataset.split.train, data / dataset.split.train[0]

    def refitted() -> str:
        out = bundle.with_name(f"{recipe}-refit.tauext")
        refit_bundle(bundle, data, out, threads=1, accept=accept)
        return unhealthy(out, dataset.training())

    def calibrated() -> str:
        out, new_scale = bundle.with_name(f"{recipe}-calibrated.tauext"), len(train) > 1 and small.number % 4 == 0
        own = replace(dataset, split=replace(dataset.split, train=(), validation=(), calibration=train))
        recalibrate(bundle, own, out, AlarmConfig(), 1, refit_error_scale=new_scale, accept=accept)
        return unhealthy(out, dataset.training())

    def weighed(known_kg: float | None) -> str:
        out = None if known_kg is None else bundle.with_name(f"{recipe}-weighed.tauext")
        with open(os.devnull, "w") as nowhere, redirect_stdout(nowhere):
            load(bundle, (recording,), known_kg=known_kg, out=out)
        if out is not None:
            load_bundle(out)
        return ""

    if recipe in (*MAIN, "friction"):
        yield ended(*small.known_as, f"{recipe}, refit", refitted)
    yield ended(*small.known_as, f"{recipe}, calibrate", calibrated)
    yield ended(*small.known_as, f"{recipe}, load", lambda: weighed(None))
    yield ended(*small.known_as, f"{recipe}, load --known-kg", lambda: weighed(1.0))


def of_number(number: int) -> list[Ending]:
    """All endings of one dataset, in a folder of its own."""
    with tempfile.TemporaryDirectory() as folder:
        return list(endings(Small(number), Path(folder)))
