"""Every event in words and as plain JSON, once, for text and JSON lines, page, journal, reactions and ROS 2."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from tauext._core import cause_names
from tauext.bundle.estimates import ALARMS, COLLISION, DECLARED, FIRST_KIND, HEALTHS, TOUCHES, number, torque_lists
from tauext.bundle.units import short
from tauext.monitor.changes import (
    BEYOND,
    AlarmChange,
    Change,
    DeclaredChange,
    DriftChange,
    FoundLoad,
    HealthChange,
    LoadChange,
    TouchChange,
    WeighChange,
    with_article,
)
from tauext.monitor.episode import Episode
from tauext.monitor.loads import load_facts, load_words
from tauext.monitor.phases import bounds_words
from tauext.monitor.touch_place import INCONSISTENT, PlaceChange, links_words, newtons, place_facts, place_words, run_of

# --- Changes in words.


def change_words(change: Change, joints: tuple[str, ...], units: Sequence[str]) -> list[str]:
    """A line of text or more for a change.

    Args:
        units: units of the estimates, one a joint.
    """
    if isinstance(change, WeighChange):
        return weigh_words(change)
    if isinstance(change, AlarmChange):
        return [alarm_words(change, joints, units)]
    if isinstance(change, TouchChange):
        return [touch_words(change)]
    if isinstance(change, PlaceChange):
        return [place_words(change, joints)]
    if isinstance(change, DeclaredChange):
        return [declared_words(change)]
    if isinstance(change, LoadChange):
        return [load_change_words(change)]
    if isinstance(change, FoundLoad):
        return [found_load_words(change)]
    assert isinstance(change, DriftChange)
    return [f"recalibrate: joint {joints[change.joint]}'s drift is at its bound"]


def health_words(change: HealthChange, joints: tuple[str, ...]) -> str:
    """`fault: not finite, joint2 (was ok)`."""
    causes = ", ".join(cause_names(change.causes))
    where = f", {joints[change.joint]}" if change.joint >= 0 else ""
    why = f": {causes}{where}" if causes else ""
    was = f" (was {HEALTHS[change.was]})" if change.was != change.health else ""
    return f"{HEALTHS[change.health]}{why}{was}"


def alarm_words(change: AlarmChange, joints: tuple[str, ...], units: Sequence[str]) -> str:
    """`COLLISION joint1: |tau_ext| 6.21 Nm (standard error 0.35 Nm), collision limit 4.62 Nm`.

    units: of the answers, a joint.
    """
    if change.acknowledged:
        return f"{ALARMS[change.was]} acknowledged"
    if change.joint < 0:
        return f"no {ALARMS[change.was]} any more" if change.alarm == 0 else ALARMS[change.alarm]
    level, unit = ALARMS[change.alarm], short(units[change.joint])
    region = " near stiction" if change.near_stiction else ""
    error = f" (standard error {change.sigma_nm:.2f} {unit})" if math.isfinite(change.sigma_nm) else ""
    return (
        f"{level.upper()} {joints[change.joint]}: |tau_ext| {abs(change.tau_ext_nm):.2f} {unit}{error}, "
        f"{level} limit{region} {change.limit_nm:.2f} {unit}"
    )


def touch_words(change: TouchChange) -> str:
    """`the collision is a clamp, 164 ms after the alarm`."""
    kind = TOUCHES[change.touch]
    was = f" (was taken for {TOUCHES[change.was]})" if TOUCHES[change.was] not in ("none", "unknown") else ""
    return f"the {ALARMS[change.alarm]} is {with_article(kind)}, {change.since_s * 1e3:.0f} ms after the alarm{was}"


def declared_words(change: DeclaredChange) -> str:
    """`sanding: 34 N at tool0, of at most 30 N`; `sanding: contact at tool0 of at most 30 N`."""
    name, bounds = f"{change.phase}: " * bool(change.phase), change.bounds
    if bounds is None or change.state == 0:
        return f"{name}no declared contact any more"
    if change.state < BEYOND:
        return f"{name}contact {bounds_words(bounds)}"
    if DECLARED[change.state] == "moved":
        return (
            f"{name}{bounds.frame} moved {abs(change.travel_m) * 1e3:.0f} mm along the contact's axis, of at most "
            f"{bounds.at_most_travel_m * 1e3:.0f} mm; nothing is explained until the force has gone"
        )
    error = f"{float(format(change.sigma, '.1g')):g}"
    if bounds.joint:
        return f"{name}{change.size:.3g} ± {error} at joint {bounds.joint}, of at most {bounds.at_most_nm:g}"
    moment = f" and {change.moment_nm:.2g} N m" if bounds.at_most_nm else ""
    most = f"{bounds.at_most_n:g} N" + (f" and {bounds.at_most_nm:g} N m" if bounds.at_most_nm else "")
    return f"{name}{change.size:.0f} ± {error} N{moment} at {bounds.frame}, of at most {most}"


def declared_facts(change: DeclaredChange) -> dict[str, Any]:
    """The state of a declared contact as plain JSON."""
    facts: dict[str, Any] = {"phase": change.phase or None, "state": DECLARED[change.state]}
    if (bounds := change.bounds) is not None:
        facts |= {"frame": bounds.frame or None, "joint": bounds.joint or None}
        facts |= {"at_most_n": bounds.at_most_n, "at_most_nm": bounds.at_most_nm}
    sizes = {
        "size": change.size,
        "size_error": change.sigma,
        "moment_nm": change.moment_nm,
        "travel_m": change.travel_m,
    }
    return facts | {key: number(value) for key, value in sizes.items()}


def load_change_words(change: LoadChange) -> str:
    since = f" since {(change.t_ns - change.since_ns) * 1e-9:.3f} s" if change.since_ns is not None else ""
    words = f"carries {load_words(change.load)}{since}" + (f", by {change.by}" if change.by else "")
    if not change.left_out or change.load.mass == 0:
        return words
    return f"{words}; limits of {', '.join(change.left_out)}, not in Nm, are higher by its largest torque there"


def found_load_words(change: FoundLoad) -> str:
    if change.mass_kg == 0:
        return "the expected load was put down: carries nothing"
    return f"the expected load was picked up: carries {change.mass_kg:.2f} ± {max(change.error_kg, 0.005):.2f} kg"


def weigh_words(change: WeighChange) -> list[str]:
    """The result of weighing in sentences."""
    from tauext.monitor.weighing import load_sentences

    if change.found is None:
        beside = f" besides {load_words(change.beside)}" if change.beside.mass > 0 else ""
        return [f"weighing the payload{beside}, by {change.by}"]
    sentences = load_sentences(change.found, change.frame, "N m")
    if change.beside.mass > 0 and change.found.verdict == "load":
        sentences.append(f"with the {change.beside.mass:.4g} kg that are set: {load_words(change.found.load)}")
    return sentences


# --- An episode, as the page and the journal have it.


def touched_words(one: Episode, joints: tuple[str, ...]) -> str:
    """`Touched at joint6, about 84 N`; without a place the joint whose torque is too large."""
    if not is_placed(one):
        return f"Touched at {joints[one.joint]} or beyond it"
    assert one.place is not None
    return f"Touched at {links_at(one.place, joints)}, about {float(format(newtons(one.place.best), '.2g')):g} N"


def episode_words(one: Episode, joints: tuple[str, ...], units: Sequence[str]) -> str:
    """`COLLISION, a push on the link of joint2 (91%): 12.4 Nm at joint2, limit 6.1 Nm`."""
    unit = short(units[one.joint]) if units else "Nm"
    kind = f", {with_article(TOUCHES[one.touch])}" if one.touch >= FIRST_KIND else ""
    place = f" on {links_words(one.place.links, joints, one.place.guessed)}" if one.place and is_placed(one) else ""
    level = ALARMS[one.alarm].upper() if one.alarm == COLLISION else ALARMS[one.alarm].capitalize()
    torque = torque_of(one)
    sizes = [f"{abs(torque):.3g} {unit} at {joints[one.joint]}"] if math.isfinite(torque) else []
    sizes += [f"limit {one.limit_nm:.3g} {unit}"] if math.isfinite(one.limit_nm) else []
    return f"{level}{kind}{place}: {', '.join(sizes) or joints[one.joint]}"


def episode_facts(one: Episode, joints: tuple[str, ...], units: Sequence[str]) -> dict[str, Any]:
    """What is known of an alarm, as plain JSON. Of one that stands since an earlier process, what is new."""
    facts: dict[str, Any] = {"id": one.number, "ended": one.ended}
    if one.t_ns is not None:
        facts |= {"bundle": one.bundle, "t_ns": one.t_ns, "held_ns": one.touch_t_ns, "over": rounded(one.over)}
        facts |= {"touch": None, "links": [], "newtons": None}
    if one.touch >= FIRST_KIND:
        facts["touch"] = TOUCHES[one.touch]
    if math.isfinite(one.limit_nm):  # else it has risen under an earlier process
        facts |= {"level": ALARMS[one.alarm], "joint": joints[one.joint], "limit_nm": number(one.limit_nm)}
        facts |= {"tau_ext_nm": number(torque_of(one)), "sentence": touched_words(one, joints)}
        facts["details"] = episode_words(one, joints, units)
    if (place := one.place) is not None and is_placed(one):
        facts |= {
            "at": links_at(place, joints),
            "links": [[joints[link], round(share, 3)] for link, share in place.links],
            "newtons": number(newtons(place.best)),
            "on": links_words(place.links, joints, place.guessed),
            "place": {
                "link": place.best.link,
                "point": list(place.best.point),
                "force": list(place.best.force),
                "q": rounded(one.q),
            },
        }
    return facts


def is_placed(one: Episode) -> bool:
    """Whether a single force on a link explains the touch."""
    return one.place is not None and one.place.consistent >= INCONSISTENT


def links_at(place: PlaceChange, joints: tuple[str, ...]) -> str:
    """`joint2 or joint3`: the joints that carry the links of the stated run."""
    first, last, _ = run_of(place.links)
    return " or ".join(joints[first : last + 1])


def torque_of(one: Episode) -> float:
    """Torque of the alarm's joint, at the moment of the place where one is known."""
    if one.place is not None and is_placed(one) and one.place.tau_ext_nm:
        return one.place.tau_ext_nm[one.joint]
    return one.tau_ext_nm


