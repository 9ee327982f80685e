"""What matters first, in plain words: what was tested, what one method found, what it cannot see, what to do next."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

from tauext.check.rejected import WORTH_A_WARNING
from tauext.report.results import EvaluatedBundle, Numbers, Results
from tauext.report.tables import milliseconds, number

MOST_FALSE_PER_HOUR = 1.0
"""At so many false alarms methods are compared by what they miss."""
NO_ALARMS_BELOW = 3.0
"""Without one false alarm in T hours the rate is below 3/T with 95 %: exp(-3) = 0.05."""
RELIABLE = 0.9
"""Share of collisions of one strength that raise an alarm, from which on they count as seen."""
FEW_HOURS = 1.0
"""Fewer of test motion say little about an hour."""
MOST_JOINTS = 8
"""Whose limits are named one by one."""
CONTACT_KINDS = {"pads": "by padded bodies", "pulses": "by force pulses"}


@dataclass(frozen=True)
class Glance:
    """A number and what it means."""

    value: str
    means: str


@dataclass(frozen=True)
class Step:
    """What to do, and by which command; empty: by none."""

    words: str
    command: str = ""


@dataclass(frozen=True)
class FirstScreen:
    """Its parts in their order on the page."""

    tested: str
    method: str
    """Of which the numbers are; by its label."""
    why: str
    """It is shown."""
    glances: tuple[Glance, ...]
    unseen: tuple[str, ...]
    steps: tuple[Step, ...]


def first_screen(results: Results) -> FirstScreen:
    """Of the method that misses least."""
    bundle = shown_bundle(results)
    several = len(results.bundles) > 1
    return FirstScreen(
        tested=tested(results, bundle),
        method=bundle.label,
        why=f"of {len(results.bundles)} that were compared it misses least; the others stand below" if several else "",
        glances=(found(bundle), false_alarms(bundle), delay(bundle), limits(results, bundle)),
        unseen=tuple(unseen(results, bundle)),
        steps=tuple(steps(results, bundle)),
    )


def shown_bundle(results: Results) -> EvaluatedBundle:
    """The one that misses fewest collisions at limits scaled to at most one false alarm an hour, and errs least."""

    def rank(bundle: EvaluatedBundle) -> tuple[float, int, float]:
        points = bundle.measured.missed_curve
        missed = [p.missed for p in points if p.false_per_hour is not None and p.false_per_hour <= MOST_FALSE_PER_HOUR]
        latched = bundle.measured.latched
        errors = [error for error in bundle.l1_nm if error is not None]
        return min(missed, default=math.inf), -(latched.latched if latched else 0), sum(errors)

    return min(results.bundles, key=rank)


def tested(results: Results, bundle: EvaluatedBundle) -> str:
    """One sentence."""
    motion = f"{span(bundle.hours)} of motion in which nothing touched the arm" if bundle.hours else "no free motion"
    kinds = Counter(collision.kind for collision in results.collisions.values())
    told = [f"{count} {CONTACT_KINDS[kind]}" for kind, count in sorted(kinds.items()) if kind in CONTACT_KINDS]
    known = f" ({', '.join(told)})" if sum(kinds[kind] for kind in CONTACT_KINDS) == kinds.total() and told else ""
    touches = f"{plural(kinds.total(), 'collision')}{known}" if kinds else "no collision"
    return f"Tested on {motion}, and on {touches}; training saw none of it.{rejected_words(bundle)}"


def rejected_words(bundle: EvaluatedBundle) -> str:
    """A sentence about the time in which nothing could be detected; empty where it is next to nothing."""
    if not bundle.rejected_share or bundle.rejected_share <= WORTH_A_WARNING:
        return ""
    causes = f" ({', '.join(bundle.rejected_causes)})" if bundle.rejected_causes else ""
    return (
        f" The monitor was not healthy for {bundle.rejected_share:.0%} of the time{causes}; nothing is detected then."
    )


def found(bundle: EvaluatedBundle) -> Glance:
    latched = bundle.measured.latched
    if latched is None or not latched.collisions:
        return Glance("–", "no collisions were tried, so nobody knows how many are found")
    strong = f"; of the {latched.strong} strong ones, which every method must find, {latched.strong_latched}"
    if latched.unhealthy:
        why = f"; {latched.unhealthy} came while the monitor was not healthy, and nothing is detected"
    else:
        why = "" if latched.latched else "; none pushed a joint over its limit for as long as an alarm takes"
    return Glance(
        f"{latched.latched} of {latched.collisions}",
        "collisions of every strength raised an alarm" + (strong if latched.strong else "") + why,
    )


def false_alarms(bundle: EvaluatedBundle) -> Glance:
    false = bundle.measured.false_collisions
    if false.count is None or not bundle.hours:
        return Glance("–", "false alarms: no free motion was tested")
    if false.count == 0:
        rate = f"fewer than {plain(NO_ALARMS_BELOW / bundle.hours)} an hour, as far as so short a test can tell"
        return Glance(f"0 in {span(bundle.hours)}", f"false alarms while nothing touched the arm: {rate}")
    rate = f"{plain(false.count / bundle.hours)} an hour"
    if false.low is not None and false.high is not None:
        rate += f" (the truth lies between {plain(false.low)} and {plain(false.high)}, 95 %)"
    return Glance(f"{false.count:,} in {span(bundle.hours)}", f"false alarms while nothing touched the arm: {rate}")


def delay(bundle: EvaluatedBundle) -> Glance:
    latched = bundle.measured.latched
    if latched is None or latched.onset_median_s is None:
        return Glance("–", "delay from the touch to the alarm: not available")
    most = f"; 95 % within {milliseconds(latched.onset_p95_s)} ms" if latched.onset_p95_s is not None else ""
    return Glance(
        f"{milliseconds(latched.onset_median_s)} ms",
        f"from the first touch to the alarm, for half of them{most} (soft touches take long to grow)",
    )


def limits(results: Results, bundle: EvaluatedBundle) -> Glance:
    words = "push on a joint that raises an alarm while it moves" + (
        " in the usual way; the limit follows the motion" if bundle.limits_move else ""
    )
    near = joint_list(results, bundle.limit_near_stiction_nm)
    at_rest = f"; at rest or creeping: {near}" if near else ""
    return Glance(joint_list(results, bundle.limit_sliding_nm) or "–", f"{words}{at_rest}")


def unseen(results: Results, bundle: EvaluatedBundle) -> list[str]:
    """What it does not see, with what the test showed of it."""
    lines = ["Touches that push every joint by less than its limit." + weak_words(results, bundle)]
    lines.append(
        "Forces that turn no joint: along a link towards the base, or through a joint's axis. Encoders and motors do "
        "not feel them."
    )
    lines.append(
        "A load that training did not have: a new tool or workpiece looks like a touch that stays, until the monitor "
        "is told of it or the arm is trained with it."
    )
    lines.append("The first second after a start, while the filters fill.")
    return lines


def weak_words(results: Results, bundle: EvaluatedBundle) -> str:
    """Of the collisions below the strength from which on they are seen."""
    bins = [one for one in bundle.measured.by_strength if one.collisions]
    dim = [k for k, one in enumerate(bins) if one.latched < RELIABLE * one.collisions]
    if not dim or bins[dim[-1]].high_nm is None:
        return ""
    below = bins[: dim[-1] + 1]
    missed = sum(one.collisions - one.latched for one in below)
    total = sum(one.collisions for one in below)
    return f" Of {plural(total, 'collision')} below {below[-1].high_nm:g} Nm it missed {missed}."


def steps(results: Results, bundle: EvaluatedBundle) -> list[Step]:
    """What to do next."""
    false, lines = bundle.measured.false_collisions, list[Step]()
    if rejected_words(bundle):
        words = "Find out why the monitor rejects so much, record or import anew, and evaluate again:"
        lines.append(Step(words, "tauext check"))
    if false.promised is None:
        words = (
            "The limits promise nothing about false alarms. Record an hour or more of the arm's own work with nothing "
        )
        lines.append(Step(f"{words}touching it, and set them for a rate that you can bear:", "tauext calibrate"))
    elif false.kept is False:
        words = (
            f"At most {plain(false.promised)} false alarms an hour were promised, and the test had more. Find out what "
        )
        lines.append(
            Step(f"{words}differs (load, speed, temperature), record it, and set limits anew:", "tauext calibrate")
        )
    if bundle.hours is not None and bundle.hours < FEW_HOURS:
        rate = plain(NO_ALARMS_BELOW / bundle.hours)
        words = f"{span(bundle.hours)} of test motion can show no rate below {rate} an hour: record more before you "
        lines.append(Step(f"{words}trust it."))
    if not results.collisions:
        lines.append(Step("Touch the arm while it is recorded, and mark when: else nobody knows what is found."))
    else:
        lines.append(Step("Look at what was missed: every collision has its row below, and the traces show it."))
    command = f"tauext run {bundle.name}.tauext RECORDING.parquet --acknowledge-after-s 1"
    lines.append(Step("Watch it on a recording:", command))
    lines.append(Step("Keep the arm's own safety functions: this is none."))
    return lines


def joint_list(results: Results, values: Numbers) -> str:
    """`joint1 1.3, joint2 0.5 Nm`; of many joints their range; empty where no number exists."""
    known = [(name, k) for k, name in enumerate(results.joints) if values[k] is not None]
    if not known:
        return ""
    if len(known) > MOST_JOINTS:
        several = [value for value in values if value is not None]
        return f"{number(min(several), 1)} to {number(max(several), 1)} {results.unit}"
    apart = "\N{NO-BREAK SPACE}"  # of a number and its name or unit
    return ", ".join(f"{name}{apart}{number(values[k], 1)}" for name, k in known) + f"{apart}{results.unit}"


def span(hours: float | None) -> str:
    """A time in words: 6 seconds, 6 minutes, 10.2 hours."""
    if hours is None:
        return "an unknown time"
    if hours < 1 / 60:
        return plural(round(3600 * hours), "second")
    if hours < 1:
        return plural(max(round(60 * hours), 1), "minute")
    return f"{hours:.1f} hours"


def plain(value: float) -> str:
    """Two digits, without an exponent."""
    return f"{value:.0f}" if value >= 10 else f"{value:.2g}"


def plural(count: int, word: str) -> str:
    return f"{count:,} {word}{'' if count == 1 else 's'}"
