"""From recordings of a real arm, in any format, to a dataset folder in rad, rad/s and N m: the import stage."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from tauext.data.dataset_writing import recordings_of, write_dataset
from tauext.data.description import Arm, load_arm
from tauext.data.importers.open_raw import open_raw
from tauext.data.lerobot_folder import export_lerobot
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.files.places import Place
from tauext.files.plain_file import read_text
from tauext.files.provenance import provenance, write_json
from tauext.files.room import expect_folder
from tauext.robot.capsules import write_shapes
from tauext.robot.load import load_tree, robot_sha256
from tauext.robot.write import Payload, write_placeholder, write_robot

Say = Callable[[str], object]


def import_dataset(paths: Sequence[Path], arm_file: Place, out: Path, format: str, say: Say) -> None:
    """Import all sources into a folder that appears whole or not at all.

    Args:
        paths: files or folders of one arm.
        arm_file: their description, arm.toml.
        out: folder to write, which must be empty or not there.
        format: tauext or lerobot.
        say: is told what was done to the numbers, a line each.

    Raises:
        ConfigError: a description or a folder that cannot be used.
        RecordingError: a source that is damaged or of no format that is read.
        RobotError: a robot file that cannot be used.
    """
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
            recordings = (_told(recording, say) for _, recording in recordings_of(sources, arm, ""))
            say(f"{export_lerobot(recordings, part)} episodes")
        else:
            robot = _robot_file(arm, part, say)
            for line in write_dataset(sources, arm, robot_sha256(robot), part, lambda one: _told(one, say)).said:
                say(line)
        settings = {"arm": read_text(arm_file), "sources": [path.name for path in paths], "format": format}
        write_json(provenance("tauext import", settings, None), part / "run.json")
        write_json({"import_s": round(time.monotonic() - started, 3)}, part / "wall_time_s.json")
        if out.exists():
            out.rmdir()
        part.rename(out)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)  # half a dataset serves nobody
        raise


def _robot_file(arm: Arm, out: Path, say: Say) -> Path:
    """The dataset's robot file: the arm's own with what the description adds, or a placeholder, and said so."""
    if arm.model is None:
        say("robot: no model; robot.urdf is a placeholder without masses, and train takes the case none")
        return write_placeholder(arm.robot.joints, out)
    inertia = arm.robot.rotor_inertia_kg_m2
    rotors = dict(zip(arm.robot.joints, zip(inertia, arm.gear_ratio, strict=True), strict=True)) if inertia else {}
    carried = arm.payload
    payload = Payload(carried.link, carried.mass_kg, carried.com_m, carried.inertia_kg_m2) if carried.mass_kg else None
    path = write_robot(arm.model, out, rotors, payload, arm.robot.gravity_m_s2 or None)
    tree = load_tree(path, joints=arm.robot.joints)
    say(f"robot: {arm.model.name} with {tree.size} joints: {', '.join(arm.robot.joints)}")
    shapes = write_shapes(arm.model, out)
    for line in shapes.notes:
        say(f"  {line}; where touches are is told by guessed shapes there")
    if payload:
        say(f"  payload of {payload.mass_kg:g} kg at {payload.link}")
    if rotors:
        say(f"  rotor inertia at the joint, kg m^2: {', '.join(f'{link.rotor_inertia:.4g}' for link in tree.links)}")
    if arm.robot.gravity_m_s2:
        say(f"  gravity {', '.join(f'{g:g}' for g in tree.gravity)} m/s^2")
    return path


def _told(recording: Recording, say: Say) -> Recording:
    """The recording, after saying what it is and what was done to it, a line each."""
    joints = len(recording.joints)
    head = f"{recording.name}: {recording.duration_s:.2f} s, {recording.rate_hz:g} Hz, {joints} joints, "
    head += f"{recording.samples} samples from {recording.source}"
    say("\n".join([head, *(f"  {line}" for line in recording.provenance["done"])]))
    return recording
