"""What results.json holds, as the report uses it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

from tauext.bundle.units import of_all, short

# --- The paper's published numbers, to stand beside ours.
#
# Source: D. Lim, D. Kim, J. Park, "Momentum Observer-Based Collision Detection Using LSTM for Model Uncertainty
# Learning", ICRA 2021: Table I, and the text for stiction, limit, collisions and delays. The observer's extremes are of
# the real arm, as its authors published them. Two joints everywhere; None where the paper gives no number.


JOINTS = 2

CASE_LABELS = {"exact": "exact", "mass": "mass", "com": "CoM", "mass+com": "mass + CoM", "none": "no model"}
"""The five estimated models: as the robot is, masses halved, centres of mass halved, both, none at all."""

L1_NM = {
    "exact": (0.402, 0.262),
    "mass": (0.401, 0.256),
    "com": (0.392, 0.253),
    "mass+com": (0.415, 0.258),
    "none": (0.409, 0.259),
}
L2_NM = {
    "exact": (0.661, 0.369),
    "mass": (0.687, 0.365),
    "com": (0.680, 0.355),
    "mass+com": (0.681, 0.368),
    "none": (0.683, 0.376),
}
MSE_NM2 = {
    "exact": (0.435, 0.136),
    "mass": (0.468, 0.132),
    "com": (0.458, 0.126),
    "mass+com": (0.464, 0.134),
    "none": (0.466, 0.141),
}
RMSE_SLIDING_NM = {"exact": (0.418, None)}
RMSE_NEAR_STICTION_NM = {"exact": (1.344, None)}
LIMIT_SLIDING_NM = {"exact": (4.62, None)}
COLLISIONS = FOUND = 10
"""Collisions tried, and found in each of the five cases."""
DELAYS_AGAINST_SENSOR_MS = (3, 6, -1)
"""Three collisions, exact model, observer and sensor at the same limit."""

OBSERVER_PEAK_NM = {
    "exact": (24.0, 14.0),
    "mass": (52.0, 22.0),
    "com": (37.0, 22.0),
    "mass+com": (59.0, 26.0),
    "none": (81.0, 29.0),
}
"""Largest observer output of the real arm in free motion."""


# --- Names of bundles: which of the paper's models one is of, and how it is called in figures and tables.


def model_of(name: str) -> str | None:
    """The paper's model that a bundle is of: `exact` and `exact-anything` are of `exact`; None for other names."""
    model = name.partition("-")[0]
    return model if model in CASE_LABELS else None


def bundle_label(name: str, recipe: str | None = None) -> str:
    """`exact-paper` is "exact, paper recipe" if it was trained so; names that are no model's stay as they are."""
    model = model_of(name)
    if model is None:
        return name
    variant = name.removeprefix(model).removeprefix("-")
    words = [CASE_LABELS[model], f"{variant} recipe" if variant == recipe else variant]
    return ", ".join(word for word in words if word)


def place(name: str) -> tuple[int, bool]:
    """Sorts bundles as the paper does, one with another recipe behind its model's own, other names last."""
    model = model_of(name)
    return (len(CASE_LABELS) if model is None else list(CASE_LABELS).index(model)), name != model


# --- What was detected of forces that an evaluation added to free motion, as results.json has it, and in words.


ASSUMED = (
    "The forces were added to the recorded motor torque of free motion: the position controller is assumed to hold its "
    "path. Hands and compliance reduce a real force, and a controller that gives way shows less of it, and later."
)


@dataclass(frozen=True)
class PeakBin:
    """Events whose peaks lie between two, in the entry's unit."""

    peak_from: float
    peak_to: float
    events: int
    latched: int
    delay_median_s: float | None

    @property
    def middle(self) -> float:
        return (self.peak_from * self.peak_to) ** 0.5


@dataclass(frozen=True)
class InjectedCurve:
    """Of one place and shape."""

    place: str
    shape: str
    events: int
    latched: int
    nine_of_ten: float | None
    """Peak from which on 9 of 10 are detected; None where there is none."""
    delay_median_s: float | None
    """From there on."""
    delay_p95_s: float | None
    bins: tuple[PeakBin, ...]


