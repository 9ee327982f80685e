"""What the training process does next: every decision by a table."""

from __future__ import annotations

import pytest
from tauext_commission.schedule import Facts, next_limits_h, next_step

BUNDLE = {"has_bundle": True, "seconds": 7000.0, "checked_s": 7000.0, "promised_s": 6000.0}


@pytest.mark.parametrize(
    ("facts", "what", "minutes"),
    [
        ({}, "nothing", 0),
        ({"seconds": 9}, "nothing", 0),
        ({"seconds": 10}, "check", 0),
        ({"seconds": 59, "checked_s": 31}, "nothing", 0),
        ({"seconds": 61, "checked_s": 31, "kept_s": 61}, "check", 0),
        ({"seconds": 61, "checked_s": 61, "kept_s": 61}, "train", 1),
        ({"seconds": 61, "checked_s": 61, "kept_s": 59}, "nothing", 0),
        ({"checked_s": 999, "kept_s": 130, "trained_min": 1}, "train", 2),
        ({"checked_s": 999, "kept_s": 500, "trained_min": 1}, "train", 8),
        ({"checked_s": 999, "kept_s": 9999, "trained_min": 64}, "nothing", 0),
        ({"checked_s": 999, "kept_s": 130, "trained_min": 1, "unseen_s": 59}, "nothing", 0),
        ({"checked_s": 999, "kept_s": 130, "trained_min": 1, "unseen_s": 60}, "judge", 0),
        (BUNDLE | {"kept_s": 130, "trained_min": 1, "unseen_s": 20}, "train", 2),
        (BUNDLE, "nothing", 0),
        (BUNDLE | {"unlearned_s": 599}, "nothing", 0),
        (BUNDLE | {"unlearned_s": 600}, "learn", 0),
        (BUNDLE | {"learned_h": 0.24}, "nothing", 0),
        (BUNDLE | {"learned_h": 0.25}, "limits", 0),
        (BUNDLE | {"learned_h": 0.9, "limits_h": 0.5}, "nothing", 0),
        (BUNDLE | {"learned_h": 0.9, "limits_h": 0.5, "is_broken": True}, "limits", 0),
        (BUNDLE | {"promised_s": 3400}, "promise", 0),
        (BUNDLE | {"is_chosen": True, "kept_s": 61, "is_broken": True}, "budget", 0),
        (BUNDLE | {"is_chosen": True, "is_asking": True}, "nothing", 0),
        (BUNDLE | {"is_chosen": True, "is_changed": True}, "nothing", 0),
        (BUNDLE | {"is_morning": True, "unlearned_s": 900}, "morning", 0),
        (BUNDLE | {"is_answered": True, "is_morning": True}, "answer", 0),
        (BUNDLE | {"is_early": True, "is_broken": True, "unlearned_s": 900}, "nothing", 0),
        (BUNDLE | {"is_changed": True, "is_broken": True, "unlearned_s": 900, "is_morning": True}, "nothing", 0),
        (BUNDLE | {"is_changed": True, "kept_s": 61}, "train", 1),
        ({"unlearned_s": 900, "learned_h": 9, "checked_s": 9}, "nothing", 0),
    ],
)
def test_the_most_urgent_work(facts, what, minutes):
    step = next_step(Facts(**facts))
    assert (step.what, step.minutes) == (what, minutes)


def test_limits_follow_more_and_more_hours():
    assert [next_limits_h(hours) for hours in (0, 0.25, 0.3, 16, 24.0, 48, 72.5)] == [0.25, 0.5, 0.5, 24, 48, 72, 96.5]
