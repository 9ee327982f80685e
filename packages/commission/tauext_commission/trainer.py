"""The training process of a commissioned arm: it exchanges only files with the loop, and may be killed at any time."""

from __future__ import annotations

import errno
import json
import os
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from tauext_lab.evaluate.comparison import evaluate
from tauext_lab.evaluate.results import EvaluatedBundle
from tauext_lab.evaluate.results_folder import write_results

from tauext.bundle.bundle_file import load_bundle
from tauext.bundle.estimates import COLLISION
from tauext.check.before_training import WORTH_A_WARNING
from tauext.check.finding import Finding
from tauext.config import PAPER_CASES, PriorConfig, TrainConfig
from tauext.data.dataset import ROBOT_FILES, Dataset, Split
from tauext.data.free_motion import free_pieces
from tauext.errors import ConfigError, FaultyDataError, TauextError
from tauext.files.plain_file import json_of, read_text
from tauext.files.preflight import expect_memory
from tauext.monitor.estimate import estimate_recording
from tauext.progress import SILENT
from tauext.robot.model_case import chosen_case
from tauext.train.data_check import check_data
from tauext.train.limits import limit_findings
from tauext.train.preparation import TrainingInput
from tauext.train.stage import accepted_settings, train_on_recordings
from tauext.train.suspects import search
from tauext_commission.arm_change import STROKES_S, DayComparison, is_changed
from tauext_commission.budget import alarm_to_train, promise_of
from tauext_commission.connect import (
    HELD,
    Remark,
    as_data,
    as_entries,
    as_live,
    facts_of_data,
    judge,
    load_known,
    sentence_of,
    settled,
)
from tauext_commission.folder import CommissionFolder, Segment, up_to, wall
from tauext_commission.history_file import read_findings
from tauext_commission.journal import REPAIR
from tauext_commission.journal_lines import is_bundle_name
from tauext_commission.motion_recorder import motion_s, segments_of_arm
from tauext_commission.promises import MOST_TEST_S, THREADS, Promises, meets, put_suspects
from tauext_commission.schedule import Facts, next_step
from tauext_commission.synced_file import write_synced

RIPPLES_FROM_MIN = 8
"""Motion from which ripples are fitted, [min]; less has too few turns, and their search takes most of a training."""
MOST_ALARMED = 0.02
"""Largest share of free motion with collisions: a lasting one counts as one false alarm only."""
MOST_HITS_LOST = 0.05
"""A new bundle replaces the old one only if it loses at most this share of the hits, or has fewer false alarms."""
LEAST_HITS_KEPT = 0.6
"""One that is set for rarer false alarms, or replaces one with too many, may detect this share of the other's hits."""
BYTES_A_VALUE = 8 * 12
"""Memory of a training for each sample and joint, [bytes]."""


