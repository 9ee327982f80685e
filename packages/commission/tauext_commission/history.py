"""What the limits of a commissioned arm are set for and what happened, and its history in words."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tauext.bundle.units import in_terms
from tauext.errors import ConfigError, TauextError
from tauext.files.atomic_write import atomic_write
from tauext.fit.tail import FalseAlarmBudget, duration, is_kept
from tauext.monitor.monitored_time import percent
from tauext_commission.budget import Promise, chosen_alarm, once_in, promise_of
from tauext_commission.history_file import (
    active_bundle,
    left_out,
    lost_lines,
    lost_words,
    monitored_of,
    read_coverage,
    read_events,
    read_facts,
    read_findings,
    read_history,
    received_s,
    unusable_words,
    watches,
)

# --- What the bundle in charge is set for, and its false alarms.


MENTIONED = 0.999
"""Monitored share below which it is stated with the false alarms."""


@dataclass(frozen=True)
class Kept:
    """What the limits of a bundle are set for, and what happened while it monitored."""

    bundle: str
    promise: Promise
    hours: float
    """Hours that it monitored: with a valid estimate, in time."""
    false_alarms: Sequence[dict[str, Any]]
    """Collision alarms that a person answered with `nothing`, as read_events() returns them."""
    unanswered: int
    """Collision alarms without an answer, which may be false."""
    of_hours: float = 0.0
    """Hours that it was in charge while the arm was connected; 0: not counted."""

    @property
    def false(self) -> int:
        """Number of false alarms."""
        return len(self.false_alarms)

    @property
    def kept(self) -> bool:
        """Whether so many false alarms are plausible at the largest rate that the limits state."""
        most = self.promise.at_most_per_hour
        return most is None or not self.hours or is_kept(self.false, self.hours, most)

    def counted(self) -> str:
        """Counted false alarms, and whether they agree with what the limits are set for; empty: nothing is counted."""
        if not self.hours:
            return ""
        happened = f"{self.false} false alarm{'s' * (self.false != 1)} in {duration(self.hours)}"
        if self.of_hours and (share := self.hours / self.of_hours) < MENTIONED:
            happened += f" (monitored {percent(share)} of {duration(self.of_hours)})"
        if self.unanswered:
            happened += f", {self.unanswered} alarm{'s' * (self.unanswered != 1)} without an answer"
        return happened if self.promise.per_hour is None else f"{happened}: {'kept' if self.kept else 'BROKEN'}"

    def words(self) -> str:
        """What the limits are set for, what the data prove, and what was counted."""
        return f"{self.bundle}: {self.promise.words()}" + (f" Counted: {one}." if (one := self.counted()) else "")


def kept_of(folder: Path, bundle: str, seconds: float) -> Kept:
    """What a bundle of this folder is set for and what happened, up to so many received seconds."""
    counted = monitored_of(read_coverage(folder)).get(bundle)
    if counted is None:  # coverage.json is lost
        counted = (sum(w.to_s - w.from_s for w in watches(read_history(folder), seconds) if w.bundle == bundle), 0.0)
    hours, of_hours = (one / 3600 for one in counted)
    alarms = [one for one in read_events(folder) if one.get("bundle") == bundle and one.get("level") == "collision"]
    false = [one for one in alarms if one.get("answer") == "nothing"]
    unanswered = sum(one.get("answer") is None for one in alarms) + left_out(folder).get(bundle, 0)
    return Kept(bundle, promise_of(folder, bundle), hours, false, unanswered, of_hours)


def monitored_words(coverage: dict[str, Any]) -> str | None:
    """`97.2 % of the last hour, 98.1 % of 12.3 hours in all`; None: nothing is counted yet."""
    sums = list(monitored_of(coverage).values())
    seconds, of_seconds = (sum(one) for one in zip(*sums, strict=True)) if sums else (0.0, 0.0)
    if not of_seconds:
        return None
    hour = coverage.get("monitored_hour")
    newest = f"{percent(hour)} of the last hour, " if isinstance(hour, float) and of_seconds > 3600 else ""
    return f"{newest}{percent(seconds / of_seconds)} of {duration(of_seconds / 3600)} in all"


# --- A folder for `tauext show`.


def describe_folder(folder: Path) -> dict[str, Any]:
    """What a folder of `tauext commission` holds, as plain JSON.

    Raises:
        ConfigError: its commission.json is damaged.
    """
    facts, history, events = read_facts(folder), read_history(folder), read_events(folder)
    coverage = read_coverage(folder)
    seconds, active, chosen = received_s(folder), active_bundle(folder), chosen_alarm(folder)
    content: dict[str, Any] = {
        "source": facts.get("source"),
        "created": facts.get("created"),
        "bundle": None if active is None else active.stem,
        "received_hours": round(seconds / 3600, 3),
        "kept_minutes": round(float(coverage.get("kept_s") or 0.0) / 60, 2),
        "dropped_hours": round(float(coverage.get("dropped_s") or 0.0) / 3600, 3),
        "recordings_gb": round(float(coverage.get("bytes") or 0.0) / 1e9, 3),
        "trainings": sum(one["kind"] == "training" for one in history),
        "bundles_in_charge": sum(one["kind"] == "activation" for one in history),
        "lost_lines": lost_lines(folder),
        "unusable_lines": unusable_words(folder),
        "alarms": len(events),
        "touched": sum(one.get("answer") == "touched" for one in events),
        "nothing": sum(one.get("answer") == "nothing" for one in events),
        "unanswered": sum(one.get("answer") is None for one in events),
        "missing": {one["joint"]: one["missing"] for one in coverage.get("joints", ()) if one.get("missing")},
        "monitored": monitored_words(coverage),
        "budget": str(FalseAlarmBudget(chosen.false_alarms, chosen.in_hours)),
        "limits": None if active is None else kept_of(folder, active.stem, seconds).words(),
        "history": [{key: one.get(key) for key in ("wall", "kind", "words")} for one in history],
    }
    return content


# --- Several arms in one table for `tauext report`.


COLUMNS = ("arm", "since", "monitored", "set for", "proved", "alarms", "false", "last training", "warnings")


def arm_row(folder: Path) -> tuple[str, ...]:
    """A commissioned arm in words, by COLUMNS; of a damaged folder its name and the damage."""
    try:
        return _arm_row(folder)
    except TauextError as error:
        why = str(error)
    except Exception as error:  # whatever is wrong with one arm, the others have their rows
        why = f"its files are damaged ({type(error).__name__}: {error})"
    return (folder.name, *[""] * (len(COLUMNS) - 2), why)


def _arm_row(folder: Path) -> tuple[str, ...]:
    content, history = describe_folder(folder), read_history(folder)
    since = next((one.get("wall") for one in history if one["kind"] in ("exchange", "activation")), "")
    trained = [one for one in history if one["kind"] == "training"]
    active, set_for, proved = active_bundle(folder), "no bundle yet", ""
    if active is not None:
        kept = kept_of(folder, active.stem, 3600 * content["received_hours"])
        set_for, rate = f"{kept.promise.short()}: {'kept' if kept.kept else 'BROKEN'}", kept.promise.proved_per_hour
        proved = "" if rate is None else once_in(rate, "down")
    warnings = [
        f"{one['joint']}: {one.get('words')}" if one.get("joint") else str(one.get("words"))
        for one in read_findings(folder)
        if one.get("severity") in ("fault", "warning")
    ]
    if lost := content["lost_lines"]:
        warnings.insert(0, lost_words(lost, content["unusable_lines"]))
    return (
        folder.name,
        str(since or "")[:10],
        content["monitored"] or "",
        set_for,
        proved,
        str(content["alarms"]),
        str(content["nothing"]),
        f"{str(trained[-1].get('wall'))[:10]} {'passed' if trained[-1].get('passed') else 'did not pass'}"
        if trained
        else "",
        "; ".join(warnings),
    )


def write_arms(folders: Sequence[Path], out: Path) -> list[tuple[str, ...]]:
    """Write OUT/arms.html, a row for each commissioned arm; returns the rows.

    Raises:
        ConfigError: the page cannot be written.
    """
    rows = [arm_row(folder) for folder in folders]
    write_page(out / "arms.html", "Commissioned arms", [table("", COLUMNS, rows)])
    return [COLUMNS, *rows]


# --- A page of the history for `tauext report`.


def write_history(folder: Path, out: Path) -> Path:
    """Write OUT/history.html, one file: state, trainings, what limits are set for and what happened, and alarms.

    Raises:
        ConfigError: the folder is damaged, or the page cannot be written.
    """
    content, history = describe_folder(folder), read_history(folder)
    trainings = [one for one in history if one["kind"] == "training"]
    promises = [one for one in history if one["kind"] == "promise"]
    state = [(in_terms(key), in_words(value)) for key, value in content.items() if key != "history"]
    parts = [
        table("State", ("", ""), state),
        chart(trainings, promises),
        table(
            "Trainings",
            ("bundle", "minutes", "error of each joint", "detected hits", "false alarms an hour", "result"),
            [[in_words(one.get(key)) for key in ("bundle", "minutes", "error", "hits", "per_hour", "words")]
             for one in trainings],
        ),
        table(
            "What thresholds are set for, and what happened",
            ("time", "bundle", "set for an hour", "proved an hour", "hours", "false alarms", "kept", ""),
            [[in_words(one.get(key)) for key in
              ("wall", "bundle", "promised_per_hour", "proved_per_hour", "hours", "alarms", "kept", "words")]
             for one in promises],
        ),
        table(
            "Alarms",
            ("number", "time", "bundle", "what", "", "answer"),
            [[in_words(one.get(key)) for key in ("id", "wall", "bundle", "sentence", "details", "answer")]
             for one in read_events(folder)],
        ),
        table("History", ("time", ""), [(in_words(one.get("wall")), in_words(one["words"])) for one in history]),
    ]  # fmt: skip
    return write_page(out / "history.html", f"{folder.name}: history of a commissioned arm", parts)


def write_page(path: Path, title: str, parts: Sequence[str]) -> Path:
    """Write a page of HTML and return its path.

    Raises:
        ConfigError: it cannot be written.
    """
    style = (
        "body{font:15px/1.5 system-ui,sans-serif;margin:2em auto;max-width:64em;padding:0 1em;color:#222;"
        "background:#fff}table{border-collapse:collapse}td,th{padding:.2em .8em .2em 0;text-align:left;"
        "vertical-align:top;border-bottom:1px solid #8884;min-width:4.5em;max-width:18em}.wide{overflow-x:auto}"
        "svg{display:block;width:100%;max-width:34em}"
        "@media(prefers-color-scheme:dark){body{color:#ddd;background:#181818}}"
    )
    title = html.escape(title)
    head = '<!doctype html><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">'
    head += '<meta name="color-scheme" content="light dark">'
    text = f"{head}<title>{title}</title><style>{style}</style><h1>{title}</h1>"
    try:
        with atomic_write(path) as part:
            part.write_text(text + "".join(parts) + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error
    return path


def in_words(value: Any) -> str:
    """A value for people; numbers with three digits."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.3g}"
    if isinstance(value, list | tuple):
        return ", ".join(map(in_words, value))
    if isinstance(value, dict):
        return "; ".join(f"{key}: {in_words(one)}" for key, one in value.items()) or "nothing"
    return "" if value is None else str(value)


