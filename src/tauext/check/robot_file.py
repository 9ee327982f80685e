"""What the robot file has wrong: masses, inertias, names, limits, direction of gravity, load, or another arm."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.check import joint_fit
from tauext.check.examination import Examination
from tauext.check.finding import Finding, Severity
from tauext.check.joint_fit import FitRows
from tauext.check.motion import Stretch
from tauext.check.sensors import noise_nm
from tauext.data.importers.raw import short_list
from tauext.errors import RobotError
from tauext.robot.compile import LEAST
from tauext.robot.inertial import point_inertia, six_of, with_more_at_end
from tauext.robot.read import CarriedBody, carried_bodies, load_tree, movable_joints, robot_sha256, tree_with_inertias
from tauext.robot.torque_limits import torque_limits
from tauext.robot.xml_file import read_xml

# --- Masses, inertias and limits, which loading accepts as the file gives them.


def position_limits(path: Path, joints: Sequence[str]) -> np.ndarray:
    """Lower and upper limits of a URDF (joints, 2), [rad or m]; infinite where the file has none, and for an MJCF."""
    limits = np.tile([-math.inf, math.inf], (len(joints), 1))
    for joint in read_xml(path).root.findall("joint"):
        limit = joint.find("limit")
        if joint.get("name") not in joints or joint.get("type") == "continuous" or limit is None:
            continue
        try:
            low, high = float(limit.get("lower", "0")), float(limit.get("upper", "0"))
        except ValueError:
            continue
        if high > low:  # both 0 means no limits
            limits[list(joints).index(joint.get("name", ""))] = low, high
    return limits


CORRECT = "correct the file: take it from the CAD model, about the centre of mass, in kg m^2 (not kg mm^2)"


@dataclass(frozen=True)
class ImpossibleInertia:
    """A link with an inertia that no body can have, though it is finite, and what it changes can be computed."""

    joint: str
    evidence: str
    body: CarriedBody


def model_findings(bodies: Sequence[CarriedBody], negligible: float = 1e-3) -> Iterator[Finding | ImpossibleInertia]:
    """Findings on masses and inertias of the links that joints in use move: notes where the link's share of what the
    joint moves is negligible, so that nothing changes."""
    for joint in dict.fromkeys(body.joint for body in bodies):
        carried = [body for body in bodies if body.joint == joint]
        for body in carried:
            if not 0 <= body.mass_kg < math.inf:
                evidence = f"link '{body.name}': mass = {body.mass_kg:g} kg"
                yield Finding("inertia-impossible", "fault", joint, evidence, "it must be > 0")
            problem = _impossible(body.inertia_kg_m2) if body.mass_kg > LEAST else None
            if problem:
                evidence = f"link '{body.name}': {problem}"
                if _share(body, carried) <= negligible:
                    evidence += f"; below {negligible:.1%} of what the joint moves, it changes nothing"
                    yield Finding("inertia-impossible", "note", joint, evidence, CORRECT)
                elif np.isfinite(body.inertia_kg_m2).all():
                    yield ImpossibleInertia(joint, evidence, body)
                else:
                    yield Finding("inertia-impossible", "fault", joint, evidence, CORRECT)
        if all(abs(body.mass_kg) <= LEAST for body in carried):
            evidence = f"link '{carried[0].name}' and links fixed to it have no mass"
            advice = "give it its mass, centre of mass and inertia"
            yield Finding("inertia-impossible", "fault", joint, evidence, advice)


def _share(body: CarriedBody, carried: Sequence[CarriedBody]) -> float:
    """Largest share of a body in mass and inertia of the bodies that are carried together."""
    mass = sum(max(one.mass_kg, 0.0) for one in carried)
    inertia = sum(float(np.abs(one.inertia_kg_m2).sum()) for one in carried)
    return max(body.mass_kg / mass, float(np.abs(body.inertia_kg_m2).sum()) / max(inertia, LEAST))


def _impossible(inertia: np.ndarray) -> str | None:
    if not np.isfinite(inertia).all():
        return "an inertia is not finite"
    principal = np.sort(inertia)
    values = f"principal inertias {', '.join(f'{x:.3g}' for x in principal)} kg m^2"
    if principal[0] <= LEAST:
        return f"{values}: not positive"
    # share by which a rounded principal inertia may exceed the sum of the others
    if principal[2] > (principal[0] + principal[1]) * (1 + 1e-3):
        excess = principal[2] / (principal[0] + principal[1]) - 1
        return f"{values}: the largest exceeds the sum of the others by {excess:.2g} of it"
    return None


def inertia_findings(x: Examination) -> Iterator[Finding]:
    """Findings of inertias that no body can have, by what they change in the torques of this motion.

    The inertia is compared with the nearest possible one, whose smaller two principal moments are larger by half of the
    excess each. The recordings can show no less than the error that the fit leaves, the torque's noise, and 2 % of its
    spread: an effect below them is a note. Later checks have the possible inertia in the place of a fault.
    """
    if not x.impossible:
        return
    assert x.robot is not None
    shown_nm, given = _shown_nm(x), x.rows.model if x.motion else None
    wrong: dict[str, np.ndarray] = {}
    for one in x.impossible:
        possible = None if given is None else _tree_with(x, {one.body.name: possible_inertia(one.body)})
        if possible is None or given is None:
            advice = f"{CORRECT}; no joint moves, so that what it changes is not known"
            yield Finding("inertia-impossible", "note", one.joint, one.evidence, advice)
            continue
        effect_nm = np.abs(x.rows.with_model(x.motion, possible).model - given).max(axis=0, initial=0.0)
        worst = int(np.argmax(effect_nm / shown_nm))
        against = f"{shown_nm[worst]:.2g} Nm, what these recordings can show there"
        changes = f"in this motion, it changes the torque of '{x.joints[worst]}' by up to {effect_nm[worst]:.2g} Nm"
        if effect_nm[worst] > shown_nm[worst]:
            evidence = f"{one.evidence}; {changes}, more than {against}"
            wrong[one.body.name] = possible_inertia(one.body)
            yield Finding("inertia-impossible", "fault", one.joint, evidence, CORRECT)
        else:
            evidence = f"{one.evidence}; {changes}, less than {against}"
            yield Finding("inertia-impossible", "note", one.joint, evidence, "no action is needed")
    if wrong:
        x.correct(tree=_tree_with(x, wrong))


def possible_inertia(body: CarriedBody, density_kg_m3: float = 1000.0) -> np.ndarray:
    """The nearest principal moments that the body can have, (3,), [kg m^2]: no principal second moment of its mass,
    half of the sum of two moments less the third, is negative.

    A mass without an inertia, as many files have for a sensor or a flange, has that of a sphere of this density.
    """
    principal = body.inertia_kg_m2
    sphere = 0.4 * body.mass_kg * (3 * body.mass_kg / (4 * math.pi * density_kg_m3)) ** (2 / 3)
    if np.abs(principal).max() < 1e-3 * sphere:
        return np.full(3, sphere)
    second = np.maximum(principal.sum() / 2 - principal, 0.0)
    nearest: np.ndarray = second.sum() - second
    return nearest


def _shown_nm(x: Examination) -> np.ndarray:
    """Least effect that the recordings can show, (joints,), [N m]."""
    tau = np.concatenate([r.tau for r in x.recordings])
    error_nm = np.array([fit.error_nm for fit in x.fits]) if x.has_fit else np.zeros(len(x.joints))
    return np.maximum.reduce(
        [error_nm, noise_nm(x.recordings), joint_fit.SEEN * tau.std(axis=0), np.full(tau.shape[1], 1e-9)]
    )


def _tree_with(x: Examination, inertias: Mapping[str, np.ndarray]) -> _core.Tree:
    """The examination's tree with other principal moments of these links."""
    assert x.robot is not None
    return tree_with_inertias(x.robot, list(x.model_joints), x.gravity, inertias)


