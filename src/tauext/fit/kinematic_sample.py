"""A thin sample of free motion on which candidate arms are compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tauext import _core
from tauext.data.cut import between
from tauext.data.recording import FLAGS, OPTIONAL_SIGNALS, Recording
from tauext.fit.inertial_regressors import inertial_regressors
from tauext.fit.regression import FOLDS, NormalEquations, Regression

SAMPLE_S = 120.0
PIECE_S = 10.0
ROW_S = 0.04  # r changes little within it: 1/K0 is 0.05 s
RIDGE = 1e-4
LEAST_ROWS = 250  # 10 s of motion: an arm has some seventy unknowns


class KinematicSample:
    """Up to two minutes of motion at the network's rate, and what every candidate is measured by.

    Args:
        tree: the estimated model: empty, with the gravity of its base.
        observer: of the setup; its method must be the momentum observer's.
        recordings: free motion.
        own: terms of each joint alone; they stand beside every candidate's inertia.
        widths_rad: of their presliding states.
    """

    def __init__(
        self,
        tree: _core.Tree,
        observer: _core.ObserverSettings,
        recordings: Sequence[Recording],
        own: Sequence[Sequence[_core.Term]],
        widths_rad: Sequence[float],
    ) -> None:
        self.joints, self.gravity = tree.size, tuple(tree.gravity)
        self.observer = _core.ObserverSettings(
            gain_per_s=observer.gain_per_s,
            timing=_core.TorqueTiming.averaged if observer.network_stride > 1 else observer.timing,
            sample_period_ns=observer.sample_period_ns * observer.network_stride,
            network_stride=1,
            nm_per_unit=observer.nm_per_unit,
        )
        self.pieces: list[tuple[Recording, np.ndarray]] = []
        targets, values = [], []
        settings = _core.PriorSettings()
        settings.widths_rad = list(widths_rad)
        settings.terms = [term for group in own for term in group]
        settings.weights = [0.0] * (self.joints * len(settings.terms))
        step = max(1, round(ROW_S / (self.observer.sample_period_ns * 1e-9)))
        for piece in pieces(recordings, SAMPLE_S, PIECE_S):
            thin = thinned(piece, observer.network_stride)
            signals = (thin.t_ns, thin.q, thin.dq, thin.tau)
            observation = _core.observe(tree, self.observer, *signals)
            rows = np.flatnonzero(observation.warm.astype(bool))[::step].astype(np.int64)
            if len(rows) < FOLDS:
                continue
            self.pieces.append((thin, rows))
            targets.append(observation.residual[rows])
            values.append(_core.prior_regressors(tree, self.observer, settings, *signals, rows))
        if not targets:
            self.rows = 0
            return
        self.target, value = np.concatenate(targets), np.concatenate(values)
        self.rows = len(self.target)
        ends = np.cumsum([len(group) for group in own])
        self.own = [value[:, end - len(group) : end] for group, end in zip(own, ends, strict=True)]
        self._folds = np.array_split(np.arange(self.rows), FOLDS)

    def regressors(self, tree: _core.Tree, of: Sequence[int], parameters: Sequence[int]) -> np.ndarray:
        """See inertial_regressors, over the whole sample."""
        each = [inertial_regressors(tree, self.observer, *piece, of, parameters) for piece in self.pieces]
        return np.concatenate(each)

    def regression(self, shared: np.ndarray, scales: np.ndarray | None = None) -> Regression:
        """Of r on every joint's own terms and on these columns, common to all joints: (rows, n, columns).

        Args:
            scales: (n,) of each joint's r against what the columns say; None: 1.
        """
        scales = np.ones(self.joints) if scales is None else scales
        widths = [values.shape[1] for values in self.own]
        ends, common = np.cumsum(widths), np.arange(shared.shape[2])
        columns = tuple(np.r_[end - width : end, ends[-1] + common] for width, end in zip(widths, ends, strict=True))
        equations = []
        for fold in self._folds:
            gram, moment = [], []
            for joint, (values, scale) in enumerate(zip(self.own, scales, strict=True)):
                X = np.hstack([values[fold], scale * shared[fold, joint]])
                gram.append(X.T @ X)
                moment.append(X.T @ self.target[fold, joint])
            energy = (self.target[fold] ** 2).sum(axis=0)
            equations.append(NormalEquations(columns, gram, moment, energy, len(fold)))
        return Regression(equations)


def pieces(recordings: Sequence[Recording], most_s: float, piece_s: float) -> list[Recording]:
    """All recordings, or as many pieces of this length, spread evenly over them, as make up most_s."""
    whole_s = sum(recording.duration_s for recording in recordings)
    if whole_s <= most_s:
        return list(recordings)
    cut = all_pieces(recordings, piece_s)
    wanted = max(1, int(most_s // piece_s))
    return [cut[k] for k in np.unique(np.linspace(0, len(cut) - 1, wanted).astype(int))]


def all_pieces(recordings: Sequence[Recording], piece_s: float) -> list[Recording]:
    """All of them cut into pieces of at least this length."""
    cut = []
    for recording in recordings:
        count = max(1, int(recording.duration_s // piece_s))
        edges = np.linspace(0, recording.samples, count + 1).astype(int)
        cut += [
            between(recording, a, b, recording.name) for a, b in zip(edges[:-1], edges[1:], strict=True) if b - a > 1
        ]
    return cut


def thinned(recording: Recording, stride: int) -> Recording:
    """Every stride-th sample, with the mean torque of the samples since the one before."""
    if stride == 1:
        return recording
    whole = recording.samples // stride * stride
    tau = recording.tau[:whole].reshape(-1, stride, recording.tau.shape[1]).mean(axis=1)
    kept = {name: getattr(recording, name)[stride - 1 : whole : stride] for name in ("t_ns", "q", "dq")}
    without: dict[str, Any] = dict.fromkeys((*OPTIONAL_SIGNALS, *FLAGS))
    rate_hz = recording.rate_hz / stride
    return replace(recording, tau=tau, rate_hz=rate_hz, torque_timing="averaged", **kept, **without)
