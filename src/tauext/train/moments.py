"""Limits that one moment carries: an end-of-program stop, a touch nobody labelled, a glitch, or the truth.

Such a limit stays: large errors of free motion are what limits are for. But a person is told where to look.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from tauext.train.held_peaks import REGIONS, Peaks

CODE = "one-moment-limit"
MOMENT_S = 1.0
"""A moment is a peak and what lies so near it, [s]: a touch or a stop, and what rings after it."""
CARRIED = 0.6
"""Told where the limit without the moment is less than this share of it: the moment does more than the factor of 1.6
on limits from minutes, which stands for all that minutes do not show. By chance a tail of shape 0.2 has such a largest
peak once in 13 times (0.6^5), one of Gaussian noise hardly ever."""


@dataclass(frozen=True)
class Moment:
    """What sets one joint's limit in one region, all by itself."""

    joint: str
    region: str
    recording: str
    time_s: float
    """Of its largest peak, after the recording's first sample."""
    limit_nm: float
    without_nm: float

    def scaled(self, factor: float, by_nm: float = 0.0) -> Moment:
        """For limits that are raised afterwards."""
        return replace(self, limit_nm=factor * self.limit_nm + by_nm, without_nm=factor * self.without_nm + by_nm)

    def sentence(self, unit: str = "Nm") -> str:
        """In words, for a person who is to look there."""
        return (
            f"warning: {CODE} ({self.joint}): one moment of '{self.recording}', at {self.time_s:.1f} s, sets its limit "
            f"{self.region.replace('_', ' ')}: {self.limit_nm:.3g} {unit}; without it {self.without_nm:.3g} {unit}. If "
            "something touched the arm there, label it; if a signal failed, cut it out"
        )

    def facts(self) -> dict:
        """For provenance, as plain JSON."""
        return asdict(self)


def carrying_moments(peaks: Peaks, limits_of: Callable[[int, Sequence[np.ndarray]], np.ndarray]) -> list[Moment]:
    """Moments without which a limit would be less than CARRIED of what it is; one a joint and moment, of the region
    where it matters most.

    Only peaks are needed again: what lies within MOMENT_S of a region's largest one is left out of both regions.

    Args:
        limits_of: both limits of a joint (regions,), [N m], from its peaks in each region, falling.
    """
    first: dict[str, int] = {}
    same = np.array([first.setdefault(name, k) for k, name in enumerate(peaks.recordings)])
    found = []
    for j, joint in enumerate(peaks.joints):
        with_nm = limits_of(j, peaks.nm[j])
        told: list[tuple[int, int]] = []
        for at in peaks.at[j]:
            if not len(at):
                continue
            number, at_ns = int(same[at[0, 0]]), int(at[0, 1])
            if any(number == other and abs(at_ns - other_ns) <= MOMENT_S * 1e9 for other, other_ns in told):
                continue
            told.append((number, at_ns))
            without_nm = limits_of(j, _without(peaks.nm[j], peaks.at[j], same, number, at_ns))
            r = int(np.argmin(without_nm / with_nm))
            if without_nm[r] < CARRIED * with_nm[r]:
                where = peaks.recordings[number], at_ns * 1e-9
                found.append(Moment(joint, REGIONS[r], *where, float(with_nm[r]), float(without_nm[r])))
    return found


def _without(
    nm: Sequence[np.ndarray], at: Sequence[np.ndarray], same: np.ndarray, number: int, at_ns: int
) -> list[np.ndarray]:
    """The peaks of each region that do not belong to a moment."""
    near = [(same[one[:, 0]] == number) & (np.abs(one[:, 1] - at_ns) <= MOMENT_S * 1e9) for one in at]
    return [values[~left_out] for values, left_out in zip(nm, near, strict=True)]
