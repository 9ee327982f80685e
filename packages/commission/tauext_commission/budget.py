"""What a bundle's limits are set for, what its data prove, and the budget of false alarms that a person chooses.

Bundles are trained for 1 false alarm in 8 h, or a rarer budget that a person chooses, so that their table of budgets
always begins there. A budget that allows more takes its share of the limits from this table.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.config import AlarmConfig
from tauext.errors import ConfigError, TauextError
from tauext.fit.tail import FalseAlarmBudget, at_most_per_hour, duration, promised_per_hour
from tauext.train.asked_limits import RAREST_PER_HOUR
from tauext_commission.history_file import bundle_file
from tauext_commission.journal import read

BUDGET = "budget"
"""Kind of the journal's line of a chosen budget."""
ALIKE = 1e-6
"""Relative difference up to which two rates are the same."""

# --- What a bundle's limits are set for.


class Promise(NamedTuple):
    """The rate of false alarms that a bundle's limits are set for, and the rate that its data prove, [1/h]."""

    per_hour: float | None = None
    """None: the limits have no budget."""
    at_most_per_hour: float | None = None
    """Upper end of the stated interval; `per_hour` where the data prove the budget."""
    between_per_hour: Sequence[float] | None = None
    """Interval of the rate of extrapolated limits; None: they are not extrapolated."""
    probability: float = 0.0
    """Of the interval."""
    hours: float = 0.0
    """Free motion from which the limits follow."""
    proved_per_hour: float | None = None
    """Smallest rate that so many hours can prove; None: they prove none."""
    budgets: Sequence[Mapping[str, Any]] = ()
    """Rates with their share of these limits and the pushes that they notice, the rarest first."""

    @classmethod
    def of_limits(cls, limits: Mapping[str, Any]) -> Promise:
        """From the facts of a bundle's limits; KeyError, TypeError or ValueError where they are damaged."""
        rate, at_most, proof = promised_per_hour(limits), at_most_per_hour(limits), limits.get("promise") or {}
        if rate is None or at_most is None or not 1e-9 < rate <= at_most < 1e9:
            return cls()
        found = limits.get("extrapolated") or {}
        between = [min(float(found["between_per_hour"][0]), rate), at_most] if found else None
        hours = float(found["hours"] if found else proof["calibration_hours"])
        proved = float(proof["supported_budget"]["rate_per_hour"]) if proof else None
        budgets = tuple(map(row_of, limits.get("budgets", ())))
        return cls(rate, at_most, between, float(found.get("probability", 0.0)), hours, proved, budgets)

    def words(self) -> str:
        """What the limits are set for, and what the data prove, in plain sentences."""
        return f"{self.set_words()} {self.proved_words()}".strip()

    def set_words(self) -> str:
        """What the limits are set for, in a sentence."""
        if self.per_hour is None:
            return "The thresholds have no target false alarm rate."
        rate, hours = duration(1 / self.per_hour), duration(self.hours, "down")
        if self.between_per_hour is None:
            return f"Set for one false alarm in {rate}, as {hours} of free motion prove."
        interval = f"{self.interval('between ')} ({100 * self.probability:.3g} %)"
        return f"Set for one false alarm in {rate}, extrapolated from {hours}: {interval}."

    def proved_words(self) -> str:
        """What the data prove, in a sentence; empty where they prove no less than the limits are set for."""
        if self.per_hour is None or self.between_per_hour is None:
            return ""
        if self.proved_per_hour is None:
            return "So short a time alone proves nothing."
        if self.proved_per_hour <= self.per_hour * (1 + ALIKE):
            return ""
        return f"The data alone prove {once_in(self.proved_per_hour, 'down')}."

    def short(self) -> str:
        """`1 in 8 h (1 in 50 minutes to 1 in 60 h)`."""
        if self.per_hour is None:
            return "no rate"
        return once_in(self.per_hour) + (f" ({self.interval()})" if self.between_per_hour is not None else "")

    def interval(self, before: str = "") -> str:
        """`1 in 50 minutes to 1 in 60 h`; with `between ` before it, `and` in its middle."""
        assert self.between_per_hour is not None
        low, high = self.between_per_hour
        soonest = once_in(high, "down")
        if low < RAREST_PER_HOUR:
            return f"{soonest} or rarer"
        return f"{before}{soonest} {'and' if before else 'to'} {once_in(low)}"

    def numbers(self) -> dict[str, Any]:
        """Entries of a line of the history."""
        beside = {"between_per_hour": self.between_per_hour, "proved_per_hour": self.proved_per_hour}
        return {"promised_per_hour": self.per_hour} | beside


