"""What the demo's rig is taught in tests: a minute of motion, no network; and an arm that need not be taught."""

from dataclasses import replace

from tauext.config import AlarmConfig, PriorConfig, TrainConfig
from tauext.page.bundles import Lesson
from tauext.sim.arms import ARMS, DemoArm

SHORT = Lesson(
    recordings=4,
    recording_s=15.0,
    validation=1,
    prior_recordings=4,
    methods={
        "tauext": TrainConfig(
            recipe="prior", alarm=AlarmConfig(friction_reserve=0.1), prior=PriorConfig(most_ripples=0)
        ),
        "observer": TrainConfig(recipe="observer"),
    },
)


def smooth_arm() -> DemoArm:
    """The seven-axis arm without friction: an observer knows all of it, and nothing needs to be trained."""
    seven = ARMS["seven"]()
    little = {"coulomb_nm": 1e-4, "static_nm": 1.2e-4, "viscous_nm_s_rad": 0.0, "ripple_nm": 0.0}
    return replace(seven, friction=tuple(replace(friction, **little) for friction in seven.friction))
