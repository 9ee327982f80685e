"""The page of a benchmark: for each track its table and its curve, and what is missing."""

from __future__ import annotations

import base64
from io import BytesIO
from pathlib import Path
from typing import Any

import jinja2
from matplotlib import rc_context
from matplotlib.figure import Figure

from tauext.files.atomic_write import atomic_write
from tauext_lab.report.style import DPI, RC, bundle_strokes

COLUMNS = (
    "method", "detected at equal false alarms", "over events", "over recordings", "delay, ms",
    "own thresholds: detected", "false", "L1 free, N m", "L1 in contact", "training, min", "µs a sample",
)  # fmt: skip


def write_page(content: dict[str, Any], path: Path) -> None:
    """Write the page of a bench.json: one file that needs no network."""
    loader = jinja2.FileSystemLoader(Path(__file__).parents[1] / "report")
    template = jinja2.Environment(loader=loader, autoescape=True).get_template("bench.html.j2")
    look = (Path(__file__).parents[1] / "report/look.css").read_text()
    tracks = [
        track
        | {
            "rows": [row_of(one) for one in track["methods"]],
            "curve": curve(track) if track["methods"] else "",
            "hours": hours_of(track),
        }
        for track in content["tracks"]
    ]
    text = template.render(content | {"tracks": tracks}, look=look, columns=COLUMNS, overview=overview(content))
    with atomic_write(path) as part:
        part.write_text(text)


def overview(content: dict[str, Any]) -> list[list[str]]:
    """A row for each method with the contacts that it detects on each track at equal false alarms; heading first."""
    found = {
        track["name"]: {one["name"]: f"{one['equal']['found']}/{one['equal']['contacts']}" for one in track["methods"]}
        for track in content["tracks"]
    }
    methods = dict.fromkeys(name for of_track in found.values() for name in of_track)
    return [["method", *found], *([name, *(one.get(name, "–") for one in found.values())] for name in methods)]


def hours_of(track: dict[str, Any]) -> str:
    """Free hours and contacts of the test, as a sentence."""
    if not track["methods"]:
        return "No method has a result."
    first = track["methods"][0]
    at, minutes = first["equal"], 60 * first["equal"]["hours"]
    return (
        f"Test: {at['contacts']} contacts and {minutes:.1f} minutes of free time in {first['recordings']} recordings."
    )


def row_of(one: dict[str, Any]) -> list[str]:
    """Cells of a method's row."""
    equal, own = one["equal"], one["own"]
    return [
        one["name"],
        f"{equal['found']} of {equal['contacts']} ({equal['false']} false)",
        share(equal["found_share"]),
        share(equal["found_over_recordings"]),
        milliseconds(equal),
        f"{own['found']} of {own['contacts']}",
        f"{own['false']} ({' to '.join(f'{x:.1f}' if x < 10 else f'{x:.0f}' for x in own['false_per_hour'])} an hour)",
        numbers(one["l1_free"]),
        numbers(one["l1_contact"]),
        f"{one['training_minutes']:.1f}",
        f"{one['us_per_sample']:.2g}",
    ]


def share(interval: list[float] | None) -> str:
    """A 95 % interval of a share in percent."""
    return "–" if interval is None else f"{100 * interval[0]:.0f} to {100 * interval[1]:.0f} %"


def milliseconds(point: dict[str, Any]) -> str:
    """Median and 95 % quantile of delays."""
    median, late = point["delay_median_s"], point["delay_p95_s"]
    return "–" if median is None else f"{1e3 * median:.0f}, {1e3 * late:.0f}"


def numbers(values: list[float] | None) -> str:
    """One number a joint."""
    return "–" if values is None else "/".join(f"{value:.2f}" for value in values)


def curve(track: dict[str, Any]) -> str:
    """Detected contacts over measured false alarms an hour, a PNG in base64."""
    strokes = bundle_strokes([one["name"] for one in track["methods"]])
    with rc_context(RC):
        figure = Figure(figsize=(7.2, 3.6), layout="constrained")
        axes = figure.subplots()
        for one in track["methods"]:
            hours, contacts = one["equal"]["hours"], max(1, one["equal"]["contacts"])
            rates = [false / hours for false, *_ in one["curve"]]
            found = [100 * found / contacts for _, found, _ in one["curve"]]
            stroke = strokes[one["name"]] | {"markersize": 4, "markevery": max(1, len(rates) // 12)}
            axes.step(rates, found, where="post", label=one["name"], **stroke)
        axes.set_xlabel("measured false alarms an hour, as all thresholds of a method are scaled by one factor")
        axes.set_ylabel("contacts detected, %")
        axes.set_ylim(0, 103)
        axes.set_xlim(left=0)
        figure.legend(loc="outside lower center", ncols=4)
        buffer = BytesIO()
        figure.savefig(buffer, format="png", dpi=DPI)
    return base64.b64encode(buffer.getvalue()).decode()