class Trainer:
    """One piece of work after the other, each from what the folder holds."""

    def __init__(self, folder: CommissionFolder):
        self.folder = folder
        self._checked_s = 0.0
        self.days, self.promises = DayComparison(folder), Promises(folder, self._judged)
        self._repair()

    def _repair(self) -> None:
        """After a kill: bundles that nothing names are removed, unless names were ever lost."""
        folder, history = self.folder, self.folder.history()
        active, pending = folder.active(), self._pending()
        named = {str(one.get("bundle")) for one in history} | {str(pending.get("bundle"))}
        is_known = not folder.lost() and not any(one["kind"] == REPAIR for one in history)
        is_known = is_known and (active is not None or not folder.activation)
        for path in folder.bundles.glob("b*.tauext") if is_known else ():
            if path.stem not in named and path.stem > max(named - {"None"}, default=""):
                for one in folder.bundles.glob(f"{path.stem}.*"):
                    with suppress(OSError):  # a folder of that name
                        one.unlink(missing_ok=True)
        self.folder.progress("")

    # What is there.

    def facts(self) -> Facts:
        """State of the folder."""
        folder = self.folder
        history, segments, question = folder.history(), segments_of_arm(folder), self.days.question()
        seconds, pending, active = folder.seconds(), self._pending(), folder.active()
        learned = max((k for k, one in enumerate(history) if one.get("learned") or one["kind"] == REPAIR), default=0)
        trained = [float(one.get("minutes") or 0.0) for one in history[learned:] if one["kind"] == "training"]
        promised = [float(one["seconds"]) for one in history if one["kind"] in ("promise", "activation")]
        calibration = self.promises.calibration() if active is not None else None
        unlearned = self.promises.unlearned(segments) if calibration else []
        strokes = self.days.strokes(segments, history) if active is not None and not pending else []
        strokes_s = sum(one.seconds for one in strokes)
        return Facts(
            seconds=seconds,
            kept_s=motion_s(folder, segments, ("train", "test")),
            checked_s=self._checked_s if "arm" in folder.facts else seconds,
            trained_min=max([*trained, float(pending.get("minutes") or 0.0)], default=0.0),
            unseen_s=sum(one.seconds for one in self._unseen(pending, segments)) if pending else None,
            has_bundle=active is not None,
            unlearned_s=sum(one.seconds for one in unlearned),
            learned_h=calibration.hours if calibration else 0.0,
            limits_h=calibration.limits_h if calibration else 0.0,
            is_broken=calibration is not None and self.promises.is_broken(),
            is_chosen=self.promises.is_chosen(),
            promised_s=max(promised, default=0.0),
            is_asking=bool(question),
            is_answered=question.get("answer") in ("learn", "leave"),
            is_changed=is_changed(history),
            is_early=0 < strokes_s < STROKES_S,
            is_morning=strokes_s >= STROKES_S,
        )

    def _pending(self) -> dict[str, Any]:
        """The bundle that waits to be judged; empty: none."""
        folder = self.folder
        try:
            content = json_of(read_text(folder.pending_file))
            if not is_pending(content):
                return {}
            path = folder.bundles / f"{content['bundle']}.tauext"
            if path == folder.active():  # it was judged, and a kill or a full disk kept the file
                folder.pending_file.unlink()
                return {}
            return content if path.is_file() else {}
        except (OSError, ValueError, KeyError, TypeError):
            return {}

    def _unseen(self, pending: dict[str, Any], segments: Sequence[Segment]) -> list[Segment]:
        """Newest motion that the bundle was not trained on, up to MOST_TEST_S."""
        seen, after = set(pending.get("trained_on", ())), int(pending.get("after") or 0)
        unseen = [one for one in reversed(segments) if one.name not in seen and one.number > after]
        return up_to(unseen, MOST_TEST_S)[::-1]

    # One step.

    def step(self) -> str:
        """Do the most urgent work; returns what it was, `nothing` if there is none, or the journal has lost lines."""
        if self.folder.lost():
            return "nothing"
        if self.folder.activation and self.folder.active() is None:
            self.folder.fall_back()
        step = next_step(self.facts())
        work: dict[str, Callable[[], None]] = {
            "check": self._check,
            "train": lambda: self._train(step.minutes),
            "judge": self._judge_bundle,
            "learn": self.promises.learn,
            "limits": self.promises.renew,
            "promise": self.promises.compare,
            "morning": self.days.compare,
            "answer": self.days.answer,
            "budget": self.promises.choose,
        }
        if step.what in work:
            try:
                work[step.what]()
            finally:
                self.folder.progress("")
        return step.what

    def _robot(self) -> Path:
        for name in ROBOT_FILES:
            if (self.folder.path / name).is_file():
                return self.folder.path / name
        raise ConfigError(f"{self.folder.path}: it has no {' or '.join(ROBOT_FILES)}")

    def _check(self) -> None:
        """Check the stream: the newest three minutes suffice."""
        folder, seconds = self.folder, self.folder.seconds()
        newest = up_to(folder.segments()[::-1], MOST_TEST_S)
        try:
            facts = facts_of_data(folder.facts["arm"])
            lives = judge(load_known(self.folder, newest[::-1]), self._robot(), facts)
            if (now := settled(facts, lives)) != facts:
                folder.save(arm=as_data(now))
            known = read_findings(folder.path)
            self._report(lives, known)
            found = [*as_entries(lives), *(one for one in known if one.get("code") == HELD)]
            write_synced(folder.findings_file, json.dumps({"findings": found}, default=float) + "\n")
        except TauextError as error:
            folder.log(f"the stream cannot be checked: {error}")
        self._checked_s = max(seconds, self._checked_s)

    def _report(self, lives: Sequence[Remark], known: Sequence[dict[str, Any]]) -> None:
        """Add faults and warnings that the last check did not find to the history, and those that are gone since."""
        before = {(one.get("code"), one.get("joint"), one.get("severity")) for one in known}
        now = {(live.code, live.joint) for live in lives if live.severity in ("fault", "warning")}
        for one in known:
            was_bad = one.get("severity") in ("fault", "warning") and one.get("code") != HELD
            if was_bad and (one.get("code"), one.get("joint")) not in now:
                joint = f"{one['joint']}: " if one.get("joint") else ""
                words = f"no longer found in the newest motion: {one['severity']}: {joint}{one.get('words')}"
                self.folder.note("finding", self.folder.seconds(), words)
        for live in lives:
            if live.severity in ("fault", "warning") and (live.code, live.joint, live.severity) not in before:
                self.folder.note("finding", self.folder.seconds(), sentence_of(live))

    # Training.

    def _config(self, minutes: float) -> TrainConfig:
        prior = PriorConfig() if minutes >= RIPPLES_FROM_MIN else PriorConfig(most_ripples=0)
        alarm = alarm_to_train(self.folder.path)
        return accepted_settings(TrainConfig(recipe="prior", threads=THREADS, prior=prior, alarm=alarm), ())

    def _train(self, minutes: float) -> None:
        """Train on all training motion; suspected touches without a report are left out."""
        folder, segments = self.folder, segments_of_arm(self.folder)
        training = [one for one in segments if one.set == "train"]
        out = folder.next_bundle()
        self.folder.progress(f"training {out.stem} on {minutes:g} min")
        try:
            robot = self._robot()
            case, _ = chosen_case(None, robot)
            if is_changed(folder.history()):
                self._withdraw([one for one in segments if one.set != "calibration"])
            config = self._config(minutes)
            recordings = load_known(self.folder, training)
            if not recordings:
                raise ConfigError("no training motion is left")
            size = sum(one.samples for one in recordings) * len(recordings[0].joints) * BYTES_A_VALUE
            expect_memory(size, f"training on {minutes:g} min")
            given = TrainingInput(robot, PAPER_CASES[case], recordings, labels=folder.labels())
            given, checked = self._checked(given, config)
            put_suspects(folder, train_on_recordings(given, config, out, SILENT, checked), out.stem)
        except TauextError as error:
            if any(os.strerror(one) in str(error) for one in (errno.ENOSPC, errno.EDQUOT)):  # it is tried again
                raise
            text = str(error)
            if isinstance(error, FaultyDataError):  # without the option of `tauext train` that accepts them
                found = [sentence_of(as_live(one)) for one in error.findings if isinstance(one, Finding)]
                text = "; ".join([*found, "then begin with a new --out"])
            why = " ".join(text.split())
            words = f"training on {minutes:g} min of motion failed: {why}"
            folder.note("training", folder.seconds(), words, minutes=minutes, passed=False, why=why)
            return
        content = {"bundle": out.stem, "minutes": minutes, "trained_on": [one.name for one in training]}
        replaced = self._pending().get("bundle")
        write_synced(folder.pending_file, json.dumps(content) + "\n")
        if replaced is not None:  # it was not judged
            for path in folder.bundles.glob(f"{replaced}.*"):
                path.unlink(missing_ok=True)

    def _checked(self, given: TrainingInput, config: TrainConfig) -> tuple[TrainingInput, dict[str, Any]]:
        """Input of a training without recordings that have faults of their own, and the facts of the check.

        Raises:
            FaultyDataError: a fault concerns all recordings, or most of the motion.
        """
        dataset, left_out = Dataset(self.folder.path, Split((), (), ())), dict[str, str]()
        total = sum(one.samples for one in given.training)
        while True:
            try:
                checked = check_data(dataset, given, config, (), SILENT)
                break
            except FaultyDataError as error:
                faults = {one.recording: one.code for one in error.findings if isinstance(one, Finding)}
                good = [one for one in given.training if one.name not in faults]
                if None in faults or len(good) == len(given.training) or 2 * sum(one.samples for one in good) < total:
                    raise
                left_out |= {str(name): code for name, code in faults.items()}
                given = replace(given, training=good)
        if left_out:
            named = ", ".join(f"{name} ({code})" for name, code in sorted(left_out.items()))
            self.folder.note("note", self.folder.seconds(), f"left out of training for faults: {named}")
        return given, checked

    def _withdraw(self, segments: Sequence[Segment]) -> None:
        """Withdraw labels of alarms without an answer: the changed arm itself raises them under the earlier bundle."""
        for label in self.folder.labels():
            if label.answer == "unanswered" and any(meets(one, label) for one in segments):
                self.folder.append_label(replace(label, answer="withdrawn", by="trainer", wall=wall()))

    def _judge_bundle(self) -> None:
        """Put the waiting bundle in charge if it passes on motion outside of its training, and is no worse."""
        folder, pending = self.folder, self._pending()
        name, minutes = str(pending["bundle"]), float(pending["minutes"])
        unseen = self._unseen(pending, segments_of_arm(self.folder))
        self.folder.progress(f"judging {name}")
        self.promises.put_chosen(folder.bundles / f"{name}.tauext")
        candidate = load_bundle(folder.bundles / f"{name}.tauext")
        if is_changed(folder.history()):
            self._withdraw(unseen)
        found = search(candidate, load_known(self.folder, unseen), folder.labels(), THREADS)
        put_suspects(folder, found, candidate.name)
        facts, why = self._judged(name, unseen)
        if pending.get("refit"):
            self.days.judge_refit(name, facts, why)
            return
        passed = not why
        promise = promise_of(folder.path, name)
        verdict = f"passed. {promise.words()}" if passed else f"did not pass: {why}"
        words = f"{name}, trained on {minutes:g} min of motion, {verdict}"
        facts |= promise.numbers()
        worse = f"; {facts['worse']}" if facts.get("worse") else ""
        folder.note("training", folder.seconds(), words, bundle=name, minutes=minutes, passed=passed, why=why, **facts)
        if passed:
            reason = f"it passed on {60 * facts['test_minutes']:.0f} s outside its training{worse}"
            folder.activate(name, reason, folder.seconds())
        folder.pending_file.unlink(missing_ok=True)

    def _judged(self, name: str, unseen: Sequence[Segment], is_broken: bool = False) -> tuple[dict[str, Any], str]:
        """Numbers of a bundle on unseen motion for the history, and why it does not pass.

        is_broken: the bundle in charge has more false alarms than its limits state.
        """
        folder, active = self.folder, self.folder.active()
        pieces = free_pieces(load_known(self.folder, unseen))
        pieces = [replace(one, name=f"{one.name}-{k:02d}") for k, one in enumerate(pieces)]
        if not pieces:
            return {}, "there is no free motion to judge it"
        old = [] if active is None or active.stem == name or is_changed(folder.history()) else [active.stem]
        bundles = {one: load_bundle(folder.bundles / f"{one}.tauext") for one in (*old, name)}
        provenance = json.loads(bundles[name].provenance or "{}")
        wrong = [one for one in limit_findings(bundles[name], provenance) if one.severity == "fault"]
        loaders = [lambda one=one: one for one in pieces]
        out = folder.results / name
        results = evaluate(bundles, loaders, [], out / "estimates", 0, THREADS, keep_free_estimates=0, inject=True)
        source: dict[str, Any] = {
            "command": "tauext commission",
            "dataset": folder.path.name,
            "scale": None,
            "recordings": {},
        }
        write_results(results, out, "tauext commission", 0, source)
        found = {one.name: one for one in results.bundles}
        new, before = found[name], found[old[0]] if old else None
        free = new.free_motion
        facts = {
            "joints": list(results.joints),
            "error": list(free.l2_nm),
            "units": list(new.estimate_units),
            "hits": hits(new),
            "per_hour": (free.false_collisions or 0) / free.hours if free.hours else None,
            "test_minutes": round(60 * (free.hours or 0.0), 3),
        }
        if before is not None and before.free_motion.hours:
            old_free = before.free_motion
            facts["before"] = (old_free.false_collisions or 0) / before.free_motion.hours
            ratios = [a / b for a, b in zip(free.l2_nm, old_free.l2_nm, strict=True) if a is not None and b]
            ratio = float(np.mean(ratios)) if ratios else 1.0
            facts |= {"error_ratio": round(ratio, 4), "worse": why_worse(new, before, is_broken, ratio)}
        alarmed = sum(int((estimate_recording(bundles[name], one).held_alarm == COLLISION).sum()) for one in pieces)
        if (share := alarmed / sum(one.samples for one in pieces)) > MOST_ALARMED:
            return facts, f"it reports collisions during {share:.0%} of the motion"
        if wrong:
            return facts, "; ".join(sentence_of(as_live(one)) for one in wrong)
        return facts, why_not(new, before, is_broken)


