"""One case: a folder, a command line and what is hostile about it, all drawn from a seed and the case's number."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hostile.damage import damage
from hostile.values import PLACES, hostile_value, hostile_words, keys_of, options_of
from tauext.cli import command_of
from tauext.cli.commands import all_commands
from tauext.config import TrainConfig

VERBS = [
    [name, *within]
    for name, command in all_commands().items()
    for within in [[one] for one in command.commands] or [[]]
]
OPTIONS = {" ".join(verb): options_of(command_of(verb)[1]) for verb in VERBS}
OPTIONS["fleet run"] = [option for option in OPTIONS["fleet run"] if option.name != "--dry-run"]
KEYS = keys_of(TrainConfig)
# What works and is soon done; {} takes a file where a reader is tried.
SIMULATE = "simulate --out out/data --minutes 1 --collision-recordings 0"
TRAIN = "train --data data --out out/a.tauext --recipe observer"
PRIOR = "train --data data --out out/a.tauext --recipe prior"
NETWORK = "train --data data --out out/a.tauext --recipe tauext --max-steps 2 --batch 4"
EVALUATE = "evaluate --data data --out out/results --bundles observer.tauext"
CALIBRATE = "calibrate --bundle prior.tauext --data hours --out out/a.tauext"
REFIT = "refit prior.tauext --data data/free-000.parquet --out out/a.tauext"
CHECK = "check --data data/free-000.parquet --robot robot.xml --out out/check"
REPORT = "report --results results --data data --out out/report --page-mb 1"
FLIGHT = "report --flight flights --out out/report --page-mb 1"
RUN = "run observer.tauext data/free-006.parquet data/free-007.parquet --flights out/flights"
MONITOR = "monitor observer.tauext --source replay:data/free-006.parquet --speed 20 --duration-s 0.3"
LOAD = "load observer.tauext data/free-006.parquet"
LOAD_KNOWN = LOAD + " --known-kg 1 --out out/a.tauext"
CARRYING = "run prior.tauext data/free-006.parquet --loads loads.toml"
LIKE = "train --data data --out out/a.tauext --recipe prior --like arm.prior.json"
OWN = "train --data data --out out/a.tauext --recipe paper --network own.npz"
REFIT_LIKE = REFIT + " --like arm.prior.json"
FLEET = "fleet run fleet.toml --out out/fleet --dry-run"  # Ray needs more threads and memory than a case has
FLEET_PRIOR = "fleet prior data data-2 data-3 --out out/a.prior.json"
RECORD = MONITOR + " --record out/record --flights out/flights"
IMPORT = "import --source arm.csv --arm table.toml --out out/imported"
LEROBOT = IMPORT + " --format lerobot"
LABEL = "label --dataset servos-v3.0 --bundle servos.tauext --arm servos.toml --out out/labelled"
FEETECH = "monitor servos.tauext --source feetech:/dev/null --cell {} --duration-s 0.2"
DYNAMIXEL = "monitor servos.tauext --source dynamixel:/dev/null --cell {} --duration-s 0.2"
DAMIAO = "monitor observer.tauext --source damiao:hostile --cell {} --duration-s 0.2"
NEW = "import --new out/arm.toml --source arm.csv --robot robot.xml"
GOOD = (SIMULATE, TRAIN, PRIOR, NETWORK, EVALUATE, CALIBRATE, CHECK, REPORT, FLIGHT, RUN, MONITOR, RECORD)
GOOD += (LOAD, REFIT, LOAD_KNOWN, LIKE, OWN, REFIT_LIKE, CARRYING)
GOOD += (FLEET, FLEET_PRIOR, "fleet example --out out/fleet.toml", "fleet example")
GOOD += (IMPORT, LEROBOT, NEW, "show observer.tauext", "reproduce --scale smoke --out out/all --cases exact")
GOOD += (LABEL, LABEL + " --json", FEETECH.format("bus.toml"), DAMIAO.format("can.toml"))
GOOD += (
    "commission --source replay:data/free-006.parquet --out out/cell",
    "commission --source sim:rig --out out/cell",
)
RARE = {"commission": 0.1, "reproduce": 0.1, "report": 0.2, "evaluate": 0.4, "calibrate": 0.3, "check": 0.4}
RARE |= {"fleet prior": 0.1}
RARE |= {"results": 0.2, "flight": 0.4, "run.json": 0.4}
"""Commands and readers whose good lines take seconds come so much less often."""
WRITERS: tuple[str, ...] = (
    SIMULATE, TRAIN, NETWORK, EVALUATE, CHECK, REPORT, FLIGHT, RUN, RECORD, IMPORT, LEROBOT, NEW,
)  # fmt: skip
WRITERS += (LABEL,)
WRITERS += (FLEET_PRIOR, "fleet example --out out/fleet.toml")
BUNDLE = ("show {}", "show {}", "run {} data/free-006.parquet", "evaluate --data data --out out/results --bundles {}")
BUNDLE += ("calibrate --bundle {} --data hours --out out/a.tauext",)
BUNDLE += ("refit {} --data data/free-000.parquet --out out/a.tauext",)
BUNDLE += ("monitor {} --source replay:data/free-006.parquet --speed 50 --duration-s 0.2",)
RECORDING = ("show {}", "show {}", "run observer.tauext {}", "check --data {} --robot robot.xml", TRAIN, CHECK)
RECORDING += (
    "refit prior.tauext --data {} --out out/a.tauext",
    "monitor observer.tauext --source replay:{} --speed 50 --duration-s 0.2",
    "import --source {} --new out/arm.toml",
)
ROBOT = ("check --data data/free-000.parquet --robot {}", "import --new out/arm.toml --source arm.csv --robot {}")
ROBOT += ("train --data data --out out/a.tauext --recipe observer --robot {}",)
RAW = ("import --source {} --arm table.toml --out out/imported", "import --source {} --new out/arm.toml")
ARRAYS = ("import --source {} --arm arrays.toml --out out/imported", "import --source {} --new out/arm.toml")
BAG = ("import --source {} --arm topics.toml --out out/imported", "import --source {} --new out/arm.toml")
# Reader: its files, of which one is damaged, and commands that read it.
READERS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "bundle": (("observer.tauext", "prior.tauext", "tauext.tauext"), BUNDLE),
    "recording": (("data/free-000.parquet",), RECORDING),
    "contacts": (("data/collisions-000.parquet",), (EVALUATE, "run observer.tauext {}", "show {}")),
    "split.json": (("data/split.json",), (TRAIN, EVALUATE, "check --data data", REPORT, CALIBRATE)),
    "run.json": (("data/run.json",), ("simulate --out data --minutes 1 --collision-recordings 1",)),
    "MJCF": (("robot.xml",), ROBOT),
    "URDF": (("robot.urdf",), ROBOT),
    "csv": (("arm.csv",), RAW),
    "parquet": (("arm.parquet",), RAW),
    "hdf5": (("arm.h5",), ARRAYS),
    "mat": (("arm.mat",), ARRAYS),
    "bag of ROS 1": (("arm.bag",), BAG),
    "bag of ROS 2": (
        ("arm/arm.db3", "arm/metadata.yaml"),
        ("import --source arm --arm topics.toml --out out/imported", BAG[1]),
    ),
    "mcap": (("arm-mcap/arm-mcap.mcap",), BAG),
    "lerobot": (
        ("lerobot/meta/info.json", "lerobot/data/*/*.parquet", "lerobot/meta/episodes/*/*.parquet"),
        ("import --source lerobot --new out/arm.toml",),
    ),
    "labelled": (
        ("servos-v3.0/meta/*", "servos-v3.0/data/*/*.parquet", "servos-v3.0/meta/episodes/*/*.parquet"),
        (LABEL, LABEL + " --into features"),
    ),
    "labelled, of v2.1": (
        ("servos-v2.1/meta/*", "servos-v2.1/data/*/*.parquet"),
        (LABEL.replace("v3.0", "v2.1"), LABEL.replace("v3.0", "v2.1") + " --into features"),
    ),
    "servos": (("servos.toml",), (LABEL, "import --source servos-v3.0 --arm {} --out out/imported")),
    "servo bundle": (("servos.tauext",), (LABEL, "show {}")),
    "servo recording": (("servos/*.parquet", "servos/split.json"), (TRAIN.replace("--data data", "--data servos"),)),
    "calibration": (
        ("calibration.json",),
        (LABEL, LABEL + " --calibration {}", FEETECH, DYNAMIXEL, FEETECH.format("bus.toml")),
    ),
    "bus": (("bus.toml",), (FEETECH, DYNAMIXEL)),
    "CAN bus": (("can.toml",), (DAMIAO,)),
    "arm.toml": (("table.toml",), (IMPORT, IMPORT, LEROBOT)),
    "FLEET.toml": (("fleet.toml",), (FLEET, FLEET + " --json")),
    "fleet prior": (("arm.prior.json",), ("show {}", "show {} --json", "show {}", LIKE, REFIT_LIKE)),
    "network weights": (("own.npz",), (OWN,)),
    "loads": (("loads.toml",), (CARRYING,)),
    "results": (("results/results.json", "results/results.json", "results/estimates/*/*.parquet"), (REPORT,)),
    "flight": (("flights/*.parquet",), (FLIGHT,)),
    "reactions": (("reactions.toml",), (MONITOR + " --cell {}",)),
    "profiles": (("profiles.toml",), (MONITOR + " --cell {}",)),
    "constants": (("constants.toml",), ("monitor observer.tauext --source ur:127.0.0.1 --torque-constants {}",)),
    "any place": (
        (),
        (
            "show {}",
            "run {} data/free-006.parquet",
            "run observer.tauext {}",
            "check --data {}",
            "train --data {} --out out/a.tauext --max-steps 20",
            "report --flight {} --out out/r",
            "report --results {} --data data --out out/r",
            "import --source {} --new out/a.toml",
            "import --source arm.csv --arm {} --out out/i",
            "check --data data/free-000.parquet --robot {}",
            "run prior.tauext data/free-006.parquet --loads {}",
            "train --data data --out out/a.tauext --recipe prior --like {}",
            "train --data data --out out/a.tauext --recipe paper --network {}",
            "refit prior.tauext --data data/free-000.parquet --out out/a.tauext --like {}",
            "fleet run {} --out out/fleet --dry-run",
            "fleet prior {} data data-2 --out out/a.prior.json",
            MONITOR + " --cell {}",
            LABEL.replace("servos-v3.0", "{}"),
            LABEL.replace("servos.tauext", "{}"),
            LABEL.replace("servos.toml", "{}"),
            LABEL + " --calibration {}",
            FEETECH,
            DAMIAO,
            "monitor observer.tauext --source replay:{}",
            "evaluate --data data --out out/r --bundles {}",
        ),
    ),
}
FILE_LIMITS = (2000, 5000, 30_000, 100_000)
"""Standard output and error are files, too, and bear two thousand bytes."""


@dataclass(frozen=True)
class Case:
    """What is run, and why it is hostile."""

    kind: str
    """settings, options, output, or the reader."""
    arguments: list[str]
    what: str
    largest_file: int | None = None
    """Writing beyond it fails, as on a full disk, [bytes]."""

    @property
    def command(self) -> str:
        return verb_of(self.arguments)


def lay_out(good: Path, folder: Path, full: Path | None) -> None:
    """The good files as links, and hostile places, in a folder that is made."""
    for source in good.rglob("*"):
        place = folder / source.relative_to(good)
        if source.is_dir():
            place.mkdir(parents=True, exist_ok=True)
        else:
            place.symlink_to(source)
    for name in ("empty", "read-only", "out"):
        (folder / name).mkdir()
    (folder / "read-only").chmod(0o555)
    os.mkfifo(folder / "pipe")
    (folder / "loop").symlink_to("loop")
    if full is not None:
        (folder / "full").symlink_to(full)


def make_case(seed: int, number: int, folder: Path, only: str = "") -> Case:
    """Draw the case and damage what it damages; the current folder is `folder`, and is laid out."""
    rng = np.random.default_rng([seed, number])
    share = rng.random()
    if only:
        share = {"settings": 0.0, "options": 0.1, "output": 0.4}.get(only, 0.9)
    if share < 0.05:
        return of_settings(rng)
    if share < 0.35:
        return of_options(rng)
    if share < 0.45:
        return of_output(rng)
    return of_reader(rng, only if only in READERS else drawn(tuple(READERS), rng), folder)


def of_options(rng: np.random.Generator) -> Case:
    """One to three options of a command with hostile values."""
    arguments = drawn(GOOD, rng).split()
    command = verb_of(arguments)
    told = []
    for option in rng.choice(np.array(OPTIONS[command], dtype=object), int(rng.choice([1, 1, 1, 2, 3]))):
        words = hostile_words(option, rng)
        arguments = without(arguments, option.name) + words
        told.append(" ".join(words)[:80])
    return Case("options", arguments, " ".join(told))


def of_settings(rng: np.random.Generator) -> Case:
    """A file of settings with one hostile value, as it stands or as text."""
    name, kind = KEYS[int(rng.integers(len(KEYS)))]
    value = hostile_value(kind, rng)
    line = f"{name} = {value if rng.random() < 0.7 else json.dumps(value)}\n"
    Path("study.toml").write_text(line, errors="surrogateescape")
    command = str(rng.choice([TRAIN, CALIBRATE]))
    return Case("settings", [*command.split(), "--config", "study.toml"], line[:80])


def drawn(choices: tuple[str, ...], rng: np.random.Generator) -> str:
    """One of the command lines or readers; what takes long less often."""
    while True:
        chosen = str(rng.choice(choices))
        if rng.random() < RARE.get(chosen, RARE.get(verb_of(chosen.split()), 1.0)):
            return chosen


def verb_of(arguments: list[str]) -> str:
    """The command, of two words where it has them."""
    return " ".join(arguments[: 1 + (arguments[0] == "fleet")])


def without(arguments: list[str], name: str) -> list[str]:
    """The arguments without an option and its values."""
    if name not in arguments:
        return arguments
    k = arguments.index(name)
    end = k + 1
    while end < len(arguments) and not arguments[end].startswith("--"):
        end += 1
    return arguments[:k] + arguments[end:]


def of_output(rng: np.random.Generator) -> Case:
    """A place that cannot be written to, or a disk that is full at some point."""
    arguments = drawn(WRITERS, rng).split()
    if rng.random() < 0.5:
        limit = int(rng.choice(FILE_LIMITS))
        return Case("output", arguments, f"no file beyond {limit} bytes", limit)
    outs = [k for k, word in enumerate(arguments) if word.startswith("out/")]
    k = int(rng.choice(outs))
    place = str(rng.choice(PLACES))
    if rng.random() < 0.5 and arguments[k].endswith(".tauext"):
        place += ".tauext"
    arguments[k] = place
    return Case("output", arguments, f"{arguments[k - 1]} {place[:60]!r}")


def of_reader(rng: np.random.Generator, reader: str, folder: Path) -> Case:
    """A damaged file, and a command that reads it."""
    patterns, lines = READERS[reader]
    line = str(rng.choice(lines))
    if not patterns:
        place = str(rng.choice(PLACES))
        arguments = [word.replace("{}", place) for word in line.split()]
        return Case(reader, arguments, f"{place[:60]!r}")
    files = [file for pattern in patterns for file in sorted(folder.glob(pattern))]
    file = files[int(rng.integers(len(files)))]
    source = file.resolve()
    file.unlink()
    shutil.copyfile(source, file)
    told = damage(file, rng)
    if rng.random() < 0.2:
        told += f"; {damage(file, rng)}" if file.stat().st_size else ""
    name = str(file.relative_to(folder))
    return Case(reader, [word.replace("{}", name) for word in line.split()], f"{name}: {told}")