NOT_COMPARED = "; torques were not compared with the model: order, sign, scale, load and contacts are not judged"
"""End of the evidence of a fault without whose correction there is no model; it remains where the fault is accepted."""

# --- The robot file: a tree where it can be loaded, else findings of its faults.


def file_findings(x: Examination) -> Iterator[Finding]:
    """Findings of the robot file; gives tree and limits to the examination where the file can be used. A file with none
    of the names has its first joints taken in order: drivers may use other names, and later checks find a wrong order.

    Raises:
        RobotError: the file is missing.
    """
    path = x.robot
    if path is None or not path.is_file():
        raise RobotError(f"{path}: there is no such robot file; give a URDF or MJCF")
    names = list(x.joints)
    x.position_limits_rad = np.tile([-np.inf, np.inf], (len(names), 1))
    x.torque_limits_nm = np.full(len(names), np.inf)
    try:
        known = movable_joints(path)
        unknown = [name for name in names if name not in known]
        foreign = len(unknown) < len(names) or len(known) < len(names)
        if unknown:
            names = names if foreign else known[: len(names)]
            advice = (
                "name the joints as the robot file does, at import"
                if foreign
                else f"taken in the file's order: {', '.join(names)}; name them so at import"
            )
            evidence = f"{', '.join(unknown)} are not in {path.name}; its joints are {', '.join(known)}"
            evidence += NOT_COMPARED if foreign else ""
            yield Finding("joint-names", "fault" if foreign else "warning", None, evidence, advice)
        if not (unknown and foreign):
            judged = list(model_findings(carried_bodies(path, names)))
            found = [one for one in judged if isinstance(one, Finding)]
            # what wrong masses do not explain is no finding; an impossible inertia is judged by its effect
            if any(one.severity == "fault" for one in found):
                yield from (replace(one, evidence=one.evidence + NOT_COMPARED) for one in found)
            else:
                yield from found
                tree, limits_rad = load_tree(path, names, gravity=x.gravity), position_limits(path, names)
                x.torque_limits_nm = torque_limits(path, names)
                x.tree, x.position_limits_rad, x.model_joints = tree, limits_rad, tuple(names)
                x.impossible = [one for one in judged if isinstance(one, ImpossibleInertia)]
    except RobotError as error:
        advice = "correct the file, or check without --robot"
        yield Finding("model-unusable", "fault", None, str(error) + NOT_COMPARED, advice)
    yield from _changed(x, path)


