"""Limits of a commissioned arm from all its calibration motion, as `tauext calibrate` sets them, and their budget.

CalibrationPeaks keep the peaks of the errors under one model. New motion is added as it comes, so that recordings may
be dropped; touches that are reported later are left out again. Promises makes bundles with limits by these peaks or for
a budget that a person chooses, and counts what happens while they monitor.
"""

from __future__ import annotations

import copy
import json
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, replace
from itertools import chain, groupby
from pathlib import Path
from typing import Any

import numpy as np

from tauext import _core
from tauext.bundle.bundle_file import load_bundle
from tauext.config import AlarmConfig
from tauext.data.labels import EPOCH, MARGINS, SUSPECT_MARGINS, Label
from tauext.data.recording import Recording
from tauext.errors import TauextError
from tauext.files.checkpoint import Checkpoint
from tauext.files.provenance import provenance
from tauext.train.calibrate import remove_reserves, write_calibrated
from tauext.train.held_peaks import Peaks, collect_peaks
from tauext.train.limits import LIMITS
from tauext.train.paper_limits import LimitMotion
from tauext.train.promised_limits import no_freeze
from tauext.train.suspects import Suspect, find_suspects, suspect_sentences
from tauext_commission.budget import (
    RAISED,
    Promise,
    alarm_to_train,
    can_take,
    chosen_alarm,
    limits_of,
    once_in,
    promise_of,
    put_budget,
    rate_of,
)
from tauext_commission.folder import CommissionFolder, Segment, joined, up_to, wall
from tauext_commission.history import Kept, kept_of
from tauext_commission.journal_lines import is_bundle_name
from tauext_commission.motion_recorder import LEARNED, segments_of_arm
from tauext_commission.synced_file import write_synced

THREADS = 1
"""Training must not take cores from the loop."""
LEAD_S = 600.0
"""Motion before calibration motion that the drift tracker learns from, [s]."""
TURN_S = 1800.0
"""Calibration motion in memory at a time, [s]."""
Span = tuple[str, int, int, int]
"""Name, epoch, first and last stamp of a motion in the peaks."""
STATE = tuple[list[Peaks], list[Span], int, float, set[int], set[int], dict[int, tuple[int, int]]]
"""Fields of CalibrationPeaks in their file."""


