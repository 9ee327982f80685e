"""What inertial parameters of links show in the observer's r: regressors, in which r is linear."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext.data.recording import Recording
from tauext.robot.inertial import PARAMETERS, inertial_parameters, with_inertial_parameters


def inertial_regressors(
    tree: _core.Tree,
    observer: _core.ObserverSettings,
    recording: Recording,
    rows: np.ndarray,
    of: Sequence[int] | None = None,
    parameters: Sequence[int] = range(len(PARAMETERS)),
) -> np.ndarray:
    """What a unit more of a link's parameter in the *robot* adds to r at these rows: (rows, n, links * parameters).

    Args:
        tree: kinematics and inertia about which r is differentiated; since r is linear, only its kinematics matter.
        of: links, None: all of them; the columns hold their parameters link by link.
        parameters: indices in PARAMETERS.
    """
    of = range(tree.size) if of is None else of
    # A first moment needs some mass; where it is added does not matter.
    starts = [inertial_parameters(link) for link in tree.links]
    for start in starts:
        start[0] = start[0] or 1.0
    started = [with_inertial_parameters(link, start) for link, start in zip(tree.links, starts, strict=True)]
    base = observed(started, tree.gravity, observer, recording, rows)
    units = np.eye(len(PARAMETERS))
    values = np.empty((len(rows), tree.size, len(of) * len(parameters)))
    for k, link in enumerate(of):
        for m, parameter in enumerate(parameters):
            changed = list(started)
            changed[link] = with_inertial_parameters(tree.links[link], starts[link] + units[parameter])
            values[:, :, len(parameters) * k + m] = base - observed(changed, tree.gravity, observer, recording, rows)
    return values


def observed(
    links: Sequence[_core.Link],
    gravity: Sequence[float],
    observer: _core.ObserverSettings,
    recording: Recording,
    rows: np.ndarray,
) -> np.ndarray:
    """r of these links beside a motor torque of zero: what the model says alone, (rows, n), [N m]."""
    still = np.zeros_like(recording.tau)
    tree = _core.Tree(list(links), gravity)
    return _core.observe(tree, observer, recording.t_ns, recording.q, recording.dq, still).residual[rows]
