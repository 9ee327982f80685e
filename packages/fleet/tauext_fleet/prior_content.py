"""What is in a fleet prior: its arms in a table, and what the next arm begins with."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tauext.errors import ConfigError
from tauext_fleet.fleet_prior import FleetDays, FleetErrors, FleetPrior, load_fleet_prior

Content = dict[str, Any]
"""Values by identifiers that end in their units, as `tauext show` prints them."""
ODD = 0.5
"""An arm's joint is the odd one whose trust is below this."""


def table(facts: dict) -> str:
    """Arms by joints: friction by the fleet's; * marks a joint that is not like the others'."""
    joints = list(facts["spread"])
    head = ["arm", "minutes", *joints, "links"]
    rows = [head]
    for one in facts["arms"]:
        cells = [
            "–" if factor is None else f"{factor:.2f} ± {error:.2f}{' *' * (one['trust'][joint] < ODD)}"
            for joint, (factor, error) in one["friction"].items()
        ]
        rows.append([one["name"], f"{one['minutes']:.1f}", *cells, "*" * (one["trust"]["links"] < ODD)])
    rows.append(["fleet, Nm", "", *(f"{of['friction_nm']:.3g}" for of in facts["spread"].values()), ""])
    spreads = [of["spread"] for of in facts["spread"].values()]
    rows.append(["arms differ by", "", *("–" if spread is None else f"{spread:.0%}" for spread in spreads), ""])
    widths = [max(len(row[k]) for row in rows) for k in range(len(head))]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)


def prior_content(file: Path) -> Content:
    """Content of a fleet prior's file; `table` is what `tauext fleet prior` prints at its end.

    Raises:
        ConfigError: the file is no fleet prior, or damaged.
    """
    prior = load_fleet_prior(file)
    try:
        return described(file, prior)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, ZeroDivisionError) as error:
        why = " ".join(f"{type(error).__name__}: {error}".split())
        raise ConfigError(f"{file}: its data of the arms is damaged ({why}); `tauext fleet prior` makes one") from error


def described(file: Path, prior: FleetPrior) -> Content:
    """Content of a prior that was read; KeyError, TypeError or ValueError where data are missing."""
    facts, kind, names = prior.facts, prior.type, list(prior.type.joints)
    odd = {one["name"]: [name for name, share in one["trust"].items() if share < ODD] for one in facts["arms"]}
    return {
        "fleet_prior": file.name,
        "table": table(dict(facts)).splitlines(),
        "arms": len(facts["arms"]),
        "minutes": round(sum(float(one["minutes"]) for one in facts["arms"]), 3),
        "not_like_the_others": {name: parts for name, parts in odd.items() if parts},
        "left_out": dict(facts["left_out"]),
        "joints": names,
        "model_case": kind.case,
        "sample_rate_hz": kind.rate_hz,
        "torque_is": kind.torque_timing,
        "takes_tau_in": dict(zip(names, (unit.replace("newton_metre", "N m") for unit in kind.units), strict=True)),
        "gain_per_s": prior.gain_per_s,
        "presliding_widths_rad": list(prior.widths_rad),
        "terms": {joint: dict(term_counts(group)) for joint, group in zip(names, prior.own, strict=True)},
        "usual_error_nm": dict(zip(names, prior.weights.error_nm.tolist(), strict=True)),
        "errors_last_s": dict(zip(names, prior.weights.memory_s.tolist(), strict=True)),
        "weight_of_a_row": prior.weights.trust,
        "error_after_a_minute_by_that_with_all": dict(facts["after_a_minute"]),
        **describe_errors(prior.errors, names),
        **describe_days(prior.days, names),
        "made_by": {key: facts.get(key) for key in ("command", "version", "seed", "machine")},
        "made_from": {name: str(data) for name, data in facts["settings"]["data"].items()},
        "sha256": prior.sha256,
    }


def term_counts(group: Any) -> Iterator[tuple[str, int]]:
    """How many of a joint's terms are of each kind."""
    kinds = [term.kind.name for term in group]
    return ((kind, kinds.count(kind)) for kind in dict.fromkeys(kinds))


def describe_errors(errors: FleetErrors | None, joints: list[str]) -> Content:
    """Basis of the next arm's limits: errors of the fleet's arms, or its own minute alone."""
    if errors is None:
        return {"limits_of_the_next_arm": "follow from its own minute: no three arms showed more than a minute"}
    return {
        "limits_of_the_next_arm": (
            f"rest on the errors in {errors.hours:.3g} h of {errors.arms} arms, each taken for a new one with "
            f"{errors.minutes:g} min of its own"
        ),
        "limits_sliding_nm": dict(zip(joints, errors.sliding_limit_nm.tolist(), strict=True)),
        "limits_near_stiction_nm": dict(zip(joints, errors.near_stiction_limit_nm.tolist(), strict=True)),
        "factor_for_different_arms": errors.facts["arms_factor"],
        "collision_hold_s": errors.hold_s,
        "limits_promise": errors.facts["sentence"],
    }


def describe_days(days: FleetDays | None, joints: list[str]) -> Content:
    """How much the friction of one arm differs between recordings, which `refit --like` goes by."""
    if days is None:
        return {"friction_change_share": None}
    shares = {joint: math.sqrt(days.covariance[j, j]) for j, joint in enumerate(joints)}
    return {"friction_change_share": shares, "friction_change_from": {"recordings": days.recordings, "arms": days.arms}}
