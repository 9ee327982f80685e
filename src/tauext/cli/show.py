"""`tauext show`: what is in a bundle or a recording; packages show files and folders of theirs."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import tyro

from tauext import plugins
from tauext.cli.arguments import JsonArg
from tauext.cli.commands import folders_like, loaded
from tauext.errors import BundleError, ConfigError
from tauext.files.kind import LOGS, import_first

if TYPE_CHECKING:
    from tauext._core import Bundle, ObserverSettings

Content = dict[str, Any]
"""Values by identifiers that end in their units, for --json. Text shows the identifiers with blanks, and adds words."""
SHOWN = "a bundle (*.tauext), a recording (*.parquet), a prior (*.prior.json) or a folder of `tauext commission`"
UNITS = {"_nm": "Nm", "_per_s": "1/s", "_rad_s": "rad/s", "_rad": "rad", "_mrad": "mrad", "_s": "s", "_hz": "Hz"} | {
    "_kg_m2": "kg m2", "_kg": "kg", "_m": "m", "_a": "A"
}  # fmt: skip
"""Units by the end of an identifier; the first that fits."""


# --- The command.


def show(
    file: tyro.conf.Positional[Path],
    as_json: JsonArg = False,
    force: bool = False,
    data: tuple[Path, ...] = (),
    frame: tuple[str, ...] = (),
    picture: Path | None = None,
) -> None:
    """Print what is in a bundle (*.tauext), a recording (*.parquet), a prior of arms of one type (*.prior.json) or a
    folder of `tauext commission`.

    Args:
        file: bundle (*.tauext), recording (*.parquet), prior (*.prior.json) or folder of `tauext commission` to show.
        as_json: print what is found as JSON for scripts.
        force: print the minimum detectable force at each link's end, in newtons.
        data: recordings (*.parquet) whose poses and thresholds --force takes; none: poses that the bundle keeps.
        frame: frames at which --force gives the force, too.
        picture: PNG that --force draws.
    """
    if folders := folders_like(file):
        if force or data or frame or picture is not None:
            raise ConfigError(f"--force, --data, --frame and --picture belong to a bundle; give one in {file}")
        loaded(folders.show)(file, as_json)
        return
    if (file / "split.json").is_file():
        raise ConfigError(f"{file}: is a dataset folder; `tauext check --data {file}` shows its data. Or give {SHOWN}")
    if not file.is_file():
        raise ConfigError(f"{file}: there is no such file; give {SHOWN}")
    if force:
        plugins.part("force")(file, as_json, data, frame, picture)
        return
    if data or frame or picture is not None:
        raise ConfigError("--data, --frame and --picture belong to --force; give that, too")
    if file.suffix == ".tauext":
        try:
            content = describe_bundle(file)
            text = [*lines(content), *aligned(words_of_provenance(content)), *situation_lines(content)]
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise BundleError(f"{file}: its provenance is damaged ({type(error).__name__}: {error})") from error
    elif file.suffix == ".parquet":
        content = describe_recording(file)
        text = lines(content)
    elif file.name.endswith(".prior.json"):
        content = plugins.part("prior-content")(file)
        text = [*content["table"], *lines(content)]
    else:
        remedy = f"; {import_first(file)}" if file.suffix in LOGS else ""
        raise ConfigError(f"{file}: its name must end as that of {SHOWN}{remedy}")
    print(json.dumps(content, indent=1) if as_json else "\n".join(text))


def lines(content: Content) -> list[str]:
    """A line an identifier, in words."""
    from tauext.bundle.units import of_all

    units = UNITS | ({"_nm": of_all(content["answers_in"].values())} if "answers_in" in content else {})
    # The values of these have the unit of the estimate, which is not Nm for every bundle.
    estimated = ("limits", "contact_limits", "drift", "largest_torque_in_training", "drive_torque_limits")
    in_words = ("provenance", "situations", "table")
    shown = {key: value for key, value in content.items() if key not in in_words}
    return aligned({label(key, units if key.startswith(estimated) else UNITS): in_text(shown[key]) for key in shown})


def label(key: str, units: Mapping[str, str]) -> str:
    """The identifier in words: `sample rate [Hz]`."""
    from tauext.bundle.units import in_terms

    end, unit = next(((end, unit) for end, unit in units.items() if key.endswith(end)), ("", ""))
    words = in_terms(key.removesuffix(end))
    return f"{words} [{unit}]" if unit else words


def in_text(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{key} {in_text(one)}" for key, one in value.items()) or "none"
    if isinstance(value, list):
        return ", ".join(map(in_text, value)) or "none"
    if isinstance(value, float):
        return f"{value:.4g}"
    return "none" if value is None else str(value)


def aligned(words: Mapping[str, str]) -> list[str]:
    width = max(map(len, words), default=0)
    return [f"{key:<{width}}  {value}" for key, value in words.items()]


# --- A bundle.


def describe_bundle(file: Path) -> Content:
    """Content of a bundle; loading it also replays its reference."""
    from tauext.bundle.bundle_file import load_bundle
    from tauext.bundle.units import left_out, own_shares, situations

    bundle = load_bundle(file)
    names = [link.joint_name for link in bundle.links]
    # Provenance has its keys by the alphabet: joint10 before joint2.
    facts = in_order(json.loads(bundle.provenance or "{}"), names)
    if not isinstance(facts, dict):
        raise TypeError("it is no object")

    load = bundle.load_settings
    set_to = {"frame": load.frame, "largest_kg": load.largest_mass_kg, "reach_m": load.largest_reach_m}
    period_s = bundle.observer.sample_period_ns * 1e-9
    content: Content = {
        "bundle": bundle.name,
        "joints": names,
        "masses_kg": [link.mass for link in bundle.links],
        "rotor_inertias_kg_m2": [link.rotor_inertia for link in bundle.links],
        "takes_tau_in": each(names, bundle.torque_units),
        "answers_in": each(names, bundle.estimate_units),
        "observer": describe_observer(bundle.observer),
        "sample_rate_hz": 1 / period_s,
        "network": None,
        "prior": None,
        **describe_limits(bundle, names),
        "load": set_to if load.settable else {"refused": load.refused},
        "shapes_of_links": describe_shapes(bundle, names, facts.get("shapes", {}).get("notes", [])),
        "reference": "replayed, equal",
        "provenance": facts,
    }
    if bundle.has_network:
        shape, stride = bundle.shape, bundle.observer.network_stride
        content["network"] = {name: getattr(shape, name) for name in ("inputs", "hidden", "outputs")}
        content["network"] |= {"parameters": shape.parameter_count, "window_steps": bundle.window_steps}
        content["network"] |= {"step_s": round(period_s * stride, 9)}
    if bundle.prior.terms:
        content["prior"] = {"terms": len(bundle.prior.terms), "presliding_widths_rad": list(bundle.prior.widths_rad)}
    if bundle.prior.temperature.reference_c:
        warm = bundle.prior.temperature
        for name in ("coulomb_per_10k", "viscous_per_10k", "reference_c"):
            content[f"temperature_{name}"] = each(names, getattr(warm, name))
    if bundle.observer.nm_per_unit:
        content["torque_constants"] = each(names, bundle.observer.nm_per_unit)
        content["torque_constants_own_error"] = each(names, own_shares(bundle))
        content["torque_constants_common_error"] = bundle.wrench_settings.common_share
    if (names_left := left_out(bundle)) and not bundle.too_few_in_newtons(""):
        content["without_loads_and_forces"] = names_left
    content |= describe_servo(bundle, names) | describe_drift(bundle, names) | describe_coverage(bundle, names)
    if found := situations(bundle):
        content["situations"] = found
    return content


def describe_shapes(bundle: Bundle, names: list[str], notes: Sequence[str]) -> Content:
    """Which links have capsules, and which are guessed and why.

    Args:
        notes: notes of the training on shapes that could not be read.
    """
    links = sorted({one.link for one in bundle.capsules})
    guessed = [name for number, name in enumerate(names) if number not in links]
    content: Content = {"capsules": len(bundle.capsules), "links": len(links), "guessed": guessed}
    if guessed:
        content["why_guessed"] = notes[0] if notes else "the robot file has no geometry for them"
    return content


def describe_limits(bundle: Bundle, names: list[str]) -> Content:
    """Limits of the estimates, and ranges of the signals."""
    from tauext.bundle.units import not_monitored

    return {
        "limits_hold": "in usual motion; they follow the motion" if bundle.error_scale.follows else "always",
        "limits_sliding_nm": each(names, map(finite, bundle.sliding_limit_nm)),
        "limits_near_stiction_nm": each(names, map(finite, bundle.near_stiction_limit_nm)),
        "contact_limits_sliding_nm": each(names, map(finite, bundle.contact_sliding_limit_nm)),
        "contact_limits_near_stiction_nm": each(names, map(finite, bundle.contact_near_stiction_limit_nm)),
        "not_monitored": not_monitored(bundle),
        "near_stiction_below_rad_s": bundle.near_stiction_rad_s,
        "collision_hold_s": bundle.hold_s,
        "contact_hold_s": bundle.contact_hold_s,
        "contact_release_s": bundle.contact_release_s,
        "after_contact_factor": bundle.after_contact_factor,
        "largest_torque_in_training_nm": each(names, bundle.largest_torque_nm),
        "drive_torque_limits_nm": each(names, map(finite, bundle.torque_limit_nm)),
        "a_fault_beyond": each(names, (beyond(bundle, joint) for joint in range(len(names)))),
    }


def each(names: Sequence[str], values: Iterable[Any]) -> Content:
    """A value of each joint."""
    return dict(zip(names, values, strict=True))


def in_order(facts: Any, names: list[str]) -> Any:
    """The content with the joints of every object in the arm's order."""
    if not isinstance(facts, dict):
        return facts
    keys = [name for name in names if name in facts]
    keys += [key for key in facts if key not in keys]
    return {key: in_order(facts[key], names) for key in keys}


def finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def describe_observer(observer: ObserverSettings) -> Content:
    """Its method, its gain, and its filters where it has any."""
    content = {"method": observer.method.name, "gain_per_s": observer.gain_per_s, "torque_is": observer.timing.name}
    filters = {name: getattr(observer, name) for name in ("high_pass_per_s", "low_pass_per_s")}
    return content | {name: cutoff for name, cutoff in filters.items() if cutoff > 0}


def beyond(bundle: Bundle, joint: int) -> str:
    """Samples of a joint beyond these values are faults."""
    from tauext.bundle.units import short

    unit = short(bundle.estimate_units[joint])
    speed_unit = "m/s" if bundle.links[joint].type.name == "prismatic" else "rad/s"
    torque, speed = bundle.possible_torque_nm[joint], bundle.possible_speed_rad_s[joint]
    bounds = [f"{torque:.4g} {unit}"] if math.isfinite(torque) else []
    bounds += [f"{speed:.4g} {speed_unit}, also from one position to the next"] if math.isfinite(speed) else []
    return " and ".join(bounds) or "unknown"


def describe_servo(bundle: Bundle, names: list[str]) -> Content:
    """Empty where the joints are no servos', or report their torque and velocity."""
    servo = bundle.servo
    content: Content = {}
    made_of = {
        "phase_current": "current of the windings",
        "supply_current": "current of the supply, with the sign of the duty or of goal minus position",
        "duty": "duty, less back-EMF",
        "goal": "goal minus position by the gain of the servo's controller, less back-EMF",
    }
    if servo.on and servo.torque_from.name in made_of:
        content["torque_made_of"] = made_of[servo.torque_from.name]
        for name in ("volts", "ohm", "back_emf_v_s", "nm_per_ampere", "duty_per_rad", "most_duty"):
            content[f"servo_{name}"] = each(names, (getattr(one, name) for one in servo.joints))
    if servo.on and servo.velocity_steps:
        content["velocity_from_position_steps"] = servo.velocity_steps
        content["encoder_counts_rad"] = each(names, (joint.count_rad for joint in servo.joints))
    return content


