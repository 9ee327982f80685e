"""results.json: dataclasses whose fields are its keys, reader and writer; contract: docs/reference/files-results.md."""

from __future__ import annotations

import json
from dataclasses import MISSING, dataclass, field, fields, is_dataclass, replace
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, get_args, get_origin, get_type_hints

from tauext.bundle.units import of_all, short
from tauext.check.before_training import RejectedTime
from tauext.errors import ConfigError
from tauext.files.plain_file import expect_format, json_of, read_text

Number = float | None
"""None (null in JSON) if a number does not exist."""
A_JOINT = "a joint"
Numbers = Annotated[tuple[Number, ...], A_JOINT]
"""One number per joint."""

# --- JSON to dataclasses and back: a key is a field, an object a dataclass or dict, a list a tuple.


def to_json(value: Any) -> Any:
    """Plain JSON of a dataclass; fields that have their default are left out."""
    if is_dataclass(value):
        items = ((one, getattr(value, one.name)) for one in fields(value))
        return {one.name: to_json(found) for one, found in items if found != default_of(one)}
    if isinstance(value, dict):
        return {key: to_json(found) for key, found in value.items()}
    return [to_json(one) for one in value] if isinstance(value, list | tuple) else value


def default_of(one: Any) -> Any:
    return one.default if one.default_factory is MISSING else one.default_factory()


hints_of = cache(lambda kind: get_type_hints(kind, include_extras=True))
origin_of, arguments_of = cache(get_origin), cache(get_args)


@dataclass(frozen=True)
class JsonReader:
    """Reads the JSON of an evaluation with this number of joints."""

    joints: int

    def object(self, kind: Any, content: Any, place: str) -> Any:
        """A dataclass of this kind; unknown keys are ignored.

        Raises:
            ConfigError: a value is of another kind than its field, with its place and key.
        """
        if not isinstance(content, dict):
            raise ConfigError(f"{place}: is {shown(content)}, must be an object")
        found = {}
        for one in fields(kind):
            value = content.get(one.name)
            if value is None and default_of(one) is not MISSING:
                continue
            found[one.name] = self.value(hints_of(kind)[one.name], value, place, one.name)
        try:
            return kind(**found)
        except ValueError as error:
            raise ConfigError(f"{place}: {error}") from error

    def value(self, kind: Any, value: Any, place: str, key: str) -> Any:
        """A value of this type; None or an empty list or object if it is null or absent and the type allows that."""
        if origin_of(kind) is Annotated:
            return self._numbers(value, place, key)
        if isinstance(kind, UnionType):  # of something and None
            return None if value is None else self.value(arguments_of(kind)[0], value, place, key)
        if is_dataclass(kind):
            return self.object(kind, {} if value is None else value, f"{place}, {key}")
        if origin_of(kind) is tuple:
            items = self._expect(list, [] if value is None else value, place, key)
            return self._list(arguments_of(kind), items, place, key)
        if origin_of(kind) is dict:
            content = self._expect(dict, {} if value is None else value, place, key)
            return {
                name: self.value(arguments_of(kind)[1], one, f"{place}, {key}", name) for name, one in content.items()
            }
        return value if kind is Any else self._expect(kind, value, place, key)

    def _list(self, kinds: tuple[Any, ...], items: list[Any], place: str, key: str) -> tuple[Any, ...]:
        if kinds[-1] is ...:
            kinds = kinds[:1] * len(items)
        if len(kinds) != len(items):
            raise ConfigError(f"{place}: '{key}' is {shown(items)}, must be a list of {len(kinds)}")
        if kinds and is_dataclass(kinds[0]):
            return tuple(self.object(kinds[0], one, f"{place}, {key}[{k}]") for k, one in enumerate(items))
        pairs = enumerate(zip(kinds, items, strict=True))
        return tuple(self.value(kind, one, place, f"{key}[{k}]") for k, (kind, one) in pairs)

    def _numbers(self, items: Any, place: str, key: str) -> tuple[Number, ...]:
        if items is None:
            return (None,) * self.joints
        known = isinstance(items, list) and all(type(item) in (int, float, NoneType) for item in items)
        if not known or len(items) != self.joints:
            raise ConfigError(f"{place}: '{key}' must be a list of {self.joints} numbers or null, one a joint")
        return tuple(items)

    @staticmethod
    def _expect(kind: type, value: Any, place: str, key: str) -> Any:
        kinds = (int, float) if kind is float else (kind,)
        if not isinstance(value, kinds) or (isinstance(value, bool) and kind is not bool):
            names = " or ".join(one.__name__ for one in kinds)
            raise ConfigError(f"{place}: '{key}' is {shown(value)}, must be {names}")
        return value


