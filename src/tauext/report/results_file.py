"""Reads results.json, and refuses a dataset other than the one it was measured on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tauext.data.dataset import FILE_NAME
from tauext.data.recording_file import fingerprint
from tauext.errors import ConfigError
from tauext.files.places import Place
from tauext.files.plain_file import expect_format, json_of, read_text
from tauext.report.entry import Entry, read_events, read_touches
from tauext.report.results import (
    WAYS,
    Aftermath,
    Collision,
    CurveBin,
    CurvePoint,
    EvaluatedBundle,
    FalseCollisions,
    Injected,
    InjectedCurve,
    Latched,
    Measured,
    Noticed,
    NoticedAt,
    OverPoses,
    PeakBin,
    Results,
    SanityRow,
    SigmaBin,
    SigmaRegion,
    StrengthBin,
    Verdict,
    place,
)

# --- Reads what force on a link a bundle notices.


def read_noticed(entry: Entry) -> Noticed | None:
    """Entry `noticed_force` of a bundle; None where the evaluation had none."""
    if not entry.content:
        return None
    if refused := entry.text("refused"):
        return Noticed(refused=refused)
    limits = entry.object("limits")
    return Noticed(
        poses=entry.get("poses", int, needed=True),
        limits={name: tuple(read_place(one) for one in limits.entries(name)) for name in limits.content},
        left_out=entry.texts("left_out"),
        **entry.each_number("gain_per_s", "error_share"),
    )


def read_place(entry: Entry) -> NoticedAt:
    every = entry.object("every_way")
    return NoticedAt(
        place=entry.text("place", needed=True),
        every_median_n=every.number("median_n"),
        nine_of_ten_n=every.number("nine_of_ten_n"),
        ways={way: read_over_poses(entry.object(way)) for way in WAYS},
    )


def read_over_poses(entry: Entry) -> OverPoses:
    return OverPoses(**entry.each_number("median_n", "worst_n"), blind_share=entry.number("blind_share", needed=True))


# --- Reads what results.json holds beyond the paper's own measures.


def read_measured(entry: Entry, joints: int) -> Measured:
    """Of one bundle's entry."""
    after = entry.object("after_contact")
    free = after.object("free_motion")
    return Measured(
        training_minutes=entry.number("training_minutes"),
        model_case=entry.text("case"),
        false_collisions=read_false_collisions(entry.object("free_motion")),
        latched=read_latched(entry.object("latched")),
        missed_curve=tuple(read_point(e) for e in entry.entries("missed_curve")),
        by_strength=tuple(read_strength(e) for e in entry.entries("by_strength")),
        after_contact=tuple(read_aftermath(e, joints) for e in after.entries("bins")),
        after_nothing=read_aftermath(free, joints) if free.content else None,
        rmse_during_contact_nm=entry.numbers("rmse_during_contact_nm", joints),
        sigma=read_sigma(entry.object("error_against_sigma"), joints),
        noticed=read_noticed(entry.object("noticed_force")),
        injected=read_injected(entry.object("injected")),
    )


def read_false_collisions(free: Entry) -> FalseCollisions:
    interval = free.get("false_collisions_interval_per_hour", list) or [None, None]
    if len(interval) != 2 or not all(type(end) in (int, float, type(None)) for end in interval):
        raise ConfigError(f"{free.place}: 'false_collisions_interval_per_hour' must be two numbers")
    return FalseCollisions(
        count=free.get("false_collisions", int),
        low=interval[0],
        high=interval[1],
        promised=free.number("promised_per_hour"),
        kept=free.get("promise_kept", bool),
        consistent=free.get("promise_consistent", bool),
    )


def read_latched(entry: Entry) -> Latched | None:
    if not entry.content:
        return None
    counts = ("collisions", "latched", "strong", "strong_latched")
    return Latched(
        **{key: entry.get(key, int, needed=True) for key in counts},
        delay_median_s=entry.number("delay_against_sensor_median_s"),
        delay_p95_s=entry.number("delay_against_sensor_p95_s"),
        onset_median_s=entry.number("delay_median_s"),
        onset_p95_s=entry.number("delay_p95_s"),
        unhealthy=entry.get("unhealthy", int) or 0,
    )


def read_point(entry: Entry) -> CurvePoint:
    return CurvePoint(
        scale=entry.number("scale", needed=True),
        false_per_hour=entry.number("false_per_hour"),
        missed=entry.get("missed", int, needed=True),
    )


