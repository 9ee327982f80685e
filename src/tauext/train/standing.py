"""Whether a promise that was made of yesterday's arm may be believed of today's, a joint at a time.

A minute cannot keep a promise of hours. What it can do is to speak against one: the limits were found from a tail,
peaks of the error over a threshold, so many an hour. After the refit, peaks over that threshold, raised as the limits
were, must come no more often than then.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tauext import _core
from tauext.train.held_peaks import REGIONS, separate_peaks
from tauext.train.promise import FalseAlarmBudget, Promise, duration, is_kept

LEAST_MOVED_S = 10.0
"""A joint that moved for less showed too little of its friction."""
STANDS = "stands"


def standing(found: _core.Refit, bundle: _core.Bundle, limits: Mapping[str, Any], joint: int) -> str:
    """`stands`, or why the promise is open for this joint, in words.

    Args:
        bundle: the old one.
        limits: what its provenance says of its limits.
    """
    of_joint = found.joints[joint]
    if not promised(limits):
        return "none was made"
    if of_joint.moved_s < LEAST_MOVED_S:
        return f"open: it moved for {of_joint.moved_s:.1f} s, and {LEAST_MOVED_S:g} s are needed"
    if any(touch.counted and touch.joint == joint for touch in found.touches):
        return "open: its error is over its old limit too often for touches"
    name = bundle.links[joint].joint_name
    usual_nm = (bundle.sliding_limit_nm[joint], bundle.near_stiction_limit_nm[joint])
    for region, limit_nm in zip(REGIONS, usual_nm, strict=True):
        tail = limits["tails"].get(f"{name} {region}")
        if tail is None:
            return "open: the bundle does not say what its limit rests on"
        over = of_joint.limit_factor * tail["threshold_nm"] / limit_nm
        count, hours = peaks_over(found, joint, region, over), found.used_s / 3600
        if not is_kept(count, hours, tail["rate_per_hour"]):
            usual = tail["rate_per_hour"] * hours
            where = region.replace("_", " ")
            return f"open: {count} errors over {over:.0%} of its limit {where}, and {usual:.2g} were usual"
    return STANDS


def promised(limits: Mapping[str, Any]) -> bool:
    """Whether the limits rest on a tail and a budget."""
    return bool(limits.get("tails")) and "promise" in limits


def peaks_over(found: _core.Refit, joint: int, region: str, share: float) -> int:
    """Separate peaks of the left-out error over this share of the limit, while the joint was in the region."""
    left_out = found.left_out
    inside = left_out["free"].astype(bool) & (left_out["near_stiction"][:, joint] == REGIONS.index(region))
    values = np.where(inside, left_out["share"][:, joint], 0.0)
    return len(separate_peaks(values, left_out["t_ns"], floor=share))


def sentence(limits: Mapping[str, Any], used_s: float, open_joints: list[str]) -> str:
    """What of the old promise may be believed, and what it takes to make it anew, in words."""
    if not promised(limits):
        return "The bundle's limits promise nothing, and still do not."
    asked = limits["promise"]["asked"]
    budget = FalseAlarmBudget(asked["alarms"], asked["hours"])
    new = Promise(budget, used_s / 3600, confidence=limits["promise"]["confidence"])
    alone = f"{duration(used_s / 3600, 'down')} alone support 1 in {duration(new.supported.hours, 'down')}"
    take = f"to promise {budget} of today's arm by itself takes {duration(new.needed_hours, 'up')} of calibration"
    if open_joints:
        return f"The promise ({limits['set_for']}) is open at {', '.join(open_joints)}: {alone}; {take}."
    return f"The promise ({limits['set_for']}) stands as far as the old errors are like today's: {alone}; {take}."
