"""Limits of the paper, the largest errors; and what all kinds of limits share: their motion, and how they are set."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tauext import _core
from tauext.config import AlarmConfig, FreeMotionConfig
from tauext.data.free_motion import standing_joints
from tauext.data.recording import Recording
from tauext.errors import TrainingError
from tauext.fit.prior_terms import PriorFit
from tauext.progress import SILENT, Reporter
from tauext.train.error_scale import ErrorRows, HeldOut, whole_recordings
from tauext.train.held_peaks import REGIONS, Peaks, collect_peaks


def set_limits(
    bundle: _core.Bundle,
    limits: np.ndarray,
    alarm: AlarmConfig,
    contact: np.ndarray | None = None,
    holds_s: tuple[float, float] | None = None,
) -> None:
    """Set limits and hold times of a bundle; limits of joints that are not monitored stay infinite.

    Args:
        limits: of a collision, (regions, joints), [N m].
        contact: of a contact; None: the same, as in the paper, where the levels differ in hold time only.
        holds_s: hold times of a collision and a contact; None: the alarm's.
    """
    for level, by_region in (("", limits), ("contact_", limits if contact is None else contact)):
        for region, limit_nm in zip(REGIONS, by_region, strict=True):
            setattr(bundle, f"{level}{region}_limit_nm", np.where(bundle.monitored, limit_nm, np.inf).tolist())
    bundle.hold_s, bundle.contact_hold_s = holds_s or (alarm.collision_hold_s, alarm.contact_hold_s)
    bundle.contact_release_s = alarm.contact_release_s


def change_limits(bundle: _core.Bundle, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """Change the limits of both levels in both regions, (joints,) each, [N m]."""
    for name in (f"{level}{region}_limit_nm" for level in ("", "contact_") for region in REGIONS):
        setattr(bundle, name, change(np.array(getattr(bundle, name))).tolist())


def ignore_standing(bundle: _core.Bundle, recordings: Sequence[Recording]) -> str:
    """Give joints that stand still in all recordings, while others move, infinite limits; returns a sentence.

    Their friction in motion is unknown, and limits of a locked joint would be those of rounding. If no joint moves, all
    keep limits that hold at this pose. Call it first: whatever sets limits later leaves infinite ones.
    """
    stand = standing_joints(recordings)
    if stand.all():
        return "thresholds at rest only: no joint moves in the recordings; in motion expect false alarms"
    if not stand.any():
        return ""
    change_limits(bundle, lambda limit_nm: np.where(stand, np.inf, limit_nm))
    names = [link.joint_name for link, stands in zip(bundle.links, stand, strict=True) if stands]
    verb = "never moves" if len(names) == 1 else "never move"
    return f"{', '.join(names)} {verb} in the recordings: not monitored; move every joint that is to be monitored"


Loaders = Sequence[Callable[[], Recording]]


@dataclass(frozen=True)
class LimitMotion:
    """Free motion from which limits follow; each kind of limits uses some of it."""

    name: str
    """Name of the bundle."""
    alarm: AlarmConfig
    threads: int = 0
    margins: FreeMotionConfig = FreeMotionConfig()
    report: Reporter = SILENT
    note: Callable[[str], None] = lambda words: None
    """Receives sentences about the limits for the user."""
    calibration: Loaders = ()
    """Loaders of recordings that are used for limits alone."""
    peaks: Sequence[Peaks] | None = None
    """Peaks of such recordings without suspects for each of alarm.holds_s, if they are known."""
    out: Path | None = None
    """The bundle to write, beside which a checkpoint keeps the peaks."""
    suspects: int = 0
    """Number of suspected touches that were left out of the motion."""
    poses: Sequence[Sequence[float]] | None = None
    """Poses of the arm's motion, in which links are hit; None: those that the bundle keeps."""
    unseen: Sequence[HeldOut] = ()
    """Motion that was not used for training."""
    left_out: Sequence[HeldOut] = ()
    """Training motion, each part with a bundle that was fitted to the others."""
    rows: ErrorRows | None = None
    """Errors from which the bundle's error scale follows."""
    added_weights: np.ndarray | None = None
    """What other programs added to the scale, (joints, features); see other_programs."""
    rest_sigma_nm: np.ndarray | None = None
    """Standard errors at rest in the recorded motion, (joints,); None: those of the bundle."""
    fit: PriorFit | None = None

    @property
    def by_calibration(self) -> bool:
        """Whether limits follow from recordings that are used for nothing else."""
        return bool(self.calibration) or self.peaks is not None

    @property
    def held_out(self) -> list[HeldOut]:
        """All motion from which no bundle here has learned."""
        return [*self.unseen, *self.left_out]


def put_paper(bundle: _core.Bundle, motion: LimitMotion) -> dict:
    """The paper's limits on validation motion; without any, on the training motion."""
    held_out = motion.unseen or motion.held_out
    set_limits(bundle, paper_limits(bundle, held_out, motion.threads, motion.margins), motion.alarm)
    return {}


def paper_limits(
    bundle: _core.Bundle,
    recordings: Sequence[Recording | HeldOut],
    threads: int,
    margins: FreeMotionConfig = FreeMotionConfig(),  # noqa: B008
) -> np.ndarray:
    """Largest |tau_ext| of each joint on validation free motion [Lim2021], in each region as the paper suggests,
    (regions, joints), [N m].

    A joint that was never near stiction, or has smaller errors there, gets the sliding limit in both regions: friction
    at rest is no more certain than in motion. A joint that never slid gets its limit at rest in both regions; its
    errors in motion are unknown, and `ignore_standing` reports it. Contacts, with margins, are left out.

    Raises:
        TrainingError: no healthy sample of free motion, or |tau_ext| of a joint is zero throughout.
    """
    (peaks,) = collect_peaks(bundle, recordings, (0.0,), threads, margins)
    sliding, near = peaks.largest_nm.T
    sliding[~np.array(bundle.monitored)] = np.inf
    both = np.maximum(sliding, near)
    if (both == 0).any():
        name = bundle.links[int(np.argmin(both))].joint_name
        raise TrainingError(
            f"joint '{name}': |tau_ext| is zero throughout the validation recordings, so its threshold cannot be "
            "found; is its torque recorded?"
        )
    stand = standing_joints(whole_recordings(recordings))
    return np.array([np.where(stand | (sliding == 0), both, sliding), both])
