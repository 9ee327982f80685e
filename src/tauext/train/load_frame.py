"""Frames of the arm for loads and forces, shapes of its links, and errors of an arm found in the motion."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext._core import Bundle, Load, LoadSettings, Tree
from tauext.bundle.units import left_out
from tauext.config import PriorConfig
from tauext.data.recording import Recording
from tauext.errors import ConfigError, RobotError
from tauext.fit.find_kinematics import ArmSearch, Candidate, Kinematics, KinematicSample, all_pieces, refined
from tauext.fit.prior_terms import PriorFit, own_terms
from tauext.fit.training_set import Setup
from tauext.robot.capsules import link_capsules
from tauext.robot.frames import load_frame, wrench_frames
from tauext.train.preparation import TrainingRun

# --- Accuracy of an arm found in the motion for loads not in training.


def load_disagreement(
    setup: Setup, recordings: Sequence[Recording], config: PriorConfig, kinematics: Kinematics
) -> float | None:
    """Relative difference of a load's torques between arms refitted to each half of the motion.

    Axes are kept. Lengths start off by half a link, 0.2 m, differently for each half, and are fitted to that half: a
    length not determined by the motion stays wrong and increases the difference. The result is the largest root mean
    square over joints, divided by the largest weight torque of the load.

    Returns:
        The share; None if a half is too short, or nothing weighs on the arm.
    """
    own = [own_terms(setup, config, joint) for joint in range(setup.tree.size)]
    joints = tuple(link.joint_name for link in setup.tree.links)
    parts = all_pieces(recordings, ArmSearch.piece_s)
    arms = []
    for seed, half in enumerate((parts[: len(parts) // 2], parts[len(parts) // 2 :])):
        sample = KinematicSample(setup.tree, setup.observer, half, own, setup.widths_rad)
        if sample.rows < ArmSearch.least_rows:
            return None
        shifts = np.random.default_rng(seed).normal(size=(sample.joints, 2)) * 0.2
        off = kinematics.moved(np.zeros((sample.joints, 2)), shifts)
        start = Candidate(off, np.inf, np.ones(sample.joints))
        arms.append(refined(sample, start, frozenset()).kinematics)
    poses = np.concatenate([recording.q[:: max(1, recording.samples // 500)] for recording in recordings])
    first, second = (weight(arm, joints, setup.tree.gravity, np.ascontiguousarray(poses)) for arm in arms)
    apart = np.sqrt(np.mean((first - second) ** 2, axis=0)).max()
    whole = np.sqrt(np.mean((0.5 * (first + second)) ** 2, axis=0)).max()
    return float(apart / whole) if whole > 0 else None


def last_axis_shows(
    links: Sequence[_core.Link], gravity: Sequence[float], recordings: Sequence[Recording], error_nm: float
) -> bool:
    """Whether the last link's weight torque on its own joint exceeds the prior's error there, error_nm.

    Otherwise the direction of its axis is unknown, and so is the place of a load. A wrong sign would be off by twice
    the torque, so three errors are asked for.
    """
    poses = np.ascontiguousarray(np.concatenate([one.q[:: max(1, one.samples // 500)] for one in recordings]))
    torque = _core.Tree(list(links), list(gravity)).momentum(poses, np.zeros_like(poses))[1][:, -1]
    return bool(np.sqrt(np.mean(torque**2)) > 3.0 * error_nm)


def weight(kinematics: Kinematics, joints: Sequence[str], gravity: Sequence[float], poses: np.ndarray) -> np.ndarray:
    """Torques of a kilogram, 0.1 m along the last axis of a weightless arm as at a flange, (poses, joints) [N m]."""
    links = kinematics.tree(joints, gravity).links
    links[-1].mass, links[-1].com = 1.0, [0.0, 0.0, 0.1]
    return _core.Tree(links, list(gravity)).momentum(poses, np.zeros_like(poses))[1]


# --- Loads of the arm: frame and largest mass.


def put_load(run: TrainingRun, bundle: Bundle, setup: Setup, fit: PriorFit | None) -> None:
    """Enable loads in the bundle if its model allows it; otherwise report the reason.

    The frame is the robot file's (robot.load_frame), or the last link's of an arm found in the motion and confirmed by
    each half. The largest mass is the one whose weight at that frame takes a drive to its limit at some pose of
    training; half the arm's own if the robot file states no limits.

    Args:
        setup: with the prior, if there is one.
        fit: fit of the prior; None: no prior.

    Raises:
        ConfigError: the requested load frame does not exist.
    """
    bundle.assume_load()
    settings, asked = bundle.load_settings, run.config.load_frame
    carries = any(link.mass > 0 for link in bundle.links)
    newtons = not bundle.too_few_in_newtons("")
    if carries and newtons:
        try:
            frame = load_frame(run.given.robot, run.tree, asked)
        except RobotError as error:
            if asked is not None:
                raise ConfigError(str(error)) from error
            settings.refused = str(error)
            settings.link = -1
        else:
            settings.frame, settings.link, settings.refused = frame.name, frame.link, ""
            settings.rotation, settings.translation = frame.rotation.ravel().tolist(), frame.translation.tolist()
            limits = run.torque_limit_nm
            settings.largest_mass_kg = largest_mass_kg(run, settings, run.tree, limits) or settings.largest_mass_kg
    elif asked is not None:
        raise ConfigError(f"load_frame = {asked}: the arm has no model with this frame")
    elif newtons and fit is not None and fit.kinematics is not None:
        put_found_arm(run, bundle, settings, setup, fit, fit.kinematics)
    bundle.load_settings = settings
    names = left_out(bundle)
    run.facts["load"] = load_facts(settings) | ({"left_out": names} if names else {})


def put_found_arm(
    run: TrainingRun, bundle: Bundle, settings: LoadSettings, setup: Setup, fit: PriorFit, found: Kinematics
) -> None:
    """Enable loads for an arm found in the motion, if its last axis is determined and both halves confirm its
    lengths."""
    motion, last = run.motion.uncut, run.joints[-1]
    if not last_axis_shows(fit.settings.corrected_links, bundle.gravity, motion, float(fit.error_nm[-1])):
        settings.refused = (
            "the bundle has no model of the arm, and the motion does not determine the direction of the axis of "
            f"{last}: hardly anything weighs on it"
        )
        return
    share = load_disagreement(setup, motion, run.config.prior, found)
    if share is None or share > 0.1:  # three times a load's own error
        why = (
            "there is too little motion to check it" if share is None else f"its halves differ by {share:.0%} of a load"
        )
        settings.refused = f"the bundle has no model of the arm, and the one found in the motion is uncertain: {why}"
        return
    run.facts["load_disagreement"] = round(share, 4)
    tree = found.tree(run.joints, run.tree.gravity)
    length_m = sum(float(np.linalg.norm(link.translation)) for link in tree.links)
    settings.frame, settings.link = f"axis of {last}", len(run.joints) - 1
    settings.largest_reach_m = max(0.5 * length_m, 0.3)
    settings.refused = ""
    limits = np.where(bundle.in_newtons, bundle.possible_torque_nm, np.inf)
    settings.largest_mass_kg = largest_mass_kg(run, settings, tree, limits) or 1.0


def largest_mass_kg(run: TrainingRun, settings: LoadSettings, tree: Tree, limits: np.ndarray) -> float | None:
    """Mass at the frame's origin whose weight takes a joint to its limit at some pose of training.

    None: no joint that the mass weighs on has a limit.
    """
    poses = np.concatenate([recording.q for recording in run.training])
    poses = np.ascontiguousarray(poses[:: max(1, len(poses) // 5000)])
    links = tree.links
    links[settings.link] = settings.merged(Load(1.0), links[settings.link])
    at_rest = np.zeros_like(poses)
    heavier = Tree(links, tree.gravity).momentum(poses, at_rest)[1] - tree.momentum(poses, at_rest)[1]
    levers = np.abs(heavier).max(axis=0)
    bounded = np.isfinite(limits) & (levers > 1e-6)  # for a kilogram; a smaller lever does not determine the mass
    return float((limits[bounded] / levers[bounded]).min()) if bounded.any() else None


def load_facts(settings: LoadSettings) -> dict:
    """Load settings as plain JSON."""
    if not settings.settable:
        return {"refused": settings.refused}
    bounds = {"largest_mass_kg": settings.largest_mass_kg, "largest_reach_m": settings.largest_reach_m}
    return {"frame": settings.frame, **bounds}


# --- Accuracy of forces: the robot file's frames, and errors of the torque constants.


def put_wrench(run: TrainingRun, bundle: Bundle) -> None:
    """Add the robot file's frames for forces, and the errors of the torque constants.

    Fitted constants have individual standard errors and a common one. Known constants, and torques recorded in N m, may
    be off by config.torque_share each. The friction of gears under a push is part of `contact_sigma_nm`.
    """
    settings = bundle.wrench_settings
    share = np.full(len(run.joints), run.config.torque_share)
    if run.constants is not None:
        found = run.constants.shares
        share = np.where(np.isfinite(found) & (found > 0), np.minimum(found, 1.0), share)
        settings.common_share = min(run.constants.common_share, 1.0)
    settings.torque_share = share.tolist()
    if any(link.mass > 0 for link in bundle.links):
        try:
            settings.frames = wrench_frames(run.given.robot, run.tree)
            put_shapes(run, bundle)
        except RobotError as error:
            run.notes.append(f"forces are available at links only: {error}")
    bundle.wrench_settings = settings
    run.facts["wrench"] = {"torque_share": [round(one, 4) for one in share.tolist()]}
    run.facts["wrench"] |= {"common_share": round(settings.common_share, 4)} if settings.common_share else {}


def put_shapes(run: TrainingRun, bundle: Bundle) -> None:
    """Add capsules of the robot file's links to the bundle; links without a shape get guessed ones, and a note."""
    bundle.capsules, notes = link_capsules(run.given.robot, run.tree, run.given.meshes)
    shaped = {one.link for one in bundle.capsules}
    guessed = [link.joint_name for number, link in enumerate(bundle.links) if number not in shaped]
    run.facts["shapes"] = {"capsules": len(bundle.capsules), "guessed": guessed, "notes": notes}
    if guessed:
        bare = "the robot file has no geometry for them; import with the robot file that has the arm's meshes"
        run.notes.append(
            f"the shapes of {len(guessed)} of {len(bundle.links)} links are guessed, and so are places of touches on "
            f"{', '.join(guessed)}: {notes[0] if notes else bare}"
        )
