"""Bundles on recordings: metrics on test free motion, collisions found, and the estimates that the figures need."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.config import EventsConfig
from tauext.data import Recording, free_samples, scaled_torque, torque_constants_of
from tauext.data.estimates import STALE, Estimates, save_estimates
from tauext.errors import ConfigError
from tauext.evaluate.case import CaseMeasures
from tauext.evaluate.collisions import Collision, choose_ten, find_collisions
from tauext.evaluate.estimating import estimate, expect_fit
from tauext.evaluate.loss_history import LossHistory
from tauext.evaluate.own_torque import OwnTorque, own_limits
from tauext.evaluate.reference import sensor_reference
from tauext.evaluate.sanity import sanity_detectors

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
) -> dict:
    """Results of every bundle: the content of results.json but for its provenance.

    Recordings are loaded one at a time, so that hours of them need the memory of one.

    Args:
        bundles: by the name of their case.
        test: recordings that neither training nor validation saw; of those with contacts the free motion counts, and
            the contacts are taken with the others.
        collisions: recordings with contacts.
        estimates_dir: gets one folder a case, with the estimates of every collision recording and some of free motion.
        seed: of the choice of ten collisions, and of random alarms.
        loss_histories: of the bundles' training, by the name of their case; only passed on.
        keep_free_estimates: so many test recordings, the first, have their estimates written: hours of them would fill
            a disk, and figures need minutes.
        sanity: add detectors that know nothing, see sanity.py.
        events: how labels are read, see events.py.
        quiet: recordings whose free time gives the limits of the robot's own tau_ext, where it has one.

    Raises:
        BundleError: a recording does not fit a bundle.
        ConfigError: no bundle or no recording, or keep_free_estimates < 0.
    """
    if not bundles:
        raise ConfigError("there is nothing to evaluate: no bundle was given")
    if not test and not collisions:
        raise ConfigError(
            "there is no test recording: errors and false alarms need free motion that training never saw"
        )
    if keep_free_estimates < 0:
        raise ConfigError(f"keep_free_estimates = {keep_free_estimates} must be >= 0")
    for name in bundles:
        (estimates_dir / name).mkdir(parents=True, exist_ok=True)
    measures = {name: CaseMeasures(name, bundle, events) for name, bundle in bundles.items()}
    constants = {name: torque_constants_of(bundle.provenance) for name, bundle in bundles.items()}
    ignorant = sanity_detectors(seed) if sanity else []
    own_nm = own_limits(load() for load in quiet)
    own = None if own_nm is None else OwnTorque(own_nm, events, next(iter(bundles.values())).near_stiction_rad_s)
    touches: list[Collision] = []
    total = len(test) + len(collisions)
    for number, load in enumerate([*test, *collisions]):
        recording = load()
        found = find_collisions(recording)
        free = number < len(test)
        touches += found
        if own is not None:
            own.add(recording)
        gains = set() if not found else {bundle.observer.gain_per_s for bundle in bundles.values()}
        references = {gain: sensor_reference(recording, gain) for gain in gains}
        for name, bundle in bundles.items():
            expect_fit(bundle, recording)
            estimates = estimate(bundle, scaled_torque(recording, constants[name]), threads)
            if not free or number < keep_free_estimates:
                save_estimates(estimates, estimates_dir / name / f"{recording.name}.parquet")
            measures[name].add_events(recording, estimates)
            if free:
                measures[name].add_free(recording, free_part(recording, estimates) if found else estimates)
            if found or not free:
                reference = references.get(bundle.observer.gain_per_s)
                measures[name].add_touched(found, recording, estimates, reference)
        for detector in ignorant:
            if free and not found:
                detector.add_free(number, recording)
            else:
                detector.add_collisions(number, found, recording, estimates)
        progress("evaluate", number + 1, total)

    histories = loss_histories or {}
    first = next(iter(bundles.values()))
    limits = np.array([bundle.sliding_limit_nm for bundle in bundles.values()])
    ten = choose_ten(touches, limits.max(axis=0), seed)
    if len(ten) < 10:  # one hopeless method among many must not leave the others without collisions to show
        ten = choose_ten(touches, np.median(limits, axis=0), seed)
    return {
        "joints": [link.joint_name for link in first.links],
        "near_stiction_rad_s": first.near_stiction_rad_s,
        "ten_collisions": ten,
        "collisions": [collision.summary() for collision in touches],
        "cases": [measured.summary(touches, ten, histories.get(name)) for name, measured in measures.items()],
        "own_torque": None if own is None else own.summary(),
        "sanity": [detector.summary() for detector in ignorant],
    }


def free_part(recording: Recording, estimates: Estimates) -> Estimates:
    """The estimates with what is in contact or near one taken for not healthy, and without its alarms."""
    free = free_samples(recording)
    return replace(
        estimates,
        health=np.where(free | ~estimates.healthy, estimates.health, STALE).astype(np.int8),
        detection=estimates.detection & free,
        held_alarm=None if estimates.held_alarm is None else np.where(free, estimates.held_alarm, 0).astype(np.int8),
    )
