"""A twin: the user's robot file with what the arm's motion showed, beside it a JSON with errors, and a page."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from tauext import _core
from tauext.files.provenance import provenance, write_json
from tauext.fit.prior_terms import encoder_count
from tauext.progress import Reporter
from tauext.robot.read import choose_joints, compiled, make_tree
from tauext_twin.arm import Arm
from tauext_twin.held_out import Model, curves, rollout_errors, torque_errors, unheld
from tauext_twin.model_file import KINDS, Drive, JointChange, body_change, expect_kinds, given_of, write_model
from tauext_twin.posterior import OF_LINK, VALUES, Posterior, find_posterior
from tauext_twin.usd_file import write_usd

DIFFERS = 2.0
"""A parameter is written where it differs from the file's by this many standard errors."""
MISLEADS = 0.25
"""Share of a twin's squared error that friction by load or place explains, from which a constant misleads."""


def make_twin(arm: Arm, out: Path, draws: int, seed: int, report: Reporter) -> dict[str, Any]:
    """Write OUT, OUT's draws, and NAME.twin.json; returns the content of the last one.

    Raises:
        TauextError: too little motion, or a file that cannot be written.
    """
    expect_kinds(arm.given, out)
    report.say("fitting friction, inertia and masses")
    posterior = find_posterior(arm)
    x = posterior.off_the_file()
    values, errors = posterior.values(x), posterior.standard_errors(seed)
    moved: np.ndarray = np.any(posterior.theta(x)[:, : len(OF_LINK) - 1] != 0, axis=1)
    deviations, sampling = noise(arm), errors.copy()  # what a lag hides makes no file's rotor inertia better
    sampling[:, 2] = np.sqrt(np.maximum(errors[:, 2] ** 2 - posterior.hidden**2, 0.0))
    changes = changes_of(arm, values, sampling, moved, deviations)
    note = f"made by tauext twin {_core.__version__} from {arm.given.name}; errors are in {side_file(out).name}"
    sensors = write(arm, out, changes, note)
    for k, drawn in enumerate(posterior.draws(draws, seed + 1)):
        every = changes_of(arm, drawn, np.zeros_like(errors), np.ones(len(arm.names), dtype=bool), deviations)
        name = out.with_name(f"{out.stem}-{k:0{max(3, len(str(draws - 1)))}d}{out.suffix}")
        write(arm, name, every, f"{note}; draw {k} of seed {seed}")
    report.say("judging on motion that was left out")
    joints = parameters(arm, values, errors, changes)
    content = {
        "robot": arm.given.name,
        "out": out.name,
        "joints": joints,
        "drives": {name: vars(change.drive) for name, change in zip(arm.names, changes, strict=True) if change.drive},
        "noise": {"encoder_count_rad": encoder_count(arm.test)} | deviations,
        "sensors": sensors,
        **judged(arm, posterior, x, changes, joints),
        **provenance("tauext twin", {"draws": draws, "training": [one.name for one in arm.training]}, seed),
    }
    write_json(content, side_file(out))
    return content


def side_file(out: Path) -> Path:
    """The JSON beside a twin."""
    return out.with_suffix(".twin.json")


def write(arm: Arm, out: Path, changes: list[JointChange], note: str) -> list[str]:
    """Write one robot file, by its ending; returns the sensors it got."""
    out.parent.mkdir(parents=True, exist_ok=True)
    if KINDS.get(out.suffix) != "USD":
        return write_model(arm.robot, out, changes, note)
    named = [replace(change, joint=name) for change, name in zip(changes, arm.of_out, strict=True)]
    write_usd(arm.robot, out, arm.setup.tree, named, note, arm.usd)
    return []


