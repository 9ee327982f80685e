"""The fleet in a table that a person reads: each arm's friction by the fleet's, and which arm is the odd one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext.fit.fleet_prior import block_columns
from tauext.fit.hierarchy import Hierarchy

SPEED_RAD_S = 0.5
"""Friction is compared at this speed."""
ODD = 0.5
"""An arm's joint is the odd one whose trust is below this."""
Kind = _core.TermKind


def friction_columns(terms: Sequence[Sequence[_core.Term]], joint: int) -> np.ndarray:
    """What each of all columns adds to the joint's friction at SPEED_RAD_S, (columns,)."""
    blocks = block_columns(terms)
    value = {
        Kind.coulomb: lambda term: float(np.tanh(SPEED_RAD_S / term.speed)),
        Kind.presliding: lambda term: 1.0,
        Kind.viscous: lambda term: SPEED_RAD_S,
    }
    out = np.zeros(int(blocks[-1][-1]) + 1)
    out[blocks[joint]] = [value[t.kind](t) if t.kind in value else 0.0 for t in terms[joint]]
    return out


def arms_facts(
    names: Sequence[str], minutes: Sequence[float], joints: Sequence[str], terms: Sequence, found: Hierarchy
) -> list[dict]:
    """Of each arm: minutes, and of each joint its friction by the fleet's with its error, and how it is trusted."""
    lines = [friction_columns(terms, j) for j in range(len(joints))]
    mean = [float(line @ found.mean) for line in lines]
    facts = []
    for a, name in enumerate(names):
        factor = [share(float(line @ found.weights[a]), of) for line, of in zip(lines, mean, strict=True)]
        error = [share(float(np.sqrt(line @ found.errors[a] @ line)), of) for line, of in zip(lines, mean, strict=True)]
        friction = [[f, None if e is None else abs(e)] for f, e in zip(factor, error, strict=True)]
        trust = [round(float(u), 3) for u in found.trust[a]]
        facts.append(
            {
                "name": name,
                "minutes": round(minutes[a], 3),
                "friction": dict(zip(joints, friction, strict=True)),
                "trust": dict(zip((*joints, "links"), trust, strict=True)),
            }
        )
    return facts


def spread_facts(joints: Sequence[str], terms: Sequence, found: Hierarchy) -> dict:
    """Of each joint: the fleet's friction at SPEED_RAD_S, [N m], and by what share arms differ."""
    out = {}
    for j, name in enumerate(joints):
        line = friction_columns(terms, j)
        mean = float(line @ found.mean)
        spread = share(float(np.sqrt(line @ found.covariance @ line)), abs(mean))
        out[name] = {"friction_nm": round(abs(mean), 4), "spread": spread}
    return out


def share(value: float, whole: float) -> float | None:
    """None: of a joint that no arm moved, the fleet has no friction to compare with."""
    return round(value / whole, 4) if whole else None


def table(facts: dict) -> str:
    """Arms by joints: friction by the fleet's; * marks a joint that is not like the others'."""
    joints = list(facts["spread"])
    head = ["arm", "minutes", *joints, "links"]
    rows = [head]
    for one in facts["arms"]:
        cells = [
            "–" if factor is None else f"{factor:.2f} ± {error:.2f}{' *' * (one['trust'][joint] < ODD)}"
            for joint, (factor, error) in one["friction"].items()
        ]
        rows.append([one["name"], f"{one['minutes']:.1f}", *cells, "*" * (one["trust"]["links"] < ODD)])
    rows.append(["fleet, Nm", "", *(f"{of['friction_nm']:.3g}" for of in facts["spread"].values()), ""])
    spreads = [of["spread"] for of in facts["spread"].values()]
    rows.append(["arms differ by", "", *("–" if spread is None else f"{spread:.0%}" for spread in spreads), ""])
    widths = [max(len(row[k]) for row in rows) for k in range(len(head))]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)
