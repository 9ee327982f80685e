"""`tauext guard`: a bundle, usual torques and the gripper's grip, from minutes of motion."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tauext.cli.arguments import AcceptArg
from tauext.cli.progress import Terminal
from tauext.config import require
from tauext.errors import ConfigError
from tauext.files.atomic_write import new_folder
from tauext.progress import SILENT

if TYPE_CHECKING:
    from tauext._core import Bundle
    from tauext.data.recording import Recording
    from tauext_lerobot.guard import GuardSettings
    from tauext_lerobot.lerobot_folder import LerobotFolder

LEAST_MINUTES = 5.0
LEAST_MOTION_DEG = 2 * math.pi
"""Least range of the joint that moves farthest, [deg]. Radians that are declared as degrees never exceed it, since a
servo covers one turn at most; usual motion of an arm exceeds it many times."""
MOST_SHARE = 0.5
"""Share of the servo's stall torque that no joint holds in usual motion: LeRobot's Max_Torque_Limit of a gripper. A
joint that holds more stalls."""
GRIP_SHARE = 0.25
"""Share of the servo's stall torque that is declared where the data have no grip: LeRobot's Overload_Torque, to which
an overloaded gripper falls."""
RAW = (("current", "A"), ("duty", "1"), ("voltage", "V"))
"""Signals that `--robot.type=tauext` records beside the position, and their units."""


def guard(
    source: tuple[Path, ...],
    out: Path,
    arm: Path | None = None,
    calibration: Path | None = None,
    gripper: str | None = None,
    at_most_nm: float | None = None,
    accept: AcceptArg = (),
) -> None:
    """Make a guard of a servo arm against stalls, from about ten minutes of its usual motion.

    Writes a folder for LeRobot's `--robot.type=tauext_guard --robot.guard=DIR`: arm.toml, the bundle arm.tauext, and
    guard.toml with the torques that are usual and the expected grip of the gripper. The folder appears complete or not
    at all. The torque comes from the current if the dataset has it, else from the duty, else from goal and position.

    Args:
        source: LeRobot dataset; with --arm, any recordings that `tauext import` reads.
        out: folder to write; it must be empty or missing.
        arm: arm.toml that describes the recordings. None: it is made for a LeRobot dataset in degrees.
        calibration: LeRobot's calibration file of the arm (*.json), for a dataset of values from -100 to 100.
        gripper: joint whose grip is no stall; "none": every stall is one. Default: the joint `gripper`, if any.
        at_most_nm: largest torque of a grip, in the unit that the command prints. Default: the largest in the data, or
            a quarter of the servo's stall torque if the gripper grips nothing there.
        accept: codes of faults in the data to accept, at all joints or at one.
    """
    from tauext.config import TrainConfig
    from tauext.data.dataset import load_dataset
    from tauext.data.importing import import_dataset
    from tauext.train.stage import train_bundle
    from tauext_lerobot.calibration import load_lerobot_calibration
    from tauext_lerobot.guard import ARM, BUNDLE, CALIBRATION, SETTINGS

    require(at_most_nm is None or 0 < at_most_nm < 1e6, "at_most_nm", at_most_nm, "> 0")
    if arm is not None and calibration is not None:
        raise ConfigError("--calibration goes without --arm; name the file in arm.toml ([robot] calibration)")
    motors = calibration if arm is None else named_calibration(arm)
    if motors is not None:
        load_lerobot_calibration(motors)
    with new_folder(out) as folder:
        if motors is not None:
            shutil.copyfile(motors, folder / CALIBRATION)
        text = described(source, calibration is not None) if arm is None else arm.read_text()
        (folder / ARM).write_text(text)
        # Files that arm.toml names are relative to its own place.
        import_dataset(source, arm or folder / ARM, folder / "data", "tauext", SILENT.say)
        dataset = load_dataset(folder / "data")
        training = dataset.training()
        minutes = sum(recording.duration_s for recording in training) / 60
        expect_minutes(minutes, source)
        expect_motion(training, source)
        name = gripper_of(training[0].joints, gripper)
        config = TrainConfig(recipe="prior", fit_torque_constants=False)
        bundle = train_bundle(dataset, folder / BUNDLE, config=config, report=Bars(), accept=accept)
        settings, notes = learned(bundle, training, name, at_most_nm)
        (folder / SETTINGS).write_text(settings_text(settings, bundle, source, minutes, notes))
        shutil.rmtree(folder / "data")
    print(*notes, out, sep="\n")


def expect_minutes(minutes: float, sources: Sequence[Path]) -> None:
    """Raise ConfigError where there is too little motion."""
    if minutes < LEAST_MINUTES:
        raise ConfigError(
            f"{', '.join(map(str, sources))}: {minutes:.1f} minutes of motion are too few for a guard; record at "
            f"least {LEAST_MINUTES:g}, better 10, in which every joint moves as it will move later"
        )


class Bars(Terminal):
    """Progress without sentences: these are about a bundle's limits, which the guard does not use alone."""

    def say(self, sentence: str) -> None:
        pass


