"""A hand that leads a follower arm against a table feels it, and nothing swings up.

    python benchmarks/feeling.py OUT [--seed 0]

Leader, wire and follower are simulated: two arms of an SO-101's size in MuJoCo (felt/arm.py), servos as they were
identified (felt/arm.py), 50 ticks a second, 1 to 3 ticks of delay each way, a table of 10 N/mm. tau_ext is tauext's
own: OUT/data gets free motion of the follower with its bundle; what is there is used again. OUT/README.md gets the
tables, OUT/press.png and OUT/taps.png the pictures, OUT/feeling.json the numbers; those of docs/results/feeling are
one run of these. Some 4 minutes of one core.
"""

from __future__ import annotations

import json
from dataclasses import asdict

import numpy as np
from common import arguments, write_page
from felt.arm import GEARS, HANDS, Gears, Hand, Wall
from felt.pages import draw, page, swing
from felt.session import Course, MonitorSenses, Wish, free_motion, moves, press, run, taps, train

from tauext._core import Bundle
from tauext.monitor.leader_feedback import (
    EnergyTank,
    FeedbackSettings,
    LeaderFeedback,
    TankSettings,
    free_motion_sigmas,
)
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
    parser = arguments(__doc__, "out")
    parser.add_argument("--seed", type=int, default=0, help="of the motion: training, validation and test")
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
    (options.out / "feeling.json").write_text(json.dumps(numbers, indent=1) + "\n")
    draw(courses[GEARS[1].name, HANDS[0].name, 3], TABLE, options.out / "press.png")
    draw(tapped, TABLE, options.out / "taps.png")
    write_page(options.out / "README.md", page(numbers))


def press_session(
    wish: Wish, bundle: Bundle, settings: FeedbackSettings, hand: Hand, gears: Gears, delay: int, kept: bool
) -> Course:
    """A session against the table, whose energy is kept or only counted."""
    feedback = LeaderFeedback(3, settings)
    if not kept:
        feedback.tank = EnergyTank(TankSettings(1e9, np.zeros(3), settings.acceleration_rad_s2, 0.0, 1.0, 1.0))
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


if __name__ == "__main__":
    main()
