"""How far a robot file and its twin explain motion that they were not made of: torques, and positions over windows."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from tauext import _core
from tauext.data.free_motion import cut
from tauext.data.recording import Recording
from tauext.robot.compile import no_mujoco_warnings
from tauext.robot.model_case import empty
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


def torque_errors(arm: Arm, models: Sequence[Model]) -> tuple[np.ndarray, np.ndarray]:
    """RMSE of each model's torque in the test motion, (models, n), and RMS of the torque, (n,), [N m].

    Both behind the observer, over the samples in which the joint moves.
    """
    every: tuple[Model | None, ...] = (None, *models)
    squares, count = np.zeros((len(every), arm.setup.tree.size)), np.zeros(arm.setup.tree.size)
    for recording in arm.test:
        for k, model in enumerate(every):
            left, moves = left_over(arm, model, recording)
            squares[k] += np.where(moves, left**2, 0.0).sum(axis=0)
        count += moves.sum(axis=0)
    rms, *errors = np.sqrt(squares / np.maximum(count, 1))
    return np.array(errors), rms


def curves(arm: Arm, models: dict[str, Model]) -> dict[str, Any]:
    """Measured torque behind the observer and what the models make of it, by joint, in the liveliest CURVE_S of the
    test motion; at most CURVE_ROWS values each, [N m]."""
    recording = max(arm.test, key=lambda one: one.duration_s)
    width = max(2, round(CURVE_S * recording.rate_hz))
    moved = np.cumsum(np.r_[0.0, (recording.dq**2).sum(axis=1)])
    first = int(np.argmax(moved[width:] - moved[:-width])) if len(moved) > width else 0
    lead = round((arm.setup.warm_up_s + 0.1) * recording.rate_hz)
    part = cut(recording, slice(max(0, first - lead), first + width))
    torque = -left_over(arm, None, part)[0]
    step = max(1, len(torque) // CURVE_ROWS)
    shown = {"measured": torque} | {name: torque + left_over(arm, model, part)[0] for name, model in models.items()}
    return {"step_s": arm.setup.network_period_s * step} | {
        name: values[::step].round(5).T.tolist() for name, values in shown.items()
    }


def left_over(arm: Arm, model: Model | None, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """What a model leaves of the torque, and which joints move, (rows, n) each; None: the torque itself."""
    setup, none = arm.setup, np.zeros(arm.setup.tree.size)
    model = model or Model(empty(setup.tree), none, none)
    friction = sliding_friction(model.damping, model.frictionloss, arm.speed)
    seen, rows = replace(setup, tree=model.tree).observe(recording, friction)
    return seen.residual[rows] - seen.prior[rows], np.abs(recording.dq[rows]) > MOVES_RAD_S


def sliding_friction(damping: np.ndarray, frictionloss: np.ndarray, speed: float) -> _core.PriorSettings:
    """Viscous and Coulomb friction of each joint as a model of r, which has it with a minus."""
    prior, n = _core.PriorSettings(), len(damping)
    prior.terms = [
        term for j in range(n) for term in (_core.Term(Kind.viscous, j), _core.Term(Kind.coulomb, j, speed=speed))
    ]
    weights = np.zeros((n, n, 2))
    weights[np.arange(n), np.arange(n)] = -np.column_stack([damping, frictionloss])
    prior.weights = weights.ravel().tolist()
    return prior


def unheld(arm: Arm, posterior: Posterior, x: np.ndarray, model: Model) -> dict[str, np.ndarray]:
    """Share of the squared error of the twin's torque that each of GROUPS explains beside it, (n,)."""
    setup, n = arm.setup, arm.setup.tree.size
    terms = [term for of in arm.terms for term in of]
    settings = _core.PriorSettings()
    settings.widths_rad, settings.branches = setup.widths_rad, setup.prior.branches
    settings.terms, settings.weights = terms, [0.0] * (n * len(terms))
    settings.corrected_links = setup.prior.corrected_links
    ends = np.cumsum([0, *map(len, arm.terms)])
    base, explained = np.zeros(n), {name: np.zeros(n) for name in GROUPS}
    for recording in arm.test:
        left, moves = left_over(arm, model, recording)
        _, rows = setup.observe(recording)
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


@no_mujoco_warnings()  # of states that diverge
def rollout_errors(arm: Arm, model: mujoco.MjModel, drives: Sequence[Drive] | None) -> dict[float, np.ndarray]:
    """RMS error of position at the end of windows, by their length, (n,), [rad]; infinite where it diverges.

    From recorded states, the recorded torques act, or the recorded goals through servos' drives. Contacts, limits and
    constraints are off; other joints stay where they are.
    """
    off = (mujoco.mjtDisableBit.mjDSBL_CONTACT, mujoco.mjtDisableBit.mjDSBL_LIMIT, mujoco.mjtDisableBit.mjDSBL_EQUALITY)
    model.opt.disableflags |= int(sum(map(int, (*off, mujoco.mjtDisableBit.mjDSBL_AUTORESET))))
    model.opt.gravity, model.opt.integrator = arm.setup.tree.gravity, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    (qpos, dofs), found = state_of(arm, model), {}
    for window_s in WINDOWS_S:
        errors = []
        for recording, first, last in windows(arm.test, window_s):
            data = mujoco.MjData(model)
            data.qpos[qpos], data.qvel[dofs] = recording.q[first], recording.dq[first]
            still = data.qpos.copy()
            steps = max(1, round(1 / (recording.rate_hz * STEP_S)))
            model.opt.timestep = 1 / (recording.rate_hz * steps)
            for k, part in itertools.product(range(first, last), range(steps)):
                if drives and recording.q_des is not None:
                    torque = [
                        np.clip(d.kp * (goal - q) - d.kd * v, -d.most_nm, d.most_nm)
                        for d, goal, q, v in zip(
                            drives, recording.q_des[k], data.qpos[qpos], data.qvel[dofs], strict=True
                        )
                    ]
                else:
                    share = part / steps
                    torque = arm.units * ((1 - share) * recording.tau[k] + share * recording.tau[k + 1])
                data.qfrc_applied[dofs] = torque
                mujoco.mj_step(model, data)
                still[qpos] = data.qpos[qpos]
                data.qpos[:] = still
            errors.append(data.qpos[qpos] - recording.q[last])
        if errors:
            found[window_s] = np.sqrt(np.mean(np.square(np.nan_to_num(errors, nan=np.inf)), axis=0))
    return found


def state_of(arm: Arm, model: mujoco.MjModel) -> tuple[list[int], list[int]]:
    """Where the arm's joints are in MuJoCo's positions and velocities."""
    joints = [model.joint(link.joint_name) for link in arm.setup.tree.links]
    return [int(one.qposadr[0]) for one in joints], [int(one.dofadr[0]) for one in joints]


def windows(recordings: Sequence[Recording], window_s: float) -> list[tuple[Recording, int, int]]:
    """First and last sample of windows without a gap, end to end; at most MOST_WINDOWS, evenly over the motion."""
    found = []
    for one in recordings:
        length = round(window_s * one.rate_hz)
        for first in range(0, one.samples - length, length):
            if 1e-9 * (one.t_ns[first + length] - one.t_ns[first]) < 1.05 * window_s:
                found.append((one, first, first + length))
    return [found[round(k)] for k in np.linspace(0, len(found) - 1, min(MOST_WINDOWS, len(found)))]