def describe_drift(bundle: Bundle, names: list[str]) -> Content:
    """Settings of the drift tracker; empty where there is none."""
    drift = bundle.drift
    if not drift.time_constant_s:
        return {}
    tracker = ("time_constant_s", "freeze_share", "freeze_s", "friction_share")
    a_minute = min(1.0, 60 * drift.rate_share_per_s)
    content: Content = {
        "drift": {name: getattr(drift, name) for name in tracker},
        "drift_at_most_nm": each(names, drift.size_nm),
        "drift_a_minute_at_most_nm": each(names, (a_minute * size for size in drift.size_nm)),
    }
    if any(drift.freeze_floor_nm):
        content["drift_never_frozen_below_nm"] = each(names, drift.freeze_floor_nm)
    return content


def describe_coverage(bundle: Bundle, names: list[str]) -> Content:
    """Motion that the training data covers; empty where the bundle does not hold it."""
    coverage = bundle.coverage
    if coverage.empty:
        return {}
    near = zip(names, coverage.reach, coverage.span_rad, coverage.turns, strict=True)
    together = math.degrees(2 * math.pi * coverage.reach_together / coverage.PAIR_CELLS)
    return {
        "fastest_in_training_rad_s": each(names, coverage.fastest_rad_s),
        "familiar_within": {
            name: f"{reach * span / coverage.CELLS:.2g} {'rad' if turns else 'm'} of training"
            if reach
            else "any position"
            for name, reach, span, turns in near
        },
        "pairs_of_joints_familiar_within": f"{together:.3g}° of training" if together else "any positions",
    }


