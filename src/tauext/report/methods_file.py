"""Reads what results.json holds beyond the paper's own measures."""

from __future__ import annotations

from tauext.errors import ConfigError
from tauext.report.entry import Entry
from tauext.report.injected import Injected, InjectedCurve, PeakBin
from tauext.report.methods import (
    Aftermath,
    CurvePoint,
    FalseCollisions,
    Latched,
    Measured,
    SanityRow,
    SigmaBin,
    SigmaRegion,
    StrengthBin,
)
from tauext.report.noticed_file import read_noticed


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
