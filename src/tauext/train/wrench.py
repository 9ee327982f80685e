r"""Correlation of the joints' errors in free motion, and size of the error ellipsoids of forces.

With z = tau_ext / sigma of rows of free motion not used in training, clipped at 3, the correlation is

.. math:: R = (1 - a)\,\hat R + a\,1, \qquad a = \max\left(A, \frac{n}{n + T}\right),

with T seconds of motion, since errors a second apart are about independent. The radius is the factor on variances that
puts 95 % of the errors within the 95 % ellipsoid. Errors are force and moment in free motion, where the truth is 0.
Unlike a mean, it covers heavy tails.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

from tauext import _core
from tauext.config import FreeMotionConfig
from tauext.data.recording import Recording
from tauext.train.error_scale import FOR_ERRORS, HeldOut, judge_all


@dataclass(frozen=True)
class ForceErrors:
    """How errors of forces are fitted to free motion."""

    clip: float = 3.0
    """Bound of z, so that a single large error does not determine the correlation."""
    least_shrink: float = 0.05
    """A: limits correlations to 0.95, since an hour's correlation is not permanent."""
    held: float = 0.95
    """Share of errors within the ellipsoids."""
    least_radius: float = 0.5
    """Least radius. sigma is too large by a tenth to a quarter of the variance; a radius below half means that the
    motion was too slow. Errors that occur only under contact have their own term in the covariance."""
    most_rows: int = 100_000
    """Most rows, an hour and a half at 20 Hz; quantiles do not change with more."""
    row_s: float = 0.05
    """Period between rows, [s]: errors change within the observer's 1/K0."""
    least_rows: int = 200
    """Fewest rows for a quantile of 95 %; with fewer the radius stays 1."""
    poses: int = 64
    """Number of poses stored in a bundle: shares of them are accurate to 6 %, and they cover each joint's range."""


def fit_wrench(
    bundle: _core.Bundle,
    held_out: Iterable[Recording | HeldOut],
    threads: int,
    margins: FreeMotionConfig = FreeMotionConfig(),  # noqa: B008
) -> dict:
    """Set correlation and radius of a bundle with an error scale; returns facts for provenance.

    A bundle without a wrench is unchanged.
    """
    if refused := _core.WrenchModel(bundle).refused:
        return {"refused": refused}
    q, tau_ext, sigma = free_rows(bundle, held_out, threads, margins)
    if len(q) < ForceErrors.least_rows:
        return {"rows": len(q), "poses": poses(q)}
    settings = bundle.wrench_settings
    settings.correlation = correlation(tau_ext / sigma, len(q) * ForceErrors.row_s).ravel().tolist()
    settings.radius = settings.residual_radius = [1.0, 1.0]
    bundle.wrench_settings = settings
    frame = outermost(bundle)
    settings.radius = [radius(bundle, frame, q, tau_ext, sigma, point) for point in (None, [0.0, 0.0, 0.0])]
    bundle.wrench_settings = settings
    settings.residual_radius = [residual(bundle, frame, q, tau_ext, sigma, point) for point in (None, [0.0, 0.0, 0.0])]
    bundle.wrench_settings = settings
    return {
        "frame": frame,
        "rows": len(q),
        "poses": poses(q),
        "radius": dict(zip(("wrench", "force"), settings.radius, strict=True)),
        "residual_radius": dict(zip(("wrench", "force"), settings.residual_radius, strict=True)),
    }


def poses(q: np.ndarray) -> list[list[float]]:
    """Select some rows evenly in time, to 0.001 rad: a millimetre at the end of an arm."""
    if len(q) == 0:
        return []
    at = np.unique(np.linspace(0, len(q) - 1, min(ForceErrors.poses, len(q))).round().astype(int))
    found: list[list[float]] = np.round(q[at], 3).tolist()
    return found


def outermost(bundle: _core.Bundle) -> str:
    """Frame at which the radius is determined: the load's, or the last link's."""
    load = bundle.load_settings
    return load.frame if load.link >= 0 else bundle.links[-1].joint_name


