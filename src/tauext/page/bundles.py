"""Bundles of the simulated arms: trained on first use from a few minutes of motion, then kept in a cache."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from tauext.bundle.bundle_file import load_bundle
from tauext.config import PAPER_CASES, AlarmConfig, ModelCase, PriorConfig, TrainConfig
from tauext.data.recording import Recording
from tauext.errors import ConfigError, TauextError
from tauext.files import copies
from tauext.files.provenance import VERSION
from tauext.progress import Show, Silent
from tauext.sim.arms import DemoArm
from tauext.sim.collect import SETTLE_S
from tauext.sim.rig import draw_motion, measure, roll_out

# --- Free motion of a demo arm, as its instruments record it: what its bundles are trained on.


def practice_recording(arm: DemoArm, seconds: float, seed: int, number: int) -> Recording:
    """Recording `number` of the arm's free motion around its home; the same arguments give the same samples."""
    moving, measuring = (np.random.default_rng(s) for s in np.random.SeedSequence(seed, spawn_key=(number,)).spawn(2))
    settle, samples = round(SETTLE_S * arm.rate_hz), round(seconds * arm.rate_hz)
    q_des, dq_des = draw_motion(arm.motion, len(arm.joints), samples + settle, arm.rate_hz, moving)
    q_des += arm.home
    controls = np.stack([q_des, dq_des], axis=2).reshape(len(q_des), -1)
    truth = roll_out(arm, arm.model, q_des[0], controls).after(settle)
    measured = measure(arm, truth, np.zeros_like(truth.q), measuring)
    return Recording(
        name=f"practice-{number:03d}",
        joints=arm.joints,
        t_ns=np.arange(samples, dtype=np.int64) * round(1e9 / arm.rate_hz),
        **{signal: measured[signal] for signal in ("q", "dq", "tau")},
        rate_hz=float(arm.rate_hz),
        torque_timing="held",
        source=arm.title,
        robot_sha256=hashlib.sha256(arm.xml.encode()).hexdigest(),
        provenance={"seed": seed, "number": number},
    )


# --- Bundles of the demo, one a method: trained on first use from a few minutes of practice, then kept in a cache.


ERRORS = {"exact": "exact", "mass": "half the mass", "none": "no model at all"}
"""Model cases that the demo offers, and how the page calls them."""
STALE_S = 24 * 3600.0
"""A training that was killed leaves its folder; a folder of this age is no longer in use."""

Report = Callable[[float, str], None]
"""Called with the share that is done, 0 to 1, and what is being done."""


def short_training(ripples: int, steps: int) -> dict[str, TrainConfig]:
    """What each method is trained by, shortened to what a demo may take.

    The paper's network learns by the dense recipe, whose steps each teach a hundred times as much; tauext's method is
    the prior alone, since its network needs an hour of motion. Limits are found in each method's own way.
    """
    little_reserve = AlarmConfig(friction_reserve=0.1)
    return {
        "tauext": TrainConfig(recipe="prior", alarm=little_reserve, prior=PriorConfig(most_ripples=ripples)),
        "paper": TrainConfig(recipe="dense", max_steps=steps),
        "observer": TrainConfig(recipe="observer"),
    }


@dataclass(frozen=True)
class Lesson:
    """How much free motion is simulated, and what is trained on it."""

    recordings: int  # the first of them train, the rest validate
    recording_s: float = 60.0
    validation: int = 4
    prior_recordings: int = 8  # the prior needs less motion, and its fit takes longer with more
    methods: dict[str, TrainConfig] = field(default_factory=lambda: short_training(ripples=2, steps=3000))


LESSONS = {
    "rig": Lesson(recordings=20),
    "seven": Lesson(recordings=16, prior_recordings=6, methods=short_training(ripples=0, steps=2000)),
}
"""By arm; a search for ripples in seven joints would take longer than everything else."""


def cache_folder() -> Path:
    """Where bundles of demos are kept: $XDG_CACHE_HOME/tauext/demo, or ~/.cache/tauext/demo."""
    return copies.cache_folder() / "demo"


