"""From what a recording counts in to rad, rad/s and N m at the joint, and the same in words."""

from __future__ import annotations

import numpy as np

from tauext.data.description import NORMALISED, UNITS, Arm, SignalTable


def in_si(key: str, signal: SignalTable, values: np.ndarray, arm: Arm) -> np.ndarray:
    """Joint side, SI: sign · unit · (torque constant) · gear, and a position's offset added (rad where normalised)."""
    if signal.unit == NORMALISED:
        values = _of_normalised(key, values, arm)
    factor = np.full(len(arm.robot.joints), UNITS[key][signal.unit])
    if signal.torque_constant and signal.torque_constant != "unknown":
        factor *= signal.torque_constant
    if signal.side == "motor":
        gear = np.array(arm.gear_ratio)
        factor = factor * gear if key == "tau" else factor / gear
    if signal.sign:
        factor = factor * signal.sign
    converted = values * factor
    return converted + np.array(signal.offset) * UNITS[key][signal.unit] if signal.offset else converted


def _of_normalised(key: str, values: np.ndarray, arm: Arm) -> np.ndarray:
    """Angles [rad] of LeRobot's normalised positions and goals; Dynamixel's bus does not turn them by drive_mode."""
    types = arm.servo.type if arm.servo is not None else ()
    turned = not any(name.startswith("x") for name in types)
    columns = [
        motor.radians_of_normalised(
            values[:, j], 0.0 if motor.name.endswith("gripper") else -100.0, turned, sent=key == "q_des"
        )
        for j, motor in enumerate(arm.motors)
    ]
    return np.stack(columns, axis=1)


def conversions(arm: Arm) -> list[str]:
    """What in_si did, in words, where it did anything."""
    lines = []
    for key, signal in arm.signals.items():
        is_current = signal.is_current and key == "tau"
        plain = UNITS[key][signal.unit] == 1 and signal.unit != NORMALISED and not is_current
        done = [] if plain else [f"from {signal.unit}"]
        if is_current:
            known = signal.torque_constant != "unknown"
            done.append(f"times {', '.join(f'{k:g}' for k in signal.torque_constant)} Nm/A" if known else "left in A")
        if signal.side == "motor":
            done.append(f"{'times' if key == 'tau' else 'divided by'} gear ratio")
        if any(s < 0 for s in signal.sign):
            all_of_them = all(s < 0 for s in signal.sign)
            names = [joint for joint, s in zip(arm.robot.joints, signal.sign, strict=True) if s < 0]
            done.append("sign turned" + ("" if all_of_them else f" of {', '.join(names)}"))
        if any(signal.offset):
            done.append(f"offset {', '.join(f'{o:g}' for o in signal.offset)} {signal.unit} added")
        if done:
            lines.append(f"{key}: {', '.join(done)}")
    return lines


def constant_unknown(arm: Arm) -> bool:
    """Whether the torque stays in amperes, since nobody knows the motor's constant."""
    return arm.signals["tau"].torque_constant == "unknown"
