"""Whether the standard error is right: errors in free motion against the sigma that was told with them."""

from __future__ import annotations

import numpy as np

from tauext.data.estimates import Estimates

EDGES_NM = np.geomspace(1e-3, 1e4, 7 * 6 + 1)
"""Bins of sigma, six a decade; what is beyond is in the outermost."""
REGIONS = ("sliding", "near_stiction")


class ErrorAgainstSigma:
    """Sums over the healthy samples of free motion in each bin of sigma, a joint and region each.

    A region is the one that the bundle's own limits and sigma go by.
    """

    def __init__(self, joints: int) -> None:
        self._shape = (len(REGIONS), joints, len(EDGES_NM) - 1)
        # Of each bin: samples, those within one and two sigma, sums of the squares of sigma and error.
        self._sums = np.zeros((5, *self._shape))
        self._known = False

    def add(self, estimates: Estimates) -> None:
        """Take in one recording of free motion; of a bundle without an error scale there is nothing to count."""
        if estimates.sigma_nm is None:
            return
        self._known = True
        regions, joints, bins = self._shape
        for j in range(joints):
            sigma, error = estimates.sigma_nm[:, j].astype(float), np.abs(estimates.tau_ext[:, j].astype(float))
            counted = estimates.healthy & np.isfinite(sigma) & (sigma > 0)
            sigma, error = sigma[counted], error[counted]
            place = np.clip(np.searchsorted(EDGES_NM, sigma, side="right") - 1, 0, bins - 1)
            place += bins * estimates.near_stiction[counted, j]
            for k, weights in enumerate((None, error <= sigma, error <= 2 * sigma, sigma**2, error**2)):
                self._sums[k, :, j] += np.bincount(place, weights, regions * bins).reshape(regions, bins)

    def summary(self) -> dict | None:
        """The entry `error_against_sigma` of a bundle in results.json; null without an error scale."""
        if not self._known:
            return None
        return {
            region: [self._entry(self._sums[:, k, j]) for j in range(self._shape[1])]
            for k, region in enumerate(REGIONS)
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
