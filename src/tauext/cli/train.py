"""`tauext train`, `calibrate` and `refit`: the commands that write bundles, and their settings."""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypedDict

import tyro

from tauext import plugins
from tauext.cli.arguments import AcceptArg, BundleArg, JsonArg, MeshesArg, expect_another, print_replaced
from tauext.cli.progress import Terminal
from tauext.config import AlarmConfig, CaseName, TrainConfig, require, require_threads
from tauext.errors import ConfigError
from tauext.files.plain_file import read_toml
from tauext.files.typed_table import field_help, hints_of, values_of

# --- Settings: those of a file, and the few that are options of the command line, too.


COMMON = (
    *("recipe", "minutes", "limits", "fit_torque_constants", "torque_constants"),
    *("max_steps", "batch", "threads", "backend", "seed"),
)
"""Fields of TrainConfig that are options of `tauext train`."""
ALARM = ("false_alarms", "in_hours")
"""Fields of AlarmConfig that are options of `tauext train` and `calibrate`."""


def options(kind: type, names: tuple[str, ...]) -> dict[str, Any]:
    """Types of these fields for the parser, with their help and defaults; an option that is not given has no value."""
    hints, words, defaults = hints_of(kind), field_help(kind), kind()
    found = {}
    for name in names:
        hint, default = hints[name], getattr(defaults, name)
        given = [one for one in getattr(hint, "__args__", ()) if one is not type(None)]
        hint = given[0] if default is None else hint
        shown = "" if default is None else f"(default: {default})"
        about = tyro.conf.arg(help=words[name], help_behavior_hint=shown)
        found[name] = Annotated[hint, about, tyro.conf.FlagConversionOff]
    return found


if TYPE_CHECKING:
    AlarmOptions = Mapping[str, Any]
    TrainOptions = Mapping[str, Any]
else:
    AlarmOptions = TypedDict("AlarmOptions", options(AlarmConfig, ALARM), total=False)
    TrainOptions = TypedDict("TrainOptions", options(TrainConfig, COMMON) | options(AlarmConfig, ALARM), total=False)


def train_settings(file: Path | None, given: Mapping[str, Any]) -> TrainConfig:
    """Settings of the file, under those that are given.

    Raises:
        ConfigError: one line with file, key, value and rule.
    """
    values = {} if file is None else values_of(TrainConfig, read_toml(file), f"{file}:")
    values |= {"alarm": promise(values, given)} | {name: given[name] for name in COMMON if name in given}
    try:
        return TrainConfig(**values)
    except ConfigError as error:
        wrong = str(error).partition(" ")[0]
        raise (error if file is None or wrong in given else ConfigError(f"{file}: {error}")) from None


def alarm_settings(file: Path | None, given: Mapping[str, Any]) -> AlarmConfig:
    """Settings of the table [alarm] alone, under those that are given."""
    return promise({} if file is None else values_of(TrainConfig, read_toml(file), f"{file}:"), given)


def promise(values: Mapping[str, Any], given: Mapping[str, Any]) -> AlarmConfig:
    """The alarm settings, with the given options."""
    return replace(values.get("alarm", AlarmConfig()), **{name: given[name] for name in ALARM if name in given})


# --- The commands.


def train(
    data: Path,
    out: Path,
    config: Path | None = None,
    case: CaseName | None = None,
    robot: Path | None = None,
    meshes: MeshesArg = (),
    like: Path | None = None,
    network: Path | None = None,
    accept: AcceptArg = (),
    options: Annotated[TrainOptions, tyro.conf.arg(name="")] = {},  # noqa: B006
) -> None:
    """Train on a dataset's free motion, set the thresholds, and write one trained detector (bundle).

    The data are checked first, as by `tauext check`; a second training on the same data skips the checks. A fault
    refuses the training unless it is accepted. Warnings are printed and stored in the bundle. The last line on stderr
    is the wall time of each phase; NAME.wall_time_s.json beside the bundle holds it, too.

    Args:
        data: dataset folder, made by `tauext import` or `tauext simulate`.
        out: bundle to write, NAME.tauext; an existing one is replaced, and named on stderr. While a network is
            trained, a checkpoint beside it is written every 20 s: after an interruption, the same command continues
            from there. Earlier steps are repeated.
        config: FILE.toml with further settings; `tauext train --help-config` lists its keys. Options of the command
            line override it.
        case: estimated model: the nominal model, which is the robot file as it is (exact), with halved mass or centre
            of mass (mass, com, mass+com), or no model (none). Default: exact, or none where the dataset was imported
            without a model.
        robot: URDF or MJCF of the arm; default: the dataset's own.
        meshes: folders of the meshes that the URDF names, as in `tauext import`, for shapes that the dataset lacks.
        like: NAME.prior.json with what arms of this type have in common; one minute of this arm's motion is then
            enough. None: this arm's motion alone.
        network: FILE.npz with the weights of a network that was trained in PyTorch (recipe paper); nothing is trained.
            None: the recipe trains its own.
        accept: codes of faults to accept, at all joints or at one; they are stored in the bundle.
        options: settings that are often changed.
    """
    from tauext.data.dataset import load_dataset
    from tauext.robot.mesh_files import mesh_folders
    from tauext.train.preparation import NOTHING
    from tauext.train.stage import train_bundle

    if out.suffix != ".tauext":
        raise ConfigError(f"{out}: a bundle's name ends in .tauext")
    settings = train_settings(config, options)
    require(like is None or network is None, "network", network, "left out with --like: a training has one start")
    starts = {"like": like, "network": network}
    start = next((plugins.part(name)(file) for name, file in starts.items() if file is not None), NOTHING)
    print_replaced(out)
    train_bundle(
        load_dataset(data),
        out,
        case,
        robot,
        settings,
        Terminal(),
        accept,
        start=start,
        meshes=mesh_folders(meshes),
    )
    print(out)