def _changed(x: Examination, path: Path) -> Iterator[Finding]:
    """Finding of recordings made with another robot file, by SHA-256; recordings without one are ignored."""
    now = robot_sha256(path)
    others = [r for r in x.recordings if r.robot_sha256 and r.robot_sha256 != now]
    if not others:
        return
    names = short_list((f"'{r.name}'" for r in others), 3)
    evidence = (
        f"{len(others)} of {len(x.recordings)} recordings ({names}) were made with a file of SHA-256 "
        f"{others[0].robot_sha256[:12]}..., {path.name} has {now[:12]}..."
    )
    advice = "expected if you corrected the model; else give the file that was there when it was recorded"
    one = others[0].name if len(others) == 1 else None
    yield Finding("robot-file-changed", "warning", None, evidence, advice, one)


def limit_findings(x: Examination) -> Iterator[Finding]:
    """Findings of values beyond a limit of the robot file by 0.05 rad or 5 % in at least three rows."""
    assert x.position_limits_rad is not None and x.torque_limits_nm is not None
    for j, joint in enumerate(x.joints):
        q = np.concatenate([r.q[:, j] for r in x.recordings])
        tau = np.abs(np.concatenate([r.tau[:, j] for r in x.recordings]))
        (low, high), limit = x.position_limits_rad[j], x.torque_limits_nm[j]
        outside, over = (q < low - 0.05) | (q > high + 0.05), tau > limit * (1 + 0.05)
        if outside.sum() >= 3:
            evidence = (
                f"positions from {q.min():.4g} to {q.max():.4g} rad, limits {low:.4g} to {high:.4g}; "
                f"{outside.mean():.1%} of the samples are outside"
            )
            advice = "a turn counted too many, another zero position, degrees, or limits of another arm"
            yield Finding("beyond-limit", "warning", joint, evidence, advice)
        if over.sum() >= 3:
            evidence = f"torques up to {tau.max():.4g} {x.unit}, limit {limit:.4g} Nm; {over.mean():.1%} of the samples"
            advice = "another unit of the effort, or limits of another arm"
            yield Finding("beyond-limit", "warning", joint, evidence, advice)


# --- The direction of gravity, and a load that the arm has and the model lacks, by all joints' torques together.


