"""p and beta the long way, by Pinocchio's matrices: p = M dq, beta = g - C^T dq."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest

pin = pytest.importorskip("pinocchio")


def read_model(urdf_text: str, rotor_inertia: Mapping[str, float] | None = None):
    """Pinocchio's reading of a URDF, with rotor inertia as its armature."""
    model = pin.buildModelFromXML(urdf_text)
    for joint, inertia in (rotor_inertia or {}).items():
        model.armature[model.joints[model.getJointId(joint)].idx_v] = inertia
    return model


def locked(model, positions: Mapping[str, float]):
    """The model with these joints fixed where they stand."""
    ids = [model.getJointId(joint) for joint in positions]
    q = configurations(model, np.zeros((1, model.nv)), list(model.names)[1:])[0]
    for joint, position in zip(ids, positions.values(), strict=True):
        q[model.joints[joint].idx_q] = position
    return pin.buildReducedModel(model, ids, q)


def configurations(model, q: np.ndarray, joints: list[str]) -> np.ndarray:
    """Pinocchio's positions (samples, nq): a continuous joint takes cosine and sine."""
    out = np.zeros((len(q), model.nq))
    for column, name in enumerate(joints):
        joint = model.joints[model.getJointId(name)]
        if joint.nq == 2:
            out[:, joint.idx_q], out[:, joint.idx_q + 1] = np.cos(q[:, column]), np.sin(q[:, column])
        else:
            out[:, joint.idx_q] = q[:, column]
    return out


def momentum(model, q: np.ndarray, dq: np.ndarray, joints: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """p and beta (samples, n), in the order of `joints`."""
    data = model.createData()
    order = [model.joints[model.getJointId(name)].idx_v for name in joints]
    p, beta = np.empty((len(q), model.nv)), np.empty((len(q), model.nv))
    for k, configuration in enumerate(configurations(model, q, joints)):
        speed = np.zeros(model.nv)
        speed[order] = dq[k]
        upper = np.triu(pin.crba(model, data, configuration))
        mass_matrix = upper + np.triu(upper, 1).T
        coriolis = pin.computeCoriolisMatrix(model, data, configuration, speed)
        p[k] = mass_matrix @ speed
        beta[k] = pin.computeGeneralizedGravity(model, data, configuration) - coriolis.T @ speed
    return p[:, order], beta[:, order]


def frame_jacobian(model, q: np.ndarray, joints: list[str], frame: str, axes) -> np.ndarray:
    """(6, n), its columns in the order of `joints`."""
    data = model.createData()
    pin.computeJointJacobians(model, data, configurations(model, q[None], joints)[0])
    pin.updateFramePlacements(model, data)
    order = [model.joints[model.getJointId(name)].idx_v for name in joints]
    return pin.getFrameJacobian(model, data, model.getFrameId(frame, pin.FrameType.BODY), axes)[:, order]