def is_pending(content: Any) -> bool:
    """Whether this is the content of pending.json: a name that leads elsewhere, or another type, is none."""
    return (
        isinstance(content, dict)
        and is_bundle_name(content.get("bundle"))
        and isinstance(content.get("minutes"), int | float)
        and isinstance(content.get("trained_on", []), list)
        and isinstance(content.get("after", 0), int)
    )


def hits(bundle: EvaluatedBundle) -> float | None:
    """Share of the injected forces that are detected; None without any."""
    curves = bundle.forces.added.curves if bundle.forces.added else ()
    events = sum(one.events for one in curves)
    return round(sum(one.latched for one in curves) / events, 4) if events else None


def why_not(new: EvaluatedBundle, old: EvaluatedBundle | None, is_broken: bool = False) -> str:
    """Why a bundle does not monitor the arm; empty: it does.

    is_broken: the old bundle has more false alarms than its limits state.
    """
    free, rejected = new.free_motion, new.rejected
    if not free.hours:
        return "it accepts none of the motion"
    if rejected.share is not None and rejected.share > WORTH_A_WARNING:
        causes = ", ".join(f"{name} {share:.1%}" for name, share in rejected.causes.items()) or "warming up"
        return f"it rejects {rejected.share:.1%} of the motion ({causes})"
    if free.promise_kept is False:
        return (
            f"{free.false_collisions} false alarms in {60 * free.hours:.1f} min, where its thresholds allow at most "
            f"{free.at_most_per_hour:.3g} an hour"
        )
    if old is None or not old.free_motion.hours:
        return ""
    false, before = free.false_collisions or 0, old.free_motion.false_collisions or 0
    seen, seen_before = hits(new), hits(old)
    if false > before + 1:
        return f"{false} false alarms, {before} with {old.name}"
    if seen is None or seen_before is None or false < before:
        return ""
    rate, rate_before = free.promised_per_hour, old.free_motion.promised_per_hour
    may_lose = rate is not None and (rate_before is None or rate < rate_before or is_broken)
    if seen < (LEAST_HITS_KEPT * seen_before if may_lose else seen_before - MOST_HITS_LOST):
        return f"it detects {seen:.0%} of the hits, {old.name} {seen_before:.0%}"
    return ""


