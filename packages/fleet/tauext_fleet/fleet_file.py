"""FLEET.toml: arms, common settings, stages; checked before anything runs."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

from tauext.check.before_training import expect_codes
from tauext.config import NOT_EMPTY, CaseName, Rule, TrainConfig
from tauext.data.dataset import ROBOT_FILES, SETS, load_dataset
from tauext.errors import ConfigError
from tauext.files.plain_file import read_toml
from tauext.files.typed_table import OneOrMore, Text, expect_known, read_table, value_of
from tauext.robot.capsules import SHAPES_FILE
from tauext_fleet.config import CalibrateStage, EvaluateStage
from tauext_fleet.locations import Location, files_in, local_copy, located, locations_of, model_of, named_files
from tauext_fleet.store import Stored
from tauext_fleet.task import Contents

# --- Template of a FLEET.toml.


EXAMPLE = """\
# A fleet: which arms there are, and what is done with their recordings. Paths count from this file's folder.
# `tauext fleet run FLEET.toml --out fleet` does it; --dry-run prints what it would do, and why.

stages = ["import", "check", "train", "calibrate", "evaluate"]   # or fewer; these are all, and what holds if left out

# For all arms. [types.NAME] is for the arms of a type, an arm's own table for that arm: the last one counts.
[train]                     # settings of a training; `tauext train --help-config` lists them
recipe = "prior"
alarm = { false_alarms = 1.0, in_hours = 8.0 }

[evaluate]                  # the options of `tauext evaluate`: seed, keep_free_estimates, shortest_event_s, tolerance_s
keep_free_estimates = 5

[types.ur10e]
arm = "ur10e.toml"          # description of its recordings: `tauext import --new ur10e.toml` writes one
# robot = "ur10e.urdf"      # instead of the dataset's own, as for `tauext train`
# train.like = "ur10e.prior.json"   # prior from a fleet of this type: a minute of a new arm is enough
# case = "none"             # model case: exact, mass, com, mass+com, none
# accept = ["payload"]      # codes of faults to accept

[[arms]]
name = "cell-01"            # names its folder and its bundle
type = "ur10e"
sources = ["bags/cell-01/*.mcap"]   # files and folders of any format that `tauext import` reads; *, ? and ** as usual

[[arms]]
name = "cell-02"
type = "ur10e"
sources = ["bags/cell-02"]
arm = "cell-02.toml"        # another tool, another logger
train.minutes = 20          # what differs for this arm

[[arms]]
name = "cell-03"
type = "ur10e"
dataset = "datasets/cell-03"        # imported or simulated already, instead of sources
calibration = "datasets/cell-03-nights"  # the stage calibrate: new thresholds, on the calibration recordings of another
calibrate = { false_alarms = 1.0, in_hours = 24.0 }   # dataset, for another rate, or both; else train's thresholds stay
"""


# --- FLEET.toml: arms, common settings by type, and the stages; all of it is checked before anything runs.


if TYPE_CHECKING:
    from tauext_fleet.like import Like

Stage = Literal["import", "check", "train", "calibrate", "evaluate"]
STAGES = get_args(Stage)
"""In their order; docs/reference/files.md lists what each needs."""
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,99}")
NAME_RULE = "1 to 100 letters, digits, dots, dashes, underscores: it names a folder and a bundle"


PlainText = Annotated[Text, Rule("", lambda value: "\0" not in value)]
TABLES = ("train", "calibrate", "evaluate")
ONE_THREAD = "each task has one thread, and --workers sets how many run at a time"


@dataclass(frozen=True)
class TrainStage(TrainConfig):
    """Settings of a fleet's stage train."""

    like: PlainText | None = None
    """Fleet prior that the training starts from; None: none."""

    @property
    def config(self) -> TrainConfig:
        """The settings of `tauext train`."""
        return TrainConfig(**{name: getattr(self, name) for name in TrainConfig.__dataclass_fields__})


@dataclass(frozen=True)
class SharedKeys:
    """Keys at the top for all arms, in [types.NAME] for those of a type, or at an arm; the most specific one wins."""

    arm: PlainText | None = None
    robot: PlainText | None = None
    case: CaseName | None = None
    accept: OneOrMore[PlainText] = ()
    stages: Annotated[OneOrMore[Stage], NOT_EMPTY] = STAGES
    train: TrainStage = TrainStage()
    calibrate: CalibrateStage = CalibrateStage()
    evaluate: EvaluateStage = EvaluateStage()


@dataclass(frozen=True)
class ArmKeys(SharedKeys):
    """Keys of an arm, [[arms]]."""

    name: Annotated[str, Rule(f", {NAME_RULE}", NAME.fullmatch)] = field(kw_only=True)
    type: str = ""
    sources: OneOrMore[PlainText] = ()
    dataset: PlainText | None = None
    calibration: PlainText | None = None


