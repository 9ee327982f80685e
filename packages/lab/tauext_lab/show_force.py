"""`tauext show --force`: what force on a link a bundle notices."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from tauext.errors import ConfigError
from tauext.progress import aligned

if TYPE_CHECKING:
    from tauext._core import Bundle
    from tauext_lab.evaluate.results import NoticedAt, NoticedForce

UNOBSERVABLE = ">1000"


def show_force(file: Path, as_json: bool, data: Sequence[Path], frames: Sequence[str], picture: Path | None) -> None:
    """Print the smallest force on a link that a bundle detects, and draw it if `picture` is given."""
    if file.suffix != ".tauext":
        raise ConfigError(f"{file}: --force needs a bundle (*.tauext)")
    expect_picture(picture)
    conditions, found = describe_force(file, data, frames)
    if picture is not None:
        from tauext_lab.report.force_figures import write_noticed_picture

        write_noticed_picture(found, picture)
    if as_json:
        from tauext_lab.evaluate.results import to_json

        print(json.dumps(conditions | to_json(found), indent=1))
    else:
        print("\n".join(force_lines(conditions, found)))


def describe_force(file: Path, data: Sequence[Path], frames: Sequence[str]) -> tuple[dict, NoticedForce]:
    """Forces that a bundle's limits notice, over the poses of recordings or over those that it keeps.

    Before them the bundle, the origin of the poses, and the torque error.

    Raises:
        BundleError: it estimates no forces, or keeps no poses and no recording is given.
        ConfigError: there is no such frame or recording.
    """
    from tauext.bundle.bundle_file import load_bundle
    from tauext.bundle.units import largest_share
    from tauext.train.hits import points
    from tauext_lab.evaluate.noticed_force import noticed_in_usual_motion

    bundle = load_bundle(file)
    points(bundle, frames)  # refuses before hours of recordings are read
    if data:
        found = over_recordings(bundle, data, frames)
        of = f"of {', '.join(path.name for path in data)}, with the thresholds that applied there"
    else:
        found = noticed_in_usual_motion(bundle, frames)
        of = (
            "that the bundle keeps of its training's motion, with its thresholds in usual motion (after a stop or "
            "while it speeds up they are higher; --data shows them)"
        )
    return {"bundle": bundle.name, "poses_of": of, "torque_share": largest_share(bundle)}, found


def over_recordings(bundle: Bundle, data: Sequence[Path], frames: Sequence[str]) -> NoticedForce:
    """Recordings are loaded one at a time."""
    from tauext.data.recording_file import load_recording
    from tauext.monitor.estimate import estimate_recording
    from tauext_lab.evaluate.comparison import free_part
    from tauext_lab.evaluate.free_motion import LimitsHeld

    held = LimitsHeld()
    for path in data:
        if not path.is_file():
            raise ConfigError(f"{path}: there is no such recording; --data takes recordings (*.parquet)")
        recording = load_recording(path)
        estimates = estimate_recording(bundle, recording)
        held.add(recording, free_part(recording, estimates))
    found = held.summary(bundle, frames)
    if found is None:
        raise ConfigError(
            f"{', '.join(map(str, data))}: no sample of free motion has thresholds; give longer recordings"
        )
    return found


def expect_picture(picture: Path | None) -> None:
    """Raise ConfigError where no picture could be written."""
    from tauext.files.preflight import expect_new_file

    if picture is not None:
        if picture.suffix != ".png":
            raise ConfigError(f"{picture}: a picture's name ends in .png")
        expect_new_file(picture)


def force_lines(conditions: dict, found: NoticedForce) -> list[str]:
    """The tables, with the conditions under which they hold."""
    from tauext_lab.report.force_figures import CLOSING, joined, left_out_words, surely

    lines = [
        f"{conditions['bundle']}: minimum detectable force [N], over {found.poses} poses {conditions['poses_of']}.",
        "x, y, z (of the base) and the worst way: median pose / worst pose. "
        "Every way: median over poses and ways / 9 of 10 are below it.",
        f"{UNOBSERVABLE}: unobservable, more than 1000 N or no joint feels it at all.",
    ]
    for name, entries in joined(found.limits).items():
        lines += ["", f"threshold: {name}", *aligned([HEADING, *map(cells, entries)])]
    holds, error_share = found.hold_s, found.error_share or 0.0
    levels = [f"{k} after {1e3 * s:.0f} ms (hold time {1e3 * holds[k]:g} ms)" for k, s in found.twice_after_s.items()]
    return [
        *lines,
        "",
        f"Of a force that stays: the observer shows 1 - exp(-K0 t) of it, K0 = {found.gain_per_s:g} 1/s. "
        f"Twice such a force is reported as a {' and as a '.join(levels)}. A shorter impact may peak higher "
        "undetected.",
        f"The estimate of such a force errs by {error_share:.0%} of it (one standard error; the torque constants alone "
        f"by {conditions['torque_share']:.0%}): 19 of 20 forces exceed the threshold from {surely(error_share):.2g} "
        "times these on. A joint at rest may hide a push behind its friction.",
        *([without] if (without := left_out_words(found.left_out)) else []),
        CLOSING,
    ]


HEADING = ["", "every way", "x", "y", "z", "worst way", "unobservable in"]


def cells(at: NoticedAt) -> list[str]:
    """A row of the table."""
    every = f"{force(at.every_way.median_n)} / {force(at.every_way.nine_of_ten_n)}"
    ways = (f"{force(way.median_n)} / {force(way.worst_n)}" for way in (at.x, at.y, at.z, at.worst_way))
    return [at.place, every, *ways, f"{at.worst_way.blind_share:.0%} of poses"]


def force(value: float | None) -> str:
    return UNOBSERVABLE if value is None else f"{value:.3g}" if value < 100 else f"{value:.0f}"
