"""`tauext show --force`: what force on the arm a bundle notices, at each link's end."""

from __future__ import annotations

import json
import math
import textwrap
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from tauext.errors import ConfigError
from tauext.store import Place

if TYPE_CHECKING:
    from tauext._core import Bundle
    from tauext.calibrate import NoticedAt
    from tauext.calibrate.noticed import Noticed

CLOSING = (
    "A force that stays. The observer answers a step with 1 - exp(-{gain:g}/s t), and alarms are held for {hold:g} ms "
    "(collision) and {contact:g} ms (contact): a blow may be harder than this before it is noticed. ISO/TS 15066 and "
    "your own risk assessment say what force is allowed where; these are the forces that are noticed, not those that a "
    "contact exerts until the arm stands."
)


def describe_force(file: Place, recordings: Sequence[Place], frames: Sequence[str]) -> dict:
    """Table and plain content.

    Raises:
        ConfigError: the bundle tells no forces or knows no poses, or a frame is not there.
    """
    from tauext.bundles.bundle_file import load_bundle
    from tauext.calibrate.noticed import facts_of, noticed_forces

    bundle = load_bundle(file)
    poses, told = poses_of(bundle, file, recordings)
    found = noticed_forces(bundle, poses, frames)
    closing = CLOSING.format(
        gain=bundle.observer.gain_per_s, hold=bundle.hold_s * 1e3, contact=bundle.contact_hold_s * 1e3
    )
    return {
        "table": [*table(found, len(poses), told), "", *textwrap.wrap(closing, 100)],
        "bundle": bundle.name,
        "poses": len(poses),
        "of": told,
        "forces": facts_of(found),
    }


def poses_of(bundle: Bundle, file: Place, recordings: Sequence[Place]) -> tuple[Any, str]:
    """(poses, joints), [rad], and where they are from."""
    from tauext.calibrate import spread_poses
    from tauext.data import load_recording

    if recordings:
        loaded = [load_recording(one) for one in recordings]
        names = tuple(link.joint_name for link in bundle.links)
        for path, one in zip(recordings, loaded, strict=True):
            if one.joints != names:
                raise ConfigError(
                    f"{path}: its joints are {', '.join(one.joints)}; the bundle's are {', '.join(names)}"
                )
        return spread_poses([one.q for one in loaded]), ", ".join(one.name for one in loaded)
    kept = json.loads(bundle.provenance or "{}").get("poses")
    if not kept:
        raise ConfigError(f"{file}: it keeps no poses of its training; give recordings with --poses RECORDING...")
    return kept, "the motion it was trained on"


def table(found: Sequence[NoticedAt], poses: int, told: str) -> list[str]:
    """A line a point and direction; newtons, median of the poses and worst."""
    heads = [f"{one.level}, {one.region}" for one in found[0].forces]
    width = max(len(at.where) for at in found) + 2
    lines = [f"Force that is noticed, N: median of {poses} poses of {told}, in brackets the worst", ""]
    lines.append(" " * (width + 10) + "".join(f"{head:>22}" for head in heads))
    for at in found:
        for row, name in enumerate(("x", "y", "z", "any way", "worst way")):
            cells = "".join(f"{cell(one, name):>22}" for one in at.forces)
            lines.append(f"{at.where if row == 0 else '':<{width}}{name:<10}{cells}")
        blind = max(one.blind_share for one in at.forces)
        if blind:
            lines.append(f"{'':<{width}}blind to some way in {blind:.0%} of the poses")
    return lines


def cell(noticed: Noticed, name: str) -> str:
    if name == "any way":
        return number(noticed.median_n)
    median, worst = noticed.worst_n if name == "worst way" else noticed.by_axis_n[name]
    return f"{number(median)} ({number(worst)})"


def number(newtons: float) -> str:
    return "never" if math.isinf(newtons) else f"{newtons:.3g}"
