"""Play of joints, as a finding."""

from __future__ import annotations

import math
from collections.abc import Sequence

from tauext.check.finding import Finding
from tauext.data.backlash import Play

DEGREES = 180 / math.pi


def play_findings(joints: Sequence[str], plays: Sequence[Play]) -> list[Finding]:
    """Findings of joints whose play is seen."""
    return [
        Finding(
            "backlash",
            "note",
            joint,
            f"{play.width_rad:.2g} ± {play.error_rad:.1g} rad ({play.width_rad * DEGREES:.2g} ± "
            f"{play.error_rad * DEGREES:.1g} degrees): after {play.turns} turns the position travels so far, in the "
            f"mean, before the drive bears the {play.share:.0%} of its friction that lie behind the play",
            "the gear carries nothing while it crosses its play, nor is a touch felt there; where the encoder sits "
            "behind it there is more than is seen",
        )
        for joint, play in zip(joints, plays, strict=True)
        if play.width_rad > 0
    ]
