"""Bundles of formats 3 and 4 with torque constants in their provenance, as bundles that apply them themselves."""

from __future__ import annotations

import json

from tauext import _core
from tauext.bundle.bundle_file import expect_text
from tauext.errors import BundleError
from tauext.fit.torque_constants import with_constants


def converted(old: bytes) -> _core.Bundle:
    """The bundle of these bytes, with its torque constants and units as fields; its answers are the same.

    It takes tau as the recordings had it that it was trained on, where the old one took tau times its constants. Its
    provenance stays.

    Raises:
        CoreError: damaged, no bundle, or of format 5 or later.
        BundleError: there are no torque constants in its provenance, and it needs no conversion; or none to be read.
    """
    bundle = _core.Bundle.from_old_bytes(old)
    expect_text(bundle)
    facts = json.loads(bundle.provenance or "{}")
    constants = facts.get("torque_constants")
    if constants is None:
        raise BundleError("it has no torque constants, so it needs no conversion: it is read as it is")
    try:
        used = [float(constant) for constant in constants["used"]]
        units = _units([link.joint_name for link in bundle.links], constants, used, facts)
        factors = [1 / constant for constant in used]
    except (KeyError, TypeError, ValueError, ZeroDivisionError, AttributeError) as error:
        raise BundleError(f"the torque constants in its provenance cannot be read ({error!r})") from error
    bundle.observer, bundle.units = with_constants(bundle.observer, used), units
    bundle.scale_reference(factors)
    return bundle


def _units(joints: list[str], constants: dict, used: list[float], facts: dict) -> _core.TorqueUnits:
    """As TorqueConstants.units says them; a constant of exactly 1 that was not determined was not used."""
    if constants.get("given"):
        return _core.TorqueUnits(_core.TorqueUnit.newton_metre)
    asked = facts.get("settings", {}).get("config", {}).get("fit_torque_constants")
    given = _core.TorqueUnit.recorded if asked else _core.TorqueUnit.ampere
    relative_to = constants.get("relative_to")
    found = [constants["found"][name] for name in joints]
    unknown = [int(not one["determined"] and k == 1.0) for one, k in zip(found, used, strict=True)]
    return _core.TorqueUnits(
        given, -1 if relative_to is None else joints.index(relative_to), unknown if any(unknown) else []
    )
