"""A fleet prior: mean and covariance of the weights of arms of one type, its file, and a fit with it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from tauext import _core
from tauext.config import PriorConfig
from tauext.data.recording import Recording
from tauext.errors import ConfigError
from tauext.files.plain_file import FORMAT, expect_format, json_of, read_text
from tauext.files.provenance import write_json
from tauext.fit.prior import bound_loads, branches_of
from tauext.fit.prior_terms import PriorFit
from tauext.fit.regression import inverse
from tauext.fit.ridge import MapRegression, Regressors, WeightPrior, gather, solved
from tauext.fit.temperature import with_temperature
from tauext.fit.training_set import Setup, with_presliding
from tauext.robot.inertial import PARAMETERS

# --- Mean and covariance of the weights of many arms of one type: empirical Bayes by EM, robust to a bad arm.
#
# .. math:: w_{ab} \sim N(\mu_b, \Sigma_b / u_{ab}), \qquad y_a = X_a w_a + e_a
#
# a: an arm, b: a block of weights that vary together (friction of a joint, the inertial corrections of all links). u_ab
# is 1 for an arm like the others and falls with how far the arm's block is from those of the others, so steeply that a
# worn joint neither moves nor widens the estimate for all. Arms are few and weights many: Sigma_b is drawn
# towards its own diagonal, as if MORE_ARMS more had been seen whose weights vary independently.


ROUNDS = 60
SETTLED = 1e-3
"""Largest relative change of a block's total variance in the last round."""
MORE_ARMS = 4.0
CLOSE = 2.5
"""Standard deviations up to which an arm is like the others: one healthy arm in 160 is farther away ..."""
STEEP = 6
"""... from where its trust falls with this power of the distance: with the fourth of Mahalanobis', so that what a block
adds to the mean and to the covariance falls, too."""
LEAST_ARMS = 5
"""Among fewer arms, no outlier can be identified."""
USUAL = 1.4826
"""Standard deviation per median distance from the median."""
COMMON, SINGLE = 0.3, 0.1
"""The first guess: all of a block moves by this share, and each weight by what shows as this share of the block."""
WEAK = 1e-2
"""Ridge of the mean that the first guess is about, by the rows."""


@dataclass(frozen=True)
class Evidence:
    """One arm's normal equations, each joint's rows counted by how sure they are: -2 log p = w G w - 2 w b + ..."""

    gram: np.ndarray  # (columns, columns)
    moment: np.ndarray  # (columns,)
    rows: float
    """Independent ones."""


@dataclass(frozen=True)
class Hierarchy:
    """Distribution of an arm type's weights, and each arm's own weights."""

    mean: np.ndarray  # (columns,)
    covariance: np.ndarray  # (columns, columns), block by block: of one more arm
    trust: np.ndarray  # (arms, blocks), u: 1 for an arm like the others
    weights: np.ndarray  # (arms, columns): each arm's own
    errors: np.ndarray  # (arms, columns, columns): their covariance


def learn_hierarchy(evidence: Sequence[Evidence], blocks: Sequence[np.ndarray]) -> Hierarchy:
    """Mean, covariance and trust at the maximum of the likelihood, by EM.

    Args:
        evidence: of at least two arms.
        blocks: columns of each, together all that any arm excites; other columns stay 0.
    """
    width = len(evidence[0].moment)
    scale = scale_of(evidence)
    excited = scale > 0
    inside = [at[excited[at]] for at in blocks]
    scaled = [Evidence(one.gram / outer(scale), one.moment / floor(scale), one.rows) for one in evidence]
    mean, covariance = first_guess(scaled, inside)
    trust = np.ones((len(evidence), len(blocks)))
    distance = np.zeros_like(trust)
    for _ in range(ROUNDS):
        w, V = expected(scaled, mean, covariance, trust, inside)
        alone = expected(scaled, mean, covariance, np.ones_like(trust), inside)
        distance = distances(*alone, moments_without(w, V, trust, inside), inside)
        trust = trust_of(distance)
        before = covariance
        mean, covariance = moments(w, V, trust, inside)
        if settled(before, covariance, inside):
            break
    w, V = expected(scaled, mean, covariance, trust, inside)
    predictive = np.zeros((width, width))
    for b, at in enumerate(inside):
        predictive[np.ix_(at, at)] = covariance[np.ix_(at, at)] * (1 + 1 / trust[:, b].sum())
    back = 1 / floor(scale)
    return Hierarchy(mean * back, predictive * np.outer(back, back), trust, w * back, V * np.outer(back, back))


