"""Settings with their defaults. The docstring under a field is its help text."""

from __future__ import annotations

import functools
import inspect
import math
import numbers
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from types import NoneType, UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    Literal,
    NamedTuple,
    ParamSpec,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from tauext.errors import ConfigError
from tauext.recipes import Recipe, recipe_of, summaries

Backend = Literal["core", "torch"]
LimitsKind = Literal["auto", "asked", "promised", "supported", "paper"]
OnOff = Literal["on", "off"]
PAPER_GAIN_PER_S = 20.0
"""Observer gain of [Lim2021]."""
MOST_HIDDEN = 256
"""Units of a network that the core runs."""
MOST_THREADS = 1024
"""Upper bound, above any processor's cores: every thread takes memory."""
LARGEST_SEED = 2**63 - 1
MOST_STEPS = 10**12
"""Largest number of training steps: more would run for years on any machine."""


# --- Rules of values beyond their types, for annotations.


class Rule(NamedTuple):
    """A rule beyond the type of an annotation: `Annotated[float, Rule(" > 0", lambda value: value > 0)]`."""

    words: str
    """Follow the type in messages."""
    holds: Callable[[Any], Any]


def within(lowest: float, highest: float) -> Rule:
    """Rule of a number from lowest to highest, both included."""
    return Rule(f" from {lowest:g} to {highest:g}", lambda value: lowest <= value <= highest)


def above(lowest: float, highest: float = math.inf) -> Rule:
    """Rule of a number above lowest and at most highest."""
    most = f", at most {highest:g}" if highest < math.inf else ""
    return Rule(f" > {lowest:g}{most}", lambda value: lowest < value <= highest)


AT_LEAST_0 = Rule(" >= 0", lambda value: value >= 0)
NOT_0 = Rule(", not 0", bool)
NOT_EMPTY = Rule(", not empty", lambda value: value.strip() if isinstance(value, str) else value)
Positive = Annotated[float, above(0, 1e6)]
Share = Annotated[float, within(0, 1)]
PositiveShare = Annotated[float, above(0, 1)]
Seconds = Annotated[float, within(0, 60)]
Count = Annotated[int, within(1, MOST_STEPS)]
Threads = Annotated[int, within(0, MOST_THREADS)]
Seed = Annotated[int, within(0, LARGEST_SEED)]


def rising(values: tuple[float, ...], most: float, above: float = -math.inf) -> bool:
    """Whether numbers rise from one to the next, above a bound and up to another one."""
    return all(a < b <= most for a, b in pairwise((above, *values)))


Widths = Annotated[
    tuple[float, ...], Rule(", at most 8, rising, > 0, at most 1000", lambda w: len(w) <= 8 and rising(w, 1e3, 0))
]
Holds = Annotated[
    tuple[float, ...], Rule(", one or more, rising from 0 to 60", lambda t: len(t) > 0 and t[0] >= 0 and rising(t, 60))
]


@dataclass(frozen=True)
class Settings:
    """Settings whose fields are of the types and within the rules of their annotations."""

    def __post_init__(self) -> None:
        expect_types(vars(self), type(self))


# --- The settings.


@dataclass(frozen=True)
class ModelCase:
    """Difference of the estimated model from the robot file, as of the paper's perturbed models."""

    name: str
    mass_factor: float = 1.0
    """Factor on every link's mass; the inertia about its centre of mass is unchanged."""
    com_factor: float = 1.0
    """Factor on the distance of every centre of mass from its joint."""
    no_model: bool = False
    """Whether the model is zero throughout, rotor inertia included: the observer's residual is minus the low-passed
    motor torque."""


PAPER_CASES = {
    case.name: case
    for case in (
        ModelCase("exact"),
        ModelCase("mass", mass_factor=0.5),
        ModelCase("com", com_factor=0.5),
        ModelCase("mass+com", mass_factor=0.5, com_factor=0.5),
        ModelCase("none", no_model=True),
    )
}

