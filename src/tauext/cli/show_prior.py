"""`tauext show` of a fleet prior: its arms in a table, and what the next arm would be told."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from tauext.errors import ConfigError
from tauext.files.place import Place

if TYPE_CHECKING:
    from tauext.fit.fleet_prior import FleetDays, FleetErrors, FleetPrior

Told = dict[str, Any]


def describe_fleet_prior(file: Place) -> Told:
    """Plain content of a fleet prior's file; `table` is what `tauext fleet prior` prints at its end.

    Raises:
        ConfigError: it is none, or what it says of its arms is damaged.
    """
    from tauext.fit.fleet_prior_file import load_fleet_prior

    prior = load_fleet_prior(file)
    try:
        return described(file, prior)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, ZeroDivisionError) as error:
        why = " ".join(f"{type(error).__name__}: {error}".split())
        raise ConfigError(
            f"{file}: what it says of its arms is damaged ({why}); `tauext fleet prior` makes one"
        ) from error


def described(file: Place, prior: FleetPrior) -> Told:
    """The same of what was read; KeyError, TypeError or ValueError of whatever is missing."""
    from tauext.fleet.summary import ODD, table

    facts, kind = prior.facts, prior.type
    odd = {one["name"]: parts for one in facts["arms"] if (parts := odd_parts(one["trust"], ODD))}
    per_joint = list(kind.joints)
    content: Told = {
        "fleet prior": file.name,
        "table": table(dict(facts)).splitlines(),
        "arms": len(facts["arms"]),
        "minutes": round(sum(float(one["minutes"]) for one in facts["arms"]), 3),
        "not like the others": odd or "none",
        "left out": dict(facts["left_out"]) or "none",
        "joints": per_joint,
        "model case": kind.case,
        "sample rate [Hz]": kind.rate_hz,
        "torque is": kind.torque_timing,
        "takes tau in": dict(zip(per_joint, (unit.replace("newton_metre", "N m") for unit in kind.units), strict=True)),
        "gain [1/s]": prior.gain_per_s,
        "presliding widths [mrad]": [1e3 * width for width in prior.widths_rad],
        **{f"terms of {joint}": words(group) for joint, group in zip(per_joint, prior.own, strict=True)},
        "usual error [Nm]": dict(zip(per_joint, prior.weights.error_nm.tolist(), strict=True)),
        "errors last for [s]": dict(zip(per_joint, prior.weights.memory_s.tolist(), strict=True)),
        "a row of the next arm counts": prior.weights.trust,
        "error after a minute, by that with all": dict(facts["after_a_minute"]),
        **describe_errors(prior.errors, per_joint),
        **describe_days(prior.days, per_joint),
    }
    content["made by"] = {key: facts.get(key) for key in ("command", "version", "seed", "machine")}
    content["made from"] = {name: str(data) for name, data in facts["settings"]["data"].items()}
    content["sha256"] = prior.sha256
    return content


def odd_parts(trust: Mapping[str, float], least: float) -> list[str]:
    """Joints, or the links, that count for less."""
    return [name for name, share in trust.items() if share < least]


def words(group: Any) -> str:
    """How many of a joint's terms are of which kind."""
    kinds = [term.kind.name for term in group]
    return ", ".join(f"{kinds.count(kind)} {kind}" for kind in dict.fromkeys(kinds))


def describe_days(days: FleetDays | None, joints: list[str]) -> Told:
    """What `refit --like` goes by."""
    name = "friction of one arm differs from recording to recording by"
    if days is None:
        return {name: "nobody knows: fewer than three arms have two recordings in which all joints moved"}
    shares = [f"{math.sqrt(days.covariance[j, j]):.1%}" for j in range(len(joints))]
    return {name: dict(zip(joints, shares, strict=True)), "which is of": f"{days.recordings} of {days.arms} arms"}


def describe_errors(errors: FleetErrors | None, joints: list[str]) -> Told:
    """What the next arm's limits rest on."""
    if errors is None:
        return {"limits of the next arm": "follow from its own minute: no three arms showed more than a minute"}
    of_arms = (
        f"{errors.hours:.3g} h of {errors.arms} arms, each taken for a new one with {errors.minutes:g} min of its own"
    )
    return {
        "limits of the next arm": f"rest on the errors in {of_arms}",
        "limits sliding [Nm]": dict(zip(joints, errors.sliding_limit_nm.tolist(), strict=True)),
        "limits near stiction [Nm]": dict(zip(joints, errors.near_stiction_limit_nm.tolist(), strict=True)),
        "raised for arms unlike each other by": errors.facts["arms_factor"],
        "collision held for [s]": errors.hold_s,
        "limits promise": errors.facts["sentence"],
    }
