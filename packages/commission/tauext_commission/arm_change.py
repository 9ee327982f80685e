"""Compares the arm with earlier days, and names what has changed: the load in its hand, or single joints."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np

from tauext import _core
from tauext.bundle.bundle_file import load_bundle, write_bundle
from tauext.data.free_motion import free_samples
from tauext.data.recording import Recording
from tauext.errors import TauextError, TooLittleMotionError
from tauext.files.provenance import provenance
from tauext.monitor.weighing import ROW_S, expect_weighable, identify, load_frame, see
from tauext.progress import WallTimes
from tauext.train.refit import refit_recordings
from tauext_commission.connect import load_known
from tauext_commission.folder import CommissionFolder, Segment, up_to
from tauext_commission.history_file import read_question
from tauext_commission.motion_recorder import LEARN_FROM, segments_of_arm
from tauext_commission.promises import THREADS, base_of, meets
from tauext_commission.synced_file import write_synced

MOST_LEFT = 0.5
"""Largest share of the squared errors that a named load leaves. On two simulated arms, loads of 0.3 kg and more left
at most 0.18 of them; the best load left at least 0.97 of those of another friction. On a simulated SO-101, 60 g left
0.18 to 0.30, more in the cold; the best load left at least 0.83 where nothing had changed."""
ERRORS, SHARE = 2.0, 0.05
"""A mass is reported within ERRORS standard errors of it, or within this share of it if that is more. It is reported
only if it exceeds 2 * ERRORS of them."""
USUAL, ODD = 2.0, 5.0
"""Error of a joint, divided by that of training: up to the first the joint is as before; from the second it is not."""
ONE_SIGMA = 0.683
LEAST_FREE_S = 10.0


@dataclass(frozen=True)
class LoadChange:
    """A load that explains the torques."""

    mass_kg: float
    """Beside what the arm carried in training; negative: it carries less."""
    within_kg: float
    lever_m: float | None
    """Distance of its centre of mass from the load frame; None: the motion does not determine it."""
    frame: str


def find_change(
    bundle: _core.Bundle, recordings: Sequence[Recording], threads: int
) -> tuple[LoadChange | None, dict[str, float]]:
    """Weigh what the arm carries beside the load of training, in motion without labelled touches.

    An alarm that stands all the time leaves none; all motion is then weighed.

    Returns:
        The load; None if no load explains the torques. The error of each joint, divided by that of training; empty if
        a force explains it, or if the bundle has no robot model that accepts loads.
    """
    settings = bundle.load_settings
    if not settings.settable or not any(link.mass > 0 for link in bundle.links):
        return None, {}
    try:
        expect_weighable(bundle)
        parts, where = [see(bundle, one, threads) for one in recordings], load_frame(bundle)
        free = [one.part(free_samples(one.recording)[one.samples]) for one in parts]
        if sum(one.rows for one in free) * ROW_S >= LEAST_FREE_S:
            parts = free
        # As if the largest load were set: the arm may carry less than in training, too.
        found = identify(bundle, where, parts, settings.largest_reach_m, beside=_core.Load(settings.largest_mass_kg))
    except TauextError:  # torques in amperes, or too little motion
        return None, {}
    if found.verdict == "contact":
        return None, {}
    explains = found.fits["load"].cost < MOST_LEFT * found.fits["nothing"].cost
    if explains and found.mass_seen and abs(found.mass_kg) > 2 * ERRORS * found.mass_error_kg:
        lever = None if found.unseen else float(np.linalg.norm(found.com_m))
        within_kg = max(ERRORS * found.mass_error_kg, SHARE * abs(found.mass_kg))
        return LoadChange(found.mass_kg, within_kg, lever, where.name), {}
    errors = np.quantile(np.concatenate([np.abs(one.tau_ext) / one.sigma for one in parts]), ONE_SIGMA, axis=0)
    return None, dict(zip([link.joint_name for link in bundle.links], errors.tolist(), strict=True))


def change_words(load: LoadChange | None, errors: Mapping[str, float], why: str) -> str:
    """A question about a change of the arm.

    Args:
        errors: error of each joint, divided by that of training; empty: unknown.
        why: why no friction explains the torques.
    """
    if load is not None:
        more = f"{abs(load.mass_kg):.2f} kg {'more' if load.mass_kg > 0 else 'less'}"
        at = "" if load.lever_m is None else f", {1e3 * load.lever_m:.0f} mm from the origin of {load.frame}"
        within = f"within {max(load.within_kg, 0.01):.2f} kg{at}"
        return f"the hand carries {more} than in training ({within}): another tool or payload?"
    odd = {joint: error for joint, error in errors.items() if error > USUAL}
    if odd and len(odd) <= max(1, len(errors) // 3) and min(odd.values()) >= ODD:
        named = " and ".join(f"{joint} (error {error:.3g} times that of training)" for joint, error in odd.items())
        return f"only {named} {'is' if len(odd) == 1 else 'are'} not as before: gear, damage, or a weight on that link?"
    return f"the arm is not as before, and no friction explains it (tool, payload or damage?): {why}"


# --- Days: the first strokes after a pause, and motion full of alarms, are compared with earlier days.


PAUSE_S = 3600.0
"""Pause after which the first strokes are compared with earlier days, [s]; so are those after every start."""
STROKES_S = 60.0
CHANGED_SHARE = 0.9
"""Share of the newest recordings with alarms, none of them a touch, from which the arm may have changed at work."""
CHANGED_AFTER_S = 1200.0
"""Least motion of the arm as it is before that, [s]: early bundles raise alarms in motion that they have not seen."""
CHANGED_FOR_S = 180.0
"""Newest motion in which alarms are counted, [s]."""
STEP, STEP_SPREADS = 0.5, 4.0
"""A change of friction is named if its logarithm exceeds the first, and so many standard deviations of earlier days."""
SINCE_TRAINING = "since_training"
"""Entry of a refitted bundle: factors on the friction of training by joint, those of earlier refits included."""
REFIT_FROM, REFIT_WORTH = 0.1, 0.95
"""Change of friction from which a refit is tried, and the ratio of errors below which it is used."""


class DayComparison:
    """Refits friction in the morning, and asks a person about changes that are no friction."""

    def __init__(self, folder: CommissionFolder):
        self.folder = folder

    def question(self) -> dict[str, Any]:
        """See read_question()."""
        return read_question(self.folder.path)

    def strokes(self, segments: Sequence[Segment], history: Sequence[dict[str, Any]]) -> list[Segment]:
        """Motion to compare with earlier days, up to STROKES_S, but for motion that was compared before.

        These are the first strokes after the newest pause. Once they are compared, it is the newest motion if alarms
        without a touch came during nearly all of the last CHANGED_FOR_S: the arm may have changed without a pause.
        """
        begins = [k for k, (a, b) in enumerate(pairwise(segments), 1) if b.epoch != a.epoch or _pause(a, b) > PAUSE_S]
        first = segments[begins[-1]].number if begins else 0
        done = max((int(one.get("segment") or 0) for one in compared(history)), default=0)
        if begins and first > done:
            return up_to(segments[begins[-1] :], STROKES_S)
        asked = max((int(one.get("segment") or 0) for one in history if one["kind"] == "step"), default=-1)
        newest = up_to(segments[::-1], CHANGED_FOR_S)
        if asked >= first or sum(one.seconds for one in segments) < CHANGED_AFTER_S or newest[-1].number <= done:
            return []
        return up_to(newest, STROKES_S)[::-1] if len(self._alarmed(newest)) >= CHANGED_SHARE * len(newest) else []

    def _alarmed(self, segments: Sequence[Segment]) -> list[Segment]:
        """Recordings with alarms that no answer calls a touch."""
        labels = [one for one in self.folder.labels() if one.id > 0 and one.answer in ("unanswered", "nothing")]
        return [one for one in segments if any(meets(one, label) for label in labels)]

    def compare(self) -> None:
        """Refit to the first strokes; name a load, and what no friction explains or is far beyond the earlier days."""
        folder, active = self.folder, self.folder.active()
        assert active is not None
        history = folder.history()
        motion = self.strokes(segments_of_arm(folder), history)
        folder.progress("comparing the first strokes with earlier days")
        facts: dict[str, Any] = {"bundle": active.stem, "segment": motion[0].number}
        bundle, recordings = load_bundle(active), load_known(folder, motion)
        load, errors = find_change(bundle, recordings, THREADS)
        if load is not None:
            return self._ask(change_words(load, {}, ""), facts)
        try:
            refitted = refit_recordings(bundle, recordings, THREADS)
        except TauextError as error:
            why = " ".join(str(error).split())
            if not bundle.prior.terms:
                words = f"{active.stem} has no friction that could be refitted"
            elif isinstance(error, TooLittleMotionError) and 2 * len(self._alarmed(motion)) < len(motion):
                words = f"the first strokes are not compared with earlier days: {why}"
            else:
                return self._ask(change_words(None, errors, why), facts)
            return folder.note("morning", folder.seconds(), words, **facts)
        factors = {one.joint: one.coulomb[0] * self._factor(active.stem, one.joint) for one in refitted.joints}
        facts["friction"] = {joint: round(factor, 4) for joint, factor in factors.items()}
        earlier = [one["friction"] for one in compared(history) if one.get("friction")]
        if steps := named_steps(factors, {one.joint: one.coulomb[1] for one in refitted.joints}, earlier):
            causes = "a replaced gear, wear or damage" if errors else "a replaced gear, wear, damage or another payload"
            return self._ask(f"{'; '.join(steps)}: {causes}?", facts)
        words = ", ".join(f"{joint} {factor:.2f}" for joint, factor in factors.items())
        folder.note(
            "morning", folder.seconds(), f"friction of the first strokes, relative to training: {words}", **facts
        )
        if any(abs(np.log(one.coulomb[0])) > max(REFIT_FROM, 2 * one.coulomb[1]) for one in refitted.joints):
            out = folder.next_bundle()
            about = json.loads(bundle.provenance or "{}")
            about["refitted"] = provenance("tauext commission", {"bundle": active.name}, seed=None) | refitted.facts()
            about["refitted"][SINCE_TRAINING] = factors
            about["calibrated"] = about.get("calibrated", {}) | {"base": base_of(folder, active.stem)}
            refitted.bundle.name = out.stem
            write_bundle(refitted.bundle, out, about, [], WallTimes())
            content = {"bundle": out.stem, "minutes": 0, "refit": True, "after": motion[-1].number}
            write_synced(folder.pending_file, json.dumps(content) + "\n")

    def _factor(self, bundle: str, joint: str) -> float:
        """Factor of a joint's friction that refits have put into the bundle already."""
        try:
            about = json.loads(load_bundle(self.folder.bundles / f"{bundle}.tauext").provenance or "{}")
        except (TauextError, ValueError):
            return 1.0
        return float(((about.get("refitted") or {}).get(SINCE_TRAINING) or {}).get(joint, 1.0))

    def judge_refit(self, name: str, facts: dict[str, Any], why: str) -> None:
        """A refit monitors if it passes and is better: fewer false alarms, or smaller errors."""
        folder = self.folder
        better = facts.get("error_ratio", 1.0) < REFIT_WORTH
        better |= (facts.get("per_hour") or 0.0) < (facts.get("before") or 0.0)
        why = why or ("" if better else "it is no better than the adaptive bias alone")
        words = f"{name}, refitted to the first strokes of the day, " + (f"is not used: {why}" if why else "passed")
        folder.note("refit", folder.seconds(), words, bundle=name, passed=not why, **facts)
        if not why:
            worse = f"; {facts['worse']}" if facts.get("worse") else ""
            folder.activate(name, f"friction of the first strokes of the day{worse}", folder.seconds())
        folder.pending_file.unlink(missing_ok=True)

    def _ask(self, words: str, facts: dict[str, Any]) -> None:
        """Name a change and ask a person whether it may be learned."""
        self.folder.note("step", self.folder.seconds(), words, **facts)

    def answer(self) -> None:
        """learn: train on motion since the change alone. leave: the bundle in charge stays, and the motion is used."""
        folder, question = self.folder, self.question()
        learns = question["answer"] == "learn"
        if learns:
            folder.save(**{LEARN_FROM: int(question.get("segment") or 0)})
        words = "the change is learned: training begins again" if learns else "the change is not learned"
        folder.note("step", folder.seconds(), f"{words} ({question.get('words')})", learned=learns)


def compared(history: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Comparisons of first strokes with earlier days, those that led to a question included."""
    return [one for one in history if one["kind"] == "morning" or (one["kind"] == "step" and "learned" not in one)]


def is_changed(history: Sequence[dict[str, Any]]) -> bool:
    """Whether the bundle in charge is of the arm before a change that may be learned."""
    kinds = [one["kind"] for one in history if one["kind"] == "activation" or one.get("learned")]
    return bool(kinds) and kinds[-1] != "activation"


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