def shown(value: Any) -> str:
    return json.dumps(value)[:60]


# --- Names of bundles: the paper's model of each, and its label in figures and tables.


CASE_LABELS = {"exact": "exact", "mass": "mass", "com": "CoM", "mass+com": "mass + CoM", "none": "no model"}
"""The paper's five estimated models: as the robot is, masses halved, centres of mass halved, both, none at all."""


def model_of(name: str) -> str | None:
    """The paper's model of a bundle: `exact` for `exact` and `exact-anything`; None for other names."""
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


# --- Collisions, and those that one bundle found.


@dataclass(frozen=True)
class LabelledCollision:
    """One physical touch; times count from its recording's first sample."""

    id: str
    recording: str
    kind: str
    start_s: float
    end_s: float
    link: int
    true_peak_nm: Numbers
    sensor_peak_nm: Numbers


@dataclass(frozen=True)
class CollisionVerdict:
    """Whether one bundle found one collision; None if a time does not exist."""

    id: str
    found: bool
    joint: str | None
    delay_s: Number
    peak_over_limit: Number
    sensor_delay_s: Number
    delay_against_sensor_s: Number
    joint_delays_against_sensor_s: Numbers
    """Delay of each joint alone: of its own estimate against its own sensor."""


@dataclass(frozen=True)
class FoundBin:
    """Collisions whose sensor peak lies between two multiples of the threshold, and how many were found."""

    peak_over_limit_from: float
    peak_over_limit_to: Number
    collisions: int
    found: int

    @property
    def edges(self) -> tuple[float, Number]:
        return self.peak_over_limit_from, self.peak_over_limit_to


@dataclass(frozen=True)
class Latched:
    """Collisions as a monitor would have latched them; delays from the true onset, and against the sensor."""

    collisions: int
    latched: int
    strong: int
    unhealthy: int | None
    """Collisions while the monitor was not healthy."""
    strong_latched: int
    delay_median_s: Number
    delay_p95_s: Number
    delay_against_sensor_median_s: Number
    delay_against_sensor_p95_s: Number


@dataclass(frozen=True)
class StrengthBin:
    """Collisions whose sensor reference peaks between two torques; delays from the onset."""

    peak_nm_from: float
    peak_nm_to: Number
    collisions: int
    latched: int
    delay_median_s: Number
    delay_p95_s: Number

    @property
    def edges(self) -> tuple[float, Number]:
        return self.peak_nm_from, self.peak_nm_to


@dataclass(frozen=True)
class CurvePoint:
    """All thresholds times `scale`: false collisions an hour, and collisions missed."""

    scale: float
    false_per_hour: Number
    missed: int


# --- Free motion, and errors during and after contacts.


@dataclass(frozen=True)
class FreeMotion:
    """Errors and false alarms in the test recordings."""

    recordings: tuple[str, ...]
    hours: Number
    samples: int | None
    l1_nm: Numbers
    l2_nm: Numbers
    mse_nm2: Numbers
    rmse_near_stiction_nm: Numbers
    rmse_sliding_nm: Numbers
    near_stiction_share: Numbers
    observer_peak_nm: Numbers
    false_alarms: int | None
    """Single samples over a threshold."""
    false_alarms_per_hour: Number
    false_collisions: int | None
    promised_per_hour: Number
    """Target false alarm rate; None: none."""
    false_collisions_interval_per_hour: tuple[Number, Number] | None
    """The 95 % interval."""
    promise_consistent: bool | None
    promise_kept: bool | None
    at_most_per_hour: Number = None
    """Upper end of the interval that extrapolated thresholds state; else promised_per_hour."""


@dataclass(frozen=True)
class Limits:
    sliding_nm: Numbers
    near_stiction_nm: Numbers
    moving: bool | None
    """Thresholds follow the motion; these are those of usual motion."""


@dataclass(frozen=True, kw_only=True)
class Aftermath:
    """Alarms that begin, and errors, in a time after a touch; without times, in free motion."""

    from_s: Number = None
    to_s: Number = None
    hours: float
    contacts: int | None
    contacts_per_hour: Number
    collisions: int | None
    collisions_per_hour: Number
    rmse_nm: Numbers


@dataclass(frozen=True)
class AfterContacts:
    bins: tuple[Aftermath, ...]
    free_motion: Aftermath


@dataclass(frozen=True)
class SigmaBin:
    """Samples of free motion whose standard error lies in one bin: its root mean square, and that of the errors."""

    sigma_nm_from: Number
    sigma_nm_to: Number
    samples: int
    within_one_sigma: Number
    within_two_sigma: Number
    sigma_rms_nm: float
    error_rms_nm: float


