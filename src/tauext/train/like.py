"""A training that starts where a fleet of the same type already is."""

from __future__ import annotations

from dataclasses import replace

from tauext.config import TrainConfig
from tauext.errors import ConfigError
from tauext.fit.fleet_prior import ArmType, FleetPrior, links_digest
from tauext.fit.training_set import Setup
from tauext.recipes import FULL_PRIOR
from tauext.train.preparation import Job


def like_settings(config: TrainConfig, like: FleetPrior | None) -> TrainConfig:
    """The settings with the fleet's observer gain, unless a number was asked for.

    Raises:
        ConfigError: the recipe has no prior that a fleet could know.
    """
    if like is None:
        return config
    if config.row.fit != FULL_PRIOR["fit"]:
        raise ConfigError(f"like: recipe = {config.recipe} must be tauext or prior, whose weights a fleet prior holds")
    if isinstance(config.observer.gain_per_s, int | float):
        return config
    return replace(config, observer=replace(config.observer, gain_per_s=like.gain_per_s))


def arm_type(job: Job, setup: Setup) -> ArmType:
    """What a fleet's arms must have in common with this one."""
    training = job.training[0]
    return ArmType(
        joints=job.joints,
        case=job.case.name,
        rate_hz=round(float(training.rate_hz), 3),
        network_stride=setup.observer.network_stride,
        torque_timing=training.torque_timing,
        units=units_of(job),
        links=links_digest(job.tree),
    )


def units_of(job: Job) -> tuple[str, ...]:
    """Of each joint's torque as the prior sees it: newton metres, or what only this arm knows."""
    if job.constants is None:
        return (job.units.given.name,) * len(job.joints)
    unknown = job.units.unknown or [0] * len(job.joints)
    relative = job.units.relative_to >= 0
    return tuple("its own unit" if one or relative else "newton_metre" for one in unknown)


def expect_like(job: Job, setup: Setup) -> None:
    """Raise ConfigError where the fleet's arms are of another type than this one."""
    if job.like is not None:
        job.like.type.expect(arm_type(job, setup), "the fleet prior", job.name)


def like_facts(like: FleetPrior) -> dict:
    """For provenance: which fleet prior, by its content."""
    errors = like.errors
    return {
        "sha256": like.sha256,
        "arms": [one["name"] for one in like.facts.get("arms", [])],
        "trust": like.weights.trust,
        **({} if errors is None else {"judged_hours": errors.hours, "judged_minutes": errors.minutes}),
    }