# Choices from the table, as the help lists them. Type checkers need literal choices and accept any name here.
if TYPE_CHECKING:
    CaseName = str
else:
    CaseName = Literal[tuple(PAPER_CASES)]


@dataclass(frozen=True)
class ObserverConfig(Settings):
    """The momentum observer and the rates of the chain."""

    gain_per_s: Positive | Literal["auto"] | None = None
    """Observer gain K0, [1/s]: the residual lags the true disturbance by 1/K0. auto: the one of 20, 50 and 100 that
    detects a hit soonest, by the errors on left-out motion (recipes tauext and prior). None: auto for these two, the
    paper's 20 for the others."""
    network_period_s: Positive = 0.01
    """Wanted time between two network steps, [s]; the nearest whole multiple of the sample period is used."""
    window_s: Positive = 1.0
    """Wanted length of the network's window, [s]."""
    near_stiction_rad_s: Positive = 0.02
    """Below this joint speed, [rad/s], a joint counts as near stiction and has a threshold of its own."""

    @property
    def first_gain_per_s(self) -> float:
        """K0 as a number, [1/s]; the paper's value while it is still to be chosen."""
        return self.gain_per_s if isinstance(self.gain_per_s, int | float) else PAPER_GAIN_PER_S

    def sample_period_ns(self, rate_hz: float) -> int:
        """Sample period of a recording of this rate, [ns]."""
        return round(1e9 / rate_hz)

    def network_stride(self, rate_hz: float) -> int:
        """Samples in a network period: the whole number of sample periods nearest to it, at least 1."""
        return max(1, round(self.network_period_s * rate_hz))

    def window_steps(self, rate_hz: float) -> int:
        """Network steps in a window, at least 1."""
        return max(1, round(self.window_s * rate_hz / self.network_stride(rate_hz)))


@dataclass(frozen=True)
class FreeMotionConfig(Settings):
    """Margins around labelled contacts; the motion between them is used."""

    before_s: Seconds = 0.2
    """Time left out before a labelled contact, since labels may come late, [s]."""
    after_s: Seconds = 1.0
    """Time left out after a labelled contact, until it has left filters and windows, [s]."""


@dataclass(frozen=True)
class AlarmConfig(Settings):
    """Conditions of an alarm, and the target false alarm rate."""

    false_alarms: Annotated[float, within(1e-6, 1e6)] = 1.0
    """Largest number of false collisions of the whole arm in in_hours. With calibration recordings, thresholds and hold
    time follow from it."""
    in_hours: Annotated[float, within(1e-6, 1e6)] = 8.0
    """Time in which at most false_alarms false collisions may occur, [h]."""
    confidence: Annotated[float, Rule(" from 0.5 to below 1", lambda value: 0.5 <= value < 1)] = 0.95
    """Confidence that false_alarms in in_hours is not exceeded, 0.5 to below 1."""
    contacts_an_hour: Annotated[float, within(1e-6, 1e6)] = 2.0
    """Largest number of false contacts of the whole arm an hour; a contact ends by itself."""
    holds_s: Holds = (0.0, 0.002, 0.005, 0.01, 0.02)
    """Hold times of a collision from which calibration chooses, [s]; a longer one allows lower thresholds."""
    friction_reserve: Share = 0.2
    """Share of each joint's friction added to constant thresholds without calibration recordings: minutes of one day do
    not show how friction changes with temperature and time."""
    minutes_factor: Annotated[float, within(1, 10)] = 1.4
    """Factor on adaptive thresholds without calibration recordings, for the same reason. With T minutes of
    motion it is 1 + (factor - 1)(1 - e^(-T/4)), since friction_reserve covers the first minutes."""
    after_contact_factor: Annotated[float, within(1, 10)] = 2.0
    """Factor on the thresholds of a joint pushed while stuck, from the end of the contact until the joint has slid: its
    motion does not determine its friction (recipes tauext and prior); 1: none."""
    collision_hold_s: Seconds = 0.01
    """Time that a joint must stay over its collision threshold before a collision is reported, without calibration
    recordings, [s]."""
    contact_hold_s: Seconds = 0.0
    """Time that a joint must stay over its contact threshold before a contact is reported, [s]; 0: the first sample
    reports it."""
    contact_release_s: Seconds = 0.5
    """Time that all joints must stay within their thresholds before a contact ends, [s]. Observer and freed arm settle
    for half a second, which would otherwise sometimes count as another contact."""


