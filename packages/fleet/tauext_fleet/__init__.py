"""Many arms: their stages as tasks, and a prior for the next arm of a type.

In go folders of recordings, one an arm. Out come bundles, results and fleet priors.
"""

from tauext.cli.commands import Command

COMMAND = Command(
    "run all stages for many arms; fleet priors",
    commands={
        "run": Command("import, check, train, calibrate and evaluate every arm", "tauext_fleet.commands:run"),
        "example": Command("print an example of FLEET.toml", "tauext_fleet.commands:example"),
        "prior": Command("fit a prior for the next arm of a type from several arms", "tauext_fleet.commands:prior"),
    },
)
"""`tauext fleet`, found by its entry point."""
