"""A bundle that was trained on the warm arm, on the cold one: as it is, and after a refit."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.data.dataset import load_split
from tauext.data.recording import Recording
from tauext.data.recording_file import load_recording
from tauext.evaluate.injected import estimate_recording
from tauext.train.refit import refit_motion, refit_recordings
from unseen.arms import Maker
from unseen.of_type import arm_of
from unseen.recordings import told_constants
from unseen.results import STRONG, nearest

COLLISION, EPISODE_S, AFTER_S = 2, 0.5, 0.5
WARM_UP_S = 3.0


def judge_cold(maker: Maker, seed: int, path: Path, mornings_s: Sequence[float]) -> dict:
    """False collisions and strong contacts that were found: of the old bundle, after a refit on so many seconds each,
    and after one inside a monitor on the first of these."""
    old = _core.Bundle.load(str(path))
    data = path.parent / "data"
    split = load_split(data)
    tests = {name: load_recording(data / name) for name in split.test}
    morning = next(one for name, one in tests.items() if name.startswith("morning"))
    free = [one for name, one in tests.items() if name.startswith("cold")]
    refits = [refit_recordings(old, [first(morning, s + WARM_UP_S)], threads=1) for s in mornings_s]
    told, kept = during_refit(old, first(morning, mornings_s[0] + WARM_UP_S))
    bundles = [old, *(one.bundle for one in refits), refit_motion(old, kept).bundle]
    false, hours = [0] * len(bundles), 0.0
    for recording in free:
        for k, bundle in enumerate(bundles):
            said = estimate_recording(bundle, recording, 1)
            false[k] += false_collisions(said.held_alarm, recording.t_ns)
            hours += float(said.healthy.sum()) / recording.rate_hz / 3600 if k == 0 else 0.0
    meanwhile = false_collisions(told["held_alarm"], morning.t_ns)
    strong, found = strong_found(maker, seed, path, [load_recording(data / name) for name in split.collisions], bundles)
    return {
        "arm": maker.name,
        "hours": hours,
        "false": false,
        "strong": strong,
        "found": found,
        "meanwhile": meanwhile,
        "factors": " · ".join(f"{joint.coulomb[0]:.2f}" for joint in refits[0].joints),
        "raised": " · ".join(f"{joint.limit_factor:.2f}" for joint in refits[0].joints),
    }


def during_refit(bundle: _core.Bundle, recording: Recording) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """What a monitor says that keeps this motion for a refit, its limits raised by the usual share of friction; and
    the motion."""
    monitor = _core.Monitor(bundle)
    monitor.reserve_refit(recording.duration_s + 1)
    monitor.start_refit()
    said = monitor.run(recording.t_ns, recording.q, recording.dq, recording.tau)
    return said, monitor.finish_refit()


def strong_found(
    maker: Maker, seed: int, path: Path, recordings: Sequence[Recording], bundles: Sequence[_core.Bundle]
) -> tuple[int, list[int]]:
    """How many contacts turn some joint by STRONG times its error in training or more, and how many each found."""
    facts = json.loads(bundles[0].provenance)
    error = np.array([facts["prior"]["error_nm"][joint] for joint in maker.joints])
    given = told_constants(maker, seed, True)
    arm = arm_of(maker, seed)
    believed = np.array(bundles[0].observer.nm_per_unit or 1.0)  # times what was told, where the import applied that
    true = arm.nm_per_ampere / (1.0 if given == "unknown" else given) / believed
    truths = json.loads((path.parent / "csv" / "touched.truth.json").read_text())
    strong, found = 0, [0] * len(bundles)
    for recording in recordings:
        assert recording.contact is not None
        start_s = 1e-9 * float(recording.t_ns[0])
        said = [estimate_recording(bundle, recording, 1) for bundle in bundles]
        touched = np.flatnonzero(np.diff(np.r_[0, recording.contact == 1, 0])).reshape(-1, 2)
        for begin, end in touched:
            truth = nearest(truths, start_s + float(recording.time_s[begin]))
            if np.max(np.array(truth["peak_nm"]) / (true * error)) < STRONG:
                continue
            strong += 1
            last = end + round(AFTER_S * recording.rate_hz)
            for k, one in enumerate(said):
                found[k] += bool((one.held_alarm[begin:last] == COLLISION).any())
    return strong, found


def first(recording: Recording, seconds: float) -> Recording:
    """Its first seconds."""
    from tauext.data.free_motion import cut

    return cut(recording, slice(0, int(np.searchsorted(recording.time_s, seconds))))


def false_collisions(held: np.ndarray | None, t_ns: np.ndarray) -> int:
    """Collisions that began, those less than EPISODE_S apart counted as one."""
    assert held is not None
    at = np.flatnonzero(held == COLLISION)
    return 0 if len(at) == 0 else 1 + int((np.diff(t_ns[at]) >= EPISODE_S * 1e9).sum())