@dataclass(frozen=True)
class PriorConfig(Settings):
    """Physics that is fitted before a network is trained (recipe tauext)."""

    widths_rad: Widths = (1e-4, 3e-4, 1e-3, 3e-3, 1e-2)
    """Widths of the presliding states, [rad]: how far a joint bends before it slides."""
    drop_widths: bool = True
    """Leave out widths below the encoder's resolution and those that do not help on held-out recordings."""
    region_width_rad: Annotated[float, above(0, 10)] = 0.003
    """Distance that a joint must slide after a reversal before its threshold for sliding applies, [rad]; until then it
    is near stiction."""
    coulomb_speeds_rad_s: Annotated[Widths, NOT_EMPTY] = (0.003, 0.01, 0.03, 0.06, 0.1, 0.2, 0.4, 1.5)
    """Widths of the smoothed sign of the speed, [rad/s]; the widest models viscous friction that grows less than the
    speed."""
    most_ripples: Annotated[int, within(0, 10)] = 2
    """Largest number of motor and gear ripples fitted to each joint; 0: none."""
    correct_model: bool = True
    """Let the data correct mass, centre of mass and inertia of the estimated model."""
    find_kinematics: bool = True
    """Without a model, find the arm's axes and link lengths from its motion."""
    follow_temperature: bool = True
    """Let friction follow recorded joint temperatures if that helps on held-out motion."""


@dataclass(frozen=True)
class DriftConfig(Settings):
    """The adaptive bias: a tracker of slow changes of friction and offset (recipes tauext and prior)."""

    time_constant_s: Annotated[
        float, Rule(": 0 (no tracker) or 1 to 1e6", lambda value: value == 0 or 1 <= value <= 1e6)
    ] = 120.0
    """Time constant of the adaptive bias, [s], at least 1; 0: no tracker."""
    size_share: Annotated[float, within(0, 1e6)] = 0.3
    """Bound of each of a joint's three bias coefficients, as a share of its friction at 0.5 rad/s."""
    least_size_nm: Annotated[float, within(0, 1e6)] = 0.1
    """Least bound of a bias coefficient, where size_share of the friction is smaller, [N m]."""
    rate_share_per_s: PositiveShare = 1 / 60
    """Largest change of a bias coefficient in a second, as a share of its bound."""
    freeze_share: PositiveShare = 0.5
    """Share of a joint's threshold, above 0 and at most 1: the tracker pauses while |tau_ext| of any joint is
    above it."""
    freeze_s: Seconds = 1.0
    """Time for which the tracker stays paused after a joint was over freeze_share of its threshold, [s]."""
    freeze_floor_share: PositiveShare = 0.4
    """To pause the tracker, |tau_ext| must also be above this share of a coefficient's bound. Adaptive thresholds
    are so low in easy motion that the adaptive bias alone exceeds them."""
    most_frozen: Annotated[float, Rule(" > 0, below 1", lambda value: 0 < value < 1)] = 0.03
    """Largest share of free motion in which the tracker is paused; the threshold of |tau_ext| is raised to keep it."""
    friction_share: Annotated[float, within(0, 9)] = 1.5
    """Friction that is followed within some strokes, even during contact: 1 / (1 + this) to 1 + this times the friction
    of training (0: none is). Needs adaptive thresholds."""


