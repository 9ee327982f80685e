"""What the demo's rig is taught in tests: a minute of motion, and no network."""

from tauext.config import AlarmConfig, PriorConfig, TrainConfig
from tauext.demo.bundles import Lesson

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
