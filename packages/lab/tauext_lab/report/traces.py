"""The interactive traces of a page: which recordings they show, and their part of it, data and script inside."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from tauext.bundle.estimates import Estimates
from tauext.data.dataset import ahead
from tauext.data.recording import Recording
from tauext.data.recording_file import describe
from tauext.errors import ConfigError
from tauext_lab.evaluate.results import EvaluatedBundle, Results
from tauext_lab.report.flight_file import Flight
from tauext_lab.report.signals import NotAvailable, Signals
from tauext_lab.report.style import CASE_COLOURS, bundle_colours, uncertainty_words
from tauext_lab.report.tables import render_template
from tauext_lab.report.trace_packing import METHOD_SIGNALS, Plan, Traced, pack, trace

FOLDER = Path(__file__).parent
SCRIPTS = ("traces_data.js", "traces_view.js", "traces_control.js")
PAGE_MB = 9.5
"""Default size of the whole page; traces get what figures and tables leave."""
LEAST_MB, SCRIPT_MB = 0.3, 0.05
"""With less room there are no traces; what script and controls take."""
HOUR_S = 3600.0
FREE_EVERY = 4
"""One recording in so many is of free motion, while both last."""
ROOM = 5
"""For so many methods, unless they are chosen."""


@dataclass(frozen=True)
class PageTraces:
    """The traces' part of a page, and the recordings in it."""

    html: str
    recordings: tuple[str, ...] = ()


NO_TRACES = PageTraces("")


@dataclass(frozen=True)
class Words:
    """What the page calls things."""

    learned: str
    """Taken off the observer's output: prior, network, drift."""
    units: list[str]
    """Units of the torques, one a joint."""


def results_traces(results: Results, signals: Signals, room: float, methods: Sequence[str] = ()) -> PageTraces:
    """Traces of recordings with contacts and of free motion, an hour in all, with the estimates of methods.

    Args:
        room: bytes that they may take.
        methods: names of bundles; none: the five best of them.

    Raises:
        ConfigError: there is no bundle of such a name.
        NotAvailable: no recording is there with its estimates, or there is too little room.
        RecordingError: a file is damaged, or of another recording.
    """
    bundles = chosen_bundles(results, methods)
    there = [name for name in recordings_of(results) if is_there(name, bundles, signals)]
    if not there:
        raise NotAvailable("no recording is there with its estimates")
    heads = [describe(signals.dataset_dir / f"{name}.parquet") for name in there]
    until_s = np.cumsum([head.samples / head.rate_hz for head in heads])
    shown = there[: max(int((until_s <= HOUR_S).sum()), 1)]
    samples = sum(head.samples for head in heads[: len(shown)])
    plan = make_plan(samples, len(results.joints), len(bundles), room)
    traced: list[Traced] = []
    learned: set[str] = set()

    def read(name: str) -> tuple[Recording, dict[str, Estimates]]:
        recording = signals.recording(name)
        return recording, signals.by_bundle([bundle.name for bundle in bundles], recording)[0]

    for recording, estimates in ahead([partial(read, name) for name in shown]):
        learned |= {uncertainty_words([one]) for one in estimates.values()}
        first = [(touch.start_s, touch.end_s) for touch in results.ten if touch.recording == recording.name]
        traced.append(trace(recording, estimates, plan.size, plan.windows(recording), first))
    colours = bundle_colours([bundle.name for bundle in results.bundles])
    listed = [
        {"name": bundle.name, "label": bundle.label, "colour": colours[bundle.name], "on": bundle is bundles[0]}
        for bundle in bundles
    ]
    left = [bundle.label for bundle in results.bundles if bundle not in bundles]
    note = f"{len(shown)} of the {len(there)} recordings that have estimates, " if len(shown) < len(there) else ""
    note += "an hour at most. " if note else ""
    note += f"Methods left out: {', '.join(left)}; --trace-methods chooses. " if left else ""
    units = [results.unit_of(joint) for joint in range(len(results.joints))]
    words = Words(learned.pop() if len(learned) == 1 else "what was learned", units)
    return section(traced, results.joints, listed, plan.room, note, words)


