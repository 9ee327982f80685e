"""Bundles on recordings: metrics on test free motion, collisions found, and the estimates that the figures need."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from tauext import _core
from tauext.bundle.bundle_file import changed_since_training
from tauext.bundle.estimates import STALE, Estimates, save_estimates
from tauext.bundle.loss_history import LossHistory
from tauext.check.before_training import Rejected
from tauext.data.dataset import ahead
from tauext.data.free_motion import free_samples, unknown_s
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.files.checkpoint import Checkpoint
from tauext.files.plain_file import FORMAT
from tauext.fit.tail import at_most_per_hour, promised_per_hour
from tauext.monitor.estimate import estimate_recording
from tauext_lab.evaluate.collisions import (
    STRONG_PEAK,
    Collision,
    LatchVerdict,
    TouchMeasures,
    by_strength,
    choose_ten,
    find_collisions,
    found_curve,
    judge,
    judge_latched,
    latched_summary,
)
from tauext_lab.evaluate.config import EventsConfig
from tauext_lab.evaluate.errors import ErrorAgainstSigma, sensor_reference
from tauext_lab.evaluate.events import EventMeasures, Labels, OtherMeasures, OwnTorque, own_limits
from tauext_lab.evaluate.free_motion import (
    AfterContact,
    DuringContact,
    FreeMotionErrors,
    LimitsHeld,
    Sanity,
    sanity_detectors,
)
from tauext_lab.evaluate.injected import EVENTS, Injection
from tauext_lab.evaluate.missed_curve import MissedCurve
from tauext_lab.evaluate.results import CollisionVerdict, DetectedForces, EvaluatedBundle, Limits, Results
from tauext_lab.other_methods import OtherMethod

# --- All measurements of one bundle, collected recording by recording.


COPIED = ("recipe", "case", "training_minutes", "steps", "epochs", "batch")
"""Fields of a bundle's provenance that its entry contains."""


class BundleMeasures:
    """One bundle's numbers."""

    def __init__(
        self,
        name: str,
        bundle: _core.Bundle,
        events: EventsConfig = EventsConfig(),  # noqa: B008
        touches: TouchMeasures | None = None,
    ) -> None:
        self._name, self._bundle = name, bundle
        self._errors = FreeMotionErrors(bundle.joints, bundle.near_stiction_rad_s)
        self._curve = MissedCurve(bundle.hold_s)
        self._after = AfterContact(bundle.joints)
        self._during = DuringContact(bundle.joints)
        self._sigma = ErrorAgainstSigma(bundle.joints)
        self._rejected = Rejected()
        self._events = EventMeasures(events)
        self._touches = touches or TouchMeasures(bundle)
        self._verdicts: list[CollisionVerdict] = []
        self._latched: list[LatchVerdict] = []

    def add_events(self, labels: Labels, estimates: Estimates) -> None:
        """Add any recording once, for events, free time and health."""
        self._rejected.add(labels.recording.name, estimates.health, estimates.causes)
        self._events.add_estimates(labels, estimates)

    def add_free(self, recording: Recording, estimates: Estimates) -> None:
        """Add a test recording; all of it is free motion except unhealthy time."""
        self._errors.add(recording, estimates)
        self._curve.add_free(recording, estimates)
        self._after.add_free(recording, estimates)
        self._sigma.add(estimates)

    def add_touched(
        self, touches: Sequence[Collision], recording: Recording, estimates: Estimates, reference: np.ndarray | None
    ) -> None:
        """Add a recording with these collisions; the reference is `sensor_reference` at the bundle's gain."""
        self._verdicts += [judge(touch, recording, estimates) for touch in touches]
        self._latched += [judge_latched(t, recording, estimates, self._bundle.hold_s, reference) for t in touches]
        self._curve.add_collisions(touches, recording, estimates)
        self._after.add_touched(recording, estimates)
        self._during.add(touches, recording, estimates, reference)
        self._sigma.add_touched(touches, recording, estimates, reference)
        self._touches.add(touches, recording, estimates)

    def peaks_over_limit(self) -> dict[str, float | None]:
        """Ratio of the sensor's peak to the bundle's limits, by collision id."""
        return {verdict.id: verdict.peak_over_limit for verdict in self._verdicts}

    def summary(
        self,
        touches: Sequence[Collision],
        ten: Sequence[str],
        loss_history: LossHistory | None,
        forces: DetectedForces = DetectedForces(None),  # noqa: B008
    ) -> EvaluatedBundle:
        """All numbers of the bundle.

        Args:
            touches: all that were added, in their order.
            ten: ids of the chosen ones.
        """
        bundle = self._bundle
        trained = json.loads(bundle.provenance or "{}")
        limits = trained.get("limits") or {}
        losses = tuple((int(step), training, check) for step, training, check in loss_history or ())
        sliding, near = (
            tuple(limit if np.isfinite(limit) else None for limit in level)  # none: not monitored
            for level in (bundle.sliding_limit_nm, bundle.near_stiction_limit_nm)
        )
        return EvaluatedBundle(
            name=self._name,
            bundle=f"{bundle.name}.tauext",
            estimate_units=tuple(bundle.estimate_units),
            **{key: trained.get(key) for key in COPIED},
            free_motion=self._errors.summary(promised_per_hour(limits), at_most_per_hour(limits)),
            limits=Limits(sliding, near, bundle.error_scale.follows),
            collisions=tuple(self._verdicts),
            ten_found=sum(verdict.found for verdict in self._verdicts if verdict.id in ten),
            found_curve=found_curve(self._verdicts),
            rejected=self._rejected.summary(),
            latched=latched_summary(self._latched),
            by_strength=by_strength(touches, self._latched),
            missed_curve=self._curve.summary(),
            after_contact=self._after.summary(),
            rmse_during_contact_nm=self._during.rmse_nm(),
            error_against_sigma=self._sigma.summary(),
            events=self._events.summary(),
            touches=self._touches.summary(),
            loss_history=losses or None,
            changed_since_training=changed_since_training(trained),
            forces=forces,
        )


