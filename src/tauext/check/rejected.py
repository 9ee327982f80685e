"""How much of some motion a bundle's monitor rejects, and why."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any, Self

import numpy as np

from tauext import _core
from tauext.bundle.estimates import OK
from tauext.data.recording import Recording
from tauext.errors import TrainingError

WORTH_A_WARNING = 0.02
"""Of the samples; beyond it results follow from less motion than was recorded."""
TOO_MUCH = 0.2
"""Beyond it they follow from other motion than was recorded."""
REJECTED = "rejected"
"""With this code a person accepts that."""
REMEDIES = {
    "wrong rate": "import the recordings again, or state their mean rate (arm.toml, [time] rate_hz)",
    "torque saturated": "check the robot file's torque limits and the unit of tau",
    "encoder still": "check which column each joint's position comes from",
    "gap": "record without losing samples",
}
"""By cause; of any other one `tauext check` reports more."""


class Rejected:
    """Counts the samples that are not healthy, by cause and recording.

    Counted are the samples behind the first healthy one of each recording; a recording without any counts whole. The
    warm-up after a fault is rejected, too, and counts for the fault.
    """

    def __init__(self) -> None:
        self.samples = self.rejected = 0
        self._causes: dict[str, int] = {}
        self._shares: dict[str, float] = {}

    @classmethod
    def of(cls, bundle: _core.Bundle, recordings: Iterable[Recording], threads: int) -> Self:
        """What a monitor with this bundle rejects of these recordings."""
        found = cls()
        for recording in recordings:
            said = _core.estimate(bundle, recording.t_ns, recording.q, recording.dq, recording.tau, threads)
            found.add(recording.name, said["health"], said["causes"])
        return found

    def add(self, name: str, health: np.ndarray, causes: np.ndarray | None) -> None:
        """Take in a recording: health and bits of the causes, (samples,)."""
        healthy = health == OK
        first = int(healthy.argmax())  # 0 where none is
        bad = ~healthy[first:]
        bits = np.zeros(len(bad), np.uint32) if causes is None else causes[first:]
        if bad.any() and not healthy.any():
            bad = bits != 0  # all but the warm-up, which has no cause
        for cause, samples in zip(*np.unique(bits[bad], return_counts=True), strict=True):
            for text in _core.cause_names(int(cause)):
                self._causes[text] = self._causes.get(text, 0) + int(samples)
        self._shares[name] = float(bad.mean()) if len(bad) else 0.0
        self.rejected, self.samples = self.rejected + int(bad.sum()), self.samples + len(bad)

    @property
    def share(self) -> float:
        return self.rejected / self.samples if self.samples else 0.0

    def facts(self) -> dict[str, Any]:
        """For JSON: share of the samples, share of each cause, and the worst recording with its share."""
        worst = max(self._shares, key=self._shares.__getitem__, default="")
        return {
            "share": round(self.share, 4),
            "causes": {
                name: round(count / self.samples, 4)
                for name, count in sorted(self._causes.items(), key=lambda cause: -cause[1])
            },
            "worst": {"recording": worst, "share": round(self._shares.get(worst, 0.0), 4)},
        }

    def warning(self, motion: str, accept: Collection[str] = (REJECTED,)) -> str:
        """A sentence with cause, recording and remedy; empty where hardly anything is rejected.

        Args:
            motion: what was rejected: `its own training motion`.
            accept: codes that a person accepted.

        Raises:
            TrainingError: more than TOO_MUCH is rejected, and REJECTED is not accepted.
        """
        if self.share <= WORTH_A_WARNING:
            return ""
        facts = self.facts()
        causes, worst = facts["causes"], facts["worst"]
        named = ", ".join(f"{name} {share:.1%}" for name, share in causes.items()) or "warming up"
        remedy = next((REMEDIES[name] for name in causes if name in REMEDIES), "look at it with `tauext check`")
        words = (
            f"a monitor with this bundle rejects {self.share:.1%} of {motion} ({named}), {worst['share']:.0%} of "
            f"'{worst['recording']}'"
        )
        if self.share > TOO_MUCH and REJECTED not in accept:
            raise TrainingError(f"{words}: {remedy}; --accept {REJECTED} goes on with the rest")
        return f"{words}; what is found follows from the rest alone: {remedy}"
