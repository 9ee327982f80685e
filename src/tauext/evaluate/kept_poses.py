"""What force is noticed at the poses that a bundle keeps, with its limits in usual motion: no recording is needed."""

from __future__ import annotations

import json
from collections.abc import Sequence

import numpy as np

from tauext import _core
from tauext.bundle.situations import situations
from tauext.errors import BundleError
from tauext.evaluate.noticed_force import noticed

NO_POSES = (
    "it was trained before bundles kept poses of their motion, or on too little; give recordings of the arm's own "
    "with --data REC.parquet"
)


def noticed_in_usual_motion(bundle: _core.Bundle, frames: Sequence[str] = ()) -> dict:
    """As noticed() says, by level and region: all joints sliding, or all near stiction.

    Raises:
        BundleError: it keeps no poses, or none that can be used.
        BundleError, ConfigError: as points.
    """
    q = kept_poses(bundle)
    return noticed(bundle, q, usual_limits(bundle, len(q)), usual_error_share(bundle), frames)


def kept_poses(bundle: _core.Bundle) -> np.ndarray:
    """Of its provenance, (poses, joints)."""
    try:
        kept = json.loads(bundle.provenance or "{}").get("wrench", {}).get("poses")
        q = np.array(kept or [], dtype=float)
        if kept and (q.ndim != 2 or q.shape[1] != bundle.joints or not np.isfinite(q).all()):
            raise ValueError(f"poses of the shape {q.shape} where (poses, {bundle.joints}) belong")
    except (TypeError, ValueError, AttributeError) as error:
        raise BundleError(f"{bundle.name}: its provenance is damaged ({type(error).__name__}: {error})") from error
    if not kept:
        raise BundleError(f"{bundle.name}: it keeps no poses: {NO_POSES}")
    return q


def usual_limits(bundle: _core.Bundle, poses: int) -> dict[str, np.ndarray]:
    """Limits of the bundle in usual motion, by level and region, (poses, joints) each: all joints in that region."""
    levels = {
        "collision while sliding": bundle.sliding_limit_nm,
        "collision near stiction": bundle.near_stiction_limit_nm,
        "contact while sliding": bundle.contact_sliding_limit_nm,
        "contact near stiction": bundle.contact_near_stiction_limit_nm,
    }
    return {name: np.tile(np.asarray(limit), (poses, 1)) for name, limit in levels.items()}


def usual_error_share(bundle: _core.Bundle) -> float:
    """Standard error over limit, the median over joints and the motions that everybody knows."""
    shares = [
        situation["standard error"][joint] / limit
        for situation in situations(bundle).values()
        for joint, limit in situation["limit"].items()
        if limit > 0
    ]
    return float(np.median(shares)) if shares else 0.0
