"""Settings, velocity and torque of recordings of currents and servos."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from tauext import _core
from tauext.data.description import Arm, parse_arm
from tauext.data.recording import Recording
from tauext.data.servo_types import COUNTS_A_TURN, SERVO_TYPES, ServoType
from tauext.errors import ConfigError

# --- Recordings whose tau is or was a motor current, according to provenance.


AMPERES = "amperes: the torque constant is unknown"
FROM_AMPERES = "N m: amperes times given torque constants"


class _Recorded(Protocol):
    """A recording, or the metadata of its file."""

    @property
    def provenance(self) -> dict[str, Any]: ...


def in_amperes(recordings: Sequence[_Recorded]) -> bool:
    """Whether any recording has currents with unknown torque constants."""
    return _unscaled(recordings, AMPERES)


def from_amperes(recordings: Sequence[Recording]) -> bool:
    """Whether any recording has currents times given constants, which training may correct."""
    return _unscaled(recordings, FROM_AMPERES)


def torque_unit(recordings: Sequence[Recording]) -> str:
    """Unit of tau for messages: `A` for a motor current with unknown torque constant."""
    return "A" if in_amperes(recordings) else "Nm"


# Flights of tauext 0.1 contain torques that are already multiplied, as their provenance states.
def _unscaled(recordings: Sequence[_Recorded], torque: str) -> bool:
    return any(r.provenance.get("torque") == torque and "torque_constants" not in r.provenance for r in recordings)


# --- Recordings of servo arms: the core's settings from the [servo] table, and velocity and torque.


RAW_SIGNALS = ("q_des", "current", "duty", "voltage")
"""Signals from which a servo's torque is computed, beside position and velocity."""
TORQUE_WORDS = {
    "phase-current": "current of the windings",
    "supply-current": "current of the supply",
    "duty": "duty",
    "goal": "goal and the position",
}
"""Signal from which a torque is computed, by [servo] torque_from."""
OF_GOAL = ("goal", "supply_current")
"""Sources of torque, by TorqueFrom, for which goals count: a supply current has no sign."""
UNKNOWN = ServoType(1.0, 1.0, 0.0, None, count_rad=0.0)
"""An unknown servo: torque in units of duty or current, times a constant found in training; back-EMF acts as viscous
friction."""


def servo_settings(arm: Arm, rate_hz: float, q: np.ndarray) -> _core.ServoSettings:
    """Return the core's servo settings of an arm at this rate.

    Args:
        q: positions (samples, joints), [rad]; their smallest step replaces a missing encoder step.

    Raises:
        ConfigError: the torque comes from the goal, and the gain of the position controller is unknown.
    """
    servo = arm.servo
    assert servo is not None
    joints, moved = arm.robot.joints, np.abs(np.diff(q, axis=0))
    least = np.where(moved > 0, moved, np.inf).min(axis=0, initial=np.inf)
    types = [SERVO_TYPES[name] for name in servo.type] or [UNKNOWN]
    types = types * len(joints) if len(types) == 1 else types
    table = arm.signals["tau"].torque_constant
    nm_per_ampere = (1.0,) * len(joints) if isinstance(table, str) or not table else table
    constants = []
    for j, kind in enumerate(types):
        # The table's constants come before those of the type.
        given = {name: one[j] for name, one in vars(servo).items() if isinstance(one, tuple) and one and name != "type"}
        count_rad = 2 * math.pi / given["counts_a_turn"] if "counts_a_turn" in given else kind.count_rad
        gain = given.get("gain", kind.gain)
        duty_per_rad = given.get("duty_per_rad", (gain or 0.0) * (kind.duty_per_rad or 0.0))
        duty_per_rad = duty_per_rad or float(kind is UNKNOWN)
        if servo.torque_from == "goal" and not duty_per_rad:
            raise ConfigError(
                f"{arm.path}: [servo] torque_from = 'goal' needs the gain of the position controller of joint "
                f"'{joints[j]}': duty_per_rad, since that of {servo.type[min(j, len(servo.type) - 1)]} is not known"
            )
        constants.append(
            _core.ServoConstants(
                volts=given.get("voltage_v", kind.volts),
                ohm=given.get("ohm", kind.ohm or 1.0),
                back_emf_v_s=given.get("back_emf_v_s", kind.back_emf_v_s or 0.0),
                nm_per_ampere=nm_per_ampere[j],
                duty_per_rad=duty_per_rad,
                most_duty=given.get("most_duty", kind.most_duty),
                count_rad=count_rad or (float(least[j]) if np.isfinite(least[j]) else 0.0),
            )
        )
    steps = min(round(servo.velocity_window_s * rate_hz), 64)
    source = getattr(_core.TorqueFrom, servo.torque_from.replace("-", "_"))
    delay_s = 1 / rate_hz if isinstance(servo.goal_delay_s, str) else servo.goal_delay_s
    return _core.ServoSettings(
        source,
        constants,
        velocity_steps=max(steps, 1) if servo.velocity_window_s else 0,
        sample_period_ns=round(1e9 / rate_hz),
        goal_delay_ns=round(delay_s * 1e9) if source.name in OF_GOAL else 0,
    )


