"""Torque ripple of motor and gear, searched for in what a fit leaves."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from tauext import _core
from tauext.data.recording import Recording
from tauext.fit.prior_fit import PriorFit
from tauext.fit.training_set import Setup

MOST_CYCLES = 400
RIPPLE_DATA_S = 300.0  # so much motion is enough to find a ripple, and it takes a while ...
RIPPLE_JOINTS_S = 600.0  # ... for each joint anew, so with many joints this over their number, but RIPPLE_ENOUGH_S
RIPPLE_ENOUGH_S = 120.0
RIPPLE_LEAST_S = 45.0  # in less, noise looks like one
AT_A_TIME = 2
"""Joints: all numbers of cycles of one take hundreds of MB."""
RIPPLE_SHARE, RIPPLE_OUTSTANDS = 0.03, 5.0
ALIAS_TIE = 1e-6
"""An encoder of N counts a turn shows k and N - k cycles as the same, but for rounding: the fewer are taken."""


def find_ripple(
    setup: Setup,
    recordings: Sequence[Recording],
    fit: PriorFit,
    known: Sequence[Sequence[int]],
    least_cycles: int = 1,
) -> list[list[int]]:
    """For each joint the cycles a turn at which a ripple of motor and gear stands out of what a fit leaves.

    Every whole number of cycles is tried: the share of the remainder's sum of squares that its sine and cosine,
    filtered as the observer filters, explain by themselves. One counts that explains RIPPLE_SHARE of it and
    RIPPLE_OUTSTANDS times as much as the median number.

    Args:
        known: cycles that the fit holds already.
        least_cycles: fewer a turn are no ripple.
    """
    n = setup.tree.size
    if sum(recording.duration_s for recording in recordings) < RIPPLE_LEAST_S:
        return [[] for _ in range(n)]
    energy = np.zeros(n)
    moments, squares = np.zeros((n, MOST_CYCLES, 2)), np.zeros((n, MOST_CYCLES, 2))
    looked_at_s, data_s = 0.0, min(RIPPLE_DATA_S, max(RIPPLE_JOINTS_S / n, RIPPLE_ENOUGH_S))
    for recording in recordings:
        if looked_at_s >= data_s:
            break
        looked_at_s += recording.duration_s
        signals = (recording.t_ns, recording.q, recording.dq, recording.tau)
        observation = _core.observe(setup.tree, setup.observer, *signals, fit.settings)
        rows = np.flatnonzero(observation.warm.astype(bool))[:: setup.observer.network_stride].astype(np.int64)
        left = (observation.residual - observation.prior)[rows]
        energy += (left**2).sum(axis=0)
        with ThreadPoolExecutor(min(setup.threads, AT_A_TIME)) as pool:
            each = pool.map(lambda joint, r=recording, k=rows, x=left: _of_joint(setup, r, k, x, joint), range(n))
            for joint, (moment, square) in enumerate(each):
                moments[joint] += moment
                squares[joint] += square
    explained = (moments**2 / np.maximum(squares, 1e-12)).sum(axis=2)
    explained[:, : least_cycles - 1] = 0
    found = []
    for joint in range(n):
        best = int(np.flatnonzero(explained[joint] >= (1 - ALIAS_TIE) * explained[joint].max())[0])
        stands_out = explained[joint, best] > RIPPLE_OUTSTANDS * np.median(explained[joint])
        matters = explained[joint, best] > RIPPLE_SHARE * energy[joint]
        found.append([best + 1] if stands_out and matters and best + 1 not in known[joint] else [])
    return found


def _of_joint(
    setup: Setup, recording: Recording, rows: np.ndarray, left: np.ndarray, joint: int
) -> tuple[np.ndarray, np.ndarray]:
    """Products of each number's sine and cosine with what is left of the joint, and their squares: (MOST_CYCLES, 2)."""
    settings = _core.PriorSettings()
    settings.terms = [
        _core.Term(_core.TermKind.ripple, joint, b=cycles, form=form)
        for cycles in range(1, MOST_CYCLES + 1)
        for form in (0, 1)
    ]
    settings.weights = [0.0] * (setup.tree.size * len(settings.terms))
    signals = (recording.t_ns, recording.q, recording.dq, recording.tau)
    values = _core.prior_regressors(setup.tree, setup.observer, settings, *signals, rows)
    return (values.T @ left[:, joint]).reshape(-1, 2), (values**2).sum(axis=0).reshape(-1, 2)