def tilted_tree(stretches: Sequence[Stretch], tree: _core.Tree, rows: FitRows) -> tuple[str, _core.Tree] | None:
    """A direction of gravity that fits far better: evidence, and the tree with that direction. Gravity torque is linear
    in the vector of free fall: three columns common to all joints, beside each joint's own inertia and friction."""
    up = [_core.Tree(list(tree.links), axis) for axis in np.eye(3).tolist()]
    shared, given = np.stack([joint_fit.model_of(stretches, t)[0] for t in up], axis=2), np.array(tree.gravity)
    columns, torques = joint_fit.without_own(rows, shared, rows.tau - rows.inertial)
    known = np.array([joint_fit.robust_spread(y - x @ given) for x, y in zip(columns, torques, strict=True)])
    found, errors, _ = joint_fit.shared_numbers(columns, torques, known, rcond=1e-6)
    size, usual = float(np.linalg.norm(found)), float(np.linalg.norm(given))
    if size == 0 or usual == 0:
        return None
    angle = float(np.degrees(np.arccos(np.clip(found @ given / size / usual, -1, 1))))
    ratio = np.maximum(errors, 1e-9) / np.maximum(known, 1e-9)
    far_better = -np.log(ratio).sum() > 1.0 and ratio.min() < 0.6  # [nats], and at some joint
    # a mounting plate is level within a degree or two, and errors of the model turn gravity by a few more
    if angle < 10.0 or not far_better or not 0.5 < size / usual < 2:
        return None
    components = ", ".join(f"{x:.2f}" for x in found)
    evidence = (
        f"the torques indicate gravity of ({components}) m/s^2 in the base frame, {angle:.0f} degrees from the model's "
        f"({', '.join(f'{x:.2f}' for x in given)}); a joint's error falls to {ratio.min():.0%}"
    )
    return evidence, _core.Tree(list(tree.links), (found / size * usual).tolist())


def gravity_findings(x: Examination) -> Iterator[Finding]:
    """Finding of another direction of gravity; corrects the tree."""
    tilted = tilted_tree(x.motion, x.model, x.rows)
    if tilted is not None:
        advice = "the arm hangs or is tilted: give its gravity direction in the robot's description"
        yield Finding("gravity-direction", "fault", None, tilted[0], advice)
        x.correct(tree=tilted[1])


def unit_findings(
    x: Examination, factors_of: Callable[[Examination], dict[int, tuple[float, float]]]
) -> Finding | None:
    """Finding of a robot file whose masses are in g or whose lengths are in mm: the torques of all joints are a
    thousandth of the model's, or less, and the model is too heavy or too large for an arm."""
    links = x.model.links
    mass_kg, length_m = sum(link.mass for link in links), sum(float(np.linalg.norm(k.translation)) for k in links)
    heavy, long = mass_kg > 500.0, length_m > 50.0
    if not (heavy or long) or not x.rows.gravity.any():
        return None
    factors = [factor for factor, _ in factors_of(x).values()]
    off = float(np.median(factors)) if factors else 1.0
    if not 0.8e-6 < off < 2e-3 or max(factors) > 1.5 * min(factors):
        return None
    limits_nm = np.full(len(links), np.inf) if x.torque_limits_nm is None else x.torque_limits_nm
    over = float((np.abs(x.rows.gravity).max(axis=0) / limits_nm).max())
    times = f", up to {over:.2g} times the file's own torque limits" if over > 2 else ""
    evidence = (
        f"the model of the robot file weighs {mass_kg:.3g} kg and is {length_m:.2g} m long; its torques are "
        f"{1 / off:.3g} times the measured ones at all {len(factors)} joints that show them{times}"
    )
    what = " and ".join(["masses in g, not kg"] * heavy + ["lengths in mm, not m"] * long)
    return Finding("inertia-impossible", "fault", None, evidence, f"correct the robot file: it seems to have {what}")


LEAST_KG = 0.3  # least mass of a load; less is a cable or an error of the links


@dataclass(frozen=True)
class Load:
    """Load to be added to the last link."""

    mass_kg: float
    mass_error_kg: float
    com_m: np.ndarray  # (3,), in the tree's frame of the last joint: z is its axis, x and y are any
    error_nm: np.ndarray  # (joints,), robust: with it
    error_without_nm: np.ndarray

    def on(self, tree: _core.Tree) -> _core.Tree:
        """The tree with the load, if the last link keeps a positive mass."""
        mass = max(self.mass_kg, 0.1 * tree.links[-1].mass - tree.links[-1].mass)
        return with_load(tree, np.r_[mass, mass * self.com_m])