@dataclass(frozen=True)
class SigmaRegion:
    """One joint in one region: shares of the errors within one and two standard errors."""

    samples: int
    within_one_sigma: Number
    within_two_sigma: Number
    bins: tuple[SigmaBin, ...]


# --- Forces: the smallest that a bundle notices, and those that were added to free motion.


@dataclass(frozen=True)
class EveryWay:
    """Over poses and directions, [N]; None: unobservable."""

    median_n: Number
    nine_of_ten_n: Number


@dataclass(frozen=True)
class OverPoses:
    """Force in one direction, [N]; None: unobservable."""

    median_n: Number
    worst_n: Number
    blind_share: float


@dataclass(frozen=True)
class NoticedAt:
    """Forces at one point of the arm."""

    place: str
    frame: str | None
    point_m: tuple[float, ...]
    every_way: EveryWay
    x: OverPoses
    y: OverPoses
    z: OverPoses
    worst_way: OverPoses


@dataclass(frozen=True)
class NoticedForce:
    """Smallest forces that exceed a threshold; `refused` is the reason if there are none."""

    refused: str | None = None
    poses: int = 0
    limits: dict[str, tuple[NoticedAt, ...]] = field(default_factory=dict)
    error_share: Number = None
    """Standard error of such a force's estimate as a share of it, in the median, torque constants included."""
    left_out: tuple[str, ...] = ()
    """Joints without answers in N m; the numbers leave them out."""
    gain_per_s: Number = None
    hold_s: dict[str, float] = field(default_factory=dict)
    twice_after_s: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class PeakBin:
    """Events whose peaks lie between two, in the entry's unit."""

    peak_from: float
    peak_to: float
    events: int
    latched: int
    delay_median_s: Number

    @property
    def middle(self) -> float:
        return (self.peak_from * self.peak_to) ** 0.5


@dataclass(frozen=True)
class InjectedCurve:
    """Results of one place and shape."""

    place: str
    shape: str
    events: int
    latched: int
    nine_of_ten: Number
    """Peak above which 9 of 10 are detected; None if there is none."""
    delay_median_s: Number
    """Delay of detected events above that peak."""
    delay_p95_s: Number
    bins: tuple[PeakBin, ...]


@dataclass(frozen=True)
class Pressed:
    """The same forces on links while the tool presses, which is declared."""

    least_n: float
    most_n: float
    """Range of the tool's force, one for each recording, [N]."""
    hours: float
    """Hours of pressing without other forces."""
    false_collisions: int
    """In that time; those less than 0.5 s apart count as one."""
    events: int
    latched: int
    latched_free: int
    """Number of the same events that are detected in free motion."""
    delay_median_s: Number
    delay_free_median_s: Number


@dataclass(frozen=True, kw_only=True)
class Injected:
    """Forces added to free motion, and which of them one bundle detects."""

    unit: str
    events: int
    unhealthy: int
    without_forces: str | None = None
    """Reason for torques on single joints instead of forces."""
    left_out: tuple[str, ...] = ()
    blind: tuple[str, ...]
    """Places where no joint usually notices a force."""
    curves: tuple[InjectedCurve, ...]
    pressed: Pressed | None = None
    """None: the bundle can have no declared contact at its tool."""

    @property
    def place(self) -> str:
        """Place with most events: the end of the arm."""
        return max(self.curves, key=lambda one: (sum(c.events for c in self.at(one.place)), one.place)).place

    def at(self, place: str) -> tuple[InjectedCurve, ...]:
        return tuple(one for one in self.curves if one.place == place)


@dataclass(frozen=True)
class DetectedForces:
    """What push a bundle detects: one that lasts, by its thresholds, and pushes added to free motion."""

    lasting: NoticedForce | None
    added: Injected | None = None
    """None: none were added."""


# --- Labelled events: found, how late, false alarms an hour of free time, moving and resting apart.


@dataclass(frozen=True)
class EventCounts:
    """One method in one state of the arm; delays from the label's start and from the re-timed onset."""

    events: int
    found: int
    delay_median_s: Number
    delay_p95_s: Number
    delay_from_onset_median_s: Number
    delay_from_onset_p95_s: Number
    free_hours: float
    false_alarms: int
    false_alarms_per_hour: Number


@dataclass(frozen=True)
class EventVerdict:
    """Whether one labelled event was found."""

    id: str
    recording: str
    start_s: float
    end_s: float
    onset_s: Number
    moving: bool
    found: bool
    joint: str | None
    delay_s: Number
    delay_from_onset_s: Number


