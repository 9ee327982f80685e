"""`tauext show`: what is in a bundle, a recording or a fleet prior."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from tauext.cli.place_argument import PlaceArg
from tauext.errors import BundleError, ConfigError
from tauext.files.places import Place

# --- `tauext show` of a fleet prior: its arms in a table, and what the next arm would be told.


if TYPE_CHECKING:
    from tauext.fit.fleet_prior import FleetDays, FleetErrors, FleetPrior

Told = dict[str, Any]


def describe_fleet_prior(file: Place) -> Told:
    """Plain content of a fleet prior's file; `table` is what `tauext fleet prior` prints at its end.

    Raises:
        ConfigError: it is none, or what it says of its arms is damaged.
    """
    from tauext.fit.fleet_prior import load_fleet_prior

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
    from tauext.fleet.prior import ODD, table

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


# --- What a bundle says of servos, in words.


if TYPE_CHECKING:
    from tauext._core import Bundle

MADE_OF = {
    "phase_current": "current of the windings",
    "supply_current": "current of the supply, with the sign of the duty or of goal minus position",
    "duty": "duty, less back-EMF",
    "goal": "goal minus position by the gain of the servo's controller, less back-EMF",
}


def describe_servo(bundle: Bundle, names: list[str]) -> dict:
    """Empty where the joints are no servos', or report their torque and velocity."""
    servo = bundle.servo
    if not servo.on:
        return {}
    said: dict = {}
    if (source := servo.torque_from.name) in MADE_OF:
        said["torque is made of"] = MADE_OF[source]
        said["servos"] = {
            name: f"{joint.volts:g} V, {joint.ohm:g} ohm, {joint.back_emf_v_s:g} V s/rad, {joint.nm_per_ampere:g} Nm/A"
            + (f", duty {joint.duty_per_rad:.3g} a rad, at most {joint.most_duty:g}" if joint.duty_per_rad else "")
            for name, joint in zip(names, servo.joints, strict=True)
        }
    if servo.velocity_steps:
        said["velocity is derived from the position"] = f"over {servo.velocity_steps} samples at most"
        said["encoder counts [rad]"] = {name: joint.count_rad for name, joint in zip(names, servo.joints, strict=True)}
    return said


# --- The command.


if TYPE_CHECKING:
    from tauext._core import Bundle, LoadSettings, ObserverSettings

SHOWN = "a bundle (*.tauext), a recording (*.parquet) or a fleet prior (*.prior.json)"


def show(
    file: tyro.conf.Positional[PlaceArg],
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
    force: bool = False,
    data: tuple[PlaceArg, ...] = (),
    frame: tuple[str, ...] = (),
    picture: PlaceArg | None = None,
) -> None:
    """Say what is in a bundle (*.tauext), a recording (*.parquet) or a fleet prior (*.prior.json).

    Args:
        file: bundle (*.tauext), recording (*.parquet) or fleet prior (*.prior.json) to show.
        as_json: print what is found as JSON for scripts.
        force: say what force at each link's end goes over a bundle's limits, in newtons.
        data: recordings (*.parquet) whose poses and limits --force takes; none: poses that the bundle keeps.
        frame: frames that --force tells, too.
        picture: PNG that --force draws.
    """
    if not file.is_file():
        raise ConfigError(f"{file}: there is no such file; give {SHOWN}")
    if force:
        from tauext.cli.show_force import show_force

        show_force(file, as_json, data, frame, picture)
        return
    if data or frame or picture is not None:
        raise ConfigError("--data, --frame and --picture belong to --force; give that, too")
    if file.suffix == ".tauext":
        try:
            content = describe_bundle(file)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise BundleError(f"{file}: its provenance is damaged ({type(error).__name__}: {error})") from error
    elif file.suffix == ".parquet":
        content = describe_recording(file)
    elif file.name.endswith(".prior.json"):
        content = describe_fleet_prior(file)
    else:
        raise ConfigError(f"{file}: its name must end as that of {SHOWN}")
    if as_json:
        print(json.dumps(content, indent=1))
        return
    from tauext.bundle.units import certainty

    if "table" in content:
        print("\n".join(content.pop("table")))
    tabled = content.pop("situations", {})
    width = max(map(len, content))
    for key, value in content.items():
        if isinstance(value, dict):
            value = ", ".join(f"{k} {_text(v)}" for k, v in value.items())
        print(f"{key:<{width}}  {_text(value)}")
    for name, situation in tabled.items():
        told = [f"{joint} {certainty(situation, joint, unit)}" for joint, unit in content["answers in"].items()]
        print(f"{name:<{width}}  {'; '.join(told)}")