@dataclass(frozen=True)
class FilterConfig(Settings):
    """Filters of the observer's r, which distinguish a collision from a model error by how fast it changes (recipes
    highpass and bandpass)."""

    high_pass_per_s: Positive = 5.0
    """Cut-off of the first-order high-pass of recipes highpass and bandpass, [1/s]: slower changes count as model
    error."""
    low_pass_per_s: Positive = 60.0
    """Cut-off of the first-order low-pass of recipe bandpass, [1/s]; above the observer's gain, itself a low-pass."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            self.low_pass_per_s > self.high_pass_per_s,
            "low_pass_per_s",
            self.low_pass_per_s,
            f"> high_pass_per_s = {self.high_pass_per_s:g}",
        )


@dataclass(frozen=True)
class TrainConfig(Settings):
    """Settings of a training. None: the recipe's own value."""

    recipe: str = field(default="prior", metadata={"choices": summaries})
    """Method to train."""
    minutes: Annotated[float, above(0, 1e9)] | None = None
    """Minutes of the training recordings to train on, the first ones, with a fifth as many (at least one) of the
    validation recordings; None: all."""
    hidden: Annotated[int, within(1, MOST_HIDDEN)] = 20
    """Hidden units of the LSTM."""
    epochs: Count | None = None
    """Passes over all training windows, recipe paper only (None: 500); other recipes draw windows at random."""
    max_steps: Count | None = None
    """Steps after which training stops (None: paper by its epochs; dense 90,000; tauext 10,000)."""
    batch: Count | None = None
    """Windows or sequences a training step (None: paper 1000, dense 32, tauext 64)."""
    learning_rate: Annotated[float, above(0, 1e3)] | None = None
    """Step size of Adam, whose decay rates are 0.9 and 0.999 (dense: 0.99); all recipes but paper rise to it and fall
    to zero (None: paper 0.001, dense and tauext 0.01)."""
    targets: Count | None = None
    """Targets of a sequence, at its last steps (None: dense 140, of which 40 come before a whole window of 100 steps;
    tauext 100, all of them after a whole window)."""
    gate_margin: Annotated[float, Rule(" from 0 to below 1", lambda value: 0 <= value < 1)] = 0.03
    """Share by which the network must lower a joint's RMSE on validation recordings to be used for it (recipe
    tauext)."""
    backend: Backend = "core"
    """Library that computes the gradient. core: C++. torch: PyTorch, on a GPU where there is one (package
    tauext-lab, `pip install torch`)."""
    seed: Seed = 0
    """Seed of the initial weights and of the order of the windows."""
    threads: Threads = 0
    """Threads that compute the gradient; 0: one a core. The result does not depend on it."""
    observer: ObserverConfig = field(default_factory=ObserverConfig)
    """The momentum observer and the rates of the chain."""
    limits: LimitsKind = "auto"
    """Method of finding thresholds. asked: for the permitted false alarms, extrapolated where the recordings do not
    prove them. promised: for the fewest that the dataset's calibration recordings prove. supported: for the fewest that
    validation recordings and held-out training motion prove. paper: the largest errors on validation recordings. auto:
    paper for the recipes paper and dense; else asked."""
    error_scale: OnOff | None = None
    """Whether thresholds follow the error predicted from the motion or are constants (None: on for recipes tauext and
    prior, off for the others)."""
    fit_torque_constants: bool | None = None
    """Treat the recordings' tau as motor current or another multiple of torque. Find one constant a joint, from the
    model or from the arm's own motion. None: where the recordings are currents; given constants are corrected."""
    load_frame: str | None = None
    """Link (URDF) or body (MJCF) in whose frame the payload is given to the monitor. None: the last one that is
    fixed behind the last joint, such as tool0, else the last joint's own."""
    torque_constants: (
        Annotated[
            tuple[float, ...], Rule(", of a size from 1e-9 to 1e9", lambda k: all(1e-9 <= abs(v) <= 1e9 for v in k))
        ]
        | None
    ) = None
    """Known torque constants, one a joint, N m a unit of the recordings' tau, used unchanged (`tauext load --known-kg`
    finds some). None: --fit-torque-constants decides."""
    torque_share: Share = 0.05
    """Relative standard error of the recordings' torques where training finds no constants; it bounds the accuracy of
    forces (Monitor.wrench). Measured torques and makers' constants are off by 5 to 10 %, sensors checked with weights
    by less."""
    margins: FreeMotionConfig = field(default_factory=FreeMotionConfig)
    """Margins around labelled contacts."""
    alarm: AlarmConfig = field(default_factory=AlarmConfig)
    """Permitted rate of false alarms, and conditions of an alarm."""
    prior: PriorConfig = field(default_factory=PriorConfig)
    """Terms and fit of the prior."""
    drift: DriftConfig = field(default_factory=DriftConfig)
    """The tracker of slow changes."""
    filters: FilterConfig = field(default_factory=FilterConfig)
    """Rates of the filters of recipes highpass and bandpass."""

    def __post_init__(self) -> None:
        super().__post_init__()
        recipe_of(self.recipe)
        drawn = self.row.draws
        require(
            self.observer.gain_per_s != "auto" or self.row.chooses_gain,
            "observer.gain_per_s",
            "auto",
            f"a number with recipe {self.recipe}: recipes tauext and prior choose",
        )
        unused = ["epochs"] if drawn else []
        unused += ["epochs", "max_steps", "batch"] if self.row.network is None else []
        for name in unused:
            value = getattr(self, name)
            require(value is None, name, value, f"left out with recipe {self.recipe}, which does not use it")
        alone = self.torque_constants is None or self.fit_torque_constants is None
        require(alone, "fit_torque_constants", self.fit_torque_constants, "left out with torque_constants")

    @property
    def row(self) -> Recipe:
        """The recipe: its row of the table."""
        return recipe_of(self.recipe)

    @property
    def warm_up_s(self) -> float:
        """Warm-up of the recipe's observer and low-pass, [s]."""
        return warm_up_s(self.observer.first_gain_per_s, self.filters.low_pass_per_s if self.row.low_pass else 0.0)

    def resolved(self) -> TrainConfig:
        """The settings with the recipe's values for None."""
        own: Mapping[str, Any] = {"error_scale": "on" if self.row.error_scale else "off"} | dict(self.row.defaults)
        filled = replace(self, **{name: value for name, value in own.items() if getattr(self, name) is None})
        if self.observer.gain_per_s is not None:
            return filled
        gain: Any = "auto" if self.row.chooses_gain else PAPER_GAIN_PER_S
        return replace(filled, observer=replace(self.observer, gain_per_s=gain))


