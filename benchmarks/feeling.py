"""A hand that leads a follower arm against a table feels it, and nothing swings up.

    python benchmarks/feeling.py OUT [--seed 0]

Leader, wire and follower are simulated (leader.py): 50 ticks a second, 1 to 3 ticks of delay each way, a table of 10
N/mm. tau_ext is tauext's own: OUT/data gets free motion of the follower with its bundle; what is there is used again.
OUT gets feeling.md, feeling.json and press.png. Some 4 minutes of one core.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from common import arguments, head, joined, table_row, write_tables
from leader import (
    GEARS,
    HANDS,
    TICK_S,
    Course,
    Gears,
    Hand,
    MonitorSenses,
    Wall,
    Wish,
    free_motion,
    moves,
    press,
    run,
    taps,
    train,
)
from tauext_lerobot.leader_feedback import EnergyTank, FeedbackSettings, LeaderFeedback, free_motion_sigmas

from tauext._core import Bundle
from tauext.progress import SILENT

TABLE = Wall((0.0, 0.0, 1.0), 0.08)
DEEP_M = 0.10
"""The hand wants to go so far below where it began."""
BEGIN_M = 0.131
"""Height of the hand there."""
TAP_HZ = 1.2
PRESS_S = 12.0
FREE_MINUTES = 2.0
DELAYS = (1, 2, 3)
CAP_NM = 1.0


def main() -> None:
    parser = arguments(__doc__, "out", seed=0)
    options = parser.parse_args()
    bundle = train(options.out / "data", options.seed, SILENT)
    tau_ext, sigma = free_motion(options.out / "data", bundle)
    settings = FeedbackSettings(cap_nm=CAP_NM, dead_band_sigmas=free_motion_sigmas(tau_ext, sigma))
    free = [free_session(bundle, settings, options.seed, hand, gears) for hand in HANDS for gears in GEARS]
    presses, courses = [], {}
    for gears in GEARS:
        for hand in HANDS:
            for delay in DELAYS:
                pair = [
                    press_session(press(DEEP_M), bundle, settings, hand, gears, delay, kept) for kept in (False, True)
                ]
                presses.append((gears.name, hand.name, delay, *(asdict(swing(course)) for course in pair)))
                courses[gears.name, hand.name, delay] = pair
    tapped = [
        press_session(taps(DEEP_M, TAP_HZ), bundle, settings, HANDS[0], GEARS[1], 3, kept) for kept in (False, True)
    ]
    numbers = {
        "seed": options.seed,
        "dead_band_sigmas": settings.dead_band_sigmas,
        "cap_nm": settings.cap_nm,
        "tank_j": settings.tank_j,
        "below_m": DEEP_M - (BEGIN_M - TABLE.at_m),
        "tap_hz": TAP_HZ,
        "free": free,
        "press": presses,
        "taps": [asdict(swing(course)) for course in tapped],
    }
    draw(courses[GEARS[1].name, HANDS[0].name, 3], TABLE, options.out / "press.png")
    write_tables(options.out, tables(numbers), numbers, "feeling")


def press_session(
    wish: Wish, bundle: Bundle, settings: FeedbackSettings, hand: Hand, gears: Gears, delay: int, kept: bool
) -> Course:
    """A session against the table, whose energy is kept or only counted."""
    feedback = LeaderFeedback(3, settings)
    if not kept:
        feedback.tank = EnergyTank(3, replace(settings, tank_j=1e9, friction_nm=0.0, rest_w=0.0))
    return run(wish, PRESS_S, delay, hand, gears, TABLE, MonitorSenses(bundle), feedback)


def free_session(bundle: Bundle, settings: FeedbackSettings, seed: int, hand: Hand, gears: Gears) -> dict:
    """Motion in the air that neither training nor the dead band saw: what was felt of it."""
    wish = moves(60 * FREE_MINUTES, np.random.default_rng([seed, 3000, HANDS.index(hand), GEARS.index(gears)]))
    feedback = LeaderFeedback(3, settings)
    course = run(wish, 60 * FREE_MINUTES, 2, hand, gears, None, MonitorSenses(bundle), feedback)
    known = np.isfinite(course.tau_ext).all(axis=1)
    return {
        "gears": gears.name,
        "hand": hand.name,
        "minutes": FREE_MINUTES,
        "most_tau_ext_nm": np.abs(course.tau_ext[known]).max(axis=0).tolist(),
        "most_torque_nm": float(np.abs(course.torque_nm).max()),
        "ticks_felt": int((np.abs(course.torque_nm) > 0).any(axis=1).sum()),
    }


# --- What a session shows, tables and a picture.


FIRST_S, LAST_S = (3.0, 5.0), (10.0, 12.0)
"""Stretches of a press that lasts 12 s: after the hand has come down, and the end."""


@dataclass(frozen=True)
class Swing:
    """Of one press."""

    first_mm: float
    """Peak to peak of the leader's hand along z in FIRST_S."""
    last_mm: float
    """In LAST_S."""
    given_j: float
    """What the leader's motors gave the hand in all, [J]; negative: they took."""
    most_given_j: float
    """The most that they had given at any time."""
    felt: float
    """Mean torque of the leader in LAST_S as a share of the wall's at the follower, joints that the wall loads."""

    @property
    def settles(self) -> bool:
        """Does not swing at the end: by no more than the hand trembles under the estimate's noise."""
        return self.last_mm < 3.0

    @property
    def grows(self) -> bool:
        """More at the end than at first."""
        return self.last_mm > 1.1 * self.first_mm and not self.settles


