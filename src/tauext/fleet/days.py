r"""How friction of an arm differs from one recording to the next, over its joints: what a refit may expect of a joint
that hardly moved.

.. math:: \log f_{ar} \sim N(m_a, D)

f_ar: factors of friction of arm a's joints in recording r by the arm's own fit, and D their covariance between
recordings of one arm, pooled over the arms. Joints get warm together, so that one tells of the others. Recordings are
few: D is drawn towards its own diagonal, as if MORE_ARMS more arms had been seen whose joints vary independently.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext.data.recording import Recording
from tauext.fit.fleet_prior import FleetDays
from tauext.fit.hierarchy import MORE_ARMS
from tauext.fit.regression import NormalEquations

Kind = _core.TermKind
FRICTION = (Kind.coulomb, Kind.presliding, Kind.viscous, Kind.load, Kind.load_presliding)
LEAST_MOVED_S = 10.0
"""A joint that moved for less showed too little of its friction, as for a refit's promise."""
MOVES_RAD_S = 0.02
LEAST_ARMS = 3
"""With two recordings or more each."""


def recording_factors(
    equations: Sequence[NormalEquations],
    recordings: Sequence[Recording],
    weights: np.ndarray,
    terms: Sequence[Sequence[_core.Term]],
) -> np.ndarray:
    """Each recording's friction by that of the arm's own fit, (recordings, n); of those in which every joint moved.

    Args:
        equations: of pieces of recordings.
        recordings: that each piece is of.
        weights: the arm's own, (columns,).
    """
    found = []
    for recording in dict.fromkeys(recordings):
        pieces = [one for one, of in zip(equations, recordings, strict=True) if of is recording]
        if moved_s(recording).min() >= LEAST_MOVED_S:
            found.append(factors(sum(pieces[1:], start=pieces[0]), weights, terms))
    return np.array(found).reshape(-1, len(terms))


def moved_s(recording: Recording) -> np.ndarray:
    """For how long each joint moved, (n,)."""
    return (np.abs(recording.dq) > MOVES_RAD_S).sum(axis=0) / recording.rate_hz


def factors(equations: NormalEquations, weights: np.ndarray, terms: Sequence[Sequence[_core.Term]]) -> np.ndarray:
    """By which friction of each joint explains the equations best while all else stays, (n,)."""
    out, first = np.ones(len(terms)), 0
    for j, (at, gram, moment) in enumerate(zip(equations.columns, equations.gram, equations.moment, strict=True)):
        friction = np.zeros(len(weights))
        own = np.arange(first, first + len(terms[j]))
        friction[own] = [weights[c] if t.kind in FRICTION else 0.0 for c, t in zip(own, terms[j], strict=True)]
        first += len(terms[j])
        shown = friction[at] @ gram @ friction[at]
        if shown > 0:
            out[j] += friction[at] @ (moment - gram @ weights[at]) / shown
    return out


def fleet_days(factors_of: Sequence[np.ndarray]) -> FleetDays | None:
    """Covariance of the logarithms of factors between recordings of one arm; None: too few arms have several.

    Args:
        factors_of: of each arm, (recordings, n).
    """
    logs = [np.log(np.clip(one, 0.1, 10.0)) for one in factors_of if len(one) >= 2]
    if len(logs) < LEAST_ARMS:
        return None
    apart = [one - one.mean(axis=0) for one in logs]
    free = sum(len(one) - 1 for one in apart)
    covariance = np.sum([one.T @ one for one in apart], axis=0) / free
    share = len(logs) / (len(logs) + MORE_ARMS)
    covariance = share * covariance + (1 - share) * np.diag(np.diag(covariance))
    return FleetDays(covariance, len(logs), sum(map(len, logs)))
