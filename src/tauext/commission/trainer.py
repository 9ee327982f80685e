"""The training process of a commissioned arm: it exchanges only files with the loop, and may be killed at any time."""

from __future__ import annotations

import errno
import json
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import asdict, replace
from itertools import pairwise
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from tauext import _core
from tauext.bundle.bundle_file import load_bundle, write_bundle
from tauext.bundle.estimates import COLLISION
from tauext.check.finding import Finding
from tauext.check.preflight import WORTH_A_WARNING
from tauext.commission.arm_change import change_words, find_change
from tauext.commission.connect import as_data, as_entries, facts_of_data, judge, provenance_of, settled
from tauext.commission.course import Facts, Step, next_step
from tauext.commission.folder import CommissionFolder, Segment, wall
from tauext.commission.history import kept_of
from tauext.commission.keep import LEARN_FROM, learns_from, motion_s
from tauext.commission.ledger import THREADS, Ledger, meets
from tauext.commission.suspects import Suspect, find_suspects
from tauext.config import PAPER_CASES, AlarmConfig, PriorConfig, TrainConfig
from tauext.data.dataset import ROBOT_FILES, Dataset, Split
from tauext.data.free_motion import free_pieces
from tauext.data.labels import Label
from tauext.data.recording import Recording
from tauext.errors import ConfigError, FaultyDataError, TauextError
from tauext.evaluate.comparison import evaluate
from tauext.evaluate.injected import estimate_recording
from tauext.evaluate.results import EvaluatedBundle, to_json
from tauext.files.append_file import write_synced
from tauext.files.plain_file import json_of, read_text
from tauext.files.preflight import expect_memory
from tauext.files.provenance import provenance, write_json
from tauext.progress import SILENT, Show, Silent, WallTimes
from tauext.robot.model_case import chosen_case
from tauext.train.calibrate import no_freeze
from tauext.train.preflight import check_data
from tauext.train.preparation import Given
from tauext.train.promised_limits import apply_promised, promised_limits
from tauext.train.refit import refit_recordings
from tauext.train.stage import accepted_settings, train_on_recordings

PENDING = "pending.json"
"""The bundle that waits to be judged, and what it was trained on."""
MOST_TEST_S = 180.0
"""Newest motion outside of training that judges a bundle, [s]."""
FIRST_ROUNDS = 3
"""Most trainings of an arm's first bundle: after each, touches that nobody reported are looked for and left out of the
next. Before a later training, the bundle in charge looks for them in motion that it was not trained on."""
RIPPLES_FROM_MIN = 8
"""Motion from which ripples are fitted, [min]; less has too few turns, and their search takes most of a training."""
SPARE_S = 660.0
"""Calibration motion is learned when it is this old, [s]: answers about it have then come."""
MOST_ALARMED = 0.02
"""Largest share of free motion with collisions: a lasting one counts as one false alarm only."""
MOST_HITS_LOST = 0.05
"""A bundle that detects a smaller share of the hits by so much replaces none, unless it has fewer false alarms."""
LEAST_HITS_KEPT = 0.6
"""One that promises rarer false alarms, or repairs a broken promise, may detect this share of the hits of the other."""
RAISED = "raised"
"""Entry of a bundle's limits: factors on the limits from calibration, by joint, with which a promise was repaired."""
PAUSE_S = 3600.0
"""Pause after which the first strokes are compared with earlier days, [s]; so are those after every start."""
STROKES_S = 60.0
CHANGED_SHARE = 0.9
"""Share of the newest recordings with alarms, none of them a touch, from which the arm may have changed at work."""
CHANGED_AFTER_S = 1200.0
"""Least motion of the arm as it is before that, [s]: early bundles raise alarms in motion that they have not seen."""
WATCHED_S = 1200.0
"""Least time that a bundle monitors before its promise counts as broken, [s]: else single alarms replace it by one that
hardly differs, again and again."""
STEP, STEP_SPREADS = 0.5, 4.0
"""A change of friction is named if its logarithm exceeds the first, and so many standard deviations of earlier days."""
REFIT_FROM, REFIT_WORTH = 0.1, 0.95
"""Change of friction from which a refit is tried, and the ratio of errors below which it is used."""
BYTES_A_VALUE = 8 * 12
"""Memory of a training for each sample and joint, [bytes]."""