@dataclass(frozen=True)
class FalseAlarm:
    recording: str
    start_s: float
    moving: bool
    since_contact_s: Number


@dataclass(frozen=True)
class Events:
    """Labelled events that one method found."""

    shortest_event_s: float
    tolerance_s: float
    left_out: int
    all: EventCounts
    resting: EventCounts
    moving: EventCounts
    verdicts: tuple[EventVerdict, ...]
    false_alarms_at: tuple[FalseAlarm, ...]


@dataclass(frozen=True)
class OwnTorqueEvents:
    """The robot's own tau_ext as one more method."""

    limit_nm: Numbers
    events: Events


@dataclass(frozen=True)
class OtherEvents:
    """A method of others that makes no bundle, with thresholds at its largest values in training."""

    name: str
    events: Events


# --- Links and kinds of collisions beside the labels.


@dataclass(frozen=True)
class LinkTable:
    """Labelled link by the link that was reported as the most probable."""

    joints: tuple[str, ...]
    table: tuple[tuple[int, ...], ...]
    collisions: int
    first: int
    first_two: int
    stated: int
    stated_right: int

    def __post_init__(self) -> None:
        size = len(self.joints)
        if len(self.table) != size or any(len(row) != size for row in self.table):
            raise ValueError(f"'table' must be {size} lists of {size} counts, one a link")


@dataclass(frozen=True)
class LinkProbability:
    joint: str
    probability: float


@dataclass(frozen=True)
class TouchEstimate:
    """Estimate of one collision; without links if no place was found."""

    id: str
    kind: str | None
    links: tuple[LinkProbability, ...] = ()
    """The most probable first."""
    force_n: Number = None
    point_m: tuple[float, ...] = ()
    spread_m: Number = None
    consistent: float | None = None


@dataclass(frozen=True)
class Touches:
    """Links, kinds and forces that one bundle reported of labelled touches."""

    stated_from: float
    links: LinkTable | None
    kinds: dict[str, dict[str, int]]
    """Number of each kind, by the recordings' name for their contacts."""
    reported: tuple[TouchEstimate, ...]


# --- The results of one evaluation.


@dataclass(frozen=True)
class SanityRow:
    """A detector without information."""

    name: str
    false_per_hour: Number
    time_in_alarm_share: Number
    collisions: int
    found: int
    latched: int
    worth: str | None


@dataclass(frozen=True)
class EvaluatedBundle:
    """All results of one bundle."""

    name: str
    bundle: str | None
    estimate_units: tuple[str, ...]
    """Unit of each joint's torque; not N m if an arm without a model was recorded in amperes or by power."""
    recipe: str | None
    case: str | None
    training_minutes: Number
    steps: int | None
    epochs: int | None
    batch: int | None
    free_motion: FreeMotion
    limits: Limits
    collisions: tuple[CollisionVerdict, ...]
    ten_found: int | None
    found_curve: tuple[FoundBin, ...]
    rejected: RejectedTime
    latched: Latched | None
    by_strength: tuple[StrengthBin, ...]
    missed_curve: tuple[CurvePoint, ...]
    after_contact: AfterContacts | None
    rmse_during_contact_nm: Numbers
    error_against_sigma: dict[str, tuple[SigmaRegion, ...]] | None
    """By region and joint; None if the bundle has no error scale."""
    events: Events | None
    touches: Touches | None
    loss_history: tuple[tuple[int, float, float], ...] | None
    """Step, training loss, validation loss; None if nothing was recorded."""
    changed_since_training: dict[str, str]
    """Steps after its training, and their results as text."""
    forces: DetectedForces

    @property
    def model(self) -> str | None:
        """The paper's model that it is of, by its name."""
        return model_of(self.name)

    @property
    def label(self) -> str:
        return bundle_label(self.name, self.recipe)

    @property
    def verdicts(self) -> dict[str, CollisionVerdict]:
        """Verdicts by collision id."""
        return {one.id: one for one in self.collisions}


ROOM, SHOWN = 7, 5
"""Largest number of bundles in figures with one column per bundle; of more, the first few are shown."""


