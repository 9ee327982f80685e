"""How far an arm that was found in the motion can be trusted to carry a load that training never saw."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext.config import PriorConfig
from tauext.data.recording import Recording
from tauext.fit.find_kinematics import Candidate, refined
from tauext.fit.kinematic_sample import LEAST_ROWS, PIECE_S, KinematicSample, all_pieces
from tauext.fit.kinematics import Kinematics
from tauext.fit.prior_terms import own_terms
from tauext.fit.training_set import Setup

PROBE_M = 0.1
"""The probe's centre of mass lies so far along the last axis: about where a flange is."""

OFF_M = 0.2
"""Half a link: enough to show, and the search still finds back."""
STANDS_OUT = 3.0
"""Times the error: a sign that is wrong would be twice the torque off."""


def load_disagreement(
    setup: Setup, recordings: Sequence[Recording], config: PriorConfig, kinematics: Kinematics
) -> float | None:
    """By what share a load's torques differ between the arms that each half of the motion makes of this one.

    Axes stay. Lengths are first put off by OFF_M, those of each half otherwise, and follow that half alone: one that
    the motion does not tell stays off, and shows. The largest over joints of the root mean square, over the largest of
    what the load weighs on a joint.

    Returns:
        The share; None where a half is too short to tell, or nothing weighs on the arm.
    """
    own = [own_terms(setup, config, joint) for joint in range(setup.tree.size)]
    joints = tuple(link.joint_name for link in setup.tree.links)
    parts = all_pieces(recordings, PIECE_S)
    arms = []
    for seed, half in enumerate((parts[: len(parts) // 2], parts[len(parts) // 2 :])):
        sample = KinematicSample(setup.tree, setup.observer, half, own, setup.widths_rad)
        if sample.rows < LEAST_ROWS:
            return None
        shifts = np.random.default_rng(seed).normal(size=(sample.joints, 2)) * OFF_M
        off = kinematics.moved(np.zeros((sample.joints, 2)), shifts)
        start = Candidate(off, np.inf, np.ones(sample.joints))
        arms.append(refined(sample, joints, start, frozenset()).kinematics)
    poses = np.concatenate([recording.q[:: max(1, recording.samples // 500)] for recording in recordings])
    first, second = (weight(arm, joints, setup.tree.gravity, np.ascontiguousarray(poses)) for arm in arms)
    apart = np.sqrt(np.mean((first - second) ** 2, axis=0)).max()
    whole = np.sqrt(np.mean((0.5 * (first + second)) ** 2, axis=0)).max()
    return float(apart / whole) if whole > 0 else None


def last_axis_shows(
    links: Sequence[_core.Link], gravity: Sequence[float], recordings: Sequence[Recording], error_nm: float
) -> bool:
    """Whether what the last link weighs on its own joint stands out of what the prior leaves there, error_nm.

    Else nothing tells where its axis points, and a load is put at its end on a guess.
    """
    poses = np.ascontiguousarray(np.concatenate([one.q[:: max(1, one.samples // 500)] for one in recordings]))
    torque = _core.Tree(list(links), list(gravity)).momentum(poses, np.zeros_like(poses))[1][:, -1]
    return bool(np.sqrt(np.mean(torque**2)) > STANDS_OUT * error_nm)


def weight(kinematics: Kinematics, joints: Sequence[str], gravity: Sequence[float], poses: np.ndarray) -> np.ndarray:
    """Torques of a kilogram at the end of a weightless arm, (poses, joints) [N m]."""
    links = kinematics.tree(joints, gravity).links
    links[-1].mass, links[-1].com = 1.0, [0.0, 0.0, PROBE_M]
    return _core.Tree(links, list(gravity)).momentum(poses, np.zeros_like(poses))[1]
