"""Forces added to free motion: which of them a bundle detects, without any recording of contacts."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import isotonic_regression

from tauext import _core
from tauext.bundle.estimates import COLLISION
from tauext.bundle.units import left_out, of_all
from tauext.data.free_motion import free_samples
from tauext.data.recording import Recording
from tauext.monitor.changes import APART_S
from tauext.monitor.estimate import estimate_recording
from tauext.train.declared_spread import Contacts, pressed
from tauext.train.hits import Point, points
from tauext_lab.evaluate.collisions import Collision, judge_latched
from tauext_lab.evaluate.noticed_force import noticed_force
from tauext_lab.evaluate.results import Injected, InjectedCurve, Number, PeakBin, Pressed

# --- Detectable hits without contact recordings: forces added to free motion, as a stiff arm's motors would react
# to them.
#
# A force F on a link is a torque J^T F at the joints. The position controller holds the path, so the motors take it up:
# the recorded motor torque becomes tau - J^T F, and q and dq stay as they are. Hands and compliance reduce a real
# force, and a controller that gives way bends the path; both make a real hit show less of its force, and later.


SHAPES: Mapping[str, float] = {
    "hit of 20 ms": 0.02,
    "hit of 60 ms": 0.06,
    "hit of 200 ms": 0.2,
    "ramp of 1 s": 1.0,
    "press": 1.0,
}
"""Lengths, [s]. A hit is a half sine; a ramp rises to its end; a press rises in a tenth of its length and stays."""
EVENTS = 2400
"""Number of events over all test recordings; each copy of a recording holds one every SLOT_S."""
MOST_COPIES = 12
SLOT_S = 3.5
"""Time from one event to the next: the longest event, the release of a latched alarm, and the observer's decay."""
FIRST_S = 1.5
"""Time of the first event of a recording: filters and the network's window have filled."""
QUIET_S = 0.5
"""Free motion before an event."""
SCALE = (0.25, 12.0)
"""Peaks are log-uniform between these multiples of the force unnoticed in half of all poses and directions."""
BINS = 10
NINE_OF_TEN = 0.9
POSES = 24


@dataclass(frozen=True)
class InjectedForce:
    """One force: where and when it acts, and its joint torques, (samples of the event, joints), [N m]."""

    begin: int
    shape: str
    place: int
    peak: float
    tau_ext: np.ndarray


