"""What results.json holds, as the report uses it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from tauext.bundle.units import of_all, short
from tauext.report.methods import Measured, SanityRow
from tauext.report.naming import bundle_label, model_of

Numbers = tuple[float | None, ...]
"""One number a joint; None where it does not exist."""
ROOM, SHOWN = 7, 5
"""Figures with a column a bundle have room for so many; of more, the first few are shown."""


@dataclass(frozen=True)
class Collision:
    """One physical touch; times count from its recording's first sample."""

    id: str
    recording: str
    kind: str
    start_s: float
    end_s: float
    link: int
    sensor_peak_nm: Numbers


@dataclass(frozen=True)
class Verdict:
    """What one bundle made of one collision; None where a time does not exist."""

    found: bool
    joint: str | None
    delay_s: float | None
    sensor_delay_s: float | None
    delay_against_sensor_s: float | None


@dataclass(frozen=True)
class CurveBin:
    """Collisions whose sensor peak lies between two multiples of the limit, and how many were found."""

    low: float
    high: float | None
    collisions: int
    found: int


@dataclass(frozen=True)
class EvaluatedBundle:
    """Everything that was found of one bundle."""

    name: str
    recipe: str | None
    steps: int | None
    epochs: int | None
    batch: int | None
    recordings: tuple[str, ...]
    hours: float | None
    samples: int | None
    false_alarms: int | None
    false_alarms_per_hour: float | None
    l1_nm: Numbers
    l2_nm: Numbers
    mse_nm2: Numbers
    rmse_near_stiction_nm: Numbers
    rmse_sliding_nm: Numbers
    near_stiction_share: Numbers
    observer_peak_nm: Numbers
    limit_sliding_nm: Numbers
    limit_near_stiction_nm: Numbers
    verdicts: dict[str, Verdict]
    ten_found: int | None
    found_curve: tuple[CurveBin, ...]
    loss_history: tuple[tuple[int, float, float], ...]
    """Step, training loss, validation loss; empty where nothing was recorded."""
    measured: Measured
    """Beyond the paper's own measures."""
    limits_move: bool = False
    """Its limits are multiplied by what the motion announces; those named are of usual motion."""
    estimate_units: tuple[str, ...] = ()
    """Of its torques, a joint: not Nm where an arm without a model was recorded in amperes, or by power."""
    rejected_share: float | None = None
    """Of the time, in which its monitor was not healthy; None in results of earlier versions."""
    rejected_causes: tuple[str, ...] = ()
    changed: tuple[tuple[str, str], ...] = ()
    """What was done to it after its training, and in words what came of it."""

    @property
    def model(self) -> str | None:
        """The paper's model that it is of, by its name."""
        return model_of(self.name)

    @property
    def label(self) -> str:
        return bundle_label(self.name, self.recipe)


@dataclass(frozen=True)
class Results:
    """One run of `tauext evaluate`."""

    provenance: dict[str, Any]
    joints: tuple[str, ...]
    near_stiction_rad_s: float
    ten: tuple[str, ...]
    collisions: dict[str, Collision]
    bundles: tuple[EvaluatedBundle, ...]
    """In the paper's order, whatever the order of evaluation; other names follow."""
    sanity: tuple[SanityRow, ...] = ()
    events: tuple[Any, ...] = ()
    """Of type MethodEvents: what labelled events and free time made of each method; empty where nothing is labelled."""
    touches: tuple[Any, ...] = ()
    """Of type BundleTouches: links, newtons and kinds of the collisions; empty where no bundle tells them."""

    @property
    def shown(self) -> tuple[EvaluatedBundle, ...]:
        """Those that stand in figures with a column, a lane or a curve over time for each: all, or the first few.

        Of the paper's models, all of which were trained by two recipes, those of the case's own name.
        """
        if len(self.bundles) <= ROOM:
            return self.bundles
        own = tuple(bundle for bundle in self.bundles if bundle.name == bundle.model)
        return own if len(own) == SHOWN else self.bundles[:SHOWN]

    @property
    def shown_note(self) -> str:
        """A sentence for the caption of such a figure; empty where all are shown."""
        left = len(self.bundles) - len(self.shown)
        first = "the first " if self.shown == self.bundles[: len(self.shown)] else ""
        return f" Only {first}{len(self.shown)} of {len(self.bundles)} bundles are drawn." if left else ""

    @property
    def some_limits_move(self) -> bool:
        return any(bundle.limits_move for bundle in self.bundles)

    @property
    def unit(self) -> str:
        """Of torques, as headings say it: one for all joints and bundles, or that each has its own."""
        return of_all([unit for bundle in self.bundles for unit in bundle.estimate_units])

    def unit_of(self, joint: int) -> str:
        """Of torques of one joint."""
        return of_all([bundle.estimate_units[joint] for bundle in self.bundles if bundle.estimate_units])

    @property
    def units_note(self) -> str:
        """Which bundle answers in what, where that is not Nm throughout; else empty."""
        if self.unit == "Nm":
            return ""
        told = {
            bundle.label: ", ".join(
                f"{name} in {short(unit)}" for name, unit in zip(self.joints, bundle.estimate_units, strict=True)
            )
            for bundle in self.bundles
            if bundle.estimate_units
        }
        if len(set(told.values())) == 1:
            return f"All bundles answer {next(iter(told.values()))}."
        return "".join(f"{label} answers {units}. " for label, units in told.items()).strip()

    @property
    def labels(self) -> dict[str, str]:
        """What the bundles are called, by their names."""
        return {bundle.name: bundle.label for bundle in self.bundles}

    def bundle(self, name: str) -> EvaluatedBundle:
        """The bundle of this name, else the first of that model, else the first that is no plain observer."""
        alike = [bundle for bundle in self.bundles if bundle.name == name] or [
            c for c in self.bundles if c.model == name
        ]
        learned = [bundle for bundle in self.bundles if bundle.recipe != "observer"]
        return (alike or learned or list(self.bundles))[0]