class CalibrationPeaks:
    """Peaks and hours of the calibration motion under one model, and what of the labels they contain."""

    def __init__(self, folder: CommissionFolder, base: str):
        self._folder, self.base = folder, base
        self.peaks: list[Peaks] = []
        """Largest errors, one entry for each hold time."""
        self.spans: list[Span] = []
        self.learned = 0
        self.limits_h = 0.0
        self.counted: set[int] = set()
        """Alarms answered `nothing` whose motion is in the peaks."""
        self.limited: set[int] = set()
        """Alarms answered `nothing` when the newest limits were found."""
        self.forgotten: dict[int, tuple[int, int]] = {}
        """Spans of labels whose peaks were left out."""
        self._checkpoint = Checkpoint(folder.path / "peaks.state", f"{base}, layout 4")

    @classmethod
    def load(cls, folder: CommissionFolder, base: str) -> CalibrationPeaks:
        made = cls(folder, base)
        if (state := made._checkpoint.load(STATE)) is not None:
            (made.peaks, made.spans, made.learned) = state[:3]
            (made.limits_h, made.counted, made.limited, made.forgotten) = state[3:]
        return made

    def put(self) -> None:
        """Keep the state, then allow the recorder to drop what was learned."""
        peaks = (self.peaks, self.spans, self.learned)
        self._checkpoint.put((*peaks, self.limits_h, self.counted, self.limited, self.forgotten))
        write_synced(self._folder.path / LEARNED, json.dumps({"number": self.learned}) + "\n")

    @property
    def hours(self) -> float:
        return self.peaks[0].hours if self.peaks else 0.0

    def model(self) -> _core.Bundle:
        """The bundle whose errors the peaks are, without what its limits reserve for motion that they had not seen."""
        bundle = load_bundle(self._folder.bundles / f"{self.base}.tauext")
        remove_reserves(bundle)
        return bundle

    def news(self, labels: Sequence[Label]) -> bool:
        """Whether answers have come since the newest limits."""
        return any(one.answer == "nothing" and one.id not in self.limited for one in labels)

    def renewed(self) -> None:
        """The newest limits follow from these peaks, or could not be found or used."""
        self.limits_h, self.limited = self.hours, set(self.counted)
        self.put()

    def learn(self, fresh: Sequence[Segment], segments: Sequence[Segment]) -> None:
        """Add calibration motion; then leave out what labels called a touch since, and add answered alarms."""
        labels = self._folder.labels()
        learned = max([self.learned, *(one.number for one in fresh)])
        again = [one for one in labels if one.answer == "nothing" and one.id not in self.counted]
        false = [one for one in segments if any(meets(one, label) for label in again)]
        false = [one for one in false if one.set != "calibration" or one.number <= self.learned]
        bundle = self.model()
        numbers = {one.number for one in (*fresh, *false)}
        before, spans, since = copy.deepcopy(self.peaks), list[Span](), len(self.spans)
        try:
            with no_freeze(bundle):
                counted = self._counted([one for one in segments if one.number in numbers], segments, spans)
                if (first := next(counted, None)) is not None:
                    recordings = chain([first], counted)
                    holds_s = AlarmConfig().holds_s
                    self.peaks = collect_peaks(bundle, recordings, holds_s, THREADS, before=self.peaks)
        except BaseException:
            self.peaks = before
            raise
        self.spans += spans
        self.learned = learned
        self.counted = {one.id for one in labels if one.answer == "nothing"}
        self.forgotten = {id: span for id, span in self.forgotten.items() if id not in self.counted}
        self._forget(labels)
        if spans:
            self._forget(self._suspected(bundle, segments, labels, since))
        self.put()

    def _suspected(
        self, bundle: _core.Bundle, segments: Sequence[Segment], labels: Sequence[Label], since: int
    ) -> list[Label]:
        """Label touches without an alarm or an answer in the newest motion; returns their labels."""

        def load(number: int) -> Recording:
            _, epoch, from_ns, to_ns = self.spans[number]
            inside = [one for one in segments if one.epoch == epoch and one.from_ns <= to_ns and one.to_ns >= from_ns]
            return joined(self._folder.load(inside))

        with no_freeze(bundle):
            found = find_suspects(bundle, self.peaks[-1], load, labels, THREADS, since)
        return put_suspects(self._folder, found, bundle.name)

    def suspects(self) -> int:
        """Number of suspects whose peaks were left out."""
        left_out = [one for one in self._folder.labels() if one.answer == "suspect" and one.id in self.forgotten]
        return sum(any(_within(one, span) for span in self.spans) for one in left_out)

    def _counted(
        self, chosen: Sequence[Segment], segments: Sequence[Segment], spans: list[Span]
    ) -> Iterator[Recording]:
        """Motion of the chosen recordings, each after the motion before it: the drift tracker then has learned what it
        has learned in the loop. Only chosen motion counts; the other is of unknown contact.

        Args:
            spans: receives the span of each motion.
        """
        at_s = dict(zip((one.number for one in segments), np.cumsum([one.seconds for one in segments]), strict=True))
        groups: list[list[Segment]] = []
        for one in chosen:
            group, now_s = groups[-1] if groups else [], at_s[one.number]
            if group and now_s - at_s[group[-1].number] < LEAD_S and now_s - at_s[group[0].number] < TURN_S:
                group.append(one)
            else:
                groups.append([one])
        for group in groups:
            begin_s, end_s = at_s[group[0].number] - LEAD_S, at_s[group[-1].number]
            loaded = self._folder.load([one for one in segments if begin_s <= at_s[one.number] <= end_s])
            for epoch, runs in groupby(loaded, lambda one: int(one.provenance[EPOCH])):
                own = [one for one in group if one.epoch == epoch]
                motion = joined([_only(own, run) for run in runs])  # the drift tracker goes on after a gap
                known = motion.contact is not None and bool((motion.contact == 0).any())
                if own and known:  # else their files were dropped meanwhile
                    spans.append((own[0].stem, epoch, int(motion.t_ns[0]), int(motion.t_ns[-1])))
                    yield replace(motion, name=own[0].stem)

    def _forget(self, labels: Sequence[Label]) -> None:
        for label in labels:
            margins = SUSPECT_MARGINS if label.answer == "suspect" else MARGINS
            before, after = round(margins.before_s * 1e9), round(margins.after_s * 1e9)
            span = (label.from_ns - before, label.to_ns + after)
            if label.answer == "nothing" or self.forgotten.get(label.id) == span:
                continue
            for k, (_, epoch, from_ns, to_ns) in enumerate(self.spans):
                if epoch == label.epoch and from_ns <= span[1] and to_ns >= span[0]:
                    for peaks in self.peaks:
                        peaks.forget(k, span[0] - from_ns, span[1] - from_ns)
            self.forgotten[label.id] = span


