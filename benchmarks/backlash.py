"""Backlash that `tauext check` estimates on simulated servos, against the true backlash.

    python benchmarks/backlash.py --out docs/results/backlash        # the table there; two minutes on one core

Servos of tests/made_servos.py, two bodies over a gap with friction, gravity, a position controller and 4096 counts a
turn, at 50 Hz. tau is the drive's torque, or made of goal and position as an import makes it: a duty less its back-EMF.
"""

import shlex
import sys
from dataclasses import replace
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent / "tests"))

import numpy as np
from common import arguments, head, table_row, write_page
from made_servos import COUNT_RAD, NO_LOAD_RAD_S, STALL_NM, Driven, Servo, drive, recorded

from tauext import _core
from tauext.data.drive_signal import Play, play_of
from tauext.data.recording import Recording

DEGREE = np.pi / 180
RATE_HZ = 50.0
PLAYS = (0.0, 0.3, 0.5, 0.8, 1.0, 1.3, 1.5)
CASES = {
    "friction alone": Servo(),
    "gravity equal to friction": Servo(gravity_nm=0.1),
    "motor friction equal to link friction": Servo(motor_friction_nm=0.1),
    "a third of the friction behind the backlash": Servo(link_friction_nm=0.03),
    "gravity ten times friction": Servo(gravity_nm=1.0),
    "encoder behind the backlash": Servo(encoder="link"),
    "elastic friction over 1.1 degrees": Servo(bend_rad=0.01),
}


def main() -> None:
    parser = arguments(__doc__)
    parser.add_argument("--minutes", type=float, default=2.0, help="of each recording")
    parser.add_argument("--recordings", type=int, default=3, help="that a width is found from")
    parser.add_argument("--out", type=Path, help="folder for the table as README.md")
    options = parser.parse_args()
    servos = [replace(servo, play_rad=play * DEGREE) for servo in CASES.values() for play in PLAYS]
    driven = [drive(servos, 60 * options.minutes, RATE_HZ, seed) for seed in range(options.recordings)]
    lines = [
        "# Backlash of servo joints",
        "",
        "Backlash that `tauext check` estimates on simulated servos, against the true backlash (column heads).",
        "",
        f"    python benchmarks/backlash.py {shlex.join(sys.argv[1:])}".rstrip(),
        "",
        f"Each case has {options.recordings} recordings of {options.minutes:g} minutes at {RATE_HZ:g} Hz. "
        "Positions have steps of 0.088 degrees. Cells",
        "show the estimated width ± its standard error in degrees. A number in parentheses is the travel after which",
        "half of the friction has built up, where no backlash is certain. A dash: nothing found.",
        "",
        "The estimate fails where gravity is ten times the friction. Elastic friction (last row) shows travel without",
        "backlash. With an encoder behind the backlash, the width is too small or not found. From goal and position, "
        "widths are",
        "up to a quarter too small in the other cases.",
    ]
    for what, made in (("the drive", False), ("goal and position, with the servo's gain", True)):
        lines += ["", f"## Torque from {what}", "", *head(" | ".join(["joint", *(f"{play:g}°" for play in PLAYS)]))]
        for k, (name, servo) in enumerate(CASES.items()):
            recordings = [recording(part(one, k), servo, made) for one in driven]
            lines.append(table_row(name, *(told(play_of(recordings, j)) for j in range(len(PLAYS)))))
            print(lines[-1], flush=True)
    if options.out:
        write_page(options.out / "README.md", lines)


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
        _core.TorqueFrom.goal, [constants] * len(PLAYS), velocity_steps=10, sample_period_ns=round(1e9 / RATE_HZ)
    )
    t_ns = np.round(driven.t_s * 1e9).astype(np.int64)
    _, tau = _core.ServoInput(settings).recording(t_ns, driven.q, q_des=driven.goal)
    return recorded(driven, tau)


def told(play: Play) -> str:
    if play.width_rad > 0:
        return f"{play.width_rad / DEGREE:.2f} ± {play.error_rad / DEGREE:.2f}"
    return f"({play.lost_rad / DEGREE:.2f})" if play.lost_rad > 0 else "–"


if __name__ == "__main__":
    main()
