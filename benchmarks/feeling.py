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
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from common import arguments, write_page
from felt.arm import GEARS, HANDS, TICK_S, Gears, Hand, Wall
from felt.session import Course, MonitorSenses, Wish, free_motion, moves, press, run, taps, train
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


# --- What a session shows, the page and its pictures.


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


# --- The page.


HEAD = """# Force feedback at the leader's hand

Everything on this page is simulated; nothing ran on hardware. For how to use leader feedback, see [servo
arms](../../servo-arms.md).

    python benchmarks/feeling.py OUT --seed {seed}

A hand guides a leader arm. A follower arm follows it by position control and reaches a table with a stiffness
of 10 N/mm. The link runs at 50 ticks a second and delays signals by 1 to 3 ticks in each direction.

- **Arms**: the size of an SO-101, three joints, 12-bit encoders.
- **Follower**: STS3215 servos at 7.4 V, as identified by Rhoban's BAM: motor, position loop at P = 16,
  friction that grows with the load.
- **tau_ext**: estimated by tauext from position and goal alone, with a bundle trained on 10 minutes of free
  motion. Its observer adds 50 ms to the delay of the link.
- **Leader**: its motors produce the commanded torque, and the hand carries its weight. Its gears are those of
  the follower (*STS3215*) or have almost no friction (*light*). Light gears are the harder case.
- **Hands**: spring, damper and mass. Two fingers: 50 N/m, 2 N s/m, 0.1 kg; loose: 150, 6, 0.3; firm: 400, 20,
  0.5.
- **Feedback**: gain 1, at most {cap:g} N m, an energy tank of {tank:g} mJ that refills at 2 mW at rest. The
  dead band is {sigmas} standard errors (pan, lift, elbow), 1.5 times the largest value in the validation
  recordings.

## Free motion

Neither training nor the choice of the dead band used this motion. The link delays by 2 ticks in each
direction.

| gears | hand | minutes | largest tau_ext, N m: pan, lift, elbow | largest leader torque, N m | ticks with feedback |
|---|---|---|---|---|---|
"""
AFTER_FREE = """
On two earlier draws, one tick in 12 minutes had feedback, of 5 and 10 mN m. Since then the dead band narrows
no faster than the observer's memory fades. The draws above are different ones.
"""
PRESS = """
## Pressing on the table

Within one second the hand moves its target {deep:.0f} cm below the surface of the table, and holds it there
for 10 s.

- **Swing**: peak to peak of the leader's hand along the vertical, in seconds 3 to 5 → 10 to 12.
- **Energy**: the largest net energy that the leader's motors had delivered to the hand at any time. A real
  wall delivers none.
- **Share**: the leader's torque divided by the table's torque at the end. It is below 100 % because of the
  dead band, and where the torque reaches its cap.

| gears | hand | ticks each way | swing, mm: no tank | tank | energy, mJ: no tank | tank | share: no tank | tank |
|---|---|---|---|---|---|---|---|---|
"""
TAIL = """
{verdict}

![Height of both hands, torque and energy of a press, without and with the tank](press.png)

The figure shows two fingers on light gears with 3 ticks each way. The table is grey. Without the tank the
leader swings up within two seconds.

## Tapping

Two fingers on light gears with 3 ticks each way tap {hz:g} times a second. The motors delivered up to
{taps_free:.0f} mJ without the tank and {taps_kept:.0f} mJ with it. With the tank, feedback after the first
tap is close to zero: a torque that arrives while the hand moves away only delivers energy.

![Height of both hands, torque and energy of taps, without and with the tank](taps.png)
"""


def page(numbers: dict[str, Any]) -> str:
    """README.md."""
    sigmas = ", ".join(f"{value:.1f}" for value in numbers["dead_band_sigmas"])
    text = HEAD.format(seed=numbers["seed"], cap=numbers["cap_nm"], tank=1000 * numbers["tank_j"], sigmas=sigmas)
    for row in numbers["free"]:
        errors = ", ".join(f"{value:.2f}" for value in row["most_tau_ext_nm"])
        torque = f"{row['most_torque_nm']:.3f}" if row["ticks_felt"] else "0"
        text += f"| {row['gears']} | {row['hand']} | {row['minutes']:g} | {errors} | {torque} | {row['ticks_felt']} |\n"
    text += AFTER_FREE + PRESS.format(deep=100 * numbers["below_m"])
    pairs = []
    for gears, hand, delay, *pair in numbers["press"]:
        free, kept = (Swing(**measured) for measured in pair)
        pairs.append((free, kept))
        swings = " | ".join(f"{one.first_mm:.1f} → {one.last_mm:.1f}" for one in (free, kept))
        given = " | ".join(f"{1000 * one.most_given_j:.0f}" for one in (free, kept))
        felt = " | ".join(f"{100 * one.felt:.0f} %" for one in (free, kept))
        text += f"| {gears} | {hand} | {delay} | {swings} | {given} | {felt} |\n"
    taps_free, taps_kept = (1000 * Swing(**measured).most_given_j for measured in numbers["taps"])
    return text + TAIL.format(verdict=verdict(pairs), hz=numbers["tap_hz"], taps_free=taps_free, taps_kept=taps_kept)


def verdict(pairs: list[tuple[Swing, Swing]]) -> str:
    """The summary of the table of presses."""
    (free, kept), n = zip(*pairs, strict=True), len(pairs)
    swinging, growing = sum(not one.settles for one in free), sum(one.grows for one in free)
    with_tank = sum(not one.settles for one in kept)
    grown = sum(one.grows for one in kept)
    worst = max(one.last_mm for one in kept)
    return (
        f"With the tank, {grown or 'none'} of {n} presses grow, and {with_tank or 'none'} still swing by 3 mm or more "
        f"at the end (at most {worst:.1f} mm). Without\nit, {swinging} of {n} keep swinging, {growing} of them more "
        "than at first. Only the torque cap bounds them."
    )


# --- The pictures.


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