def rounded(values: Any) -> list[float | None]:
    """One value a joint as JSON has it."""
    return [round(value, 5) if math.isfinite(value) else None for value in np.ravel(np.asarray(values, float)).tolist()]


# --- Changes and single samples as plain JSON.


def change_facts(change: Change, joints: tuple[str, ...]) -> tuple[str, dict[str, Any]]:
    """Name of the event, and its content beside row and time."""
    if isinstance(change, DeclaredChange):
        return "declared", declared_facts(change)
    if isinstance(change, LoadChange):
        facts = {"by": change.by, "since_ns": change.since_ns, "left_out": list(change.left_out)}
        return "load", {**load_facts(change.load), **facts}
    if isinstance(change, FoundLoad):
        return "load", {"mass_kg": change.mass_kg, "mass_error_kg": change.error_kg, "by": "expected"}
    if isinstance(change, WeighChange):
        return "weigh", {"what": change.what, "by": change.by, **found_facts(change)}
    assert isinstance(change, DriftChange | TouchChange | PlaceChange | HealthChange | AlarmChange)
    joint = joints[change.joint] if change.joint >= 0 else None
    if isinstance(change, DriftChange):
        return "drift", {"joint": joint, "advice": "recalibrate"}
    if isinstance(change, TouchChange):
        kinds = {"touch": TOUCHES[change.touch], "was": TOUCHES[change.was], "alarm": ALARMS[change.alarm]}
        return "touch", {"number": change.number, **kinds, "joint": joint, "since_s": change.since_s}
    if isinstance(change, PlaceChange):
        raised = {"number": change.number, "alarm": ALARMS[change.alarm], "joint": joint, "since_s": change.since_s}
        return "place", {**raised, **place_facts(change, joints)}
    if isinstance(change, HealthChange):
        facts = {"health": HEALTHS[change.health], "was": HEALTHS[change.was], "causes": cause_names(change.causes)}
        return "health", {**facts, "joint": joint}
    return "alarm", {
        "number": change.number,
        "alarm": ALARMS[change.alarm],
        "was": ALARMS[change.was],
        "joint": joint,
        "tau_ext_nm": number(change.tau_ext_nm),
        "sigma_nm": number(change.sigma_nm),
        "limit_nm": number(change.limit_nm),
        "near_stiction": change.near_stiction if joint else None,
        "acknowledged": change.acknowledged,
    }


