"""What results.json holds beyond the paper's own measures, as the report uses it."""

from __future__ import annotations

from dataclasses import dataclass, field

from tauext.report.injected import Injected
from tauext.report.noticed import Noticed

Number = float | None


@dataclass(frozen=True)
class Latched:
    """Collisions as a monitor would have latched them."""

    collisions: int
    latched: int
    strong: int
    strong_latched: int
    delay_median_s: Number
    """Against the sensor, as the next."""
    delay_p95_s: Number
    onset_median_s: Number = None
    """From the true onset to the alarm, as the next; None in results of earlier versions."""
    onset_p95_s: Number = None
    unhealthy: int = 0
    """Of the collisions, while the monitor was not healthy."""


@dataclass(frozen=True)
class FalseCollisions:
    """False collisions in test free motion, and what was promised of them; an hour where nothing else is said."""

    count: int | None
    low: Number
    high: Number
    promised: Number
    kept: bool | None
    consistent: bool | None


@dataclass(frozen=True)
class CurvePoint:
    """All limits times `scale`: false collisions an hour, and collisions missed."""

    scale: float
    false_per_hour: Number
    missed: int


@dataclass(frozen=True)
class StrengthBin:
    """Collisions whose sensor reference peaks between two torques; delays from the onset."""

    low_nm: float
    high_nm: Number
    collisions: int
    latched: int
    delay_median_s: Number
    delay_p95_s: Number


@dataclass(frozen=True)
class Aftermath:
    """Alarms that begin, and errors, in a time after a touch; without times, in free motion."""

    from_s: Number
    to_s: Number
    hours: float
    contacts_per_hour: Number
    collisions_per_hour: Number
    rmse_nm: tuple[Number, ...]


@dataclass(frozen=True)
class SigmaBin:
    """Samples of free motion whose standard error lies in one bin: its root mean square, and that of the errors."""

    samples: int
    sigma_rms_nm: float
    error_rms_nm: float


@dataclass(frozen=True)
class SigmaRegion:
    """Of one joint in one region; shares of the errors within one and two standard errors."""

    samples: int
    within_one_sigma: Number
    within_two_sigma: Number
    bins: tuple[SigmaBin, ...]


@dataclass(frozen=True)
class SanityRow:
    """A detector that knows nothing."""

    name: str
    false_per_hour: Number
    time_in_alarm_share: Number
    collisions: int
    found: int
    latched: int
    worth: str


@dataclass(frozen=True)
class Measured:
    """Of one bundle; empty or None where an evaluation did not have it."""

    training_minutes: Number
    model_case: str | None
    false_collisions: FalseCollisions
    latched: Latched | None
    missed_curve: tuple[CurvePoint, ...]
    by_strength: tuple[StrengthBin, ...]
    after_contact: tuple[Aftermath, ...]
    after_nothing: Aftermath | None
    """Free motion, beside the bins."""
    rmse_during_contact_nm: tuple[Number, ...]
    sigma: dict[str, tuple[SigmaRegion, ...]] = field(default_factory=dict)
    """By region, a joint each; empty where the bundle has no error scale."""
    noticed: Noticed | None = None
    """What force on a link it notices."""
    injected: Injected | None = None
    """What it detects of forces that were added to free motion."""
