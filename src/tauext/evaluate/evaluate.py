"""Bundles on recordings: metrics on test free motion, collisions found, and the estimates that the figures need."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.data import Recording
from tauext.data.estimates import save_estimates
from tauext.errors import ConfigError
from tauext.evaluate.collisions import Collision, choose_ten, find_collisions, found_curve, judge
from tauext.evaluate.estimating import estimate, expect_fit
from tauext.evaluate.free_motion import FreeMotionErrors
from tauext.evaluate.latched import judge_latched, latched_summary
from tauext.evaluate.loss_history import LossHistory

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
) -> dict:
    """Results of every bundle: the content of results.json but for its provenance.

    Recordings are loaded one at a time, so that hours of them need the memory of one.

    Args:
        bundles: by the name of their case.
        test: recordings of free motion that neither training nor validation saw.
        collisions: recordings with contacts.
        estimates_dir: gets one folder a case, with the estimates of every recording.
        seed: of the choice of ten collisions.
        loss_histories: of the bundles' training, by the name of their case; only passed on.

    Raises:
        BundleError: a recording does not fit a bundle.
        ConfigError: no bundle or no test recording.
    """
    if not bundles:
        raise ConfigError("there is nothing to evaluate: no bundle was given")
    if not test:
        raise ConfigError(
            "there is no test recording: errors and false alarms need free motion that training never saw"
        )
    for name in bundles:
        (estimates_dir / name).mkdir(parents=True, exist_ok=True)
    joints = [link.joint_name for link in next(iter(bundles.values())).links]
    errors = {name: FreeMotionErrors(len(joints), bundle.near_stiction_rad_s) for name, bundle in bundles.items()}
    touches: list[Collision] = []
    verdicts: dict[str, list[dict]] = {name: [] for name in bundles}
    latched: dict[str, list[dict]] = {name: [] for name in bundles}
    total = len(test) + len(collisions)
    for number, load in enumerate([*test, *collisions]):
        recording = load()
        found = find_collisions(recording)
        free = number < len(test)
        if free and found:
            raise ConfigError(f"{recording.name}: a test recording of free motion holds contacts")
        touches += found
        for name, bundle in bundles.items():
            expect_fit(bundle, recording)
            estimates = estimate(bundle, recording, threads)
            save_estimates(estimates, estimates_dir / name / f"{recording.name}.parquet")
            if free:
                errors[name].add(recording, estimates)
            verdicts[name] += [judge(collision, recording, estimates) for collision in found]
            latched[name] += [judge_latched(collision, recording, estimates, bundle.hold_s) for collision in found]
        progress("evaluate", number + 1, total)

    histories = loss_histories or {}
    largest_limit = np.max([bundle.sliding_limit_nm for bundle in bundles.values()], axis=0)
    ten = choose_ten(touches, largest_limit, seed)
    return {
        "joints": joints,
        "near_stiction_rad_s": next(iter(bundles.values())).near_stiction_rad_s,
        "ten_collisions": ten,
        "collisions": [collision.summary() for collision in touches],
        "cases": [
            _case(name, bundle, errors[name], touches, verdicts[name], ten)
            | {"latched": latched_summary(latched[name]), "loss_history": histories.get(name)}
            for name, bundle in bundles.items()
        ],
    }


def _case(
    name: str,
    bundle: _core.Bundle,
    errors: FreeMotionErrors,
    touches: list[Collision],
    verdicts: list[dict],
    ten: list[str],
) -> dict:
    trained = json.loads(bundle.provenance or "{}")
    found = {verdict["id"]: verdict["found"] for verdict in verdicts}
    return {
        "name": name,
        "bundle": f"{bundle.name}.tauext",
        **{key: trained.get(key) for key in ("recipe", "steps", "epochs", "batch")},
        "free_motion": errors.summary(),
        "limits": {"sliding_nm": bundle.sliding_limit_nm, "near_stiction_nm": bundle.near_stiction_limit_nm},
        "collisions": verdicts,
        "ten_found": sum(found[one] for one in ten),
        "found_curve": found_curve(touches, verdicts, np.array(bundle.sliding_limit_nm)),
    }