def settings_by_type(
    types: Sequence[str], joints: Sequence[str], torque_from: str, rate_hz: float
) -> tuple[_core.ServoSettings, bool]:
    """Settings for servos of these types, as an arm.toml with [servo] gives them, and whether the constants are known.

    Args:
        types: names in SERVO_TYPES, one a joint; "": unknown, and then no constant of any is used.
    """
    known = all(types) and all(SERVO_TYPES[name].nm_per_ampere for name in types)
    lines = [f"[robot]\njoints = {json.dumps(list(joints))}"]
    lines += [f'[signals.{name}]\ncolumns = "{name}_{{joint}}"' for name in ("q", "current", "duty", "voltage")]
    lines.append(f'[servo]\ntorque_from = "{torque_from}"')
    lines.append(f"type = {json.dumps(list(types))}" if known else f"counts_a_turn = {COUNTS_A_TURN}")
    return servo_settings(parse_arm("\n".join(lines)), rate_hz, np.zeros((0, len(joints)))), known


def velocity_and_torque(
    settings: _core.ServoSettings, t_ns: np.ndarray, q: np.ndarray, signals: Mapping[str, np.ndarray | None]
) -> tuple[np.ndarray, np.ndarray]:
    """Compute dq [rad/s] and tau [N m or A] of a recording, (samples, joints), equal to a live loop's values.

    Args:
        signals: the measured ones of dq, tau, q_des, current, duty, voltage.
    """
    measured = {
        name: np.ascontiguousarray(values, dtype=np.float64)
        for name in ("dq", "tau", *RAW_SIGNALS)
        if (values := signals.get(name)) is not None
    }
    q = np.ascontiguousarray(q, dtype=np.float64)
    return _core.ServoInput(settings).recording(np.ascontiguousarray(t_ns), q, **measured)


def servo_facts(settings: _core.ServoSettings) -> dict[str, Any]:
    """The settings as plain JSON, for provenance."""
    constants = ("volts", "ohm", "back_emf_v_s", "nm_per_ampere", "duty_per_rad", "most_duty", "count_rad")
    return {
        "torque_from": settings.torque_from.name,
        "velocity_steps": settings.velocity_steps,
        "sample_period_ns": settings.sample_period_ns,
        "goal_delay_ns": settings.goal_delay_ns,
        "joints": [{name: getattr(joint, name) for name in constants} for joint in settings.joints],
    }


def servo_of(facts: Mapping[str, Any]) -> _core.ServoSettings:
    """Return the settings from servo_facts()."""
    return _core.ServoSettings(
        getattr(_core.TorqueFrom, facts["torque_from"]),
        [_core.ServoConstants(**joint) for joint in facts["joints"]],
        facts["velocity_steps"],
        facts["sample_period_ns"],
        facts["goal_delay_ns"],
    )


def makes_torque(recording: Recording) -> bool:
    """Whether its torque was computed from servo signals."""
    return recording.provenance.get("servo", {}).get("torque_from", "torque") != "torque"


def derives_velocity(recording: Recording) -> bool:
    """Whether its velocity was derived from the counted positions of servos."""
    return bool(recording.provenance.get("servo", {}).get("velocity_steps"))


def servo_of_recordings(recordings: Sequence[Recording]) -> _core.ServoSettings:
    """Return the common servo settings of the recordings; off without servos.

    Raises:
        ConfigError: the recordings' settings differ.
    """
    facts = [recording.provenance.get("servo") for recording in recordings]
    for recording, other in zip(recordings, facts, strict=True):
        if other != facts[0]:
            raise ConfigError(
                f"{recording.name} and {recordings[0].name}: their velocity and torque were made with other settings "
                "of [servo]; import both with one arm.toml"
            )
    return servo_of(facts[0]) if facts and facts[0] else _core.ServoSettings()
