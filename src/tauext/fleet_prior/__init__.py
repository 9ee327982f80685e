"""What a fleet knows that an arm does not: many arms of one type make a prior for the next."""

from tauext.fleet_prior.arms import FleetArm, fleet_arms
from tauext.fleet_prior.stage import make_fleet_prior

__all__ = ["FleetArm", "fleet_arms", "make_fleet_prior"]