def flight_traces(flight: Flight, room: float) -> PageTraces:
    """Traces of one flight, with its monitor's estimates; every sample of the event comes first.

    Raises:
        NotAvailable: there is too little room.
    """
    recording, name = flight.recording, str(flight.facts.get("bundle", "monitor"))
    plan = make_plan(recording.samples, len(recording.joints), 1, room)
    event_s = (flight.event["t_ns"] - int(recording.t_ns[0])) * 1e-9
    traced = trace(
        recording,
        {name: replace(flight.estimates, limit_nm=flight.limit_nm)},
        plan.size,
        plan.windows(recording),
        [(event_s, event_s)],
    )
    marks = [(event_s, flight.event["what"])]
    marks += [(event_s + since_s, load_words(mass_kg)) for since_s, mass_kg in flight.loads[1:]]
    traced.head["marks"] = sorted(marks)
    method = {"name": name, "label": name, "colour": CASE_COLOURS["exact"], "on": True}
    units = [flight.estimate_unit_of(joint) for joint in range(len(recording.joints))]
    words = Words(uncertainty_words([flight.estimates]), units)
    return section([traced], recording.joints, [method], plan.room, "", words)


def load_words(mass_kg: float) -> str:
    """A change of what the arm was taken to carry."""
    return f"payload set to {mass_kg:.3g} kg" if mass_kg else "no payload"


def or_reason(draw: Callable[[], PageTraces]) -> PageTraces:
    """The traces, or, where there are none, why."""
    try:
        return draw()
    except NotAvailable as reason:
        text = escape(f"Interactive traces are not available: {reason}.")
        return PageTraces(f'<h2>Traces</h2>\n<p class="absent">{text}</p>')


def make_plan(samples: int, joints: int, methods: int, room: float) -> Plan:
    left = room - SCRIPT_MB * 1e6
    if left < LEAST_MB * 1e6:
        raise NotAvailable(
            f"the page has {max(room, 0) / 1e6:.2f} MB left for them, they need {LEAST_MB + SCRIPT_MB:.2f}; "
            "--page-mb sets its size"
        )
    return Plan(samples, joints * (2 + len(METHOD_SIGNALS) * methods), int(left))


def chosen_bundles(results: Results, names: Sequence[str]) -> list[EvaluatedBundle]:
    """Bundles with these names, or the five that latch most collisions and err least; the paper's exact model first."""
    for name in names:
        if name not in results.labels:
            raise ConfigError(f"--trace-methods: there is no method '{name}'; choose among {', '.join(results.labels)}")
    if names:
        return [bundle for bundle in results.bundles if bundle.name in names]

    def rank(bundle: EvaluatedBundle) -> tuple[bool, int, float]:
        latched = bundle.latched.latched if bundle.latched else 0
        return bundle.model != "exact", -latched, sum(error for error in bundle.free_motion.l1_nm if error is not None)

    return sorted(results.bundles, key=rank)[:ROOM]


def recordings_of(results: Results) -> list[str]:
    """Those with collisions and those of free motion, three and one by turns."""
    touched = list(dict.fromkeys(collision.recording for collision in results.collisions))
    free = [name for bundle in results.bundles for name in bundle.free_motion.recordings]
    free = [name for name in dict.fromkeys(free) if name not in touched]
    order = []
    while touched or free:
        order += touched[: FREE_EVERY - 1] + free[:1]
        touched, free = touched[FREE_EVERY - 1 :], free[1:]
    return order


def is_there(name: str, bundles: Sequence[EvaluatedBundle], signals: Signals) -> bool:
    estimates = (signals.results_dir / "estimates" / bundle.name / f"{name}.parquet" for bundle in bundles)
    return (signals.dataset_dir / f"{name}.parquet").is_file() and any(path.is_file() for path in estimates)


def section(
    traced: list[Traced],
    joints: Sequence[str],
    methods: list[dict[str, Any]],
    room: int,
    note: str,
    words: Words,
) -> PageTraces:
    """Their part of the page."""
    content, texts = pack(traced, joints, room)
    content |= {"learned": words.learned, "units": words.units}
    windows = sum(len(one["windows"]) for one in content["recordings"])
    size = max(one["tiers"][0]["size"] for one in content["recordings"])
    if size > 1:
        note += f"Minimum and maximum of every {size} samples are kept"
        note += f", and every sample in {windows} stretches around events. " if windows else ". "
    html = render_template(
        FOLDER / "traces.html.j2",
        content=json.dumps(content | {"methods": methods}, allow_nan=False).replace("<", "\\u003c"),
        texts=texts,
        script="\n".join((FOLDER / name).read_text(encoding="utf-8") for name in SCRIPTS),
        note=note,
    )
    return PageTraces(html, tuple(one["name"] for one in content["recordings"]))
