"""Torque constants from a known weight."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext._core import KnownWeight, LoadFound
from tauext.errors import ConfigError
from tauext.files.provenance import VERSION
from tauext.monitor.weighing import NamedFrame, WeighedMotion, identify, load_sentences, weighing_joints


def weigh_constants(
    bundle: _core.Bundle,
    frame: NamedFrame,
    parts: Sequence[WeighedMotion],
    mass_kg: float,
    com_m: Sequence[float] | None = None,
    reach_m: float = LoadFound.USUAL_REACH_M,
    most_factor: float = 5.0,
    most_ratio: float = 1e6,
) -> KnownWeight:
    """Find the factors on the bundle's torques from a load of known mass.

    Args:
        most_factor: largest error factor of constants in N m: beyond it the error is a gear ratio or a unit.
        most_ratio: largest error factor in any unit: a smaller estimated mass is no weight.

    Raises:
        ConfigError: no load is detected, no torque constant is off by so much, or the motion does not determine the
            common factor to 3 %.
    """
    first = identify(bundle, frame, parts, reach_m)
    if first.verdict != "load" or not first.mass_seen:
        reason = load_sentences(first, frame.name, "N m")[0]
        raise ConfigError(f"--known-kg {mass_kg:g} cannot set torque constants: {reason}")
    if not first.mass_kg * most_ratio > mass_kg:
        raise ConfigError(
            f"--known-kg {mass_kg:g} cannot set torque constants: the estimated mass is {first.mass_kg:.2g} kg, "
            f"a factor of more than {most_ratio:g} less; are these the recordings with the payload?"
        )
    try:
        known = _core.weigh_known(
            bundle, frame.frame, [part.arrays for part in parts], mass_kg, first.phi.tolist(),
            (~weighing_joints(bundle)).tolist(), None if com_m is None else list(com_m), reach_m,
        )  # fmt: skip
    except _core.CoreError as error:
        raise ConfigError(f"--known-kg {mass_kg:g} cannot set torque constants: {error}") from None
    if bundle.units.relative_to < 0 and not 1 / most_factor < known.common < most_factor:
        raise ConfigError(
            f"{mass_kg:g} kg would make every torque {known.common:.3g} times as large; torque constants are not off "
            "by so much: is its mass in kg, and the tau in the bundle's unit?"
        )
    return known


def corrected_constants(bundle: _core.Bundle, known: KnownWeight) -> list[float]:
    """The torque constant of each joint times its factor; joints without a constant keep theirs."""
    constants = np.array(bundle.observer.nm_per_unit or [1.0] * bundle.joints)
    return np.where(weighing_joints(bundle), constants * known.factors, constants).tolist()


def one_factor(known: KnownWeight) -> bool:
    """Whether one factor fits all joints: no factor found is off by more than two standard errors."""
    off = np.abs(known.factors - known.common) > 2 * known.errors
    return not off[known.shows].any()


def with_provenance(bundle: _core.Bundle, known: KnownWeight, mass_kg: float, recordings: list[str]) -> dict:
    """Store the source of the constants in the bundle and return it as facts."""
    facts = json.loads(bundle.provenance or "{}")
    joints = [link.joint_name for link in bundle.links]
    relative = zip(known.factors / known.common, known.errors / known.factors, strict=True)
    own = dict(zip(joints, ([float(one) for one in pair] for pair in relative), strict=True))
    facts["known_weight"] = {
        "joints": {name: pair for (name, pair), shows in zip(own.items(), known.shows, strict=True) if shows},
        "mass_kg": mass_kg,
        "factor": known.common,
        "standard_error": known.common_error,
        "recordings": recordings,
        "version": VERSION,
    }
    bundle.provenance = json.dumps(facts, sort_keys=True)
    return facts