@dataclass(frozen=True)
class Arm:
    """One arm of a fleet with all of its settings; paths are absolute."""

    name: str
    type: str
    stages: tuple[str, ...]
    """Its stages, in order."""
    sources: tuple[Location, ...] = ()
    """Files to import, described by `description`; none: `dataset` exists already."""
    description: Location | None = None
    """Its arm.toml."""
    dataset: Location | None = None
    calibration: Location | None = None
    """Dataset whose calibration recordings the stage calibrate uses; None: those of the arm's own dataset."""
    robot: Location | None = None
    case: CaseName | None = None
    accept: tuple[str, ...] = ()
    train: TrainConfig = TrainConfig()
    like: Location | None = None
    """Fleet prior that its training starts from; None: none."""
    calibrate: CalibrateStage = CalibrateStage()
    evaluate: EvaluateStage = EvaluateStage()


@dataclass(frozen=True)
class Fleet:
    """The content of FLEET.toml."""

    path: Path
    arms: tuple[Arm, ...]


def load_fleet(path: Path) -> Fleet:
    """Read a FLEET.toml; every key, value and path in it is checked, and no recording is read.

    Raises:
        ConfigError: no such file, not TOML, an unknown key, a value of the wrong type or against its rule, two arms of
            one name, a file that is not there.
    """
    content = read_toml(path, "`tauext fleet example` prints one")
    shared = [one.name for one in fields(SharedKeys)]
    expect_known(f"{path}:", content, (*shared, "types", "arms"))
    top = {key: value for key, value in content.items() if key in shared}
    types = value_of(dict[str, dict], content.get("types", {}), f"{path}:", "types")
    for name, table in types.items():
        expect_known(f"{path}: [types.{name}]", table, shared)
    listed = content.get("arms")
    if not isinstance(listed, list) or not listed:
        raise ConfigError(f"{path}: arms is missing; it must be one or more tables [[arms]]")
    base = path.absolute().parent
    arms = tuple(arm_of(one, number, top, types, path, base) for number, one in enumerate(listed, 1))
    expect_different(arms, path)
    expect_likes(arms, path)
    return Fleet(path, arms)


def arm_of(table: Any, number: int, top: Mapping[str, Any], types: Mapping[str, Any], path: Path, base: Path) -> Arm:
    """One arm from its own table, that of its type, and the top-level keys."""
    expect_known(f"{path}: arm {number}:", table, [one.name for one in fields(ArmKeys)])
    kind, where = table.get("type", ""), f"{path}: arm '{table.get('name', number)}':"
    if types and kind not in types:
        raise ConfigError(f"{where} type = {kind!r} must be one of {', '.join(types)}, which have tables [types.NAME]")
    merged = merged_tables(top, merged_tables(types.get(kind, {}), table))
    for key in TABLES:
        if isinstance(own := merged.get(key), dict) and "threads" in own:
            raise ConfigError(f"{where} [{key}] threads is not set here: {ONE_THREAD}")
    keys = read_table(ArmKeys, merged, where)
    like = None if keys.train.like is None else located(keys.train.like, base)
    arm = Arm(
        keys.name,
        keys.type,
        stages=(),
        case=keys.case,
        accept=keys.accept,
        train=keys.train.config,
        like=like,
        calibrate=keys.calibrate,
        evaluate=keys.evaluate,
    )
    try:
        expect_codes(arm.accept)
    except ConfigError as error:
        raise ConfigError(f"{where} {error}") from None
    arm = with_data(arm, keys, where, base)
    calibrates = arm.calibration is not None or "calibrate" in merged
    return replace(arm, stages=stages_of(keys.stages, arm, calibrates, where))


def with_data(arm: Arm, keys: ArmKeys, where: str, base: Path) -> Arm:
    """The arm with its recordings and files, all of which exist."""
    dataset, calibration, robot, description = (
        None if name is None else located(name, base) for name in (keys.dataset, keys.calibration, keys.robot, keys.arm)
    )
    patterns = keys.sources
    if bool(patterns) == (dataset is not None):
        raise ConfigError(f"{where} give either sources (with arm, their arm.toml) or dataset, and not both")
    sources: list[Location] = []
    for pattern in patterns:
        found = locations_of(pattern, base)
        if not found or not all(one.exists() for one in found):
            raise ConfigError(f"{where} sources = '{pattern}': there is no such file or folder")
        sources += [one for one in found if one not in sources]
    description = description if patterns else None
    if patterns and description is None:
        raise ConfigError(f"{where} arm is missing, the arm.toml of its sources; `tauext import --new` writes one")
    try:
        if description is not None and (model := model_of(description)) is not None and not model.is_file():
            raise ConfigError(f"{description}: [robot] model = '{model}': there is no such file")
        for folder in (dataset, calibration):
            if folder is not None:
                expect_dataset(folder)
    except ConfigError as error:
        raise ConfigError(f"{where} {error}") from None
    if robot is not None and not robot.is_file():
        raise ConfigError(f"{where} robot = '{robot}': there is no such file; give a URDF or MJCF")
    return replace(
        arm, sources=tuple(sources), description=description, dataset=dataset, calibration=calibration, robot=robot
    )


