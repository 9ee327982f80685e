"""The Bayes rule that knows the arm's shape, how touches are drawn and how large this arm's errors are."""

from __future__ import annotations

import numpy as np
from unseen.surfaces import draw_touch

from tauext import _core
from touches.run import CONE_RAD, FORCES_N, Arm

DRAWS, SIZES = 6000, 60
"""Touches drawn a link, and sizes of each, that its integrals are sums over."""


def errors_of(looks: list[dict]) -> tuple[np.ndarray, np.ndarray]:
    """Of each joint: standard deviation of its error without a touch, and what a touch adds as a share of its torque.

    Found by likelihood on the very errors of the touches that are judged: nobody could know them better.
    """
    from scipy.optimize import minimize

    seen = [look for look in looks if look["seen"]]
    true = np.array([look["_true_nm"] for look in seen])
    error = np.array([look["_tau_ext"] for look in seen]) - true

    def cost(log: np.ndarray, joint: int) -> float:
        variance = np.exp(2 * log[0]) + np.exp(2 * log[1]) * true[:, joint] ** 2
        return float(np.sum(np.log(variance) + error[:, joint] ** 2 / variance))

    found = []
    for joint in range(true.shape[1]):
        start = [np.log(np.std(error[:, joint])), np.log(0.05)]
        found.append(np.exp(minimize(cost, start, args=(joint,), method="Nelder-Mead").x))
    floor, share = np.array(found).T
    return floor, share


class Bayes:
    def __init__(self, arm: Arm, errors: tuple[np.ndarray, np.ndarray], rng: np.random.Generator):
        self._names, self._model = arm.names, _core.WrenchModel(arm.bundle)
        self._floor, self._share = errors
        self._wrenches = []
        for link in range(len(arm.names)):
            drawn = [draw_touch(arm.surface, link, CONE_RAD, rng) for _ in range(DRAWS)]
            point, way = np.array([one[0] for one in drawn]), np.array([one[1] for one in drawn])
            self._wrenches.append(np.concatenate([way, np.cross(point, way)], axis=1))
        self._forces = np.exp(np.linspace(*np.log(FORCES_N), SIZES))

    def probability(self, look: dict) -> np.ndarray:
        """Of each link."""
        tau = look["_tau_ext"]
        variance = self._floor**2 + (self._share * tau) ** 2
        logs = np.empty(len(self._names))
        for link, name in enumerate(self._names):
            columns = self._model.columns(name, look["_q"].tolist(), axes=_core.WrenchAxes.frame)
            torque = self._wrenches[link] @ columns
            along, size = torque @ (tau / variance), (torque**2) @ (1 / variance)
            log = self._forces * along[:, None] - 0.5 * self._forces**2 * size[:, None]
            logs[link] = log.max() + np.log(np.exp(log - log.max()).mean())
        told = np.exp(logs - logs.max())
        return told / told.sum()
