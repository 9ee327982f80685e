"""`tauext load`: the payload from the arm's own joints; torque constants from a known weight."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from tauext._core import LoadFound
from tauext.cli.arguments import BundleArg, JsonArg, RecordingsArg, expect_another, write_another
from tauext.config import require
from tauext.errors import ConfigError

if TYPE_CHECKING:
    from tauext._core import Bundle, KnownWeight
    from tauext.monitor.weighing import NamedFrame, WeighedMotion

# --- `tauext load --known-kg`: torque constants from a known weight.


def set_constants(
    bundle: Bundle,
    path: Path,
    where: NamedFrame,
    parts: list[WeighedMotion],
    mass_kg: float,
    com_m: tuple[float, float, float] | None,
    reach_m: float,
    out: Path | None,
    as_json: bool,
) -> None:
    """Find the factors, print them, and write a bundle with the common factor if `out` is given.

    Raises:
        ConfigError: the weight does not determine the factors, or the new bundle cannot be written.
    """
    from tauext._core import corrected_bundle
    from tauext.monitor.known_load import corrected_constants, weigh_constants, with_provenance

    if out is not None:  # refused before anything is computed
        expect_another(out, path, "correct")
    known = weigh_constants(bundle, where, parts, mass_kg, com_m, reach_m)
    constants, left_out = corrected_constants(bundle, known), not_used(bundle)
    joints = [link.joint_name for link in bundle.links]
    if as_json:
        print(json.dumps(known_facts(known, joints, constants, left_out), indent=1))
    else:
        for line in known_sentences(known, joints, mass_kg, constants, left_out):
            print(line)
    if out is not None:
        new = corrected_bundle(bundle, known)
        with_provenance(new, known, mass_kg, [part.recording.name for part in parts])
        write_another(new, path, out)
        if not as_json:
            print(out)


def not_used(bundle: Bundle) -> list[str]:
    """Names of the joints that weigh nothing, since their torque constants are unknown."""
    from tauext.monitor.weighing import weighing_joints

    return [link.joint_name for link, weighs in zip(bundle.links, weighing_joints(bundle), strict=True) if not weighs]


def known_sentences(
    known: KnownWeight, joints: list[str], mass_kg: float, constants: list[float], left_out: list[str]
) -> list[str]:
    """The factors in words, and what to do where one for all joints is not enough."""
    from tauext.monitor.known_load import one_factor

    lines = [
        f"with {mass_kg:g} kg known, multiply the torques of all joints by {known.common:.3f} "
        f"± {known.common_error:.3f}"
    ]
    own = [
        f"{joint} {factor:.3f} ± {error:.3f}" if shows else f"{joint} same as all"
        for joint, factor, error, shows in zip(joints, known.factors, known.errors, known.shows, strict=True)
        if joint not in left_out
    ]
    lines.append(f"joint by joint: {', '.join(own)}")
    if left_out:
        lines.append(
            f"skipped: {', '.join(left_out)}, whose torque constants remain unknown; a new bundle multiplies their "
            "numbers by the common factor, so that their thresholds hold"
        )
    elif not one_factor(known):
        given = " ".join(f"{constant:.5g}" for constant in constants)
        lines.append(
            "the factors differ by more than their standard errors: with --out, loads and forces take each joint's, "
            "the arm's own masses and thresholds the common one. To correct these too, train with "
            f"--torque-constants {given}"
        )
    return lines


def known_facts(known: KnownWeight, joints: list[str], constants: list[float], left_out: list[str]) -> dict:
    """The factors as plain JSON."""
    from tauext.monitor.known_load import one_factor

    return {
        "factor": known.common,
        "standard_error": known.common_error,
        "joints": {
            joint: {"factor": f, "standard_error": e, "shows": shows, "nm_per_unit": constant}
            for joint, f, e, shows, constant in zip(
                joints, known.factors.tolist(), known.errors.tolist(), known.shows, constants, strict=True
            )
        },
        "left_out": left_out,
        "one_factor": one_factor(known),
        "com_m": known.com_m.tolist(),
    }


# --- The command.


def load(
    bundle: BundleArg,
    recordings: RecordingsArg,
    from_s: Annotated[float | None, tyro.conf.arg(name="from")] = None,
    to_s: Annotated[float | None, tyro.conf.arg(name="to")] = None,
    frame: str | None = None,
    reach_m: float = LoadFound.USUAL_REACH_M,
    known_kg: float | None = None,
    known_com_m: tuple[float, float, float] | None = None,
    out: Path | None = None,
    as_json: JsonArg = False,
) -> None:
    """Identify the arm's payload: mass and centre of mass, from seconds of ordinary motion or several poses at rest.

    The bundle must have been trained without this payload, and nothing may touch the arm. The command reports which
    parameters the motion does not determine. It also reports a torque that does not turn as gravity does: a contact.
    With --known-kg, the known payload sets the torque constants instead.

    Args:
        bundle: bundle (*.tauext) of the arm.
        recordings: recordings (*.parquet) of the arm, all with the same payload.
        from_s: seconds to skip at the start of each recording. None: none.
        to_s: seconds from the start of each recording at which it ends. None: the last sample.
        frame: joint whose link carries the payload. None: the bundle's load frame, on the last link.
        reach_m: largest distance of the centre of mass from that frame's origin, [m].
        known_kg: known mass of the payload, [kg]; torque constants are found instead. None: unknown.
        known_com_m: centre of mass of the known payload in that frame, [m]. None: it is found.
        out: bundle (*.tauext) to write with the torque constants from a known payload. None: no bundle.
        as_json: print one JSON object for scripts.
    """
    require(1e-3 <= reach_m <= 100, "reach_m", reach_m, "0.001 to 100")
    require(from_s is None or from_s >= 0, "from", from_s, ">= 0")
    require(to_s is None or to_s > (from_s or 0), "to", to_s, "> --from")
    require(known_kg is None or 1e-3 <= known_kg <= 1e4, "known_kg", known_kg, "0.001 to 1e4")
    near = known_com_m is None or all(abs(c) <= 100 for c in known_com_m)
    require(near, "known_com_m", known_com_m, "three numbers within +-100")
    if known_kg is None and (out is not None or known_com_m is not None):
        raise ConfigError("--out and --known-com-m need --known-kg: without a known payload there is nothing to set")
    from tauext.cli.run import fitting_bundle
    from tauext.data.recording_file import load_recording
    from tauext.monitor.weighing import between, expect_different, expect_weighable, load_frame, see

    loaded = fitting_bundle(bundle, recordings)
    expect_weighable(loaded)
    where = load_frame(loaded, frame)
    read = [load_recording(path) for path in recordings]
    expect_different(read)
    parts = [between(see(loaded, recording), from_s, to_s) for recording in read]
    if known_kg is None:
        weigh(loaded, where, parts, reach_m, as_json)
    else:
        set_constants(loaded, bundle, where, parts, known_kg, known_com_m, reach_m, out, as_json)


def weigh(bundle: Bundle, where: NamedFrame, parts: list[WeighedMotion], reach_m: float, as_json: bool) -> None:
    """Print the load from all of the motion, and from each window alone."""
    from tauext.monitor.weighing import (
        constants_errors,
        constants_sentence,
        each_window,
        found_facts,
        identify,
        load_sentences,
        mass_words,
        weighing_joints,
    )

    found = identify(bundle, where, parts, reach_m)
    alone = each_window(bundle, where, parts, found) if found.verdict == "load" else []
    unit = bundle.estimate_units[int(weighing_joints(bundle).argmax())]
    left_out = not_used(bundle)
    errors = constants_errors(bundle, found) if found.verdict == "load" and found.mass_seen else {}
    if as_json:
        windows = [{"recording": name, "from_s": start} | found_facts(own) for name, start, own in alone]
        facts = {"frame": where.name, "unit": unit, "left_out": left_out} | found_facts(found)
        facts |= {"constants_errors_kg": errors, "windows": windows}
        print(json.dumps(facts, indent=1))
        return
    for line in load_sentences(found, where.name, unit):
        print(line)
    if errors and (cause := constants_sentence(found, errors)):
        print(cause)
    if left_out:
        print(f"not used: {', '.join(left_out)}, whose torque constants are not known")
    if len(alone) > 1:
        print(scatter_sentence(alone))
        for name, start, own in alone:
            com = ", ".join(f"{1e3 * c:.0f}" for c in own.com_m)
            mass = mass_words(own.mass_kg, own.mass_error_kg)
            print(f"  {name} from {start:.1f} s: {mass} at ({com}) mm, {own.verdict}")


def scatter_sentence(alone: list[tuple[str, float, LoadFound]]) -> str:
    """How the windows agree."""
    masses = sorted(own.mass_kg for _, _, own in alone)
    return f"by windows of 4 s each alone, ± from motion: {len(masses)} give {masses[0]:.2f} to {masses[-1]:.2f} kg"