LARGER = 1.05
"""Ratio of two errors from which the larger one is stated."""


def why_worse(new: EvaluatedBundle, old: EvaluatedBundle, is_broken: bool, error_ratio: float) -> str:
    """In what a bundle that passes is worse than the old one, and why it may replace it; empty: in nothing.

    Args:
        is_broken: see why_not().
        error_ratio: error of the new bundle, divided by that of the old one.
    """
    parts, free, old_free = list[str](), new.free_motion, old.free_motion
    false, before = free.false_collisions or 0, old_free.false_collisions or 0
    seen, seen_before = hits(new), hits(old)
    rate, rate_before = free.promised_per_hour, old_free.promised_per_hour
    if false > before:
        parts.append(f"it has {false} false alarms, {old.name} {before}: one more may be chance")
    if seen is not None and seen_before is not None and seen < seen_before:
        is_rarer = rate is not None and (rate_before is None or rate < rate_before)
        may_lose = [
            ("it has fewer false alarms", false < before),
            ("its thresholds are set for rarer false alarms", is_rarer),
            (f"{old.name} exceeds its target false alarm rate", is_broken),
            (f"up to {MOST_HITS_LOST:.0%} of the hits less are accepted", True),
        ]
        reason = next(words for words, holds in may_lose if holds)
        parts.append(f"it detects {seen:.1%} of the hits, {old.name} {seen_before:.1%}: {reason}")
    if error_ratio > LARGER:
        parts.append(f"its error is {error_ratio:.2f} times that of {old.name}: hits and false alarms decide")
    return "; ".join(parts)


# --- The process.


POLL_S = 1.0


def run_trainer(pipe: Connection, path: Path) -> None:
    """Train until the pipe closes; the folder's other process is the loop."""
    folder = CommissionFolder.open(path)
    with folder.locked("trainer.lock"):
        trainer = Trainer(folder)
        failed: dict[str, int] = {}
        while True:
            what = "nothing"
            try:
                what = trainer.step()
                failed.clear()
            except (TauextError, OSError) as error:  # a disk may be full: what failed is tried again
                failed[str(error)] = failed.get(str(error), 0) + 1
                with suppress(OSError):
                    folder.log(f"the training process failed: {error}")
                    folder.fall_back()  # the bundle in charge may be damaged
            try:
                if pipe.poll(POLL_S * min(60, 2 ** max(failed.values(), default=0)) if what == "nothing" else 0):
                    pipe.recv()
            except (EOFError, OSError):
                return
