"""Whether the standard errors are right: errors in free motion against sigma, and during contacts against theirs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.bundle.estimates import Estimates
from tauext.data.recording import Recording
from tauext.evaluate.collisions import Collision

EDGES_NM = np.geomspace(1e-3, 1e4, 7 * 6 + 1)
"""Bins of sigma, six a decade; what is beyond is in the outermost."""
REGIONS = ("sliding", "near_stiction")
CONTACT = ("contact", "second_after")
"""What is judged beside free motion, by the standard error of a contact."""
AFTER_S = 1.0


class ErrorAgainstSigma:
    """Sums over the healthy samples of free motion in each bin of sigma, a joint and region each.

    A region is the one that the bundle's own limits and sigma go by.
    """

    def __init__(self, joints: int) -> None:
        self._shape = (len(REGIONS), joints, len(EDGES_NM) - 1)
        # Of each bin: samples, those within one and two sigma, sums of the squares of sigma and error.
        self._sums = np.zeros((5, *self._shape))
        self._contact_sums = np.zeros((5, len(CONTACT), *self._shape[1:]))
        self._known = self._touched = False

    def add(self, estimates: Estimates) -> None:
        """Take in one recording of free motion; of a bundle without an error scale there is nothing to count."""
        if estimates.sigma_nm is None:
            return
        self._known = True
        for j in range(self._shape[1]):
            place = estimates.near_stiction[:, j].astype(int)
            error = np.abs(estimates.tau_ext[:, j].astype(float))
            self._count(self._sums[:, :, j], error, estimates.sigma_nm[:, j], place, estimates.healthy)

    def add_touched(
        self, touches: Sequence[Collision], recording: Recording, estimates: Estimates, reference: np.ndarray | None
    ) -> None:
        """Take in what a recording with these contacts shows of them and of the second after each.

        Args:
            reference: the true external torque, or a sensor's, (samples, joints), [N m]; None: nothing to count.
        """
        if estimates.contact_sigma_nm is None or reference is None or not touches:
            return
        self._touched = True
        phase = np.full(recording.samples, -1)
        for touch in touches:
            last = np.searchsorted(recording.t_ns, recording.t_ns[touch.end - 1] + AFTER_S * 1e9)
            phase[touch.end : last] = 1
        for touch in touches:
            phase[touch.begin : touch.end] = 0
        counted = estimates.healthy & (phase >= 0)
        error = np.abs(estimates.tau_ext.astype(float) - reference)
        for j in range(self._shape[1]):
            self._count(self._contact_sums[:, :, j], error[:, j], estimates.contact_sigma_nm[:, j], phase, counted)

    @staticmethod
    def _count(sums: np.ndarray, error: np.ndarray, sigma: np.ndarray, place: np.ndarray, counted: np.ndarray) -> None:
        """Into the sums of a joint, (5, places, bins)."""
        _, places, bins = sums.shape
        sigma = sigma.astype(float)
        counted = counted & np.isfinite(sigma) & (sigma > 0) & np.isfinite(error)
        sigma, error = sigma[counted], error[counted]
        at = np.clip(np.searchsorted(EDGES_NM, sigma, side="right") - 1, 0, bins - 1) + bins * place[counted]
        for k, weights in enumerate((None, error <= sigma, error <= 2 * sigma, sigma**2, error**2)):
            sums[k] += np.bincount(at, weights, places * bins).reshape(places, bins)

    def summary(self) -> dict | None:
        """The entry `error_against_sigma` of a bundle in results.json; null without an error scale."""
        if not self._known:
            return None
        parts = [(REGIONS, self._sums)] + ([(CONTACT, self._contact_sums)] if self._touched else [])
        return {
            name: [self._entry(sums[:, k, j]) for j in range(self._shape[1])]
            for names, sums in parts
            for k, name in enumerate(names)
        }

    @staticmethod
    def _entry(sums: np.ndarray) -> dict:
        total = sums.sum(axis=1)
        bins = [
            {
                "sigma_nm_from": float(EDGES_NM[k]),
                "sigma_nm_to": float(EDGES_NM[k + 1]),
                **shares(sums[:, k]),
                "sigma_rms_nm": float(np.sqrt(sums[3, k] / sums[0, k])),
                "error_rms_nm": float(np.sqrt(sums[4, k] / sums[0, k])),
            }
            for k in np.flatnonzero(sums[0]).tolist()
        ]
        return {**shares(total), "bins": bins}


def shares(sums: np.ndarray) -> dict:
    """Samples, and the shares of them within one and two sigma; null without any."""
    samples, one, two = sums[:3].tolist()
    return {
        "samples": int(samples),
        "within_one_sigma": one / samples if samples else None,
        "within_two_sigma": two / samples if samples else None,
    }
