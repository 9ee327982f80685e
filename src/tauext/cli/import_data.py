"""`tauext import`: recordings of a real arm, in any format, to a dataset folder; or a template of its description."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Literal

from tauext.errors import ConfigError
from tauext.plain_file import read_text
from tauext.room import expect_folder, expect_new_file

if TYPE_CHECKING:
    from tauext.data import Recording
    from tauext.data.description import Arm


def import_data(
    source: tuple[Path, ...] = (),
    arm: Path | None = None,
    out: Path | None = None,
    new: Path | None = None,
    robot: Path | None = None,
    format: Literal["tauext", "lerobot"] = "tauext",
) -> None:
    """Bring recordings of a real arm to rad, rad/s and Nm, and write a dataset folder that `tauext train` takes.

    First `tauext import --new arm.toml --source FILE --robot FILE` writes a description to fill in, then
    `tauext import --source FILE ... --arm arm.toml --out DIR` imports. All that was done to the numbers is printed and
    kept in the recordings. In the end all that would be trained on is looked at: faults, which train will refuse, and
    warnings are told; the dataset stays, so that `tauext check` can draw it.

    Args:
        source: files or folders to import: ROS 1 and ROS 2 bags (sqlite3, MCAP), CSV, Parquet, HDF5, MATLAB, LeRobot
            v3.
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
        write_template(new, source, robot)
        return
    if robot is not None:
        raise ConfigError("--robot goes with --new; an import takes the robot file that arm.toml names (model)")
    for name, value in (("--source", source), ("--arm", arm), ("--out", out)):
        if not value:
            raise ConfigError(f"{name} is missing; `tauext import --new arm.toml --source FILE` writes a description")
    assert arm is not None and out is not None
    import_dataset(source, arm, out, format)


def write_template(path: Path, sources: tuple[Path, ...], robot: Path | None) -> None:
    """Write the commented arm.toml; nothing is overwritten."""
    import os

    from tauext.data.description_template import Guess, guess, template
    from tauext.data.importers import open_raw
    from tauext.live.toml_file import write_template as write_text
    from tauext.robot import movable_joints

    if path.exists():
        raise ConfigError(f"{path}: is there already; choose another name or remove it")
    expect_new_file(path)
    guessed, streams = Guess(), {}
    if sources:
        (first, *_) = open_raw(sources[0])
        streams = first.streams()
        guessed = guess(streams)
    joints, model = [], ""
    if robot is not None:
        joints = movable_joints(robot)
        model = Path(os.path.relpath(robot, path.parent)).as_posix()
    write_text(path, template(guessed, model, joints, list(streams)))
    print(path)


def import_dataset(paths: tuple[Path, ...], arm_file: Path, out: Path, format: str) -> None:
    """Import all sources into a folder that appears whole or not at all; what was done goes to stdout."""
    import shutil
    import time

    from tauext.data.dataset_writing import recordings_of, write_dataset
    from tauext.data.description_file import load_arm
    from tauext.data.importers import open_raw
    from tauext.data.lerobot_export import export_lerobot
    from tauext.provenance import provenance, write_json
    from tauext.robot import load_tree, robot_sha256

    started = time.monotonic()
    arm = load_arm(arm_file)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise ConfigError(f"{out}: is not empty; choose another folder or remove it")
    expect_folder(out)
    sources = [source for path in paths for source in open_raw(path, arm.topics)]
    if arm.model is not None:
        load_tree(arm.model, joints=arm.robot.joints)  # names its faults before an hour is imported
    part = out.with_name(out.name + ".part")
    shutil.rmtree(part, ignore_errors=True)  # of an import that was killed
    part.mkdir(parents=True)
    try:
        if format == "lerobot":
            recordings = (_told(recording) for _, recording in recordings_of(sources, arm, ""))
            print(f"{export_lerobot(recordings, part)} episodes")
        else:
            robot = _robot_file(arm, part)
            for line in write_dataset(sources, arm, robot_sha256(robot), part, _told).said:
                print(line)
        settings = {"arm": read_text(arm_file), "sources": [path.name for path in paths], "format": format}
        write_json(provenance("tauext import", settings, None), part / "run.json")
        write_json({"import_s": round(time.monotonic() - started, 3)}, part / "wall_time_s.json")
        if out.exists():
            out.rmdir()
        part.rename(out)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)  # half a dataset serves nobody
        raise
    if format == "tauext":
        tell_findings(out)
    print(out)


def tell_findings(out: Path) -> None:
    """Say on stderr what `tauext train` would refuse of this dataset, and what it would warn of."""
    from tauext.cli.reporter import Terminal
    from tauext.config import PAPER_CASES, TrainConfig
    from tauext.data import load_dataset
    from tauext.look import entries, sentence, told
    from tauext.robot import chosen_case
    from tauext.train import view_dataset

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


def _robot_file(arm: Arm, out: Path) -> Path:
    """The dataset's robot file: the arm's own with what the description adds, or a placeholder, and said so."""
    from tauext.robot import Payload, load_tree, write_placeholder, write_robot

    if arm.model is None:
        print("robot: no model; robot.urdf is a placeholder without masses, and train takes the case none")
        return write_placeholder(arm.robot.joints, out)
    inertia = arm.robot.rotor_inertia_kg_m2
    rotors = dict(zip(arm.robot.joints, zip(inertia, arm.gear_ratio, strict=True), strict=True)) if inertia else {}
    carried = arm.payload
    payload = Payload(carried.link, carried.mass_kg, carried.com_m, carried.inertia_kg_m2) if carried.mass_kg else None
    path = write_robot(arm.model, out, rotors, payload, arm.robot.gravity_m_s2 or None)
    tree = load_tree(path, joints=arm.robot.joints)
    print(f"robot: {arm.model.name} with {tree.size} joints: {', '.join(arm.robot.joints)}")
    if payload:
        print(f"  payload of {payload.mass_kg:g} kg at {payload.link}")
    if rotors:
        print(f"  rotor inertia at the joint, kg m^2: {', '.join(f'{link.rotor_inertia:.4g}' for link in tree.links)}")
    if arm.robot.gravity_m_s2:
        print(f"  gravity {', '.join(f'{g:g}' for g in tree.gravity)} m/s^2")
    return path


def _told(recording: Recording) -> Recording:
    """The recording, after printing what it is and what was done to it, a line each."""
    joints = len(recording.joints)
    head = f"{recording.name}: {recording.duration_s:.2f} s, {recording.rate_hz:g} Hz, {joints} joints, "
    head += f"{recording.samples} samples from {recording.source}"
    print("\n".join([head, *(f"  {line}" for line in recording.provenance["done"])]))
    return recording
