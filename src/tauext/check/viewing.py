"""All checks look at a share of what is learned from; the cheap ones, and for contacts, at every sample of it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from dataclasses import replace
from pathlib import Path

import numpy as np

from tauext.check.contacts import is_unlabelled_contact, spoils_contacts
from tauext.check.examine import Diagnosis, examine
from tauext.check.finding import Finding, Severity
from tauext.check.memory import digest_of, file_digest, remembered
from tauext.check.quick import quick_look, unlabelled_contacts
from tauext.check.verdict import Look
from tauext.data.cut import cut
from tauext.data.recording import Recording
from tauext.data.stretches import stretches
from tauext.files.place import Place
from tauext.progress import Reporter

MOST_MOVING_S = 180.0
"""Of motion that all checks look at, [s], the same share of each recording from its beginning on: order, axes, signs
and scales show within half a minute, what is rare the cheap checks see."""
LEAST_MOVING_S = 20.0
"""Of each recording, [s]: a shorter one shows too little to be held against the others."""
LEAST_ROWS = 200
"""Of each recording: stamps of another unit make seconds of an hour, or hours of a second."""
MOVES_RAD_S = 0.02
FITTED = ("effort-scale", "effort-motor-side")
"""Is no fault where the factor is what training finds."""
LESSER: Mapping[str, Severity] = {
    "contact-in-free-motion": "note",  # is labelled: training and limits leave it out, and say so
    "smoothed": "warning",  # model and friction are right, limits too low for the raw signal
}
"""What no fault of these codes is more than where something is learned."""
TOO_FEW = ("too-short", "temperature-drift")
"""What a share of the recordings cannot tell."""
RARE = ("spike",)
"""Is in a share of the recordings by luck."""
AT_A_TIME = 4
"""Recordings that are looked at at a time, at most."""


def look_at_training(
    recordings: Sequence[Recording],
    robot: Path | None,
    limits_nm: np.ndarray | None,
    finds_constants: bool,
    threads: int,
    report: Reporter,
) -> Look:
    """All checks of what a training learns from, remembered by content.

    Contacts that are labelled are left out of it, hence no fault.

    Args:
        recordings: for training and validation, as they will be used.
        robot: the robot file; None: there is no model, and nothing is held against one.
        limits_nm: largest torque of each drive, (joints,); None: tau is in another unit, or nothing is known.
        finds_constants: whether training finds what tau is to be multiplied by, which nobody knows before.
        threads: 0: one a core. What is found does not depend on it.
    """
    settings = [str(finds_constants), "none" if robot is None else file_digest(robot), _words(limits_nm)]
    workers = _workers(threads)
    with ThreadPoolExecutor(workers) as pool:
        digests = list(pool.map(digest_of, recordings))

    def find() -> list[Finding]:
        few = shares(recordings)
        diagnoses: list[Diagnosis] = []

        def examined() -> list[Finding]:
            diagnoses.append(examine(few, robot))
            return diagnoses[0].findings

        tasks = [examined, *(_quick(one, limits_nm) for one in recordings)]
        general, *quick = _in_parallel(tasks, workers, "look at the data", report)
        if any(a is not b for a, b in zip(few, recordings, strict=True)):
            general = [f for f in general if f.code not in TOO_FEW]
            refused = any(forgiven(f).severity == "fault" for f in general)
            if not refused and not spoils_contacts(general):
                general = [f for f in general if not is_unlabelled_contact(f)]
                general += unlabelled_contacts(recordings, diagnoses[0])
        return together([f for f in map(forgiven, general) if not (finds_constants and f.code in FITTED)], quick)

    return Look(_worth_telling(remembered(["training", *settings, *digests], find)))


def look_at_calibration(files: Sequence[Place], limits_nm: np.ndarray | None, threads: int, report: Reporter) -> Look:
    """The cheap checks of every calibration recording, remembered by content.

    Args:
        files: the recordings.
        limits_nm: as of look_at_training.
    """
    workers = _workers(threads)
    with ThreadPoolExecutor(workers) as pool:
        digests = [f"{file.name} {digest}" for file, digest in zip(files, pool.map(file_digest, files), strict=True)]

    def find() -> list[Finding]:
        tasks = [_quick_of(load, limits_nm) for load in stretches(files)]
        found = _in_parallel(tasks, workers, "look at the calibration recordings", report)
        return [forgiven(finding) for of_recording in found for finding in of_recording]

    return Look(_worth_telling(remembered(["calibration", _words(limits_nm), *digests], find)))


def shares(recordings: Sequence[Recording]) -> list[Recording]:
    """The beginning of each, as long as its share of MOST_MOVING_S of motion takes; all where there is no more."""
    moving = [np.cumsum((np.abs(r.dq) > MOVES_RAD_S).any(axis=1)) / r.rate_hz for r in recordings]
    share = min(1.0, MOST_MOVING_S / max(1e-9, sum(float(m[-1]) for m in moving)))
    if share == 1.0:
        return list(recordings)
    ends = [max(LEAST_ROWS, int(np.searchsorted(m, max(LEAST_MOVING_S, share * m[-1]))) + 1) for m in moving]
    return [r if end >= r.samples else cut(r, slice(0, end)) for r, end in zip(recordings, ends, strict=True)]


def forgiven(finding: Finding) -> Finding:
    """A fault that training leaves out, or that leaves training right, is a lesser finding: no reason to refuse."""
    return replace(finding, severity=LESSER.get(finding.code, "fault")) if finding.severity == "fault" else finding


def together(general: Sequence[Finding], quick: Iterable[Sequence[Finding]]) -> list[Finding]:
    """The findings of all checks, and of the cheap ones the faults that those did not say, and what is rare.

    Other warnings that hold for one recording, and not for all of them together, are none.
    """
    said = {(f.code, f.joint, f.recording) for f in general}
    found = list(general)
    for finding in (forgiven(finding) for of_recording in quick for finding in of_recording):
        if finding.severity != "fault" and finding.code not in RARE:
            continue
        same = {(finding.code, joint, name) for joint in (finding.joint, None) for name in (finding.recording, None)}
        if not said & same:
            found.append(finding)
    return found


def _worth_telling(findings: Iterable[Finding]) -> list[Finding]:
    return [finding for finding in findings if finding.severity != "note"]


def _quick(recording: Recording, limits_nm: np.ndarray | None) -> Callable[[], list[Finding]]:
    return lambda: quick_look(recording, limits_nm)


def _quick_of(load: Callable[[], Recording], limits_nm: np.ndarray | None) -> Callable[[], list[Finding]]:
    return lambda: quick_look(load(), limits_nm)


def _in_parallel(
    tasks: Sequence[Callable[[], list[Finding]]], workers: int, title: str, report: Reporter
) -> list[list[Finding]]:
    """What each found, in their order; the first error ends all."""
    with report.progress(title) as show, ThreadPoolExecutor(workers) as pool:
        futures: list[Future[list[Finding]]] = [pool.submit(task) for task in tasks]
        try:
            for done, future in enumerate(as_completed(futures), 1):
                future.result()
                show(done, len(futures), "checks")
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return [future.result() for future in futures]


def _words(limits_nm: np.ndarray | None) -> str:
    return "unknown" if limits_nm is None else ", ".join(f"{limit:g}" for limit in limits_nm)


def _workers(threads: int) -> int:
    return min(threads or os.cpu_count() or 1, AT_A_TIME)