def situation_lines(content: Content) -> list[str]:
    """Limit and standard error of each joint in each situation."""
    from tauext.bundle.units import certainty

    return aligned(
        {
            name: "; ".join(f"{joint} {certainty(one, joint, content['answers_in'][joint])}" for joint in one["limit"])
            for name, one in content.get("situations", {}).items()
        }
    )


# --- What the provenance of a bundle holds, in words.


def words_of_provenance(content: Content) -> dict[str, str]:
    """Facts of the training in words: fits, accepted findings, warnings, promises."""
    from tauext.bundle.bundle_file import changed_since_training
    from tauext.bundle.units import sentences, short

    facts: Content = content["provenance"]
    made = {key: facts.get(key) for key in ("command", "version", "seed", "recipe", "case", "steps", "batch")}
    rows: dict[str, str] = {"made by": in_text({key: value for key, value in made.items() if value is not None})}
    units = {joint: short(unit) for joint, unit in content["answers_in"].items()}
    rows |= prior_words(facts.get("prior", {}), units)
    rows |= {f"network of {joint}": reason for joint, reason in facts.get("gate", {}).items()}
    if given := facts.get("network"):
        rows["weights of the network are those of"] = f"{given['file']}, SHA-256 {given['sha256']}"
    rows |= changed_since_training(facts)
    for recordings, checked in facts.get("checks", {}).items():
        for what, entries in checked.items():
            rows |= {f"{what.removesuffix('s')} in {recordings}: {of_joint(one)}": one["evidence"] for one in entries}
    limits = facts.get("limits", {})
    if "extrapolated" in limits:
        rows["largest error of free motion"] = f"{limits['extrapolated']['largest_seen']:.0%} of the thresholds"
    else:
        rows |= named(facts, ("thresholds are these times what was seen in training", "limits", "minutes_factor"))
    rows |= named(
        facts,
        ("share of the friction in the thresholds, since it changes", "limits", "friction_reserve"),
        ("error scale was found on [h]", "error_scale", "hours"),
    )
    if found := content.get("situations"):
        rows |= {f"{joint} is": words for joint, words in sentences(found, content["answers_in"]).items()}
    rows |= named(facts, ("gain was chosen", "gain", "reason"))
    rows |= {f"{one['severity']}: {of_joint(one)}": one["evidence"] for one in facts.get("limit_findings", [])}
    for moment in limits.get("one_moment", []):
        rows[f"warning: one moment sets the threshold of {moment['joint']}"] = (
            f"at {moment['time_s']:.1f} s of {moment['recording']}: {moment['limit_nm']:.3g} {units[moment['joint']]} "
            f"{moment['region'].replace('_', ' ')}, without it {moment['without_nm']:.3g} {units[moment['joint']]}"
        )
    rows |= named(facts, ("false alarms", "limits", "sentence"))
    for one in limits.get("budgets", []):
        pushes = ", ".join(f"{push:.3g} N at the {place}" for place, push in one["push_n"].items())
        share = f"thresholds {one['share_of_limits']:.0%} as high"
        rows[f"thresholds for {one['text']}"] = f"detect {pushes} ({share})" if pushes else share
    rows |= named(facts, ("during expected contacts", "standing", "sentence"))
    rows |= named(limits, ("in other motion", "other_motion", "sentence"), ("by other signals", "signals", "sentence"))
    if "set_for" in limits:
        rows["thresholds were set for"] = f"{limits['set_for']}, hold time {limits['hold_s'] * 1e3:g} ms"
    return rows