def with_load(tree: _core.Tree, by: np.ndarray) -> _core.Tree:
    """The tree with m and m com (4,) added to the last link."""
    com = by[1:] / by[0] if by[0] else np.zeros(3)
    return with_more_at_end(tree, np.r_[by, six_of(point_inertia(by[0], com))])


def load_columns(stretches: Sequence[Stretch], tree: _core.Tree, rows: FitRows) -> np.ndarray:
    """Torque of 1 kg, and of 1 kg m of first moment, at the last link: (rows, joints, 4)."""
    with_units = (rows.with_model(stretches, with_more_at_end(tree, unit)) for unit in np.eye(4))
    return np.stack([one.model - rows.model for one in with_units], axis=2)


def fit_load(stretches: Sequence[Stretch], tree: _core.Tree, rows: FitRows) -> Load:
    r"""Fit a load by least squares of all joints together.

    .. math:: \tau_i - \hat\tau_i = Z_i(m, m c) + J_i \ddot q_i + friction_i

    with m and m c common to all joints, and J_i and friction of each joint. The load's inertia about its centre of mass
    is neglected: for a hand it is a hundredth of m c^2 + rotor inertia.
    """
    columns, torques = joint_fit.without_own(rows, load_columns(stretches, tree, rows), rows.tau - rows.model)
    without = np.array([joint_fit.robust_spread(y) for y in torques])
    numbers, errors, weights = joint_fit.shared_numbers(
        columns, torques, np.maximum(without, 0.02 * rows.tau.std(axis=0))
    )
    kept = [
        np.delete(np.arange(len(rows.time_s)), b) for b in np.array_split(np.arange(len(rows.time_s)), joint_fit.BLOCKS)
    ]
    parts_kg = [joint_fit.weighted_solve([x[k] for x in columns], [y[k] for y in torques], weights)[0] for k in kept]
    com_m = numbers[1:] / (numbers[0] or 1.0)
    return Load(float(numbers[0]), joint_fit.spread_of(np.array(parts_kg)), com_m, np.maximum(errors, 1e-9), without)


def payload_of(x: Examination, strong: Sequence[int]) -> tuple[Finding, _core.Tree] | None:
    """Finding of a load, if it explains the torques of the joints under gravity, and the tree with the load."""
    load, strong = fit_load(x.motion, x.model, x.rows), list(strong)
    if not strong:
        return None
    gain = np.log(load.error_without_nm[strong] / load.error_nm[strong]).sum()
    sure = abs(load.mass_kg) > max(LEAST_KG, 5.0 * load.mass_error_kg)
    # [m]; no tool is further out, none weighs less than nothing, and taking one away makes no joint's error larger. One
    # that is added may: the joints before it have errors of their own, which it uncovers.
    possible = np.linalg.norm(load.com_m) <= 0.6 and load.mass_kg + x.model.links[-1].mass > 0
    better = load.mass_kg > 0 or bool((load.error_nm[strong] < 1.05 * load.error_without_nm[strong]).all())
    # factors of the torques that leave far less of the errors are the cause
    factors = np.mean([math.log(load.error_nm[j] / max(x.fits[j].error_nm, 1e-9)) for j in strong]) > 0.5
    if not sure or gain < 0.5 or not possible or not better or factors:
        return None
    changes = ", ".join(f"'{x.joints[j]}' {load.error_without_nm[j]:.3g} to {load.error_nm[j]:.3g}" for j in strong)
    what, advice = (
        ("a payload that the model lacks", "add the tool or payload to the model, fixed to the last link")
        if load.mass_kg > 0
        else ("less payload than the model has", "remove the tool or hand that is not mounted from the model")
    )
    evidence = (
        f"{what}: {abs(load.mass_kg):.2f} ± {load.mass_error_kg:.1g} kg at "
        f"({', '.join(f'{c:.2f}' for c in load.com_m)}) m from '{x.joints[-1]}', z along its axis, "
        f"bring the error in {x.unit} from {changes}"
    )
    return Finding("payload", "warning", x.joints[-1], evidence, advice), load.on(x.model)