def _only(own: Sequence[Segment], motion: Recording) -> Recording:
    """Motion whose contact is unknown outside of these recordings, but for touches."""
    known = np.zeros(motion.samples, dtype=np.int8) if motion.contact is None else motion.contact
    contact = np.where(known == 1, 1, -1).astype(np.int8)
    for one in own:
        rows = slice(*np.searchsorted(motion.t_ns, (one.from_ns, one.to_ns + 1)))
        contact[rows] = known[rows]
    return replace(motion, contact=contact)


def base_of(folder: CommissionFolder, bundle: str) -> str:
    """The bundle whose model a bundle with other limits, or with today's friction, comes from."""
    try:
        facts = json.loads(load_bundle(folder.bundles / f"{bundle}.tauext").provenance or "{}")
    except (TauextError, ValueError):
        return bundle
    base = (facts.get("calibrated") or {}).get("base")
    return str(base) if is_bundle_name(base) else bundle


def meets(one: Segment, label: Label) -> bool:
    return one.epoch == label.epoch and one.from_ns <= label.to_ns and one.to_ns >= label.from_ns


def _within(label: Label, span: Span) -> bool:
    _, epoch, from_ns, to_ns = span
    return label.epoch == epoch and from_ns <= label.to_ns and to_ns >= label.from_ns


def put_suspects(folder: CommissionFolder, found: Sequence[Suspect], bundle: str) -> list[Label]:
    """Label suspects and note them in the history; returns the labels."""
    number = min([0, *(one.id for one in folder.labels() if one.id < 0 and one.id % 2 == 0)])
    added = []
    for one in found:
        number -= 2
        added.append(Label(number, int(one.epoch or 0), *one.span, "suspect", "trainer", wall(), bundle))
        folder.append_label(added[-1])
    if words := suspect_sentences(found, "answer `nothing`"):
        folder.note("note", folder.seconds(), "; ".join(words), bundle=bundle)
    return added


# --- Limits and promises.


MOST_TEST_S = 180.0
"""Newest motion outside of training that judges a bundle, [s]."""
SPARE_S = 660.0
"""Calibration motion is learned when it is this old, [s]: answers about it have then come."""
WATCHED_S = 1200.0
"""Least time that a bundle monitors before its promise counts as broken, [s]: else single alarms replace it by one that
hardly differs, again and again."""
Judge = Callable[[str, Sequence[Segment], bool], tuple[dict[str, Any], str]]