def describe_bundle(file: Place) -> dict:
    """Plain content of a bundle; loading it also replays its reference."""
    from tauext.bundle.bundle_file import changed_since_training, load_bundle
    from tauext.bundle.units import of_all

    bundle = load_bundle(file)
    names = [link.joint_name for link in bundle.links]
    facts = json.loads(bundle.provenance or "{}")
    facts = in_order(facts, names)  # provenance has its keys by the alphabet: joint10 before joint2
    period_s = bundle.observer.sample_period_ns * 1e-9
    network_period_s = period_s * bundle.observer.network_stride
    usual = ", in usual motion" if bundle.error_scale.follows else ""
    unit = of_all(bundle.estimate_units)  # of answers and limits; what is given may be another
    content: dict[str, Any] = {
        "bundle": bundle.name,
        "joints": names,
        "model": {
            "masses [kg]": [link.mass for link in bundle.links],
            "rotor inertias [kg m2]": [link.rotor_inertia for link in bundle.links],
        },
        "takes tau in": dict(zip(names, bundle.torque_units, strict=True)),
        "answers in": dict(zip(names, bundle.estimate_units, strict=True)),
        "observer": describe_observer(bundle.observer),
        "sample rate [Hz]": 1 / period_s,
        "network": "none: the plain observer",
        f"limits sliding{usual} [{unit}]": dict(zip(names, bundle.sliding_limit_nm, strict=True)),
        f"limits near stiction{usual} [{unit}]": dict(zip(names, bundle.near_stiction_limit_nm, strict=True)),
        "near stiction below [rad/s]": bundle.near_stiction_rad_s,
        "collision held for [s]": bundle.hold_s,
        f"contact limits sliding{usual} [{unit}]": dict(zip(names, bundle.contact_sliding_limit_nm, strict=True)),
        f"contact limits near stiction{usual} [{unit}]": dict(
            zip(names, bundle.contact_near_stiction_limit_nm, strict=True)
        ),
        "contact held for, released after [s]": [bundle.contact_hold_s, bundle.contact_release_s],
        "largest torque in training [Nm]": dict(zip(names, bundle.largest_torque_nm, strict=True)),
        "torque limits of the drives [Nm]": {
            name: limit if math.isfinite(limit) else "not known"
            for name, limit in zip(names, bundle.torque_limit_nm, strict=True)
        },
        "a fault beyond": {name: beyond(bundle, joint) for joint, name in enumerate(names)},
        "load": describe_load(bundle.load_settings),
        **describe_left_out(bundle),
        "shapes of links": describe_shapes(bundle, names),
        "reference": "replayed, equal",
        "made by": {key: facts.get(key) for key in ("command", "version", "seed", "recipe", "case", "steps", "batch")},
    }
    if bundle.has_network:
        content["network"] = {
            "inputs": bundle.shape.inputs,
            "hidden": bundle.shape.hidden,
            "outputs": bundle.shape.outputs,
            "parameters": bundle.shape.parameter_count,
            "window": f"{bundle.window_steps} steps of {network_period_s * 1e3:g} ms",
        }
    content |= describe_servo(bundle, names)
    if bundle.observer.nm_per_unit:
        content["torque constants"] = dict(zip(names, bundle.observer.nm_per_unit, strict=True))
    if bundle.prior.terms:
        if not bundle.has_network:
            content["network"] = "none: observer and prior"
        content |= describe_prior(bundle, facts)
    if bundle.drift.time_constant_s:
        content["drift tracker"] = {
            "time constant [s]": bundle.drift.time_constant_s,
            "learns nothing over this share of a contact limit": bundle.drift.freeze_share,
            "and so long afterwards [s]": bundle.drift.freeze_s,
        }
        if any(bundle.drift.freeze_floor_nm):
            content[f"but never below this [{unit}]"] = dict(zip(names, bundle.drift.freeze_floor_nm, strict=True))
        if bundle.drift.friction_share:
            content["drift tracker"]["follows friction that is off at once by this share"] = bundle.drift.friction_share
        content[f"drift of a coefficient at most [{unit}]"] = dict(zip(names, bundle.drift.size_nm, strict=True))
        content[f"and a minute at most [{unit}]"] = {
            name: min(1.0, 60 * bundle.drift.rate_share_per_s) * size
            for name, size in zip(names, bundle.drift.size_nm, strict=True)
        }
    content |= describe_coverage(bundle)
    for joint, reason in facts.get("gate", {}).items():
        content[f"network of {joint}"] = reason
    content |= changed_since_training(facts)
    content |= describe_look(facts)
    content |= describe_limits(bundle, facts)
    if "reason" in facts.get("gain", {}):
        content["gain was chosen"] = facts["gain"]["reason"]
    limits = facts.get("limits", {})
    for moment in limits.get("one_moment", []):
        where = f"at {moment['time_s']:.1f} s of {moment['recording']}"
        content[f"warning: one moment sets the limit of {moment['joint']}"] = (
            f"{where}: {moment['limit_nm']:.3g} Nm {moment['region'].replace('_', ' ')}, "
            f"without it {moment['without_nm']:.3g} Nm"
        )
    if "sentence" in limits:
        content["limits promise"] = limits["sentence"]
    if "other_motion" in limits:
        content["in other motion"] = limits["other_motion"]["sentence"]
    if "set_for" in limits:
        content["limits were set for"] = f"{limits['set_for']}, hold time {limits['hold_s'] * 1e3:g} ms"
    return content


