"""What arms of one type have in common: terms, mean and covariance of the prior's weights, and errors of new arms."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np

from tauext import _core
from tauext.errors import ConfigError
from tauext.fit.map_regression import WeightPrior
from tauext.robot.inertial import PARAMETERS


@dataclass(frozen=True)
class ArmType:
    """What arms must agree in to be of one type; the names of its fields are those of its words."""

    joints: tuple[str, ...]
    case: str
    rate_hz: float
    network_stride: int
    torque_timing: str
    units: tuple[str, ...]
    """Of each joint's torque as the prior sees it."""
    links: str
    """SHA-256 of axes and lengths; masses may differ, by a payload that the description names."""

    def expect(self, other: ArmType, what: str, other_what: str) -> None:
        """Raise ConfigError naming the first thing in which the other differs."""
        for one in fields(self):
            mine, theirs = getattr(self, one.name), getattr(other, one.name)
            if mine != theirs:
                name = one.name.replace("_", " ")
                raise ConfigError(
                    f"{other_what}: {name} = {worded(theirs)} must be {worded(mine)} as of {what}: a fleet prior is "
                    "for arms of one type"
                )


def worded(value: object) -> str:
    """For a message: digests by their first letters."""
    if isinstance(value, tuple):
        return "(" + ", ".join(map(str, value)) + ")"
    return str(value)[:12]


def links_digest(tree: _core.Tree) -> str:
    """SHA-256 of where the joints are and how they turn."""
    numbers = [
        [link.parent, link.type.name, *(round(x, 6) + 0.0 for x in (*link.rotation, *link.translation))]
        for link in tree.links
    ]
    return hashlib.sha256(json.dumps(numbers).encode()).hexdigest()


@dataclass(frozen=True)
class FleetErrors:
    """Errors of arms that had a minute of their own and the prior of the others, on the rest of their motion."""

    minutes: float
    """Of its own that each arm had."""
    hours: float
    """Of motion that was judged."""
    arms: int
    features: tuple[str, ...]
    limit_weights: np.ndarray  # (n, features), of an arm whose errors are as large as the fleet's
    sigma_weights: np.ndarray  # (n, features), sliding
    sigma_near_weights: np.ndarray
    largest: np.ndarray  # (n,)
    largest_sigma: np.ndarray
    sliding_limit_nm: np.ndarray  # (n,)
    near_stiction_limit_nm: np.ndarray
    contact_sliding_limit_nm: np.ndarray
    contact_near_stiction_limit_nm: np.ndarray
    hold_s: float
    contact_hold_s: float
    facts: Mapping[str, Any]
    """What the limits promise, as a training's provenance has it."""


@dataclass(frozen=True)
class FleetDays:
    """How friction of one arm differs from one recording to the next."""

    covariance: np.ndarray  # (n, n), of the logarithms of each joint's factor
    arms: int
    """With two recordings or more."""
    recordings: int
    """Of these arms."""


@dataclass(frozen=True)
class FleetPrior:
    """A fleet prior, as its file holds it."""

    type: ArmType
    gain_per_s: float
    widths_rad: tuple[float, ...]
    own: tuple[tuple[_core.Term, ...], ...]
    """Terms of each joint."""
    weights: WeightPrior
    errors: FleetErrors | None = None
    """None: no arm's motion is long enough to judge a minute by the rest."""
    coverage: _core.CoverageSettings | None = None
    """Motion that any of the arms showed."""
    days: FleetDays | None = None
    """None: too few arms had several recordings."""
    facts: Mapping[str, Any] = field(default_factory=dict)
    """Provenance, arms and spreads."""
    sha256: str = ""
    """Of its file."""

    @property
    def blocks(self) -> list[np.ndarray]:
        """Columns of each joint's own terms, then those of all links' corrections."""
        return block_columns(self.own)


def block_columns(own: Sequence[Sequence[_core.Term]]) -> list[np.ndarray]:
    """Columns of each joint's own terms, then those of all links' corrections."""
    ends = np.cumsum([len(group) for group in own])
    joints = [np.arange(end - len(group), end) for end, group in zip(ends, own, strict=True)]
    return [*joints, np.arange(ends[-1], ends[-1] + len(PARAMETERS) * len(own))]
