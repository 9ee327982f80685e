"""A bundle whose torque constants are multiplied by one factor."""

from __future__ import annotations

import json
from collections.abc import Sequence

from tauext import _core
from tauext.files.provenance import VERSION
from tauext.monitor.known import KnownWeight

RATIOS = (_core.TermKind.load, _core.TermKind.load_presliding)
"""Terms whose weight is a share of a torque, and so no torque."""


def scaled_bundle(bundle: _core.Bundle, factor: float) -> _core.Bundle:
    """The same chain in other N m: every torque that it takes, answers or compares with is `factor` times as large.

    Masses and inertias of the model grow along, since the arm's own weight was told by the same torques: all of it
    follows, to the last digit that rounding leaves, and limits keep what they promise. One factor a joint could not be
    put in: no arm has such masses.
    """
    new = _core.Bundle.from_bytes(bundle.to_bytes())
    new.observer = observer_with(bundle.observer, times(factor, bundle.observer.nm_per_unit or [1.0] * bundle.joints))
    new.units = _core.TorqueUnits(bundle.units.given, -1, bundle.units.unknown)  # a weight in kg says what a N m is
    new.links = [scaled_link(link, factor) for link in bundle.links]
    prior, terms = new.prior, len(new.prior.terms)
    prior.most_load_nm = times(factor, prior.most_load_nm)
    prior.corrected_links = [scaled_link(link, factor) for link in prior.corrected_links]
    share = [term.kind in RATIOS for term in prior.terms]
    prior.weights = [weight if share[k % terms] else factor * weight for k, weight in enumerate(prior.weights)]
    for part, names in ((new, TORQUES), (new.drift, DRIFT), (new.error_scale, SIGMA)):
        for name in names:
            setattr(part, name, times(factor, getattr(part, name)))
    new.answer_reference()
    return new


TORQUES = (
    "sliding_limit_nm",
    "near_stiction_limit_nm",
    "contact_sliding_limit_nm",
    "contact_near_stiction_limit_nm",
    "output_scale_nm",
    "torque_limit_nm",
    "largest_torque_nm",
    "possible_torque_nm",
)
"""Of a bundle, one a joint, in N m."""
DRIFT = ("size_nm", "freeze_floor_nm")
SIGMA = ("sigma_weights", "sigma_near_weights", "largest_sigma")


def times(factor: float, values: Sequence[float]) -> list[float]:
    return [factor * value for value in values]


def observer_with(observer: _core.ObserverSettings, nm_per_unit: list[float]) -> _core.ObserverSettings:
    """The same settings with these constants."""
    kept = ("gain_per_s", "timing", "sample_period_ns", "network_stride", "method", "high_pass_per_s", "low_pass_per_s")
    return _core.ObserverSettings(**{name: getattr(observer, name) for name in kept}, nm_per_unit=nm_per_unit)


def scaled_link(link: _core.Link, factor: float) -> _core.Link:
    """The link with masses and inertias times the factor."""
    scaled = _core.Link()
    for name in ("joint_name", "parent", "type", "rotation", "translation", "com"):
        setattr(scaled, name, getattr(link, name))
    scaled.mass, scaled.rotor_inertia = factor * link.mass, factor * link.rotor_inertia
    scaled.inertia = [factor * value for value in link.inertia]
    return scaled


def with_provenance(bundle: _core.Bundle, known: KnownWeight, mass_kg: float, recordings: list[str]) -> dict:
    """Note in the bundle where its constants are from; the facts."""
    facts = json.loads(bundle.provenance or "{}")
    facts["known_weight"] = {
        "mass_kg": mass_kg,
        "factor": known.common,
        "standard_error": known.common_error,
        "recordings": recordings,
        "version": VERSION,
    }
    bundle.provenance = json.dumps(facts, sort_keys=True)
    return facts
