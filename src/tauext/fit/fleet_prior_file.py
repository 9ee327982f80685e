"""A fleet prior's file: JSON that says what arms it is of, and holds a mean and a covariance block by block."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, fields
from typing import Any

import numpy as np

from tauext import _core
from tauext.errors import ConfigError
from tauext.files.place import Place
from tauext.files.plain_file import json_of, read_text
from tauext.files.provenance import json_text, write_json
from tauext.fit.fleet_prior import ArmType, FleetDays, FleetErrors, FleetPrior
from tauext.fit.map_regression import WeightPrior
from tauext.robot.inertial import PARAMETERS

LEAST_MEMORY_S, MOST_MEMORY_S = 1e-3, 1e4
"""Of errors that go on in one direction: a sample of the fastest loop, and hours."""
FORMAT = 1
SUFFIX = ".prior.json"
OPTIONAL = ("trust", "errors", "coverage", "days")
COVERAGE = ("fastest_rad_s", "turns", "centre_rad", "span_rad", "seen", "reach", "seen_together", "reach_together")


def write_fleet_prior(prior: FleetPrior, path: Place) -> None:
    """Write the file, whole or not at all.

    Raises:
        ConfigError: its name does not end in .prior.json, or it cannot be written.
    """
    expect_name(path)
    try:
        write_json(content(prior), path)
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error


def expect_name(path: Place) -> None:
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


def load_fleet_prior(path: Place) -> FleetPrior:
    """The fleet prior in a file.

    Raises:
        ConfigError: there is no such file, or it is none of these.
    """
    try:
        text = read_text(path)
        raw = json_of(text)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: not a readable fleet prior ({error}); `tauext fleet prior` makes one") from error
    if not isinstance(raw, dict) or raw.get("format") != FORMAT:
        told = raw.get("format") if isinstance(raw, dict) else None
        raise ConfigError(f"{path}: format = {told} of a fleet prior must be {FORMAT}; `tauext fleet prior` makes one")
    try:
        prior = parsed(raw, hashlib.sha256(text.encode()).hexdigest())
        expect_sound(prior)
    except (KeyError, TypeError, ValueError, AttributeError, IndexError, OverflowError) as error:
        why = " ".join(f"{type(error).__name__}: {error}".split())
        raise ConfigError(f"{path}: not a readable fleet prior ({why}); `tauext fleet prior` makes one") from error
    return prior


def parsed(raw: Mapping[str, Any], sha256: str) -> FleetPrior:
    """What the JSON says; a KeyError, TypeError or ValueError of whatever is missing."""
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
    days = None if raw.get("days") is None else days_of(raw["days"], len(own))
    widths = tuple(float(width) for width in raw["widths_rad"])
    return FleetPrior(kind, float(raw["gain_per_s"]), widths, own, weights, errors, coverage, days, kept, sha256)


def hashable(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def errors_of(raw: Mapping[str, Any], joints: int) -> FleetErrors:
    """The errors of new arms; ValueError where they are not one a joint."""
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
    """How days differ; ValueError where that is no covariance of so many joints."""
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
    """Raise ValueError where the numbers are none of a distribution."""
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


def same_bytes(prior: FleetPrior) -> str:
    """The text that the file holds."""
    return json_text(content(prior))