def read_strength(entry: Entry) -> StrengthBin:
    return StrengthBin(
        low_nm=entry.number("peak_nm_from", needed=True),
        high_nm=entry.number("peak_nm_to"),
        **{key: entry.get(key, int, needed=True) for key in ("collisions", "latched")},
        **entry.each_number("delay_median_s", "delay_p95_s"),
    )


def read_aftermath(entry: Entry, joints: int) -> Aftermath:
    return Aftermath(
        hours=entry.number("hours", needed=True),
        **{key: entry.number(key) for key in ("from_s", "to_s", "contacts_per_hour", "collisions_per_hour")},
        rmse_nm=entry.numbers("rmse_nm", joints),
    )


def read_sigma(entry: Entry, joints: int) -> dict[str, tuple[SigmaRegion, ...]]:
    if not entry.content:
        return {}
    regions = {region: tuple(map(read_sigma_region, entry.entries(region))) for region in ("sliding", "near_stiction")}
    if any(len(of_joints) != joints for of_joints in regions.values()):
        raise ConfigError(f"{entry.place}: each region must hold {joints} entries, one a joint")
    return regions


def read_sigma_region(entry: Entry) -> SigmaRegion:
    return SigmaRegion(
        samples=entry.get("samples", int, needed=True),
        **entry.each_number("within_one_sigma", "within_two_sigma"),
        bins=tuple(
            SigmaBin(
                samples=one.get("samples", int, needed=True),
                sigma_rms_nm=one.number("sigma_rms_nm", needed=True),
                error_rms_nm=one.number("error_rms_nm", needed=True),
            )
            for one in entry.entries("bins")
        ),
    )


def read_sanity(entry: Entry) -> SanityRow:
    return SanityRow(
        name=entry.text("name", needed=True),
        **entry.each_number("false_per_hour", "time_in_alarm_share"),
        **{key: entry.get(key, int, needed=True) for key in ("collisions", "found", "latched")},
        worth=entry.text("worth") or "",
    )


def read_injected(entry: Entry) -> Injected | None:
    """Entry `injected` of a bundle; None where the evaluation added no forces."""
    if not entry.content:
        return None
    return Injected(
        unit=entry.text("unit", needed=True),
        events=entry.get("events", int, needed=True),
        unhealthy=entry.get("unhealthy", int, needed=True),
        curves=tuple(read_curve(one) for one in entry.entries("curves", needed=True)),
        without_forces=entry.text("without_forces"),
        left_out=entry.texts("left_out"),
        blind=entry.texts("blind"),
    )


def read_curve(entry: Entry) -> InjectedCurve:
    return InjectedCurve(
        place=entry.text("place", needed=True),
        shape=entry.text("shape", needed=True),
        events=entry.get("events", int, needed=True),
        latched=entry.get("latched", int, needed=True),
        **entry.each_number("nine_of_ten", "delay_median_s", "delay_p95_s"),
        bins=tuple(
            PeakBin(
                peak_from=one.number("peak_from", needed=True),
                peak_to=one.number("peak_to", needed=True),
                events=one.get("events", int, needed=True),
                latched=one.get("latched", int, needed=True),
                delay_median_s=one.number("delay_median_s"),
            )
            for one in entry.entries("bins", needed=True)
        ),
    )


# --- Reads results.json; docs/files.md is its contract.


def load_results(folder: Path) -> Results:
    """Read `results.json` of a results folder. A number may be null, or absent: it is None then.

    Raises:
        ConfigError: no such file, not JSON, another format, or an entry of the wrong kind, with its place.
    """
    path = folder / "results.json"
    try:
        content = json_of(read_text(path), refuse_constant)
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: there are no such results; `tauext evaluate` writes them") from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: not readable as JSON ({error}); evaluate again") from error
    expect_format(content, path, "evaluate again")
    return read_results(Entry(str(path), content))


def refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON number; null stands for a number that does not exist")


def read_results(top: Entry) -> Results:
    """The whole of results.json."""
    joints = top.texts("joints", needed=True)
    entries = top.entries("bundles", needed=True)
    if not joints or not entries:
        raise ConfigError(f"{top.place}: it holds no {'bundle' if joints else 'joints'}; evaluate at least one bundle")
    bundles = tuple(read_bundle(entry, len(joints)) for entry in entries)
    collisions = [read_collision(entry, len(joints)) for entry in top.entries("collisions")]
    return Results(
        provenance=top.object("provenance").content,
        joints=joints,
        near_stiction_rad_s=top.number("near_stiction_rad_s", needed=True),
        ten=top.texts("ten_collisions"),
        collisions={collision.id: collision for collision in collisions},
        bundles=tuple(sorted(bundles, key=lambda bundle: place(bundle.name))),
        events=read_events(top),
        touches=read_touches(top),
        sanity=tuple(read_sanity(entry) for entry in top.entries("sanity")),
    )


