"""What a bundle says of its arm, joint by joint: friction, ripple, limits, constants, promise."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.files.place import Place

SPEED_RAD_S = 0.5
"""Friction is told at this speed: most joints slide at it, and few slow moves are faster."""
MEMORY_S = 2.0
"""Errors of a fit so far apart are independent: the longest that a refit counts."""
MOVING = 0.5
"""Share of its recordings in which a joint moves, where nobody counted."""
Kind = _core.TermKind


@dataclass(frozen=True)
class BundleFacts:
    """Of one bundle; arrays over the joints."""

    joints: tuple[str, ...]
    units: tuple[str, ...]
    """Of torques."""
    recipe: str
    minutes: float | None
    error_nm: np.ndarray
    """Left by the prior in training; NaN: nobody knows."""
    ripple_nm: np.ndarray
    """Amplitudes of all ripples of the joint together, as squares add; NaN without a prior."""
    limit_nm: np.ndarray
    stiction_limit_nm: np.ndarray
    false_per_hour: float | None
    """What its limits promise at most."""
    promise: str
    constants: np.ndarray
    """Found, in N m a unit of the recordings' torque, or by the import's; NaN where motion did not tell."""
    constants_error: np.ndarray
    bundle: _core.Bundle

    @property
    def nm_per_unit(self) -> np.ndarray:
        """What recorded torque is multiplied by."""
        used = self.bundle.observer.nm_per_unit
        return np.array(used) if len(used) else np.ones(len(self.joints))

    @property
    def has_prior(self) -> bool:
        """Friction that can be told."""
        return any(term.kind in (Kind.coulomb, Kind.presliding) for term in self.bundle.prior.terms)

    def friction_error(self, friction_nm: np.ndarray) -> np.ndarray:
        """Standard error of the friction as a share of it: what a fit leaves, over the independent moments it saw."""
        seconds = 60 * (self.minutes or 1.0) * MOVING
        return self.error_nm / np.maximum(friction_nm, 1e-9) / np.sqrt(max(seconds / MEMORY_S, 1.0))


def read_bundle(path: Place) -> BundleFacts:
    """Of a bundle's file.

    Raises:
        TauextError: it cannot be read.
    """
    bundle = load_bundle(path)
    facts = json.loads(bundle.provenance or "{}")
    joints = tuple(link.joint_name for link in bundle.links)
    prior = of(facts, "prior")
    found = of(of(facts, "torque_constants"), "found")
    told = [of(found, name) for name in joints]
    known = [bool(one.get("determined")) for one in told]
    promise = of(of(facts, "limits"), "promise")
    budget = of(promise, "asked") if promise.get("supported", True) else of(promise, "supported_budget")
    return BundleFacts(
        joints=joints,
        units=tuple(bundle.estimate_units),
        recipe=str(facts.get("recipe") or ""),
        minutes=facts.get("training_minutes"),
        error_nm=numbers(of(prior, "error_nm").get(name) for name in joints),
        ripple_nm=ripples_nm(bundle),
        limit_nm=np.array(bundle.sliding_limit_nm, dtype=float),
        stiction_limit_nm=np.array(bundle.near_stiction_limit_nm, dtype=float),
        false_per_hour=budget.get("rate_per_hour"),
        promise=str(of(facts, "limits").get("sentence") or promise.get("sentence") or ""),
        constants=numbers(
            one.get("nm_per_unit") if is_known else None for one, is_known in zip(told, known, strict=True)
        ),
        constants_error=numbers(one.get("standard_error") for one in told),
        bundle=bundle,
    )


def of(facts: Any, key: str) -> dict[str, Any]:
    """The table under the key; empty where there is none."""
    value = facts.get(key) if isinstance(facts, dict) else None
    return value if isinstance(value, dict) else {}


def numbers(values: Any) -> np.ndarray:
    """NaN for what is not there."""
    return np.array([np.nan if value is None else float(value) for value in values])


def friction_nm(facts: BundleFacts, weight_nm: np.ndarray) -> np.ndarray:
    """Friction of each joint at SPEED_RAD_S, (n,); NaN without a prior.

    Args:
        weight_nm: (n,) what weighs on the joint on the average: friction that grows with it belongs to it.
    """
    prior, n = facts.bundle.prior, len(facts.joints)
    if not facts.has_prior:
        return np.full(n, np.nan)
    at_speed = {
        Kind.coulomb: lambda term: float(np.tanh(SPEED_RAD_S / term.speed)),
        Kind.presliding: lambda term: 1.0,
        Kind.viscous: lambda term: SPEED_RAD_S,
        Kind.load: lambda term: weight_nm[term.a] * float(np.tanh(SPEED_RAD_S / term.speed)),
        Kind.load_presliding: lambda term: weight_nm[term.a],
    }
    weights = np.array(prior.weights).reshape(n, -1)
    out = np.zeros(n)
    for m, term in enumerate(prior.terms):
        if term.kind in at_speed:
            out[term.a] -= weights[term.a, m] * at_speed[term.kind](term)
    return out


def ripples_nm(bundle: _core.Bundle) -> np.ndarray:
    """Root of the sum of squares of each joint's ripple weights, (n,)."""
    n = bundle.joints
    if not bundle.prior.terms:
        return np.full(n, np.nan)
    weights = np.array(bundle.prior.weights).reshape(n, -1)
    squares = np.zeros(n)
    for m, term in enumerate(bundle.prior.terms):
        if term.kind == Kind.ripple:
            squares[term.a] += weights[term.a, m] ** 2
    return np.sqrt(squares)
