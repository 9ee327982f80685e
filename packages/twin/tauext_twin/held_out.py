"""How far a robot file and its twin explain motion that they were not made of: torques, and positions over windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from tauext import _core
from tauext.data.free_motion import cut
from tauext.data.recording import Recording
from tauext.fit.training_set import Setup
from tauext.robot.compile import no_mujoco_warnings
from tauext_twin.arm import Arm
from tauext_twin.model_file import Drive
from tauext_twin.posterior import FRICTION, Kind, Posterior

MOVES_RAD_S = 0.02
"""Slower, a simulator's friction may hold any torque within +-frictionloss."""
GROUPS = {
    "presliding memory": (Kind.presliding, Kind.local_memory),
    "Stribeck": (Kind.coulomb,),
    "load share": (Kind.load, Kind.load_presliding),
    "backlash": (Kind.backlash,),
    "torque ripple": (Kind.ripple,),
    "constant": (Kind.constant,),
}
"""What a simulator's damping and frictionloss cannot hold, by kinds of terms: what these terms are beside both."""
CURVE_S, CURVE_ROWS = 12.0, 400
"""Length [s] and most values of the curves of a page."""
WINDOWS_S = (0.2, 1.0, 5.0)
MOST_WINDOWS = 40
STEP_S = 0.002
"""Longest step of a simulation."""


@dataclass(frozen=True)
class Model:
    """A robot file as a simulator has it."""

    tree: _core.Tree
    damping: np.ndarray
    frictionloss: np.ndarray


def torque_errors(arm: Arm, models: Sequence[Model], speed: float) -> tuple[np.ndarray, np.ndarray]:
    """RMSE of each model's torque in the test motion, (models, n), and RMS of the torque, (n,), [N m].

    Both behind the observer, over the samples in which the joint moves.

    Args:
        speed: smoothing of Coulomb friction, [rad/s].
    """
    squares, energy, count = np.zeros((len(models), arm.setup.tree.size)), 0.0, 0.0
    for recording in arm.test:
        for k, model in enumerate(models):
            left, moves = left_over(arm.setup, model, recording, speed)
            squares[k] += np.where(moves, left**2, 0.0).sum(axis=0)
        torque, moves = left_over(arm.setup, None, recording, speed)
        energy = energy + np.where(moves, torque**2, 0.0).sum(axis=0)
        count = count + moves.sum(axis=0)
    rows = np.maximum(count, 1)
    return np.sqrt(squares / rows), np.sqrt(np.asarray(energy) / rows)