def changes_of(
    arm: Arm, values: np.ndarray, errors: np.ndarray, moved: np.ndarray, deviations: dict[str, list[float]]
) -> list[JointChange]:
    """What the file gets; a parameter within its error of the file's stays, and a rotor inertia within its error of 0.

    Joints whose torque constant is unknown keep the file's parameters.

    Args:
        values, errors: of VALUES, (n, 8).
        moved: links whose inertial parameters change.
        deviations: see noise().
    """
    given, drives = given_of(arm.robot, arm.setup.tree), drives_of(arm)
    found = []
    for j, change in enumerate(body_change(arm.robot, arm.setup.tree, values, moved & arm.in_nm)):
        differs = (np.abs(values[j, :3] - given[j, :3]) > DIFFERS * errors[j, :3]) & arm.in_nm[j]
        differs[:2] = differs[:2].any()  # damping and frictionloss stand for one friction
        differs[2] &= shows(values[j, 2], errors[j, 2])
        damping, loss, armature = (float(v) if d else None for v, d in zip(values[j, :3], differs, strict=True))
        if armature is not None:
            armature = max(armature - given[j, 3], 0.0)
        drive, known = drives[j] if drives else None, 3 if arm.in_nm[j] else 2
        own = tuple(of_joint[j] for of_joint in deviations.values())[:known]
        found.append(replace(change, damping=damping, frictionloss=loss, armature=armature, drive=drive, noise=own))
    return found


def shows(value: float, error: float) -> bool:
    """Whether a value that cannot be below 0 differs from it."""
    return value > DIFFERS * error


def drives_of(arm: Arm) -> list[Drive]:
    """Position drives of a servo arm, with torque constants as trained; empty without servos."""
    servo = arm.bundle.servo
    if not servo.on or servo.torque_from.name not in ("goal", "duty"):
        return []
    return [
        Drive(
            kp=unit * one.nm_per_ampere * one.volts / one.ohm * one.duty_per_rad,
            kd=unit * one.nm_per_ampere * one.back_emf_v_s / one.ohm,
            most_nm=unit * one.nm_per_ampere * one.volts * one.most_duty / one.ohm,
            ohm=one.ohm,
            nm_per_ampere=unit * one.nm_per_ampere,
        )
        for one, unit in zip(servo.joints, arm.units.tolist(), strict=True)
    ]


def parameters(arm: Arm, values: np.ndarray, errors: np.ndarray, changes: list[JointChange]) -> dict[str, Any]:
    """Each joint's parameters: value, standard error, the file's, and whether the twin's file has the value."""
    given, found = given_of(arm.robot, arm.setup.tree), {}
    for j, (name, link, change) in enumerate(zip(arm.names, arm.setup.tree.links, changes, strict=True)):
        file = (*given[j, :3], link.mass, *link.com, 1.0)
        found[name] = {
            what: {
                "value": float(values[j, k]),
                "standard_error": float(errors[j, k]),
                "file": float(file[k]),
                "written": getattr(change, what if k < 3 else "inertial") is not None,
            }
            for k, what in enumerate(VALUES)
        }
    return found


def noise(arm: Arm) -> dict[str, list[float]]:
    """Standard deviations of the noise of q [rad], dq [rad/s] and tau [N m], by joint: of third differences, which
    motion hardly has."""
    found = {}
    for signal in ("q", "dq", "tau"):
        thirds = [np.abs(np.diff(getattr(one, signal), 3, axis=0)) for one in arm.test if one.samples > 3]
        units = arm.units if signal == "tau" else 1.0
        found[signal] = (1.4826 * np.median(np.concatenate(thirds), axis=0) / np.sqrt(20) * units).tolist()
    return found