def of_joint(finding: Content) -> str:
    """Code of a finding, and its joint."""
    return f"{finding['code']} of {finding['joint']}" if finding["joint"] else str(finding["code"])


def named(facts: Content, *rows: tuple[str, str, str]) -> dict[str, str]:
    """Facts by words, each with the two keys that lead to it, where it is there."""
    return {words: in_text(facts[one][key]) for words, one, key in rows if key in facts.get(one, {})}


def prior_words(fitted: Content, units: Mapping[str, str]) -> dict[str, str]:
    """Fitted parameters in the units of a data sheet.

    Args:
        units: unit of each joint's torque.
    """
    rows: dict[str, str] = {}
    for joint, friction in fitted.get("friction", {}).items():
        unit = units[joint]
        terms = {  # a recipe without a term has 0
            f"Coulomb {friction['coulomb_nm']:.3g} {unit}": friction["coulomb_nm"],
            f"viscous {friction['viscous_nm_s_rad']:.3g} {unit} s/rad": friction["viscous_nm_s_rad"],
            f"constant {friction['constant_nm']:.2g} {unit}": friction["constant_nm"],
        }
        words = [
            *(term for term, value in terms.items() if value),
            *(f"ripple {r['amplitude_nm']:.2g} {unit}, {r['cycles_a_turn']} cycles a turn" for r in friction["ripple"]),
        ]
        if friction["not_supported"]:
            words.append(f"not supported by the data: {', '.join(friction['not_supported'])}")
        rows[f"friction of {joint}"] = "; ".join(words)
    for joint, found in fitted.get("arm", {}).items():
        words = ["axis " + " ".join(f"{value:.2g}" for value in found["axis"])]
        if "angle_deg" in found:
            words.append(f"{found['angle_deg']:.3g}° and {found['distance_m']:.2g} m from the axis before")
        rows[f"found in the motion of {joint}"] = "; ".join(words)
    for joint, corrections in fitted.get("model", {}).items():
        supported = {name: value for name, value in corrections.items() if isinstance(value, dict)}
        words = [f"{name} {value['by']:+.3g} ± {value['standard_error']:.1g}" for name, value in supported.items()]
        left = [name.split(" ")[0] for name in corrections if name not in supported]
        words.append(f"not supported by the data: {', '.join(left)}")
        rows[f"model error of {joint}"] = "; ".join(words)
    return rows


# --- A recording.


def describe_recording(file: Path) -> Content:
    """Content of a recording."""
    from tauext.data.recording import FLAGS, OPTIONAL_SIGNALS
    from tauext.data.recording_file import load_recording
    from tauext.data.servo import torque_unit

    recording = load_recording(file)
    joints, contact = recording.joints, recording.contact

    def largest(values: Any) -> Content:
        return dict(zip(joints, abs(values).max(axis=0).tolist(), strict=True))

    return {
        "recording": recording.name,
        "joints": list(joints),
        "duration_s": recording.duration_s,
        "samples": recording.samples,
        "rate_hz": recording.rate_hz,
        "torque_is": recording.torque_timing,
        "also_holds": [name for name in (*OPTIONAL_SIGNALS, *FLAGS) if getattr(recording, name) is not None],
        "share_in_contact": None if contact is None else float((contact == 1).mean()),
        "share_of_unknown_contact": None if contact is None else float((contact == -1).mean()),
        "largest_q_rad": largest(recording.q),
        "largest_dq_rad_s": largest(recording.dq),
        f"largest_tau_{torque_unit([recording]).lower()}": largest(recording.tau),
        "source": recording.source,
    }