def read_collision(entry: Entry, joints: int) -> Collision:
    link = entry.get("link", int)
    return Collision(
        id=entry.text("id", needed=True),
        recording=entry.text("recording", needed=True),
        kind=entry.text("kind") or "unknown",
        start_s=entry.number("start_s", needed=True),
        end_s=entry.number("end_s", needed=True),
        link=-1 if link is None else link,
        sensor_peak_nm=entry.numbers("sensor_peak_nm", joints),
    )


def read_bundle(entry: Entry, joints: int) -> EvaluatedBundle:
    free, limits = entry.object("free_motion"), entry.object("limits")
    measures = ("l1_nm", "l2_nm", "mse_nm2", "observer_peak_nm")
    errors: dict[str, Any] = {key: free.numbers(key, joints) for key in measures}
    name = entry.text("name", needed=True)
    return EvaluatedBundle(
        name=name,
        recipe=entry.text("recipe"),
        **{key: entry.get(key, int) for key in ("steps", "epochs", "batch", "ten_found")},
        recordings=free.texts("recordings"),
        **{key: free.get(key, int) for key in ("samples", "false_alarms")},
        **free.each_number("hours", "false_alarms_per_hour"),
        **errors,
        rmse_near_stiction_nm=free.numbers("rmse_near_stiction_nm", joints),
        rmse_sliding_nm=free.numbers("rmse_sliding_nm", joints),
        near_stiction_share=free.numbers("near_stiction_share", joints),
        limit_sliding_nm=limits.numbers("sliding_nm", joints),
        limit_near_stiction_nm=limits.numbers("near_stiction_nm", joints),
        verdicts={e.text("id", needed=True): read_verdict(e) for e in entry.entries("collisions")},
        found_curve=tuple(read_bin(e) for e in entry.entries("found_curve")),
        loss_history=entry.loss_history("loss_history"),
        measured=read_measured(entry, joints),
        limits_move=bool(limits.get("moving", bool)),
        estimate_units=entry.texts("estimate_units", needed=True),
        rejected_share=entry.object("rejected").number("share"),
        rejected_causes=tuple(entry.object("rejected").object("causes").content),
        changed=read_changed(entry.object("changed_since_training")),
    )


def read_changed(entry: Entry) -> tuple[tuple[str, str], ...]:
    return tuple((key, entry.text(key, needed=True)) for key in entry.content)


def read_verdict(entry: Entry) -> Verdict:
    times = ("delay_s", "sensor_delay_s", "delay_against_sensor_s")
    return Verdict(
        found=entry.get("found", bool, needed=True),
        joint=entry.text("joint"),
        **{key: entry.number(key) for key in times},
    )


def read_bin(entry: Entry) -> CurveBin:
    return CurveBin(
        low=entry.number("peak_over_limit_from", needed=True),
        high=entry.number("peak_over_limit_to"),
        collisions=entry.get("collisions", int, needed=True),
        found=entry.get("found", int, needed=True),
    )


# --- Results are drawn with the dataset that they were measured on, and with no other.


NAMED = 3
"""So many of the recordings are named."""


def expect_same_dataset(results: Results, results_dir: Path, dataset_dir: Place) -> None:
    """Raise ConfigError where the dataset's recordings are not those that were evaluated.

    One that is missing is said on the page where it would stand; a dataset that has none of them is another one.
    """
    judged = Entry(f"{results_dir / 'results.json'}, provenance", results.provenance).object("recordings")
    there = [name for name in judged.content if (dataset_dir / f"{name}.parquet").is_file()]
    other = [name for name in there if fingerprint(dataset_dir / f"{name}.parquet") != judged.text(name)]
    missing = bool(judged.content) and not there and (dataset_dir / FILE_NAME).is_file()
    if not other and not missing:
        return
    names = other or list(judged.content)
    told = ", ".join(names[:NAMED]) + (f" and {len(names) - NAMED} more" if len(names) > NAMED else "")
    what = "are not those that were evaluated" if other else "are not in it"
    raise ConfigError(
        f"{dataset_dir}: it is another dataset than that of {results_dir}, '{results.provenance.get('dataset')}': "
        f"{told} {what}; give the dataset that was evaluated, or evaluate this one"
    )
