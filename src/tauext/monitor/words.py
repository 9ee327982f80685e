"""What was found of a load, in sentences; what the motion cannot tell too."""

from __future__ import annotations

import numpy as np

from tauext.monitor.identify import LoadEstimate

SHOWS = 3.0
"""Standard errors between a mass and 0: as the verdict has it."""
UNTOLD_KG = 100.0
"""A mass with a larger standard error is not told at all: before any motion it is 1000 kg."""
ALONG = 0.9
"""Cosine from which a direction is called by the axis of the frame that it is near."""


def load_sentences(found: LoadEstimate, where: str, unit: str) -> list[str]:
    """Mass, centre of mass, and what is not told.

    Args:
        where: what the frame is called.
        unit: of the bundle's answers; a mass is in kg only where that is N m.
    """
    kg = "kg" if unit == "N m" else f"kg times {unit} a N m"
    mass = f"{found.mass_kg:.2f} ± {found.mass_error_kg:.2f} {kg}"
    if found.mass_error_kg > UNTOLD_KG:
        return [
            f"no weight shows there: gravity never pulls a load at {where} against a joint that weighs it; is the load "
            "fixed to a link farther out (--frame)?"
        ]
    if found.verdict == "too little":
        return [f"{found.seconds:.2f} s of healthy motion are too little to weigh a load"]
    if found.verdict == "nothing":
        return [f"no load shows: {mass}; one of less than {SHOWS * found.mass_error_kg:.2g} {kg} would not"]
    if found.verdict == "lifts":
        lift = -found.fits["load"].values[0]
        return [f"what shows pulls up, as {lift:.2f} {kg} less would: no load, or one that the bundle was trained with"]
    if found.verdict == "contact":
        return [contact_sentence(found, unit)]
    if found.verdict == "unclear":
        left = found.misfit**0.5
        return [
            f"neither a load nor a constant force explains it: the best load, {mass}, leaves {left:.1f} times the "
            "bundle's error; several contacts, a force that changes, or an arm that has changed itself"
        ]
    return [*weighed(found, where, mass, kg), *unseen_sentences(found)]


def weighed(found: LoadEstimate, where: str, mass: str, kg: str) -> list[str]:
    """Mass and centre of mass of a load, as far as they are told."""
    if not found.mass_seen:
        return [
            f"a load, but its mass is not told apart from its lever here: {mass}. Known is only how it pulls at the "
            "joints in these poses; turn the wrist to other ones"
        ]
    said = ", ".join(
        f"{axis} {1e3 * c:.0f} ± {max(1e3 * e, 1):.0f}"
        for axis, c, e in zip("xyz", found.com_m, found.com_error_m, strict=True)
    )
    lines = [f"load {mass}, centre of mass at {said} mm of {where}"]
    if found.at_bound:
        lines.append(
            f"the centre of mass is at the bound of {found.reach_m:g} m that was stated (--reach-m): the load reaches "
            "farther, or is fixed to another link (--frame)"
        )
    return lines


def unseen_sentences(found: LoadEstimate) -> list[str]:
    """Directions of the centre of mass that gravity never turned to, in words."""
    lines = []
    for direction in found.unseen:
        named = axis_name(direction)
        error = 1e3 * float(np.sqrt(direction @ found.com_covariance @ direction))
        lines.append(
            f"the centre of mass along {named} is not visible in this motion (± {error:.0f} mm): gravity never turned "
            "across it, and nothing sped it up enough"
        )
    return lines


def contact_sentence(found: LoadEstimate, unit: str) -> str:
    """What fits better than a load, and how much."""
    force_unit = "N" if unit == "N m" else "units of force"
    base, frame = found.fits["base"], found.fits["frame"]
    best, axes = (base, "the base") if base.cost <= frame.cost else (frame, "the frame")
    force = ", ".join(f"{value:.1f}" for value in best.values)
    load = found.fits["load"]
    return (
        f"this does not turn as gravity would: a constant force of ({force}) {force_unit} along the axes of {axes} "
        f"fits better than any load (it leaves {best.misfit**0.5:.1f} of the bundle's error, the load "
        f"{load.misfit**0.5:.1f}). Something touches the arm"
    )


def axis_name(direction: np.ndarray) -> str:
    """`the z axis of the frame`, or the direction in numbers."""
    k = int(np.abs(direction).argmax())
    if abs(direction[k]) >= ALONG:
        return f"the {'xyz'[k]} axis of the frame"
    turned = direction * np.sign(direction[k])
    return f"the direction ({', '.join(f'{c:.2f}' for c in turned)}) of the frame"


def load_facts(found: LoadEstimate) -> dict:
    """The same for scripts."""
    return {
        "verdict": found.verdict,
        "mass_kg": found.mass_kg,
        "mass_error_kg": found.mass_error_kg,
        "com_m": found.com_m.tolist(),
        "com_error_m": found.com_error_m.tolist(),
        "inertia_kg_m2": found.phi[4:].tolist(),
        "mass_seen": found.mass_seen,
        "com_unseen": [direction.tolist() for direction in found.unseen],
        "at_bound": found.at_bound,
        "misfit": found.misfit,
        "seconds": found.seconds,
    }
