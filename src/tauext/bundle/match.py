"""Whether a recording is one that a bundle was made for."""

from __future__ import annotations

from tauext import _core
from tauext.config import checked
from tauext.data.recording import Recording
from tauext.data.recording_file import Description
from tauext.data.servo import FROM_AMPERES, servo_facts
from tauext.errors import BundleError


@checked
def expect_fit(bundle: _core.Bundle, recording: Recording | Description) -> None:
    """Raise BundleError, naming what differs, where the recording is not of the bundle's robot, rate and timing.

    So it does where the bundle takes amperes and the recording states that its tau is in N m; most state nothing.
    """
    joints = tuple(link.joint_name for link in bundle.links)
    if recording.joints != joints:
        raise BundleError(
            f"bundle '{bundle.name}' is for joints {', '.join(joints)}; recording {recording.name} has "
            f"{', '.join(recording.joints)}"
        )
    rate_hz = 1e9 / bundle.observer.sample_period_ns
    if abs(recording.rate_hz / rate_hz - 1) > bundle.rate_tolerance:
        raise BundleError(
            f"bundle '{bundle.name}' runs at {rate_hz:g} Hz; recording {recording.name} has {recording.rate_hz:g} Hz"
        )
    timing = bundle.observer.timing.name
    if recording.torque_timing != timing:
        raise BundleError(
            f"bundle '{bundle.name}' takes torques that are {timing}; those of recording {recording.name} are "
            f"{recording.torque_timing}"
        )
    made, wanted = recording.provenance.get("servo"), servo_facts(bundle.servo) if bundle.servo.on else None
    if wanted is not None and made != wanted:
        how = "with other settings" if made else "not made by [servo] of an arm.toml"
        raise BundleError(
            f"bundle '{bundle.name}' makes velocity and torque of what servos report; those of recording "
            f"{recording.name} are {how}: import it with the arm.toml that the bundle's recordings were imported with"
        )
    unit = recording.provenance.get("torque")
    if "A" in bundle.torque_units and unit in ("N m", FROM_AMPERES):
        raise BundleError(
            f"bundle '{bundle.name}' takes motor currents in amperes; recording {recording.name} is in {unit}"
        )
