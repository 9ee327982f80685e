"""`tauext import`: recordings of a real arm, in any format, to a dataset folder; or a template of its description."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tauext.cli.place_argument import PlaceArg
from tauext.errors import ConfigError
from tauext.files.copies import local_folder, local_robot, staged
from tauext.files.places import is_stored
from tauext.files.room import expect_new_file

if TYPE_CHECKING:
    from tauext.data.importers.raw import RawRecording


def import_data(
    source: tuple[PlaceArg, ...] = (),
    arm: PlaceArg | None = None,
    out: PlaceArg | None = None,
    new: Path | None = None,
    robot: PlaceArg | None = None,
    format: Literal["tauext", "lerobot"] = "tauext",
) -> None:
    """Bring recordings of a real arm to rad, rad/s and Nm, and write a dataset folder that `tauext train` takes.

    First `tauext import --new arm.toml --source FILE --robot FILE` writes a description to fill in, then
    `tauext import --source FILE ... --arm arm.toml --out DIR` imports. All that was done to the numbers is printed and
    kept in the recordings. In the end all that would be trained on is looked at: faults, which train will refuse, and
    warnings are told; the dataset stays, so that `tauext check` can draw it.

    Args:
        source: files or folders to import: ROS 1 and ROS 2 bags (sqlite3, MCAP), CSV, Parquet, HDF5, MATLAB, LeRobot
            v3.0 and v2.1.
        arm: description of robot and recordings, arm.toml.
        out: folder to write, which must be empty or not there.
        new: file to write a commented description to instead of importing, filled in from the names in the source and
            the robot file.
        robot: URDF or MJCF of the arm, named in the description that --new writes.
        format: what is written. tauext: recordings, robot file, split.json. lerobot: a LeRobot v3
            dataset, an episode a recording.
    """
    if new is not None:
        if arm is not None or out is not None:
            raise ConfigError("--new writes a description and imports nothing: leave --arm and --out out")
        write_template(new, tuple(map(local_folder, source)), local_robot(robot) if robot is not None else None)
        return
    if robot is not None:
        raise ConfigError("--robot goes with --new; an import takes the robot file that arm.toml names (model)")
    for name, value in (("--source", source), ("--arm", arm), ("--out", out)):
        if not value:
            raise ConfigError(f"{name} is missing; `tauext import --new arm.toml --source FILE` writes a description")
    assert arm is not None and out is not None
    from tauext.data.importing import import_dataset

    if is_stored(out) and any(out.iterdir()):
        raise ConfigError(f"{out}: is not empty; choose another folder or remove it")
    with staged(out, fresh=True) as folder:
        import_dataset([local_folder(one) for one in source], arm, folder, format, print)
        if format == "tauext":
            tell_findings(folder)
    print(out)


def write_template(path: Path, sources: tuple[Path, ...], robot: Path | None) -> None:
    """Write the commented arm.toml; nothing is overwritten."""
    import os

    from tauext.data.description_template import Guess, guess, template
    from tauext.data.importers.open_raw import open_raw
    from tauext.files.toml_file import write_template as write_text
    from tauext.robot.load import movable_joints

    if path.exists():
        raise ConfigError(f"{path}: is there already; choose another name or remove it")
    expect_new_file(path)
    guessed, streams = Guess(), {}
    if sources:
        (first, *_) = open_raw(sources[0])
        streams = first.streams()
        guessed = guess(streams)
        guessed.time_unit = unit_of_times(first, guessed.columns.get("time", ""))
    joints, model = [], ""
    if robot is not None:
        joints = movable_joints(robot)
        model = Path(os.path.relpath(robot, path.parent)).as_posix()
    write_text(path, template(guessed, model, joints, list(streams)))
    print(path)


def unit_of_times(raw: RawRecording, column: str) -> str:
    """Unit of the column of times, as its first values show it."""
    from tauext.data.description_template import time_unit

    for block in raw.blocks():
        if column in block.names:
            return time_unit(block.columns[:, block.names.index(column)])
    return ""


def tell_findings(out: Path) -> None:
    """Say on stderr what `tauext train` would refuse of this dataset, and what it would warn of."""
    from tauext.check.look import entries, sentence, told
    from tauext.cli.progress import Terminal
    from tauext.config import PAPER_CASES, TrainConfig
    from tauext.data.dataset import load_dataset
    from tauext.robot.model_case import chosen_case
    from tauext.train.look import view_dataset

    dataset, terminal = load_dataset(out), Terminal()
    if not dataset.split.train:
        return
    robot = dataset.robot_file(None)
    case = PAPER_CASES[chosen_case(None, robot)[0]]
    training, validation = dataset.training(), dataset.recordings("validation")
    looks = view_dataset(dataset, robot, case, training, validation, TrainConfig(), terminal)
    findings = [finding for look in looks.values() for finding in look.findings]
    for entry in entries(finding for finding in findings if finding.severity == "warning"):
        terminal.say(f"warning: {sentence(entry)}")
    faults = [finding for finding in findings if finding.severity == "fault"]
    if faults:
        plural = "" if len(faults) == 1 else "s"
        words = f"{out}: {len(faults)} fault{plural}, which `tauext train` refuses; mend arm.toml, and import again"
        terminal.say("\n".join([words, *told(faults), f"  `tauext check --data {out} --out DIR` draws it"]))
