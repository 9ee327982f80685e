"""Where a load is taken to be fixed."""

from __future__ import annotations

from dataclasses import dataclass

from tauext import _core
from tauext.errors import ConfigError


@dataclass(frozen=True)
class NamedFrame:
    """A load frame, and what people call it."""

    frame: _core.LoadFrame
    name: str


def load_frame(bundle: _core.Bundle, joint: str | None = None) -> NamedFrame:
    """The frame that the bundle's loads are given in, or that of the link that a joint carries: its origin is on the
    joint's axis, z along it.

    Args:
        joint: whose link carries the load; None: the bundle's frame or, if it names none, the link that most joints
            carry.

    Raises:
        ConfigError: there is no such joint.
    """
    joints = [link.joint_name for link in bundle.links]
    known = bundle.load_settings
    if joint is None and known.link >= 0:
        named = known.frame if known.frame.startswith("link of ") else f"frame {known.frame}"
        return NamedFrame(_core.LoadFrame(known.link, known.rotation, known.translation), f"the {named}")
    if joint is None:
        joint = joints[max(range(len(joints)), key=lambda link: (carriers(bundle, link), link))]
    if joint not in joints:
        raise ConfigError(f"frame = {joint!r}: must be the joint whose link carries the load, of {', '.join(joints)}")
    return NamedFrame(_core.LoadFrame(joints.index(joint)), f"the link of {joint}")


def carriers(bundle: _core.Bundle, link: int) -> int:
    """How many joints carry a link."""
    count = 0
    while link >= 0:
        link, count = bundle.links[link].parent, count + 1
    return count
