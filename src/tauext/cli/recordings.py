"""`tauext import` and `check`: datasets and what is wrong in them."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from tauext import plugins
from tauext.cli.arguments import JsonArg, MeshesArg, print_replaced
from tauext.cli.progress import Terminal
from tauext.errors import ConfigError
from tauext.files.atomic_write import atomic_folder
from tauext.files.preflight import expect_folder, expect_new_file
from tauext.progress import aligned

if TYPE_CHECKING:
    from tauext.data.dataset import Dataset
    from tauext.data.recording import Recording

# --- `tauext import`: recordings of a real arm, in any format, to a dataset folder; or a template of its description.


def import_data(
    source: tuple[Path, ...] = (),
    arm: Path | None = None,
    out: Path | None = None,
    new: Path | None = None,
    robot: Path | None = None,
    meshes: MeshesArg = (),
    format: str = "tauext",
) -> None:
    """Convert recordings of a real arm to rad, rad/s and Nm, and write a dataset folder for `tauext train`.

    First run `tauext import --new arm.toml --source FILE --robot FILE`, which writes a description to complete. Then
    `tauext import --source FILE ... --arm arm.toml --out DIR` imports. Every conversion is printed and stored in the
    recordings. The training data are checked at the end. Faults, which `tauext train` refuses, and warnings are
    printed; the dataset is written in any case, so that `tauext check` can draw it.

    Args:
        source: files or folders to import: ROS 1 and ROS 2 bags (sqlite3, MCAP), CSV, Parquet, HDF5, MATLAB; with
            packages/lerobot also LeRobot v3.0 and v2.1.
        arm: description of robot and recordings, arm.toml.
        out: folder to write; it must be empty or missing.
        new: write a commented description to this file instead of importing, with the names found in the source and
            the robot file.
        robot: URDF or MJCF of the arm, for the description that --new writes.
        meshes: folders of the meshes that the URDF names: a package's, or one that holds packages. They are searched
            before the folders near the URDF, ROS_PACKAGE_PATH, AMENT_PREFIX_PATH, example_robot_data and
            robot_descriptions.
        format: output format. tauext: recordings, robot file, split.json. lerobot, of packages/lerobot: a LeRobot v3
            dataset, an episode a recording.
    """
    if new is not None:
        if arm is not None or out is not None or meshes:
            raise ConfigError("--new writes a description and imports nothing: omit --arm, --out and --meshes")
        write_template(new, source, robot)
        return
    if robot is not None:
        raise ConfigError("--robot goes with --new; an import takes the robot file that arm.toml names (model)")
    for name, value in (("--source", source), ("--arm", arm), ("--out", out)):
        if not value:
            raise ConfigError(f"{name} is missing; `tauext import --new arm.toml --source FILE` writes a description")
    assert arm is not None and out is not None
    from tauext.data.importing import import_dataset
    from tauext.robot.mesh_files import mesh_folders

    import_dataset(source, arm, out, format, print, mesh_folders(meshes))
    if format == "tauext":
        print_joints_and_findings(out)
    print(out)


def write_template(path: Path, sources: tuple[Path, ...], robot: Path | None) -> None:
    """Write the commented arm.toml; nothing is overwritten."""
    from tauext.data.description import GUESSED, open_entries
    from tauext.data.description_template import RATE, Guess, guess_of, template
    from tauext.data.importers.open_raw import open_raw
    from tauext.data.importers.raw import short_list, whole
    from tauext.files.plain_file import parse_toml
    from tauext.files.typed_table import write_template as write_text
    from tauext.robot.read import movable_joints

    if path.exists():
        raise ConfigError(f"{path}: already exists; choose another name or remove it")
    expect_new_file(path)
    guessed, streams = Guess(), {}
    joints, model = [], ""
    if robot is not None:
        joints = movable_joints(robot)
        model = Path(os.path.relpath(robot, path.parent)).as_posix()
    if sources:
        with whole(sources[0], "a recording", ()):
            (first, *_) = open_raw(sources[0])
            streams = first.streams
            guessed = guess_of(first, joints)
    text = template(guessed, model, joints, list(streams))
    write_text(path, text)
    print(path)
    values: dict[str, list[str]] = {}
    for words in open_entries(parse_toml(text, path)):
        entry, _, value = words.partition(" has ")
        values.setdefault(entry, []).append(value)
    for entry, guesses in values.items():
        evidence = guessed.why.get(entry.removeprefix("[").replace("] ", "."), "no evidence")
        to_do = "fill in" if set(guesses) == {f"'{GUESSED}'"} else "confirm or fill in"
        Terminal().say(f"to {to_do}, marked with '{GUESSED}': {entry}: {evidence}")
    if guessed.unused:
        Terminal().say(f"not in use: {short_list(guessed.unused, 16)}")
    if RATE in guessed.why:
        Terminal().say(f"to fill in: [time] rate_hz: {guessed.why[RATE]}")


def print_joints_and_findings(out: Path) -> None:
    """Print what each joint of an imported dataset did, draw it, and report what `tauext train` would say of it."""
    from tauext.data.dataset import load_dataset

    dataset = load_dataset(out)
    training = dataset.training() if dataset.split.train else []
    shown = training or dataset.recordings("collisions")
    if shown:
        print_joints(dataset, shown, out / "joints.png")
    if training:
        print_findings(dataset, training)


def print_joints(dataset: Dataset, recordings: Sequence[Recording], picture: Path) -> None:
    """Print what each joint did, and draw the first recording: a swap shows at a glance."""
    from tauext.check.motion import joint_table
    from tauext.data.servo import torque_unit
    from tauext.robot.read import load_tree
    from tauext.robot.write import is_placeholder

    robot, unit = dataset.robot_file(None), torque_unit(recordings)
    tree = None if is_placeholder(robot) else load_tree(robot, joints=recordings[0].joints)
    print("\n".join(aligned(joint_table(recordings, tree, unit))))
    try:
        plugins.part("joint-picture")(recordings[0], tree, unit, picture)
    except ConfigError as missing:
        Terminal().say(f"{picture.name} is not drawn: {missing}")


def print_findings(dataset: Dataset, training: Sequence[Recording]) -> None:
    """Print on stderr the faults for which `tauext train` would refuse this dataset, and its warnings."""
    from tauext.check.before_training import entries, sentence
    from tauext.check.finding import by_code, finding_lines
    from tauext.config import PAPER_CASES, TrainConfig
    from tauext.robot.model_case import chosen_case
    from tauext.train.data_check import check_results
    from tauext.train.preparation import TrainingInput

    out, terminal = dataset.folder, Terminal()
    robot = dataset.robot_file(None)
    case = PAPER_CASES[chosen_case(None, robot)[0]]
    given = TrainingInput(robot, case, training, dataset.recordings("validation"))
    results = check_results(dataset, given, TrainConfig(), terminal)
    findings = [finding for result in results.values() for finding in result]
    for entry in entries(findings, "warning"):
        terminal.say(f"warning: {sentence(entry)}")
    faults = [finding for finding in findings if finding.severity == "fault"]
    if faults:
        count = len(by_code(faults))
        plural = "" if count == 1 else "s"
        words = f"{out}: {count} fault{plural}, which `tauext train` refuses; correct arm.toml, and import again"
        terminal.say(
            "\n".join([words, *finding_lines(faults), f"  `tauext check --data {out} --out DIR` draws the data"])
        )


# --- `tauext check`: errors in the data, before training.


def check(
    data: tuple[Path, ...],
    robot: Path | None = None,
    out: Path | None = None,
    gravity: tuple[float, float, float] | None = None,
    as_json: JsonArg = False,
) -> int:
    """Find wrong units, signs, joint order and timing in recordings, and errors in the robot file.

    Prints each finding with its evidence and the remedy. Exit status: 0 no fault (warnings are possible), 1 a fault,
    2 bad input.

    Args:
        data: a dataset folder, a folder of recordings, or recordings (*.parquet), of free motion.
        robot: URDF or MJCF of the arm; default: the dataset's own. Without one, checks that need a model are skipped.
        out: folder to write: check.txt, check.json, and pictures of measured and predicted torque; existing ones are
            replaced, and named on stderr.
        gravity: gravitational acceleration in the base frame, m/s^2; default: the robot file's.
        as_json: print the findings as JSON for scripts.
    """
    from tauext.check.examine import as_files, examine, gather

    if out is not None:
        draw = plugins.part("check-pictures")  # refused before minutes of work
        expect_folder(out)
        print_replaced(out / "check.json")
    recordings, free, robot = gather(data, robot, Terminal())
    diagnosis = examine(recordings, robot, gravity, free, Terminal())
    text, content = as_files(diagnosis, (recording.name for recording in recordings), robot is None)
    if out is not None:
        with atomic_folder(out) as part:
            (part / "check.txt").write_text(text + "\n")
            (part / "check.json").write_text(json.dumps(content, indent=1) + "\n")
            draw(diagnosis, part, Terminal())
    print(json.dumps(content, indent=1) if as_json else text)
    return 1 if diagnosis.faulty else 0