def curves(arm: Arm, models: Sequence[Model], speed: float) -> dict[str, Any]:
    """Measured torque behind the observer and what the models make of it, by joint, in the liveliest CURVE_S of the
    test motion; at most CURVE_ROWS values each, [N m]."""
    recording = max(arm.test, key=lambda one: one.duration_s)
    width = max(2, round(CURVE_S * recording.rate_hz))
    moved = np.cumsum(np.r_[0.0, (recording.dq**2).sum(axis=1)])
    first = int(np.argmax(moved[width:] - moved[:-width])) if len(moved) > width else 0
    lead = round((arm.setup.warm_up_s + 0.1) * recording.rate_hz)
    part = cut(recording, slice(max(0, first - lead), first + width))
    torque = -left_over(arm.setup, None, part, speed)[0]
    shown = slice(None, None, max(1, len(torque) // CURVE_ROWS))
    step_s = arm.setup.network_period_s * (shown.step or 1)
    return {
        "step_s": step_s,
        "measured": torque[shown].round(5).T.tolist(),
        **{
            name: (torque + left_over(arm.setup, model, part, speed)[0])[shown].round(5).T.tolist()
            for name, model in zip(("file", "twin"), models, strict=True)
        },
    }


def left_over(setup: Setup, model: Model | None, recording: Recording, speed: float) -> tuple[np.ndarray, np.ndarray]:
    """What a model leaves of the torque, and which joints move, (rows, n) each; None: the torque itself."""
    n = setup.tree.size
    links = setup.tree.links if model is None else model.tree.links
    if model is None:
        for link in links:
            link.mass = link.rotor_inertia = 0.0
            link.com, link.inertia = [0.0] * 3, [0.0] * 6
    prior = _core.PriorSettings()
    if model is not None:
        prior.terms = [
            term for j in range(n) for term in (_core.Term(Kind.viscous, j), _core.Term(Kind.coulomb, j, speed=speed))
        ]
        weights = np.zeros((n, 2 * n))
        weights[np.arange(n), 2 * np.arange(n)] = -model.damping
        weights[np.arange(n), 2 * np.arange(n) + 1] = -model.frictionloss
        prior.weights = weights.ravel().tolist()
    seen = _core.observe(_core.Tree(links, setup.tree.gravity), setup.observer, *recording.signals, prior)
    rows = np.flatnonzero(seen.warm)[:: setup.observer.network_stride]
    left = seen.residual[rows] - (seen.prior[rows] if model is not None else 0.0)
    return left, np.abs(recording.dq[rows]) > MOVES_RAD_S


def unheld(arm: Arm, posterior: Posterior, x: np.ndarray, model: Model, speed: float) -> dict[str, np.ndarray]:
    """Share of the squared error of the twin's torque that each of GROUPS explains beside it, (n,)."""
    setup, n = arm.setup, arm.setup.tree.size
    terms = [term for of in posterior.terms for term in of]
    settings = _core.PriorSettings()
    settings.widths_rad, settings.branches = setup.widths_rad, setup.prior.branches
    settings.terms, settings.weights = terms, [0.0] * (n * len(terms))
    settings.corrected_links = setup.prior.corrected_links
    ends = np.cumsum([0, *map(len, posterior.terms)])
    base, explained = np.zeros(n), {name: np.zeros(n) for name in GROUPS}
    for recording in arm.test:
        left, moves = left_over(setup, model, recording, speed)
        seen = _core.observe(setup.tree, setup.observer, *recording.signals, _core.PriorSettings())
        rows = np.flatnonzero(seen.warm)[:: setup.observer.network_stride]
        values = _core.prior_regressors(setup.tree, setup.observer, settings, *recording.signals, rows)
        base += np.where(moves, left**2, 0.0).sum(axis=0)
        for name, kinds in GROUPS.items():
            held = posterior.friction(x, [kind for kind in kinds if kind in FRICTION], bounded=False)
            for j in range(n):
                own = np.arange(ends[j], ends[j + 1])
                mine = own[[terms[m].kind in kinds for m in own]]
                beside = values[:, mine] @ x[mine] + values[:, list(posterior.sliding[j])] @ held[j]
                explained[name][j] += np.where(moves[:, j], left[:, j] ** 2 - (left[:, j] - beside) ** 2, 0.0).sum()
    return {name: one / np.maximum(base, 1e-300) for name, one in explained.items() if np.any(one != 0)}


def rollout_errors(
    arm: Arm, model: mujoco.MjModel, joints: Sequence[int], drives: Sequence[Drive] | None
) -> dict[float, np.ndarray]:
    """RMS error of position at the end of windows, by their length, (n,), [rad]; infinite where it diverges.

    From recorded states, the recorded torques act, or the recorded goals through servos' drives. Contacts, limits and
    constraints are off; other joints stay where they are.
    """
    off = (mujoco.mjtDisableBit.mjDSBL_CONTACT, mujoco.mjtDisableBit.mjDSBL_LIMIT, mujoco.mjtDisableBit.mjDSBL_EQUALITY)
    model.opt.disableflags |= int(sum(map(int, (*off, mujoco.mjtDisableBit.mjDSBL_AUTORESET))))
    model.opt.gravity, model.opt.integrator = arm.setup.tree.gravity, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    qpos, dofs = model.jnt_qposadr[list(joints)], model.jnt_dofadr[list(joints)]
    units = np.array(arm.setup.observer.nm_per_unit or [1.0] * len(joints))
    with no_mujoco_warnings():  # of states that diverge
        return _ends(arm, model, (qpos, dofs), units, drives)


def _ends(
    arm: Arm,
    model: mujoco.MjModel,
    at: tuple[np.ndarray, np.ndarray],
    units: np.ndarray,
    drives: Sequence[Drive] | None,
) -> dict[float, np.ndarray]:
    """RMS errors at the ends of all windows; see rollout_errors.

    Args:
        at: where position and velocity of the joints are in MuJoCo's state.
        units: of the recorded torque, [N m].
    """
    qpos, dofs = at
    found: dict[float, np.ndarray] = {}
    for window_s in WINDOWS_S:
        errors = []
        for recording, first, last in windows(arm.test, window_s):
            data = mujoco.MjData(model)
            data.qpos[qpos], data.qvel[dofs] = recording.q[first], recording.dq[first]
            still = data.qpos.copy()
            steps = max(1, round(1 / (recording.rate_hz * STEP_S)))
            model.opt.timestep = 1 / (recording.rate_hz * steps)
            goals = recording.q_des if drives is not None else None
            for k in range(first, last):
                for part in range(steps):
                    share = part / steps
                    if drives is not None and goals is not None:
                        torque = [
                            np.clip(d.kp * (g - q) - d.kd * v, -d.most_nm, d.most_nm)
                            for d, g, q, v in zip(drives, goals[k], data.qpos[qpos], data.qvel[dofs], strict=True)
                        ]
                    else:
                        torque = units * ((1 - share) * recording.tau[k] + share * recording.tau[k + 1])
                    data.qfrc_applied[dofs] = torque
                    mujoco.mj_step(model, data)
                    now = data.qpos[qpos].copy()
                    data.qpos[:] = still
                    data.qpos[qpos] = now
            errors.append(data.qpos[qpos] - recording.q[last])
        if errors:
            found[window_s] = np.sqrt(np.mean(np.square(np.nan_to_num(errors, nan=np.inf)), axis=0))
    return found


def windows(recordings: Sequence[Recording], window_s: float) -> list[tuple[Recording, int, int]]:
    """First and last sample of windows without a gap, evenly over the motion, at most MOST_WINDOWS."""
    found = []
    for recording in recordings:
        length = round(window_s * recording.rate_hz)
        for first in range(0, recording.samples - length - 1, max(length, 1)):
            if 1e-9 * (recording.t_ns[first + length] - recording.t_ns[first]) < 1.05 * window_s:
                found.append((recording, first, first + length))
    step = max(1, len(found) // MOST_WINDOWS)
    return found[::step][:MOST_WINDOWS]
