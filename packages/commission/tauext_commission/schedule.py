"""What the training process does next: a pure function of what the folder holds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from tauext_commission.motion_recorder import SCHEDULE_MIN

LEAST_TEST_S = 60.0
"""Motion outside of its training that judges a bundle, [s]."""
LIMITS_AT_H = (0.25, 0.5, 1, 2, 3, 4, 6, 8, 12, 16, 24, 48)
"""Hours of learned calibration after which limits are found again; then after each further day."""
DAY_H = 24.0
CHECKS_S = (10.0, 30.0, 60.0, 180.0, 600.0, 1800.0, 3600.0)
"""Received motion after which the stream is checked, [s]."""
PROMISE_S = 3600.0
"""Time between two comparisons of the promise with what happened, [s] of received motion."""

What = Literal["check", "answer", "train", "judge", "learn", "limits", "promise", "morning", "budget", "nothing"]


@dataclass(frozen=True)
class Facts:
    """State of a folder."""

    seconds: float = 0.0
    """Received motion, [s]."""
    kept_s: float = 0.0
    """Training and test motion, [s]."""
    checked_s: float = 0.0
    """Received motion at the newest check, [s]."""
    trained_min: float = 0.0
    """Minutes of the schedule that the newest training had, also one that failed."""
    unseen_s: float | None = None
    """Motion outside the training of the bundle that waits to be judged, [s]; None: none waits."""
    has_bundle: bool = False
    """Whether a bundle is in charge."""
    unlearned_s: float = 0.0
    """Calibration motion whose peaks can be learned, [s]."""
    learned_h: float = 0.0
    """Hours of the learned calibration."""
    limits_h: float = 0.0
    """Hours that the newest limits from calibration follow from."""
    is_broken: bool = False
    """Whether the promise of the bundle in charge is broken, and its false alarms are learned."""
    promised_s: float = 0.0
    """Received motion at the newest comparison of the promise, [s]."""
    is_asking: bool = False
    """Whether a person is asked about a change of the arm; nothing is learned meanwhile."""
    is_answered: bool = False
    """Whether a person has answered the question."""
    is_changed: bool = False
    """Whether the bundle in charge is of the arm before a change that may be learned: only a new bundle helps."""
    is_chosen: bool = False
    """Whether a person has chosen a budget of false alarms that the bundle in charge has not, but can take."""
    is_early: bool = False
    """Whether a pause has ended and the first strokes after it are too short to be compared: alarms may come from a
    changed arm, and limits must not follow them."""
    is_morning: bool = False
    """Whether a pause has ended and the first strokes after it are not compared yet."""


@dataclass(frozen=True)
class Step:
    """One piece of work."""

    what: What
    minutes: float = 0.0


LEARN_S = 600.0
"""Least calibration motion that is worth a pass, [s]."""


def next_step(facts: Facts) -> Step:
    """The most urgent work: a bundle that waits, then the schedule, then limits and promises."""
    if facts.is_answered:
        return Step("answer")
    due_s = max((at for at in CHECKS_S if at <= facts.seconds), default=0.0)
    if due_s > facts.checked_s:
        return Step("check")
    if facts.unseen_s is not None and facts.unseen_s >= LEAST_TEST_S:
        return Step("judge")
    if facts.is_asking:
        return Step("nothing")
    if facts.is_chosen and not facts.is_changed:
        return Step("budget")
    due = max((minutes for minutes in SCHEDULE_MIN if 60 * minutes <= facts.kept_s), default=0)
    if due > facts.trained_min and (facts.unseen_s is None or facts.has_bundle):
        return Step("train", due)
    if not facts.has_bundle or facts.is_changed:
        return Step("nothing")
    if facts.is_morning:
        return Step("morning")
    if facts.is_early:
        return Step("nothing")
    if facts.unlearned_s >= LEARN_S:
        return Step("learn")
    if facts.is_broken or facts.learned_h >= next_limits_h(facts.limits_h):
        return Step("limits")
    if facts.seconds >= facts.promised_s + PROMISE_S:
        return Step("promise")
    return Step("nothing")


def next_limits_h(limits_h: float) -> float:
    """Hours of calibration that are worth new limits."""
    return next((hours for hours in LIMITS_AT_H if hours > limits_h * (1 + 1e-9)), limits_h + DAY_H)