@dataclass(frozen=True)
class Results:
    """One run of `tauext evaluate`."""

    format: int
    provenance: dict[str, Any]
    joints: tuple[str, ...]
    near_stiction_rad_s: float
    ten_collisions: tuple[str, ...]
    collisions: tuple[LabelledCollision, ...]
    bundles: tuple[EvaluatedBundle, ...]
    """As read in the paper's order, whatever the order of evaluation; other names follow."""
    own_torque: OwnTorqueEvents | None
    sanity: tuple[SanityRow, ...]
    others: tuple[OtherEvents, ...] = ()
    unknown_contact_hours: Number = None
    """Hours of the recordings that count neither as free motion nor as contact: contact = -1."""

    @property
    def ten(self) -> tuple[LabelledCollision, ...]:
        """The chosen ones, in their order."""
        known = {one.id: one for one in self.collisions}
        return tuple(known[one] for one in self.ten_collisions if one in known)

    @property
    def shown(self) -> tuple[EvaluatedBundle, ...]:
        """Bundles shown in figures with a column, a lane or a curve over time for each: all, or the first few.

        Of the paper's models, all of which were trained by two recipes, those of the case's own name.
        """
        if len(self.bundles) <= ROOM:
            return self.bundles
        own = tuple(bundle for bundle in self.bundles if bundle.name == bundle.model)
        return own if len(own) == SHOWN else self.bundles[:SHOWN]

    @property
    def shown_note(self) -> str:
        """A sentence for the caption of such a figure; empty if all are shown."""
        left = len(self.bundles) - len(self.shown)
        first = "the first " if self.shown == self.bundles[: len(self.shown)] else ""
        return f" Only {first}{len(self.shown)} of {len(self.bundles)} bundles are drawn." if left else ""

    @property
    def some_limits_move(self) -> bool:
        return any(bundle.limits.moving for bundle in self.bundles)

    @property
    def unit(self) -> str:
        """Unit of torques in headings: one for all joints and bundles, or a note that each has its own."""
        return of_all([unit for bundle in self.bundles for unit in bundle.estimate_units])

    def unit_of(self, joint: int) -> str:
        """Unit of one joint's torque."""
        return of_all([bundle.estimate_units[joint] for bundle in self.bundles])

    @property
    def units_note(self) -> str:
        """Units of the bundles' answers if not all are in Nm; else empty."""
        if self.unit == "Nm":
            return ""
        units = {
            bundle.label: ", ".join(
                f"{name} in {short(unit)}" for name, unit in zip(self.joints, bundle.estimate_units, strict=True)
            )
            for bundle in self.bundles
            if bundle.estimate_units
        }
        if len(set(units.values())) == 1:
            return f"All bundles answer {next(iter(units.values()))}."
        return "".join(f"{label} answers {of_joints}. " for label, of_joints in units.items()).strip()

    @property
    def labels(self) -> dict[str, str]:
        """Labels of the bundles, by their names."""
        return {bundle.name: bundle.label for bundle in self.bundles}

    def bundle(self, name: str) -> EvaluatedBundle:
        """The bundle with this name, else the first of that model, else the first that is not a plain observer."""
        alike = [bundle for bundle in self.bundles if bundle.name == name] or [
            c for c in self.bundles if c.model == name
        ]
        learned = [bundle for bundle in self.bundles if bundle.recipe != "observer"]
        return (alike or learned or list(self.bundles))[0]


# --- The file.


def load_results(folder: Path) -> Results:
    """Read `results.json` of a results folder. A number that is null or absent becomes None.

    Raises:
        ConfigError: no such file, not JSON, another format, or an entry of the wrong kind, with its place.
    """
    path = folder / "results.json"
    try:
        content = json_of(read_text(path), refuse_constant)
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: there are no such results; `tauext evaluate` writes them") from error
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: not readable as JSON ({error}); evaluate again") from error
    expect_format(content, path, "evaluate again")
    return results_of(content, str(path))


def refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON number; null stands for a number that does not exist")


def results_of(content: dict[str, Any], path: str) -> Results:
    """The content of results.json.

    Raises:
        ConfigError: an entry of the wrong kind, with its place.
    """
    joints = content.get("joints")
    for what in ("joints", "bundles"):
        if not content.get(what):
            raise ConfigError(f"{path}: it holds no {what}; evaluate at least one bundle")
    size = len(joints) if isinstance(joints, list) else 0
    read: Results = JsonReader(size).object(Results, content, path)
    for k, bundle in enumerate(read.bundles):
        if len(bundle.estimate_units) != size:
            raise ConfigError(f"{path}, bundles[{k}]: 'estimate_units' must be a list of {size} texts, one a joint")
        regions = bundle.error_against_sigma
        if regions and any(len(regions.get(name, ())) != size for name in ("sliding", "near_stiction")):
            where = f"{path}, bundles[{k}], error_against_sigma"
            raise ConfigError(f"{where}: each region must hold {size} entries, one a joint")
    return replace(read, bundles=tuple(sorted(read.bundles, key=lambda one: place(one.name))))
