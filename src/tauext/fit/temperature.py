r"""Temperature dependence of a joint's friction: two shares per joint, found in the residual of the prior.

With f_C and f_V the prior's friction of a joint (Coulomb's, viscous; filtered as r is) and
k = (T - T_ref) / 10 K, least squares on the motion of training whose temperature is known:

.. math:: r - \mathrm{prior} = (b_C + c_C k) f_C + (b_V + c_V k) f_V

b corrects the prior's own weights, since the motion was not at T_ref on the average of every term; c are the shares.
Both are kept where they lower the error on left-out parts of the motion, and are 0 elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.data.recording import Recording
from tauext.fit.prior_terms import PriorFit
from tauext.fit.training_set import Setup

COULOMB = frozenset({"coulomb", "presliding", "local_memory", "load", "load_presliding"})
FRICTION = COULOMB | {"viscous"}


@dataclass(frozen=True)
class TemperatureConfig:
    """Where friction follows the temperature; a joint that follows it wrongly has larger errors than a constant one."""

    least_spread_k: float = 1.0
    """Standard deviation of a joint's temperature over the motion, [K]: a smaller one is the sensor's."""
    beyond_k: float = 5.0
    """The shares hold this far beyond the temperatures of training, [K]; beyond that, friction is constant."""
    usual_share: float = 0.3
    """Friction changes by a third in 10 K at most; the shares are shrunk accordingly."""
    memory_s: float = 0.3
    """Errors this close together count as one, [s]."""
    helps: float = 0.01
    """A joint's shares are kept if they lower the error on left-out motion by this share."""
    parts: int = 10
    """Number of parts of the motion, in order of time; each is left out in turn."""
    least_parts: int = 4
    """Fewest parts in which the temperature is known."""


@dataclass(frozen=True)
class Warmth:
    """Motion of known temperature, at the network's rate."""

    left_nm: np.ndarray  # (rows, n): r - prior
    friction_nm: np.ndarray  # (rows, n, 2): Coulomb's, viscous
    temperature_c: np.ndarray  # (rows, n); NaN: unknown
    part: np.ndarray  # (rows,): which one
    period_s: float


def with_temperature(
    setup: Setup, recordings: Sequence[Recording], fit: PriorFit, config: TemperatureConfig = TemperatureConfig()
) -> PriorFit:
    """The fit with temperature-dependent friction on the joints whose motion shows the dependence.

    Every fit in `left_out` gets the same shares and corrections, which are found on all of the motion.
    """
    warmth = measure_warmth(setup, [one for one in recordings if one.temperature is not None], fit, config)
    if warmth is None:
        return fit
    n = setup.tree.size
    reference, reach, shares, factors = np.full(n, 20.0), np.zeros(n), np.zeros((n, 2)), np.ones((n, 2))
    for joint in range(n):
        temperature = warmth.temperature_c[:, joint]
        known = np.isfinite(temperature)
        if not known.any() or np.std(temperature[known]) < config.least_spread_k:
            continue
        reference[joint] = np.mean(temperature[known])
        found = fit_joint(warmth, joint, known, reference[joint], config)
        if found is None:
            continue
        factors[joint], shares[joint] = 1 + found[:2], found[2:] / (1 + found[:2])
        reach[joint] = np.max(np.abs(temperature[known] - reference[joint])) + config.beyond_k
    if not shares.any():
        return fit
    follows = _core.FrictionTemperature()
    follows.reference_c, follows.reach_k = reference.tolist(), reach.tolist()
    follows.coulomb_per_10k, follows.viscous_per_10k = shares[:, 0].tolist(), shares[:, 1].tolist()
    for settings in (fit.settings, *(one.settings for one in fit.left_out)):
        settings.weights = scaled_friction(settings, factors).ravel().tolist()
        settings.temperature = follows
    fit.weights[:] = np.array(fit.settings.weights).reshape(n, -1)
    return fit


def fit_joint(
    warmth: Warmth, joint: int, known: np.ndarray, reference_c: float, config: TemperatureConfig
) -> np.ndarray | None:
    """(b_C, b_V, c_C, c_V) of a joint; None if they do not help on left-out motion."""
    friction, left = warmth.friction_nm[known, joint], warmth.left_nm[known, joint]
    warm = 0.1 * (warmth.temperature_c[known, joint] - reference_c)
    X, part = np.hstack([friction, friction * warm[:, None]]), warmth.part[known]
    names = np.unique(part)
    if len(names) < config.least_parts:
        return None
    equations = [(X[part == k].T @ X[part == k], X[part == k].T @ left[part == k]) for k in names]
    gram, moment = (sum(one[i] for one in equations) for i in (0, 1))
    noise = np.mean((left - X @ np.linalg.lstsq(X, left, rcond=None)[0]) ** 2) * config.memory_s / warmth.period_s
    shrink = max(noise, 1e-12) / config.usual_share**2 * np.eye(4)
    squares = 0.0
    for k, (own_gram, own_moment) in zip(names, equations, strict=True):
        found = np.linalg.solve(gram - own_gram + shrink, moment - own_moment)
        squares += float(np.sum((left[part == k] - X[part == k] @ found) ** 2))
    if squares > (1 - config.helps) ** 2 * float(np.sum(left**2)):
        return None
    return np.linalg.solve(gram + shrink, moment)


def measure_warmth(
    setup: Setup, recordings: Sequence[Recording], fit: PriorFit, config: TemperatureConfig
) -> Warmth | None:
    """The motion of known temperature in the recordings; None if there is none."""
    if not recordings:
        return None
    with ThreadPoolExecutor(min(setup.threads, 4)) as pool:
        found = [rows for rows in pool.map(lambda one: _rows(setup, one, fit.settings), recordings) if len(rows[0])]
    if not found:
        return None
    left, friction, temperature = (np.concatenate(column) for column in zip(*found, strict=True))
    part = np.arange(len(left)) * config.parts // len(left)
    return Warmth(left, friction, temperature, part, setup.network_period_s)


def _rows(
    setup: Setup, recording: Recording, settings: _core.PriorSettings
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:

    whole, rows = setup.observe(recording, settings)
    kinds = frozenset[str](), COULOMB, FRICTION - COULOMB
    # Without any term the prior is that of the corrected links.
    model, *of_terms = (setup.observe(recording, of_kinds(settings, some))[0].prior[rows] for some in kinds)
    parts = [one - model for one in of_terms]
    assert recording.temperature is not None
    return (whole.residual - whole.prior)[rows], np.stack(parts, axis=-1), recording.temperature[rows]


def of_kinds(settings: _core.PriorSettings, kinds: frozenset[str]) -> _core.PriorSettings:
    """The prior with weights of terms of these kinds alone."""
    part = _core.PriorSettings()
    part.widths_rad, part.branches = settings.widths_rad, settings.branches
    part.terms, part.corrected_links = settings.terms, settings.corrected_links
    weights = np.array(settings.weights).reshape(-1, len(settings.terms))
    weights[:, [term.kind.name not in kinds for term in settings.terms]] = 0
    part.weights = weights.ravel().tolist()
    return part


def scaled_friction(settings: _core.PriorSettings, factors: np.ndarray) -> np.ndarray:
    """The prior's weights with those of each joint's own friction times these factors of its two parts, (n, terms)."""
    weights = np.array(settings.weights).reshape(-1, len(settings.terms))
    for m, term in enumerate(settings.terms):
        if term.kind.name in FRICTION:
            weights[term.a, m] *= factors[term.a, 0 if term.kind.name in COULOMB else 1]
    return weights
