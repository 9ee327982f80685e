"""The arms of a fleet, each loaded when it is needed: recordings of a hundred arms do not fit into memory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.cli.arguments import local_path
from tauext.config import PAPER_CASES, TrainConfig
from tauext.data.dataset import load_dataset
from tauext.data.free_motion import first_seconds
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.progress import SILENT, Reporter
from tauext.robot.model_case import chosen_case
from tauext.train.data_check import check_data
from tauext.train.fitting import choose_gain, fit_prior, observe
from tauext.train.preparation import NOTHING, Start, TrainingInput, TrainingRun, prepare
from tauext_fleet.fleet_prior import ArmType
from tauext_fleet.like import arm_type

LEAST_ARMS = 3
BUNDLE_AND_DATA = ".tauext:"


@dataclass(frozen=True)
class FleetArm:
    """One arm: its recordings, and the bundle that was trained on them where there is one."""

    name: str
    data: Path
    bundle: Path | None = None


@dataclass(frozen=True)
class OwnTerms:
    """What one arm's own training kept, and how its recordings are read."""

    arm: FleetArm
    type: ArmType
    nm_per_unit: tuple[float, ...] | None
    gain_per_s: float
    widths_rad: tuple[float, ...]
    ripples: tuple[frozenset[int], ...]
    """Cycles a turn, of each joint."""
    loaded: tuple[bool, ...]
    """Whether friction of the joint grows with its load."""
    tops_rad_s: tuple[float, ...]
    """Largest speeds."""


def fleet_arms(words: Sequence[str]) -> list[FleetArm]:
    """Arms of the command line: DATA or BUNDLE.tauext:DATA.

    Raises:
        ConfigError: fewer than LEAST_ARMS, or one twice.
    """
    pairs: list[tuple[Path, Path | None]] = []
    for word in words:
        bundle, found, data = word.partition(BUNDLE_AND_DATA)
        pairs.append((Path(data), Path(f"{bundle}.tauext")) if found else (local_path([word]), None))
    folders = [data.resolve() for data, _ in pairs]
    twice = [str(data) for k, data in enumerate(folders) if data in folders[:k]]
    if twice:
        raise ConfigError(f"{twice[0]}: the same arm twice; a fleet prior is of different ones")
    expect_enough(len(pairs))
    names = distinct(folders)
    return [FleetArm(name, data, bundle) for name, (data, bundle) in zip(names, pairs, strict=True)]


def expect_enough(arms: int) -> None:
    """Raise ConfigError of fewer than LEAST_ARMS."""
    if arms < LEAST_ARMS:
        raise ConfigError(
            f"{arms} arms: a fleet prior needs at least {LEAST_ARMS} of one type, to estimate how they differ"
        )


def distinct(folders: Sequence[Path]) -> list[str]:
    """Names of folders: as many of their last parts as make them distinct, without those that all have."""
    most = max(len(folder.parts) for folder in folders)
    for count in range(1, most + 1):
        names = [folder.parts[-count:] for folder in folders]
        if len(set(names)) == len(folders):
            while len(names[0]) > 1 and len({name[-1] for name in names}) == 1:
                names = [name[:-1] for name in names]
            if len(set(names)) == len(folders):
                return ["-".join(name) for name in names]
    return [str(folder) for folder in folders]


def run_of(
    arm: FleetArm,
    config: TrainConfig,
    minutes: float | None = None,
    start: Start = NOTHING,
    accept: Sequence[str] | None = None,
    report: Reporter = SILENT,
) -> TrainingRun:
    """A training of the arm up to its motion, as `train` begins it.

    Args:
        minutes: of its training recordings; None: all.
        accept: codes that are accepted when its recordings are checked; None: they are not checked.

    Raises:
        TauextError: whatever makes `train` refuse it; and no model.
    """
    dataset = load_dataset(arm.data)
    robot = dataset.robot_file(None)
    case, _ = chosen_case(None, robot)
    model = PAPER_CASES[case]
    if model.no_model:
        raise ConfigError(f"{arm.data}: it has no model, and a fleet prior holds corrections of one; import with one")
    training = dataset.training()
    given = TrainingInput(robot, model, training, start=start)
    if accept is not None:
        check_data(dataset, given, config, accept, report)
    config = replace(start.settings(config), minutes=minutes)
    name = Path(f"{arm.name}.tauext")
    return prepare(given, config, name, report)


def own_terms_of(arm: FleetArm, config: TrainConfig, accept: Sequence[str], report: Reporter) -> OwnTerms:
    """What the arm's own training kept: of its bundle, or found as a training finds it.

    Raises:
        TauextError: as run_of; a bundle without a prior.
    """
    run = run_of(arm, config, accept=accept if arm.bundle is None else None, report=report)
    recordings = run.motion.uncut
    if arm.bundle is None:
        setup = observe(run)
        fit = fit_prior(run, setup, recordings)
        assert fit is not None
        kind = arm_type(run, setup)
        if run.config.resolved().observer.gain_per_s == "auto":
            setup, fit = choose_gain(run, setup, fit)
        settings, observer = fit.settings, setup.observer
    else:
        bundle = load_bundle(arm.bundle)
        if not bundle.prior.corrected_links:
            raise ConfigError(f"{arm.bundle}: it has no prior that corrects a model; recipes tauext and prior make one")
        settings, observer = bundle.prior, bundle.observer
        kind = arm_type(run, observe(run))
    joints = range(len(kind.joints))
    ripples, loads = ([t for t in settings.terms if t.kind == k] for k in (_core.TermKind.ripple, _core.TermKind.load))
    tops = [float(max(abs(recording.dq[:, j]).max() for recording in recordings)) for j in joints]
    return OwnTerms(
        arm=arm,
        type=kind,
        nm_per_unit=tuple(observer.nm_per_unit) or None,
        gain_per_s=observer.gain_per_s,
        widths_rad=tuple(settings.widths_rad),
        ripples=tuple(frozenset(t.b for t in ripples if t.a == j) for j in joints),
        loaded=tuple(any(t.a == j for t in loads) for j in joints),
        tops_rad_s=tuple(tops),
    )


def settings_of(own: OwnTerms, config: TrainConfig, gain_per_s: float) -> TrainConfig:
    """The settings with which the arm's motion is read again: its torque constants, the fleet's gain."""
    observer = replace(config.observer, gain_per_s=gain_per_s)
    return replace(config, observer=observer, torque_constants=own.nm_per_unit, fit_torque_constants=None)


def first_minutes(recordings: Sequence[Recording], minutes: float) -> list[Recording]:
    """The beginning of the motion."""
    return list(first_seconds(recordings, 60 * minutes))
