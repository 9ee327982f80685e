"""An arm's twin for simulation: the user's robot file with friction, rotor inertia and masses that motion showed."""

from tauext.cli.commands import Command

COMMAND = Command(
    "write the arm's robot file for simulation: friction, inertia and drive from its motion",
    "tauext_twin.commands:twin",
)
"""`tauext twin`, found by its entry point."""
