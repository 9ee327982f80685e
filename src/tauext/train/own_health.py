"""How much of its own training motion a bundle's monitor rejects, and why."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from tauext import _core
from tauext.data import Recording
from tauext.data.estimates import OK
from tauext.train.preparation import Job

WORTH_A_WARNING = 0.02
"""Of the samples behind the warm-up; beyond it the limits follow from less motion than was recorded."""
REMEDIES = {
    "wrong rate": "import the recordings again, or state their mean rate (arm.toml, [time] rate_hz)",
    "torque saturated": "check the robot file's torque limits and the unit of tau",
    "encoder still": "check which column each joint's position comes from",
    "gap": "record without losing samples",
}
"""By cause; of any other one `tauext check` reports more."""


def note_rejected(job: Job, bundle: _core.Bundle) -> None:
    """Note it where a monitor rejects more than WORTH_A_WARNING of what the bundle was trained on."""
    facts = rejected_facts(bundle, job.possible.training, job.threads)
    if facts["share"] > WORTH_A_WARNING:
        job.facts["rejected"] = facts
        job.notes.append(rejected_sentence(facts))


def rejected_facts(bundle: _core.Bundle, recordings: Sequence[Recording], threads: int) -> dict[str, Any]:
    """Share of the samples that a monitor rejects, share of each cause, and the worst recording with its share.

    Counted are the samples behind the first healthy one of each recording; a recording without any counts whole. The
    warm-up after a fault is rejected, too, and counts for the fault.
    """
    causes: Counter[str] = Counter()
    shares: dict[str, float] = {}
    bad = counted = 0
    for recording in recordings:
        answers = _core.estimate(bundle, recording.t_ns, recording.q, recording.dq, recording.tau, threads)
        healthy = answers["health"] == OK
        first = int(healthy.argmax())  # 0 where none is
        left_out, bits = ~healthy[first:], answers["causes"][first:]
        if left_out.any() and not healthy.any():
            left_out = bits != 0  # all but the warm-up, which has no cause
        for cause, samples in zip(*np.unique(bits[left_out], return_counts=True), strict=True):
            causes.update({name: int(samples) for name in _core.cause_names(int(cause))})
        shares[recording.name] = float(left_out.mean())
        bad, counted = bad + int(left_out.sum()), counted + len(left_out)
    worst = max(shares, key=shares.__getitem__)
    return {
        "share": round(bad / counted, 4),
        "causes": {name: round(samples / counted, 4) for name, samples in causes.most_common()},
        "worst": {"recording": worst, "share": round(shares[worst], 4)},
    }


def rejected_sentence(facts: dict[str, Any]) -> str:
    """A warning with cause, recording and remedy."""
    causes, worst = facts["causes"], facts["worst"]
    named = ", ".join(f"{name} {share:.1%}" for name, share in causes.items()) or "warming up"
    remedy = next((REMEDIES[name] for name in causes if name in REMEDIES), "look at it with `tauext check`")
    return (
        f"a monitor with this bundle rejects {facts['share']:.1%} of its own training motion ({named}), "
        f"{worst['share']:.0%} of '{worst['recording']}'; limits follow from the rest alone: {remedy}"
    )
