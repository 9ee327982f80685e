"""Virtual arms in MuJoCo: what they are, how they move, what touches them, and the recordings that come of it."""

from tauext.rig.collect import simulate_dataset
from tauext.rig.config import RigConfig

__all__ = ["RigConfig", "simulate_dataset"]