def warm_up_s(gain_per_s: float, low_pass_per_s: float = 0.0) -> float:
    """Time after which r counts as warmed up, [s]: its initial value has decayed to e^-10.

    That is 10/K0, or 10 over the rate of the low-pass behind the observer where that is slower (0: none). The velocity
    observer, where the inertia couples joints, takes longer.
    """
    return 10 / min(gain_per_s, low_pass_per_s or gain_per_s)


def require(ok: bool, name: str, value: object, rule: str) -> None:
    """Raise ConfigError `name = value must be rule` unless ok."""
    if not ok:
        raise ConfigError(f"{name} = {brief(value, str)} must be {rule}")


MOST_SHOWN = 60
"""Letters of a value in a message."""


def brief(value: object, as_text: Callable[[object], str] = repr) -> str:
    """The value for a message, in one line, shortened."""
    try:
        text = " ".join(as_text(value).split())
    except Exception:  # an object without a text, a whole number of more digits than Python prints
        text = f"an object of type {type(value).__name__}"
    return text if len(text) <= MOST_SHOWN else f"{text[:MOST_SHOWN]} ..."


# --- Values of a wrong type, refused before they are used. TOML files and callers in Python have the same rules.


NUMBERS = {bool: "true or false", int: "a whole number", float: "a number"}
NUMBER_KINDS: Mapping[type, type] = {int: numbers.Integral, float: numbers.Real}
"""NumPy's numbers are numbers, too."""
Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def fits(value: Any, hint: Any) -> bool:
    """Whether the value is of the type of an annotation; of containers, every value."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return fits(value, inner[0]) and all(one.holds(value) for one in inner[1:] if isinstance(one, Rule))
    if origin in (Union, UnionType):
        return any(fits(value, one) for one in inner)
    if origin is Literal:
        return isinstance(value, str) and value in inner
    if origin is not None and issubclass(origin, Mapping):
        return isinstance(value, Mapping) and all(fits(k, inner[0]) and fits(v, inner[1]) for k, v in value.items())
    if origin is tuple and inner[-1] is not Ellipsis:
        same = isinstance(value, tuple) and len(value) == len(inner)
        return same and all(map(fits, value, inner))
    if origin is not None and issubclass(origin, Collection):
        whole = isinstance(value, origin) and not isinstance(value, str | bytes)
        return whole and all(fits(one, inner[0]) for one in value)
    if hint in NUMBER_KINDS:
        return isinstance(value, NUMBER_KINDS[hint]) and not isinstance(value, bool)
    if getattr(hint, "_is_protocol", False):
        return all(callable(getattr(value, name, None)) for name in vars(hint) if not name.startswith("_"))
    kind = origin or (NoneType if hint is None else hint)
    return isinstance(value, kind) if isinstance(kind, type) else True


def described(hint: Any) -> str:
    """The type and the rules of an annotation for a message."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return described(inner[0]) + "".join(one.words for one in inner[1:] if isinstance(one, Rule))
    if origin in (Union, UnionType):
        return " or ".join(described(choice) for choice in inner if choice is not NoneType)
    if origin is Literal:
        return f"one of {', '.join(map(str, inner))}" if len(inner) > 1 else f'"{inner[0]}"'
    if origin is tuple and inner[-1] is Ellipsis:
        return f"a list, each {described(inner[0])}"
    if origin is tuple:
        return f"a list of {len(inner)}, each {described(inner[0])}"
    if origin is dict:
        return "a table"
    if origin is not None and inner:
        return f"{origin.__name__} of {', '.join(map(described, inner))}"
    name = getattr(hint, "__name__", str(hint))
    return NUMBERS.get(hint) or {"str": "text", "Path": "a path", "dict": "a table"}.get(name, name)