class Trainer:
    """One piece of work after the other, each from what the folder holds."""

    def __init__(self, folder: CommissionFolder):
        self.folder = folder
        self._checked_s = 0.0
        self._ledger: Ledger | None = None
        self._bases: dict[str, str] = {}
        """Names of bundles and of those whose model they have."""
        self._repair()

    def _repair(self) -> None:
        """After a kill: an activation without its line is added; bundles that nothing names are removed."""
        folder, history = self.folder, self.folder.history()
        active, pending = folder.active(), self._pending()
        begun = [one.get("bundle") for one in history if one["kind"] == "activation"]
        if active is not None and (not begun or begun[-1] != active.stem):
            words = f"{active.stem} monitors the arm"
            folder.note(
                "activation", folder.seconds(), words, bundle=active.stem, replaces=begun[-1] if begun else None
            )
        named = {str(one.get("bundle")) for one in history} | {str(pending.get("bundle"))}
        for path in folder.bundles.glob("b*.tauext"):
            if path.stem not in named and (active is None or path != active):
                for one in folder.bundles.glob(f"{path.stem}.*"):
                    one.unlink(missing_ok=True)
        self._progress("")

    # What is there.

    def facts(self) -> Facts:
        """State of the folder."""
        folder = self.folder
        history, segments, question = folder.history(), self._segments(), self._question()
        seconds, pending, active = folder.seconds(), self._pending(), folder.active()
        learned = max((k for k, one in enumerate(history) if one.get("learned")), default=0)
        trained = [float(one.get("minutes") or 0.0) for one in history[learned:] if one["kind"] == "training"]
        promised = [float(one["seconds"]) for one in history if one["kind"] in ("promise", "activation")]
        ledger = self.ledger() if active is not None else None
        unlearned = self._unlearned(segments, ledger) if ledger else []
        strokes = self._strokes(segments, history) if active is not None and not pending else []
        strokes_s = sum(one.seconds for one in strokes)
        return Facts(
            seconds=seconds,
            kept_s=motion_s(folder, segments, ("train", "test")),
            checked_s=self._checked_s if "arm" in folder.facts else seconds,
            trained_min=max([*trained, float(pending.get("minutes") or 0.0)], default=0.0),
            unseen_s=sum(one.seconds for one in self._unseen(pending, segments)) if pending else None,
            has_bundle=active is not None,
            unlearned_s=sum(one.seconds for one in unlearned),
            learned_h=ledger.hours if ledger else 0.0,
            limits_h=ledger.limits_h if ledger else 0.0,
            is_broken=ledger is not None and self._is_broken(ledger),
            promised_s=max(promised, default=0.0),
            is_asking=bool(question),
            is_answered=question.get("answer") in ("learn", "leave"),
            is_changed=is_changed(history),
            is_early=0 < strokes_s < STROKES_S,
            is_morning=strokes_s >= STROKES_S,
        )

    def _segments(self) -> list[Segment]:
        """Recordings of the arm as it is: since the last change that a person let it learn."""
        begin = learns_from(self.folder)
        return [one for one in self.folder.segments() if one.number >= begin]

    def _question(self) -> dict[str, Any]:
        try:
            content = json_of(read_text(self.folder.question_file))
        except (OSError, ValueError):
            return {}
        return content if isinstance(content, dict) else {}

    def _strokes(self, segments: Sequence[Segment], history: Sequence[dict[str, Any]]) -> list[Segment]:
        """Motion to compare with earlier days, up to STROKES_S, but for motion that was compared before.

        These are the first strokes after the newest pause. Once they are compared, it is the newest motion if alarms
        without a touch came during nearly all of the last MOST_TEST_S: the arm may have changed without a pause.
        """
        begins = [k for k, (a, b) in enumerate(pairwise(segments), 1) if b.epoch != a.epoch or _pause(a, b) > PAUSE_S]
        first = segments[begins[-1]].number if begins else 0
        done = max((int(one.get("segment") or 0) for one in history if one["kind"] == "morning"), default=0)
        if begins and first > done:
            return _up_to(segments[begins[-1] :], STROKES_S)
        asked = max((int(one.get("segment") or 0) for one in history if one["kind"] == "step"), default=-1)
        newest = _up_to(segments[::-1], MOST_TEST_S)
        if asked >= first or sum(one.seconds for one in segments) < CHANGED_AFTER_S or newest[-1].number <= done:
            return []
        labels = [one for one in self.folder.labels() if one.id > 0 and one.answer in ("unanswered", "nothing")]
        alarmed = sum(any(meets(one, label) for label in labels) for one in newest)
        return _up_to(newest, STROKES_S)[::-1] if alarmed >= CHANGED_SHARE * len(newest) else []

    def _pending(self) -> dict[str, Any]:
        try:
            content = json_of(read_text(self.folder.path / PENDING))
            return content if (self.folder.bundles / f"{content['bundle']}.tauext").is_file() else {}
        except (OSError, ValueError, KeyError, TypeError):
            return {}

    def _unseen(self, pending: dict[str, Any], segments: Sequence[Segment]) -> list[Segment]:
        """Newest motion that the bundle was not trained on, up to MOST_TEST_S."""
        seen = set(pending.get("trained_on", ()))
        return _up_to([one for one in reversed(segments) if one.name not in seen], MOST_TEST_S)[::-1]

    # One step.

    def step(self) -> str:
        """Do the most urgent work; returns what it was, `nothing` if there is none."""
        step = next_step(self.facts())
        work: dict[str, Callable[[Step], None]] = {
            "check": self._check,
            "train": self._train,
            "judge": self._judge_bundle,
            "learn": self._learn,
            "limits": self._limits,
            "promise": self._compare,
            "morning": self._morning,
            "answer": self._answer,
        }
        if step.what in work:
            try:
                work[step.what](step)
            finally:
                self._progress("")
        return step.what

    def _progress(self, doing: str, share: float = 0.0) -> None:
        with suppress(OSError):
            write_json({"doing": doing, "share": round(share, 3)}, self.folder.progress_file)

    def _robot(self) -> Path:
        for name in ROBOT_FILES:
            if (self.folder.path / name).is_file():
                return self.folder.path / name
        raise ConfigError(f"{self.folder.path}: it has no {' or '.join(ROBOT_FILES)}")

    def _check(self, step: Step) -> None:
        """Check the stream: the newest three minutes suffice."""
        folder, seconds = self.folder, self.folder.seconds()
        newest = _up_to(folder.segments()[::-1], MOST_TEST_S)
        try:
            facts = facts_of_data(folder.facts["arm"])
            lives = judge(self._load(newest[::-1]), self._robot(), facts)
            if (now := settled(facts, lives)) != facts:
                folder.save(arm=as_data(now))
            write_synced(folder.findings_file, json.dumps({"findings": as_entries(lives)}, default=float) + "\n")
        except TauextError as error:
            folder.log(f"the stream cannot be checked: {error}")
        self._checked_s = max(seconds, self._checked_s)

    def _load(self, segments: Sequence[Segment]) -> list[Recording]:
        """Recordings with their labels, and with what is known of the torque by now."""
        recordings, arm = self.folder.load(segments), self.folder.facts.get("arm")
        known = {} if arm is None else provenance_of(facts_of_data(arm))
        return [replace(one, provenance=one.provenance | known) for one in recordings] if known else recordings

    # Training.

    def _config(self, minutes: float) -> TrainConfig:
        prior = PriorConfig() if minutes >= RIPPLES_FROM_MIN else PriorConfig(most_ripples=0)
        return accepted_settings(TrainConfig(recipe="prior", threads=THREADS, prior=prior), (), None)

    def _train(self, step: Step) -> None:
        """Train on all training motion, without touches that this training or an earlier one finds."""
        folder, segments = self.folder, self._segments()
        training = [one for one in segments if one.set == "train"]
        out = folder.next_bundle()
        self._progress(f"training {out.stem} on {step.minutes:g} min")
        try:
            robot = self._robot()
            case, _ = chosen_case(None, robot)
            learning = [one for one in segments if one.set != "calibration"]
            active, rounds = folder.active(), FIRST_ROUNDS
            if is_changed(folder.history()):
                self._withdraw(learning)
            elif active is not None:
                self._suspect(load_bundle(active), self._load(learning))
                rounds = 1
            config = self._config(step.minutes)
            for number in range(rounds):
                recordings = self._load(training)
                if not recordings:
                    raise ConfigError("no training motion is left")
                size = sum(one.samples for one in recordings) * len(recordings[0].joints) * BYTES_A_VALUE
                expect_memory(size, f"training on {step.minutes:g} min")
                given, checked = self._checked(Given(robot, PAPER_CASES[case], recordings), config)
                report = Share(lambda share: self._progress(f"training {out.stem}", share))
                train_on_recordings(given, config, out, report, checked)
                if number == rounds - 1 or not self._suspect(load_bundle(out), self._load(learning)):
                    break
        except TauextError as error:
            if os.strerror(errno.ENOSPC) in str(error):  # no fault of the motion: it is tried again
                raise
            why = " ".join(str(error).split())
            words = f"training on {step.minutes:g} min of motion failed: {why}"
            folder.note("training", folder.seconds(), words, minutes=step.minutes, passed=False, why=why)
            return
        content = {"bundle": out.stem, "minutes": step.minutes, "trained_on": [one.name for one in training]}
        write_synced(folder.path / PENDING, json.dumps(content) + "\n")

    def _checked(self, given: Given, config: TrainConfig) -> tuple[Given, dict[str, Any]]:
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

    def _suspect(self, bundle: _core.Bundle, recordings: Sequence[Recording]) -> list[Suspect]:
        """Label touches that nobody reported; returns them."""
        labels = self.folder.labels()
        nothing = [one for one in labels if one.answer == "nothing"]
        found = [one for one in find_suspects(bundle, recordings, THREADS) if not any(meets(one, of) for of in nothing)]
        ids = [one.id for one in labels]
        number = min([0, *(one for one in ids if one < 0 and one % 2 == 0)])
        for one in found:
            number -= 2
            span = one.epoch, one.from_ns, one.to_ns
            self.folder.append_label(Label(number, *span, "suspect", "trainer", wall(), bundle.name))
        if found:
            seconds = 1e-9 * sum(one.to_ns - one.from_ns for one in found)
            words = f"{len(found)} touch{'es' * (len(found) > 1)} that nobody reported, {seconds:.1f} s, left out"
            self.folder.note("note", self.folder.seconds(), words, bundle=bundle.name)
        return found

    def _judge_bundle(self, step: Step) -> None:
        """Put the waiting bundle in charge if it passes on motion outside of its training, and is no worse."""
        folder, pending = self.folder, self._pending()
        name, minutes = str(pending["bundle"]), float(pending["minutes"])
        unseen = self._unseen(pending, self._segments())
        self._progress(f"judging {name}")
        candidate = load_bundle(folder.bundles / f"{name}.tauext")
        if is_changed(folder.history()):
            self._withdraw(unseen)
        self._suspect(candidate, self._load(unseen))
        facts, why = self._judged(name, unseen)
        if pending.get("refit"):
            self._judge_refit(name, facts, why)
            return
        passed = not why
        words = f"{name}, trained on {minutes:g} min of motion, " + ("passed" if passed else f"did not pass: {why}")
        folder.note("training", folder.seconds(), words, bundle=name, minutes=minutes, passed=passed, why=why, **facts)
        if passed:
            folder.activate(
                name, f"it passed on {60 * facts['test_minutes']:.0f} s outside its training", folder.seconds()
            )
        (folder.path / PENDING).unlink(missing_ok=True)

    def _judged(self, name: str, unseen: Sequence[Segment], is_broken: bool = False) -> tuple[dict[str, Any], str]:
        """Numbers of a bundle on unseen motion for the history, and why it does not pass.

        is_broken: the bundle in charge does not keep its promise.
        """
        folder, active = self.folder, self.folder.active()
        pieces = free_pieces(self._load(unseen))
        pieces = [replace(one, name=f"{one.name}-{k:02d}") for k, one in enumerate(pieces)]
        if not pieces:
            return {}, "there is no free motion to judge it"
        old = [] if active is None or active.stem == name or is_changed(folder.history()) else [active.stem]
        bundles = {one: load_bundle(folder.bundles / f"{one}.tauext") for one in (*old, name)}
        loaders = [lambda one=one: one for one in pieces]
        out = folder.results / name
        results = evaluate(bundles, loaders, [], out / "estimates", 0, THREADS, keep_free_estimates=0, inject=True)
        source: dict[str, Any] = {
            "command": "tauext commission",
            "dataset": folder.path.name,
            "scale": None,
            "recordings": {},
        }
        run = provenance("tauext commission", {"bundles": list(bundles)}, 0)
        keep = {key: run[key] for key in ("version", "seed", "machine")}
        write_json(to_json(replace(results, provenance=source | keep)), out / "results.json")
        write_json(run, out / "run.json")
        found = {one.name: one for one in results.bundles}
        new, before = found[name], found[old[0]] if old else None
        free = new.free_motion
        facts = {
            "joints": list(results.joints),
            "error": list(free.l2_nm),
            "units": list(new.estimate_units),
            "hits": hits(new),
            "per_hour": (free.false_collisions or 0) / free.hours if free.hours else None,
            "promised_per_hour": free.promised_per_hour,
            "test_minutes": round(60 * (free.hours or 0.0), 3),
        }
        if before is not None and before.free_motion.hours:
            old_free = before.free_motion
            facts["before"] = (old_free.false_collisions or 0) / before.free_motion.hours
            ratios = [a / b for a, b in zip(free.l2_nm, old_free.l2_nm, strict=True) if a is not None and b]
            facts["error_ratio"] = round(float(np.mean(ratios)), 4) if ratios else 1.0
        alarmed = sum(int((estimate_recording(bundles[name], one).held_alarm == COLLISION).sum()) for one in pieces)
        if (share := alarmed / sum(one.samples for one in pieces)) > MOST_ALARMED:
            return facts, f"it reports collisions during {share:.0%} of the motion"
        return facts, why_not(new, before, is_broken)

    # Days: the first strokes after a pause, and motion full of alarms, are compared with earlier days.

    def _morning(self, step: Step) -> None:
        """Refit to the first strokes; name what is not explained by friction, or is far beyond the earlier days."""
        folder, active = self.folder, self.folder.active()
        assert active is not None
        history = folder.history()
        motion = self._strokes(self._segments(), history)
        self._progress("comparing the first strokes with earlier days")
        facts: dict[str, Any] = {"bundle": active.stem, "segment": motion[0].number}
        bundle, recordings = load_bundle(active), self._load(motion)
        try:
            refitted = refit_recordings(bundle, recordings, THREADS)
        except TauextError as error:
            if not bundle.prior.terms:
                folder.note(
                    "morning", folder.seconds(), f"{active.stem} has no friction that could be refitted", **facts
                )
                return
            change = find_change(bundle, recordings, THREADS)
            self._ask(change_words(*change, " ".join(str(error).split())), facts)
            return
        factors = {one.joint: one.coulomb[0] * self._factor(active.stem, one.joint) for one in refitted.joints}
        facts["friction"] = {joint: round(factor, 4) for joint, factor in factors.items()}
        earlier = [one["friction"] for one in history if one["kind"] == "morning" and one.get("friction")]
        if steps := named_steps(factors, {one.joint: one.coulomb[1] for one in refitted.joints}, earlier):
            load, errors = find_change(bundle, recordings, THREADS)
            causes = "a replaced gear, wear or damage" if errors else "a replaced gear, wear, damage or another load"
            self._ask(change_words(load, {}, "") if load else f"{'; '.join(steps)}: {causes}?", facts)
            return
        words = ", ".join(f"{joint} {factor:.2f}" for joint, factor in factors.items())
        folder.note(
            "morning", folder.seconds(), f"friction of the first strokes, times that of training: {words}", **facts
        )
        if any(abs(np.log(one.coulomb[0])) > max(REFIT_FROM, 2 * one.coulomb[1]) for one in refitted.joints):
            out = folder.next_bundle()
            about = json.loads(bundle.provenance or "{}")
            about["refitted"] = provenance("tauext commission", {"bundle": active.name}, seed=None) | refitted.facts()
            about["calibrated"] = about.get("calibrated", {}) | {"base": base_of(folder, active.stem)}
            refitted.bundle.name = out.stem
            write_bundle(refitted.bundle, out, about, [], WallTimes())
            content = {"bundle": out.stem, "minutes": 0, "refit": True, "trained_on": [one.name for one in motion]}
            write_synced(folder.path / PENDING, json.dumps(content) + "\n")

    def _factor(self, bundle: str, joint: str) -> float:
        """Factor of a joint's friction that a refit has put into the bundle already."""
        try:
            about = json.loads(load_bundle(self.folder.bundles / f"{bundle}.tauext").provenance or "{}")
        except (TauextError, ValueError):
            return 1.0
        joints = (about.get("refitted") or {}).get("joints") or []
        return float(next((one["coulomb"][0] for one in joints if one["joint"] == joint), 1.0))

    def _judge_refit(self, name: str, facts: dict[str, Any], why: str) -> None:
        """A refit monitors if it passes and is better: fewer false alarms, or smaller errors."""
        folder = self.folder
        better = facts.get("error_ratio", 1.0) < REFIT_WORTH or facts.get("per_hour", 0.0) < facts.get("before", 0.0)
        why = why or ("" if better else "the drift tracker does as well")
        words = f"{name}, refitted to the first strokes of the day, " + (f"is not used: {why}" if why else "passed")
        folder.note("refit", folder.seconds(), words, bundle=name, passed=not why, **facts)
        if not why:
            folder.activate(name, "friction of the first strokes of the day", folder.seconds())
        (folder.path / PENDING).unlink(missing_ok=True)

    def _ask(self, words: str, facts: dict[str, Any]) -> None:
        """Name a change and ask a person whether it may be learned."""
        self.folder.note("morning", self.folder.seconds(), words, **facts)
        self.folder.note("step", self.folder.seconds(), words, segment=facts["segment"])
        content = {"words": words, "asked": wall(), "segment": facts["segment"]}
        write_synced(self.folder.question_file, json.dumps(content) + "\n")

    def _answer(self, step: Step) -> None:
        """learn: train on motion since the change alone. leave: the bundle in charge stays, and the motion is used."""
        folder, question = self.folder, self._question()
        learns = question["answer"] == "learn"
        if learns:
            folder.save(**{LEARN_FROM: int(question.get("segment") or 0)})
        words = "the change is learned: training begins again" if learns else "the change is not learned"
        folder.note("step", folder.seconds(), f"{words} ({question.get('words')})", learned=learns)
        folder.question_file.unlink(missing_ok=True)

    # Limits from calibration motion.

    def ledger(self) -> Ledger:
        """Peaks of the calibration motion for the model of the bundle in charge."""
        active = self.folder.active()
        assert active is not None
        if active.stem not in self._bases:
            self._bases[active.stem] = base_of(self.folder, active.stem)
        base = self._bases[active.stem]
        if self._ledger is None or self._ledger.base != base:
            self._ledger = Ledger.load(self.folder, base)
        return self._ledger

    def _unlearned(self, segments: Sequence[Segment], ledger: Ledger) -> list[Segment]:
        later, found = 0.0, []
        for one in reversed(segments):
            if one.set == "calibration" and one.number > ledger.learned and later >= SPARE_S:
                found.append(one)
            later += one.seconds
        return found[::-1]

    def _learn(self, step: Step) -> None:
        """Collect the peaks of new calibration motion, and of alarms that were answered with `nothing`."""
        ledger = self.ledger()
        segments = self._segments()
        fresh = self._unlearned(segments, ledger)
        self._progress(f"learning from {sum(one.seconds for one in fresh) / 60:.0f} min of motion")
        ledger.learn(fresh, segments)

    def _limits(self, step: Step) -> None:
        """A copy of the bundle in charge with limits from all learned calibration motion."""
        folder, ledger = self.folder, self.ledger()
        active = folder.active()
        assert active is not None
        out = folder.next_bundle()
        self._progress(f"limits of {out.stem}")
        started = time.monotonic()
        segments = self._segments()
        ledger.learn([], segments)
        bundle = load_bundle(folder.bundles / f"{ledger.base}.tauext")  # without the refit of a morning
        alarm = AlarmConfig()
        try:
            with no_freeze(bundle):
                promised = promised_limits(bundle, lambda: [], alarm, THREADS, kept=ledger)
        except TauextError as error:
            folder.note("note", folder.seconds(), f"no limits from calibration: {error}")
            ledger.limits_h = ledger.hours
            ledger.put()
            return
        apply_promised(bundle, promised, alarm)
        rate, sentence = promised.budget.rate_per_hour, promised.sentence()
        is_broken = not kept_of(folder.path, active.stem, folder.seconds()).kept
        if raised := self._raise(bundle, rate):
            words = ", ".join(f"{joint} by {factor - 1:.0%}" for joint, factor in raised.items())
            sentence += f" Limits are raised for false alarms that the calibration does not contain: {words}."
        facts = json.loads(bundle.provenance or "{}")
        recordings = sorted({name for name, *_ in ledger.places})
        facts["limits"] = promised.facts() | {"sentence": sentence, "recordings": recordings, RAISED: raised}
        settings = {"bundle": active.name, "dataset": folder.path.name, "alarm": asdict(alarm)}
        facts["calibrated"] = provenance("tauext commission", settings, seed=None)
        facts["calibrated"]["base"] = ledger.base
        bundle.name = out.stem
        write_bundle(bundle, out, facts, [], WallTimes({"calibrate": time.monotonic() - started}))
        ledger.limits_h = ledger.hours
        ledger.put()
        unseen = self._unseen({}, [one for one in segments if one.set == "test"])
        found, why = self._judged(out.stem, unseen, is_broken)
        numbers = {"promised_per_hour": rate, "sentence": sentence, "hours": 0.0, "alarms": 0, "kept": True}
        if why and found:
            folder.note("note", folder.seconds(), f"{out.stem} with new limits does not replace {active.stem}: {why}")
            for path in folder.bundles.glob(f"{out.stem}.*"):
                path.unlink(missing_ok=True)
            return
        folder.activate(out.stem, f"limits from {ledger.hours:.2g} h of this work", folder.seconds())
        folder.note("promise", folder.seconds(), sentence, bundle=out.stem, **numbers)

    def _raise(self, bundle: _core.Bundle, rate_per_hour: float) -> dict[str, float]:
        """Raise new limits so far that the false alarms under the bundle in charge would have kept this rate.

        Some errors do not appear when the recordings of the alarms are replayed, since they depend on hours before.

        Returns:
            Factors by joint, also of earlier repairs.
        """
        folder, active = self.folder, self.folder.active()
        assert active is not None
        old, found = load_bundle(active), kept_of(folder.path, active.stem, folder.seconds())
        earlier = (json.loads(old.provenance or "{}").get("limits") or {}).get(RAISED) or {}
        joints = [link.joint_name for link in bundle.links]
        factors = np.array([float(earlier.get(joint, 1.0)) for joint in joints])
        overs = [] if found.kept else [np.array(one.get("over") or (), dtype=float) for one in found.false_alarms]
        peaks = sorted(
            (over.max(), int(over.argmax())) for over in overs if len(over) == len(joints) and over.max() > 1
        )
        for over, j in peaks[: max(0, len(peaks) - int(rate_per_hour * found.hours))]:
            kept = (
                old.sliding_limit_nm[j] / bundle.sliding_limit_nm[j],
                old.near_stiction_limit_nm[j] / bundle.near_stiction_limit_nm[j],
            )
            factors[j] = max(factors[j], over * max(kept))
        bundle.sliding_limit_nm = (factors * bundle.sliding_limit_nm).tolist()
        bundle.near_stiction_limit_nm = (factors * bundle.near_stiction_limit_nm).tolist()
        return {joint: round(float(factor), 4) for joint, factor in zip(joints, factors, strict=True) if factor > 1}

    def _compare(self, step: Step) -> None:
        """Add what was promised and what happened to the history."""
        folder, active = self.folder, self.folder.active()
        assert active is not None
        found = kept_of(folder.path, active.stem, folder.seconds())
        folder.note(
            "promise",
            folder.seconds(),
            found.words(),
            bundle=found.bundle,
            promised_per_hour=found.promised_per_hour,
            sentence=found.sentence,
            hours=round(found.hours, 3),
            alarms=found.false,
            kept=found.kept,
        )

    def _is_broken(self, ledger: Ledger) -> bool:
        """Whether the promise is broken and new limits would differ, since there are new answers."""
        active = self.folder.active()
        assert active is not None
        if ledger.hours <= 0 or not ledger.news(self.folder.labels()):
            return False
        seconds = self.folder.seconds()
        begun = [float(one["seconds"]) for one in self.folder.history() if one["kind"] == "activation"]
        if begun and seconds < begun[-1] + WATCHED_S:
            return False
        return not kept_of(self.folder.path, active.stem, seconds).kept