class Promises:
    """Limits of the bundle in charge, and whether false alarms are as rare as these limits state."""

    def __init__(self, folder: CommissionFolder, judged: Judge):
        """judged: numbers of a bundle on these recordings, and why it does not pass; the last argument:
        whether the bundle in charge breaks its promise."""
        self.folder, self._judged = folder, judged
        self._calibration: CalibrationPeaks | None = None
        self._bases: dict[str, str] = {}
        """Names of bundles and of those whose model they have."""
        self._fits: tuple[str, float] | None = None
        """A bundle and a budget that it has, or cannot take."""

    def calibration(self) -> CalibrationPeaks:
        """Peaks of the calibration motion for the model of the bundle in charge."""
        active = self.folder.active()
        assert active is not None
        if active.stem not in self._bases:
            self._bases[active.stem] = base_of(self.folder, active.stem)
        base = self._bases[active.stem]
        if self._calibration is None or self._calibration.base != base:
            self._calibration = CalibrationPeaks.load(self.folder, base)
        return self._calibration

    def unlearned(self, segments: Sequence[Segment]) -> list[Segment]:
        """Calibration motion that can be learned."""
        later, found, calibration = 0.0, list[Segment](), self.calibration()
        for one in reversed(segments):
            if one.set == "calibration" and one.number > calibration.learned and later >= SPARE_S:
                found.append(one)
            later += one.seconds
        return found[::-1]

    def learn(self) -> None:
        """Collect the peaks of new calibration motion, and of alarms that were answered with `nothing`."""
        calibration = self.calibration()
        segments = segments_of_arm(self.folder)
        fresh = self.unlearned(segments)
        self.folder.progress(f"learning from {sum(one.seconds for one in fresh) / 60:.0f} min of motion")
        calibration.learn(fresh, segments)

    def renew(self) -> None:
        """A copy of the bundle in charge with limits from all learned calibration motion."""
        folder, calibration = self.folder, self.calibration()
        active = folder.active()
        assert active is not None
        out = folder.next_bundle()
        folder.progress(f"thresholds of {out.stem}")
        started = time.monotonic()
        segments = segments_of_arm(folder)
        calibration.learn([], segments)
        bundle = calibration.model()  # without the refit of a morning
        alarm, chosen = alarm_to_train(folder.path), rate_of(chosen_alarm(folder.path))
        try:
            motion = LimitMotion(out.stem, alarm, THREADS, peaks=calibration.peaks, suspects=calibration.suspects())
            limits = LIMITS["asked"](bundle, motion)
        except TauextError as error:
            folder.note("note", folder.seconds(), f"no thresholds from calibration: {error}")
            return calibration.renewed()
        if can_take(Promise.of_limits(limits), chosen):
            limits = put_budget(bundle, limits, chosen)
        promise, sentence = Promise.of_limits(limits), limits["sentence"]
        assert promise.per_hour is not None
        happened, more = kept_of(folder.path, active.stem, folder.seconds()), ""
        if raised := raise_limits(bundle, load_bundle(active), happened, promise.per_hour):
            words = ", ".join(f"{joint} by {factor - 1:.0%}" for joint, factor in raised.items())
            more = f" Thresholds are raised for false alarms that the calibration does not contain: {words}."
            sentence += more
        facts = json.loads(bundle.provenance or "{}")
        recordings = sorted({name for name, *_ in calibration.spans})
        facts["limits"] = limits | {"sentence": sentence, "recordings": recordings, RAISED: raised}
        settings = {"bundle": active.name, "dataset": folder.path.name, "alarm": asdict(alarm)}
        facts["calibrated"] = provenance("tauext commission", settings, seed=None)
        facts["calibrated"]["base"] = calibration.base
        bundle.name = out.stem
        write_calibrated(bundle, out, facts, started)
        tests = [one for one in segments if one.set == "test"]
        found, why = self._judged(out.stem, up_to(tests[::-1], MOST_TEST_S)[::-1], not happened.kept)
        if why and found:
            folder.note(
                "note", folder.seconds(), f"{out.stem} with new thresholds does not replace {active.stem}: {why}"
            )
            for path in folder.bundles.glob(f"{out.stem}.*"):
                path.unlink(missing_ok=True)
            return calibration.renewed()
        worse = f"; {found['worse']}" if found.get("worse") else ""
        folder.activate(out.stem, f"thresholds from {calibration.hours:.2g} h of this work{worse}", folder.seconds())
        self._note_promise(out.stem, promise, sentence, more)
        calibration.renewed()  # last: after a kill, the limits are found again

    def _note_promise(self, bundle: str, promise: Promise, sentence: str, more: str = "") -> None:
        """Add what a new bundle's limits are set for to the history.

        more: further sentence of the line.
        """
        numbers = promise.numbers() | {"sentence": sentence, "hours": 0.0, "alarms": 0, "kept": True}
        self.folder.note("promise", self.folder.seconds(), f"{promise.words()}{more}", bundle=bundle, **numbers)

    # The budget that a person chooses.

    def is_chosen(self) -> bool:
        """Whether a person has chosen another budget than that of the bundle in charge, which can take it."""
        active, chosen = self.folder.active(), rate_of(chosen_alarm(self.folder.path))
        if active is None or self._fits == (active.stem, chosen):
            return False
        if can_take(promise_of(self.folder.path, active.stem), chosen):
            return True
        self._fits = active.stem, chosen
        return False

    def put_chosen(self, path: Path) -> None:
        """Set the limits of a bundle's file for the chosen budget, if it can take it."""
        chosen = rate_of(chosen_alarm(self.folder.path))
        if can_take(promise_of(self.folder.path, path.stem), chosen):
            self._write_chosen(load_bundle(path), path, chosen, {})

    def choose(self) -> None:
        """A copy of the bundle in charge with limits for the chosen budget."""
        folder, chosen = self.folder, rate_of(chosen_alarm(self.folder.path))
        active = folder.active()
        assert active is not None
        out, bundle = folder.next_bundle(), load_bundle(active)
        folder.progress(f"thresholds of {out.stem}")
        before, old = promise_of(folder.path, active.stem), np.array(bundle.sliding_limit_nm)
        bundle.name = out.stem
        about = provenance("tauext commission", {"bundle": active.name, "budget": once_in(chosen)}, seed=None)
        limits = self._write_chosen(bundle, out, chosen, about | {"base": base_of(folder, active.stem)})
        share = float((np.array(bundle.sliding_limit_nm) / old)[np.isfinite(old)][0])
        why = f"thresholds for {once_in(chosen)}, {share:.0%} of those for {before.short().partition(' (')[0]}"
        folder.activate(out.stem, why, folder.seconds())
        self._note_promise(out.stem, Promise.of_limits(limits), limits["sentence"])

    def _write_chosen(
        self, bundle: _core.Bundle, out: Path, per_hour: float, calibrated: dict[str, Any]
    ) -> dict[str, Any]:
        """Write a bundle with limits for this rate; returns their facts.

        calibrated: the copy's origin; empty: it is no copy.
        """
        started, facts = time.monotonic(), json.loads(bundle.provenance or "{}")
        limits = facts["limits"] = put_budget(bundle, limits_of(bundle), per_hour)
        if calibrated:
            facts["calibrated"] = calibrated
        write_calibrated(bundle, out, facts, started)
        return limits

    def compare(self) -> None:
        """Add what limits are set for and what happened to the history."""
        folder, active = self.folder, self.folder.active()
        assert active is not None
        found = kept_of(folder.path, active.stem, folder.seconds())
        folder.note(
            "promise",
            folder.seconds(),
            found.words(),
            bundle=found.bundle,
            sentence=found.promise.words(),
            hours=round(found.hours, 3),
            alarms=found.false,
            kept=found.kept,
            **found.promise.numbers(),
        )

    def is_broken(self) -> bool:
        """Whether the promise is broken and new limits would differ, since there are new answers."""
        active = self.folder.active()
        assert active is not None
        calibration = self.calibration()
        if calibration.hours <= 0 or not calibration.news(self.folder.labels()):
            return False
        seconds = self.folder.seconds()
        begun = [float(one["seconds"]) for one in self.folder.history() if one["kind"] == "activation"]
        if begun and seconds < begun[-1] + WATCHED_S:
            return False
        return not kept_of(self.folder.path, active.stem, seconds).kept