def changed_model(arm: Arm, changes: list[JointChange]) -> tuple[mujoco.MjModel, Model]:
    """MuJoCo's model of the robot file with these changes, and the same as a Model."""
    model, given = compiled(arm.robot), given_of(arm.robot, arm.setup.tree)
    choice = choose_joints(model, [link.joint_name for link in arm.setup.tree.links], {}, str(arm.robot))
    dofs = model.jnt_dofadr[choice.joint_ids]
    friction = given[:, :2].copy()
    for j, change in enumerate(changes):
        both = zip(given[j], (change.damping, change.frictionloss), strict=False)
        friction[j] = [file if new is None else new for file, new in both]
        if change.armature is not None:
            model.dof_armature[dofs[j]] = change.armature
        if (new := change.inertial) is not None:
            body = model.body(new.body).id
            model.body_mass[body], model.body_ipos[body] = new.mass, new.com
            model.body_inertia[body], model.body_iquat[body] = new.inertia, new.axes
    damping, loss = friction.T
    model.dof_frictionloss[dofs] = loss
    model.dof_damping[dofs] = damping.reshape(-1, *[1] * (model.dof_damping.ndim - 1))
    tree = make_tree(model, choice.joint_ids, choice.qpos, arm.setup.tree.gravity, str(arm.robot))
    return model, Model(tree, damping, loss)


def judged(
    arm: Arm, posterior: Posterior, x: np.ndarray, changes: list[JointChange], joints: dict[str, Any]
) -> dict[str, Any]:
    """Held-out torque and rollouts of the file as it came and of the twin, and what no simulator's joint holds."""
    (came, came_model), (twin, twin_model) = changed_model(arm, []), changed_model(arm, changes)
    errors, rms = torque_errors(arm, [came_model, twin_model])
    beside = unheld(arm, posterior, x, twin_model)
    drives = drives_of(arm) if all(one.q_des is not None for one in arm.test) else []
    rolled = [rollout_errors(arm, model, drives) for model in (came, twin)]
    by_joint: dict[str, dict[str, Any]] = {
        name: {
            "unit": "N m" if arm.in_nm[j] else "recorded unit",
            "rms": float(rms[j]),
            "rmse_file": float(errors[0, j]),
            "rmse_twin": float(errors[1, j]),
            "lag_s": float(posterior.lag_s[j]),
            "not_held": {what: float(share[j]) for what, share in beside.items()},
        }
        for j, name in enumerate(arm.names)
    }
    return {
        "torque": by_joint,
        "warnings": warnings_of(by_joint, joints),
        "curves": curves(arm, {"file": came_model, "twin": twin_model}),
        "rollout": {
            "replayed": "goals" if drives else "torques",
            "rms_end_rad": {
                f"{window:g}": {"file": finite(rolled[0][window]), "twin": finite(rolled[1][window])}
                for window in rolled[0]
            },
        },
    }


def warnings_of(by_joint: dict[str, dict[str, Any]], joints: dict[str, Any]) -> list[str]:
    """Sentences about joints that a twin does not serve: friction that no constant holds, torques that it explains
    worse than the file as it came, and rotor inertias that do not show."""
    rotors = {name: one["armature"] for name, one in joints.items()}
    unseen = [name for name, one in rotors.items() if not shows(one["value"], one["standard_error"])]
    worse = [
        f"{name}: the twin's error of {one['rmse_twin']:.3g} {one['unit']} exceeds that of the file as it came, "
        f"{one['rmse_file']:.3g}; record more motion of this joint"
        for name, one in by_joint.items()
        if one["rmse_twin"] > one["rmse_file"]
    ]
    if unseen:
        worse.append(
            f"{', '.join(unseen)}: the motion does not show the rotor inertia, which is within two standard errors of "
            "0; a torque that lags behind the motion, or is measured behind the gear, hides it"
        )
    return worse + [
        f"{name}: {what} explains {share:.0%} of the twin's squared error, so that a constant friction misleads"
        for name, one in by_joint.items()
        for what, share in one["not_held"].items()
        if what in ("load share", "torque ripple", "backlash") and share > MISLEADS
    ]


def finite(values: np.ndarray) -> list[float | None]:
    """For JSON; None where it diverged."""
    return [float(value) if np.isfinite(value) else None for value in values]