def expect_dataset(folder: Location) -> None:
    """Raise ConfigError unless it is a dataset; the worker of a stored one checks the rest."""
    if isinstance(folder, Path):
        load_dataset(folder)
    elif not (folder / "split.json").is_file():
        raise ConfigError(f"{folder}: no dataset is there: it has no split.json; `tauext import` makes one")


def stages_of(wanted: Sequence[str], arm: Arm, calibrates: bool, where: str) -> tuple[str, ...]:
    """The stages that this arm has: the requested ones, without import where it has a dataset, and with calibrate only
    where its recordings or its promise are given; train finds limits itself."""
    if arm.sources and "import" not in wanted:
        raise ConfigError(f"{where} stages lack import, which its sources need; or give a dataset")
    for stage in ("calibrate", "evaluate"):
        if stage in wanted and "train" not in wanted:
            raise ConfigError(f"{where} stages lack train, which {stage} needs")
    left_out = {"import": not arm.sources, "calibrate": not calibrates}
    return tuple(stage for stage in STAGES if stage in wanted and not left_out.get(stage, False))


def expect_different(arms: tuple[Arm, ...], path: Path) -> None:
    """Raise ConfigError where two arms would write to one folder, even on a disk that ignores case."""
    seen: dict[str, str] = {}
    for arm in arms:
        other = seen.setdefault(arm.name.lower(), arm.name)
        if other != arm.name or sum(one.name == arm.name for one in arms) > 1:
            names = f"'{arm.name}'" if other == arm.name else f"'{other}' and '{arm.name}'"
            raise ConfigError(f"{path}: two arms are named {names}; names must differ, capitals aside")


def expect_likes(arms: tuple[Arm, ...], path: Path) -> None:
    """Raise ConfigError of a fleet prior that is none, or that an arm's recipe cannot take."""
    from tauext_fleet.like import load_like

    priors: dict[Location, Like] = {}
    for arm in arms:
        if arm.like is None:
            continue
        try:
            if arm.like not in priors:
                with local_copy(arm.like) as prior:
                    priors[arm.like] = load_like(prior)
            priors[arm.like].settings(arm.train)
        except ConfigError as error:
            raise ConfigError(f"{path}: arm '{arm.name}': [train] {error}") from None


def merged_tables(under: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """The keys of both tables, those of tables within too; the second one has priority."""
    found = dict(under)
    for key, value in over.items():
        both = isinstance(value, dict) and isinstance(found.get(key), dict)
        found[key] = merged_tables(found[key], value) if both else value
    return found


# --- What a stage depends on, by readable names: contents of files, settings, and tasks before it.


def files_of(arm: Arm) -> Iterator[Location]:
    """All files that anything of this arm depends on."""
    yield from source_files(arm).values()
    for name in ("dataset", "calibration"):
        folder = getattr(arm, name)
        yield from dataset_files(folder, name).values() if folder else ()
    yield from robot_files(arm.robot).values()
    yield from like_files(arm).values()


def source_files(arm: Arm) -> dict[str, Location]:
    """Input files of an import: sources, description, and the robot file that this names."""
    if arm.description is None:
        return {}
    found = {"arm.toml": arm.description} | robot_files(model_of(arm.description))
    for source in arm.sources:
        for below, file in files_in(source).items():
            name = f"{source.name}/{below}" if below else source.name
            found[f"source {name}" if f"source {name}" not in found else f"source {file}"] = file
    return found


def dataset_files(folder: Location, what: str) -> dict[str, Location]:
    """Split, robot file and recordings of a dataset, each once; of a stored one, all files of the folder."""
    if isinstance(folder, Stored):
        return {f"{what} {name}": file for name, file in files_in(folder).items()}
    dataset = load_dataset(folder)
    there = [folder / name for name in ("split.json", *ROBOT_FILES, SHAPES_FILE) if (folder / name).is_file()]
    recordings = [file for set_name in SETS for file in dataset.files(set_name)]
    return {f"{what} {file.name}": file for file in [*there, *recordings]}


def like_files(arm: Arm) -> dict[str, Location]:
    """The fleet prior that its training starts from."""
    return {} if arm.like is None else {"train.like": arm.like}


def robot_files(robot: Location | None) -> dict[str, Location]:
    """A robot file, and meshes and includes that it names and that are there; MuJoCo reads masses off them."""
    found: dict[str, Location] = {}
    for file in () if robot is None else named_files(robot):
        found[f"robot file {file.name}" if f"robot file {file.name}" not in found else f"robot file {file}"] = file
    return found


def digests(files: dict[str, Location], contents: Contents) -> dict[str, str]:
    """The same names with the files' contents."""
    return {name: contents.digest(path) for name, path in files.items()}
