"""Bundles from their files, and what was done to them after training."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tauext import _core
from tauext.bundle.loss_history import LossHistory
from tauext.config import checked
from tauext.errors import BundleError, ConfigError
from tauext.files.atomic_write import atomic_files
from tauext.files.kind import why_no_bundle
from tauext.files.plain_file import json_of
from tauext.files.provenance import json_text
from tauext.progress import WallTimes

# --- Bundles from their files.


@checked
def load_bundle(path: Path | str) -> _core.Bundle:
    """The bundle in a file NAME.tauext, checked and its reference replayed; `Bundle.save` writes one.

    Raises:
        BundleError: there is no such file.
        CoreError: damaged, or of another format.
    """
    path = Path(path)
    if path.suffix != ".tauext" and (reason := why_no_bundle(path)):
        raise BundleError(f"{path}: {reason}")
    if not path.is_file():
        raise BundleError(f"{path}: there is no such bundle; `tauext train` makes one")
    try:
        str(path).encode()  # the core takes no other names
        bundle = _core.Bundle.load(str(path))
    except (RuntimeError, UnicodeError) as error:  # a disk that fails while it is read; a name that is no text
        raise BundleError(f"{path}: cannot be read ({error})") from error
    try:
        expect_text(bundle)
    except BundleError as error:
        raise BundleError(f"{path}: {error}") from error
    return bundle


def expect_text(bundle: _core.Bundle) -> None:
    """Raise BundleError where names are no text or the provenance is no JSON object: the core takes both as bytes."""
    try:
        facts = json_of(bundle.provenance or "{}")
        names = [bundle.name, *(link.joint_name for link in bundle.links)]
    except (UnicodeError, ValueError) as error:
        raise BundleError(f"its names or provenance cannot be read ({error}); it is damaged") from error
    if not isinstance(facts, dict) or not all(names):
        raise BundleError("its provenance is no JSON object, or a joint has no name; it is damaged")
    if odd := [name for name in names if not name.isprintable()]:
        raise BundleError(f"its name {odd[0]!r} has characters that cannot be printed")


def write_bundle(bundle: _core.Bundle, path: Path, facts: dict, history: LossHistory, times: WallTimes) -> None:
    """Write NAME.tauext with NAME.run.json and NAME.wall_time_s.json beside it: all three, or none.

    The bundle is written last: if it exists, its run file exists.

    Args:
        facts: the bundle's provenance; the run file contains them too, with the loss history.
        times: wall times of the phases so far; writing the bundle is added as the phase `write`.

    Raises:
        ConfigError: one of them cannot be written.
    """
    beside = (path.with_suffix(".run.json"), path.with_suffix(".wall_time_s.json"))
    bundle.provenance = json.dumps(facts, sort_keys=True, allow_nan=False)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with atomic_files(*beside, path) as (run_part, wall_part, part):
            with times.phase("write"):
                run_part.write_text(json_text(facts | {"loss_history": history}))
                bundle.save(str(part))
            wall_part.write_text(json_text(times.facts()))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error
    except _core.CoreError as error:
        raise ConfigError(f"{path}: {str(error).removeprefix(f'{part}: ')}") from error


# --- What was done to a bundle after its training: friction brought up to date, torque constants from a known weight.


def changed_since_training(facts: Mapping[str, Any]) -> dict[str, str]:
    """By what was done, in words; empty for a bundle as training left it.

    Args:
        facts: the bundle's provenance.
    """
    lines: dict[str, str] = {}
    if refitted := facts.get("refitted"):
        lines |= refitted_words(refitted)
    if known := facts.get("known_weight"):
        off = known["factor"] - 1
        lines["torques corrected"] = (
            f"times {known['factor']:.3f} ± {known['standard_error']:.3f} ({off:+.1%}), from a known payload of "
            f"{known['mass_kg']:g} kg in {', '.join(known['recordings'])}"
        )
    return lines


def refitted_words(refitted: Mapping[str, Any]) -> dict[str, str]:
    """What a refit found of every joint, and whether the promise holds."""
    lines = {"friction brought up to date": f"on {refitted['used_s']:.0f} s of the arm's motion"}
    for joint in refitted["joints"]:
        (coulomb, coulomb_error), (viscous, viscous_error) = joint["coulomb"], joint["viscous"]
        words = f"friction times {coulomb:.3f} ± {coulomb_error:.3f}, viscous {viscous:.3f} ± {viscous_error:.3f}"
        if joint["limit_factor"] > 1:
            words += f", thresholds times {joint['limit_factor']:.2f}"
        lines[f"since training, {joint['joint']}"] = words
    lines["target false alarm rate"] = refitted["promise"]
    return lines