@dataclass(frozen=True)
class Injected:
    """Of one bundle."""

    unit: str
    events: int
    unhealthy: int
    curves: tuple[InjectedCurve, ...]
    without_forces: str | None = None
    """Why there are torques on single joints instead of forces."""
    left_out: tuple[str, ...] = ()
    blind: tuple[str, ...] = ()
    """Places where usually no joint notices any force."""

    @property
    def place(self) -> str:
        """Where most events were: the end of the arm."""
        return max(self.curves, key=lambda one: (sum(c.events for c in self.at(one.place)), one.place)).place

    def at(self, place: str) -> tuple[InjectedCurve, ...]:
        return tuple(one for one in self.curves if one.place == place)

    def words(self) -> str:
        """`30 N (hit of 20 ms, after 35 ms), ...`: the peaks from which on 9 of 10 are detected, at `place`."""
        return ", ".join(
            f"{number(one.nine_of_ten)} {self.unit} ({one.shape}, after {milliseconds(one.delay_median_s)} ms)"
            if one.nine_of_ten is not None
            else f"no peak that was tried ({one.shape})"
            for one in self.at(self.place)
        )


def number(peak: float | None) -> str:
    return "none" if peak is None else f"{peak:.2g}" if peak < 10 else f"{peak:.0f}"


def milliseconds(delay_s: float | None) -> str:
    return "–" if delay_s is None else f"{1e3 * delay_s:.0f}"


# --- What force on a link a bundle notices, as results.json has it.


Limit = TypeVar("Limit")

ONE_SIDED_95 = 1.645
"""Standard errors that 95 % of errors are below."""
WAYS = {"x": "x", "y": "y", "z": "z", "worst_way": "worst way"}
"""Directions by their keys, in words."""


@dataclass(frozen=True)
class OverPoses:
    """Force in one direction, [N]; None: blind."""

    median_n: float | None
    worst_n: float | None
    blind_share: float


@dataclass(frozen=True)
class NoticedAt:
    """Forces at one point of the arm."""

    place: str
    every_median_n: float | None
    """Over poses and directions, as the next."""
    nine_of_ten_n: float | None
    ways: Mapping[str, OverPoses]
    """By the names of WAYS."""


@dataclass(frozen=True)
class Noticed:
    """Of one bundle; `refused` says why there is nothing."""

    poses: int = 0
    limits: Mapping[str, tuple[NoticedAt, ...]] | None = None
    gain_per_s: float | None = None
    error_share: float | None = None
    """Standard error of the estimate as a share of the limit, in the median."""
    left_out: tuple[str, ...] = ()
    """Joints that do not answer in N m: what they notice is not in the numbers."""
    refused: str | None = None


def joined(limits: Mapping[str, Limit]) -> dict[str, Limit]:
    """The same, with limits that notice the same under one name: `collision and contact while sliding`."""
    found: dict[str, Limit] = {}
    for name, entries in limits.items():
        same = next((other for other, those in found.items() if those == entries), None)
        if same is None:
            found[name] = entries
            continue
        (level, _, motion), after = same.partition(" "), name.partition(" ")[2]
        both = f"{level if motion == after else same} and {name}"
        found = {both if other == same else other: those for other, those in found.items()}
    return found


def left_out_words(joints: Sequence[str]) -> str:
    """A sentence about joints that do not answer in N m; empty without any."""
    if not joints:
        return ""
    return f"Without {', '.join(joints)}: their torque constants are not known, so what they notice is not counted."


def surely(error_share: float) -> float:
    """Times the force that goes over a limit: from there on 19 of 20 do, whatever way the estimate errs."""
    return 1 + ONE_SIDED_95 * error_share


# --- What results.json holds beyond the paper's own measures, as the report uses it.


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
    """From the true onset to the alarm, as the next; None where no collision was latched."""
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


# --- The results of one report.


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
    estimate_units: tuple[str, ...]
    """Of its torques, a joint: not Nm where an arm without a model was recorded in amperes, or by power."""
    limits_move: bool = False
    """Its limits are multiplied by what the motion announces; those named are of usual motion."""
    rejected_share: float | None = None
    """Of the time, in which its monitor was not healthy."""
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
        return of_all([bundle.estimate_units[joint] for bundle in self.bundles])

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