def table(title: str, head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table of HTML; empty without rows."""
    if not rows:
        return ""
    lines = [f"<h2>{html.escape(title)}</h2>" * bool(title) + '<div class="wide"><table>']
    if any(head):
        lines.append("<tr>" + "".join(f"<th>{html.escape(one)}</th>" for one in head) + "</tr>")
    lines += ["<tr>" + "".join(f"<td>{html.escape(one)}</td>" for one in row) + "</tr>" for row in rows]
    return "".join([*lines, "</table></div>"])


def chart(trainings: Sequence[dict[str, Any]], promises: Sequence[dict[str, Any]]) -> str:
    """Detected hits and the target time of a false alarm over received hours, as SVG."""
    rows = (
        ("Detected hits, %", [(one["seconds"], one.get("hits")) for one in trainings], 100.0, 100.0),
        ("Target: hours to one false alarm", [
            (one["seconds"], 1 / rate) for one in promises if (rate := one.get("promised_per_hour"))], 1.0, None),
    )  # fmt: skip
    drawn = []
    for title, points, times, most in rows:
        known = [(float(x) / 3600, times * float(y)) for x, y in points if y is not None]
        if known:
            drawn.append(f"<h2>{html.escape(title)}</h2>{curve(known, most or max(y for _, y in known))}")
    return "".join(drawn)


def curve(points: Sequence[tuple[float, float]], most: float) -> str:
    """A line through points (hours, value), with axes from 0 to the last hour and to `most`, as SVG."""
    across, up = ticks(max(x for x, _ in points)), ticks(most)
    at = [(40 + 340 * x / across[-1], 130 - 120 * y / up[-1]) for x, y in points]
    grid = [f'<path d="M40 {130 - 120 * y / up[-1]:.1f}H380" stroke="#8886"/>' for y in up]
    grid += [f'<path d="M{40 + 340 * x / across[-1]:.1f} 130v4" stroke="currentColor"/>' for x in across]
    words = [(34.0, 134 - 120 * y / up[-1], "end", f"{y:g}") for y in up]
    words += [(40 + 340 * x / across[-1], 147.0, "middle", f"{x:g}") for x in across]
    words.append((210.0, 164.0, "middle", "received motion, h"))
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in at)
    return "".join(
        [
            '<svg viewBox="0 0 400 170" role="img" font-size="12" fill="currentColor">',
            *grid,
            *(f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}">{text}</text>' for x, y, anchor, text in words),
            f'<polyline points="{line}" fill="none" stroke="currentColor" stroke-width="2"/>',
            *(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3"/>' for x, y in at),
            "</svg>",
        ]
    )


def ticks(most: float) -> list[float]:
    """Round numbers from 0 to the first that is `most` or more, five intervals at most."""
    step = 10.0 ** math.floor(math.log10(most)) / 10 if most > 0 else 1.0
    step *= next(times for times in (1, 2, 5, 10, 20) if 5 * times * step >= most)
    return [step * k for k in range(max(math.ceil(most / step - 1e-9), 1) + 1)]