# --- All bundles on all recordings.


Loader = Callable[[], Recording]


def evaluate(
    bundles: Mapping[str, _core.Bundle],
    test: Sequence[Loader],
    collisions: Sequence[Loader],
    estimates_dir: Path,
    seed: int,
    threads: int,
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
    loss_histories: Mapping[str, LossHistory | None] | None = None,
    keep_free_estimates: int = 20,
    sanity: bool = False,
    events: EventsConfig = EventsConfig(),  # noqa: B008
    quiet: Sequence[Loader] = (),
    kept: Checkpoint | None = None,
    inject: bool = False,
    others: Mapping[str, OtherMethod] = MappingProxyType({}),
) -> Results:
    """Evaluate every bundle; the results have no provenance.

    Recordings are loaded one at a time, so that the memory of one suffices for hours of data.

    Args:
        bundles: by their names.
        test: recordings outside training and validation; of those with contacts the free motion counts, and
            the contacts are taken with the others. Time of unknown contact counts nowhere.
        collisions: recordings with contacts.
        estimates_dir: gets one folder per bundle, with estimates of all collision recordings and of some free motion.
        seed: of the choice of ten collisions, and of random alarms.
        loss_histories: of the bundles' training, by their names; only passed on.
        keep_free_estimates: number of test recordings whose estimates are written. Hours of them would fill a disk;
            figures need minutes.
        sanity: add detectors without information, see `Sanity`.
        events: how labels are read, see `labelled_events`.
        quiet: recordings whose free time gives the limits of the robot's own tau_ext, where it has one.
        kept: checkpoint of a killed process; its estimates are on disk already.
        inject: add forces to free test motion, see `Injection`.
        others: methods of others by their names, compared with labels.

    Raises:
        BundleError: a recording does not fit a bundle.
        TrainingError: a recording lacks a signal that one of the other methods needs.
        ConfigError: no bundle or no recording, or keep_free_estimates < 0.
    """
    expect_work(bundles, test, collisions, keep_free_estimates)
    for name in bundles:
        (estimates_dir / name).mkdir(parents=True, exist_ok=True)
    comparison, done = (kept.load(tuple[Comparison, int]) if kept else None) or (None, 0)
    if comparison is None:
        own_nm = own_limits(load() for load in quiet)
        own = None if own_nm is None else OwnTorque(own_nm, events)
        injection = Injection(bundles, seed, math.ceil(EVENTS / max(1, len(test)))) if inject else None
        comparison = Comparison(bundles, events, sanity_detectors(seed) if sanity else [], own, injection, others)
    total = len(test) + len(collisions)
    with ThreadPoolExecutor(max(1, min(threads, len(bundles)))) as pool:
        for number, recording in enumerate(ahead([*test, *collisions][done:]), done):
            free = number < len(test)
            keep_in = estimates_dir if not free or number < keep_free_estimates else None
            comparison.add(number, recording, free, threads, keep_in, pool)
            progress("evaluate", number + 1, total)
            if kept:
                kept.offer((comparison, number + 1))
    return comparison.summary(seed, loss_histories or {})