def scale_of(evidence: Sequence[Evidence]) -> np.ndarray:
    """RMS of each column over the fleet, in standard errors of a row, (columns,); 0: no arm excites it."""
    mean = np.mean([np.diag(one.gram) / max(one.rows, 1.0) for one in evidence], axis=0)
    largest = float(mean.max(initial=0.0))
    return np.sqrt(np.where(mean > 1e-14 * largest, mean, 0.0))


def floor(scale: np.ndarray) -> np.ndarray:
    """The scale, 1 where it is 0."""
    return np.where(scale > 0, scale, 1.0)


def outer(scale: np.ndarray) -> np.ndarray:
    return np.outer(floor(scale), floor(scale))


def first_guess(evidence: Sequence[Evidence], blocks: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """First guess: the mean of all arms as if they were one, and a covariance about it."""
    gram = np.sum([one.gram for one in evidence], axis=0)
    moment = np.sum([one.moment for one in evidence], axis=0)
    rows = sum(one.rows for one in evidence)
    mean, covariance = np.zeros(len(moment)), np.zeros_like(gram)
    used = np.concatenate(blocks)
    ridge = WEAK * rows * np.eye(len(used))
    mean[used] = np.linalg.solve(gram[np.ix_(used, used)] + ridge, moment[used])
    for at in blocks:
        own, block = mean[at], gram[np.ix_(at, at)] / rows
        size = max(float(np.sqrt(max(own @ block @ own, 0.0))), 1.0)
        covariance[np.ix_(at, at)] = COMMON**2 * np.outer(own, own) + (SINGLE * size) ** 2 * np.eye(len(at))
    return mean, covariance


def expected(
    evidence: Sequence[Evidence],
    mean: np.ndarray,
    covariance: np.ndarray,
    trust: np.ndarray,
    blocks: Sequence[np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Each arm's weights (arms, columns) by its data and the fleet, and their covariance (arms, columns, columns)."""
    used = np.concatenate(blocks)
    w, V = np.tile(mean, (len(evidence), 1)), np.zeros((len(evidence), *covariance.shape))
    precision = [inverse(covariance[np.ix_(at, at)]) for at in blocks]
    for a, one in enumerate(evidence):
        information, right = one.gram.copy(), one.moment.copy()
        for b, at in enumerate(blocks):
            own = trust[a, b] * precision[b]
            information[np.ix_(at, at)] += own
            right[at] += own @ mean[at]
        V[a][np.ix_(used, used)] = inverse(information[np.ix_(used, used)])
        w[a, used] = V[a][np.ix_(used, used)] @ right[used]
    return w, V


def moments(
    w: np.ndarray, V: np.ndarray, trust: np.ndarray, blocks: Sequence[np.ndarray], without: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance of the arms' weights, all or without one."""
    arms = np.array([a for a in range(len(w)) if a != without])
    mean, covariance = np.zeros(w.shape[1]), np.zeros(V.shape[1:])
    for b, at in enumerate(blocks):
        u, own = trust[arms, b], w[np.ix_(arms, at)]
        mean[at] = u @ own / u.sum()
        apart = own - mean[at]
        spread = (u[:, None] * apart).T @ apart + np.einsum("a,aij->ij", u, V[np.ix_(arms, at, at)])
        share = len(arms) / (len(arms) + MORE_ARMS)
        spread = spread / len(arms)
        covariance[np.ix_(at, at)] = share * spread + (1 - share) * np.diag(np.diag(spread))
    return mean, covariance


Moments = tuple[np.ndarray, np.ndarray]


def moments_without(w: np.ndarray, V: np.ndarray, trust: np.ndarray, blocks: Sequence[np.ndarray]) -> list[Moments]:
    """Mean and covariance of the other arms, for each arm; none with fewer than LEAST_ARMS."""
    return [moments(w, V, trust, blocks, without=a) for a in range(len(w))] if len(w) >= LEAST_ARMS else []


def distances(w: np.ndarray, V: np.ndarray, others: Sequence[Moments], blocks: Sequence[np.ndarray]) -> np.ndarray:
    r"""Distance of each arm's blocks from those of the other arms, (arms, blocks), in standard deviations.

    The squared distance of Mahalanobis is expected over what an arm's own data leave open; its cube root is normal, of
    mean 1 and variance 2 / (9 p) where p weights are as the others' [WilsonHilferty1931]_. Held against the median over
    the arms, since few arms make the covariance too small for one more of them.

    Args:
        w, V: of each arm as if it were trusted; an untrusted arm's wide errors would distort the distance.
        others: mean and covariance of the others, for each arm; none: all distances are 0.
    """
    squares = np.zeros((len(w), len(blocks)))
    if not others:
        return squares
    for a, (mean, covariance) in enumerate(others):
        for b, at in enumerate(blocks):
            precision = inverse(covariance[np.ix_(at, at)])
            apart = w[a, at] - mean[at]
            squares[a, b] = apart @ precision @ apart + float(np.sum(precision * V[a][np.ix_(at, at)]))
    middle = np.maximum(np.median(squares, axis=0), 1e-300)
    root = np.cbrt(squares / middle)
    usual = USUAL * np.median(np.abs(root - 1), axis=0)
    of_chance = np.sqrt(2 / (9 * np.array([max(len(at), 1) for at in blocks])))
    return (root - 1) / np.maximum(usual, of_chance)


def trust_of(distance: np.ndarray) -> np.ndarray:
    """1 up to CLOSE, falling beyond."""
    return (CLOSE / np.maximum(distance, CLOSE)) ** STEEP


def settled(before: np.ndarray, after: np.ndarray, blocks: Sequence[np.ndarray]) -> bool:
    """Whether no block's total variance changed by more than SETTLED."""
    pairs = [(np.diag(before)[at].sum(), np.diag(after)[at].sum()) for at in blocks]
    return all(abs(a - b) <= SETTLED * max(b, 1e-300) for a, b in pairs)


# --- What arms of one type have in common: terms, mean and covariance of the prior's weights, and errors of new arms.


@dataclass(frozen=True)
class ArmType:
    """Properties that arms of one type share; messages use the names of its fields."""

    joints: tuple[str, ...]
    case: str
    rate_hz: float
    network_stride: int
    torque_timing: str
    units: tuple[str, ...]
    """Unit of each joint's torque in the prior."""
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
    """A value for a message; digests are shortened."""
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
    """Errors of arms trained on one own minute and the others' prior, on the rest of their motion."""

    minutes: float  # of its own motion that each arm had
    hours: float  # of motion in which errors were counted
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
    facts: Mapping[str, Any]  # what the limits promise, as in a training's provenance


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
    """None: no arm has enough motion beyond the first minute."""
    coverage: _core.CoverageSettings | None = None
    """Motion of all arms together."""
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


# --- A fleet prior's file: JSON with the arms it was made of, and a mean and a covariance block by block.


LEAST_MEMORY_S, MOST_MEMORY_S = 1e-3, 1e4
"""Of errors that go on in one direction: a sample of the fastest loop, and hours."""
SUFFIX = ".prior.json"
OPTIONAL = ("trust", "errors", "coverage", "days")
COVERAGE = ("fastest_rad_s", "turns", "centre_rad", "span_rad", "seen", "reach", "seen_together", "reach_together")


def write_fleet_prior(prior: FleetPrior, path: Path) -> None:
    """Write the file, whole or not at all.

    Raises:
        ConfigError: its name does not end in .prior.json, or it cannot be written.
    """
    expect_name(path)
    try:
        write_json(content(prior), path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error


def expect_name(path: Path) -> None:
    """Raise ConfigError unless the name ends as a fleet prior's does."""
    if not path.name.endswith(SUFFIX):
        raise ConfigError(f"{path}: a fleet prior's name ends in {SUFFIX}")


def content(prior: FleetPrior) -> dict:
    """As plain JSON."""
    weights = prior.weights
    names = [*prior.type.joints, "links"]
    return {
        "format": FORMAT,
        **prior.facts,
        "type": asdict(prior.type),
        "gain_per_s": prior.gain_per_s,
        "widths_rad": list(prior.widths_rad),
        "terms": {
            joint: [[t.kind.name, t.a, t.b, t.c, t.form, t.speed] for t in group]
            for joint, group in zip(prior.type.joints, prior.own, strict=True)
        },
        "parameters": list(PARAMETERS),
        "weights": {
            name: {
                "mean": weights.mean[at].tolist(),
                "covariance": weights.covariance[np.ix_(at, at)].tolist(),
            }
            for name, at in zip(names, prior.blocks, strict=True)
        },
        "error_nm": weights.error_nm.tolist(),
        "memory_s": weights.memory_s.tolist(),
        "trust": weights.trust,
        "errors": None if prior.errors is None else plain(asdict(prior.errors)),
        "days": None if prior.days is None else plain(asdict(prior.days)),
        "coverage": None if prior.coverage is None else {name: getattr(prior.coverage, name) for name in COVERAGE},
    }


def plain(values: Mapping[str, Any]) -> dict:
    """Arrays as lists."""
    return {key: value.tolist() if isinstance(value, np.ndarray) else value for key, value in values.items()}


def load_fleet_prior(path: Path) -> FleetPrior:
    """Read a fleet prior's file.

    Raises:
        ConfigError: there is no such file, or is not a fleet prior.
    """
    try:
        text = read_text(path)
        raw = json_of(text)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: not a readable fleet prior ({error}); `tauext fleet prior` makes one") from error
    expect_format(raw, path, "`tauext fleet prior` makes one")
    try:
        prior = parsed(raw, hashlib.sha256(text.encode()).hexdigest())
        expect_sound(prior)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError) as error:
        why = " ".join(f"{type(error).__name__}: {error}".split())
        raise ConfigError(f"{path}: not a readable fleet prior ({why}); `tauext fleet prior` makes one") from error
    return prior


def parsed(raw: Mapping[str, Any], sha256: str) -> FleetPrior:
    """The JSON's content; a KeyError, TypeError or ValueError of whatever is missing."""
    of = raw["type"]
    kind = ArmType(**{one.name: hashable(of[one.name]) for one in fields(ArmType)})
    if tuple(raw["parameters"]) != PARAMETERS:
        raise ValueError(f"its links' parameters are not {', '.join(PARAMETERS)}")
    own = tuple(
        tuple(_core.Term(getattr(_core.TermKind, k), a, b, c, form, speed) for k, a, b, c, form, speed in group)
        for group in (raw["terms"][joint] for joint in kind.joints)
    )
    blocks = [raw["weights"][name] for name in (*kind.joints, "links")]
    sizes = [len(block["mean"]) for block in blocks]
    if sizes != [*map(len, own), len(PARAMETERS) * len(own)]:
        raise ValueError("its weights are not as many as its terms")
    covariance, first = np.zeros((sum(sizes), sum(sizes))), 0
    for block, size in zip(blocks, sizes, strict=True):
        covariance[first : first + size, first : first + size] = np.array(block["covariance"], dtype=float)
        first += size
    mean = np.concatenate([np.array(block["mean"], dtype=float) for block in blocks])
    error_nm, memory_s = (np.array(raw[name], dtype=float) for name in ("error_nm", "memory_s"))
    weights = WeightPrior(mean, covariance, error_nm, memory_s, float(raw["trust"]))
    named = ("format", "type", "gain_per_s", "widths_rad", "terms", "parameters", "weights", "error_nm", "memory_s")
    kept = {key: value for key, value in raw.items() if key not in (*named, *OPTIONAL)}
    errors = None if raw["errors"] is None else errors_of(raw["errors"], len(own))
    coverage = None if raw["coverage"] is None else coverage_of(raw["coverage"])
    days = None if raw["days"] is None else days_of(raw["days"], len(own))
    widths = tuple(float(width) for width in raw["widths_rad"])
    return FleetPrior(kind, float(raw["gain_per_s"]), widths, own, weights, errors, coverage, days, kept, sha256)


def hashable(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def errors_of(raw: Mapping[str, Any], joints: int) -> FleetErrors:
    """Errors of new arms; ValueError unless there is one per joint."""
    values: dict[str, Any] = {one.name: raw[one.name] for one in fields(FleetErrors)}
    values["features"] = tuple(values["features"])
    for name, value in values.items():
        if isinstance(value, list):
            values[name] = np.array(value, dtype=float)
            if len(value) != joints or not np.isfinite(values[name]).all():
                raise ValueError(f"{name} must be finite numbers, one a joint")
            if name.endswith("_limit_nm") and not (values[name] > 0).all():
                raise ValueError(f"{name} must be above 0")
    if not (isinstance(values["facts"]["sentence"], str) and values["facts"]["arms_factor"] >= 1):
        raise ValueError("facts must hold a sentence, and arms_factor >= 1")
    for name in values["features"]:
        getattr(_core.MotionFeature, name)
    return FleetErrors(**values)


def days_of(raw: Mapping[str, Any], joints: int) -> FleetDays:
    """Differences between days; ValueError unless it is a covariance of this many joints."""
    covariance = np.array(raw["covariance"], dtype=float)
    if covariance.shape != (joints, joints) or not np.isfinite(covariance).all():
        raise ValueError("days must have a finite covariance of the joints")
    if not np.allclose(covariance, covariance.T, atol=1e-12) or np.linalg.eigvalsh(covariance)[0] <= 0:
        raise ValueError("the covariance of days is not symmetric and positive")
    return FleetDays(covariance, int(raw["arms"]), int(raw["recordings"]))


def coverage_of(raw: Mapping[str, Any]) -> _core.CoverageSettings:
    """The motion that was seen."""
    settings = _core.CoverageSettings()
    for name in COVERAGE:
        setattr(settings, name, raw[name])
    return settings


def expect_sound(prior: FleetPrior) -> None:
    """Raise ValueError if the numbers are not a distribution."""
    weights, n = prior.weights, len(prior.own)
    for name, values in (("error_nm", weights.error_nm), ("memory_s", weights.memory_s)):
        if values.shape != (n,) or not (np.isfinite(values) & (values > 0)).all():
            raise ValueError(f"{name} must be numbers above 0, one a joint")
    if not ((weights.memory_s >= LEAST_MEMORY_S) & (weights.memory_s <= MOST_MEMORY_S)).all():
        raise ValueError(f"memory_s must be {LEAST_MEMORY_S:g} to {MOST_MEMORY_S:g}")
    if (np.diag(weights.covariance) < 0).any():
        raise ValueError("a variance is negative")
    if not (0 < weights.trust <= 1 and 0 < prior.gain_per_s < 1e6):
        raise ValueError("trust must be above 0, at most 1, and gain_per_s above 0")
    if not (np.isfinite(weights.mean).all() and np.isfinite(weights.covariance).all()):
        raise ValueError("weights must be finite")
    known = weights.known
    size = np.sqrt(np.diag(weights.covariance)[known])
    correlation = weights.covariance[np.ix_(known, known)] / np.outer(size, size)
    if not np.allclose(correlation, correlation.T, atol=1e-9) or np.linalg.eigvalsh(correlation)[0] <= 0:
        raise ValueError("a covariance is not symmetric and positive")


# --- Arms of a fleet beside one another.


ODD = 0.5
"""An arm's joint is the odd one whose trust is below this."""


def table(facts: dict) -> str:
    """Arms by joints: friction by the fleet's; * marks a joint that is not like the others'."""
    joints = list(facts["spread"])
    head = ["arm", "minutes", *joints, "links"]
    rows = [head]
    for one in facts["arms"]:
        cells = [
            "–" if factor is None else f"{factor:.2f} ± {error:.2f}{' *' * (one['trust'][joint] < ODD)}"
            for joint, (factor, error) in one["friction"].items()
        ]
        rows.append([one["name"], f"{one['minutes']:.1f}", *cells, "*" * (one["trust"]["links"] < ODD)])
    rows.append(["fleet, Nm", "", *(f"{of['friction_nm']:.3g}" for of in facts["spread"].values()), ""])
    spreads = [of["spread"] for of in facts["spread"].values()]
    rows.append(["arms differ by", "", *("–" if spread is None else f"{spread:.0%}" for spread in spreads), ""])
    widths = [max(len(row[k]) for row in rows) for k in range(len(head))]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)


# --- A prior from a minute of an arm's own motion and the fleet prior of its type.


def fit_like(setup: Setup, recordings: Sequence[Recording], config: PriorConfig, like: FleetPrior) -> PriorFit:
    """The most likely prior given this motion and the fleet; terms and widths are the fleet's.

    Every left-out fold is predicted from the fleet and the other folds.

    Args:
        setup: without a prior, of the fleet's type.

    Raises:
        TrainingError: no recording is longer than the observer's warm-up.
    """
    bent = with_presliding(setup, like.widths_rad)
    regressors = Regressors(like.own, corrected=bent.tree)
    found = gather(bent, recordings, regressors)
    period_s = 1e-9 * setup.observer.sample_period_ns * setup.observer.network_stride
    regression = MapRegression([problem for problem, _ in found], like.weights, period_s)
    fit = solved(bent, regression, found, regressors)
    for settings in (fit.settings, *(one.settings for one in fit.left_out)):
        settings.branches = branches_of(settings)
    bound_loads(bent, recordings, fit)
    return with_temperature(bent, recordings, fit) if config.follow_temperature else fit