def row_of(entry: Mapping[str, Any]) -> dict[str, Any]:
    """Row of a table of budgets with values of the right types; KeyError, TypeError or ValueError where damaged."""
    low, high = map(float, entry["between_per_hour"])
    row = {name: float(entry[name]) for name in ("per_hour", "share_of_limits")}
    if not all(1e-9 < one < 1e9 for one in row.values()):
        raise ValueError(row)
    pushes = {str(place): float(push) for place, push in entry["push_n"].items()}
    return row | {"text": str(entry["text"]), "between_per_hour": [low, high], "push_n": pushes}


def once_in(per_hour: float, rounding: Any = "nearest") -> str:
    """A rate as `1 in 8 h`."""
    return f"1 in {duration(1 / per_hour, rounding)}"


def limits_of(bundle: _core.Bundle) -> dict[str, Any]:
    """Facts of a bundle's limits; empty where its provenance has none."""
    try:
        return dict(json.loads(bundle.provenance or "{}").get("limits") or {})
    except (ValueError, AttributeError, TypeError):
        return {}


def promise_of(folder: Path, bundle: object) -> Promise:
    """What the limits of a bundle of this folder are set for; empty where it is missing or of another program."""
    if (path := bundle_file(folder, bundle)) is None:
        return Promise()
    try:
        return Promise.of_limits(limits_of(load_bundle(path)))
    except (TauextError, ValueError, KeyError, TypeError, AttributeError, IndexError):
        return Promise()


# --- The budget that a person chooses.


def chosen_alarm(folder: Path) -> AlarmConfig:
    """Settings of an alarm with the budget that was chosen last in this folder."""
    lines = read(folder).kinds.get(BUDGET)
    return AlarmConfig(float(lines[-1]["false_alarms"]), float(lines[-1]["in_hours"])) if lines else AlarmConfig()


def rate_of(alarm: AlarmConfig) -> float:
    """Permitted false alarms an hour."""
    return alarm.false_alarms / alarm.in_hours


def alarm_to_train(folder: Path) -> AlarmConfig:
    """Settings for trainings: the chosen budget, or the usual one if that is rarer."""
    return min(AlarmConfig(), chosen_alarm(folder), key=rate_of)


def alarm_in(budgets: Sequence[Mapping[str, Any]], per_hour: float) -> AlarmConfig:
    """Settings with a budget of this table.

    Raises:
        ConfigError: the table has no such budget.
    """
    if row := next((one for one in budgets if is_alike(one["per_hour"], per_hour)), None):
        return AlarmConfig(in_hours=1 / row["per_hour"])
    choices = ", ".join(f"{one['per_hour']:g} ({one['text']})" for one in budgets)
    rule = f"one of {choices}" if choices else "left as it is: there is no table of target false alarm rates yet"
    raise ConfigError(f"false alarms an hour = {per_hour:g} must be {rule}")


def is_alike(a: float | None, b: float | None) -> bool:
    """Whether two rates are the same."""
    return a is not None and b is not None and math.isclose(a, b, rel_tol=ALIKE)