def expect_motion(training: Sequence[Recording], sources: Sequence[Path]) -> None:
    """Raise ConfigError where no joint moves by LEAST_MOTION_DEG: friction and torques would be those of rest."""
    ranges_deg = np.degrees(np.ptp(np.concatenate([one.q for one in training]), axis=0))
    if (most := float(ranges_deg.max())) <= LEAST_MOTION_DEG:
        joint = training[0].joints[int(ranges_deg.argmax())]
        raise ConfigError(
            f"{', '.join(map(str, sources))}: the joint that moves farthest, {joint}, "
            f"covers {most:.2g} deg, must be more than {LEAST_MOTION_DEG:.2g} deg; positions in rad that are declared "
            "as deg cover less: check the unit of q (--arm), or record usual motion"
        )


def named_calibration(arm: Path) -> Path | None:
    """The calibration file that arm.toml names. Raises ConfigError where arm.toml breaks a rule."""
    from tauext.data.description import load_arm

    named = load_arm(arm).robot.calibration
    return arm.parent / named if named else None


def gripper_of(joints: Sequence[str], named: str | None) -> str:
    """The joint whose grip is declared; empty: none.

    Raises:
        ConfigError: there is no joint of this name.
    """
    if named is None:
        return "gripper" if "gripper" in joints else ""
    if named not in (*joints, "none"):
        raise ConfigError(f"--gripper {named}: must be one of {', '.join(joints)}, or none")
    return "" if named == "none" else named


# --- The description of a LeRobot dataset.


def described(sources: Sequence[Path], normalised: bool) -> str:
    """arm.toml of LeRobot datasets of one arm.

    Raises:
        ConfigError: a source is no LeRobot dataset, or its state and action share no joint.
    """
    from tauext_lerobot.lerobot_folder import INFO, open_folder

    for path in sources:
        if not (path / INFO).is_file():
            raise ConfigError(f"{path}: is no LeRobot dataset (it has no {INFO}); describe other recordings with --arm")
    folder = open_folder(sources[0])
    state, action = (element_names(folder, feature) for feature in ("observation.state", "action"))
    suffix = ".pos" if any(name.endswith(".pos") for name in state) else ""
    joints = [name.removesuffix(suffix) for name in state if name.endswith(suffix) and name in action]
    if not joints:
        raise ConfigError(
            f"{sources[0]}: observation.state ({', '.join(state)}) and action ({', '.join(action)}) share no joint; "
            "describe the dataset with --arm"
        )
    unit = "normalised" if normalised else "deg"
    lines = ["# Written by `tauext guard`.", "[robot]", f"joints = {json.dumps(joints)}"]
    lines += ['calibration = "calibration.json"'] * normalised
    for signal, source in (("q", f"observation.state[{{joint}}{suffix}]"), ("q_des", f"goal[{{joint}}{suffix}]")):
        lines += ["", f"[signals.{signal}]", f'columns = "{source}"', f'unit = "{unit}"']
    measured = [signal for signal, _ in RAW if all(f"{joint}.{signal}" in state for joint in joints)]
    for signal, si in RAW:
        if signal in measured:
            lines += ["", f"[signals.{signal}]", f'columns = "observation.state[{{joint}}.{signal}]"', f'unit = "{si}"']
    lines += ["", "[servo]", f'torque_from = "{torque_source(folder, state, measured)}"', "goal_delay_s = 0"]
    if str(folder.info.get("robot_type", "")).startswith(("so100", "so101", "so_follower")):
        lines.append('type = "sts3215-7.4v"')
    lines += ["", "[split]", f"train = {json.dumps([path.name for path in sources])}"]
    return "\n".join(lines) + "\n"


def element_names(folder: LerobotFolder, feature: str) -> list[str]:
    """Names of a feature's elements.

    Raises:
        ConfigError: the dataset lacks the feature.
    """
    if feature not in folder.features:
        raise ConfigError(f"{folder.path}: it has no {feature}; it has {', '.join(folder.features)}")
    return folder.names(feature, int(folder.features[feature]["shape"][0]))


def torque_source(folder: LerobotFolder, state: Sequence[str], measured: Sequence[str]) -> str:
    """The value of [servo] torque_from. A current of both signs is that of the windings."""
    from tauext_lerobot.lerobot_folder import episode_rows, frames_of

    if "current" not in measured:
        return "duty" if "duty" in measured else "goal"
    number = min(folder.lengths)
    rows = episode_rows(folder, number, frames_of(folder).files.get(number))
    values = np.stack(rows["observation.state"].to_numpy())
    currents = values[:, [name.endswith(".current") for name in state]]
    return "phase-current" if (currents < 0).any() else "supply-current"


# --- Usual torques and grip, from the training data.


