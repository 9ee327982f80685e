"""Collisions latched, and how soon, over how hard they were in N m: one scale for all methods and limits."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext.evaluate.collisions import Collision

EDGES_NM = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 40.0)


def by_strength(touches: Sequence[Collision], verdicts: Sequence[dict]) -> list[dict]:
    """The entry `by_strength` of a bundle in results.json.

    Args:
        touches: their strength is the sensor reference's peak on the joint where that is largest, [N m].
        verdicts: what `judge_latched` said of them, in their order; those in unhealthy time are in no bin.
    """
    unseen = [v["unhealthy"] for v in verdicts]
    # NaN: no sensor, in no bin
    peak_nm = np.where(unseen, np.nan, [touch.sensor_peak_nm.max() or np.nan for touch in touches])
    entries = []
    for low, high in zip(EDGES_NM, (*EDGES_NM[1:], np.inf), strict=True):
        inside = [verdicts[k] for k in np.flatnonzero((peak_nm >= low) & (peak_nm < high)).tolist()]
        delays_s = [v["delay_s"] for v in inside if v["delay_s"] is not None]
        median, late = (float(np.quantile(delays_s, q)) if delays_s else None for q in (0.5, 0.95))
        entries.append(
            {
                "peak_nm_from": low,
                "peak_nm_to": None if np.isinf(high) else high,
                "collisions": len(inside),
                "latched": sum(v["latched"] for v in inside),
                "delay_median_s": median,
                "delay_p95_s": late,
            }
        )
    return entries
