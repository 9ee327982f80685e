"""What was done to a bundle after its training: friction brought up to date, torque constants from a known weight."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def changed_since_training(facts: Mapping[str, Any]) -> dict[str, str]:
    """By what was done, in words; empty for a bundle as training left it.

    Args:
        facts: the bundle's provenance.
    """
    told: dict[str, str] = {}
    if refitted := facts.get("refitted"):
        told |= refitted_words(refitted)
    if known := facts.get("known_weight"):
        off = known["factor"] - 1
        told["torques corrected"] = (
            f"times {known['factor']:.3f} ± {known['standard_error']:.3f} ({off:+.1%}), from a known weight of "
            f"{known['mass_kg']:g} kg in {', '.join(known['recordings'])}"
        )
    return told


def refitted_words(refitted: Mapping[str, Any]) -> dict[str, str]:
    """What a refit found of every joint, and what it says of the promise."""
    told = {"friction brought up to date": f"on {refitted['used_s']:.0f} s of the arm's motion"}
    for joint in refitted["joints"]:
        (coulomb, coulomb_error), (viscous, viscous_error) = joint["coulomb"], joint["viscous"]
        words = f"friction times {coulomb:.3f} ± {coulomb_error:.3f}, viscous {viscous:.3f} ± {viscous_error:.3f}"
        if joint["limit_factor"] > 1:
            words += f", limits times {joint['limit_factor']:.2f}"
        told[f"since training, {joint['joint']}"] = words
    told["the old promise"] = refitted["promise"]
    return told