def learned(
    bundle: Bundle, training: Sequence[Recording], gripper: str, at_most_nm: float | None
) -> tuple[GuardSettings, list[str]]:
    """Settings of the guard, and sentences about them.

    Args:
        gripper: joint whose grip is declared; empty: none.
        at_most_nm: its largest torque; None: it follows from the data.

    Raises:
        ConfigError: the data have no grip, and the servo's stall torque is unknown.
    """
    from tauext_lerobot.guard import Grip, GuardSettings, Usual, held_at_rest, nm_per_unit

    joints, units = training[0].joints, bundle.estimate_units
    torques = [np.abs(recording.tau) * nm_per_unit(bundle) for recording in training]
    pairs = list(zip(torques, training, strict=True))
    held = np.max([held_at_rest(torque, one.q, one.rate_hz) for torque, one in pairs], axis=0)
    largest = np.max([torque.max(axis=0) for torque in torques], axis=0)
    moved = np.max([np.ptp(one.q, axis=0) for one in training], axis=0)
    notes = [
        f"{joint} never moves in these recordings: it is not guarded"
        for joint, far, limit in zip(joints, moved, bundle.sliding_limit_nm, strict=True)
        if not np.isfinite(limit) or far == 0
    ]
    stall = stall_torques(bundle)
    notes += [
        f"warning: {joint} holds {torque:.3g} {unit} in these recordings, more than half of its servo's stall torque: "
        "it stalls there, and such a stall is not reported; leave the recording out"
        for joint, torque, most, unit in zip(joints, held, stall, units, strict=True)
        if torque > MOST_SHARE * most and joint != gripper
    ]
    usual = {joint: Usual(*map(float, pair)) for joint, *pair in zip(joints, held, largest, strict=True)}
    if not gripper:
        return GuardSettings(usual), [*notes, "no gripper: every stall is reported as one"]
    g = joints.index(gripper)
    if at_most_nm is None:
        moving = [torque[np.abs(one.dq[:, g]) > 0.2, g] for torque, one in pairs]
        at_most_nm, words = grip_of(float(held[g]), np.concatenate(moving), float(stall[g]))
        notes.append(f"{gripper}: {words}")
    notes.append(f"{gripper}: a grip of at most {at_most_nm:.3g} {units[g]} is expected; guard.toml sets it ([grip])")
    return GuardSettings(usual, Grip(gripper, at_most_nm)), notes


def stall_torques(bundle: Bundle) -> np.ndarray:
    """Stall torque of each joint's servo by its constants, in the recordings' unit of torque; NaN: unknown."""
    servo = bundle.servo
    if not servo.on or servo.torque_from.name == "torque":
        return np.full(len(bundle.links), np.nan)
    return np.array([one.most_duty * one.volts / one.ohm * one.nm_per_ampere for one in servo.joints])


def grip_of(held: float, moving: np.ndarray, stall: float) -> tuple[float, str]:
    """The declared grip, in the unit of its arguments, and the sentence that gives its origin.

    Args:
        held: largest torque that the gripper held at rest. It is a grip if it exceeds what motion needs.
        moving: torque while it moved, (samples,).
        stall: stall torque of its servo; NaN: unknown.

    Raises:
        ConfigError: nothing was gripped, and the servo's stall torque is unknown.
    """
    gripped = len(moving) and held > 2.0 * np.quantile(moving, 0.95)  # friction alone holds about as much as motion
    if gripped and held > MOST_SHARE * stall:
        return MOST_SHARE * stall, f"it stalls in the data ({held:.3g}); half of the servo's stall torque is used"
    if gripped:
        return held, "the strongest grip in the data is used"
    if np.isnan(stall):
        raise ConfigError(
            "the gripper grips nothing in these recordings, and its stall torque is unknown: set --at-most-nm, or "
            "record some grips"
        )
    return GRIP_SHARE * stall, "nothing is gripped in the data; a quarter of the servo's stall torque is used"


def settings_text(
    settings: GuardSettings, bundle: Bundle, sources: Sequence[Path], minutes: float, notes: Sequence[str]
) -> str:
    """guard.toml."""
    units = sorted(set(bundle.estimate_units))
    source = bundle.servo.torque_from.name.replace("_", "-") if bundle.servo.on else "torque"
    lines = [
        f"# Written by `tauext guard` from {', '.join(path.name for path in sources)}: {minutes:.1f} minutes, torque "
        f"from {source}. Torques are in {', '.join(units)}.",
        *(f"# {note}" for note in notes),
        f"hold_s = {settings.hold_s:g}  # a stall is reported after this time",
        "",
        "[joints]  # torque of the motor in the data: the largest held at rest, and the largest at any time",
    ]
    for joint, usual in settings.joints.items():
        lines.append(f"{json.dumps(joint)} = {{ held = {usual.held:.4g}, largest = {usual.largest:.4g} }}")
    if settings.grip is not None:
        lines += ["", "[grip]  # torque of the gripper that is no stall"]
        lines += [f"joint = {json.dumps(settings.grip.joint)}", f"at_most_nm = {settings.grip.at_most_nm:.4g}"]
    return "\n".join(lines) + "\n"