def hits(bundle: EvaluatedBundle) -> float | None:
    """Share of the injected forces that are detected; None without any."""
    curves = bundle.injected.curves if bundle.injected else ()
    events = sum(one.events for one in curves)
    return round(sum(one.latched for one in curves) / events, 4) if events else None


def why_not(new: EvaluatedBundle, old: EvaluatedBundle | None, is_broken: bool = False) -> str:
    """Why a bundle does not monitor the arm; empty: it does.

    is_broken: the old bundle does not keep its promise.
    """
    free, rejected = new.free_motion, new.rejected
    if not free.hours:
        return "it accepts none of the motion"
    if rejected.share is not None and rejected.share > WORTH_A_WARNING:
        causes = ", ".join(f"{name} {share:.1%}" for name, share in rejected.causes.items()) or "warming up"
        return f"it rejects {rejected.share:.1%} of the motion ({causes})"
    if free.promise_kept is False:
        return (
            f"{free.false_collisions} false alarms in {60 * free.hours:.1f} min, where its limits allow "
            f"{free.promised_per_hour:.3g} an hour"
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
    is_rarer = rate is not None and (rate_before is None or rate < rate_before or is_broken)
    if seen < (LEAST_HITS_KEPT * seen_before if is_rarer else seen_before - MOST_HITS_LOST):
        return f"it detects {seen:.0%} of the hits, {old.name} {seen_before:.0%}"
    return ""


def is_changed(history: Sequence[dict[str, Any]]) -> bool:
    """Whether the bundle in charge is of the arm before a change that may be learned."""
    kinds = [one["kind"] for one in history if one["kind"] == "activation" or one.get("learned")]
    return bool(kinds) and kinds[-1] != "activation"


def base_of(folder: CommissionFolder, bundle: str) -> str:
    """The bundle whose model a bundle with other limits, or with today's friction, comes from."""
    try:
        facts = json.loads(load_bundle(folder.bundles / f"{bundle}.tauext").provenance or "{}")
    except (TauextError, ValueError):
        return bundle
    return str((facts.get("calibrated") or {}).get("base") or bundle)


def named_steps(
    now: Mapping[str, float], errors: Mapping[str, float], earlier: Sequence[Mapping[str, float]]
) -> list[str]:
    """Joints whose friction is far from that of earlier days, in words.

    Args:
        now: friction of the first strokes, times that of training. errors: its standard errors.
        earlier: the same of earlier days.
    """
    found = []
    for joint, factor in now.items():
        logs = np.log([one[joint] for one in earlier if one.get(joint, 0.0) > 0] or [1.0])
        usual, spread = float(np.median(logs)), float(np.std(logs))
        apart = abs(float(np.log(factor)) - usual)
        if apart > max(STEP, STEP_SPREADS * float(np.hypot(spread, errors[joint]))):
            found.append(f"friction of {joint} is {factor / np.exp(usual):.2f} times that of earlier days")
    return found


def _pause(before: Segment, after: Segment) -> float:
    return 1e-9 * (after.from_ns - before.to_ns)


def _up_to(segments: Sequence[Segment], seconds: float) -> list[Segment]:
    """The first of these recordings, until they last so long."""
    lasts = np.cumsum([one.seconds for one in segments])
    return list(segments[: int(np.searchsorted(lasts, seconds)) + 1])


# --- The process.


class Share(Silent):
    """Passes the share of a training that is done. Discards all messages."""

    def __init__(self, show: Callable[[float], None]):
        self._show, self._shown = show, time.monotonic()

    def progress(self, title: str) -> AbstractContextManager[Show]:
        def show(done: int, total: int, note: str) -> None:
            if time.monotonic() > self._shown + 1:
                self._shown = time.monotonic()
                self._show(done / max(1, total))

        return nullcontext(show)


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
            except TauextError as error:
                folder.log(f"the training process failed: {error}")
                failed[str(error)] = failed.get(str(error), 0) + 1
            try:
                if pipe.poll(POLL_S * min(60, 2 ** max(failed.values(), default=0)) if what == "nothing" else 0):
                    pipe.recv()
            except (EOFError, OSError):
                return