def calibrate(
    bundle: Path,
    data: Path,
    out: Path,
    config: Path | None = None,
    options: Annotated[AlarmOptions, tyro.conf.arg(name="")] = {},  # noqa: B006
    threads: int = 0,
    refit_error_scale: bool = False,
    cell: Path | None = None,
    accept: AcceptArg = (),
) -> None:
    """Set the thresholds and hold times of a bundle for another target false alarm rate, or on other recordings.

    Nothing is trained. The quick checks of `tauext check` run on every calibration recording first; a fault refuses it.

    Args:
        bundle: bundle (*.tauext) to start from; it stays as it is.
        data: dataset folder; its calibration recordings are used.
        out: bundle to write, NAME.tauext; an existing one is replaced, and named on stderr.
        config: FILE.toml of `tauext train`; only its table [alarm] is used. Options of the command line override it.
        options: target false alarm rate.
        threads: threads that estimate; 0: one a core. The result does not depend on it.
        refit_error_scale: refit how errors grow with the motion, on the first fifth of the calibration recordings;
            thresholds follow from the others.
        cell: TOML file of the cell with phases, contacts that the task means (docs/contacts.md). The recordings are
            then of the task, without collisions. Only the thresholds during these contacts change.
        accept: codes of faults to accept, at all joints or at one; they are stored in the bundle.
    """
    from tauext.bundle.bundle_file import load_bundle
    from tauext.data.dataset import load_dataset
    from tauext.data.recording_file import describe
    from tauext.monitor.cell_file import load_cell
    from tauext.train.calibrate import calibrate_contacts, recalibrate

    require_threads(threads)
    if cell is not None:
        others = {"config": config, "refit_error_scale": refit_error_scale, "accept": accept} | dict(options)
        for name, value in others.items():
            require(not value, name, value, "left out with --cell, which changes the thresholds during contacts only")
        expect_another(out, bundle, "start from")
        loaded = load_bundle(bundle)
        its = load_cell(cell, [link.joint_name for link in loaded.links])
        unmonitored, phases = its.unmonitored(loaded), its.phases
        if phases is None:
            raise ConfigError(f"{cell}: a table [phases.NAME] is missing: the contacts that the task means")
        dataset = load_dataset(data)
        heads = map(describe, dataset.files("calibration"))
        longest_s = max((head.samples / head.rate_hz for head in heads), default=math.inf)
        print_replaced(out)
        for words in (*unmonitored, *phases.after_the_end(longest_s, "the longest calibration recording")):
            print(f"tauext: {words}", file=sys.stderr)
        print(calibrate_contacts(bundle, dataset, out, phases.timed, threads, Terminal()).sentence())
        print(out)
        return
    alarm = alarm_settings(config, options)
    expect_another(out, bundle, "start from")
    print_replaced(out)
    limits = recalibrate(bundle, load_dataset(data), out, alarm, threads, Terminal(), refit_error_scale, accept)
    print(limits["sentence"])
    print(out)


def refit(
    bundle: BundleArg,
    data: Path,
    out: Path,
    from_s: Annotated[float, tyro.conf.arg(name="from")] = 0.0,
    to_s: Annotated[float | None, tyro.conf.arg(name="to")] = None,
    like: Path | None = None,
    threads: int = 0,
    accept: AcceptArg = (),
    as_json: JsonArg = False,
) -> None:
    """Update the friction of a bundle with 30 to 60 s of the arm's ordinary motion.

    All friction terms of a joint change by a common factor, and separately where the motion supports it. Gravity and
    inertia stay. Thresholds rise where today's error is larger, and never shrink. The command prints the changes, a row
    a joint, and whether the target false alarm rate still holds. The quick checks of `tauext check` run first; a fault
    refuses the recordings. Labelled contacts are left out. So is motion that no friction explains; it is reported.

    Args:
        bundle: bundle (*.tauext) with a prior, of recipe tauext or prior; it stays as it is.
        data: recording (*.parquet), or dataset folder whose training recordings are used.
        out: bundle to write, NAME.tauext; an existing one is replaced, and named on stderr.
        from_s: seconds of each recording at which the motion to be used begins.
        to_s: seconds of each recording at which it ends. None: at its end.
        like: NAME.prior.json with what arms of this type have in common: a joint that hardly moved follows the others
            as far as joints of these arms changed together between recordings.
        threads: threads that estimate; 0: one a core. The result does not depend on it.
        accept: codes of faults to accept, at all joints or at one; they are stored in the bundle.
        as_json: print one JSON object instead of the table.
    """
    from tauext.files.provenance import json_text
    from tauext.train.refit import Span, refit_bundle

    require_threads(threads)
    expect_another(out, bundle, "start from")
    known = None if like is None else plugins.part("like")(like)
    print_replaced(out)
    span = Span(from_s, to_s)
    found = refit_bundle(bundle, data, out, span, threads, Terminal(), accept, known)
    if as_json:
        print(json_text(found.facts() | {"bundle": str(out)}), end="")
        return
    print(found.table())
    print(found.promise)
    print(out)
