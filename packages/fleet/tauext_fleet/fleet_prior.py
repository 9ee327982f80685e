"""A fleet prior: mean and covariance of the weights of arms of one type, and its file."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from tauext import _core
from tauext.errors import ConfigError
from tauext.files.plain_file import FORMAT, expect_format, json_of, read_text
from tauext.files.provenance import write_json
from tauext.robot.inertial import PARAMETERS
from tauext_fleet.map_regression import WeightPrior

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
    """Number of arms with two recordings or more."""
    recordings: int
    """Number of recordings of these arms."""


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
    """SHA-256 of its file."""

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
    """Return the prior as plain JSON."""
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