def describe_load(settings: LoadSettings) -> dict | str:
    """In which frame a load is told, and the most that is believed."""
    if not settings.settable:
        return f"none can be set: {settings.refused}"
    most = {"at most [kg]": settings.largest_mass_kg, "reaching [m]": settings.largest_reach_m}
    return {"in the frame": settings.frame, **most}


def describe_left_out(bundle: Bundle) -> dict[str, str]:
    """Joints by which no load and no force is told; nothing where all answer in N m, or none."""
    from tauext.bundle.units import left_out

    if not (names := left_out(bundle).get("left_out", [])) or bundle.too_few_in_newtons(""):
        return {}
    return {
        "not in N m": f"{', '.join(names)}: they tell nothing of loads and forces, and while a load is set their "
        "limits are higher by all that it may show there"
    }


def describe_shapes(bundle: Bundle, names: list[str]) -> str:
    """What a touch's place rests on."""
    if not bundle.capsules:
        return "none: where a touch is is told by guessed ones"
    shaped = {one.link for one in bundle.capsules}
    guessed = [name for number, name in enumerate(names) if number not in shaped]
    beside = f"; guessed for {', '.join(guessed)}" if guessed else ""
    return f"{len(bundle.capsules)} capsules of {len(shaped)} links{beside}"


def describe_look(facts: dict) -> dict:
    """What the data had wrong and a person accepted, and what they were warned of."""
    content: dict[str, str] = {}
    for recordings, looked in facts.get("look", {}).items():
        for what, entries in looked.items():
            for entry in entries:
                joint = f" of {entry['joint']}" if entry["joint"] else ""
                content[f"{LOOKED[what]} in {recordings}: {entry['code']}{joint}"] = entry["evidence"]
    return content


LOOKED = {"accepted": "accepted", "warnings": "warning"}
"""What a look found, by its name in the provenance."""


def in_order(facts: Any, names: list[str]) -> Any:
    """The same, with every object that goes by joints in the arm's order of joints."""
    if not isinstance(facts, dict):
        return facts
    keys = [name for name in names if name in facts]
    keys += [key for key in facts if key not in keys]
    return {key: in_order(facts[key], names) for key in keys}


def beyond(bundle: Bundle, joint: int) -> str:
    """What of a joint the monitor takes for no sample at all, in words."""
    from tauext.bundle.units import short

    unit = short(bundle.estimate_units[joint])
    speed_unit = "m/s" if bundle.links[joint].type.name == "prismatic" else "rad/s"
    torque, speed = bundle.possible_torque_nm[joint], bundle.possible_speed_rad_s[joint]
    told = [f"{torque:.4g} {unit}"] if math.isfinite(torque) else []
    told += [f"{speed:.4g} {speed_unit}, also from one position to the next"] if math.isfinite(speed) else []
    return " and ".join(told) or "nothing is known"


def describe_limits(bundle: Bundle, facts: dict) -> dict:
    """What raises limits beside the error scale, and how sure each joint is in motions that everybody knows."""
    from tauext.bundle.units import sentences, situations

    content: dict[str, Any] = {}
    limits, scale = facts.get("limits", {}), facts.get("error_scale", {})
    if bundle.after_contact_factor != 1:
        content["limits of a joint pushed at rest, until it slides, times"] = bundle.after_contact_factor
    if "minutes_factor" in limits:
        content["limits are these times what was seen in training"] = limits["minutes_factor"]
    if "friction_reserve" in limits:
        content["share of the friction in the limits, since it changes"] = limits["friction_reserve"]
    if "hours" in scale:
        content["error scale was found on [h]"] = scale["hours"]
    if found := situations(bundle):
        names = [link.joint_name for link in bundle.links]
        told = sentences(found, dict(zip(names, bundle.estimate_units, strict=True)))
        content |= {f"{joint} is": words for joint, words in told.items()}
        content["situations"] = found
    return content


