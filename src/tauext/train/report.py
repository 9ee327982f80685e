"""What a refit found, joint by joint: for people, for JSON and for provenance."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

from tauext import _core


@dataclass(frozen=True)
class JointReport:
    """One joint. A factor is of today's friction by the old one, beside its standard error."""

    joint: str
    coulomb: tuple[float, float]
    """Of all that follows the motion's sign: Coulomb, presliding, load."""
    viscous: tuple[float, float]
    constant: tuple[float, float]
    """By how much the constant moved, in the unit of the answers."""
    unit: str
    moved_s: float
    error_ratio: float | None
    """Of today's left-out error by the standard error that the motion announced; None: nobody knew one."""
    error_ratio_upper: float | None
    limit_factor: float
    sigma_factor: float
    promise: str
    follows: bool = False
    """It hardly moved, and its friction is what the other joints let a fleet expect."""

    @classmethod
    def of(
        cls, bundle: _core.Bundle, joint: int, found: _core.RefitJoint, promise: str, follows: bool = False
    ) -> JointReport:
        """Of one joint of a refit."""
        return cls(
            joint=bundle.links[joint].joint_name,
            coulomb=found.coulomb,
            viscous=found.viscous,
            constant=(found.constant_nm, found.constant_error_nm),
            unit=bundle.estimate_units[joint],
            moved_s=found.moved_s,
            error_ratio=number(found.error_ratio),
            error_ratio_upper=number(found.error_ratio_upper),
            limit_factor=found.limit_factor,
            sigma_factor=found.sigma_factor,
            promise=promise,
            follows=follows,
        )


@dataclass(frozen=True)
class Touch:
    """A moment that no friction explains."""

    recording: str
    joint: str
    from_s: float
    """After the recording's first sample."""
    to_s: float
    limit_share: float
    """Largest error by the old collision limit."""
    counted: bool
    """Too many for touches: they are the joint's error, and its limits were raised by them."""

    def sentence(self) -> str:
        """In words, for a person who is to look there."""
        what = "raised its limits" if self.counted else "was left out as a touch"
        return (
            f"{self.joint}: {self.from_s:.1f} to {self.to_s:.1f} s of '{self.recording}' is {self.limit_share:.1f} "
            f"times its limit, which no friction explains, and {what}"
        )


@dataclass(frozen=True)
class Refitted:
    """A bundle brought up to date, and what changed."""

    bundle: _core.Bundle
    joints: list[JointReport]
    touches: list[Touch]
    used_s: float
    memory_s: float
    """How long errors stay what they are: samples nearer to each other say the same."""
    promise: str
    """Whether the old one may be believed, in words."""

    def facts(self) -> dict:
        """All of it for JSON."""
        return {
            "used_s": round(self.used_s, 3),
            "memory_s": round(self.memory_s, 3),
            "joints": [asdict(joint) for joint in self.joints],
            "left_out": [asdict(touch) for touch in self.touches],
            "promise": self.promise,
        }

    def table(self) -> str:
        """For people, a row a joint."""
        head = ["joint", "friction", "viscous", "constant", "limits", "promise"]
        rows = [head] + [
            [
                one.joint,
                f"x {one.coulomb[0]:.3f} ± {one.coulomb[1]:.3f}",
                f"x {one.viscous[0]:.3f} ± {one.viscous[1]:.3f}",
                f"{one.constant[0]:+.3g} ± {one.constant[1]:.1g} {one.unit}",
                f"x {one.limit_factor:.2f}",
                one.promise + "; its friction follows the other joints'" * one.follows,
            ]
            for one in self.joints
        ]
        widths = [max(len(row[k]) for row in rows) for k in range(len(head))]
        return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)


def number(value: float) -> float | None:
    """JSON has no NaN."""
    return value if math.isfinite(value) else None