class Comparison:
    """Bundles, detectors without information, and the robot's own estimate, on the same recordings one by one."""

    def __init__(
        self,
        bundles: Mapping[str, _core.Bundle],
        events: EventsConfig,
        ignorant: Sequence[Sanity],
        own: OwnTorque | None,
        injection: Injection | None = None,
        others: Mapping[str, OtherMethod] = MappingProxyType({}),
    ):
        self._bundles, self._ignorant, self._own, self._injection = bundles, ignorant, own, injection
        self._events = events
        self._measures = {name: BundleMeasures(name, bundle, events) for name, bundle in bundles.items()}
        self._others = [OtherMeasures(name, other, EventMeasures(events)) for name, other in others.items()]
        self._limits_held = {name: LimitsHeld() for name in bundles}
        self._touches: list[Collision] = []
        self._unknown_s = 0.0

    def add(
        self,
        number: int,
        recording: Recording,
        free: bool,
        threads: int,
        keep_in: Path | None,
        pool: ThreadPoolExecutor,
    ) -> None:
        """Add a recording. number: its index; free: it belongs to the test set, whose free motion counts.

        Args:
            threads: of each bundle's network: the last bundle of a recording then has all cores.
            keep_in: folder for its estimates, with a folder a bundle; None: they are not kept.
            pool: evaluates the bundles, one thread each.
        """
        found, all_free = find_collisions(recording), bool(free_samples(recording).all())
        self._touches += found
        self._unknown_s += unknown_s([recording])
        speeds = [bundle.near_stiction_rad_s for bundle in self._bundles.values()]
        labels = {speed: Labels(recording, self._events, speed) for speed in set(speeds)}
        if self._own is not None:
            self._own.add(labels[speeds[0]])
        for other in self._others:
            other.add(labels[speeds[0]])
        gains = set() if not found else {bundle.observer.gain_per_s for bundle in self._bundles.values()}
        references = {gain: sensor_reference(recording, gain) for gain in gains}
        hits = self._injection.draw(number, recording) if self._injection is not None and free else []
        last = list(self._bundles)[-1]

        def judge(name: str) -> Estimates | None:
            bundle, measures = self._bundles[name], self._measures[name]
            estimates = estimate_recording(bundle, recording, threads)
            if keep_in is not None:
                save_estimates(replace(estimates, contact_limit_nm=None), keep_in / name / f"{recording.name}.parquet")
            measures.add_events(labels[bundle.near_stiction_rad_s], estimates)
            if free:
                without_touches = estimates if all_free else free_part(recording, estimates)
                measures.add_free(recording, without_touches)
                self._limits_held[name].add(recording, without_touches)
            if found or not free:
                measures.add_touched(found, recording, estimates, references.get(bundle.observer.gain_per_s))
            if self._injection is not None:
                self._injection.add(name, recording, hits, threads)
            return estimates if self._ignorant and name == last else None  # else the memory of all at once

        *_, estimates = pool.map(judge, self._bundles)
        for detector in self._ignorant:
            assert estimates is not None
            if free and not found:
                detector.add_free(number, recording)
            else:
                detector.add_collisions(number, found, recording, estimates)

    def summary(self, seed: int, histories: Mapping[str, LossHistory | None]) -> Results:
        """All results, without provenance.

        Args:
            seed: of the choice of ten collisions.
            histories: of the bundles' training, by their names.
        """
        first, touches = next(iter(self._bundles.values())), self._touches
        moving = [
            self._measures[name].peaks_over_limit() for name, one in self._bundles.items() if one.error_scale.follows
        ]
        ten = ten_for_all(touches, self._bundles, moving, seed)
        return Results(
            format=FORMAT,
            provenance={},
            joints=tuple(link.joint_name for link in first.links),
            near_stiction_rad_s=first.near_stiction_rad_s,
            ten_collisions=tuple(ten),
            collisions=tuple(collision.summary() for collision in touches),
            bundles=tuple(
                measured.summary(
                    touches,
                    ten,
                    histories.get(name),
                    self._detected(name),
                )
                for name, measured in self._measures.items()
            ),
            own_torque=None if self._own is None else self._own.summary(),
            sanity=tuple(detector.summary() for detector in self._ignorant),
            others=tuple(other.summary() for other in self._others),
            unknown_contact_hours=self._unknown_s / 3600,
        )

    def _detected(self, name: str) -> DetectedForces:
        """What push the bundle of this name detects."""
        added = None if self._injection is None else self._injection.summary(name)
        return DetectedForces(self._limits_held[name].summary(self._bundles[name]), added)


