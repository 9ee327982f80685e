"""What a bundle says of servos, in words."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tauext._core import Bundle

MADE_OF = {
    "phase_current": "current of the windings",
    "supply_current": "current of the supply, with the sign of the duty or of goal minus position",
    "duty": "duty, less back-EMF",
    "goal": "goal minus position by the gain of the servo's controller, less back-EMF",
}


def describe_servo(bundle: Bundle, names: list[str]) -> dict:
    """Empty where the joints are no servos', or report their torque and velocity."""
    servo = bundle.servo
    if not servo.on:
        return {}
    said: dict = {}
    if (source := servo.torque_from.name) in MADE_OF:
        said["torque is made of"] = MADE_OF[source]
        said["servos"] = {
            name: f"{joint.volts:g} V, {joint.ohm:g} ohm, {joint.back_emf_v_s:g} V s/rad, {joint.nm_per_ampere:g} Nm/A"
            + (f", duty {joint.duty_per_rad:.3g} a rad, at most {joint.most_duty:g}" if joint.duty_per_rad else "")
            for name, joint in zip(names, servo.joints, strict=True)
        }
    if servo.velocity_steps:
        said["velocity is derived from the position"] = f"over {servo.velocity_steps} samples at most"
        said["encoder counts [rad]"] = {name: joint.count_rad for name, joint in zip(names, servo.joints, strict=True)}
    return said
