"""Whether a test leaves standing what a bundle's calibration promised."""

from __future__ import annotations

from collections.abc import Mapping

from tauext.train.promise import is_consistent, is_kept, rate_interval


def promised_per_hour(provenance: Mapping) -> float | None:
    """False collisions an hour that the bundle's limits are set for, [1/h]; None where they come from no budget.

    What was asked; where the calibration was too short for that, the smallest budget that it supports.
    """
    promise = (provenance.get("limits") or {}).get("promise")
    if promise is None:
        return None
    return promise["asked" if promise["supported"] else "supported_budget"]["rate_per_hour"]


def check_promise(promised: float | None, false_collisions: int, hours: float) -> dict:
    """Entries of `free_motion` in results.json: the promised rate, the interval that the test found, and the verdicts.

    promise_consistent: the promised rate lies in the interval of 95 %; promise_kept: so many false collisions or more
    are no surprise at that rate. null without a promise, or without healthy hours.
    """
    known = promised if promised is not None and hours > 0 else None
    return {
        "promised_per_hour": promised,
        "false_collisions_interval_per_hour": list(rate_interval(false_collisions, hours)) if hours > 0 else None,
        "promise_consistent": is_consistent(false_collisions, hours, known) if known is not None else None,
        "promise_kept": is_kept(false_collisions, hours, known) if known is not None else None,
    }