@dataclass
class Injection:
    """Events in every test recording, the same for all bundles, and the bundles' detections."""

    bundles: Mapping[str, _core.Bundle]
    seed: int
    a_recording: int
    """Largest number of events in a recording."""
    reference: _core.Bundle = field(init=False)
    """The bundle whose model and limits set the events: the first that can estimate forces, else the first."""
    refused: str = field(init=False)
    """Reason for torques on single joints instead of forces; empty with forces."""
    places: list[Point] = field(init=False)
    seen: dict[str, list[tuple[str, int, float, bool, bool, float | None]]] = field(init=False)
    pressing: dict[str, list[PressedRecording]] = field(init=False)

    def __post_init__(self) -> None:
        bundles = list(self.bundles.values())
        refused = [_core.WrenchModel(bundle).refused for bundle in bundles]
        known = refused.index("") if "" in refused else 0
        self.reference, self.refused = bundles[known], refused[known]
        self.places = [] if self.refused else points(self.reference)
        self.seen = {name: [] for name in self.bundles}
        self.pressing = {name: [] for name in self.bundles}

    def draw(self, number: int, recording: Recording) -> list[list[InjectedForce]]:
        """Events of each copy of a recording; number: in the order of all, so that the draw is its own."""
        rng = np.random.default_rng([self.seed, number, 35])
        free = free_samples(recording)
        times, length = recording.time_s, max(SHAPES.values())
        starts = []
        for at in np.arange(FIRST_S, recording.duration_s - SLOT_S, SLOT_S):
            first, last = np.searchsorted(times, [at - QUIET_S, at + SLOT_S])
            if free[first:last].all():
                starts.append(at)
        scale = self._scale(recording)
        if not starts or not scale:
            return []
        copies = min(MOST_COPIES, math.ceil(self.a_recording / len(starts)))
        spare = SLOT_S - length - 2 * QUIET_S
        return [
            [self._event(recording, at + rng.uniform(0, spare), scale, rng) for at in starts] for _ in range(copies)
        ]

    def add(self, name: str, recording: Recording, copies: Sequence[Sequence[InjectedForce]], threads: int) -> None:
        """One bundle's detections of the events; those of the first copy again while the tool presses."""
        found = [self._detect(self.bundles[name], recording, events, threads) for events in copies]
        for events, rows in zip(copies, found, strict=True):
            self.seen[name] += [
                (event.shape, event.place, event.peak, *row) for event, row in zip(events, rows, strict=True)
            ]
        if copies and not self.refused:
            self._press(name, recording, copies[0], found[0], threads)

    def _detect(
        self,
        bundle: _core.Bundle,
        recording: Recording,
        events: Sequence[InjectedForce],
        threads: int,
        contacts: Contacts = (),
    ) -> list[tuple[bool, bool, float | None]]:
        """Whether each event was latched, whether its time was unhealthy, and its delay."""
        nm_per_unit = np.array(self.reference.observer.nm_per_unit or 1.0)
        tau = recording.tau.copy()
        for event in events:
            tau[event.begin : event.begin + len(event.tau_ext)] -= event.tau_ext / nm_per_unit
        touched = replace(recording, tau=tau, contact=None, contact_link=None, tau_ext=None, tau_ext_sensor=None)
        estimates = estimate_recording(bundle, touched, threads, contacts)
        rows = []
        for event in events:
            end = event.begin + len(event.tau_ext)
            touch = Collision(
                id="",
                recording=recording.name,
                kind=event.shape,
                begin=event.begin,
                end=end,
                start_s=float(recording.time_s[event.begin]),
                end_s=float(recording.time_s[end - 1]),
                link=-1,
                true_peak_nm=np.abs(event.tau_ext).max(axis=0),
                sensor_peak_nm=np.zeros(bundle.joints),
            )
            found = judge_latched(touch, touched, estimates, bundle.hold_s, None)
            # The first sample of an event represents the middle of its own period.
            delay_s = None if found.delay_s is None else found.delay_s + 0.5 / recording.rate_hz
            rows.append((found.latched, found.unhealthy, delay_s))
        return rows

    def _press(
        self,
        name: str,
        recording: Recording,
        events: Sequence[InjectedForce],
        free: Sequence[tuple[bool, bool, float | None]],
        threads: int,
    ) -> None:
        bundle, number = self.bundles[name], len(self.pressing[name])
        made = pressed(bundle, recording, np.random.default_rng([self.seed, number, 65]))
        if made is None:
            return
        pressing, contact, force_n = made
        contacts = [(contact, int(recording.t_ns[0]), math.inf)]
        quiet = estimate_recording(bundle, pressing, threads, contacts)
        over = recording.time_s[(quiet.held_alarm == COLLISION) & free_samples(recording)]
        false = int(len(over) > 0) + int((np.diff(over) > APART_S).sum())
        rows = self._detect(bundle, pressing, events, threads, contacts)
        hours = float(quiet.healthy.sum() / recording.rate_hz / 3600)
        self.pressing[name].append(PressedRecording(force_n, hours, false, tuple(rows), tuple(free)))

    def summary(self, name: str) -> Injected:
        rows = self.seen[name]
        by: dict[tuple[int, str], list] = defaultdict(list)
        for shape, place, *row in rows:
            by[place, shape].append(row)
        names = self._names()
        return Injected(
            unit=of_all(self.reference.estimate_units) if self.refused else "N",
            events=len(rows),
            unhealthy=sum(unhealthy for *_, unhealthy, _ in rows),
            without_forces=self.refused or None,
            left_out=() if self.refused else left_out(self.reference),
            blind=tuple(place for k, place in enumerate(names) if rows and not any(row[1] == k for row in rows)),
            curves=tuple(
                curve(names[place], shape, by[place, shape])
                for place in range(len(names))
                for shape in SHAPES
                if by[place, shape]
            ),
            pressed=pressed_summary(self.pressing[name]),
        )

    def _names(self) -> list[str]:
        if not self.refused:
            return [place.name for place in self.places]
        return [f"joint {link.joint_name}" for link in self.reference.links]

    def _scale(self, recording: Recording) -> dict[int, float]:
        """Typical unnoticed force by place; places where no joint usually notices a force are left out."""
        bundle = self.reference
        limit = np.array(bundle.sliding_limit_nm)
        if self.refused:
            return dict(enumerate(limit.tolist()))
        q = recording.q[np.linspace(0, recording.samples - 1, POSES).round().astype(int)]
        entries = noticed_force(bundle, q, np.tile(limit, (len(q), 1)), self.places)
        median_n = {place: entry.every_way.median_n for place, entry in enumerate(entries)}
        return {place: force_n for place, force_n in median_n.items() if force_n is not None}

    def _event(
        self, recording: Recording, at_s: float, scale: Mapping[int, float], rng: np.random.Generator
    ) -> InjectedForce:
        bundle, places = self.reference, list(scale)
        begin = int(np.searchsorted(recording.time_s, at_s))
        shape = list(SHAPES)[rng.integers(len(SHAPES))]
        # Half of them at the end of the arm, near most touches; single joints all alike.
        place = places[-1] if not self.refused and rng.uniform() < 0.5 else int(rng.choice(places))
        peak = scale[place] * math.exp(rng.uniform(*np.log(SCALE)))
        force = peak * profile(shape, recording.rate_hz)
        way = rng.standard_normal(3)
        way /= np.linalg.norm(way)
        if self.refused:
            lever = np.zeros(bundle.joints)
            lever[place] = np.sign(way[0])
            return InjectedForce(begin, shape, place, peak, force[:, None] * lever)
        model, point = _core.WrenchModel(bundle), self.places[place]
        poses, there = recording.q[begin : begin + len(force)].tolist(), list(point.point_m)
        levers = np.array([way @ model.columns(point.frame, pose, there)[:3] for pose in poses])
        # Unknown: how much such a joint would show in its own unit.
        levers[:, ~np.array(bundle.in_newtons)] = 0
        return InjectedForce(begin, shape, place, peak, force[:, None] * levers)