def row_at(budgets: Sequence[Mapping[str, Any]], per_hour: float) -> dict[str, Any] | None:
    """Row of a table of budgets at this rate, also between two rows; None: the rate is beyond the table."""
    rates = [one["per_hour"] for one in budgets]
    if not rates or not rates[0] * (1 - ALIKE) <= per_hour <= rates[-1] * (1 + ALIKE):
        return None
    shares = [one["share_of_limits"] for one in budgets]
    share = float(np.interp(math.log(per_hour), np.log(rates), shares))
    ends = [np.log(np.maximum([one["between_per_hour"][k] for one in budgets], 1e-30)) for k in (0, 1)]
    between = [float(np.exp(np.interp(math.log(per_hour), np.log(rates), end))) for end in ends]
    pushes = {place: push * share / shares[0] for place, push in budgets[0].get("push_n", {}).items()}
    text = str(FalseAlarmBudget(1, 1 / per_hour))
    return {"text": text, "per_hour": per_hour, "between_per_hour": between, "share_of_limits": share, "push_n": pushes}


UNSCALED = "unscaled"
"""Entry of limits with another budget than in training: facts and contact limits as they were."""
RAISED = "raised"
"""Entry of a bundle's limits: factors on the limits from calibration, by joint, with which a promise was repaired."""


def can_take(promise: Promise, per_hour: float) -> bool:
    """Whether limits can be changed to this rate, and are not set for it yet."""
    rates = (per_hour, promise.per_hour or 0.0)
    return not is_alike(*rates) and all(row_at(promise.budgets, one) for one in rates)


def put_budget(bundle: _core.Bundle, limits: Mapping[str, Any], per_hour: float) -> dict[str, Any]:
    """Set a bundle's limits for another rate of its table of budgets; returns the facts of its limits.

    Contact limits are those of training, and never above the collision limits.

    Args:
        limits: facts of the limits; can_take() is true.
    """
    now = row_at(limits["budgets"], Promise.of_limits(limits).per_hour or 0.0)
    row = row_at(limits["budgets"], per_hour)
    assert now is not None and row is not None
    ratio = row["share_of_limits"] / now["share_of_limits"]
    own: dict[str, Any] = dict(limits.get(UNSCALED) or {key: one for key, one in limits.items() if key != "budgets"})
    for region in ("sliding", "near_stiction"):
        name, collision = f"contact_{region}_limit_nm", ratio * np.array(getattr(bundle, f"{region}_limit_nm"))
        kept = own.setdefault(name, [one if math.isfinite(one) else None for one in getattr(bundle, name)])
        contact = [math.inf if one is None else one for one in kept]
        setattr(bundle, f"{region}_limit_nm", collision.tolist())
        setattr(bundle, name, np.minimum(contact, collision).tolist())
    rows = [one | {"share_of_limits": one["share_of_limits"] / row["share_of_limits"]} for one in limits["budgets"]]
    found = own | {"budgets": rows, UNSCALED: own}
    if RAISED in limits:
        found[RAISED] = limits[RAISED]
    promise = Promise.of_limits(own)
    if (trained := row_at(limits["budgets"], promise.per_hour or 0.0)) and not is_alike(promise.per_hour, per_hour):
        share = row["share_of_limits"] / trained["share_of_limits"]
        set_for = {"per_hour": per_hour, "between_per_hour": row["between_per_hour"], "hours": promise.hours}
        found["extrapolated"] = {"probability": 0.9, **own.get("extrapolated", {}), **set_for}
        for name, times in (("factor", share), ("largest_seen", 1 / share)):
            if name in found["extrapolated"]:
                found["extrapolated"][name] *= times
        found |= {"set_for": row["text"], "hold_s": bundle.hold_s}
        found.pop("other_motion", None)  # a test of the other limits
        found["one_moment"] = [
            one | {key: share * one[key] for key in ("limit_nm", "without_nm")} for one in own.get("one_moment", ())
        ]
        found["sentence"] = Promise.of_limits(found).words()
    return found