def expect_work(
    bundles: Mapping[str, _core.Bundle], test: Sequence[Loader], collisions: Sequence[Loader], keep_free_estimates: int
) -> None:
    """Raise ConfigError if there is nothing to evaluate, or keep_free_estimates < 0."""
    if not bundles:
        raise ConfigError("there is nothing to evaluate: no bundle was given")
    if not test and not collisions:
        raise ConfigError(
            "there is no test recording: errors and false alarms need free motion outside the training set"
        )
    if keep_free_estimates < 0:
        raise ConfigError(f"keep_free_estimates = {keep_free_estimates} must be >= 0")


def ten_for_all(
    touches: list[Collision],
    bundles: Mapping[str, _core.Bundle],
    moving: Sequence[Mapping[str, float | None]],
    seed: int,
) -> list[str]:
    """Ids of ten collisions that are strong for every bundle or, if there are fewer than ten, for half of the bundles.

    Args:
        moving: `peaks_over_limit` of each bundle with an error scale, whose limits change with the motion.
    """
    limits = np.array([bundle.sliding_limit_nm for bundle in bundles.values()])
    peaks = np.array([[of_bundle[touch.id] or 0.0 for touch in touches] for of_bundle in moving])

    def choose(limit_nm: np.ndarray, peak: np.ndarray) -> list[str]:
        weak = {touch.id for touch, over in zip(touches, peak.tolist(), strict=True) if over < STRONG_PEAK}
        return choose_ten(touches, limit_nm, seed, weak)

    without = np.full(len(touches), np.inf)
    ten = choose(limits.max(axis=0), peaks.min(axis=0) if moving else without)
    if len(ten) < 10:  # one useless method must not leave the others without collisions to show
        ten = choose(np.median(limits, axis=0), np.median(peaks, axis=0) if moving else without)
    return ten


def free_part(recording: Recording, estimates: Estimates) -> Estimates:
    """The estimates with time in or near contacts, or of unknown contact, marked as unhealthy and without alarms."""
    labels = None if recording.contact is None else np.abs(recording.contact)  # an alarm may outlast unknown time, too
    free = free_samples(replace(recording, contact=labels))
    return replace(
        estimates,
        health=np.where(free | ~estimates.healthy, estimates.health, STALE).astype(np.int8),
        detection=estimates.detection & free,
        held_alarm=np.where(free, estimates.held_alarm, 0).astype(np.int8),
    )