def raise_limits(bundle: _core.Bundle, old: _core.Bundle, happened: Kept, rate_per_hour: float) -> dict[str, float]:
    """Raise the limits of a bundle so far that the false alarms under the old one would have kept this rate.

    Some errors do not appear when the recordings of the alarms are replayed, since they depend on hours before. Limits
    that were raised earlier stay as high; calibration that contains these errors by now needs no factor any more.

    Returns:
        Factors by joint, also of earlier repairs.
    """
    joints = [link.joint_name for link in bundle.links]
    earlier = (json.loads(old.provenance or "{}").get("limits") or {}).get(RAISED) or {}
    before, now = (np.array([one.sliding_limit_nm, one.near_stiction_limit_nm]) for one in (old, bundle))
    ratio = np.divide(before, now, out=np.ones_like(now), where=np.isfinite(now))  # infinite: not monitored
    factors = np.where([joint in earlier for joint in joints], np.maximum(1.0, ratio.max(axis=0)), 1.0)
    overs = [] if happened.kept else [np.array(one.get("over") or (), dtype=float) for one in happened.false_alarms]
    peaks = sorted((over.max(), int(over.argmax())) for over in overs if len(over) == len(joints) and over.max() > 1)
    for over, j in peaks[: max(0, len(peaks) - int(rate_per_hour * happened.hours))]:
        factors[j] = max(factors[j], over * ratio[:, j].max())
    bundle.sliding_limit_nm, bundle.near_stiction_limit_nm = (factors * now).tolist()
    return {joint: round(float(factor), 4) for joint, factor in zip(joints, factors, strict=True) if factor > 1}