def swing(course: Course) -> Swing:
    """Of a press."""
    first, last = (slice(round(a / TICK_S), round(b / TICK_S)) for a, b in (FIRST_S, LAST_S))
    z = 1000 * course.leader_tip[:, 2]
    truth = np.abs(course.outside_nm[last].mean(axis=0))
    loaded = truth > 0.1
    felt = np.abs(course.torque_nm[last].mean(axis=0))[loaded].sum() / max(truth[loaded].sum(), 1e-9)
    given = course.given_j
    return Swing(float(np.ptp(z[first])), float(np.ptp(z[last])), float(given[-1]), float(given.max()), float(felt))


# --- Tables.


def tables(numbers: dict[str, Any]) -> list[str]:
    """Free motion, presses, taps."""
    lines = head("gears | hand | minutes | largest tau_ext, N m | largest leader torque, N m | ticks with feedback")
    for row in numbers["free"]:
        errors = joined(row["most_tau_ext_nm"], by=", ")
        cells = (row["gears"], row["hand"], f"{row['minutes']:g}", errors, f"{row['most_torque_nm']:.3f}")
        lines.append(table_row(*cells, row["ticks_felt"]))
    pairs = "swing, mm: no tank | tank | energy, mJ: no tank | tank | share: no tank | tank"
    lines += ["", *head(f"gears | hand | ticks each way | {pairs}")]
    presses = [(row[:3], [Swing(**measured) for measured in row[3:]]) for row in numbers["press"]]
    for what, pair in presses:
        swings = [f"{one.first_mm:.1f} → {one.last_mm:.1f}" for one in pair]
        given, felt = [f"{1000 * one.most_given_j:.0f}" for one in pair], [f"{100 * one.felt:.0f} %" for one in pair]
        lines.append(table_row(*what, *swings, *given, *felt))
    for k, name in enumerate(("without", "with")):
        swings = [pair[k] for _, pair in presses]
        growing, swinging = sum(one.grows for one in swings), sum(not one.settles for one in swings)
        tapped = 1000 * Swing(**numbers["taps"][k]).most_given_j
        lines += [
            "",
            f"{name} the tank: {growing} of {len(swings)} presses grow, {swinging} swing by 3 mm or more at the end "
            f"(at most {max(one.last_mm for one in swings):.1f} mm); taps get {tapped:.0f} mJ.",
        ]
    return lines


# --- The picture.


LEADER, FOLLOWER = "#1f6fb4", "#c8501e"


def draw(pair: Sequence[Course], wall: Wall, out: Path) -> None:
    """Without and with the tank, side by side: height of both hands, torque of the lift, energy given."""
    figure, axes = plt.subplots(3, 2, figsize=(9.5, 6.2), sharex=True, sharey="row", constrained_layout=True)
    for column, (course, title) in enumerate(zip(pair, ("energy not kept", "energy kept by the tank"), strict=True)):
        t = course.t_s
        height, torque, energy = axes[:, column]
        height.axhspan(-40, 1000 * wall.at_m, color="0.9")
        height.plot(t, 1000 * course.leader_tip[:, 2], color=LEADER, label="leader")
        height.plot(t, 1000 * course.follower_tip[:, 2], color=FOLLOWER, lw=1.2, label="follower")
        height.set_title(title)
        torque.plot(t, course.outside_nm[:, 1], color=FOLLOWER, lw=1.0, label="of the table, at the follower")
        torque.plot(t, course.torque_nm[:, 1], color=LEADER, label="of the leader's motor")
        energy.plot(t, 1000 * course.given_j, color=LEADER)
        energy.axhline(0, color="0.6", lw=0.8)
        energy.set_xlabel("time, s")
        for axis in axes[:, column]:
            axis.grid(color="0.92")
    axes[0, 0].set_ylabel("height of the hand, mm")
    axes[1, 0].set_ylabel("torque of the lift, N m")
    axes[2, 0].set_ylabel("energy the motors gave, mJ")
    axes[2, 0].set_yscale("symlog", linthresh=100)
    axes[0, 0].set_ylim(-20, None)
    for axis in axes[:2, 0]:
        axis.legend(loc="lower left", fontsize=8)
    figure.savefig(out, dpi=110)
    plt.close(figure)


if __name__ == "__main__":
    main()
