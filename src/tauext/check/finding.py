"""Findings of the checks, and their codes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["fault", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("fault", "warning", "note")
NEGATE_EFFORT = "negate the effort at import (`sign = -1` in [signals.tau])"
"""Remedy of every `effort-sign`."""

CODES = {
    "backlash": "a joint has play between its motor and its load",
    "beyond-limit": "a position or torque exceeds the robot file's limit",
    "clock-gaps": "samples are missing",
    "clock-irregular": "the steps between samples differ",
    "contact-in-free-motion": "contacts in a recording declared free, labelled or found in the torque",
    "current-signed": "a current declared as the supply's has a sign",
    "degrees": "positions, or positions and velocities, are in degrees",
    "effort-compensated": "gravity or the whole model is already subtracted from the torque",
    "effort-duty": "the torque is the duty of a drive, or a load register",
    "effort-motor-side": "the torque is that of the motor, before the gear",
    "effort-scale": "the torque has another unit, or is the model's times a constant",
    "effort-sign": "the torque is positive where it pushes in the negative direction",
    "excitation-low": "a joint moves too little",
    "gravity-direction": "gravity has another direction than in the robot file",
    "inertia-impossible": "a link of the robot file has a mass or inertia that no body can have",
    "joint-axis": "an axis is opposite to the robot file's",
    "joint-names": "joints are named otherwise than in the robot file",
    "joint-order": "joints are in another order",
    "limit-fine": "the limit of a training is below the step of the torque",
    "limit-wide": "the limit of a training is a large share of the joint's torque",
    "load-sign-bit": "the torque is a load register with its sign still in a bit",
    "model-unusable": "the robot file cannot be used",
    "never-moves": "no joint moves",
    "odd-recording": "a recording disagrees with the others in unit, sign, order, zero, scale or load",
    "payload": "the arm carries another load than the model",
    "position-offset": "a joint's zero position differs from the robot file's",
    "position-wraps": "a position jumps by whole turns",
    "promise-worse": "the recordings support a worse promise than that of the bundle",
    "repeated-rows": "rows repeat the row before",
    "resolution": "a signal has coarse steps, or less noise than a measurement can have",
    "robot-file-changed": "the robot file differs from the one recorded with",
    "robot-file-other": "the robot file seems to be of another arm",
    "rows-dropped": "an import left out or sorted many rows",
    "saturated": "many samples have one extreme value",
    "spike": "a few samples lie far beyond their neighbours",
    "stuck": "a signal is constant while its joint moves",
    "supply-current": "the torque is the current of a servo's supply, without a sign",
    "time-unit": "the time stamps are in another unit",
    "too-short": "the recordings are short",
    "torque-changes": "the torque changes with time: its zero, in steps, or its friction",
    "torque-delay": "the torque is late or early relative to the motion",
    "unsigned-torque": "the torque has no sign",
    "velocity-delay": "the velocity is late relative to the position",
    "velocity-mismatch": "the velocity is not the derivative of the position",
    "velocity-sign": "the velocity has the opposite sign",
    "velocity-unit": "the velocity is the derivative of the position times a constant",
}
"""Codes of findings and their meaning; stable, scripts may rely on them."""


@dataclass(frozen=True)
class Finding:
    """One fault, warning or note about data or robot file."""

    code: str
    """Key of CODES."""
    severity: Severity
    """fault: a bundle trained on these data is wrong. warning: it may be wrong or inaccurate. note: information."""
    joint: str | None
    """Joint concerned; None: all joints, or no single one."""
    evidence: str
    """Measured evidence, in numbers."""
    advice: str
    """The remedy."""
    recording: str | None = None
    """Name of the recording concerned; None: all, or several."""

    def __post_init__(self) -> None:
        assert self.code in CODES and self.severity in SEVERITIES