# --- Another arm's robot file: torque that depends on the pose, but not as the model says.


def other_robot_findings(x: Examination) -> Iterator[Finding]:
    """Finding of a robot file of another arm, by the last fit and the findings that the model's gravity contradicts."""
    rows, fits, joints = x.rows, x.fits, x.joints
    # in less motion, [s], the pose explains anything
    if not rows.has_model or x.position_limits_rad is None or len(np.unique(rows.time_s // 1.0)) < 20.0:
        return
    doubted = ("effort-compensated", "effort-scale", "gravity-direction")
    suspected = any(finding.code in doubted and finding.severity == "fault" for finding in x.all_found)
    low, high = x.position_limits_rad[:, 0] - 0.3, x.position_limits_rad[:, 1] + 0.3
    outside = ((rows.q < low) | (rows.q > high)).mean(axis=0)
    beyond = np.flatnonzero(outside > 0.05).tolist()  # widely, of two joints at least
    beyond = beyond if len(beyond) >= 2 else []
    strong = rows.gravity.std(axis=0) > 0.1 * rows.gravity.std(axis=0).max()
    fitted = [j for j in range(len(joints)) if strong[j] and fits[j].explained > 0.8 and fits[j].gravity_factor[0] > 0]
    if not suspected and len(fitted) > strong.sum() / 2:
        return
    shares = [pose_share(rows, j) for j in range(len(joints))]
    # such a torque has gravity in it that is not the model's
    misfits = [j for j, share in enumerate(shares) if share > 0.3]
    if not misfits and (suspected or not beyond):
        return
    parts = [
        f"{shares[j]:.0%} of the torque of {joints[j]} depends on the pose, but not as the model's gravity does (on "
        "left-out motion)"
        for j in misfits
    ]
    parts += [f"{outside[j]:.0%} of the positions of {joints[j]} are far beyond the file's limits" for j in beyond]
    advice = "perhaps another robot's file: give the one of this arm"
    # A crude model of the right arm also leaves torque unexplained, and training corrects it.
    severity: Severity = "fault" if suspected or beyond else "warning"
    yield Finding("robot-file-other", severity, None, "; ".join(parts), advice)


def pose_share(rows: FitRows, joint: int) -> float:
    """Share of a joint's torque that the pose explains on left-out motion beyond friction, inertia and model: by sines
    and cosines of angles, of sums and differences of two, and of sums of three neighbours, as gravity of any arm whose
    neighbouring axes are parallel or at right angles."""
    model = np.column_stack([rows.gravity[:, joint], rows.inertial[:, joint]])
    plain = np.column_stack([rows.friction[:, joint], rows.acceleration, model])
    with_pose = np.column_stack([plain, _pose_features(rows.q)])
    # motion is left out in blocks of five seconds
    block = (rows.time_s // 5.0).astype(int) % 2
    tau = rows.tau[:, joint]
    errors = np.zeros(2)
    for left_out in (0, 1):
        train, test = block != left_out, block == left_out
        if not train.any() or not test.any():
            return 0.0
        for k, features in enumerate((plain, with_pose)):
            mean, size = features[train].mean(axis=0), features[train].std(axis=0) + 1e-9
            a, b = (features[train] - mean) / size, tau[train] - tau[train].mean()
            weights = np.linalg.solve(a.T @ a + 1e-3 * len(a) * np.eye(a.shape[1]), a.T @ b)
            left = tau[test] - tau[train].mean() - (features[test] - mean) / size @ weights
            errors[k] += float(left @ left)
    spread = float(np.sum((tau - tau.mean()) ** 2))
    return (min(float(errors[0]), spread) - float(errors[1])) / spread if spread > 0 else 0.0


def _pose_features(q: np.ndarray) -> np.ndarray:
    n = q.shape[1]
    angles = [q[:, i] for i in range(n)]
    angles += [q[:, i] + sign * q[:, k] for i in range(n) for k in range(i + 1, n) for sign in (1, -1)]
    angles += [q[:, i] + a * q[:, i + 1] + b * q[:, i + 2] for i in range(n - 2) for a in (1, -1) for b in (1, -1)]
    return np.column_stack([wave(angle) for angle in angles for wave in (np.sin, np.cos)])