@functools.cache
def annotations_of(thing: Any) -> dict[str, Any]:
    """The annotations of a class or function, with their rules."""
    return get_type_hints(thing, include_extras=True)


def expect_types(values: Mapping[str, Any], of: Any, before: str = "") -> None:
    """Raise ConfigError unless each value is of the type that its annotation in a class or function states."""
    hints = annotations_of(of)
    for name, value in values.items():
        if name in hints and not fits(value, hints[name]):
            raise ConfigError(f"{before}{name} = {brief(value)} must be {described(hints[name])}")


def checked(function: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    """A public function whose arguments are of the types of their annotations, or ConfigError names the first other."""
    takes = inspect.signature(function)

    @functools.wraps(function)
    def call(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        expect_types(takes.bind(*args, **kwargs).arguments, function, f"{function.__name__}: ")
        return function(*args, **kwargs)

    return call


def require_seed(seed: int) -> None:
    """Raise ConfigError unless every random generator accepts this seed."""
    require(0 <= seed <= LARGEST_SEED, "seed", seed, f">= 0, at most {LARGEST_SEED}")


def require_threads(threads: int) -> None:
    """Raise ConfigError unless the number of threads is valid; 0: one a core."""
    require(0 <= threads <= MOST_THREADS, "threads", threads, f"0 (one a core) to {MOST_THREADS}")
