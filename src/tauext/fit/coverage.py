"""Coverage of the training motion, kept so that the monitor recognises motion outside of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tauext import _core
from tauext.data.free_motion import total_s
from tauext.data.recording import Recording
from tauext.fit.regression import FOLDS
from tauext.fit.training_set import Setup


@dataclass(frozen=True)
class CoverageConfig:
    """What motion counts as familiar; a wider reach reports less, also of motion whose errors are unknown."""

    reaches: tuple[int, ...] = (2, 3, 4, 5, 6, 8, 12)
    """Within how many cells of a 64th of a turn a joint's position may be familiar: 11 to 68 degrees ..."""
    reaches_together: tuple[int, ...] = (1, 2, 3, 4, 6, 8)
    """... and in a pair, in cells of a 32nd: as many."""
    most_false: float = 0.002
    """Largest share of left-out motion reported as unfamiliar by the position of a joint ..."""
    most_false_together: float = 0.005
    """... and by those of all pairs."""
    short_min: float = 10.0
    """Less motion holds so few poses, [minutes], that a fifth of it hardly misses one: half of it is left out in turn,
    and the reach is the next wider one. On simulated arms 0.3 to 1.0 % of other motion was called unfamiliar after 5
    minutes of training, and 1.4 to 5.3 % without."""
    least_speed_rad_s: float = 0.05
    """Speed always allowed for joints that training hardly moved, [rad/s], so that noise is not reported."""


@dataclass(frozen=True)
class CoverageFit:
    """Coverage of training, and the share of motion of the same kind that would be reported as unfamiliar."""

    settings: _core.CoverageSettings
    left_out_share: float
    """Share for each fifth of the motion against the other four, or each half against the other."""


@dataclass(frozen=True)
class Motion:
    """Samples at the network period, of all recordings one after the other, (samples, joints)."""

    q: np.ndarray
    dq: np.ndarray
    lasting: np.ndarray
    """|dq| that lasted until the next sample: a lone wrong value is no speed."""

    @classmethod
    def of(cls, recordings: Sequence[Recording], stride: int) -> Motion:
        """Every stride-th sample of each recording."""
        q = [recording.q[::stride] for recording in recordings]
        dq = [recording.dq[::stride] for recording in recordings]
        speeds = [np.abs(one) for one in dq]
        lasting = [np.minimum(speed, np.concatenate([speed[1:], speed[-1:]])) for speed in speeds]
        return cls(np.concatenate(q), np.concatenate(dq), np.concatenate(lasting))

    def cut(self, at: np.ndarray) -> Motion:
        """Some of the samples."""
        return Motion(self.q[at], self.dq[at], self.lasting[at])


def fit_coverage(
    setup: Setup, recordings: Sequence[Recording], config: CoverageConfig = CoverageConfig()
) -> CoverageFit:
    """Speeds and positions of this motion, positions as finely as this much motion allows.

    Positions near a seen one are familiar too: within the least reach of each joint with which, of every fifth of the
    motion beside the other four, no more than `most_false` would be called unfamiliar, and of pairs of joints, all
    alike, `most_false_together`. Minutes of many joints leave gaps between what was seen; see `short_min`. Where not
    even the widest will do, a position (pairs) has no information.

    Args:
        recordings: free motion, at least one sample.
    """
    motion = Motion.of(recordings, setup.observer.network_stride)
    slides = np.array([link.type == _core.JointType.prismatic for link in setup.tree.links])
    nothing = np.zeros(len(slides), dtype=int)
    short = total_s(recordings) < 60 * config.short_min
    count = 2 if short else FOLDS
    if len(motion.q) < count:
        return CoverageFit(seen(motion, slides, nothing, 0), 0.0)
    parts = np.array_split(np.arange(len(motion.q)), count)
    folds = [(motion.cut(np.concatenate(parts[:k] + parts[k + 1 :])), motion.cut(parts[k])) for k in range(count)]

    def reported(reach: np.ndarray, together: int, speeds: bool = False) -> float:
        """Share of the left-out samples that the remaining motion would report as unfamiliar."""
        number = 0
        for stayed, left in folds:
            looked = seen(stayed, slides, reach, together).look(left.q, left.dq if speeds else 0 * left.dq)
            number += int((looked["share"] >= _core.CoverageSettings.WORTH_TELLING).sum())
        return number / len(motion.q)

    def least(reaches: Sequence[int], share: Callable[[int], float], most: float) -> int:
        """The least reach by which no more than this share is reported, or the next one; 0: none."""
        found = next((k for k, cells in enumerate(reaches) if share(cells) <= most), None)
        return 0 if found is None else reaches[min(found + short, len(reaches) - 1)]

    def own(joint: int) -> int:
        """The reach of a joint by itself."""
        only = (np.arange(len(slides)) == joint).astype(int)
        return least(config.reaches, lambda cells: reported(cells * only, 0), config.most_false)

    reach = np.array([own(joint) for joint in range(len(slides))])
    together = 0
    if len(slides) > 1:
        together = least(config.reaches_together, lambda cells: reported(nothing, cells), config.most_false_together)
    return CoverageFit(seen(motion, slides, reach, together), reported(reach, together, speeds=True))


def seen(motion: Motion, slides: np.ndarray, reach: np.ndarray, together: int) -> _core.CoverageSettings:
    """Coverage of this motion. Cells of a revolute joint cover one turn, those of a prismatic joint twice its range.

    Args:
        slides: whether a joint does, (joints,).
        reach: of each joint by itself, (joints,), [cells]; 0: it has no information.
        together: that of pairs.
    """
    n = len(slides)
    low, high = motion.q.min(axis=0), motion.q.max(axis=0)
    settings = _core.CoverageSettings()
    settings.fastest_rad_s = np.maximum(motion.lasting.max(axis=0), CoverageConfig.least_speed_rad_s).tolist()
    settings.turns = [0 if slide else 1 for slide in slides]
    settings.centre_rad = np.where(slides, (low + high) / 2, 0.0).tolist()
    settings.span_rad = np.where(slides, np.maximum(2 * (high - low), 0.1), 2 * np.pi).tolist()
    settings.seen, settings.reach = [0] * n, reach.tolist()
    settings.seen_together = [0] * (n * (n - 1) // 2 * settings.PAIR_CELLS if together else 0)
    settings.reach_together = together
    settings.see(motion.q)
    return settings


def coverage_facts(fit: CoverageFit, joints: Sequence[str]) -> dict:
    """Bounds of familiar motion as plain JSON: speeds [rad/s], distances from seen positions [rad]."""
    sizes, settings = _core.CoverageSettings, fit.settings
    cell_rad = np.array(settings.span_rad) / sizes.CELLS
    pair_cell_rad = float(cell_rad[np.array(settings.turns) == 1].max(initial=0.0)) * sizes.CELLS / sizes.PAIR_CELLS
    return {
        "fastest_rad_s": dict(zip(joints, settings.fastest_rad_s, strict=True)),
        "reach_rad": dict(zip(joints, (cell_rad * settings.reach).tolist(), strict=True)),
        "reach_together_rad": pair_cell_rad * settings.reach_together,
        "left_out_share": fit.left_out_share,
    }
