"""Reads results.json; docs/files.md is its contract."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tauext.errors import ConfigError
from tauext.files.plain_file import json_of, read_text
from tauext.report.entry import Entry
from tauext.report.events import read_events
from tauext.report.methods_file import read_measured, read_sanity
from tauext.report.naming import place
from tauext.report.results import Collision, CurveBin, EvaluatedBundle, Results, Verdict
from tauext.report.touches import read_touches

FORMATS = (2, 3)
"""What differs: the list of bundles is called `cases` in format 2."""


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
    if not isinstance(content, dict) or content.get("format") not in FORMATS:
        found = content.get("format") if isinstance(content, dict) else None
        readable = " and ".join(map(str, FORMATS))
        raise ConfigError(f"{path}: its format is {found!r}, this version reads {readable}; evaluate again")
    if content["format"] == 2 and "cases" in content:
        content["bundles"] = content.pop("cases")
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
        recording=entry.text("recording", needed=True).removesuffix(".parquet"),
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
        recordings=tuple(recording.removesuffix(".parquet") for recording in free.texts("recordings")),
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
        estimate_units=entry.texts("estimate_units") or ("N m",) * joints,
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