def found_facts(change: WeighChange) -> dict[str, Any]:
    """The result of weighing, and the load to set, as plain JSON."""
    from tauext.monitor.weighing import load_facts as facts_of_found

    if change.found is None:
        return {"frame": change.frame, "found": None, "load": None}
    load = {**load_facts(change.found.load), "error_share": change.found.load.error_share}
    return {"frame": change.frame, "found": facts_of_found(change.found), "load": load}


def sample_facts(estimates: Mapping[str, np.ndarray], row: int) -> dict[str, Any]:
    """Estimate at one row of Monitor.run, as plain JSON; null for missing numbers."""
    return estimate_facts(lambda name: estimates[name][row], cause_names(int(estimates["causes"][row])))


def estimate_facts(of: Callable[[str], Any], causes: Sequence[str]) -> dict[str, Any]:
    """One estimate as plain JSON.

    Args:
        of: a quantity by the core's name; health, alarm and touch as numbers.
    """
    return {
        "health": HEALTHS[of("health")],
        "causes": list(causes),
        "alarm": ALARMS[of("alarm")],
        "touch": TOUCHES[of("touch")],
        "detection": bool(of("detection")),
        "declared": DECLARED[of("declared")],
        "declared_size": number(of("declared_size")),
        **torque_lists(of),
        "unfamiliar": float(of("unfamiliar")),
        "near_stiction": [bool(near) for near in of("near_stiction")],
    }
