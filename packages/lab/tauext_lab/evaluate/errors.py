"""Errors against the torque of an ideal sensor, and against the standard errors that are reported."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.bundle.estimates import Estimates
from tauext.data.recording import Recording
from tauext_lab.evaluate.collisions import Collision
from tauext_lab.evaluate.results import Number, SigmaBin, SigmaRegion

# --- Reference for the estimates: the torque that an ideal sensor would show after the observer's own low-pass.


FORGOTTEN = 1e-18
"""Share of an earlier torque below which it vanishes in the rounding of doubles."""


def sensor_reference(recording: Recording, gain_per_s: float) -> np.ndarray | None:
    """The true tau_ext low-passed at the observer's gain, (samples, joints), [N m]; the sensor's where that is unknown.

    A sensor's own low-pass is that of its recording, whatever the gain. None where a recording has neither.
    """
    if recording.tau_ext is None:
        return recording.tau_ext_sensor
    return low_pass(recording.t_ns, recording.tau_ext, gain_per_s)


def low_pass(t_ns: np.ndarray, torque: np.ndarray, gain_per_s: float) -> np.ndarray:
    r"""First-order low-pass of a torque that is held from a sample to the next, (samples, joints); 0 at the first.

    .. math:: y_k = a_k y_{k-1} + (1 - a_k)\,\tau_{k-1}, \quad a_k = e^{-K_0 (t_k - t_{k-1})}

    exact for steps of any length. Steps are joined in pairs of pairs, O(samples log) without a loop over samples, until
    nothing older counts.

    Args:
        t_ns: increasing, (samples,), [ns].
        torque: (samples, joints), [N m].
        gain_per_s: K0, [1/s], > 0.
    """
    share = np.exp(-gain_per_s * 1e-9 * np.diff(t_ns))[:, None]  # of y that a step keeps
    y = (1 - share) * torque[:-1]
    span = 1
    while span < len(y) and share[span:].max() > FORGOTTEN:
        y[span:] += share[span:] * y[:-span]
        share[span:] = share[span:] * share[:-span]
        span *= 2
    return np.vstack([np.zeros((1, torque.shape[1])), y])


# --- Whether the standard errors are right: errors in free motion against sigma, and during contacts against theirs.


EDGES_NM = np.geomspace(1e-3, 1e4, 7 * 6 + 1)
"""Bins of sigma, six a decade; values beyond them count in the outermost."""
REGIONS = ("sliding", "near_stiction")
CONTACT = ("contact", "second_after")
"""Times other than free motion, evaluated by the standard error of a contact."""
AFTER_S = 1.0


class ErrorAgainstSigma:
    """Sums over the healthy samples of free motion in each bin of sigma, a joint and region each.

    Regions are those of the bundle's own limits and sigma.
    """

    def __init__(self, joints: int) -> None:
        self._shape = (len(REGIONS), joints, len(EDGES_NM) - 1)
        # Of each bin: samples, those within one and two sigma, sums of the squares of sigma and error.
        self._sums = np.zeros((5, *self._shape))
        self._contact_sums = np.zeros((5, len(CONTACT), *self._shape[1:]))
        self._known = self._touched = False

    def add(self, estimates: Estimates) -> None:
        """Add one recording of free motion; without an error scale nothing is counted."""
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
        """Add the contacts of a recording and the second after each.

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
        """Add to the sums of a joint, (5, places, bins)."""
        _, places, bins = sums.shape
        sigma = sigma.astype(float)
        counted = counted & np.isfinite(sigma) & (sigma > 0) & np.isfinite(error)
        sigma, error = sigma[counted], error[counted]
        at = np.clip(np.searchsorted(EDGES_NM, sigma, side="right") - 1, 0, bins - 1) + bins * place[counted]
        for k, weights in enumerate((None, error <= sigma, error <= 2 * sigma, sigma**2, error**2)):
            sums[k] += np.bincount(at, weights, places * bins).reshape(places, bins)

    def summary(self) -> dict[str, tuple[SigmaRegion, ...]] | None:
        """Results by region and joint; None without an error scale."""
        if not self._known:
            return None
        parts = [(REGIONS, self._sums)] + ([(CONTACT, self._contact_sums)] if self._touched else [])
        return {
            name: tuple(sigma_region(sums[:, k, j]) for j in range(self._shape[1]))
            for names, sums in parts
            for k, name in enumerate(names)
        }


def sigma_region(sums: np.ndarray) -> SigmaRegion:
    """Results of one joint's sums, (5, bins)."""
    rms = np.sqrt(sums[3:] / np.maximum(sums[0], 1)).tolist()
    edges = EDGES_NM.tolist()
    bins = (
        SigmaBin(edges[k], edges[k + 1], *shares(sums[:, k]), rms[0][k], rms[1][k])
        for k in np.flatnonzero(sums[0]).tolist()
    )
    return SigmaRegion(*shares(sums.sum(axis=1)), tuple(bins))


def shares(sums: np.ndarray) -> tuple[int, Number, Number]:
    """Samples, and the shares of them within one and two sigma; None without any."""
    samples, one, two = sums[:3].tolist()
    return (int(samples), one / samples, two / samples) if samples else (0, None, None)