def bundle_folder(arm: DemoArm, error: str, lesson: Lesson, seed: int, cache: Path) -> Path:
    """Folder of the bundles of these settings; another version or other settings have another one."""
    looks = dict.fromkeys(("title", "camera_m", "look_at_m", "floor_m", "push"), None)
    known = {**asdict(arm), **looks}
    del known["hand_m"]  # it is empty in practice
    settings = [known, asdict(lesson), error, seed]
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()
    return cache / f"{VERSION}-{arm.name}-{error}-{digest[:12]}"


def find_bundles(folder: Path, lesson: Lesson) -> dict[str, Path] | None:
    """The bundle of every method; None: not trained yet, or one is damaged."""
    paths = {method: folder / f"{method}.tauext" for method in lesson.methods}
    try:
        for path in paths.values():
            load_bundle(path)
    except TauextError:
        return None
    return paths


def find_or_train_bundles(
    arm: DemoArm, error: str, lesson: Lesson, seed: int, cache: Path, report: Report = lambda share, what: None
) -> dict[str, Path]:
    """Those of an earlier use, else those of train_bundles()."""
    found = find_bundles(bundle_folder(arm, error, lesson, seed, cache), lesson)
    return found or train_bundles(arm, error, lesson, seed, cache, report)


def train_bundles(
    arm: DemoArm, error: str, lesson: Lesson, seed: int, cache: Path, report: Report = lambda share, what: None
) -> dict[str, Path]:
    """Train every method for an arm whose model is wrong in this way; an interrupted training leaves nothing behind.

    The folder appears at once with all that is in it, under its name, or not at all.

    Raises:
        ConfigError: an unknown model error, or a cache that cannot be written.
    """
    if error not in ERRORS:
        raise ConfigError(f"error = {error} must be one of {', '.join(ERRORS)}")
    folder = bundle_folder(arm, error, lesson, seed, cache)
    try:
        cache.mkdir(parents=True, exist_ok=True)
        _sweep(cache)
        part = Path(tempfile.mkdtemp(prefix=f"{folder.name}.part-", dir=cache))
    except OSError as failed:
        raise ConfigError(f"{cache}: bundles cannot be kept there ({failed.strerror}); set XDG_CACHE_HOME") from failed
    try:
        _train(arm, PAPER_CASES[error], lesson, seed, part, report)
        shutil.rmtree(folder, ignore_errors=True)  # damaged, or made meanwhile by another demo
        os.replace(part, folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)
    report(1.0, "done")
    return {method: folder / f"{method}.tauext" for method in lesson.methods}


def _train(arm: DemoArm, case: ModelCase, lesson: Lesson, seed: int, out: Path, report: Report) -> None:
    from tauext.train.preparation import Given
    from tauext.train.stage import train_on_recordings

    recordings = []
    for k in range(lesson.recordings):
        report(0.2 * k / lesson.recordings, "practising free motion")
        recordings.append(practice_recording(arm, lesson.recording_s, seed, k))
    training, validation = recordings[: -lesson.validation], recordings[-lesson.validation :]
    robot = out / "robot.xml"
    robot.write_text(arm.xml)
    done = 0.2
    for method, config in lesson.methods.items():
        share = 0.8 / len(lesson.methods)
        what = f"training method '{method}', {case.name} model"
        report(done, what)
        learns_all = config.row.judges_itself
        train_on_recordings(
            Given(
                robot,
                case,
                recordings[: lesson.prior_recordings] if learns_all else training,
                [] if learns_all else validation,
            ),
            replace(config, seed=seed),
            out / f"{method}.tauext",
            report=_Share(report, done, share, what),
        )
        done += share


class _Share(Silent):
    """Of the whole, from `begin` on: what a training's progress fills. Discards all messages."""

    def __init__(self, report: Report, begin: float, share: float, what: str):
        self._report, self._begin, self._share, self._what = report, begin, share, what

    def progress(self, title: str) -> AbstractContextManager[Show]:
        return nullcontext(lambda done, of, note: self._report(self._begin + self._share * done / of, self._what))


def _sweep(cache: Path) -> None:
    for part in cache.glob("*.part-*"):
        if time.time() - part.stat().st_mtime > STALE_S:
            shutil.rmtree(part, ignore_errors=True)
