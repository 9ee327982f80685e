r"""How the joints' errors go together on free motion, and how large the ellipsoids of forces must be to hold them.

With z = tau_ext / sigma of rows of free motion that nothing was trained on, clipped at CLIP, the correlation is

.. math:: R = (1 - a)\,\hat R + a\,1, \qquad a = \max\left(A, \frac{n}{n + T}\right),

T being the seconds of motion: errors a second apart are about independent, and so many of them separate n joints. The
radius is what variances are multiplied by so that 95 % of the errors of force and moment, which are 0 in free motion,
lie within the ellipsoid of 95 %; heavy tails are in it, where a mean would miss them.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from scipy.special import gammaincinv

from tauext import _core
from tauext.config import FreeMotionConfig
from tauext.data.recording import Recording
from tauext.train.error_scale import Judged, judge

CLIP = 3.0
"""Bound of z, so that a single large error does not determine the correlation."""
LEAST_SHRINK = 0.05
"""A: a correlation of 0.95 at most, since what an hour showed is not for good."""
HELD = 0.95
"""Share of errors within the ellipsoids."""
LEAST_RADIUS = 0.5
"""sigma is rather too large than too small, by some tenth to a quarter of the variance; less than half of it, and the
motion was too slow to show it. What free motion does not show of a touch is in the covariance apart."""
MOST_ROWS = 100_000
"""An hour and a half at 20 Hz: beyond, quantiles do not change."""
ROW_S = 0.05
"""Between rows: errors change within the observer's 1/K0."""
LEAST_ROWS = 200
"""Fewer determine no quantile of 95 %: the radius stays 1."""
POSES = 64
"""That a bundle keeps: a share of them is then known to some 6 %, and a joint to be seen in its whole range."""
POSE_DIGITS = 3
"""A thousandth of a rad moves the end of an arm by a millimetre."""


def fit_wrench(
    bundle: _core.Bundle,
    judged: Iterable[Recording | Judged],
    threads: int,
    margins: FreeMotionConfig = FreeMotionConfig(),  # noqa: B008
) -> dict:
    """Put correlation and radius into a bundle whose error scale stands; the facts for its provenance.

    Nothing happens where the bundle has no wrench.
    """
    if refused := _core.WrenchModel(bundle).refused:
        return {"refused": refused}
    q, tau_ext, sigma = free_rows(bundle, judged, threads, margins)
    if len(q) < LEAST_ROWS:
        return {"rows": len(q), "poses": poses(q)}
    settings = bundle.wrench_settings
    settings.correlation = correlation(tau_ext / sigma, len(q) * ROW_S).ravel().tolist()
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
    """Some of these rows, even in time, so that shares of them are shares of the motion; POSES at most."""
    if len(q) == 0:
        return []
    at = np.unique(np.linspace(0, len(q) - 1, min(POSES, len(q))).round().astype(int))
    found: list[list[float]] = np.round(q[at], POSE_DIGITS).tolist()
    return found


def outermost(bundle: _core.Bundle) -> str:
    """The frame that the radius is found at: the load's, or the last link's."""
    load = bundle.load_settings
    return load.frame if load.link >= 0 else bundle.links[-1].joint_name


def correlation(z: np.ndarray, seconds: float) -> np.ndarray:
    """R of the module's equation, (joints, joints); a joint without errors is independent of all."""
    joints = z.shape[1]
    z = np.clip(z, -CLIP, CLIP)
    size = np.sqrt(np.mean(z**2, axis=0))
    z = z / np.where(size > 0, size, 1.0)
    shrink = max(LEAST_SHRINK, joints / (joints + seconds))
    together = (1 - shrink) * (z.T @ z) / len(z)
    together = np.clip((together + together.T) / 2, -1, 1)
    np.fill_diagonal(together, 1.0)
    return together


def radius(
    bundle: _core.Bundle, frame: str, q: np.ndarray, tau_ext: np.ndarray, sigma: np.ndarray, point: list | None
) -> float:
    """Factor on variances that makes the ellipsoids of 95 % hold 95 % of these rows, in which the truth is 0."""
    wrenches = _core.WrenchModel(bundle).wrenches(frame, q, tau_ext, sigma, point)
    seen = (wrenches["freedom"] >= 0) & (wrenches["blind"] == 0)
    if seen.sum() < LEAST_ROWS:  # it never sees all: those that it sees most of
        seen = wrenches["blind"] == wrenches["blind"].min()
    size = len(wrenches["covariance"][0])
    shown = size - int(wrenches["blind"][seen].min())
    if shown == 0:  # no joint torque depends on a force there: one joint whose axis passes through the point
        return 1.0
    unknown = np.concatenate([wrenches["force"], wrenches["moment"]], axis=1)[:, :size]
    return factor(squared_distances(unknown, wrenches["covariance"])[seen], shown)


def squared_distances(errors: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Errors in standard deviations, squared: (rows, m) by (rows, m, m) give (rows,).

    A direction may be known so much better than another that rounding hides its variance; it then counts with the
    least variance that shows beside the other's.
    """
    size = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    variances, directions = np.linalg.eigh(covariance / (size[:, :, None] * size[:, None, :]))
    least = np.finfo(float).eps * variances[:, -1:]
    along = np.einsum("rim,ri->rm", directions, errors / size)
    return np.sum(along**2 / np.maximum(variances, least), axis=1)


def residual(
    bundle: _core.Bundle, frame: str, q: np.ndarray, tau_ext: np.ndarray, sigma: np.ndarray, point: list | None
) -> float:
    """The same factor for the residual that a wrench does not explain; 1: no residual."""
    wrenches = _core.WrenchModel(bundle).wrenches(frame, q, tau_ext, sigma, point)
    freedom = wrenches["freedom"]
    if freedom.max() < 1:
        return 1.0
    usual = int(np.bincount(freedom).argmax())
    at = freedom == max(usual, 1)
    return factor(wrenches["chi_square"][at], max(usual, 1)) if at.sum() >= LEAST_ROWS else 1.0


def factor(squared: np.ndarray, freedom: int) -> float:
    """That a chi-square's quantile of 95 % is multiplied by to be that of these."""
    chi_square = 2 * gammaincinv(freedom / 2, HELD)  # as scipy.stats, which takes a third of a second to load
    return max(float(np.quantile(squared, HELD) / chi_square), LEAST_RADIUS)


def free_rows(
    bundle: _core.Bundle, judged: Iterable[Recording | Judged], threads: int, margins: FreeMotionConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """q, tau_ext and sigma of free motion, 3 x (rows, joints)."""
    stride = max(1, round(ROW_S / (1e-9 * bundle.observer.sample_period_ns)))
    found = []
    for one in judged:
        one = one if isinstance(one, Judged) else Judged(one)
        estimates, _, counted = judge(bundle, one, threads, margins)
        counted &= np.isfinite(estimates["sigma_nm"]).all(axis=1) & (estimates["sigma_nm"] > 0).all(axis=1)
        at = np.flatnonzero(counted)[::stride]
        found.append((one.recording.q[at], estimates["tau_ext"][at], estimates["sigma_nm"][at]))
    if not found:
        return (np.empty((0, bundle.joints)),) * 3
    rows = [np.concatenate(column) for column in zip(*found, strict=True)]
    thin = max(1, -(-len(rows[0]) // MOST_ROWS))
    q, tau_ext, sigma = (np.ascontiguousarray(column[::thin]) for column in rows)
    return q, tau_ext, sigma