@dataclass(frozen=True)
class PressedRecording:
    """One recording whose tool presses: false collisions without events, and the events, then in free motion."""

    force_n: float
    hours: float
    false: int
    rows: tuple[tuple[bool, bool, float | None], ...]
    free: tuple[tuple[bool, bool, float | None], ...]


def pressed_summary(found: Sequence[PressedRecording]) -> Pressed | None:
    """Sums over the recordings; None without any."""
    if not found:
        return None
    rows, free = ([row for one in found for row in of(one)] for of in (lambda one: one.rows, lambda one: one.free))
    return Pressed(
        least_n=min(one.force_n for one in found),
        most_n=max(one.force_n for one in found),
        hours=sum(one.hours for one in found),
        false_collisions=sum(one.false for one in found),
        events=len(rows),
        latched=sum(latched for latched, *_ in rows),
        latched_free=sum(latched for latched, *_ in free),
        delay_median_s=median([delay for *_, delay in rows]),
        delay_free_median_s=median([delay for *_, delay in free]),
    )


def profile(shape: str, rate_hz: float) -> np.ndarray:
    """Share of the peak at each sample of an event, (samples,); of a hit that is shorter than one, its mean there."""
    length = SHAPES[shape]
    samples = max(1, round(length * rate_hz))
    s = (np.arange(samples) + 0.5) / samples
    if shape.startswith("ramp"):
        return s
    if shape == "press":
        return np.minimum(1.0, 10 * s)
    return np.sin(np.pi * s) * min(1.0, length * rate_hz / samples)


def curve(place: str, shape: str, rows: Sequence[tuple[float, bool, bool, float | None]]) -> InjectedCurve:
    """Share and delay over the peak, of (peak, latched, unhealthy, delay); events in unhealthy time count as missed.

    nine_of_ten: the smallest peak from which on 9 of 10 are detected by the best rising curve (isotonic regression);
    None where there is none.
    """
    rows = sorted(rows, key=lambda row: row[0])
    peaks, latched = np.array([row[0] for row in rows]), np.array([row[1] for row in rows], dtype=float)
    sure = isotonic_regression(latched).x >= NINE_OF_TEN - 1e-9
    edges = np.geomspace(peaks[0], peaks[-1] * (1 + 1e-9), BINS + 1)
    which = np.clip(np.searchsorted(edges, peaks, side="right") - 1, 0, BINS - 1)
    delays = [row[3] for row, over in zip(rows, sure, strict=True) if over and row[3] is not None]
    bins = (
        PeakBin(
            peak_from=float(edges[k]),
            peak_to=float(edges[k + 1]),
            events=int((which == k).sum()),
            latched=int(latched[which == k].sum()),
            delay_median_s=median([rows[i][3] for i in np.flatnonzero(which == k)]),
        )
        for k in range(BINS)
    )
    return InjectedCurve(
        place=place,
        shape=shape,
        events=len(rows),
        latched=int(latched.sum()),
        nine_of_ten=float(peaks[sure.argmax()]) if sure.any() else None,
        delay_median_s=median(delays),
        delay_p95_s=float(np.quantile(delays, 0.95)) if delays else None,
        bins=tuple(bins),
    )


def median(delays: Sequence[Number]) -> Number:
    known = [delay for delay in delays if delay is not None]
    return float(np.median(known)) if known else None