def correlation(z: np.ndarray, seconds: float) -> np.ndarray:
    """R of the module's equation, (joints, joints); a joint without errors is independent of all."""
    joints = z.shape[1]
    z = np.clip(z, -ForceErrors.clip, ForceErrors.clip)
    size = np.sqrt(np.mean(z**2, axis=0))
    z = z / np.where(size > 0, size, 1.0)
    shrink = max(ForceErrors.least_shrink, joints / (joints + seconds))
    together = (1 - shrink) * (z.T @ z) / len(z)
    together = np.clip((together + together.T) / 2, -1, 1)
    np.fill_diagonal(together, 1.0)
    return together


def radius(
    bundle: _core.Bundle, frame: str, q: np.ndarray, tau_ext: np.ndarray, sigma: np.ndarray, point: list | None
) -> float:
    """Factor on variances with which the 95 % ellipsoids contain 95 % of these rows, whose true values are 0."""
    wrenches = _core.WrenchModel(bundle).wrenches(frame, q, tau_ext, sigma, point)
    seen = (wrenches["freedom"] >= 0) & (wrenches["blind"] == 0)
    if seen.sum() < ForceErrors.least_rows:  # no row observes all directions: use the rows that observe most
        seen = wrenches["blind"] == wrenches["blind"].min()
    size = len(wrenches["covariance"][0])
    shown = size - int(wrenches["blind"][seen].min())
    if shown == 0:  # no torque depends on a force there: a single joint with its axis through the point
        return 1.0
    unknown = np.concatenate([wrenches["force"], wrenches["moment"]], axis=1)[:, :size]
    return factor(squared_distances(unknown, wrenches["covariance"])[seen], shown)


def squared_distances(errors: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Errors in standard deviations, squared: (rows, m) by (rows, m, m) give (rows,).

    If one direction's variance is lost by rounding beside another's, the least representable variance is used.
    """
    size = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    variances, directions = np.linalg.eigh(covariance / (size[:, :, None] * size[:, None, :]))
    least = np.finfo(float).eps * variances[:, -1:]
    along = np.einsum("rim,ri->rm", directions, errors / size)
    return np.sum(along**2 / np.maximum(variances, least), axis=1)


def residual(
    bundle: _core.Bundle, frame: str, q: np.ndarray, tau_ext: np.ndarray, sigma: np.ndarray, point: list | None
) -> float:
    """Factor as in radius() for the residual not explained by a wrench; 1: no residual."""
    wrenches = _core.WrenchModel(bundle).wrenches(frame, q, tau_ext, sigma, point)
    freedom = wrenches["freedom"]
    if freedom.max() < 1:
        return 1.0
    usual = int(np.bincount(freedom).argmax())
    at = freedom == max(usual, 1)
    return factor(wrenches["chi_square"][at], max(usual, 1)) if at.sum() >= ForceErrors.least_rows else 1.0


def factor(squared: np.ndarray, freedom: int) -> float:
    """Ratio of these values' 95 % quantile to a chi-square distribution's."""
    # The inverse of scipy.stats.chi2, which takes a third of a second to import.
    chi_square = 2 * gammaincinv(freedom / 2, ForceErrors.held)
    return max(float(np.quantile(squared, ForceErrors.held) / chi_square), ForceErrors.least_radius)


def free_rows(
    bundle: _core.Bundle, held_out: Iterable[Recording | HeldOut], threads: int, margins: FreeMotionConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return q, tau_ext and sigma of free motion, 3 x (rows, joints)."""
    stride = max(1, round(ForceErrors.row_s / (1e-9 * bundle.observer.sample_period_ns)))
    found = []
    for motion, estimates, _, counted in judge_all(bundle, held_out, threads, margins, (*FOR_ERRORS, "sigma_nm")):
        counted &= np.isfinite(estimates["sigma_nm"]).all(axis=1) & (estimates["sigma_nm"] > 0).all(axis=1)
        at = np.flatnonzero(counted)[::stride]
        found.append((motion.q[at], estimates["tau_ext"][at], estimates["sigma_nm"][at]))
    if not found:
        return (np.empty((0, bundle.joints)),) * 3
    rows = [np.concatenate(column) for column in zip(*found, strict=True)]
    thin = max(1, -(-len(rows[0]) // ForceErrors.most_rows))
    q, tau_ext, sigma = (np.ascontiguousarray(column[::thin]) for column in rows)
    return q, tau_ext, sigma
