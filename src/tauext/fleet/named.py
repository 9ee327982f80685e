"""Which arms and joints are named, in words: what is rather so than not."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tauext.fleet.odds import NAMED

WORDS = {
    ("own", "friction", "more"): ("wearing", "friction × {factor} of {since}"),
    ("own", "friction", "less"): (
        "less friction",
        "friction × {factor} of {since}: new grease, a mended gear, or a loose one",
    ),
    ("own", "constant", "more"): ("constant changed", "a unit of its recorded torque is × {factor} of {since}"),
    ("own", "constant", "less"): ("constant changed", "a unit of its recorded torque is × {factor} of {since}"),
    ("own", "tool", "more"): ("tool changed", "carries {kg} kg more than on {since}"),
    ("own", "tool", "less"): ("tool changed", "carries {kg} kg less than on {since}"),
    ("fleet", "friction", "more"): ("more friction than the fleet", "friction × {factor} of the fleet's"),
    ("fleet", "friction", "less"): ("less friction than the fleet", "friction × {factor} of the fleet's"),
    ("fleet", "constant", "more"): (
        "constant unlike the fleet's",
        "a unit of its recorded torque is × {factor} of the fleet's",
    ),
    ("fleet", "constant", "less"): (
        "constant unlike the fleet's",
        "a unit of its recorded torque is × {factor} of the fleet's",
    ),
    ("fleet", "tool", "more"): ("tool unlike the fleet's", "carries {kg} kg more than the fleet's middle"),
    ("fleet", "tool", "less"): ("tool unlike the fleet's", "carries {kg} kg less than the fleet's middle"),
}


def named_of(serial: str, joints: Sequence[str], visit: Mapping[str, Any], centres: Mapping[str, Any]) -> list[dict]:
    """What is named of one arm at its last date.

    Args:
        visit: with "own" and "fleet".
        centres: of the tables of its group, (joints,) each, by names as "fleet friction".
    """
    found = []
    for against in ("own", "fleet"):
        tables = visit.get(against) or {}
        since = tables.get("since") or "its first date"
        for what in ("friction", "constant", "tool"):
            table = tables.get(what)
            if table is None or "more" not in table:
                continue
            for j, pair in enumerate(zip(table["more"], table["less"], strict=True)):
                for way, probability in zip(("more", "less"), pair, strict=True):
                    if probability is None or probability < NAMED:
                        continue
                    value = table["value"][j] - (centres[f"{against} {what}"][j] if against == "fleet" else 0.0)
                    kind, words = WORDS[against, what, way]
                    factor, kg = f"{np.exp(min(value, 20)):.2f}", f"{abs(value):.2f}"
                    found.append(
                        {
                            "arm": serial,
                            "joint": joints[j] if what != "tool" else None,
                            "kind": kind,
                            "against": against,
                            "what": what,
                            "probability": probability,
                            "value": round(float(value if what == "tool" else np.exp(min(value, 20))), 4),
                            "words": words.format(factor=factor, kg=kg, since=since),
                        }
                    )
    return found
