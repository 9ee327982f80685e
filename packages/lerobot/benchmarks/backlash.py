"""Backlash of simulated servos, and the width that `tauext check` estimates.

    python packages/lerobot/benchmarks/backlash.py OUT

Servos of tests/made_servos.py: two bodies over a gap with friction, gravity, a position controller and 4096 counts a
turn, at 50 Hz; tau is the drive's torque, or computed from goal and position as an import does. OUT/backlash.md gets
the tables.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).parents[3] / "benchmarks"))
from common import arguments, head, table_row, write_tables
from made_servos import COUNT_RAD, NO_LOAD_RAD_S, STALL_NM, Driven, Servo, drive, recorded
from tauext_lerobot.backlash import Play, play_of

from tauext import _core
from tauext.data.recording import Recording

DEGREE = np.pi / 180
SERVO_HZ = 50.0
PLAYS = (0.0, 0.3, 0.5, 0.8, 1.0, 1.3, 1.5)
SERVOS = {
    "friction alone": Servo(),
    "gravity equal to friction": Servo(gravity_nm=0.1),
    "motor friction equal to link friction": Servo(motor_friction_nm=0.1),
    "a third of the friction behind the backlash": Servo(link_friction_nm=0.03),
    "gravity ten times friction": Servo(gravity_nm=1.0),
    "encoder behind the backlash": Servo(encoder="link"),
    "elastic friction over 1.1 degrees": Servo(bend_rad=0.01),
}


def backlash_tables() -> list[str]:
    """Estimated width ± standard error in degrees; in parentheses the travel after which half of the friction acts."""
    servos = [replace(servo, play_rad=play * DEGREE) for servo in SERVOS.values() for play in PLAYS]
    driven = [drive(servos, 120.0, SERVO_HZ, seed) for seed in range(3)]
    lines: list[str] = []
    for what, made in (("the drive", False), ("goal and position", True)):
        lines += ["", *head(" | ".join([f"torque from {what}", *(f"{play:g}°" for play in PLAYS)]))]
        for k, (name, servo) in enumerate(SERVOS.items()):
            recordings = [recording(part(one, k), servo, made) for one in driven]
            lines.append(table_row(name, *(width(play_of(recordings, j)) for j in range(len(PLAYS)))))
    return lines


def part(driven: Driven, k: int) -> Driven:
    """Of the case k alone."""
    columns = slice(k * len(PLAYS), (k + 1) * len(PLAYS))
    names = ("goal", "q", "dq", "duty", "torque")
    return replace(driven, **{name: np.ascontiguousarray(getattr(driven, name)[:, columns]) for name in names})


def recording(driven: Driven, servo: Servo, made: bool) -> Recording:
    if not made:
        return recorded(driven, driven.torque)
    constants = _core.ServoConstants(
        volts=1.0, ohm=1.0, back_emf_v_s=1 / NO_LOAD_RAD_S, nm_per_ampere=STALL_NM, most_duty=1.0, count_rad=COUNT_RAD,
        duty_per_rad=servo.duty_per_rad,
    )  # fmt: skip
    settings = _core.ServoSettings(
        _core.TorqueFrom.goal, [constants] * len(PLAYS), velocity_steps=10, sample_period_ns=round(1e9 / SERVO_HZ)
    )
    t_ns = np.round(driven.t_s * 1e9).astype(np.int64)
    _, tau = _core.ServoInput(settings).recording(t_ns, driven.q, q_des=driven.goal)
    return recorded(driven, tau)


def width(play: Play) -> str:
    if play.width_rad > 0:
        return f"{play.width_rad / DEGREE:.2f} ± {play.error_rad / DEGREE:.2f}"
    return f"({play.lost_rad / DEGREE:.2f})" if play.lost_rad > 0 else "–"


if __name__ == "__main__":
    options = arguments(__doc__, "out").parse_args()
    write_tables(options.out, backlash_tables(), name="backlash")
