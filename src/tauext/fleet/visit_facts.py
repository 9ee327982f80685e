"""What the files of one arm at one date say, as plain JSON: bundle, results, findings of the doctor."""

from __future__ import annotations

from typing import Any

import numpy as np

from tauext.files.place import Place
from tauext.files.plain_file import json_of, read_text
from tauext.fleet.bundle_facts import BundleFacts
from tauext.fleet.visits import Visit


def visit_facts(visit: Visit, facts: BundleFacts | None, friction_nm: np.ndarray | None, broken: str) -> dict[str, Any]:
    """All of one visit but what it is compared with.

    Args:
        facts: None: it has no bundle.
        friction_nm: of each joint.
        broken: why its bundle cannot be read; empty where it can.
    """
    said: dict[str, Any] = {
        "name": visit.name,
        "run": visit.run,
        "date": visit.date or None,
        "state": "failed" if broken else visit.state,
        "stage": ("train" if broken else visit.stage) or None,
        "reason": broken or visit.reason or None,
        "findings": findings_of(visit.folder / "check" / "check.json"),
    }
    if visit.results is not None and visit.dataset is not None:
        said["places"] = {"results": str(visit.results), "dataset": str(visit.dataset)}
    if facts is None:
        return said
    said |= {
        "recipe": facts.recipe or None,
        "minutes": rounded(facts.minutes),
        "friction_nm": rounded(friction_nm),
        "ripple_nm": rounded(facts.ripple_nm),
        "limit_nm": rounded(facts.limit_nm),
        "near_stiction_limit_nm": rounded(facts.stiction_limit_nm),
        "promised_per_hour": rounded(facts.false_per_hour),
        "promise": facts.promise or None,
    }
    return said | results_of(visit.results)


def results_of(folder: Place | None) -> dict[str, Any]:
    """Of the free motion that training did not see: its error, and what was false there."""
    content = json_file(folder / "results.json") if folder is not None else None
    bundles = content.get("bundles") if isinstance(content, dict) else None
    free = bundles[0].get("free_motion") if isinstance(bundles, list) and bundles else None
    free = free if isinstance(free, dict) else {}
    return {
        "error_nm": rounded(free.get("l2_nm")),
        "hours": rounded(free.get("hours")),
        "false_collisions": free.get("false_collisions"),
    }


def findings_of(path: Place) -> list[dict[str, Any]]:
    """What the doctor found, without notes."""
    content = json_file(path)
    listed = content.get("findings") if isinstance(content, dict) else None
    kept = ("code", "severity", "joint", "evidence", "advice")
    return [
        {key: one.get(key) for key in kept}
        for one in (listed if isinstance(listed, list) else [])
        if isinstance(one, dict) and one.get("severity") in ("fault", "warning")
    ]


def json_file(path: Place) -> Any:
    """Its content; None: not there, or damaged. A report of a hundred arms does not end for one of them."""
    try:
        return json_of(read_text(path))
    except (OSError, ValueError):
        return None


def rounded(value: Any) -> Any:
    """A number or a list of them with five digits; None for what is no number."""
    if value is None:
        return None
    if isinstance(value, list | tuple | np.ndarray):
        return [rounded(one) for one in value]
    return float(f"{value:.5g}") if np.isfinite(value) else None