def describe_coverage(bundle: Bundle) -> dict:
    """What motion training saw; nothing where nobody knows."""
    coverage = bundle.coverage
    if coverage.empty:
        return {}
    names = [link.joint_name for link in bundle.links]
    width = [span / coverage.CELLS for span in coverage.span_rad]
    units = ["rad" if turns else "m" for turns in coverage.turns]
    near = zip(names, coverage.reach, width, units, strict=True)
    return {
        "fastest in training [rad/s]": dict(zip(names, coverage.fastest_rad_s, strict=True)),
        "familiar within": {
            name: f"{reach * cell:.2g} {unit} of training" if reach else "any position"
            for name, reach, cell, unit in near
        },
        "pairs of joints familiar within": (
            f"{math.degrees(2 * math.pi * coverage.reach_together / coverage.PAIR_CELLS):.3g}° of training"
            if coverage.reach_together
            else "any positions"
        ),
    }


def describe_observer(observer: ObserverSettings) -> dict:
    """Its method where that is not the momentum observer, its gain, and its filters where it has any."""
    content: dict[str, Any] = {} if observer.method.name == "momentum" else {"method": METHODS[observer.method.name]}
    content |= {"gain [1/s]": observer.gain_per_s, "torque is": observer.timing.name}
    filters = {"high-pass [1/s]": observer.high_pass_per_s, "low-pass [1/s]": observer.low_pass_per_s}
    return content | {name: cutoff for name, cutoff in filters.items() if cutoff > 0}


METHODS = {
    "direct": "direct residual",
    "velocity": "velocity observer",
    "energy": "energy observer: its residual and limits are in watts",
}


def describe_prior(bundle: Bundle, facts: dict) -> dict:
    """What was fitted, as an engineer would compare it with a data sheet."""
    content: dict = {
        "prior": {
            "terms": len(bundle.prior.terms),
            "presliding widths [mrad]": [1e3 * w for w in bundle.prior.widths_rad],
        }
    }
    fitted = facts.get("prior", {})
    for joint, friction in fitted.get("friction", {}).items():
        words = [
            f"Coulomb {friction['coulomb_nm']:.3g} Nm",
            f"viscous {friction['viscous_nm_s_rad']:.3g} Nm s/rad",
            f"constant {friction['constant_nm']:.2g} Nm",
            *(f"ripple {r['amplitude_nm']:.2g} Nm, {r['cycles_a_turn']} cycles a turn" for r in friction["ripple"]),
        ]
        if friction["not_supported"]:
            words.append(f"not supported by the data: {', '.join(friction['not_supported'])}")
        content[f"friction of {joint}"] = "; ".join(words)
    warm = bundle.prior.temperature
    if warm.reference_c:
        shares = zip(warm.coulomb_per_10k, warm.viscous_per_10k, warm.reference_c, strict=True)
        content["friction follows the temperature: share for 10 K (Coulomb, viscous), fitted at [degC]"] = {
            link.joint_name: f"{coulomb:+.1%}, {viscous:+.1%}, {celsius:.0f}" if coulomb or viscous else "no"
            for link, (coulomb, viscous, celsius) in zip(bundle.links, shares, strict=True)
        }
    for joint, found in fitted.get("arm", {}).items():
        words = ["axis " + " ".join(f"{value:.2g}" for value in found["axis"])]
        if "angle_deg" in found:
            words.append(f"{found['angle_deg']:.3g}° and {found['distance_m']:.2g} m from the axis before")
        content[f"found in the motion of {joint}"] = "; ".join(words)
    for joint, corrections in fitted.get("model", {}).items():
        told = {name: value for name, value in corrections.items() if isinstance(value, dict)}
        words = [f"{name} {value['by']:+.3g} ± {value['standard_error']:.1g}" for name, value in told.items()]
        left = [name.split(" ")[0] for name in corrections if name not in told]
        words.append(f"not supported by the data: {', '.join(left)}")
        content[f"model error of {joint}"] = "; ".join(words)
    return content


def describe_recording(file: Place) -> dict:
    """Plain content of a recording."""
    from tauext.data.recording import FLAGS, OPTIONAL_SIGNALS
    from tauext.data.recording_file import load_recording

    recording = load_recording(file)
    signals = (*OPTIONAL_SIGNALS, *FLAGS)
    touched = "unknown" if recording.contact is None else f"{(recording.contact == 1).mean():.1%} of the samples"
    return {
        "recording": recording.name,
        "joints": list(recording.joints),
        "duration [s]": recording.duration_s,
        "samples": recording.samples,
        "rate [Hz]": recording.rate_hz,
        "torque is": recording.torque_timing,
        "also holds": [s for s in signals if getattr(recording, s) is not None],
        "in contact": touched,
        "largest |q| [rad]": dict(zip(recording.joints, abs(recording.q).max(axis=0).tolist(), strict=True)),
        "largest |dq| [rad/s]": dict(zip(recording.joints, abs(recording.dq).max(axis=0).tolist(), strict=True)),
        "largest |tau| [Nm]": dict(zip(recording.joints, abs(recording.tau).max(axis=0).tolist(), strict=True)),
        "source": recording.source,
    }


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list):
        return ", ".join(_text(v) for v in value)
    return str(value)
