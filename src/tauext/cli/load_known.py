"""`tauext load --known-kg`: torque constants from a weight that is known."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

from tauext.cli.another_bundle import expect_another, write_another
from tauext.files.place import Place

if TYPE_CHECKING:
    from tauext._core import Bundle
    from tauext.monitor.frame import NamedFrame
    from tauext.monitor.known import KnownWeight
    from tauext.monitor.rows import Seen


def set_constants(
    bundle: Bundle,
    path: Place,
    where: NamedFrame,
    parts: list[Seen],
    mass_kg: float,
    com_m: tuple[float, float, float] | None,
    reach_m: float,
    out: Place | None,
    as_json: bool,
) -> None:
    """Find the factors, say them, and write a bundle with the common one where that is asked for.

    Raises:
        ConfigError: the weight does not tell, or the new bundle cannot be written.
    """
    from tauext.monitor.known import weigh_constants

    check_out(path, out)
    known = weigh_constants(bundle, where, parts, mass_kg, com_m, reach_m)
    constants = known.constants(bundle)
    joints = [link.joint_name for link in bundle.links]
    if as_json:
        print(json.dumps(known_facts(known, joints, constants), indent=1))
    else:
        for line in known_sentences(known, joints, mass_kg, constants):
            print(line)
    if out is not None:
        write(bundle, path, known, mass_kg, [part.recording.name for part in parts], out)
        if not as_json:
            print(out)


def check_out(path: Place, out: Place | None) -> None:
    """Raise ConfigError where the new bundle cannot be written, before anything is computed."""
    if out is not None:
        expect_another(out, path, "correct")


def write(bundle: Bundle, path: Place, known: KnownWeight, mass_kg: float, recordings: list[str], out: Place) -> None:
    """The bundle with its constants times the common factor; its run file is copied along, where there is one."""
    from tauext.monitor.scaled_bundle import scaled_bundle, with_provenance

    new = scaled_bundle(bundle, known.common)
    with_provenance(new, known, mass_kg, recordings)
    write_another(new, path, out)


def known_sentences(known: KnownWeight, joints: list[str], mass_kg: float, constants: list[float]) -> list[str]:
    """The factors in words, and what to do where one for all joints is not enough."""
    lines = [
        f"with {mass_kg:g} kg known, torques are to be multiplied by {known.common:.3f} ± {known.common_error:.3f}, "
        "all joints together"
    ]
    own = [
        f"{joint} {factor:.3f} ± {error:.3f}" if shows else f"{joint} as all"
        for joint, factor, error, shows, skipped in zip(
            joints, known.factors, known.errors, known.shows, known.skipped, strict=True
        )
        if not skipped
    ]
    lines.append(f"joint by joint: {', '.join(own)}")
    left_out = [joint for joint, skipped in zip(joints, known.skipped, strict=True) if skipped]
    if left_out:
        lines.append(
            f"skipped: {', '.join(left_out)}, whose torque constants are not known and stay so; a new bundle has their "
            "numbers times the common factor, so that their limits hold"
        )
    if not known.one_factor and not left_out:
        told = " ".join(f"{constant:.5g}" for constant in constants)
        lines.append(
            "joints differ by more than their errors, which do not know how far the bundle's own arm was fitted with "
            f"wrong constants; a bundle takes one factor. A training of its own takes all: --torque-constants {told}"
        )
    return lines


def known_facts(known: KnownWeight, joints: list[str], constants: list[float]) -> dict:
    """The same for scripts."""
    return {
        "factor": known.common,
        "standard_error": known.common_error,
        "joints": {
            joint: {"factor": float(f), "standard_error": float(e), "shows": bool(s), "nm_per_unit": c}
            for joint, f, e, s, c in zip(joints, known.factors, known.errors, known.shows, constants, strict=True)
        },
        "left_out": [joint for joint, skipped in zip(joints, known.skipped, strict=True) if skipped],
        "one_factor": known.one_factor,
        "com_m": known.com_m.tolist(),
    }
