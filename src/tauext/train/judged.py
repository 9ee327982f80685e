"""What limits are found on: samples of free motion, and the error that a bundle makes there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from tauext import _core
from tauext.bundle.estimates import STALE
from tauext.config import FreeMotionConfig, warm_up_s
from tauext.data.free_motion import free_samples
from tauext.data.recording import Recording
from tauext.errors import TrainingError


@dataclass(frozen=True)
class Judged:
    """A recording, which of its samples count, and who is judged on them."""

    recording: Recording
    span: slice = field(default_factory=lambda: slice(None))
    bundle: _core.Bundle | None = None
    """A stand-in that was fitted without these samples; None: the bundle itself, which never saw them."""


def whole_recordings(judged: Sequence[Recording | Judged]) -> list[Recording]:
    """Each recording once, however many spans of it are judged."""
    return list({id(r): r for r in (one.recording if isinstance(one, Judged) else one for one in judged)}.values())


def errors(
    bundle: _core.Bundle, judged: Recording | Judged, threads: int, margins: FreeMotionConfig
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Times, |tau_ext|, region and which samples count: (samples,), 2 x (samples, joints) and (samples,) bool.

    |tau_ext| is divided by the error scale of whoever judges, where it has one: what it would be in usual motion.

    Counted are samples of free motion within the span at which an alarm could rise: where tau_ext is held against the
    limits, also while a drive is saturated, which is no healthy one. The whole recording runs through the chain, so
    that filters are warm where the span begins.
    """
    said, error, counted = judge(bundle, judged, threads, margins)
    recording = judged.recording if isinstance(judged, Judged) else judged
    return recording.t_ns, error, said["near_stiction"].astype(bool), counted


def judge(
    bundle: _core.Bundle, judged: Recording | Judged, threads: int, margins: FreeMotionConfig
) -> tuple[dict[str, np.ndarray], np.ndarray, np.ndarray]:
    """All that the chain said of the recording, and of errors() |tau_ext| and which samples count."""
    judged = judged if isinstance(judged, Judged) else Judged(judged)
    recording = judged.recording
    signals = (recording.t_ns, recording.q, recording.dq, recording.tau)
    said = _core.estimate(judged.bundle or bundle, *signals, threads, recording.temperature)
    counted = np.zeros(recording.samples, dtype=bool)
    counted[judged.span] = True
    counted &= (said["health"] != STALE) & np.isfinite(said["tau_ext"]).all(axis=1) & free_samples(recording, margins)
    # What the prior's doubt raises the limits by is no error that limits must stand.
    error = np.maximum(np.abs(said["tau_ext"]) - said["doubt"], 0) / said["limit_scale"]
    return said, error, counted


def no_free_motion(bundle: _core.Bundle, margins: FreeMotionConfig) -> TrainingError:
    """What to raise where no recording holds a sample that counts."""
    warm_s = warm_up_s(bundle.observer.gain_per_s, bundle.observer.low_pass_per_s)
    window = " and the network's window" if bundle.has_network else ""
    return TrainingError(
        f"limits need free motion: no recording holds any beyond the warm-up of {warm_s:g} s{window}, with "
        f"{margins.before_s:g} s before and {margins.after_s:g} s after every contact left out"
    )
